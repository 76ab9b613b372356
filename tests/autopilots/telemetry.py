"""What an autopilot double says of itself: one function for each message. None means that it has nothing
to say yet.
"""

import math
from typing import TYPE_CHECKING, Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

if TYPE_CHECKING:
    from tests.autopilots.autopilot import Autopilot

Message = Any
LATITUDE_DEG, LONGITUDE_DEG, ALTITUDE_M = 47.3977419, 8.5455938, 488.0
"""Where the EKF's origin lies; altitude above mean sea level."""
METRES_PER_DEG = 111319.49
NAN = math.nan


def amsl_m(down: float) -> float:
    """Altitude above mean sea level of a local `down`."""
    return ALTITUDE_M - down


def degrees_e7(north: float, east: float) -> tuple[int, int]:
    """(latitude, longitude) in 1e-7 degrees of a local place."""
    latitude = LATITUDE_DEG + north / METRES_PER_DEG
    longitude = LONGITUDE_DEG + east / METRES_PER_DEG / math.cos(math.radians(LATITUDE_DEG))
    return round(latitude * 1e7), round(longitude * 1e7)


def heartbeat(ap: "Autopilot") -> Message:
    """HEARTBEAT (0)."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, ap.autopilot, ap.base_mode, ap.custom_mode, ap.system_status, 3
    )


def sys_status(ap: "Autopilot") -> Message:
    """SYS_STATUS (1)."""
    health = mavlink.MAV_SYS_STATUS_PREARM_CHECK if ap.why_not_arm() is None else 0
    present = mavlink.MAV_SYS_STATUS_PREARM_CHECK
    voltage = round(ap.battery_v * 1000)
    return mavlink.MAVLink_sys_status_message(
        present, present, health, 300, voltage, 1500, ap.battery_percent, 0, 0, 0, 0, 0, 0
    )


def gps_raw(ap: "Autopilot") -> Message:
    """GPS_RAW_INT (24)."""
    fixed = ap.gps_good
    latitude, longitude = degrees_e7(*ap.body.position[:2]) if fixed else (0, 0)
    return mavlink.MAVLink_gps_raw_int_message(
        round(ap.now_s * 1e6),
        (6 if ap.is_ardupilot else 3) if fixed else 0 if ap.faults.on("gps") else 1,
        latitude,
        longitude,
        round(amsl_m(ap.body.position[2]) * 1000) if fixed else 0,
        121 if fixed else 9999,
        200 if fixed else 65535,
        0,
        0,
        10 if fixed else 0,
    )


def attitude(ap: "Autopilot") -> Message:
    """ATTITUDE (30)."""
    north, east, _ = ap.body.acceleration
    cos, sin = math.cos(ap.yaw_rad), math.sin(ap.yaw_rad)
    pitch, roll = -math.atan2(north * cos + east * sin, 9.81), math.atan2(east * cos - north * sin, 9.81)
    return mavlink.MAVLink_attitude_message(ap.now_ms, roll, pitch, ap.yaw_rad, 0.0, 0.0, 0.0)


def local_position(ap: "Autopilot") -> Message | None:
    """LOCAL_POSITION_NED (32): from the EKF's origin, not from home."""
    if not ap.origin_set:  # PX4 says zeros, ArduPilot nothing
        return (
            None
            if ap.is_ardupilot
            else mavlink.MAVLink_local_position_ned_message(ap.now_ms, 0, 0, 0, 0, 0, 0)
        )
    return mavlink.MAVLink_local_position_ned_message(ap.now_ms, *ap.reported(), *ap.body.velocity)


def global_position(ap: "Autopilot") -> Message:
    """GLOBAL_POSITION_INT (33)."""
    if not ap.origin_set:
        return mavlink.MAVLink_global_position_int_message(ap.now_ms, 0, 0, 0, 0, 0, 0, 0, 65535)
    north, east, down = ap.reported()
    latitude, longitude = degrees_e7(north, east)
    above_home = (ap.home[2] - down) * 1000
    velocity = [round(v * 100) for v in ap.body.velocity]
    heading = round(math.degrees(ap.yaw_rad) % 360.0 * 100)
    return mavlink.MAVLink_global_position_int_message(
        ap.now_ms, latitude, longitude, round(amsl_m(down) * 1000), round(above_home), *velocity, heading
    )


def origin(ap: "Autopilot") -> Message | None:
    """GPS_GLOBAL_ORIGIN (49)."""
    if not ap.origin_set:
        return None
    return mavlink.MAVLink_gps_global_origin_message(
        *degrees_e7(0.0, 0.0), round(ALTITUDE_M * 1000), round(ap.now_s * 1e6)
    )


