"""Protects all clients of a vehicle from one of them: a message that meets a fault of ours is dropped,
counted and told, and no more.
"""

import os
import signal
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.operator import change_mode, command
from aircraft.search.clock import Clock
from aircraft.search.command import Orders
from aircraft.search.uav import Equipment, Speaker
from aircraft.state import Result, VehicleEvent, VehicleFailed
from link.bus.inbox import Inbox
from link.bus.keys import MAVLINK_IN, MAVLINK_OUT
from link.bus.mavlink import Codec, unpack
from link.bus.session import Arrival
from link.modes import Mode
from plume.scenario import draw
from plume.sensor import Gaussian
from plume.worlds.world import World
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.vehicle import Vehicle
from sitl.uav.simulated import simulated_uav
from tests.fuzz.services import QuietBus

FIRST, SECOND = Codec(255, 190), Codec(250, 1)
AIRBORNE = (
    command(1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0),
    command(1, mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3.0),
)


class Heard(Inbox):
    """An inbox of payloads on `mavlink/in`; after the last one a signal comes."""

    def __init__(self, *payloads: bytes) -> None:
        super().__init__()
        self._left = [*payloads]

    def get(self, timeout: float | None = None) -> Any:
        if not self._left:
            os.kill(os.getpid(), signal.SIGTERM)
            return None
        return Arrival(MAVLINK_IN, self._left.pop(0), b"")


class FaultyModes(Vehicle):
    """A vehicle with a fault that a change of mode meets."""

    fault: Exception = KeyError("a fault")

    def set_mode(self, *args: Any, **kwargs: Any) -> Result:
        raise self.fault


class FaultyTime(Vehicle):
    """A vehicle with a fault that no message meets."""

    def advance(self, t_s: float) -> list[VehicleEvent]:
        raise KeyError("a fault")


def flown(vehicle: Vehicle, *payloads: bytes) -> QuietBus:
    """Return the bus of a vehicle that was told these messages."""
    bus = QuietBus()
    world = World(draw(1_000_000), 1, Gaussian())
    uav = simulated_uav(
        vehicle, Orders(world), Equipment(Clock(1.0), Heard(*payloads), bus, Speaker(bus.log))
    )
    with pytest.raises(KeyboardInterrupt):
        uav.run()
    return bus


def acknowledged(bus: QuietBus) -> list[int]:
    """The commands that the vehicle has taken."""
    said = [message for key, payload, _ in bus.published if key is MAVLINK_OUT for message in unpack(payload)]
    return [
        it.command
        for it in said
        if it.get_type() == "COMMAND_ACK" and it.result == mavlink.MAV_RESULT_ACCEPTED
    ]


def test_a_message_that_meets_a_fault_is_counted_and_named_once_a_type_and_the_vehicle_flies_for_the_others(
    capsys: pytest.CaptureFixture[str],
) -> None:
    vehicle = FaultyModes(VehicleConfig())
    hold = change_mode(1, Mode.HOLD)
    arm, take_off = map(SECOND.pack, AIRBORNE)
    bus = flown(vehicle, FIRST.pack(hold) + arm, FIRST.pack(hold), take_off)
    assert bus.tally.refused == {"fault": 2}
    assert acknowledged(bus) == [mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_CMD_NAV_TAKEOFF]
    assert vehicle.moving
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "fault" in line]
    assert "level=error" in line
    assert "of 255/190 dropped: KeyError: 'a fault'" in line
    assert "set_mode" in line  # the traceback says where


def test_a_vehicle_that_has_failed_ends_whoever_made_it_known() -> None:
    vehicle = FaultyModes(VehicleConfig())
    vehicle.fault = VehicleFailed("it is gone")
    with pytest.raises(VehicleFailed):
        flown(vehicle, FIRST.pack(change_mode(1, Mode.HOLD)))


def test_a_fault_of_the_loop_itself_ends_the_vehicle_loudly() -> None:
    with pytest.raises(KeyError):
        flown(FaultyTime(VehicleConfig()))
