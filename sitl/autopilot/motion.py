"""Closed-form motion: the position is a formula of time, never a sum of steps.

Every speed-up therefore sees the same positions.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from aircraft.state import ZERO, Ned
from plume.flight import profile

GRAVITY_MPS2 = 9.80665
# A target nearer than this (m) counts as reached, a vehicle slower than this (m/s) as at rest: its direction
# would be 0/0.
TINY = 1e-9
SAME_ROOT = 1e-6  # a root of a polynomial with a smaller imaginary part is real, but for rounding


class Limits(NamedTuple):
    """Speed limits (horizontal, up, down) and the acceleration along a line."""

    speed_mps: float
    climb_mps: float
    descent_mps: float
    accel_mps2: float


class Motion(NamedTuple):
    """Position, velocity and acceleration at one instant, NED."""

    position: Ned
    velocity: Ned = ZERO
    acceleration: Ned = ZERO


class Phase(NamedTuple):
    """A stretch of constant acceleration, defined by the known motion at one instant of it.

    A phase that ends at rest is defined at its end. Rounding then cannot carry the vehicle past it,
    through the ground or the fence.
    """

    start_s: float
    end_s: float
    known_s: float
    known: Motion

    def at(self, t_s: float) -> Motion:
        """Motion at a time of the phase."""
        dt = max(t_s, self.start_s) - self.known_s
        position, velocity, acceleration = self.known
        return Motion(
            along(along(position, velocity, dt), acceleration, dt * dt / 2.0),
            along(velocity, acceleration, dt),
            acceleration,
        )


class Trajectory(NamedTuple):
    """Consecutive phases, then rest. The final position equals the target bit for bit."""

    start_s: float
    target: Ned
    phases: tuple[Phase, ...] = ()

    @property
    def end_s(self) -> float:
        """Time at which the path comes to rest."""
        return self.phases[-1].end_s if self.phases else self.start_s

    def at(self, t_s: float) -> Motion:
        """Motion at a time not before the start."""
        for phase in self.phases:
            if t_s < phase.end_s:
                return phase.at(t_s)
        return Motion(self.target)

    def to(self, target: Ned, limits: Limits) -> "Trajectory":
        """Return this trajectory and a straight leg to a new target: speed up, cruise, slow down."""
        difference = minus(target, self.target)
        length = math.hypot(*difference)
        if length < TINY:
            return self._replace(target=target)
        direction = times(difference, 1.0 / length)
        accel = limits.accel_mps2
        leg = profile(length, _speed_limit(direction, limits), accel)
        peak, ramp_s, ramp_m, cruise_s = map(float, leg)

        started_s = self.end_s
        fast_s = started_s + ramp_s
        slowing_s = fast_s + cruise_s
        stopped_s = slowing_s + ramp_s
        speed_up, slow_down = times(direction, accel), times(direction, -accel)
        phases = (
            Phase(started_s, fast_s, started_s, Motion(self.target, ZERO, speed_up)),
            Phase(
                fast_s,
                slowing_s,
                fast_s,
                Motion(along(self.target, direction, ramp_m), times(direction, peak)),
            ),
            Phase(slowing_s, stopped_s, stopped_s, Motion(target, ZERO, slow_down)),
        )
        return Trajectory(self.start_s, target, self.phases + phases)


def halt(t_s: float, motion: Motion, limits: Limits) -> Trajectory:
    """Brake to rest along the current direction; a vehicle at rest stays where it is."""
    speed = math.hypot(*motion.velocity)
    if speed < TINY:
        return Trajectory(t_s, motion.position)
    direction, end_s = times(motion.velocity, 1.0 / speed), t_s + speed / limits.accel_mps2
    north, east, down = along(motion.position, direction, speed * speed / limits.accel_mps2 / 2.0)
    stop = north, east, min(down, 0.0)  # rounding must not put it below the ground
    return Trajectory(
        t_s, stop, (Phase(t_s, end_s, end_s, Motion(stop, ZERO, times(direction, -limits.accel_mps2))),)
    )


def fall(t_s: float, motion: Motion) -> Trajectory:
    """Fall to the ground (down = 0) with the motors off and without air drag; rest at the point of impact."""
    height, climb = -motion.position[2], -motion.velocity[2]
    duration = (climb + math.sqrt(climb * climb + 2.0 * GRAVITY_MPS2 * max(height, 0.0))) / GRAVITY_MPS2
    end_s, gravity = t_s + duration, (0.0, 0.0, GRAVITY_MPS2)
    north, east, _ = along(motion.position, motion.velocity, duration)
    impact = Motion((north, east, 0.0), along(motion.velocity, gravity, duration), gravity)
    return Trajectory(t_s, impact.position, (Phase(t_s, end_s, end_s, impact),))


class Turn(NamedTuple):
    """A yaw turn at a constant rate. It ends exactly on its target, or never. Yaw is clockwise from north."""

    start_s: float
    start_rad: float
    rate_radps: float
    end_s: float = math.inf
    target_rad: float = math.nan

    def at(self, t_s: float) -> tuple[float, float]:
        """Return (yaw in [−π, π] rad, yaw rate in rad/s) at a time not before the start."""
        if t_s >= self.end_s:
            return self.target_rad, 0.0
        return wrapped(self.start_rad + self.rate_radps * max(t_s - self.start_s, 0.0)), self.rate_radps

    def stopped(self, t_s: float) -> "Turn":
        """Return this turn, which ends on its target, or without one its end at a time."""
        return self if self.end_s < math.inf else turn(t_s, self.at(t_s)[0], self.at(t_s)[0], 1.0)


def turn(t_s: float, start_rad: float, target_rad: float, rate_radps: float) -> Turn:
    """Return the turn to a yaw, the shorter way round."""
    angle = wrapped(target_rad - start_rad)
    return Turn(t_s, start_rad, math.copysign(rate_radps, angle), t_s + abs(angle) / rate_radps, target_rad)


def wrapped(angle_rad: float) -> float:
    """The same angle in [−π, π]."""
    return angle_rad if -math.pi <= angle_rad <= math.pi else math.remainder(angle_rad, 2.0 * math.pi)


def tilt(acceleration: Ned, yaw_rad: float) -> tuple[float, float]:
    """Return (roll, pitch) in rad of a multirotor that accelerates (NED, m/s²), without air drag."""
    north, east, down = acceleration
    forward = north * math.cos(yaw_rad) + east * math.sin(yaw_rad)
    right = east * math.cos(yaw_rad) - north * math.sin(yaw_rad)
    weight = GRAVITY_MPS2 - down
    if forward == right == weight == 0.0:  # free fall: without thrust the attitude is undefined
        return 0.0, 0.0
    return math.atan2(right, math.hypot(forward, weight)), math.atan2(-forward, weight)


def stretches(start_s: float, end_s: float, crossings: Iterable[float]) -> Iterator[tuple[float, float]]:
    """Return the stretches into which crossings cut the time from start to end."""
    return itertools.pairwise(sorted({start_s, *(at for at in crossings if start_s < at < end_s), end_s}))


def first_exit_s(
    is_inside: Callable[[float], bool],
    stretches: Iterable[tuple[float, float]],
    since_s: float,
    outside: bool = False,
) -> float:
    """Return the last time before something leaves a region for the first time; infinity if it stays inside.

    stretches: (start, end) in s, in order, such that the region's edge is crossed between them only; so one
    look at the middle of each tells. The time itself is bisected down to neighbouring floats.
    outside: it is outside at `since_s`, so it has to come in first.
    """
    inside_s = since_s
    for start_s, end_s in stretches:
        middle_s = (start_s + end_s) / 2.0
        if is_inside(middle_s):
            inside_s, outside = middle_s, False
        elif not outside:
            outside_s = middle_s
            while inside_s < (middle_s := (inside_s + outside_s) / 2.0) < outside_s:
                if is_inside(middle_s):
                    inside_s = middle_s
                else:
                    outside_s = middle_s
            return inside_s
    return math.inf


def real_roots(coefficients: Iterable[float]) -> list[float]:
    """Return the real roots of a polynomial, highest power first; one of even order may come twice."""
    return [root.real for root in np.roots(list(coefficients)).tolist() if abs(root.imag) < SAME_ROOT]


def _speed_limit(direction: Ned, limits: Limits) -> float:
    """Highest speed (m/s) along a unit vector within the horizontal and vertical limits."""
    horizontal, down = math.hypot(direction[0], direction[1]), direction[2]
    return min(
        limits.speed_mps / horizontal if horizontal > 0.0 else math.inf,
        limits.descent_mps / down if down > 0.0 else math.inf,
        limits.climb_mps / -down if down < 0.0 else math.inf,
    )


def minus(a: Ned, b: Ned) -> Ned:
    """Return a − b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def times(a: Ned, factor: float) -> Ned:
    """Return a · factor."""
    return a[0] * factor, a[1] * factor, a[2] * factor


def along(start: Ned, direction: Ned, distance: float) -> Ned:
    """Return start + direction · distance."""
    return (
        start[0] + direction[0] * distance,
        start[1] + direction[1] * distance,
        start[2] + direction[2] * distance,
    )
