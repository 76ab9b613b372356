"""The world `walls` as its name says it: it is listed without the compiler that flies in it."""

from plume.scenario import Scenario
from plume.walls.buildings import read
from plume.worlds.air import Air
from plume.worlds.puffs import within_limits


def walls(
    scenario: Scenario,
    seed: int,
    *,
    file: str = "",
    share: float = 0.2,
    rate: float = 10.0,
    size: float = 0.1,
) -> Air:
    """Gas in puffs among buildings, around which the wind flows.

    file: of the buildings, or the name of a shipped one; by default there are none. share: of the diffusivity
    that widens a puff; the rest moves it whole. rate: puffs a second. size: standard deviation of a new puff,
    m. Raises ValueError on a number that `puffs` does not take, on a file that is none, and NoRelease.
    """
    given = within_limits(share=share, rate=rate, size=size)
    from plume.walls.walls import Walled  # which loads the compiler

    return Walled(scenario, seed, read(file), **given)
