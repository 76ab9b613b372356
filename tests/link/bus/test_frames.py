"""Protects the scanner of MAVLink frames: MAVLink 1, 2 and signed frames are found whole or not at all, as
by pymavlink.
"""

import pytest
from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import LAYOUTS, Frame, checksums, fields_of, frame_at, frame_length

ATTITUDE = mavlink.MAVLink_attitude_message(2500, 0.5, -0.25, 0.125, 0.0, 0.0, 0.0)


def packed(version: int = 2, signed: bool = False) -> bytes:
    sender = mavlink.MAVLink(None, srcSystem=42, srcComponent=191)
    sender.signing.sign_outgoing, sender.signing.secret_key = signed, bytes(32)
    return bytes(ATTITUDE.pack(sender, force_mavlink1=version == 1))


PLAIN, OLD, SIGNED = packed(), packed(1), packed(signed=True)


@pytest.mark.parametrize(
    ("data", "header", "behind"),
    [(PLAIN, 10, 2), (OLD, 6, 2), (SIGNED, 10, 2 + 13)],
    ids=["MAVLink 2", "MAVLink 1", "signed"],
)
def test_a_frame_is_found_whole_wherever_it_begins(data: bytes, header: int, behind: int) -> None:
    lying = b"noise" + data + PLAIN
    length = data[1]
    assert len(data) == header + length + behind
    frame = frame_at(lying, 5)
    assert frame == Frame(data, mavlink.MAVLINK_MSG_ID_ATTITUDE, 42, 191)
    assert frame.payload == data[header : header + length]
    assert frame_length(lying, 5) == len(data)


@pytest.mark.parametrize("data", [PLAIN, OLD, SIGNED], ids=["MAVLink 2", "MAVLink 1", "signed"])
def test_a_frame_that_is_cut_off_is_none(data: bytes) -> None:
    assert all(frame_at(data[:length], 0) is None for length in range(len(data)))
    assert frame_at(data, len(data)) is None


def test_what_begins_otherwise_is_none() -> None:
    assert [frame_at(bytes([magic]) + PLAIN[1:], 0) is None for magic in (0x00, 0x55, 0xFC, 0xFF)] == [
        True
    ] * 4
    assert frame_length(b"\x55" + PLAIN[1:], 0) == 0


@pytest.mark.parametrize("flags", [0x02, 0x03, 0x80])
def test_a_frame_with_flags_that_nobody_knows_is_dropped(flags: int) -> None:
    assert frame_at(PLAIN[:2] + bytes([flags]) + PLAIN[3:] + bytes(13), 0) is None


@pytest.mark.parametrize("data", [PLAIN, OLD, SIGNED], ids=["MAVLink 2", "MAVLink 1", "signed"])
def test_a_checksum_is_right_until_any_of_its_bytes_changes(data: bytes) -> None:
    frame = frame_at(data, 0)
    assert frame is not None
    seed = LAYOUTS[frame.message_id].seed
    told, right = checksums(frame, seed)
    assert told == right
    header = len(frame.data) - len(frame.payload) - 2 - (13 if data is SIGNED else 0)
    for at in range(header, header + len(frame.payload) + 2):
        changed = data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :]
        told, right = checksums(frame._replace(data=changed), seed)
        assert told != right


@pytest.mark.parametrize("data", [PLAIN, OLD, SIGNED], ids=["MAVLink 2", "MAVLink 1", "signed"])
def test_fields_are_those_that_were_packed(data: bytes) -> None:
    frame = frame_at(data, 0)
    assert frame is not None
    fields = fields_of(frame)
    assert (fields["time_boot_ms"], fields["roll"], fields["pitch"], fields["yaw"]) == (
        2500,
        0.5,
        -0.25,
        0.125,
    )
