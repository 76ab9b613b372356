"""Telemetry: the table of streamed messages, each built from one snapshot, at the rates of PX4's ONBOARD link."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Message, gas_message, wind_message
from plume.geodesy import to_global
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.motion import GRAVITY_MPS2
from sitl.autopilot.state import LOW_BATTERY, State

CELLS = 4
EMPTY_CELL_V, FULL_CELL_V = 3.5, 4.2
HOVER_THROTTLE = 0.5
FLIGHT_SW_VERSION = (0, 1, 0, mavlink.FIRMWARE_VERSION_TYPE_DEV)
"""Plumeward's own version: the vehicle speaks PX4's protocol but does not claim to be a PX4 release."""
FASTEST_HZ = 1000.0
"""Highest rate that a client can set."""
UNKNOWN_U16 = 0xFFFF


class Snapshot(NamedTuple):
    """The vehicle and the air at one instant: the input of every message."""

    config: VehicleConfig
    state: State
    wind: tuple[float, float]
    """(u cos φ, u sin φ) m/s, x east, y north: points to where the wind comes from."""
    gas: tuple[int, float] | None
    """time_boot_ms and value of the last reading, in the sensor's unit; None before the first."""

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


def heartbeat(s: Snapshot) -> Message:
    """HEARTBEAT (0): a PX4 quadrotor, its mode and whether it is armed."""
    mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    mode |= mavlink.MAV_MODE_FLAG_GUIDED_ENABLED | mavlink.MAV_MODE_FLAG_AUTO_ENABLED
    status = mavlink.MAV_STATE_STANDBY
    if s.state.armed:
        mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        status = mavlink.MAV_STATE_CRITICAL if s.state.failsafe else mavlink.MAV_STATE_ACTIVE
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, mode, s.state.mode.custom_mode, status, mavlink_version=3
    )


ALWAYS_HEALTHY = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink.MAV_SYS_STATUS_AHRS
    | mavlink.MAV_SYS_STATUS_GEOFENCE
)
"""Parts that the simulation models without faults. Parts that it does not model (barometer, receiver, logging) are not reported."""


def sys_status(s: Snapshot) -> Message:
    """SYS_STATUS (1): only simulated parts that work are reported healthy; PREARM_CHECK unless the battery is empty or it is falling."""
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
    return mavlink.MAVLink_global_position_int_message(s.time_boot_ms, lat, lon, altitude, above_home, north, east, down, heading)


def local_position_ned(s: Snapshot) -> Message:
    """LOCAL_POSITION_NED (32): position and velocity from home; a reading is taken at exactly these float32 values."""
    values = np.array(s.state.position + s.state.velocity, np.float32).tolist()
    return mavlink.MAVLink_local_position_ned_message(s.time_boot_ms, *values)


def attitude(s: Snapshot) -> Message:
    """ATTITUDE (30): roll and pitch from the thrust direction, yaw, and the yaw rate; roll and pitch rates are not simulated (0)."""
    state = s.state
    return mavlink.MAVLink_attitude_message(s.time_boot_ms, state.roll, state.pitch, state.yaw, 0.0, 0.0, state.yaw_rate)


def vfr_hud(s: Snapshot) -> Message:
    """VFR_HUD (74): airspeed, ground speed, heading, throttle, altitude and climb rate."""
    north, east, down = s.state.velocity
    a_north, a_east, a_down = s.state.acceleration
    throttle = HOVER_THROTTLE * math.hypot(a_north, a_east, GRAVITY_MPS2 - a_down) / GRAVITY_MPS2 if s.state.armed else 0.0
    return mavlink.MAVLink_vfr_hud_message(
        airspeed=math.hypot(north + s.wind[1], east + s.wind[0], down),  # the air moves with −wind
        groundspeed=math.hypot(north, east),
        heading=round(math.degrees(s.state.yaw)) % 360,
        throttle=min(round(throttle * 100.0), 100),
        alt=s.altitude_m,
        climb=-down,
    )


def battery_status(s: Snapshot) -> Message:
    """BATTERY_STATUS (147): a battery that drains evenly while the motors are on; current is not simulated."""
    left = s.state.battery
    if left <= 0.0:
        charge = mavlink.MAV_BATTERY_CHARGE_STATE_CRITICAL
    else:
        charge = mavlink.MAV_BATTERY_CHARGE_STATE_OK if left > LOW_BATTERY else mavlink.MAV_BATTERY_CHARGE_STATE_LOW
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
        time_remaining=round(left * s.config.endurance_s) if s.config.endurance_s < 0x7FFFFFFF else 0,  # 0: no estimate
        charge_state=charge,
    )


