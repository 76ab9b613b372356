"""An aircraft in its search's words: where it may fly, what it tells, and results of commands."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from plume.problem import AREA, CLEARANCE_M, Area, Fenced

# (north, east, down): position in m from home, velocity in m/s or acceleration in m/s². Down grows towards
# the ground.
Ned = tuple[float, float, float]
ZERO: Ned = (0.0, 0.0, 0.0)
OTHER_TARGET = "to another target"  # how a pilot takes a vehicle without a change of its mode
LOW_BATTERY = 0.15  # share of the charge at which the low-battery warning comes; PX4's default


def as_float32(position: Ned) -> Ned:
    """The position rounded to float32, as the wire carries it."""
    with np.errstate(over="ignore"):  # a number too large becomes infinite, and the fence refuses it
        north, east, down = np.array(position, np.float32).tolist()
    return north, east, down


def metres(value: float) -> str:
    """Return the shortest decimal that rounds to this float32: 31.1, not 31.100000381."""
    return str(np.float32(value))


@dataclass(frozen=True, kw_only=True)
class AircraftConfig:
    """Where an aircraft may fly, and how long it may be left without a waypoint."""

    area: Area = AREA  # where it searches: x east, y north, m from home
    # Latitude and longitude from which the area is meant, degrees; None: from wherever home is.
    home_meant: tuple[float, float] | None = None
    ceiling_m: float = 120.0  # highest altitude above home
    takeoff_altitude_m: float = 5.0
    # Time without a setpoint after which OFFBOARD fails safe: return in the air, disarm on the ground
    silence_s: float = 30.0

    @cached_property
    def flown(self) -> Area:
        """Where it may fly: the search area, and what it crosses on the way from home."""
        (west, south), (east, north) = self.area.low, self.area.high
        return Area((min(west, 0.0), min(south, 0.0)), (max(east, 0.0), max(north, 0.0)))

    def outside(self, position: Ned) -> tuple[str, str] | None:
        """Return why a position (NED, m from home) is outside the area or the altitudes: kind and reason.

        None if it is inside.
        """
        north, east, down = position
        place = f"({metres(east)}, {metres(north)}) m"
        if not all(map(math.isfinite, position)):
            return "not finite", f"{place} at {metres(-down)} m is not finite"
        if not self.flown.holds((east, north)):
            return "outside the area", f"{place} is outside the area {self.flown.text}"
        if not 0.0 <= -down <= self.ceiling_m:
            return "outside the altitudes", f"altitude {metres(-down)} m is outside [0, {self.ceiling_m:g}] m"
        return None

    @property
    def home_within_m(self) -> float:
        """How far from `home_meant` home may be: no further than ways stay from polygons."""
        return self.area.clearance_m if isinstance(self.area, Fenced) else CLEARANCE_M

    def in_the_way(self, start: Ned, end: Ned) -> tuple[str, str] | None:
        """Return why the straight way between positions is not to be flown: kind and reason.

        None if it crosses no polygon to keep out of, at whatever altitude.
        """
        obstacles = self.area.obstacles
        way = np.array([start[1::-1], end[1::-1]])
        if obstacles is None or not obstacles.cross(way):
            return None
        return "keep-out", f"the way to ({metres(end[1])}, {metres(end[0])}) m crosses a polygon of keep_out"


class Arrived(NamedTuple):
    """The vehicle came to rest on a setpoint (NED, m from home): one reading is due here."""

    time_s: float
    position: Ned
    # A real autopilot's clock when it was at the position; None: the vehicle has no clock but that of the
    # simulation
    boot_ms: int | None = None


class Said(NamedTuple):
    """A text that the autopilot sends unasked, as STATUSTEXT (253)."""

    time_s: float
    severity: int  # MAV_SEVERITY
    text: str
    heard: bool = False  # whether a real autopilot has said it itself, so that its clients have heard it


class Reached(NamedTuple):
    """An item of the mission is done, as MISSION_ITEM_REACHED (46) tells."""

    time_s: float
    seq: int


class TakenOver(NamedTuple):
    """A pilot, or the autopilot itself, has changed the flight mode or the target of a real autopilot."""

    time_s: float
    mode: str  # the autopilot's name of the mode, and that the target is another one
    by: str = ""  # who asked for it, if a client has; empty: the autopilot itself, or a pilot by another way


VehicleEvent = Arrived | Said | Reached | TakenOver


class VehicleFailed(Exception):
    """The vehicle cannot fly the search, or no longer; the text is the reason."""


class Result(NamedTuple):
    """The result of a command: a MAV_RESULT, and the reason if it was refused."""

    code: int
    reason: str = ""
    kind: str = ""  # kind of reason, for counting refused setpoints; empty for other commands

    @property
    def accepted(self) -> bool:
        """True for MAV_RESULT_ACCEPTED."""
        return self.code == ACCEPTED.code


ACCEPTED = Result(mavlink.MAV_RESULT_ACCEPTED)
UNSUPPORTED = Result(mavlink.MAV_RESULT_UNSUPPORTED)


def not_now(reason: str) -> Result:
    """A refusal because of the vehicle's current state (MAV_RESULT_TEMPORARILY_REJECTED)."""
    return Result(mavlink.MAV_RESULT_TEMPORARILY_REJECTED, reason)


def going_on(what: str) -> Result:
    """What is asked for takes its time (MAV_RESULT_IN_PROGRESS): it has to be asked again."""
    return Result(mavlink.MAV_RESULT_IN_PROGRESS, what)


def denied(reason: str, kind: str = "") -> Result:
    """A refusal because the request itself is invalid (MAV_RESULT_DENIED)."""
    return Result(mavlink.MAV_RESULT_DENIED, reason, kind)
