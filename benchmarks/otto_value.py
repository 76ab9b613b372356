"""A value function on the OTTO benchmark: the expected steps to the source, learned, and its planner.

    python -m benchmarks.otto_value      # 14 minutes of one core; results/otto/value.npz

Loisy and Eloy 2022 train such a network and take the move with the least expected value after it. Ours is for
isotropic-19x19 alone. V = D + softplus(network). D is the expected Manhattan distance: no search is shorter.
The network sees the square roots of the belief around the vehicle, D and the entropy. Its target is the least
over the moves of 1 + Σ chance · V after the move, summed over the numbers of hits (temporal differences).
"""

import math
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.otto_grid import CASES, STEPS, Case, Cell, Rule, State, advance, window
from link import cli
from link.files import whole
from plume.compiled import kernel, subroutine
from plume.elementary import Array, Indices
from plume.numerics import exp, log, log1p, total_of
from plume.randomness import keyed

if TYPE_CHECKING:  # it takes long to import
    import torch
Inputs = NDArray[np.float32]
CASE = CASES["isotropic-19x19"]
WEIGHTS = Path(__file__).parents[1] / "results" / "otto" / "value.npz"
FEATURES = 3  # D, entropy, number of cells that it stands for
UNITS = 64
SYMMETRIES = 8
BATCH = 256  # searches side by side
ITERATIONS = 30_000
KEPT = 40  # of the latest iterations, whose states are learned again
AGAIN = 3  # gradient steps an iteration
RATE, LAST_RATE = 1e-3, 3e-5
EXPLORE, LAST_EXPLORE = 0.2, 0.02
POLYAK = 0.995


class Layers(NamedTuple):
    """The network: weights (inputs, units) and biases of three layers."""

    first: Array
    first_bias: Array
    second: Array
    second_bias: Array
    last: Array
    last_bias: Array


@subroutine
def _features(belief: Array, x: int, y: int, into: Array) -> None:
    """Fill in expected Manhattan distance, entropy and e^entropy of a belief (X, Y), each by its scale."""
    distance, entropy = 0.0, 0.0
    for i in range(belief.shape[0]):
        for j in range(belief.shape[1]):
            if belief[i, j] > 0.0:
                distance += belief[i, j] * (abs(i - x) + abs(j - y))
                entropy -= belief[i, j] * log(belief[i, j])
    into[0], into[1], into[2] = distance / 10, entropy / 5, exp(entropy) / 100


@subroutine
def _turned(i: int, j: int, symmetry: int) -> tuple[int, int]:
    """(i, j) by one of the square's eight symmetries."""
    if symmetry & 1:
        i = -i
    if symmetry & 2:
        j = -j
    return (j, i) if symmetry & 4 else (i, j)


@kernel(
    "float64(float64[:, ::1], int64, int64, float64[:, ::1], float64[::1], float64[:, ::1], float64[::1], "
    "float64[:, ::1], float64[::1])",
    nogil=True,
)
def value_of(
    belief: Array,
    x: int,
    y: int,
    first: Array,
    first_bias: Array,
    second: Array,
    second_bias: Array,
    last: Array,
    last_bias: Array,
) -> float:
    """Value of a belief (X, Y) of a vehicle at (x, y), the mean over the square's symmetries."""
    wide, high = belief.shape
    features, units = np.empty(FEATURES), len(first_bias)
    _features(belief, x, y, features)
    one, two, result = np.empty(units), np.empty(units), 0.0
    for symmetry in range(SYMMETRIES):
        one[:] = first_bias
        for f in range(FEATURES):
            row = first[len(first) - FEATURES + f]
            for u in range(units):
                one[u] += features[f] * row[u]
        for i in range(wide):
            for j in range(high):
                if belief[i, j] > 0.0:
                    root = math.sqrt(belief[i, j])
                    a, b = _turned(i - x, j - y, symmetry)
                    row = first[(a + wide - 1) * (2 * high - 1) + b + high - 1]
                    for u in range(units):
                        one[u] += root * row[u]
        two[:] = second_bias
        for k in range(units):
            if one[k] > 0.0:
                row = second[k]
                for u in range(units):
                    two[u] += one[k] * row[u]
        said = last_bias[0]
        for k in range(units):
            if two[k] > 0.0:
                said += two[k] * last[k, 0]
        result += max(said, 0.0) + log1p(exp(-abs(said)))
    return float(10 * features[0] + result / SYMMETRIES)


