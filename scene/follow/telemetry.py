"""The vehicle's telemetry as what there is to see: where it is, in which mode, and what it says."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import LAYOUTS, Frame, fields_of
from link.bus.mavlink import split
from scene.scene import ERROR, INFO, WARNING, Craft, Place

HEARTBEAT, ATTITUDE, LOCAL, GLOBAL, TEXT, SETPOINT = 0, 30, 32, 33, 253, 84
SHOWN = {HEARTBEAT, ATTITUDE, LOCAL, GLOBAL, TEXT}
PX4_MODES = {
    (1, 0): "MANUAL", (2, 0): "ALTITUDE", (3, 0): "POSITION", (4, 2): "TAKEOFF", (4, 3): "HOLD", (4, 4): "MISSION", (4, 5): "RETURN",
    (4, 6): "LAND", (6, 0): "OFFBOARD",
}  # fmt: skip
"""Names of PX4's flight modes by (main, sub) mode."""
CHUNK = 50
"""Characters of one STATUSTEXT; longer texts come in chunks."""


def frames(payload: bytes, wanted: set[int], counts: Callable[[Frame], bool] = lambda _: True) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield (message id, fields) of the wanted frames that count. Raises BadFrame if the payload is not made of whole, valid frames."""
    for frame in split(payload):
        if frame.message_id in wanted and counts(frame):
            yield frame.message_id, fields_of(payload, frame, LAYOUTS[frame.message_id])


def mode_name(custom_mode: int) -> str:
    """Return the name of a mode in PX4's numbers, as HEARTBEAT carries them."""
    numbers = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    return PX4_MODES.get(numbers, f"mode {numbers[0]}.{numbers[1]}")


def seen(craft: Craft, message_id: int, fields: dict[str, Any], time_s: float) -> Craft:
    """Return the vehicle after one of its messages; values that are not finite are not taken."""
    match message_id:
        case 0:  # HEARTBEAT
            armed = bool(fields["base_mode"] & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            return replace(craft, mode=mode_name(fields["custom_mode"]), armed=armed)
        case 30 if math.isfinite(fields["yaw"]):  # ATTITUDE: yaw is clockwise from north
            heading = math.remainder(math.pi / 2 - fields["yaw"], 2 * math.pi)
            # Not `replace`, which takes ten times as long: these two are nearly all of the telemetry.
            return Craft(time_s, craft.position, craft.altitude_m, heading, craft.mode, craft.armed, craft.fix)
        case 32 if all(map(math.isfinite, (fields["x"], fields["y"], fields["z"]))):  # LOCAL_POSITION_NED
            return Craft(time_s, (fields["y"], fields["x"]), -fields["z"], craft.heading, craft.mode, craft.armed, craft.fix)
        case 33:  # GLOBAL_POSITION_INT
            return replace(craft, fix=(fields["lat"] / 1e7, fields["lon"] / 1e7, fields["alt"] / 1e3))
    return craft


def waypoint(fields: dict[str, Any]) -> Place | None:
    """Return where a SET_POSITION_TARGET_LOCAL_NED leads; None if it has no position from home."""
    ignored = mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE
    place = fields["y"], fields["x"]
    home = fields["coordinate_frame"] == mavlink.MAV_FRAME_LOCAL_NED and not fields["type_mask"] & ignored
    return place if home and all(map(math.isfinite, place)) else None


class Texts:
    """Joins the chunks of STATUSTEXTs."""

    def __init__(self) -> None:
        """Start without any."""
        self._begun: dict[int, str] = {}

    def said(self, fields: dict[str, Any]) -> tuple[str, str] | None:
        """Take a STATUSTEXT; returns (level, text) once the text is whole."""
        number, text = fields["id"], fields["text"]
        if number:
            text = (self._begun.pop(number, "") if fields["chunk_seq"] else "") + text
            if len(fields["text"]) == CHUNK and fields["chunk_seq"] < 255 and len(text) < 256 * CHUNK:
                self._begun = {number: text}  # one text at a time: what is cut off is dropped
                return None
        severity = fields["severity"]
        level = ERROR if severity <= mavlink.MAV_SEVERITY_ERROR else WARNING if severity == mavlink.MAV_SEVERITY_WARNING else INFO
        return level, "".join(letter if letter.isprintable() else "?" for letter in text)
