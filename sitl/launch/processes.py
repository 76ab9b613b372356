"""The parts of a mission as processes: how each starts, what it prints, and how all end together."""

import contextlib
import math
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple, NoReturn, Self

from link.bus import log
from link.bus.inbox import Inbox
from link.bus.session import SIGNAL_POLL_S
from link.cli import BAD_INPUT, FAILED
from link.early import INTERRUPTED, ask_for_stack
from link.interrupts import LAUNCHER, uninterrupted

ROOT = Path(__file__).parents[2]  # where our packages are
# Time to a part's first message, until people are told and until it counts as hung: on a slow machine it
# may compile for minutes.
START_WARN_S, START_LIMIT_S = 15.0, 300.0
# How long to read on after a part has ended: its own children may hold its stdout and stderr open.
LEFT_OPEN_S = 0.5
# How a line of the stack begins that a part prints when it hangs.
STACK = re.compile(r'(Stack \(most recent call first\):|File ".*", line \d+ in )')
LONGEST_LINE = 4_000  # characters of a line that are kept
STOP_TIMEOUT_S = 1.0  # how long a part may take to end
STACK_S = 0.5  # how long a part that is about to be killed may take to write its stack


@dataclass(frozen=True)
class PartKind:
    """How a part starts and ends, where it differs from others."""

    answers: bool = False  # it prints a first line on stdout for the launcher when it is ready
    spared: str = ""  # what to say when it ends and the mission goes on; empty: the mission fails
    turn: int = 1  # parts end in the order of their turns, those of one turn at a time
    last_task: str = ""  # what may keep it longer than others when it is asked to end
    last_task_s: float = 0.0  # how much longer
    tells_progress: bool = False  # in its last task it says that it goes on: so much longer after each line
    if_killed: str = ""  # what it means if it does not end in time


ROUTER, RECORDER, PAGE = "router", "recorder", "view"
# The parts that differ from others.
KINDS = {
    RECORDER: PartKind(
        answers=True,
        spared="the recording stopped",
        turn=2,  # after the others, so that the record holds their last words
        last_task="write the end of the record",  # at low priority
        last_task_s=20.0,
        tells_progress=True,
        if_killed="the record may lack its end",
    ),
    ROUTER: PartKind(answers=True, turn=3),
    PAGE: PartKind(answers=True, spared="the page ended"),
}
# A part that flies a real vehicle. It is never suspended. It ends once the vehicle stands, comes down, or is
# a pilot's.
FLYING = PartKind(
    turn=0, last_task="leave the vehicle safe", last_task_s=10.0, if_killed="its keeper has the vehicle"
)


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
        super().__init__(text)
        self.status = status


def raise_for(ended: Ended) -> NoReturn:
    """Raise the exception that the end of a part means for the mission."""
    if ended.status == INTERRUPTED:
        raise KeyboardInterrupt  # an interrupted part ends the mission as Ctrl-C does
    if ended.status == BAD_INPUT:
        raise MissionFailed(ended.last_words.rpartition("error: ")[2], BAD_INPUT)
    raise MissionFailed(f"{ended.part} {how_ended(ended)}; its last words: {ended.last_words}")


def how_ended(ended: Ended) -> str:
    """Return how a part has ended, in words."""
    if ended.status < 0:
        return f"was killed by signal {-ended.status}"
    return f"exited with status {ended.status}"


def why_ended(ended: Ended) -> str:
    """Return why a part has ended, in its own words if it has said so; else how."""
    said = ended.last_words.startswith("error: ") and ended.status > 0
    return ended.last_words.removeprefix("error: ") if said else how_ended(ended)


