"""Telemetry of where the vehicle is and how it moves, and of the air. Each message is built from one
snapshot.
"""

import math

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import Ned
from link.bus.mavlink import POSITION_ONLY, Message, gas_message, wind_message
from sitl.autopilot.motion import GRAVITY_MPS2
from sitl.autopilot.state import Snapshot

HOVER_THROTTLE = 0.5
VELOCITY_ONLY = POSITION_ONLY & ~0b111000 | 0b111
UNKNOWN_U16 = 0xFFFF


def gps_raw_int(s: Snapshot) -> Message:
    """GPS_RAW_INT (24): a GPS without error; its accuracy is reported as unknown, not as zero."""
    lat, lon = s.lat_lon_e7
    north, east, _ = s.state.velocity
    speed = math.hypot(north, east)
    return mavlink.MAVLink_gps_raw_int_message(
        time_usec=round(s.state.time_s * 1e6),
        fix_type=mavlink.GPS_FIX_TYPE_3D_FIX,
        lat=lat,
        lon=lon,
        alt=round(s.altitude_m * 1000.0),
        eph=UNKNOWN_U16,
        epv=UNKNOWN_U16,
        vel=round(speed * 100.0),
        cog=_centidegrees(math.atan2(east, north)) if speed > 0.0 else UNKNOWN_U16,
        satellites_visible=10,
    )


def global_position_int(s: Snapshot) -> Message:
    """GLOBAL_POSITION_INT (33): latitude, longitude, altitude, velocity and heading."""
    lat, lon = s.lat_lon_e7
    north, east, down = (round(speed * 100.0) for speed in s.state.velocity)
    altitude, above_home = round(s.altitude_m * 1000.0), round(-s.state.position[2] * 1000.0)
    heading = _centidegrees(s.state.yaw)
    return mavlink.MAVLink_global_position_int_message(
        s.time_boot_ms, lat, lon, altitude, above_home, north, east, down, heading
    )


def local_position_ned(s: Snapshot) -> Message:
    """LOCAL_POSITION_NED (32): position and velocity from home; a reading is taken at exactly these
    float32 values.
    """
    values = np.array(s.state.position + s.state.velocity, np.float32).tolist()
    return mavlink.MAVLink_local_position_ned_message(s.time_boot_ms, *values)


def attitude(s: Snapshot) -> Message:
    """ATTITUDE (30): roll and pitch from the thrust direction, yaw, and the yaw rate; roll and pitch rates
    are not simulated (0).
    """
    state = s.state
    return mavlink.MAVLink_attitude_message(
        s.time_boot_ms, state.roll, state.pitch, state.yaw, 0.0, 0.0, state.yaw_rate
    )


def vfr_hud(s: Snapshot) -> Message:
    """VFR_HUD (74): airspeed, ground speed, heading, throttle, altitude and climb rate."""
    north, east, down = s.state.velocity
    a_north, a_east, a_down = s.state.acceleration
    throttle = (
        HOVER_THROTTLE * math.hypot(a_north, a_east, GRAVITY_MPS2 - a_down) / GRAVITY_MPS2
        if s.state.armed
        else 0.0
    )
    return mavlink.MAVLink_vfr_hud_message(
        airspeed=math.hypot(north + s.wind[1], east + s.wind[0], down),  # the air moves with −wind
        groundspeed=math.hypot(north, east),
        heading=round(math.degrees(s.state.yaw)) % 360,
        throttle=min(round(throttle * 100.0), 100),
        alt=s.altitude_m,
        climb=-down,
    )


def wind_cov(s: Snapshot) -> Message:
    """WIND_COV (231): the air's velocity, NED, m/s."""
    return wind_message(s.time_boot_ms, s.wind)


def named_value_float_gas(s: Snapshot) -> Message | None:
    """NAMED_VALUE_FLOAT (251) `gas`: the last reading with the time it was taken; None before the first."""
    return None if s.gas is None else gas_message(*s.gas)


# ---- more than PX4's clients need: on request ----


def attitude_quaternion(s: Snapshot) -> Message:
    """ATTITUDE_QUATERNION (31): the attitude as (w, x, y, z); roll and pitch rates are not simulated (0)."""
    return mavlink.MAVLink_attitude_quaternion_message(
        s.time_boot_ms, *quaternion(s), 0.0, 0.0, s.state.yaw_rate, [0.0] * 4
    )


