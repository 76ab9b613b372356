"""The simulated payload: reads the mission's plume where the vehicle reports to be."""

import math

import msgspec

from aircraft.payload.messages import Question, Sample
from link.cli import BadInput
from plume.scenario import WorldError
from plume.worlds.exposure import Before
from plume.worlds.world import World


class Simulated:
    """A sensor in a world.

    Its values depend on world, seed and question alone, and of a sensor that lags on the reading before: one
    that starts again has been in clean air.
    """

    def __init__(self, world: World) -> None:
        """Take the world, and a first look at it: some worlds compile, which takes seconds.

        Raises BadInput if it fails.
        """
        self.world = world
        self._lost = -1
        self._number, self._latest = -1, Before(world.start, 0.0, 0.0)  # the newest reading
        self._before: Before | None = None  # the one before it
        try:
            world.measure(world.start, 0)
        except WorldError as error:
            raise BadInput(f"--world: {error}") from error

    def __call__(self, question: Question, time_s: float | None = None) -> Sample:
        """Measure once.

        The plume blows with the wind of the question; without one, with that of the scenario.
        time_s: of the mission; by default that of the question.
        """
        world, wind = self.world, question.wind
        if wind and wind != world.wind:  # else to the last bit as it is: these are float32 components
            world = turned(world, math.hypot(*wind), math.atan2(wind[1], wind[0]))
        at_s = question.time_boot_ms / 1000.0 if time_s is None else time_s
        if question.number != self._number:
            self._before = self._latest if question.number == self._number + 1 and self._number >= 0 else None
        gas, measured = world.measure(question.position, question.number, at_s, self._before)
        self._number, self._latest = question.number, Before(question.position, at_s, gas)
        if world.warms_up(at_s):
            gas = math.nan
        elif world.loses(question.number) and question.number != self._lost:
            self._lost = question.number  # only the first time: then it is read again
            gas = math.nan
        return Sample(question.time_boot_ms, gas, wind or measured)


def turned(world: World, u: float | None, phi: float | None) -> World:
    """Return the world in another wind; None: its speed or direction as it was."""
    then = world.scenario
    u, phi = then.u if u is None else u, then.phi if phi is None else phi
    return World(msgspec.structs.replace(then, u=u, phi=phi), world.seed, world.sensor, world.name)