@kernel(
    "void(float64[:, ::1], int64, int64, float64[:, :, ::1], float64[::1], float64[:, :, ::1])",
    nogil=True,
)
def _after(belief: Array, x: int, y: int, chances: Array, chance: Array, into: Array) -> None:
    """Fill in the chance (H,) of each number of hits, unfound at (x, y), and beliefs (H, X, Y) after it."""
    wide, high = belief.shape
    seen = np.empty(wide * high)
    for h in range(len(chances)):
        window(chances[h], (wide, high), x, y, seen)
        flat = into[h].reshape(-1)
        for i in range(wide):
            for j in range(high):
                left = 0.0 if i == x and j == y else belief[i, j]
                flat[i * high + j] = left * seen[i * high + j]
        chance[h] = total_of(flat)
        for i in range(len(flat)):
            flat[i] /= max(chance[h], 1e-300)


@cache
def layers(path: Path = WEIGHTS) -> Layers:
    """Read the network."""
    with np.load(path) as file:
        return Layers(*(np.ascontiguousarray(file[name], np.float64) for name in Layers._fields))


def by_value(network: Layers) -> Rule:
    """Return the planner of a network: the least 1 + Σ chance · V of the belief after a step."""

    def rule(state: State, moves: list[Cell], _rng: np.random.Generator) -> int:
        chance, beliefs = np.empty(state.case.hits), np.empty((state.case.hits, *state.case.shape))
        costs = []
        for cell in moves:
            _after(state.belief, *cell, state.case.chances, chance, beliefs)
            costs.append(
                sum(
                    of * value_of(belief, *cell, *network)
                    for of, belief in zip(chance.tolist(), beliefs, strict=True)
                    if of > 0.0
                )
            )
        return int(np.argmin(costs))

    return rule


def value(state: State, moves: list[Cell], rng: np.random.Generator) -> int:
    """The trained value policy."""
    return by_value(layers())(state, moves, rng)


@kernel(
    "void(float64[:, :, ::1], int64[:, ::1], float64[:, :, ::1], float64[:, :, ::1], float32[:, :, :, ::1], "
    "float64[:, ::1])",
    nogil=True,
)
def _look(
    beliefs: Array, cells: Indices, chances: Array, chance: Array, inputs: Inputs, found: Array
) -> None:
    """Fill in what a step in each direction can lead to, for searches side by side.

    chance (B, 4, H) that the source is unfound there and these are the hits, inputs (B, 4, H, ·) of the
    network after them, found (B, 4) the chance to find the source there; −1 off the grid.
    """
    (count, wide, high), many = beliefs.shape, len(chances)
    after, of_hits, features = np.empty((many, wide, high)), np.empty(many), np.empty(FEATURES)
    inputs[:] = 0.0
    for b in range(count):
        for a in range(4):
            x, y = cells[b, 0] + (2 * a - 1 if a < 2 else 0), cells[b, 1] + (2 * a - 5 if a >= 2 else 0)
            if x < 0 or y < 0 or x >= wide or y >= high:
                found[b, a] = -1.0
                chance[b, a] = 0.0
                continue
            found[b, a] = beliefs[b, x, y]
            _after(beliefs[b], x, y, chances, of_hits, after)
            for h in range(many):
                chance[b, a, h] = of_hits[h]
                into = inputs[b, a, h]
                _features(after[h], x, y, features)
                for f in range(FEATURES):
                    into[len(into) - FEATURES + f] = features[f]
                for i in range(wide):
                    row = into[(i - x + wide - 1) * (2 * high - 1) : (i - x + wide) * (2 * high - 1)]
                    for j in range(high):
                        row[j - y + high - 1] = math.sqrt(after[h, i, j])


