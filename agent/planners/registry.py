"""Planners by name."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib import import_module
from types import MappingProxyType

import numpy as np

from agent.planning.moves import Reach
from link.bus.messages import Belief, Particles

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
    "lookahead": "agent.planners.lookahead",
    "homing": "agent.planners.homing",
}
"""The module of each planner; it is imported when the planner is asked for."""


def reach(name: str, given: Mapping[str, float] = MappingProxyType({})) -> Reach:
    """What a planner chooses from: what is given of the fields of `Reach`, else its own `REACH`, else what is usual."""
    return replace(getattr(import_module(PLANNERS[name]), "REACH", Reach()), **given)


def planner(name: str) -> Planner:
    """Find a planner by its name."""
    plan: Planner = import_module(PLANNERS[name]).plan
    return plan
