"""Writes the record of a running mission: an MCAP file of all messages, a .tlog of the MAVLink frames."""

import contextlib
import json
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any, cast

import msgspec
from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer, Metadata
from mcap.writer import MCAP0_MAGIC
from mcap.writer import Writer as McapWriter

from link.bus.keys import BELIEF, READING
from link.bus.mavlink import BadFrame, split
from link.files import Appender
from link.record.decoded import (
    FlatReading,
    Malformed,
    decode,
    decode_reading,
    encode,
    message_schema,
    struct_schema,
)
from link.record.record import (
    ABOUT,
    ATTACHMENT,
    DECODED,
    FORMAT,
    FORMAT_NAME,
    MALFORMED,
    PARTICLES,
    STOPPED,
    STRUCTS,
    Entry,
    has_frames,
    row,
    text_of,
    time_field,
    with_time,
)

# Both files are flushed when this many bytes of messages wait, if not before. Only a flush closes a chunk.
FLUSH_BYTES = 4_000_000
UNLIMITED = 1 << 62  # chunk size that is never reached
# A flush leaves frames younger than this out of the .tlog, so that frames that overtook each other are
# written in order.
TLOG_LAG_NS = 100_000_000
DECODERS = {name: msgspec.json.Decoder(kind) for name, kind in STRUCTS.items()}


class Writer:
    """Writes PATH and the .tlog of the same stem.

    If writing fails, it raises OSError; what was flushed stays readable.
    """

    def __init__(self, path: Path, about: dict[str, Any]) -> None:
        """Create the files and write the description of the run, `about`; raises OSError if that fails."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file, self._tlog = Appender(path), _Tlog(path.with_suffix(".tlog"))
        self._mcap = McapWriter(cast(IO[bytes], self._file), chunk_size=UNLIMITED)
        self._channels: dict[tuple[str, str], int] = {}
        self._count = 0
        self._waiting = 0  # bytes of messages that wait for the next flush
        self._mcap.start()
        self._mcap.add_metadata(
            ABOUT, {name: text_of(value) for name, value in {**about, FORMAT_NAME: FORMAT}.items()}
        )
        self._file.flush()

    def write(self, entry: Entry, received_ns: int) -> None:
        """Write one message with its decoded copies and its attachment. Call it in order of `received_ns`."""
        try:
            if has_frames(entry.key):
                self._write_frames(entry, received_ns)
            else:
                DECODERS[row(entry.key)].decode(entry.payload)
                self._add(entry, "", received_ns, with_time(entry.payload, entry.simulation_s))
        except (BadFrame, msgspec.DecodeError, UnicodeDecodeError) as error:
            text = encode(Malformed(str(error), entry.payload))
            self._add(entry, MALFORMED, received_ns, with_time(text, entry.simulation_s))
        if entry.attachment:
            self._add(
                entry, PARTICLES if entry.key == BELIEF.name else ATTACHMENT, received_ns, entry.attachment
            )
        self._count += 1
        if self._waiting > FLUSH_BYTES:
            self.flush()

    def write_for_viewers(
        self, topic: str, schema: Callable[[], tuple[str, bytes]], data: bytes, received_ns: int
    ) -> None:
        """Write a protobuf message that was not on the bus.

        Readers of records leave it out, if its topic does not begin with a key's name.

        `schema` returns the name of the message's type and its encoded FileDescriptorSet.
        """
        channel = self._channels.get((topic, ""))
        if channel is None:
            name, described = schema()
            channel = self._channels[topic, ""] = self._mcap.register_channel(
                topic, "protobuf", self._mcap.register_schema(name, "protobuf", described)
            )
        self._put(channel, received_ns, data, received_ns)

    def _write_frames(self, entry: Entry, received_ns: int) -> None:
        self._add(entry, "", received_ns, entry.payload)
        for frame in split(entry.payload):
            self._tlog.add(entry.published_ns, received_ns, frame.data)
        if row(entry.key) == READING.name:
            text = encode(decode_reading(entry.payload))
            self._add(entry, DECODED, received_ns, with_time(text, entry.simulation_s))
        else:
            ending = time_field(entry.simulation_s)
            for kind, fields in decode(entry.payload):
                self._add(entry, kind, received_ns, fields[:-1] + ending)

    def _add(self, entry: Entry, ending: str, received_ns: int, data: bytes) -> None:
        channel = self._channels.get((entry.key, ending)) or self._open_channel(entry.key, ending)
        self._put(channel, received_ns, data, entry.published_ns)

    def _put(self, channel: int, received_ns: int, data: bytes, published_ns: int) -> None:
        self._mcap.add_message(channel, received_ns, data, published_ns, self._count)
        self._waiting += len(data)

    def _open_channel(self, key: str, ending: str) -> int:
        encoding, schema_id = "json", 0
        if ending in (PARTICLES, ATTACHMENT):
            encoding = "bytes"
        elif not ending and has_frames(key):
            encoding = "mavlink"
        else:
            kinds: dict[str, type[msgspec.Struct]] = {MALFORMED: Malformed, DECODED: FlatReading}
            kind = kinds.get(ending) or STRUCTS.get(row(key))
            schema = struct_schema(kind) if kind else message_schema(ending)
            schema_id = self._mcap.register_schema(
                schema["title"], "jsonschema", json.dumps(schema, ensure_ascii=False).encode()
            )
        topic = f"{key}/{ending}" if ending else key
        return self._channels.setdefault(
            (key, ending), self._mcap.register_channel(topic, encoding, schema_id)
        )

    def flush(self) -> None:
        """Write everything that waits, except frames of the .tlog younger than TLOG_LAG_NS."""
        self._waiting = 0
        with self._breaking_off():
            self._mcap.flush()  # type: ignore[no-untyped-call]
            self._tlog.flush_until(time.time_ns() - TLOG_LAG_NS)

    def close(self) -> None:
        """Write everything that waits and close both files."""
        with self._breaking_off():
            self._tlog.flush_until(math.inf)
            self._mcap.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
        self._file.close()
        self._tlog.close()

    @contextlib.contextmanager
    def _breaking_off(self) -> Iterator[None]:
        """If the system cannot write, end and close both files: with the reason, and the shortest footer."""
        try:
            yield
        except OSError as error:
            end = RecordBuilder()
            for record in (
                Metadata(ABOUT, {STOPPED: error.strerror or str(error)}),
                DataEnd(0),
                Footer(0, 0, 0),
            ):
                record.write(end)
            with contextlib.suppress(OSError):
                self._file.write(bytes(end.end()) + MCAP0_MAGIC)  # type: ignore[no-untyped-call]
                self._file.flush()
            self._file.close()
            self._tlog.close()
            raise


class _Tlog(Appender):
    """A .tlog: MAVLink frames, each after its time (8 bytes, big-endian, µs since the Unix epoch)."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._waiting: list[tuple[int, int, bytes]] = []
        self._last_us = 0

    def add(self, published_ns: int, received_ns: int, frame: bytes) -> None:
        self._waiting.append((published_ns, received_ns, frame))

    def flush_until(self, until_ns: float) -> None:
        """Write the frames received until `until_ns`, in order of publishing.

        With them go those published before them.
        """
        self._waiting.sort(key=lambda waiting: waiting[0])
        due = max(
            (n for n, (_, received_ns, _) in enumerate(self._waiting, 1) if received_ns <= until_ns),
            default=0,
        )
        for published_ns, _, frame in self._waiting[:due]:
            self._last_us = max(published_ns // 1000, self._last_us)
            self.write(self._last_us.to_bytes(8) + frame)
        self.flush()
        del self._waiting[:due]
