"""Zenoh's files in shared memory: removed when a process ends, and after one that was killed.

Each process that uses such a file holds a shared lock on it. Zenoh 1.10.2 removes its own files at exit only if nothing refers to the
session any more. Files that nobody has locked it removes when the next process opens a session.
"""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path("/dev/shm")
ENDING = ".zenoh"


def tidy() -> None:
    """Remove the files that only this process uses, and, if it has used any, those of the dead. Call it last: it ends all sessions here."""
    own = [(number, path) for number, path in _open_files() if path.parent == FOLDER and path.suffix == ENDING]
    for number, path in own:
        with contextlib.suppress(OSError):
            _remove(number, path)
    for path in FOLDER.glob(f"*{ENDING}") if own else ():
        with contextlib.suppress(OSError):  # another user's
            descriptor = os.open(path, os.O_RDWR)
            try:
                _remove(descriptor, path)
            finally:
                os.close(descriptor)


def _open_files() -> Iterator[tuple[int, Path]]:
    """Yield the files that this process has open, with their descriptors; none where there is no /proc."""
    with contextlib.suppress(OSError):
        for link in Path("/proc/self/fd").iterdir():
            with contextlib.suppress(OSError):
                yield int(link.name), Path(os.readlink(link))


def _remove(descriptor: int, path: Path) -> None:
    """Remove a file, if the lock on it can be had alone; raises OSError if not."""
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    path.unlink()
