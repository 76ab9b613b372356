"""Distances as a vehicle can fly them: straight, or around what is in the way."""

import numpy as np

from agent.planning import kernels
from agent.planning.moves import lengths
from agent.planning.predict import Cloud
from plume.elementary import Array
from plume.polygons.obstacles import Obstacles
from plume.problem import Area


def distances(hypotheses: Cloud, places: Array, area: Area) -> Array:
    """Return the lengths of the shortest ways from places (..., 2) m to the particles: (..., N) m."""
    if area.obstacles is None:
        return hypotheses.distances(places)
    return around(places, hypotheses.places, area.obstacles)


def distances_to(goal: Array, places: Array, area: Area) -> Array:
    """Return the lengths of the shortest ways from places (A, 2) m to a goal (2,) m: (A,) m."""
    if area.obstacles is None:
        return lengths(places - goal)
    return around(places, np.asarray(goal)[:, None], area.obstacles)[:, 0]


def around(places: Array, goals: Array, obstacles: Obstacles) -> Array:
    """Return the lengths of the shortest ways from places (..., 2) m to goals (2, N): (..., N) m.

    Ways stay clear of obstacles, but for the last leg to a goal that is not clear, from the nearest place
    that is. Without any way, as to a source inside, it is the straight distance.
    """
    found = kernels.shortest_ways(
        np.ascontiguousarray(places.reshape(-1, 2)),
        np.ascontiguousarray(goals),
        obstacles.sides.reshape(-1, 4),
        obstacles.corners,
        obstacles.between,
        obstacles.clearance_m,
        obstacles.margin_m,
    )
    return np.asarray(found.reshape(*places.shape[:-1], -1))
