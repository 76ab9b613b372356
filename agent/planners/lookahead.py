"""Lookahead: homing with several hypothetical readings, one after the other along each heading."""

import numpy as np

from agent.planning.around import distances as distances_of
from agent.planning.moves import Reach, lengths
from agent.planning.predict import cloud, entropy_spread, imagine_along
from link.bus.messages import Belief, Particles
from plume.elementary import Array
from plume.numerics import exp_each

REACH = Reach(headings=8, measurements=50, fits=True)
PARTICLES = 500  # most particles used for planning
AHEAD = (2.0, 4.0)  # steps to the hypothetical readings; not every step: neighbours are nearly redundant
WEIGHT = 4.0  # c: metres of flight that a metre of spread is expected to cost


def plan(belief: Belief, particles: Particles, moves: Array, reach: Reach, rng: np.random.Generator) -> int:
    """The first move of the path with the least (metres flown to p) + E‖p − s‖ + c · E[spread].

    p is the best place on the path. The spread is `entropy_spread` after readings at all places up to p.
    """
    paths = reach.ahead(belief.position, moves, np.array(AHEAD))  # (A, L, 2)
    flown = lengths(paths - belief.position)  # (A, L)
    hypotheses = reach.once("hypotheses", lambda: cloud(belief, particles).thinned(PARTICLES))
    distances = hypotheses.mean(distances_of(hypotheses, paths, reach.area))  # (A, L)
    before = reach.foreseen(AHEAD[0])
    gains = imagine_along(hypotheses, paths, reach.measurements, rng, before=before).gains
    spread = reach.once("spread", lambda: entropy_spread(hypotheses, belief.spread))
    spreads = spread * exp_each(-gains / 2).mean(axis=2)
    return int(np.argmin(scores(flown, distances, spreads)))


def scores(flown: Array, distances: Array, spreads: Array) -> Array:
    """(A,): the least over a path's places of metres flown + E‖p − s‖ + c · E[spread]; all are (A, L)."""
    return np.asarray((flown + distances + WEIGHT * spreads).min(axis=1))
