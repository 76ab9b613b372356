"""The search problem of the OTTO benchmark: a grid, a belief of the source's cell, and Poisson hits.

Loisy, Eloy 2022: Searching for a source without gradients, Proc. R. Soc. A 478 (the isotropic cases).
Loisy, Heinonen 2023: Deep reinforcement learning for the olfactory search POMDP: a quantitative benchmark,
Eur. Phys. J. E 46 (the windy cases). Lengths are in cells, one cell a step. Arithmetic is in a fixed order.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from plume.compiled import kernel, subroutine
from plume.elementary import Array, Indices, exp, log
from plume.numerics import dot, total_of
from plume.numerics import log as log_of
from plume.randomness import keyed

Cell = tuple[int, int]
STEPS: tuple[Cell, ...] = ((-1, 0), (1, 0), (0, -1), (0, 1))
FOUND_BELOW = 1e-6  # a run ends when the source is left unfound with less probability
NEARLY = 1e-10  # OTTO takes probabilities as close as this for equal
RETURNS = 9  # a run stalls when the vehicle goes back and forth so many times in a row
SERIES = 60  # terms of the Poisson law's tail


@dataclass(frozen=True)
class Isotropic:
    """Gas in still air: μ = I · K0(d/L) / ln 2L hits a step at a distance d."""

    length: float  # L: how far gas spreads, cells
    rate: float  # I: hits a step that leave the source

    def hits(self, x: Array, y: Array) -> Array:
        """Mean number of hits a step at (x, y) cells from the source."""
        return np.asarray(self.rate * k0(np.sqrt(x * x + y * y) / self.length) / log(2 * self.length))

    def first_hits(self, number: int) -> Array:
        """Probability of each number of hits at the start, (H,): at least one, far from any edge.

        A source at a distance of r cells counts by the circumference of that circle.
        """
        r = np.arange(1.0, 1000 * self.length)
        chances = np.array([np.sum(of * r) for of in chances_of(self.hits(r, 0 * r), number)])
        chances[0] = 0.0
        return np.asarray(chances / chances.sum())


@dataclass(frozen=True)
class Windy:
    """Gas in a wind along +x: μ = R/d · exp(Vx/2 − d/λ), λ² = (τ/V²)/(1 + τ/4)."""

    rate: float  # R
    wind: float = 2.0  # V
    lifetime: float = 150.0  # τ

    def hits(self, x: Array, y: Array) -> Array:
        """Mean number of hits a step at (x, y) cells from the source, x downwind."""
        far = np.sqrt(x * x + y * y)
        length = math.sqrt(self.lifetime / self.wind**2 / (1 + self.lifetime / 4))
        return np.asarray(self.rate / far * exp(0.5 * self.wind * x - far / length))

    def first_hits(self, number: int) -> Array:
        """Probability of each number of hits at the start, (H,): a search begins with one hit."""
        return np.asarray(np.eye(number)[1])


@dataclass(frozen=True)
class Case:
    """A problem of the benchmark."""

    name: str
    gas: Isotropic | Windy
    shape: Cell  # of the grid
    hits: int  # H: numbers of hits that are told apart; the last stands for itself and all greater ones
    start: Cell
    most_steps: int  # a run that takes longer stalls
    back_and_forth: bool  # whether RETURNS ends a run
    ties: float  # a planner's scores of moves that are closer count as equal, and the first move is taken

    @cached_property
    def chances(self) -> Array:
        """(H, 2X − 1, 2Y − 1): chance of each number of hits by the source's place relative to the vehicle.

        The middle is the vehicle's own cell: it is searched by being there, so all are 0.
        """
        wide, high = self.shape
        x, y = np.meshgrid(np.arange(1.0 - wide, wide), np.arange(1.0 - high, high), indexing="ij")
        middle = (wide - 1, high - 1)
        x[middle] = 1.0  # any: the result is overwritten
        result = chances_of(self.gas.hits(-x, -y), self.hits)
        result[:, wide - 1, high - 1] = 0.0
        return result

    @cached_property
    def logs(self) -> Array:
        """Logarithms of `chances`; 0 in the middle."""
        wide, high = self.shape
        chances = self.chances.copy()
        chances[:, wide - 1, high - 1] = 1.0
        return log(chances)

    @cached_property
    def first_hits(self) -> Array:
        """Probability of each number of hits at the start, (H,)."""
        return self.gas.first_hits(self.hits)

    def prior(self, hits: int) -> Array:
        """The belief (X, Y) after the first hits: the source may be in any cell but the vehicle's."""
        (wide, high), (x, y) = self.shape, self.start
        seen = self.chances[hits, wide - 1 - x : 2 * wide - 1 - x, high - 1 - y : 2 * high - 1 - y]
        return np.asarray(seen / seen.sum())

    def moves(self, cell: Cell) -> list[Cell]:
        """The cells that a step reaches."""
        places = [(cell[0] + x, cell[1] + y) for x, y in STEPS]
        return [place for place in places if self.has(place)]

    def has(self, cell: Cell) -> bool:
        """Whether a cell is on the grid."""
        return 0 <= cell[0] < self.shape[0] and 0 <= cell[1] < self.shape[1]


