"""Mean gas concentration around a point source: the paper's isotropic plume (Vergassola et al. 2007)."""

import numpy as np
from numpy.typing import ArrayLike

from plume.elementary import Array, exp

SOURCE_RADIUS_M = 0.1  # Radius of the source: shorter distances are clamped to it


def concentration(
    position: ArrayLike,
    source: ArrayLike,
    wind: ArrayLike,
    *,
    rate: ArrayLike,
    diffusivity: ArrayLike,
    lifetime: ArrayLike,
) -> Array:
    """Mean concentration m = q/(4π d r) · exp(−r/λ + ψ), Vergassola et al. 2007 eq. (S5).

    position, source: (..., 2) or (..., 3) m, x east, y north, z up; without z both lie in one plane.
    wind: (..., 2) = (u cos φ, u sin φ) m/s, φ the direction it comes FROM.
    rate q in g/s, diffusivity d in m²/s, lifetime τ in s, (...) each.  Shapes broadcast; returns (...) in
    g/m³.  Gas lies towards −wind.
    """
    offset = np.asarray(position, np.float64) - np.asarray(source, np.float64)
    wind = np.asarray(wind, np.float64)
    rate, diffusivity, lifetime = (np.asarray(value, np.float64) for value in (rate, diffusivity, lifetime))
    distance = np.maximum(np.sqrt(np.square(offset).sum(axis=-1)), SOURCE_RADIUS_M)
    speed_squared = np.square(wind).sum(axis=-1)
    decay_length = np.sqrt(diffusivity * lifetime / (1 + speed_squared * lifetime / (4 * diffusivity)))  # λ
    drift = -(offset[..., :2] * wind).sum(axis=-1) / (2 * diffusivity)  # ψ
    # λ ≤ 2d/u keeps the exponent at or below zero: the exponential cannot overflow, however strong the wind.
    result: Array = rate / (4 * np.pi * diffusivity * distance) * exp(-distance / decay_length + drift)
    return result
