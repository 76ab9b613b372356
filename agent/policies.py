"""Policies by name: planners, the bundles that ship, bundles in files, and what other packages plug in."""

import argparse
import ast
import inspect
import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import MappingProxyType

import numpy as np

from agent.planners import registry
from agent.planning.moves import Reach
from link import cli
from link.bus.messages import Belief, Particles
from plume.problem import PAPER, Problem
from plume.randomness import keyed
from plume.scenario import STEP_M

# (belief, particles, how it may move, keyed randomness) -> the next waypoint (x, y) m.
Policy = Callable[[Belief, Particles, Reach, np.random.Generator], Sequence[float]]

# What each shipped bundle is.
LEARNED = {
    "ppo": "Learned by proximal policy optimisation (PPO): steps in 16 headings.",
    "dqn": "Learned by deep Q-learning (DQN): steps in 16 headings.",
    "ddpg": "Learned by deep deterministic policy gradient (DDPG): a heading and a step of up to 1 m.",
}
# Learned policies that come with the project, made by `make train`.
SHIPPED = {name: Path(__file__).parent / "bundles" / f"{name}.zip" for name in LEARNED}
OURS = (*registry.PLANNERS, *SHIPPED)  # the policies of the project, in the order of its tables
DEFAULT = "homing"  # the best policy that needs no training
PLUGINS = "plumeward.policies"  # entry points of this group are policies of other packages: docs/policies.md

loaded: dict[str, tuple[tuple[object, ...], Policy]] = {}  # by name, with the state of the file then


class PolicyError(ValueError):
    """A policy failed at a decision, or returned something that is not a waypoint; the text is one line."""


def named() -> tuple[str, ...]:
    """Return the names of all policies, each once. The path of a bundle is a policy too."""
    return tuple(dict.fromkeys((*OURS, *(plugin.name for plugin in entry_points(group=PLUGINS)))))


def policies() -> dict[str, str]:
    """Return the policies that can be flown, and one line about each.

    The keys are the names that `rollout`, `evaluate` and the flag `--policy` take: the planners, the
    learned policies that ship, and the policies that installed packages plug in (entry points of the group
    `plumeward.policies`). A bundle in a file is a policy too, by its path.

    Examples:
        >>> "homing" in plumeward.policies()
        True
    """
    planned = {name: _first_line(module) for name, module in registry.PLANNERS.items()}
    plugged = {it.name: _about(it) for it in entry_points(group=PLUGINS) if it.name not in OURS}
    return planned | LEARNED | plugged


def _first_line(module: str) -> str:
    """The first line of a module's docstring. The module is not imported: some compile."""
    source = Path(__file__).parents[1].joinpath(*module.split(".")).with_suffix(".py")
    return (ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or "").partition("\n")[0]


def _about(plugin: EntryPoint) -> str:
    try:
        with redirect_stdout(sys.stderr):  # for what it prints: stdout is the command's
            about = inspect.getdoc(plugin.load()) or ""
    except (Exception, SystemExit) as error:  # it may be anybody's code
        about = f"does not load: {type(error).__name__}: {_short(str(error))}"
    return f"{about.partition(chr(10))[0]} [plug-in {plugin.value}]".lstrip()


def name_of(said: str | os.PathLike[str]) -> str:
    """Return the name of a policy that is given by its name or as a path."""
    return os.fsdecode(said) if isinstance(said, os.PathLike) else said


def check(name: str) -> None:
    """Raise ValueError if no policy has this name, or the file is not a bundle.

    The policy is not loaded, which may take seconds.
    """
    if not isinstance(name, str):
        raise ValueError(f"{name!r:.60} is not allowed; wanted {_wanted()}")
    if name in registry.PLANNERS:
        return
    if path := bundle_path(name):
        from agent.bundle import BundleError, read

        try:
            read(path)
        except BundleError as error:
            raise ValueError(f"{path}: {error}") from error
    elif not entry_points(group=PLUGINS, name=name):
        raise ValueError(cli.not_allowed(name, named(), _wanted()))


def _wanted() -> str:
    return f"{', '.join(named())}, or the path of a bundle, FILE.zip"


def policy(name: str) -> Policy:
    """Return the policy of a name or a file, which is loaded anew if it has changed.

    Raises ValueError with what is wrong and what is allowed.
    """
    state = _state(bundle_path(name))
    if name not in loaded or loaded[name][0] != state:
        loaded[name] = state, _load(name)
    return loaded[name][1]


def _state(path: Path | None) -> tuple[object, ...]:
    """Path, time and size of a file: one that was written anew has others. Empty if there is none."""
    if path is None or not path.is_file():
        return ()
    state = path.stat()
    return path.absolute(), state.st_mtime_ns, state.st_size


def _load(name: str) -> Policy:
    check(name)
    if name in registry.PLANNERS:
        return _planned(name)
    if path := bundle_path(name):
        from agent.bundle import BundleError, load

        try:
            return load(path).waypoint
        except BundleError as error:
            raise ValueError(f"{path}: {error}") from error
    return _plugged_in(name, tuple(entry_points(group=PLUGINS, name=name)))


def bundle_path(name: str) -> Path | None:
    """Return where the bundle of a learned policy is; None for other policies."""
    return SHIPPED.get(name) or (Path(name) if name.endswith(".zip") else None)