CASES = {
    case.name: case
    for case in (
        Case("isotropic-19x19", Isotropic(1.0, 1.0), (19, 19), 3, (9, 9), 642, True, NEARLY),
        Case("isotropic-53x53", Isotropic(3.0, 2.0), (53, 53), 4, (26, 26), 2188, True, NEARLY),
        Case("windy-medium", Windy(2.5), (81, 41), 2, (65, 20), 10_000, False, 0.0),
        Case("windy-low", Windy(0.25), (81, 41), 2, (65, 20), 10_000, False, 0.0),
    )
}


def k0(x: Array) -> Array:
    """K0(x), the modified Bessel function, for x > 0: the trapezoidal rule on ∫ exp(−x cosh t) dt, t ≥ 0."""
    step = 1 / 32
    grows = exp(np.arange(1, round(40 / step)) * step)
    result = 0.5 * exp(-x)
    for cosh in (grows + 1 / grows) / 2:
        if float(np.min(x)) * cosh > 745:  # e^−745 is 0
            break
        result = result + np.where(x * cosh < 700, exp(-x * cosh), 0.0)
    return np.asarray(step * result)


def chances_of(mean: Array, number: int) -> Array:
    """Chance of 0, 1, … hits of this mean (...), and of `number` − 1 or more: (number, ...)."""
    term, result = exp(-mean), np.zeros((number, *mean.shape))
    for hits in range(number - 1 + SERIES):
        result[min(hits, number - 1)] += term
        term = term * mean / (hits + 1)
    return result


@dataclass(frozen=True)
class Outcomes:
    """What can come of A paths: the source is found in one of the path's L cells, or hits are counted.

    (A, L + K) each: first the finds in the order of the path, then the K = H^R combinations of hits.
    """

    chance: Array
    gain: Array  # Kullback–Leibler divergence of the belief after it from the belief now, nats
    entropy: Array  # of the belief after it, nats
    distance: Array  # expected Manhattan distance from the end of the path after it, cells


@dataclass(frozen=True)
class State:
    """Where a vehicle is, and what it believes."""

    case: Case
    cell: Cell
    belief: Array  # (X, Y), sum one; 0 where the vehicle is

    def outcomes(self, paths: Indices, counted: tuple[int, ...]) -> Outcomes:
        """What can come of paths (A, L, 2), with hits counted in the `counted` cells of each."""
        return Outcomes(
            *_outcomes(self.belief, self.case.chances, self.case.logs, paths, np.array(counted, np.int64))
        )


@subroutine
def window(table: Array, shape: tuple[int, int], x: int, y: int, into: Array) -> None:
    """Copy to `into` (X Y,) what a table (2X − 1, 2Y − 1) has for the grid with the vehicle at (x, y)."""
    wide, high = shape
    for i in range(wide):
        row = table[wide - 1 - x + i]
        for j in range(high):
            into[i * high + j] = row[high - 1 - y + j]


