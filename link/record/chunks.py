"""MCAP files with atomic flushes: each flush is in the file whole or not at all, even if the disk is full."""

import contextlib
import os
from pathlib import Path
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer, Metadata
from mcap.writer import MCAP0_MAGIC, Writer

from link.files import claim

UNLIMITED = 1 << 62  # chunk size that is never reached: only a flush closes a chunk


def _as_it_is(path: str, flags: int) -> int:
    """Open a file without emptying it: it may be another process's."""
    return os.open(path, flags & ~os.O_TRUNC, 0o666)


class WholeFile:
    """A file to which pieces are appended, each whole or not at all."""

    def __init__(self, path: Path) -> None:
        """Create an empty file; raises OSError if that fails, or if another process is writing it."""
        self._file = open(path, "wb", buffering=0, opener=_as_it_is)  # noqa: SIM115
        self.size = 0
        try:
            claim(self._file)
            if path.is_file():
                self._file.truncate()
        except OSError:
            self._file.close()
            raise

    def append(self, piece: bytes | bytearray) -> None:
        """Append a piece. Raises OSError if it does not fit; then none of it stays in the file."""
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
        """Close the file."""
        self._file.close()


class _Pieces:
    """The file object of the MCAP writer: buffers its output until a flush."""

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


class McapFile(Writer):
    """An MCAP file with zstd chunks, indexes and summary.

    Methods that write raise OSError if the system does.
    """

    def __init__(self, path: Path) -> None:
        self._pieces = _Pieces(path)
        stream: Any = self._pieces
        super().__init__(stream, chunk_size=UNLIMITED)
        self.waiting = 0  # bytes of messages that wait for the next flush
        self.start()

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Write a metadata record at once."""
        super().add_metadata(name, data)
        self._pieces.flush()

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """Add a message to the chunk."""
        super().add_message(channel_id, log_time, data, publish_time, sequence)
        self.waiting += len(data)

    def flush(self) -> None:
        """Close the chunk and write it."""
        self.waiting = 0
        super().flush()  # type: ignore[no-untyped-call]

    def finish(self) -> None:
        """Write the waiting messages and the summary, then close the file."""
        super().finish()  # type: ignore[no-untyped-call]
        self._pieces.flush()
        self._pieces.file.close()

    def break_off(self, name: str, data: dict[str, str]) -> None:
        """Discard the waiting messages, and end and close the file.

        Its end is a metadata record and the shortest valid footer.
        """
        end = RecordBuilder()
        for record in (Metadata(name, data), DataEnd(0), Footer(0, 0, 0)):
            record.write(end)
        with contextlib.suppress(OSError):
            self._pieces.file.append(bytes(end.end()) + MCAP0_MAGIC)  # type: ignore[no-untyped-call]
        self._pieces.file.close()
