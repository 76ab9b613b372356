"""What differs between ArduCopter and PX4 for a companion computer: modes by number, and streams."""

from typing import NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from link.modes import MEANINGS, Mode, mode_name

COMING_DOWN = (Mode.RETURN, Mode.LAND)
# Flag of EKF_STATUS_REPORT (193) and ESTIMATOR_STATUS (230): the absolute horizontal position is good.
POSITION_GOOD = mavlink.ESTIMATOR_POS_HORIZ_ABS


class Firmware(NamedTuple):
    """One autopilot firmware."""

    name: str
    autopilot: int  # HEARTBEAT's
    modes: dict[Mode, int]  # the HEARTBEAT's custom_mode to ask for, for each mode of the search
    climbs: frozenset[int]  # the custom modes that come of a take-off
    hovers: frozenset[int]  # custom modes in which it stays in the air for as long as nobody asks for another
    streams: dict[int, float]  # messages to ask for, and their rates in Hz
    is_ardupilot: bool

    @property
    def reports(self) -> dict[int, Mode]:
        """The mode of the search that a custom_mode is; one that is not here only pilots fly."""
        return REPORTS[self.autopilot]

    def params(self, custom_mode: int) -> tuple[float, float, float]:
        """Return params 1 to 3 of MAV_CMD_DO_SET_MODE (176)."""
        custom = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
        if self.is_ardupilot:
            return custom, float(custom_mode), 0.0
        return custom, float(custom_mode >> 16 & 0xFF), float(custom_mode >> 24)

    def mode_name(self, custom_mode: int) -> str:
        """Return a mode's name for people."""
        return mode_name(self.autopilot, custom_mode)


def _rates(*more: int) -> dict[int, float]:
    usual = {
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 20.0,
        mavlink.MAVLINK_MSG_ID_ATTITUDE: 10.0,
        mavlink.MAVLINK_MSG_ID_SYS_STATUS: 2.0,
        mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
        mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: 5.0,
        mavlink.MAVLINK_MSG_ID_HOME_POSITION: 1.0,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: 1.0,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 2.0,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,  # for people
    }
    return usual | dict.fromkeys(more, 5.0)


ARDUCOPTER = Firmware(
    "ArduCopter",
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    {Mode.OFFBOARD: 4, Mode.HOLD: 17, Mode.RETURN: 6, Mode.LAND: 9},
    frozenset({4}),
    frozenset({4, 17}),
    _rates(
        mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
        mavlink.MAVLINK_MSG_ID_WIND,
        mavlink.MAVLINK_MSG_ID_FENCE_STATUS,
    ),
    is_ardupilot=True,
)
PX4 = Firmware(
    "PX4",
    mavlink.MAV_AUTOPILOT_PX4,
    {mode: mode.custom_mode for mode in (Mode.TAKEOFF, Mode.HOLD, Mode.RETURN, Mode.LAND, Mode.OFFBOARD)},
    frozenset({Mode.TAKEOFF.custom_mode, Mode.HOLD.custom_mode}),
    frozenset({Mode.HOLD.custom_mode, Mode.OFFBOARD.custom_mode}),
    _rates(mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS, mavlink.MAVLINK_MSG_ID_WIND_COV),
    is_ardupilot=False,
)
REPORTS = {
    autopilot: {number: Mode[name] for number, name in meanings.items()}
    for autopilot, meanings in MEANINGS.items()
}
FIRMWARES = {firmware.autopilot: firmware for firmware in (ARDUCOPTER, PX4)}  # by HEARTBEAT's autopilot
# HEARTBEAT's types that can hover.
COPTERS = {
    mavlink.MAV_TYPE_QUADROTOR,
    mavlink.MAV_TYPE_COAXIAL,
    mavlink.MAV_TYPE_HELICOPTER,
    mavlink.MAV_TYPE_HEXAROTOR,
    mavlink.MAV_TYPE_OCTOROTOR,
    mavlink.MAV_TYPE_TRICOPTER,
    mavlink.MAV_TYPE_DODECAROTOR,
    mavlink.MAV_TYPE_DECAROTOR,
}


def unfit(heartbeat: mavlink.MAVLink_heartbeat_message) -> str:
    """Return why the search cannot fly what sent this HEARTBEAT; empty if it can."""
    wanted = "; wanted an ArduCopter or a PX4 multirotor"
    if heartbeat.autopilot not in FIRMWARES:
        return f"autopilot {_name('MAV_AUTOPILOT', heartbeat.autopilot)} is not supported{wanted}"
    if heartbeat.type not in COPTERS:
        return f"vehicle type {_name('MAV_TYPE', heartbeat.type)} cannot hover{wanted}"
    return ""


def stands(landed: int, status: int) -> bool:
    """Return whether a vehicle is on the ground.

    landed: its MAV_LANDED_STATE, which counts if it is told; status: its MAV_STATE.
    """
    if landed != mavlink.MAV_LANDED_STATE_UNDEFINED:
        return bool(landed == mavlink.MAV_LANDED_STATE_ON_GROUND)
    return status in (mavlink.MAV_STATE_STANDBY, mavlink.MAV_STATE_BOOT, mavlink.MAV_STATE_UNINIT)


def _name(enum: str, number: int) -> str:
    entry = mavlink.enums[enum].get(number)
    return f"{entry.name.removeprefix(enum + '_')} ({number})" if entry else str(number)
