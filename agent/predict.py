"""What a belief predicts of readings not yet taken, and what it would become by them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent import kernels
from estimator.filter import sensor_row
from estimator.kernels import mean_concentrations
from estimator.priors import KNOWN, MEASURED, PARAMETERS
from link.messages import Belief, Particles
from plume.sensor import parse

Array = NDArray[np.float64]


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


@dataclass(frozen=True)
class Imagined:
    """What hypothetical readings at each place would do to a belief; K of them a place, drawn from what it predicts there."""

    log_predictive: Array
    """(A, K): log-density of the reading in the belief's predictive distribution. Of hits log z! is left out."""
    log_likelihood: Array
    """(A, K): its expected log-likelihood under the belief after it, less the same."""
    expectations: Array
    """(A, K, F): of the values asked for, under the belief after it."""

    @property
    def information(self) -> Array:
        """(A,): Kullback–Leibler divergence from the belief to the belief after a reading, nats; mean over readings."""
        gains: Array = (self.log_likelihood - self.log_predictive).mean(axis=1)
        return gains


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
    sensor = parse(belief.sensor)
    means = concentrations(belief, hypotheses, places)
    cumulative = np.cumsum(hypotheses.weights)
    strata = (np.arange(number) + rng.random()) / number * cumulative[-1]
    drawn = np.minimum(np.searchsorted(cumulative, strata, side="right"), len(cumulative) - 1)
    bits = np.random.Philox(int(rng.integers(2**63)))
    begin, readings = bits.state, np.empty((len(places), number))
    for row, of_place in zip(means, readings, strict=True):
        bits.state = begin
        of_place[:] = sensor.measure(row[drawn], np.random.Generator(bits))
    if values is None:
        values = np.empty((0, len(cumulative)))
    shaped = np.ascontiguousarray(values[None] if values.ndim == 2 else values)
    return Imagined(*kernels.imagine(means, hypotheses.weights, shaped, drawn, readings, sensor_row(sensor)))


def variances(belief: Belief, hypotheses: Cloud, places: Array, number: int, rng: np.random.Generator) -> Array:
    """Trace of the location's covariance, m², after each of `number` readings imagined at each place (A, 2): (A, K)."""
    offsets = hypotheses.places - hypotheses.places @ hypotheses.weights[:, None]  # about the mean, so that squares cancel little
    values = np.vstack([offsets, np.square(offsets).sum(axis=0)])
    expected = imagine(belief, hypotheses, places, number, rng, values).expectations
    traces: Array = np.maximum(expected[:, :, 2] - np.square(expected[:, :, :2]).sum(axis=2), 0.0)
    return traces
