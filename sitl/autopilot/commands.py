"""The commands that the vehicle obeys, a row each: COMMAND_LONG (76), COMMAND_INT (75) and SET_MODE (11)."""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import ACCEPTED, UNSUPPORTED, Result, denied
from link.bus.mavlink import Message
from link.bus.px4 import AvailableModes, ProtocolVersion
from link.modes import Mode
from sitl.autopilot.parameters import Parameters
from sitl.autopilot.plan import ABOVE_HOME, ABOVE_SEA
from sitl.autopilot.telemetry import Telemetry
from sitl.autopilot.vehicle import Vehicle

FORCE = 21196.0  # MAVLink's magic number: as param 2 it forces a disarm in the air
TAKE_OFF_WITHIN_M = 0.1  # a take-off so little below the lowest is raised without a word, as in PX4
# The parameter that MAV_CMD_DO_CHANGE_SPEED (178) changes, by its SPEED_TYPE.
SPEEDS = {0.0: "MPC_XY_CRUISE", 1.0: "MPC_XY_CRUISE", 2.0: "MPC_Z_VEL_MAX_UP", 3.0: "MPC_Z_VEL_MAX_DN"}
UNCHANGED = -1.0  # as a speed or as the number of an item: leave it as it is


class Params(NamedTuple):
    """The parameters of a command; NaN means "not given"."""

    p1: float
    p2: float
    p3: float
    p4: float
    lat_deg: float
    lon_deg: float
    alt_m: float
    frame: int


class CommandRequest(NamedTuple):
    """A command to a vehicle, and how it came."""

    vehicle: Vehicle
    parameters: Parameters
    t_s: float  # simulation time
    streams: Telemetry | None  # the telemetry of the link that it came over; without it no message is sent
    answers: list[Message]  # messages to send behind the acknowledgement


class KnownCommand(NamedTuple):
    """What a command does."""

    does: str  # for the documentation
    obey: Callable[[CommandRequest, Params], Result]
    finite: int = 0  # how many leading parameters must be finite; NaN in any other means "not given"
    for_all: bool = False  # whether it may be sent to system 0; PX4, too, obeys no other that is broadcast


def params(m: Message) -> Params:
    """Return the parameters of a COMMAND_LONG or a COMMAND_INT."""
    first = m.param1, m.param2, m.param3, m.param4
    if m.get_type() == "COMMAND_LONG":
        return Params(*first, m.param5, m.param6, m.param7, mavlink.MAV_FRAME_GLOBAL)
    lat, lon = (math.nan if degrees == 0x7FFFFFFF else degrees / 1e7 for degrees in (m.x, m.y))
    return Params(*first, lat, lon, m.z, m.frame)


def obey(command: int, request: CommandRequest, p: Params) -> Result:
    """Obey a command, if it is one of the table."""
    known = COMMANDS.get(command)
    if known is None:
        return UNSUPPORTED
    for number, value in enumerate(p[: known.finite], start=1):
        if not math.isfinite(value):
            return denied(f"Command {command} refused: param {number} is {value}")
    return known.obey(request, p)


# ---- arming, modes, take-off ----


def _arm(request: CommandRequest, p: Params) -> Result:
    if p.p1 not in (0.0, 1.0):
        return denied(f"Arming refused: param 1 is {p.p1:g}, allowed is 0 or 1")
    if p.p1:
        return request.vehicle.arm(request.t_s)
    return request.vehicle.disarm(request.t_s, force=p.p2 == FORCE)


def _change_mode(request: CommandRequest, _: Params, mode: Mode) -> Result:
    return request.vehicle.set_mode(request.t_s, mode)


def _set_mode(request: CommandRequest, p: Params) -> Result:
    sub = int(p.p3) if math.isfinite(p.p3) else 0
    return set_custom_mode(request.vehicle, request.t_s, int(p.p1), int(p.p2), sub)


