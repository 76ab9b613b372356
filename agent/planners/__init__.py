"""Planners by name: each a pure function from a belief to the next waypoint, one small file each."""

from collections.abc import Callable
from importlib import import_module

import numpy as np

from agent.moves import Reach
from link.messages import Belief, Particles

Planner = Callable[[Belief, Particles, Reach, np.random.Generator], int]
"""(belief, particles, what may be chosen from, keyed randomness) -> which of `reach.moves(belief.position)`."""

PLANNERS = {
    "infotaxis": "agent.planners.infotaxis",
    "entrotaxis": "agent.planners.entrotaxis",
    "dcee": "agent.planners.dcee",
    "random": "agent.planners.random",
    "infotaxis-variance": "agent.planners.infotaxis_variance",
    "entrotaxis-belief": "agent.planners.entrotaxis_belief",
    "thompson": "agent.planners.thompson",
    "space-aware-infotaxis": "agent.planners.space_aware_infotaxis",
    "greedy": "agent.planners.greedy",
}
"""The module of each planner; it is imported when the planner is asked for."""


def planner(name: str) -> Planner:
    """Find a planner by its name."""
    plan: Planner = import_module(PLANNERS[name]).plan
    return plan
