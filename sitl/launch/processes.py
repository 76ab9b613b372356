"""The parts of a mission as child processes: started, and ended together."""

import contextlib
import os
import queue
import signal
import sys
import time
from pathlib import Path
from typing import Any, Self

from link.bus.inbox import Inbox
from link.interrupts import uninterrupted
from sitl.launch.child import Child, Ended, PartKind, raise_for

STOP_TIMEOUT_S = 1.0  # how long a part may take to end
STACKS_S = 0.5  # how long a part that is about to be killed may take to write its stacks
ROUTER, RECORDER, PAGE = "router", "recorder", "view"
# The parts that differ from others.
KINDS = {
    RECORDER: PartKind(
        answers=True,
        spared="the recording stopped",
        turn=2,  # after the others, so that the record holds their last words
        last_task="write the end of the record",  # at low priority
        last_task_s=20.0,
        if_killed="the record may lack its end",
    ),
    ROUTER: PartKind(answers=True, turn=3),
    PAGE: PartKind(answers=True, spared="the page ended"),
}
# A part that flies a real vehicle. It is never suspended.
FLYING = PartKind(
    turn=0, last_task="send the vehicle home", last_task_s=10.0, if_killed="its keeper has the vehicle"
)


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

    def release(self, part: str) -> None:
        """Let a part outlast the others: its end is the caller's business."""
        del self._children[part]

    def tell_stacks(self, part: str) -> None:
        """Let a part of ours that hangs print where its threads are."""
        if child := self._children.get(part):
            child.tell_stacks()

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
        """Tell what stopped the recording at the mission's end, when nobody reads the inbox any more: a
        full disk, for example.
        """
        with contextlib.suppress(queue.Empty):
            while True:
                item = self._inbox.get(timeout=0.0)
                if isinstance(item, Ended) and item.part == RECORDER and item.status > 0:
                    print(f"warning: {KINDS[RECORDER].spared}: {item.last_words}", file=sys.stderr)


def _end(children: list[Child]) -> None:
    for child in children:
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
    child.signal(signal.SIGTERM)  # the first one may have come while it started, and been lost
    if child.wait(child.kind.last_task_s):
        return True
    print(f"warning: the {child.part} hangs and is killed: {child.kind.if_killed}", file=sys.stderr)
    child.tell_stacks()
    return child.wait(STACKS_S)
