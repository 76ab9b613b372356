"""Protects the session on the bus: late joiners, liveliness, refusals, and errors that tell what to do."""

import json
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import msgspec
import pytest
import zenoh

from link.bus.inbox import WAITING_MESSAGES, Inbox
from link.bus.keys import BELIEF, HEALTH, MAVLINK_IN, READING, STOP
from link.bus.messages import Health, Stop
from link.bus.opening import BusError, NoRouter, open_client, open_router, zenoh_config
from link.bus.session import Arrival, Bus, LivelinessChange
from sitl.launch.relay import Relay

pytestmark = pytest.mark.slow

CLAIM = Stop(
    time_boot_ms=5, step=3, estimate=(1.0, 2.0), covariance=(0.1, 0.0, 0.1), spread=0.4, threshold=0.5
)


def arrivals(bus: Bus, count: int) -> list[bytes]:
    payloads: list[bytes] = []
    while len(payloads) < count:
        item = bus.receive(timeout_s=60.0)
        assert item is not None, f"only {len(payloads)} of {count} arrived"
        if isinstance(item, Arrival):
            payloads.append(item.payload)
    return payloads


@pytest.fixture
def stranger(router: str) -> Iterator[zenoh.Session]:
    """Plain Zenoh, without our code."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([router]))
    with zenoh.open(config) as session:
        yield session


def taking(router: str, session_id: str) -> zenoh.Session:
    """Plain Zenoh with the id of another session, which is away."""
    return zenoh.open(
        zenoh_config("client", {"connect": [router]}, id=session_id, connect__timeout_ms=60_000)
    )


def settle(stranger: zenoh.Session) -> None:
    """Wait until the router has taken what was said so far."""
    for _ in stranger.get("uav/1/nobody", timeout=60.0):
        pass


WAVE = 1000
"""Messages of a flood that are under way at once. A router cuts the link of a receiver whose queue is
full, and what waits is lost.
"""


class Counted(Inbox):
    """An inbox that counts what comes into each lane."""

    def __init__(self) -> None:
        super().__init__()
        self.came: Counter[str] = Counter()

    def lane(self, name: str, *most: int, **how: bool) -> Callable[[Any, int], None]:
        put = super().lane(name, *most, **how)

        def counted(item: Any, size: int) -> None:
            put(item, size)
            self.came[name] += 1

        return counted


def flood(
    stranger: zenoh.Session, wait_until: Callable[..., None], inbox: Counted, key: str, count: int
) -> None:
    """Publish this many messages, as fast as they arrive at an inbox from which none is taken."""
    publisher = stranger.declare_publisher(f"uav/1/{key}", congestion_control=zenoh.CongestionControl.BLOCK)
    wait_until(lambda: publisher.matching_status.matching)
    before = inbox.came[key]
    for number in range(count):
        publisher.put(b"%d" % number)
        if (number + 1) % WAVE == 0:
            wait_until(lambda sent=number + 1: inbox.came[key] == before + sent)
    publisher.undeclare()


@pytest.mark.parametrize("attempt", range(8))  # the loss occurred in every fourth join
def test_a_late_joiner_gets_all_readings_in_order_while_more_are_published(router: str, attempt: int) -> None:
    wanted = [str(n).encode() for n in range(400)]
    with Bus("uav", router) as uav, Bus("estimator", router) as estimator:
        for payload in wanted[:100]:
            uav.publish(READING, payload)
        live = threading.Thread(target=lambda: [uav.publish(READING, payload) for payload in wanted[100:]])
        live.start()
        estimator.subscribe(READING)
        got = arrivals(estimator, len(wanted))
        live.join()
    assert got == wanted


def test_a_late_joiner_gets_the_stop(router: str) -> None:
    with Bus("estimator", router) as estimator:
        estimator.publish(STOP, CLAIM)
        with Bus("viewer", router) as viewer:
            viewer.subscribe(STOP)
            assert viewer.decode(viewer.receive(timeout_s=60.0), Stop) == CLAIM


def test_a_plain_client_without_the_advanced_protocol_is_heard(
    router: str, stranger: zenoh.Session, wait_until: Callable[..., None]
) -> None:
    with Bus("estimator", router, "uav/3") as estimator:
        estimator.subscribe(READING)
        publisher = stranger.declare_publisher("uav/3/reading")
        wait_until(lambda: publisher.matching_status.matching)
        publisher.put(b"frames")
        assert arrivals(estimator, 1) == [b"frames"]


@pytest.mark.full
def test_all_hundred_thousand_kept_readings_reach_a_late_joiner_that_is_slow_to_take_them(
    router: str, wait_until: Callable[..., None]
) -> None:
    count, inbox = READING.delivery.kept, Counted()
    with Bus("uav", router) as uav, Bus("estimator", router, inbox=inbox) as estimator:
        for number in range(count):
            uav.publish(READING, b"%d" % number)
        estimator.subscribe(READING)
        wait_until(lambda: inbox.came["reading"] >= count)
        assert arrivals(estimator, count) == [b"%d" % number for number in range(count)]
        assert not estimator.tally.refused


def test_a_flood_of_commands_waits_in_part_only_and_the_stop_still_arrives(
    router: str, stranger: zenoh.Session, wait_until: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    count, inbox = 110_000, Counted()
    with Bus("uav", router, inbox=inbox) as uav, Bus("estimator", router) as estimator:
        uav.subscribe(MAVLINK_IN, STOP)
        flood(stranger, wait_until, inbox, "mavlink/in", count // 2)
        estimator.publish(STOP, CLAIM)
        wait_until(lambda: inbox.came["agdc/stop"])  # although nothing is received
        flood(stranger, wait_until, inbox, "mavlink/in", count // 2)
        assert inbox.waiting() == WAITING_MESSAGES + 1
        items = [uav.receive(timeout_s=1.0) for _ in range(WAITING_MESSAGES + 1)]
        assert uav.receive(timeout_s=0) is None
        assert [uav.decode(item, Stop) for item in items if item.key is STOP] == [CLAIM]
        assert [int(item.payload) for item in items if item.key is MAVLINK_IN] == [
            *range(count // 2 - WAITING_MESSAGES, count // 2)
        ]
        assert uav.tally.refused == {"overflow": count - WAITING_MESSAGES}
    assert capsys.readouterr().err.count("refused mavlink/in: ") == 1


def test_readings_that_a_flood_has_pushed_out_are_had_again(
    router: str, stranger: zenoh.Session, wait_until: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("link.bus.session.WAITING_MESSAGES", 100)
    few = replace(READING, delivery=replace(READING.delivery, kept=1000))
    wanted = [b"reading %d" % number for number in range(501)]
    inbox = Counted()
    with Bus("uav", router) as uav, Bus("estimator", router, inbox=inbox) as estimator:
        estimator.subscribe(few)
        estimator.settle(
            60.0
        )  # what is published before the router knows of it comes only when it is asked for again
        for payload in wanted[:-1]:
            uav.publish(READING, payload)
        wait_until(lambda: inbox.came["reading"] == 500)
        flood(stranger, wait_until, inbox, "reading", 20_000)
        assert inbox.waiting() == 1100
        uav.publish(READING, wanted[-1])
        got: list[bytes] = []
        while len(got) < len(wanted):
            got += [payload for payload in arrivals(estimator, 1) if payload in wanted]
        assert got == wanted
        assert estimator.tally.refused["overflow"] >= 20_500 - 1100


def test_who_needs_only_the_newest_is_given_it_at_once(router: str, wait_until: Callable[..., None]) -> None:
    inbox = Inbox()
    with Bus("estimator", router) as estimator, Bus("agent", router, inbox=inbox) as agent:
        agent.subscribe(BELIEF, newest=True)
        estimator.publish(BELIEF, b"0")
        wait_until(inbox.waiting)
        seen: list[bytes] = []
        for number in range(1, 2000):
            estimator.publish(BELIEF, b"%d" % number)
            assert inbox.waiting() <= 1
        while seen[-1:] != [b"1999"]:
            seen += arrivals(agent, 1)
        assert [int(payload) for payload in seen] == sorted({int(payload) for payload in seen})
        assert not agent.tally.refused


def test_a_wait_ends_in_time_however_many_messages_come_again(router: str) -> None:
    again = Arrival(READING, b"frames", b"", number=("uav", 0))

    class Endless(Inbox):
        def get(self, timeout: float | None = None) -> Any:
            return again

    with Bus("estimator", router, inbox=Endless()) as estimator:
        estimator.subscribe(READING)
        assert estimator.receive(timeout_s=60.0) == again
        assert estimator.receive(timeout_s=0.1) is None


def test_a_reason_that_quotes_a_strangers_megabyte_is_cut(
    router: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with Bus("viewer", router) as viewer:
        assert viewer.decode(Arrival(STOP, b'{"' + b"x" * 2**20 + b'": 1}', b""), Stop) is None
        assert len(viewer.tally.last_error) < 1000
    (line,) = capsys.readouterr().err.splitlines()
    assert len(line) < 1000
    assert "refused agdc/stop: Object contains unknown field `xxx" in line


def test_what_is_refused_again_and_again_for_the_same_reason_is_a_warning_once(
    router: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Such as a reading that is published until it is answered."""
    with Bus("estimator", router, "uav/1") as estimator:
        for gas in (1e12, 1e12, 1e12, 2e12, 1e12):
            estimator.refuse(READING, f"gas {gas:g} is absurd", "absurd")
    lines = [line for line in capsys.readouterr().err.splitlines() if "absurd" in line]
    assert [line.split("level=")[1].split()[0] for line in lines] == [
        *("warning", "info", "info"),
        *("warning", "warning"),
    ]
    assert estimator.tally.refused == {"absurd": 5}


