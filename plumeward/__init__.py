"""Plumeward: simulate a gas leak, search for it with a drone, and measure how far to trust the search.

Imports: plume, plume.sensors, plume.worlds, plume.problems, link, link.bus, link.record, estimator, sitl,
sitl.script, sitl.launch, agent, agent.trials, agent.learn.

`import plumeward` registers the gymnasium environments `plumeward/SourceSearch-v0` and
`plumeward/SourceSearchContinuous-v0`. It does not load gymnasium, but waits until somebody does. The other
names are loaded when they are first used. The command `plumeward` is in `plumeward.__main__`.

    import plumeward

    outcome, trace = plumeward.rollout(seed=1)
    print(outcome.located, outcome.error_m)

Lengths are in metres, x east and y north of home; times in seconds; angles in radians.
"""

from importlib import import_module

from plumeward.names import check, leave_out_the_current_folder

TYPE_CHECKING = False  # `typing` itself takes longer to load than the rest of this file
if TYPE_CHECKING:
    from agent.learn.env import SourceSearch, SourceSearchVector
    from agent.learn.parallel import SourceSearchParallel
    from agent.policies import policies
    from agent.trials.rollout import rollout
    from estimator.belief import belief
    from estimator.filter import Config, Posterior, assimilate, prior
    from link.bus.mavlink import Reading
    from link.bus.messages import Belief
    from link.record.reader import Recording
    from link.record.reader import read as read_record
    from plume.outcome import Outcome, TracePoint
    from plume.problem import Area, PriorPart, Problem
    from plume.scenario import Scenario
    from plume.worlds.world import World
    from plumeward.evaluation import evaluate
    from plumeward.scenarios import draw

# The module of each name of the API, and its name there if it differs.
WHERE = {
    "rollout": "agent.trials.rollout",
    "evaluate": "plumeward.evaluation",
    "policies": "agent.policies",
    "Problem": "plume.problem",
    "Area": "plume.problem",
    "PriorPart": "plume.problem",
    "Scenario": "plume.scenario",
    "draw": "plumeward.scenarios",
    "World": "plume.worlds.world",
    "Config": "estimator.filter",
    "prior": "estimator.filter",
    "assimilate": "estimator.filter",
    "belief": "estimator.belief",
    "Reading": "link.bus.mavlink",
    "read_record": "link.record.reader:read",
    "SourceSearch": "agent.learn.env",
    "SourceSearchVector": "agent.learn.env",
    "SourceSearchParallel": "agent.learn.parallel",
    "Outcome": "plume.outcome",
    "TracePoint": "plume.outcome",
    "Posterior": "estimator.filter",
    "Belief": "link.bus.messages",
    "Recording": "link.record.reader",
}

__all__ = [
    "Area",
    "Belief",
    "Config",
    "Outcome",
    "Posterior",
    "PriorPart",
    "Problem",
    "Reading",
    "Recording",
    "Scenario",
    "SourceSearch",
    "SourceSearchParallel",
    "SourceSearchVector",
    "TracePoint",
    "World",
    "__version__",
    "assimilate",
    "belief",
    "draw",
    "evaluate",
    "policies",
    "prior",
    "read_record",
    "rollout",
]


def __getattr__(name: str) -> object:
    """Load a name of the API when it is first used."""
    if name not in WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, there = WHERE[name].partition(":")
    return globals().setdefault(name, getattr(import_module(module), there or name))


def __dir__() -> list[str]:
    """List the API."""
    return sorted({*globals(), *__all__})


leave_out_the_current_folder()
check()

from plume import __version__  # noqa: E402  (after the check, which names a user's plume.py)
from plumeward.environments import register  # noqa: E402

register()
