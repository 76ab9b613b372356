"""Protects what vehicle and payload say to each other: read field by field with pymavlink, and refused
where it is malformed.
"""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from aircraft.payload.messages import (
    Question,
    Sample,
    pack_answer,
    pack_question,
    unpack_answer,
    unpack_question,
)
from link.bus.mavlink import BadFrame, Codec

float32 = st.floats(-1000, 1000, width=32)
times = st.integers(0, 2**32 - 1)
winds = st.none() | st.tuples(float32, float32)
T = 1234


def place(time_boot_ms: int = T, north: float = 1.0) -> object:
    return mavlink.MAVLink_local_position_ned_message(time_boot_ms, north, 2.0, -5.0, 0.0, 0.0, 0.0)


def number(value: int = 3, name: bytes = b"sample", time_boot_ms: int = T) -> object:
    return mavlink.MAVLink_named_value_int_message(time_boot_ms, name, value)


def air(time_boot_ms: int = T, north: float = 1.0) -> object:
    return mavlink.MAVLink_wind_cov_message(time_boot_ms * 1000, north, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def gas(value: float = 1.0, name: bytes = b"gas", time_boot_ms: int = T) -> object:
    return mavlink.MAVLink_named_value_float_message(time_boot_ms, name, value)


def frames(*messages: object) -> bytes:
    return Codec(1, 1).pack(*messages)


def test_a_question_says_place_wind_and_number_in_standard_messages() -> None:
    said = mavlink.MAVLink(None).parse_buffer(
        pack_question(Codec(7, 1), T, 3, (4.25, 3.5, -5.0), (1.5, -0.5))
    )
    position, wind, which = said
    assert {m.get_srcSystem() for m in said} == {7}
    assert (position.get_type(), position.time_boot_ms, position.x, position.y, position.z) == (
        "LOCAL_POSITION_NED",
        T,
        4.25,
        3.5,
        -5.0,
    )
    assert (wind.get_type(), wind.time_usec, wind.wind_x, wind.wind_y) == (
        "WIND_COV",
        1_234_000,
        0.5,
        -1.5,
    )  # from the east: west
    assert (which.get_type(), which.time_boot_ms, which.name, which.value) == (
        "NAMED_VALUE_INT",
        T,
        "sample",
        3,
    )


def test_an_answer_says_gas_and_wind_in_standard_messages_of_the_vehicles_system() -> None:
    value, wind = mavlink.MAVLink(None).parse_buffer(pack_answer(7, Sample(T, 0.75, (1.5, -0.5))))
    assert (value.get_srcSystem(), value.get_srcComponent()) == (7, mavlink.MAV_COMP_ID_PERIPHERAL)
    assert (value.get_type(), value.time_boot_ms, value.name, value.value) == (
        "NAMED_VALUE_FLOAT",
        T,
        "gas",
        0.75,
    )
    assert (wind.get_type(), wind.time_usec, wind.wind_x, wind.wind_y) == ("WIND_COV", 1_234_000, 0.5, -1.5)


@given(times, st.integers(0, 2**31 - 1), float32, float32, winds)
def test_a_question_survives_the_wire_to_the_last_bit(
    time: int, which: int, x: float, y: float, wind: tuple[float, float] | None
) -> None:
    assert unpack_question(pack_question(Codec(9, 1), time, which, (y, x, -5.0), wind)) == Question(
        9, time, which, (x, y), wind
    )


@given(times, float32, winds)
def test_an_answer_survives_the_wire_to_the_last_bit(
    time: int, value: float, wind: tuple[float, float] | None
) -> None:
    assert unpack_answer(pack_answer(9, Sample(time, value, wind))) == Sample(time, value, wind)


def test_a_sensor_without_a_value_answers_nan() -> None:
    sample = unpack_answer(pack_answer(1, Sample(T, math.nan, None)))
    assert math.isnan(sample.gas)
    assert sample.wind is None


def test_messages_of_other_types_beside_them_are_ignored() -> None:
    beat = mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    assert unpack_question(frames(beat, place(), number())) == Question(1, T, 3, (2.0, 1.0), None)
    assert unpack_answer(frames(gas(), beat)) == Sample(T, 1.0, None)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "not made of whole MAVLink frames"),
        (frames(place(), number())[:-1], "not made of whole MAVLink frames"),
        (frames(number()), "the question has no LOCAL_POSITION_NED"),
        (frames(place()), "the question has no NAMED_VALUE_INT"),
        (frames(place(), number(name=b"other")), "NAMED_VALUE_INT is 'other', not 'sample'"),
        (
            frames(place(), number(time_boot_ms=T + 1)),
            "the frames of the question do not share one time_boot_ms",
        ),
        (frames(place(), air(T + 1), number()), "the frames of the question do not share one time_boot_ms"),
        (frames(place(), number(-1)), "sample is -1; wanted a whole number from 0"),
        (frames(place(north=math.nan), number()), "position is not finite"),
        (frames(place(), air(north=math.inf), number()), "wind is not finite"),
    ],
)
def test_a_malformed_question_is_refused_with_the_reason(payload: bytes, reason: str) -> None:
    with pytest.raises(BadFrame, match=reason):
        unpack_question(payload)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\x00", "invalid MAVLink prefix"),
        (frames(air()), "the answer has no NAMED_VALUE_FLOAT"),
        (frames(gas(name=b"smoke")), "NAMED_VALUE_FLOAT is 'smoke', not 'gas'"),
        (frames(gas(math.inf)), "gas is inf; wanted a finite value, or NaN for none"),
        (frames(gas(), air(T + 1)), "the frames of the answer do not share one time_boot_ms"),
        (frames(gas(), air(north=math.nan)), "wind is not finite"),
    ],
)
def test_a_malformed_answer_is_refused_with_the_reason(payload: bytes, reason: str) -> None:
    with pytest.raises(BadFrame, match=reason):
        unpack_answer(payload)
