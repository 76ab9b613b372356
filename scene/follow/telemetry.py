"""The vehicle's telemetry as what there is to see: where it is, in which mode, and what it says."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import Frame, fields_of
from link.bus.mavlink import split
from link.modes import mode_name
from scene.follow.area import PLACING, AreaFrame
from scene.scene import ERROR, INFO, WARNING, Condition, Craft, Point

ATTITUDE, LOCAL, GLOBAL, TEXT, SETPOINT = 30, 32, 33, 253, 84
RADIO = 109  # RADIO_STATUS, of the radio on the vehicle's link: it goes on where the vehicle is silent
# Messages that tell of the vehicle's condition, see `_condition`.
CONDITION = {1, 24, RADIO, 168, 193, 230, 231}
SHOWN = PLACING | CONDITION | {ATTITUDE, LOCAL, GLOBAL, TEXT}
UNKNOWN_MV, UNKNOWN_SATELLITES, UNKNOWN_SIGNAL = 0xFFFF, 0xFF, 0xFF
# GPS_RAW_INT's fix_type (GPS_FIX_TYPE).
FIXES = (
    "no GPS",
    "no fix",
    "2-D fix",
    "3-D fix",
    "3-D fix, DGPS",
    "RTK float",
    "RTK fixed",
    "static",
    "3-D fix, PPP",
)


def frames(
    payload: bytes, wanted: set[int], counts: Callable[[Frame], bool] = lambda _: True
) -> Iterator[tuple[Frame, dict[str, Any]]]:
    """Yield the wanted frames that count, with their fields.

    Raises BadFrame if the payload is not made of whole, valid frames.
    """
    for frame in split(payload):
        if frame.message_id in wanted and counts(frame):
            yield frame, fields_of(frame)


def seen(was: Craft, message_id: int, fields: dict[str, Any], time_s: float, area: AreaFrame) -> Craft:
    """Return the vehicle after one of its messages; a position or heading that is not finite is not taken."""
    match message_id:
        case 0:  # HEARTBEAT
            armed = bool(fields["base_mode"] & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            return replace(was, mode=mode_name(fields["autopilot"], fields["custom_mode"]), armed=armed)
        # Not `replace`, which takes ten times as long: the next two are nearly all of the telemetry.
        case 30 if math.isfinite(fields["yaw"]):  # ATTITUDE: yaw is clockwise from north
            yaw = math.remainder(math.pi / 2 - fields["yaw"], 2 * math.pi)
            return Craft(
                time_s,
                was.position,
                was.altitude_m,
                yaw,
                was.mode,
                was.armed,
                was.fix,
                was.condition,
                was.speed_mps,
                was.home,
            )
        case 32 if place := area.place(fields):  # LOCAL_POSITION_NED
            return Craft(
                time_s,
                place[:2],
                place[2],
                was.heading,
                was.mode,
                was.armed,
                was.fix,
                was.condition,
                math.hypot(fields["vx"], fields["vy"]),
                area.own_home,
            )
        case 33:  # GLOBAL_POSITION_INT; (0, 0) is sent without a position
            fix = fields["lat"] / 1e7, fields["lon"] / 1e7, fields["alt"] / 1e3
            return replace(was, fix=fix if any(fix[:2]) else None)
    condition = _condition(was.condition, message_id, fields)
    return was if condition == was.condition else replace(was, condition=condition)


def _condition(known: Condition, message_id: int, fields: dict[str, Any]) -> Condition:
    match message_id:
        case 1:  # SYS_STATUS; ArduPilot sends 0 V without a monitor
            percent, millivolts = fields["battery_remaining"], fields["voltage_battery"]
            return replace(
                known,
                battery=percent / 100 if 0 <= percent <= 100 else None,
                volts=None if millivolts in (0, UNKNOWN_MV) else millivolts / 1e3,
                ailing=_ailing(fields),
                lost=min(fields["drop_rate_comm"] / 1e4, 1.0),
            )
        case 24:  # GPS_RAW_INT
            kind, satellites = fields["fix_type"], fields["satellites_visible"]
            words = FIXES[kind] if kind < len(FIXES) else f"fix type {kind}"
            counted = "" if satellites == UNKNOWN_SATELLITES else f", {satellites} satellites"
            return replace(known, gps=words + counted)
        case 109:  # RADIO_STATUS
            ends = [fields[name] for name in ("rssi", "remrssi")]
            here, there = (math.nan if end == UNKNOWN_SIGNAL else float(end) for end in ends)
            return replace(known, radio=None if math.isnan(here) and math.isnan(there) else (here, there))
        case 168:  # WIND, ArduPilot's: whence, degrees clockwise from north; infinity % 360 is NaN
            speed, angle = fields["speed"], math.radians(fields["direction"] % 360)
            return replace(known, wind=_wind(speed * math.sin(angle), speed * math.cos(angle)))
        case 193 | 230:  # ArduPilot's EKF_STATUS_REPORT and ESTIMATOR_STATUS, whose first flags mean the same
            return replace(known, placed=bool(fields["flags"] & mavlink.ESTIMATOR_POS_HORIZ_ABS))
        case 231:  # WIND_COV: where the air goes
            return replace(known, wind=_wind(-fields["wind_y"], -fields["wind_x"]))
    return known


def _ailing(fields: dict[str, Any]) -> tuple[str, ...]:
    """Return the parts that a SYS_STATUS calls present, enabled and not healthy."""
    present, enabled, healthy = (
        fields[f"onboard_control_sensors_{state}"] for state in ("present", "enabled", "health")
    )
    names = mavlink.enums["MAV_SYS_STATUS_SENSOR"]
    bits = [1 << n for n in range(32) if present & enabled & ~healthy & 1 << n]
    return tuple(
        names[bit].name.removeprefix("MAV_SYS_STATUS_").removeprefix("SENSOR_").replace("_", " ").lower()
        for bit in bits
    )


def _wind(x: float, y: float) -> tuple[float, float] | None:
    """Return a wind; one of exactly zero is one that the autopilot has not estimated."""
    return (x, y) if math.isfinite(x) and math.isfinite(y) and (x or y) else None


def waypoint(fields: dict[str, Any]) -> Point | None:
    """Return where a SET_POSITION_TARGET_LOCAL_NED leads; None if it has no position from home."""
    ignored = mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE
    place = fields["y"], fields["x"]
    home = fields["coordinate_frame"] == mavlink.MAV_FRAME_LOCAL_NED and not fields["type_mask"] & ignored
    return place if home and all(map(math.isfinite, place)) else None


def level_of(severity: int) -> str:
    """Return the level of a STATUSTEXT's severity (MAV_SEVERITY)."""
    if severity > mavlink.MAV_SEVERITY_WARNING:
        return INFO
    return WARNING if severity == mavlink.MAV_SEVERITY_WARNING else ERROR
