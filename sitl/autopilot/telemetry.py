"""Telemetry: the table of streamed messages, and the schedule of a link. Rates are those of PX4's ONBOARD."""

import math
from collections.abc import Callable
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import ACCEPTED, UNSUPPORTED, Result, denied
from link.bus.mavlink import Message
from link.bus.px4 import AvailableModesMonitor, CurrentMode, MissionCurrent
from sitl.autopilot import messages
from sitl.autopilot.messages import Snapshot

FASTEST_HZ = 1000.0  # highest rate that a client can set
# Stations take a vehicle without heartbeats for lost: a client can neither turn them off nor slow them down.
SLOWEST_HEARTBEAT_US = 1_000_000.0


class Stream(NamedTuple):
    """A message, its default rate (0: on request only), and its builder, which returns None for nothing."""

    message_id: int
    rate_hz: float
    build: Callable[[Snapshot], Message | None]


STREAMS = (
    Stream(mavlink.MAVLINK_MSG_ID_HEARTBEAT, 1.0, messages.heartbeat),
    Stream(mavlink.MAVLINK_MSG_ID_SYS_STATUS, 5.0, messages.sys_status),
    Stream(mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, 10.0, messages.gps_raw_int),
    Stream(mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 50.0, messages.global_position_int),
    Stream(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 30.0, messages.local_position_ned),
    Stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 100.0, messages.attitude),
    Stream(mavlink.MAVLINK_MSG_ID_VFR_HUD, 10.0, messages.vfr_hud),
    Stream(mavlink.MAVLINK_MSG_ID_BATTERY_STATUS, 0.5, messages.battery_status),
    Stream(mavlink.MAVLINK_MSG_ID_HOME_POSITION, 0.5, messages.home_position),
    Stream(mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 5.0, messages.extended_sys_state),
    Stream(mavlink.MAVLINK_MSG_ID_WIND_COV, 10.0, messages.wind_cov),
    Stream(mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT, 10.0, messages.named_value_float_gas),
    Stream(mavlink.MAVLINK_MSG_ID_ALTITUDE, 10.0, messages.altitude),
    Stream(mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED, 10.0, messages.position_target_local_ned),
    Stream(mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS, 1.0, messages.estimator_status),
    Stream(mavlink.MAVLINK_MSG_ID_SYSTEM_TIME, 1.0, messages.system_time),
    Stream(CurrentMode.id, 0.5, messages.current_mode),
    Stream(MissionCurrent.id, 1.0, messages.mission_current),
    Stream(mavlink.MAVLINK_MSG_ID_MISSION_ITEM_REACHED, 10.0, messages.mission_item_reached),
    # PX4 streams the next three at 50, 50 and 30 Hz. That would more than double what a mission records.
    Stream(mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 0.0, messages.attitude_quaternion),
    Stream(mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, 0.0, messages.highres_imu),
    Stream(mavlink.MAVLINK_MSG_ID_ODOMETRY, 0.0, messages.odometry),
    Stream(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, 0.0, messages.gps_global_origin),
    Stream(mavlink.MAVLINK_MSG_ID_FENCE_STATUS, 0.0, messages.fence_status),
    Stream(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0.0, messages.autopilot_version),
    Stream(AvailableModesMonitor.id, 0.0, messages.available_modes_monitor),
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
            longest = f"{SLOWEST_HEARTBEAT_US:.0f} us"
            return denied(f"Interval refused: HEARTBEAT has at most {longest} and stays on")
        rate = STREAM[message_id].rate_hz if interval_us == 0.0 else min(1e6 / interval_us, FASTEST_HZ)
        self._rate_hz.pop(message_id, None)
        self._next_s.pop(message_id, None)
        if rate > 0.0:
            self._rate_hz[message_id], self._next_s[message_id] = rate, _next_slot(now_s, rate)
        return ACCEPTED

    def interval_us(self, message_id: int) -> int:
        """Return a stream's interval in µs, as MESSAGE_INTERVAL (244) has it: −1 off, 0 unknown."""
        if message_id not in STREAM:
            return 0
        rate = self._rate_hz.get(message_id)
        return -1 if rate is None else round(1e6 / rate)

    def build(self, message_id: int, now_s: float) -> Message | None:
        """Return one message as of now; None if the message is unknown or has no value yet."""
        return STREAM[message_id].build(self._snapshot(now_s)) if message_id in STREAM else None


def _next_slot(now_s: float, rate_hz: float) -> float:
    """The next multiple of the interval after now: a late call does not shift the schedule."""
    slot = math.floor(now_s * rate_hz) + 1
    return slot / rate_hz if slot / rate_hz > now_s else (slot + 1) / rate_hz
