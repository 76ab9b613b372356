"""Homing: close in on the source and on what is still possible at once; ours, the best without learning (docs/planners.md)."""

import numpy as np

from agent.planning.moves import Reach
from agent.planning.predict import cloud, entropy_spread, imagine
from link.bus.messages import Belief, Particles

REACH = Reach(headings=8, measurements=100)
PARTICLES = 500
"""Of the belief, to plan with."""
AHEAD = 2.0
"""Readings are imagined so many steps ahead: one step further the belief is hardly another."""
WEIGHT = 4.0
"""Metres to fly that a metre of spread is expected to cost."""


def plan(belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator) -> int:
    """The move with the least E‖p − s‖ + c · E[spread after a reading at p], p two steps ahead; the spread is that of entropy.

    No reading changes how far off the source is expected to be: the first term is the belief's own.
    """
    moves = reach.moves(belief.position)
    places = np.clip(belief.position + AHEAD * (moves - belief.position), 0.0, reach.area_m)
    hypotheses = cloud(belief, particles).thinned(PARTICLES)
    distances = np.linalg.norm(places[:, :, None] - hypotheses.places, axis=1) @ hypotheses.weights
    gains = imagine(belief, hypotheses, places, reach.measurements, rng).gains
    spreads = entropy_spread(hypotheses, belief.spread) * np.exp(-gains / 2).mean(axis=1)
    return int(np.argmin(distances + WEIGHT * spreads))
