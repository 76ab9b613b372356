"""The service of parameters: names, types and meaning are PX4's.

What is set lasts as long as the process runs.
"""

import dataclasses
import math
import struct
import zlib
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import LOW_BATTERY
from link.bus.mavlink import Message
from sitl.autopilot.services import Microservice, Reply, Request
from sitl.autopilot.telemetry import CELLS, EMPTY_CELL_V, FULL_CELL_V
from sitl.autopilot.vehicle import Vehicle

REAL, INT = mavlink.MAV_PARAM_TYPE_REAL32, mavlink.MAV_PARAM_TYPE_INT32
EXT_REAL = mavlink.MAV_PARAM_EXT_TYPE_REAL32
NEVER = -1.0  # PX4's value of a time that never comes; the vehicle's is infinite
HASH = "_HASH_CHECK"  # PX4's checksum of all parameters: a station that holds them need not read them
NO_INDEX = 0xFFFF


class Parameter(NamedTuple):
    """A parameter, with the field of `VehicleConfig` that it sets, or, if it is fixed, with its value."""

    name: str
    kind: int  # MAV_PARAM_TYPE
    about: str
    field: str = ""
    low: float = 0.0
    high: float = 0.0
    unit: str = ""
    value: float = 0.0

    @property
    def allowed(self) -> str:
        """The allowed values in words."""
        if not self.field:
            return "it cannot be changed"
        low, never = ("above 0", f", or {NEVER:g} for never") if self.low == NEVER else (f"{self.low:g}", "")
        return f"allowed is {low} to {self.high:g} {self.unit}".rstrip() + never

    def pack(self, value: float) -> bytes:
        """Return the four bytes of a value in a message: PX4 packs integers bytewise."""
        return struct.pack("<i", int(value)) if self.kind == INT else struct.pack("<f", value)

    def unpack(self, data: bytes) -> float:
        """Return the value of four bytes."""
        return float(struct.unpack("<i" if self.kind == INT else "<f", data)[0])


# By name: the order of their indices. QGroundControl reads the fixed ones to see whether the vehicle
# is set up.
PARAMETERS = tuple(
    sorted(
        (
            Parameter(
                "MIS_TAKEOFF_ALT",
                REAL,
                "altitude of a take-off above home",
                "takeoff_altitude_m",
                0.5,
                80,
                "m",
            ),
            Parameter(
                "RTL_RETURN_ALT",
                REAL,
                "lowest altitude of a return above home",
                "return_altitude_m",
                0.5,
                150,
                "m",
            ),
            Parameter("GF_MAX_VER_DIST", REAL, "highest altitude above home", "ceiling_m", 1, 10_000, "m"),
            Parameter("GF_MAX_HOR_DIST", REAL, "no circle around home is a fence", value=0),
            Parameter("MPC_XY_CRUISE", REAL, "horizontal speed", "speed_mps", 0.5, 20, "m/s"),
            Parameter("MPC_Z_VEL_MAX_UP", REAL, "speed of climbs", "climb_mps", 0.5, 8, "m/s"),
            Parameter("MPC_Z_VEL_MAX_DN", REAL, "speed of descents", "descent_mps", 0.5, 4, "m/s"),
            Parameter("MPC_ACC_HOR", REAL, "acceleration along a leg", "accel_mps2", 0.5, 15, "m/s2"),
            Parameter("MPC_YAWRAUTO_MAX", REAL, "rate of turns", "yaw_rate_dps", 5, 360, "deg/s"),
            Parameter(
                "GF_ACTION",
                INT,
                "on leaving the fence: 0 nothing, 1 warns, 2 holds, 3 returns, 4 motors off, 5 lands",
                "fence_action",
                0,
                5,
            ),
            Parameter("RTL_TYPE", INT, "a return goes to the nearest of home and rally points", value=0),
            Parameter(
                "COM_OF_LOSS_T",
                REAL,
                "time without a setpoint until OFFBOARD returns home",
                "silence_s",
                0.5,
                3600,
                "s",
            ),
            Parameter("COM_OBL_RC_ACT", INT, "when OFFBOARD gets no setpoints: return home", value=3),
            Parameter("COM_LOW_BAT_ACT", INT, "at BAT_LOW_THR a warning, at BAT_CRIT_THR a landing", value=2),
            Parameter("BAT_LOW_THR", REAL, "charge at which the battery is low", value=LOW_BATTERY),
            Parameter("BAT_CRIT_THR", REAL, "charge at which it lands", value=0),
            Parameter("EKF2_DRAG_CTRL", INT, "the wind is estimated: WIND_COV", value=1),
            Parameter("NAV_DLL_ACT", INT, "the loss of a ground station does nothing", value=0),
            Parameter("COM_RCL_EXCEPT", INT, "modes that fly on without RC: all", value=7),
            Parameter(
                "COM_DISARM_LAND",
                REAL,
                "time after a landing until the motors stop",
                "disarm_landed_s",
                NEVER,
                20,
                "s",
            ),
            Parameter(
                "COM_DISARM_PRFLT",
                REAL,
                "time after arming without a take-off until the motors stop",
                "disarm_preflight_s",
                NEVER,
                60,
                "s",
            ),
            Parameter("MAV_SYS_ID", INT, "system id; set at start (`-I`)"),
            Parameter("SYS_AUTOSTART", INT, "airframe: generic quadcopter", value=4001),
            Parameter("COM_RC_IN_MODE", INT, "there is no RC receiver", value=1),
            Parameter("BAT1_N_CELLS", INT, "cells of the battery", value=CELLS),
            Parameter("BAT1_V_CHARGED", REAL, "voltage of a full cell, V", value=FULL_CELL_V),
            Parameter("BAT1_V_EMPTY", REAL, "voltage of an empty cell, V", value=EMPTY_CELL_V),
            Parameter("CAL_ACC0_ID", INT, "accelerometer: simulated, calibrated", value=1310988),
            Parameter("CAL_GYRO0_ID", INT, "gyroscope: simulated, calibrated", value=1310988),
            Parameter("CAL_MAG0_ID", INT, "compass: simulated, calibrated", value=197388),
        )
    )
)
INDEX = {parameter.name: index for index, parameter in enumerate(PARAMETERS)}


