"""The search's side of the vehicle: when it begins and ends, and who leads, the search or a pilot.

The pilot always wins.

One rule: the search leads only while it holds control. Anyone else's change of mode takes control at once;
the search then leads again only when it is given back: a simulated vehicle by OFFBOARD, a real one by a
command to its search. Setpoints are the leader's alone.
"""

import math
from collections.abc import Callable
from typing import Literal

from pymavlink.dialects.v20 import common as mavlink

from aircraft.aircraft import Aircraft
from aircraft.operator import BY_LAUNCHER, MODES_WANTED, CommandName
from aircraft.state import ACCEPTED, OTHER_TARGET, Ned, Result, denied, not_now
from link.bus.mavlink import WRAP_MS, Message, elapsed_ms
from link.bus.messages import Stop
from link.modes import Mode
from plume.outcome import outside_text
from plume.scenario import SURE_OUTSIDE

# What the vehicle does once the search is over: return home and land, land on the spot, or hold until told
AfterStop = Literal["return", "land", "hold"]
# The frame of an answer, and the bits of its type mask that leave out a part of the position
LOCAL_NED, NO_POSITION = mavlink.MAV_FRAME_LOCAL_NED, 0b111
AFTER_STOP: dict[AfterStop, Mode] = {"return": Mode.RETURN, "land": Mode.LAND, "hold": Mode.HOLD}
STANDBY, TAKING_OFF, SEARCHING, PAUSED = "standby", "taking off", "searching", "paused"
RETURNING, HOLDING, LANDED = "returning", "holding", "landed"
# An autopilot whose motors have stopped may forget its target so long before it tells of them, s.
FORGETS_S = 2.0


class Answers:
    """The readings of one search, by their MAVLink time, and which waypoint answers them."""

    def __init__(self) -> None:
        self._readings: set[int] = set()
        self._last_ms = -1
        self.newest: int | None = None  # the time of the newest reading
        self.awaited = False  # True while the newest reading is unanswered

    def time_of(self, now_ms: float) -> int:
        """Return the time_boot_ms of a reading that is about to be taken, later than that of any before."""
        self._last_ms = max(round(now_ms), self._last_ms + 1)
        return self._last_ms % WRAP_MS

    def sampled(self, time_boot_ms: int) -> None:
        """Note that a reading was taken. Raises ValueError unless times increase."""
        if self.newest is not None and elapsed_ms(self.newest, time_boot_ms) <= 0:
            raise ValueError(
                f"reading at {time_boot_ms} ms after one at {self.newest} ms: reading times must increase"
            )
        self._readings.add(time_boot_ms)
        self.newest, self.awaited = time_boot_ms, True

    def refusal(self, time_boot_ms: int) -> Result | None:
        """Return why a waypoint with this time is not the awaited answer, if so.

        One that comes late or twice is only ignored.
        """
        if time_boot_ms not in self._readings:
            return denied(f"Waypoint refused: no reading was taken at {time_boot_ms} ms", "no reading")
        if time_boot_ms != self.newest or not self.awaited:
            kind = "duplicate" if time_boot_ms == self.newest else "late"
            return not_now(f"Waypoint ignored: {kind} answer to the reading at {time_boot_ms} ms")
        return None


