"""A fleet that searches together, against its number of vehicles, and against searchers that share nothing.

    python -m benchmarks.together                              # the table of docs/fleet.md, from results/
    python -m benchmarks.together --fly --missions 100         # flies what the rows lack, and adds them
    python -m benchmarks.together --wide                       # the same of an area of 150 m, from corners

A fleet is compared with one vehicle from the same formation, and with one from a point, on the same seeds:
the share of its moves, with a bootstrap interval over the pairs; and by medians, which do not depend on when
a search is given up. `alone` flies each vehicle of a formation with a belief of its own, as if the others
were not there; the first to stop ends the search of all, and all have flown as many moves. `told` are fleets
that know where the source is, fly straight to it, and search from there: the way, and the readings that the
stop wants.
"""

import argparse
import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from agent.planning.apart import Shared
from agent.planning.moves import lengths
from agent.policies import DEFAULT, choose, reach
from agent.together import in_turn, seen_by
from agent.trials.evaluate import FIRST_TEST_SEED
from agent.trials.figures import bootstrap, wilson
from agent.trials.rollout import prepared, rollout
from agent.trials.rounds import Rounds
from agent.trials.workers import as_flown
from benchmarks.rows import append, read
from estimator.belief import belief
from estimator.criterion import USUAL_THRESHOLD_M
from estimator.filter import Config, assimilate, prior
from link import cli
from link.bus.mavlink import Reading
from link.terminal import tell
from plume.elementary import Array
from plume.outcome import verdict
from plume.problem import ALTITUDE_M, PAPER, Area, Problem
from plume.problems.fleet import FORMATIONS, Fleet, Place
from plume.randomness import derived_seed, seed_of
from plume.scenario import BUDGET_STEPS, draw
from plume.worlds.world import World

ROWS, OF_WIDE = Path("results/together/missions.csv"), Path("results/together/wide.csv")
MOST = 4
NEAR_M = 3.0
WIDE = Problem(area=Area((0, 0), (150, 150)), step_m=2.5, budget=1000)
"""The plumes of Table 1 in an area that is far wider than they are."""


HEADINGS = (
    *("policy", "from", "vehicles", "missions", "not ceased", "moves together", "share of one"),
    *("of one from a point", "if told", "median", "share of one's", "metres in all"),
    *("moves alone", "share of one"),
    *("false stops together", "alone"),
)


class Cell(NamedTuple):
    """What is flown over all seeds."""

    policy: str
    formation: str
    vehicles: int
    how: str  # together, told, or alone: then `vehicles` says which vehicle of the formation


class Flown(msgspec.Struct, frozen=True):
    """A row: one search of a cell."""

    policy: str
    formation: str
    vehicles: int
    how: str
    seed: int
    ceased: bool
    false_stop: bool
    moves: int  # of each vehicle
    distance_m: float  # of all

    @property
    def cell(self) -> Cell:
        """The cell that it belongs to."""
        return Cell(self.policy, self.formation, self.vehicles, self.how)


def fly(seed: int, cells: Sequence[Cell], problem: Problem = PAPER) -> list[Flown]:
    """Fly one seed in each of these cells; only fleets that search together have another problem."""
    ways: dict[str, Callable[[int, Cell], Flown]] = {
        "together": partial(_together, problem=problem),
        "told": _told,
        "alone": _alone,
    }
    return [ways[cell.how](seed, cell) for cell in cells]


def _together(seed: int, cell: Cell, problem: Problem) -> Flown:
    result, _ = rollout(seed, cell.policy, problem=problem, vehicles=cell.vehicles, formation=cell.formation)
    false_stop = result.ceased and not result.located and not result.outside
    return Flown(*cell, seed, result.ceased, false_stop, result.steps, result.distance_m)


