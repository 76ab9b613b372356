"""Telemetry: messages, each built from one snapshot of vehicle and air, and a link's schedule of them.

Rates are those of PX4's ONBOARD.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import ACCEPTED, LOW_BATTERY, UNSUPPORTED, Ned, Result, denied
from link.bus.mavlink import POSITION_ONLY, Message, gas_message, wind_message
from link.bus.px4 import AvailableModesMonitor, CurrentMode, MissionCurrent
from plume.geodesy import to_global
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.motion import GRAVITY_MPS2
from sitl.autopilot.vehicle import State

UNKNOWN_U16 = 0xFFFF


class Snapshot(NamedTuple):
    """The vehicle and the air at one instant: the input of every message."""

    config: VehicleConfig
    state: State
    wind: tuple[float, float]  # (u cos φ, u sin φ) m/s, x east, y north: points to where the wind comes from
    gas: tuple[int, float] | None  # time_boot_ms and value of the last reading, in the sensor's unit

    @property
    def time_boot_ms(self) -> int:
        """Milliseconds since the start of the simulation, 32 bits (wraps after 49.7 days)."""
        return round(self.state.time_s * 1000.0) & 0xFFFFFFFF

    @property
    def lat_lon_e7(self) -> tuple[int, int]:
        """Latitude and longitude in 1e-7 degrees."""
        north, east, _ = self.state.position
        lat, lon = to_global(self.config.home_lat_deg, self.config.home_lon_deg, north, east)
        return round(lat * 1e7), round(lon * 1e7)

    @property
    def altitude_m(self) -> float:
        """Above mean sea level."""
        return self.config.home_alt_m - self.state.position[2]


# ---- where it is, how it moves, and the air ----

HOVER_THROTTLE = 0.5
VELOCITY_ONLY = POSITION_ONLY & ~0b111000 | 0b111


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
    return mavlink.MAVLink_global_position_int_message(
        s.time_boot_ms,
        lat,
        lon,
        alt=round(s.altitude_m * 1000.0),
        relative_alt=round(-s.state.position[2] * 1000.0),
        vx=north,
        vy=east,
        vz=down,
        hdg=_centidegrees(s.state.yaw),
    )


def local_position_ned(s: Snapshot) -> Message:
    """LOCAL_POSITION_NED (32): position and velocity; a reading is taken at these float32 values."""
    return mavlink.MAVLink_local_position_ned_message(
        s.time_boot_ms, *np.array(s.state.position + s.state.velocity, np.float32).tolist()
    )


def attitude(s: Snapshot) -> Message:
    """ATTITUDE (30): roll and pitch of the thrust, yaw and yaw rate; other rates are not simulated."""
    return mavlink.MAVLink_attitude_message(
        s.time_boot_ms, s.state.roll, s.state.pitch, s.state.yaw, 0.0, 0.0, s.state.yaw_rate
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
    """NAMED_VALUE_FLOAT (251) `gas`: the last reading with the time it was taken; none before the first."""
    return None if s.gas is None else gas_message(*s.gas)


# ---- more than PX4's clients need: on request ----


def attitude_quaternion(s: Snapshot) -> Message:
    """ATTITUDE_QUATERNION (31): the attitude as (w, x, y, z); roll and pitch rates are not simulated (0)."""
    return mavlink.MAVLink_attitude_quaternion_message(
        s.time_boot_ms, *quaternion(s), 0.0, 0.0, s.state.yaw_rate, [0.0] * 4
    )


def odometry(s: Snapshot) -> Message:
    """ODOMETRY (331): position from home, NED; velocity forward, right, down; accuracy unknown."""
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
    """HIGHRES_IMU (105): what an accelerometer measures, and the yaw rate; nothing else is simulated."""
    north, east, down = s.state.acceleration
    return mavlink.MAVLink_highres_imu_message(
        round(s.state.time_s * 1e6),
        *in_body(s, (north, east, down - GRAVITY_MPS2)),
        0.0,
        0.0,
        s.state.yaw_rate,
        *[0.0] * 7,
        IMU_FIELDS,
    )


def altitude(s: Snapshot) -> Message:
    """ALTITUDE (141): above sea and above home, m. The ground is level, at home's altitude."""
    height = -s.state.position[2]
    return mavlink.MAVLink_altitude_message(
        round(s.state.time_s * 1e6), s.altitude_m, s.altitude_m, height, height, math.nan, math.nan
    )


def position_target_local_ned(s: Snapshot) -> Message | None:
    """POSITION_TARGET_LOCAL_NED (85): the end of the leg, or the velocity asked for; none while disarmed."""
    if not s.state.armed:
        return None
    mask, values = POSITION_ONLY, [*s.state.target, *[0.0] * 8]
    if s.state.cruise is not None:
        mask, values = VELOCITY_ONLY, [0.0, 0.0, 0.0, *s.state.cruise, *[0.0] * 5]
    return mavlink.MAVLink_position_target_local_ned_message(
        s.time_boot_ms, mavlink.MAV_FRAME_LOCAL_NED, mask, *values
    )


