"""Messages as viewers can plot them: flat JSON, and a JSON Schema of each kind.

Viewers such as Foxglove read plain object schemas only: no references, no unions (so no null either), no tuples. A float that JSON
cannot say (NaN, infinity) is therefore left out of its message.
"""

import itertools
import math
import struct
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta
from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import GAS_NAME, Message, unpack, unpack_reading

SIMULATION_S = {"type": "number", "description": "simulation time, s: the message's own where it has one, else the newest one known"}
SENDER = {
    "system": {"type": "integer", "description": "MAVLink system id of the sender"},
    "component": {"type": "integer", "description": "MAVLink component id of the sender"},
}
PLAIN = {"char": "string", "float": "number", "double": "number"}
"""JSON types of MAVLink's; all others are integers."""
UNKNOWN = "UNKNOWN"
"""Type of the messages that the dialect does not know."""


class FlatReading(msgspec.Struct, frozen=True):
    """One sample of gas and wind, in the search plane."""

    time_boot_ms: Annotated[int, Meta(ge=0, description="milliseconds since the start of the simulation")]
    x: Annotated[float, Meta(description="where it was taken, m east of home")]
    y: Annotated[float, Meta(description="where it was taken, m north of home")]
    altitude_m: Annotated[float, Meta(description="height above home at which it was taken")]
    wind_x: Annotated[float, Meta(description="u cos φ, m/s: the wind's east part, to where it comes from")]
    wind_y: Annotated[float, Meta(description="u sin φ, m/s: the wind's north part, to where it comes from")]
    gas: Annotated[float, Meta(description="the reading, in the sensor's unit: g/m³, or a count of hits")]


class Malformed(msgspec.Struct, frozen=True):
    """What was published but is not what docs/bus.md says."""

    reason: str
    payload: Annotated[bytes, Meta(description="as it was published")]


class Decoded(NamedTuple):
    """One MAVLink message of a payload."""

    kind: str
    fields: bytes
    """A JSON object: its fields, and who sent it."""
    frame: bytes


def decode(payload: bytes) -> list[Decoded]:
    """Decode a payload of whole frames; raises BadFrame where any byte of it is not one.

    A vehicle at --speedup 0 sends thousands of frames a second, of which pymavlink takes 10 µs each. So frames of the usual kind
    (MAVLink 2, not signed, known to the dialect) are decoded here; with any other, the payload is left to pymavlink.
    """
    messages = _decode_fast(payload)
    return [_decoded(message) for message in unpack(payload)] if messages is None else messages


