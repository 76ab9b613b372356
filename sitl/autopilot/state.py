"""What is told of a vehicle: its modes, its state at one instant, what happened to it, what became of a command."""

from enum import Enum
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from sitl.autopilot.motion import Ned

LOW_BATTERY = 0.15


class Mode(Enum):
    """The PX4 flight modes that are flown here, as PX4 numbers them: (main mode, sub mode)."""

    TAKEOFF = (4, 2)
    HOLD = (4, 3)
    RETURN = (4, 5)
    LAND = (4, 6)
    OFFBOARD = (6, 0)

    @property
    def custom_mode(self) -> int:
        """The two in one number, as HEARTBEAT carries them."""
        main, sub = self.value
        return int(main << 16 | sub << 24)


class State(NamedTuple):
    """All that telemetry needs to know of the vehicle at one instant. Vectors are north, east, down from home."""

    time_s: float
    position: Ned
    velocity: Ned
    acceleration: Ned
    roll: float
    pitch: float
    yaw: float
    yaw_rate: float
    mode: Mode
    armed: bool
    landed_state: int
    """MAV_LANDED_STATE."""
    failsafe: bool
    battery: float
    """What is left of it, 0 to 1."""
    fit: bool
    """Nothing but being disarmed keeps it from flying."""


class Arrived(NamedTuple):
    """A setpoint was reached, to the last bit: take one reading here."""

    time_s: float
    position: Ned


class Said(NamedTuple):
    """The autopilot has something to say, unasked."""

    time_s: float
    severity: int
    """MAV_SEVERITY."""
    text: str


VehicleEvent = Arrived | Said


class Result(NamedTuple):
    """What became of a command: a MAV_RESULT, and the reason where it was refused."""

    code: int
    reason: str = ""
    kind: str = ""
    """Which of the reasons that a setpoint is refused for."""

    @property
    def accepted(self) -> bool:
        """Whether it is being done."""
        return self.code == ACCEPTED.code


ACCEPTED = Result(mavlink.MAV_RESULT_ACCEPTED)


def not_now(reason: str) -> Result:
    """Refused because of the state that the vehicle is in."""
    return Result(mavlink.MAV_RESULT_TEMPORARILY_REJECTED, reason)


def denied(reason: str, kind: str = "") -> Result:
    """Refused because of what was asked."""
    return Result(mavlink.MAV_RESULT_DENIED, reason, kind)
