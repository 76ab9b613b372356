"""The time of a fleet's rounds, by which the gas moves: it follows from where all vehicles go."""

from collections.abc import Sequence

from plume.flight import ACCEL_MPS2, SPEED_MPS, TRY_AGAIN_S, leg_s
from plume.worlds.world import World

Place = tuple[float, float]  # (x, y) m


class RoundTime:
    """When each round of a mission takes its readings.

    Vehicles wait for each other: a round takes as long as that of them which is there last.
    """

    def __init__(
        self,
        world: World,
        starts: Sequence[Place],
        speed_mps: float = SPEED_MPS,
        accel_mps2: float = ACCEL_MPS2,
    ) -> None:
        """Take the world as vehicle 1 measures it, and where the vehicles are."""
        self.worlds = [world.of_vehicle(vehicle + 1) for vehicle in range(len(starts))]
        self.places = list(starts)
        self.number = -1  # of the round whose time is `time_s`; -1 before the first
        self.time_s = 0.0
        self._motion = speed_mps, accel_mps2

    def go(self, places: Sequence[Place], numbers: Sequence[int] | None = None) -> None:
        """Fly vehicles to their next places; `time_s` is then the time of the readings there.

        numbers: those of the vehicles, from 1, in their order; None: all. Those that have left stay behind.
        """
        self.number += 1
        flown = range(len(self.places)) if numbers is None else [number - 1 for number in numbers]
        self.time_s += max(
            float(leg_s(self.places[vehicle], end, *self._motion))
            + self.worlds[vehicle].sensor.dwell
            + TRY_AGAIN_S * self.worlds[vehicle].loses(self.number)
            for vehicle, end in zip(flown, places, strict=True)
        )
        while self.worlds[0].warms_up(self.time_s):
            self.time_s += TRY_AGAIN_S
        for vehicle, end in zip(flown, places, strict=True):
            self.places[vehicle] = end
