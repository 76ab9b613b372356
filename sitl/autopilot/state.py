"""The simulated vehicle at one instant: what its telemetry is made of."""

from typing import NamedTuple

from aircraft.mode import Mode as Mode
from aircraft.state import Ned
from plume.geodesy import to_global
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.plan import MissionProgress


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
