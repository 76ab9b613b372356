"""What is done about a real vehicle's troubles.

They are a link or a position that is lost, a low battery, a breached geofence, and failsafes of its own.
"""

import math

from pymavlink.dialects.v20 import all as mavlink

from aircraft.firmware import COMING_DOWN
from aircraft.remote.procedures import Procedures
from aircraft.state import LOW_BATTERY, VehicleFailed

# A link that is lost for longer is given up, by the vehicle's time and by real time.
GIVEN_UP_S, GIVEN_UP_REAL_S = 60.0, 20.0
UNKNOWN_S = 1.0  # a position that is unknown for longer is told
BLIND_S = 10.0  # a vehicle that hovers without a position for longer, and does nothing about it, is landed
# A glitch that lasts for longer ends the search; one that ArduPilot takes for the truth for half a minute
# lasts for one.
GLITCHES_S = 120.0
SAME_TIME_S = 3.0  # a failsafe's words, its state and its change of mode come within this time
CRITICAL, WARNING = mavlink.MAV_SEVERITY_CRITICAL, mavlink.MAV_SEVERITY_WARNING


class Watch:
    """Watches a flight. Times in s."""

    def __init__(self, flight: Procedures) -> None:
        self._flight, self._known = flight, flight.known
        self._lost_since_s = self._blind_since_s = math.inf
        self._blind = self._drained = False
        self._explained_s = -math.inf  # the change of mode that a failsafe has made
        self._judged_s = -math.inf  # the change of mode that was looked at last
        self._warned_s = -math.inf  # the critical status that was looked at last

    def look(self, now_s: float) -> None:
        """Look, and act. Raises VehicleFailed when the vehicle has been lost."""
        self._link(now_s)
        if not self._known.flying:
            self._warned_s = self._known.critical_s
        elif not self._known.lost(now_s):
            self._mode(now_s)
            self._failsafe(now_s)
            self._fence(now_s)
            self._battery()
            self._position(now_s)
            self._glitch(now_s)

    def _link(self, now_s: float) -> None:
        lost_s = now_s - self._lost_since_s
        if not self._known.lost(now_s):
            if lost_s > -math.inf:
                self._flight.say(WARNING, f"Link is back after {lost_s:.0f} s: {self._known.mode_name}")
            self._lost_since_s = math.inf
        elif self._lost_since_s == math.inf and self._flight.commander.system:
            self._lost_since_s = self._known.heard_s
            self._flight.say(CRITICAL, "Link lost: the autopilot's own failsafe is in charge; waiting for it")
        elif self._known.armed and lost_s > max(GIVEN_UP_S, GIVEN_UP_REAL_S * self._flight.commander.speedup):
            raise VehicleFailed(f"link lost for {lost_s:.0f} s: the autopilot's own failsafe is in charge")

    def _mode(self, now_s: float) -> None:
        """A failsafe that only hovers leaves nobody in charge: then it is flown home.

        A pilot is left alone.

        The HEARTBEAT in which a failsafe's mode is new is the first, or soon after the first, with a
        critical status; a breach of the fence may have its text alone, before or after. A status that
        rises later has changed no mode. A sign explains one change: the next is a pilot's, who has seen
        it.
        """
        flight, known, changed_s = self._flight, self._known, self._flight.taken_s
        if not flight.begun or not flight.taken_over or changed_s == self._judged_s:
            return
        by_hand = flight.taken_by_client or changed_s - self._explained_s <= SAME_TIME_S
        struck = (
            0.0 <= changed_s - known.critical_s <= SAME_TIME_S
            or abs(known.breached_s - changed_s) <= SAME_TIME_S
        )
        if by_hand or not struck:
            if by_hand or now_s - changed_s > SAME_TIME_S:
                self._judged_s = changed_s
            return
        self._judged_s = self._explained_s = changed_s
        reason = f"{known.firmware.name} has changed to {known.mode_name} by its failsafe"
        reason += self._said(changed_s)
        if known.custom_mode in known.firmware.hovers and flight.taken_from_us:
            flight.taken_over = False
            flight.fail(reason)
        else:
            flight.failure = flight.failure or reason
            flight.say(CRITICAL, reason)

    def _failsafe(self, now_s: float) -> None:
        """A failsafe that only warns, as its action is 0.

        Each is looked at once: a pilot who leads then knows of it.
        """
        critical_s = self._known.critical_s
        if critical_s <= self._warned_s or now_s - critical_s <= SAME_TIME_S:
            return
        self._warned_s = critical_s
        if self._ours and self._known.status >= mavlink.MAV_STATE_CRITICAL:
            self._flight.fail(f"{self._known.firmware.name}'s failsafe has struck{self._said(critical_s)}")

    def _fence(self, now_s: float) -> None:
        breach_s = self._known.breach_s
        if self._ours and now_s - breach_s <= SAME_TIME_S:
            self._flight.fail(f"Geofence breached{self._said(breach_s) or ': FENCE_STATUS says so'}")

    def _battery(self) -> None:
        if self._ours and not self._drained and self._known.battery < LOW_BATTERY:  # NaN is not less
            self._drained = True
            self._flight.fail(f"Battery low: {self._known.battery:.0%}")

    def _position(self, now_s: float) -> None:
        if self._known.knows_place(now_s):
            if self._blind:
                self._flight.say(WARNING, "Position is back")
            self._blind, self._blind_since_s = False, math.inf
            return
        self._blind_since_s = min(self._blind_since_s, now_s)
        blind_s = now_s - self._blind_since_s
        if blind_s > UNKNOWN_S and not self._blind:
            self._blind = True
            self._flight.say(CRITICAL, "Position lost: no readings until the EKF has it again")
        if blind_s > BLIND_S and self._ours:
            self._flight.fail_and_land(f"Position lost for {blind_s:.0f} s")

    def _glitch(self, now_s: float) -> None:
        glitches = self._known.glitches
        glitches.look(now_s)
        for text in glitches.news:
            self._flight.say(WARNING, text)
        glitches.news.clear()
        if now_s - glitches.began_s > GLITCHES_S and self._ours:
            self._flight.fail_and_land(f"GPS glitch for {now_s - glitches.began_s:.0f} s")

    def _said(self, since_s: float) -> str:
        """What the autopilot has said of it, behind a colon; empty if it has not."""
        said = self._known.warned(since_s - SAME_TIME_S)
        return f": {said}" if said else ""

    @property
    def _ours(self) -> bool:
        """Whether it does what we last asked, and that is not to come down."""
        comes_down = self._flight.doing in COMING_DOWN or self._known.reported in COMING_DOWN
        return self._flight.in_charge and not comes_down
