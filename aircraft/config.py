"""What the search must know of an aircraft, simulated or real."""

import math
from dataclasses import dataclass

from aircraft.state import Ned, metres


@dataclass(frozen=True, kw_only=True)
class AircraftConfig:
    """Where an aircraft may fly, and how long it may be left without a waypoint."""

    area_m: float = 30.0  # side of the search area [0, area]²: x east, y north, origin at home
    ceiling_m: float = 120.0  # highest altitude above home
    takeoff_altitude_m: float = 5.0
    # Time without a setpoint after which OFFBOARD fails safe: return in the air, disarm on the ground
    silence_s: float = 30.0

    def outside(self, position: Ned) -> tuple[str, str] | None:
        """Return (kind of reason, reason) if a position (NED, m from home) is outside the area or the
        altitudes; else None.
        """
        north, east, down = position
        place = f"({metres(east)}, {metres(north)}) m"
        if not all(map(math.isfinite, position)):
            return "not finite", f"{place} at {metres(-down)} m is not finite"
        if not (0.0 <= east <= self.area_m and 0.0 <= north <= self.area_m):
            return (
                "outside the area",
                f"{place} is outside the area [0, {self.area_m:g}] x [0, {self.area_m:g}] m",
            )
        if not 0.0 <= -down <= self.ceiling_m:
            return "outside the altitudes", f"altitude {metres(-down)} m is outside [0, {self.ceiling_m:g}] m"
        return None
