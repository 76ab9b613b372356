"""Protects the bridge as a process: real UDP, TCP and serial endpoints, both directions, reconnects,
loops, floods, and a real client.
"""

import asyncio
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from link.bus.keys import MAVLINK_IN, MAVLINK_OUT
from link.bus.session import Bus
from tests.system.drones import connected, until
from tests.system.wires import BusWire, SerialWire, Speaker, TcpWire, UdpWire, Wire, count, free_port

UDP, TCP = socket.SOCK_DGRAM, socket.SOCK_STREAM


def beats_until(wait_until: Callable, say: Callable[[], None], holds: Callable[[], object]) -> None:
    """Say something again and again, as a heartbeat is, until something holds."""

    def again() -> object:
        if not (so := holds()):
            say()
        return so

    wait_until(again)


@pytest.fixture
def bus(router: str) -> Iterator[BusWire]:
    with BusWire(router) as bus:
        bus.settle()
        yield bus


class Five:
    """A bridge with an endpoint of each kind, and a peer on each."""

    def __init__(self, start, router: str, folder: Path, stack: ExitStack, wait_until: Callable) -> None:
        out, server = (
            stack.enter_context(UdpWire()),
            stack.enter_context(socket.create_server(("127.0.0.1", 0))),
        )
        serial = stack.enter_context(SerialWire(folder / "tty"))
        udp, tcp = free_port(UDP), free_port(TCP)
        urls = [f"udpin:127.0.0.1:{udp}", f"udpout:127.0.0.1:{out.port}", f"tcpin:127.0.0.1:{tcp}"]
        urls += [f"tcp:127.0.0.1:{server.getsockname()[1]}", f"serial:{folder / 'tty'}:115200"]
        self.bridge = start("sitl", "bridge", *urls, "--connect", router)
        server.settimeout(30)
        accepted = stack.enter_context(TcpWire(server.accept()[0]))
        wait_until(lambda: self.bridge.says("115200: open"))
        called = stack.enter_context(TcpWire(socket.create_connection(("127.0.0.1", tcp))))
        self.wires: list[Wire] = [stack.enter_context(UdpWire(udp)), out, called, accepted, serial]


@pytest.fixture
def five(start, router: str, bus: BusWire, tmp_path: Path, wait_until: Callable) -> Iterator[Five]:
    with (
        ExitStack() as stack
    ):  # after the bus has joined: what a bridge says that knows of no receiver is not sent
        yield Five(start, router, tmp_path, stack, wait_until)


def test_stations_on_each_kind_of_endpoint_reach_a_vehicle_on_the_bus_and_only_the_one_that_asked_gets_the_answer(
    five: Five, bus: BusWire, wait_until: Callable
) -> None:
    drone = Speaker(1, 1)
    stations = [Speaker(250 + at, 190, version=1 + at % 2) for at in range(5)]
    for station, wire in zip(stations, five.wires, strict=True):
        if wire is five.wires[1]:  # it waits to be called, which the first heartbeat of the vehicle does
            beats_until(
                wait_until,
                lambda: bus.say(MAVLINK_OUT, drone.beat(autopilot=True)),
                lambda: five.wires[1].heard,
            )
        beat = station.beat()
        wire.say(beat)
        wait_until(lambda beat=beat: count(bus.into, beat) == 1)
    beat = drone.beat(autopilot=True)
    bus.say(MAVLINK_OUT, beat)
    wait_until(lambda: all(wire.has(beat) for wire in five.wires))
    for at, (station, wire) in enumerate(zip(stations, five.wires, strict=True)):
        order, answer, last = station.order(1), drone.answer(250 + at, 190), drone.beat(autopilot=True)
        wire.say(order[:7])  # a frame may come in two parts
        wire.say(order[7:])
        wait_until(lambda order=order: count(bus.into, order) == 1)
        bus.say(MAVLINK_OUT, answer)
        bus.say(MAVLINK_OUT, last)
        wait_until(lambda last=last: all(other.has(last) for other in five.wires))
        assert [other.has(answer) for other in five.wires] == [other is wire for other in five.wires]
        assert not any(count(other.heard, order) for other in five.wires)


def test_autopilots_on_each_kind_of_endpoint_become_the_vehicles_output_and_get_their_own_commands(
    five: Five, bus: BusWire, wait_until: Callable
) -> None:
    agent = Speaker(1, 191)
    drones = [Speaker(1 + at, 1, version=1 + at % 2) for at in range(5)]
    beats_until(wait_until, lambda: bus.say(MAVLINK_IN, agent.beat()), lambda: five.wires[1].heard)
    for drone, wire in zip(drones, five.wires, strict=True):
        beat, answer = drone.beat(autopilot=True), drone.answer(255, 190)
        wire.say(beat)
        wire.say(answer)
        wait_until(lambda beat=beat, answer=answer: count(bus.out, beat) == count(bus.out, answer) == 1)
    for at, wire in enumerate(five.wires):
        order, last = agent.order(1 + at), agent.beat()
        bus.say(MAVLINK_IN, order)
        bus.say(MAVLINK_IN, last)
        wait_until(lambda last=last: all(other.has(last) for other in five.wires))
        assert [other.has(order) for other in five.wires] == [other is wire for other in five.wires]
    assert bus.into == []  # nothing of an autopilot is taken for a command


