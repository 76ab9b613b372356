"""What a belief predicts of readings not yet taken, and what it would become by them."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.planning import kernels
from link.bus.messages import Belief, Particles
from plume.dispersion import SOURCE_RADIUS_M
from plume.kernels import mean_concentrations
from plume.parameters import KNOWN, MEASURED, PARAMETERS
from plume.sensor import parse, sensor_row

Array = NDArray[np.float64]

CELLS_A_SPREAD = 4


@dataclass(frozen=True)
class Cloud:
    """A belief's particles as columns of float64."""

    values: Array
    """(D, N): a row for each unknown."""
    weights: Array
    """(N,), sum one."""

    @property
    def places(self) -> Array:
        """(2, N): where the particles see the source, m."""
        return self.values[:2]

    def thinned(self, most: int) -> "Cloud":
        """Every so many-th particle, so that there are at most so many: enough to plan with, where N are needed to know."""
        every = math.ceil(len(self.weights) / most)
        weights = self.weights[::every]
        return Cloud(np.ascontiguousarray(self.values[:, ::every]), weights / weights.sum())


@dataclass(frozen=True)
class Imagined:
    """What hypothetical readings at each place would do to a belief; K of them a place, drawn from what it predicts there."""

    log_predictive: Array
    """(A, K): log-density of the reading in the belief's predictive distribution. Of hits log z! is left out."""
    log_likelihood: Array
    """(A, K): its expected log-likelihood under the belief after it, less the same."""
    expectations: Array
    """(A, K, F): of the values asked for, under the belief after it."""
    means: Array
    """(A, N): concentration at each place under each particle, g/m³."""

    @property
    def gains(self) -> Array:
        """(A, K): Kullback–Leibler divergence from the belief to the belief after the reading, nats."""
        return self.log_likelihood - self.log_predictive


def cloud(belief: Belief, particles: Particles) -> Cloud:
    """Unpack a belief's particles; x or y that is known becomes a row like the others."""
    columns = dict(zip(belief.unknowns, particles.T.astype(np.float64), strict=False))
    weights = particles[:, -1].astype(np.float64)
    x, y = (np.broadcast_to(columns.pop(name, np.float64(known)), weights.shape) for name, known in zip("xy", belief.mean, strict=True))
    return Cloud(np.vstack([x, y, *columns.values()]), weights / weights.sum())


def concentrations(belief: Belief, hypotheses: Cloud, places: Array) -> Array:
    """Mean concentration (A, N) at places (A, 2), at the height flown, under each particle."""
    names = ("x", "y", *(name for name in belief.unknowns if name not in ("x", "y")))
    priors = np.zeros((8, 5))
    priors[:, 0] = KNOWN
    priors[:, 1] = 0.0, 0.0, belief.z, belief.rate, 0.0, 0.0, belief.diffusivity, belief.lifetime
    for name in ("u", "phi"):
        if name not in names:
            priors[PARAMETERS.index(name), 0] = MEASURED
    readings = np.empty((len(places), 5))
    readings[:, :2] = places
    readings[:, 2:] = belief.altitude_m, *belief.wind
    unknowns = np.array([PARAMETERS.index(name) for name in names])
    means: Array = mean_concentrations(hypotheses.values, unknowns, priors, readings)
    return means


def imagine(
    belief: Belief, hypotheses: Cloud, places: Array, number: int, rng: np.random.Generator, values: Array | None = None
) -> Imagined:
    """Draw `number` readings at each place (A, 2) from the predictive density there, and reweight the belief by each.

    values: (F, N) or (A, F, N), of the particles.  The draws are stratified over the belief, and all places share the same ones, so
    that chance does not decide between them.
    """
    if values is not None:
        values = values[None, None] if values.ndim == 2 else values[:, None]
    along = imagine_along(belief, hypotheses, places[:, None], number, rng, values)
    return Imagined(along.log_predictive[:, 0], along.log_likelihood[:, 0], along.expectations[:, 0], along.means[:, 0])


def imagine_along(
    belief: Belief, hypotheses: Cloud, paths: Array, number: int, rng: np.random.Generator, values: Array | None = None
) -> Imagined:
    """The same for readings at all places along paths (A, L, 2): what is imagined (A, L, K) counts those before. values: (A, L, F, N)."""
    sensor = parse(belief.sensor)
    means = concentrations(belief, hypotheses, paths.reshape(-1, 2)).reshape(*paths.shape[:2], -1)
    cumulative = np.cumsum(hypotheses.weights)
    strata = (np.arange(number) + rng.random()) / number * cumulative[-1]
    drawn = np.minimum(np.searchsorted(cumulative, strata, side="right"), len(cumulative) - 1)
    bits = np.random.Philox(int(rng.integers(2**63)))
    begin, readings = bits.state, np.empty((*paths.shape[:2], number))
    for along, of_path in zip(means, readings, strict=True):
        bits.state = begin
        generator = np.random.Generator(bits)
        for row, of_place in zip(along, of_path, strict=True):
            of_place[:] = sensor.measure(row[drawn], generator)
    if values is None:
        values = np.empty((1, 1, 0, len(cumulative)))
    return Imagined(*kernels.imagine(means, hypotheses.weights, np.ascontiguousarray(values), drawn, readings, sensor_row(sensor)), means)


def entropy_spread(hypotheses: Cloud, spread: float) -> float:
    """Spread of the normal distribution with the same entropy as the location's, m: sqrt(exp(H)/(π e)), H in nats of m².

    H is counted in cells of a quarter of the spread. Where half of a disc has been ruled out, this one shrinks, and the spread need not.
    """
    cell = max(spread, SOURCE_RADIUS_M) / CELLS_A_SPREAD
    columns, rows = np.floor(hypotheses.places / cell).astype(np.int64)
    rows -= rows.min()
    shares = np.bincount((columns - columns.min()) * (1 + rows.max()) + rows, hypotheses.weights)
    shares = shares[shares > 0]
    return float(cell * np.sqrt(np.exp(-np.sum(shares * np.log(shares))) / (np.pi * np.e)))


def variances(belief: Belief, hypotheses: Cloud, places: Array, number: int, rng: np.random.Generator) -> Array:
    """Trace of the location's covariance, m², after each of `number` readings imagined at each place (A, 2): (A, K)."""
    offsets = hypotheses.places - hypotheses.places @ hypotheses.weights[:, None]  # about the mean, so that squares cancel little
    values = np.vstack([offsets, np.square(offsets).sum(axis=0)])
    expected = imagine(belief, hypotheses, places, number, rng, values).expectations
    traces: Array = np.maximum(expected[:, :, 2] - np.square(expected[:, :, :2]).sum(axis=2), 0.0)
    return traces
