"""Protects the frames of the search: compared with values that pymavlink packs and reads field by field."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import (
    BadFrame,
    Codec,
    Reading,
    continued,
    elapsed_ms,
    nearest,
    pack_reading,
    unpack,
    unpack_plan,
    unpack_reading,
    unpack_waypoint,
    waypoint_message,
)

READING = Reading(time_boot_ms=1234, position=(3.5, 4.25), altitude_m=5.0, wind=(1.5, -0.5), gas=0.75)
float32 = st.floats(-1000, 1000, width=32)


def frames(*messages: object) -> bytes:
    return Codec(1, 1).pack(*messages)


def test_a_reading_crosses_the_wire_as_north_east_down_and_air_velocity() -> None:
    position, wind, gas = mavlink.MAVLink(None).parse_buffer(pack_reading(Codec(1, 1), READING))
    assert (position.time_boot_ms, position.x, position.y, position.z) == (1234, 4.25, 3.5, -5.0)
    assert (wind.time_usec, wind.wind_x, wind.wind_y) == (
        1_234_000,
        0.5,
        -1.5,
    )  # from the east, so the air moves west
    assert (gas.time_boot_ms, gas.name, gas.value) == (1234, "gas", 0.75)


@given(st.integers(0, 2**32 - 1), float32, float32, float32, float32, float32, float32)
def test_a_reading_survives_the_wire_to_the_last_bit(
    t: int, x: float, y: float, z: float, u: float, v: float, gas: float
) -> None:
    reading = Reading(t, (x, y), z, (u, v), gas)
    assert unpack_reading(pack_reading(Codec(7, 1), reading)) == reading


def test_frames_count_their_sequence_per_link() -> None:
    codec = Codec(1, 1)
    messages = [m for _ in range(100) for m in unpack(pack_reading(codec, READING))]
    assert [m.get_seq() for m in messages] == [n % 256 for n in range(300)]


def test_a_waypoint_names_the_reading_that_it_answers_and_asks_for_position_only() -> None:
    (m,) = unpack(frames(waypoint_message(3, 1234, (10.0, 20.0), 5.0)))
    assert (m.time_boot_ms, m.x, m.y, m.z, m.target_system) == (1234, 20.0, 10.0, -5.0, 3)
    assert m.coordinate_frame == mavlink.MAV_FRAME_LOCAL_NED
    assert m.type_mask == 0b110111111000


WAYPOINT = waypoint_message(3, 1234, (10.0, 20.0), 5.0)
ORDER = mavlink.MAVLink_command_long_message(3, 1, 400, 0, 0.0, 21196.0, 0, 0, 0, 0, 0)


@pytest.mark.parametrize("system", [3, 0], ids=["its system", "all"])
def test_a_waypoint_is_read_back(system: int) -> None:
    m = unpack_waypoint(frames(waypoint_message(system, 1234, (10.0, 20.0), 5.0)), 3)
    assert (m.time_boot_ms, m.x, m.y, m.z) == (1234, 20.0, 10.0, -5.0)


@pytest.mark.parametrize(
    ("payload", "reason", "kind"),
    [
        (b"", "malformed frame", "malformed"),
        (frames(WAYPOINT)[:-1], "malformed frame", "malformed"),
        (frames(WAYPOINT, WAYPOINT), "2 frames; wanted one SET_POSITION_TARGET_LOCAL_NED (84)", "malformed"),
        (frames(ORDER), "message 76; wanted one SET_POSITION_TARGET_LOCAL_NED (84)", "malformed"),
        (frames(ORDER, WAYPOINT), "2 frames; wanted one", "malformed"),
        (
            frames(waypoint_message(2, 1234, (10.0, 20.0), 5.0)),
            "a waypoint for 2/1; this is 3/1",
            "other vehicle",
        ),
    ],
    ids=["nothing", "cut off", "two", "a command", "a command before it", "for another system"],
)
def test_what_is_no_waypoint_for_this_system_is_refused(payload: bytes, reason: str, kind: str) -> None:
    with pytest.raises(BadFrame) as refused:
        unpack_waypoint(payload, 3)
    assert str(refused.value).startswith(reason)
    assert refused.value.kind == kind


PLAN = [waypoint_message(system, 1000 + system, (10.0 * system, 20.0), 5.0) for system in (2, 3)]


def test_of_the_waypoints_of_a_round_a_vehicle_takes_its_own_and_learns_where_all_go() -> None:
    m, places = unpack_plan(frames(*PLAN), 3)
    assert (m.time_boot_ms, m.x, m.y) == (1003, 20.0, 30.0)
    assert places == [(20.0, 20.0), (30.0, 20.0)]


@pytest.mark.parametrize(
    ("payload", "reason", "kind"),
    [
        (b"", "malformed frame", "malformed"),
        (frames(ORDER, *PLAN), "message 76; wanted SET_POSITION_TARGET_LOCAL_NED (84) alone", "malformed"),
        (frames(PLAN[0]), "waypoints for 2; wanted one for 3", "other vehicle"),
        (frames(*PLAN, PLAN[1]), "waypoints for 2 3 3; wanted one for 3", "other vehicle"),
    ],
    ids=["nothing", "a command", "none for it", "two for it"],
)
def test_what_is_no_plan_with_this_system_is_refused(payload: bytes, reason: str, kind: str) -> None:
    with pytest.raises(BadFrame) as refused:
        unpack_plan(payload, 3)
    assert str(refused.value).startswith(reason)
    assert refused.value.kind == kind


def local_position(time_boot_ms: int = 1234, north: float = 1.0) -> object:
    return mavlink.MAVLink_local_position_ned_message(time_boot_ms, north, 2.0, -5.0, 0.0, 0.0, 0.0)


def wind_cov(time_boot_ms: int = 1234, north: float = 1.0) -> object:
    return mavlink.MAVLink_wind_cov_message(time_boot_ms * 1000, north, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def named_value(value: float = 1.0, name: bytes = b"gas") -> object:
    return mavlink.MAVLink_named_value_float_message(1234, name, value)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "not made of whole MAVLink frames"),
        (b"not mavlink at all", "malformed frame"),
        (pack_reading(Codec(1, 1), READING)[:-1], "malformed frame"),
        (pack_reading(Codec(1, 1), READING) + b"\x00", "malformed frame"),
        (frames(local_position(), named_value()), "without WIND_COV"),
        (frames(local_position(), wind_cov(), named_value(name=b"temp")), "not 'gas'"),
        (frames(local_position(1235), wind_cov(), named_value()), "do not share one time_boot_ms"),
        (frames(local_position(), wind_cov(1235), named_value()), "do not share one time_boot_ms"),
        (frames(local_position(), wind_cov(), named_value(math.nan)), "gas is not finite"),
        (frames(local_position(), wind_cov(), named_value(-math.inf)), "gas is not finite"),
        (frames(local_position(north=math.nan), wind_cov(), named_value()), "position is not finite"),
        (frames(local_position(), wind_cov(north=math.inf), named_value()), "wind is not finite"),
    ],
)
def test_what_is_no_reading_is_refused_with_its_reason(payload: bytes, reason: str) -> None:
    with pytest.raises(BadFrame, match=reason):
        unpack_reading(payload)


@given(st.integers(0, 500), st.integers(1, 255))
def test_a_changed_byte_is_always_noticed(index: int, flip: int) -> None:
    payload = bytearray(pack_reading(Codec(1, 1), READING))
    payload[index % len(payload)] ^= flip
    with pytest.raises(BadFrame):
        unpack_reading(bytes(payload))


def test_frames_of_mavlink_1_and_signed_ones_tell_a_reading_too() -> None:
    old = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    signing = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    signing.signing.sign_outgoing, signing.signing.secret_key = True, bytes(32)
    messages = local_position(), wind_cov(), named_value(2.5)
    for payload in (
        b"".join(m.pack(old, force_mavlink1=m.id < 256) for m in messages),
        b"".join(m.pack(signing) for m in messages),
    ):
        assert unpack_reading(bytes(payload), 1) == Reading(1234, (2.0, 1.0), 5.0, (0.0, -1.0), 2.5)


# ---- time_boot_ms, which wraps after 49.7 days ----

ROUND = 4_294_967_296
HOURS = 3_600_000


@given(st.integers(0, 3 * ROUND), st.integers(1 - ROUND // 2, ROUND // 2 - 1))
def test_of_two_times_the_later_one_is_less_than_half_a_round_ahead(since_ms: int, step_ms: int) -> None:
    until_ms = since_ms + step_ms
    assert elapsed_ms(since_ms % ROUND, until_ms % ROUND) == step_ms
    assert nearest(since_ms, until_ms % ROUND) == until_ms


@pytest.mark.parametrize(
    ("newest_ms", "time_boot_ms", "time_ms"),
    [
        (0, 3_000_000_000, 3_000_000_000),  # heard for the first time
        (5000, 5010, 5010),
        (5000, 4000, 4000),  # overtaken, or started again
        (ROUND - 10, 5, ROUND + 5),
        (ROUND + 5, ROUND - 10, ROUND - 10),
        (ROUND + 5, 20 * HOURS, ROUND + 20 * HOURS),  # not heard of for long
        (2 * ROUND + 50, 49, 2 * ROUND + 49),
        (3_000_000_000, 0, 0),  # started again
        (ROUND + 20 * HOURS, 100, 100),
    ],
)
def test_a_vehicles_own_time_goes_on_where_it_wraps_and_begins_anew_with_the_vehicle(
    newest_ms: int, time_boot_ms: int, time_ms: int
) -> None:
    assert continued(newest_ms, time_boot_ms) == time_ms
