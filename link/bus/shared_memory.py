"""Zenoh's files in shared memory: removed when a process ends, and after one that was killed.

Each process that uses such a file holds a shared lock on it. Zenoh 1.10.2 removes its own files at exit only if nothing refers to the
session any more. Files that nobody has locked it removes when the next process opens a session.
"""

import contextlib
import fcntl
import os
from pathlib import Path

FOLDER = Path("/dev/shm")
ENDING = ".zenoh"


def release() -> None:
    """Remove the files that only this process uses. Call it last: its sessions are of no use afterwards."""
    with contextlib.suppress(OSError):  # there is no /proc: not Linux
        for descriptor in Path("/proc/self/fd").iterdir():
            with contextlib.suppress(OSError):
                path = Path(os.readlink(descriptor))
                if path.parent == FOLDER and path.suffix == ENDING:
                    _remove(int(descriptor.name), path)


def sweep() -> None:
    """Remove the files that no process uses, where this user may."""
    for path in FOLDER.glob(f"*{ENDING}"):
        with contextlib.suppress(OSError):
            descriptor = os.open(path, os.O_RDWR)
            try:
                _remove(descriptor, path)
            finally:
                os.close(descriptor)


def _remove(descriptor: int, path: Path) -> None:
    """Remove a file, if the lock on it can be had alone; raises OSError if not."""
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    path.unlink()
