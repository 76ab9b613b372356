"""Whether a vehicle is where it says: jumps of its position, its doubts about it, and their end."""

import math
import re
from typing import NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from aircraft.state import Ned
from link.bus.mavlink import Message, elapsed_ms

# An EKF may reset its position by this much, for instance when it changes to another of its filters: no
# glitch.
RESET_M = 1.0
# Largest acceleration of a multirotor in a search; PX4's limit (MPC_ACC_HOR_MAX), twice ArduCopter's
# (WPNAV_ACCEL).
ACCELERATION_MPS2 = 5.0
SPEED_ERROR = 0.1  # share of the speed by which the reported velocity may be wrong
# Of position or velocity, by whether it is ArduPilot: there FS_EKF_THRESH's default. From 1 on both reject
# what GPS says.
LARGEST_VARIANCE = {True: 0.8, False: 1.0}
# Large variances that last for this long are a glitch; ArduPilot waits as long. Shorter ones only delay a
# reading.
DOUBTED_S = 1.0
SOUND_S = 5.0  # a glitch is over when nothing has been wrong for this long
SHIFTED_S = 20.0  # the same while the position has not jumped back: most glitches do
# A glitch may begin this long before it is noticed: ArduPilot waits for 1 s, telemetry and the EKF add a few
# tenths.
NOTICED_S = 2.0
# What ArduPilot and PX4 say of a position that they doubt, or take from another filter.
BEGINS = re.compile(
    r"gps glitch|ekf variance|ekf primary changed|lane switch|emergency yaw reset|dead reckoning started"
    r"|g(nss|ps) data fusion stopped|g(nss|ps) signal (spoofed|jammed)",
    re.IGNORECASE,
)
ENDS = re.compile(r"glitch cleared|dead reckoning stopped|g(nss|ps) data fusion started", re.IGNORECASE)
Shift = tuple[float, float]  # m north and east


class Fix(NamedTuple):
    """One LOCAL_POSITION_NED: the autopilot's clock, m and m/s."""

    boot_ms: int
    position: Ned
    velocity: Ned


def innovation(before: Fix, now: Fix) -> Shift:
    """Return how far north and east a position lies from where the last one and both velocities lead."""
    seconds = elapsed_ms(before.boot_ms, now.boot_ms) / 1000.0
    north, east = (
        now.position[n] - before.position[n] - (before.velocity[n] + now.velocity[n]) / 2.0 * seconds
        for n in (0, 1)
    )
    return north, east


def margin_m(before: Fix, now: Fix) -> float:
    """Return how large an innovation can be without a jump.

    A vehicle that speeds up and slows down again between two reports `seconds` apart has flown up to
    a·seconds²/4 further than the velocities tell.
    """
    seconds = elapsed_ms(before.boot_ms, now.boot_ms) / 1000.0
    speed = max(math.hypot(*fix.velocity[:2]) for fix in (before, now))
    return RESET_M + ACCELERATION_MPS2 * seconds**2 / 4.0 + SPEED_ERROR * speed * seconds