def test_garbage_and_a_flood_of_markers_hold_nothing_up_and_are_counted(
    five: Five, bus: BusWire, wait_until: Callable
) -> None:
    for system, wire in ((254, five.wires[0]), (255, five.wires[2])):
        station = Speaker(system, 190)
        wire.say(b"\xfe" * 60_000)
        wire.say(b"GET / HTTP/1.1\r\n\r\n")
        beats_until(  # over TCP the first beats may come in one delivery with the flood, and be cut with it
            wait_until,
            lambda wire=wire, station=station: wire.say(station.beat()),
            lambda system=system: any(frame.system == system for frame in bus.into),
        )
    five.bridge.process.send_signal(signal.SIGINT)
    assert five.bridge.ended() == 0
    counts = [line for line in five.bridge.err if "frames in" in line]
    garbage = [int(found[1]) for line in counts if (found := re.search(r"(\d+) bytes of garbage", line))]
    assert [count >= 60_018 for count in garbage] == [True, True]
    assert len(counts) == 6  # one for each URL and one for the bus


@pytest.mark.full
def test_a_peer_that_reads_nothing_holds_nobody_up_and_what_it_misses_is_counted(
    five: Five, bus: BusWire, start, wait_until: Callable
) -> None:
    station, drone = Speaker(255, 190), Speaker(1, 1)
    udp, deaf = five.wires[0], five.wires[2]
    for wire in (udp, deaf):
        wire.say(station.beat())
    wait_until(lambda: len(bus.into) == 2)
    deaf.turn_deaf()
    text = drone.pack(mavlink.MAVLink_statustext_message(6, b"x" * 50))
    for _ in range(20):
        bus.say(MAVLINK_OUT, text * 4000)  # each of 248 kB
        beat = drone.beat(autopilot=True)
        bus.say(MAVLINK_OUT, beat)
        wait_until(
            lambda beat=beat: udp.has(beat) or any(frame.data == beat for frame in five.wires[3].heard)
        )
    wait_until(lambda: five.bridge.says("that came too fast"))


def test_it_comes_back_to_a_tcp_server_that_comes_goes_and_returns(
    start, router: str, bus: BusWire, wait_until: Callable
) -> None:
    port, drone, agent = free_port(TCP), Speaker(1, 1), Speaker(1, 191)
    bridge = start("sitl", "bridge", f"tcp:127.0.0.1:{port}", "--connect", router)
    wait_until(lambda: bridge.says("Connection refused; it is tried again"))
    for _ in range(2):
        with socket.create_server(("127.0.0.1", port), reuse_port=True) as server:
            server.settimeout(30)
            with TcpWire(server.accept()[0]) as wire:
                beat, order = drone.beat(autopilot=True), agent.order(1)
                wire.say(beat)
                wait_until(lambda beat=beat: count(bus.out, beat) == 1)
                bus.say(MAVLINK_IN, order)
                wait_until(lambda wire=wire, order=order: wire.has(order))
    assert not bridge.says("Traceback")


@pytest.mark.full
def test_it_comes_back_to_a_serial_device_that_is_unplugged(
    start, router: str, bus: BusWire, tmp_path: Path, wait_until: Callable
) -> None:
    device, drone, agent = tmp_path / "ttyACM0", Speaker(1, 1), Speaker(1, 191)
    bridge = start("sitl", "bridge", f"serial:{device}", "--connect", router)
    wait_until(lambda: bridge.says("No such file or directory; it is tried again"))
    for plugged in (1, 2):
        with SerialWire(device) as wire:
            wait_until(lambda plugged=plugged: sum("57600: open" in line for line in bridge.err) == plugged)
            beat, order = drone.beat(autopilot=True), agent.order(1)
            wire.say(beat)
            wait_until(lambda beat=beat: count(bus.out, beat) == 1)
            bus.say(MAVLINK_IN, order)
            wait_until(lambda wire=wire, order=order: wire.has(order))
    assert not bridge.says("Traceback")