def test_vehicles_do_not_hear_each_other(router: str) -> None:
    with (
        Bus("agent", router, "uav/1") as one,
        Bus("agent", router, "uav/2") as two,
        Bus("uav", router, "uav/2") as vehicle_two,
    ):
        vehicle_two.subscribe(READING)
        one.publish(READING, b"from one")
        two.publish(READING, b"from two")
        assert arrivals(vehicle_two, 1) == [b"from two"]


def test_services_are_seen_to_come_and_go(router: str) -> None:
    with Bus("viewer", router) as viewer:
        viewer.watch_services()
        with Bus("agent", router):
            seen = [viewer.receive(timeout_s=60.0), viewer.receive(timeout_s=60.0)]
            assert LivelinessChange("agent", True) in seen
        assert viewer.receive(timeout_s=60.0) == LivelinessChange("agent", False)


def test_services_of_ever_new_names_are_counted_and_ours_are_still_seen(
    router: str, stranger: zenoh.Session, wait_until: Callable[..., None]
) -> None:
    with Bus("viewer", router, announced=False) as viewer:
        tokens = [stranger.liveliness().declare_token(f"uav/1/health/forged{number}") for number in range(50)]
        settle(stranger)
        viewer.watch_services()
        seen: set[str] = set()  # Zenoh may tell of a token twice
        with Bus("agent", router):
            wait_until(lambda: seen.add(viewer.receive(timeout_s=60.0).service) or len(seen) == 17)
            assert "agent" in seen
            assert set(viewer.tally.refused) == {"stranger"}
            assert viewer.tally.refused["stranger"] >= 34
            wait_until(lambda: viewer.services() == seen)
        wait_until(lambda: viewer.receive(timeout_s=60.0) == LivelinessChange("agent", False))
        del tokens


