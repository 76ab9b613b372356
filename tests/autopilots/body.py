"""How the double's vehicle moves: second order, with limits, so that a long leg ends with an overshoot of
about 0.4 m.

A step of 1 m is within 0.3 m after 1.6 s and within 0.1 m after 2.0 s, as measured on ArduCopter 4.6.3.
"""

import math
from dataclasses import dataclass, field

DT_S = 0.02
DAMPING, FREQUENCY_RADPS = 0.65, 1.2
POSITION_GAIN = FREQUENCY_RADPS / 2.0 / DAMPING
VELOCITY_GAIN = 2.0 * DAMPING * FREQUENCY_RADPS
ACCEL_MPS2, ACCEL_Z_MPS2 = 2.7, 2.5
GRAVITY_MPS2 = 9.80665

Vector = tuple[float, float, float]
"""North, east, down."""
NAN = math.nan
FREE: Vector = (NAN, NAN, NAN)
"""A place that does not matter: the velocity leads."""
STILL: Vector = (0.0, 0.0, 0.0)


@dataclass
class Body:
    """A multirotor: position (m) from the EKF's origin and velocity (m/s), north, east, down. The ground
    is flat.
    """

    position: list[float]
    velocity: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    acceleration: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    ground: float = field(init=False)

    def __post_init__(self) -> None:
        self.ground = self.position[2]

    @property
    def landed(self) -> bool:
        """Whether it stands on the ground."""
        return self.position[2] >= self.ground

    @property
    def height_m(self) -> float:
        """Height above the ground."""
        return self.ground - self.position[2]

    def fly(self, place: Vector, velocity: Vector, speed: float, climb: float, descent: float) -> None:
        """Fly for one time step to a place; where the place is NaN, the velocity leads. Limits in m/s."""
        wanted = [
            v if math.isnan(p) else POSITION_GAIN * (p - at)
            for p, v, at in zip(place, velocity, self.position, strict=True)
        ]
        north, east = _within(wanted[0], wanted[1], speed)
        down = max(-climb, min(descent, wanted[2]))
        a_north, a_east = _within(
            VELOCITY_GAIN * (north - self.velocity[0]), VELOCITY_GAIN * (east - self.velocity[1]), ACCEL_MPS2
        )
        a_down = max(-ACCEL_Z_MPS2, min(ACCEL_Z_MPS2, VELOCITY_GAIN * (down - self.velocity[2])))
        self._move([a_north, a_east, a_down])

    def fall(self) -> None:
        """Motors off for one time step: it rests on the ground, or falls."""
        self._move([0.0, 0.0, GRAVITY_MPS2])

    def rest(self) -> None:
        """Stand still on the ground."""
        self.velocity, self.acceleration = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]

    def _move(self, acceleration: list[float]) -> None:
        self.acceleration = acceleration
        for axis in range(3):
            self.velocity[axis] += acceleration[axis] * DT_S
            self.position[axis] += self.velocity[axis] * DT_S
        if self.position[2] >= self.ground:
            self.position[2] = self.ground
            if self.velocity[2] >= 0.0:
                self.rest()


def _within(north: float, east: float, most: float) -> tuple[float, float]:
    """The same direction, at most this long."""
    length = math.hypot(north, east)
    return (north, east) if length <= most else (north * most / length, east * most / length)
