"""How long the legs of a flight take. A mission's own clock follows from its path alone, on every machine."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from plume.elementary import Array
from plume.scenario import STEP_M

SPEED_MPS = 5.0  # horizontal speed of the simulated vehicle at most
ACCEL_MPS2 = 3.0  # its acceleration along a leg
TRY_AGAIN_S = 1.0  # time after which a sensor without a value is read again
SLOWEST_MPS = 1e-9  # a leg of no length has a peak speed of 0, and is over at once


class Profile(NamedTuple):
    """A leg from rest to rest: speed up, cruise, slow down."""

    peak_mps: Array
    ramp_s: Array  # of speeding up, and of slowing down
    ramp_m: Array
    cruise_s: Array

    @property
    def duration_s(self) -> Array:
        """Time from rest to rest."""
        return self.ramp_s + self.cruise_s + self.ramp_s


def profile(length_m: ArrayLike, speed_mps: float = SPEED_MPS, accel_mps2: float = ACCEL_MPS2) -> Profile:
    """Return the trapezoidal profile of legs of these lengths (...)."""
    length_m = np.asarray(length_m, np.float64)
    peak = np.minimum(speed_mps, np.sqrt(accel_mps2 * length_m))
    ramp_m = peak * peak / accel_mps2 / 2.0
    cruise_m = np.maximum(length_m - 2.0 * ramp_m, 0.0)
    return Profile(peak, peak / accel_mps2, ramp_m, cruise_m / np.maximum(peak, SLOWEST_MPS))


def leg_s(
    start: ArrayLike, end: ArrayLike, speed_mps: float = SPEED_MPS, accel_mps2: float = ACCEL_MPS2
) -> Array:
    """Duration of level legs between places (..., 2) m: (...)."""
    offset = np.asarray(end, np.float64) - np.asarray(start, np.float64)
    length_m = np.sqrt(offset[..., 0] * offset[..., 0] + offset[..., 1] * offset[..., 1])
    return profile(length_m, speed_mps, accel_mps2).duration_s


def usual_s(step: int) -> float:
    """Mission time of a reading where all steps are of the usual length."""
    return step * float(profile(STEP_M).duration_s)
