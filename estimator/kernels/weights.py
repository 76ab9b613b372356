"""Weights of particles: reweighting, effective sample size, moments, systematic resampling."""

import numpy as np

from plume.compiled import kernel, subroutine
from plume.elementary import Array, Indices
from plume.numerics import dot, exp, total_of

# One resamples below a certain effective sample size.
# If a reading would bring it below this share of that, the reading is taken in tempered stages.
STAGE_FLOOR = 0.8


@kernel("float64(float64[::1])")
def effective_sample_size(weights: Array) -> float:
    """Effective sample size (Σ w)² / Σ w² of weights (N,), which need not be normalised."""
    total = total_of(weights)
    return total * total / dot(weights, weights)


@subroutine
def _greatest(values: Array) -> float:
    a, b, c, d = values[0], values[0], values[0], values[0]
    whole = len(values) - len(values) % 4
    for i in range(0, whole, 4):
        a = max(a, values[i])
        b = max(b, values[i + 1])
        c = max(c, values[i + 2])
        d = max(d, values[i + 3])
    for i in range(whole, len(values)):
        a = max(a, values[i])
    return float(max(max(a, b), max(c, d)))


@subroutine
def weigh(log_weights: Array, share: float, log_densities: Array, weights: Array) -> float:
    """Set weights ∝ exp(log_weights + share · log_densities), scaled so that the greatest is 1.

    Returns the effective sample size.
    """
    for i in range(len(weights)):
        weights[i] = log_weights[i] + share * log_densities[i]
    highest = _greatest(weights)
    for i in range(len(weights)):
        weights[i] = exp(weights[i] - highest)
    return effective_sample_size(weights)


@subroutine
def tempered_share(
    log_weights: Array, log_densities: Array, left: float, weights: Array, least: float
) -> tuple[float, float]:
    """Return the exponent for the next stage and the effective sample size that it leaves.

    The weights are set accordingly. The exponent is `left` if that leaves at least STAGE_FLOOR · `least` · N
    effective particles. Otherwise bisection finds one that leaves 1 to 1.2 times that.
    """
    floor = STAGE_FLOOR * least * len(weights)
    size = weigh(log_weights, left, log_densities, weights)
    if size >= floor:
        return left, size
    low, high = 0.0, left
    for _ in range(60):
        middle = 0.5 * (low + high)
        size = weigh(log_weights, middle, log_densities, weights)
        if size < floor:
            high = middle
        elif size > 1.2 * floor:
            low = middle
        else:
            return middle, size
    return high, weigh(log_weights, high, log_densities, weights)


@kernel("float64(float64[::1], float64[::1])")
def weighted_mean(weights: Array, values: Array) -> float:
    """Mean of values (N,) with weights (N,), which need not be normalised."""
    return dot(weights, values) / total_of(weights)


@kernel("Tuple((float64[::1], float64[:, ::1]))(float64[:, ::1], float64[::1])")
def moments(particles: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean (D,) and covariance (D, D) of particles (D, N); the weights need not be normalised."""
    rows, count = particles.shape
    total = total_of(weights)
    mean = np.empty(rows)
    covariance = np.empty((rows, rows))
    offsets = np.empty((rows, count))
    weighted = np.empty(count)
    for row in range(rows):
        mean[row] = dot(weights, particles[row]) / total
        for i in range(count):
            offsets[row, i] = particles[row, i] - mean[row]
            weighted[i] = weights[i] * offsets[row, i]
        for other in range(row + 1):
            covariance[row, other] = dot(weighted, offsets[other]) / total
            covariance[other, row] = covariance[row, other]
    return mean, covariance


@kernel(
    "void(float64[:, :, ::1], float64[:, ::1], int64[::1], float64[:, ::1], float64[:, :, ::1])", nogil=True
)
def moments_of_missions(
    particles: Array, weights: Array, missions: Indices, means: Array, covariances: Array
) -> None:
    """Write the `moments` of these missions of a batch into means (B, D) and covariances (B, D, D)."""
    for b in missions:
        mean, covariance = moments(particles[b], weights[b])
        for row in range(len(mean)):  # assigning whole arrays takes ten times as long to compile
            means[b, row] = mean[row]
            for other in range(len(mean)):
                covariances[b, row, other] = covariance[row, other]


@kernel("int64[::1](float64[::1], float64)")
def systematic(weights: Array, offset: float) -> Indices:
    """Systematic resampling: returns the ancestors (N,).

    The cumulative weight passes (k + offset) / N at ancestor k; offset in [0, 1).
    """
    count = len(weights)
    ancestors = np.empty(count, np.int64)
    scale = count / total_of(weights)
    ancestor = 0
    cumulative = weights[0] * scale
    for k in range(count):
        while cumulative <= k + offset and ancestor < count - 1:
            ancestor += 1
            cumulative += weights[ancestor] * scale
        ancestors[k] = ancestor
    return ancestors