def _told(seed: int, cell: Cell) -> Flown:
    """Fly a fleet of which each vehicle goes straight to the source, and searches within NEAR_M of it."""
    world, config = prepared(seed, PAPER, 1000, USUAL_THRESHOLD_M, assume="field")
    source, fleet = np.array(world.truth.source), Fleet(cell.vehicles, cell.formation)
    rounds, agent_seed = Rounds(world, config, fleet.starts(world.start, seed)), derived_seed(seed, "agent")
    flown, within = rounds.fly(rounds.places), reach(cell.policy)

    def decide(vehicle: int, free: Shared) -> Place:
        place = rounds.places[vehicle]
        if math.dist(place, source) <= NEAR_M:
            seen = seen_by(flown.belief, place, flown.readings[vehicle].gas, vehicle + 1)
            return choose(cell.policy, seen, flown.particles, seed_of(agent_seed, vehicle + 1), free)
        moves = free.moves(place)
        x, y = moves[np.argmin(lengths(moves - source))].tolist()
        return x, y

    while not flown.belief.ceased and flown.belief.step < BUDGET_STEPS:
        stands = [each.place for each in flown.belief.stands or ()]
        flown = rounds.fly(in_turn(within, rounds.places, fleet.separation_m, decide, stands=stands))
    said = flown.belief
    ended = verdict(said.ceased, said.mean, world.truth.source, said.outside)
    metres = float(said.step * cell.vehicles)
    return Flown(*cell, seed, said.ceased, ended == "FALSE STOP", said.step, metres)


def _alone(seed: int, cell: Cell) -> Flown:
    """Fly vehicle number `cell.vehicles` of a formation with a belief of its own."""
    scenario, within, vehicle = draw(seed), reach(cell.policy), cell.vehicles
    first = World(scenario, seed)
    world, place = first.of_vehicle(vehicle), Fleet(vehicle, cell.formation).starts(first.start, seed)[-1]
    of_estimator, of_agent = (seed_of(derived_seed(seed, who), vehicle) for who in ("estimator", "agent"))
    config = Config(
        seed=of_estimator, rate=scenario.q, diffusivity=scenario.d, lifetime=scenario.tau, assume="field"
    )
    posterior, distance_m = prior(config), 0.0
    for step in range(BUDGET_STEPS + 1):
        reading = Reading(step, place, ALTITUDE_M, world.wind, world.gas(place, step))
        posterior = assimilate(posterior, reading, config)
        said, particles = belief(posterior, reading, config)
        if said.ceased or step == BUDGET_STEPS:
            break
        last, place = place, choose(cell.policy, said, particles, of_agent, within)
        distance_m += math.dist(last, place)
    ended = verdict(said.ceased, said.mean, scenario.source, said.outside)
    return Flown(*cell, seed, said.ceased, ended == "FALSE STOP", step, distance_m)


def first_of(own: Sequence[dict[int, Flown]]) -> dict[int, Flown]:
    """Return the searches of vehicles that share nothing, by seed: the first of them to stop ends each."""
    result: dict[int, Flown] = {}
    for seed in set.intersection(*map(set, own)):
        first = min((of_one[seed] for of_one in own), key=lambda row: (not row.ceased, row.moves))
        result[seed] = msgspec.structs.replace(first, distance_m=len(own) * first.distance_m)
    return result


def cells_of(policies: Sequence[str], most: int, wide: bool = False) -> list[Cell]:
    """Return all cells. Vehicle 1 alone is a fleet of one; on an edge starts depend on how many there are."""
    if wide:
        return [Cell(policy, "corners", k + 1, "together") for policy in policies for k in range(most)]
    return [
        Cell(policy, formation, vehicles, how)
        for policy in policies
        for formation in FORMATIONS
        for vehicles in range(1, most + 1)
        for how in ("together", "told", "alone")[: 2 + (vehicles > 1 and formation != "edge")]
    ]


