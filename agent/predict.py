"""What a belief predicts: the gas that each of its particles would put at a place."""

import numpy as np
from numpy.typing import NDArray

from link.messages import Belief, Particles
from plume.dispersion import concentration

Array = NDArray[np.float64]


def mean_concentrations(belief: Belief, particles: Particles, places: Array) -> Array:
    """Concentration (A, N) at places (A, 2), at the height flown, under each particle; what is not unknown is as the belief assumes."""
    unknown = dict(zip(belief.unknowns, particles.T.astype(np.float64), strict=False))  # the last column is the weight
    x, y, z = unknown.get("x", belief.mean[0]), unknown.get("y", belief.mean[1]), unknown.get("z", belief.z)
    sources = np.stack(np.broadcast_arrays(x, y, z), axis=-1)
    wind = np.asarray(belief.wind)
    if "u" in unknown or "phi" in unknown:
        speed = unknown.get("u", np.hypot(*wind))
        direction = unknown.get("phi", np.arctan2(wind[1], wind[0]))
        wind = np.stack([speed * np.cos(direction), speed * np.sin(direction)], axis=-1)
    heights = np.full((len(places), 1), belief.altitude_m)
    return concentration(
        np.hstack([places, heights])[:, None],
        sources,
        wind,
        rate=unknown.get("q", belief.rate),
        diffusivity=unknown.get("d", belief.diffusivity),
        lifetime=unknown.get("tau", belief.lifetime),
    )
