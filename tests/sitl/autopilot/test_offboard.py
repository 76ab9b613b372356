"""Protects flight by velocity and acceleration: worked by hand, never out of the area, never beyond a
limit; and strict streams.
"""

import dataclasses
import math
import random

import pytest

from aircraft.state import Arrived, Said
from link.modes import Mode
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.setpoint import Setpoint
from sitl.autopilot.telemetry import Snapshot, position_target_local_ned
from sitl.autopilot.vehicle import Vehicle
from tests.ground.tlog.flights import (
    ACCEPTED,
    CONFIG,
    DENIED,
    GROUND,
    IN_AIR,
    NAN,
    REJECTED,
    fly_on,
    hovering,
    offboard,
    on_the_ground,
    texts,
)

CRITICAL, WARNING = 2, 4  # MAV_SEVERITY
AT = 10.0
"""When the tests' setpoints come: the vehicle of `offboard` rests by then."""


def flown(
    setpoint: Setpoint, at: tuple[float, float, float] = (0.0, 0.0, -5.0), config: VehicleConfig = CONFIG
) -> Vehicle:
    """A vehicle in OFFBOARD that rests at a place and gets a setpoint at time AT."""
    vehicle = offboard(dataclasses.replace(config, silence_s=1e4, endurance_s=math.inf))
    vehicle.setpoint(4.0, at)
    fly_on(vehicle)
    late = vehicle.now_s
    assert late <= AT or at != (0.0, 0.0, -5.0)
    assert vehicle.setpoint(max(AT, late), setpoint).code == ACCEPTED
    return vehicle


def after(vehicle: Vehicle, seconds: float):
    """Position and velocity that much later."""
    vehicle.advance(vehicle.now_s + seconds)
    state = vehicle.state(vehicle.now_s)
    return state.position, state.velocity


# ---- velocity, by hand: the limits are 5 m/s, 3 m/s up, 1.5 m/s down and 3 m/s² ----


def test_from_rest_to_2_mps_takes_two_thirds_of_a_second_and_of_a_metre():
    vehicle = flown(Setpoint(velocity=(2.0, 0.0, 0.0)))
    assert after(vehicle, 1.0 / 3.0) == (
        pytest.approx((1.0 / 6.0, 0.0, -5.0)),
        pytest.approx((1.0, 0.0, 0.0)),
    )
    assert after(vehicle, 1.0 / 3.0) == (
        pytest.approx((2.0 / 3.0, 0.0, -5.0)),
        pytest.approx((2.0, 0.0, 0.0)),
    )
    assert after(vehicle, 3.0) == (pytest.approx((2.0 / 3.0 + 6.0, 0.0, -5.0)), (2.0, 0.0, 0.0))


def test_a_new_velocity_is_reached_along_a_straight_line_in_velocity_space():
    vehicle = flown(Setpoint(velocity=(2.0, 0.0, 0.0)), at=(10.0, 10.0, -5.0))
    (north, east, _), _ = after(vehicle, 2.0)
    vehicle.setpoint(vehicle.now_s, Setpoint(velocity=(0.0, 2.0, 0.0)))
    turn_s = math.hypot(2.0, 2.0) / 3.0
    assert after(vehicle, turn_s / 2.0)[1] == pytest.approx((1.0, 1.0, 0.0))
    place, velocity = after(vehicle, turn_s / 2.0)
    assert velocity == pytest.approx((0.0, 2.0, 0.0))
    assert place == pytest.approx((north + turn_s, east + turn_s, -5.0))  # the mean velocity is (1, 1)


def test_velocity_zero_brakes_and_holds():
    vehicle = flown(Setpoint(velocity=(2.0, 0.0, 0.0)))
    after(vehicle, 2.0)
    vehicle.setpoint(vehicle.now_s, Setpoint(velocity=(0.0, 0.0, 0.0)))
    assert vehicle.advance(vehicle.now_s + 100.0) == []
    assert after(vehicle, 0.0) == (
        pytest.approx((2.0 / 3.0 + 2.0 * 4.0 / 3.0 + 2.0 / 3.0, 0.0, -5.0)),
        (0.0, 0.0, 0.0),
    )


