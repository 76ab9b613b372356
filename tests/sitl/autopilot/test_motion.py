"""Protects the claim that motion is a formula of time: bounded, continuous, and exactly on the target at
its end.
"""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from aircraft.state import ZERO
from sitl.autopilot.motion import GRAVITY_MPS2, Limits, Motion, Trajectory, fall, halt, tilt, turn, wrapped
from sitl.autopilot.offboard import Box, Push, safe_s

LIMITS = Limits(speed_mps=5.0, climb_mps=3.0, descent_mps=1.5, accel_mps2=3.0)
coordinate = st.floats(0.0, 30.0, width=32)
points = st.tuples(coordinate, coordinate, st.floats(-120.0, 0.0, width=32))


def leg(start, target, start_s=0.0):
    return Trajectory(start_s, start).to(target, LIMITS)


def test_a_path_to_where_it_already_is_takes_no_time():
    path = leg((1.0, 2.0, -5.0), (1.0, 2.0, -5.0), start_s=7.0)
    assert path.end_s == 7.0
    assert path.at(7.0) == Motion((1.0, 2.0, -5.0))


def test_a_long_leg_takes_ramp_cruise_ramp():
    # 10 m at 5 m/s and 3 m/s²: two ramps of 5/3 s and 25/6 m each, and 5/3 m of cruise in 1/3 s.
    path = leg((0.0, 0.0, -5.0), (6.0, 8.0, -5.0))
    assert path.end_s == pytest.approx(11.0 / 3.0, rel=1e-14)
    assert math.hypot(*path.at(1.0).velocity) == pytest.approx(3.0, rel=1e-14)
    assert path.at(1.8).velocity == pytest.approx((3.0, 4.0, 0.0), rel=1e-14)
    assert path.at(11.0 / 6.0).position == pytest.approx(
        (3.0, 4.0, -5.0), rel=1e-14
    )  # half the way in half the time


def test_a_short_leg_never_reaches_its_cruise_speed():
    path = leg((0.0, 0.0, -5.0), (1.0, 0.0, -5.0))  # half a metre speeding up, t² = 2 · 0.5 / 3
    assert path.end_s == pytest.approx(2.0 * math.sqrt(1.0 / 3.0), rel=1e-14)
    assert path.at(path.end_s / 2.0).velocity[0] == pytest.approx(math.sqrt(3.0), rel=1e-12)


@pytest.mark.parametrize(
    ("target", "peak"),
    [((0.0, 0.0, -60.0), 3.0), ((0.0, 0.0, 0.0), 1.5), ((40.0, 0.0, 0.0), 1.5 * math.hypot(40, 30) / 30)],
)
def test_climb_and_descent_have_their_own_limits(target, peak):
    path = leg((0.0, 0.0, -30.0), target)
    speeds = [math.hypot(*path.at(t).velocity) for t in np.linspace(0.0, path.end_s, 1001)]
    assert max(speeds) == pytest.approx(peak, rel=1e-12)


@given(points, points, st.floats(0.0, 1e4))
def test_a_leg_ends_on_its_target_to_the_last_bit_and_at_rest(start, target, start_s):
    path = leg(start, target, start_s)
    assert path.at(path.end_s) == Motion(target, ZERO, ZERO)
    assert path.at(path.end_s + 1e6) == Motion(target, ZERO, ZERO)


@given(points, points)
def test_the_position_is_the_integral_of_a_bounded_speed(start, target):
    path = leg(start, target)
    assume(path.end_s > 0.01)
    times, step = np.linspace(0.0, path.end_s, 2001, retstep=True)
    motions = [path.at(t) for t in times]
    velocities = np.array([m.velocity for m in motions])
    travelled = np.vstack([np.zeros(3), np.cumsum((velocities[1:] + velocities[:-1]) / 2.0, axis=0) * step])
    np.testing.assert_allclose(
        np.array([m.position for m in motions]), np.array(start) + travelled, atol=3.0 * step**2 + 1e-9
    )
    assert np.all(np.hypot(velocities[:, 0], velocities[:, 1]) <= LIMITS.speed_mps * (1 + 1e-12))
    assert np.all(velocities[:, 2] >= -LIMITS.climb_mps * (1 + 1e-12))
    assert np.all(velocities[:, 2] <= LIMITS.descent_mps * (1 + 1e-12))
    assert all(math.hypot(*m.acceleration) <= LIMITS.accel_mps2 * (1 + 1e-12) for m in motions)


