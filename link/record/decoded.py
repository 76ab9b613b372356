"""Messages in a form that viewers can plot: flat JSON, with a JSON Schema for each kind.

Viewers such as Foxglove read only plain object schemas: no references, no unions (hence no null), no
tuples. A float that JSON cannot express (NaN, infinity) is therefore left out of its message.
"""

import math
from collections.abc import Iterator
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from link.bus.frames import DIALECT, LAYOUTS, fields_of
from link.bus.mavlink import split, unpack_reading

SIMULATION_S = {
    "type": "number",
    "description": "simulation time, s: the message's own if it has one, else the newest known",
}
SENDER = {
    "system": {"type": "integer", "description": "MAVLink system id of the sender"},
    "component": {"type": "integer", "description": "MAVLink component id of the sender"},
}
# JSON types of MAVLink types; all others are integers.
PLAIN = {"char": "string", "float": "number", "double": "number"}
TYPES = {message.msgname: message for message in DIALECT.values()}  # the message types by name
UNKNOWN = "UNKNOWN"  # type of messages that are not in the dialect


class FlatReading(msgspec.Struct, frozen=True):
    """One sample of gas and wind, in the search plane."""

    time_boot_ms: Annotated[
        int, Meta(ge=0, description="milliseconds since the start of the simulation, modulo 2³²")
    ]
    x: Annotated[float, Meta(description="place of the reading, m east of home")]
    y: Annotated[float, Meta(description="place of the reading, m north of home")]
    altitude_m: Annotated[float, Meta(description="height of the reading above home, m")]
    wind_x: Annotated[
        float, Meta(description="u cos φ, m/s: east component of the wind, pointing to where it comes from")
    ]
    wind_y: Annotated[
        float, Meta(description="u sin φ, m/s: north component of the wind, pointing to where it comes from")
    ]
    gas: Annotated[float, Meta(description="the reading, in the sensor's unit: g/m³, or a count of hits")]


class Malformed(msgspec.Struct, frozen=True):
    """A message that violates docs/bus.md."""

    reason: str
    payload: Annotated[bytes, Meta(description="as it was published")]


def decode(payload: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield type and JSON of the messages of a payload; raises BadFrame as `split` does.

    The JSON is an object with the message's fields, and its sender's system and component. pymavlink's own
    decoder is not used: it takes 10 µs per frame, and a vehicle at --speedup 0 sends thousands a second.
    """
    for frame in split(payload):
        layout = LAYOUTS.get(frame.message_id)
        fields: dict[str, Any] = {"data": list(frame.data)} if layout is None else fields_of(frame)
        fields["system"], fields["component"] = frame.system, frame.component
        yield UNKNOWN if layout is None else layout.kind, _encoded(fields)


def decode_reading(payload: bytes) -> FlatReading:
    """Return a reading as viewers show it; raises BadFrame with the same reason as the estimator."""
    reading = unpack_reading(payload)
    return FlatReading(
        reading.time_boot_ms, *reading.position, reading.altitude_m, *reading.wind, reading.gas
    )


encode = msgspec.json.Encoder().encode


def _encoded(fields: dict[str, Any]) -> bytes:
    """Encode as JSON, without the values that would become null (NaN, infinity)."""
    text = encode(fields)
    return (
        encode({name: value for name, value in fields.items() if _is_finite(value)})
        if b"null" in text
        else text
    )


def _is_finite(value: Any) -> bool:
    values = value if isinstance(value, list) else [value]
    return all(math.isfinite(each) for each in values if isinstance(each, float))


def struct_schema(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the schema of a JSON message as recorded, that is with its simulation time."""
    known = msgspec.json.schema_components([kind])[1]
    schema: dict[str, Any] = known[kind.__name__]
    for field in schema["properties"].values():
        if reference := field.get("items", {}).get("$ref") if isinstance(field.get("items"), dict) else None:
            field["items"] = _flat(known[reference.rpartition("/")[2]])
        if "prefixItems" in field:
            field["items"] = field.pop("prefixItems")[0]
        if "additionalProperties" in field:
            field["properties"] = {}
    return {
        **schema,
        "properties": {**schema["properties"], "simulation_s": SIMULATION_S},
        "required": [*schema["required"], "simulation_s"],
    }


def _flat(schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of an object in a list, without tuples."""
    for field in schema["properties"].values():
        if "prefixItems" in field:
            field["items"] = field.pop("prefixItems")[0]
    return schema


def message_schema(kind: str) -> dict[str, Any]:
    """Return the schema of a MAVLink message type."""
    properties: dict[str, Any] = {}
    required: list[str] = []
    if kind == UNKNOWN:
        properties["data"] = {"type": "array", "items": {"type": "integer"}, "description": "the whole frame"}
    else:
        message = TYPES[kind]
        counts = LAYOUTS[message.id].counts
        types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
        required = [name for name, wire_type in types.items() if wire_type not in ("float", "double")]
        for name, wire_type in types.items():
            value = {"type": PLAIN.get(wire_type, "integer")}
            about = message.fieldunits_by_name.get(name), message.fieldenums_by_name.get(name)
            properties[name] = {
                **({"type": "array", "items": value} if counts[name] > 1 else value),
                **({"description": " ".join(filter(None, about))} if any(about) else {}),
            }
    properties |= {**SENDER, "simulation_s": SIMULATION_S}
    return {
        "title": kind,
        "type": "object",
        "properties": properties,
        "required": [*required, *SENDER, "simulation_s"],
    }