def vfr_hud(ap: "Autopilot") -> Message:
    """VFR_HUD (74)."""
    speed = math.hypot(*ap.body.velocity[:2])
    return mavlink.MAVLink_vfr_hud_message(
        speed, speed, 0, 30, amsl_m(ap.reported()[2]), -ap.body.velocity[2]
    )


def target(ap: "Autopilot") -> Message | None:
    """POSITION_TARGET_LOCAL_NED (85): the target that the autopilot flies to."""
    said = ap.target_said()
    if said is None:
        return None
    mask, place, velocity, other = said
    return mavlink.MAVLink_position_target_local_ned_message(
        ap.now_ms, 1, mask, *place, *velocity, other, other, other, other, other
    )


def battery(ap: "Autopilot") -> Message:
    """BATTERY_STATUS (147)."""
    cells = [round(ap.battery_v * 1000)] + [65535] * 9
    return mavlink.MAVLink_battery_status_message(0, 0, 0, 32767, cells, 1500, 100, -1, ap.battery_percent)


def version(ap: "Autopilot") -> Message:
    """AUTOPILOT_VERSION (148): 4.6.3 or 1.15.0."""
    number = (4 << 24 | 6 << 16 | 3 << 8 | 255) if ap.is_ardupilot else (1 << 24 | 15 << 16 | 255)
    return mavlink.MAVLink_autopilot_version_message(
        0xFBEF if ap.is_ardupilot else 0xE4EF, number, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0
    )


def wind(ap: "Autopilot") -> Message:
    """WIND (168), ArduPilot's: the direction that it comes from (deg). Without the model of its drag, and
    on the ground, it reads 0.
    """
    if ap.landed or not any(value for name, value in ap.parameters.items() if name.startswith("EK3_DRAG")):
        return mavlink.MAVLink_wind_message(-180.0, 0.0, 0.0)
    return mavlink.MAVLink_wind_message(*ap.settings.wind, 0.0)


def fence_status(ap: "Autopilot") -> Message:
    """FENCE_STATUS (162), ArduPilot's."""
    breached, count = getattr(ap, "breached", False), getattr(ap, "breaches", 0)
    return mavlink.MAVLink_fence_status_message(
        int(breached), count, mavlink.FENCE_BREACH_BOUNDARY if breached else 0, 0
    )


def ekf_status(ap: "Autopilot") -> Message:
    """EKF_STATUS_REPORT (193), ArduPilot's."""
    ratios = (1.8, 1.4, 0.3, 0.9) if ap.faults.on("ekf") else ap.gps.ratios()
    return mavlink.MAVLink_ekf_status_report_message(ap.ekf_flags() | ap.gps.flag(True), *ratios, 0.0)


def estimator_status(ap: "Autopilot") -> Message:
    """ESTIMATOR_STATUS (230), PX4's."""
    ratios = (1.8, 1.4, 0.3, 0.9) if ap.faults.on("ekf") else ap.gps.ratios()
    return mavlink.MAVLink_estimator_status_message(
        round(ap.now_s * 1e6), ap.ekf_flags() | ap.gps.flag(False), *ratios, NAN, NAN, 0.3, 0.4
    )


def wind_cov(ap: "Autopilot") -> Message:
    """WIND_COV (231), PX4's: where the air goes, NED; what it does not know is NaN."""
    direction, speed = math.radians(ap.settings.wind[0]), ap.settings.wind[1]
    air = -speed * math.cos(direction), -speed * math.sin(direction)
    return mavlink.MAVLink_wind_cov_message(
        round(ap.now_s * 1e6), *air, NAN, 0.1, NAN, amsl_m(ap.body.position[2]), NAN, NAN
    )


def home(ap: "Autopilot") -> Message | None:
    """HOME_POSITION (242): from the EKF's origin. ArduPilot's approach vector is zero, PX4's NaN."""
    if not ap.origin_set:
        return None
    unknown = 0.0 if ap.is_ardupilot else NAN
    latitude, longitude = degrees_e7(*ap.home[:2])
    return mavlink.MAVLink_home_position_message(
        latitude,
        longitude,
        round(amsl_m(ap.home[2]) * 1000),
        *ap.home,
        [1.0, 0.0, 0.0, 0.0],
        unknown,
        unknown,
        unknown,
    )


def extended(ap: "Autopilot") -> Message:
    """EXTENDED_SYS_STATE (245)."""
    return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, ap.landed_state())


COMMON = {
    0: heartbeat,
    1: sys_status,
    24: gps_raw,
    30: attitude,
    32: local_position,
    33: global_position,
    49: origin,
    74: vfr_hud,
    85: target,
    147: battery,
    148: version,
    242: home,
    245: extended,
}
ARDUPILOT = {**COMMON, 162: fence_status, 168: wind, 193: ekf_status}
PX4 = {**COMMON, 230: estimator_status, 231: wind_cov}
