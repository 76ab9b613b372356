"""What a companion asks of the vehicle in OFFBOARD: a setpoint, the way it becomes, the reading it
answers, how long silence is borne.
"""

import math
from typing import NamedTuple

from aircraft.state import ZERO, Ned, Result, denied, metres
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.motion import (
    NOTHING,
    Box,
    Limits,
    Motion,
    Push,
    Spin,
    Trajectory,
    Turn,
    halt,
    steer,
    wrapped,
)

SAME_PLACE_M = 1e-6
"""A vehicle this close to where it shall be is there."""
CREEP_MPS = 1e-3
"""A component of a velocity below this counts as 0. A float32 yaw turns a velocity along the area's edge
by that little.
"""


class Setpoint(NamedTuple):
    """A position, a velocity, a velocity at a height, or an acceleration; vectors are NED, positions in m
    from home.

    Of several the first is flown. With neither a yaw nor a yaw rate the heading stays.
    """

    position: Ned | None = None
    velocity: Ned | None = None
    """m/s. Limited to the vehicle's speeds: its horizontal part keeps its direction, as in PX4."""
    down_m: float | None = None
    """The height to fly to, with a velocity whose own down is then ignored; None: none."""
    acceleration: Ned | None = None
    """m/s². Limited to the vehicle's acceleration. It acts until a speed limit is reached; then the
    vehicle cruises.
    """
    yaw_rad: float | None = None
    yaw_rate_radps: float | None = None
    """Without a yaw: turn at this rate until told otherwise; limited to the vehicle's rate of turns."""

    def same_way(self, other: "Setpoint | None") -> bool:
        """True if both ask for the same motion; the yaw may differ."""
        return other is not None and self[:4] == other[:4]

    def refusal(self, config: VehicleConfig) -> Result | None:
        """Return why it cannot be flown, if so."""
        angles = {"yaw": self.yaw_rad, "yaw rate": self.yaw_rate_radps}
        if wrong := [
            f"{name} {value}"
            for name, value in angles.items()
            if value is not None and not math.isfinite(value)
        ]:
            return denied(f"Waypoint refused: {wrong[0]} is not finite", "not finite")
        if self.position is not None:
            outside = config.outside(self.position)
            return outside and denied(f"Waypoint refused: {outside[1]}", outside[0])
        for name, vector in (("velocity", self.velocity), ("acceleration", self.acceleration)):
            if vector is not None and not all(map(math.isfinite, vector)):
                return denied(
                    f"Setpoint refused: {name} ({', '.join(map(metres, vector))}) is not finite", "not finite"
                )
        if self.down_m is not None and not 0.0 <= -self.down_m <= config.ceiling_m:
            high = f"altitude {metres(-self.down_m)} m is outside [0, {config.ceiling_m:g}] m"
            return denied(f"Setpoint refused: {high}", "outside the altitudes")
        return None

    def wants_to_move(self, config: VehicleConfig) -> bool:
        """True if it is a velocity or an acceleration, and not 0."""
        return (
            any(_clamped(self.velocity, config.limits)) if self.velocity else any(self.acceleration or ZERO)
        )

    def steered(self, t_s: float, motion: Motion, config: VehicleConfig) -> Trajectory:
        """Return the way of a velocity or an acceleration. It ends at rest, at the latest on the edge of
        the area or the altitudes.

        On the ground, only what climbs moves the vehicle.
        """
        limits, pushes = config.limits, self._pushes(motion, config.limits)
        climbs = any(push.acceleration[2] < 0.0 for push in pushes)
        if motion.position[2] >= 0.0 and not climbs:
            return halt(t_s, motion, limits)
        return steer(
            t_s,
            motion,
            pushes,
            limits,
            Box((0.0, 0.0, -config.ceiling_m), (config.area_m, config.area_m, 0.0)),
        )

    def _pushes(self, motion: Motion, limits: Limits) -> list[Push]:
        if self.velocity is None:
            return _accelerate(motion.velocity, self.acceleration or ZERO, limits)
        north, east, down = _clamped(self.velocity, limits)
        if self.down_m is None or (
            abs(self.down_m - motion.position[2]) < SAME_PLACE_M and abs(motion.velocity[2]) < NOTHING
        ):
            return _change(
                motion.velocity, (north, east, down if self.down_m is None else 0.0), limits.accel_mps2
            )
        return _change_at_height(motion, (north, east), self.down_m - motion.position[2], limits)


