"""Protects whom the page commands, and whose picture and time are shown, from other systems on the
vehicle's bus.
"""

import msgspec
import pytest
from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Codec
from link.bus.messages import Health
from link.record.own import OwnSystem
from link.record.record import SimulationClock
from scene.follow.history import History
from scene.scene import Backdrop


def beat(system: int, component: int = 1, time_boot_ms: int = 1000, north: float = 0.0) -> bytes:
    """What an autopilot says of itself."""
    heartbeat = mavlink.MAVLink_heartbeat_message(2, 12, 128, 6 << 16, 4, 3)
    return Codec(system, component).pack(
        heartbeat, mavlink.MAVLink_local_position_ned_message(time_boot_ms, north, 0, -5, 0, 0, 0)
    )


def health(system: int) -> bytes:
    return msgspec.json.encode(Health("uav", "searching", 1, 0.1, 1.0, {}, system=system))


@pytest.fixture
def own() -> OwnSystem:
    return OwnSystem()


def test_the_first_autopilot_that_is_heard_is_the_vehicle_and_stays_it(own: OwnSystem) -> None:
    own.learn("mavlink/in", beat(255, 190))
    own.learn("mavlink/out", beat(7, 154) + b"")  # a gimbal
    assert own.system == 0
    for system in (3, 42, 1):
        own.learn("mavlink/out", beat(system))
        assert own.system == 3


def test_what_the_vehicles_health_tells_goes_before_what_is_heard(own: OwnSystem) -> None:
    own.learn("mavlink/out", beat(42))
    assert own.learn("health/uav", health(3))  # it was taken for another one
    assert own.system == 3
    assert not own.learn("mavlink/out", beat(42))
    for key, payload in (
        ("health/agent", health(42)),
        ("health/uav", health(0)),
        ("health/uav", b'{"system": 300}'),
        ("health/uav", b"["),
    ):
        own.learn(key, payload)
    assert own.system == 3


@pytest.mark.parametrize("noise", [b"", b"noise", beat(9)[:-1], beat(9)[:-1] + b"\0"])
def test_noise_is_no_vehicle(own: OwnSystem, noise: bytes) -> None:
    own.learn("mavlink/out", noise)
    assert own.system == 0


def test_another_system_on_the_bus_neither_begins_a_mission_nor_moves_the_vehicle() -> None:
    history = History(Backdrop("uav/1"))
    for second in range(20, 40):
        history.take("mavlink/out", beat(1, time_boot_ms=1000 * second, north=1.0), b"", float(second), 100.0)
        history.take("mavlink/out", beat(42, time_boot_ms=second, north=9.0), b"", float(second), 100.0)
        history.take("mavlink/out", beat(1, 191, time_boot_ms=second, north=9.0), b"", float(second), 100.0)
    scene = history.at()
    assert history.missions == 1
    assert scene.track.tolist() == [[0.0, 1.0]]
    assert scene.craft is not None
    assert scene.craft.position == (0.0, 1.0)


def test_a_picture_of_another_system_goes_when_the_vehicle_tells_which_one_it_is() -> None:
    history = History(Backdrop("uav/1"))
    history.take("mavlink/out", beat(42, time_boot_ms=90_000, north=9.0), b"", 1.0, 100.0)
    history.take("health/uav", health(1), b"", 1.0, 100.0)
    assert history.at().craft is None
    history.take("mavlink/out", beat(1, north=2.0), b"", 1.0, 100.0)
    assert (history.missions, history.at().track.tolist()) == (1, [[0.0, 2.0]])


def test_the_clock_of_a_record_is_the_vehicles_alone() -> None:
    clock = SimulationClock()
    assert clock.time_s("mavlink/out", beat(1, time_boot_ms=20_000), 1) == 20.0
    assert clock.time_s("mavlink/out", beat(42, time_boot_ms=900_000), 2) == 20.0
    assert clock.time_s("health/agent", b"", 3) == 20.0
    assert clock.time_s("mavlink/out", beat(42, time_boot_ms=1) + beat(1, time_boot_ms=21_000), 4) == 21.0
