"""What vehicle and payload say to each other: "measure here, now", and the value."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import messages_in
from link.bus.mavlink import GAS_NAME, BadFrame, Codec, gas_message, split, wind_message

NUMBER_NAME = "sample"
# The payload's MAVLink component id; its system id is the vehicle's
PAYLOAD_COMPONENT = mavlink.MAV_COMP_ID_PERIPHERAL
LARGEST_FLOAT32 = 3.4028234e38  # largest float32: the wire carries no larger value
# Messages of a question or an answer: they share its time, with WIND_COV. Others are ignored.
TIMED = frozenset({"LOCAL_POSITION_NED", "NAMED_VALUE_INT", "NAMED_VALUE_FLOAT"})
WindVector = tuple[float, float]  # (u cos φ, u sin φ) m/s: points to where the wind comes from


class Question(NamedTuple):
    """Measure here, now. All floats are exact float32 values, as on the wire."""

    system: int  # MAVLink system id of the vehicle that asks
    time_boot_ms: int  # identifies the question and its answer
    number: int  # number of the reading, 0 at the start
    position: tuple[float, float]  # (x, y) m, x east, y north: where the vehicle reports to be
    wind: WindVector | None  # as the autopilot reports it; None if it reports none


class Sample(NamedTuple):
    """The payload's answer. All floats are exact float32 values, as on the wire."""

    time_boot_ms: int  # that of the question
    gas: float  # in the sensor's unit: g/m³, or a count of hits; NaN: the sensor has no value
    # (u cos φ, u sin φ) m/s, points to where the wind comes from; None if the payload does not know it
    wind: WindVector | None


def pack_question(
    codec: Codec,
    time_boot_ms: int,
    number: int,
    position: tuple[float, float, float],
    wind: WindVector | None,
) -> bytes:
    """Return the frames of a question; position is (north, east, down) m."""
    place = mavlink.MAVLink_local_position_ned_message(time_boot_ms, *position, 0.0, 0.0, 0.0)
    which = mavlink.MAVLink_named_value_int_message(time_boot_ms, NUMBER_NAME.encode(), number)
    return codec.pack(place, *([] if wind is None else [wind_message(time_boot_ms, wind)]), which)


def unpack_question(payload: bytes) -> Question:
    """Undo `pack_question`; raises BadFrame with the reason."""
    names = {"LOCAL_POSITION_NED": "", "NAMED_VALUE_INT": NUMBER_NAME}
    system, (place, counted), wind = _said(payload, "question", names)
    number = counted["value"]
    if number < 0:
        raise BadFrame(f"{NUMBER_NAME} is {number}; wanted a whole number from 0")
    position = place["y"], place["x"]
    if not all(map(math.isfinite, position)):
        raise BadFrame(f"position is not finite: {position}", "not finite")
    return Question(system, place["time_boot_ms"], number, position, wind)


def pack_answer(system: int, sample: Sample) -> bytes:
    """Return the frames of the answer to a vehicle."""
    time_boot_ms, gas, wind = sample
    winds = [] if wind is None else [wind_message(time_boot_ms, wind)]
    return Codec(system, PAYLOAD_COMPONENT).pack(gas_message(time_boot_ms, gas), *winds)


def unpack_answer(payload: bytes) -> Sample:
    """Undo `pack_answer`; raises BadFrame with the reason."""
    _, (gas,), wind = _said(payload, "answer", {"NAMED_VALUE_FLOAT": GAS_NAME})
    if math.isinf(gas["value"]):
        raise BadFrame(f"gas is {gas['value']}; wanted a finite value, or NaN for none", "not finite")
    return Sample(gas["time_boot_ms"], gas["value"], wind)


def _said(
    payload: bytes, what: str, names: Mapping[str, str]
) -> tuple[int, list[dict[str, Any]], WindVector | None]:
    """Return who sent a payload, the fields of the messages that it must have, and the wind.

    names: those messages by type, and the value that each names.
    """
    frames = split(payload)
    said, wind = messages_in(frames), None
    for kind, name in names.items():
        if kind not in said:
            raise BadFrame(f"the {what} has no {kind}")
        if (found := said[kind].get("name", name)) != name:
            raise BadFrame(f"{kind} is {found!r}, not {name!r}")
    times = {fields["time_boot_ms"] for kind, fields in said.items() if kind in TIMED}
    if air := said.get("WIND_COV"):
        times.add(air["time_usec"] // 1000)
        wind = -air["wind_y"], -air["wind_x"]
        if not all(map(math.isfinite, wind)):
            raise BadFrame(f"wind is not finite: {wind}", "not finite")
    if len(times) > 1:
        raise BadFrame(f"the frames of the {what} do not share one time_boot_ms")
    return frames[0].system, [said[kind] for kind in names], wind
