"""What the estimator says after a reading: the belief, its particles, and AGDC's stop."""

import math

import numpy as np

from estimator import kernels
from estimator.filter import Config, Posterior
from link.mavlink import Reading
from link.messages import Belief, Particles, Stop


def belief(posterior: Posterior, reading: Reading, config: Config) -> tuple[Belief, Particles]:
    """Summarise the posterior after `reading`, as it crosses the wire. The search has ceased when the spread is below ζ."""
    weights = kernels.normalised(posterior.log_weights)
    mean_x, mean_y, xx, xy, yy = kernels.moments(posterior.particles, weights)
    spread = math.sqrt(xx + yy)
    summary = Belief(
        time_boot_ms=reading.time_boot_ms,
        step=len(posterior.readings) - 1,
        position=reading.position,
        altitude_m=reading.altitude_m,
        gas=reading.gas,
        wind=reading.wind,
        rate=config.rate,
        diffusivity=config.diffusivity,
        lifetime=config.lifetime,
        mean=(mean_x, mean_y),
        covariance=(xx, xy, yy),
        spread=spread,
        effective_sample_size=kernels.effective_sample_size(posterior.log_weights),
        ceased=spread < config.threshold_m,
    )
    return summary, np.column_stack([posterior.particles, weights]).astype(np.float32)


def stop(ceased: Belief, config: Config) -> Stop:
    """Return the claim that ends the search."""
    return Stop(
        time_boot_ms=ceased.time_boot_ms,
        step=ceased.step,
        estimate=ceased.mean,
        covariance=ceased.covariance,
        spread=ceased.spread,
        threshold=config.threshold_m,
    )
