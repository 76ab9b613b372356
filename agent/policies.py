"""Policies by name: planners, the bundles that ship, bundles in files, and what other packages plug in."""

import argparse
import traceback
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import MappingProxyType

import numpy as np

from agent.planners import registry as planners
from agent.planners.registry import PLANNERS
from agent.planning.moves import Reach
from link.bus.messages import Belief, Particles
from plume.randomness import keyed
from plume.scenario import AREA_M

Policy = Callable[[Belief, Particles, Reach, np.random.Generator], Sequence[float]]
"""(belief, particles, how it may move, keyed randomness) -> the next waypoint (x, y) m."""

SHIPPED = {name: Path(__file__).parent / "bundles" / f"{name}.zip" for name in ("ppo", "dqn", "ddpg")}
"""Learned policies that come with the project; `make train` makes them anew."""
OURS = (*PLANNERS, *SHIPPED)
"""The policies of the project, in the order of its tables."""
PLUGINS = "plumeward.policies"
"""Entry points of this group are policies of other packages: docs/policies.md."""


class PolicyError(ValueError):
    """A policy failed at a decision, or said what is no place, in one line."""


def named() -> tuple[str, ...]:
    """Return all the names; a path to a bundle is good too."""
    return (*OURS, *(plugin.name for plugin in entry_points(group=PLUGINS)))


@cache
def policy(name: str) -> Policy:
    """Find a policy by its name or its file. Raises ValueError with what is wrong and what is allowed."""
    if name in PLANNERS:
        return _planned(name)
    if path := bundle_path(name):
        from agent.bundle import BundleError, load  # what a learned policy sees with takes time to load

        try:
            return load(path).waypoint
        except BundleError as error:
            raise ValueError(f"{path}: {error}") from error
    if plugins := tuple(entry_points(group=PLUGINS, name=name)):
        return _plugged_in(name, plugins)
    raise ValueError(f"{name!r} is not allowed; wanted {', '.join(named())}, or the path of a bundle, FILE.zip")


def bundle_path(name: str) -> Path | None:
    """Where the bundle of a policy is; None where it is not a learned one."""
    return SHIPPED.get(name) or (Path(name) if name.endswith(".zip") else None)


def policy_argument(text: str) -> str:
    """Argument type: a policy that can be flown, by its name or its file."""
    try:
        policy(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def _plugged_in(name: str, plugins: Sequence[EntryPoint]) -> Policy:
    plugin = plugins[0]
    if len(plugins) > 1:
        raise ValueError(f"{name} is plugged in more than once, by {' and '.join(each.value for each in plugins)}; wanted one")
    try:
        found: Policy = plugin.load()
    except Exception as error:  # it may be anybody's code
        raise ValueError(f"{name} of {plugin.value} does not load: {type(error).__name__}: {_short(str(error))}") from error
    if not callable(found):
        raise ValueError(f"{name} is {plugin.value}, which cannot be called; wanted a function (belief, particles, reach, rng) -> (x, y)")
    return found


def _planned(name: str) -> Policy:
    plan = planners.planner(name)

    def waypoint(belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator) -> Sequence[float]:
        chosen: Sequence[float] = reach.moves(belief.position)[plan(belief, particles, reach, rng)].tolist()
        return chosen

    return waypoint


def reach(name: str, given: Mapping[str, float] = MappingProxyType({}), area_m: float = AREA_M) -> Reach:
    """What a policy may choose from: a planner's own, but for the area and what is given of the fields of `Reach`. Raises ValueError."""
    if name in PLANNERS:
        return planners.reach(name, {**given, "area_m": area_m})
    if bundle_path(name):
        if given:
            flags = ", ".join(f"--{flag}" for flag in given)
            raise ValueError(f"{flags} is for planners; {name} moves as it was trained to")
        if area_m != AREA_M:
            raise ValueError(
                f"--area: {area_m:g} is not allowed with {name}; learned policies see the area that they were trained in, {AREA_M:g} m"
            )
    return Reach(**given, area_m=area_m)  # type: ignore[arg-type]


def choose(name: str, belief: Belief, particles: Particles, seed: int, within: Reach) -> tuple[float, float]:
    """Return the next waypoint (x, y) m in the area, a float32 pair: a function of the belief and the seed alone.

    Raises PolicyError where a policy fails, or says what is no place.
    """
    decide = policy(name)
    seen = np.asfortranarray(particles).view()  # one order of numbers in memory, on the bus and off it: sums depend on it
    seen.flags.writeable = False
    try:
        said = decide(belief, seen, within, keyed(seed, name, belief.step))
    except Exception as error:  # it may be anybody's code
        where = traceback.extract_tb(error.__traceback__)[-1]
        raise PolicyError(
            f"policy {name} failed: {type(error).__name__}: {_short(str(error))} ({Path(where.filename).name}, line {where.lineno})"
        ) from error
    try:
        place = np.asarray(said, np.float64)
    except (TypeError, ValueError):
        place = np.empty(0)
    if place.shape != (2,) or not np.isfinite(place).all():
        raise PolicyError(f"policy {name} said {_short(repr(said))}; wanted a waypoint (x, y) in metres")
    x, y = np.clip(place, 0.0, within.edge).astype(np.float32).tolist()
    return x, y


def _short(text: str) -> str:
    return " ".join(text.split())[:200]
