"""Planners by name."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib import import_module
from types import MappingProxyType

import numpy as np

from agent.planning.moves import Reach
from link.bus.messages import Belief, Particles
from plume.elementary import Array
from plume.problem import AREA, Area

# (belief, particles, moves (A, 2) m, their reach, keyed random generator) -> index into the moves.
Planner = Callable[[Belief, Particles, Array, Reach, np.random.Generator], int]

# Module of each planner by name; it is imported on first use.
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
    "lookahead": "agent.planners.lookahead",
    "homing": "agent.planners.homing",
}


def reach(name: str, given: Mapping[str, float] = MappingProxyType({}), area: Area = AREA) -> Reach:
    """Return a planner's reach: the `given` fields, and the planner's own `REACH` or the defaults else."""
    return replace(getattr(import_module(PLANNERS[name]), "REACH", Reach()), area=area, **given)


def planner(name: str) -> Planner:
    """Return the `plan` function of a planner. Raises KeyError if the name is unknown."""
    plan: Planner = import_module(PLANNERS[name]).plan
    return plan
