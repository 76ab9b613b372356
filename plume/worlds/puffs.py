"""Gas in puffs, which the wind carries, eddies displace and diffusion widens.

As in Farrell et al. 2002 and the filaments of GADEN (Monroy et al. 2017), in closed form: a puff of age a has
the variance s² = size² + 2 share d a of its own in each direction, and stands sqrt(2 d a − s²) ξ from where
the wind has carried it, ξ ~ N(0, 1)³. Over many realisations its gas is then normal with variance 2 d a, and
the mean of all puffs is the paper's plume, whatever the share (but within `size` of the source).
"""

import math
from typing import Any

import numpy as np

from plume.elementary import Array, exp
from plume.randomness import derived_seed
from plume.scenario import Scenario
from plume.worlds.air import Air

STEP_S = 0.5  # the wind's deviations are constant so long
CELL_S = 1.0  # releases are drawn by cells of time
AHEAD = 64  # cells that are drawn at once
AT_ONCE = 1 << 16  # times of the grid for which the air is followed at once
LIFETIMES, OLDEST_S = 5.0, 600.0  # puffs are dropped at an age of so many lifetimes, and at this one
LIMITS = {
    "share": (0.0, 1.0),
    "rate": (0.1, 100.0),
    "size": (0.01, 10.0),
    "meander": (0.0, 90.0),
    "gusts": (0.0, 0.5),
    "wander": (1.0, 3600.0),
}


def puffs(
    scenario: Scenario,
    seed: int,
    *,
    share: float = 0.2,
    rate: float = 10.0,
    size: float = 0.1,
    meander: float = 0.0,
    gusts: float = 0.0,
    wander: float = 20.0,
) -> Air:
    """Gas in puffs, whose mean is the paper's plume; the wind may meander.

    share: of the diffusivity that widens a puff; the rest moves it whole. rate: puffs a second. size:
    standard deviation of a new puff, m. meander, gusts: standard deviations of the wind's direction, degrees,
    and of its speed, as a share; both are Ornstein–Uhlenbeck processes, alike for all puffs, with the
    correlation time `wander`, s. Raises ValueError on a number outside `LIMITS`.
    """
    given = within_limits(share=share, rate=rate, size=size, meander=meander, gusts=gusts, wander=wander)
    return Puffs(scenario, seed, **given)


def within_limits(**given: float) -> dict[str, float]:
    """Return the given parameters. Raises ValueError on one outside `LIMITS`."""
    for name, value in given.items():
        low, high = LIMITS[name]
        if not low <= value <= high:
            raise ValueError(f"{name} is {value:g}; wanted a number from {low:g} to {high:g}")
    return given


class Puffs:
    """The puffs of one mission: it keeps those that are in the air, and draws others when they are needed."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        *,
        share: float,
        rate: float,
        size: float,
        meander: float,
        gusts: float,
        wander: float,
    ) -> None:
        """Take the release and the world's parameters, as of `puffs`."""
        s = scenario
        self._seed = derived_seed(seed, "puffs")
        self._oldest_s = min(LIFETIMES * s.tau, OLDEST_S)
        self._expected = rate * CELL_S
        spread = 2.0 * s.d
        self._release = np.array(
            [*s.source, s.height, s.q / rate, s.tau, self._oldest_s, size * size, share * spread, spread]
        )
        kept = float(exp(-STEP_S / wander))
        self._wind = np.array([s.u, s.phi, math.radians(meander), gusts, kept, STEP_S])
        self._start = -math.ceil((self._oldest_s + 2 * CELL_S) / STEP_S)  # of the path, in steps of the grid
        self._forget()

    def _forget(self) -> None:
        self._path, self._path_first = np.empty((6, 0)), self._start
        self._puffs, self._cells = np.empty((6, 0)), range(0)

    def __call__(self, places: Array, times_s: Array) -> tuple[Array, Array]:
        """Return gas and wind, as of `Air`."""
        gas, winds = np.empty(len(places)), np.empty((len(places), 2))
        for at_s in dict.fromkeys(times_s.tolist()):
            those = times_s == at_s
            gas[those], winds[those] = self._at(places[those], at_s)
        return gas, winds

    def _at(self, places: Array, time_s: float) -> tuple[Array, Any]:
        """Return the gas at places (M, 3), and the wind (2,), at one time."""
        from plume.worlds.puff_kernels import DX, DY, WIND_X, WIND_Y, gas_at

        self._draw(time_s)
        cell = math.floor(time_s / STEP_S)
        wind, air = (self._path[rows, cell - self._path_first] for rows in ([WIND_X, WIND_Y], [DX, DY]))
        air = air - (time_s - cell * STEP_S) * wind
        return gas_at(np.ascontiguousarray(places), time_s, self._puffs, air, self._release), wind

    def _draw(self, time_s: float) -> None:
        """Draw what is in the air at a time, and what follows; forget what is too old."""
        from plume.worlds.puff_kernels import releases

        first, last = math.floor((time_s - self._oldest_s) / CELL_S), math.floor(time_s / CELL_S) + 1
        if first < self._cells.start:
            self._forget()
        if last <= self._cells.stop and self._cells:
            return
        begin = self._cells.stop if first in self._cells else first
        end = last + AHEAD
        self._blow(math.floor(first * CELL_S / STEP_S), math.ceil(end * CELL_S / STEP_S) + 1)
        new = releases(
            self._seed,
            begin,
            end - begin,
            CELL_S,
            self._expected,
            self._path,
            self._path_first,
            STEP_S,
        )
        old = self._puffs[:, self._puffs[0] >= first * CELL_S]
        self._puffs, self._cells = np.ascontiguousarray(np.hstack([old, new])), range(first, end)

    def _blow(self, first: int, last: int) -> None:
        """Follow the air up to the time `last` of the grid; forget its path before the time `first`."""
        from plume.worlds.puff_kernels import path_of

        while (there := self._path_first + self._path.shape[1]) < last:
            before = np.ascontiguousarray(self._path[:, -1]) if self._path.size else np.empty(0)
            path = path_of(self._seed, there, min(last - there, AT_ONCE), before, self._wind)
            keep = min(max(first - self._path_first, 0), self._path.shape[1])
            self._path = np.ascontiguousarray(np.hstack([self._path[:, keep:], path]))
            self._path_first += keep
