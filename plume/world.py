"""The world that one mission flies in: it knows the source and returns the readings that a sensor would take."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from plume.dispersion import concentration
from plume.randomness import Abreast, Keyed
from plume.scenario import Scenario
from plume.sensor import GAUSSIAN, Sensor


def float32(value: float) -> float:
    """Round to the nearest float32, as the wire rounds positions, wind and gas. In-process missions round the same way."""
    return float(np.float32(value))


class World:
    """A scenario and the noise of its sensor. It answers with what an instrument would read.

    `wind` is (u cos φ, u sin φ) in m/s and points to where the wind comes from; `start` is where the search begins, (x, y) in metres.

    Example:
        ```python
        world = plumeward.World(plumeward.draw(7), seed=7)
        world.gas((12.0, 15.0), step=0)  # the first reading, g/m³
        ```
    """

    def __init__(self, scenario: Scenario, seed: int, sensor: Sensor = GAUSSIAN) -> None:
        """Take the mission's seed: the noise of reading k is keyed by (seed, k)."""
        self.scenario = scenario
        self.seed = seed
        self.sensor = sensor
        self.wind = (float32(scenario.wind[0]), float32(scenario.wind[1]))
        """(u cos φ, u sin φ) m/s as the anemometer reports it, float32 values: points to where the wind comes from."""
        self.start = (float32(scenario.start[0]), float32(scenario.start[1]))
        self._release = (*scenario.source, scenario.height, *scenario.wind, scenario.q, scenario.d, scenario.tau)

    def gas(self, position: tuple[float, float], step: int) -> float:
        """Take gas reading number `step` (0 at the start) at a position (x, y) m; returns a float32 value in the sensor's unit."""
        return float(gas_of([self], np.array([position]), [step], self._noise)[0])

    @cached_property
    def _noise(self) -> Keyed:
        return Keyed()


def gas_of(worlds: Sequence[World], positions: NDArray[np.float64], steps: Sequence[int], noise: Keyed) -> NDArray[np.float64]:
    """Take one reading in each of M worlds at positions (M, 2) m: (M,) float32 values. `noise` is the generator to draw with.

    Raises ValueError if the worlds' sensors differ.
    """
    sensor = worlds[0].sensor
    if any(world.sensor is not sensor and world.sensor != sensor for world in worlds):
        raise ValueError("worlds that are read together must have the same sensor")
    places = np.zeros((len(worlds), 3))
    places[:, :2] = positions
    releases = np.array([world._release for world in worlds])
    rate, diffusivity, lifetime = releases[:, 5:].T
    means = concentration(places, releases[:, :3], releases[:, 3:5], rate=rate, diffusivity=diffusivity, lifetime=lifetime)
    draws = Abreast(noise, [(world.seed, "sensor", step) for world, step in zip(worlds, steps, strict=True)])
    return sensor.measure(means, draws).astype(np.float32).astype(np.float64)