ESTIMATED = (
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
    """ESTIMATOR_STATUS (230): the position has no error, so no test ratio comes near its limit."""
    return mavlink.MAVLink_estimator_status_message(round(s.state.time_s * 1e6), ESTIMATED, *[0.0] * 8)


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


# ---- its status ----

CELLS = 4
EMPTY_CELL_V, FULL_CELL_V = 3.5, 4.2
REACHED_S = 1.0  # how long MISSION_ITEM_REACHED is sent; PX4 sends it ten times, at 10 Hz
# The PX4 release whose protocol the vehicle speaks: stations warn of older ones. "dev": it is none of PX4's.
FLIGHT_SW_VERSION = (1, 15, 0, mavlink.FIRMWARE_VERSION_TYPE_DEV)
# Its own name and version: `flight_custom_version` has the version, as PX4's vendors order it, and the name.
OWN_NAME, OWN_VERSION = b"plume", (0, 1, 0)


def heartbeat(s: Snapshot) -> Message:
    """HEARTBEAT (0): a PX4 quadrotor, its mode and whether it is armed."""
    mode = (
        mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
        | mavlink.MAV_MODE_FLAG_GUIDED_ENABLED
        | mavlink.MAV_MODE_FLAG_AUTO_ENABLED
    )
    status = mavlink.MAV_STATE_STANDBY
    if s.state.armed:
        mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        status = mavlink.MAV_STATE_CRITICAL if s.state.failsafe else mavlink.MAV_STATE_ACTIVE
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_AUTOPILOT_PX4,
        mode,
        s.state.mode.custom_mode,
        status,
        mavlink_version=3,
    )


# Parts that the simulation models without faults. Those that it does not model (barometer, receiver, logging)
# are not reported.
ALWAYS_HEALTHY = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink.MAV_SYS_STATUS_AHRS
    | mavlink.MAV_SYS_STATUS_GEOFENCE
)


def sys_status(s: Snapshot) -> Message:
    """SYS_STATUS (1): simulated parts that work are healthy; PREARM_CHECK, if it is fit to fly."""
    simulated = ALWAYS_HEALTHY | mavlink.MAV_SYS_STATUS_SENSOR_BATTERY | mavlink.MAV_SYS_STATUS_PREARM_CHECK
    healthy = ALWAYS_HEALTHY
    if s.state.battery > LOW_BATTERY:
        healthy |= mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
    if s.state.fit:
        healthy |= mavlink.MAV_SYS_STATUS_PREARM_CHECK
    return mavlink.MAVLink_sys_status_message(
        onboard_control_sensors_present=simulated,
        onboard_control_sensors_enabled=simulated,
        onboard_control_sensors_health=healthy,
        load=0,
        voltage_battery=_voltage_mv(s),
        current_battery=-1,
        battery_remaining=_percent(s),
        drop_rate_comm=0,
        errors_comm=0,
        errors_count1=0,
        errors_count2=0,
        errors_count3=0,
        errors_count4=0,
    )


def battery_status(s: Snapshot) -> Message:
    """BATTERY_STATUS (147): it drains evenly while the motors are on; current is not simulated."""
    left = s.state.battery
    charge = mavlink.MAV_BATTERY_CHARGE_STATE_OK
    if left <= LOW_BATTERY:
        charge = (
            mavlink.MAV_BATTERY_CHARGE_STATE_LOW if left > 0.0 else mavlink.MAV_BATTERY_CHARGE_STATE_CRITICAL
        )
    return mavlink.MAVLink_battery_status_message(
        id=0,
        battery_function=mavlink.MAV_BATTERY_FUNCTION_ALL,
        type=mavlink.MAV_BATTERY_TYPE_LIPO,
        temperature=0x7FFF,
        voltages=[_voltage_mv(s)] + [UNKNOWN_U16] * 9,
        current_battery=-1,
        current_consumed=-1,
        energy_consumed=-1,
        battery_remaining=_percent(s),
        time_remaining=round(left * s.config.endurance_s)
        if s.config.endurance_s < 0x7FFFFFFF
        else 0,  # 0: no estimate
        charge_state=charge,
    )


def home_position(s: Snapshot) -> Message:
    """HOME_POSITION (242): the origin of the local frame."""
    heading = math.radians(s.config.home_heading_deg)
    return mavlink.MAVLink_home_position_message(
        *_home(s),
        x=0.0,
        y=0.0,
        z=0.0,
        q=[math.cos(heading / 2.0), 0.0, 0.0, math.sin(heading / 2.0)],
        approach_x=0.0,
        approach_y=0.0,
        approach_z=0.0,
    )