@pytest.mark.parametrize(
    ("asked", "flies"),
    [
        ((30.0, 40.0, 0.0), (3.0, 4.0, 0.0)),
        ((0.0, 0.0, -9.0), (0.0, 0.0, -3.0)),
        ((6.0, 8.0, 9.0), (3.0, 4.0, 1.5)),
    ],
)
def test_a_velocity_is_cut_to_the_limits_and_its_horizontal_part_keeps_its_direction(asked, flies):
    vehicle = flown(Setpoint(velocity=asked), at=(5.0, 5.0, -20.0))
    assert after(vehicle, 2.5)[1] == pytest.approx(flies)


def test_it_comes_to_rest_on_the_edge_of_the_area_and_says_so_once():
    vehicle = flown(Setpoint(velocity=(2.0, 0.0, 0.0)))
    began = vehicle.now_s
    rests = began + 2.0 / 3.0 + (30.0 - 4.0 / 3.0) / 2.0 + 2.0 / 3.0  # it brakes 2²/(2·3) m before the edge
    vehicle.advance(rests - 1.0 / 3.0)
    assert vehicle.state(rests - 1.0 / 3.0).velocity == pytest.approx((1.0, 0.0, 0.0))
    assert vehicle.state(rests - 1.0 / 3.0).position == pytest.approx((30.0 - 1.0 / 6.0, 0.0, -5.0))
    (said,) = vehicle.advance(rests + 100.0)
    assert (said.time_s, said.severity) == (pytest.approx(rests), WARNING)
    assert (
        said.text == "Setpoint ends at (0.0, 30.0) m at 5.0 m: allowed is [0, 30] x [0, 30] m at [0, 120] m"
    )
    assert vehicle.state(vehicle.now_s).position == (30.0, 0.0, -5.0)
    for n in range(40):  # the client goes on pushing, ever a little differently
        vehicle.setpoint(vehicle.now_s + 0.05, Setpoint(velocity=(2.0 + n / 10.0, 0.0, 0.0)))
        assert vehicle.advance(vehicle.now_s) == []
    assert vehicle.state(vehicle.now_s).position == (30.0, 0.0, -5.0)


def test_a_speed_that_it_cannot_reach_before_the_edge_is_not_reached():
    vehicle = flown(Setpoint(velocity=(2.0, 0.0, 0.0)), at=(29.5, 10.0, -5.0))
    began = vehicle.now_s
    half_s = math.sqrt(0.5 / 3.0)  # half of the way to speed up, half to slow down
    assert after(vehicle, half_s) == (
        pytest.approx((29.75, 10.0, -5.0)),
        pytest.approx((3.0 * half_s, 0.0, 0.0)),
    )
    (said,) = vehicle.advance(began + 10.0)
    assert said.time_s == pytest.approx(began + 2.0 * half_s)
    assert vehicle.state(vehicle.now_s).position == (30.0, 10.0, -5.0)


def test_a_turn_that_would_swing_over_the_edge_brakes_first_and_then_goes_on_along_it():
    vehicle = flown(Setpoint(velocity=(5.0, 0.0, 0.0)), at=(10.0, 10.0, -5.0))
    after(
        vehicle, (15.5 - 25.0 / 6.0) / 5.0 + 5.0 / 3.0
    )  # 4.5 m before the edge; to brake from 5 m/s takes 4.17 m
    assert after(vehicle, 0.0)[0] == pytest.approx((25.5, 10.0, -5.0))
    # North speed falls by 3/√2 m/s², so a free turn would take 25/(2·2.12) = 5.9 m.
    vehicle.setpoint(vehicle.now_s, Setpoint(velocity=(0.0, 5.0, 0.0)))
    furthest = 0.0
    for _ in range(200):
        (north, _, _), velocity = after(vehicle, 0.1)
        furthest = max(furthest, north)
        if velocity[1] == 5.0:
            break
    assert furthest <= 30.0
    assert velocity == (0.0, 5.0, 0.0)


