"""Observation `polar`, version 2: a belief without units of length, time or mass, and without its own prior.

It knows of the problem what the belief says, the area's sides and the step. The frame's x axis points to the
estimate and is as long as a move. The frame is mirrored if the wind would otherwise come from the right.
Lengths are in units of a thirtieth of the area's side, or of 4 spreads if they are shorter, so that the last
metres of a search in a wide field look like those of one in a small field. The numbers are, in order:
- the belief's mass in 16 sectors of 8 rings, as 2 √mass;
- the information gain of a reading 2 and 5 units ahead in each of 16 headings, ½ log(1 + Var g(m)), as in
  version 1, but with each particle's own release rate, lifetime and wind, and the expected noise;
- how much nearer the source is expected 2 units ahead in each heading, in units;
- how far it is to the area's edge in each heading, t/(t + 5) of t units;
- distance of the estimate and of the source, spread and covariance; wind and plume; the move, the area's
  extent, the mass outside it, and the noise.
"""

import math

import numpy as np
from numpy.typing import NDArray

from agent.facts import DIFFUSIVITY, LIFETIME, MEAN_X, MEAN_Y, RATE, WIND_X, WIND_Y, XX, XY, YY, X, Y
from plume.compiled import kernel, subroutine
from plume.elementary import Array, Indices, direction
from plume.numerics import cosine_and_sine, exp, log, total_of
from plume.sensors.names import GAUSSIAN

SECTORS = 16
RINGS = np.array([1.5, 3.0, 5.0, 8.0, 11.5, 15.5, 20.0])  # radii between the rings, in units
CELLS = SECTORS * (len(RINGS) + 1)
AHEAD = np.array([2.0, 5.0])  # units
HEADINGS = 16
NEAREST = 0.1  # least distance of a reading from a source, in units: as `SOURCE_RADIUS_M` in Table 1's area
FEW = 128  # number of particles for the information gains, drawn by systematic resampling
NUMBERS = 18
GAINS = CELLS + HEADINGS * len(AHEAD)
SIZE = GAINS + 2 * HEADINGS + NUMBERS
# Numbers computed from FACTS are clipped to ±BOUND; only worlds unlike any in training exceed it.
BOUND = 10.0
# Parts of the area's side, as of `Shared.fitted`. The first is also the unit of length.
FINE, FINEST = 1 / 30, 1 / 300
SENSOR_NOISE, FLOOR = GAUSSIAN.sensor_noise, GAUSSIAN.environment_noise
TANGENTS = np.divide(*reversed(direction(np.array([1, 3, 5, 7]) / 32)))
COSINES, SINES = direction(np.arange(HEADINGS) / HEADINGS)
RADIANS = math.pi / 180
TO_Q, TO_D, TO_TAU, TO_DIRECTION, TO_SPEED, TO_NOISE, TO_CV = range(7)  # `agent.facts.ROWS`


@subroutine
def sector_of(along: float, across: float) -> int:
    """Return the sector of a place, found without an arc tangent: within a quadrant, then the quadrant."""
    wide, high = abs(along), abs(across)
    sector = 0
    for tangent in TANGENTS:
        sector += high > tangent * wide
    sector = sector if along >= 0 else SECTORS // 2 - sector
    return sector if across >= 0 else (SECTORS - sector) % SECTORS


