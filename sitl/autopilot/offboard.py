"""How the vehicle follows a companion in OFFBOARD: the way of a setpoint, and when the companion was heard.

A velocity or an acceleration becomes pushes of constant acceleration, and a cruise. `steer` flies them and
brakes in time to come to rest on the edge of the area.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from aircraft.state import ZERO, Ned
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.motion import (
    TINY,
    Limits,
    Motion,
    Phase,
    Trajectory,
    Turn,
    along,
    first_exit_s,
    halt,
    minus,
    real_roots,
    stretches,
    times,
    turn,
    wrapped,
)
from sitl.autopilot.setpoint import Setpoint

SAME_PLACE_M = 1e-6  # a vehicle this close to where it shall be is there
CREEP_MPS = 1e-3  # a component below this counts as 0: a float32 yaw turns a velocity by that little
ROUNDING_M = 1e-12  # by how much rounding may put a vehicle over an edge
ROUNDING = 1e-12  # a coefficient that is smaller than the largest by this factor is 0, but for rounding


class Box(NamedTuple):
    """Where the vehicle may be: the lowest and the highest north, east and down, m from home."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def holds(self, position: Ned) -> bool:
        """True if a position is inside or on an edge."""
        return all(
            low - ROUNDING_M <= at <= high + ROUNDING_M
            for at, low, high in zip(position, self.low, self.high, strict=True)
        )

    def within(self, position: Ned) -> Ned:
        """Return the nearest position inside; what is all but on an edge is put on it."""
        north, east, down = (
            low if at - low < TINY else high if high - at < TINY else at
            for at, low, high in zip(position, self.low, self.high, strict=True)
        )
        return north, east, down

    def extended_to(self, position: Ned) -> "Box":
        """Return the smallest box that also holds a position."""
        return Box(tuple(map(min, self.low, position)), tuple(map(max, self.high, position)))


class Push(NamedTuple):
    """A constant acceleration (NED, m/s²) for a duration, s, and the velocity that it leads to, m/s."""

    acceleration: Ned
    duration_s: float
    velocity: Ned


# ---- steering inside a box ----


def steer(t_s: float, motion: Motion, pushes: Sequence[Push], limits: Limits, box: Box) -> Trajectory:
    """Fly pushes and cruise on, but brake in time to come to rest on the box's edge instead of leaving it.

    At each moment of the way, braking to rest (`halt`) ends inside the box: a push that would break this is
    broken off at the last moment. If braking now ends outside, the box is extended to there.
    """
    motion = motion._replace(velocity=_moving(motion.velocity))
    box = box.extended_to(halt(t_s, motion, limits).target)
    cruise, phases, now_s = _moving(pushes[-1].velocity), [], t_s
    if any(cruise):  # by the time that the way through the whole box takes, the vehicle has left it
        pushes = [*pushes, Push(ZERO, math.dist(box.low, box.high) / math.hypot(*cruise), cruise)]
    for push in pushes:
        lasts_s = safe_s(motion, push, limits.accel_mps2, box)
        phase = Phase(now_s, now_s + lasts_s, now_s, motion._replace(acceleration=push.acceleration))
        phases.append(phase)
        now_s = phase.end_s
        motion = Motion(*phase.at(now_s)[:2])
        if lasts_s < push.duration_s:
            break
        motion = motion._replace(velocity=_moving(push.velocity))
    brakes = halt(now_s, motion, limits)
    stop = box.within(brakes.target)
    phases += [phase._replace(known=phase.known._replace(position=stop)) for phase in brakes.phases]
    return Trajectory(t_s, stop, tuple(phases))


