"""The vehicle and the air at one instant: the input of every message of the telemetry."""

from typing import NamedTuple

from plume.geodesy import to_global
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.state import State


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
