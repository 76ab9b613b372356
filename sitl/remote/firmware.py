"""What differs between ArduCopter and PX4 for a companion computer: modes by number, streams, take-off altitudes, when it can fly."""

from typing import NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from sitl.autopilot.state import Mode

ESTIMATES = mavlink.ESTIMATOR_POS_HORIZ_ABS
"""Flag of EKF_STATUS_REPORT (193) and ESTIMATOR_STATUS (230): the absolute horizontal position is good."""


class Firmware(NamedTuple):
    """One autopilot firmware."""

    name: str
    modes: dict[Mode, int]
    """The HEARTBEAT's custom_mode to ask for, for each mode of the search."""
    reports: dict[int, Mode]
    """The mode of the search that a custom_mode is; one that is not here only pilots fly."""
    names: dict[int, str]
    """Names of custom modes for people."""
    hovers: frozenset[int]
    """Custom modes in which it stays in the air for as long as nobody asks for another."""
    streams: dict[int, float]
    """Messages to ask for, and their rates in Hz."""
    is_ardupilot: bool

    def params(self, custom_mode: int) -> tuple[float, float, float]:
        """Return params 1 to 3 of MAV_CMD_DO_SET_MODE (176)."""
        custom = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
        if self.is_ardupilot:
            return custom, float(custom_mode), 0.0
        return custom, float(custom_mode >> 16 & 0xFF), float(custom_mode >> 24)

    def mode_name(self, custom_mode: int) -> str:
        """Return a mode's name for people."""
        return self.names.get(custom_mode, f"mode {custom_mode:#x}")


def _rates(*more: int) -> dict[int, float]:
    usual = {
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 20.0, mavlink.MAVLINK_MSG_ID_ATTITUDE: 10.0, mavlink.MAVLINK_MSG_ID_SYS_STATUS: 2.0,
        mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0, mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: 5.0,
        mavlink.MAVLINK_MSG_ID_HOME_POSITION: 1.0, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: 1.0,
    }  # fmt: skip
    return usual | dict.fromkeys(more, 5.0)


def _px4(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


ARDUCOPTER = Firmware(
    "ArduCopter",
    {Mode.OFFBOARD: 4, Mode.HOLD: 17, Mode.RETURN: 6, Mode.LAND: 9},
    {4: Mode.OFFBOARD, 17: Mode.HOLD, 6: Mode.RETURN, 21: Mode.RETURN, 27: Mode.RETURN, 9: Mode.LAND},
    {
        0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL", 7: "CIRCLE", 9: "LAND", 11: "DRIFT",
        13: "SPORT", 14: "FLIP", 15: "AUTOTUNE", 16: "POSHOLD", 17: "BRAKE", 18: "THROW", 19: "AVOID_ADSB", 20: "GUIDED_NOGPS",
        21: "SMART_RTL", 22: "FLOWHOLD", 23: "FOLLOW", 24: "ZIGZAG", 25: "SYSTEMID", 26: "AUTOROTATE", 27: "AUTO_RTL",
    },
    frozenset({4, 17}),
    _rates(mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT, mavlink.MAVLINK_MSG_ID_WIND, mavlink.MAVLINK_MSG_ID_FENCE_STATUS),
    is_ardupilot=True,
)  # fmt: skip
PX4 = Firmware(
    "PX4",
    {mode: mode.custom_mode for mode in (Mode.TAKEOFF, Mode.HOLD, Mode.RETURN, Mode.LAND, Mode.OFFBOARD)},
    {**{mode.custom_mode: mode for mode in Mode if mode is not Mode.MISSION}, _px4(4, 9): Mode.LAND},
    {
        _px4(1): "MANUAL", _px4(2): "ALTITUDE", _px4(3): "POSITION", _px4(4, 2): "TAKEOFF", _px4(4, 3): "HOLD", _px4(4, 4): "MISSION",
        _px4(4, 5): "RETURN", _px4(4, 6): "LAND", _px4(4, 8): "FOLLOW", _px4(4, 9): "PRECISION LAND", _px4(5): "ACRO",
        _px4(6): "OFFBOARD", _px4(7): "STABILIZED", _px4(8): "RATTITUDE",
    },
    frozenset({_px4(4, 3), _px4(6)}),
    _rates(mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS, mavlink.MAVLINK_MSG_ID_WIND_COV),
    is_ardupilot=False,
)  # fmt: skip
FIRMWARES = {mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: ARDUCOPTER, mavlink.MAV_AUTOPILOT_PX4: PX4}
"""By HEARTBEAT's autopilot."""
COPTERS = {
    mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_TYPE_COAXIAL, mavlink.MAV_TYPE_HELICOPTER, mavlink.MAV_TYPE_HEXAROTOR,
    mavlink.MAV_TYPE_OCTOROTOR,
    mavlink.MAV_TYPE_TRICOPTER, mavlink.MAV_TYPE_DODECAROTOR, mavlink.MAV_TYPE_DECAROTOR,
}  # fmt: skip
"""HEARTBEAT's types that can hover."""


def unfit(heartbeat: mavlink.MAVLink_heartbeat_message) -> str:
    """Return why the search cannot fly what sent this HEARTBEAT; empty if it can."""
    wanted = "; wanted an ArduCopter or a PX4 multirotor"
    if heartbeat.autopilot not in FIRMWARES:
        return f"autopilot {_name('MAV_AUTOPILOT', heartbeat.autopilot)} is not supported{wanted}"
    if heartbeat.type not in COPTERS:
        return f"vehicle type {_name('MAV_TYPE', heartbeat.type)} cannot hover{wanted}"
    return ""


def _name(enum: str, number: int) -> str:
    entry = mavlink.enums[enum].get(number)
    return f"{entry.name.removeprefix(enum + '_')} ({number})" if entry else str(number)
