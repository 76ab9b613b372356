"""What a script does to processes and links, and what it orders: kills, restarts, cuts, who leaves and joins.

Delays are real time: the speed-up does not apply to processes.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from operator import itemgetter

from sitl.launch.processes import Processes
from sitl.launch.relay import Relay
from sitl.launch.watchdog import Watchdog
from sitl.script.script import Cut, Exclude, Kill, Late


class Disturbances:
    """The kills and cuts of one mission; the watchdog must not take them for hangs."""

    def __init__(
        self,
        events: Iterable[object],
        processes: Processes,
        relays: Mapping[str, Relay],
        watchdog: Watchdog,
        say: Callable[[str], None],
        leave_out: Callable[[int, str], None],
        start: Callable[[int], None],
    ) -> None:
        """Take what does it all.

        leave_out: orders that a vehicle leaves the search, with who says so.  start: starts one that joins.
        """
        # The events that have not happened yet.
        self.to_come = [event for event in events if isinstance(event, Kill | Cut | Exclude | Late)]
        self._processes, self._relays, self._watchdog = processes, relays, watchdog
        self._say, self._leave_out, self._start = say, leave_out, start
        self._mends: list[tuple[float, Kill | Cut]] = []  # by the time of each restart or restored link

    def reached(self, step: int, time_s: float) -> None:
        """Perform the events that are due at a step and a simulation time."""
        for event in [event for event in self.to_come if _due(event, step, time_s)]:
            self.to_come.remove(event)
            if isinstance(event, Exclude):
                self._say(f"script: uav/{event.vehicle} is left out at step {step}")
                self._leave_out(event.vehicle, "left out by the script")
                continue
            if isinstance(event, Late):
                self._say(f"script: uav/{event.vehicle} is started at step {step}")
                self._start(event.vehicle)
                self._watchdog.joins(f"uav/{event.vehicle}", time.monotonic())
                continue
            self._watchdog.disturb(event.part)
            if isinstance(event, Kill):
                self._processes.kill(event.part)
                after_s, done = event.restart_after_s, f"{event.part} killed at step {step}"
            else:
                self._relays[event.part].cut()
                after_s, done = event.for_s, f"link of {event.part} cut at step {step} for {event.for_s:g} s"
            self._mends = sorted([*self._mends, (time.monotonic() + after_s, event)], key=itemgetter(0))
            self._say(f"script: {done}")
        self.mend()

    def mend(self) -> None:
        """Restart processes and restore links that are due."""
        while self._mends and self._mends[0][0] <= time.monotonic():
            _, event = self._mends.pop(0)
            if isinstance(event, Kill):
                self._processes.restart(event.part)
                self._watchdog.begins(event.part, time.monotonic())
                self._say(f"script: {event.part} started again")
            else:
                self._relays[event.part].restore()
                self._say(f"script: link of {event.part} restored")
            self._watchdog.mend(event.part, time.monotonic())

    def wait_s(self) -> float | None:
        """Real time until the next restart or restore; None if there is none."""
        return max(self._mends[0][0] - time.monotonic(), 0.0) if self._mends else None


def _due(event: Kill | Cut | Exclude | Late, step: int, time_s: float) -> bool:
    if event.step is not None:
        return step >= event.step
    return event.time_s is not None and time_s >= event.time_s