class Searches:
    """Searches side by side, each begun anew when it ends."""

    def __init__(self, case: Case, count: int, rng: np.random.Generator) -> None:
        self.case, self.rng = case, rng
        self.beliefs, self.cells = np.empty((count, *case.shape)), np.empty((count, 2), np.int64)
        self.unfound = np.ones(count)
        wide, high = case.shape
        size = (2 * wide - 1) * (2 * high - 1) + FEATURES
        self.chance, self.found = np.empty((count, 4, case.hits)), np.empty((count, 4))
        self.inputs = np.empty((count, 4, case.hits, size), np.float32)
        self.steps = np.zeros(count, np.int64)
        for number in range(count):
            self.begin(number)

    def begin(self, number: int) -> None:
        """Begin a search anew."""
        hits = int(np.searchsorted(np.cumsum(self.case.first_hits), self.rng.random(), side="right"))
        self.beliefs[number] = self.case.prior(min(hits, self.case.hits - 1))
        self.cells[number], self.unfound[number], self.steps[number] = self.case.start, 1.0, 0

    def look(self) -> None:
        """Fill in what a step in each direction can lead to."""
        _look(self.beliefs, self.cells, self.case.chances, self.chance, self.inputs, self.found)

    def step(self, actions: Indices) -> NDArray[np.float32]:
        """Take a step in each search; returns the inputs of the network there.

        Every other search ends as a real one would, by finding the source; the others as the benchmark's do.
        """
        inputs = np.empty((len(actions), self.inputs.shape[-1]), np.float32)
        draws = self.rng.random((2, len(actions)))
        for b, action in enumerate(actions.tolist()):
            x, y = self.cells[b] + STEPS[action]
            found, hits = advance(self.beliefs[b], self.case.chances, int(x), int(y), draws[0, b])
            self.cells[b], self.steps[b] = (x, y), self.steps[b] + 1
            self.unfound[b] *= 1 - found
            inputs[b] = self.inputs[b, action, max(hits, 0)]
            ends = draws[1, b] < found if b % 2 else self.unfound[b] < 1e-6
            if ends or hits < 0 or self.steps[b] > 200:
                self.begin(b)
        return inputs


def train(iterations: int, path: Path, seed: int = 0) -> Iterator[tuple[int, float]]:
    """Train a network and write it; yields the iteration and the loss now and then."""
    import torch

    torch.set_num_threads(1)
    torch.manual_seed(seed)
    rng = keyed(seed, "otto value")
    searches = Searches(CASE, BATCH, rng)
    size = searches.inputs.shape[-1]
    net, slow = (
        torch.nn.Sequential(
            torch.nn.Linear(size, UNITS),
            torch.nn.ReLU(),
            torch.nn.Linear(UNITS, UNITS),
            torch.nn.ReLU(),
            torch.nn.Linear(UNITS, 1),
        )
        for _ in range(2)
    )
    slow.load_state_dict(net.state_dict())
    optimiser = torch.optim.Adam(net.parameters(), lr=RATE)
    kept: list[tuple[torch.Tensor, torch.Tensor]] = []
    before: NDArray[np.float32] | None = None
    for iteration in range(iterations):
        share = iteration / iterations
        rate = LAST_RATE + (RATE - LAST_RATE) * (1 + math.cos(math.pi * share)) / 2
        optimiser.param_groups[0]["lr"] = rate
        searches.look()
        with torch.no_grad():
            after = _said(slow, torch.from_numpy(searches.inputs.reshape(-1, size))).numpy()
        costs = 1 + (searches.chance * after.reshape(BATCH, 4, -1)).sum(axis=2)
        costs[searches.found < 0] = np.inf
        if before is not None:
            kept.append((torch.from_numpy(before), torch.from_numpy(costs.min(axis=1).astype(np.float32))))
            del kept[:-KEPT]
            for again in range(AGAIN):
                states, wanted = kept[-1] if again == 0 else kept[int(rng.integers(len(kept)))]
                loss = torch.nn.functional.mse_loss(_said(net, _mirrored(states, rng)), wanted)
                optimiser.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                optimiser.step()
            with torch.no_grad():
                for mine, its in zip(slow.parameters(), net.parameters(), strict=True):
                    mine.lerp_(its, 1 - POLYAK if iteration > 500 else 0.1)
        explore = EXPLORE + (LAST_EXPLORE - EXPLORE) * share
        wild = rng.random(BATCH) < explore
        random = np.where(searches.found < 0, np.inf, rng.random((BATCH, 4)))
        actions = np.where(wild, random.argmin(axis=1), costs.argmin(axis=1))
        before = _now(searches, searches.step(actions))
        if iteration % 500 == 499 or iteration + 1 == iterations:
            _write(slow, path)
            yield iteration + 1, float(loss.detach())