def test_health_on_the_key_of_another_is_refused(router: str, capsys: pytest.CaptureFixture[str]) -> None:
    with Bus("viewer", router, announced=False) as viewer, Bus("agent", router) as agent:
        viewer.subscribe(HEALTH)
        agent.publish_health()
        own = viewer.receive(timeout_s=60.0)
        assert viewer.decode(own, Health) is not None
        assert viewer.decode(own._replace(name="estimator"), Health) is None
        assert viewer.tally.refused == {"malformed": 1}
    assert "refused health/<service>: 'estimator' says that it is 'agent'" in capsys.readouterr().err


def test_who_speaks_with_the_source_id_of_another_hides_no_health_of_that(
    router: str, stranger: zenoh.Session, wait_until: Callable[..., None]
) -> None:
    overheard: list[zenoh.SourceInfo] = []
    with stranger.declare_subscriber(
        "uav/1/health/agent", lambda sample: overheard.append(sample.source_info)
    ):
        settle(stranger)
        with Bus("viewer", router, announced=False) as viewer, Bus("agent", router) as agent:
            viewer.subscribe(HEALTH)
            viewer.settle(60.0)
            agent.publish_health()
            wait_until(lambda: overheard)
            publisher = stranger.declare_publisher(
                "uav/1/health/observer", congestion_control=zenoh.CongestionControl.BLOCK
            )
            wait_until(lambda: publisher.matching_status.matching)
            for number in range(1, 100):
                publisher.put(b"{}", source_info=zenoh.SourceInfo(overheard[0].source_id, number))
            settle(stranger)
            agent.publish_health()
            wait_until(lambda: len(overheard) == 2)
            heard = [viewer.receive(timeout_s=60.0).name for _ in range(101)]
            assert heard == ["health/agent", *["health/observer"] * 99, "health/agent"]


