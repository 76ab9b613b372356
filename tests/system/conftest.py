"""Real processes for the system tests: their output is collected, and they end with the test."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest


class Part:
    """A process and the lines of its stdout and stderr."""

    def __init__(self, *arguments: str, cwd: Path | None = None) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=cwd,
        )
        self.out: list[str] = []
        self.err: list[str] = []
        self._threads = [
            threading.Thread(target=self._collect, args=streams)
            for streams in ((self.process.stdout, self.out), (self.process.stderr, self.err))
        ]
        for thread in self._threads:
            thread.start()

    def _collect(self, stream, lines: list[str]) -> None:
        with stream:
            lines.extend(iter(stream.readline, ""))

    def says(self, text: str) -> bool:
        return any(text in line for line in self.err)

    def comes_to(self, text: str, timeout_s: float = 400.0) -> None:
        """Wait until it says a text; fails at once, with what it said instead, if it ends before."""
        until_s = time.monotonic() + timeout_s
        while not self.says(text):
            if self.process.poll() is not None or time.monotonic() > until_s:
                said = "".join(self.err[-40:])
                pytest.fail(f"it did not say {text!r} (status {self.process.poll()}); it said:\n{said}")
            self._threads[1].join(0.02)

    def ended(self, timeout_s: float = 400.0) -> int:
        """Wait for the process to end; returns its exit status. `timeout_s` is for what never ends: a busy
        machine must not reach it.
        """
        try:
            status = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            pytest.fail(f"still there after {timeout_s:g} s; it said:\n{''.join(self.err[-20:])}")
        for thread in self._threads:
            thread.join()
        return status

    def kill(self) -> None:
        self.process.kill()
        self.ended()


@pytest.fixture
def start() -> Iterator[type[Part]]:
    """Start `python -m arguments`; processes that still run at the end of the test are killed."""
    parts: list[Part] = []

    class Started(Part):
        def __init__(self, *arguments: str, cwd: Path | None = None) -> None:
            super().__init__(*arguments, cwd=cwd)
            parts.append(self)

    yield Started
    for part in parts:
        part.kill()


def family(pid: int) -> dict[str, int]:
    """The process ids of a launcher's children, by part."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    found = {}
    for child in children:
        words = Path(f"/proc/{child}/cmdline").read_text().split("\0")
        if len(words) < 4:  # forked, but has not yet executed the part
            continue
        found[words[3] if words[2] == "sitl" else words[2]] = int(child)
    return found


@pytest.fixture(name="family")
def family_fixture():
    """Give tests the function `family`."""
    return family
