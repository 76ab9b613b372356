"""Predictions of a belief: readings not yet taken, and the belief after them."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from agent.planning import kernels
from link.bus.messages import Belief, Particles
from plume.dispersion import SOURCE_RADIUS_M
from plume.elementary import Array, Indices
from plume.intermittency import SMALLEST_CV
from plume.numerics import exp_each, log_each
from plume.parameters import KNOWN, MEASURED, NEUTRAL, PARAMETERS
from plume.randomness import Alike, standard_gamma
from plume.sensors.names import Sensor, parse, sensor_row
from plume.sensors.response import settled_readings
from plume.sensors.sensor import Gaussian

NOWHERE: Array = np.empty((0, 2))
CELLS_A_SPREAD = 4  # cells per spread in `entropy_spread`
# Most cells of a grid that is counted in whole; cells beyond ±FAR count as those at ±FAR.
MOST_CELLS, FAR = 1_000_000, 2.0**30


@dataclass(frozen=True)
class Cloud:
    """A belief's particles in float64."""

    values: Array  # (D, N): one row per unknown; the first two are x and y
    weights: Array  # (N,), sum one

    @property
    def places(self) -> Array:
        """(2, N): the source positions (x, y) of the particles, m."""
        return self.values[:2]

    def mean(self, values: Array) -> Array:
        """Return the mean of values (..., N) of the particles: (...)."""
        return np.asarray((values * self.weights).sum(axis=-1))

    def distances(self, places: Array) -> Array:
        """Return the distances of the particles from places (..., 2) m: (..., N) m."""
        east, north = (places[..., axis, None] - self.places[axis] for axis in (0, 1))
        return np.asarray(np.sqrt(east * east + north * north))

    def thinned(self, most: int) -> Self:
        """Return a cloud of at most `most` evenly spaced particles: planning needs fewer than estimating."""
        every = math.ceil(len(self.weights) / most)
        weights = self.weights[::every]
        return replace(
            self, values=np.ascontiguousarray(self.values[:, ::every]), weights=weights / weights.sum()
        )


@dataclass(frozen=True)
class Hypotheses(Cloud):
    """The particles of a belief, and what readings of theirs depend on beside them."""

    belief: Belief

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the rows."""
        return ("x", "y", *(name for name in self.belief.unknowns if name not in ("x", "y")))

    @cached_property
    def sensor(self) -> Sensor:
        """What is read with."""
        return parse(self.belief.sensor)

    @cached_property
    def sensor_row(self) -> Array:
        """The sensor as compiled loops take it."""
        return sensor_row(self.sensor)

    @cached_property
    def unknowns(self) -> Indices:
        """Number of each row in PARAMETERS."""
        return np.array([PARAMETERS.index(name) for name in self.names])

    @cached_property
    def priors(self) -> Array:
        """What is known of each of PARAMETERS, as the filter's loops take it: (P, 5)."""
        belief = self.belief
        known = {"z": belief.z, "q": belief.rate, "d": belief.diffusivity, "tau": belief.lifetime, **NEUTRAL}
        priors = np.zeros((len(PARAMETERS), 5))
        priors[:, 0] = [MEASURED if name in {"u", "phi"} - {*self.names} else KNOWN for name in PARAMETERS]
        priors[:, 1] = [known.get(name, 0.0) for name in PARAMETERS]
        return priors

    @cached_property
    def noises(self) -> Array:
        """Each particle's factor on the sensor's noise, and its intermittency (cv) of the gas: (2, N)."""
        rows = dict(zip(self.names, self.values, strict=True))
        result = np.empty((2, len(self.weights)))
        result[0] = rows.get("noise", NEUTRAL["noise"])
        result[1] = rows.get("cv", self.sensor.cv if isinstance(self.sensor, Gaussian) else 0.0)
        return result

    @cached_property
    def cumulative(self) -> Array:
        """The weights' cumulative sums (N,)."""
        return np.cumsum(self.weights)