@kernel(
    "UniTuple(float64[:, ::1], 4)(float64[:, ::1], float64[:, :, ::1], float64[:, :, ::1], int64[:, :, ::1], "
    "int64[::1])",
    nogil=True,
)
def _outcomes(
    belief: Array, chances: Array, logs: Array, paths: Indices, counted: Indices
) -> tuple[Array, Array, Array, Array]:
    """See `State.outcomes`."""
    (wide, high), (number, length, _), many = belief.shape, paths.shape, len(chances)
    size, combinations = wide * high, many ** len(counted)
    now, logs_now = belief.copy().reshape(-1), np.zeros(size)
    for i in range(size):
        if now[i] > 0.0:
            logs_now[i] = log_of(now[i])
    likely, log_likely, far, left = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    seen, log_seen = np.empty((len(counted), many, size)), np.empty((len(counted), many, size))
    chance, gain = np.zeros((number, length + combinations)), np.zeros((number, length + combinations))
    entropy, distance = np.zeros((number, length + combinations)), np.zeros((number, length + combinations))
    for a in range(number):
        left[:] = now
        for step in range(length):
            found = paths[a, step, 0] * high + paths[a, step, 1]
            chance[a, step] = left[found]
            if left[found] > 0.0:
                gain[a, step] = -logs_now[found]
            left[found] = 0.0
        for r in range(len(counted)):
            x, y = paths[a, counted[r]]
            for h in range(many):
                window(chances[h], (wide, high), x, y, seen[r, h])
                window(logs[h], (wide, high), x, y, log_seen[r, h])
        x, y = paths[a, length - 1]
        for i in range(wide):
            for j in range(high):
                far[i * high + j] = abs(i - x) + abs(j - y)
        for k in range(combinations):
            likely[:] = left
            log_likely[:] = 0.0
            rest = k
            for r in range(len(counted)):
                one, log_one = seen[r, rest % many], log_seen[r, rest % many]
                rest //= many
                for i in range(size):
                    likely[i] *= one[i]
                    log_likely[i] += log_one[i]
            total, into = total_of(likely), length + k
            if total < 1e-300:  # the source is surely on the path
                continue
            fits, log_total = dot(likely, log_likely) / total, log_of(total)
            chance[a, into] = total
            gain[a, into] = fits - log_total
            entropy[a, into] = log_total - fits - dot(likely, logs_now) / total
            distance[a, into] = dot(likely, far) / total
    return chance, gain, entropy, distance


@kernel("Tuple((float64, int64))(float64[:, ::1], float64[:, :, ::1], int64, int64, float64)")
def advance(belief: Array, chances: Array, x: int, y: int, draw: float) -> tuple[float, int]:
    """Move to (x, y), draw hits by `draw` in [0, 1), and make `belief` the belief after them.

    Returns the probability to find the source there, and the number of hits: −1 if it is surely found.
    """
    (wide, high), many = belief.shape, len(chances)
    found = belief[x, y]
    belief[x, y] = 0.0
    flat, seen, joint = belief.reshape(-1), np.empty(belief.size), np.empty((many, belief.size))
    totals = np.empty(many)
    for h in range(many):
        window(chances[h], (wide, high), x, y, seen)
        for i in range(len(flat)):
            joint[h, i] = flat[i] * seen[i]
        totals[h] = total_of(joint[h])
    whole = total_of(totals)
    if whole < NEARLY:
        return found, -1
    hits, below = 0, totals[0]
    while hits + 1 < many and draw * whole >= below:
        hits += 1
        below += totals[hits]
    for i in range(len(flat)):
        flat[i] = joint[hits, i] / totals[hits]
    return found, hits


# A planner on the grid: (state, cells that a step reaches, keyed random generator) -> index of the chosen
# cell.
Rule = Callable[[State, list[Cell], np.random.Generator], int]


class Search(NamedTuple):
    """What came of a search."""

    expected: float  # steps to the source, over all places where it may be
    steps: int  # until the search ended
    stalled: bool


def search(case: Case, rule: Rule, seed: int) -> Search:
    """Search once.

    No source is drawn. The search goes on as if the source were not where it looks, and each step counts by
    the probability that it is needed. A search that stalls counts by the steps up to then.
    """
    draws, own = keyed(seed, f"{case.name} hits"), keyed(seed, f"{case.name} planner")
    first = np.cumsum(case.first_hits)
    hits = min(int(np.searchsorted(first, draws.random(), side="right")), case.hits - 1)
    belief, path = case.prior(hits), [case.start]
    expected, unfound, returns = 0.0, 1.0, 0
    while True:
        moves = case.moves(path[-1])
        cell = moves[rule(State(case, path[-1], belief), moves, own)]
        expected += unfound
        found, hits = advance(belief, case.chances, *cell, draws.random())
        unfound *= 1 - found
        path.append(cell)
        if unfound < FOUND_BELOW or hits < 0:
            return Search(expected, len(path) - 1, False)
        returns = returns + 1 if len(path) > 2 and path[-3] == cell else 0
        if len(path) > case.most_steps or (case.back_and_forth and returns >= RETURNS):
            return Search(expected, len(path) - 1, True)
