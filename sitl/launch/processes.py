"""The parts of a mission as child processes: started, watched, and ended together."""

import contextlib
import math
import os
import queue
import re
import selectors
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Self

from link.bus import log
from link.bus.inbox import Inbox
from link.bus.session import SIGNAL_POLL_S
from link.cli import BAD_INPUT, FAILED
from link.early import INTERRUPTED, ask_for_stacks
from link.interrupts import LAUNCHER, uninterrupted
from sitl.launch.output import Lines

STOP_TIMEOUT_S, RECORDER_STOP_TIMEOUT_S, FLYING_STOP_TIMEOUT_S = 1.0, 20.0, 10.0
"""How long a part may take to end, and how much longer the recorder, which writes the end of the record at
low priority, and a part that flies a real vehicle."""
LAST = ("recorder", "router")
"""Ended after the others, in this order, so that the record holds their last words."""
ROOT = Path(__file__).parents[2]
"""Where our packages are."""
ANSWERING = ("recorder", "router", "view")
"""Parts that print a first line on stdout for the launcher when they are ready."""
START_WARN_S, START_LIMIT_S = 15.0, 300.0
"""Time to a part's first message, until people are told and until it counts as hung: on a slow machine it
may compile for minutes.
"""
LEFT_OPEN_S = 0.5
"""How long to read on after a part has ended: its own children may hold its stdout and stderr open."""
CHUNK = 1 << 16
STACK = re.compile(r'((Current t|T)hread 0x[0-9a-f]+ |File ".*", line \d+ in )')
"""How a line of the stacks begins that a part tells when it hangs."""
STACKS_S = 0.5
"""How long a part that is about to be killed may take to write its stacks."""


class Ended(NamedTuple):
    """A part is gone; its last words say why."""

    part: str
    status: int
    last_words: str


class LogLine(NamedTuple):
    """A line that a part wrote, as people see it."""

    part: str
    line: str
    level: str = "info"


class MissionFailed(Exception):
    """A mission or a replay cannot go on; the text says why, the status is the launcher's exit status."""

    def __init__(self, text: str, status: int = FAILED) -> None:
        """Take the reason and the exit status."""
        super().__init__(text)
        self.status = status


def raise_for(ended: Ended) -> NoReturn:
    """Raise the exception that the end of a part means for the mission."""
    if ended.status == INTERRUPTED:
        raise KeyboardInterrupt  # an interrupted part ends the mission as Ctrl-C does
    if ended.status == BAD_INPUT:
        raise MissionFailed(ended.last_words.rpartition("error: ")[2], BAD_INPUT)
    how = (
        f"was killed by signal {-ended.status}" if ended.status < 0 else f"exited with status {ended.status}"
    )
    raise MissionFailed(f"{ended.part} {how}; its last words: {ended.last_words}")