@dataclass(frozen=True)
class Imagined:
    """A belief after hypothetical readings: K at each of A places.

    They are drawn from the belief's predictive distribution there.
    """

    log_predictive: Array  # (A, K): log predictive density of each reading. For hits, log z! is left out.
    # (A, K): expected log-likelihood of each reading under the belief after it. For hits, log z! is left out.
    log_likelihood: Array
    expectations: Array  # (A, K, F): expectations of the given values under the belief after each reading
    means: Array  # (A, N): concentration at each place under each particle, g/m³
    # (2, N): each particle's factor on the sensor's noise, and its intermittency (cv) of the gas.
    noises: Array
    gains_before: Array  # (K,): as `gains`, of the readings before those at the places

    @property
    def gains(self) -> Array:
        """(A, K): Kullback–Leibler divergence from the belief to the belief after the reading, nats."""
        return self.log_likelihood - self.log_predictive


def cloud(belief: Belief, particles: Particles) -> Hypotheses:
    """Unpack a belief's particles; a known x or y becomes a constant row."""
    columns = dict(zip(belief.unknowns, particles.T.astype(np.float64), strict=False))
    weights = particles[:, -1].astype(np.float64)
    x, y = (
        np.broadcast_to(columns.pop(name, np.float64(known)), weights.shape)
        for name, known in zip("xy", belief.mean, strict=True)
    )
    return Hypotheses(np.vstack([x, y, *columns.values()]), weights / weights.sum(), belief)


def concentrations(hypotheses: Hypotheses, places: Array) -> Array:
    """What the sensor reads without noise, (A, N), after long at places (A, 2) m under each particle.

    It is the mean concentration, g/m³, at flight height; of an instrument, in its unit. Its lag is left out.
    """
    belief = hypotheses.belief
    readings = np.empty((len(places), 5))
    readings[:, :2] = places
    readings[:, 2:] = belief.altitude_m, *belief.wind
    return settled_readings(
        hypotheses.values, hypotheses.unknowns, hypotheses.priors, readings, hypotheses.sensor_row
    )


def imagine(
    hypotheses: Hypotheses,
    places: Array,
    number: int,
    rng: np.random.Generator,
    values: Array | None = None,
    before: Array = NOWHERE,
) -> Imagined:
    """Draw `number` readings at each place (A, 2) m, and reweight the belief by each.

    They are drawn from the predictive distribution there. values: (F, N) or (A, F, N) values of the
    particles, whose expectations are wanted.  before: (B, 2) m where readings are taken before; results
    include them, as along a path.  The draws are stratified over the belief. All places share the
    same random numbers, so that chance does not decide between them.
    """
    if values is not None:
        values = values[None, None] if values.ndim == 2 else values[:, None]
    along = imagine_along(hypotheses, places[:, None], number, rng, values, before)
    return Imagined(
        along.log_predictive[:, 0],
        along.log_likelihood[:, 0],
        along.expectations[:, 0],
        along.means[:, 0],
        along.noises,
        along.gains_before,
    )


