"""Mutants of real messages, and the checksums without which nothing of a changed frame is read."""

import re
import struct
import zlib

from link.bus.frames import LAYOUTS, checksums, frame_at, frame_length

WORDS = (
    b"\0" * 4,
    b"\xff" * 4,
    b"\xff" * 8,
    b"\x7f\xff\xff\xff",
    b"\0\0\0\x80",
    b"\0\0\xc0\x7f",
    b"\0\0\x80\x7f",
    b"\xff\xff\x7f\x7f",
    b"1e308",
    b"-1e308",
    b"1e999",
    b"4294967296",
    b"9" * 30,
    b"9" * 5000,
    b"-1",
    b"NaN",
    b"null",
    b"0.5",
    b"true",
    b'""',
    b"\xff\xfe",
    b"[" * 200,
    b'{"":' * 200,
    b"]",
    b"}",
    b",",
    b"\n",
    b": ",
    b"\xfd",
    b"\xfe",
    b"&a [*a]",
    b"<<: *a",
    b"!!int ",
    b"\0" * 300,
)
"""What decoders stumble over: edges of whole numbers, NaN and infinity as floats, and pieces of JSON and
YAML.
"""
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
NUMBERS = (
    b"0",
    b"-1",
    b"1e308",
    b"-1e308",
    b"1e-320",
    b"4294967295",
    b"4294967296",
    b"9223372036854775808",
    b"9" * 30,
    b"9" * 5000,
    b"0.5",
    b"3.5e38",
    b"1e7",
    b"null",
    b"true",
    b'"1"',
    b"[]",
    b"{}",
    b"[1,2]",
    b".inf",
    b"NaN",
)
FLOATS = (0.0, -0.0, 1e-45, 1e30, 3.4e38, -3.4e38, float("inf"), float("nan"), 1e6, -1.0)
MAGIC = re.compile(rb"[\xfd\xfe]")
"""The first byte of a frame."""
EDIT = 5
"""Bytes that say one edit."""


def edited(seed: bytes, edits: bytes) -> bytes:
    """Return a seed after edits: one byte for what to do, two for where, two for with what."""
    data = bytearray(seed)
    for start in range(0, len(edits) - EDIT + 1, EDIT):
        what, with_what = edits[start], int.from_bytes(edits[start + 3 : start + 5])
        at = int.from_bytes(edits[start + 1 : start + 3]) * (len(data) + 1) >> 16
        length = with_what >> 8
        match what % 10:
            case 0 if at < len(data):
                data[at] ^= with_what & 0xFF or 1
            case 1:
                data[at : at + 1] = bytes([with_what & 0xFF])
            case 2:
                del data[at : at + 1 + length]
            case 3:
                data[at:at] = data[at : at + length]
            case 4:
                data[at:at] = WORDS[with_what % len(WORDS)]
            case 5:
                word = WORDS[with_what % len(WORDS)]
                data[at : at + len(word)] = word
            case 6:
                other = with_what * len(data) >> 16
                data[at : at + 8] = data[other : other + 8]
            case 7 if length > 200:
                del data[at:]
            case 8 if numbers := list(NUMBER.finditer(data)):  # of a text
                number = numbers[at * len(numbers) // (len(data) + 1)]
                data[number.start() : number.end()] = NUMBERS[with_what % len(NUMBERS)]
            case 9:
                data[at : at + 4] = struct.pack("<f", FLOATS[with_what % len(FLOATS)])
    return bytes(data)


def as_sent(data: bytes, stamp: int = 0) -> bytes:
    """Return MAVLink frames with the checksums that their receivers want, else nothing of a changed one is
    read; one in eight stays.

    stamp: how many bytes precede each frame.
    """
    if zlib.crc32(data) % 8 == 0:
        return data
    mended, at = bytearray(data), 0
    while (magic := MAGIC.search(data, at + stamp)) and magic.start() + 3 <= len(data):
        at = magic.start() - stamp
        frame = frame_at(data, at + stamp)
        if frame is None:
            at += frame_length(data, at + stamp) or 1
            continue
        if (layout := LAYOUTS.get(frame.message_id)) is not None:
            _, right = checksums(frame, layout.seed)
            checksum = (
                magic.start() + len(frame.data) - (15 if frame.data[0] == 0xFD and frame.data[2] else 2)
            )
            mended[checksum : checksum + 2] = right.to_bytes(2, "little")
        at += stamp + len(frame.data)
    return bytes(mended)