def table(rows: Sequence[Flown]) -> str:
    """Return the table of docs/fleet.md, in Markdown."""
    of_cell: dict[Cell, dict[int, Flown]] = defaultdict(dict)
    for row in rows:
        of_cell[row.cell][row.seed] = row
    lines = [HEADINGS]

    def order(cell: Cell) -> tuple[str, int, int]:
        return cell.policy, [*FORMATIONS].index(cell.formation), cell.vehicles

    for cell in sorted((cell for cell in of_cell if cell.how == "together"), key=order):
        own, one = of_cell[cell], of_cell.get(cell._replace(vehicles=1), {})
        # One alone from corners starts where one from a point does.
        at_a_point = of_cell.get(cell._replace(formation="corners", vehicles=1), {})
        told = of_cell.get(cell._replace(how="told"), {})
        alone = [of_cell.get(cell._replace(vehicles=k, how="alone"), {}) for k in range(2, cell.vehicles + 1)]
        apart = first_of([one, *alone]) if alone else {}
        metres = bootstrap(np.array([row.distance_m for row in own.values()])).text(1, 0)
        lines.append(
            (
                *(cell.policy, cell.formation, str(cell.vehicles), f"{len(own):,}"),
                *(str(sum(not row.ceased for row in own.values())), _moves(own)),
                *(_share(own, one), _share(own, at_a_point), _share(told, at_a_point)),
                *(f"{np.median([row.moves for row in own.values()]):.0f}", _share(own, one, np.median)),
                *(metres, _moves(apart), _share(apart, one)),
                *(_false(own), _false(apart)),
            )
        )
    said = [column for column in zip(*lines, strict=True) if any(column[1:])]
    heading, *others = (f"| {' | '.join(cells)} |" for cells in zip(*said, strict=True))
    return "\n".join([heading, "|---" * len(said) + "|", *others])


def _moves(own: dict[int, Flown]) -> str:
    return bootstrap(np.array([row.moves for row in own.values()])).text(1, 1) if own else ""


def _share(own: dict[int, Flown], one: dict[int, Flown], middle: Callable[..., Array] = np.mean) -> str:
    both = np.array([(own[seed].moves, one[seed].moves) for seed in own if seed in one], np.float64)
    if not len(both):
        return ""
    share = bootstrap(both, lambda drawn: middle(drawn[..., 0], axis=1) / middle(drawn[..., 1], axis=1))
    return share.text(1, 2)


def _false(own: dict[int, Flown]) -> str:
    false = sum(row.false_stop for row in own.values())
    return f"{false}, at most {100 * wilson(false, len(own)).high:.1f}%" if own else ""


def main() -> None:
    """Fly what is asked for, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--fly", action="store_true", help="fly what the rows lack")
    parser.add_argument("--missions", type=cli.whole(1, 100_000), default=100, help="seeds from 1,000,000 on")
    parser.add_argument("--policy", type=cli.listed(str), default=[DEFAULT], help="policies between commas")
    parser.add_argument("--vehicles", type=cli.whole(1, 8), default=MOST, help="largest fleet")
    parser.add_argument("--workers", type=cli.whole(1, 64), default=1)
    parser.add_argument("--wide", action="store_true", help="an area of 150 m")
    parser.add_argument("--rows", type=Path, help=f"default: {ROWS}, {OF_WIDE}")
    args: Any = parser.parse_args()
    rows_at = args.rows or (OF_WIDE if args.wide else ROWS)
    if args.fly:
        done = {(row.cell, row.seed) for row in read(rows_at, Flown)}
        cells, problem = cells_of(args.policy, args.vehicles, args.wide), WIDE if args.wide else PAPER
        tasks = [
            (seed, [cell for cell in cells if (cell, seed) not in done], problem)
            for seed in range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.missions)
        ]
        for _, rows in as_flown(_fly_task, tasks, args.workers):
            append(rows, rows_at)
    tell(table(read(rows_at, Flown)))


def _fly_task(task: tuple[int, Sequence[Cell], Problem]) -> list[Flown]:
    return fly(*task)


if __name__ == "__main__":
    main()