def environment() -> dict[str, str]:
    """Return the environment of a part: it finds our packages, and no file of the current folder that has
    their names.
    """
    found = {**os.environ, LAUNCHER: str(os.getpid()), "PYTHONSAFEPATH": "1"}
    if ROOT.name not in ("site-packages", "dist-packages"):  # in a checkout, which need not be installed
        found["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return found


def secure_words(secure: Path | None) -> tuple[str, ...]:
    """Return the flag that tells a part where the certificates are."""
    return () if secure is None else ("--secure", str(secure))


class Child:
    """One part as a process. It leads a process group: its children end with it, and a terminal's Ctrl-C
    reaches only the launcher.
    """

    def __init__(self, part: str, command: list[str], inbox: Inbox) -> None:
        """Start it. Its output and its end go into the inbox."""
        self.part = part
        self.killed = False
        """Whether its end is intended: then it is not reported."""
        self.flies = False
        """Whether it flies a real vehicle: it then ends before all others, with the time to send it home,
        and is never suspended.
        """
        self._inbox = inbox
        self._answer = Inbox()
        self._awaited = part in ANSWERING
        self._lines = inbox.lane(f"lines of the {part}")
        self._last_words = "no last words"
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            process_group=0,
            env=environment(),
        )
        self._thread = threading.Thread(target=self._watch, name=part, daemon=True)
        self._thread.start()

    def readline(self) -> str:
        """Wait for the answer of an ANSWERING part; empty if it ends without one. Raises MissionFailed if
        it hangs.
        """
        began, told = time.monotonic(), False
        while True:
            try:
                return str(self._answer.get(timeout=SIGNAL_POLL_S))
            except queue.Empty:
                waited_s = time.monotonic() - began
            if waited_s >= START_LIMIT_S:
                raise MissionFailed(
                    f"the {self.part} has said nothing in {START_LIMIT_S:g} s since it was started"
                )
            if waited_s >= START_WARN_S and not told:
                print(f"waiting for the {self.part} to start", file=sys.stderr)
                told = True

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        self._process.send_signal(number)  # does nothing if it has ended

    def tell_stacks(self) -> None:
        """Ask it, which hangs, to write where its threads are. They are shown at once; of one that is
        stopped once it continues.
        """
        ask_for_stacks(self._process.pid)

    def kill(self) -> None:
        """Kill it and its children."""
        with contextlib.suppress(OSError):  # already gone
            os.killpg(self._process.pid, signal.SIGKILL)

    def wait(self, timeout_s: float) -> bool:
        """Return whether it ends in time."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def join(self) -> None:
        """Wait until all its output has been passed on. Call it after the process has ended."""
        self._thread.join()

    def _watch(self) -> None:
        """Pass on its output and its end. Its children end with it, unless they left the process group."""
        process, give_up_at = self._process, math.inf
        assert process.stdout
        assert process.stderr
        with process.stdout, process.stderr, selectors.DefaultSelector() as pipes:
            for pipe in (process.stdout, process.stderr):
                pipes.register(pipe, selectors.EVENT_READ, Lines())
            while pipes.get_map() and time.monotonic() < give_up_at:
                for key, _ in pipes.select(SIGNAL_POLL_S):
                    data = os.read(key.fd, CHUNK)
                    for line in key.data.take(data):
                        self._said(line, key.fileobj is process.stdout)
                    if not data:
                        pipes.unregister(key.fileobj)
                if math.isinf(give_up_at) and process.poll() is not None:
                    self.kill()
                    give_up_at = time.monotonic() + LEFT_OPEN_S
        status = process.wait()
        self.kill()
        if not self.killed:
            self._inbox.put(Ended(self.part, status, self._last_words))
        self._answer.put("")

    def _said(self, line: str, on_stdout: bool) -> None:
        if on_stdout and self._awaited:
            self._awaited = False
            self._answer.put(line)
            return
        if STACK.match(line):  # at once: it is about to be killed, and then nobody reads the inbox
            print(f"{self.part}: {line}", file=sys.stderr)
            return
        level, text = ("info", f"{self.part}: {line}") if on_stdout else log.parse(line)
        if not on_stdout:
            self._last_words = text
        self._lines(LogLine(self.part, text, level), len(text))


class Processes:
    """The child processes; their output and ends go into the inbox."""

    def __init__(self, inbox: Inbox) -> None:
        """Start with none."""
        self._inbox = inbox
        self._children: dict[str, Child] = {}
        self._commands: dict[str, tuple[str, ...]] = {}
        self._all: list[Child] = []
        self._suspended_before: Any = None

    def start(self, part: str, module: str, *arguments: str) -> Child:
        """Start `python -m module arguments`."""
        with uninterrupted():
            child = Child(part, [sys.executable, "-m", module, *arguments], self._inbox)
            self._children[part] = child
            self._commands[part] = (module, *arguments)
            self._all.append(child)
        return child

    def start_router(self, listen: str, secure: Path | None = None) -> str:
        """Start a router; returns its endpoint, which a restart uses again. Raises MissionFailed if it
        cannot listen.
        """
        words = ("sitl", "router", *secure_words(secure), "--listen")
        endpoint = self.answer(self.start("router", *words, listen))
        self._commands["router"] = (*words, endpoint)
        return endpoint

    def answer(self, child: Child) -> str:
        """Wait for the answer of an ANSWERING part. If a part ends instead, raises what that means."""
        line = child.readline().strip()
        while not line:
            if isinstance(item := self._inbox.get(), Ended):
                raise_for(item)
        return line

    def release(self, part: str) -> None:
        """Let a part outlast the others: its end is the caller's business."""
        self._all.remove(self._children.pop(part))

    def tell_stacks(self, part: str) -> None:
        """Let a part of ours that hangs tell where its threads are."""
        if child := self._children.get(part):
            child.tell_stacks()

    def kill(self, part: str) -> None:
        """Kill a part on purpose: its end is not reported."""
        child = self._children[part]
        child.killed = True
        child.kill()
        child.wait(STOP_TIMEOUT_S)

    def restart(self, part: str) -> None:
        """Start a killed part again with its first command; a router at its old endpoint."""
        self.start(part, *self._commands[part])

    def __enter__(self) -> Self:
        """Enter a with block; its end ends all processes."""
        self._suspended_before = signal.signal(signal.SIGTSTP, self._suspend)
        return self

    def __exit__(self, *_: object) -> None:
        """End all of them."""
        self.stop()
        signal.signal(signal.SIGTSTP, self._suspended_before)

    def _suspend(self, *_: object) -> None:
        """Ctrl-Z reaches only the launcher: pass it on to all."""
        for child in self._children.values():
            if not child.flies:
                child.signal(signal.SIGSTOP)
        os.kill(os.getpid(), signal.SIGSTOP)  # continues here after SIGCONT
        for child in self._children.values():
            child.signal(signal.SIGCONT)

    def stop(self) -> None:
        """End all of them: SIGTERM first, then SIGKILL. None is left, even if Ctrl-C is pressed meanwhile."""
        with contextlib.suppress(KeyboardInterrupt), uninterrupted():
            first = {part for part, child in self._children.items() if child.flies}
            for group in (first, set(self._children) - first - set(LAST), *({part} for part in LAST)):
                self._end([child for part, child in self._children.items() if part in group])
            for child in self._all:
                child.join()
            self._tell_what_the_recorder_lacks()

    def _tell_what_the_recorder_lacks(self) -> None:
        """Tell what stopped the recording at the mission's end, when nobody reads the inbox any more: a
        full disk, for example.
        """
        with contextlib.suppress(queue.Empty):
            while True:
                item = self._inbox.get(timeout=0.0)
                if isinstance(item, Ended) and item.part == "recorder" and item.status > 0:
                    print(f"warning: the recording stopped: {item.last_words}", file=sys.stderr)

    @staticmethod
    def _end(children: list[Child]) -> None:
        for child in children:
            child.signal(signal.SIGTERM)
            child.signal(signal.SIGCONT)  # a stopped process cannot handle SIGTERM
        deadline = time.monotonic() + STOP_TIMEOUT_S
        for child in children:
            ended = child.wait(max(deadline - time.monotonic(), 0.0))
            if not ended and child.flies:
                ended = _await_end(
                    child, FLYING_STOP_TIMEOUT_S, "send the vehicle home", "its keeper has the vehicle"
                )
            elif not ended and child.part == "recorder":
                ended = _await_end(
                    child,
                    RECORDER_STOP_TIMEOUT_S,
                    "write the end of the record",
                    "the record may lack its end",
                )
            if not ended:
                child.kill()
                child.wait(STOP_TIMEOUT_S)


def _await_end(child: Child, timeout_s: float, what: str, or_else: str) -> bool:
    """Give a part more time to end, and say what for; returns whether it has ended."""
    print(f"waiting for the {child.part} to {what}", file=sys.stderr)
    child.signal(signal.SIGTERM)  # the first one may have come while it started, and been lost
    if child.wait(timeout_s):
        return True
    print(f"warning: the {child.part} hangs and is killed: {or_else}", file=sys.stderr)
    child.tell_stacks()
    return child.wait(STACKS_S)
