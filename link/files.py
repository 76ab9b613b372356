"""Files that are written completely or not at all, and by one process at a time."""

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Yield a file beside `path` to write to.

    It replaces `path` when the block ends, and is removed if the block fails.

    A pipe or a device, such as /dev/stdout, is written to directly.
    """
    if path.exists() and not path.is_file():
        yield path
        return
    target = path.resolve()  # a link stays a link
    partial = _beside(target)
    try:
        yield partial
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)


def obstacle(path: Path) -> str | None:
    """Return what would keep `whole` from writing a file, found by trying; None if nothing does."""
    try:
        if path.is_dir():
            return "is a folder; wanted a file"
        if path.exists() and not path.is_file():
            return None if os.access(path, os.W_OK) else f"cannot be written: {os.strerror(errno.EACCES)}"
        partial = _beside(path.resolve())
        partial.open("ab").close()
        partial.unlink()
    except OSError as error:
        return f"cannot be written: {error.strerror}"
    return None


def drop_if_empty(folder: Path) -> None:
    """Remove a folder that was made for files which nobody will write now."""
    with contextlib.suppress(OSError):
        folder.rmdir()


def _beside(target: Path) -> Path:
    return target.with_name(f"{target.name}.{os.getpid()}.partial")


def claim(file: IO[bytes]) -> None:
    """Claim an open file until it is closed. Raises OSError if another process has."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OSError(errno.EBUSY, "another process is writing it") from None
    except OSError:  # a file system that knows no locks
        pass


def is_claimed(path: Path) -> bool:
    """Whether another process has claimed the file at `path`."""
    try:
        if path.is_file():
            with path.open("rb") as file:
                claim(file)
    except OSError as error:
        return error.errno == errno.EBUSY
    return False


class Appender:
    """A file to which pieces are appended: what is flushed is in it whole or not at all."""

    def __init__(self, path: Path) -> None:
        """Create an empty file; raises OSError if that fails, or if another process is writing it."""
        # Opened as it is, not emptied: it may be another process's.
        self._file = open(os.open(str(path), os.O_WRONLY | os.O_CREAT, 0o666), "wb", buffering=0)  # noqa: SIM115
        self._size = 0
        self._piece = bytearray()  # waits for the next flush
        try:
            claim(self._file)
            if path.is_file():
                self._file.truncate()
        except OSError:
            self._file.close()
            raise

    def write(self, data: bytes) -> int:
        """Add to the piece that waits."""
        self._piece += data
        return len(data)

    def tell(self) -> int:
        """Return where the next byte will be in the file."""
        return self._size + len(self._piece)

    def flush(self) -> None:
        """Append the piece. Raises OSError if it does not fit; then none of it stays in the file."""
        piece, self._piece = self._piece, bytearray()
        left = memoryview(piece)
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError:
            with contextlib.suppress(OSError):
                self._file.truncate(self._size)
                self._file.seek(self._size)
            raise
        self._size += len(piece)

    def close(self) -> None:
        """Close the file, without what waits."""
        self._file.close()
