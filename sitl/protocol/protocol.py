"""The autopilot's MAVLink protocol, compatible with PX4: commands and setpoints in; acknowledgements,
messages, texts out.
"""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from aircraft.mode import Mode
from aircraft.state import ACCEPTED, UNSUPPORTED, Result, denied
from aircraft.words import Words
from link.bus.mavlink import Message
from link.bus.px4 import AvailableModes, ProtocolVersion
from plume.geodesy import to_local
from sitl.autopilot.plan import ABOVE_HOME, ABOVE_SEA
from sitl.autopilot.telemetry import Telemetry
from sitl.autopilot.vehicle import Vehicle
from sitl.protocol import clocks, files, logs, refused, setpoints
from sitl.protocol.missions import PlanService
from sitl.protocol.modes import available_modes
from sitl.protocol.parameters import Parameters
from sitl.protocol.service import Microservice

COMPONENT = mavlink.MAV_COMP_ID_AUTOPILOT1
FORCE = 21196.0
"""MAVLink's magic number: as param2 of MAV_CMD_COMPONENT_ARM_DISARM (400) it forces a disarm in the air.
"""
COMMANDS = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: "arms and disarms; in the air only with param 2 = 21196, and the "
    "vehicle falls",
    mavlink.MAV_CMD_NAV_TAKEOFF: "climbs to an altitude above sea, at least and with NaN to MIS_TAKEOFF_ALT; "
    "disarmed: once it is armed",
    mavlink.MAV_CMD_NAV_LAND: "lands on the spot",
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: "returns home and lands",
    mavlink.MAV_CMD_DO_SET_MODE: "changes to a mode by PX4's numbers",
    mavlink.MAV_CMD_DO_CHANGE_SPEED: "sets MPC_XY_CRUISE (param 1 is 0 or 1), MPC_Z_VEL_MAX_UP (2) or "
    "MPC_Z_VEL_MAX_DN (3) to param 2",
    mavlink.MAV_CMD_DO_REPOSITION: "flies to a global position inside the area and holds there",
    mavlink.MAV_CMD_MISSION_START: "flies the mission from item param 1 on, -1: from the current one; arms",
    mavlink.MAV_CMD_DO_SET_MISSION_CURRENT: "goes on with item param 1 of the mission; all its jumps count "
    "anew",
    mavlink.MAV_CMD_DO_PAUSE_CONTINUE: "param 1 = 0: holds; 1: goes on with the mission's current item",
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: "sets the rate of a stream of this link; HEARTBEAT stays on",
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: "MESSAGE_INTERVAL",
    mavlink.MAV_CMD_REQUEST_MESSAGE: "sends a message of the next table once",
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: "AUTOPILOT_VERSION",
    mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION: "PROTOCOL_VERSION",
    mavlink.MAV_CMD_GET_HOME_POSITION: "HOME_POSITION",
}
"""The commands that are obeyed, and what each does; all others are unsupported."""
NUMBERED = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: 1,
    mavlink.MAV_CMD_DO_SET_MODE: 2,
    mavlink.MAV_CMD_DO_CHANGE_SPEED: 2,
    mavlink.MAV_CMD_MISSION_START: 1,
    mavlink.MAV_CMD_DO_SET_MISSION_CURRENT: 1,
    mavlink.MAV_CMD_DO_PAUSE_CONTINUE: 1,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: 2,
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: 1,
    mavlink.MAV_CMD_REQUEST_MESSAGE: 1,
}
"""How many leading parameters of a command must be finite; NaN in any other means "not given"."""
TAKE_OFF_WITHIN_M = 0.1
"""A take-off so little below the lowest is raised without a word, as in PX4."""
SPEEDS = {0.0: "MPC_XY_CRUISE", 1.0: "MPC_XY_CRUISE", 2.0: "MPC_Z_VEL_MAX_UP", 3.0: "MPC_Z_VEL_MAX_DN"}
"""The parameter that MAV_CMD_DO_CHANGE_SPEED (178) changes, by its SPEED_TYPE."""
UNCHANGED = -1.0
"""The speed that means: leave it as it is."""
ASKED_OF_ALL = {
    mavlink.MAV_CMD_REQUEST_MESSAGE,
    mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION,
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
}
"""Commands that may be broadcast; PX4, too, obeys no other command that is sent to system 0."""

BROADCAST = Result(mavlink.MAV_RESULT_FAILED, "Command refused: sent to all, wanted one vehicle")


class Params(NamedTuple):
    """The parameters of a COMMAND_LONG (76) or a COMMAND_INT (75); NaN means "not given"."""

    p1: float
    p2: float
    p3: float
    p4: float
    lat_deg: float
    lon_deg: float
    alt_m: float
    frame: int