def imagine_along(
    hypotheses: Hypotheses,
    paths: Array,
    number: int,
    rng: np.random.Generator,
    values: Array | None = None,
    before: Array = NOWHERE,
) -> Imagined:
    """Do the same along paths (A, L, 2) m: results (A, L, K) include the path's readings before a place.

    values: (A, 1, F, N), or (A, L, F, N) if nothing is read `before`.
    """
    sensor, noises, cumulative = hypotheses.sensor, hypotheses.noises, hypotheses.cumulative
    at_all = concentrations(hypotheses, np.concatenate([before, paths.reshape(-1, 2)]))
    means_before, means = at_all[: len(before)], at_all[len(before) :].reshape(*paths.shape[:2], -1)
    strata = (np.arange(number) + rng.random()) / number * cumulative[-1]
    drawn = np.minimum(np.searchsorted(cumulative, strata, side="right"), len(cumulative) - 1)
    bits = np.random.Philox(int(rng.integers(2**63)))
    own = noises[:, drawn]

    def draw(rows: Array) -> Array:
        """Draw readings at places (L, A, N) in turn: (A, L, K)."""
        alike = Alike(bits, rows.shape[1])
        return np.array([_readings(sensor, at[:, drawn], own, alike) for at in rows]).transpose(1, 0, 2)

    readings_before = np.empty((0, number))
    if len(before):
        readings_before = _readings(sensor, means_before[:, drawn], own, np.random.Generator(bits))
    readings = np.ascontiguousarray(draw(means.transpose(1, 0, 2)))
    if values is None:
        values = np.empty((1, 1, 0, len(cumulative)))
    log_predictive, log_likelihood, expectations, gains_before = kernels.imagine(
        *(
            means,
            hypotheses.weights,
            np.ascontiguousarray(values),
            drawn,
            readings,
            hypotheses.sensor_row,
            noises,
        ),
        *(means_before, readings_before),
    )
    return Imagined(log_predictive, log_likelihood, expectations, means, noises, gains_before)


def _readings(sensor: Sensor, means: Array, noises: Array, rng: np.random.Generator | Alike) -> Array:
    """Draw a reading for each mean (A, K). noises: (2, K) each one's noise factor and intermittency."""
    factors, cvs = noises
    gas = None
    if cvs.any():
        shapes = 1 / np.square(np.maximum(cvs, SMALLEST_CV))
        gas = means * standard_gamma(rng, shapes, means.shape) / shapes
    return sensor.measure(means, rng, gas, factors)


def entropy_spread(hypotheses: Cloud, spread: float) -> float:
    """Spread of the round normal distribution with the same entropy H as the location's, m.

    It is sqrt(exp(H)/(π e)), H in nats (m²). H is computed from cells with a side of a quarter of the spread.
    If half of a disc is ruled out, the entropy spread shrinks, while the spread itself need not.
    """
    cell = max(spread, SOURCE_RADIUS_M) / CELLS_A_SPREAD
    return spread_of_cells(shares_of_cells(hypotheses, cell), cell)


def spread_of_cells(shares: Array, cell: float) -> float:
    """Return `entropy_spread` of a belief with these shares (C,), all above 0, of cells with this side, m."""
    return float(cell * np.sqrt(exp_each(-np.sum(shares * log_each(shares))) / (np.pi * np.e)))


def shares_of_cells(hypotheses: Cloud, cell: float) -> Array:
    """Return the belief's weight in each square cell of this side (m) that has any, by column and row."""
    columns, rows = np.clip(np.floor(hypotheses.places / cell), -FAR, FAR).astype(np.int64)
    rows -= rows.min()
    numbers = (columns - columns.min()) * (1 + rows.max()) + rows
    if numbers.max() > MOST_CELLS:  # particles that are far apart: only cells that hold some are counted
        numbers = np.unique(numbers, return_inverse=True)[1].astype(np.int64)
    shares: Array = np.asarray(np.bincount(numbers, hypotheses.weights), np.float64)
    return shares[shares > 0]


def variances(
    hypotheses: Hypotheses,
    places: Array,
    number: int,
    rng: np.random.Generator,
    before: Array = NOWHERE,
) -> Array:
    """Trace of the location's covariance after hypothetical readings at places (A, 2) m: (A, K) m².

    before: as of `imagine`.
    """
    # Offsets from the mean limit cancellation below.
    offsets = hypotheses.places - hypotheses.mean(hypotheses.places)[:, None]
    values = np.vstack([offsets, np.square(offsets).sum(axis=0)])
    expected = imagine(hypotheses, places, number, rng, values, before).expectations
    return np.asarray(np.maximum(expected[:, :, 2] - np.square(expected[:, :, :2]).sum(axis=2), 0.0))
