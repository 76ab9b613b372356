"""The simulated payload: reads the mission's plume where the vehicle reports to be."""

import math

import msgspec

from aircraft.payload.messages import Question, Sample, WindVector
from plume.world import World


class Simulated:
    """A sensor in a world.

    Its values depend on world, seed and question alone, so that it may start again at any time.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self._lost = -1

    def __call__(self, question: Question) -> Sample:
        """Measure once.

        The plume blows with the wind of the question; without one, with that of the scenario.
        """
        world = self.world if question.wind is None else blown(self.world, question.wind)
        wind = question.wind or world.wind
        if world.loses(question.number) and question.number != self._lost:
            self._lost = question.number  # only the first time: then it is read again
            return Sample(question.time_boot_ms, math.nan, wind)
        return Sample(question.time_boot_ms, world.gas(question.position, question.number), wind)


def blown(world: World, wind: WindVector) -> World:
    """Return the world in another measured wind, m/s, which points to where it comes from."""
    if wind == world.wind:
        return world  # to the last bit: direction and speed of float32 components are not the scenario's
    return turned(world, math.hypot(*wind), math.atan2(wind[1], wind[0]))


def turned(world: World, u: float | None, phi: float | None) -> World:
    """Return the world in another wind; None: its speed or direction as it was."""
    then = world.scenario
    u, phi = then.u if u is None else u, then.phi if phi is None else phi
    return World(msgspec.structs.replace(then, u=u, phi=phi), world.seed, world.sensor, world.name)