def safe_s(motion: Motion, push: Push, accel: float, box: Box) -> float:
    """Return how long a push may last so that braking at any moment of it ends inside the box, s.

    Let p(t) be the position during the push, v(t) = p'(t) the velocity, and a the acceleration of braking.
    Braking ends at s = p + v|v|/2a. So s lies on an edge, axis i at e, where

        2a (e − p_i) = v_i |v|.

    Squared, both sides are polynomials of degree 4, as p_i is of degree 2, v_i of degree 1, and v·v of 2:

        4a² (p_i − e)² − v_i² (v·v) = 0.

    Between neighbouring roots, of all axes and edges, s stays inside or stays outside. Squaring adds roots
    at which s is on no edge; they do no harm. The polynomials are in u = t/T, T being the push's duration.
    An edge further away than the vehicle gets at its fastest needs none.
    """
    lasts_s = push.duration_s
    phase = Phase(0.0, lasts_s, 0.0, motion._replace(acceleration=push.acceleration))
    speeds = [(g * lasts_s, v) for g, v in zip(push.acceleration, motion.velocity, strict=True)]
    speed_squared = np.sum([np.convolve(speed, speed) for speed in speeds], axis=0)
    fastest = max(math.hypot(*phase.at(t_s).velocity) for t_s in (0.0, lasts_s))
    reach_m = fastest * lasts_s + fastest * fastest / (2.0 * accel)
    crossings: list[float] = []
    for axis, (gain, speed) in enumerate(speeds):
        braking = np.convolve(np.convolve(speeds[axis], speeds[axis]), speed_squared)
        for edge in (box.low[axis], box.high[axis]):
            if abs(motion.position[axis] - edge) > reach_m:
                continue
            way = (gain * lasts_s / 2.0, speed * lasts_s, motion.position[axis] - edge)
            terms = 4.0 * accel * accel * np.convolve(way, way) - braking
            terms[np.abs(terms) < ROUNDING * np.abs(terms).max()] = 0.0  # the leading terms may cancel
            crossings += [root * lasts_s for root in real_roots(terms)]

    def stops_inside(t_s: float) -> bool:
        position, velocity, _ = phase.at(t_s)
        return box.holds(along(position, velocity, math.hypot(*velocity) / (2.0 * accel)))

    return min(first_exit_s(stops_inside, stretches(0.0, lasts_s, crossings), 0.0), lasts_s)


def _moving(velocity: Ned) -> Ned:
    """The velocity without what is left of it by rounding."""
    north, east, down = (speed if abs(speed) >= TINY else 0.0 for speed in velocity)
    return north, east, down


# ---- setpoints as pushes ----


def steered(setpoint: Setpoint, t_s: float, motion: Motion, config: VehicleConfig) -> Trajectory:
    """Return the way of a velocity or an acceleration, which ends at rest, at the latest on an edge.

    On the ground, only what climbs moves the vehicle.
    """
    limits, pushes = config.limits, _pushes(setpoint, motion, config.limits)
    if motion.position[2] >= 0.0 and all(push.acceleration[2] >= 0.0 for push in pushes):
        return halt(t_s, motion, limits)
    (west, south), (east, north) = config.flown.low, config.flown.high
    box = Box((south, west, -config.ceiling_m), (north, east, 0.0))
    return steer(t_s, motion, pushes, limits, box)


def wants_to_move(setpoint: Setpoint, limits: Limits) -> bool:
    """True if a setpoint is a velocity or an acceleration, and not 0."""
    return any(clamped(setpoint.velocity, limits) if setpoint.velocity else setpoint.acceleration or ZERO)


def clamped(velocity: Ned, limits: Limits) -> Ned:
    """Return a velocity within the speed limits, m/s; its horizontal part keeps its direction."""
    north, east, down = (speed if abs(speed) >= CREEP_MPS else 0.0 for speed in velocity)
    horizontal = math.hypot(north, east)
    factor = limits.speed_mps / horizontal if horizontal > limits.speed_mps else 1.0
    return north * factor, east * factor, min(max(down, -limits.climb_mps), limits.descent_mps)


def _pushes(setpoint: Setpoint, motion: Motion, limits: Limits) -> list[Push]:
    if setpoint.velocity is None:
        return [_accelerate(motion.velocity, setpoint.acceleration or ZERO, limits)]
    north, east, down = clamped(setpoint.velocity, limits)
    if setpoint.down_m is None:
        return [_change(motion.velocity, (north, east, down), limits.accel_mps2)]
    height_m = setpoint.down_m - motion.position[2]
    if abs(height_m) < SAME_PLACE_M and abs(motion.velocity[2]) < TINY:
        return [_change(motion.velocity, (north, east, 0.0), limits.accel_mps2)]
    return _change_at_height(motion, (north, east), height_m, limits)


def _change(start: Ned, end: Ned, accel: float) -> Push:
    """From one velocity to another along a straight line in velocity space, at the acceleration limit."""
    difference = minus(end, start)
    size = math.hypot(*difference)
    if size < TINY:
        return Push(ZERO, 0.0, end)
    return Push(times(difference, accel / size), size / accel, end)


