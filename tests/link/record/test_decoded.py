"""Protects the data for viewers: decoded as by pymavlink, with schemas that the simplest viewer can read."""

import json
import math
import random
from typing import Any

import jsonschema
import pytest
from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import BadFrame, Codec, Reading, gas_message, pack_reading, unpack
from link.bus.messages import Belief, Health, Stop
from link.bus.px4 import ADDED
from link.record.decoded import FlatReading, Malformed, decode, decode_reading, message_schema, struct_schema

NUMBER = {kind.msgname: number for number, kind in mavlink.mavlink_map.items()}
TYPES = list(NUMBER)
STRUCTS = [Belief, Stop, Health, FlatReading, Malformed]
READING = Reading(3000, (3.25, 4.5), 5.0, (2.0, -1.0), 0.75)
POSITION, WIND, _ = (bytes(message.get_msgbuf()) for message in unpack(pack_reading(Codec(1, 1), READING)))


def frame(kind: str, payload: bytes, flags: int = 0) -> bytes:
    """A hand-made MAVLink 2 frame: header, payload, and the checksum over both and CRC_EXTRA."""
    message = mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{kind}")]
    head = bytes([0xFD, len(payload), flags, 0, 7, 42, 191]) + message.id.to_bytes(3, "little")
    crc = mavlink.x25crc(head[1:] + payload + bytes([message.crc_extra])).crc
    return head + payload + crc.to_bytes(2, "little")


def by_pymavlink(payload: bytes) -> list[dict[str, Any]]:
    """The frame decoded by pymavlink, without the values that JSON cannot express."""
    found = []
    for message in mavlink.MAVLink(None).parse_buffer(payload):
        fields = message.to_dict()
        del fields["mavpackettype"]
        fields |= {"system": message.get_srcSystem(), "component": message.get_srcComponent()}
        found.append({name: value for name, value in fields.items() if sayable(value)})
    return found


def sayable(value: object) -> bool:
    return (
        all(map(sayable, value))
        if isinstance(value, list)
        else not isinstance(value, float) or math.isfinite(value)
    )


@pytest.mark.parametrize("kind", [kind for kind in TYPES if NUMBER[kind] not in ADDED])
def test_every_type_of_message_is_decoded_as_pymavlink_does_and_keeps_to_its_schema(kind: str) -> None:
    rng = random.Random(kind)
    size = mavlink.mavlink_map[getattr(mavlink, f"MAVLINK_MSG_ID_{kind}")].unpacker.size
    schema = {**message_schema(kind), "additionalProperties": False}
    for length in (
        size,
        rng.randint(1, size),
        min(size + 3, 255),
    ):  # whole; without trailing zeros; of a later version
        for make in (rng.randbytes, lambda length: b"\xff" * length):  # a float with all bits set is NaN
            payload = frame(kind, make(length)) + frame("HEARTBEAT", bytes(9))
            kinds, texts = zip(*decode(payload), strict=True)
            assert [json.loads(text) for text in texts] == by_pymavlink(payload)
            assert kinds == (kind, "HEARTBEAT")
            jsonschema.validate({**json.loads(texts[0]), "simulation_s": 1.5}, schema)


def test_unusual_frames_are_decoded_too() -> None:
    signed = frame("HEARTBEAT", bytes(9), flags=1) + bytes(13)
    unknown = bytes([0xFD, 1, 0, 0, 0, 42, 191, 0xFF, 0xFF, 0, 5, 0, 0])
    old = gas_message(1000, 0.5).pack(
        mavlink.MAVLink(None, srcSystem=42, srcComponent=191), force_mavlink1=True
    )
    kinds = {}
    for payload in (signed, unknown, bytes(old)):
        ((kind, text),) = decode(payload)
        fields = json.loads(text)
        assert (fields["system"], fields["component"]) == (42, 191)
        jsonschema.validate(
            {**fields, "simulation_s": 1.5}, {**message_schema(kind), "additionalProperties": False}
        )
        kinds[kind] = fields
    assert set(kinds) == {"HEARTBEAT", "UNKNOWN", "NAMED_VALUE_FLOAT"}
    assert kinds["UNKNOWN"]["data"] == list(unknown)


@pytest.mark.parametrize(
    "damage",
    [
        lambda b: b[:-1],
        lambda b: b[1:],
        lambda b: b + b"\x00",
        lambda b: b[:20] + b"\x55" + b[21:],
        lambda b: b"",
    ],
)
def test_damaged_frames_are_refused_with_a_reason(damage) -> None:
    with pytest.raises(BadFrame, match="malformed frame"):
        list(decode(damage(pack_reading(Codec(1, 1), READING))))


def test_a_reading_is_flat_in_the_search_plane() -> None:
    payload = pack_reading(Codec(1, 1), READING)
    assert decode_reading(payload) == FlatReading(3000, 3.25, 4.5, 5.0, 2.0, -1.0, 0.75)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (pack_reading(Codec(1, 1), READING._replace(gas=math.nan)), "gas is not finite"),
        (POSITION, "a reading without WIND_COV"),
        (POSITION + WIND + Codec(1, 1).pack(gas_message(2999, 0.5)), "do not share one time_boot_ms"),
    ],
    ids=["gas", "wind", "times"],
)
def test_what_is_no_reading_is_refused_with_the_estimators_reason(payload: bytes, reason: str) -> None:
    with pytest.raises(BadFrame, match=reason):
        decode_reading(payload)


@pytest.mark.parametrize(
    "schema",
    [*map(message_schema, [*TYPES, "UNKNOWN"]), *map(struct_schema, STRUCTS)],
    ids=lambda schema: schema["title"],
)
def test_a_schema_is_one_that_viewers_can_read(schema: dict[str, Any]) -> None:
    """By the rules of Foxglove's reader, the strictest: a plain object with plain fields at every level."""
    jsonschema.Draft202012Validator.check_schema(schema)

    def check(part: dict[str, Any]) -> None:
        assert part["type"] == "object"
        for field in part["properties"].values():
            assert "oneOf" not in field
            assert "$ref" not in field
            if field["type"] == "object":
                check(field)
            elif field["type"] == "array" and field["items"]["type"] == "object":
                check(field["items"])  # as in Foxglove's own SceneUpdate
            elif field["type"] == "array":
                assert field["items"]["type"] in ("boolean", "string", "number", "integer")
            else:
                assert field["type"] in ("boolean", "string", "number", "integer")
            assert field.get("contentEncoding", "base64") == "base64"

    check(schema)
    assert "simulation_s" in schema["required"]