def test_down_to_the_ground_it_brakes_lands_and_stops_its_motors():
    vehicle = flown(Setpoint(velocity=(0.0, 0.0, 1.5)))
    lands = vehicle.now_s + 0.5 + (5.0 - 0.75) / 1.5 + 0.5
    vehicle.advance(lands - 0.01)
    assert vehicle.state(vehicle.now_s).landed_state == IN_AIR
    vehicle.advance(lands + 1.9)
    assert (vehicle.state(vehicle.now_s).landed_state, vehicle.state(vehicle.now_s).armed) == (GROUND, True)
    vehicle.advance(lands + 2.1)
    assert not vehicle.state(vehicle.now_s).armed


def test_on_the_ground_only_a_climb_moves_it():
    vehicle = on_the_ground(VehicleConfig(disarm_preflight_s=math.inf))
    vehicle.setpoint(0.0, Setpoint(velocity=(2.0, 0.0, 0.0)))
    assert vehicle.set_mode(0.0, Mode.OFFBOARD).accepted
    assert vehicle.arm(0.0).accepted
    assert after(vehicle, 5.0) == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    vehicle.setpoint(5.0, Setpoint(velocity=(0.0, 0.0, -3.0)))
    assert after(vehicle, 2.0) == (pytest.approx((0.0, 0.0, -1.5 - 3.0)), pytest.approx((0.0, 0.0, -3.0)))


def test_a_velocity_at_a_height_climbs_there_and_flies_on_level():
    vehicle = flown(Setpoint(velocity=(2.0, 0.0, 0.0), down_m=-14.0))
    # Together 2 and 3 m/s at 3 m/s²: √13/3 s; then 3 m/s up; 1 s and 1.5 m to level off.
    joint_s = math.sqrt(13.0) / 3.0
    climb_s = (9.0 - 1.5 * joint_s - 1.5) / 3.0
    assert after(vehicle, joint_s + climb_s) == (
        pytest.approx((joint_s + 2.0 * climb_s, 0.0, -12.5)),
        pytest.approx((2.0, 0.0, -3.0)),
    )
    assert after(vehicle, 1.0)[0][2] == pytest.approx(-14.0)
    assert after(vehicle, 1.0)[1] == pytest.approx((2.0, 0.0, 0.0))


# ---- acceleration ----


def test_an_acceleration_acts_until_the_speed_limit_and_then_it_cruises():
    vehicle = flown(Setpoint(acceleration=(1.0, 0.0, 0.0)), at=(1.0, 10.0, -5.0))
    assert after(vehicle, 2.0) == (pytest.approx((3.0, 10.0, -5.0)), pytest.approx((2.0, 0.0, 0.0)))
    assert after(vehicle, 3.0) == (
        pytest.approx((13.5, 10.0, -5.0)),
        pytest.approx((5.0, 0.0, 0.0)),
    )  # 5 s at 1 m/s²
    assert after(vehicle, 1.0) == (pytest.approx((18.5, 10.0, -5.0)), pytest.approx((5.0, 0.0, 0.0)))
    assert len(vehicle.advance(vehicle.now_s + 100.0)) == 1
    assert vehicle.state(vehicle.now_s).position == (30.0, 10.0, -5.0)


def test_an_acceleration_beyond_the_limit_is_cut_and_acceleration_0_keeps_the_velocity():
    vehicle = flown(Setpoint(acceleration=(0.0, 30.0, 0.0)))
    assert after(vehicle, 1.0)[1] == pytest.approx((0.0, 3.0, 0.0))
    vehicle.setpoint(vehicle.now_s, Setpoint(acceleration=(0.0, 0.0, 0.0)))
    assert after(vehicle, 2.0) == (pytest.approx((0.0, 1.5 + 6.0, -5.0)), pytest.approx((0.0, 3.0, 0.0)))