def environment() -> dict[str, str]:
    """Return the environment of a part: it finds our packages, whatever lies in the current folder."""
    found = {**os.environ, LAUNCHER: str(os.getpid()), "PYTHONSAFEPATH": "1"}
    if ROOT.name not in ("site-packages", "dist-packages"):  # in a checkout, which need not be installed
        found["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return found


class Child:
    """One part as a process.

    It leads a process group: its children end with it, and a terminal's Ctrl-C reaches only the launcher.
    """

    def __init__(self, part: str, kind: PartKind, words: tuple[str, ...], inbox: Inbox) -> None:
        """Start `python -m words`. Its output and its end go into the inbox."""
        self.part = part
        self.kind = kind
        self.words = words
        self.killed = False  # on purpose: then its end is not reported
        self.heard_s = -math.inf  # when it printed its last line, by the monotonic clock
        self.answered = False  # whether it has printed the first line for which the launcher waits
        # Its log lines, or its warnings only, are printed at once: nobody reads the inbox any more.
        self.aloud = self.parting = False
        self._inbox = inbox
        self._answer = Inbox()
        self._awaited = kind.answers
        self._lines = inbox.lane(f"lines of the {part}")
        self._last_words = "none"
        self._process = subprocess.Popen(
            [sys.executable, "-m", *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            process_group=0,
            env=environment(),
        )
        self.pid = self._process.pid
        self._thread = threading.Thread(target=self._watch, name=part, daemon=True)
        self._thread.start()

    def readline(self) -> str:
        """Wait for the answer of a part that answers; empty if it ends without one.

        Raises MissionFailed if it hangs.
        """
        began, told = time.monotonic(), False
        while True:
            with contextlib.suppress(queue.Empty):
                return str(self._answer.get(timeout=SIGNAL_POLL_S))
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

    def kill(self) -> None:
        """Kill it and its children."""
        with contextlib.suppress(OSError):  # already gone
            os.killpg(self.pid, signal.SIGKILL)

    def wait(self, timeout_s: float) -> bool:
        """Return whether it ends in time."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout_s)
        return self._process.returncode is not None

    def join(self) -> None:
        """Wait until it has ended and all its output has been passed on."""
        self._thread.join()

    def _watch(self) -> None:
        """Pass on its output and its end. Its children end with it, unless they left the process group."""
        readers = [
            threading.Thread(target=self._read, args=(pipe,), name=f"output of {self.part}", daemon=True)
            for pipe in (self._process.stdout, self._process.stderr)
        ]
        for reader in readers:
            reader.start()
        status = self._process.wait()
        self.kill()
        for reader in readers:
            reader.join(LEFT_OPEN_S)
        if not self.killed:
            self._inbox.put(Ended(self.part, status, self._last_words))
        self._answer.put("")

    def _read(self, pipe: IO[str]) -> None:
        """Pass on the lines of a pipe; a long line is cropped."""
        with pipe:
            while line := pipe.readline(LONGEST_LINE):
                text = line.strip()
                if not line.endswith("\n") and (line := pipe.readline(LONGEST_LINE)).strip():
                    text += " …"
                    while line and not line.endswith("\n"):
                        line = pipe.readline(LONGEST_LINE)
                if text:
                    self._said(text, pipe is self._process.stdout)

    def _said(self, line: str, on_stdout: bool) -> None:
        self.heard_s = time.monotonic()
        if on_stdout and self._awaited:
            self._awaited, self.answered = False, True
            self._answer.put(line)
        elif STACK.match(line):  # at once: it is about to be killed, and then nobody reads the inbox
            print(f"{self.part}: {line}", file=sys.stderr)
        elif on_stdout:
            self._lines(LogLine(self.part, f"{self.part}: {line}", "info"), len(line))
        else:
            level, text = log.parse(line)
            troubled = level in ("warning", "error")
            if troubled or text == line:  # what a log says of its everyday work explains no end
                told = self._last_words.startswith("error: ") and text.startswith("keeper: ")
                self._last_words = self._last_words if told else text  # its keeper goes on once it has failed
            if self.aloud:
                print(f"{self.part}: {text}", file=sys.stderr)
            elif self.parting and troubled:
                print(text, file=sys.stderr)
            self._lines(LogLine(self.part, text, level), len(line))


# ---- all of them ----


def secure_words(secure: Path | None) -> tuple[str, ...]:
    """Return the flag that tells a part where the certificates are."""
    return () if secure is None else ("--secure", str(secure))


class Processes:
    """The child processes; their output and ends go into the inbox."""

    def __init__(self, inbox: Inbox) -> None:
        self._inbox = inbox
        self._children: dict[str, Child] = {}
        self._suspended_before: Any = None

    def start(self, part: str, *words: str, kind: PartKind | None = None) -> Child:
        """Start `python -m words`."""
        with uninterrupted():
            child = Child(part, kind or KINDS.get(part, PartKind()), words, self._inbox)
            self._children[part] = child
        return child

    def start_router(self, listen: str, secure: Path | None = None) -> str:
        """Start a router; returns its endpoint, which a restart uses again.

        Raises MissionFailed if it cannot listen.
        """
        words = ("sitl", "router", *secure_words(secure), "--listen")
        router = self.start(ROUTER, *words, listen)
        endpoint = self.answer(router)
        router.words = *words, endpoint
        return endpoint

    def answer(self, child: Child) -> str:
        """Wait for the answer of a part that answers. If a part ends instead, raises what that means."""
        line = child.readline().strip()
        while not line:
            if isinstance(item := self._inbox.get(), Ended):
                raise_for(item)
        return line

    def has_answered(self, part: str) -> bool:
        """Whether a part that answers has done so; once it has ended, whoever has waited for it."""
        return part in self._children and self._children[part].answered

    def release(self, part: str) -> None:
        """Let a part outlast the others: its end is the caller's business."""
        del self._children[part]

    def tell_stack(self, part: str) -> None:
        """Let a part of ours that hangs print where it is; a stopped one does once it continues."""
        if child := self._children.get(part):
            ask_for_stack(child.pid)

    def kill(self, part: str) -> None:
        """Kill a part on purpose: its end is not reported."""
        child = self._children[part]
        child.killed = True
        child.kill()
        child.join()

    def restart(self, part: str) -> None:
        """Start a killed part again with its first command; a router at its old endpoint."""
        self.start(part, *self._children[part].words)

    def __enter__(self) -> Self:
        self._suspended_before = signal.signal(signal.SIGTSTP, self._suspend)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        signal.signal(signal.SIGTSTP, self._suspended_before)

    def _suspend(self, *_: object) -> None:
        """Ctrl-Z reaches only the launcher: pass it on to all."""
        for child in self._children.values():
            if child.kind is not FLYING:
                child.signal(signal.SIGSTOP)
        os.kill(os.getpid(), signal.SIGSTOP)  # continues here after SIGCONT
        for child in self._children.values():
            child.signal(signal.SIGCONT)

    def stop(self) -> None:
        """End all of them: SIGTERM first, then SIGKILL. None is left, even if Ctrl-C is pressed meanwhile."""
        with contextlib.suppress(KeyboardInterrupt), uninterrupted():
            for turn in sorted({child.kind.turn for child in self._children.values()}):
                _end([child for child in self._children.values() if child.kind.turn == turn])
            for child in self._children.values():
                child.join()
            self._tell_what_the_recorder_lacks()

    def _tell_what_the_recorder_lacks(self) -> None:
        """Tell what stopped the recording, such as a full disk, when nobody reads the inbox any more.

        A recorder that was interrupted before it began lacks nothing.
        """
        with contextlib.suppress(queue.Empty):
            while True:
                item = self._inbox.get(timeout=0.0)
                stopped = isinstance(item, Ended) and item.part == RECORDER and item.status > 0
                if stopped and item.status != INTERRUPTED:
                    print(f"warning: {KINDS[RECORDER].spared}: {item.last_words}", file=sys.stderr)


def _end(children: list[Child]) -> None:
    for child in children:
        child.parting = child.kind is FLYING
        child.signal(signal.SIGTERM)
        child.signal(signal.SIGCONT)  # a stopped process cannot handle SIGTERM
    deadline = time.monotonic() + STOP_TIMEOUT_S
    for child in children:
        in_time = child.wait(max(deadline - time.monotonic(), 0.0))
        if not (in_time or (child.kind.last_task and _await_last_task(child))):
            child.kill()
            child.wait(STOP_TIMEOUT_S)


def _await_last_task(child: Child) -> bool:
    """Give a part more time to end, and say what for; returns whether it has ended."""
    print(f"waiting for the {child.part} to {child.kind.last_task}", file=sys.stderr)
    child.aloud = child.kind.tells_progress
    child.signal(signal.SIGTERM)  # the first one may have come while it started, and been lost
    deadline = time.monotonic() + child.kind.last_task_s
    while (left_s := deadline - time.monotonic()) > 0.0:
        if child.wait(left_s):
            return True
        if child.kind.tells_progress:
            deadline = child.heard_s + child.kind.last_task_s
    print(f"warning: the {child.part} hangs and is killed: {child.kind.if_killed}", file=sys.stderr)
    ask_for_stack(child.pid)
    return child.wait(STACK_S)
