"""The world that one mission flies in: it knows the source, and gives a sensor's readings."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import msgspec
import numpy as np
from numpy.typing import NDArray

from plume.dispersion import concentration
from plume.randomness import Abreast, Keyed
from plume.scenario import Scenario
from plume.sensor import GAUSSIAN, Hits, Sensor, Threshold
from plume.worlds import AS_MODELLED, errors


def float32(value: float) -> float:
    """Round to the nearest float32, as the wire rounds positions, wind and gas.

    In-process missions round the same way.
    """
    return float(np.float32(value))


class World:
    """A scenario, the noise of its sensor, and how the truth differs from both.

    It answers with what an instrument would read.

    `wind` is (u cos φ, u sin φ) in m/s and points to where the wind comes from; `start` is where the
    search begins, (x, y) in metres.

    Example:
        ```python
        world = plumeward.World(plumeward.draw(7), seed=7)
        world.gas((12.0, 15.0), step=0)  # the first reading, g/m³
        ```
    """

    def __init__(
        self, scenario: Scenario, seed: int, sensor: Sensor = GAUSSIAN, name: str = AS_MODELLED
    ) -> None:
        """Take the mission's seed: the noise of reading k is keyed by (seed, k).

        Raises ValueError on an unknown name.

        scenario, sensor: what the estimator is told. name: of a world in `plume.worlds`, which says how
        the truth differs.
        """
        self.scenario = scenario
        self.seed = seed
        self.sensor = sensor
        self.name = name
        self.errors = wrong = errors(name, seed)
        # The scenario as it truly is, by which missions are judged.
        self.truth = msgspec.structs.replace(
            scenario,
            source=wrong.source or scenario.source,
            q=wrong.q * scenario.q,
            u=wrong.speed * scenario.u,
            phi=scenario.phi + math.radians(wrong.direction_deg),
            d=wrong.d * scenario.d,
            tau=wrong.tau * scenario.tau,
        )
        # (u cos φ, u sin φ) m/s, float32, as the anemometer reports it: points to where it comes from.
        self.wind = (float32(scenario.wind[0]), float32(scenario.wind[1]))
        self.start = (float32(scenario.start[0]), float32(scenario.start[1]))
        truth = self.truth
        self._release = (*truth.source, truth.height, *truth.wind, truth.q, truth.d, truth.tau)
        self._instrument = sensor, wrong.cv is None
        if wrong.noise != 1 and not isinstance(sensor, Hits):
            noisy = replace(
                sensor,
                sensor_noise=wrong.noise * sensor.sensor_noise,
                environment_noise=wrong.noise * sensor.environment_noise,
            )
            self._instrument = noisy, wrong.cv is None
        self._strengths: list[float] = []

    def gas(self, position: tuple[float, float], step: int) -> float:
        """Take gas reading number `step` (0 at the start) at a position (x, y) m.

        Returns a float32 value in the sensor's unit.
        """
        return float(gas_of([self], np.array([position]), [step], self._noise)[0])

    def loses(self, step: int) -> bool:
        """Whether reading number `step` has no value at first.

        The one then taken in its place is that of `gas`.
        """
        return (
            step > 0
            and self.errors.lost > 0
            and bool(self._noise.at(self.seed, "lost reading", step).random() < self.errors.lost)
        )

    def _strength(self, step: int, noise: Keyed) -> float:
        """The gas that reading `step` meets, by the plume's mean.

        It is gamma-distributed with mean 1 and standard deviation cv. Correlated gas follows the beta-gamma
        autoregressive process of Lewis, McKenzie and Hugus (1989), whose marginals are gamma, too:
        X_n = B_n X_(n−1) + G_n with B ~ Beta(k ρ, k (1 − ρ)), G ~ Gamma(k (1 − ρ)) and k = 1/cv² has the
        autocorrelation ρ^lag.
        """
        cv, correlation = self.errors.cv, self.errors.correlation
        if not cv:
            return 1.0
        shape = 1 / (cv * cv)
        if not correlation:
            return noise.at(self.seed, "gas", step).standard_gamma(shape) / shape
        while (number := len(self._strengths)) <= step:
            rng = noise.at(self.seed, "gas", number)
            kept = (
                rng.beta(shape * correlation, shape * (1 - correlation)) * self._strengths[-1]
                if number
                else 0.0
            )
            self._strengths.append(
                kept + rng.standard_gamma(shape * (1 - correlation) if number else shape) / shape
            )
        return self._strengths[step]

    def _stuck(self, step: int, noise: Keyed) -> float:
        """The reading of a stuck sensor."""
        wrong = self.errors
        return self._shown(
            wrong.stuck_at + wrong.stuck_std * noise.at(self.seed, "stuck", step).standard_normal()
        )

    def _shown(self, value: float) -> float:
        """What the sensor shows for a false value, one that it could give.

        A count is whole, and below its threshold a sensor reads 0.
        """
        match self.sensor:
            case Hits():
                return max(round(value), 0)
            case Threshold(threshold) if value < threshold:
                return 0.0
        return value

    @cached_property
    def _noise(self) -> Keyed:
        return Keyed()


def gas_of(
    worlds: Sequence[World], positions: NDArray[np.float64], steps: Sequence[int], noise: Keyed
) -> NDArray[np.float64]:
    """Take one reading in each of M worlds at positions (M, 2) m: (M,) float32 values.

    `noise` is the generator to draw with.
    """
    places = np.zeros((len(worlds), 3))
    places[:, :2] = positions
    releases = np.array([world._release for world in worlds])
    rate, diffusivity, lifetime = releases[:, 5:].T
    means = concentration(
        places, releases[:, :3], releases[:, 3:5], rate=rate, diffusivity=diffusivity, lifetime=lifetime
    )
    means = means * [world.errors.gain for world in worlds]
    readings = np.empty(len(worlds))
    alike: dict[tuple[Sensor, bool], list[int]] = {}
    for number, world in enumerate(worlds):
        alike.setdefault(world._instrument, []).append(number)
    for (sensor, gas_as_told), those in alike.items():
        draws = Abreast(noise, [(worlds[i].seed, "sensor", steps[i]) for i in those])
        gas = None if gas_as_told else means[those] * [worlds[i]._strength(steps[i], noise) for i in those]
        readings[those] = sensor.measure(means[those], draws, gas)
    for number, (world, step) in enumerate(zip(worlds, steps, strict=True)):
        for spiked, amount in world.errors.spikes:
            if step == spiked:
                readings[number] = world._shown(readings[number] + amount)
        if step >= world.errors.stuck_from:
            readings[number] = world._stuck(step, noise)
    return readings.astype(np.float32).astype(np.float64)
