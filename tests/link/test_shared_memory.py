"""Protects shared memory from files that nobody uses: a service leaves none, however it ends."""

import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from link import shared_memory

pytestmark = pytest.mark.skipif(not shared_memory.FOLDER.exists(), reason="this system has no /dev/shm")


def used_by(pid: int) -> set[Path]:
    """Zenoh's files in shared memory that a process has open."""
    links = [os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir() if link.is_symlink()]
    return {Path(link) for link in links if link.startswith(str(shared_memory.FOLDER)) and link.endswith(shared_memory.ENDING)}


def test_a_service_that_is_ended_leaves_no_file(wait_until: Callable) -> None:
    command = [sys.executable, "-m", "sitl", "router", "--listen", "tcp/127.0.0.1:0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as router:
        assert router.stdout
        router.stdout.readline()
        files = used_by(router.pid)
        router.send_signal(signal.SIGTERM)
        router.wait(30)
    assert files
    assert not any(path.exists() for path in files)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in place of /dev/shm, with files that are this process's own, another's too, a dead one's, and not Zenoh's."""
    monkeypatch.setattr(shared_memory, "FOLDER", tmp_path)
    for name in ("own.zenoh", "shared.zenoh", "dead.zenoh", "other.dat"):
        (tmp_path / name).touch()
    return tmp_path


def test_a_process_removes_its_own_files_and_those_of_the_dead_but_none_that_is_used(folder: Path) -> None:
    other = "import fcntl, sys; file = open(sys.argv[1]); fcntl.flock(file, fcntl.LOCK_SH); print('has it', flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", other, str(folder / "shared.zenoh")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout
        assert process.stdout.readline() == b"has it\n"
        with (folder / "own.zenoh").open() as own, (folder / "shared.zenoh").open() as shared:
            for file in (own, shared):
                fcntl.flock(file, fcntl.LOCK_SH)
            shared_memory.tidy()
        assert {path.name for path in folder.iterdir()} == {"shared.zenoh", "other.dat"}


def test_a_process_that_has_used_none_touches_none(folder: Path) -> None:
    shared_memory.tidy()
    assert len(list(folder.iterdir())) == 4
