"""Vehicles in the initial situations of the tests, and helpers that read their events."""

import math

from aircraft.state import Arrived, Ned, Said, VehicleEvent
from link.modes import Mode
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.vehicle import Vehicle

ACCEPTED, REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3  # MAV_RESULT
GROUND, IN_AIR, TAKING_OFF, LANDING = 1, 2, 3, 4  # MAV_LANDED_STATE
NAN = math.nan
CONFIG = VehicleConfig()
CLIMB_S = (
    5.0 / 3.0 + 1.0
)  # the take-off to 5 m: 3 m/s at 3 m/s², so two ramps of 1 s and 1.5 m, and 2 m of cruise


def on_the_ground(config: VehicleConfig = CONFIG) -> Vehicle:
    return Vehicle(config)


def hovering(config: VehicleConfig = CONFIG) -> Vehicle:
    """A vehicle that holds 5 m above home."""
    vehicle = Vehicle(config)
    assert vehicle.arm(0.0).accepted
    assert vehicle.take_off(0.0).accepted
    vehicle.advance(CLIMB_S + 0.01)
    assert vehicle.state(vehicle.now_s).mode is Mode.HOLD
    return vehicle


def offboard(config: VehicleConfig = CONFIG) -> Vehicle:
    """A vehicle in OFFBOARD at rest 5 m above home; its arrival event has already been read."""
    vehicle = hovering(config)
    t = vehicle.now_s
    vehicle.setpoint(t, (0.0, 0.0, -5.0))
    assert vehicle.set_mode(t, Mode.OFFBOARD).accepted
    assert places(vehicle.advance(t)) == [(0.0, 0.0, -5.0)]
    return vehicle


def fly_on(vehicle: Vehicle, until_s: float = math.inf) -> list[VehicleEvent]:
    """Jump from event to event, as an event-driven loop does."""
    events: list[VehicleEvent] = []
    while vehicle.moving and (at := vehicle.next_event_s()) is not None and at <= until_s:
        events += vehicle.advance(at)
    return events


def places(events: list[VehicleEvent]) -> list[Ned]:
    return [event.position for event in events if isinstance(event, Arrived)]


def texts(events: list[VehicleEvent]) -> list[str]:
    return [event.text for event in events if isinstance(event, Said)]