def gps_global_origin(s: Snapshot) -> Message:
    """GPS_GLOBAL_ORIGIN (49): the origin of the local frame is home."""
    return mavlink.MAVLink_gps_global_origin_message(*_home(s), time_usec=round(s.state.time_s * 1e6))


def extended_sys_state(s: Snapshot) -> Message:
    """EXTENDED_SYS_STATE (245): on the ground, taking off, in the air or landing."""
    return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, s.state.landed_state)


def system_time(s: Snapshot) -> Message:
    """SYSTEM_TIME (2): time since the start; a simulation has no date (0)."""
    return mavlink.MAVLink_system_time_message(0, s.time_boot_ms)


def current_mode(s: Snapshot) -> Message:
    """CURRENT_MODE (436): the flight mode by its standard and its PX4 number."""
    mode = s.state.mode
    return CurrentMode(
        custom_mode=mode.custom_mode, intended_custom_mode=mode.custom_mode, standard_mode=mode.standard
    )


def mission_current(s: Snapshot) -> Message:
    """MISSION_CURRENT (42): the item, the count, the state, the ids of mission, fence and rally points."""
    mission = s.state.mission
    return MissionCurrent(
        seq=mission.seq,
        total=mission.total or UNKNOWN_U16,
        mission_state=mission.state,
        mission_mode=1 if mission.active else 2,  # flown, or suspended
        mission_id=mission.number,
        fence_id=s.config.fence.number,
        rally_points_id=s.config.rally.number,
    )


def mission_item_reached(s: Snapshot) -> Message | None:
    """MISSION_ITEM_REACHED (46): the item done within the last second, ten times, for lossy links."""
    seq, reached_s = s.state.mission.reached or (0, -math.inf)
    return (
        mavlink.MAVLink_mission_item_reached_message(seq) if s.state.time_s - reached_s <= REACHED_S else None
    )


def fence_status(s: Snapshot) -> Message:
    """FENCE_STATUS (162): whether the vehicle is outside the fence, and how often and when it left it."""
    breaches = s.state.breaches
    return mavlink.MAVLink_fence_status_message(
        breach_status=int(breaches.outside),
        breach_count=breaches.times,
        breach_type=mavlink.FENCE_BREACH_BOUNDARY if breaches.times else mavlink.FENCE_BREACH_NONE,
        breach_time=round(breaches.last_s * 1000.0) & 0xFFFFFFFF,
    )


def available_modes_monitor(_: Snapshot) -> Message:
    """AVAILABLE_MODES_MONITOR (437): the modes never change."""
    return AvailableModesMonitor(seq=0)


def autopilot_version(s: Snapshot) -> Message:
    """AUTOPILOT_VERSION (148): capabilities, the version of PX4 that it is like, and who it is."""
    major, minor, patch, kind = FLIGHT_SW_VERSION
    return mavlink.MAVLink_autopilot_version_message(
        capabilities=mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
        | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
        | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
        | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2,
        flight_sw_version=major << 24 | minor << 16 | patch << 8 | kind,
        middleware_sw_version=0,
        os_sw_version=0,
        board_version=0,
        flight_custom_version=[*reversed(OWN_VERSION), *OWN_NAME],
        middleware_custom_version=[0] * 8,
        os_custom_version=[0] * 8,
        vendor_id=0,
        product_id=0,
        uid=s.config.sysid,
        uid2=[*b"plumeward".ljust(17, b"\0"), s.config.sysid],
    )


def _home(s: Snapshot) -> tuple[int, int, int]:
    """Latitude and longitude in 1e-7 degrees, altitude above sea in mm."""
    return (
        round(s.config.home_lat_deg * 1e7),
        round(s.config.home_lon_deg * 1e7),
        round(s.config.home_alt_m * 1000.0),
    )


def _voltage_mv(s: Snapshot) -> int:
    return round(1000.0 * CELLS * (EMPTY_CELL_V + (FULL_CELL_V - EMPTY_CELL_V) * s.state.battery))


def _percent(s: Snapshot) -> int:
    return math.ceil(s.state.battery * 100.0)


# ---- rates and schedule ----

FASTEST_HZ = 1000.0  # highest rate that a client can set
# Stations take a vehicle without heartbeats for lost: a client can neither turn them off nor slow them down.
SLOWEST_HEARTBEAT_US = 1_000_000.0


class Stream(NamedTuple):
    """A message, its default rate (0: on request only), and its builder, which returns None for nothing."""

    message_id: int
    rate_hz: float
    build: Callable[[Snapshot], Message | None]