def facing(turn: Turn | Spin, t_s: float, setpoint: Setpoint, config: VehicleConfig) -> Turn | Spin:
    """Return how the vehicle turns once it has a setpoint: to its yaw, or at its yaw rate, or not at all."""
    yaw_rad, most = turn.at(t_s)[0], math.radians(config.yaw_rate_dps)
    if setpoint.yaw_rad is not None:
        wanted = wrapped(setpoint.yaw_rad)
        return (
            turn if isinstance(turn, Turn) and wanted == turn.target_rad else Turn(t_s, yaw_rad, wanted, most)
        )
    rate = min(max(setpoint.yaw_rate_radps or 0.0, -most), most)
    if rate:
        return turn if isinstance(turn, Spin) and rate == turn.rate_radps else Spin(t_s, yaw_rad, rate)
    return turn.stopped(t_s)


class Companion:
    """The program that flies the vehicle in OFFBOARD: its newest setpoint, and when it was heard. Times in
    s of simulation time.
    """

    def __init__(self) -> None:
        """Begin unheard."""
        self.setpoint: Setpoint | None = None
        self.is_own_search = False
        """True while the vehicle's own search leads: it answers readings, and need not stream."""
        self._heard_s = self._before_s = -math.inf
        self._told: Ned | None = None  # where it was told that the way ends

    def hear(self, setpoint: Setpoint, now_s: float) -> None:
        """Take an accepted setpoint."""
        self.setpoint, self._before_s, self._heard_s = setpoint, self._heard_s, now_s

    def goes_on(self, t_s: float, motion: Motion, config: VehicleConfig) -> Trajectory | str:
        """Return how a velocity or an acceleration that came to rest goes on, or a text that tells of its
        end, once; or nothing.
        """
        assert self.setpoint is not None
        way = self.setpoint.steered(t_s, motion, config)
        if math.dist(way.target, motion.position) > SAME_PLACE_M:
            self._told = None
            return way
        if motion.position == self._told or not self.setpoint.wants_to_move(config):
            return ""
        self._told = motion.position
        north, east, down = motion.position
        side, above = f"[0, {config.area_m:g}]", f"[0, {config.ceiling_m:g}]"
        place = f"({metres(east)}, {metres(north)}) m at {metres(-down)} m"
        return f"Setpoint ends at {place}: allowed is {side} x {side} m at {above} m"

    def cruise(self, config: VehicleConfig) -> Ned | None:
        """Return the velocity that is asked for, within the limits, m/s; None if it is something else."""
        return (
            _clamped(self.setpoint.velocity, config.limits)
            if self.setpoint and self.setpoint.velocity
            else None
        )

    def missing(self, now_s: float, config: VehicleConfig) -> str:
        """Return what OFFBOARD still needs: a setpoint at most `silence_s` old, if strict a stream of at
        least 2 Hz; or nothing.
        """
        if self.setpoint is None:
            return "no setpoint received yet"
        age_s, gap_s, longest_s = now_s - self._heard_s, self._heard_s - self._before_s, self.borne_s(config)
        if age_s > longest_s:
            return f"no setpoint in the last {longest_s:g} s"
        # Two in the time after which a stream is lost: 2 Hz. A pause of twice that time is the end of an
        # earlier stream.
        slow = age_s > longest_s / 2.0 or longest_s / 2.0 < gap_s <= 2.0 * longest_s
        return "setpoints come at less than 2 Hz" if self._must_stream(config) and slow else ""

    def lost_s(self, since_s: float, path_end_s: float, config: VehicleConfig) -> float:
        """Return when it counts as lost, if it flies the vehicle since a time and says nothing more.

        A leg may take longer than `silence_s`, so silence counts from the end of a leg to a position,
        unless it must stream.
        """
        heard_s = max(self._heard_s, since_s)
        if self.setpoint and self.setpoint.position is not None and not self._must_stream(config):
            heard_s = max(heard_s, path_end_s)
        return heard_s + self.borne_s(config)

    def _must_stream(self, config: VehicleConfig) -> bool:
        return math.isfinite(config.stream_s) and not self.is_own_search

    def borne_s(self, config: VehicleConfig) -> float:
        """Return how long it may be silent."""
        return config.stream_s if self._must_stream(config) else config.silence_s


