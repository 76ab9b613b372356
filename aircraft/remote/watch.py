"""What is done about a real vehicle's troubles: link or position lost, battery low, geofence breached,
failsafes of its own.
"""

import math

from pymavlink.dialects.v20 import all as mavlink

from aircraft.mode import Mode
from aircraft.remote.procedures import Procedures
from aircraft.state import LOW_BATTERY, VehicleFailed

GIVEN_UP_S = 60.0
"""A link that is lost for so long is given up."""
UNKNOWN_S = 1.0
"""A position that is unknown for so long is told."""
BLIND_S = 10.0
"""A vehicle that hovers without a position for so long, and does nothing about it, is landed."""
GLITCHES_S = 120.0
"""A glitch that lasts for so long ends the search; one that ArduPilot takes for the truth for half a
minute lasts for one.
"""
SAME_TIME_S = 3.0
"""A failsafe's words, its state and its change of mode come within this time."""
CRITICAL, WARNING, INFO = (
    mavlink.MAV_SEVERITY_CRITICAL,
    mavlink.MAV_SEVERITY_WARNING,
    mavlink.MAV_SEVERITY_INFO,
)


class Watch:
    """Watches a flight. Times in s."""

    def __init__(self, flight: Procedures) -> None:
        """Begin without a trouble."""
        self._flight, self._known = flight, flight.known
        self._lost_since_s = math.inf
        self._blind_since_s = math.inf
        self._blind = self._drained = False
        self._explained_s = -math.inf  # the change of mode that a failsafe has made
        self._judged_s = (
            self._warned_s
        ) = -math.inf  # the change of mode, and the critical status, that were looked at last

    def look(self, now_s: float) -> None:
        """Look, and act. Raises VehicleFailed when the vehicle has been lost."""
        self._link(now_s)
        if not self._flight.flying or self._known.lost(now_s):
            self._warned_s = self._warned_s if self._flight.flying else self._known.critical_s
            return
        self._mode(now_s)
        self._failsafe(now_s)
        self._fence(now_s)
        self._battery()
        self._position(now_s)
        self._glitch(now_s)

    def _link(self, now_s: float) -> None:
        if not self._known.lost(now_s):
            if self._lost_since_s < math.inf:
                mode = self._flight.firmware.mode_name(self._known.custom_mode)
                self._flight.say(WARNING, f"Link is back after {now_s - self._lost_since_s:.0f} s: {mode}")
            self._lost_since_s = math.inf
        elif self._flight.commander.system:
            if self._lost_since_s == math.inf:
                self._lost_since_s = self._known.heard_s
                self._flight.say(
                    CRITICAL, "Link lost: the autopilot's own failsafe is in charge; waiting for it"
                )
            if self._known.armed and now_s - self._lost_since_s > self._flight.commander.patient(GIVEN_UP_S):
                raise VehicleFailed(
                    f"link lost for {now_s - self._lost_since_s:.0f} s: the autopilot's own failsafe is in "
                    "charge"
                )

    def _mode(self, now_s: float) -> None:
        """A failsafe that only hovers leaves nobody in charge: then it is flown home. A pilot is left
        alone.

        The HEARTBEAT in which a failsafe's mode is new is the first, or soon after the first, with a
        critical status; a breach of the fence may have its text alone, before or after. A status that
        rises later has changed no mode. A sign explains one change: the next is a pilot's, who has seen
        it.
        """
        flight, changed_s = self._flight, self._flight.taken_s
        if not flight.begun or not flight.theirs or changed_s == self._judged_s:
            return
        by_hand = flight.taken_by_client or changed_s - self._explained_s <= SAME_TIME_S
        struck = (
            0.0 <= changed_s - self._known.critical_s <= SAME_TIME_S
            or abs(self._known.breached_s - changed_s) <= SAME_TIME_S
        )
        if not by_hand and struck:
            self._judged_s = self._explained_s = changed_s
            mode = self._known.custom_mode
            said = self._known.warned(changed_s - SAME_TIME_S)
            reason = (
                f"{flight.firmware.name} has changed to {flight.firmware.mode_name(mode)} by its "
                f"failsafe{said and ': '}{said}"
            )
            if mode in flight.firmware.hovers and flight.taken_from_us:
                flight.theirs = False
                flight.fail(reason)
            else:
                flight.failure = flight.failure or reason
                flight.say(CRITICAL, reason)
        elif by_hand or now_s - changed_s > SAME_TIME_S:
            self._judged_s = changed_s

    def _failsafe(self, now_s: float) -> None:
        """A failsafe that only warns, as its action is 0. Each is looked at once: a pilot who leads then
        knows of it.
        """
        critical_s = self._known.critical_s
        if critical_s <= self._warned_s or now_s - critical_s <= SAME_TIME_S:
            return
        self._warned_s = critical_s
        if self._ours and self._known.failsafe:
            said = self._known.warned(critical_s - SAME_TIME_S)
            self._flight.fail(f"{self._flight.firmware.name}'s failsafe has struck{said and ': '}{said}")

    def _fence(self, now_s: float) -> None:
        if self._ours and now_s - self._known.breach_s <= SAME_TIME_S:
            self._flight.fail(
                "Geofence breached: "
                f"{self._known.warned(self._known.breach_s - SAME_TIME_S) or 'FENCE_STATUS says so'}"
            )

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
            self._flight.failure = self._flight.failure or f"Position lost for {blind_s:.0f} s"
            self._flight.say(CRITICAL, f"{self._flight.failure}: landing")
            self._flight.land()

    def _glitch(self, now_s: float) -> None:
        glitches = self._known.glitches
        glitches.look(now_s)
        for text in glitches.news:
            self._flight.say(WARNING, text)
        glitches.news.clear()
        if now_s - glitches.began_s > GLITCHES_S and self._ours:
            self._flight.failure = self._flight.failure or f"GPS glitch for {now_s - glitches.began_s:.0f} s"
            self._flight.say(CRITICAL, f"{self._flight.failure}: landing")
            self._flight.land()

    @property
    def _ours(self) -> bool:
        """Whether it does what we last asked, and that is not to come down."""
        return (
            self._flight.in_charge
            and self._flight.doing not in COMING_DOWN
            and self._reported not in COMING_DOWN
        )

    @property
    def _reported(self) -> Mode | None:
        return self._flight.firmware.reports.get(self._known.custom_mode)


COMING_DOWN = (Mode.RETURN, Mode.LAND)
