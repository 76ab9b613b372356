"""The record of a run: every message as it was published in one MCAP file, its MAVLink in a .tlog beside it, and how they are read back.

A payload of MAVLink lies as it flew under its key, and beside it what viewers can plot: each message under `mavlink/out/ATTITUDE` and
the like, a reading under `reading/decoded`. JSON lies under its key with one more field, `simulation_s`; the particles of a belief
under `belief/particles`. What is not what docs/bus.md says is kept under `<key>/malformed`, with the reason. All that comes from one
message has the same times and the same sequence number.
"""

import contextlib
import io
import json
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from link.bus.keys import BELIEF, HEALTH, KEYS, MAVLINK_IN, READING, STOP
from link.bus.mavlink import BadFrame
from link.record.chunks import McapFile, WholeFile
from link.record.decoded import FlatReading, Malformed, decode, decode_reading, encode, message_schema, struct_schema

ABOUT, STOPPED = "plumeward", "stopped"
"""Name of the metadata record that says what the run was, and the entry of a second one which says why the record broke off."""
MALFORMED, DECODED, PARTICLES, ATTACHMENT = "malformed", "decoded", "particles", "attachment"
"""What topics add to their key."""
CHUNK_BYTES = 4_000_000
"""A chunk is closed when it holds this much, if no flush has closed it before."""
TLOG_LAG_NS = 100_000_000
"""A frame goes into the .tlog this long after it was published: so those that overtook each other on their way are in order again."""

STRUCTS: dict[str, type[msgspec.Struct]] = {key.name: key.payload for key in KEYS if isinstance(key.payload, type)}
DECODERS = {name: msgspec.json.Decoder(kind) for name, kind in STRUCTS.items()}
FRAME_KEYS = {key.name for key in KEYS if isinstance(key.payload, str)}
HEALTH_PREFIX = HEALTH.name.removesuffix("<service>")


class RecordError(ValueError):
    """The file is no log that can be read; the text is one clear line."""


class Entry(NamedTuple):
    """One message of a run."""

    key: str
    """Relative to the vehicle's namespace: `reading`, `mavlink/out`, `health/uav`."""
    published_ns: int
    """When it was published, ns since the Unix epoch."""
    simulation_s: float
    """Simulation time: the message's own where it has one, else the newest one known."""
    payload: bytes
    attachment: bytes = b""


class Recording(NamedTuple):
    """What a log holds."""

    about: dict[str, Any]
    """What the launcher told of the run, with versions, git revision, host and namespace; empty where the file has none of it."""
    entries: list[Entry]
    """All messages, in the order in which they were recorded."""
    complete: bool
    """False where the record was cut off, or broke off by itself: then about["stopped"] says why."""


def _row(key: str) -> str:
    """The name of the row of the table of keys that a key is of; empty where it is of none."""
    name = HEALTH.name if key.startswith(HEALTH_PREFIX) else key
    return name if name in STRUCTS or name in FRAME_KEYS else ""


def parted(topic: str) -> tuple[str, str]:
    """Return the key that a topic belongs to, empty where it is none of ours, and what the topic adds to it."""
    words = topic.split("/")
    for count in (1, 2):
        if _row(key := "/".join(words[:count])):
            return key, "/".join(words[count:])
    return "", topic


# ---- simulation time ----


class _Timed(msgspec.Struct):
    time_boot_ms: Annotated[int, msgspec.Meta(ge=0, lt=2**32)]


OWN_TIME = {30, 32, 33}
"""ATTITUDE, LOCAL_POSITION_NED and GLOBAL_POSITION_INT begin with the vehicle's own time_boot_ms."""
WAYPOINT = {84}
"""SET_POSITION_TARGET_LOCAL_NED begins with the time_boot_ms of the reading it answers."""


def _time_boot_ms(payload: bytes, message_ids: set[int]) -> int | None:
    """The time that the first such MAVLink 2 frame begins with, without decoding more than headers."""
    at = 0
    while at + 12 <= len(payload) and payload[at] == 0xFD:
        length = payload[at + 1]
        if int.from_bytes(payload[at + 7 : at + 10], "little") in message_ids:
            return int.from_bytes(payload[at + 10 : at + 10 + min(length, 4)], "little")  # zeros at a payload's end are not sent
        at += 12 + length + (13 if payload[at + 2] & 1 else 0)
    return None


class SimulationClock:
    """Tells the simulation time of messages from what the vehicle says."""

    def __init__(self) -> None:
        """Begin at zero."""
        self._newest_ms = 0
        self._told_ns = 0
        self._readings: set[int] = set()

    def time_s(self, key: str, payload: bytes, published_ns: int) -> float:
        """Simulation time of a message; of the vehicle's, the last published one counts, so that one which begins anew is followed."""
        own: int | None = None
        if key in (BELIEF.name, STOP.name):
            with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError):
                own = msgspec.json.decode(payload, type=_Timed).time_boot_ms
        elif key == MAVLINK_IN.name:
            answered = _time_boot_ms(payload, WAYPOINT)
            own = answered if answered in self._readings else None  # a ground station may send times of its own
        elif key in FRAME_KEYS:
            own = _time_boot_ms(payload, OWN_TIME)
            if own is not None and key == READING.name:
                self._readings.add(own)
            if own is not None and published_ns >= self._told_ns:
                self._newest_ms, self._told_ns = own, published_ns
        return (self._newest_ms if own is None else own) / 1000.0

    @property
    def step(self) -> int:
        """Number of the newest reading, 0 at the start; -1 before the first."""
        return len(self._readings) - 1


