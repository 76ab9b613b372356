"""A solver of gas in turbulent wind on a grid: a plume that owes nothing to the puffs of our worlds.

A layer of air of even gas from top to bottom: ∂c/∂t + ∇·(w c) = d ∇²c − c/τ + source, by finite volumes.
Van Leer's limiter keeps the fluxes from making gas negative, and Heun's method steps in time. The wind w is
its mean and the curl of a stream function: no air is made or lost in any cell. That is a sum of Fourier modes
which the mean wind carries, of the energy spectrum k^(−5/3), each an Ornstein–Uhlenbeck process that lives
about as long as an eddy of its size takes to turn over. `python -m benchmarks.recorded` films it.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from plume.compiled import kernel, subroutine
from plume.elementary import Array, direction, exp
from plume.randomness import keyed, standard_normal

WIND_MPS = 2.5  # its mean, to +x
DIFFUSIVITY = 0.5  # m²/s, of eddies smaller than the cells
LIFETIME_S = 10.0
RATE = 300.0  # of the source, g/s
# As thick as the mean plume of the middle of Table 1 is high 10 m downwind, √(4π · 4.5 · 10/2.5).
THICKNESS_M = 15.0
EDDIES_MPS = 1.2  # standard deviation of each component of the wind
LARGEST_M, SMALLEST_M = 40.0, 2.0  # wavelengths of the eddies
MODES = 64
TURNOVERS = 4.0  # correlation time of a mode, by 1/(k EDDIES_MPS)
STEP_S, CELL_M = 0.0125, 0.5


class Grid(NamedTuple):
    """The cells of a layer, and in which of them the source is."""

    cells: tuple[int, int] = (88, 80)  # along x and y
    source: tuple[int, int] = (16, 40)
    cell_m: float = CELL_M


class Ledger(NamedTuple):
    """What became of the gas so far, g."""

    released: float
    carried_out: float
    lost: float  # to the air, within LIFETIME_S or so


class Eddies:
    """The modes of the stream function."""

    def __init__(
        self, grid: Grid, seed: int, speed_mps: float = EDDIES_MPS, wind_mps: float = WIND_MPS
    ) -> None:
        """Draw the modes. speed_mps: standard deviation of each component.  wind_mps: that carries them."""
        self._seed, self._steps = seed, 0
        ratio = np.log(LARGEST_M / SMALLEST_M) * (np.arange(MODES) + 0.5) / MODES
        k = 2 * np.pi / LARGEST_M * exp(ratio)
        cosine, sine = direction(keyed(seed, "modes").random(MODES))
        self._k = np.stack([k * cosine, k * sine])
        # Energy k^(−5/3) dk, modes at even steps of log k. One of the amplitude A has the velocity A k.
        energy = exp(-2 / 3 * ratio)
        self._amplitudes = speed_mps * np.sqrt(2 * energy / energy.sum()) / k
        self._kept = exp(-STEP_S * k * max(speed_mps, 1e-9) / TURNOVERS)
        self._shift = direction(-wind_mps * STEP_S * self._k[0] / (2 * np.pi))
        corners = [self._k[axis, :, None] * grid.cell_m * np.arange(grid.cells[axis] + 1) for axis in (0, 1)]
        self._waves = [np.stack(direction(phases / (2 * np.pi))) for phases in corners]
        self._state = self._drawn()

    def _drawn(self) -> Array:
        """Draw (2, MODES) of N(0, 1), another for each step."""
        self._steps += 1
        return standard_normal(keyed(self._seed, "eddies", self._steps), 2 * MODES).reshape(2, MODES)

    def step(self) -> Array:
        """Return the stream function at the corners of the cells, (nx + 1, ny + 1) m²/s, one step later."""
        (cosine, sine), (real, imaginary) = self._shift, self._state
        carried = np.stack([real * cosine - imaginary * sine, real * sine + imaginary * cosine])
        self._state = self._kept * carried + np.sqrt(1 - self._kept**2) * self._drawn()
        return summed(self._amplitudes * self._state, *self._waves)


@kernel("float64[:, ::1](float64[:, ::1], float64[:, :, ::1], float64[:, :, ::1])")
def summed(amplitudes: Array, along_x: Array, along_y: Array) -> Array:
    """Return the real part of Σ amplitude e^(i kx x) e^(i ky y): of (2, M), (2, M, nx) and (2, M, ny)."""
    result = np.zeros((along_x.shape[2], along_y.shape[2]))
    for mode in range(amplitudes.shape[1]):
        a, b = amplitudes[0, mode], amplitudes[1, mode]
        for i in range(along_x.shape[2]):
            real = a * along_x[0, mode, i] - b * along_x[1, mode, i]
            imaginary = a * along_x[1, mode, i] + b * along_x[0, mode, i]
            for j in range(along_y.shape[2]):
                result[i, j] += real * along_y[0, mode, j] - imaginary * along_y[1, mode, j]
    return result


@subroutine
def _at_face(before: float, upwind: float, downwind: float) -> float:
    """Gas at a face, by the two cells upwind of it and the one downwind: van Leer's harmonic slope."""
    one, other = upwind - before, downwind - upwind
    return upwind + one * other / (one + other) if one * other > 0 else upwind


