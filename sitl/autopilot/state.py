"""What the vehicle reports: flight modes, the state at one instant, events, and results of commands."""

from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from aircraft.mode import Mode as Mode
from plume.geodesy import to_global
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.motion import Ned
from sitl.autopilot.plan import MissionProgress

LOW_BATTERY = 0.15
"""Share of the charge at which the low-battery warning comes; PX4's default."""


class Breaches(NamedTuple):
    """How often and when the fence was left."""

    outside: bool = False
    """True while the vehicle is outside."""
    times: int = 0
    last_s: float = 0.0
    """Time of the last breach; 0 if there was none."""


class State(NamedTuple):
    """The vehicle at one instant. Vectors are NED from home, in m, m/s and m/s²; angles in rad, yaw
    clockwise from north.
    """

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
    """Remaining charge, 0 to 1."""
    fit: bool
    """False if the battery is empty or the vehicle is falling: it then cannot be armed."""
    target: Ned
    """Where the current path ends."""
    cruise: Ned | None = None
    """The velocity that a companion asks for, within the limits; None on the way to a position or while it
    asks for an acceleration.
    """
    mission: MissionProgress = MissionProgress()
    breaches: Breaches = Breaches()


class Snapshot(NamedTuple):
    """The vehicle and the air at one instant: the input of every message."""

    config: VehicleConfig
    state: State
    wind: tuple[float, float]
    """(u cos φ, u sin φ) m/s, x east, y north: points to where the wind comes from."""
    gas: tuple[int, float] | None
    """time_boot_ms and value of the last reading, in the sensor's unit; None before the first."""

    @property
    def time_boot_ms(self) -> int:
        """Milliseconds since the start of the simulation, 32 bits (wraps after 49.7 days)."""
        return round(self.state.time_s * 1000.0) & 0xFFFFFFFF

    @property
    def lat_lon_e7(self) -> tuple[int, int]:
        """Latitude and longitude in 1e-7 degrees."""
        north, east, _ = self.state.position
        lat, lon = to_global(self.config.home_lat_deg, self.config.home_lon_deg, north, east)
        return round(lat * 1e7), round(lon * 1e7)

    @property
    def altitude_m(self) -> float:
        """Above mean sea level."""
        return self.config.home_alt_m - self.state.position[2]


class Arrived(NamedTuple):
    """The vehicle came to rest on a setpoint (NED, m from home): one reading is due here."""

    time_s: float
    position: Ned
    boot_ms: int | None = None
    """A real autopilot's clock when it was at the position; None: the vehicle has no clock but that of the
    simulation.
    """


class Said(NamedTuple):
    """A text that the autopilot sends unasked, as STATUSTEXT (253)."""

    time_s: float
    severity: int
    """MAV_SEVERITY."""
    text: str
    heard: bool = False
    """Whether a real autopilot has said it itself, so that its clients have heard it."""


class Reached(NamedTuple):
    """An item of the mission is done, as MISSION_ITEM_REACHED (46) tells."""

    time_s: float
    seq: int


class Led(NamedTuple):
    """Someone else has changed the flight mode or the target of a real autopilot: a pilot, or the
    autopilot itself.
    """

    time_s: float
    mode: str
    """The autopilot's name of the mode, and that the target is another one."""
    by: str = ""
    """Who asked for it, if a client has; empty: the autopilot itself, or a pilot by another way."""


VehicleEvent = Arrived | Said | Reached | Led


class VehicleFailed(Exception):
    """The vehicle cannot fly the search, or no longer; the text is the reason."""


class Result(NamedTuple):
    """The result of a command: a MAV_RESULT, and the reason if it was refused."""

    code: int
    reason: str = ""
    kind: str = ""
    """Kind of reason, for counting refused setpoints; empty for other commands."""

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