# ---- writing ----


class Writer:
    """Writes PATH and the .tlog of the same stem. Where that fails it raises OSError, and leaves what was flushed readable."""

    def __init__(self, path: Path, about: dict[str, Any]) -> None:
        """Begin the files with what the run is about; raises OSError where they cannot be written."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._mcap, self._tlog = McapFile(path), _Tlog(path.with_suffix(".tlog"))
        self._channels: dict[tuple[str, str], int] = {}
        self._count = 0
        self._mcap.add_metadata(ABOUT, {name: _text(value) for name, value in about.items()})

    def write(self, entry: Entry, received_ns: int) -> None:
        """Write one message, with all that belongs to it, behind those that were received before."""
        if entry.key in FRAME_KEYS:
            self._write_frames(entry, received_ns)
        else:
            self._write_json(entry, received_ns)
        if entry.attachment:
            self._add(entry, PARTICLES if entry.key == BELIEF.name else ATTACHMENT, received_ns, entry.attachment)
        self._count += 1
        if self._mcap.waiting > CHUNK_BYTES:
            self.flush()

    def _write_json(self, entry: Entry, received_ns: int) -> None:
        try:
            DECODERS[_row(entry.key)].decode(entry.payload)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            self._add_malformed(entry, received_ns, str(error))
        else:
            self._add(entry, "", received_ns, _with_time(entry.payload, entry.simulation_s))

    def _write_frames(self, entry: Entry, received_ns: int) -> None:
        self._add(entry, "", received_ns, entry.payload)
        try:
            messages = decode(entry.payload)
            for message in messages:
                self._tlog.add(entry.published_ns, received_ns, message.frame)
            if entry.key == READING.name:
                self._add(entry, DECODED, received_ns, _with_time(encode(decode_reading(entry.payload, messages)), entry.simulation_s))
            else:
                time_field = _time_field(entry.simulation_s)
                for message in messages:
                    self._add(entry, message.kind, received_ns, message.fields[:-1] + time_field)
        except BadFrame as error:
            self._add_malformed(entry, received_ns, str(error))

    def _add_malformed(self, entry: Entry, received_ns: int, reason: str) -> None:
        self._add(entry, MALFORMED, received_ns, _with_time(encode(Malformed(reason, entry.payload)), entry.simulation_s))

    def _add(self, entry: Entry, ending: str, received_ns: int, data: bytes) -> None:
        channel = self._channels.get((entry.key, ending)) or self._open_channel(entry.key, ending)
        self._mcap.add_message(channel, self._count, received_ns, entry.published_ns, data)

    def _open_channel(self, key: str, ending: str) -> int:
        encoding, schema_id = "json", 0
        if ending in (PARTICLES, ATTACHMENT):
            encoding = "bytes"
        elif not ending and key in FRAME_KEYS:
            encoding = "mavlink"
        else:
            kinds: dict[str, type[msgspec.Struct]] = {MALFORMED: Malformed, DECODED: FlatReading}
            kind = kinds.get(ending) or STRUCTS.get(_row(key))
            schema = struct_schema(kind) if kind else message_schema(ending)
            schema_id = self._mcap.add_schema(schema["title"], "jsonschema", json.dumps(schema, ensure_ascii=False).encode())
        channel = self._mcap.add_channel(f"{key}/{ending}" if ending else key, encoding, schema_id)
        self._channels[key, ending] = channel
        return channel

    def flush(self) -> None:
        """Close the chunk and hand all to the system, but for frames of the .tlog that may be overtaken."""
        with self._breaking_off():
            self._mcap.flush()
            self._tlog.flush(time.time_ns() - TLOG_LAG_NS)

    def close(self) -> None:
        """Finish the files."""
        with self._breaking_off():
            self._mcap.finish()
            self._tlog.finish()

    @contextlib.contextmanager
    def _breaking_off(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._mcap.break_off(ABOUT, {STOPPED: error.strerror or str(error)})
            self._tlog.close()
            raise


def _text(value: object) -> str:
    """A value of the metadata, which are strings: JSON, but for a string that cannot be mistaken for it."""
    if isinstance(value, str):
        try:
            json.loads(value)
        except ValueError:
            return value
    return json.dumps(value, ensure_ascii=False)


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def _with_time(text: bytes, simulation_s: float) -> bytes:
    """Add the simulation time as the last field of a JSON object that has fields."""
    head, _, blank = text.rpartition(b"}")
    return head + _time_field(simulation_s) + blank


def _time_field(simulation_s: float) -> bytes:
    return f',"simulation_s":{simulation_s!r}}}'.encode()


def _without_time(text: bytes) -> tuple[bytes, float]:
    """Undo `_with_time`, to the last byte."""
    head, _, tail = text.rpartition(b',"simulation_s":')
    number, _, blank = tail.partition(b"}")
    return head + b"}" + blank, float(number)


class _Tlog:
    """MAVLink frames, each behind its time: 8 bytes, big-endian, µs since the Unix epoch."""

    def __init__(self, path: Path) -> None:
        self._file = WholeFile(path)
        self._waiting: list[tuple[int, int, bytes]] = []
        self._last_us = 0

    def add(self, published_ns: int, received_ns: int, frame: bytes) -> None:
        self._waiting.append((published_ns, received_ns, frame))

    def flush(self, until_ns: int) -> None:
        """Write what was received until then, and what was published before it."""
        self._waiting.sort(key=lambda waiting: waiting[0])
        due = max((n for n, (_, received_ns, _) in enumerate(self._waiting, 1) if received_ns <= until_ns), default=0)
        piece = bytearray()
        for published_ns, _, frame in self._waiting[:due]:
            self._last_us = max(published_ns // 1000, self._last_us)
            piece += self._last_us.to_bytes(8) + frame
        self._file.append(piece)
        del self._waiting[:due]

    def finish(self) -> None:
        self.flush(max((received_ns for _, received_ns, _ in self._waiting), default=0))
        self.close()

    def close(self) -> None:
        self._file.close()


# ---- reading ----

RECORD, MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")


def _records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """The records of a file, those within chunks too, as opcode and content; ends before one that is cut off."""
    at = 0
    while at + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, at)
        at += RECORD.size + length
        if at > len(data):
            return
        content = data[at - length : at]
        if opcode == Opcode.CHUNK:
            stream, size = get_chunk_data_stream(Chunk.read(_stream(content)), validate_crc=True)
            yield from _records(memoryview(stream.read(size)))
        else:
            yield opcode, content


def _stream(content: memoryview) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))


def read(path: Path) -> Recording:
    """Read a log, also one that was cut off; raises RecordError where it is none."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordError(f"{path}: {error.strerror}") from None
    if not data.startswith(MCAP0_MAGIC):
        raise RecordError(f"{path} is no MCAP file")
    reader = _Reader()
    whole = False
    with contextlib.suppress(McapError, zstandard.ZstdError, struct.error, ValueError, LookupError):  # damage ends a log as a cut does
        for opcode, content in _records(memoryview(data)[len(MCAP0_MAGIC) :]):
            reader.take(opcode, content)
        whole = reader.ended and data.endswith(MCAP0_MAGIC)
    if whole and not reader.entries and not reader.about:
        raise RecordError(f"{path} is an MCAP file, but no log of ours: none of its channels is named as a key of the bus")
    return Recording(reader.about, reader.entries, whole and STOPPED not in reader.about)


