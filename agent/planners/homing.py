"""Homing: approach the source and reduce its uncertainty at the same time; our best planner without learning (docs/planners.md)."""

import numpy as np

from agent.planning.moves import Reach
from agent.planning.predict import cloud, entropy_spread, imagine
from link.bus.messages import Belief, Particles

REACH = Reach(headings=8, measurements=100)
PARTICLES = 500
"""Most particles used for planning."""
AHEAD = 2.0
"""Distance of the hypothetical readings, steps: a reading one step ahead hardly changes the belief."""
WEIGHT = 4.0
"""c: metres of flight that a metre of spread is expected to cost."""


def plan(belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator) -> int:
    """The move with the least E‖p − s‖ + c · E[spread after a reading at p], p two steps ahead; the spread is `entropy_spread`.

    The first term is taken over the current belief: by the law of total expectation, a reading does not change it on average.
    """
    moves = reach.moves(belief.position)
    places = np.clip(belief.position + AHEAD * (moves - belief.position), 0.0, reach.area_m)
    hypotheses = cloud(belief, particles).thinned(PARTICLES)
    distances = np.linalg.norm(places[:, :, None] - hypotheses.places, axis=1) @ hypotheses.weights
    gains = imagine(belief, hypotheses, places, reach.measurements, rng).gains
    spreads = entropy_spread(hypotheses, belief.spread) * np.exp(-gains / 2).mean(axis=1)
    return int(np.argmin(distances + WEIGHT * spreads))
