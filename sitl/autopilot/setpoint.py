"""Setpoints, read as PX4 1.15 does: SET_POSITION_TARGET_LOCAL_NED (84) and _GLOBAL_INT (86).

They are never acknowledged. A refused one is reported by STATUSTEXT, an ignored one is not.
"""

import math
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import Ned, Result, denied, metres
from link.bus.mavlink import Message
from sitl.autopilot.config import VehicleConfig

LOCAL, GLOBAL = "SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT"
SETPOINT_FRAMES = {
    LOCAL: {mavlink.MAV_FRAME_LOCAL_NED: "LOCAL_NED", mavlink.MAV_FRAME_BODY_NED: "BODY_NED"},
    GLOBAL: {
        mavlink.MAV_FRAME_GLOBAL_INT: "GLOBAL_INT",
        mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: "GLOBAL_RELATIVE_ALT_INT",
        mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT: "GLOBAL_TERRAIN_ALT_INT",
    },
}
NOT_WHOLE = denied(
    "Setpoint refused: wanted a position, a velocity, a velocity x, y with a position z, or an acceleration, "
    "each whole",
    "not whole",
)

Parts = tuple[float | None, float | None, float | None]  # north, east, down; None is ignored
NONE: Parts = (None, None, None)


class Setpoint(NamedTuple):
    """What the vehicle shall do: a position, a velocity, a velocity at a height, or an acceleration.

    Vectors are NED, positions in m from home. Of several the first is flown. With neither a yaw nor a yaw
    rate the heading stays.
    """

    position: Ned | None = None
    velocity: Ned | None = None  # m/s, cut to the speed limits; its horizontal part keeps its direction
    down_m: float | None = None  # the height to fly to, with a velocity whose own down is then ignored
    acceleration: Ned | None = None  # m/s², cut to the limit; it acts until a speed limit is reached
    yaw_rad: float | None = None
    yaw_rate_radps: float | None = None  # without a yaw: turn on at this rate, cut to the limit

    def same_way(self, other: "Setpoint | None") -> bool:
        """True if both ask for the same motion; the yaw may differ."""
        return other is not None and self[:4] == other[:4]

    def refusal(self, config: VehicleConfig, here: Ned) -> Result | None:
        """Return why it cannot be flown from a position, if so."""
        for name, angle in (("yaw", self.yaw_rad), ("yaw rate", self.yaw_rate_radps)):
            if angle is not None and not math.isfinite(angle):
                return denied(f"Waypoint refused: {name} {angle} is not finite", "not finite")
        if self.position is not None:
            outside = config.outside(self.position) or config.in_the_way(here, self.position)
            return outside and denied(f"Waypoint refused: {outside[1]}", outside[0])
        for name, vector in (("velocity", self.velocity), ("acceleration", self.acceleration)):
            if vector is not None and not all(map(math.isfinite, vector)):
                return denied(
                    f"Setpoint refused: {name} ({', '.join(map(metres, vector))}) is not finite",
                    "not finite",
                )
        if self.down_m is not None and not 0.0 <= -self.down_m <= config.ceiling_m:
            return denied(
                f"Setpoint refused: altitude {metres(-self.down_m)} m is outside [0, {config.ceiling_m:g}] m",
                "outside the altitudes",
            )
        return None


def read(m: Message, config: VehicleConfig, yaw_rad: float) -> Setpoint | Result:
    """Return the setpoint of a message, or why it is refused.

    yaw_rad: the vehicle's yaw, by which vectors in BODY_NED are turned.
    """
    frames = SETPOINT_FRAMES[m.get_type()]
    if m.coordinate_frame not in frames:
        allowed = " or ".join(f"{name} ({number})" for number, name in frames.items())
        return denied(f"Setpoint refused: frame {m.coordinate_frame} is not {allowed}", "frame")
    position, velocity = _position(m, config), _given(m, 3, (m.vx, m.vy, m.vz))
    acceleration = _given(m, 6, (m.afx, m.afy, m.afz))
    if m.type_mask & mavlink.POSITION_TARGET_TYPEMASK_FORCE_SET and acceleration != NONE:
        return denied("Setpoint refused: a force is not flown, only an acceleration", "force")
    if m.get_type() == LOCAL and m.coordinate_frame == mavlink.MAV_FRAME_BODY_NED:
        position, velocity, acceleration = NONE, _turned(velocity, yaw_rad), _turned(acceleration, yaw_rad)
    yaw, rate, _ = _given(m, 10, (m.yaw, m.yaw_rate, math.nan))
    wanted = Setpoint(yaw_rad=yaw, yaw_rate_radps=rate)
    if any((north is None) != (east is None) for north, east, _ in (position, velocity, acceleration)):
        return _not_whole(m, config)
    if place := _whole(position):
        return wanted._replace(position=place)
    if position == NONE and (speed := _whole(velocity)):
        return wanted._replace(velocity=speed)
    if position == velocity == NONE and (push := _whole(acceleration)):
        return wanted._replace(acceleration=push)
    level = _whole((*velocity[:2], 0.0))
    if position[0] is None and position[2] is not None and level:
        return wanted._replace(velocity=level, down_m=position[2])
    return _not_whole(m, config)


def _not_whole(m: Message, config: VehicleConfig) -> Result:
    """Refuse a setpoint that PX4 does not take, or that is not flown here; a NaN may be why."""
    place = (m.x, m.y, m.z) if m.get_type() == LOCAL else (m.lat_int, m.lon_int, m.alt)
    if not m.type_mask & 0b111 and any(map(math.isnan, place)):
        return Setpoint(place).refusal(config, place) or NOT_WHOLE
    return NOT_WHOLE


def _given(m: Message, first_bit: int, values: Ned) -> Parts:
    """The values that neither the type mask, from `first_bit` on, nor, as in PX4, NaN excludes."""
    x, y, z = (
        None if m.type_mask >> (first_bit + n) & 1 or math.isnan(value) else value
        for n, value in enumerate(values)
    )
    return x, y, z


def _position(m: Message, config: VehicleConfig) -> Parts:
    if m.get_type() == LOCAL:
        return _given(m, 0, (m.x, m.y, m.z))
    zero_m = config.home_alt_m if m.coordinate_frame == mavlink.MAV_FRAME_GLOBAL_INT else 0.0
    given = _given(m, 0, (*config.local(m.lat_int / 1e7, m.lon_int / 1e7), zero_m - m.alt))
    return NONE if None in given else given  # PX4 takes a global position whole, or not at all


def _turned(parts: Parts, yaw_rad: float) -> Parts:
    """A vector in the body's axes, forward, right, down, as NED; none unless it is whole, as in PX4."""
    whole = _whole(parts)
    if whole is None:
        return NONE
    (forward, right, down), cos, sin = whole, math.cos(yaw_rad), math.sin(yaw_rad)
    return forward * cos - right * sin, forward * sin + right * cos, down


def _whole(parts: Parts) -> Ned | None:
    x, y, z = parts
    return None if x is None or y is None or z is None else (x, y, z)
