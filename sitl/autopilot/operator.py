"""MAVLink messages of an operator at a ground station; a mission script's operator events send them."""

from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Message
from sitl.autopilot.state import Mode

OPERATOR = (255, mavlink.MAV_COMP_ID_MISSIONPLANNER)
"""System id and component id of a ground station."""


def command(system: int, number: int, *params: float) -> Message:
    """COMMAND_LONG (76) to the autopilot of a system; parameters not given are 0."""
    return mavlink.MAVLink_command_long_message(system, mavlink.MAV_COMP_ID_AUTOPILOT1, number, 0, *params, *[0.0] * (7 - len(params)))


def change_mode(system: int, mode: Mode) -> Message:
    """COMMAND_LONG (76) with MAV_CMD_DO_SET_MODE (176) and PX4's mode numbers."""
    return command(system, mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, *mode.value)
