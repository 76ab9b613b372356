"""A fleet's next places: each vehicle chooses, given where those before it go and what they may read."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from agent.planning.apart import Shared
from agent.planning.moves import Reach
from agent.policies import choose
from link.bus.messages import Belief, Particles
from plume.problems.fleet import Place
from plume.randomness import seed_of


def choose_all(
    name: str,
    belief: Belief,
    particles: Particles,
    seed: int,
    within: Reach,
    places: Sequence[Place],
    gases: Sequence[float],
    separation_m: float,
    numbers: Sequence[int] | None = None,
) -> list[Place]:
    """Return the next place of each vehicle, in their order, float32 pairs; alone, as `choose` does.

    belief: after the last round's readings, which were taken at `places` and said `gases`. The draws of a
    policy are keyed by (seed, vehicle, step).  numbers: those of the vehicles, by default 1, 2 and so on;
    some may have left.
    """
    numbers = range(1, len(places) + 1) if numbers is None else numbers
    left_at = [place for each in belief.left_at or () for place in (each.first, each.last)]
    if len(places) == 1 and not left_at:
        return [choose(name, belief, particles, seed_of(seed, numbers[0]), within)]

    def decide(vehicle: int, reach: Shared) -> Place:
        seen = seen_by(belief, places[vehicle], gases[vehicle], numbers[vehicle])
        return choose(name, seen, particles, seed_of(seed, numbers[vehicle]), reach)

    stands = [each.place for each in belief.stands or ()]
    return in_turn(within, places, separation_m, decide, left_at, stands)


def in_turn(
    within: Reach,
    places: Sequence[Place],
    separation_m: float,
    decide: Callable[[int, Shared], Place],
    left_at: Sequence[Place] = (),
    stands: Sequence[Place] = (),
) -> list[Place]:
    """Let each vehicle decide on its next place, one after the other; returns where they may go.

    decide: of a vehicle, from 0, and its moves. A way that is too near to another's is turned aside, or the
    vehicle stays where it is.  left_at: near which places those may be that have left.  stands: where each
    comes back to, from which the others keep the separation, too; empty if that is not known.
    """
    here = np.array(places, np.float64)
    hovering, homes = (np.array(there, np.float64).reshape(-1, 2) for there in (left_at, stands))
    chosen: list[Place] = []
    common: dict[str, Any] = {}
    for vehicle, place in enumerate(places):
        ways = np.stack([here[:vehicle], np.array(chosen, np.float64).reshape(-1, 2)], axis=1)
        of_others = np.delete(homes, vehicle, axis=0) if len(homes) else homes
        reach = Shared.of(within, ways, here[vehicle + 1 :], separation_m, hovering, of_others, common)
        if len(hovering) and reach.moves(place).tolist() == [[*place]]:
            reach = replace(reach, away=0.0)  # it is hemmed in, and leaves as well as it can
        chosen.append(reach.freed(place, decide(vehicle, reach)))
    return chosen


def seen_by(belief: Belief, place: Place, gas: float, number: int) -> Belief:
    """Return a round's belief as the vehicle of this number sees it, which read this there."""
    back = (belief.backs or {}).get(number, msgspec.UNSET)
    return msgspec.structs.replace(belief, position=place, gas=gas, back=back)
