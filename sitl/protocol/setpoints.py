"""The service of setpoints: SET_POSITION_TARGET_LOCAL_NED (84) and SET_POSITION_TARGET_GLOBAL_INT (86),
read as PX4 1.15 does.

They are never acknowledged. A refused one is reported by STATUSTEXT, an ignored one is not.
"""

import math

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import Ned, Result, denied
from link.bus.mavlink import Message
from plume.geodesy import to_local
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.plan import snapped
from sitl.autopilot.setpoint import Setpoint
from sitl.autopilot.vehicle import Vehicle

LOCAL, GLOBAL = "SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT"
POSITION, VELOCITY, ACCELERATION = 0, 3, 6
"""The first bit of three in the type mask; a bit that is set means: ignore."""
FRAMES = {
    LOCAL: {mavlink.MAV_FRAME_LOCAL_NED: "LOCAL_NED", mavlink.MAV_FRAME_BODY_NED: "BODY_NED"},
    GLOBAL: {
        mavlink.MAV_FRAME_GLOBAL_INT: "GLOBAL_INT",
        mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: "GLOBAL_RELATIVE_ALT_INT",
        mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT: "GLOBAL_TERRAIN_ALT_INT",
    },
}
SAYS = {
    LOCAL: "flown in OFFBOARD: a position, a velocity, a horizontal velocity at a height, or an "
    "acceleration, in LOCAL_NED or BODY_NED",
    GLOBAL: "the same with a global position, its altitude above the sea, above home or above the ground, "
    "which is level",
}
"""What becomes of each message, for the documentation."""

ALL = 0b111
"""The bits of x, y and z, from the first on."""
NOT_WHOLE = denied(
    "Setpoint refused: wanted a position, a velocity, a velocity x, y with a position z, or an acceleration, "
    "each whole",
    "not whole",
)

Parts = tuple[float | None, float | None, float | None]
"""North, east, down; None is ignored."""


def take(vehicle: Vehicle, message: Message, t_s: float) -> Result:
    """Hand a setpoint to the vehicle; returns why not if it is refused."""
    setpoint = read(message, vehicle.config, vehicle.state(t_s).yaw)
    if isinstance(setpoint, Result):
        return setpoint
    return vehicle.setpoint(t_s, setpoint)


def read(m: Message, config: VehicleConfig, yaw_rad: float) -> Setpoint | Result:
    """Return the setpoint of a message, or why it is refused. Vectors in BODY_NED are turned by the
    vehicle's yaw.
    """
    frames = FRAMES[m.get_type()]
    if m.coordinate_frame not in frames:
        allowed = " or ".join(f"{name} ({number})" for number, name in frames.items())
        return denied(f"Setpoint refused: frame {m.coordinate_frame} is not {allowed}", "frame")
    position = _position(m, config)
    velocity, acceleration = (
        _parts(m, VELOCITY, (m.vx, m.vy, m.vz)),
        _parts(m, ACCELERATION, (m.afx, m.afy, m.afz)),
    )
    if m.type_mask & mavlink.POSITION_TARGET_TYPEMASK_FORCE_SET and acceleration != (None,) * 3:
        return denied("Setpoint refused: a force is not flown, only an acceleration", "force")
    if m.get_type() == LOCAL and m.coordinate_frame == mavlink.MAV_FRAME_BODY_NED:
        position, velocity, acceleration = (
            (None,) * 3,
            _turned(velocity, yaw_rad),
            _turned(acceleration, yaw_rad),
        )
    yaw = None if m.type_mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE or math.isnan(m.yaw) else m.yaw
    rate = (
        None
        if m.type_mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE or math.isnan(m.yaw_rate)
        else m.yaw_rate
    )
    halves = [
        north for north, east, _ in (position, velocity, acceleration) if (north is None) != (east is None)
    ]
    if halves:
        return _not_whole(m, config)
    if whole := _whole(position):
        return Setpoint(whole, yaw_rad=yaw, yaw_rate_radps=rate)
    if position[:2] == (None, None):
        down = position[2]
        if down is None and (whole := _whole(velocity)):
            return Setpoint(velocity=whole, yaw_rad=yaw, yaw_rate_radps=rate)
        if down is not None and velocity[0] is not None and velocity[1] is not None:
            return Setpoint(
                velocity=(velocity[0], velocity[1], 0.0), down_m=down, yaw_rad=yaw, yaw_rate_radps=rate
            )
        if down is None and velocity == (None,) * 3 and (whole := _whole(acceleration)):
            return Setpoint(acceleration=whole, yaw_rad=yaw, yaw_rate_radps=rate)
    return _not_whole(m, config)


def _not_whole(m: Message, config: VehicleConfig) -> Result:
    """Refuse a setpoint that PX4 does not take, or that is not flown here; a NaN may be why."""
    place = (m.x, m.y, m.z) if m.get_type() == LOCAL else (m.lat_int, m.lon_int, m.alt)
    if not m.type_mask & ALL and any(map(math.isnan, place)):
        return Setpoint((place[0], place[1], place[2])).refusal(config) or NOT_WHOLE
    return NOT_WHOLE


def _parts(m: Message, first_bit: int, values: tuple[float, float, float]) -> Parts:
    """The values that are not ignored: neither by the type mask nor, as in PX4, by being NaN."""
    x, y, z = (
        None if m.type_mask >> (first_bit + n) & 1 or math.isnan(value) else value
        for n, value in enumerate(values)
    )
    return x, y, z


def _position(m: Message, config: VehicleConfig) -> Parts:
    if m.get_type() == LOCAL:
        return _parts(m, POSITION, (m.x, m.y, m.z))
    north, east = on_edge(
        to_local(config.home_lat_deg, config.home_lon_deg, m.lat_int / 1e7, m.lon_int / 1e7), config
    )
    above_sea = m.coordinate_frame == mavlink.MAV_FRAME_GLOBAL_INT
    given = _parts(m, POSITION, (north, east, (config.home_alt_m if above_sea else 0.0) - m.alt))
    return (
        given if None not in given else (None, None, None)
    )  # PX4 takes a global position whole, or not at all


def on_edge(place: tuple[float, float], config: VehicleConfig) -> tuple[float, float]:
    """Return (north, east) m from a latitude and a longitude; next to the area's edge it counts as on it.

    Home lies on the edge, and steps of 1e-7 degrees cannot hit that exactly.
    """
    north, east = (snapped(along_m, config.area_m) for along_m in place)
    return north, east


def _turned(parts: Parts, yaw_rad: float) -> Parts:
    """A vector in the body's axes, forward, right, down, as NED. As in PX4, one of which a part is ignored
    is ignored.
    """
    whole = _whole(parts)
    if whole is None:
        return (None,) * 3
    (forward, right, down), cos, sin = whole, math.cos(yaw_rad), math.sin(yaw_rad)
    return forward * cos - right * sin, forward * sin + right * cos, down


def _whole(parts: Parts) -> Ned | None:
    x, y, z = parts
    return None if x is None or y is None or z is None else (x, y, z)
