"""The search's side of the vehicle: when it begins and ends, and who leads, the search or a pilot. The pilot always wins.

One rule: the search leads only while it holds control. Anyone else's change of mode takes control at once; the search then leads again
only when it is given back, by OFFBOARD. Setpoints are the leader's alone.
"""

import math
import time
from collections.abc import Callable

from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Message
from link.bus.messages import Stop
from sitl.autopilot.motion import Ned
from sitl.autopilot.setpoint import Answers
from sitl.autopilot.state import Mode, Result, denied, not_now
from sitl.autopilot.telemetry import Telemetry
from sitl.protocol.protocol import MavlinkProtocol
from sitl.protocol.service import AnyVehicle
from sitl.protocol.setpoints import GLOBAL, LOCAL, read
from sitl.script.script import AfterStop

AFTER_STOP: dict[AfterStop, Mode] = {"return": Mode.RETURN, "land": Mode.LAND, "hold": Mode.HOLD}
STREAM_S = 1.0
"""Real time after which a client's stream of setpoints has ended: PX4's COM_OF_LOSS_T."""
CHANGES = {"COMMAND_LONG", "COMMAND_INT", "SET_MODE"}
SETPOINTS = {LOCAL, GLOBAL}
STANDBY, TAKING_OFF, SEARCHING, PAUSED = "standby", "taking off", "searching", "paused"
RETURNING, HOLDING, LANDED = "returning", "holding", "landed"

Sender = tuple[int, int]
"""System and component id."""