def add_policy_argument(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Add the flag that chooses the policy, or with `several` the policies."""
    flown = cli.checked(policy)
    argument = parser.add_argument(
        "--policy",
        type=cli.listed(flown) if several else flown,
        default=[DEFAULT] if several else DEFAULT,
        metavar="NAME,NAME" if several else "NAME",
        help=f"how waypoints are chosen: {', '.join(named())}, or a bundle, FILE.zip (default: {DEFAULT})",
    )
    cli.completed(argument, named, "zip")


def _plugged_in(name: str, plugins: Sequence[EntryPoint]) -> Policy:
    plugin = plugins[0]
    if len(plugins) > 1:
        raise ValueError(
            f"{name} is plugged in more than once, by {' and '.join(each.value for each in plugins)}; wanted "
            "one"
        )
    try:
        with redirect_stdout(sys.stderr):
            found: Policy = plugin.load()
    except (Exception, SystemExit) as error:  # it may be anybody's code
        raise ValueError(
            f"{name} of {plugin.value} does not load: {type(error).__name__}: {_short(str(error))}"
        ) from error
    if not callable(found):
        raise ValueError(
            f"{name} is {plugin.value}, which cannot be called; wanted a function (belief, particles, reach, "
            "rng) -> (x, y)"
        )
    return found


def _planned(name: str) -> Policy:
    plan = registry.planner(name)

    def waypoint(
        belief: Belief, particles: Particles, reach: Reach, rng: np.random.Generator
    ) -> Sequence[float]:
        fitted = reach.fitted(belief)
        moves = fitted.moves(belief.position)
        return tuple(moves[plan(belief, particles, moves, fitted, rng)])

    return waypoint


def reach(name: str, given: Mapping[str, float] = MappingProxyType({}), problem: Problem = PAPER) -> Reach:
    """Return what a policy may choose from: the planner's own `Reach`, with the problem's area and step.

    The given fields come first. Raises ValueError.
    """
    step = {} if problem.step_m == STEP_M else {"step": problem.step_m}
    if name in registry.PLANNERS:
        return registry.reach(name, {**step, **given}, problem.ground)
    if bundle_path(name):
        trained = _trained_for(name)
        if wrong := ", ".join(f"--{flag}" for flag in given if trained or flag != "step"):
            raise ValueError(f"{wrong} is for planners; {name} moves as it was trained to")
        if trained and (refusal := _unlike(problem, trained)):
            raise ValueError(f"--problem: {refusal}")
    return Reach(**{**step, **given}, area=problem.ground)  # type: ignore[arg-type]


def _trained_for(name: str) -> Problem | None:
    """Return the problem that a learned policy flies; None if it flies any. Raises ValueError."""
    path = bundle_path(name)
    if path is None or path in SHIPPED.values():
        return PAPER
    from agent.bundle import BundleError, flies_anywhere, read, trained_for

    try:
        page, _ = read(path)
        return None if flies_anywhere(page) else trained_for(page)
    except BundleError as error:
        raise ValueError(f"{path}: {error}") from error


def _unlike(problem: Problem, trained: Problem) -> str:
    """Return why a learned policy refuses a problem; empty if it was trained for such a one."""
    if problem.area != trained.area:
        said = f"the area {problem.area.text}"
    elif problem.step_m != trained.step_m:
        said = f"a step of {problem.step_m:g} m"
    elif problem.expected != trained.expected:
        said = f"the prior {problem.expected.text}"
    else:
        return ""
    return (
        f"{said} is not allowed with a learned policy; it was trained in the area {trained.area.text}, in "
        f"steps of {trained.step_m:g} m, with the source expected in {trained.expected.text}"
    )


def choose(name: str, belief: Belief, particles: Particles, seed: int, within: Reach) -> tuple[float, float]:
    """Return the next waypoint (x, y) m, a float32 pair: a function of the belief and the seed alone.

    The policy is the one that `policy` returned last: a file written in flight changes no mission.

    Raises PolicyError where the policy fails, or returns something that is not a waypoint.
    """
    decide = loaded[name][1] if name in loaded else policy(name)
    # One order of numbers in memory, on the bus and off it: sums depend on it.
    seen = np.asfortranarray(particles).view()
    seen.flags.writeable = False
    try:
        said: object = decide(belief, seen, within, keyed(seed, name, belief.step))
    except (Exception, SystemExit) as error:  # it may be anybody's code
        where = traceback.extract_tb(error.__traceback__)[-1]
        failure = PolicyError(
            f"policy {name} failed: {type(error).__name__}: {_short(str(error))} "
            f"({Path(where.filename).name}, line {where.lineno})"
        )
        failure.add_note("".join(traceback.format_exception(error)).rstrip())
        raise failure from error
    try:
        place = np.asarray(said, np.float64)
    except (TypeError, ValueError):
        place = np.empty(0)
    except OverflowError as error:  # an integer so long that Python may not even write it
        place, said = np.empty(0), error
    if place.shape != (2,) or not np.isfinite(place).all():
        raise PolicyError(f"policy {name} said {_short(repr(said))}; wanted a waypoint (x, y) in metres")
    x, y = within.wire.clipped(place).astype(np.float32).tolist()
    return within.freed(belief.position, (x, y)) if within.area.obstacles else (x, y)


def _short(text: str) -> str:
    return " ".join(text.split())[:200]
