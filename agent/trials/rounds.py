"""The rounds of a mission: each vehicle takes a reading at its place, and one belief takes them all."""

import time
from collections.abc import Sequence
from typing import NamedTuple

from agent.together import Place
from estimator.belief import belief
from estimator.filter import Config, Posterior, assimilate, prior
from link.bus.mavlink import Reading
from link.bus.messages import Belief, Particles
from plume.flight import TRY_AGAIN_S, leg_s
from plume.worlds.exposure import Before
from plume.worlds.world import World


class Round(NamedTuple):
    """The readings of a round, one of each vehicle, and the belief after them."""

    readings: Sequence[Reading]
    belief: Belief
    particles: Particles
    posterior: Posterior  # what both were made from
    update_s: float  # processor time of the estimator for them: others on the machine do not count


class Rounds:
    """The rounds of one mission, as they are flown.

    Vehicles wait for each other: a round begins when all are there, and its readings are assimilated in the
    order of the vehicles.
    """

    def __init__(self, world: World, config: Config, starts: Sequence[Place]) -> None:
        """Take the world as vehicle 1 measures it, and the vehicles' places."""
        self.places = list(starts)
        self.number = 0  # of the next round
        self._config = config
        self._posterior = prior(config)
        self._worlds = [world.of_vehicle(vehicle + 1) for vehicle in range(len(starts))]
        self._before: list[Before | None] = [None] * len(starts)
        self._time_s = 0.0

    def fly(self, places: Sequence[Place]) -> Round:
        """Fly each vehicle to its next place, and take a reading there."""
        self._time_s += max(
            float(leg_s(start, end)) + world.sensor.dwell + TRY_AGAIN_S * world.loses(self.number)
            for start, end, world in zip(self.places, places, self._worlds, strict=True)
        )
        while self._worlds[0].warms_up(self._time_s):
            self._time_s += TRY_AGAIN_S
        self.places = list(places)
        readings = [self._reading(vehicle) for vehicle in range(len(places))]
        self.number += 1
        began = time.process_time()
        for reading in readings:
            self._posterior = assimilate(self._posterior, reading, self._config)
        said, particles = belief(self._posterior, readings[-1], self._config)
        return Round(readings, said, particles, self._posterior, time.process_time() - began)

    def _reading(self, vehicle: int) -> Reading:
        place = self.places[vehicle]
        gas, wind = self._worlds[vehicle].measure(place, self.number, self._time_s, self._before[vehicle])
        self._before[vehicle] = Before(place, self._time_s, gas)
        return Reading(self.number, place, self._worlds[0].problem.altitude_m, wind, gas, vehicle + 1)