STREAMS = (
    Stream(mavlink.MAVLINK_MSG_ID_HEARTBEAT, 1.0, heartbeat),
    Stream(mavlink.MAVLINK_MSG_ID_SYS_STATUS, 5.0, sys_status),
    Stream(mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 10.0, gps_raw_int),
    Stream(mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 50.0, global_position_int),
    Stream(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 30.0, local_position_ned),
    Stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 100.0, attitude),
    Stream(mavlink.MAVLINK_MSG_ID_VFR_HUD, 10.0, vfr_hud),
    Stream(mavlink.MAVLINK_MSG_ID_BATTERY_STATUS, 0.5, battery_status),
    Stream(mavlink.MAVLINK_MSG_ID_HOME_POSITION, 0.5, home_position),
    Stream(mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 5.0, extended_sys_state),
    Stream(mavlink.MAVLINK_MSG_ID_WIND_COV, 10.0, wind_cov),
    Stream(mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT, 10.0, named_value_float_gas),
    Stream(mavlink.MAVLINK_MSG_ID_ALTITUDE, 10.0, altitude),
    Stream(mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED, 10.0, position_target_local_ned),
    Stream(mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS, 1.0, estimator_status),
    Stream(mavlink.MAVLINK_MSG_ID_SYSTEM_TIME, 1.0, system_time),
    Stream(CurrentMode.id, 0.5, current_mode),
    Stream(MissionCurrent.id, 1.0, mission_current),
    Stream(mavlink.MAVLINK_MSG_ID_MISSION_ITEM_REACHED, 10.0, mission_item_reached),
    # PX4 streams the next three at 50, 50 and 30 Hz. That would more than double what a mission records.
    Stream(mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 0.0, attitude_quaternion),
    Stream(mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, 0.0, highres_imu),
    Stream(mavlink.MAVLINK_MSG_ID_ODOMETRY, 0.0, odometry),
    Stream(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, 0.0, gps_global_origin),
    Stream(mavlink.MAVLINK_MSG_ID_FENCE_STATUS, 0.0, fence_status),
    Stream(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0.0, autopilot_version),
    Stream(AvailableModesMonitor.id, 0.0, available_modes_monitor),
)
STREAM = {stream.message_id: stream for stream in STREAMS}


class Telemetry:
    """The message schedule of one link, whose client may change the rates. Times in s."""

    def __init__(self, snapshot: Callable[[float], Snapshot], start_s: float = 0.0) -> None:
        self._snapshot = snapshot
        self._rate_hz = {stream.message_id: stream.rate_hz for stream in STREAMS if stream.rate_hz > 0.0}
        self._next_s = dict.fromkeys(self._rate_hz, start_s)

    def due(self, now_s: float) -> list[Message]:
        """Return the messages to send now: at most one per stream, however late the call."""
        due = [message_id for message_id, at in self._next_s.items() if at <= now_s]
        if not due:
            return []
        snapshot = self._snapshot(now_s)
        self._next_s |= {message_id: _next_slot(now_s, self._rate_hz[message_id]) for message_id in due}
        return [message for message_id in due if (message := STREAM[message_id].build(snapshot)) is not None]

    def next_due_s(self) -> float:
        """Return when to call `due` again: slower streams wait for the fastest one, to wake less often."""
        return self._next_s[max(self._rate_hz, key=self._rate_hz.__getitem__)]

    def set_interval(self, message_id: int, interval_us: float, now_s: float) -> Result:
        """Set a stream's interval in µs: −1 turns it off, 0 restores the default."""
        if message_id not in STREAM or not (interval_us >= 0.0 or interval_us == -1.0):
            return UNSUPPORTED
        if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT and not 0.0 <= interval_us <= SLOWEST_HEARTBEAT_US:
            return denied(
                f"Interval refused: HEARTBEAT has at most {SLOWEST_HEARTBEAT_US:.0f} us and stays on"
            )
        rate = STREAM[message_id].rate_hz if interval_us == 0.0 else min(1e6 / interval_us, FASTEST_HZ)
        self._rate_hz[message_id] = rate = max(rate, 0.0)
        self._next_s[message_id] = _next_slot(now_s, rate) if rate else math.inf
        return ACCEPTED

    def interval_us(self, message_id: int) -> int:
        """Return a stream's interval in µs, as MESSAGE_INTERVAL (244) has it: −1 off, 0 unknown."""
        if message_id not in STREAM:
            return 0
        rate = self._rate_hz.get(message_id)
        return round(1e6 / rate) if rate else -1

    def build(self, message_id: int, now_s: float) -> Message | None:
        """Return one message as of now; None if the message is unknown or has no value yet."""
        return STREAM[message_id].build(self._snapshot(now_s)) if message_id in STREAM else None


def _next_slot(now_s: float, rate_hz: float) -> float:
    """The next multiple of the interval after now: a late call does not shift the schedule."""
    slot = math.floor(now_s * rate_hz) + 1
    return slot / rate_hz if slot / rate_hz > now_s else (slot + 1) / rate_hz
