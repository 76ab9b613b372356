"""What vehicle and payload say to each other: "measure here, now", and the value."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import messages_in
from link.bus.mavlink import GAS_NAME, BadFrame, Codec, gas_message, split, wind_message

NUMBER_NAME = "sample"
PAYLOAD_COMPONENT = mavlink.MAV_COMP_ID_PERIPHERAL
"""The payload's MAVLink component id; its system id is the vehicle's."""
LARGEST = 3.4028234e38
"""Largest float32: the wire carries no larger value."""
TIMED = frozenset({"LOCAL_POSITION_NED", "WIND_COV", "NAMED_VALUE_INT", "NAMED_VALUE_FLOAT"})
"""Messages of one question or answer: they share its time. Others beside them are ignored."""
Wind = tuple[float, float]
"""(u cos φ, u sin φ) m/s: points to where the wind comes from."""


class Question(NamedTuple):
    """Measure here, now. All floats are exact float32 values, as on the wire."""

    system: int
    """MAVLink system id of the vehicle that asks."""
    time_boot_ms: int
    """Identifies the question and its answer."""
    number: int
    """Number of the reading, 0 at the start."""
    position: tuple[float, float]
    """(x, y) m, x east, y north: where the vehicle reports to be."""
    wind: Wind | None
    """As the autopilot reports it; None if it reports none."""


class Sample(NamedTuple):
    """The payload's answer. All floats are exact float32 values, as on the wire."""

    time_boot_ms: int
    """That of the question."""
    gas: float
    """In the sensor's unit: g/m³, or a count of hits; NaN: the sensor has no value."""
    wind: Wind | None
    """(u cos φ, u sin φ) m/s, points to where the wind comes from; None if the payload does not know it.
    """


def pack_question(
    codec: Codec, time_boot_ms: int, number: int, position: tuple[float, float, float], wind: Wind | None
) -> bytes:
    """Return the frames of a question; position is (north, east, down) m."""
    place = mavlink.MAVLink_local_position_ned_message(time_boot_ms, *position, 0.0, 0.0, 0.0)
    which = mavlink.MAVLink_named_value_int_message(time_boot_ms, NUMBER_NAME.encode(), number)
    return codec.pack(place, *([] if wind is None else [wind_message(time_boot_ms, wind)]), which)


def unpack_question(payload: bytes) -> Question:
    """Undo `pack_question`; raises BadFrame with the reason."""
    said, system = _said(payload)
    place, which = (
        _wanted(said, "LOCAL_POSITION_NED", "question"),
        _wanted(said, "NAMED_VALUE_INT", "question"),
    )
    _check_name(which, "NAMED_VALUE_INT", NUMBER_NAME)
    wind = _wind(said)
    _check_times(said, place["time_boot_ms"], "question")
    if which["value"] < 0:
        raise BadFrame(f"{NUMBER_NAME} is {which['value']}; wanted a whole number from 0")
    position = place["y"], place["x"]
    if not all(map(math.isfinite, position)):
        raise BadFrame(f"position is not finite: {position}", "not finite")
    return Question(system, place["time_boot_ms"], which["value"], position, wind)


def pack_answer(system: int, sample: Sample) -> bytes:
    """Return the frames of the answer to a vehicle."""
    time_boot_ms, gas, wind = sample
    winds = [] if wind is None else [wind_message(time_boot_ms, wind)]
    return Codec(system, PAYLOAD_COMPONENT).pack(gas_message(time_boot_ms, gas), *winds)


def unpack_answer(payload: bytes) -> Sample:
    """Undo `pack_answer`; raises BadFrame with the reason."""
    said, _ = _said(payload)
    gas = _wanted(said, "NAMED_VALUE_FLOAT", "answer")
    _check_name(gas, "NAMED_VALUE_FLOAT", GAS_NAME)
    wind = _wind(said)
    _check_times(said, gas["time_boot_ms"], "answer")
    if math.isinf(gas["value"]):
        raise BadFrame(f"gas is {gas['value']}; wanted a finite value, or NaN for none", "not finite")
    return Sample(gas["time_boot_ms"], gas["value"], wind)


Said = Mapping[str, Mapping[str, Any]]
"""The fields of a payload's messages, by message type."""


def _said(payload: bytes) -> tuple[Said, int]:
    """Return the messages of a payload, and the system id of its first frame."""
    frames = split(payload)
    return messages_in(frames), frames[0].system


def _wanted(said: Said, kind: str, what: str) -> Mapping[str, Any]:
    if kind not in said:
        article = "an" if what == "answer" else "a"
        raise BadFrame(f"{article} {what} without {kind}")
    return said[kind]


def _check_name(message: Mapping[str, Any], kind: str, name: str) -> None:
    if message["name"] != name:
        raise BadFrame(f"{kind} is {message['name']!r}, not {name!r}")


def _check_times(said: Said, time_boot_ms: int, what: str) -> None:
    for kind, message in said.items():
        if (
            kind in TIMED
            and (message["time_usec"] // 1000 if kind == "WIND_COV" else message["time_boot_ms"])
            != time_boot_ms
        ):
            raise BadFrame(f"the frames of the {what} do not share one time_boot_ms")


def _wind(said: Said) -> Wind | None:
    if "WIND_COV" not in said:
        return None
    wind = -said["WIND_COV"]["wind_y"], -said["WIND_COV"]["wind_x"]
    if not all(map(math.isfinite, wind)):
        raise BadFrame(f"wind is not finite: {wind}", "not finite")
    return wind
