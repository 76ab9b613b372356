"""The records of an MCAP file, one after the other.

What is damaged is stepped over: the next chunk is looked for behind it.
"""

import re
import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import IO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata
from mcap.writer import MCAP0_MAGIC

# Most bytes of a chunk, packed or not. Ours hold 4 MB and one message. A chunk that claims more is damaged,
# or made to exhaust memory: small messages take ten times their bytes there.
LARGEST_PIECE = 256 << 20
# What reading damaged bytes can raise.
DAMAGE = (McapError, struct.error, ValueError, LookupError, RuntimeError, EOFError, ArithmeticError)
HEAD = struct.Struct("<BQ")  # the beginning of each record: its kind, and the length of what follows
# How a chunk may be packed, after the length of that name. By it a chunk is found again; a plain one is not.
NAMES = re.compile(rb"\x04\0\0\0zstd|\x03\0\0\0lz4")
NAME_AT = HEAD.size + 28  # where a chunk says how it is packed
WINDOW = 1 << 20  # bytes that are searched at once


class Hole(NamedTuple):
    """Bytes that cannot be read."""

    at: int
    size: int


class Pieces:
    """The records of a file with their places. `whole` is then true if the file ends as it should."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file = file
        self._size = size
        self.whole = False

    def __iter__(self) -> Iterator[tuple[Hole, McapRecord | None]]:
        """Yield where each piece is, and the record there: None where it is damaged.

        Records that mean nothing to us are left out.
        """
        # All before `sound` is surely not the beginning of a chunk that is still to come.
        at = sound = len(MCAP0_MAGIC)
        while at < self._size:
            kind, length = self._head(at)
            if not kind:
                found = self._next_chunk(sound)
                if found is None:
                    return
                # Behind it, or within a record that claims to be longer than it is.
                begin = at if found >= at else sound
                yield Hole(begin, found - begin), None
                at = sound = found
                continue
            here = Hole(at, HEAD.size + length)
            if kind == Opcode.FOOTER:
                self.whole = self._bytes(at + here.size, len(MCAP0_MAGIC) + 1) == MCAP0_MAGIC
                return
            if kind in (Opcode.CHUNK, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.METADATA):
                yield here, _parsed(kind, self._bytes(at + HEAD.size, length))
            at += here.size
            sound = at if kind == Opcode.CHUNK else here.at + 1

    def channels(self) -> Iterator[Channel]:
        """Yield the channels that the end of the file repeats: those of a damaged chunk are known by it."""
        at = self._size - len(MCAP0_MAGIC) - HEAD.size - 20
        if at < 0 or self._head(at) != (Opcode.FOOTER, 20):
            return
        (at,) = struct.unpack("<Q", self._bytes(at + HEAD.size, 8))
        while at:
            kind, length = self._head(at)
            if kind not in (Opcode.SCHEMA, Opcode.CHANNEL):
                return
            if kind == Opcode.CHANNEL and isinstance(
                channel := _parsed(kind, self._bytes(at + HEAD.size, length)), Channel
            ):
                yield channel
            at += HEAD.size + length

    def _bytes(self, at: int, count: int) -> bytes:
        self._file.seek(at)
        return self._file.read(count)

    def _head(self, at: int) -> tuple[int, int]:
        """Return kind and length of the record at a place; zeros if none can be there."""
        head = self._bytes(at, HEAD.size)
        kind, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
        known = Opcode.HEADER <= kind <= Opcode.DATA_END or kind >= 0x80
        if not known or length > LARGEST_PIECE or at + HEAD.size + length > self._size:
            return 0, 0
        return (kind, length) if kind != Opcode.CHUNK or self._is_chunk(at, length) else (0, 0)

    def _is_chunk(self, at: int, length: int) -> bool:
        """Whether a chunk's own lengths add up."""
        begin = self._bytes(at + NAME_AT, 4)
        (name,) = struct.unpack("<I", begin) if len(begin) == 4 else (LARGEST_PIECE,)
        packed = self._bytes(at + NAME_AT + 4 + name, 8) if name <= length else b""
        return (
            len(packed) == 8
            and NAME_AT - HEAD.size + 4 + name + 8 + int.from_bytes(packed, "little") == length
        )

    def _next_chunk(self, start: int) -> int | None:
        """Return where the first chunk at or behind a place begins."""
        for window_at in range(start, self._size, WINDOW):
            window = self._bytes(window_at, WINDOW + NAME_AT + 8)
            for found in NAMES.finditer(window):
                at = window_at + found.start() - NAME_AT
                if at >= start and self._head(at)[0] == Opcode.CHUNK:
                    return at
        return None


def _parsed(kind: int, data: bytes) -> McapRecord | None:
    """Return a record from its bytes; None if they are damaged."""
    stream = ReadDataStream(BytesIO(data))
    try:
        return READ[kind](stream) if kind in READ else Message.read(stream, len(data))
    except DAMAGE:
        return None


READ: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.CHUNK: Chunk.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
}
