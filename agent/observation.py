"""The observations of learned policies, by schema: one arithmetic for the env, many missions and flight.

`paper` (version 1, 5 numbers, in the world's frame): position (x, y), reading and estimate (x, y), as in
the paper.

`polar` (version 1): the belief as seen from the vehicle. The x axis of its frame points to the estimate.
The frame is mirrored if the wind would otherwise come from the right. Beliefs that differ only by a
rotation or a mirror thus look alike. The numbers are, in order:
- the belief's mass in 16 sectors of 8 rings, as 2 √mass;
- the information gain of a reading 2 and 5 m ahead in each of 16 headings, ½ log(1 + Var g(m)). g(m) =
  asinh(α m/β)/α transforms
  the concentrations expected there by the particles into values with noise of standard deviation 1;
- distance of the estimate, spread and covariance; wind and plume; place in the area, and direction of the
  frame.

The policy has its own prior. In training, sources are drawn from the square of Table 1, so particles
outside it get a twentieth of their weight; in another problem the square is where its estimator expects
them. The observation also contains the estimator's own spread, since that decides the stop.

`polar-2` (version 2 of `polar`): without units and without a prior of its own, for any area, step and prior
(`agent.scale_free`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent import scale_free
from agent.facts import (
    DIFFUSIVITY,
    GAS,
    LIFETIME,
    MEAN_X,
    MEAN_Y,
    RATE,
    ROWS,
    WIND_X,
    WIND_Y,
    XX,
    YY,
    X,
    Y,
    site_of,
)
from agent.scale_free import BOUND, COSINES, FEW, HEADINGS, SECTORS, SINES, sector_of
from link.bus.messages import Belief, Particles
from plume.compiled import kernel, subroutine
from plume.dispersion import SOURCE_RADIUS_M
from plume.elementary import Array, Indices
from plume.numerics import exp, log, log1p, total_of
from plume.problem import PAPER, Problem
from plume.sensors.names import GAUSSIAN

Observation = NDArray[np.float32]
# (3,): the observation's x axis in the world, (x, y); 1, or −1 if its y axis is mirrored. The axis has length
# 1, in `polar-2` the length of a move, m.
Frame = Array

RINGS_M = np.array([1.5, 3.0, 5.0, 8.0, 11.5, 15.5, 20.0])  # radii between the rings, m
CELLS = SECTORS * (len(RINGS_M) + 1)
AHEAD_M = np.array([2.0, 5.0])
OUTSIDE = 0.05  # factor on the weights of particles outside the square in which sources are drawn
NUMBERS = 24  # numbers of a polar observation after the cells and the headings
POLAR_SIZE = CELLS + HEADINGS * len(AHEAD_M) + NUMBERS
PAPER_SIZE = 5
STEEPNESS = GAUSSIAN.sensor_noise / GAUSSIAN.environment_noise  # α/β
INVERSE_NOISE_SQUARED = 1 / (GAUSSIAN.sensor_noise * GAUSSIAN.sensor_noise)  # 1/α²


@subroutine
def _frame(
    x: Array, y: Array, weights: Array, facts: Array, site: Array, frame: Frame
) -> tuple[float, float, float, float, float]:
    """Multiply the weights by the policy's prior, normalise them, and fill `frame`.

    Returns the mass inside the square in which sources are drawn (before the prior), the estimate's
    distance, the spread, and the elements xx and xy of the covariance in the frame as shares of the
    squared spread.
    """
    inside, total, mean_x, mean_y = 0.0, 0.0, 0.0, 0.0
    for i in range(len(x)):
        drawn = site[4] <= x[i] <= site[6] and site[5] <= y[i] <= site[7]
        total += weights[i]
        inside += weights[i] if drawn else 0.0
        weights[i] *= 1.0 if drawn else OUTSIDE
    inside /= total
    total *= inside + OUTSIDE * (1 - inside)
    for i in range(len(x)):
        weights[i] /= total
        mean_x += weights[i] * x[i]
        mean_y += weights[i] * y[i]
    xx, xy, yy = 0.0, 0.0, 0.0
    for i in range(len(x)):
        dx, dy = x[i] - mean_x, y[i] - mean_y
        xx += weights[i] * dx * dx
        xy += weights[i] * dx * dy
        yy += weights[i] * dy * dy
    dx, dy = mean_x - facts[X], mean_y - facts[Y]
    off = math.sqrt(dx * dx + dy * dy)
    c, s = (dx / off, dy / off) if off > 1e-6 else (1.0, 0.0)
    mirror = 1.0 if c * facts[WIND_Y] - s * facts[WIND_X] >= 0 else -1.0
    frame[0], frame[1], frame[2] = c, s, mirror
    square = max(xx + yy, 1e-12)
    along = (c * c * xx + 2 * c * s * xy + s * s * yy) / square
    across = mirror * ((c * c - s * s) * xy + c * s * (yy - xx)) / square
    return inside, off, math.sqrt(square), along, across


@subroutine
def _fill_cells(x: Array, y: Array, weights: Array, facts: Array, frame: Frame, result: Observation) -> None:
    """Fill `result` (CELLS,) with 2 √mass of each sector, ring after ring.

    The first sector is centred on the frame's x axis.
    """
    c, s, mirror = frame
    squares = RINGS_M * RINGS_M
    mass = np.zeros(CELLS)
    for i in range(len(x)):
        dx, dy = x[i] - facts[X], y[i] - facts[Y]
        along, across = dx * c + dy * s, mirror * (dy * c - dx * s)
        square = along * along + across * across
        ring = 0
        for edge in squares:
            ring += square > edge
        mass[ring * SECTORS + sector_of(along, across)] += weights[i]
    for cell in range(CELLS):
        result[cell] = 2 * math.sqrt(mass[cell])


@subroutine
def _fill_gains(
    x: Array, y: Array, weights: Array, facts: Array, site: Array, frame: Frame, result: Observation
) -> None:
    """Fill `result` with the approximate information gain of a reading, nats, by AHEAD_M and heading."""
    few_x, few_y = np.empty(FEW), np.empty(FEW)
    last, mass = 0, weights[0]
    for k in range(FEW):
        while mass <= (k + 0.5) / FEW and last < len(x) - 1:
            last += 1
            mass += weights[last]
        few_x[k], few_y[k] = x[last], y[last]
    c, s, mirror = frame
    diffusivity, wind_x, wind_y = facts[DIFFUSIVITY], facts[WIND_X], facts[WIND_Y]
    decay = math.sqrt(
        1 / (diffusivity * facts[LIFETIME])
        + (wind_x * wind_x + wind_y * wind_y) / (4 * diffusivity * diffusivity)
    )
    scale = STEEPNESS * facts[RATE] / (4 * math.pi * diffusivity)
    drift_x, drift_y = wind_x / (2 * diffusivity), wind_y / (2 * diffusivity)
    steady = np.empty(FEW)
    for ahead in range(len(AHEAD_M)):
        for heading in range(HEADINGS):
            along, across = AHEAD_M[ahead] * COSINES[heading], AHEAD_M[ahead] * mirror * SINES[heading]
            there_x = min(max(facts[X] + c * along - s * across, site[0]), site[2])
            there_y = min(max(facts[Y] + s * along + c * across, site[1]), site[3])
            for k in range(FEW):
                dx, dy = there_x - few_x[k], there_y - few_y[k]
                distance = max(math.sqrt(dx * dx + dy * dy), SOURCE_RADIUS_M)
                m = scale / distance * exp(-distance * decay - (dx * drift_x + dy * drift_y))
                steady[k] = log(m + math.sqrt(m * m + 1))
            mean = total_of(steady) / FEW
            for k in range(FEW):
                steady[k] = (steady[k] - mean) * (steady[k] - mean)
            variance = total_of(steady) / FEW
            result[ahead * HEADINGS + heading] = 0.5 * log(1 + variance * INVERSE_NOISE_SQUARED)


SEE_ALONE = (
    "void(float64[::1], float64[::1], float64[::1], float64[::1], float64[::1], float64[::1], float32[::1])"
)
SEE_MISSIONS = (
    "void(float64[:, :, ::1], float64[:, ::1], float64[::1], int64[::1], float64[:, ::1], float64[:, ::1], "
    "int64[::1], float64[:, ::1], float32[:, ::1])"
)


@kernel(SEE_ALONE, error_model="numpy")
def _paper(
    _x: Array, _y: Array, _weights: Array, facts: Array, site: Array, frame: Frame, result: Observation
) -> None:
    """Fill `frame` and `result` (PAPER_SIZE,).

    Places are shares of the area's extent, and the reading z is sign(z) log(1 + |z|).
    """
    frame[0], frame[1], frame[2] = 1.0, 0.0, 1.0
    gas = facts[GAS]
    numbers = (
        (facts[X] - site[0]) / (site[2] - site[0]),
        (facts[Y] - site[1]) / (site[3] - site[1]),
        math.copysign(log1p(abs(gas)), gas),
        (facts[MEAN_X] - site[0]) / (site[2] - site[0]),
        (facts[MEAN_Y] - site[1]) / (site[3] - site[1]),
    )
    for k in range(PAPER_SIZE):
        result[k] = min(max(numbers[k], -BOUND), BOUND)


@kernel(SEE_ALONE, error_model="numpy")
def _polar(
    x: Array, y: Array, weights: Array, facts: Array, site: Array, frame: Frame, result: Observation
) -> None:
    """Fill `frame` and `result` (POLAR_SIZE,) from particles (N,), whose weights change, and facts (13,)."""
    inside, off, spread, xx, xy = _frame(x, y, weights, facts, site, frame)
    _fill_cells(x, y, weights, facts, frame, result[:CELLS])
    _fill_gains(x, y, weights, facts, site, frame, result[CELLS : POLAR_SIZE - NUMBERS])
    px, py = facts[X], facts[Y]
    c, s, mirror = frame
    speed = math.sqrt(facts[WIND_X] * facts[WIND_X] + facts[WIND_Y] * facts[WIND_Y])
    diffusivity = facts[DIFFUSIVITY]
    wind_x, wind_y = c * facts[WIND_X] + s * facts[WIND_Y], mirror * (c * facts[WIND_Y] - s * facts[WIND_X])
    length = 1 / math.sqrt(
        1 / (diffusivity * facts[LIFETIME]) + speed * speed / (4 * diffusivity * diffusivity)
    )
    said = math.sqrt(facts[XX] + facts[YY])
    to_x, to_y = 0.5 * (site[4] + site[6]) - px, 0.5 * (site[5] + site[7]) - py
    east, north = (px - site[0]) / (site[2] - site[0]), (py - site[1]) / (site[3] - site[1])
    # Mirroring at the diagonal maps the area onto itself, so a mirrored frame becomes a plain one if x and y
    # are swapped.
    plain = mirror > 0
    numbers = (
        off / 15,
        log(off + 0.1) / 3,
        log(said + 0.05) / 3,
        said / 8,
        log(spread + 0.05) / 3,
        spread / 8,
        2 * xx - 1,
        2 * xy,
        wind_x / 4,
        wind_y / 4,
        wind_x / max(speed, 1e-9),
        wind_y / max(speed, 1e-9),
        speed / (2 * diffusivity),
        log(diffusivity) / 2,
        length / 10,
        log(length),
        log(facts[RATE] / (4 * math.pi * diffusivity)) / 3,
        (c * to_x + s * to_y) / 15,
        mirror * (c * to_y - s * to_x) / 15,
        c if plain else s,
        s if plain else c,
        east if plain else north,
        north if plain else east,
        log(inside + 1e-3) / 3,
    )
    for k in range(NUMBERS):
        result[POLAR_SIZE - NUMBERS + k] = min(max(numbers[k], -BOUND), BOUND)


@kernel(SEE_MISSIONS, nogil=True)
def _paper_of_missions(
    _particles: Array,
    _weights: Array,
    _totals: Array,
    _rows: Indices,
    facts: Array,
    sites: Array,
    missions: Indices,
    frames: Array,
    results: NDArray[np.float32],
) -> None:
    nothing = np.empty(0)
    for b in missions:
        _paper(nothing, nothing, nothing, facts[b], sites[b], frames[b], results[b])


@kernel(SEE_MISSIONS, nogil=True)
def _polar_of_missions(
    particles: Array,
    weights: Array,
    totals: Array,
    _rows: Indices,
    facts: Array,
    sites: Array,
    missions: Indices,
    frames: Array,
    results: NDArray[np.float32],
) -> None:
    rows = np.empty((3, particles.shape[2]))
    x, y, sent = rows[0], rows[1], rows[2]  # unpacked, numba would not know them for contiguous
    for b in missions:
        for i in range(len(x)):  # float32 values, as on the wire
            x[i], y[i] = np.float32(particles[b, 0, i]), np.float32(particles[b, 1, i])
            sent[i] = np.float32(weights[b, i] / totals[b])
        _polar(x, y, sent, facts[b], sites[b], frames[b], results[b])


@dataclass(frozen=True)
class Schema:
    """An observation of a belief. Any change of its numbers needs a new version."""

    version: int
    size: int  # numbers in an observation
    anywhere: bool  # whether a policy that sees it may fly in any problem, not only in that of its training
    # Fills the last two arguments for the given missions: (particles (B, D, N), x and y in the first rows,
    # weights (B, N), their sums (B,), rows of ROWS (7,), facts (B, 13), sites (B, 9), missions (M,), frames
    # (B, 3), observations (B, size)).
    see_missions: Callable[
        [Array, Array, Array, Indices, Array, Array, Indices, Array, NDArray[np.float32]], None
    ]

    def see(
        self, belief: Belief, particles: Particles, problem: Problem = PAPER
    ) -> tuple[Observation, Frame]:
        """Return the observation of a belief, (size,), and its frame, in which actions are meant too.

        problem: that the policy is trained for.
        """
        return self.look(belief, particles, site_of(problem))

    def look(self, belief: Belief, particles: Particles, site: Array) -> tuple[Observation, Frame]:
        """Do the same at a site, (9,), as of `agent.facts.site_of`."""
        rows = np.array(particles.T, np.float64, order="C")
        columns, weights = dict(zip(belief.unknowns, rows, strict=False)), rows[-1]
        place = [
            columns.pop(name, np.full(len(weights), known))
            for name, known in zip("xy", belief.mean, strict=True)
        ]
        facts = (
            *belief.position,
            belief.gas,
            *belief.mean,
            *belief.covariance,
            *belief.wind,
            belief.rate,
            belief.diffusivity,
            belief.lifetime,
        )
        frame, result = np.empty((1, 3)), np.empty((1, self.size), np.float32)
        values = np.array([[*place, *columns.values()]])
        self.see_missions(
            values,
            weights[None],
            np.ones(1),
            rows_of(("x", "y", *columns)),
            np.array([facts]),
            site[None],
            np.zeros(1, np.int64),
            frame,
            result,
        )
        return result[0], frame[0]


def rows_of(unknowns: Sequence[str]) -> Indices:
    """Return the rows of ROWS among those of the unknowns, (7,); −1 for what is known."""
    return np.array([unknowns.index(name) if name in unknowns else -1 for name in ROWS], np.int64)


SCHEMAS: Mapping[str, Schema] = {
    "paper": Schema(1, PAPER_SIZE, False, _paper_of_missions),
    "polar": Schema(1, POLAR_SIZE, False, _polar_of_missions),
    "polar-2": Schema(2, scale_free.SIZE, True, scale_free.see_missions),
}