# ---- any sequence ----


def some_setpoint(random_: random.Random) -> Setpoint:
    def vector(size: float):
        return tuple(
            random_.choice((-1.0, 0.0, 1.0)) * size
            if random_.random() < 0.3
            else random_.uniform(-size, size)
            for _ in range(3)
        )

    match random_.randrange(6):
        case 0 | 1:
            return Setpoint(
                velocity=vector(random_.choice((0.5, 3.0, 8.0))), yaw_rate_radps=random_.choice((None, 0.3))
            )
        case 2:
            return Setpoint(acceleration=vector(random_.choice((0.5, 3.0, 8.0))))
        case 3:
            return Setpoint(velocity=vector(5.0), down_m=-random_.uniform(0.0, 20.0))
        case _:
            return Setpoint(
                (random_.uniform(0.0, 30.0), random_.uniform(0.0, 30.0), -random_.uniform(0.5, 20.0))
            )


@pytest.mark.parametrize(
    "seed", [*range(20), 2241]
)  # the last once jumped by a metre, for a velocity of 1e-10 m/s over the edge
def test_no_sequence_of_setpoints_leads_out_of_the_area_beyond_a_limit_or_to_a_jump(seed):
    random_ = random.Random(seed)
    vehicle = hovering(
        VehicleConfig(
            ceiling_m=20.0, endurance_s=math.inf, disarm_landed_s=math.inf, disarm_preflight_s=math.inf
        )
    )
    before = vehicle.state(vehicle.now_s)
    for _ in range(30):
        assert vehicle.setpoint(vehicle.now_s, some_setpoint(random_)).accepted
        assert vehicle.set_mode(vehicle.now_s, Mode.OFFBOARD).accepted
        if random_.random() < 0.1:
            vehicle.set_mode(vehicle.now_s, random_.choice((Mode.HOLD, Mode.RETURN, Mode.LAND)))
        step_s = random_.choice((0.05, 0.5, 2.0, 10.0)) / 20.0
        for _ in range(20):
            vehicle.advance(vehicle.now_s + step_s)
            state = vehicle.state(vehicle.now_s)
            (north, east, down), (v_north, v_east, v_down) = state.position, state.velocity
            assert -1e-9 <= north <= 30.0 + 1e-9
            assert -1e-9 <= east <= 30.0 + 1e-9
            assert -20.0 - 1e-9 <= down <= 1e-9
            assert math.hypot(v_north, v_east) <= 5.0 + 1e-9
            assert -3.0 - 1e-9 <= v_down <= 1.5 + 1e-9
            assert math.dist(state.velocity, before.velocity) <= 3.0 * (state.time_s - before.time_s) + 1e-8
            middle = [
                (a + b) / 2.0 * (state.time_s - before.time_s)
                for a, b in zip(state.velocity, before.velocity, strict=True)
            ]
            moved = [a - b for a, b in zip(state.position, before.position, strict=True)]
            assert (
                math.dist(moved, middle) <= 3.0 * (state.time_s - before.time_s) ** 2 + 1e-7
            )  # the position is the velocity's integral
            before = state


# ---- what else it does ----


def test_the_end_of_a_velocity_is_no_arrival_and_the_way_to_a_position_after_it_is_continuous():
    vehicle = flown(Setpoint(velocity=(5.0, 5.0, 0.0)))
    before = after(vehicle, 2.0)
    vehicle.setpoint(vehicle.now_s, (3.0, 3.0, -8.0))
    assert math.dist(sum(after(vehicle, 0.0), ()), sum(before, ())) < 1e-12
    assert fly_on(vehicle) == [Arrived(vehicle.now_s, (3.0, 3.0, -8.0))]
    vehicle.setpoint(vehicle.now_s, Setpoint(velocity=(0.0, -1.0, 0.0)))
    assert [type(event) for event in fly_on(vehicle)] == [Said]