class Parameters:
    """The parameters of one vehicle."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        extended = "PARAM_EXT_ACK: failed; the parameters are PARAM_VALUE's"
        self.services = (
            Microservice("PARAM_REQUEST_LIST", self._list, f"PARAM_VALUE of {HASH}, then of all parameters"),
            Microservice("PARAM_REQUEST_READ", self._read, f"PARAM_VALUE, by name or index; {HASH} by name"),
            Microservice(
                "PARAM_SET",
                self._set,
                "PARAM_VALUE; of a refused value the old one, and a STATUSTEXT with what is allowed",
            ),
            Microservice("PARAM_EXT_REQUEST_LIST", _no_extended, "PARAM_EXT_VALUE with a count of 0", False),
            Microservice("PARAM_EXT_REQUEST_READ", _extended_refused, extended, False),
            Microservice("PARAM_EXT_SET", _extended_refused, extended, False),
        )

    def value(self, parameter: Parameter) -> float:
        """Return the value that a parameter has now."""
        config = self._vehicle.config
        if parameter.name == "MAV_SYS_ID":
            return config.sysid
        value = float(getattr(config, self._field(parameter))) if parameter.field else parameter.value
        return NEVER if parameter.low == NEVER and math.isinf(value) else value

    def change(self, name: str, value: float, t_s: float) -> str:
        """Change the parameter of a name; returns why not, or nothing."""
        parameter = PARAMETERS[INDEX[name]]
        if value == parameter.unpack(parameter.pack(self.value(parameter))):
            return ""
        if not parameter.field or not parameter.low <= value <= parameter.high or NEVER < value <= 0.0:
            return f"{value:g}, {parameter.allowed}"
        try:
            changed: Any = {self._field(parameter): math.inf if parameter.low == value == NEVER else value}
            self._vehicle.configure(t_s, dataclasses.replace(self._vehicle.config, **changed))
        except ValueError as error:
            return str(error)
        return ""

    def _field(self, parameter: Parameter) -> str:
        """The field of the configuration: a strict vehicle's COM_OF_LOSS_T is that of streams."""
        return (
            "stream_s"
            if parameter.field == "silence_s" and math.isfinite(self._vehicle.config.stream_s)
            else parameter.field
        )

    # ---- requests ----

    def _list(self, _: Request) -> Reply:
        return Reply([self._hash(), *map(self._param, PARAMETERS)])

    def _read(self, request: Request) -> Reply:
        name, index = request.message.param_id, request.message.param_index
        if index < 0 and name == HASH:
            return Reply([self._hash()])
        number = index if index >= 0 else INDEX.get(name, -1)
        return (
            Reply([self._param(PARAMETERS[number])]) if 0 <= number < len(PARAMETERS) else _unknown(request)
        )

    def _set(self, request: Request) -> Reply:
        message = request.message
        if message.param_id == HASH:  # the station holds all values already: it needs no more, as in PX4
            return Reply([])
        if message.param_id not in INDEX:
            return _unknown(request)
        parameter = PARAMETERS[INDEX[message.param_id]]
        reason = f"type {message.param_type}, wanted {parameter.kind}"
        if message.param_type == parameter.kind:
            value = parameter.unpack(struct.pack("<f", message.param_value))
            reason = self.change(parameter.name, value, request.t_s)
        return Reply([self._param(parameter)], reason and f"{parameter.name} refused: {reason}")

    def _param(self, parameter: Parameter) -> Message:
        name, value = parameter.name, parameter.pack(self.value(parameter))
        return _param_value(name, value, parameter.kind, INDEX[name])

    def _hash(self) -> Message:
        named = (each.name.encode() + each.pack(self.value(each)) for each in PARAMETERS)
        return _param_value(
            HASH, struct.pack("<I", crc32(b"".join(named))), mavlink.MAV_PARAM_TYPE_UINT32, NO_INDEX
        )


def _param_value(name: str, value: bytes, kind: int, index: int) -> Message:
    (packed,) = struct.unpack("<f", value)
    return mavlink.MAVLink_param_value_message(name.encode(), packed, kind, len(PARAMETERS), index)


def crc32(data: bytes) -> int:
    """Return PX4's checksum: CRC-32 that begins with 0 and is not inverted at its end."""
    return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF


def _unknown(request: Request) -> Reply:
    name, index = request.message.param_id, getattr(request.message, "param_index", -1)
    error = mavlink.MAVLink_param_error_message(
        *request.asker, name.encode(), index, mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST
    )
    return Reply([error], f"No parameter {name if index < 0 else index}")


def _no_extended(_: Request) -> Reply:
    return Reply([mavlink.MAVLink_param_ext_value_message(b"", b"", EXT_REAL, 0, NO_INDEX)])


def _extended_refused(request: Request) -> Reply:
    name, kind = request.message.param_id, getattr(request.message, "param_type", EXT_REAL)
    return Reply([mavlink.MAVLink_param_ext_ack_message(name.encode(), b"", kind, mavlink.PARAM_ACK_FAILED)])
