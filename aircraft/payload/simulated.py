"""The simulated payload: reads the mission's plume where the vehicle reports to be."""

import math

import msgspec

from aircraft.payload.messages import Question, Sample
from link.cli import BadInput
from plume.scenario import WorldError
from plume.worlds.world import World


class Simulated:
    """A sensor in a world.

    Its values depend on world, seed and question alone, so that it may start again at any time.
    """

    def __init__(self, world: World) -> None:
        """Take the world, and a first look at it: some worlds compile, which takes seconds.

        Raises BadInput if it fails.
        """
        self.world = world
        self._lost = -1
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
        gas, measured = world.measure(question.position, question.number, at_s)
        if world.loses(question.number) and question.number != self._lost:
            self._lost = question.number  # only the first time: then it is read again
            gas = math.nan
        return Sample(question.time_boot_ms, gas, wind or measured)


def turned(world: World, u: float | None, phi: float | None) -> World:
    """Return the world in another wind; None: its speed or direction as it was."""
    then = world.scenario
    u, phi = then.u if u is None else u, then.phi if phi is None else phi
    return World(msgspec.structs.replace(then, u=u, phi=phi), world.seed, world.sensor, world.name)