def _change_at_height(
    motion: Motion, horizontal: tuple[float, float], height_m: float, limits: Limits
) -> list[Push]:
    """To a horizontal velocity, and down by `height_m` on the way, then level. Units m and m/s."""
    accel, (north, east) = limits.accel_mps2, horizontal

    def left_m(down: float) -> float:
        """What is left of the height after reaching a vertical speed and levelling off again."""
        push = _change(motion.velocity, (north, east, down), accel)
        changing_m = (motion.velocity[2] + down) / 2.0 * push.duration_s
        return height_m - changing_m - down * abs(down) / (2.0 * accel)

    slow, fast = -limits.climb_mps, limits.descent_mps
    if left_m(fast) > 0.0:
        down = fast
    elif left_m(slow) < 0.0:
        down = slow
    else:
        for _ in range(60):
            down = (slow + fast) / 2.0
            slow, fast = (down, fast) if left_m(down) > 0.0 else (slow, down)
        down = slow
    cruising: Ned = (north, east, down)
    cruise_s = left_m(down) / down if abs(down) > TINY else 0.0
    return [
        _change(motion.velocity, cruising, accel),
        Push(ZERO, max(cruise_s, 0.0), cruising),
        _change(cruising, (north, east, 0.0), accel),
    ]


def _accelerate(velocity: Ned, acceleration: Ned, limits: Limits) -> Push:
    """Accelerate until the first speed limit is reached."""
    size = math.hypot(*acceleration)
    if size < TINY:
        return Push(ZERO, 0.0, velocity)
    north, east, down = times(acceleration, min(limits.accel_mps2 / size, 1.0))
    lasts_s = []
    if down:
        limit = limits.descent_mps if down > 0.0 else -limits.climb_mps
        lasts_s.append((limit - velocity[2]) / down)
    if square := north * north + east * east:
        half = (velocity[0] * north + velocity[1] * east) / square
        over = (velocity[0] ** 2 + velocity[1] ** 2 - limits.speed_mps**2) / square
        lasts_s.append(math.sqrt(max(half * half - over, 0.0)) - half)
    t_s = max(min(lasts_s), 0.0)
    return Push((north, east, down), t_s, along(velocity, (north, east, down), t_s))


def facing(now: Turn, t_s: float, setpoint: Setpoint, config: VehicleConfig) -> Turn:
    """Return how the vehicle turns once it has a setpoint: to its yaw, or at its yaw rate, or not at all."""
    yaw_rad, most = now.at(t_s)[0], math.radians(config.yaw_rate_dps)
    if setpoint.yaw_rad is not None:
        wanted = wrapped(setpoint.yaw_rad)
        return now if wanted == now.target_rad else turn(t_s, yaw_rad, wanted, most)
    rate = min(max(setpoint.yaw_rate_radps or 0.0, -most), most)
    if rate == 0.0:
        return now.stopped(t_s)
    return now if now.end_s == math.inf and now.rate_radps == rate else Turn(t_s, yaw_rad, rate)


# ---- when it was heard ----


class Companion:
    """The program that flies the vehicle in OFFBOARD: its newest setpoint, and when it was heard.

    Times in s of simulation time.
    """

    def __init__(self) -> None:
        self.setpoint: Setpoint | None = None
        self.heard_s = self._before_s = -math.inf  # the newest setpoint, and the one before

    def hear(self, setpoint: Setpoint, now_s: float) -> None:
        """Take an accepted setpoint."""
        self.setpoint, self._before_s, self.heard_s = setpoint, self.heard_s, now_s

    def missing(self, now_s: float, patience_s: float, streams: bool) -> str:
        """Return what OFFBOARD still needs: a recent setpoint, or a stream of 2 Hz or more; or nothing."""
        if self.setpoint is None:
            return "no setpoint received yet"
        age_s, gap_s = now_s - self.heard_s, self.heard_s - self._before_s
        if age_s > patience_s:
            return f"no setpoint in the last {round(patience_s, 1):g} s"
        # Two in the time after which a stream is lost: 2 Hz. A pause of twice that time is the end of an
        # earlier stream.
        slow = age_s > patience_s / 2.0 or patience_s / 2.0 < gap_s <= 2.0 * patience_s
        return "setpoints come at less than 2 Hz" if streams and slow else ""
