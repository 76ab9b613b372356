"""What a mission shows while it flies: one live line on a terminal, a line now and then elsewhere."""

import math
import time

from rich.console import Console
from rich.live import Live
from rich.text import Text

from link.bus.messages import Belief, by_number
from link.terminal import broken

PLAIN_EVERY_STEPS = 10
PLAIN_FIELDS = 4  # fields of a line that is not on a terminal: 60 characters
SAY_AFTER_S = 2.0  # how long a wait lasts before it gets a line of its own where there is no live line


class Progress:
    """Shows on stderr what a mission waits for, then its newest belief."""

    def __init__(self, budget: int, starting: str = "router, uav, estimator, agent") -> None:
        self._budget = budget
        self._ceased = False
        self._reason = ""
        self._say_at = math.inf
        self._console = Console(stderr=True, highlight=False)
        self._live = Live(
            _line(f"starting {starting}"), console=self._console, refresh_per_second=10, transient=True
        )

    def __enter__(self) -> "Progress":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def say(self, text: str) -> None:
        """Print a line that stays; on a terminal it is broken at words."""
        width = self._console.width if self._console.is_terminal else None
        self._console.print(broken(text, width), markup=False, soft_wrap=True)

    def wait(self, reason: str) -> None:
        """Show what is waited for.

        Called again and again: without a live line it is printed once, if it lasts.
        """
        if reason != self._reason:
            self._reason, self._say_at = reason, time.monotonic() + SAY_AFTER_S
            self._live.update(_line(reason))
        if not self._console.is_terminal and time.monotonic() >= self._say_at:
            self._say_at = math.inf
            self.say(reason)

    def show(self, belief: Belief, distance_m: float) -> None:
        """Show how far the search is."""
        (mean_x, mean_y), seen = belief.mean, by_number(belief).values()
        step = f"step {belief.step:3d}/{self._budget}"
        at = "at " + " ".join("({:5.2f}, {:5.2f})".format(*each.position) for each in seen)
        gas = "gas " + " ".join(f"{each.gas:z6.2f}" for each in seen)
        spread, flown = f"spread {belief.spread:5.2f} m", f"flown {distance_m:5.1f} m"
        estimate = f"estimate ({mean_x:5.2f}, {mean_y:5.2f})"
        fields = [step, at, gas, spread, flown, estimate]
        if len(seen) > 1:  # where they are is long
            fields = [step, spread, flown, at, gas, estimate]
        if self._console.is_terminal:
            self._live.update(_line(fitting(fields, self._console.width)))
        elif belief.step % PLAIN_EVERY_STEPS == 0 or (belief.ceased and not self._ceased):
            self.say("  ".join(fields[:PLAIN_FIELDS]))
        self._ceased = belief.ceased


def fitting(fields: list[str], width: int) -> str:
    """Join as many fields as fit in the width, at least the first."""
    while len(fields) > 1 and len("  ".join(fields)) > width:
        fields = fields[:-1]
    return "  ".join(fields)


def _line(text: str) -> Text:
    return Text(text, no_wrap=True, overflow="crop")


def pace(speedup: float) -> str:
    """Return the speed-up for people."""
    return {0.0: "as fast as possible", 1.0: "real time"}.get(speedup, f"{speedup:g} times real time")
