"""A mission flown in-process, without the network, with bit-identical results."""

import os
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from agent import policies
from agent.planning.moves import Reach
from agent.policies import DEFAULT, reach
from agent.together import choose_all
from agent.trials.rounds import Rounds
from estimator.criterion import chosen
from estimator.filter import Config, Posterior
from link.bus.mavlink import Reading
from link.bus.messages import Belief, Particles
from link.cli import HEADINGS, MOST_MEASUREMENTS, PARTICLES
from plume.geodesy import HOME
from plume.outcome import LastWord, Outcome, TracePoint, outcome, rate_interval
from plume.problem import PAPER, Problem
from plume.problems.fleet import ALONE, Fleet
from plume.problems.names import sensor_of, with_arguments
from plume.problems.values import number, short, whole
from plume.randomness import MAX_SEED, derived_seed
from plume.scenario import Scenario, draw
from plume.worlds.world import World

OWN_MOVES: Mapping[str, float] = MappingProxyType({})  # the planner's own moves
NOBODY: Mapping[int, int] = MappingProxyType({})  # leaves the search
NOBODY_LATE: Mapping[int, tuple[int, int]] = MappingProxyType({})  # joins it
# Fields of `Config` that may be given for a mission; the others have arguments of their own, or come from the
# scenario.
FURTHER = ("margin_m", "priors", "sensor", "stop_on_location", "stop_limits")


class Step(NamedTuple):
    """One round of a mission, a reading of each vehicle, and the belief after it."""

    belief: Belief
    particles: Particles
    posterior: Posterior  # what both were made from
    readings: Sequence[Reading]  # of this round: one of each vehicle
    update_s: float  # processor time of the estimator for this round: others on the machine do not count
    decision_s: float  # processor time of the agent for the move to here; 0 at the start


class Mission(NamedTuple):
    """A mission ready to fly."""

    scenario: Scenario  # the truth, for judging only
    config: Config  # what the estimator knows
    # Computed when asked for, until the search ceases, if it ends there, or the budget is spent.
    steps: Iterator[Step]


def mission(
    seed: int,
    policy: str,
    particles: int,
    threshold_m: float,
    budget: int | None = None,
    moves: Mapping[str, float] = OWN_MOVES,
    world: str | None = None,
    ends: bool = True,
    problem: Problem = PAPER,
    fleet: Fleet = ALONE,
    leaving: Mapping[int, int] = NOBODY,
    forgotten: Collection[int] = (),
    joining: Mapping[int, tuple[int, int]] = NOBODY_LATE,
    **knowledge: Any,
) -> Mission:
    """Prepare the mission of a seed with a policy, by default with the paper's assumption.

    `moves`: fields of `Reach`. `ends`: whether the stop ends it. `budget` and `world`: the problem's if None.
    `fleet`: the vehicles that fly it together; `leaving`: the first round without a vehicle, by its number;
    `forgotten`: those of them whose readings do not count from then on; `joining`: of each that comes late,
    the first round after which the others keep clear of its place, and the first that it takes part in.
    `knowledge`: other fields of `Config`, like the sensor.
    """
    problem = with_arguments(problem, budget=budget, world=world)
    there, config = prepared(seed, problem, particles, threshold_m, **knowledge)
    within = reach(policy, moves, problem)
    agent_seed = derived_seed(seed, "agent")
    steps = _steps(there, config, policy, agent_seed, within, ends, fleet, leaving, forgotten, joining)
    return Mission(there.truth, config, steps)


def prepared(
    seed: int, problem: Problem, particles: int, threshold_m: float, **knowledge: Any
) -> tuple[World, Config]:
    """Return the world of a seed's mission, and what the estimator knows of it.

    `knowledge`: other fields of `Config`, like the sensor.
    """
    told = draw(seed, problem)
    config = Config(
        particles,
        threshold_m,
        derived_seed(seed, "estimator"),
        told.q,
        told.d,
        told.tau,
        problem.ground,
        expected=problem.support,
        **{"sensor": sensor_of(problem), **knowledge},
    )
    return World(told, seed, config.sensor, problem.world, problem), config


def check_policy(name: str, moves: Mapping[str, float] = OWN_MOVES, problem: Problem = PAPER) -> None:
    """Refuse a policy that is not known, and moves that it cannot choose from. Raises ValueError."""
    try:
        policies.check(name)
    except ValueError as error:
        raise ValueError(f"policy: {error}") from None
    if not isinstance(moves, Mapping) or not moves.keys() <= MOVES.keys():
        raise ValueError(f"moves {short(moves)} are not allowed; wanted a dict of {', '.join(MOVES)}")
    for flag, value in moves.items():
        MOVES[flag](f"moves: {flag}", value, problem)


def _check_headings(name: str, value: Any, _: Problem) -> None:
    if isinstance(value, float) or value not in HEADINGS:
        raise ValueError(f"{name} {short(value)} is not allowed; wanted {' or '.join(map(str, HEADINGS))}")


MOVES: Mapping[str, Callable[[str, Any, Problem], object]] = {
    "headings": _check_headings,
    "step": lambda name, value, problem: number(name, value, 0, problem.longest_step_m, above=True),
    "measurements": lambda name, value, _: whole(name, value, 1, MOST_MEASUREMENTS),
}