class MavlinkProtocol(Words):
    """Handles the MAVLink messages of all clients of one vehicle and builds the answers."""

    def __init__(self, vehicle: Vehicle, clock: Callable[[], float] = time.monotonic) -> None:
        """Serve one vehicle. `clock` is real time, s: clients live in it."""
        super().__init__()
        self._vehicle = vehicle
        self._missions = PlanService(vehicle, clock)
        self._parameters = Parameters(vehicle)
        self.services: dict[str, Microservice] = {
            service.request: service
            for services in (
                self._parameters.services,
                clocks.SERVICES,
                self._missions.services,
                logs.SERVICES,
                files.SERVICES,
                refused.services(),
            )
            for service in services
        }
        """By the type of message that each takes."""

    def receive(self, message: Message, t_s: float, streams: Telemetry | None = None) -> list[Message]:
        """Handle one decoded message received at `t_s`; return the answers for the caller to send back
        over the same link.

        Messages to another system or component get no answer. `streams` is the telemetry of the link:
        requests for messages and rates act on it; without it they are unsupported.
        """
        self._vehicle.catch_up(t_s)
        if not self.is_addressed(message):
            return []
        match message.get_type():
            case "COMMAND_LONG" | "COMMAND_INT":
                if message.target_system == 0 and message.command not in ASKED_OF_ALL:
                    return self.refuse(message, BROADCAST)
                result, answers = self._command(message.command, _params(message), t_s, streams)
                ack, *reason = self.answer(message, message.command, result)
                return [ack, *answers, *reason]
            case "SET_MODE":
                result = self._set_custom_mode(
                    t_s, message.base_mode, message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24
                )
                return self.answer(message, mavlink.MAVLINK_MSG_ID_SET_MODE, result)
            case setpoints.LOCAL | setpoints.GLOBAL:
                return self.refuse_setpoint(setpoints.take(self._vehicle, message, t_s), t_s)
        if service := self.services.get(message.get_type()):
            self._missions.link = streams
            reply = service.answer(message, t_s)
            quiet = reply.kind and self.has_told(reply.kind, t_s)
            return [*reply.messages, *([] if quiet else self.reason(denied(reply.reason)))]
        return []

    def next_due_s(self) -> float:
        """Return when to call `due` again, in real time; infinity if nothing is awaited."""
        return self._missions.next_s()

    def due(self, streams: Telemetry) -> list[Message]:
        """Return what has to be sent again over a link, of the telemetry `streams`, because a client has
        not answered.
        """
        reply = self._missions.due(streams)
        return [*reply.messages, *self.reason(denied(reply.reason))]

    def is_addressed(self, message: Message) -> bool:
        """True unless a message is for another system or component, or comes from our own ids: PX4 ignores
        those, too.
        """
        ours = self._vehicle.config.sysid, COMPONENT
        if (message.get_srcSystem(), message.get_srcComponent()) == ours:
            return False
        return all(
            getattr(message, f"target_{name}", 0) in (0, own)
            for name, own in zip(("system", "component"), ours, strict=True)
        )

    # ---- commands ----

    def _command(
        self, command: int, p: Params, t_s: float, streams: Telemetry | None
    ) -> tuple[Result, list[Message]]:
        for number, value in enumerate(p[: NUMBERED.get(command, 0)], start=1):
            if not math.isfinite(value):
                return denied(f"Command {command} refused: param {number} is {value}"), []
        match command:
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                if p.p1 not in (0.0, 1.0):
                    return denied(f"Arming refused: param 1 is {p.p1:g}, allowed is 0 or 1"), []
                return self._vehicle.arm(t_s) if p.p1 else self._vehicle.disarm(t_s, force=p.p2 == FORCE), []
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                return self._take_off(p, t_s)
            case mavlink.MAV_CMD_NAV_LAND:
                return self._vehicle.set_mode(t_s, Mode.LAND), []
            case mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                return self._vehicle.set_mode(t_s, Mode.RETURN), []
            case mavlink.MAV_CMD_DO_SET_MODE:
                return self._set_custom_mode(
                    t_s, int(p.p1), int(p.p2), int(p.p3) if math.isfinite(p.p3) else 0
                ), []
            case mavlink.MAV_CMD_DO_CHANGE_SPEED:
                return self._change_speed(p, t_s), []
            case mavlink.MAV_CMD_DO_REPOSITION:
                return self._reposition(p, t_s), []
            case mavlink.MAV_CMD_MISSION_START:
                return self._start_mission(p, t_s), []
            case mavlink.MAV_CMD_DO_SET_MISSION_CURRENT:
                return self._set_current(p, t_s), []
            case mavlink.MAV_CMD_DO_PAUSE_CONTINUE:
                if p.p1 not in (0.0, 1.0):
                    return denied(f"Pause refused: param 1 is {p.p1:g}, allowed is 0 or 1"), []
                return self._vehicle.set_mode(t_s, Mode.MISSION if p.p1 else Mode.HOLD), []
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                return (UNSUPPORTED if streams is None else streams.set_interval(int(p.p1), p.p2, t_s)), []
            case mavlink.MAV_CMD_GET_MESSAGE_INTERVAL:
                return _request(mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL, p.p1, t_s, streams)
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                return _request(int(p.p1), p.p2, t_s, streams)
            case mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
                return _request(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0.0, t_s, streams)
            case mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION:
                return _request(ProtocolVersion.id, 0.0, t_s, streams)
            case mavlink.MAV_CMD_GET_HOME_POSITION:
                return _request(mavlink.MAVLINK_MSG_ID_HOME_POSITION, 0.0, t_s, streams)
        return UNSUPPORTED, []

    def _set_custom_mode(self, t_s: float, base_mode: int, main: int, sub: int) -> Result:
        if not base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            return denied("Mode refused: only PX4's custom modes are supported")
        if main == Mode.OFFBOARD.value[0]:
            sub = 0
        try:
            mode = Mode((main, sub))
        except ValueError:
            return denied(f"Mode refused: PX4 mode {main}, {sub} is not supported")
        return self._vehicle.set_mode(t_s, mode)

    def _take_off(self, p: Params, t_s: float) -> tuple[Result, list[Message]]:
        """Take off. An altitude that is too low is raised with a word, as in PX4: stations type a height
        where it is above sea.
        """
        least_m = self._vehicle.config.takeoff_altitude_m
        altitude_m = self._above_home(p) if math.isfinite(p.alt_m) else least_m
        result = self._vehicle.take_off(t_s, max(altitude_m, least_m))
        told = result.accepted and altitude_m < least_m - TAKE_OFF_WITHIN_M
        text = f"Using minimum takeoff altitude: {least_m:g} m above home"
        return result, self.statustext(mavlink.MAV_SEVERITY_WARNING, text) if told else []

    def _change_speed(self, p: Params, t_s: float) -> Result:
        name = SPEEDS.get(p.p1)
        if name is None:
            return denied(f"Speed refused: param 1 is {p.p1:g}, allowed is 0 to 3")
        if p.p2 == UNCHANGED:
            return ACCEPTED
        reason = self._parameters.change(name, p.p2, t_s)
        return denied(f"Speed refused: {reason}") if reason else ACCEPTED

    def _start_mission(self, p: Params, t_s: float) -> Result:
        """Fly the mission, as PX4 does: choose the item, change the mode, arm."""
        result = ACCEPTED if p.p1 == -1.0 else self._set_current(p, t_s)
        if result.accepted:
            result = self._vehicle.set_mode(t_s, Mode.MISSION)
        return self._vehicle.arm(t_s) if result.accepted else result

    def _set_current(self, p: Params, t_s: float) -> Result:
        return self._vehicle.set_current(t_s, self._vehicle.mission.current if p.p1 == -1.0 else int(p.p1))

    def _reposition(self, p: Params, t_s: float) -> Result:
        if p.frame not in ABOVE_SEA | ABOVE_HOME:
            return denied(f"Go-to refused: frame {p.frame} is not global")
        config = self._vehicle.config
        north, east, down = self._vehicle.state(t_s).position
        if math.isfinite(p.lat_deg) and math.isfinite(p.lon_deg):
            north, east = setpoints.on_edge(
                to_local(config.home_lat_deg, config.home_lon_deg, p.lat_deg, p.lon_deg), config
            )
        if math.isfinite(p.alt_m):
            down = -self._above_home(p)
        return self._vehicle.go_to(t_s, (north, east, down), p.p4 if math.isfinite(p.p4) else None)

    def _above_home(self, p: Params) -> float:
        return p.alt_m if p.frame in ABOVE_HOME else p.alt_m - self._vehicle.config.home_alt_m


