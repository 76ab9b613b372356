"""Protects how setpoint messages are read: frames, type masks and NaN as PX4 1.15 reads them, and what is
refused.
"""

import math

import pytest
from pymavlink.dialects.v20 import common as mavlink

from plume.geodesy import to_global
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.protocol import MavlinkProtocol
from sitl.autopilot.setpoint import Setpoint, read
from tests.ground.tlog.flights import CONFIG, NAN, hovering, offboard, places

NORTH, EAST = 0.0, math.pi / 2
LOCAL_NED, BODY_NED = 1, 8
FORCE, YAW, RATE = 512, 1024, 2048


def mask(*given: str) -> int:
    """The type mask that ignores all but these."""
    names = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "force", "yaw", "rate")
    return sum(1 << bit for bit, name in enumerate(names) if name != "force" and name not in given)


POSITION, VELOCITY, ACCELERATION = ("x", "y", "z"), ("vx", "vy", "vz"), ("afx", "afy", "afz")


def local(
    type_mask,
    frame=LOCAL_NED,
    x=4.0,
    y=5.0,
    z=-6.0,
    v=(1.0, 2.0, 0.5),
    a=(0.5, 0.25, 0.125),
    yaw=0.75,
    rate=0.5,
):
    return mavlink.MAVLink_set_position_target_local_ned_message(
        7, 1, 1, frame, type_mask, x, y, z, *v, *a, yaw, rate
    )


def global_int(type_mask, frame, lat_lon, alt, v=(1.0, 2.0, 0.5)):
    lat, lon = (round(degrees * 1e7) for degrees in lat_lon)
    return mavlink.MAVLink_set_position_target_global_int_message(
        7, 1, 1, frame, type_mask, lat, lon, alt, *v, 0, 0, 0, 0.0, 0.0
    )


def understood(message, yaw_rad=NORTH):
    return read(message, CONFIG, yaw_rad)


# ---- what is flown ----


@pytest.mark.parametrize(
    ("given", "setpoint"),
    [
        (POSITION, Setpoint((4.0, 5.0, -6.0))),
        ((*POSITION, "yaw"), Setpoint((4.0, 5.0, -6.0), yaw_rad=0.75)),
        ((*POSITION, *VELOCITY), Setpoint((4.0, 5.0, -6.0))),  # the velocity is feed-forward
        ((*POSITION, *VELOCITY, *ACCELERATION, "yaw"), Setpoint((4.0, 5.0, -6.0), yaw_rad=0.75)),
        (VELOCITY, Setpoint(velocity=(1.0, 2.0, 0.5))),
        ((*VELOCITY, "rate"), Setpoint(velocity=(1.0, 2.0, 0.5), yaw_rate_radps=0.5)),
        ((*VELOCITY, *ACCELERATION), Setpoint(velocity=(1.0, 2.0, 0.5))),
        (("vx", "vy", "z"), Setpoint(velocity=(1.0, 2.0, 0.0), down_m=-6.0)),
        ((*VELOCITY, "z"), Setpoint(velocity=(1.0, 2.0, 0.0), down_m=-6.0)),
        (ACCELERATION, Setpoint(acceleration=(0.5, 0.25, 0.125))),
        ((*VELOCITY, "force"), Setpoint(velocity=(1.0, 2.0, 0.5))),  # it says nothing without an acceleration
    ],
    ids=str,
)
def test_a_local_setpoint_is_what_its_mask_leaves(given, setpoint):
    assert understood(local(mask(*given) | FORCE * ("force" in given))) == setpoint


def test_velocities_and_accelerations_in_the_bodys_frame_are_turned_by_the_yaw_and_positions_ignored():
    forward_and_right = understood(local(mask(*VELOCITY), BODY_NED, v=(2.0, 1.0, -0.5)), EAST)
    assert forward_and_right.velocity == pytest.approx((-1.0, 2.0, -0.5))  # nose to the east, right is south
    assert understood(local(mask(*POSITION, *ACCELERATION), BODY_NED), EAST).acceleration == pytest.approx(
        (-0.25, 0.5, 0.125)
    )
    assert understood(local(mask(*POSITION, *VELOCITY), BODY_NED)) == Setpoint(velocity=(1.0, 2.0, 0.5))


def test_a_value_that_is_no_number_is_ignored_as_in_px4():
    assert understood(local(0, x=NAN, y=NAN, z=NAN, yaw=NAN, rate=NAN)) == Setpoint(velocity=(1.0, 2.0, 0.5))
    assert understood(local(0, x=NAN, y=NAN, yaw=NAN, rate=NAN)) == Setpoint(
        velocity=(1.0, 2.0, 0.0), down_m=-6.0
    )
    nans = (NAN, NAN, NAN)
    assert understood(local(0, x=NAN, y=NAN, z=NAN, v=nans)) == Setpoint(
        acceleration=(0.5, 0.25, 0.125), yaw_rad=0.75, yaw_rate_radps=0.5
    )


