"""Protects the session on the bus: late joiners, liveliness, what is refused, and errors that say what to do."""

import threading
from collections.abc import Callable
from typing import Any

import pytest
import zenoh

from link.bus.keys import BELIEF, READING, STOP
from link.bus.messages import Stop
from link.bus.session import Arrival, Bus, BusError, LivelinessChange, open_router

CLAIM = Stop(time_boot_ms=5, step=3, estimate=(1.0, 2.0), covariance=(0.1, 0.0, 0.1), spread=0.4, threshold=0.5)


def arrivals(bus: Bus, count: int) -> list[bytes]:
    payloads: list[bytes] = []
    while len(payloads) < count:
        item = bus.receive(timeout_s=10.0)
        assert item is not None, f"only {len(payloads)} of {count} arrived"
        if isinstance(item, Arrival):
            payloads.append(item.payload)
    return payloads


@pytest.mark.parametrize("attempt", range(8))  # the loss that this guards against came in every fourth join
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
            assert viewer.decode(viewer.receive(timeout_s=10.0), Stop) == CLAIM


def test_a_plain_client_without_the_advanced_protocol_is_heard(router: str, wait_until: Callable[..., None]) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{router}"]')
    with Bus("estimator", router, "uav/3") as estimator, zenoh.open(config) as stranger:
        estimator.subscribe(READING)
        publisher = stranger.declare_publisher("uav/3/reading")
        wait_until(lambda: publisher.matching_status.matching)
        publisher.put(b"frames")
        assert arrivals(estimator, 1) == [b"frames"]


def test_vehicles_do_not_hear_each_other(router: str) -> None:
    with Bus("agent", router, "uav/1") as one, Bus("agent", router, "uav/2") as two, Bus("uav", router, "uav/2") as vehicle_two:
        vehicle_two.subscribe(READING)
        one.publish(READING, b"from one")
        two.publish(READING, b"from two")
        assert arrivals(vehicle_two, 1) == [b"from two"]


def test_services_are_seen_to_come_and_go(router: str) -> None:
    with Bus("viewer", router) as viewer:
        viewer.watch_services()
        with Bus("agent", router):
            seen = [viewer.receive(timeout_s=10.0), viewer.receive(timeout_s=10.0)]
            assert LivelinessChange("agent", True) in seen
        assert viewer.receive(timeout_s=10.0) == LivelinessChange("agent", False)


def test_what_does_not_decode_is_counted_and_logged_with_key_and_reason(router: str, capsys: pytest.CaptureFixture[str]) -> None:
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
        assert agent.receive(timeout_s=10.0).attachment == b"particles"


@pytest.mark.parametrize(
    ("attempt", "said"),
    [
        (lambda used: open_router(used), "--listen: cannot listen on .*: Address already in use"),
        (lambda used: open_router("tcp/192.0.2.1:7447"), "--listen: cannot listen on tcp/192.0.2.1:7447: Cannot assign"),
        (lambda used: open_router("7447"), "--listen: '7447' is no Zenoh endpoint; wanted one like tcp/"),
        (lambda used: Bus("uav", "7447"), "--connect: '7447' is no Zenoh endpoint; wanted one like tcp/"),
        (lambda used: Bus("uav", "tcp/127.0.0.1:1"), "--connect: no router at tcp/127.0.0.1:1 .*python -m sitl router"),
    ],
)
def test_what_cannot_be_opened_is_said_in_one_line(router: str, attempt: Callable[[str], Any], said: str) -> None:
    with pytest.raises(BusError, match=said) as refusal:
        attempt(router)
    assert len(str(refusal.value).splitlines()) == 1
