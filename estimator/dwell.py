"""What the gas was like, by the belief, and how long to hover for a reading because of it."""

import math
from collections.abc import Mapping

import numpy as np

from estimator.filter import Config, Posterior
from estimator.kernels.gas import cvs_downwind
from plume import elementary
from plume.elementary import Array
from plume.sensors.names import Sensor, lags

LEVELS = np.array([0.05, 0.5, 0.95])
PARTICLES = 250  # least number of particles, evenly spaced, that quantiles are taken of
NEAR_M = 3.0  # downwind of the source: there a search ends, and there puffs overlap least
DOWNWIND = "downwind"  # name of the coefficient of variation there
OF_GAS = "cv", "puff-rate", "puff-share"
# Dwells that are advised, s, each from this coefficient of variation of gas at one moment on: docs/trust.md
# has the times that chose them.
DWELLS_S = {1.0: 0.5, 2.0: 1.3, 5.0: 2.3}
# A hover divides the variance of gas by 1 + dwell/AVERAGED_S: measured there, too.
AVERAGED_S = 0.85

Quantiles = tuple[float, float, float]  # of LEVELS


def intermittency(posterior: Posterior, config: Config) -> dict[str, Quantiles]:
    """Return what the belief says of how the gas comes and goes, by name; nothing where that is known.

    It is of the unknowns among `OF_GAS`, and of the coefficient of variation of the gas `NEAR_M` downwind of
    the source. Gas is what the sensor meets: of a vehicle that hovers, its mean over the hover.
    """
    every = max(len(posterior.weights) // PARTICLES, 1)
    particles, weights = np.ascontiguousarray(posterior.particles[:, ::every]), posterior.weights[::every]
    said = {
        name: quantiles(row, weights)
        for name, row in zip(config.unknowns, particles, strict=True)
        if name in OF_GAS
    }
    if not said:
        return {}
    row = np.ascontiguousarray(posterior.readings[-1])
    cvs = cvs_downwind(particles, row, NEAR_M, config.model)
    return {DOWNWIND: quantiles(cvs, weights), **said}


def quantiles(values: Array, weights: Array) -> Quantiles:
    """Return the weighted quantiles of values (N,) at `LEVELS`; weights (N,) up to 1 each."""
    low, middle, high = elementary.quantiles(values, weights, LEVELS)
    return low, middle, high


def advised_dwell(said: Mapping[str, Quantiles], sensor: Sensor) -> float:
    """Return how long to hover for a reading in gas of which `intermittency` says this, s; 0: as long as now.

    Gas surely comes and goes where the 5% quantile of its coefficient of variation is high. Then a hover
    finds the source in less time, though it takes time. A shorter hover is never advised: what a hover has
    averaged away the readings cannot tell. Nor is any of a sensor that lags: it averages gas of the leg, too,
    and its readings tell less of it.
    """
    if lags(sensor):
        return 0.0
    low, _, _ = said.get(DOWNWIND, (0.0, 0.0, 0.0))
    of_a_moment = low * math.sqrt(1 + sensor.dwell / AVERAGED_S)
    advised_s = max((dwell_s for dwell_s, least in DWELLS_S.items() if of_a_moment >= least), default=0.0)
    return advised_s if advised_s > sensor.dwell else 0.0
