"""What a mission shows while it flies: one live line on a terminal, now and then a line elsewhere."""

from rich.console import Console
from rich.live import Live
from rich.text import Text

from link.bus.messages import Belief

PLAIN_EVERY_STEPS = 10


class Progress:
    """Shows the newest belief on stderr."""

    def __init__(self, budget: int, starting: str = "router, uav, estimator, agent") -> None:
        """Take the step budget, which is shown beside the step, and what is being started meanwhile."""
        self._budget = budget
        self._ceased = False
        self._console = Console(stderr=True, highlight=False)
        self._live = Live(Text(f"starting {starting}"), console=self._console, refresh_per_second=10, transient=True)

    def __enter__(self) -> "Progress":
        """Begin to show."""
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Clear the live line."""
        if self._console.is_terminal:
            self._live.stop()

    def say(self, text: str) -> None:
        """Print a line that stays."""
        self._console.print(text, markup=False, soft_wrap=True)

    def show(self, belief: Belief, distance_m: float) -> None:
        """Show how far the search is."""
        line = (
            f"step {belief.step:3d}/{self._budget}  at ({belief.position[0]:5.2f}, {belief.position[1]:5.2f}) m  gas {belief.gas:6.2f}  "
            f"estimate ({belief.mean[0]:5.2f}, {belief.mean[1]:5.2f}) ± {belief.spread:5.2f} m  flown {distance_m:5.1f} m"
        )
        if self._console.is_terminal:
            self._live.update(Text(line))
        elif belief.step % PLAIN_EVERY_STEPS == 0 or (belief.ceased and not self._ceased):
            self.say(line)
        self._ceased = belief.ceased
