"""Telemetry of the vehicle's status: mode, health, battery, home, version. Each message is built from one
snapshot.
"""

import math

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import LOW_BATTERY
from link.bus.mavlink import Message
from link.bus.px4 import AvailableModesMonitor, CurrentMode, MissionCurrent
from sitl.autopilot.state import Snapshot

CELLS = 4
EMPTY_CELL_V, FULL_CELL_V = 3.5, 4.2
UNKNOWN_U16 = 0xFFFF
REACHED_S = 1.0
"""How long it is told that an item of the mission is done; PX4 tells it ten times, at 10 Hz."""
FLIGHT_SW_VERSION = (1, 15, 0, mavlink.FIRMWARE_VERSION_TYPE_DEV)
"""The PX4 release whose protocol the vehicle speaks: stations refuse or warn of older ones. "dev", for it
is not a release of PX4.
"""
OWN_NAME, OWN_VERSION = b"plume", (0, 1, 0)
"""Who it really is. `flight_custom_version` has it: patch, minor, major, as PX4's vendors order them, and
the name.
"""


def heartbeat(s: Snapshot) -> Message:
    """HEARTBEAT (0): a PX4 quadrotor, its mode and whether it is armed."""
    mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    mode |= mavlink.MAV_MODE_FLAG_GUIDED_ENABLED | mavlink.MAV_MODE_FLAG_AUTO_ENABLED
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


ALWAYS_HEALTHY = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
    | mavlink.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink.MAV_SYS_STATUS_AHRS
    | mavlink.MAV_SYS_STATUS_GEOFENCE
)
"""Parts that the simulation models without faults. Parts that it does not model (barometer, receiver,
logging) are not reported.
"""


def sys_status(s: Snapshot) -> Message:
    """SYS_STATUS (1): only simulated parts that work are reported healthy; PREARM_CHECK unless the battery
    is empty or it is falling.
    """
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
    """BATTERY_STATUS (147): a battery that drains evenly while the motors are on; current is not
    simulated.
    """
    left = s.state.battery
    if left <= 0.0:
        charge = mavlink.MAV_BATTERY_CHARGE_STATE_CRITICAL
    else:
        charge = (
            mavlink.MAV_BATTERY_CHARGE_STATE_OK
            if left > LOW_BATTERY
            else mavlink.MAV_BATTERY_CHARGE_STATE_LOW
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
    latitude, longitude, altitude = _home(s)
    return mavlink.MAVLink_home_position_message(
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
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
    """MISSION_CURRENT (42): the current item, how many there are, the mission's state, and the ids of
    mission, fence and rally points.
    """
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
    """MISSION_ITEM_REACHED (46): the item that was done within the last second; one datagram may be lost,
    ten hardly are.
    """
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
