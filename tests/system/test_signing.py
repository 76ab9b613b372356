"""Protects a vehicle from strangers: with --sign nobody without the key, and nobody with old frames, stops
its motors in the air.
"""

import hashlib
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

from link.bus.keys import MAVLINK_OUT
from tests.system.wires import BusWire, SerialWire, Speaker, TcpWire, UdpWire, count, free_port

KEY = hashlib.sha256(b"correct horse battery staple").digest()
UDP, TCP = socket.SOCK_DGRAM, socket.SOCK_STREAM
DISARM, FORCED = mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 21196
TAKEOFF, ARMED = mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_MODE_FLAG_SAFETY_ARMED


def timestamp() -> int:
    """10 µs since 2015, by the clock."""
    return int((time.time() - 1_420_070_400) * 100_000)


def as_signed(frame: bytes, link: int, at: int, key: bytes = KEY) -> bytes:
    """A MAVLink 2 frame with a signature, by the guide's formula; pymavlink computes the checksum of the
    flagged frame.
    """
    body = bytearray(frame)
    body[2] = 1
    message_id = int.from_bytes(body[7:10], "little")
    crc = mavlink.x25crc(bytes(body[1:-2]) + bytes([mavlink.mavlink_map[message_id].crc_extra])).crc
    body[-2:] = crc.to_bytes(2, "little")
    body += bytes([link]) + at.to_bytes(6, "little")
    return bytes(body) + hashlib.sha256(key + body).digest()[:6]


def is_rightly_signed(frame: bytes) -> bool:
    return frame[2] == 1 and hashlib.sha256(KEY + frame[:-6]).digest()[:6] == frame[-6:]


@pytest.fixture
def key(tmp_path: Path) -> Path:
    path = tmp_path / "fleet.key"
    path.write_text("correct horse battery staple\n")
    path.chmod(0o600)
    return path


class Station:
    """pymavlink as its users set it up, and all that it has sent."""

    def __init__(self, port: int) -> None:
        os.environ["MAVLINK20"] = "1"  # without it pymavlink begins with MAVLink 1, which cannot be signed
        mavutil.set_dialect("common")
        self.link = mavutil.mavlink_connection(
            f"udpout:127.0.0.1:{port}", source_system=255, source_component=190
        )
        self.link.setup_signing(KEY, sign_outgoing=True)
        self.sent: list[bytes] = []
        write = self.link.write
        self.link.write = lambda frame: (self.sent.append(bytes(frame)), write(frame))

    def until(self, kind: str, holds: Callable = bool):
        """The first message that holds; a heartbeat goes out every second."""
        deadline, beat_at = time.monotonic() + 60, 0.0
        while time.monotonic() < deadline:
            if time.monotonic() > beat_at:
                self.link.mav.heartbeat_send(6, 8, 0, 0, 4)
                beat_at = time.monotonic() + 1
            message = self.link.recv_match(type=kind, blocking=True, timeout=0.2)
            if message and message.get_signed() and holds(message):
                return message
        raise AssertionError(f"no such {kind} within a minute")

    def command(self, number: int, *params: float) -> int:
        for _ in range(10):
            self.link.mav.command_long_send(1, 1, number, 0, *params, *[0] * (7 - len(params)))
            ack = self.link.recv_match(
                type="COMMAND_ACK", condition=f"COMMAND_ACK.command == {number}", blocking=True, timeout=3
            )
            if ack:
                return ack.result
        raise AssertionError(f"no answer to command {number}")

    def take_off(self) -> None:
        self.until("HEARTBEAT")
        assert self.command(DISARM, 1) == 0
        nan = float("nan")
        assert self.command(TAKEOFF, -1, 0, 0, nan, nan, nan, nan) == 0
        self.until("EXTENDED_SYS_STATE", lambda state: state.landed_state == mavlink.MAV_LANDED_STATE_IN_AIR)

    def still_armed(self) -> bool:
        """Whether the vehicle is armed in its next two heartbeats."""
        return all(self.until("HEARTBEAT").base_mode & ARMED for _ in range(2))


@pytest.fixture
def stranger() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, UDP) as stranger:
        yield stranger


def forced_disarm(version: int = 2) -> bytes:
    return Speaker(255, 190, version).pack(
        mavlink.MAVLink_command_long_message(1, 1, DISARM, 0, 0, FORCED, 0, 0, 0, 0, 0)
    )


