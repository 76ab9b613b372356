"""The figures of policies over many missions, for Python; `plumeward evaluate` is the same for shells."""

import os
from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Any

from agent.policies import DEFAULT, name_of, policy
from agent.trials.evaluate import FIRST_TEST_SEED, MOST_SCENARIOS, MOST_WORKERS, named
from agent.trials.rollout import check as check_knowledge
from agent.trials.rollout import check_policy
from agent.trials.sweep import Sweep, fly, on_cores, ordered
from estimator.criterion import chosen
from link.cli import PARTICLES
from plume.problem import PAPER, Problem
from plume.problems.fleet import ALONE, Fleet
from plume.problems.names import named as named_problem
from plume.problems.names import with_arguments
from plume.problems.values import whole
from plume.randomness import MAX_SEED


def evaluate(
    policies: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] = DEFAULT,
    scenarios: int = 100,
    *,
    first_seed: int = FIRST_TEST_SEED,
    particles: int = 1000,
    threshold_m: float | None = None,
    budget: int | None = None,
    workers: int = 1,
    problem: Problem | str | os.PathLike[str] = PAPER,
    world: str | Sequence[str] | None = None,
    assume: str = "field",
    stop: str | None = None,
    vehicles: int = ALONE.vehicles,
    formation: str = ALONE.formation,
    separation_m: float = ALONE.separation_m,
    **knowledge: Any,
) -> dict[str, Any]:
    """Fly the same missions with each policy and return the figures of each.

    Args:
        policies: One name of `plumeward.policies()` or path of a bundle, or several of them.
        scenarios: Missions for each policy, of the seeds from `first_seed` on.
        first_seed: Training uses no seed from 1,000,000 on.
        particles: Particles of the filter.
        threshold_m: The search stops when the spread of the belief is below it, m; None: the problem's
            stop, by default 0.5 m.
        budget: Moves after which a mission is given up; None: the problem's.
        workers: Processes that fly. A script that asks for more than one needs `if __name__ ==
            "__main__":`.
        problem: What is searched, as `plumeward.rollout` takes it.
        world: A world, as `plumeward.rollout` takes it, or several of them; None: the problem's.
        assume: What the estimator takes to be known: `field` or `paper`, where all but the position is
            known.
        stop: The stop criterion, instead of `threshold_m`: `"spread:0.5"`, or `"within:1,0.99"` to stop
            when at least 99% of the belief is
            within 1 m of the estimate.
        vehicles: Vehicles that search together, with `formation` and `separation_m` as
            `plumeward.rollout` takes them.
        knowledge: Further fields of `plumeward.Config`, as `plumeward.rollout` takes them.

    Returns:
        A dict with an entry for each policy, as `plumeward evaluate --json` prints it; of several worlds
        each has its own, such as `"homing world=wind-30"`. `ceased`, `located` and `false_stop` are shares
        from 0 to 1, `mtd_m` is the mean distance travelled (m) by all vehicles and `moves` the mean number
        of moves of each, `search_time_s` the processor time of a search (s), `nees_mean` is 2 for an honest
        posterior. `located_interval` and the like are their 95% intervals, `[low, high]`.

    Raises:
        ValueError: A policy or a world is not known, a number is out of range, or the assumption or the
            criterion is not allowed.
        TypeError: There is no such argument, or the sensor or a prior is something else, such as its text.

    Examples:
        >>> figures = plumeward.evaluate(["homing", "greedy"], scenarios=10)
        >>> figures["homing"]["located"], round(figures["homing"]["mtd_m"], 1)
        (1.0, 30.9)
    """
    searched = with_arguments(problem, budget=budget)
    names, worlds = _each(map(name_of, _each(policies))), _each(searched.world if world is None else world)
    if not names or not worlds:
        raise ValueError("wanted one policy and one world at least")
    for name in names:
        check_policy(name)
    for name in worlds:
        named_problem(searched.changed(world=name))
    scenarios, workers = (
        whole("scenarios", scenarios, 1, MOST_SCENARIOS),
        whole("workers", workers, 1, MOST_WORKERS),
    )
    first_seed = whole("first_seed", first_seed, 0, MAX_SEED - scenarios + 1)
    particles = whole("particles", particles, *PARTICLES)
    check_knowledge(assume, knowledge)
    for name in names:
        policy(name)
    sweep = Sweep(
        names,
        range(first_seed, first_seed + scenarios),
        (particles,),
        (chosen(threshold_m, stop, searched.stop),),
        knowledge={**knowledge, "assume": assume},
        worlds=worlds,
        problem=searched,
        fleet=Fleet(vehicles, formation, separation_m).within(searched),
    )
    by_seed = (list(flights) for _, flights in groupby(sweep.flights, key=lambda flight: flight[2]))
    flown = (
        (rows for flights in by_seed for rows in fly(sweep, flights))
        if workers == 1
        else on_cores(workers)(sweep, by_seed)
    )
    return named(ordered((row for rows in flown for row in rows), sweep))


def _each(said: Any) -> list[Any]:
    """Return the names that an argument says, each once: one, or several."""
    return list(dict.fromkeys(said)) if isinstance(said, Iterable) and not isinstance(said, str) else [said]
