"""MAVLink 2 frames of the search: the reading that a vehicle publishes and the waypoint that answers it."""

import math
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import (
    LAYOUTS,
    MAVLINK_1,
    MAVLINK_2,
    SIGNED,
    Frame,
    checksums,
    frames_in,
    messages_in,
)

Message = Any  # a pymavlink message; the dialect is generated code without types

GAS_NAME = "gas"
# Types of a reading's messages, in their order.
READING_KINDS = ("LOCAL_POSITION_NED", "WIND_COV", "NAMED_VALUE_FLOAT")
NOT_WHOLE = "the payload is not made of whole MAVLink frames"
ONBOARD_COMPUTER = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER

WRAP_MS = 2**32  # time_boot_ms is a uint32: it wraps to zero after 49.7 days
# A clock that goes back has wrapped if its step modulo 2³² is at most this; else it restarted.
WRAPPED_MS = 3_600_000

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
    """One sample of gas and wind. All floats are exact float32 values, as on the wire.

    Attributes:
        time_boot_ms: Milliseconds since the start, modulo 2³²; identifies the reading.
        position: (x, y) m, x east, y north.
        altitude_m: Height above home, m.
        wind: (u cos φ, u sin φ) m/s: points to where the wind comes from.
        gas: In the sensor's unit: g/m³, or a count of hits.
        vehicle: Which vehicle of a fleet took it, from 1.

    Examples:
        >>> reading = plumeward.Reading(0, (2.0, 3.5), 5.0, (1.5, 0.0), 0.42)  # the wind comes from the east
        >>> reading.gas
        0.42
    """

    time_boot_ms: int
    position: tuple[float, float]
    altitude_m: float
    wind: tuple[float, float]
    gas: float
    vehicle: int = 1


def elapsed_ms(since: int, until: int) -> int:
    """Return the time from one time_boot_ms to another, ms, in [-2³¹, 2³¹).

    It is negative if `until` is the earlier one.
    """
    return (until - since + WRAP_MS // 2) % WRAP_MS - WRAP_MS // 2


def nearest(time_ms: int, time_boot_ms: int) -> int:
    """Return the time nearest to another that time_boot_ms may stand for, ms.

    It goes on where time_boot_ms wraps.
    """
    return time_ms + elapsed_ms(time_ms, time_boot_ms)


def continued(newest_ms: int, time_boot_ms: int) -> int:
    """Return a vehicle's own time, ms.

    It goes on from the newest known where time_boot_ms wraps, and begins anew when the vehicle does.
    """
    step = elapsed_ms(newest_ms, time_boot_ms)
    if abs(step) <= WRAPPED_MS and newest_ms + step >= 0:
        return newest_ms + step
    wraps, newest = divmod(newest_ms, WRAP_MS)
    return wraps * WRAP_MS + time_boot_ms if time_boot_ms > newest else time_boot_ms


class BadFrame(ValueError):
    """A payload that violates the bus contract; the text gives the reason."""

    def __init__(self, text: str, kind: str = "malformed") -> None:
        super().__init__(text)
        self.kind = kind


class Codec:
    """Packs messages for one MAVLink link; each link has its own sequence numbers."""

    def __init__(self, system: int, component: int) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)

    def pack(self, *messages: Message) -> bytes:
        """Return the concatenated frames of the messages."""
        frames = []
        for message in messages:
            frames.append(bytes(message.pack(self._mav)))
            self._mav.seq = (self._mav.seq + 1) % 256
        return b"".join(frames)


def split(payload: bytes) -> list[Frame]:
    """Return the frames of a payload; raises BadFrame unless it consists of whole, valid frames.

    The checksum of a frame of unknown type cannot be verified: it is accepted as it is.
    """
    frames = list(frames_in(payload))
    at = sum(len(frame.data) for frame in frames)
    if not frames or at < len(payload):
        raise BadFrame(f"malformed frame: {_fault(payload[at:])}")
    for frame in frames:
        if layout := LAYOUTS.get(frame.message_id):
            received, right = checksums(frame, layout.seed)
            if received != right:
                raise BadFrame(
                    f"malformed frame: invalid MAVLink CRC in msgID {frame.message_id} 0x{received:04x} "
                    f"should be 0x{right:04x}"
                )
    return frames


def _fault(rest: bytes) -> str:
    """Return the reason why these bytes begin with no frame."""
    if rest and rest[0] not in (MAVLINK_1, MAVLINK_2):
        return f"invalid MAVLink prefix '{rest[0]}'"
    if len(rest) > 2 and rest[0] == MAVLINK_2 and rest[2] & ~SIGNED:
        return f"invalid incompat_flags 0x{rest[2]:x}"
    return NOT_WHOLE


def unpack(payload: bytes) -> list[Message]:
    """Decode a payload of whole frames; raises BadFrame as `split` does."""
    return [message_of(frame) for frame in split(payload)]


_PARSER = mavlink.MAVLink(None)


def message_of(frame: Frame) -> Message:
    """Return the message of a whole frame, as pymavlink has it.

    Raises pymavlink's MAVError if its checksum is wrong.
    """
    return _PARSER.decode(bytearray(frame.data))


