"""The page of a mission: a part that starts with the others, and stays for a while after the mission."""

import contextlib
import math
import signal
import sys
from collections.abc import Callable, Sequence

from sitl.launch.processes import PAGE, STOP_TIMEOUT_S, Child, MissionFailed, Processes

UNATTENDED_S = 30.0  # how long the page stays at most where nobody can press Ctrl-C


class MissionPage:
    """`plumeward view` beside a mission, if it is wanted. The mission goes on without it."""

    def __init__(self, *, wanted: bool = False, opened: bool = False, attended: bool = False) -> None:
        self._wanted = wanted or opened
        self._opened = opened  # in a browser
        self._attended = attended  # people wait at a terminal
        self._child: Child | None = None
        self._address = ""

    def start(self, processes: Processes, joining: Sequence[str], about_json: str) -> None:
        """Start it; `joining` are the flags that name the router, `about_json` describes the mission."""
        if self._wanted:
            words = ("--port", "0", *["--open"] * self._opened, "--about", about_json)
            self._child = processes.start(PAGE, "sitl", "view", *joining, *words)

    def await_start(self, say: Callable[[str], None]) -> None:
        """Wait until it is served, and say where."""
        if self._child:
            with contextlib.suppress(MissionFailed):  # it hangs: the mission begins without it
                self._address = self._child.readline().strip().removeprefix("page at ")
        if self._address:
            say(f"page at {self._address}")

    def over(self, processes: Processes) -> None:
        """Tell it that the mission is over, and keep it from ending with the other parts.

        A page that was never served ends with them.
        """
        if self._child and self._address:
            processes.release(PAGE)
            self._child.signal(signal.SIGUSR1)

    def linger(self) -> None:
        """Wait until its browsers are closed, or none has come; Ctrl-C ends it."""
        if not self._child or not self._address or self._child.wait(0.0):
            return
        until = "until it is closed" if self._attended else f"for at most {UNATTENDED_S:g} s"
        print(f"page stays open at {self._address} {until}; Ctrl-C ends it", file=sys.stderr, flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            self._child.wait(math.inf if self._attended else UNATTENDED_S)
        self.end()

    def end(self) -> None:
        """End it now."""
        if self._child:
            self._child.signal(signal.SIGTERM)
            if not self._child.wait(2 * STOP_TIMEOUT_S):
                self._child.kill()
            self._child.join()


NO_PAGE = MissionPage()  # it starts nothing