@given(points, points, st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_rounding_never_carries_it_past_its_target_or_below_the_ground(start, target, when, later):
    path = leg(start, target)
    moment = path.at(path.end_s - when * min(path.end_s, 1e-3))  # where the last digits count
    for at, low, high in zip(moment.position, map(min, start, target), map(max, start, target), strict=True):
        assert low <= at <= high
    stopped = halt(1.0, moment, LIMITS)
    assert stopped.at(1.0 + later * (stopped.end_s - 1.0)).position[2] <= 0.0


def test_a_vehicle_at_rest_halts_where_it_is():
    assert halt(3.0, Motion((1.0, 2.0, -3.0)), LIMITS) == Trajectory(3.0, (1.0, 2.0, -3.0))


def test_braking_keeps_the_direction_and_takes_v_squared_over_2a():
    path = halt(10.0, Motion((1.0, 2.0, -5.0), (0.0, 3.0, 0.0)), LIMITS)  # 1 s, 1.5 m
    assert path.end_s == pytest.approx(11.0)
    assert path.target == pytest.approx((1.0, 3.5, -5.0))
    assert path.at(10.5).velocity == pytest.approx((0.0, 1.5, 0.0))
    assert path.at(10.5).position == pytest.approx((1.0, 2.0 + 1.5 - 0.375, -5.0))


@given(points, points, points, st.floats(0.0, 1.0))
def test_a_new_target_on_the_way_changes_position_and_velocity_without_a_jump(start, target, other, when):
    path = leg(start, target)
    turn_s = when * path.end_s
    before = path.at(turn_s)
    turned = halt(turn_s, before, LIMITS).to(other, LIMITS)
    assert turned.at(turn_s).position == pytest.approx(before.position, abs=1e-9)
    if turned.phases:
        assert turned.at(turn_s).velocity == pytest.approx(before.velocity, abs=1e-6)
    assert turned.at(turned.end_s).position == other
    times = np.linspace(turn_s, turned.end_s, 200)
    velocities = np.array([turned.at(t).velocity for t in times])
    assert np.all(
        np.linalg.norm(np.diff(velocities, axis=0), axis=1) <= 2 * LIMITS.accel_mps2 * np.diff(times) + 1e-6
    )


@given(points, points, st.floats(0.0, 1.0))
def test_braking_on_the_way_stops_between_the_two_ends(start, target, when):
    path = leg(start, target)
    stop = halt(when * path.end_s, path.at(when * path.end_s), LIMITS).target
    for at, low, high in zip(stop, map(min, start, target), map(max, start, target), strict=True):
        assert low - 1e-9 <= at <= high + 1e-9


def test_a_fall_from_20_m_takes_2_s():
    path = fall(5.0, Motion((1.0, 2.0, -20.0), (3.0, 0.0, 0.0)))
    assert path.end_s - 5.0 == pytest.approx(math.sqrt(40.0 / GRAVITY_MPS2))
    assert path.target == pytest.approx((1.0 + 3.0 * math.sqrt(40.0 / GRAVITY_MPS2), 2.0, 0.0))
    assert path.target[2] == 0.0
    assert path.at(6.0).position[2] == pytest.approx(-20.0 + GRAVITY_MPS2 / 2.0)


def test_a_turn_goes_the_shorter_way_round_at_its_rate():
    turning = turn(1.0, math.radians(170.0), math.radians(-170.0), math.radians(10.0))
    assert turning.end_s == pytest.approx(3.0)
    assert turning.at(1.5) == pytest.approx((math.radians(175.0), math.radians(10.0)))
    assert turning.at(2.5)[0] == pytest.approx(math.radians(-175.0))
    assert turning.at(turning.end_s) == (math.radians(-170.0), 0.0)


@given(st.floats(-100.0, 100.0))
def test_a_wrapped_angle_is_the_same_angle(angle):
    assert -math.pi <= wrapped(angle) <= math.pi
    assert math.cos(wrapped(angle)) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped(angle)) == pytest.approx(math.sin(angle), abs=1e-9)


