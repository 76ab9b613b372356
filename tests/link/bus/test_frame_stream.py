"""Protects the cutting of bytes into frames: every good frame passes as it came, whatever lies around it
and however it is split.
"""

import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link.bus.frames import MOST_FALSE_STARTS, FrameStream, frame_at


def frame(message, system=1, component=1, version=2) -> bytes:
    return bytes(
        message.pack(
            mavlink.MAVLink(None, srcSystem=system, srcComponent=component), force_mavlink1=version == 1
        )
    )


def heartbeat(kind=mavlink.MAV_TYPE_QUADROTOR, autopilot=mavlink.MAV_AUTOPILOT_PX4):
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 0, 3)


def command(target=7, component=9):
    return mavlink.MAVLink_command_long_message(target, component, 400, 0, 1, 0, 0, 0, 0, 0, 0)


def unknown(payload=b"abc", number=0xABCDE, flags=0) -> bytes:
    """A MAVLink 2 frame of a type that no dialect has, put together by hand."""
    return (
        struct.pack("<BBBBBBBHB", 0xFD, len(payload), flags, 0, 5, 3, 4, number & 0xFFFF, number >> 16)
        + payload
        + b"\x12\x34"
    )


BEAT, ORDER, OLD = frame(heartbeat()), frame(command()), frame(command(), version=1)


def taken(stream: FrameStream, *parts: bytes, datagram=False) -> list[bytes]:
    return [found.data for part in parts for found in stream.take(part, datagram=datagram)]


@pytest.mark.parametrize("version", [1, 2])
def test_the_sender_and_the_target_of_a_frame_are_read(version: int) -> None:
    (found,) = FrameStream().take(frame(command(7, 9), 42, 43, version))
    assert (found.system, found.component, *found.target) == (42, 43, 7, 9)


def test_targets_that_mavlink_2_omits_as_zeros_are_broadcasts() -> None:
    request = frame(mavlink.MAVLink_param_request_list_message(0, 0))
    assert request[1] == 1  # all but one zero is cut off
    (found,) = FrameStream().take(request)
    assert found.target == (0, 0)


def test_a_component_without_a_system_is_a_broadcast() -> None:
    (found,) = FrameStream().take(frame(command(0, 9)))
    assert found.target == (0, 0)


def test_targets_behind_wide_fields_and_arrays_are_found() -> None:
    # In wire order: uint8 target_network, target_system, target_component, then the array.
    (found,) = FrameStream().take(frame(mavlink.MAVLink_file_transfer_protocol_message(0, 8, 6, [1] * 251)))
    assert found.target == (8, 6)
    # ArduPilot's own type 184: uint32 seqno, target_system, target_component, data.
    (found,) = FrameStream().take(frame(mavlink.MAVLink_remote_log_data_block_message(8, 6, 5, [1] * 200)))
    assert found.target == (8, 6)


@pytest.mark.parametrize(
    ("kind", "autopilot", "expected"),
    [
        (mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, True),
        (mavlink.MAV_TYPE_HEXAROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, True),
        (mavlink.MAV_TYPE_GROUND_ROVER, mavlink.MAV_AUTOPILOT_GENERIC, True),
        (mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, False),
        (mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_GENERIC, False),
        (mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, False),
        (mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_PX4, False),
        (mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_INVALID, False),
        (mavlink.MAV_TYPE_CAMERA, mavlink.MAV_AUTOPILOT_INVALID, False),
    ],
)
def test_an_autopilot_is_known_by_its_heartbeat(kind: int, autopilot: int, expected: bool) -> None:
    for version in (1, 2):
        (found,) = FrameStream().take(frame(heartbeat(kind, autopilot), version=version))
        assert found.is_autopilot is expected
    assert not FrameStream().take(ORDER)[0].is_autopilot


def test_frames_of_unknown_types_and_signed_frames_pass_as_they_came() -> None:
    signer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    signer.signing.secret_key, signer.signing.sign_outgoing = b"k" * 32, True
    signed = bytes(command().pack(signer))
    assert signed[2] == 1
    assert len(signed) == len(ORDER) + 13
    mixed = [unknown(), signed, unknown(b"", 0x800000), OLD, unknown(b"x" * 255)]
    assert taken(FrameStream(), b"".join(mixed)) == mixed
    (found,) = FrameStream().take(unknown())
    assert (found.system, found.component, *found.target) == (3, 4, 0, 0)


@given(st.lists(st.integers(1, 40)), st.randoms(use_true_random=False))
def test_frames_split_anywhere_are_joined(cuts: list[int], chance: random.Random) -> None:
    frames = [chance.choice((BEAT, ORDER, OLD, unknown())) for _ in range(8)]
    data, parts = b"".join(frames), []
    for cut in cuts:
        parts, data = [*parts, data[:cut]], data[cut:]
    stream = FrameStream()
    assert taken(stream, *parts, data) == frames
    assert stream.garbage == 0


@given(st.lists(st.binary(max_size=50), min_size=4, max_size=4))
def test_garbage_swallows_no_good_frame_and_is_counted(noise: list[bytes]) -> None:
    stream = FrameStream()
    frames = [BEAT, ORDER, OLD]
    wanted = b"".join(part for pair in zip(noise, [*frames, b""], strict=True) for part in pair)
    got = taken(stream, wanted, datagram=True) + taken(stream, BEAT, datagram=True)
    assert [data for data in got if data in frames] == [*frames, BEAT]


def test_a_beginning_whose_end_never_comes_holds_nothing_up() -> None:
    stream = FrameStream()
    assert taken(stream, b"\xfd\xff\x00") == []
    assert taken(stream, BEAT) == [BEAT]
    assert stream.garbage == 3


def test_a_frame_with_a_wrong_checksum_is_garbage() -> None:
    stream = FrameStream()
    assert taken(stream, ORDER[:-1] + bytes([ORDER[-1] ^ 1]) + BEAT) == [BEAT]
    assert stream.garbage == len(ORDER)


def test_what_looks_like_an_unknown_type_in_garbage_is_not_believed() -> None:
    assert taken(FrameStream(), b"noise" + unknown()) == []  # no frame is due there
    assert taken(FrameStream(), unknown() + b"noise") == []  # no frame follows
    stream = FrameStream()
    assert taken(stream, b"noise" + BEAT + unknown()) == [
        BEAT,
        unknown(),
    ]  # a good frame brings it into step again
    stream = FrameStream()
    assert taken(stream, b"\xfd\xff", unknown(), datagram=True) == [
        unknown()
    ]  # a datagram begins with a frame


def test_unknown_flags_are_garbage() -> None:
    stream = FrameStream()
    assert taken(stream, unknown(flags=2), datagram=True) == []
    assert stream.garbage == len(unknown())


def test_a_datagram_of_60_kb_of_markers_costs_little_and_the_next_frame_passes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flood, stream = b"\xfe" * 60_000, FrameStream()
    looked: list[int] = []
    monkeypatch.setattr("link.bus.frames.frame_at", lambda data, at: looked.append(at) or frame_at(data, at))
    assert taken(stream, flood, datagram=True) == []
    assert len(looked) <= 2 * MOST_FALSE_STARTS  # of 60,000 bytes that may begin a frame
    assert stream.garbage == 60_000
    assert taken(stream, BEAT, datagram=True) == [BEAT]
    assert MOST_FALSE_STARTS < 1000
