"""MAVLink messages of an operator at a ground station; a mission script's operator events send them."""

from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import POSITION_ONLY, Message
from sitl.autopilot.motion import Ned
from sitl.autopilot.state import Mode

OPERATOR = (255, mavlink.MAV_COMP_ID_MISSIONPLANNER)
"""System id and component id of a ground station."""


def command(number: int, *params: float) -> Message:
    """COMMAND_LONG (76) to all systems; parameters not given are 0."""
    return mavlink.MAVLink_command_long_message(0, 0, number, 0, *params, *[0.0] * (7 - len(params)))


def change_mode(mode: Mode) -> Message:
    """COMMAND_LONG (76) with MAV_CMD_DO_SET_MODE (176) and PX4's mode numbers."""
    return command(mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, *mode.value)


def setpoint(position: Ned) -> Message:
    """SET_POSITION_TARGET_LOCAL_NED (84) to a position (NED, m from home), with `time_boot_ms` 0: it answers no reading."""
    return mavlink.MAVLink_set_position_target_local_ned_message(0, 0, 0, mavlink.MAV_FRAME_LOCAL_NED, POSITION_ONLY, *position, *[0.0] * 8)
