"""The rounds of a mission: each vehicle takes a reading at its place, and one belief takes them all."""

import math
import time
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import msgspec

from estimator.belief import belief, left_at
from estimator.filter import Config, Posterior, assimilate, forget, prior, renewed
from link.bus.mavlink import Reading
from link.bus.messages import Belief, Particles, Stand
from plume.problems.fleet import Place
from plume.worlds.exposure import Before
from plume.worlds.rounds import RoundTime
from plume.worlds.world import World


class Round(NamedTuple):
    """The readings of a round, one of each vehicle that takes part in it, and the belief after them."""

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

    def __init__(
        self,
        world: World,
        config: Config,
        starts: Sequence[Place],
        leaving: Mapping[int, int] = MappingProxyType({}),
        forgotten: Collection[int] = (),
        joining: Mapping[int, tuple[int, int]] = MappingProxyType({}),
    ) -> None:
        """Take the world as vehicle 1 measures it, and the vehicles' places.

        leaving: the first round that a vehicle takes no part in, by its number, from 1, if it leaves.
        forgotten: those of them whose readings do not count from then on.
        joining: of each that comes late, the first round after which the others keep clear of its place, and
        the first that it takes part in.
        """
        self._config = config
        self._posterior = prior(config)
        self._time = RoundTime(world, starts)
        self._before: list[Before | None] = [None] * len(starts)
        self._read_at: dict[int, tuple[Place, Place]] = {}  # where each vehicle has read, first and last
        self._leaving, self._forgotten, self._joining = dict(leaving), forgotten, dict(joining)
        # Of the vehicles of the last round; before the first of those that begin.
        self.numbers: Sequence[int] = [
            number for number in range(1, len(starts) + 1) if not self._joins(number)
        ]

    @property
    def places(self) -> Sequence[Place]:
        """Where the vehicles of the last round are; before the first of those that begin."""
        return [self._time.places[number - 1] for number in self.numbers]

    @property
    def number(self) -> int:
        """The number of the next round."""
        return self._time.number + 1

    def fly(self, places: Sequence[Place]) -> Round:
        """Fly each vehicle of the last round to its next place, and take a reading there.

        One that leaves in this round has been sent on its way, which counts for the time, but does not read.

        Raises ValueError if none is left.
        """
        self._time.go(places, self.numbers)
        round_number = self._time.number
        there = sorted(
            {*self.numbers, *(each for each in self._joining if self._joins(each) == round_number)}
        )
        self.numbers = [each for each in there if round_number < self._leaving.get(each, math.inf)]
        if not self.numbers:
            raise ValueError(f"all vehicles have left before round {round_number}")
        readings = [self._reading(number - 1) for number in self.numbers]
        began = time.process_time()
        if gone := [each for each in self._forgotten if round_number == self._leaving[each]]:
            self._posterior = forget(self._posterior, gone, self._config)
        self._posterior = renewed(self._posterior, self._config)
        for reading in readings:
            self._posterior = assimilate(self._posterior, reading, self._config)
        said, particles = belief(self._posterior, readings[-1], self._config)
        for each in readings:
            first = self._read_at.get(each.vehicle, [each.position])[0]
            self._read_at[each.vehicle] = first, each.position
        stand = {
            each: self._time.places[each - 1]
            for each, (since, step) in self._joining.items()
            if since <= round_number < step
        }
        away = left_at(self._read_at, self.numbers, stand)
        said = msgspec.structs.replace(said, step=round_number, left_at=away)
        if len(self._time.places) > 1:
            stands = tuple(Stand(number, self._read_at[number][0]) for number in self.numbers)
            said = msgspec.structs.replace(said, stands=stands)
        return Round(readings, said, particles, self._posterior, time.process_time() - began)

    def _joins(self, vehicle: int) -> int:
        """Return the first round that a vehicle takes part in."""
        return self._joining.get(vehicle, (0, 0))[1]

    def _reading(self, vehicle: int) -> Reading:
        now, place, world = self._time, self._time.places[vehicle], self._time.worlds[vehicle]
        gas, wind = world.measure(place, now.number, now.time_s, self._before[vehicle])
        self._before[vehicle] = Before(place, now.time_s, gas)
        return Reading(now.number, place, world.problem.altitude_m, wind, gas, vehicle + 1)
