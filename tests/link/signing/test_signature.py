"""Protects the bits of a signature: they are those of MAVLink's guide, computed here from its formula
alone.
"""

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from link.bus.frames import checksums, frame_at
from link.signing.signature import is_genuine, is_signed, link_and_timestamp, signed, unsigned

KEY = bytes(range(32))
HEARTBEAT, HEARTBEAT_SEED = 0, 50
PAYLOAD = bytes([0, 0, 0, 0, 2, 12, 81, 4, 3])


def crc(data: bytes) -> int:
    """CRC-16/MCRF4XX, bit by bit."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0x8408 if value & 1 else 0)
    return value


def frame(
    payload: bytes = PAYLOAD, message_id: int = HEARTBEAT, seed: int = HEARTBEAT_SEED, flags: int = 0
) -> bytes:
    """A frame of MAVLink 2, written out as in the guide's section on the packet format."""
    body = bytes([len(payload), flags, 0, 7, 1, 1]) + message_id.to_bytes(3, "little") + payload
    return b"\xfd" + body + crc(body + bytes([seed])).to_bytes(2, "little")


def by_the_guide(body: bytes, link: int, timestamp: int, key: bytes = KEY) -> bytes:
    """sha256_48(secret_key + header + payload + CRC + link-ID + timestamp)."""
    ended = body + bytes([link]) + b"".join(bytes([timestamp >> 8 * at & 0xFF]) for at in range(6))
    return ended + hashlib.sha256(key + ended).digest()[:6]


def test_a_signed_frame_has_the_bits_of_the_guide() -> None:
    right = by_the_guide(frame(flags=1), link=5, timestamp=0x0123456789AB)
    assert signed(frame(), KEY, 5, 0x0123456789AB) == right
    assert is_signed(right)
    assert is_genuine(right, KEY)
    assert link_and_timestamp(right) == (5, 0x0123456789AB)
    assert unsigned(right) == frame()


@given(
    st.binary(max_size=255),
    st.integers(0, 2**24 - 1),
    st.integers(0, 255),
    st.integers(0, 255),
    st.integers(0, 2**48 - 1),
)
def test_a_frame_of_any_length_and_of_a_type_that_nobody_knows_is_signed_with_a_right_checksum(
    payload: bytes, message_id: int, seed: int, link: int, timestamp: int
) -> None:
    plain = frame(payload, message_id, seed)
    assert signed(plain, KEY, link, timestamp) == by_the_guide(
        frame(payload, message_id, seed, flags=1), link, timestamp
    )
    assert unsigned(signed(plain, KEY, link, timestamp)) == plain


def test_a_wrong_checksum_stays_wrong() -> None:
    bad = frame(seed=HEARTBEAT_SEED + 1)
    whole = signed(bad, KEY, 0, 1)
    parts = frame_at(whole, 0)
    assert parts
    received, right = checksums(parts, bytes([HEARTBEAT_SEED]))
    assert received != right
    assert unsigned(whole) == bad


def test_another_signature_is_replaced() -> None:
    other = by_the_guide(frame(flags=1), 9, 99, key=b"o" * 32)
    assert signed(other, KEY, 5, 100) == by_the_guide(frame(flags=1), 5, 100)


def test_every_changed_bit_makes_a_signature_wrong() -> None:
    right = by_the_guide(frame(flags=1), 5, 100)
    for at in range(8 * len(right)):
        changed = bytearray(right)
        changed[at // 8] ^= 1 << at % 8
        assert not is_genuine(bytes(changed), KEY)
    assert not is_genuine(right, bytes(32))


@pytest.mark.parametrize("mavlink1", [False, True])
def test_an_unsigned_frame_has_no_signature_to_remove(mavlink1: bool) -> None:
    message = mavlink.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3)
    plain = bytes(message.pack(mavlink.MAVLink(None), force_mavlink1=mavlink1))
    assert not is_signed(plain)
    assert unsigned(plain) == plain


def test_pymavlink_accepts_what_is_signed_here_and_the_other_way_round() -> None:
    peer = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    peer.signing.secret_key, peer.signing.sign_outgoing, peer.signing.link_id, peer.signing.timestamp = (
        KEY,
        True,
        3,
        1000,
    )
    assert peer.decode(bytearray(signed(frame(), KEY, 5, 1001))).get_signed()
    said = bytes(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(peer))
    assert is_genuine(said, KEY)
    assert link_and_timestamp(said) == (3, 1001)
