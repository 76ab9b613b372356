"""The parts of a mission as child processes: started, watched, and ended together."""

import contextlib
import ctypes
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import IO, NamedTuple, NoReturn, Self

from link.bus import log
from link.bus.inbox import Inbox
from link.cli import BAD_INPUT, FAILED, INTERRUPTED

STOP_TIMEOUT_S = 1.0
LAST = ("recorder", "router")
"""Ended behind the others, in this order: the record is to hold their last words."""
PR_SET_PDEATHSIG = 1
LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None


class Ended(NamedTuple):
    """A part is gone; its last words say why."""

    part: str
    status: int
    last_words: str


class LogLine(NamedTuple):
    """A line that a part wrote on stderr, as people are told it."""

    part: str
    line: str
    level: str = "info"


class MissionFailed(Exception):
    """A mission or a replay cannot go on; the text says why, the status is the launcher's."""

    def __init__(self, text: str, status: int = FAILED) -> None:
        """Take the reason and the exit status."""
        super().__init__(text)
        self.status = status


def raise_for(ended: Ended) -> NoReturn:
    """Raise what the end of a part means for the whole."""
    if ended.status == INTERRUPTED:
        raise KeyboardInterrupt  # somebody interrupted a part: that ends all as Ctrl-C does
    if ended.status == BAD_INPUT:
        raise MissionFailed(ended.last_words.rpartition("error: ")[2], BAD_INPUT)
    how = f"was killed by signal {-ended.status}" if ended.status < 0 else f"exited with status {ended.status}"
    raise MissionFailed(f"{ended.part} {how}; its last words: {ended.last_words}")


def _die_with_the_launcher() -> None:
    """Have Linux end this child when the launcher dies, however it dies."""
    if LIBC:
        LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C and SIGTERM back, so that a child that has been started is also known to have been."""
    held: list[int] = []
    before = {number: signal.signal(number, lambda number, _: held.append(number)) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if held:
        raise KeyboardInterrupt


class Processes:
    """The children; what becomes of them goes into the inbox."""

    def __init__(self, inbox: Inbox) -> None:
        """Start with none."""
        self._inbox = inbox
        self._children: dict[str, subprocess.Popen[str]] = {}
        self._commands: dict[str, tuple[str, ...]] = {}
        self._killed: list[subprocess.Popen[str]] = []
        self._threads: list[threading.Thread] = []

    def start(self, part: str, module: str, *arguments: str) -> IO[str]:
        """Start `python -m module arguments`; returns its stdout."""
        with _uninterrupted():
            child = subprocess.Popen(
                [sys.executable, "-m", module, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                preexec_fn=_die_with_the_launcher,
            )
            self._children[part] = child
            self._commands[part] = (module, *arguments)
            thread = threading.Thread(target=self._watch, args=(part, child), daemon=True)
            thread.start()
            self._threads.append(thread)
        assert child.stdout is not None
        return child.stdout

    def start_router(self, listen: str) -> str:
        """Start a router; returns its endpoint, where it is started again too. Raises MissionFailed where it cannot listen."""
        endpoint = self.start("router", "sitl", "router", "--listen", listen).readline().strip()
        while not endpoint:
            if isinstance(item := self._inbox.get(), Ended):
                raise_for(item)
        self._commands["router"] = ("sitl", "router", "--listen", endpoint)
        return endpoint

    def kill(self, part: str) -> None:
        """Kill a part on purpose: its end does not go into the inbox."""
        child = self._children[part]
        self._killed.append(child)
        child.kill()
        child.wait()

    def restart(self, part: str) -> None:
        """Start a part that was killed again, as it was started first; a router where it was."""
        self.start(part, *self._commands[part])

    def _watch(self, part: str, child: "subprocess.Popen[str]") -> None:
        assert child.stderr is not None
        words: deque[str] = deque(maxlen=1)
        put = self._inbox.lane(f"lines of the {part}")
        for line in child.stderr:
            if line.strip():
                level, text = log.parse(line.strip())
                words.append(text)
                put(LogLine(part, text, level), len(text))
        status = child.wait()
        if child not in self._killed:
            self._inbox.put(Ended(part, status, words[-1] if words else "no last words"))

    def __enter__(self) -> Self:
        """Enter a with block, which ends all of them at its end."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all of them."""
        self.stop()

    def stop(self) -> None:
        """End all of them, kindly first; afterwards none is left, however often Ctrl-C is pressed meanwhile."""
        with contextlib.suppress(KeyboardInterrupt), _uninterrupted():
            self._stop()

    def _stop(self) -> None:
        for group in (set(self._children) - set(LAST), *({part} for part in LAST)):
            self._end([child for part, child in self._children.items() if part in group])
        for thread in self._threads:
            thread.join()
        for child in (*self._killed, *self._children.values()):
            if child.stdout:
                child.stdout.close()
            if child.stderr:
                child.stderr.close()

    @staticmethod
    def _end(children: "list[subprocess.Popen[str]]") -> None:
        for child in children:
            with contextlib.suppress(ProcessLookupError):
                child.send_signal(signal.SIGTERM)
                child.send_signal(signal.SIGCONT)  # one that was stopped could not end
        deadline = time.monotonic() + STOP_TIMEOUT_S
        for child in children:
            try:
                child.wait(max(deadline - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