def home_position(s: Snapshot) -> Message:
    """HOME_POSITION (242): the origin of the local frame."""
    heading = math.radians(s.config.home_heading_deg)
    return mavlink.MAVLink_home_position_message(
        latitude=round(s.config.home_lat_deg * 1e7),
        longitude=round(s.config.home_lon_deg * 1e7),
        altitude=round(s.config.home_alt_m * 1000.0),
        x=0.0,
        y=0.0,
        z=0.0,
        q=[math.cos(heading / 2.0), 0.0, 0.0, math.sin(heading / 2.0)],
        approach_x=0.0,
        approach_y=0.0,
        approach_z=0.0,
    )


def extended_sys_state(s: Snapshot) -> Message:
    """EXTENDED_SYS_STATE (245): on the ground, taking off, in the air or landing."""
    return mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, s.state.landed_state)


def wind_cov(s: Snapshot) -> Message:
    """WIND_COV (231): the air's velocity, NED, m/s."""
    return wind_message(s.time_boot_ms, s.wind)


def named_value_float_gas(s: Snapshot) -> Message | None:
    """NAMED_VALUE_FLOAT (251) `gas`: the last reading with the time it was taken; None before the first."""
    return None if s.gas is None else gas_message(*s.gas)


def autopilot_version(s: Snapshot) -> Message:
    """AUTOPILOT_VERSION (148): capabilities and version."""
    major, minor, patch, kind = FLIGHT_SW_VERSION
    return mavlink.MAVLink_autopilot_version_message(
        capabilities=mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2,
        flight_sw_version=major << 24 | minor << 16 | patch << 8 | kind,
        middleware_sw_version=0,
        os_sw_version=0,
        board_version=0,
        flight_custom_version=[0] * 8,
        middleware_custom_version=[0] * 8,
        os_custom_version=[0] * 8,
        vendor_id=0,
        product_id=0,
        uid=s.config.sysid,
    )


class Stream(NamedTuple):
    """A message, its default rate (0: on request only), and its builder; a builder that returns None has nothing to send."""

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
    Stream(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0.0, autopilot_version),
)
STREAM = {stream.message_id: stream for stream in STREAMS}


class Telemetry:
    """The message schedule of one link; each link has its own, because its client may change the rates. Times in s."""

    def __init__(self, snapshot: Callable[[float], Snapshot], start_s: float = 0.0) -> None:
        """Take a function from a time to the snapshot; every stream is due at `start_s`."""
        self._snapshot = snapshot
        self._rate_hz = {stream.message_id: stream.rate_hz for stream in STREAMS if stream.rate_hz > 0.0}
        self._next_s = dict.fromkeys(self._rate_hz, start_s)

    def due(self, now_s: float) -> list[Message]:
        """Return the messages to send now: at most one per stream, however late the call."""
        due = [message_id for message_id, at in self._next_s.items() if at <= now_s]
        if not due:
            return []
        snapshot = self._snapshot(now_s)
        for message_id in due:
            self._next_s[message_id] = _next_slot(now_s, self._rate_hz[message_id])
        return [message for message_id in due if (message := STREAM[message_id].build(snapshot)) is not None]

    def next_due_s(self) -> float:
        """Return when to call `due` again; infinity if all streams are off."""
        return min(self._next_s.values(), default=math.inf)

    def set_interval(self, message_id: int, interval_us: float, now_s: float) -> bool:
        """Set a stream's interval in µs: −1 turns it off, 0 restores the default. Returns False for an unknown message or interval."""
        if message_id not in STREAM or not (interval_us >= 0.0 or interval_us == -1.0):
            return False
        default = STREAM[message_id].rate_hz if interval_us == 0.0 else 0.0
        rate = min(1e6 / interval_us, FASTEST_HZ) if interval_us > 0.0 else default
        self._rate_hz.pop(message_id, None)
        self._next_s.pop(message_id, None)
        if rate > 0.0:
            self._rate_hz[message_id], self._next_s[message_id] = rate, _next_slot(now_s, rate)
        return True

    def build(self, message_id: int, now_s: float) -> Message | None:
        """Return one message as of now; None if the message is unknown or has no value yet."""
        return STREAM[message_id].build(self._snapshot(now_s)) if message_id in STREAM else None


def _next_slot(now_s: float, rate_hz: float) -> float:
    """The next multiple of the interval after now: a late call does not shift the schedule."""
    slot = math.floor(now_s * rate_hz) + 1
    return slot / rate_hz if slot / rate_hz > now_s else (slot + 1) / rate_hz


def _voltage_mv(s: Snapshot) -> int:
    return round(1000.0 * CELLS * (EMPTY_CELL_V + (FULL_CELL_V - EMPTY_CELL_V) * s.state.battery))


def _percent(s: Snapshot) -> int:
    return math.ceil(s.state.battery * 100.0)


def _centidegrees(angle_rad: float) -> int:
    return round(math.degrees(angle_rad) * 100.0) % 36_000
