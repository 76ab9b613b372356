"""What the autopilot's parameters say of a flight: its failsafes and its fence.

They are read, never changed.
"""

import enum
import math
from collections.abc import Mapping
from typing import NamedTuple

from aircraft.firmware import Firmware

# The parameters by which a multirotor's EKF estimates the wind in flight, from its drag; it does if any of
# them is set.
DRAG_PARAMETERS = {
    "ArduCopter": ("EK3_DRAG_BCOEF_X", "EK3_DRAG_BCOEF_Y", "EK3_DRAG_MCOEF"),
    "PX4": ("EKF2_DRAG_CTRL",),
}
# The parameters to read. ArduPilot 4.7 calls SYSID_MYGCS MAV_GCS_SYSID, and up to MAV_GCS_SYSID_HI all are
# ground stations.
ASKED = {
    "ArduCopter": (
        "FS_GCS_ENABLE",
        "SYSID_MYGCS|MAV_GCS_SYSID",
        "SYSID_MYGCS|MAV_GCS_SYSID_HI",
        "FS_GCS_TIMEOUT",
        "BATT_FS_LOW_ACT",
        "FENCE_ENABLE",
        "FENCE_TYPE",
        "FENCE_RADIUS",
        "FENCE_ALT_MAX",
        *DRAG_PARAMETERS["ArduCopter"],
    ),
    "PX4": (
        "COM_OF_LOSS_T",
        "COM_OBL_RC_ACT",
        "NAV_DLL_ACT",
        "COM_RCL_EXCEPT",
        "COM_LOW_BAT_ACT",
        "GF_ACTION",
        "GF_MAX_HOR_DIST",
        "GF_MAX_VER_DIST",
        *DRAG_PARAMETERS["PX4"],
    ),
}
# What COM_OBL_RC_ACT chooses. A mode that a pilot flies becomes RETURN without one.
OFFBOARD_LOSS = (
    "POSITION, without a pilot to RETURN",
    "ALTITUDE, without a pilot to RETURN",
    "STABILIZED, without a pilot to RETURN",
    "RETURN",
    "LAND",
    "HOLD",
    "TERMINATE",
    "DISARM",
)
OFFBOARD_EXCEPTED = 4  # bit of COM_RCL_EXCEPT
# What each parameter chooses; 0 is nothing.
LOW_BATTERY_ACTIONS = {
    "BATT_FS_LOW_ACT": {
        1: "LAND",
        2: "RTL",
        3: "SMART_RTL, else RTL",
        4: "SMART_RTL, else LAND",
        5: "TERMINATE",
        6: "AUTO to its landing, else RTL",
        7: "BRAKE, else LAND",
    },
    "COM_LOW_BAT_ACT": {1: "RETURN", 2: "LAND", 3: "RETURN, and LAND when it is nearly empty"},
}
FENCE_ALTITUDE, FENCE_CIRCLE = 1, 2  # bits of FENCE_TYPE


class Verdict(enum.Enum):
    """What a line of the list says. `FORBIDS`: there is no flight until it is mended."""

    OK = "ok"
    WARNS = "warning"
    FORBIDS = "not ok"


class Check(NamedTuple):
    """One line of the list."""

    about: str
    verdict: Verdict
    text: str

    def __str__(self) -> str:
        """Return the line."""
        return f"Check: {self.about}: {self.verdict.value}, {self.text}"


def checks(
    firmware: Firmware, parameters: Mapping[str, float], system: int, farthest_m: float, height_m: float
) -> list[Check]:
    """Return what the parameters say of a flight up to so far from home, at this height.

    system: the companion's.
    """
    lost = (
        [_if_killed_arducopter(parameters, system)] if firmware.is_ardupilot else _if_killed_px4(parameters)
    )
    return [*lost, _low_battery(firmware, parameters), *_fence(firmware, parameters, farthest_m, height_m)]