class _Reader:
    """Puts what was recorded of each message together again."""

    def __init__(self) -> None:
        self.about: dict[str, Any] = {}
        self.entries: list[Entry] = []
        self.ended = False
        self._topics: dict[int, tuple[str, str]] = {}
        self._sequence = -1
        self._timed = False

    def take(self, opcode: int, content: memoryview) -> None:
        if opcode == Opcode.MESSAGE:
            channel, sequence, _, published_ns = MESSAGE.unpack_from(content)
            key, ending = self._topics[channel]
            if key:
                self._message(key, ending, sequence, published_ns, bytes(content[MESSAGE.size :]))
        elif opcode == Opcode.CHANNEL:
            opened = Channel.read(_stream(content))
            self._topics[opened.id] = parted(opened.topic)
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(_stream(content))
            if metadata.name == ABOUT:
                self.about |= {name: _value(text) for name, text in metadata.metadata.items()}
        elif opcode == Opcode.FOOTER:
            self.ended = True

    def _message(self, key: str, ending: str, sequence: int, published_ns: int, data: bytes) -> None:
        if not ending and key in FRAME_KEYS:
            self._begin(Entry(key, published_ns, self.entries[-1].simulation_s if self.entries else 0.0, data), sequence)
        elif not ending:
            payload, simulation_s = _without_time(data)
            self._begin(Entry(key, published_ns, simulation_s, payload), sequence)
        elif ending == MALFORMED and key not in FRAME_KEYS:
            text, simulation_s = _without_time(data)
            self._begin(Entry(key, published_ns, simulation_s, msgspec.json.decode(text, type=Malformed).payload), sequence)
        elif sequence == self._sequence and ending in (PARTICLES, ATTACHMENT):
            self.entries[-1] = self.entries[-1]._replace(attachment=data)
        elif sequence == self._sequence and not self._timed:
            self.entries[-1] = self.entries[-1]._replace(simulation_s=_without_time(data)[1])
            self._timed = True

    def _begin(self, entry: Entry, sequence: int) -> None:
        self.entries.append(entry)
        self._sequence, self._timed = sequence, False
