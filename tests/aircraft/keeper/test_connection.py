"""Protects the connection to an autopilot: TCP and UDP, both autopilots, in real time, and an endpoint
that goes and comes.
"""

import math
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.bridge.address import parse_address
from aircraft.keeper.connection import Connection
from aircraft.remote.commander import Commander, VehicleFailed
from aircraft.remote.safety import Check, Verdict
from aircraft.remote.vehicle import RemoteVehicle
from aircraft.state import Arrived, Said
from link.bus.log import Log
from link.bus.tally import Tally
from link.modes import Mode
from sitl.autopilot.config import VehicleConfig
from tests.autopilots.settings import Settings
from tests.autopilots.wire import Double

SPEEDUP = 2.0
STRETCHED = (("COM_OF_LOSS_T", 1.0 * SPEEDUP),)
"""PX4's own simulation stretches this time, too."""


def keepers() -> list[str]:
    """The command lines of the keepers that this process has started and that still run."""
    pids = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    lines = [Path(f"/proc/{pid}/cmdline").read_text() for pid in pids]  # empty of one that has ended
    return [line for line in lines if "aircraft.keeper.keeper" in line]


@pytest.fixture(autouse=True)
def _no_keeper_is_left(wait_until: Callable[..., None]) -> Iterator[None]:
    """On a busy machine a keeper outlasts its connection, and would be found running in another test."""
    yield
    wait_until(lambda: not keepers())


class Flown:
    """A vehicle behind a connection, in real time."""

    def __init__(self, double: Double, sysid: int | None = None) -> None:
        self.connection = Connection(parse_address(double.url), Log("uav", "test", Tally(), "error"))
        self.vehicle = RemoteVehicle(VehicleConfig(), Commander(self.connection, SPEEDUP, sysid))
        self.vehicle.preflight.take_wind(Check("wind", Verdict.OK, "given by --wind"))
        self.arrived: list[tuple[float, float, float]] = []
        self.said: list[str] = []
        self._began = time.monotonic()

    @property
    def now_s(self) -> float:
        return (time.monotonic() - self._began) * SPEEDUP

    def look(self) -> None:
        """One look, when something has come."""
        self.connection.selector.select(0.01)
        for event in self.vehicle.advance(self.now_s):
            if isinstance(event, Arrived):
                self.arrived.append(event.position)
            elif isinstance(event, Said):
                self.said.append(event.text)

    def until(self, holds: Callable[[], object], timeout_s: float = 100.0) -> None:
        """Look until something holds."""
        deadline = time.monotonic() + timeout_s
        while not holds():
            assert time.monotonic() < deadline, f"not true within {timeout_s:g} s; said: {self.said}"
            self.look()


def test_the_radio_on_the_link_is_handed_on_though_it_has_a_system_id_of_its_own() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    connection = Connection(parse_address(f"udpin:127.0.0.1:{port}"), Log("uav", "test", Tally(), "error"))
    radio = mavlink.MAVLink_radio_status_message(180, 170, 90, 40, 38, 0, 0).pack(
        mavlink.MAVLink(None, 51, 68)
    )
    other = mavlink.MAVLink_ping_message(1, 0, 0, 0).pack(mavlink.MAVLink(None, 9, 1))
    heard: list[bytes] = []
    with closing(connection), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        connection.use(1)
        deadline = time.monotonic() + 60
        while bytes(radio) not in heard:
            assert time.monotonic() < deadline
            beat = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(mavlink.MAVLink(None, 1, 1))
            for frame in (beat, other, radio):
                link.sendto(frame, ("127.0.0.1", port))
            connection.selector.select(0.05)
            connection.poll()
            heard += connection.frames()
    assert bytes(other) not in heard


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "listen"),
    [
        ("ardupilot", "tcp:127.0.0.1:0"),
        ("px4", "udpin:127.0.0.1:0"),
        pytest.param("ardupilot", "udpin:127.0.0.1:0", marks=pytest.mark.full),
        pytest.param("px4", "tcp:127.0.0.1:0", marks=pytest.mark.full),
    ],
)
def test_a_vehicle_flies_over_tcp_and_udp(kind: str, listen: str) -> None:
    with Double(
        kind, listen, Settings(ready_s=5.0, parameters=STRETCHED if kind == "px4" else ()), SPEEDUP
    ) as double:
        flown = Flown(double)
        vehicle = flown.vehicle
        flown.until(lambda: vehicle.arm(flown.now_s).accepted)
        assert vehicle.take_off(flown.now_s).accepted
        flown.until(lambda: vehicle.mode is Mode.HOLD)
        assert vehicle.setpoint(flown.now_s, (3.0, 2.0, -5.0)).accepted
        assert vehicle.set_mode(flown.now_s, Mode.OFFBOARD).accepted
        flown.until(lambda: flown.arrived)
        assert math.dist(flown.arrived[0], (3.0, 2.0, -5.0)) < 0.3 + 0.01
        assert vehicle.set_mode(flown.now_s, Mode.LAND).accepted
        flown.until(lambda: not vehicle.armed)
        flown.connection.close()