@pytest.mark.parametrize(
    ("frame", "altitude"), [(5, 488.0 + 6.0), (6, 6.0), (11, 6.0)], ids=["sea", "home", "terrain"]
)
def test_a_global_position_is_flown_with_its_altitude_above_sea_home_or_the_level_ground(frame, altitude):
    there = to_global(CONFIG.home_lat_deg, CONFIG.home_lon_deg, 10.0, 20.0)
    position = understood(global_int(mask(*POSITION), frame, there, altitude)).position
    assert position == pytest.approx((10.0, 20.0, -6.0), abs=0.012)  # the resolution, 1e-7 degrees


def test_a_global_setpoint_may_be_a_velocity_and_home_is_not_outside_by_a_rounded_digit():
    assert understood(global_int(mask(*VELOCITY), 6, (0.0, 0.0), 0.0)) == Setpoint(velocity=(1.0, 2.0, 0.5))
    home = VehicleConfig(
        home_lat_deg=47.39774205, home_lon_deg=8.54559405
    )  # 5 mm off the nearest position that MAVLink can carry
    assert read(global_int(mask(*POSITION), 6, (47.3977420, 8.5455940), 5.0), home, NORTH) == Setpoint(
        (0.0, 0.0, -5.0)
    )


# ---- what is refused ----


@pytest.mark.parametrize(
    "given",
    [
        ("x", "z", *VELOCITY),
        (*POSITION, "vx"),
        ("vx", "vz"),
        ("vx", "vy"),
        ("x", "y", "vz"),
        ("x", "y"),
        ("z",),
        ("afx", "afy"),
        ("afy", "afz"),
        (),
    ],
    ids=str,
)
def test_a_mask_that_px4_does_not_take_or_that_is_not_flown_is_refused(given):
    refused = understood(local(mask(*given)))
    assert refused.kind == "not whole"
    assert refused.reason.startswith("Setpoint refused: wanted a position, a velocity,")


@pytest.mark.parametrize("given", [POSITION, ("vx", "vy"), (*POSITION, "vx", "vz"), ("afx", "afy")], ids=str)
def test_in_the_bodys_frame_only_whole_velocities_and_accelerations_count(given):
    assert understood(local(mask(*given), BODY_NED)).kind == "not whole"


def test_other_frames_and_forces_are_refused_in_words():
    assert (
        understood(local(mask(*POSITION), 7)).reason
        == "Setpoint refused: frame 7 is not LOCAL_NED (1) or BODY_NED (8)"
    )
    assert (
        understood(local(mask(*ACCELERATION) | FORCE)).reason
        == "Setpoint refused: a force is not flown, only an acceleration"
    )
    told = understood(global_int(mask(*POSITION), 0, (47.0, 8.0), 5.0)).reason
    assert (
        told == "Setpoint refused: frame 0 is not GLOBAL_INT (5) or GLOBAL_RELATIVE_ALT_INT (6) or "
        "GLOBAL_TERRAIN_ALT_INT (11)"
    )


def test_a_global_position_outside_the_area_is_refused_once_a_second_and_counted():
    there = to_global(CONFIG.home_lat_deg, CONFIG.home_lon_deg, 10.0, 40.0)
    protocol = MavlinkProtocol(offboard())
    message = global_int(mask(*POSITION), 6, there, 5.0)
    message.pack(mavlink.MAVLink(None, 245, 190))
    told = [bool(protocol.receive(message, 10.0 + n / 20.0)) for n in range(60)]
    assert sum(told) == 3
    assert protocol.refused == {"outside the area": 60}


def test_a_global_setpoint_is_taken_as_a_waypoint():
    vehicle = hovering()
    there = to_global(CONFIG.home_lat_deg, CONFIG.home_lon_deg, 10.0, 20.0)
    message = global_int(mask(*POSITION), 6, there, 5.0)
    message.pack(mavlink.MAVLink(None, 245, 190))
    assert MavlinkProtocol(vehicle).receive(message, 10.0) == []
    assert vehicle.waypoint == pytest.approx((10.0, 20.0, -5.0), abs=0.012)


def test_a_body_velocity_is_turned_by_the_yaw_that_the_vehicle_has_when_it_comes():
    vehicle = offboard()
    vehicle.setpoint(10.0, Setpoint((10.0, 10.0, -5.0), yaw_rad=EAST))
    vehicle.advance(30.0)
    message = local(mask(*VELOCITY), BODY_NED, v=(2.0, 0.0, 0.0))
    message.pack(mavlink.MAVLink(None, 245, 190))
    MavlinkProtocol(vehicle).receive(message, 30.0)
    assert places(vehicle.advance(34.0)) == []
    north, east, down = vehicle.state(34.0).position
    assert (north, east, down) == pytest.approx((10.0, 10.0 + 2.0 / 3.0 + (4.0 - 2.0 / 3.0) * 2.0, -5.0))
