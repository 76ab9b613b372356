"""What a real vehicle is told to do over several seconds, and who else leads it.

One procedure runs at a time, resumed at each poll.
"""

import math
from collections import deque

from pymavlink.dialects.v20 import all as mavlink

from aircraft.firmware import COMING_DOWN
from aircraft.operator import NO_ANSWER
from aircraft.remote.commander import Commander, Steps
from aircraft.remote.known import Known
from aircraft.state import OTHER_TARGET, Ned, Result, Said, TakenOver
from link.modes import Mode

ARMING_S, ARM_AGAIN_S = 60.0, 3.0  # a refused arming is tried again every ARM_AGAIN_S, for at most ARMING_S
HOME_S = 3.0  # longest wait for the home that arming sets
LIFT_OFF_S = 12.0  # a vehicle that has not left the ground by then has disarmed itself
SLOWEST_CLIMB_MPS, CLIMB_GRACE_S = 0.5, 20.0
NEAR_TAKEOFF_M = 0.5  # a take-off has ended this near to its altitude
WARM_UP_S = 1.5  # setpoints stream for this long before OFFBOARD is asked for; PX4 wants a second
MODE_TRIES = 5
AGAIN_S = 1.0
# A change this soon after a client has asked for one is the client's: a HEARTBEAT comes once a second.
ASKED_S = 3.0
ENDED = object()
SAME_M = 0.1  # targets this near to each other are the same
KEPT = 4  # this many of our latest targets may still be read back: a radio link is slow


class Targets:
    """Whose target an autopilot flies to, as far as it reads back.

    Positions NED, m from the EKF's origin; None is no position.

    What it reads back is foreign if it is neither one of ours nor what it was before: a target of ours
    that the autopilot does not take leaves the one before, and a take-off reads back whatever was there
    before it.
    """

    def __init__(self) -> None:
        self._ours: deque[Ned] = deque(maxlen=KEPT)
        self._read: Ned | None = None
        self._fresh = True

    def send(self, target: Ned) -> None:
        """Note that this target of ours is sent."""
        if not self._ours or self._ours[-1] != target:
            self._ours.append(target)

    def begin(self) -> None:
        """Take whatever is read back next for what was there before.

        The mode has changed, or the vehicle stands.
        """
        self._fresh = True

    def takes(self, target: Ned | None) -> bool:
        """Take what the autopilot reads back; returns False if it is foreign."""
        before, fresh = self._read, self._fresh
        self._read, self._fresh = target, False
        return fresh or _same(target, before) or any(_same(target, one) for one in self._ours)

    def has(self, target: Ned) -> bool:
        """Whether the autopilot has read back this target last."""
        return not self._fresh and _same(self._read, target)


def _same(one: Ned | None, other: Ned | None) -> bool:
    return one is other if one is None or other is None else math.dist(one, other) <= SAME_M


