"""MCAP files that are written flush by flush: what one flush writes is in the file whole or not at all, also where the disk is full."""

import contextlib
from pathlib import Path
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer, Metadata
from mcap.writer import MCAP0_MAGIC, Writer

UNLIMITED = 1 << 62
"""Size of a chunk: flushes alone close one."""


class WholeFile:
    """A file that whole pieces are appended to."""

    def __init__(self, path: Path) -> None:
        """Begin an empty file; raises OSError where that is not possible."""
        self._file = open(path, "wb", buffering=0)  # noqa: SIM115
        self.size = 0

    def append(self, piece: bytes | bytearray) -> None:
        """Append a piece; where there is no room for all of it, none of it is left, and OSError is raised."""
        left = memoryview(piece)
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError:
            with contextlib.suppress(OSError):
                self._file.truncate(self.size)
                self._file.seek(self.size)
            raise
        self.size += len(piece)

    def close(self) -> None:
        """Close it."""
        self._file.close()


class _Pieces:
    """What the writer takes for its file: gathers what it writes until it flushes."""

    def __init__(self, path: Path) -> None:
        self.file = WholeFile(path)
        self._piece = bytearray()

    def write(self, data: bytes) -> int:
        self._piece += data
        return len(data)

    def tell(self) -> int:
        return self.file.size + len(self._piece)

    def flush(self) -> None:
        piece, self._piece = self._piece, bytearray()
        self.file.append(piece)


class McapFile:
    """An MCAP file with zstd chunks, indexes and summary. All that writes raises OSError where the system does."""

    def __init__(self, path: Path) -> None:
        """Begin a file."""
        self._pieces = _Pieces(path)
        stream: Any = self._pieces
        self._writer = Writer(stream, chunk_size=UNLIMITED)
        self._writer.start()
        self.waiting = 0
        """How many bytes of messages wait for the next flush."""

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Write a record of metadata at once."""
        self._writer.add_metadata(name, data)
        self._pieces.flush()

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; returns its id."""
        schema: int = self._writer.register_schema(name, encoding, data)
        return schema

    def add_channel(self, topic: str, encoding: str, schema: int) -> int:
        """Add a channel; returns its id."""
        channel: int = self._writer.register_channel(topic, encoding, schema)
        return channel

    def add_message(self, channel: int, sequence: int, log_time: int, publish_time: int, data: bytes) -> None:
        """Add a message to the chunk."""
        self._writer.add_message(channel, log_time, data, publish_time, sequence)
        self.waiting += len(data)

    def flush(self) -> None:
        """Close the chunk, and hand it to the system."""
        self.waiting = 0
        self._writer.flush()  # type: ignore[no-untyped-call]

    def finish(self) -> None:
        """Write what waits and the summary, and close."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._pieces.flush()
        self._pieces.file.close()

    def break_off(self, name: str, data: dict[str, str]) -> None:
        """Give up what waits, end the file as shortly as the format allows, with a record of metadata, and close."""
        end = RecordBuilder()
        for record in (Metadata(name, data), DataEnd(0), Footer(0, 0, 0)):
            record.write(end)
        with contextlib.suppress(OSError):
            self._pieces.file.append(bytes(end.end()) + MCAP0_MAGIC)  # type: ignore[no-untyped-call]
        self._pieces.file.close()
