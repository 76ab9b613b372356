"""The planners' rules on the grid of the OTTO benchmark.

Shared with `agent/planners/` are the scores: what a planner makes of distances, entropies and gains. Restated
is where these come from: the belief has a weight a cell, and finds and hits are summed over, not imagined.
"""

from functools import cache
from itertools import product

import numpy as np

from agent.planners import homing as homing_planner
from agent.planners import lookahead as lookahead_planner
from agent.planners import space_aware_infotaxis, thompson
from agent.planning.predict import Cloud, spread_of_cells
from benchmarks.otto_grid import NEARLY, STEPS, Case, Cell, Rule, State
from plume.elementary import Array, Indices
from plume.numerics import exp_each


def least(costs: Array, case: Case) -> int:
    """The first of the least costs (A,); costs closer than `case.ties` count as equal."""
    lowest = costs.min()
    return int(np.argmax((costs == lowest) | (costs < lowest + case.ties)))


@cache
def _next(case: Case, cell: Cell) -> Indices:
    """(A, 1, 2): the cells that a step reaches, as paths."""
    return np.array(case.moves(cell))[:, None]


@cache
def _headings(case: Case, cell: Cell, steps: int) -> tuple[Indices, Indices]:
    """Paths (P, steps, 2) in eight headings, and for each the index (P,) of its first cell among the moves.

    A diagonal heading is a staircase, of which there are two. A step that would leave the grid is left out:
    the path stays where it is. Paths whose first step is left out are missing.
    """
    moves = case.moves(cell)
    paths, firsts = [], []
    for one, two in product(STEPS, STEPS):
        if one[0] == -two[0] and one[1] == -two[1]:
            continue
        path = [cell]
        for step in range(steps):
            x, y = (one, two)[step % 2]
            further = (path[-1][0] + x, path[-1][1] + y)
            path.append(further if case.has(further) else path[-1])
        if path[1] != cell:
            paths.append(path[1:])
            firsts.append(moves.index(path[1]))
    return np.array(paths), np.array(firsts)


@cache
def _places(case: Case) -> Array:
    """(2, X Y): the middles of the cells."""
    return np.indices(case.shape).reshape(2, -1).astype(np.float64)


def _cloud(state: State) -> Cloud:
    """The belief as particles, one in the middle of each cell."""
    return Cloud(_places(state.case), state.belief.reshape(-1))


def infotaxis(state: State, _moves: list[Cell], _rng: np.random.Generator) -> int:
    """The greatest expected information gain about the source's cell (Vergassola 2007).

    Where the source is sure to be tells nothing new, so a sure find counts a little more than nothing.
    """
    outcomes = state.outcomes(_next(state.case, state.cell), (0,))
    sure = 2 * NEARLY * (outcomes.chance[:, 0] > 1 - NEARLY)
    return least(-(outcomes.chance * outcomes.gain).sum(axis=1) - sure, state.case)


def space_aware(state: State, _moves: list[Cell], _rng: np.random.Generator) -> int:
    """The least expected log(D + (2^H − 1)/2) of the belief after a step (Loisy and Eloy 2022, eq. 3.4).

    A find costs nothing.
    """
    outcomes = state.outcomes(_next(state.case, state.cell), (0,))
    costs = space_aware_infotaxis.cost(outcomes.distance[:, 1:], np.maximum(outcomes.entropy[:, 1:], 0.0))
    return least((outcomes.chance[:, 1:] * costs).sum(axis=1), state.case)


def _distances(places: Array, shape: Cell) -> Array:
    """(..., X Y): the flight on the grid, the Manhattan distance, from places (..., 2) to the cells."""
    x, y = (np.abs(places[..., axis, None] - np.arange(shape[axis])) for axis in (0, 1))
    return np.asarray((x[..., None] + y[..., None, :]).reshape(*places.shape[:-1], -1))


def _spreads(state: State, spread: float, paths: Indices, counted: tuple[int, ...]) -> Array:
    """(A,): expected spread after what is found and counted on the paths. A find leaves none."""
    outcomes, finds = state.outcomes(paths, counted), paths.shape[1]
    spreads = spread * exp_each(-outcomes.gain[:, finds:] / 2)
    return np.asarray((outcomes.chance[:, finds:] * spreads).sum(axis=1))


def homing(state: State, _moves: list[Cell], _rng: np.random.Generator) -> int:
    """`homing`: the first step to the best of the eight places two steps ahead."""
    steps, cloud = int(homing_planner.AHEAD), _cloud(state)
    paths, firsts = _headings(state.case, state.cell, steps)
    spread = spread_of_cells(cloud.weights[cloud.weights > 0], 1.0)
    spreads = _spreads(state, spread, paths, (steps - 1,))
    here, places = np.array(state.cell, np.float64), paths[:, -1].astype(np.float64)
    flown = np.abs(places - here).sum(axis=1)
    costs = homing_planner.scores(
        cloud,
        _distances(places, state.case.shape),
        cloud.mean(_distances(here, state.case.shape)),
        spread,
        spreads,
        flown,
    )
    return int(firsts[least(costs, state.case)])


def lookahead(state: State, _moves: list[Cell], _rng: np.random.Generator) -> int:
    """`lookahead`: the first step of the best of eight headings, hits counted two and four steps ahead."""
    cloud, counted = _cloud(state), [int(steps) - 1 for steps in lookahead_planner.AHEAD]
    paths, firsts = _headings(state.case, state.cell, counted[-1] + 1)
    spread = spread_of_cells(cloud.weights[cloud.weights > 0], 1.0)
    spreads = [
        _spreads(state, spread, np.ascontiguousarray(paths[:, : last + 1]), tuple(counted[: number + 1]))
        for number, last in enumerate(counted)
    ]
    places = paths[:, counted].astype(np.float64)
    flown = np.abs(places - np.array(state.cell)).sum(axis=-1)
    distances = cloud.mean(_distances(places, state.case.shape))
    costs = lookahead_planner.scores(flown, distances, np.stack(spreads, axis=1))
    return int(firsts[least(costs, state.case)])


def towards_a_draw(state: State, moves: list[Cell], rng: np.random.Generator) -> int:
    """`thompson`: towards a cell drawn from the belief at each step."""
    return thompson.towards(_cloud(state), np.array(moves, np.float64), rng)


RULES: dict[str, Rule] = {
    "infotaxis": infotaxis,
    "space-aware-infotaxis": space_aware,
    "homing": homing,
    "lookahead": lookahead,
    "thompson": towards_a_draw,
}