def test_it_comes_back_to_a_router_that_is_started_again(start, wait_until: Callable) -> None:
    endpoint, udp = f"tcp/127.0.0.1:{free_port(TCP)}", free_port(UDP)
    router = start("sitl", "router", "--listen", endpoint)
    wait_until(lambda: router.out)
    bridge = start("sitl", "bridge", f"udpin:127.0.0.1:{udp}", "--connect", endpoint)
    wait_until(lambda: bridge.says("on the bus"))
    station, drone = Speaker(255, 190), Speaker(1, 1)
    with UdpWire(udp) as wire:
        for _ in range(2):
            with BusWire(endpoint) as bus:
                beats_until(wait_until, lambda: wire.say(station.beat()), lambda bus=bus: bus.into)
                beat = drone.beat(autopilot=True)
                bus.say(MAVLINK_OUT, beat)
                wait_until(lambda beat=beat: wire.has(beat))
            if router.process.poll() is None and not bridge.says("the router is gone"):
                router.kill()
                wait_until(lambda: bridge.says("the router is gone"))
                wire.say(station.beat())
                router = start("sitl", "router", "--listen", endpoint)
                wait_until(lambda: bridge.says("the router is back"))
    bridge.process.send_signal(signal.SIGTERM)
    assert bridge.ended() == 0
    assert bridge.says("1 while it was not connected")


@pytest.mark.full
def test_two_bridges_between_the_same_two_points_do_not_storm(
    start, router: str, bus: BusWire, wait_until: Callable
) -> None:
    port, other = free_port(UDP), free_port(UDP)
    one = start("sitl", "bridge", f"udpin:127.0.0.1:{port}", f"udpin:127.0.0.1:{other}", "--connect", router)
    wait_until(lambda: one.says("on the bus"))
    two = start("sitl", "bridge", f"udpout:127.0.0.1:{port}", "--connect", router)
    wait_until(lambda: two.says("on the bus"))
    drone, station = Speaker(1, 1), Speaker(255, 190)
    with UdpWire(other) as wire:
        beats = [drone.beat(autopilot=True) for _ in range(50)]
        calls = [station.beat() for _ in range(50)]
        beats_until(
            wait_until,
            lambda: bus.say(MAVLINK_OUT, drone.beat(autopilot=True)),
            lambda: one.says(f":{port}: 127.0.0.1"),
        )

        def on_wire(beat: bytes) -> int:
            return count(wire.heard, beat)

        for beat, call in zip(beats, calls, strict=True):
            wire.say(call)
            beats_until(wait_until, partial(bus.say, MAVLINK_OUT, beat), partial(on_wire, beat))
        wait_until(lambda: all(count(bus.into, call) for call in calls))
        bus.settle()
        assert all(count(bus.into, call) <= 2 for call in calls)  # each bridge may bring it, once
        # Nothing of the vehicle comes back to the bus, except what overtakes its first frames to a bridge
        # that has not heard it there yet: a busy machine has many of them.
        assert sum(frame.is_autopilot for frame in bus.out) <= 50
    for bridge in (one, two):
        bridge.process.send_signal(signal.SIGINT)
        assert bridge.ended() == 0
        for line in bridge.err:
            if "frames in" in line:
                received = int(line.split(" frames in")[0].rpartition(" ")[2])
                assert received < 2000, line  # a storm has many thousands


def test_two_vehicles_on_a_bus_and_a_wire_and_two_stations(
    start, router: str, bus: BusWire, wait_until: Callable
) -> None:
    udp, tcp = free_port(UDP), free_port(TCP)
    bridge = start("sitl", "bridge", f"udpin:127.0.0.1:{udp}", f"tcpin:127.0.0.1:{tcp}", "--connect", router)
    wait_until(lambda: bridge.says("on the bus"))
    with ExitStack() as stack:
        real = stack.enter_context(TcpWire(socket.create_connection(("127.0.0.1", tcp))))
        walker = stack.enter_context(UdpWire(udp))
        qgc = stack.enter_context(TcpWire(socket.create_connection(("127.0.0.1", tcp))))
        first, second, one, two = Speaker(1, 1), Speaker(2, 1), Speaker(255, 190), Speaker(254, 190)
        for wire, frame in ((real, second.beat(autopilot=True)), (walker, one.beat()), (qgc, two.beat())):
            wire.say(frame)
            wait_until(lambda frame=frame: count(bus.out + bus.into, frame) == 1)
        beat = first.beat(autopilot=True)
        bus.say(MAVLINK_OUT, beat)
        wait_until(lambda: real.has(beat) and walker.has(beat) and qgc.has(beat))
        to_first, to_second, answer = one.order(1), two.order(2), second.answer(254, 190)
        walker.say(to_first)
        qgc.say(to_second)
        wait_until(lambda: count(bus.into, to_first) == 1 and real.has(to_second))
        real.say(answer)
        wait_until(lambda: qgc.has(answer) and count(bus.out, answer) == 1)
        last = first.beat(autopilot=True)
        bus.say(MAVLINK_OUT, last)
        wait_until(lambda: real.has(last) and walker.has(last))
        assert not count(bus.into, to_second)
        assert not real.has(to_first)
        assert not walker.has(answer)


