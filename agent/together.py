"""A fleet's next places: each vehicle chooses, given where those before it go and what they may read."""

from collections.abc import Sequence

import msgspec
import numpy as np

from agent.planning.apart import Shared
from agent.planning.moves import Reach
from agent.policies import choose
from link.bus.messages import Belief, Particles
from plume.randomness import derived_seed

Place = tuple[float, float]  # (x, y) m


def choose_all(
    name: str,
    belief: Belief,
    particles: Particles,
    seed: int,
    within: Reach,
    places: Sequence[Place],
    gases: Sequence[float],
    separation_m: float,
) -> list[Place]:
    """Return the next place of each vehicle, in their order, float32 pairs; alone, as `choose` does.

    belief: after the last round's readings, which were taken at `places` and said `gases`. Each vehicle sees
    the belief as if it had taken the last reading. Its draws are keyed by (seed, vehicle, step).
    """
    if len(places) == 1:
        return [choose(name, belief, particles, seed, within)]
    here = np.array(places, np.float64)
    chosen: list[Place] = []
    for vehicle, (place, gas) in enumerate(zip(places, gases, strict=True)):
        ways = np.stack([here[:vehicle], np.array(chosen).reshape(-1, 2)], axis=1)
        reach = Shared.of(within, ways, here[vehicle + 1 :], separation_m)
        seen = msgspec.structs.replace(belief, position=place, gas=gas)
        said = choose(name, seen, particles, seed_of(seed, vehicle + 1), reach)
        chosen.append(reach.freed(place, said))
    return chosen


def seed_of(seed: int, vehicle: int) -> int:
    """Return the seed of a vehicle's own draws: the first one's is that of a vehicle alone."""
    return seed if vehicle == 1 else derived_seed(seed, f"vehicle {vehicle}")