def test_px4s_own_ports_are_udpin_here() -> None:
    with Double("px4", "udp", Settings(instance=41, ready_s=5.0), SPEEDUP) as double:
        flown = Flown(double)
        flown.until(lambda: flown.vehicle.arm(flown.now_s).accepted)
        assert flown.vehicle.flight.commander.system == 42
        flown.connection.close()


def test_a_connection_that_is_lost_comes_back() -> None:
    with Double("ardupilot", settings=Settings(ready_s=5.0), speedup=SPEEDUP) as double:
        flown = Flown(double)
        flown.until(lambda: flown.vehicle.flight.commander.system)
        client = double.wire.autopilot
        double.hang_up()
        heard_s = flown.vehicle.flight.known.heard_s
        flown.until(lambda: flown.vehicle.flight.known.heard_s > heard_s + 10.0)
        assert client is double.wire.autopilot
        flown.connection.close()


def test_heartbeats_come_once_a_second_of_the_vehicles_time() -> None:
    """Its failsafes count by that: once a second of real time would be every 5 s, and the timeout of
    FS_GCS is 5 s.
    """
    settings = Settings(ready_s=5.0, parameters=(("FS_GCS_ENABLE", 1.0), ("SYSID_MYGCS", 1.0)))
    with Double("ardupilot", settings=settings, speedup=SPEEDUP) as double:
        flown = Flown(double)
        flown.until(lambda: double.wire.autopilot.station_seen_s)
        began_s = double.wire.autopilot.now_s
        flown.until(lambda: double.wire.autopilot.now_s > began_s + 12.0)
        assert not double.wire.autopilot.station_lost
        flown.connection.close()


def test_another_system_than_the_one_that_is_wanted_is_not_flown() -> None:
    with Double("ardupilot", settings=Settings(ready_s=5.0), speedup=SPEEDUP) as double:
        flown = Flown(double, sysid=7)
        began_s = double.wire.autopilot.now_s
        flown.until(lambda: double.wire.autopilot.now_s > began_s + 5.0)  # it has had five heartbeats to find
        assert not flown.vehicle.flight.commander.system
        flown.connection.close()


def test_an_autopilot_of_another_kind_fails_in_one_line() -> None:
    with Double("ardupilot", speedup=SPEEDUP) as double:
        double.wire.autopilot.autopilot = 0
        flown = Flown(double)
        with pytest.raises(
            VehicleFailed,
            match=r"^system 1: autopilot GENERIC \(0\) is not supported; wanted an ArduCopter or a PX4",
        ):
            flown.until(lambda: False)
        flown.connection.close()


@pytest.mark.parametrize("url", ["tcp:127.0.0.1:1", "udpin:192.0.2.1:14999"])  # the second cannot be used
def test_a_keeper_whose_uav_is_interrupted_at_the_start_says_nothing(url: str) -> None:
    uav, its = socket.socketpair()
    unread, stdout = os.pipe()
    os.close(unread)
    uav.close()
    with its, open(stdout, "wb") as line:
        kept = subprocess.run(
            [sys.executable, "-m", "aircraft.keeper.keeper", url, "info", "1"],
            stdin=its,
            stdout=line,
            stderr=subprocess.PIPE,
            timeout=400,
        )
    assert (kept.returncode, kept.stderr) == (0, b"")


@pytest.mark.parametrize(
    ("url", "state"),
    [
        (
            "tcp:127.0.0.1:1",
            "at tcp:127.0.0.1:1 (Connection refused; it is tried again): is it running? it is a server: "
            "ArduPilot's SITL",
        ),
        (
            "udpout:127.0.0.1:14999",
            "at udpout:127.0.0.1:14999: is it running? MAVSDK: udpin://0.0.0.0:14999, pymavlink",
        ),
    ],
)
def test_what_cannot_be_heard_is_told_with_the_url_that_the_other_side_needs(
    url: str, state: str, wait_until: Callable[..., None]
) -> None:
    with closing(Connection(parse_address(url), Log("uav", "test", Tally(), "error"))) as connection:

        def told() -> bool:
            connection.selector.select(0.05)
            connection.poll()
            return connection.state.startswith(state)

        wait_until(told)  # its keeper tells each second