def set_custom_mode(vehicle: Vehicle, t_s: float, base_mode: int, main: int, sub: int) -> Result:
    """Change to a mode by PX4's main and sub mode."""
    if not base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return denied("Mode refused: only PX4's custom modes are supported")
    try:
        mode = Mode.OFFBOARD if main == Mode.OFFBOARD.value[0] else Mode((main, sub))
    except ValueError:
        return denied(f"Mode refused: PX4 mode {main}, {sub} is not supported")
    return vehicle.set_mode(t_s, mode)


def _take_off(request: CommandRequest, p: Params) -> Result:
    """Take off. An altitude that is too low is raised, as in PX4: people type a height above the ground."""
    lowest_m = request.vehicle.config.takeoff_altitude_m
    altitude_m = _above_home(request, p) if math.isfinite(p.alt_m) else lowest_m
    result = request.vehicle.take_off(request.t_s, max(altitude_m, lowest_m))
    if result.accepted and altitude_m < lowest_m - TAKE_OFF_WITHIN_M:
        return result._replace(reason=f"Using minimum takeoff altitude: {lowest_m:g} m above home")
    return result


def _reposition(request: CommandRequest, p: Params) -> Result:
    if p.frame not in ABOVE_SEA | ABOVE_HOME:
        return denied(f"Go-to refused: frame {p.frame} is not global")
    north, east, down = request.vehicle.state(request.t_s).position
    if math.isfinite(p.lat_deg) and math.isfinite(p.lon_deg):
        north, east = request.vehicle.config.local(p.lat_deg, p.lon_deg)
    if math.isfinite(p.alt_m):
        down = -_above_home(request, p)
    yaw_rad = p.p4 if math.isfinite(p.p4) else None
    return request.vehicle.go_to(request.t_s, (north, east, down), yaw_rad)


def _above_home(request: CommandRequest, p: Params) -> float:
    return p.alt_m if p.frame in ABOVE_HOME else p.alt_m - request.vehicle.config.home_alt_m


def _change_speed(request: CommandRequest, p: Params) -> Result:
    if p.p1 not in SPEEDS:
        return denied(f"Speed refused: param 1 is {p.p1:g}, allowed is 0 to 3")
    reason = "" if p.p2 == UNCHANGED else request.parameters.change(SPEEDS[p.p1], p.p2, request.t_s)
    return denied(f"Speed refused: {reason}") if reason else ACCEPTED


# ---- the mission ----


def _start_mission(request: CommandRequest, p: Params) -> Result:
    """Fly the mission, as PX4 does: choose the item, change the mode, arm."""
    result = ACCEPTED if p.p1 == UNCHANGED else _set_current(request, p)
    if result.accepted:
        result = _change_mode(request, p, Mode.MISSION)
    return request.vehicle.arm(request.t_s) if result.accepted else result


def _set_current(request: CommandRequest, p: Params) -> Result:
    vehicle = request.vehicle
    return vehicle.set_current(request.t_s, vehicle.mission.current if p.p1 == UNCHANGED else int(p.p1))


def _pause(request: CommandRequest, p: Params) -> Result:
    if p.p1 not in (0.0, 1.0):
        return denied(f"Pause refused: param 1 is {p.p1:g}, allowed is 0 or 1")
    return _change_mode(request, p, Mode.MISSION if p.p1 else Mode.HOLD)


# ---- messages and their rates ----


class OnRequest(NamedTuple):
    """A message that is sent on request and is no stream."""

    says: str  # for the documentation
    build: Callable[[int, Telemetry], list[Message]]  # takes the number of the request's param 2


def _protocol_version(_number: int, _streams: Telemetry) -> list[Message]:
    return [
        ProtocolVersion(
            version=200,
            min_version=100,
            max_version=200,
            spec_version_hash=[0] * 8,
            library_version_hash=[0] * 8,
        )
    ]


def _available_modes(number: int, _streams: Telemetry) -> list[Message]:
    return [
        AvailableModes(
            custom_mode=mode.custom_mode,
            properties=0,
            number_modes=len(Mode),
            mode_index=index,
            standard_mode=mode.standard,
            mode_name=mode.name.capitalize().encode(),
        )
        for index, mode in enumerate(Mode, start=1)
        if number in (0, index)
    ]


def _message_interval(number: int, streams: Telemetry) -> list[Message]:
    return [mavlink.MAVLink_message_interval_message(number & 0xFFFF, streams.interval_us(number))]


