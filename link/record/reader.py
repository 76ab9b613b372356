"""Reads the record of a run. A truncated or damaged record is read up to the damage."""

import contextlib
import stat
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

import lz4.frame
import msgspec
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from link.record.decoded import Malformed
from link.record.record import (
    ABOUT,
    ATTACHMENT,
    FORMAT_NAME,
    FRAME_KEYS,
    MALFORMED,
    PARTICLES,
    READABLE,
    STOPPED,
    Entry,
    parted,
    value_of,
    without_time,
)

LARGEST_PIECE = 256 << 20
"""Most bytes of a chunk, packed or not. Ours hold 4 MB and one message. A chunk that claims more is damaged, or made to exhaust memory:
small messages take ten times their bytes there."""
LARGEST_RECORD = 4 << 30
"""Most bytes of memory for all messages: they are read at once."""
MOST_RATIO, SMALL = 100, 1 << 20
"""Chunks may unpack to so many times the size of the file, or to SMALL bytes. Real missions pack to a third; a file that unpacks to a
thousand times its size was made to exhaust memory."""
MESSAGE_BYTES = 400
"""Memory overhead of a message, bytes."""
DAMAGE = (McapError, zstandard.ZstdError, struct.error, ValueError, LookupError, RuntimeError, EOFError, ArithmeticError)
"""What reading damaged bytes can raise."""


class RecordError(Exception):
    """The file is not a readable log; the text is one line. It is not a ValueError, since damage raises those."""


class Recording(NamedTuple):
    """The contents of a log."""

    about: dict[str, Any]
    """The run's description by the launcher, with versions, git revision, host and namespace; empty if the file has none."""
    entries: list[Entry]
    """All messages, in the order of recording."""
    complete: bool
    """False if the file is truncated or damaged, or if recording stopped early; in the latter case about["stopped"] gives the reason."""

    @property
    def shortcoming(self) -> str:
        """What people should know of it, after its name: `is cut off ...`; empty if it is complete."""
        if self.complete:
            return ""
        reason = self.about.get(STOPPED)
        return f"ends early: {reason}" if reason else "is cut off, damaged or still being written: what follows is missing"


def is_record(path: Path) -> bool:
    """True if a file is an MCAP file by its first bytes; raises RecordError if it is empty, not a regular file or not readable.

    A pipe is refused: reading its first bytes would consume them, and could wait forever for a writer.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise RecordError(f"{path} is not a file that can be read as a log; wanted an .mcap or a .tlog")
        with path.open("rb") as file:
            begin = file.read(len(MCAP0_MAGIC))
    except OSError as error:
        raise RecordError(f"{path}: {error.strerror}") from None
    if not begin:
        raise RecordError(f"{path} is empty")
    return begin == MCAP0_MAGIC


def read(path: Path | str) -> Recording:
    """Read a log, also one that is truncated or still being written.

    Raises RecordError if the file is not a log of ours, its format is unknown, or it holds more than LARGEST_RECORD or MOST_RATIO allow.

    Example:
        ```python
        recording = plumeward.read_record("runs/NAME.mcap")
        beliefs = [json.loads(entry.payload) for entry in recording.entries if entry.key == "belief"]
        [said["spread"] for said in beliefs]  # m, after each reading
        ```
    """
    path = Path(path)
    if not is_record(path):
        raise RecordError(f"{path} is not an MCAP file")
    whole = False
    try:
        reader = _Reader(path)
        with path.open("rb") as file:
            whole = _read(_Whole(file, path.stat().st_size), reader)
    except OSError as error:
        raise RecordError(f"{path}: {error.strerror}") from None
    if whole and not reader.entries and not reader.about:
        raise RecordError(f"{path} is an MCAP file, but not a plumeward log: none of its channels has the name of a bus key")
    return Recording(reader.about, reader.entries, whole and STOPPED not in reader.about)


def _read(file: "_Whole", reader: "_Reader") -> bool:
    """Hand the records of a file to the reader, up to the first damage; returns True if there is none before the end."""
    records = StreamReader(cast(IO[bytes], file), emit_chunks=True, record_size_limit=LARGEST_PIECE).records
    with contextlib.suppress(*DAMAGE):
        for record in records:
            for piece in _unpacked(record, reader) if isinstance(record, Chunk) else (record,):
                reader.take(piece)
        return file.left == 0
    return False


def _unpacked(chunk: Chunk, reader: "_Reader") -> list[McapRecord]:
    """Return the records of a chunk. The size that it claims is not trusted."""
    if chunk.uncompressed_size > LARGEST_PIECE:
        raise McapError(f"a chunk that claims {chunk.uncompressed_size} bytes")
    if chunk.compression:
        reader.unpack(chunk.uncompressed_size)
    data = UNPACK[chunk.compression](chunk.data, chunk.uncompressed_size)
    return breakup_chunk(replace(chunk, compression="", data=data), validate_crc=True)


UNPACK: dict[str, Callable[[bytes, int], bytes]] = {
    "": lambda data, _: data,
    "lz4": lambda data, size: lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size),
    "zstd": lambda data, size: zstandard.ZstdDecompressor().stream_reader(data).read(size),
}
"""Decompressors that stop at a given size: mcap and zstandard trust the size in the data. Other tools may pack with lz4."""


class _Whole:
    """A file that raises EndOfFile on a short read: mcap would take a truncated piece for a whole one."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file = file
        self.left = size

    def read(self, length: int) -> bytes:
        if not 0 <= length <= self.left or len(piece := self._file.read(length)) < length:
            raise EndOfFile
        self.left -= length
        return piece