@pytest.mark.parametrize("mode", [Mode.HOLD, Mode.RETURN, Mode.LAND])
def test_a_pilot_may_end_a_velocity_at_any_time_without_a_jump(mode):
    vehicle = flown(Setpoint(velocity=(2.0, 1.0, -1.0), yaw_rate_radps=0.5))
    before = after(vehicle, 3.0)
    vehicle.set_mode(vehicle.now_s, mode)
    assert math.dist(sum(after(vehicle, 0.0), ()), sum(before, ())) < 1e-12
    assert vehicle.state(vehicle.now_s).yaw_rate == 0.0


def test_a_yaw_rate_turns_until_told_otherwise():
    vehicle = flown(Setpoint(velocity=(0.0, 0.0, 0.0), yaw_rate_radps=0.5))
    began = vehicle.now_s
    after(vehicle, 10.0)
    assert vehicle.state(vehicle.now_s).yaw == pytest.approx(5.0 - 2.0 * math.pi)
    assert vehicle.state(vehicle.now_s).yaw_rate == 0.5
    vehicle.setpoint(
        vehicle.now_s, Setpoint(velocity=(1.0, 0.0, 0.0), yaw_rate_radps=0.5)
    )  # another way, the same turn
    after(vehicle, 2.0)
    assert vehicle.state(vehicle.now_s).yaw == pytest.approx(0.5 * (vehicle.now_s - began) - 2.0 * math.pi)
    vehicle.setpoint(vehicle.now_s, Setpoint(velocity=(1.0, 0.0, 0.0)))
    assert vehicle.state(vehicle.now_s).yaw_rate == 0.0
    vehicle.setpoint(vehicle.now_s, Setpoint(velocity=(1.0, 0.0, 0.0), yaw_rate_radps=9.0))
    assert vehicle.state(vehicle.now_s).yaw_rate == pytest.approx(math.radians(45.0))
    vehicle.setpoint(
        vehicle.now_s, Setpoint(velocity=(1.0, 0.0, 0.0), yaw_rad=1.0, yaw_rate_radps=9.0)
    )  # the yaw is more
    after(vehicle, 10.0)
    assert (vehicle.state(vehicle.now_s).yaw, vehicle.state(vehicle.now_s).yaw_rate) == (1.0, 0.0)


def test_the_velocity_that_is_asked_for_is_told_until_another_mode_is_chosen():
    vehicle = flown(Setpoint(velocity=(6.0, 8.0, 1.0)))

    def told():
        return position_target_local_ned(
            Snapshot(vehicle.config, vehicle.state(vehicle.now_s), (0.0, 0.0), None)
        )

    assert (told().vx, told().vy, told().vz) == pytest.approx((3.0, 4.0, 1.0))  # within the limits
    assert told().type_mask == 0b110111000111
    vehicle.set_mode(vehicle.now_s, Mode.HOLD)
    assert told().type_mask == 0b110111111000


@pytest.mark.parametrize(
    ("setpoint", "reason"),
    [
        (Setpoint(velocity=(math.inf, 0.0, 0.0)), "Setpoint refused: velocity (inf, 0.0, 0.0) is not finite"),
        (
            Setpoint(acceleration=(0.0, NAN, 0.0)),
            "Setpoint refused: acceleration (0.0, nan, 0.0) is not finite",
        ),
        (
            Setpoint(velocity=(0.0, 0.0, 0.0), down_m=1.0),
            "Setpoint refused: altitude -1.0 m is outside [0, 120] m",
        ),
        (
            Setpoint(velocity=(0.0, 0.0, 0.0), yaw_rate_radps=NAN),
            "Waypoint refused: yaw rate nan is not finite",
        ),
    ],
)
def test_a_setpoint_that_makes_no_sense_is_refused_and_changes_nothing(setpoint, reason):
    vehicle = offboard()
    before, expiry = vehicle.state(AT), vehicle.next_event_s()
    assert vehicle.setpoint(AT, setpoint)[:2] == (DENIED, reason)
    assert (vehicle.state(AT), vehicle.next_event_s()) == (before, expiry)


