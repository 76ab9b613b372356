"""Files that are written completely or not at all, and by one process at a time."""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO


@contextmanager
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