def _clamped(velocity: Ned, limits: Limits) -> Ned:
    """The velocity within the speed limits, m/s."""
    north, east, down = (speed if abs(speed) >= CREEP_MPS else 0.0 for speed in velocity)
    horizontal = math.hypot(north, east)
    factor = limits.speed_mps / horizontal if horizontal > limits.speed_mps else 1.0
    return north * factor, east * factor, min(max(down, -limits.climb_mps), limits.descent_mps)


def _change(start: Ned, end: Ned, accel: float) -> list[Push]:
    """From one velocity to another along a straight line in velocity space, at the acceleration limit."""
    north, east, down = (to - now for now, to in zip(start, end, strict=True))
    size = math.hypot(north, east, down)
    if size < NOTHING:
        return [Push(ZERO, 0.0, end)]
    factor = accel / size
    return [Push((north * factor, east * factor, down * factor), size / accel, end)]


def _change_at_height(
    motion: Motion, horizontal: tuple[float, float], height_m: float, limits: Limits
) -> list[Push]:
    """To a horizontal velocity, and down by `height_m` on the way: climb or sink, then level off. Units m
    and m/s.
    """
    accel, (north, east) = limits.accel_mps2, horizontal

    def left_m(down: float) -> float:
        """What is left of the height after reaching a vertical speed and levelling off again."""
        (push,) = _change(motion.velocity, (north, east, down), accel)
        return (
            height_m - (motion.velocity[2] + down) / 2.0 * push.duration_s - down * abs(down) / (2.0 * accel)
        )

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
    cruise_s = left_m(down) / down if abs(down) > NOTHING else 0.0
    cruising: Ned = (north, east, down)
    change = _change(motion.velocity, cruising, accel)
    return [*change, Push(ZERO, max(cruise_s, 0.0), cruising), *_change(cruising, (north, east, 0.0), accel)]


def _accelerate(velocity: Ned, acceleration: Ned, limits: Limits) -> list[Push]:
    """Accelerate until the first speed limit is reached."""
    size = math.hypot(*acceleration)
    if size < NOTHING:
        return [Push(ZERO, 0.0, velocity)]
    factor = limits.accel_mps2 / size if size > limits.accel_mps2 else 1.0
    north, east, down = acceleration[0] * factor, acceleration[1] * factor, acceleration[2] * factor
    lasts_s = []
    if down:
        limit = limits.descent_mps if down > 0.0 else -limits.climb_mps
        lasts_s.append((limit - velocity[2]) / down)
    if square := north * north + east * east:
        half = (velocity[0] * north + velocity[1] * east) / square
        over = (velocity[0] ** 2 + velocity[1] ** 2 - limits.speed_mps**2) / square
        lasts_s.append(math.sqrt(max(half * half - over, 0.0)) - half)
    t_s = max(min(lasts_s), 0.0)
    reached = (velocity[0] + north * t_s, velocity[1] + east * t_s, velocity[2] + down * t_s)
    return [Push((north, east, down), t_s, reached)]