@subroutine
def _see(
    particles: Array,
    sent: Array,
    rows: Indices,
    facts: Array,
    site: Array,
    few: Array,
    frame: Array,
    result: NDArray[np.float32],
) -> None:
    """Fill `frame` and `result` (SIZE,).

    particles: (D, N), as float32 values are read of it.  sent: (N,) their weights as on the wire.  rows: (7,)
    of ROWS, −1 for what is known.  few: (8, FEW), a buffer.
    """
    count = particles.shape[1]
    px, py = facts[X], facts[Y]
    width, height = site[2] - site[0], site[3] - site[1]
    side = math.sqrt(width * height)
    spread = math.sqrt(facts[XX] + facts[YY])
    unit = min(max(4 * spread, side * FINEST), side * FINE)
    longest = max(spread / 4, unit)
    step = longest if spread > 0 and longest < site[8] else site[8]

    dx, dy = facts[MEAN_X] - px, facts[MEAN_Y] - py
    off = math.sqrt(dx * dx + dy * dy)
    c, s = (dx / off, dy / off) if off > 1e-6 * unit else (1.0, 0.0)
    mirror = 1.0 if c * facts[WIND_Y] - s * facts[WIND_X] >= 0 else -1.0
    frame[0], frame[1], frame[2] = step * c, step * s, mirror

    # The belief's mass by cells, and the mass beyond the area.
    mass = np.zeros(CELLS)
    total, outside = 0.0, 0.0
    for i in range(count):
        x, y, weight = float(np.float32(particles[0, i])), float(np.float32(particles[1, i])), sent[i]
        total += weight
        if not (site[0] <= x <= site[2] and site[1] <= y <= site[3]):
            outside += weight
        dx, dy = (x - px) / unit, (y - py) / unit
        along, across = dx * c + dy * s, mirror * (dy * c - dx * s)
        square = along * along + across * across
        ring = 0
        for edge in RINGS:
            ring += square > edge * edge
        mass[ring * SECTORS + sector_of(along, across)] += weight
    for cell in range(CELLS):
        result[cell] = 2 * math.sqrt(mass[cell] / total)

    # A few particles: place, and all that the concentration takes of each.
    last, reached, noise, cv = 0, sent[0], 0.0, 0.0
    for k in range(FEW):
        while reached <= (k + 0.5) / FEW * total and last < count - 1:
            last += 1
            reached += sent[last]
        few[0, k], few[1, k] = np.float32(particles[0, last]), np.float32(particles[1, last])
        rate, diffusivity, lifetime = facts[RATE], facts[DIFFUSIVITY], facts[LIFETIME]
        wind_x, wind_y = facts[WIND_X], facts[WIND_Y]
        if rows[TO_Q] >= 0:
            rate = float(np.float32(particles[rows[TO_Q], last]))
        if rows[TO_D] >= 0:
            diffusivity = float(np.float32(particles[rows[TO_D], last]))
        if rows[TO_TAU] >= 0:
            lifetime = float(np.float32(particles[rows[TO_TAU], last]))
        if rows[TO_DIRECTION] >= 0:
            turn_c, turn_s = cosine_and_sine(RADIANS * float(np.float32(particles[rows[TO_DIRECTION], last])))
            wind_x, wind_y = turn_c * wind_x - turn_s * wind_y, turn_s * wind_x + turn_c * wind_y
        if rows[TO_SPEED] >= 0:
            faster = float(np.float32(particles[rows[TO_SPEED], last]))
            wind_x, wind_y = faster * wind_x, faster * wind_y
        factor = float(np.float32(particles[rows[TO_NOISE], last])) if rows[TO_NOISE] >= 0 else 1.0
        noise += factor / FEW
        if rows[TO_CV] >= 0:
            cv += float(np.float32(particles[rows[TO_CV], last])) / FEW
        few[2, k] = rate / (4 * math.pi * diffusivity)
        few[3, k] = math.sqrt(
            1 / (diffusivity * lifetime)
            + (wind_x * wind_x + wind_y * wind_y) / (4 * diffusivity * diffusivity)
        )
        few[4, k], few[5, k] = wind_x / (2 * diffusivity), wind_y / (2 * diffusivity)
    slope = math.sqrt(noise * noise * SENSOR_NOISE * SENSOR_NOISE + cv * cv)
    steepness, inverse_square = slope / (noise * FLOOR), 1 / (slope * slope)
    here = 0.0
    for k in range(FEW):
        dx, dy = px - few[0, k], py - few[1, k]
        here += math.sqrt(dx * dx + dy * dy) / FEW

    # Readings ahead: what they tell, and how much nearer the source is there.
    for ahead in range(len(AHEAD)):
        for heading in range(HEADINGS):
            along = unit * AHEAD[ahead] * COSINES[heading]
            across = unit * AHEAD[ahead] * mirror * SINES[heading]
            there_x = min(max(px + c * along - s * across, site[0]), site[2])
            there_y = min(max(py + s * along + c * across, site[1]), site[3])
            for k in range(FEW):
                dx, dy = there_x - few[0, k], there_y - few[1, k]
                distance = math.sqrt(dx * dx + dy * dy)
                few[7, k] = distance
                distance = max(distance, NEAREST * unit)
                m = (
                    steepness
                    * few[2, k]
                    / distance
                    * exp(-distance * few[3, k] - (dx * few[4, k] + dy * few[5, k]))
                )
                few[6, k] = log(m + math.sqrt(m * m + 1))
            mean = total_of(few[6]) / FEW
            for k in range(FEW):
                few[6, k] = (few[6, k] - mean) * (few[6, k] - mean)
            variance = total_of(few[6]) / FEW
            result[CELLS + ahead * HEADINGS + heading] = 0.5 * log(1 + variance * inverse_square)
            if ahead == 0:
                result[GAINS + heading] = (here - total_of(few[7]) / FEW) / unit

    # The way to the edge in each heading.
    for heading in range(HEADINGS):
        towards_x = c * COSINES[heading] - s * mirror * SINES[heading]
        towards_y = s * COSINES[heading] + c * mirror * SINES[heading]
        way = 1e6 * unit
        if abs(towards_x) > 1e-9:
            way = min(way, ((site[2] if towards_x > 0 else site[0]) - px) / towards_x)
        if abs(towards_y) > 1e-9:
            way = min(way, ((site[3] if towards_y > 0 else site[1]) - py) / towards_y)
        way = max(way / unit, 0.0)
        result[GAINS + HEADINGS + heading] = way / (way + 5)

    speed = math.sqrt(facts[WIND_X] * facts[WIND_X] + facts[WIND_Y] * facts[WIND_Y])
    diffusivity = facts[DIFFUSIVITY]
    length = 1 / math.sqrt(
        1 / (diffusivity * facts[LIFETIME]) + speed * speed / (4 * diffusivity * diffusivity)
    )
    square = max(facts[XX] + facts[YY], 1e-12 * unit * unit)
    numbers = (
        off / unit / 15,
        log(off / unit + 0.1) / 3,
        log(here / unit + 0.1) / 3,
        log(spread / unit + 0.05) / 3,
        spread / unit / 8,
        2 * (c * c * facts[XX] + 2 * c * s * facts[XY] + s * s * facts[YY]) / square - 1,
        2 * mirror * ((c * c - s * s) * facts[XY] + c * s * (facts[YY] - facts[XX])) / square,
        (c * facts[WIND_X] + s * facts[WIND_Y]) / speed if speed > 0 else 0.0,
        mirror * (c * facts[WIND_Y] - s * facts[WIND_X]) / speed if speed > 0 else 0.0,
        speed * unit / (2 * diffusivity),
        length / unit / 10,
        log(length / unit),
        log(facts[RATE] / (4 * math.pi * diffusivity * unit)) / 3,
        log(step / unit),
        log(side / unit) - 3.4,
        max(width, height) / side - 1,
        2 * math.sqrt(outside / total),
        log(slope / SENSOR_NOISE),
    )
    for k in range(NUMBERS):
        result[SIZE - NUMBERS + k] = min(max(numbers[k], -BOUND), BOUND)
    for k in range(SIZE - NUMBERS):
        result[k] = min(max(result[k], np.float32(-BOUND)), np.float32(BOUND))


@kernel(
    "void(float64[:, :, ::1], float64[:, ::1], float64[::1], int64[::1], float64[:, ::1], float64[:, ::1], "
    "int64[::1], float64[:, ::1], float32[:, ::1])",
    nogil=True,
    error_model="numpy",
)
def see_missions(
    particles: Array,
    weights: Array,
    totals: Array,
    rows: Indices,
    facts: Array,
    sites: Array,
    missions: Indices,
    frames: Array,
    results: NDArray[np.float32],
) -> None:
    """Fill `frames` and `results` of these missions, as `agent.observation.Schema` says."""
    sent, few = np.empty(particles.shape[2]), np.empty((8, FEW))
    for b in missions:
        for i in range(len(sent)):  # float32 values, as on the wire
            sent[i] = np.float32(weights[b, i] / totals[b])
        _see(particles[b], sent, rows, facts[b], sites[b], few, frames[b], results[b])
