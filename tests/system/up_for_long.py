"""`python -m tests.system.up_for_long uav …`: a simulated vehicle that has been up for 49.7 days less 20
s, at speed-up 0.
"""

from aircraft.search import command
from aircraft.search.clock import Clock
from link import cli
from sitl.__main__ import main

BEGAN_S = 4_294_947.296
"""20 s before time_boot_ms wraps."""


class LateClock(Clock):
    """A clock that begins late."""

    def now_s(self) -> float:
        return BEGAN_S + super().now_s()

    def jump(self, moving: bool, next_event_s: float | None) -> None:
        super().jump(moving, None if next_event_s is None else next_event_s - BEGAN_S)

    def wait_s(self, next_event_s: float | None, next_stream_s: float) -> float:
        return super().wait_s(None if next_event_s is None else next_event_s - BEGAN_S, next_stream_s)


if __name__ == "__main__":
    command.Clock = LateClock  # type: ignore[misc]
    cli.run(main)