def wind_message(time_boot_ms: int, wind: tuple[float, float]) -> Message:
    """WIND_COV (231).

    It carries the velocity of the air, NED; `wind` points the other way, to where the wind comes from.
    """
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
    """Return the three frames of one sample, with the same time_boot_ms.

    Velocities are 0: the vehicle is at rest when it samples.
    """
    x, y = reading.position
    return codec.pack(
        mavlink.MAVLink_local_position_ned_message(
            reading.time_boot_ms, y, x, -reading.altitude_m, 0.0, 0.0, 0.0
        ),
        wind_message(reading.time_boot_ms, reading.wind),
        gas_message(reading.time_boot_ms, reading.gas),
    )


def unpack_reading(payload: bytes, system: int | None = None) -> Reading:
    """Undo `pack_reading`; raises BadFrame with the reason.

    If `system` is given, frames of another system are refused too.
    """
    frames = split(payload)
    if system is not None and (strangers := {frame.system for frame in frames} - {system}):
        raise BadFrame(
            f"a reading of system {min(strangers)}; this is the estimator of system {system}", "other vehicle"
        )
    messages = messages_in(frames)
    try:
        position, wind, gas = (messages[kind] for kind in READING_KINDS)
    except KeyError as missing:
        raise BadFrame(f"a reading without {missing.args[0]}") from None
    if gas["name"] != GAS_NAME:
        raise BadFrame(f"NAMED_VALUE_FLOAT is {gas['name']!r}, not {GAS_NAME!r}")
    if not position["time_boot_ms"] == gas["time_boot_ms"] == wind["time_usec"] // 1000:
        raise BadFrame("the frames of the reading do not share one time_boot_ms")
    reading = Reading(
        position["time_boot_ms"],
        (position["y"], position["x"]),
        -position["z"],
        (-wind["wind_y"], -wind["wind_x"]),
        gas["value"],
    )
    for name, field in zip(("position", "altitude", "wind", "gas"), reading[1:5], strict=True):
        if not all(map(math.isfinite, field if isinstance(field, tuple) else (field,))):
            raise BadFrame(f"{name} is not finite: {field}", "not finite")
    return reading


def waypoint_message(
    system: int, answers_time_boot_ms: int, position: tuple[float, float], altitude_m: float
) -> Message:
    """SET_POSITION_TARGET_LOCAL_NED (84) with the time_boot_ms of the reading that it answers.

    position: (x, y) m, x east, y north.
    """
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


def unpack_waypoint(payload: bytes, system: int) -> Message:
    """Return the SET_POSITION_TARGET_LOCAL_NED of a payload.

    Raises BadFrame if it is not one alone, or not for this system.
    """
    frames = split(payload)
    if len(frames) != 1 or frames[0].message_id != mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED:
        found = f"{len(frames)} frames" if len(frames) > 1 else f"message {frames[0].message_id}"
        raise BadFrame(f"{found}; wanted one SET_POSITION_TARGET_LOCAL_NED (84)")
    message = message_of(frames[0])
    to, ours = (message.target_system, message.target_component), (system, mavlink.MAV_COMP_ID_AUTOPILOT1)
    if any(asked not in (0, own) for asked, own in zip(to, ours, strict=True)):
        raise BadFrame(f"a waypoint for {to[0]}/{to[1]}; this is {ours[0]}/{ours[1]}", "other vehicle")
    return message


def unpack_plan(payload: bytes, system: int) -> tuple[Message, list[tuple[float, float]]]:
    """Return the waypoint of this system, of those that answer a round of several vehicles, and all places.

    The places, (x, y) m, are in the order of the vehicles. Raises BadFrame if it is something else, or has
    none for this system.
    """
    frames = split(payload)
    wanted = mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED
    if others := [frame.message_id for frame in frames if frame.message_id != wanted]:
        raise BadFrame(f"message {others[0]}; wanted SET_POSITION_TARGET_LOCAL_NED (84) alone")
    messages = [message_of(frame) for frame in frames]
    own = [message for message in messages if message.target_system == system]
    if len(own) != 1:
        asked = " ".join(str(message.target_system) for message in messages)
        raise BadFrame(f"waypoints for {asked}; wanted one for {system}", "other vehicle")
    return own[0], [(message.y, message.x) for message in messages]


# ---- long texts ----

TEXT_LENGTH = 50  # characters of one STATUSTEXT (253); a longer text comes in several
MOST_CHUNKS = 256


class Texts:
    """Joins the STATUSTEXTs of one sender."""

    def __init__(self) -> None:
        self._begun: dict[int, str] = {}

    def joined(self, text: str, number: int, chunk: int) -> str | None:
        """Take the text, `id` and `chunk_seq` of a STATUSTEXT.

        Return the text once it is whole, in printable characters.

        The first chunk that is not full ends a text. A text that is cut off is dropped when the next one
        begins.
        """
        whole = (self._begun.pop(number, "") if number and chunk else "") + text
        if (
            number
            and len(text) == TEXT_LENGTH
            and chunk < MOST_CHUNKS - 1
            and len(whole) < MOST_CHUNKS * TEXT_LENGTH
        ):
            self._begun = {number: whole}
            return None
        return "".join(letter if letter.isprintable() else "?" for letter in whole)
