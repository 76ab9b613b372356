"""Homing: approach the source while reducing its uncertainty; the best without learning.

docs/planners.md compares it with the others.
"""

import numpy as np

from agent.planning.around import distances as distances_of
from agent.planning.moves import Reach, lengths
from agent.planning.predict import Cloud, cloud, entropy_spread, imagine
from link.bus.messages import Belief, Particles
from plume.elementary import Array
from plume.numerics import exp_each, log_each

REACH = Reach(headings=8, measurements=100, fits=True)
PARTICLES = 500  # most particles used for planning
AHEAD = 2.0  # steps to the hypothetical readings: one a step ahead hardly changes the belief
WEIGHT = 4.0  # c: metres of flight that a metre of spread is expected to cost
# Metres by which the expected flight must shorten for each metre flown, or the belief's middle is a dead end.
PROGRESS = 0.75


def plan(belief: Belief, particles: Particles, moves: Array, reach: Reach, rng: np.random.Generator) -> int:
    """The move with the least D(p) + c · E[spread after a reading at p], p two steps ahead.

    The spread S is `entropy_spread`; `scores` has D(p). In a fleet the readings that others will have taken
    are expected first, as if they flew on: p is worth what it tells beyond them.
    """
    places = reach.ahead(belief.position, moves, AHEAD)
    hypotheses = reach.once("hypotheses", lambda: cloud(belief, particles).thinned(reach.fewer(PARTICLES)))
    before = reach.foreseen(AHEAD)
    number = reach.fewer(reach.measurements)
    imagined = imagine(hypotheses, places, number, rng, before=before)
    spread = reach.once("spread", lambda: entropy_spread(hypotheses, belief.spread))
    spreads = spread * exp_each(-imagined.gains / 2).mean(axis=1)
    anyway = spread * float(exp_each(-imagined.gains_before / 2).mean()) if len(before) else spread
    flown = lengths(places - belief.position)
    distances = distances_of(hypotheses, np.vstack([belief.position, places]), reach.area)
    here = hypotheses.mean(distances[0])
    return int(np.argmin(scores(hypotheses, distances[1:], here, spread, spreads, flown, anyway)))


def scores(
    hypotheses: Cloud,
    distances: Array,
    here: Array,
    spread: float,
    spreads: Array,
    flown: Array,
    anyway: float | None = None,
) -> Array:
    """D(p) + c · E[spread after a reading at p] of places: (A,).

    distances: (A, N) from each place to each hypothesis.  here: expected distance from the vehicle, as ().
    spread: S now.  spreads: (A,) expected after a reading.  flown: (A,) from the vehicle to the place.
    anyway: spread expected after the readings of other vehicles, `spread` by default.

    D(p) is E‖p − s‖, over the current belief: by the law of total expectation, a reading does not change it
    on average. Distances are those of ways around what is in the way. Where no place lessens the score by
    PROGRESS for each metre flown, D(p) is −S log E exp(−‖p − s‖/S) instead: the distance to the nearest part
    of the belief, and S more for each factor e by which that part is improbable.
    """
    result = hypotheses.mean(distances) + WEIGHT * spreads
    now = here + WEIGHT * (spread if anyway is None else anyway)
    if np.all(result > now - PROGRESS * flown):
        nearest = distances.min(axis=1, where=hypotheses.weights > 0, initial=np.inf)
        # Shares of e^(nearest/S), against underflow.
        shares = hypotheses.mean(exp_each(np.minimum(nearest[:, None] - distances, 0.0) / spread))
        result = nearest - spread * log_each(shares) + WEIGHT * spreads
    return result