class Procedures:
    """The procedures of one vehicle. Times in s of its clock, heights in m above home."""

    def __init__(self, commander: Commander) -> None:
        self.commander = commander
        self.known: Known = commander.known
        self.events: list[Said | TakenOver] = []  # what people are told
        self.failure = ""  # why the mission has failed, once it has
        self.targets = Targets()
        self.procedure: Steps[None] | None = None  # what is being done, until it ends
        # The mode of the search that a procedure is about to reach; None if none runs.
        self.doing: Mode | None = None
        self.arming = False
        self.streams = False  # whether setpoints are to go out
        # Whether we have begun this flight: one that was under way before us, or begins after ours, is
        # someone else's.
        self.begun = False
        self.armed_by_us = False
        # Whether someone else has changed the mode or the target: a pilot, or the autopilot by itself. A
        # flight of theirs that ends in RTL, LAND or BRAKE leaves a free vehicle.
        self.taken_over = False
        self.taken_s = -math.inf  # when someone else last changed it so
        self.taken_from_us = False  # whether it was ours before that
        self.taken_by_client = False  # whether a client of ours had asked for it
        self._client, self._client_s = "", -math.inf
        self._asked: set[int] = set()
        self._mode: int | None = None
        self._boots = 0
        self._flew = False  # when it was last armed
        self._was_armed = False
        self._told = self._sent_home = ""

    @property
    def now_s(self) -> float:
        """The time of the last poll."""
        return self.commander.now_s

    @property
    def in_charge(self) -> bool:
        """Whether the flight is ours, and nobody has taken it over."""
        return self.begun and not self.taken_over

    @property
    def start(self) -> Mode:
        """The mode in which it is armed."""
        return Mode.OFFBOARD if self.known.firmware.is_ardupilot else Mode.HOLD

    @property
    def guided(self) -> int:
        """The custom mode in which it follows a companion."""
        return self.known.firmware.modes[Mode.OFFBOARD]

    def poll(self, now_s: float) -> None:
        """Take what the vehicle has said, and go on with what it is told.

        Raises VehicleFailed if it is no vehicle for a search.
        """
        try:
            self._hear(now_s)
        finally:  # whatever we are told, a vehicle is not left half-way
            self.go_on()

    def _hear(self, now_s: float) -> None:
        self.commander.quiet = self.begun and self.taken_over
        self.commander.in_charge = self.in_charge
        self.commander.poll(now_s)
        for text in self.commander.ignored:
            self.say(mavlink.MAV_SEVERITY_WARNING, text)
        self.commander.ignored.clear()
        if (reason := self.commander.radio.sent_home) and reason != self._sent_home:
            self._sent_home, self._asked = reason, self._numbers(*COMING_DOWN)
            self.failure = reason  # what else has failed since it hung comes of that
            self.say(mavlink.MAV_SEVERITY_CRITICAL, reason)
            self._stop()
        if self.commander.system:
            self._watch_mode()
            self._watch_target()
            self.armed_by_us = self.known.armed and (self.armed_by_us or self.arming)

    def go_on(self) -> None:
        """Go on with what is being done."""
        steps = self.procedure
        ended = steps is None or next(steps, ENDED) is ENDED
        if ended and self.procedure is steps:  # it may have begun another
            self._stop()
        self.begun = self.begun and (self.known.armed or self.procedure is not None)
        self.streams = self.streams and self.begun

    def say(self, severity: int, text: str) -> None:
        """Tell people."""
        self.events.append(Said(self.now_s, severity, text))

    def say_once(self, severity: int, text: str) -> None:
        """Tell people, unless it was the last thing told so."""
        if text != self._told:
            self._told = text
            self.say(severity, text)

    # ---- who leads ----

    def _watch_mode(self) -> None:
        known = self.known
        mode, before, self._mode = known.custom_mode, self._mode, known.custom_mode
        landed, self._was_armed = self._was_armed and not known.armed, known.armed
        if known.boots != self._boots:
            self._boots, self.taken_over = known.boots, False
            self._stop()
            what = f"{known.firmware.name} has started again{' in flight' * self._flew}"
            self.say(mavlink.MAV_SEVERITY_WARNING, what)
            self.failure = self.failure or what * self._flew
        if known.armed:
            self._flew = known.flying
        if before is not None and mode != before:
            self.targets.begin()
            if self.taken_over or mode not in self._asked:
                self._give_way(known.mode_name)
        if landed and not self.begun and known.reported:  # what a flight left behind, not a pilot's choice
            self.taken_over = False

    def _watch_target(self) -> None:
        """See whether the autopilot flies to someone else's target.

        In GUIDED a ground station's go-to changes no mode. PX4 changes its mode for one; what streams
        setpoints beside us is not told apart there.
        """
        known = self.known
        came_s = known.came_s.get(mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED)
        if came_s != self.now_s or not known.firmware.is_ardupilot:
            return
        if not known.flying:
            self.targets.begin()
        ours = self.targets.takes(known.target)
        follows = known.custom_mode == self.guided and self.doing in (None, Mode.TAKEOFF, Mode.OFFBOARD)
        if not ours and follows and self.in_charge:
            self._give_way(f"{known.mode_name} {OTHER_TARGET}")

    def _give_way(self, how: str) -> None:
        """Note that someone else leads: from now on nothing of ours goes out."""
        asked = self.now_s - self._client_s <= ASKED_S and self.commander.refused_s < self._client_s
        self.taken_from_us, self.taken_by_client = self.in_charge, asked
        self.taken_over, self.taken_s, self.streams = True, self.now_s, False
        self._stop()
        self.events.append(TakenOver(self.now_s, how, self._client if asked else ""))

    def asked_by(self, client: str) -> None:
        """Note that a client's command goes to the autopilot through us.

        What changes soon after it, the client has changed, unless the autopilot refuses it.
        """
        self._client, self._client_s = client, self.now_s

    def _stop(self) -> None:
        self.procedure, self.doing, self.arming = None, None, False

    def begin(self, procedure: Steps[None], doing: Mode | None, asked: set[int]) -> None:
        """Do something instead of what was being done; `asked`: the custom modes that come of it."""
        self.procedure, self.doing, self.arming = procedure, doing, False
        self.taken_over, self.begun, self.streams = False, True, False
        self._asked = asked

    def fail(self, reason: str) -> None:
        """Give the mission up: a vehicle in the air flies home."""
        self.failure = self.failure or reason
        self.say(mavlink.MAV_SEVERITY_CRITICAL, reason)
        self._stop()
        if self.known.flying and self.in_charge:
            self.say(mavlink.MAV_SEVERITY_CRITICAL, "Returning home")
            self.enter(Mode.RETURN)
        elif self.known.armed and not self.known.flying:
            self.commander.send(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0)

    def fail_and_land(self, reason: str) -> None:
        """Give the mission up, and land on the spot: there is no position to return by."""
        self.failure = self.failure or reason
        self.say(mavlink.MAV_SEVERITY_CRITICAL, f"{self.failure}: landing")
        self.enter(Mode.LAND)

    # ---- procedures ----

    def arm(self) -> None:
        """Arm, in the mode from which it takes off."""
        self.begin(self._arm(), None, self._numbers(self.start))
        self.arming = True

    def _arm(self) -> Steps[None]:
        began_s = self.now_s
        while True:
            result = yield from self._change(self.start)
            if result.accepted:
                result = yield from self.commander.command(
                    mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, seen=lambda: self.known.armed
                )
            if result.accepted or self.known.armed:
                return
            reason = f"Arming refused: {result.reason}"
            if self.now_s - began_s >= ARMING_S:
                self.fail(reason)
                return
            self.say_once(mavlink.MAV_SEVERITY_WARNING, f"{reason}; tried again")
            yield from self.commander.wait(ARM_AGAIN_S)

    def take_off(self, altitude_m: float) -> None:
        """Climb straight up to an altitude above home."""
        self.begin(self._take_off(altitude_m), Mode.TAKEOFF, {*self.known.firmware.climbs})

    def _take_off(self, altitude_m: float) -> Steps[None]:
        """Climb. ArduPilot takes an altitude above home, and a NaN ends it.

        PX4 takes one above sea, and NaN for what it shall not change.
        """
        known, armed_s, home = self.known, self.now_s, mavlink.MAVLINK_MSG_ID_HOME_POSITION
        self.commander.send(mavlink.MAV_CMD_REQUEST_MESSAGE, float(home))
        yield from self.commander.until(  # arming sets home anew
            lambda: known.came_s.get(home, -math.inf) > armed_s, self.commander.patient(HOME_S)
        )
        if known.misplaced:
            self.fail(f"Take-off refused: {known.misplaced}")
            return
        home_m = known.to_home()[2]
        assert known.home
        unset, above = (
            (0.0, altitude_m) if known.firmware.is_ardupilot else (math.nan, altitude_m + known.home[2])
        )
        climb = (mavlink.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, unset, unset, unset, above)
        result = yield from self.commander.command(*climb, seen=lambda: known.flying, within_s=LIFT_OFF_S)
        if not result.accepted:
            self.fail(
                f"Take-off refused: {result.reason}"
                if known.armed
                else "Take-off failed: the motors have stopped"
            )
            return

        def height_m() -> float:
            return home_m - known.position[2]

        there = yield from self.commander.until(
            lambda: height_m() >= altitude_m - NEAR_TAKEOFF_M or not known.armed,
            altitude_m / SLOWEST_CLIMB_MPS + CLIMB_GRACE_S,
        )
        if not there or not known.armed:
            self.fail(f"Take-off failed: {height_m():.1f} m reached of {altitude_m:g} m")

    def enter(self, mode: Mode) -> None:
        """Follow the setpoints, which stream from now on (OFFBOARD); stay (HOLD); or come down."""
        comes_down = mode in COMING_DOWN
        procedure = self._until_down(mode) if comes_down else self._reach(mode)
        self.begin(procedure, mode, self._numbers(*COMING_DOWN) if comes_down else self._numbers(mode))
        self.streams = mode is Mode.OFFBOARD

    def _until_down(self, mode: Mode) -> Steps[None]:
        """Insist for ever: nobody else is in charge. A return that is refused becomes a landing."""
        while True:
            result = yield from self._change(mode)
            if not result.accepted and mode is Mode.RETURN and result.reason != NO_ANSWER:
                self.say_once(mavlink.MAV_SEVERITY_CRITICAL, f"Return refused: {result.reason}; landing")
                result = yield from self._change(Mode.LAND)
            if result.accepted or not self.known.armed:
                return
            yield from self.commander.wait(AGAIN_S)

    def _reach(self, mode: Mode) -> Steps[None]:
        """Insist on a mode that stays in the air, MODE_TRIES times; the search cannot do without OFFBOARD."""
        if mode is Mode.OFFBOARD and not self.known.firmware.is_ardupilot:
            yield from self.commander.wait(self.commander.patient(WARM_UP_S))
        for _ in range(MODE_TRIES):
            result = yield from self._change(mode)
            if result.accepted:
                return
            yield from self.commander.wait(AGAIN_S)
        name = self.known.firmware.mode_name(self.known.firmware.modes[mode])
        refused = f"{name} refused: {result.reason}"
        if mode is Mode.OFFBOARD:
            self.fail(refused)
        else:
            self.say(mavlink.MAV_SEVERITY_WARNING, refused)

    def _change(self, mode: Mode) -> Steps[Result]:
        known, number = self.known, self.known.firmware.modes[mode]
        return (
            yield from self.commander.command(
                mavlink.MAV_CMD_DO_SET_MODE,
                *known.firmware.params(number),
                seen=lambda: known.custom_mode == number,
            )
        )

    def _numbers(self, *modes: Mode) -> set[int]:
        return {self.known.firmware.modes[mode] for mode in modes}