@given(st.tuples(*[st.floats(-4.0, 4.0)] * 3), st.floats(-3.1, 3.1))
def test_thrust_along_the_attitude_against_gravity_gives_the_acceleration(acceleration, yaw):
    roll, pitch = tilt(acceleration, yaw)
    cr, sr, cp, sp, cy, sy = (
        math.cos(roll),
        math.sin(roll),
        math.cos(pitch),
        math.sin(pitch),
        math.cos(yaw),
        math.sin(yaw),
    )
    down_axis = np.array(
        [cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr]
    )  # third column of Rz(yaw) Ry(pitch) Rx(roll)
    thrust = np.array(acceleration) - [0.0, 0.0, GRAVITY_MPS2]
    np.testing.assert_allclose(-down_axis * np.linalg.norm(thrust), thrust, atol=1e-9)


def test_it_leans_to_where_it_accelerates():
    assert tilt((3.0, 0.0, 0.0), 0.0) == pytest.approx(
        (0.0, -math.atan(3.0 / GRAVITY_MPS2))
    )  # north, nose down
    assert tilt((0.0, 3.0, 0.0), 0.0) == pytest.approx(
        (math.atan(3.0 / GRAVITY_MPS2), 0.0)
    )  # east, right side down
    assert tilt((0.0, 0.0, GRAVITY_MPS2), 1.0) == (0.0, 0.0)  # free fall


# ---- when to brake: roots of quartics against looking at every moment ----

BOX = Box((0.0, 0.0, -20.0), (30.0, 30.0, 0.0))
components = st.tuples(*[st.floats(-5.0, 5.0)] * 3)


def over_the_edge(motion, push, times):
    """How far outside the box braking ends, m, for each moment of a push; negative inside."""
    times = np.asarray(times)[:, None]
    acceleration = np.array(push.acceleration)
    velocities = np.array(motion.velocity) + acceleration * times
    places = np.array(motion.position) + np.array(motion.velocity) * times + acceleration * times**2 / 2.0
    speeds = np.linalg.norm(velocities, axis=1, keepdims=True)
    ends = places + velocities * speeds / (2.0 * LIMITS.accel_mps2)
    return np.max(np.hstack([ends - np.array(BOX.high), np.array(BOX.low) - ends]), axis=1)


@given(
    st.tuples(coordinate, coordinate, st.floats(-20.0, 0.0, width=32)),
    components,
    components,
    st.sampled_from([0.01, 1.0, 5.0]),
)
def test_a_push_lasts_until_the_last_moment_at_which_braking_ends_inside(
    place, velocity, acceleration, lasts_s
):
    motion, push = Motion(place, velocity), Push(acceleration, lasts_s, ZERO)
    assume(over_the_edge(motion, push, [0.0])[0] <= 0.0)
    safe = safe_s(motion, push, LIMITS.accel_mps2, BOX)
    assert 0.0 <= safe <= lasts_s
    assert np.max(over_the_edge(motion, push, np.linspace(0.0, safe, 5001))) <= 1e-9
    if safe < lasts_s:
        later = np.linspace(safe, min(safe + 1e-3, lasts_s), 1001)
        assert np.max(over_the_edge(motion, push, later)) > 0.0


def test_braking_itself_moves_the_stop_nowhere_so_it_may_last_to_its_end():
    # From 3 m/s at 3 m/s² it stops 1.5 m on, wherever in the braking one looks: exactly on the edge.
    push = Push((-3.0, 0.0, 0.0), 1.0, ZERO)
    assert safe_s(Motion((28.5, 5.0, -5.0), (3.0, 0.0, 0.0)), push, 3.0, BOX) == 1.0
    assert safe_s(Motion((28.6, 5.0, -5.0), (3.0, 0.0, 0.0)), push, 3.0, BOX) == 0.0
