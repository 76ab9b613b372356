"""Which failsafe of the autopilot acts if this program is killed, as its parameters say. They are read, never changed."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from sitl.remote.firmware import Firmware
from sitl.remote.winds import ESTIMATES

ASKED = {
    "ArduCopter": ("FS_GCS_ENABLE", "SYSID_MYGCS|MAV_GCS_SYSID", "FS_GCS_TIMEOUT", *ESTIMATES["ArduCopter"]),
    "PX4": ("COM_OF_LOSS_T", "COM_OBL_RC_ACT", "NAV_DLL_ACT", "COM_RCL_EXCEPT", *ESTIMATES["PX4"]),
}
"""The parameters to read. One has another name in newer versions: either of them answers."""
OFFBOARD_LOSS = {0: "POSITION", 1: "ALTITUDE", 2: "STABILIZED", 3: "RETURN", 4: "LAND", 5: "HOLD", 6: "TERMINATE", 7: "DISARM"}
BY_HAND = {0, 1, 2}
"""What COM_OBL_RC_ACT chooses that a pilot flies: without one PX4 goes on to RETURN."""
OFFBOARD_EXCEPTED = 4


class Advice(NamedTuple):
    """A line for people."""

    warns: bool
    text: str


def advice(firmware: Firmware, parameters: Mapping[str, float], system: int) -> list[Advice]:
    """Return what happens if this program, a companion of a system, is killed in flight."""
    if firmware.is_ardupilot:
        return [_arducopter(parameters, system)]
    return _px4(parameters)


def _arducopter(parameters: Mapping[str, float], system: int) -> Advice:
    enabled = parameters.get("FS_GCS_ENABLE")
    station = parameters.get("SYSID_MYGCS", parameters.get("MAV_GCS_SYSID", 255.0))
    if enabled is None:
        return Advice(True, "FS_GCS_ENABLE could not be read: it is not known whether the vehicle returns if this program is killed")
    if enabled == 0:
        return Advice(True, "FS_GCS_ENABLE is 0: if this program is killed in flight, the vehicle hovers until its battery is low")
    if int(station) != system:
        return Advice(
            True, f"FS_GCS watches system {station:.0f}, not this program, {system}: if only that is killed in flight, the vehicle hovers"
        )
    after_s = parameters.get("FS_GCS_TIMEOUT", 5.0)
    return Advice(False, f"If this program is killed, FS_GCS acts after {after_s:g} s (FS_GCS_ENABLE {enabled:.0f})")


def _px4(parameters: Mapping[str, float]) -> list[Advice]:
    action, after_s = parameters.get("COM_OBL_RC_ACT"), parameters.get("COM_OF_LOSS_T", math.nan)
    if action is None:
        said = [Advice(True, "COM_OBL_RC_ACT could not be read: it is not known what the vehicle does if this program is killed")]
    else:
        mode = OFFBOARD_LOSS.get(int(action), f"{action:.0f}")
        else_return = ", without a pilot to RETURN" if int(action) in BY_HAND else ""
        said = [Advice(False, f"If this program is killed, PX4 changes to {mode}{else_return} after {after_s:g} s (COM_OBL_RC_ACT)")]
    if parameters.get("NAV_DLL_ACT", 0.0) > 0:
        said.append(Advice(True, "NAV_DLL_ACT is above 0: PX4 does not arm without a ground station"))
    if not int(parameters.get("COM_RCL_EXCEPT", OFFBOARD_EXCEPTED)) & OFFBOARD_EXCEPTED:
        said.append(Advice(False, "COM_RCL_EXCEPT lacks 4: the loss of a radio that was there ends OFFBOARD"))
    return said
