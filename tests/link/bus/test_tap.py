"""Protects what a record is made from: every message once, with the publisher's time, also those from before one listened."""

import json
import os
import time
from collections.abc import Callable
from itertools import pairwise

import zenoh

from link.bus.keys import HEALTH, KEYS, MAVLINK_IN, MAVLINK_OUT, READING
from link.bus.session import Bus, Stamped
from link.bus.tap import Tap
from link.record.record import SimulationClock
from tests.link.record.test_record import ATTITUDE, ENTRIES, UAV

MS = 1_000_000


def taken(tap: Tap, wait_until: Callable[..., None], count: int) -> list[Stamped]:
    """Take until so many have come, and a last time for any that come too often."""
    messages: list[Stamped] = []
    wait_until(lambda: messages.extend(tap.take()) or len(messages) >= count)
    time.sleep(0.1)
    return messages + tap.take()


def test_messages_from_before_one_joined_have_the_time_they_were_published_at(router: str, wait_until: Callable[..., None]) -> None:
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
        assert before - MS <= message.published_ns <= after + MS  # Zenoh's clock may be ahead of the system's by less
    assert (messages[-1].key, messages[-1].name) == (HEALTH, "health/uav")
    assert all(message.published_ns < joined for message in messages)


def test_messages_of_many_are_taken_in_the_order_in_which_they_were_published(router: str, wait_until: Callable[..., None]) -> None:
    expected = [(name, b"%d" % number) for number in range(50) for name in ("reading", "mavlink/in")]
    batches: list[list[Stamped]] = []
    with Bus("uav", router) as uav, Bus("agent", router) as agent, Tap("recorder", router) as tap:

        def all_there() -> bool:
            batches.append([message for message in tap.take() if message.payload != b"?"])
            return sum(map(len, batches)) >= len(expected)

        tap.subscribe(*KEYS)
        wait_until(lambda: agent.publish(MAVLINK_IN, b"?") or tap.take())  # waypoints are not kept for who is not known to listen yet
        for _, payload in expected[::2]:
            uav.publish(READING, payload)
            agent.publish(MAVLINK_IN, payload, b"array")
        wait_until(all_there)
    assert sorted((message.name, message.payload) for batch in batches for message in batch) == sorted(expected)
    for batch in batches:  # from one batch to the next they may overtake each other on their way here
        order = [expected.index((message.name, message.payload)) for message in batch]
        assert order == sorted(order)
        assert all(message.published_ns <= message.received_ns <= time.time_ns() for message in batch)
        assert {message.attachment for message in batch if message.key is MAVLINK_IN} <= {b"array"}


def test_who_puts_no_time_to_a_message_is_given_the_routers(router: str, wait_until: Callable[..., None]) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([router]))
    with Tap("recorder", router, "uav/3") as tap, zenoh.open(config) as stranger:
        tap.subscribe(MAVLINK_OUT)
        publisher = stranger.declare_publisher("uav/3/mavlink/out")
        wait_until(lambda: publisher.matching_status.matching)
        before = time.time_ns()
        publisher.put(b"frames")
        (message,) = taken(tap, wait_until, 1)
    assert (message.name, message.payload, message.attachment) == ("mavlink/out", b"frames", b"")
    assert before - MS <= message.published_ns <= time.time_ns()


def test_simulation_time_is_a_messages_own_or_the_newest_that_the_vehicle_told() -> None:
    clock = SimulationClock()
    out, reading, belief, stop, waypoint, health = (ENTRIES[index] for index in (0, 1, 2, 3, 4, 5))
    told = [
        clock.time_s(entry.key, entry.payload, at)
        for at, entry in enumerate((health, waypoint, out, health, reading, waypoint, belief, stop))
    ]
    # nothing known yet; a waypoint that answers no reading of this vehicle; the attitude; it again; own times from there on
    assert told == [0.0, 0.0, 2.5, 2.5, 3.0, 3.0, 1.0, 4.0]
    assert clock.time_s("belief", b"no JSON", 9) == 3.0
    assert clock.time_s("mavlink/out", b"noise", 9) == 3.0


def test_the_newest_time_is_that_which_was_published_last() -> None:
    clock = SimulationClock()
    later, earlier = (UAV.pack(_at(time_boot_ms)) for time_boot_ms in (5000, 4000))
    assert clock.time_s("mavlink/out", later, 20) == 5.0
    assert clock.time_s("mavlink/out", earlier, 10) == 4.0  # overtaken on its way
    assert clock.time_s("health/uav", b"", 30) == 5.0
    assert clock.time_s("mavlink/out", earlier, 40) == 4.0  # a vehicle that has begun anew
    assert clock.time_s("health/uav", b"", 50) == 4.0


def _at(time_boot_ms: int) -> object:
    return type(ATTITUDE)(time_boot_ms, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)


def test_who_taps_leaves_the_environment_as_it_was(router: str) -> None:
    """Zenoh reads how many threads it may have from there: a setting for the recorder would be one for all that are started later."""
    before = dict(os.environ)
    with Tap("recorder", router):
        assert dict(os.environ) == before
