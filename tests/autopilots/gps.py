"""A GPS whose place jumps, and what the EKF makes of it: it rejects the new place for some seconds, then
takes it for the truth.
"""

from typing import TYPE_CHECKING

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.autopilots.body import Vector

if TYPE_CHECKING:
    from tests.autopilots.autopilot import Autopilot

JUMP_M = (-20.0, 26.0)
"""North and east: 32.8 m, far outside the area."""
FOLLOWS_S = {True: 10.0, False: 7.0}
"""How long the EKF rejects another place, by whether it is ArduPilot: posRetryTimeUseVel_ms,
reset_timeout_max.
"""
FLAGGED_S, CLEARED_S = 1.0, 10.0
"""ArduPilot flags a glitch when the EKF has rejected GPS for 1 s, and no longer when it has agreed for 10
s. PX4 does at once.
"""


class Gps:
    """What GPS and EKF think of a vehicle's place beside the truth."""

    def __init__(self) -> None:
        self.shift = (0.0, 0.0)
        """Of the EKF's position from the true one."""
        self.flagged = False
        self.apart_s = 0.0
        """For how long GPS and EKF have been apart; 0 if they agree."""
        self._agreed_s = 0.0

    def step(self, ap: "Autopilot", seconds: float) -> None:
        """One time step. `jump` moves the EKF at once, without a word; `glitch` moves GPS."""
        if not ap.origin_set:
            return
        said = JUMP_M if ap.faults.on("glitch", "jump") else (0.0, 0.0)
        if said == self.shift:
            self.apart_s, self._agreed_s = 0.0, self._agreed_s + seconds
        else:
            self.apart_s, self._agreed_s = self.apart_s + seconds, 0.0
        if ap.faults.knows("jump") or self.apart_s > FOLLOWS_S[ap.is_ardupilot]:
            self.shift = said
        flagged = (
            self.apart_s > FLAGGED_S or (self.flagged and self._agreed_s < CLEARED_S)
            if ap.is_ardupilot
            else self.apart_s > 0.0
        )
        if ap.is_ardupilot and flagged != self.flagged:
            ap.text(
                mavlink.MAV_SEVERITY_CRITICAL, "GPS Glitch or Compass error" if flagged else "Glitch cleared"
            )
        self.flagged = flagged

    def truly(self, place: Vector) -> Vector:
        """Where a place of the EKF's frame truly is."""
        return place[0] - self.shift[0], place[1] - self.shift[1], place[2]

    def flag(self, ardupilot: bool) -> int:
        """The flag of EKF_STATUS_REPORT or ESTIMATOR_STATUS."""
        bit = mavlink.EKF_GPS_GLITCHING if ardupilot else mavlink.ESTIMATOR_GPS_GLITCH
        return int(bit) if self.flagged else 0

    def ratios(self) -> tuple[float, float, float, float]:
        """Velocity, horizontal and vertical position, compass: what the EKF thinks of GPS. From 1 on it
        rejects it.
        """
        return (0.02, 3.0 if self.apart_s else 0.03, 0.02, 0.05)