class Glitches:
    """What is wrong with one vehicle's position. Times are the caller's, s. Heights are not watched:
    barometers make them, not GPS.
    """

    def __init__(self) -> None:
        self.fix: Fix | None = None  # the newest position
        # The sum of the jumps of this flight. The vehicle has not jumped: what lies around it has moved by
        # this much in the EKF's frame.
        self.shift: Shift = (0.0, 0.0)
        self.began_s = math.inf  # when the glitch began that lasts; infinity if none does
        self.read_s = -math.inf  # when the last reading was taken
        self.news: list[str] = []  # what people are to be told; whoever tells them takes it away
        self._flies = False
        self._number = self._suspect = 0  # of glitches in flight, and of readings just before one
        self._wrong_s = -math.inf  # when anything was wrong last
        self._doubted_s = math.inf  # since when variances have been too large

    # ---- what the vehicle says ----

    def flies(self, flies: bool) -> None:
        """Take whether it is in the air.

        What jumps on the ground moves nothing, and is no glitch of a flight.
        """
        if not flies:
            self.shift, self.began_s = (0.0, 0.0), math.inf
        self._flies = flies

    def moved(self, fix: Fix, now_s: float) -> bool:
        """Take a position.

        Returns whether it is newer than the one before: datagrams may overtake each other.
        """
        before = self.fix
        if before and elapsed_ms(before.boot_ms, fix.boot_ms) <= 0:
            return False
        self.fix = fix
        if before and (far_m := math.hypot(*(jump := innovation(before, fix)))) > margin_m(before, fix):
            again = self.is_shifted
            if self._flies:
                self.shift = self.shift[0] + jump[0], self.shift[1] + jump[1]
            why = f"the position has jumped{' back' * (again and not self.is_shifted)} by {far_m:.1f} m"
            if self.began_s < math.inf:
                self.news.append(f"GPS glitch: {why}")
            self._wrong(now_s, now_s, why, again)
        return True

    def judge(self, message: Message, is_ardupilot: bool, now_s: float) -> None:
        """Take an EKF_STATUS_REPORT or ESTIMATOR_STATUS.

        It has a flag for a glitch, and tells how little EKF and GPS agree.
        """
        flag, velocity, position = (
            (mavlink.EKF_GPS_GLITCHING, message.velocity_variance, message.pos_horiz_variance)
            if is_ardupilot
            else (mavlink.ESTIMATOR_GPS_GLITCH, message.vel_ratio, message.pos_horiz_ratio)
        )
        largest = LARGEST_VARIANCE[is_ardupilot]
        doubted = velocity >= largest or position >= largest  # NaN is not
        self._doubted_s = min(self._doubted_s, now_s) if doubted else math.inf
        if message.flags & flag:
            self._wrong(now_s, now_s, "the autopilot flags it")
        elif now_s - self._doubted_s >= DOUBTED_S:
            why = f"the EKF's variance is {velocity:.1f} for the velocity, {position:.1f} for the position"
            self._wrong(now_s, self._doubted_s, why)
        elif doubted:
            self._wrong_s = now_s

    def hear(self, text: str, now_s: float) -> None:
        """Take a text of the autopilot."""
        if ENDS.search(text):
            self._wrong_s, self._doubted_s = min(self._wrong_s, now_s - SOUND_S), math.inf
        elif BEGINS.search(text):
            self._wrong(now_s, now_s, f"the autopilot says {text!r}")

    def starts_again(self) -> None:
        """Its clock and its frame have begun anew."""
        self.fix = None
        self.flies(False)

    def _wrong(self, now_s: float, since_s: float, why: str, again: bool | None = None) -> None:
        """Note that something is wrong.

        `again`: with a position that was off before, which makes it the same glitch.
        """
        self._wrong_s = now_s
        if not self._flies or self.began_s < math.inf:
            return
        self.began_s = since_s
        self._number += not (self.is_shifted if again is None else again)
        late = since_s - self.read_s <= NOTICED_S
        self._suspect += late
        self.news.append(
            f"GPS glitch: {why}; no readings until it is over"
            + late * f"; the reading taken {now_s - self.read_s:.1f} s ago may be off"
        )

    # ---- what comes of it ----

    @property
    def is_shifted(self) -> bool:
        """Whether the position has jumped and not jumped back."""
        return math.hypot(*self.shift) > 2.0 * RESET_M

    def lasts(self, now_s: float) -> bool:
        """Whether the position cannot be trusted now."""
        return now_s - self._wrong_s < (SHIFTED_S if self.is_shifted else SOUND_S)

    def look(self, now_s: float) -> None:
        """See whether the glitch is over."""
        if self.began_s < math.inf and not self.lasts(now_s):
            self.news.append(f"GPS glitch is over after {now_s - self.began_s:.0f} s{self._rest}")
            self.began_s = math.inf

    @property
    def caveat(self) -> str:
        """What a result of this flight has to be read with; empty if there has been no glitch."""
        if not self._number:
            return ""
        suspect = f"; readings taken just before it was noticed, which may be off: {self._suspect}" * bool(
            self._suspect
        )
        return f"GPS glitches in this flight: {self._number}{suspect}{self._rest}"

    @property
    def _rest(self) -> str:
        """What stays of it."""
        if not self.is_shifted:
            return ""
        far_m = math.hypot(*self.shift)
        return (
            "; the position has not jumped back: all places, and the autopilot's way home, may be "
            f"{far_m:.1f} m off from now on"
        )
