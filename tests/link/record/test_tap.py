"""Protects the source of records: every message once, with the publisher's time, also messages from before
the tap joined.
"""

import json
import os
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh
from pymavlink.dialects.v20 import common as mavlink

from link.bus.keys import HEALTH, KEYS, MAVLINK_IN, MAVLINK_OUT, READING, WAYPOINT
from link.bus.session import Arrival, Bus
from link.record.record import SimulationClock
from link.record.tap import Tap
from tests.link.record.test_record import ATTITUDE, ENTRIES, UAV

pytestmark = pytest.mark.slow

MS = 1_000_000


def taken(tap: Tap, wait_until: Callable[..., None], count: int) -> list[Arrival]:
    """Take until this many messages have arrived, then once more, to notice duplicates."""
    messages: list[Arrival] = []
    wait_until(lambda: messages.extend(tap.take()) or len(messages) >= count)
    tap.settle(60.0)
    return messages + tap.take()


def plain(router: str, **more: object) -> Any:
    """A session of plain Zenoh, without our code."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([router]))
    for name, value in more.items():
        config.insert_json5(name.replace("__", "/"), json.dumps(value))
    return zenoh.open(config)


@pytest.fixture
def stranger(router: str) -> Iterator[zenoh.Session]:
    """One that puts the time to its messages."""
    with plain(router, timestamping__enabled=True) as session:
        yield session


def settle(stranger: zenoh.Session) -> None:
    """Wait until the router has taken what was said so far."""
    for _ in stranger.get("uav/1/nobody", timeout=60.0):
        pass


def heard_on(stranger: zenoh.Session, key: str, wait_until: Callable[..., None]) -> Any:
    """What publishes on a key, once somebody hears it."""
    publisher = stranger.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    wait_until(lambda: publisher.matching_status.matching)
    return publisher


def test_messages_from_before_one_joined_have_the_time_they_were_published_at(
    router: str, wait_until: Callable[..., None]
) -> None:
    with Bus("uav", router) as uav:
        times = [time.time_ns()]
        for number in range(500):
            uav.publish(READING, b"%d" % number)
            times.append(time.time_ns())
        uav.publish_health()
        wait_until(lambda: time.time_ns() > times[-1] + 50 * MS)
        joined = time.time_ns()
        with Tap("recorder", router) as tap:
            tap.subscribe(*KEYS)
            messages = taken(tap, wait_until, 501)
    assert [message.payload for message in messages[:-1]] == [b"%d" % number for number in range(500)]
    for message, (before, after) in zip(messages, pairwise(times), strict=False):
        assert (
            before - MS <= message.published_ns <= after + MS
        )  # Zenoh's clock may be ahead of the system's by less
    assert (messages[-1].key, messages[-1].name) == (HEALTH, "health/uav")
    assert all(message.published_ns < joined for message in messages)


def test_messages_of_many_are_taken_in_the_order_in_which_they_were_published(
    router: str, wait_until: Callable[..., None]
) -> None:
    expected = [(name, b"%d" % number) for number in range(50) for name in ("reading", "waypoint")]
    batches: list[list[Arrival]] = []
    with Bus("uav", router) as uav, Bus("agent", router) as agent, Tap("recorder", router) as tap:

        def all_there() -> bool:
            batches.append([message for message in tap.take() if message.payload != b"?"])
            return sum(map(len, batches)) >= len(expected)

        tap.subscribe(*KEYS)
        wait_until(
            lambda: agent.publish(WAYPOINT, b"?") or tap.take()
        )  # waypoints are not kept for subscribers not yet known
        for _, payload in expected[::2]:
            uav.publish(READING, payload)
            agent.publish(WAYPOINT, payload, b"array")
        wait_until(all_there)
    assert sorted((message.name, message.payload) for batch in batches for message in batch) == sorted(
        expected
    )
    for batch in batches:  # messages of different batches may overtake each other
        order = [expected.index((message.name, message.payload)) for message in batch]
        assert order == sorted(order)
        assert all(message.published_ns <= message.received_ns <= time.time_ns() for message in batch)
        assert {message.attachment for message in batch if message.key is WAYPOINT} <= {b"array"}


def test_who_puts_no_time_to_a_message_is_given_the_routers(
    router: str, wait_until: Callable[..., None]
) -> None:
    with Tap("recorder", router, "uav/3") as tap, plain(router) as stranger:
        tap.subscribe(MAVLINK_OUT)
        publisher = heard_on(stranger, "uav/3/mavlink/out", wait_until)
        before = time.time_ns()
        publisher.put(b"frames")
        (message,) = taken(tap, wait_until, 1)
    assert (message.name, message.payload, message.attachment) == ("mavlink/out", b"frames", b"")
    assert before - MS <= message.published_ns <= time.time_ns()


def test_an_overtaken_message_is_put_where_it_was_published_but_was_not_received_before_what_was_taken(
    router: str, stranger: zenoh.Session, wait_until: Callable[..., None]
) -> None:
    with Tap("recorder", router) as tap:
        tap.subscribe(MAVLINK_IN)
        publisher = heard_on(stranger, "uav/1/mavlink/in", wait_until)

        def said(*messages: tuple[bytes, zenoh.Timestamp]) -> list[Arrival]:
            for payload, at in messages:
                publisher.put(payload, timestamp=at)
            settle(stranger)
            tap.settle(60.0)
            return tap.take()

        early, middle, late = times = [stranger.new_timestamp() for _ in range(3)]
        before_ns = time.time_ns()
        first = said((b"late", late), (b"early", early))
        between_ns = time.time_ns()
        second = said((b"middle", middle))
    assert [message.payload for message in (*first, *second)] == [b"early", b"late", b"middle"]
    at_ns = [at.get_time_as_ntp64().as_nanos() for at in times]
    assert [(message.published_ns, message.received_ns) for message in first] == [
        (at_ns[0], at_ns[0]),
        (at_ns[2], at_ns[2]),
    ]
    assert second[0].published_ns == at_ns[1] < before_ns <= second[0].received_ns <= between_ns


def test_a_message_from_the_future_was_received_when_it_was_taken(
    router: str, stranger: zenoh.Session, wait_until: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    slow_ns = time.time_ns() - 10_000 * MS  # the tap's clock is late
    monkeypatch.setattr(
        "link.record.tap.time", SimpleNamespace(time_ns=lambda: slow_ns, monotonic=time.monotonic)
    )
    with Tap("recorder", router) as tap:
        tap.subscribe(MAVLINK_IN)
        heard_on(stranger, "uav/1/mavlink/in", wait_until).put(b"frames")
        (message,) = taken(tap, wait_until, 1)
    assert message.received_ns == slow_ns < message.published_ns


def test_taking_ends_though_ever_more_messages_come(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("link.bus.session.WAITING_MESSAGES", 100)
    sample = SimpleNamespace(
        timestamp=None, attachment=None, payload=SimpleNamespace(to_bytes=lambda: b"x"), key_expr="mavlink/in"
    )
    endless = SimpleNamespace(handler=SimpleNamespace(try_recv=lambda: sample), undeclare=lambda: None)
    with Tap("recorder", router) as tap:
        monkeypatch.setattr("zenoh.ext.declare_advanced_subscriber", lambda *_, **__: endless)
        monkeypatch.setattr("zenoh.Session.declare_subscriber", lambda *_, **__: endless)
        tap.subscribe(MAVLINK_IN)
        assert len(tap.take()) == 100
        assert tap.tally.refused["overflow"]  # a ring that is full may have dropped some


def test_waiting_messages_fill_no_more_memory_than_their_limit_and_the_lost_ones_are_counted_and_told(
    router: str,
    stranger: zenoh.Session,
    wait_until: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("link.bus.inbox.WAITING_BYTES", 100_000)
    with Tap("recorder", router) as tap:
        tap.subscribe(MAVLINK_IN)
        publisher = heard_on(stranger, "uav/1/mavlink/in", wait_until)
        for number in range(50):
            publisher.put(b"%04d" % number + bytes(9_996))
        settle(stranger)
        tap.settle(60.0)
        waiting = [int(message.payload[:4]) for message in tap.take()]
    assert waiting == list(range(40, 50))
    assert tap.tally.refused == {"overflow": 40}
    assert "refused mavlink/in: messages arrive faster than they are processed" in capsys.readouterr().err


def test_a_peer_that_publishes_health_under_ever_new_names_is_counted_and_ours_are_still_heard(
    router: str, stranger: zenoh.Session, wait_until: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    with Tap("recorder", router) as tap, Bus("uav", router) as uav:
        tap.subscribe(HEALTH)
        tap.settle(60.0)
        for number in range(100):
            stranger.put(f"uav/1/health/forged{number}", b"{}")
        stranger.put(f"uav/1/health/{'x' * 1000}", b"{}")
        settle(stranger)
        uav.publish_health()
        names = {message.name for message in taken(tap, wait_until, 17)}
    assert names == {"health/uav", *(f"health/forged{number}" for number in range(16))}
    assert tap.tally.refused == {"stranger": 85}
    assert (
        capsys.readouterr().err.count(
            "refused health/<service>: there are services of too many or of strange names"
        )
        == 1
    )


def test_simulation_time_is_a_messages_own_or_the_newest_that_the_vehicle_told() -> None:
    clock = SimulationClock()
    out, reading, belief, stop, waypoint, health = (ENTRIES[index] for index in (0, 1, 2, 3, 4, 5))
    told = [
        clock.time_s(entry.key, entry.payload, at)
        for at, entry in enumerate((health, waypoint, out, health, reading, waypoint, belief, stop))
    ]
    # nothing known yet; a waypoint that answers no reading of this vehicle; the attitude; it again; own times
    # from there on
    assert told == [0.0, 0.0, 2.5, 2.5, 3.0, 3.0, 1.0, 4.0]
    assert clock.time_s("belief", b"no JSON", 9) == 3.0
    assert clock.time_s("mavlink/out", b"noise", 9) == 3.0


def test_the_newest_time_is_that_which_was_published_last() -> None:
    clock = SimulationClock()
    later, earlier = (UAV.pack(_at(time_boot_ms)) for time_boot_ms in (5000, 4000))
    assert clock.time_s("mavlink/out", later, 20) == 5.0
    assert clock.time_s("mavlink/out", earlier, 10) == 4.0  # it was overtaken
    assert clock.time_s("health/uav", b"", 30) == 5.0
    assert clock.time_s("mavlink/out", earlier, 40) == 4.0  # a restarted vehicle
    assert clock.time_s("health/uav", b"", 50) == 4.0


def test_simulation_time_goes_on_where_the_vehicles_own_wraps() -> None:
    clock, wrap = SimulationClock(), 2**32
    before, after = wrap - 3000, 1_000_000  # at a thousandfold speed minutes pass until an answer comes
    told = [
        clock.time_s(key, payload, at)
        for at, (key, payload) in enumerate(
            [
                ("reading", UAV.pack(_at(before))),
                ("mavlink/out", UAV.pack(_at(5000))),
                ("belief", b'{"time_boot_ms":%d}' % before),
                ("mavlink/out", UAV.pack(_at(9_000_000))),
                ("reading", UAV.pack(_at(before))),  # again
                ("waypoint", UAV.pack(_waypoint(before))),
                ("reading", UAV.pack(_at(after))),
                ("belief", b'{"time_boot_ms":%d}' % after),
                ("health/uav", b""),
            ]
        )
    ]
    times_ms = [
        before,
        wrap + 5000,
        before,
        wrap + 9_000_000,
        before,
        before,
        wrap + after,
        wrap + after,
        wrap + after,
    ]
    assert told == [time_ms / 1000 for time_ms in times_ms]
    assert clock.step == 1


def test_the_clock_counts_each_reading_once_knows_what_answers_the_last_ones_and_forgets_older_ones() -> None:
    """The truth is plain: reading n is at n s, is repeated 10 readings later, and is answered with its own
    time.
    """
    clock = SimulationClock()
    readings = 5000
    for number in range(readings):
        for again in (number, max(number - 10, 0)):
            assert clock.time_s("reading", UAV.pack(_at(1000 * again)), number) == again
            waypoint = UAV.pack(_waypoint(1000 * again))
            assert clock.time_s("waypoint", waypoint, number) == again
        assert clock.step == number
    assert (
        clock.time_s("waypoint", UAV.pack(_waypoint(1)), readings) == readings - 11
    )  # answers none: the newest known time
    for others in (
        _waypoint(1000 * (readings - 1)),
        _at(7000),
    ):  # on mavlink/in everybody has times of their own
        assert clock.time_s("mavlink/in", UAV.pack(others), readings) == readings - 11


def _waypoint(time_boot_ms: int) -> object:
    return mavlink.MAVLink_set_position_target_local_ned_message(time_boot_ms, 1, 1, 1, 0, *[0.0] * 11)


def _at(time_boot_ms: int) -> object:
    return type(ATTITUDE)(time_boot_ms, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)


def test_who_taps_leaves_the_environment_as_it_was(router: str) -> None:
    """Zenoh reads its number of threads from the environment: a setting for the recorder would affect all
    parts started later.
    """
    before = dict(os.environ)
    with Tap("recorder", router):
        assert dict(os.environ) == before