# ---- silence ----


def test_silence_during_a_velocity_counts_from_its_last_setpoint():
    vehicle = offboard()
    vehicle.setpoint(AT, Setpoint(velocity=(0.1, 0.0, 0.0)))  # it would fly for 300 s
    assert vehicle.advance(AT + 30.1) == [Said(AT + 30.0, CRITICAL, "No setpoint for 30 s: returning home")]


# ---- strict: PX4's COM_OF_LOSS_T of 1 s, and 2 Hz ----

STRICT = VehicleConfig(stream_s=1.0)


def streaming(vehicle: Vehicle, gaps_s: list[float], setpoint=(5.0, 5.0, -5.0)) -> Vehicle:
    """The vehicle after a stream of setpoints that begins at AT; a gap follows each."""
    at = AT
    for gap_s in gaps_s:
        vehicle.setpoint(at, setpoint)
        at += gap_s
    vehicle.advance(at)
    return vehicle


@pytest.mark.parametrize(
    ("gaps_s", "refused"),
    [
        ([0.5, 0.5, 0.5], ""),
        ([0.05], ""),  # as MAVSDK begins
        ([0.5, 0.25, 0.51], "setpoints come at less than 2 Hz"),
        ([0.75, 0.75, 0.0], "setpoints come at less than 2 Hz"),
        ([1.0, 1.0, 0.0], "setpoints come at less than 2 Hz"),
        ([0.05, 0.05, 1.25], "no setpoint in the last 1 s"),
        ([0.05, 5.0, 0.0], ""),  # an earlier stream has ended, a new one begins
    ],
)
def test_strict_offboard_needs_setpoints_at_2_hz(gaps_s, refused):
    vehicle = streaming(hovering(STRICT), gaps_s)
    answer = vehicle.set_mode(vehicle.now_s, Mode.OFFBOARD)
    assert answer[:2] == ((REJECTED, f"Offboard refused: {refused}") if refused else (ACCEPTED, ""))


@pytest.mark.parametrize(
    "setpoint", [(20.0, 20.0, -5.0), Setpoint(velocity=(1.0, 0.0, 0.0))], ids=["position", "velocity"]
)
def test_strict_offboard_is_lost_a_second_after_the_last_setpoint_even_on_the_way(setpoint):
    vehicle = streaming(hovering(STRICT), [0.25] * 4, setpoint)
    vehicle.set_mode(vehicle.now_s, Mode.OFFBOARD)
    for n in range(20):
        vehicle.setpoint(11.0 + n / 2.0, setpoint)
    assert texts(vehicle.advance(21.4)) == []
    assert vehicle.advance(22.0) == [Said(21.5, CRITICAL, "No setpoint for 1 s: returning home")]
    assert vehicle.state(vehicle.now_s).mode is Mode.RETURN


def test_strict_arming_in_offboard_needs_a_stream_too():
    vehicle = streaming(on_the_ground(STRICT), [0.25] * 4)
    assert vehicle.set_mode(11.0, Mode.OFFBOARD).accepted
    assert vehicle.arm(13.0).reason == "Arming refused: no setpoint in the last 1 s"


def test_the_vehicles_own_search_need_not_stream():
    vehicle = hovering(STRICT)
    vehicle.is_searched = True
    vehicle.setpoint(AT, (3.0, 4.0, -5.0))
    assert vehicle.set_mode(AT + 20.0, Mode.OFFBOARD).accepted
    (arrived,) = fly_on(vehicle)
    assert texts(vehicle.advance(arrived.time_s + 29.9)) == []
    assert texts(vehicle.advance(arrived.time_s + 30.1)) == ["No setpoint for 30 s: returning home"]
