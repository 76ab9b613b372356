"""The world that one mission flies in: it knows the source, and answers with what an instrument there would read."""

import numpy as np

from plume.dispersion import concentration
from plume.randomness import keyed
from plume.scenario import Scenario
from plume.sensor import GAUSSIAN, Sensor


def float32(value: float) -> float:
    """Round to the nearest float32: what the wire does to positions, wind and gas. In-process missions do the same."""
    return float(np.float32(value))


class World:
    """A scenario and the noise of its sensor."""

    def __init__(self, scenario: Scenario, seed: int, sensor: Sensor = GAUSSIAN) -> None:
        """Take the mission's seed: reading k's noise is keyed by (seed, k)."""
        self.scenario = scenario
        self.seed = seed
        self.sensor = sensor
        self.wind = (float32(scenario.wind[0]), float32(scenario.wind[1]))
        """(u cos φ, u sin φ) m/s as the anemometer reports it, a float32 pair: where the wind comes from."""
        self.start = (float32(scenario.start[0]), float32(scenario.start[1]))

    def gas(self, position: tuple[float, float], step: int) -> float:
        """Take the gas reading number `step` (0 at the start) at a position (x, y) m; a float32 value, in the sensor's unit."""
        s = self.scenario
        place, source = (*position, 0.0), (*s.source, s.height)
        mean = concentration(place, source, s.wind, rate=s.q, diffusivity=s.d, lifetime=s.tau)
        return float32(float(self.sensor.measure(mean, keyed(self.seed, "sensor", step))))