def check(assume: str, knowledge: Mapping[str, Any]) -> None:
    """Refuse further fields of `Config` that a mission cannot take.

    Raises TypeError, or ValueError if they are inconsistent.
    """
    for name, value in knowledge.items():
        if name not in FURTHER:
            raise TypeError(
                f"argument {name}={value!r} is not allowed; wanted further knowledge of {', '.join(FURTHER)}"
            )
    Config(assume=assume, **knowledge)


def _steps(
    world: World,
    config: Config,
    policy: str,
    agent_seed: int,
    within: Reach,
    ends: bool,
    fleet: Fleet,
    leaving: Mapping[int, int],
    forgotten: Collection[int],
    joining: Mapping[int, tuple[int, int]],
) -> Iterator[Step]:
    starts = fleet.starts(world.start, world.seed, config.area)
    rounds = Rounds(world, config, starts, leaving, forgotten, joining)
    positions, decision_s = rounds.places, 0.0
    for step in range(world.problem.budget + 1):
        flown = rounds.fly(positions)
        said = flown.belief
        yield Step(said, flown.particles, flown.posterior, flown.readings, flown.update_s, decision_s)
        if (ends and said.ceased) or step == world.problem.budget:
            return
        began = time.process_time()
        gases = [reading.gas for reading in flown.readings]
        positions = choose_all(
            policy,
            said,
            flown.particles,
            agent_seed,
            within,
            rounds.places,
            gases,
            fleet.separation_m,
            rounds.numbers,
        )
        decision_s = time.process_time() - began


def rollout(
    seed: int,
    policy: str | os.PathLike[str] = DEFAULT,
    particles: int = 1000,
    threshold_m: float | None = None,
    budget: int | None = None,
    moves: Mapping[str, float] = OWN_MOVES,
    *,
    problem: Problem | str | os.PathLike[str] = PAPER,
    world: str | None = None,
    assume: str = "field",
    stop: str | None = None,
    vehicles: int = 1,
    formation: str = ALONE.formation,
    separation_m: float = ALONE.separation_m,
    **knowledge: Any,
) -> tuple[Outcome, list[TracePoint]]:
    """Fly one mission in this process, without a network. The same mission over Zenoh gives the same bits.

    Args:
        seed: Draws the scenario and all noise; a whole number from 0.
        policy: A name of `plumeward.policies()`, or the path of a bundle.
        particles: Particles of the filter.
        threshold_m: The search stops when the spread of the belief is below it, m; None: the problem's
            stop, by default 0.5 m.
        budget: Moves after which the mission is given up; None: the problem's.
        moves: Of a planner: `headings`, `step` (m) and `measurements`, where its own are not wanted.
        problem: What is searched: a `plumeward.Problem`, `"paper"`, or the path of a YAML file. The other
            arguments override its fields.
        world: How the gas moves, and how the truth differs from what the estimator is told: a name that
            `plumeward list worlds` shows, or several: `"puffs:share=0.2+wind-30"`; None: the problem's.
        assume: What the estimator takes to be known: `field` or `paper`, where all but the position is
            known.
        stop: The stop criterion, instead of `threshold_m`: `"spread:0.5"`, or `"within:1,0.99"` to stop
            when at least 99% of the belief is
            within 1 m of the estimate.
        vehicles: Vehicles that search together, with one belief and one stop.
        formation: Where they start: from one `point`, along one `edge`, or in different `corners`.
        separation_m: Least distance between the ways of two vehicles, m.
        knowledge: Further fields of `plumeward.Config`: `sensor`, `priors`, `stop_limits`,
            `stop_on_location` and `margin_m`.

    Returns:
        The outcome, and a trace of one point for each reading, the first of them before any move. Lengths
        are in metres. With several vehicles a point says whose reading it is, and shows the belief after
        the round; steps are rounds, and the distance is that of all.

    Raises:
        ValueError: The policy, the problem or the world is not known, or cannot be flown so; or a number,
            the assumption or the criterion is not allowed.
        TypeError: There is no such argument, or the sensor or a prior is something else, such as its text.

    Examples:
        >>> outcome, trace = plumeward.rollout(seed=4)
        >>> outcome.located, outcome.steps, round(outcome.error_m, 2)
        (True, 36, 0.08)
    """
    searched = with_arguments(problem, budget=budget, world=world)
    criterion = chosen(threshold_m, stop, searched.stop)
    check(assume, knowledge)
    policy = policies.name_of(policy)
    check_policy(policy, moves, searched)
    seed, particles = whole("seed", seed, 0, MAX_SEED), whole("particles", particles, *PARTICLES)
    knowledge |= {"assume": assume, "within": criterion.within}
    policies.policy(policy)
    flown = mission(
        seed,
        policy,
        particles,
        criterion.threshold_m,
        moves=moves,
        problem=searched,
        fleet=Fleet(vehicles, formation, separation_m).within(searched),
        **knowledge,
    )
    trace: list[TracePoint] = []
    search_time_s = 0.0
    for step in flown.steps:
        said = step.belief
        for taken in step.readings:
            trace.append(TracePoint(taken.position, taken.gas, said.mean, said.spread, taken.vehicle))
        search_time_s += step.update_s + step.decision_s
    return outcome(
        seed,
        policy,
        flown.scenario,
        trace,
        said.ceased,
        search_time_s,
        said.assume,
        said.stop,
        searched.world,
        said.outside,
        searched.area,
        said.intermittency,
        said.advised_dwell,
        LastWord(
            said.covariance, said.rate, rate_interval(said.unknowns, step.particles, said.intermittency)
        ),
        searched.home or HOME,
    ), trace
