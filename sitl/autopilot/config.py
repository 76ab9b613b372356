"""The simulated vehicle's configuration: home, speed limits, failsafe times, battery and fence."""

import math
from dataclasses import dataclass

from aircraft.state import AircraftConfig, Ned, metres
from plume.flight import ACCEL_MPS2, SPEED_MPS
from plume.geodesy import HOME, to_local
from sitl.autopilot.fence import NO_FENCE, NO_RALLY, Fence, NorthEast, Rally
from sitl.autopilot.motion import Limits

# The values of `fence_action`; 1 only warns.
FENCE_IGNORED, FENCE_HOLD, FENCE_RETURN, FENCE_TERMINATE, FENCE_LAND = 0, 2, 3, 4, 5
GLOBAL_STEP_M = 0.02  # a little more than 1e-7 degrees, MAVLink's resolution of latitude and longitude
STREAM_S = 1.0  # real time after which a companion's stream of setpoints has ended: PX4's COM_OF_LOSS_T


@dataclass(frozen=True)
class VehicleConfig(AircraftConfig):
    """Configuration of one simulated vehicle; raises ValueError on a value outside its range.

    Speeds are PX4's defaults where PX4 has one.
    """

    sysid: int = 1
    home_lat_deg: float = HOME[0]
    home_lon_deg: float = HOME[1]
    home_alt_m: float = 488.0  # above mean sea level
    home_heading_deg: float = 0.0
    stand: NorthEast = (0.0, 0.0)  # where it stands before its flight, and comes back to: by default at home
    speed_mps: float = SPEED_MPS
    climb_mps: float = 3.0
    descent_mps: float = 1.5
    accel_mps2: float = ACCEL_MPS2
    yaw_rate_dps: float = 45.0
    return_altitude_m: float = 5.0  # a vehicle that returns climbs to this altitude above home if it is lower
    stream_s: float = math.inf  # silence of a companion that must stream until OFFBOARD fails safe
    disarm_landed_s: float = 2.0  # time on the ground after a flight until the motors stop
    disarm_preflight_s: float = 10.0  # time after arming without a take-off until the motors stop
    endurance_s: float = 1800.0  # how long the battery lasts with the motors on
    fence: Fence = NO_FENCE
    fence_action: int = FENCE_HOLD  # what is done when the fence is left: PX4's GF_ACTION
    rally: Rally = NO_RALLY  # where else than at home a return may end

    def __post_init__(self) -> None:
        self._check("sysid", 1 <= self.sysid <= 255, "1 to 255")
        for name, bound in (
            ("home_lat_deg", 90.0),
            ("home_lon_deg", 180.0),
            ("home_heading_deg", 360.0),
            ("home_alt_m", 10_000.0),
        ):
            self._check(name, abs(getattr(self, name)) <= bound, f"-{bound:g} to {bound:g}")
        for name in (
            "ceiling_m",
            "speed_mps",
            "climb_mps",
            "descent_mps",
            "accel_mps2",
            "yaw_rate_dps",
        ):
            self._check(name, 0.0 < getattr(self, name) < math.inf, "a finite number above 0")
        for name in ("takeoff_altitude_m", "return_altitude_m"):
            self._check(
                name,
                0.0 < getattr(self, name) <= self.ceiling_m,
                f"above 0 and up to the ceiling, {self.ceiling_m:g}",
            )
        self._check("fence_action", self.fence_action in range(6), "0 to 5")
        for name in ("silence_s", "stream_s", "disarm_landed_s", "disarm_preflight_s", "endurance_s"):
            self._check(name, getattr(self, name) > 0.0, "above 0, inf for never")

    def _check(self, name: str, holds: bool, allowed: str) -> None:
        if not holds:
            raise ValueError(f"{name} is {getattr(self, name)}: allowed is {allowed}")

    @property
    def limits(self) -> Limits:
        """Limits of speed and acceleration."""
        return Limits(self.speed_mps, self.climb_mps, self.descent_mps, self.accel_mps2)

    def local(self, lat_deg: float, lon_deg: float) -> NorthEast:
        """Return (north, east) in m from home of a place; next to the area's edge it counts as on it.

        Home may lie on a corner, and counts as such an edge; steps of 1e-7 degrees cannot hit that exactly.
        """
        north, east = to_local(self.home_lat_deg, self.home_lon_deg, lat_deg, lon_deg)
        return self._snapped(north, 1), self._snapped(east, 0)

    def _snapped(self, along_m: float, axis: int) -> float:
        edges = self.area.low[axis], self.area.high[axis], 0.0
        return next((edge for edge in edges if abs(along_m - edge) < GLOBAL_STEP_M), along_m)

    @property
    def guards(self) -> bool:
        """True if there is a fence and leaving it has a consequence."""
        return bool(self.fence.shapes) and self.fence_action != FENCE_IGNORED

    def outside(self, position: Ned, fence: bool = True) -> tuple[str, str] | None:
        """Return (kind of reason, reason) if a position is outside the area, the altitudes or the fence."""
        outside = super().outside(position)
        if outside is None and fence and (reason := self.fence_refusal(position)):
            return "outside the fence", reason
        return outside

    def fence_refusal(self, position: Ned) -> str:
        """Return why the fence refuses a position; nothing if it does not."""
        if not self.guards or self.fence.allows(position):
            return ""
        return f"({metres(position[1])}, {metres(position[0])}) m is outside the fence"
