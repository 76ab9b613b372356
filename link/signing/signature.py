"""The signature of a MAVLink 2 frame: added, removed and verified. Pure functions on bytes.

Source: https://mavlink.io/en/guide/message_signing.html. A signed frame ends with 13 bytes: the link id,
the timestamp (48 bits, little-endian) and the first 48 bits of the SHA-256 of the key and all bytes
before.
"""

import hashlib
import hmac
from functools import cache

from link.bus.frames import CHECKSUM, HEADER_2, MAVLINK_2, SIGNATURE, SIGNED, crc16

FLAGS_AT = 2
DIGEST = 6
LINK_AT, TIMESTAMP_AT = -SIGNATURE, -SIGNATURE + 1


def is_signed(frame: bytes) -> bool:
    """Whether a whole frame has a signature, right or wrong. MAVLink 1 has none."""
    return bool(frame[0] == MAVLINK_2 and frame[FLAGS_AT] == SIGNED)


def signed(frame: bytes, key: bytes, link: int, timestamp: int) -> bytes:
    """Return a MAVLink 2 frame with a signature; one that it has is replaced.

    key: 32 bytes; link: link id, 0 to 255; timestamp: 10 µs since 2015, below 2**48.
    """
    body = _with_flags(unsigned(frame), SIGNED) + bytes([link]) + timestamp.to_bytes(6, "little")
    return body + _digest(key, body)


def unsigned(frame: bytes) -> bytes:
    """Return a frame without its signature."""
    return _with_flags(frame[:LINK_AT], 0) if is_signed(frame) else frame


def is_genuine(frame: bytes, key: bytes) -> bool:
    """Whether a signed frame is signed with this key. It says nothing about its time."""
    return hmac.compare_digest(frame[-DIGEST:], _digest(key, frame[:-DIGEST]))


def link_and_timestamp(frame: bytes) -> tuple[int, int]:
    """Return the link id and the timestamp of a signed frame, 10 µs since 2015."""
    return frame[LINK_AT], int.from_bytes(frame[TIMESTAMP_AT:-DIGEST], "little")


def _digest(key: bytes, body: bytes) -> bytes:
    return hashlib.sha256(key + body).digest()[:DIGEST]


def _with_flags(body: bytes, flags: int) -> bytes:
    """Change the flags of a frame without a signature from one of 0 and SIGNED to the other."""
    checksum = int.from_bytes(body[-CHECKSUM:], "little") ^ _change_of_checksum(body[1])
    return (
        body[:FLAGS_AT]
        + bytes([flags])
        + body[FLAGS_AT + 1 : -CHECKSUM]
        + checksum.to_bytes(CHECKSUM, "little")
    )


@cache
def _change_of_checksum(payload: int) -> int:
    """By what the flag changes the checksum of a frame with a payload of this many bytes.

    A CRC is linear: the change depends on no other byte. So a frame of an unknown type, whose CRC_EXTRA
    nobody knows, can be signed too, and one whose checksum is wrong stays wrong.
    """
    zeros = bytes(HEADER_2.size + payload)  # the header without its first byte, the payload, CRC_EXTRA
    return int(crc16(b"\0" + bytes([SIGNED]) + zeros[2:]) ^ crc16(zeros))