def test_only_who_has_the_key_stops_the_motors_in_the_air_and_no_frame_of_the_former_run_does(
    start, key: Path, stranger: socket.socket, wait_until: Callable
) -> None:
    port = free_port(UDP)
    words = ("sitl", "uav", "--out", f"udpin:127.0.0.1:{port}", "--sign", str(key), "--speedup", "4")
    station = Station(port)
    vehicle = start(*words)
    station.take_off()

    def refused(frame: bytes, reason: str) -> None:
        """Send a frame as a stranger; it is refused for this reason and does nothing."""
        with socket.socket(socket.AF_INET, UDP) as other:
            other.sendto(frame, ("127.0.0.1", port))
            me = f"127.0.0.1:{other.getsockname()[1]}"
            wait_until(lambda: vehicle.says(f"udpin:127.0.0.1:{port}: {me}: frames {reason} are refused"))
        assert station.still_armed()

    unsigned = forced_disarm()
    refused(unsigned, "without a signature")
    refused(forced_disarm(version=1), "without a signature")
    refused(
        as_signed(unsigned, 9, timestamp(), key=hashlib.sha256(b"guess").digest()), "with a wrong signature"
    )
    refused(as_signed(unsigned, 9, timestamp() - 61 * 100_000), "with an old timestamp")
    refused(station.sent[-1], "with an old timestamp")

    assert station.command(DISARM, 0, FORCED) == 0
    station.until("HEARTBEAT", lambda beat: not beat.base_mode & ARMED)
    station.until(
        "EXTENDED_SYS_STATE", lambda state: state.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND
    )
    captured = [*station.sent]
    vehicle.kill()

    vehicle = start(*words)
    station.take_off()
    for frame in captured:
        refused(frame, "with an old timestamp") if frame is captured[0] else stranger.sendto(
            frame, ("127.0.0.1", port)
        )
    assert station.still_armed()
    assert not vehicle.says("Traceback")


def test_a_key_does_not_come_over_a_link_though_it_be_signed(start, key: Path) -> None:
    port = free_port(UDP)
    start("sitl", "uav", "--out", f"udpin:127.0.0.1:{port}", "--sign", str(key))
    station = Station(port)
    station.until("HEARTBEAT")
    station.link.mav.setup_signing_send(1, 1, list(b"n" * 32), timestamp())
    said = station.until("STATUSTEXT")
    assert said.text == "Signing setup refused: no keys over a link"
    assert station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 148) == 0  # the old key still holds


