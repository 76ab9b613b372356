"""Space-aware infotaxis: trade the information of the next reading against the distance to the source."""

import numpy as np

from agent.planning.around import distances as distances_of
from agent.planning.moves import Reach
from agent.planning.predict import cloud, imagine, shares_of_cells
from link.bus.messages import Belief, Particles
from plume.elementary import Array
from plume.numerics import exp_each, log_each


def plan(belief: Belief, particles: Particles, moves: Array, reach: Reach, rng: np.random.Generator) -> int:
    """The move with the least expected log₂(D + (2^H − 1)/2) (Loisy and Eloy 2022, eq. 3.4).

    D is the expected Manhattan distance from the move to the source, in cells. H is the entropy of the
    source's cell, in bits: Loisy and Eloy's world is a grid with a cell per step. Where something is in the
    way, D is longer by the way around. Both are taken under the
    belief after a reading there; H is the present entropy less the reading's information gain.
    """
    hypotheses, cell_m = cloud(belief, particles), reach.step
    distances = np.abs(moves[:, :, None] - hypotheses.places).sum(axis=1) / cell_m  # (A, N)
    if reach.area.obstacles:
        detours = distances_of(hypotheses, moves, reach.area) - hypotheses.distances(moves)
        distances = distances + detours / cell_m
    imagined = imagine(
        hypotheses, moves, reach.measurements, rng, distances[:, None], before=reach.foreseen()
    )
    shares = shares_of_cells(hypotheses, cell_m)
    entropy = -np.sum(shares * log_each(shares))
    entropies = np.maximum(entropy - imagined.gains, 0.0)  # (A, K), nats
    return int(np.argmin(cost(imagined.expectations[:, :, 0], entropies).mean(axis=1)))


def cost(distances: Array, entropies: Array) -> Array:
    """ln(D + (2^H − 1)/2) of beliefs with these expected distances, in cells, and entropies in nats."""
    return log_each(distances + (exp_each(entropies) - 1) / 2)