def odometry(s: Snapshot) -> Message:
    """ODOMETRY (331): position from home, NED; velocity in the body's axes, forward, right, down.
    Accuracy: unknown.
    """
    unknown = [math.nan] + [0.0] * 20
    return mavlink.MAVLink_odometry_message(
        round(s.state.time_s * 1e6),
        mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_BODY_FRD,
        *s.state.position,
        list(quaternion(s)),
        *in_body(s, s.state.velocity),
        0.0,
        0.0,
        s.state.yaw_rate,
        unknown,
        unknown,
        estimator_type=mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT,
    )


IMU_FIELDS = (
    mavlink.HIGHRES_IMU_UPDATED_XACC
    | mavlink.HIGHRES_IMU_UPDATED_YACC
    | mavlink.HIGHRES_IMU_UPDATED_ZACC
    | mavlink.HIGHRES_IMU_UPDATED_ZGYRO
)


def highres_imu(s: Snapshot) -> Message:
    """HIGHRES_IMU (105): what an accelerometer feels and the yaw rate. Nothing else is simulated, nor
    marked as updated.
    """
    north, east, down = s.state.acceleration
    felt = in_body(s, (north, east, down - GRAVITY_MPS2))
    nothing = [0.0] * 7
    return mavlink.MAVLink_highres_imu_message(
        round(s.state.time_s * 1e6), *felt, 0.0, 0.0, s.state.yaw_rate, *nothing, IMU_FIELDS
    )


def altitude(s: Snapshot) -> Message:
    """ALTITUDE (141): above sea and above home, m. There is no terrain: the ground is level, at home's
    altitude.
    """
    height = -s.state.position[2]
    sea = s.altitude_m
    return mavlink.MAVLink_altitude_message(
        round(s.state.time_s * 1e6), sea, sea, height, height, math.nan, math.nan
    )


def position_target_local_ned(s: Snapshot) -> Message | None:
    """POSITION_TARGET_LOCAL_NED (85): where the current leg ends, or the velocity that is asked for; None
    while disarmed.
    """
    if not s.state.armed:
        return None
    mask, values = POSITION_ONLY, [*s.state.target, *[0.0] * 8]
    if s.state.cruise is not None:
        mask, values = VELOCITY_ONLY, [0.0, 0.0, 0.0, *s.state.cruise, *[0.0] * 5]
    return mavlink.MAVLink_position_target_local_ned_message(
        s.time_boot_ms, mavlink.MAV_FRAME_LOCAL_NED, mask, *values
    )


KNOWN = (
    mavlink.ESTIMATOR_ATTITUDE
    | mavlink.ESTIMATOR_VELOCITY_HORIZ
    | mavlink.ESTIMATOR_VELOCITY_VERT
    | mavlink.ESTIMATOR_POS_HORIZ_REL
    | mavlink.ESTIMATOR_POS_HORIZ_ABS
    | mavlink.ESTIMATOR_POS_VERT_ABS
    | mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
    | mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS
)


def estimator_status(s: Snapshot) -> Message:
    """ESTIMATOR_STATUS (230): the position is known and without error, so no test of an innovation comes
    near its limit.
    """
    return mavlink.MAVLink_estimator_status_message(round(s.state.time_s * 1e6), KNOWN, *[0.0] * 8)


def quaternion(s: Snapshot) -> tuple[float, float, float, float]:
    """(w, x, y, z) of the attitude: yaw, then pitch, then roll."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (math.cos(a / 2.0), math.sin(a / 2.0)) for a in (s.state.roll, s.state.pitch, s.state.yaw)
    )
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def in_body(s: Snapshot, vector: Ned) -> Ned:
    """A vector (NED) in the body's axes: forward, right, down."""
    north, east, down = vector
    cy, sy = math.cos(s.state.yaw), math.sin(s.state.yaw)
    ahead, right = north * cy + east * sy, east * cy - north * sy
    cp, sp = math.cos(s.state.pitch), math.sin(s.state.pitch)
    forward, below = ahead * cp - down * sp, ahead * sp + down * cp
    cr, sr = math.cos(s.state.roll), math.sin(s.state.roll)
    return forward, right * cr + below * sr, below * cr - right * sr


def _centidegrees(angle_rad: float) -> int:
    return round(math.degrees(angle_rad) * 100.0) % 36_000