def _params(m: Message) -> Params:
    if m.get_type() == "COMMAND_LONG":
        return Params(
            m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7, mavlink.MAV_FRAME_GLOBAL
        )
    lat, lon = (
        math.nan if degrees == 0x7FFFFFFF else degrees / 1e7 for degrees in (m.x, m.y)
    )  # INT32_MAX: not given
    return Params(m.param1, m.param2, m.param3, m.param4, lat, lon, m.z, m.frame)


REQUESTED = {
    ProtocolVersion.id: "PROTOCOL_VERSION: MAVLink 2 and 1 are read, 2 is spoken",
    AvailableModes.id: "AVAILABLE_MODES: the mode of the number in param 2, 0 for all",
    mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL: "MESSAGE_INTERVAL: that of the message in param 2",
}
"""Messages that are sent on request and are no streams."""


def _request(
    message_id: int, index: float, t_s: float, streams: Telemetry | None
) -> tuple[Result, list[Message]]:
    """Build a message on request; `index` says which one where there are several."""
    if streams is None:
        return UNSUPPORTED, []
    number = int(index) if math.isfinite(index) else 0
    match message_id:
        case ProtocolVersion.id:
            nothing = [0] * 8
            messages = [
                ProtocolVersion(
                    version=200,
                    min_version=100,
                    max_version=200,
                    spec_version_hash=nothing,
                    library_version_hash=nothing,
                )
            ]
        case AvailableModes.id:
            messages = available_modes(number)
        case mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
            messages = [
                mavlink.MAVLink_message_interval_message(number & 0xFFFF, streams.interval_us(number))
            ]
        case _:
            message = streams.build(message_id, t_s)
            messages = [] if message is None else [message]
    return (ACCEPTED, messages) if messages else (UNSUPPORTED, [])
