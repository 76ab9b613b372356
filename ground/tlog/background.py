"""What a gas sensor shows in clean air: the background of a flight, and the noise around it."""

from typing import NamedTuple

import numpy as np

from ground.tlog.clock import Floats

NORMAL = 1.4826  # standard deviation of a normal law by its median absolute deviation
CUT = 2.0  # values this many standard deviations above the background count as gas
ROUNDS = 50
LEAST_SHARE = 0.2  # of the values that count as clean air: a smooth plume has no end without noise
LEAST_NOISE = 1e-3  # of the greatest value above the background
STEPS = 12.0**0.5  # standard deviation of a value that is rounded to a whole number, by 1


class Clean(NamedTuple):
    """Clean air as a sensor shows it, in the sensor's unit."""

    background: float
    noise: float  # standard deviation, above 0
    share: float  # of the values that count as clean air


def clean_air(values: Floats) -> Clean:
    """Return the background and the noise of a flight that was for the most part in clean air.

    The background is the median of the values that are not far above it, the noise that of the values below
    it: gas only adds. Where most values are gas, the background is too high. It does not drift.

    values: (N,), N at least 1, finite.
    """
    kept = values = np.sort(values)
    background = noise = 0.0
    for _ in range(ROUNDS):
        background = float(np.median(kept))
        noise = NORMAL * float(np.median(background - kept[kept <= background]))
        clean = values[values <= background + CUT * noise] if noise else values[values <= background]
        if len(clean) == len(kept) or len(clean) < LEAST_SHARE * len(values):
            break
        kept = clean
    steps = np.diff(np.unique(values))
    least = LEAST_NOISE * float(values[-1] - background)
    finest = float(steps.min()) if len(steps) else 1e-3 * abs(background)
    return Clean(background, max(noise, finest / STEPS, least, 1e-9), len(kept) / len(values))
