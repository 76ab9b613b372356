"""Gas in puffs among buildings: the wind flows around them, and puffs slide along their walls.

A puff of age a has the variance s² = size² + 2 share d a of its own. The wind carries it, and eddies move it
by steps that add up to sqrt(2 d a − s²) ξ, ξ ~ N(0, 1)³, of which a wall or a roof reflects what would go
through. A place has the gas of the puffs whose centres can be seen from it, as with the filaments of GADEN
(Monroy et al. 2017). Without buildings the mean over realisations is the paper's plume.
"""

import math

import numpy as np

from plume.elementary import Array
from plume.randomness import derived_seed
from plume.scenario import NoRelease, Scenario
from plume.walls.buildings import Buildings
from plume.walls.cells import CELL_M, FREE, Cells
from plume.walls.flow import flow_around
from plume.walls.puff_kernels import CELL_S, STEP_S, TIME, advance, gas_at, in_the_air, releases, wind_at
from plume.worlds.puffs import LIFETIMES, OLDEST_S

AHEAD = 5  # cells of time that are drawn at once
STEPS = round(AHEAD * CELL_S / STEP_S)  # times of the grid in them
KEPT = 64  # earlier states that are kept for whoever asks again


class Walled:
    """The air of one mission: it keeps the puffs as they are at one time, and follows them when asked."""

    def __init__(
        self, scenario: Scenario, seed: int, buildings: Buildings, *, share: float, rate: float, size: float
    ) -> None:
        """Take the release and the world's parameters, as of `walls`."""
        s = scenario
        cells, flow = flow_around(buildings)
        _check_source(s, cells)
        self._around = cells.tops, flow, cells.levels, _frame(s, cells)
        self._seed = derived_seed(seed, "puffs")
        self._expected = rate * CELL_S
        oldest_s, spread = min(LIFETIMES * s.tau, OLDEST_S), 2.0 * s.d
        self._release = np.array(
            [*s.source, s.height, s.q / rate, s.tau, oldest_s, size * size, share * spread, spread]
        )
        # Whole states of the puffs at the beginning of stretches of AHEAD cells, with all that leave in them.
        self._kept: dict[int, Array] = {}
        self._first = -math.ceil(oldest_s / (AHEAD * CELL_S))  # stretch of the first releases
        self._start_at(self._first)

    def __call__(self, places: Array, times_s: Array) -> tuple[Array, Array]:
        """Return gas and wind, as of `plume.worlds.air.Air`."""
        places = np.ascontiguousarray(places)
        gas = np.empty(len(places))
        tops, _, _, frame = self._around
        for at_s in sorted(set(times_s.tolist())):
            those = times_s == at_s
            gas[those] = gas_at(places[those], self.puffs(at_s), tops, frame)
        return gas, wind_at(places, *self._around)

    def puffs(self, time_s: float) -> Array:
        """Return the puffs in the air (5, P): x, y, z of their centres, m, variance, m², and mass, g."""
        step = math.floor(time_s / STEP_S)
        stretch = step // STEPS
        if stretch < self._stretch or (stretch == self._stretch and step < self._step):
            self._go_back(stretch)
        if self._stretch < stretch + self._first:  # nothing that is in the air now will be then
            self._start_at(stretch + self._first)
        while self._stretch < stretch:
            self._advance((self._stretch + 1) * STEPS)
            self._begin(self._stretch + 1)
        self._advance(step)
        return in_the_air(self._puffs, step, time_s, self._release, *self._around)

    def _start_at(self, stretch: int) -> None:
        """Start with empty air: states are whole, and kept, once all that left before has been dropped."""
        self._step, self._puffs, self._whole = stretch * STEPS, np.empty((7, 0)), stretch - self._first
        self._begin(stretch)

    def _advance(self, step: int) -> None:
        if step > self._step:
            advance(self._puffs, self._step, step, self._release, *self._around)
            self._step = step

    def _begin(self, stretch: int) -> None:
        """Drop what is too old at the beginning of a stretch, draw what leaves in it, and keep the state."""
        oldest_s = self._release[5]
        young = self._puffs[:, self._puffs[TIME] >= stretch * AHEAD * CELL_S - oldest_s]
        new = releases(self._seed, stretch * AHEAD, AHEAD, self._expected, self._release)
        self._puffs, self._stretch = np.ascontiguousarray(np.hstack([young, new])), stretch
        if stretch < self._whole:
            return
        if len(self._kept) == KEPT:
            del self._kept[min(self._kept)]
        self._kept[stretch] = self._puffs.copy()

    def _go_back(self, stretch: int) -> None:
        """Go back to the last state that is kept from the beginning of a stretch or before it, or to none."""
        earlier = [each for each in self._kept if each <= stretch]
        if not earlier:
            self._start_at(stretch + self._first)
            return
        self._stretch = max(earlier)
        self._step, self._puffs = self._stretch * STEPS, self._kept[self._stretch].copy()


def _check_source(s: Scenario, cells: Cells) -> None:
    i, j = (math.floor((at - edge) / CELL_M) for at, edge in zip(s.source, cells[:2], strict=True))
    nx, ny = cells.tops.shape
    if 0 <= i < nx and 0 <= j < ny and s.height < cells.tops[i, j]:
        x, y = s.source
        raise NoRelease(f"the source ({x:g}, {y:g}) is inside a building; wanted one in the open")


def _frame(s: Scenario, cells: Cells) -> Array:
    """Return the frame of `plume.walls.motion`: edges, the air's velocity, the box around all buildings."""
    built = np.argwhere(cells.tops > FREE)
    corner = np.array([cells.west, cells.south])
    if len(built):
        low, high = corner + built.min(axis=0) * CELL_M, corner + (built.max(axis=0) + 1) * CELL_M
        box = [*low, *high, cells.levels[-1]]
    else:
        box = [0.0, 0.0, 0.0, 0.0, FREE]
    return np.array([*corner, -s.wind[0], -s.wind[1], *box])