def decode_reading(payload: bytes, messages: list[Decoded]) -> FlatReading:
    """Return the reading that a payload and its messages are; raises BadFrame where they are none."""
    try:
        position, wind, gas = (msgspec.json.decode(message.fields) for message in messages)
        times = {position["time_boot_ms"], gas["time_boot_ms"], wind["time_usec"] // 1000}
        if len(times) == 1 and [message.kind for message in messages] == READING_KINDS and gas["name"] == GAS_NAME:
            place, air = (position["y"], position["x"], -position["z"]), (-wind["wind_y"], -wind["wind_x"])
            return FlatReading(position["time_boot_ms"], *place, *air, gas["value"])
    except (KeyError, ValueError):
        pass
    reading = unpack_reading(payload)  # unusual: it says whether and why it is none
    return FlatReading(reading.time_boot_ms, *reading.position, reading.altitude_m, *reading.wind, reading.gas)


class _Layout(NamedTuple):
    """How a type of message lies in its frame."""

    kind: str
    size: int
    crc_extra: bytes
    unpack: Callable[[bytes], tuple[Any, ...]]
    counts: dict[str, int]
    """Of each field, in the frame's order, the length of its array; 1 where it is none."""
    plain: bool
    """It has neither arrays nor text."""


def _layout(message: Any) -> _Layout:
    types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
    lengths = zip(message.ordered_fieldnames, message.array_lengths, strict=True)
    counts = {name: 1 if types[name] == "char" else max(length, 1) for name, length in lengths}
    plain = set(counts.values()) == {1} and "char" not in types.values()
    return _Layout(message.msgname, message.unpacker.size, bytes([message.crc_extra]), message.unpacker.unpack, counts, plain)


LAYOUTS = {message_id: _layout(message) for message_id, message in mavlink.mavlink_map.items()}
HEADER = struct.Struct("<BBBxxBBHB")
"""Magic, length, flags, sender's system and component, the low and the high part of the message id."""
MAVLINK_2 = 0xFD
READING_KINDS = ["LOCAL_POSITION_NED", "WIND_COV", "NAMED_VALUE_FLOAT"]
crc16 = mavlink.mcrf4xx or (lambda data: mavlink.x25crc(data).crc)
encode = msgspec.json.Encoder().encode


def _decode_fast(payload: bytes) -> list[Decoded] | None:
    messages = []
    at, end = 0, len(payload)
    while at < end:
        if end - at < HEADER.size + 2:
            return None
        magic, length, flags, system, component, low, high = HEADER.unpack_from(payload, at)
        layout = LAYOUTS.get(low | high << 16)
        crc_at = at + HEADER.size + length
        if magic != MAVLINK_2 or flags or layout is None or crc_at + 2 > end:
            return None
        if crc16(payload[at + 1 : crc_at] + layout.crc_extra) != payload[crc_at] | payload[crc_at + 1] << 8:
            return None
        values = layout.unpack(payload[at + HEADER.size : crc_at][: layout.size].ljust(layout.size, b"\0"))
        fields = dict(zip(layout.counts, values, strict=True)) if layout.plain else _grouped(values, layout.counts)
        fields["system"], fields["component"] = system, component
        messages.append(Decoded(layout.kind, _encoded(fields), payload[at : crc_at + 2]))
        at = crc_at + 2
    return messages or None


def _grouped(values: tuple[Any, ...], counts: dict[str, int]) -> dict[str, Any]:
    rest = iter(values)
    fields = {name: next(rest) if count == 1 else list(itertools.islice(rest, count)) for name, count in counts.items()}
    return {name: _text(value) if isinstance(value, bytes) else value for name, value in fields.items()}


def _text(value: bytes) -> str:
    return value.partition(b"\0")[0].decode("ascii", errors="replace")


def _encoded(fields: dict[str, Any]) -> bytes:
    """JSON; what it cannot say would become null, and is left out."""
    text = encode(fields)
    return encode({name: value for name, value in fields.items() if _sayable(value)}) if b"null" in text else text


def _sayable(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return not isinstance(value, list) or all(map(_sayable, value))


def _decoded(message: Message) -> Decoded:
    frame, fields = bytes(message.get_msgbuf()), message.to_dict()
    kind = fields.pop("mavpackettype")
    if kind.startswith(UNKNOWN):
        kind, fields = UNKNOWN, {"data": list(frame)}
    sender = 5 if frame[0] == MAVLINK_2 else 3
    fields["system"], fields["component"] = frame[sender], frame[sender + 1]
    return Decoded(kind, _encoded(fields), frame)


def struct_schema(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the schema of a JSON message with the simulation time that it is recorded with."""
    schema: dict[str, Any] = msgspec.json.schema_components([kind])[1][kind.__name__]
    for field in schema["properties"].values():
        if "prefixItems" in field:
            field["items"] = field.pop("prefixItems")[0]
        if "additionalProperties" in field:
            field["properties"] = {}
    properties, required = {**schema["properties"], "simulation_s": SIMULATION_S}, [*schema["required"], "simulation_s"]
    return {**schema, "properties": properties, "required": required}


def message_schema(kind: str) -> dict[str, Any]:
    """Return the schema of a type of MAVLink message."""
    properties: dict[str, Any] = {}
    required: list[str] = []
    if kind == UNKNOWN:
        properties["data"] = {"type": "array", "items": {"type": "integer"}, "description": "the whole frame"}
    else:
        message = mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{kind}")]
        counts = LAYOUTS[message.id].counts
        for name, wire_type in zip(message.fieldnames, message.fieldtypes, strict=True):
            field: dict[str, Any] = {"type": PLAIN.get(wire_type, "integer")}
            if counts[name] > 1:
                field = {"type": "array", "items": field}
            if about := " ".join(filter(None, (message.fieldunits_by_name.get(name), message.fieldenums_by_name.get(name)))):
                field["description"] = about
            properties[name] = field
            if wire_type not in ("float", "double"):
                required.append(name)
    properties |= {**SENDER, "simulation_s": SIMULATION_S}
    return {"title": kind, "type": "object", "properties": properties, "required": [*required, *SENDER, "simulation_s"]}