class Search:
    """One search by one vehicle: arm, take off, fly to the start, follow the agent's waypoints, come home; or let a pilot lead."""

    def __init__(
        self,
        vehicle: AnyVehicle,
        protocol: MavlinkProtocol,
        start: tuple[float, float],
        after_stop: AfterStop,
        say: Callable[[int, str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Take the start, (x, y) m, and what tells people a text of a MAV_SEVERITY. `clock` is real time, s."""
        self.state = STANDBY
        """What the uav's health says."""
        self.found = False
        """True once the stop has been declared."""
        self.answers = Answers()
        """The readings, and whether the newest is answered: the agent's first waypoint with its time answers it."""
        self._vehicle, self._protocol, self._say, self._clock = vehicle, protocol, say, clock
        self._after_stop = after_stop
        self._waypoint: Ned = (start[1], start[0], -vehicle.config.takeoff_altitude_m)
        """The search's own setpoint: the start, then what the agent last answered."""
        self._begun = False
        self._said = ""
        self._streams: dict[Sender, float] = {}  # when each other client last sent a setpoint

    @property
    def leads(self) -> bool:
        """True while the search holds control. It is then the vehicle's companion."""
        return self._vehicle.companion.is_own_search

    @leads.setter
    def leads(self, leads: bool) -> None:
        self._vehicle.companion.is_own_search = leads

    @property
    def waits_for(self) -> str:
        """Why it has not begun, in words; empty if it has, or if only the services are missing."""
        return "" if self._begun else self._said

    @property
    def measures(self) -> bool:
        """True if the vehicle's arrival is one at a waypoint of the search: only there readings are taken, one at each."""
        return self.leads and self.state == SEARCHING and not self.answers.awaited

    @property
    def wants_answers(self) -> bool:
        """True while the search waits for the answer to its newest reading; a paused one keeps the answer for later."""
        return self.state in (SEARCHING, PAUSED) and self.answers.awaited and not self.found

    # ---- how it goes on ----

    def go_on(self, searchers: bool) -> None:
        """Take the next step of the search where it is due; `searchers` says whether estimator and agent are there."""
        if self.state == LANDED:
            return
        now_s, mode = self._vehicle.now_s, self._vehicle.mode
        if not self._begun:
            if searchers and self.found:
                self._say_once("Search not begun: its estimator has stopped already; start it anew")
            elif searchers:
                self._begin(now_s)
        elif not self._vehicle.armed and not self._vehicle.moving:
            self.leads, self.state = False, LANDED
        elif mode in (Mode.RETURN, Mode.LAND):
            self.leads, self.state = False, RETURNING  # by a pilot, a failsafe, or since the source is found
        elif self.leads and self.state == SEARCHING and mode is not Mode.OFFBOARD:
            self.leads = False
            self._say(mavlink.MAV_SEVERITY_WARNING, f"Search gives way: {mode.name} by the autopilot")
        elif not self.leads:
            self.state = HOLDING if self.found else PAUSED
        elif self.state == TAKING_OFF and mode is Mode.HOLD:
            self._obeyed(self._vehicle.setpoint(now_s, self._waypoint))
            self._obeyed(self._vehicle.set_mode(now_s, Mode.OFFBOARD))
            self.state = SEARCHING

    def led(self, mode: str, given_back: bool) -> None:
        """A real autopilot's mode was changed by a pilot, or by itself: give way, or lead again where it is given back."""
        if not self._begun or self.state == LANDED:
            return
        if not given_back and self.leads:
            self.leads = False
            self._say(mavlink.MAV_SEVERITY_WARNING, f"Search gives way: {mode} by the autopilot or its pilot")
        elif given_back and not self.found:
            now_s = self._vehicle.now_s
            self._obeyed(self._vehicle.setpoint(now_s, self._waypoint))
            self.leads = self._obeyed(self._vehicle.set_mode(now_s, Mode.OFFBOARD))
            if self.leads:
                self.state = SEARCHING
                self._say(mavlink.MAV_SEVERITY_INFO, f"Search resumed: {mode} by the autopilot or its pilot")

    def _begin(self, now_s: float) -> None:
        """Arm and take off, unless someone flies the vehicle already."""
        state = self._vehicle.state(now_s)
        if self._vehicle.moving or state.mode is not Mode.HOLD or state.landed_state != mavlink.MAV_LANDED_STATE_ON_GROUND:
            self._say_once("Search waits: a pilot flies the vehicle")
            return
        north, east, _ = self._waypoint
        self._waypoint = north, east, -self._vehicle.config.takeoff_altitude_m  # a client may have changed it
        if (state.armed or self._obeyed(self._vehicle.arm(now_s))) and self._obeyed(self._vehicle.take_off(now_s)):
            self.leads = self._begun = True
            self.state = TAKING_OFF

    def declare(self, stop: Stop) -> None:
        """Take the stop: tell where the source is, and, if the search leads, do what comes after it."""
        if self.found:
            return  # repeated
        self.found = True
        if not self._begun or self.state == LANDED:
            return
        (x, y), mode = stop.estimate, AFTER_STOP[self._after_stop]
        self._say(mavlink.MAV_SEVERITY_NOTICE, f"Source found at ({x:.2f}, {y:.2f}) m, spread {stop.spread:.2f} m")
        if self.leads:
            self.leads = False
            self._obeyed(self._vehicle.set_mode(self._vehicle.now_s, mode))

    def _obeyed(self, result: Result) -> bool:
        if not result.accepted:
            going_on = result.code == mavlink.MAV_RESULT_IN_PROGRESS
            self._say_once(result.reason, mavlink.MAV_SEVERITY_INFO if going_on else mavlink.MAV_SEVERITY_WARNING)
        return result.accepted

    def _say_once(self, text: str, severity: int = mavlink.MAV_SEVERITY_WARNING) -> None:
        if text != self._said:
            self._said = text
            self._say(severity, text)

    # ---- what others ask ----

    def answer(self, waypoint: Message, t_s: float) -> list[Message]:
        """Take the agent's SET_POSITION_TARGET_LOCAL_NED, which answers the reading of its time; return texts if it is refused."""
        self._vehicle.catch_up(t_s)
        if not self.leads and self._vehicle.mode is Mode.OFFBOARD:
            return []  # another client leads; the agent is asked again when the search is given back
        setpoint = read(waypoint, self._vehicle.config, self._vehicle.state(t_s).yaw)
        if isinstance(setpoint, Result):
            return self._protocol.refuse_setpoint(setpoint, t_s)
        refusal = self.answers.refusal(waypoint.time_boot_ms, setpoint)
        result = refusal or self._vehicle.setpoint(t_s, setpoint, answers=True)
        if result.accepted:
            self.answers.awaited = False
            self._waypoint = self._vehicle.waypoint or self._waypoint
        return self._protocol.refuse_setpoint(result, t_s)

    def receive(self, message: Message, t_s: float, whence: str, streams: Telemetry | None = None) -> list[Message]:
        """Handle a message from any link as `MavlinkProtocol.receive` does, and see to it that only the leader leads.

        whence: how it came, in words; anybody can write any ids into a frame.
        """
        self._vehicle.catch_up(t_s)
        if not self._protocol.is_addressed(message):
            return []
        kind, sender = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        who = f"{sender[0]}/{sender[1]} {whence}"
        if kind in SETPOINTS:
            self._streams[sender] = self._clock()
            if self.leads:
                return self._protocol.refuse_setpoint(denied("Waypoint refused: the search leads, HOLD stops it", "not leading"), t_s)
            return self._protocol.receive(message, t_s, streams)
        if kind not in CHANGES:
            return self._protocol.receive(message, t_s, streams)
        before = self._flown()
        if _asks_offboard(message) and self._begun and not self.found and self.state != LANDED:
            if self.leads and self._is_streaming(sender):
                reason = "Offboard refused: the search leads, HOLD stops it"
                return self._protocol.refuse(message, not_now(reason))
            if not self.leads and not self._is_streaming(None):
                return self._give_back(message, who, t_s, streams)
        answers = self._protocol.receive(message, t_s, streams)
        if self._begun and self.state != LANDED and self._flown() != before:
            gives_way, self.leads = "Search gives way: " * self.leads, False
            how = self._vehicle.mode.name if self._vehicle.armed else "disarmed"
            self._say(mavlink.MAV_SEVERITY_WARNING, f"{gives_way}{how} by {who}")
        return answers

    def _give_back(self, message: Message, who: str, t_s: float, streams: Telemetry | None) -> list[Message]:
        """Lead again where the search left off. Nobody else sends its waypoint again, so it is set here."""
        self.leads = True
        self._vehicle.setpoint(t_s, self._waypoint)
        answers = self._protocol.receive(message, t_s, streams)
        self.leads = self._vehicle.mode is Mode.OFFBOARD
        if self.leads:
            self.state = SEARCHING
            self._say(mavlink.MAV_SEVERITY_INFO, f"Search resumed by {who}")
        return answers

    def _flown(self) -> tuple[Mode, bool]:
        return self._vehicle.mode, self._vehicle.armed

    def _is_streaming(self, sender: Sender | None) -> bool:
        """Whether a client, or with None any client, streams setpoints of its own: then it leads in OFFBOARD."""
        heard_s = max(self._streams.values(), default=-math.inf) if sender is None else self._streams.get(sender, -math.inf)
        return self._clock() - heard_s <= STREAM_S


def _asks_offboard(message: Message) -> bool:
    main = Mode.OFFBOARD.value[0]
    if message.get_type() == "SET_MODE":
        return bool(message.custom_mode >> 16 & 0xFF == main)
    return bool(message.command == mavlink.MAV_CMD_DO_SET_MODE and message.param2 == main)
