"""The air of one mission: its gas and its wind at a place and a time."""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from plume.dispersion import concentration
from plume.elementary import Array
from plume.scenario import Scenario


class Air(Protocol):
    """The gas and the wind of one mission.

    A pure function of the place and the time: whatever is asked before, or beside it, each answer has the
    same bits.
    """

    def __call__(self, places: Array, times_s: Array, /) -> tuple[Array, Array]:
        """Return the gas (M,) in g/m³ and the wind (M, 2) in m/s, which points to where it comes from.

        places: (M, 3) m, x east, y north, z above the search plane.  times_s: (M,) of the mission's own
        clock, 0 at the first reading.
        """


# Makes the air of a mission: (truth, seed, parameters by keyword) -> Air. Raises ValueError on a parameter
# that is not allowed, and NoRelease.
Make = Callable[..., Air]


class Steady:
    """The paper's plume: the mean gas in a steady wind."""

    def __init__(self, scenario: Scenario, _seed: int) -> None:
        self.wind = scenario.wind
        # x, y, z of the source, the wind, q, d, τ
        self.release = (
            *scenario.source,
            scenario.height,
            *self.wind,
            scenario.q,
            scenario.d,
            scenario.tau,
        )

    def __call__(self, places: Array, _times_s: Array) -> tuple[Array, Array]:
        """Return gas and wind, as of `Air`."""
        return gas_of([self], places), np.broadcast_to(self.wind, (len(places), 2))


class Both:
    """Two releases in one air."""

    def __init__(self, one: Air, other: Air) -> None:
        self._one, self._other = one, other

    def __call__(self, places: Array, times_s: Array) -> tuple[Array, Array]:
        """Return the gas of both, and the wind, as of `Air`."""
        (gas, winds), (more, _) = self._one(places, times_s), self._other(places, times_s)
        return np.asarray(gas, np.float64) + np.asarray(more, np.float64), winds


def gas_of(plumes: Sequence[Steady], places: Array) -> Array:
    """Return the gas, as of `Air`, at one place of each plume, or at all places of a single one."""
    releases = np.array([plume.release for plume in plumes])
    rate, diffusivity, lifetime = releases[:, 5:].T
    return concentration(
        places, releases[:, :3], releases[:, 3:5], rate=rate, diffusivity=diffusivity, lifetime=lifetime
    )
