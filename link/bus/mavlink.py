"""MAVLink 2 frames of the search: the reading that a vehicle publishes and the waypoint that answers it."""

import math
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

Message = Any
"""A pymavlink message; the dialect is generated code without types."""

GAS_NAME = "gas"
ONBOARD_COMPUTER = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER

POSITION_ONLY = (
    mavlink.POSITION_TARGET_TYPEMASK_VX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VZ_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
)


class Reading(NamedTuple):
    """One sample of gas and wind. All its floats are exact float32 values, as the wire carries them."""

    time_boot_ms: int
    position: tuple[float, float]
    """(x, y) m, x east, y north."""
    altitude_m: float
    wind: tuple[float, float]
    """(u cos φ, u sin φ) m/s: points to where the wind comes from."""
    gas: float


class BadFrame(ValueError):
    """What arrived is not what the contract says; the text gives the reason."""

    def __init__(self, text: str, kind: str = "malformed") -> None:
        """Take the reason, and what it is counted under."""
        super().__init__(text)
        self.kind = kind


class Codec:
    """Packs messages for one MAVLink link: each link counts its own sequence numbers."""

    def __init__(self, system: int, component: int) -> None:
        """Take the sender's system and component id."""
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)

    def pack(self, *messages: Message) -> bytes:
        """Return the frames of the messages, one after the other."""
        frames = []
        for message in messages:
            frames.append(bytes(message.pack(self._mav)))
            self._mav.seq = (self._mav.seq + 1) % 256
        return b"".join(frames)


def unpack(payload: bytes) -> list[Message]:
    """Decode a payload of whole frames; raises BadFrame where any byte of it is not one."""
    try:
        messages: list[Message] | None = mavlink.MAVLink(None).parse_buffer(payload)
    except mavlink.MAVError as error:
        raise BadFrame(f"malformed frame: {error}") from None
    if not messages or sum(len(m.get_msgbuf()) for m in messages) != len(payload):
        raise BadFrame("malformed frame: the payload is not made of whole MAVLink frames")
    return messages


def wind_message(time_boot_ms: int, wind: tuple[float, float]) -> Message:
    """WIND_COV (231) carries the air's velocity, NED; our wind points the other way, to where it comes from."""
    return mavlink.MAVLink_wind_cov_message(
        time_usec=time_boot_ms * 1000,
        wind_x=-wind[1],
        wind_y=-wind[0],
        wind_z=0.0,
        var_horiz=0.0,
        var_vert=0.0,
        wind_alt=math.nan,
        horiz_accuracy=0.0,
        vert_accuracy=0.0,
    )


def gas_message(time_boot_ms: int, gas: float) -> Message:
    """NAMED_VALUE_FLOAT (251) `gas`, g/m³."""
    return mavlink.MAVLink_named_value_float_message(time_boot_ms, GAS_NAME.encode(), gas)


def pack_reading(codec: Codec, reading: Reading) -> bytes:
    """Return the three frames of one sample, all of one time_boot_ms; the vehicle is at rest when it samples."""
    x, y = reading.position
    position = mavlink.MAVLink_local_position_ned_message(reading.time_boot_ms, y, x, -reading.altitude_m, 0.0, 0.0, 0.0)
    return codec.pack(position, wind_message(reading.time_boot_ms, reading.wind), gas_message(reading.time_boot_ms, reading.gas))


def unpack_reading(payload: bytes, system: int | None = None) -> Reading:
    """Undo `pack_reading`; raises BadFrame with the reason. With `system`, frames of any other vehicle are bad ones."""
    messages = {m.get_type(): m for m in unpack(payload)}
    if system is not None and (strangers := {m.get_srcSystem() for m in messages.values()} - {system}):
        raise BadFrame(f"a reading of system {min(strangers)}; this is the estimator of system {system}", "other vehicle")
    try:
        position, wind, gas = messages["LOCAL_POSITION_NED"], messages["WIND_COV"], messages["NAMED_VALUE_FLOAT"]
    except KeyError as missing:
        raise BadFrame(f"a reading without {missing.args[0]}") from None
    if gas.name != GAS_NAME:
        raise BadFrame(f"NAMED_VALUE_FLOAT is {gas.name!r}, not {GAS_NAME!r}")
    if not position.time_boot_ms == gas.time_boot_ms == wind.time_usec // 1000:
        raise BadFrame("the frames of the reading do not share one time_boot_ms")
    reading = Reading(position.time_boot_ms, (position.y, position.x), -position.z, (-wind.wind_y, -wind.wind_x), gas.value)
    for name, value in (("position", reading.position), ("altitude", reading.altitude_m), ("wind", reading.wind), ("gas", reading.gas)):
        if not all(map(math.isfinite, value if isinstance(value, tuple) else (value,))):
            raise BadFrame(f"{name} is not finite: {value}", "not finite")
    return reading


def waypoint_message(system: int, answers_time_boot_ms: int, position: tuple[float, float], altitude_m: float) -> Message:
    """SET_POSITION_TARGET_LOCAL_NED (84) whose time_boot_ms is that of the reading it answers."""
    return mavlink.MAVLink_set_position_target_local_ned_message(
        time_boot_ms=answers_time_boot_ms,
        target_system=system,
        target_component=mavlink.MAV_COMP_ID_AUTOPILOT1,
        coordinate_frame=mavlink.MAV_FRAME_LOCAL_NED,
        type_mask=POSITION_ONLY,
        x=position[1],
        y=position[0],
        z=-altitude_m,
        vx=0.0,
        vy=0.0,
        vz=0.0,
        afx=0.0,
        afy=0.0,
        afz=0.0,
        yaw=0.0,
        yaw_rate=0.0,
    )