REQUESTED = {
    ProtocolVersion.id: OnRequest("MAVLink 2 and 1 are read, 2 is spoken", _protocol_version),
    AvailableModes.id: OnRequest("the mode of the number in param 2, 0 for all", _available_modes),
    mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL: OnRequest("that of the message in param 2", _message_interval),
}


def _send(request: CommandRequest, _: Params, message_id: int, index: float = 0.0) -> Result:
    """Send a message once; `index` says which one where there are several."""
    if request.streams is None:
        return UNSUPPORTED
    if message_id in REQUESTED:
        number = int(index) if math.isfinite(index) else 0
        messages = REQUESTED[message_id].build(number, request.streams)
    else:
        message = request.streams.build(message_id, request.t_s)
        messages = [] if message is None else [message]
    request.answers.extend(messages)
    return ACCEPTED if messages else UNSUPPORTED


def _request_message(request: CommandRequest, p: Params) -> Result:
    return _send(request, p, int(p.p1), p.p2)


def _get_interval(request: CommandRequest, p: Params) -> Result:
    return _send(request, p, mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL, p.p1)


def _set_interval(request: CommandRequest, p: Params) -> Result:
    return request.streams.set_interval(int(p.p1), p.p2, request.t_s) if request.streams else UNSUPPORTED


# All others are unsupported.
COMMANDS = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: KnownCommand(
        "arms and disarms; in the air only with param 2 = 21196, and the vehicle falls", _arm, 1
    ),
    mavlink.MAV_CMD_NAV_TAKEOFF: KnownCommand(
        "climbs to an altitude above sea, at least and with NaN to MIS_TAKEOFF_ALT; disarmed: once it is "
        "armed",
        _take_off,
    ),
    mavlink.MAV_CMD_NAV_LAND: KnownCommand("lands on the spot", partial(_change_mode, mode=Mode.LAND)),
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: KnownCommand(
        "returns home and lands", partial(_change_mode, mode=Mode.RETURN)
    ),
    mavlink.MAV_CMD_DO_SET_MODE: KnownCommand("changes to a mode by PX4's numbers", _set_mode, 2),
    mavlink.MAV_CMD_DO_CHANGE_SPEED: KnownCommand(
        "sets MPC_XY_CRUISE (param 1 is 0 or 1), MPC_Z_VEL_MAX_UP (2) or MPC_Z_VEL_MAX_DN (3) to param 2",
        _change_speed,
        2,
    ),
    mavlink.MAV_CMD_DO_REPOSITION: KnownCommand(
        "flies to a global position inside the area and holds there", _reposition
    ),
    mavlink.MAV_CMD_MISSION_START: KnownCommand(
        "flies the mission from item param 1 on, -1: from the current one; arms", _start_mission, 1
    ),
    mavlink.MAV_CMD_DO_SET_MISSION_CURRENT: KnownCommand(
        "goes on with item param 1 of the mission; all its jumps count anew", _set_current, 1
    ),
    mavlink.MAV_CMD_DO_PAUSE_CONTINUE: KnownCommand(
        "param 1 = 0: holds; 1: goes on with the mission's current item", _pause, 1
    ),
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: KnownCommand(
        "sets the rate of a stream of this link; HEARTBEAT stays on", _set_interval, 2
    ),
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: KnownCommand("MESSAGE_INTERVAL", _get_interval, 1),
    mavlink.MAV_CMD_REQUEST_MESSAGE: KnownCommand(
        "sends a message of the next table once", _request_message, 1, for_all=True
    ),
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: KnownCommand(
        "AUTOPILOT_VERSION",
        partial(_send, message_id=mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION),
        for_all=True,
    ),
    mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION: KnownCommand(
        "PROTOCOL_VERSION", partial(_send, message_id=ProtocolVersion.id), for_all=True
    ),
    mavlink.MAV_CMD_GET_HOME_POSITION: KnownCommand(
        "HOME_POSITION", partial(_send, message_id=mavlink.MAVLINK_MSG_ID_HOME_POSITION)
    ),
}