def _now(searches: Searches, inputs: NDArray[np.float32]) -> NDArray[np.float32]:
    """Inputs of the network at the beginning of the searches that have just begun, and as given elsewhere."""
    wide, high = searches.case.shape
    for b in np.flatnonzero(searches.steps == 0):
        inputs[b] = 0.0
        belief, (x, y) = searches.beliefs[b], searches.cells[b]
        grid = inputs[b, :-FEATURES].reshape(2 * wide - 1, 2 * high - 1)
        grid[wide - 1 - x : 2 * wide - 1 - x, high - 1 - y : 2 * high - 1 - y] = np.sqrt(belief)
        some = belief[belief > 0]
        entropy = -float(np.sum(some * np.log(some)))
        i, j = np.indices(searches.case.shape)
        far = float(np.sum(belief * (abs(i - x) + abs(j - y))))
        inputs[b, -FEATURES:] = far / 10, entropy / 5, math.exp(entropy) / 100
    return inputs


def _said(net: Any, inputs: "torch.Tensor") -> "torch.Tensor":
    """V of inputs (B, ·): (B,)."""
    import torch

    out: torch.Tensor = 10 * inputs[:, -FEATURES] + torch.nn.functional.softplus(net(inputs)[:, 0])
    return out


def _mirrored(inputs: "torch.Tensor", rng: np.random.Generator) -> "torch.Tensor":
    """The inputs of states (B, ·) under one of the square's symmetries."""
    import torch

    wide = 2 * CASE.shape[0] - 1
    grids = inputs[:, :-FEATURES].reshape(-1, wide, wide)
    symmetry = int(rng.integers(SYMMETRIES))
    flips = [axis for axis in (1, 2) if symmetry & axis]
    grids = torch.flip(grids, flips)
    grids = grids.transpose(1, 2) if symmetry & 4 else grids
    return torch.cat([grids.reshape(len(inputs), -1), inputs[:, -FEATURES:]], dim=1)


def _write(net: Any, path: Path) -> None:
    """Write a network, in half precision."""
    arrays = [array.detach().numpy().T.astype(np.float16) for array in net.parameters()]
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **dict(zip(Layers._fields, arrays, strict=True)))


def main() -> None:
    """Train the value function."""
    parser = cli.Parser(
        prog="python -m benchmarks.otto_value", description="Train the value policy of isotropic-19x19."
    )
    parser.add_argument(
        "--iterations",
        type=cli.whole(1, 10**6),
        default=ITERATIONS,
        metavar="N",
        help="(default: %(default)s)",
    )
    parser.add_argument("--out", type=Path, default=WEIGHTS, metavar="FILE", help="(default: %(default)s)")
    args = parser.parse_args()
    for iteration, loss in train(args.iterations, args.out):
        print(f"iteration {iteration:,}: mean squared error {loss:.2f}", flush=True)


if __name__ == "__main__":
    cli.run(main)
