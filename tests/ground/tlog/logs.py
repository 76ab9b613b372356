"""Builds telemetry logs byte by byte for the tests of their reader: from ArduPilot, from PX4, damaged."""

import struct
from pathlib import Path

from pymavlink.dialects.v20 import all as mavlink

BEGAN_US = 1_700_000_000_000_000
"""14 November 2023."""
HOME = (47.397742, 8.545594)
ARMED, DISARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED, 0


class Recorder:
    """Writes a log as a ground station does: the arrival time of each frame, then the frame."""

    def __init__(self, stamped: bool = True) -> None:
        self.records: list[bytes] = []
        self._stamped = stamped
        self._senders: dict[tuple[int, int], mavlink.MAVLink] = {}

    def hear(self, at_s: float, message, system=1, component=1, version=2) -> bytes:
        """Log a message; returns its frame."""
        sender = self._senders.setdefault(
            (system, component), mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        )
        frame = bytes(message.pack(sender, force_mavlink1=version == 1))
        sender.seq = (sender.seq + 1) % 256
        self.put(at_s, frame)
        return frame

    def put(self, at_s: float, frame: bytes) -> None:
        self.records.append(
            (struct.pack(">Q", BEGAN_US + round(at_s * 1e6)) if self._stamped else b"") + frame
        )

    @property
    def data(self) -> bytes:
        return b"".join(self.records)

    def write(self, folder: Path, name: str = "flight.tlog") -> Path:
        path = folder / name
        path.write_bytes(self.data)
        return path


def heartbeat(autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mode=ARMED, kind=mavlink.MAV_TYPE_QUADROTOR):
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, mode, 0, mavlink.MAV_STATE_ACTIVE, 3)


def ground_station():
    return heartbeat(mavlink.MAV_AUTOPILOT_INVALID, 0, mavlink.MAV_TYPE_GCS)


def attitude(boot_ms):
    return mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0)


def local(boot_ms, north, east, up=5.0):
    return mavlink.MAVLink_local_position_ned_message(boot_ms, north, east, -up, 0.0, 0.0, 0.0)


def globe(boot_ms, lat_e7, lon_e7, up_mm=5000):
    return mavlink.MAVLink_global_position_int_message(
        boot_ms, lat_e7, lon_e7, 488_000 + up_mm, up_mm, 0, 0, 0, 0
    )


def gps(lat_e7, lon_e7, fix=mavlink.GPS_FIX_TYPE_3D_FIX, alt_mm=493_000):
    return mavlink.MAVLink_gps_raw_int_message(0, fix, lat_e7, lon_e7, alt_mm, 100, 100, 0, 0, 10)


def gas(boot_ms, value, name=b"gas"):
    return mavlink.MAVLink_named_value_float_message(boot_ms, name, value)


def wind(from_deg, speed):
    """ArduPilot's WIND (168)."""
    return mavlink.MAVLink_wind_message(from_deg, speed, 0.0)


def wind_cov(north, east):
    return mavlink.MAVLink_wind_cov_message(0, north, east, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def landed(state):
    return mavlink.MAVLink_extended_sys_state_message(0, state)