@subroutine
def _rates(gas: Array, wind: Array, cell_m: float, diffusivity: float, rates: Array) -> float:
    """Fill `rates` (nx, ny) with what flows into each cell, g/m³ a second; returns what leaves the grid.

    wind: (2, nx + 1, ny + 1), of the air through the lower face of a cell along each axis. What blows in
    is clean.
    """
    rates[:] = 0.0
    leaves = 0.0
    for axis in range(2):
        count, rows = gas.shape[axis], gas.shape[1 - axis]
        for row in range(rows):
            for face in range(count + 1):
                speed = wind[0, face, row] if axis == 0 else wind[1, row, face]
                flux = 0.0
                if 0 < face < count:
                    upwind, downwind = (face - 1, face) if speed > 0 else (face, face - 1)
                    before = min(max(2 * upwind - downwind, 0), count - 1)
                    if axis == 0:
                        far, near, next_one = gas[before, row], gas[upwind, row], gas[downwind, row]
                    else:
                        far, near, next_one = gas[row, before], gas[row, upwind], gas[row, downwind]
                    towards = 1.0 if speed > 0 else -1.0
                    flux = speed * _at_face(far, near, next_one)
                    flux += towards * diffusivity * (near - next_one) / cell_m
                elif (face == 0 and speed < 0) or (face == count and speed > 0):
                    edge = min(face, count - 1)
                    flux = speed * (gas[edge, row] if axis == 0 else gas[row, edge])
                    leaves += abs(flux) / cell_m
                flux /= cell_m
                if face > 0:
                    if axis == 0:
                        rates[face - 1, row] -= flux
                    else:
                        rates[row, face - 1] -= flux
                if face < count:
                    if axis == 0:
                        rates[face, row] += flux
                    else:
                        rates[row, face] += flux
    return leaves


@kernel("UniTuple(float64, 3)(float64[:, ::1], float64[:, ::1], float64[::1], int64, int64)")
def advance(
    gas: Array, stream: Array, numbers: Array, source_x: int, source_y: int
) -> tuple[float, float, float]:
    """Take the gas (nx, ny) one step on, by Heun's method.

    stream: (nx + 1, ny + 1) at the corners.  numbers: (6,) mean wind, diffusivity, lifetime, cell, step, and
    gas from the source a second.  Returns what left the grid and what was lost, summed over cells, and the
    greatest share of a cell's gas that the step could take: a gas at a face is at most twice that upwind.
    """
    mean_wind, diffusivity, lifetime, cell_m, step_s, released = numbers
    nx, ny = gas.shape
    wind = np.zeros((2, nx + 1, ny + 1))
    for i in range(nx + 1):
        for j in range(ny + 1):
            if j < ny:
                wind[0, i, j] = mean_wind + (stream[i, j + 1] - stream[i, j]) / cell_m
            if i < nx:
                wind[1, i, j] = -(stream[i + 1, j] - stream[i, j]) / cell_m
    most = leaves = lost = 0.0
    for i in range(nx):
        for j in range(ny):
            out = max(wind[0, i + 1, j], 0.0) + max(wind[1, i, j + 1], 0.0)
            most = max(most, out - min(wind[0, i, j], 0.0) - min(wind[1, i, j], 0.0))
    taken = step_s * (2 * most / cell_m + 4 * diffusivity / (cell_m * cell_m) + 1 / lifetime)
    begun, rates = gas.copy(), np.empty((nx, ny))
    for _ in range(2):
        leaves += 0.5 * step_s * _rates(gas, wind, cell_m, diffusivity, rates)
        for i in range(nx):
            for j in range(ny):
                decays = gas[i, j] / lifetime
                lost += 0.5 * step_s * decays
                gas[i, j] += step_s * (rates[i, j] - decays)
        gas[source_x, source_y] += step_s * released
    for i in range(nx):
        for j in range(ny):
            gas[i, j] = 0.5 * (begun[i, j] + gas[i, j])
    return leaves, lost, taken


def solved(
    grid: Grid,
    seed: int,
    *,
    eddies_mps: float = EDDIES_MPS,
    diffusivity: float = DIFFUSIVITY,
    wind_mps: float = WIND_MPS,
) -> Iterator[tuple[Array, Ledger]]:
    """Yield the gas (nx, ny), g/m³, and what became of it, after each step from clean air on.

    It is the same array each time. eddies_mps, diffusivity, wind_mps: instead of the usual ones.
    Raises ValueError if the wind is too fast for the step, so that gas could become negative.
    """
    eddies = Eddies(grid, seed, eddies_mps, wind_mps)
    volume = grid.cell_m * grid.cell_m * THICKNESS_M
    numbers = np.array([wind_mps, diffusivity, LIFETIME_S, grid.cell_m, STEP_S, RATE / volume])
    gas, ledger = np.zeros(grid.cells), Ledger(0.0, 0.0, 0.0)
    while True:
        leaves, lost, taken = advance(gas, eddies.step(), numbers, *grid.source)
        if taken > 1:
            raise ValueError(f"a step takes {taken:.2f} of the gas of a cell; wanted at most 1: less wind")
        released, carried_out, lost_so_far = ledger
        ledger = Ledger(
            math.fsum((released, STEP_S * RATE)), carried_out + leaves * volume, lost_so_far + lost * volume
        )
        yield gas, ledger
