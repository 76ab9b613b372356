"""Closed-form motion: the position is a formula of time, never a sum of steps. Every speed-up therefore
sees the same positions.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from aircraft.state import ZERO, Ned

GRAVITY_MPS2 = 9.80665

NOTHING = 1e-9
"""A target nearer than this (m) counts as reached, a vehicle slower than this (m/s) as at rest: its
direction would be 0/0.
"""
SHORTEST_S = 1e-11
"""How exactly the moment is found at which a vehicle must brake."""
ROUNDING_M = 1e-12
"""By how much rounding may put a vehicle over an edge."""
MOST_SPANS = 2000
"""How many spans of time are looked at to find it; then it brakes early. Flights need a few tens."""


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


class Box(NamedTuple):
    """Where the vehicle may be: the lowest and the highest north, east and down, m from home."""

    low: Ned
    high: Ned

    def within(self, position: Ned) -> Ned:
        """The nearest position inside; what is all but on an edge is on it."""
        north, east, down = (
            low if at - low < NOTHING else high if high - at < NOTHING else at
            for at, low, high in zip(position, self.low, self.high, strict=True)
        )
        return north, east, down


class Push(NamedTuple):
    """A constant acceleration (NED, m/s²) for a duration, s, and the velocity that it leads to, m/s."""

    acceleration: Ned
    duration_s: float
    velocity: Ned


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
            _along(_along(position, velocity, dt), acceleration, dt * dt / 2.0),
            _along(velocity, acceleration, dt),
            acceleration,
        )


class Trajectory(NamedTuple):
    """Consecutive phases, then rest exactly on the target: the final position equals the target bit for
    bit.
    """

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
        """This trajectory plus a straight leg from its end to a new target: speed up, cruise (if long
        enough), slow down.
        """
        difference = _minus(target, self.target)
        length = math.hypot(*difference)
        if length < NOTHING:
            return self._replace(target=target)
        direction = _times(difference, 1.0 / length)
        accel = limits.accel_mps2
        peak = min(_speed_limit(direction, limits), math.sqrt(accel * length))
        ramp_s, ramp_m = peak / accel, peak * peak / accel / 2.0
        cruise_m = max(length - 2.0 * ramp_m, 0.0)

        started_s = self.end_s
        fast_s = started_s + ramp_s
        slowing_s = fast_s + cruise_m / peak
        stopped_s = slowing_s + ramp_s
        speed_up, slow_down = _times(direction, accel), _times(direction, -accel)
        phases = (
            Phase(started_s, fast_s, started_s, Motion(self.target, ZERO, speed_up)),
            Phase(
                fast_s,
                slowing_s,
                fast_s,
                Motion(_along(self.target, direction, ramp_m), _times(direction, peak)),
            ),
            Phase(slowing_s, stopped_s, stopped_s, Motion(target, ZERO, slow_down)),
        )
        return Trajectory(self.start_s, target, self.phases + phases)


def halt(t_s: float, motion: Motion, limits: Limits) -> Trajectory:
    """Brake to rest along the current direction; a vehicle at rest stays where it is."""
    speed = math.hypot(*motion.velocity)
    if speed < NOTHING:
        return Trajectory(t_s, motion.position)
    direction, end_s = _times(motion.velocity, 1.0 / speed), t_s + speed / limits.accel_mps2
    north, east, down = _along(motion.position, direction, speed * speed / limits.accel_mps2 / 2.0)
    stop = (
        north,
        east,
        min(down, 0.0),
    )  # every leg ends on or above the ground; rounding must not put the stop below it
    return Trajectory(
        t_s, stop, (Phase(t_s, end_s, end_s, Motion(stop, ZERO, _times(direction, -limits.accel_mps2))),)
    )


def steer(t_s: float, motion: Motion, pushes: Sequence[Push], limits: Limits, box: Box) -> Trajectory:
    """Accelerate as told and cruise on, but brake in time to come to rest on the box's edge instead of
    leaving it.

    At each moment of the way, to brake to rest (`halt`) ends inside the box. A push that would break this
    is broken off: the vehicle brakes at the last moment. The way ends at rest, since the box is finite. A
    vehicle that is outside can only come nearer.
    """
    began_s = t_s
    phases: list[Phase] = []
    motion = motion._replace(velocity=_moving(motion.velocity))
    stop = halt(t_s, motion, limits).target
    box = Box(*(_each(bound, edge, stop) for bound, edge in ((min, box.low), (max, box.high))))
    for push in pushes:
        lasts_s = _safe_s(motion, push, limits.accel_mps2, box)
        phase = Phase(t_s, t_s + lasts_s, t_s, motion._replace(acceleration=push.acceleration))
        position, velocity, _ = phase.at(phase.end_s)
        phases, t_s = [*phases, phase], phase.end_s
        if lasts_s < push.duration_s:
            stopping = halt(t_s, Motion(position, velocity), limits)
            return _ending(began_s, tuple(phases), stopping, box.within(stopping.target))
        motion = Motion(position, _moving(push.velocity))
    stopping = halt(t_s, motion, limits)
    if not stopping.phases:
        return _ending(began_s, tuple(phases), stopping, box.within(motion.position))
    leaves_s, edge = _way_out(motion, box)
    cruise_s = (
        leaves_s - (stopping.end_s - t_s) / 2.0
    )  # to brake takes half the way that cruising makes in the same time
    if cruise_s <= 0.0:
        return _ending(began_s, tuple(phases), stopping, box.within(stopping.target))
    phases.append(Phase(t_s, t_s + cruise_s, t_s, motion))
    return _ending(began_s, tuple(phases), halt(t_s + cruise_s, motion, limits), edge)


def _ending(began_s: float, phases: tuple[Phase, ...], stopping: Trajectory, stop: Ned) -> Trajectory:
    """A way that ends with braking to rest at `stop`."""
    brakes = tuple(phase._replace(known=phase.known._replace(position=stop)) for phase in stopping.phases)
    return Trajectory(began_s, stop, phases + brakes)


def _way_out(motion: Motion, box: Box) -> tuple[float, Ned]:
    """When a vehicle that flies straight on leaves the box, s from now, and where."""
    ways = []
    for axis, (at, speed) in enumerate(zip(motion.position, motion.velocity, strict=True)):
        edge = box.high[axis] if speed > 0.0 else box.low[axis]
        if speed != 0.0:
            ways.append((max((edge - at) / speed, 0.0), axis, edge))
    leaves_s, through, edge = min(ways)
    out = list(box.within(_along(motion.position, motion.velocity, leaves_s)))
    out[through] = edge
    north, east, down = out
    return leaves_s, (north, east, down)


def _safe_s(motion: Motion, push: Push, accel: float, box: Box) -> float:
    """How long a push may last if braking at any moment of it must end inside the box, s.

    Spans of time for which that can be shown are safe; others are halved, the earlier half first, until
    they are too short to matter.
    """
    phase = Phase(0.0, push.duration_s, 0.0, motion._replace(acceleration=push.acceleration))
    spans = [(0.0, push.duration_s)]
    for _ in range(MOST_SPANS):
        if not spans:
            return push.duration_s
        start_s, end_s = spans.pop()
        if _is_safe(phase.at(start_s), phase.at(end_s), end_s - start_s, accel, box):
            continue
        middle_s = (start_s + end_s) / 2.0
        if end_s - start_s < SHORTEST_S:
            return start_s
        spans += [(middle_s, end_s), (start_s, middle_s)]
    return spans[-1][0] if spans else push.duration_s


def _is_safe(start: Motion, end: Motion, lasts_s: float, accel: float, box: Box) -> bool:
    """Whether braking at any moment of a span of constant acceleration ends inside the box; False if it
    cannot be shown.

    With position p, velocity v of direction e, and acceleration g, braking ends at s = p + v|v|/2a. This
    point moves at ds/dt = |v| (e (1 + e·g/2a) + g/2a): slow or fast by |v|, to where e tells. Both are
    bounded over the span.
    """
    speeds = math.hypot(*start.velocity), math.hypot(*end.velocity)
    push = _times(start.acceleration, 0.5 / accel)
    fastest, slowest = max(speeds), max(max(speeds) - math.hypot(*start.acceleration) * lasts_s, 0.0)
    first, last = (
        _times(at.velocity, 1.0 / speed) if speed > NOTHING else None
        for at, speed in zip((start, end), speeds, strict=True)
    )
    heads = first or last or ZERO, last or first or ZERO  # from rest and to rest it flies straight
    bulge = 1.0 / math.sqrt(
        max(1.0 - (math.dist(*heads) / 2.0) ** 2, NOTHING)
    )  # of the arc between them, over the chord
    least, most = (
        1.0 + _dot(head, push) for head in heads
    )  # it only grows: the velocity turns towards the acceleration
    for axis in range(3):
        stops = [
            at.position[axis] + at.velocity[axis] * speed / (2.0 * accel)
            for at, speed in zip((start, end), speeds, strict=True)
        ]
        for sign, edge in ((1.0, box.high[axis]), (-1.0, -box.low[axis])):
            inwards, outwards = sorted((sign * heads[0][axis], sign * heads[1][axis]))
            inwards, outwards = (
                max(inwards * (bulge if inwards < 0.0 else 1.0), -1.0),
                min(outwards * (bulge if outwards > 0.0 else 1.0), 1.0),
            )
            quickest = outwards * (most if outwards > 0.0 else least) + sign * push[axis]
            backwards = inwards * (least if inwards > 0.0 else most) + sign * push[axis]
            on_m = lasts_s * max(quickest * (fastest if quickest > 0.0 else slowest), 0.0)
            back_m = lasts_s * max(-backwards * (fastest if backwards < 0.0 else slowest), 0.0)
            if min(sign * stops[0] + on_m, sign * stops[1] + back_m) > edge + ROUNDING_M:
                return False
    return True


def fall(t_s: float, motion: Motion) -> Trajectory:
    """Fall to the ground (down = 0) with the motors off and without air drag, then rest at the impact
    point.
    """
    height, climb = -motion.position[2], -motion.velocity[2]
    duration = (climb + math.sqrt(climb * climb + 2.0 * GRAVITY_MPS2 * max(height, 0.0))) / GRAVITY_MPS2
    end_s, gravity = t_s + duration, (0.0, 0.0, GRAVITY_MPS2)
    north, east, _ = _along(motion.position, motion.velocity, duration)
    impact = Motion((north, east, 0.0), _along(motion.velocity, gravity, duration), gravity)
    return Trajectory(t_s, impact.position, (Phase(t_s, end_s, end_s, impact),))


class Turn(NamedTuple):
    """A yaw turn at a constant rate, the shorter way round; it ends exactly on the target."""

    start_s: float
    start_rad: float
    target_rad: float
    rate_radps: float

    @property
    def end_s(self) -> float:
        """Time at which the target yaw is reached."""
        return self.start_s + abs(self._angle()) / self.rate_radps

    def at(self, t_s: float) -> tuple[float, float]:
        """(yaw in rad, yaw rate in rad/s) at a time not before the start; yaw is clockwise from north, in
        [−π, π].
        """
        if t_s >= self.end_s:
            return self.target_rad, 0.0
        rate = math.copysign(self.rate_radps, self._angle())
        return wrapped(self.start_rad + rate * max(t_s - self.start_s, 0.0)), rate

    def stopped(self, _t_s: float) -> "Turn":
        """The turn itself: it stops at its target."""
        return self

    def _angle(self) -> float:
        return wrapped(self.target_rad - self.start_rad)


class Spin(NamedTuple):
    """A yaw turn at a constant rate that goes on until something else is asked for."""

    start_s: float
    start_rad: float
    rate_radps: float

    @property
    def end_s(self) -> float:
        """It has no end."""
        return math.inf

    def at(self, t_s: float) -> tuple[float, float]:
        """(yaw in rad, yaw rate in rad/s) at a time not before the start; yaw is clockwise from north, in
        [−π, π].
        """
        return wrapped(self.start_rad + self.rate_radps * max(t_s - self.start_s, 0.0)), self.rate_radps

    def stopped(self, t_s: float) -> Turn:
        """The end of the turn at a time."""
        yaw_rad, _ = self.at(t_s)
        return Turn(t_s, yaw_rad, yaw_rad, abs(self.rate_radps))


def wrapped(angle_rad: float) -> float:
    """The same angle in [−π, π]."""
    return angle_rad if -math.pi <= angle_rad <= math.pi else math.remainder(angle_rad, 2.0 * math.pi)


def tilt(acceleration: Ned, yaw_rad: float) -> tuple[float, float]:
    """(roll, pitch) in rad of a multirotor whose thrust and gravity give this acceleration (NED, m/s²),
    without air drag.
    """
    north, east, down = acceleration
    forward = north * math.cos(yaw_rad) + east * math.sin(yaw_rad)
    right = east * math.cos(yaw_rad) - north * math.sin(yaw_rad)
    weight = GRAVITY_MPS2 - down
    if forward == right == weight == 0.0:  # free fall: without thrust the attitude is undefined
        return 0.0, 0.0
    return math.atan2(right, math.hypot(forward, weight)), math.atan2(-forward, weight)


def _speed_limit(direction: Ned, limits: Limits) -> float:
    """Highest speed (m/s) along a unit vector whose horizontal and vertical parts stay within their
    limits.
    """
    horizontal, down = math.hypot(direction[0], direction[1]), direction[2]
    vertical_limit = limits.descent_mps if down > 0.0 else limits.climb_mps
    return min(
        limits.speed_mps / horizontal if horizontal > 0.0 else math.inf,
        vertical_limit / abs(down) if down != 0.0 else math.inf,
    )


def _each(pick: Callable[[float, float], float], a: Ned, b: Ned) -> Ned:
    return pick(a[0], b[0]), pick(a[1], b[1]), pick(a[2], b[2])


def _moving(velocity: Ned) -> Ned:
    """The velocity without what is left of it by rounding."""
    north, east, down = (speed if abs(speed) >= NOTHING else 0.0 for speed in velocity)
    return north, east, down


def _dot(a: Ned, b: Ned) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _minus(a: Ned, b: Ned) -> Ned:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _times(a: Ned, factor: float) -> Ned:
    return a[0] * factor, a[1] * factor, a[2] * factor


def _along(start: Ned, direction: Ned, distance: float) -> Ned:
    return (
        start[0] + direction[0] * distance,
        start[1] + direction[1] * distance,
        start[2] + direction[2] * distance,
    )