class Search:
    """One search by one vehicle, or a pilot's flight meanwhile.

    It arms, takes off, flies to the start, follows the agent's waypoints, and comes home.
    """

    def __init__(
        self,
        vehicle: Aircraft,
        start: tuple[float, float],
        after_stop: AfterStop,
        say: Callable[[int, str], None],
    ) -> None:
        """Take the start, (x, y) m, and what tells people a text of a MAV_SEVERITY."""
        self.state = STANDBY  # what the uav's health says
        self.found = False  # True once the stop has been declared
        self.left = ""  # why the vehicle has left a search of several; empty if it has not
        # The readings, and whether the newest is answered: the agent's first waypoint with its time answers
        # it
        self.answers = Answers()
        self.vehicle, self._say = vehicle, say
        self._after_stop = after_stop
        # The search's own setpoint: the start, then what the agent last answered
        self.waypoint: Ned = (start[1], start[0], -vehicle.config.takeoff_altitude_m)
        self._begun = False
        self._said = ""
        self._pilot = ""  # how, and by whom, the vehicle was last taken from the search
        self._other_target_s = -math.inf  # when that was by another target

    @property
    def leads(self) -> bool:
        """True while the search holds control. It is then the vehicle's companion."""
        return self.vehicle.is_searched

    @leads.setter
    def leads(self, leads: bool) -> None:
        self.vehicle.is_searched = leads

    @property
    def under_way(self) -> bool:
        """True from its take-off to its landing, whoever leads."""
        return self._begun and self.state != LANDED

    @property
    def waits_for(self) -> str:
        """Why it has not begun, or how a pilot has ended it, in words.

        Empty if it goes on, or if only the services are missing.
        """
        return self._said if not self._begun or self.state == LANDED else ""

    @property
    def measures(self) -> bool:
        """True if the vehicle's arrival is one at a waypoint of the search.

        Only there readings are taken, one at each.
        """
        return self.leads and self.state == SEARCHING and not self.answers.awaited

    @property
    def wants_answers(self) -> bool:
        """True while the search waits for the answer to its newest reading.

        A paused one keeps the answer for later.
        """
        return self.state in (SEARCHING, PAUSED) and self.answers.awaited and not self.is_over

    @property
    def is_over(self) -> bool:
        """True once the source is found, or the vehicle has left the search."""
        return self.found or bool(self.left)

    # ---- how it goes on ----

    def go_on(self, searchers: bool) -> None:
        """Take the next step of the search where it is due.

        searchers: whether estimator and agent are there.
        """
        if self.state == LANDED:
            return
        now_s, mode = self.vehicle.now_s, self.vehicle.mode
        if not self._begun:
            if searchers and self.found:
                self._say_once("Search not begun: its estimator has stopped already; start it anew")
            elif self.left:
                self._say_once(f"Search not begun: the vehicle has left it: {self.left}")
            elif searchers:
                self._begin(now_s)
        elif not self.vehicle.armed and not self.vehicle.moving:
            when = "while it took off" if self.state == TAKING_OFF else "in flight"
            forgot = now_s - self._other_target_s <= FORGETS_S
            stopped = f"ended by a pilot or the autopilot: the motors have stopped {when}"
            stopped *= self.leads or forgot
            ended = f"ended by the pilot: {self._pilot}" if self._pilot and not forgot else stopped
            self._said, self.leads, self.state = "", False, LANDED
            if ended and not self.is_over and not self.vehicle.failure:
                self._say_once(ended)
        elif mode in (Mode.RETURN, Mode.LAND):
            self.leads, self.state = False, RETURNING  # by a pilot, a failsafe, or since the source is found
        elif self.leads and self.state == SEARCHING and mode is not Mode.OFFBOARD:
            self.leads = False
            self._say(mavlink.MAV_SEVERITY_WARNING, f"Search gives way: {mode.name} by the autopilot")
        elif not self.leads:
            self.state = HOLDING if self.is_over else PAUSED
        elif self.state == TAKING_OFF and mode is Mode.HOLD and not self.vehicle.failure:
            self._obeyed(self.vehicle.setpoint(now_s, self.waypoint))
            self._obeyed(self.vehicle.set_mode(now_s, Mode.OFFBOARD))
            self.state = SEARCHING

    def taken_over(self, mode: str, by: str) -> None:
        """A pilot, or a real autopilot itself, has changed its mode or target.

        by: the client who asked for it, if one has.
        """
        if self.under_way and self.vehicle.armed:
            pilot, returned = self._pilot, self.state == RETURNING
            self.give_way(mode, by)
            if returned and not by and self.vehicle.mode is Mode.LAND:
                self._pilot = pilot  # some autopilots change to LAND at the end of a return

    def give_way(self, mode: str, by: str = "") -> None:
        """Someone else leads from now on; `by`: who, if that is known."""
        gives_way, self.leads = "Search gives way: " * self.leads, False
        self._pilot = "" if by == BY_LAUNCHER else f"{mode} by {by or 'a radio or a ground station'}"
        self._other_target_s = self.vehicle.now_s if mode.endswith(OTHER_TARGET) else -math.inf
        self._say(mavlink.MAV_SEVERITY_WARNING, f"{gives_way}{mode} by {by or 'the autopilot or its pilot'}")

    def give_back(self, by: str) -> Result:
        """Lead a real vehicle again where the search left off, as someone wants it.

        No change of mode gives it back.
        """
        if self.is_over or self.vehicle.failure:
            why = "the vehicle has left the search" if self.left else "the source is found"
            return not_now(f"Resume refused: {self.vehicle.failure or why}")
        if not self.under_way:
            return not_now("Resume refused: the search flies nothing")
        if self.leads:
            return ACCEPTED
        now_s = self.vehicle.now_s
        result = self.vehicle.setpoint(now_s, self.waypoint)
        if result.accepted:
            result = self.vehicle.set_mode(now_s, Mode.OFFBOARD)
        if result.accepted:
            self.leads = True
            self.resumed(by)
        return result

    def resumed(self, by: str) -> None:
        """The vehicle has been given back to the search."""
        self.state, self._pilot = SEARCHING, ""
        self._say(mavlink.MAV_SEVERITY_INFO, f"Search resumed by {by}")

    def _begin(self, now_s: float) -> None:
        """Arm and take off, unless someone flies the vehicle already."""
        if not self.vehicle.free:
            self._say_once("Search waits: a pilot flies the vehicle")
            return
        north, east, _ = self.waypoint
        self.waypoint = north, east, -self.vehicle.config.takeoff_altitude_m  # a client may have changed it
        if (self.vehicle.armed or self._obeyed(self.vehicle.arm(now_s))) and self._obeyed(
            self.vehicle.take_off(now_s)
        ):
            self.leads = self._begun = True
            self.state = TAKING_OFF

    def declare(self, stop: Stop) -> None:
        """Take the stop: tell where the source is, and, if the search leads, do what comes after it."""
        if self.found:
            return  # repeated
        self.found = True
        if not self.under_way:
            return
        (x, y), mode = stop.estimate, AFTER_STOP[self._after_stop]
        said = f"found at ({x:.2f}, {y:.2f}) m, spread {stop.spread:.2f} m"
        if stop.outside >= SURE_OUTSIDE:
            said = f"is {outside_text(stop.outside, self.vehicle.config.area.beyond(stop.estimate))}"
        self._say(mavlink.MAV_SEVERITY_NOTICE, f"Source {said}")
        if caveat := self.vehicle.caveat:
            self._say(mavlink.MAV_SEVERITY_WARNING, f"The source may be elsewhere: {caveat}")
        if self.leads:
            self.leads = False
            self._obeyed(self.vehicle.set_mode(self.vehicle.now_s, mode))

    def leave(self, reason: str) -> None:
        """Leave a search of several, which goes on without the vehicle.

        If the search leads, it does what comes after it.
        """
        if self.is_over:
            return
        self.left = reason
        self._say(mavlink.MAV_SEVERITY_WARNING, f"The search goes on without this vehicle: {reason}")
        if self.under_way and self.leads:
            self.leads = False
            self._obeyed(self.vehicle.set_mode(self.vehicle.now_s, AFTER_STOP[self._after_stop]))

    def _obeyed(self, result: Result) -> bool:
        if not result.accepted:
            goes_on = result.code == mavlink.MAV_RESULT_IN_PROGRESS
            severity = mavlink.MAV_SEVERITY_INFO if goes_on else mavlink.MAV_SEVERITY_WARNING
            self._say_once(result.reason, severity)
        return result.accepted

    def _say_once(self, text: str, severity: int = mavlink.MAV_SEVERITY_WARNING) -> None:
        if text != self._said:
            self._said = text
            self._say(severity, text)

    # ---- what others ask ----

    def answer(self, waypoint: Message, t_s: float) -> Result:
        """Take the agent's SET_POSITION_TARGET_LOCAL_NED, which answers the reading of its time."""
        self.vehicle.catch_up(t_s)
        if not self.leads and self.vehicle.mode is Mode.OFFBOARD:
            return not_now(
                "Waypoint ignored: another client leads"
            )  # the agent is asked again when the search is given back
        result = self.answers.refusal(waypoint.time_boot_ms)
        if result is None and (waypoint.coordinate_frame != LOCAL_NED or waypoint.type_mask & NO_POSITION):
            result = denied("Waypoint refused: the answer to a reading is a position", "no position")
        if result is None:
            result = self.vehicle.setpoint(t_s, (waypoint.x, waypoint.y, waypoint.z), answers=True)
        if result.accepted:
            self.answers.awaited = False
            self.waypoint = self.vehicle.waypoint or self.waypoint
        return result

    def obey(self, word: CommandName, t_s: float, by: str) -> Result:
        """Do what an operator tells the search of a real vehicle: give way to a mode, or lead again."""
        self.vehicle.catch_up(t_s)
        if not self.under_way:
            return not_now(f"{word.capitalize()} refused: the search flies nothing")
        if word == "resume":
            return self.give_back(by)
        result = self.vehicle.set_mode(t_s, MODES_WANTED[word])
        if result.accepted:
            self.give_way(self.vehicle.mode.name, by)
        return result
