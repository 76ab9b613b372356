"""Reads the record of a run as far as possible: damaged parts are left out and reported."""

import stat
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NamedTuple

import lz4.frame
import msgspec
import zstandard
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from link.record.decoded import Malformed
from link.record.pieces import DAMAGE, LARGEST_PIECE, Hole, Pieces
from link.record.record import (
    ABOUT,
    ATTACHMENT,
    FORMAT_NAME,
    MALFORMED,
    PARTICLES,
    READABLE,
    STOPPED,
    Entry,
    has_frames,
    key_today,
    parted,
    value_of,
    without_time,
)
from link.terminal import printable

# Most bytes of memory for all messages, where they are read at once.
LARGEST_RECORD = 4 << 30
# Chunks may unpack to this many times the size of the file, or to SMALL bytes. Real missions pack to a
# third; a file that unpacks to a thousand times its size was made to exhaust memory.
MOST_RATIO, SMALL = 100, 1 << 20
# Memory overhead of a message, bytes.
MESSAGE_BYTES = 400
# Most damaged places that are kept apart, and most that are named.
MOST_PLACES, LISTED = 1000, 3


class RecordError(Exception):
    """The file is not a readable log; the text is one line.

    It is not a ValueError, since damage raises those.
    """


class Damage(NamedTuple):
    """A place of a log that cannot be read.

    Attributes:
        at: Where it begins in the file, bytes.
        size: How much is lost, bytes.
        after_s: Simulation time of the message before it, s; 0 if there is none.
        before: How many messages come before it.
    """

    at: int
    size: int
    after_s: float
    before: int

    def __str__(self) -> str:
        return f"{self.size:,} bytes at byte {self.at:,}, after {self.after_s:.2f} s of simulation"


class Recording(NamedTuple):
    """The contents of a log.

    Attributes:
        about: The run's description by the launcher, with versions, git revision, host and namespace; empty
            if the file has none.
        entries: All messages, in the order of recording.
        complete: False if the file is truncated or damaged, or if recording stopped early; in the latter
            case about["stopped"] gives the reason.
        damage: The places that are left out because they cannot be read.

    Examples:
        >>> recording = plumeward.read_record("runs/NAME.mcap")
        >>> recording.about["policy"], recording.complete
        ('homing', True)
    """

    about: dict[str, Any]
    entries: list[Entry]
    complete: bool
    damage: tuple[Damage, ...] = ()

    @property
    def shortcoming(self) -> str:
        """What people should know of it, after its name: `is cut off ...`; empty if it is complete."""
        if self.complete:
            return ""
        if self.damage:
            places = "; ".join(map(str, self.damage[:LISTED]))
            more = f"; and {len(self.damage) - LISTED:,} more places" * (len(self.damage) > LISTED)
            return f"is damaged, and lacks {places}{more}"
        reason = self.about.get(STOPPED)
        return (
            f"ends early: {printable(str(reason))}"
            if reason
            else "is cut off, damaged or still being written: what follows is missing"
        )


def is_record(path: Path) -> bool:
    """True if a file is an MCAP file by its first bytes.

    Raises RecordError if it is empty, no regular file, or not readable.

    A pipe is refused: reading its first bytes would consume them, and could wait forever for a writer.
    """
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            kind = "a folder" if stat.S_ISDIR(mode) else "a pipe" if stat.S_ISFIFO(mode) else "a device"
            raise RecordError(f"{path} is {kind}; wanted a file")
        with path.open("rb") as file:
            begin = file.read(len(MCAP0_MAGIC))
    except OSError as error:
        raise RecordError(f"{path}: {error.strerror}") from None
    if not begin:
        raise RecordError(f"{path} is empty")
    return begin == MCAP0_MAGIC


def read(path: Path | str) -> Recording:
    """Read a log, also one that is damaged, truncated or still being written.

    Raises RecordError if the file is not a log of ours, its format is unknown, or it holds more than
    LARGEST_RECORD or MOST_RATIO allow.

    Examples:
        >>> import json
        >>> recording = plumeward.read_record("runs/NAME.mcap")
        >>> beliefs = [json.loads(entry.payload) for entry in recording.entries if entry.key == "belief"]
        >>> beliefs[-1]["spread"] < 0.5  # m, after the last reading
        True
    """
    log, entries, held = LogFile(Path(path)), [], 0
    for entry in log:
        held += len(entry.payload) + len(entry.attachment) + MESSAGE_BYTES
        if held > LARGEST_RECORD:
            raise RecordError(
                f"{path} holds more than {LARGEST_RECORD / 2**30:g} GiB of messages; cut out a part of it "
                "with `mcap filter`"
            )
        entries.append(entry)
    return Recording(log.about, entries, log.complete, tuple(log.damage))