def test_a_session_whose_id_is_taken_while_it_is_away_goes_on_with_a_new_one(
    router: str,
    stranger: zenoh.Session,
    wait_until: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("link.bus.standby.AWAY_S", 0.2)
    overheard: list[zenoh.SourceInfo] = []
    stranger.declare_subscriber("uav/1/reading", lambda sample: overheard.append(sample.source_info))
    settle(stranger)
    relay = Relay(router)
    try:
        with (
            Bus("uav", relay.endpoint) as uav,
            Bus("estimator", router) as estimator,
            Bus("viewer", router, announced=False) as viewer,
        ):
            uav.subscribe(STOP)
            for payload in (b"0", b"1"):
                uav.publish(READING, payload, b"attached")
            wait_until(lambda: overheard)
            relay.cut()
            wait_until(
                lambda: not (uav.receive(timeout_s=0.0) or uav.connected or "uav" in viewer.services())
            )
            with taking(router, str(overheard[0].source_id.zid)):
                relay.restore()
                wait_until(lambda: uav.receive(timeout_s=0.0) is None and uav.connected)
                assert capsys.readouterr().err.count("our session id") == 1
                uav.publish(READING, b"2", b"attached")
                estimator.publish(STOP, CLAIM)
                assert uav.decode(uav.receive(timeout_s=60.0), Stop) == CLAIM
                assert viewer.services() == {"uav", "estimator"}
                estimator.subscribe(READING)
                got = [estimator.receive(timeout_s=60.0) for _ in range(3)]
                assert [(item.payload, item.attachment) for item in got] == [
                    (b"%d" % number, b"attached") for number in range(3)
                ]
    finally:
        relay.close()


def test_a_session_that_comes_back_by_itself_stays(
    router: str,
    stranger: zenoh.Session,
    wait_until: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("link.bus.standby.AWAY_S", 0.0)
    ids: set[str] = set()
    stranger.declare_subscriber(
        "uav/1/reading", lambda sample: ids.add(str(sample.source_info.source_id.zid))
    )
    settle(stranger)
    relay = Relay(router)
    try:
        with Bus("uav", relay.endpoint) as uav:
            uav.publish(READING, b"0")
            wait_until(lambda: ids)
            relay.cut()
            wait_until(lambda: not (uav.receive(timeout_s=0.0) or uav.connected))
            relay.restore()
            wait_until(lambda: uav.receive(timeout_s=0.0) is None and uav.connected)
            uav.publish(READING, b"1")
            settle(stranger)
            assert len(ids) == 1
            assert "our session id" not in capsys.readouterr().err
    finally:
        relay.close()


def test_what_does_not_decode_is_counted_and_logged_with_key_and_reason(
    router: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with Bus("viewer", router) as viewer:
        for payload in (b"{}", b"not json", b"\xff", b'{"step": -1}'):
            assert viewer.decode(Arrival(STOP, payload, b""), Stop) is None
        assert viewer.tally.refused == {"malformed": 4}
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 4
    assert all("refused agdc/stop: " in line for line in lines)


def test_the_attachment_arrives_with_its_payload(router: str) -> None:
    with Bus("estimator", router) as estimator, Bus("agent", router) as agent:
        estimator.publish(BELIEF, CLAIM, b"particles")
        agent.subscribe(BELIEF)
        assert agent.receive(timeout_s=60.0).attachment == b"particles"


@pytest.mark.parametrize(
    ("attempt", "said"),
    [
        (lambda used: open_router(used), "--listen: cannot listen on .*: Address already in use"),
        (
            lambda used: open_router("tcp/192.0.2.1:7447"),
            "--listen: cannot listen on tcp/192.0.2.1:7447: Cannot assign",
        ),
        (lambda used: open_router("7447"), "--listen: '7447' is not a Zenoh endpoint; wanted one like tcp/"),
        (lambda used: Bus("uav", "7447"), "--connect: '7447' is not a Zenoh endpoint; wanted one like tcp/"),
        (
            lambda used: Bus("uav", "tcp/127.0.0.1"),
            "--connect: 'tcp/127.0.0.1' is not allowed; wanted one like",
        ),
        (lambda used: Bus("uav", "tcp/[::1]"), "--connect: .* a host and a port from 1 to 65535"),
        (lambda used: Bus("uav", "tcp/127.0.0.1:70000"), "--connect: .* a host and a port from 1 to 65535"),
        (lambda used: Bus("uav", "tcp/127.0.0.1:74x7?prio=1"), "--connect: .* a host and a port from 1 to"),
        (lambda used: Bus("uav", "tcp/:7447"), "--connect: 'tcp/:7447' is not allowed"),
        (
            lambda used: open_router("tcp/127.0.0.1:0", connect="tcp/192.0.2.1:0"),
            "--connect: 'tcp/192.0.2.1:0' is not allowed; wanted one like",
        ),
        (
            lambda used: Bus("uav", used, ""),
            "--namespace: '' is not allowed; wanted words separated by single slashes",
        ),
        (lambda used: Bus("uav", used, "uav//1"), "--namespace: 'uav//1' is not allowed"),
        (lambda used: Bus("uav", used, "uav/*"), r"--namespace: 'uav/\*' is not allowed"),
        (
            lambda used: Bus("uav", "tcp/127.0.0.1:1"),
            "--connect: no router at tcp/127.0.0.1:1 .*plumeward router",
        ),
    ],
)
def test_what_cannot_be_opened_is_said_in_one_line(
    router: str, attempt: Callable[[str], Any], said: str
) -> None:
    with pytest.raises(BusError, match=said) as refusal:
        attempt(router)
    assert len(str(refusal.value).splitlines()) == 1


@pytest.mark.full
def test_over_a_slow_link_joining_takes_longer(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("link.bus.opening.CONNECT_TIMEOUT_S", 0.2)
    slow = Relay(router)
    said: list[str] = []

    def wait(text: str) -> None:
        said.append(text)
        slow.restore()

    try:
        slow.cut()
        open_client(slow.endpoint, None, wait).close()  # type: ignore[no-untyped-call]
        assert said == [f"the router at {slow.endpoint} does not answer yet: trying for 15 s more"]
        monkeypatch.setattr("link.bus.opening.SLOW_CONNECT_S", 0.2)
        slow.cut()
        with pytest.raises(NoRouter, match="no router at"):
            open_client(slow.endpoint, None, said.append)
    finally:
        slow.close()


def test_of_two_services_of_a_name_the_second_is_refused_and_says_nothing(router: str) -> None:
    with Bus("viewer", router, announced=False) as viewer, Bus("estimator", router, sole=True) as first:
        first.publish_health()
        viewer.subscribe(HEALTH)
        refusals: list[str] = []

        def second() -> None:
            with pytest.raises(BusError) as refused:
                Bus("estimator", router, sole=True)
            refusals.append(str(refused.value))

        attempt = threading.Thread(target=second)
        attempt.start()
        while attempt.is_alive():
            assert first.receive(timeout_s=0.05) is None  # it goes on, and publishes its health
        attempt.join()
        assert refusals == ["another estimator is already on uav/1"]
        assert viewer.services() == {"estimator"}
        Bus("agent", router, sole=True).close()
        Bus("estimator", router, "uav/2", sole=True).close()


def test_a_service_that_was_cut_off_is_followed_when_its_token_is_gone(
    router: str, stranger: zenoh.Session
) -> None:
    token = stranger.liveliness().declare_token(
        "uav/1/health/estimator"
    )  # what a dead one leaves for a while
    gone = threading.Timer(0.5, token.undeclare)
    gone.start()
    with Bus("estimator", router, sole=True):
        gone.join()


def test_one_that_is_there_and_says_nothing_is_not_followed(
    router: str, stranger: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("link.bus.sole.WAIT_S", 0.2)
    token = stranger.liveliness().declare_token("uav/1/health/estimator")
    with (
        pytest.raises(BusError, match=r"^another estimator is already on uav/1$"),
        Bus("estimator", router, sole=True),
    ):
        pass
    token.undeclare()


def test_of_several_vehicles_the_one_that_is_there_twice_is_named(
    router: str, stranger: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("link.bus.sole.WAIT_S", 0.2)
    token = stranger.liveliness().declare_token("search/1/uav/2/health/uav")
    with (
        pytest.raises(BusError, match=r"^another uav/2 is already on search/1$"),
        Bus("uav", router, "search/1", sole=True, vehicles=(2,)),
    ):
        pass
    Bus("uav", router, "search/1", sole=True, vehicles=(1,)).close()
    token.undeclare()


@pytest.mark.parametrize(("uptime_s", "goes"), [(1000.0, True), (0.0, False)], ids=["older", "younger"])
def test_of_two_that_are_there_the_younger_goes(
    router: str, stranger: zenoh.Session, wait_until: Callable[..., None], uptime_s: float, goes: bool
) -> None:
    """As when one that hung while the other started comes back."""
    with Bus("estimator", router, sole=True) as bus:
        publisher = stranger.declare_publisher(
            "uav/1/health/estimator", congestion_control=zenoh.CongestionControl.BLOCK
        )
        wait_until(lambda: publisher.matching_status.matching)
        for more_s in (0.0, 1.0):
            publisher.put(msgspec.json.encode(Health("estimator", "ready", -1, 0.0, uptime_s + more_s, {})))
        publisher.put(b"noise")
        settle(stranger)
        bus.settle(60.0)
        if goes:
            with pytest.raises(BusError, match=r"^another estimator is already on uav/1$"):
                wait_until(bus.keep_health)  # it hears of it in a thread of its own
        else:
            bus.keep_health()


def test_who_was_cut_off_gets_the_beliefs_that_it_has_missed_and_who_joins_late_only_the_newest(
    router: str, wait_until: Callable[..., None]
) -> None:
    relay = Relay(router)
    try:
        with Bus("estimator", router) as estimator, Bus("viewer", relay.endpoint) as viewer:
            viewer.subscribe(BELIEF)
            estimator.publish(BELIEF, b"0")
            assert arrivals(viewer, 1) == [b"0"]
            relay.cut()
            wait_until(lambda: not viewer.connected)
            for number in range(1, 6):
                estimator.publish(BELIEF, b"%d" % number)
            relay.restore()
            wait_until(lambda: viewer.connected)
            estimator.publish(BELIEF, b"6")
            assert arrivals(viewer, 6) == [b"1", b"2", b"3", b"4", b"5", b"6"]
            with Bus("late", router) as late:
                late.subscribe(BELIEF)
                assert arrivals(late, 1) == [b"6"]
    finally:
        relay.close()