def test_a_bridge_verifies_what_comes_signs_what_goes_and_leaves_the_bus_and_serial_lines_unsigned(
    start, router: str, key: Path, tmp_path: Path, wait_until: Callable
) -> None:
    udp, tcp = free_port(UDP), free_port(TCP)
    with ExitStack() as stack:
        serial = stack.enter_context(SerialWire(tmp_path / "tty"))
        urls = [f"udpin:127.0.0.1:{udp}", f"tcpin:127.0.0.1:{tcp}", f"serial:{tmp_path / 'tty'}:115200"]
        bus = stack.enter_context(BusWire(router))
        bus.settle()  # what a bridge says that knows of no receiver is not sent
        bridge = start("sitl", "bridge", *urls, "--connect", router, "--sign", str(key))
        wait_until(lambda: bridge.says("115200: open"))
        station, stranger = stack.enter_context(UdpWire(udp)), stack.enter_context(UdpWire(udp))
        caller = stack.enter_context(TcpWire(socket.create_connection(("127.0.0.1", tcp))))
        person, drone, old = Speaker(255, 190), Speaker(1, 1), Speaker(2, 1, version=1)

        beats = [person.beat() for _ in range(2)]
        for wire, beat in zip((station, caller), beats, strict=True):
            stranger.say(forced_disarm())
            wire.say(as_signed(beat, 3, timestamp()))
            wait_until(lambda beat=beat: count(bus.into, beat) == 1 and serial.has(beat))
        order = as_signed(person.order(1), 3, timestamp())
        serial_beat = drone.beat(autopilot=True)
        serial.say(serial_beat)
        wait_until(lambda: count(bus.out, serial_beat) == 1)
        station.say(order)
        wait_until(lambda: any(frame.data[7:10] == b"\x4c\0\0" for frame in serial.heard))
        stranger.say(order)
        radio = Speaker(51, 68)
        strangers, stations = (
            radio.pack(mavlink.MAVLink_radio_status_message(rssi, 2, 3, 4, 5, 6, 7)) for rssi in (1, 2)
        )
        stranger.say(strangers)
        station.say(stations)
        wait_until(lambda: count(bus.into, stations) == 1)
        station.say(
            as_signed(person.pack(mavlink.MAVLink_setup_signing_message(1, 1, b"n" * 32, 1)), 3, timestamp())
        )
        bus.say(MAVLINK_OUT, old.beat(autopilot=True))
        last = drone.beat(autopilot=True)
        serial.say(last)
        wait_until(
            lambda: any(
                frame.data[:2] + frame.data[3:-15] == last[:2] + last[3:-2]
                for frame in caller.heard + station.heard
            )
        )

        wait_until(lambda: count(bus.out, last) == 1)
        for wire in (station, caller):
            assert wire.heard
            assert all(is_rightly_signed(frame.data) for frame in wire.heard)
        assert stranger.heard == []
        bus.settle()
        everything = [frame.data for frame in (*bus.into, *bus.out, *serial.heard)]
        assert not any(frame[0] == 0xFD and frame[2] for frame in everything)
        assert strangers not in everything
        assert not any(frame[7:10] == b"\0\1\0" or b"n" * 32 in frame for frame in everything)
        assert sum(frame.data[7:10] == b"\x4c\0\0" for frame in serial.heard) == 1

        told = subprocess.run(
            [sys.executable, "-m", "sitl", "status", "--connect", router, "--parts", "bridge", "--json"],
            capture_output=True,
            text=True,
        )
        bridge.process.terminate()
        assert bridge.ended() == 0
        refused = json.loads(told.stdout)["parts"]["bridge"]["refused"]
        assert refused[f"without a signature (udpin:127.0.0.1:{udp})"] == 2
        assert refused[f"with an old timestamp (udpin:127.0.0.1:{udp})"] == 1
        counts = next(line for line in bridge.err if f"udpin:127.0.0.1:{udp}: 5 frames in" in line)
        for dropped in (
            "2 without a signature",
            "1 with an old timestamp",
            "1 with a key (SETUP_SIGNING)",
            "1 of MAVLink 1, which cannot be signed",
        ):
            assert dropped in counts


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["uav", "--out", "udpout:127.0.0.1:9", "--sign", "none.key"],
            "--sign: 'none.key': No such file or directory; wanted a file with",
        ),
        (
            ["fly", "--out", "udpout:127.0.0.1:9", "--sign", "two.key"],
            "--sign: 'two.key' has more than one line; wanted a file with",
        ),
        (
            ["bridge", "udpout:127.0.0.1:9", "--sign", "two.key"],
            "--sign: 'two.key' has more than one line; wanted a file with",
        ),
        (["fly", "--sign", "fleet.key"], "--sign: there is nothing to sign; wanted it with --out"),
        (["uav", "--sign", "fleet.key"], "--sign: there is nothing to sign; wanted it with --out"),
        (
            ["bridge", "serial:/dev/null", "--sign", "fleet.key"],
            "--sign: serial lines are not signed; wanted it with a UDP or TCP endpoint",
        ),
        (["uav", "--out", "udpout:127.0.0.1:9", "--sign", "used.key"], "line 1 is damaged"),
    ],
)
def test_what_cannot_be_signed_gets_one_line_and_status_2(words: list[str], said: str, key: Path) -> None:
    key.with_name("two.key").write_text("one\ntwo\n")
    key.with_name("used.key").write_text("one")
    key.with_name("used.key.uav-1").write_text("something else\n")
    ended = subprocess.run(
        [sys.executable, "-m", "sitl", *words],
        capture_output=True,
        text=True,
        timeout=400,
        cwd=key.parent,
        env={"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": "/usr/bin:/bin"},
    )
    assert ended.returncode == 2, ended.stderr
    (line,) = [line for line in ended.stderr.splitlines() if "error" in line]
    assert said in line


def test_two_processes_with_one_key_go_side_by_side_unless_they_are_the_same_vehicle(
    start, key: Path, wait_until: Callable
) -> None:
    words = ("sitl", "uav", "--sign", str(key))
    ports = [free_port(UDP), free_port(UDP)]
    for instance, port in enumerate(ports):
        start(*words, "-I", str(instance), "--out", f"udpin:127.0.0.1:{port}")
    stations = [Station(port) for port in ports]
    for system, station in enumerate(stations, 1):
        station.until("HEARTBEAT", lambda beat, system=system: beat.get_srcSystem() == system)
    third = start(*words, "--out", f"udpin:127.0.0.1:{free_port(UDP)}")
    assert third.ended() == 2
    assert third.err[-1].startswith("error: --sign: ")
    assert (
        "fleet.key.uav-1' is in use by another process; wanted one process for each vehicle or bus"
        in third.err[-1]
    )


def test_a_mission_is_flown_and_all_that_it_sends_over_udp_is_signed(start, key: Path) -> None:
    with UdpWire() as wire:
        words = (
            "--budget",
            "5",
            "--speedup",
            "0",
            "--no-record",
            "--out",
            f"udpout:127.0.0.1:{wire.port}",
            "--sign",
            str(key),
        )
        fly = start("sitl", "fly", *words, cwd=key.parent)
        assert fly.ended() == 0, "".join(fly.err)
        assert len(wire.heard) > 50
        assert all(is_rightly_signed(frame.data) for frame in wire.heard)
        times = [int.from_bytes(frame.data[-12:-6], "little") for frame in wire.heard]
        assert times == sorted(set(times))