class LogFile:
    """The messages of a log, one after the other: no more than a chunk of them is in memory.

    The rest is known at their end.
    """

    def __init__(self, path: Path) -> None:
        """Take its path; raises RecordError if it is no MCAP file.

        So does going through it, for the reasons that `read` has.
        """
        if not is_record(path):
            raise RecordError(f"{path} is not an MCAP file")
        self.about: dict[str, Any] = {}
        self.damage: list[Damage] = []
        self.complete = False
        self._path = path
        self._topics: dict[int, tuple[str, str]] = {}
        self._format = 0
        # What belongs to this message may still follow.
        self._newest: Entry | None = None
        self._sequence = -1
        self._timed = False
        self._count = 0
        self._unpacked = self._may_unpack = 0

    def __iter__(self) -> Iterator[Entry]:
        try:
            with self._path.open("rb") as file:
                yield from self._read(file, self._path.stat().st_size)
        except OSError as error:
            raise RecordError(f"{self._path}: {error.strerror}") from None

    @property
    def shortcoming(self) -> str:
        """What people should know of it, after its name: `is cut off ...`; empty if it is complete."""
        return Recording(self.about, [], self.complete, tuple(self.damage)).shortcoming

    def _read(self, file: IO[bytes], size: int) -> Iterator[Entry]:
        pieces, self._may_unpack = Pieces(file, size), max(SMALL, MOST_RATIO * size)
        for channel in pieces.channels():
            self._topics[channel.id] = parted(channel.topic)
        for place, record in pieces:
            for each in self._of_chunk(record) if isinstance(record, Chunk) else (record,):
                before = self._newest
                if self._takes(each, place) and before is not None:
                    yield before
        if self._newest is not None:
            yield self._newest
        elif pieces.whole and not self.about and not self.damage:
            raise RecordError(
                f"{self._path} is an MCAP file, but not a plumeward log: none of its channels has the name "
                "of a bus key"
            )
        self.complete = pieces.whole and not self.damage and STOPPED not in self.about

    def _of_chunk(self, chunk: Chunk) -> list[McapRecord] | list[None]:
        """Return the records of a chunk, None in place of a damaged one's.

        The size that it claims is not trusted.
        """
        if chunk.uncompressed_size > min(LARGEST_PIECE, self._may_unpack):
            return [None]
        try:
            data = UNPACK[chunk.compression](chunk.data, chunk.uncompressed_size)
            records = breakup_chunk(replace(chunk, compression="", data=data), validate_crc=True)
        except (*DAMAGE, zstandard.ZstdError):
            return [None]
        if chunk.compression:
            self._unpacked += len(data)
            if self._unpacked > self._may_unpack:
                raise RecordError(
                    f"{self._path} unpacks to more than {MOST_RATIO} times its size: damaged, or made to "
                    "exhaust memory"
                )
        return records

    def _takes(self, record: McapRecord | None, place: Hole) -> bool:
        """Take a record; returns whether a message begins with it."""
        count = self._count
        try:
            match record:
                case Message():
                    key, ending = self._topics[record.channel_id]
                    if key:
                        self._message(key, ending, record.sequence, record.publish_time, record.data)
                case Channel():
                    self._topics[record.id] = parted(record.topic)
                case Metadata() if record.name == ABOUT:
                    self._describe(record.metadata)
                case None:
                    self._lose(place)
        except DAMAGE:
            self._lose(Hole(place.at, len(record.data)) if isinstance(record, Message) else place)
        return self._count > count

    def _lose(self, hole: Hole) -> None:
        """Note what cannot be read. Pieces between two messages are one place."""
        self._sequence = -1
        if self.damage and (self.damage[-1].before == self._count or len(self.damage) == MOST_PLACES):
            self.damage[-1] = self.damage[-1]._replace(size=self.damage[-1].size + hole.size)
        else:
            self.damage.append(
                Damage(hole.at, hole.size, self._newest.simulation_s if self._newest else 0.0, self._count)
            )

    def _describe(self, told: dict[str, str]) -> None:
        about = {name: value_of(text) for name, text in told.items()}
        written = about.pop(FORMAT_NAME, 0)
        if written not in READABLE:
            raise RecordError(
                f"{self._path} has record format {printable(str(written))} of another plumeward version; "
                f"readable formats: {', '.join(map(str, READABLE))}"
            )
        self.about |= about
        self._format = max(self._format, written)

    def _message(self, key: str, ending: str, sequence: int, published_ns: int, data: bytes) -> None:
        newest = self._newest
        if not ending and has_frames(key):
            simulation_s = newest.simulation_s if newest else 0.0
            self._begin(Entry(key_today(key, data, self._format), published_ns, simulation_s, data), sequence)
        elif ending in ("", MALFORMED) and not has_frames(key):
            text, simulation_s = without_time(data)
            payload = msgspec.json.decode(text, type=Malformed).payload if ending else text
            self._begin(Entry(key, published_ns, simulation_s, payload), sequence)
        elif newest is None or sequence != self._sequence:
            return
        elif ending in (PARTICLES, ATTACHMENT):
            self._newest = newest._replace(attachment=data)
        elif not self._timed:
            self._newest = newest._replace(simulation_s=without_time(data)[1])
            self._timed = True

    def _begin(self, entry: Entry, sequence: int) -> None:
        self._newest = entry
        self._count += 1
        self._sequence, self._timed = sequence, False


# Decompressors that stop at a given size: mcap and zstandard trust the size in the data. Other tools may
# pack with lz4.
UNPACK: dict[str, Callable[[bytes, int], bytes]] = {
    "": lambda data, _: data,
    "lz4": lambda data, size: lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size),
    "zstd": lambda data, size: zstandard.ZstdDecompressor().stream_reader(data).read(size),
}