class _Reader:
    """Rebuilds messages from their records."""

    def __init__(self, path: Path) -> None:
        self.about: dict[str, Any] = {}
        self.entries: list[Entry] = []
        self._path = path
        self._topics: dict[int, tuple[str, str]] = {}
        self._sequence = -1
        self._timed = False
        self._bytes = 0
        self._unpacked = 0
        self._may_unpack = max(SMALL, MOST_RATIO * path.stat().st_size)

    def unpack(self, count: int) -> None:
        """Count bytes that are about to be unpacked; raises RecordError if they are too many for the file."""
        self._unpacked += count
        if self._unpacked > self._may_unpack:
            raise RecordError(f"{self._path} unpacks to more than {MOST_RATIO} times its size: damaged, or made to exhaust memory")

    def take(self, record: McapRecord) -> None:
        match record:
            case Message():
                key, ending = self._topics[record.channel_id]
                if key:
                    self._message(key, ending, record.sequence, record.publish_time, record.data)
            case Channel():
                self._topics[record.id] = parted(record.topic)
            case Metadata() if record.name == ABOUT:
                about = {name: value_of(text) for name, text in record.metadata.items()}
                written = about.pop(FORMAT_NAME, 0)
                if written not in READABLE:
                    formats = ", ".join(map(str, READABLE))
                    raise RecordError(f"{self._path} has record format {written} of another plumeward version; readable formats: {formats}")
                self.about |= about

    def _message(self, key: str, ending: str, sequence: int, published_ns: int, data: bytes) -> None:
        if not ending and key in FRAME_KEYS:
            self._begin(Entry(key, published_ns, self.entries[-1].simulation_s if self.entries else 0.0, data), sequence)
        elif not ending:
            payload, simulation_s = without_time(data)
            self._begin(Entry(key, published_ns, simulation_s, payload), sequence)
        elif ending == MALFORMED and key not in FRAME_KEYS:
            text, simulation_s = without_time(data)
            self._begin(Entry(key, published_ns, simulation_s, msgspec.json.decode(text, type=Malformed).payload), sequence)
        elif sequence == self._sequence and ending in (PARTICLES, ATTACHMENT):
            self._hold(len(data))
            self.entries[-1] = self.entries[-1]._replace(attachment=data)
        elif sequence == self._sequence and not self._timed:
            self.entries[-1] = self.entries[-1]._replace(simulation_s=without_time(data)[1])
            self._timed = True

    def _begin(self, entry: Entry, sequence: int) -> None:
        self._hold(len(entry.payload) + MESSAGE_BYTES)
        self.entries.append(entry)
        self._sequence, self._timed = sequence, False

    def _hold(self, count: int) -> None:
        self._bytes += count
        if self._bytes > LARGEST_RECORD:
            gib = f"{LARGEST_RECORD / 2**30:g} GiB"
            raise RecordError(f"{self._path} holds more than {gib} of messages; cut out a part of it with `mcap filter`")
