"""Messages as viewers can plot them: flat JSON, and a JSON Schema of each kind.

Viewers such as Foxglove read plain object schemas only: no references, no unions (so no null either), no tuples. A float that JSON
cannot say (NaN, infinity) is therefore left out of its message.
"""

import math
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta
from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import LAYOUTS, fields_of
from link.bus.mavlink import split, unpack_reading

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


def decode(payload: bytes) -> list[Decoded]:
    """Decode a payload of whole frames; raises BadFrame where any byte of it is not one.

    A vehicle at --speedup 0 sends thousands of frames a second, each of which would take pymavlink 10 µs.
    """
    messages = []
    for frame in split(payload):
        layout = LAYOUTS.get(frame.message_id)
        said: dict[str, Any] = {"data": list(payload[frame.start : frame.end])} if layout is None else fields_of(payload, frame, layout)
        said["system"], said["component"] = frame.system, frame.component
        messages.append(Decoded(UNKNOWN if layout is None else layout.kind, _encoded(said)))
    return messages


def decode_reading(payload: bytes) -> FlatReading:
    """Return the reading that a payload is; raises BadFrame where it is none, with the estimator's reason."""
    reading = unpack_reading(payload)
    return FlatReading(reading.time_boot_ms, *reading.position, reading.altitude_m, *reading.wind, reading.gas)


encode = msgspec.json.Encoder().encode


def _encoded(fields: dict[str, Any]) -> bytes:
    """JSON; what it cannot say would become null, and is left out."""
    text = encode(fields)
    return encode({name: value for name, value in fields.items() if _sayable(value)}) if b"null" in text else text


def _sayable(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    return not isinstance(value, list) or all(map(_sayable, value))


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
