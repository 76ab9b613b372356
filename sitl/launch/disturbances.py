"""What a script does to processes and links: kills, restarts, cuts. Delays are real time: the speed-up
does not apply to processes.
"""

import functools
import heapq
import itertools
import time
from collections.abc import Callable, Mapping, Sequence

from sitl.launch.processes import Processes
from sitl.launch.relay import Relay
from sitl.launch.watchdog import Watchdog
from sitl.script.events import Cut, Kill


class Disturbances:
    """The kills and cuts of one mission."""

    def __init__(
        self,
        events: Sequence[Kill | Cut],
        processes: Processes,
        relays: Mapping[str, Relay],
        watchdog: Watchdog,
        say: Callable[[str], None],
    ) -> None:
        """Take what can be disturbed, the watchdog that must not take it for a hang, and how to tell
        people.
        """
        self._to_come = list(events)
        self._processes = processes
        self._relays = relays
        self._watchdog = watchdog
        self._say = say
        self._order = itertools.count()
        self._mends: list[tuple[float, int, Callable[[], None], str]] = []

    def reached(self, step: int, time_s: float) -> None:
        """Perform the events that are due at a step and a simulation time."""
        for event in [event for event in self._to_come if _due(event, step, time_s)]:
            self._to_come.remove(event)
            match event:
                case Kill(part=part, restart_after_s=delay_s):
                    self._watchdog.disturb(part)
                    self._processes.kill(part)
                    self._mend_after(delay_s, functools.partial(self._restart, part), f"{part} started again")
                    self._say(f"script: {part} killed at step {step}")
                case Cut(part=part, for_s=delay_s):
                    self._watchdog.disturb(part)
                    self._relays[part].cut()
                    restored = f"link of {part} restored"
                    self._mend_after(delay_s, functools.partial(self._restore, part), restored)
                    self._say(f"script: link of {part} cut at step {step} for {delay_s:g} s")
        self.mend()

    def mend(self) -> None:
        """Restart processes and restore links that are due."""
        while self._mends and self._mends[0][0] <= time.monotonic():
            _, _, mend, text = heapq.heappop(self._mends)
            mend()
            self._say(f"script: {text}")

    def wait_s(self) -> float | None:
        """Real time until the next restart or restore; None if there is none."""
        return max(self._mends[0][0] - time.monotonic(), 0.0) if self._mends else None

    def _restart(self, part: str) -> None:
        self._processes.restart(part)
        self._watchdog.mend(part, time.monotonic())
        self._watchdog.begins(part, time.monotonic())

    def _restore(self, part: str) -> None:
        self._relays[part].restore()
        self._watchdog.mend(part, time.monotonic())

    def _mend_after(self, delay_s: float, mend: Callable[[], None], text: str) -> None:
        heapq.heappush(self._mends, (time.monotonic() + delay_s, next(self._order), mend, text))


def _due(event: Kill | Cut, step: int, time_s: float) -> bool:
    return (
        step >= event.step if event.step is not None else event.time_s is not None and time_s >= event.time_s
    )