def _if_killed_arducopter(parameters: Mapping[str, float], system: int) -> Check:
    enabled = parameters.get("FS_GCS_ENABLE")
    station = parameters.get("SYSID_MYGCS", parameters.get("MAV_GCS_SYSID", 255.0))
    last = max(station, parameters.get("MAV_GCS_SYSID_HI", 0.0))
    verdict = Verdict.WARNS
    if enabled is None:
        text = "not known: FS_GCS_ENABLE could not be read"
    elif enabled == 0:
        text = "FS_GCS_ENABLE is 0: in flight the vehicle hovers until its battery is low"
    elif not int(station) <= system <= int(last):
        who = f"system {station:.0f}, not this program, {system}"
        text = f"FS_GCS watches {who}: in flight the vehicle hovers"
    else:
        after_s, verdict = parameters.get("FS_GCS_TIMEOUT", 5.0), Verdict.OK
        text = f"FS_GCS acts after {after_s:g} s (FS_GCS_ENABLE {enabled:.0f})"
    return Check("if this computer fails", verdict, text)


def _if_killed_px4(parameters: Mapping[str, float]) -> list[Check]:
    about, action = "if this computer fails", parameters.get("COM_OBL_RC_ACT")
    if action is None:
        said = [Check(about, Verdict.WARNS, "not known: COM_OBL_RC_ACT could not be read")]
    else:
        mode = dict(enumerate(OFFBOARD_LOSS)).get(int(action), f"{action:.0f}")
        after_s = parameters.get("COM_OF_LOSS_T", math.nan)
        said = [Check(about, Verdict.OK, f"PX4 changes to {mode} after {after_s:g} s (COM_OBL_RC_ACT)")]
    if parameters.get("NAV_DLL_ACT", 0.0) > 0:
        said.append(
            Check("ground station", Verdict.WARNS, "NAV_DLL_ACT is above 0: PX4 does not arm without one")
        )
    if not int(parameters.get("COM_RCL_EXCEPT", OFFBOARD_EXCEPTED)) & OFFBOARD_EXCEPTED:
        said.append(
            Check("radio", Verdict.OK, "the loss of one that was there ends OFFBOARD: COM_RCL_EXCEPT lacks 4")
        )
    return said


def _low_battery(firmware: Firmware, parameters: Mapping[str, float]) -> Check:
    name = "BATT_FS_LOW_ACT" if firmware.is_ardupilot else "COM_LOW_BAT_ACT"
    action, verdict = parameters.get(name), Verdict.WARNS
    if action is None:
        text = f"not known: {name} could not be read"
    elif action == 0:
        text = f"{name} is 0: the autopilot only warns, and this program alone returns home"
    else:
        mode, verdict = LOW_BATTERY_ACTIONS[name].get(int(action), "a mode of its own"), Verdict.OK
        text = f"the autopilot changes to {mode} ({name})"
    return Check("on low battery", verdict, text)


def _fence(
    firmware: Firmware, parameters: Mapping[str, float], farthest_m: float, height_m: float
) -> list[Check]:
    """Return a line if there is a fence around home; a polygon is not read."""
    if firmware.is_ardupilot:
        kinds = int(parameters.get("FENCE_TYPE", 0.0)) if parameters.get("FENCE_ENABLE") else 0
        names = [
            name
            for bit, name in ((FENCE_CIRCLE, "FENCE_RADIUS"), (FENCE_ALTITUDE, "FENCE_ALT_MAX"))
            if kinds & bit
        ]
    else:
        names = ["GF_MAX_HOR_DIST", "GF_MAX_VER_DIST"] if parameters.get("GF_ACTION") else []
    limits = {name: limit for name in names if (limit := parameters.get(name, 0.0)) > 0.0}
    needs = dict.fromkeys(("FENCE_RADIUS", "GF_MAX_HOR_DIST"), farthest_m)
    tight = [name for name, limit in limits.items() if limit < needs.get(name, height_m)]
    text = ", ".join(
        f"{name} is {limit:g} m" + f", the search needs {needs.get(name, height_m):.0f} m" * (name in tight)
        for name, limit in limits.items()
    )
    return [Check("fence", Verdict.WARNS if tight else Verdict.OK, text)] if limits else []