@pytest.mark.parametrize(
    ("urls", "said"),
    [
        (["udp:1:2"], "'udp:1:2' is not a MAVLink endpoint; wanted udpin:HOST:PORT"),
        (["tcp:no.such.host.invalid:5760"], "tcp:no.such.host.invalid:5760: "),
        (["udpin:127.0.0.1:9", "udpin:127.0.0.1:9"], "udpin:127.0.0.1:9 is given twice"),
        (["udpin:192.0.2.1:14550"], "udpin:192.0.2.1:14550: Cannot assign requested address"),
        ([], "URL"),
    ],
)
def test_bad_urls_get_one_line_and_status_2(router: str, urls: list[str], said: str) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "sitl", "bridge", *urls, "--connect", router],
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert ended.returncode == 2
    (line,) = [line for line in ended.stderr.splitlines() if "error" in line]
    assert said in line


def test_a_port_in_use_is_refused_and_all_interfaces_are_warned_of(
    start, router: str, wait_until: Callable
) -> None:
    port = free_port(TCP)
    first = start("sitl", "bridge", f"tcpin:0.0.0.0:{port}", "--connect", router)
    wait_until(lambda: first.says(f"whoever reaches port {port} can command the vehicle"))
    second = start("sitl", "bridge", f"tcpin:0.0.0.0:{port}", "--connect", router)
    assert second.ended() == 2
    assert second.err == [f"error: URL: tcpin:0.0.0.0:{port}: Address already in use\n"]


def test_a_bridge_to_a_search_by_several_says_how_it_joins_one_of_them(
    start, router: str, wait_until: Callable
) -> None:
    url = f"tcpin:127.0.0.1:{free_port(TCP)}"
    with Bus("uav", router, "search/1", vehicles=(2,)):
        bridge = start("sitl", "bridge", url, "--connect", router, "--namespace", "search/1")
        wait_until(
            lambda: bridge.says("search/1 is a search by several; --namespace search/1/uav/2 joins one")
        )


def test_a_bridge_says_so_too_if_it_was_there_before_the_vehicles(
    start, router: str, wait_until: Callable
) -> None:
    url = f"tcpin:127.0.0.1:{free_port(TCP)}"
    bridge = start("sitl", "bridge", url, "--connect", router, "--namespace", "search/1")
    bridge.comes_to("on the bus at")
    assert not bridge.says("is a search by several")
    with Bus("uav", router, "search/1", vehicles=(2,)), Bus("uav", router, "search/1", vehicles=(3,)):
        wait_until(lambda: bridge.says("search/1 is a search by several; --namespace search/1/uav/"))


@pytest.mark.full
@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_mavsdk_flies_the_vehicle_of_the_bus_through_the_bridge(
    kind: str, start, router: str, wait_until: Callable
) -> None:
    port = free_port(TCP if kind == "tcp" else UDP)
    url, calls = {
        "tcp": (f"tcpin:127.0.0.1:{port}", f"tcpout://127.0.0.1:{port}"),
        "udp": (f"udpin:127.0.0.1:{port}", f"udpout://127.0.0.1:{port}"),
    }[kind]
    start("sitl", "uav", "--connect", router, "--speedup", "3")
    bridge = start("sitl", "bridge", url, "--connect", router)
    wait_until(lambda: bridge.says(calls))

    async def fly() -> None:
        async with asyncio.timeout(60), connected(calls) as drone:
            await until(drone.telemetry.health_all_ok(), bool)
            await drone.action.arm()
            await drone.action.takeoff()
            await until(drone.telemetry.position(), lambda p: p.relative_altitude_m > 4.7)
            await drone.action.land()
            await until(drone.telemetry.armed(), lambda armed: not armed)

    asyncio.run(fly())


@pytest.mark.parametrize(
    ("words", "may"),
    [
        (("bridge",), "command the vehicle"),
        (("uav", "--out"), "command the vehicle"),
        (("uav", "--vehicle"), "speak as the vehicle"),
    ],
)
def test_whatever_listens_beside_the_loopback_warns(
    start, router: str, wait_until: Callable, words: tuple[str, ...], may: str
) -> None:
    port = free_port(UDP)
    url = f"udpin:{socket.gethostname()}:{port}"  # a name may point anywhere
    part = start("sitl", *words, url, *(() if "--out" in words else ("--connect", router)))
    wait_until(lambda: part.says(f"{url} is open to other machines: whoever reaches port {port} can {may}"))
