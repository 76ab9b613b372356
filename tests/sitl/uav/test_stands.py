"""Protects that simulated vehicles of a search are apart on the ground, on their way up, and on their way home."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import pytest

from aircraft.state import Ned
from aircraft.together import Berth
from link.modes import Mode
from plume.problem import AREA
from plume.problems.fleet import FORMATIONS, Fleet
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.vehicle import Vehicle
from sitl.uav.options import at_own_stand

SEPARATION_M = 3.0
STEP_S = 0.05  # between two looks: at 5 m/s each that is 0.5 m of two that meet head on


def standing(starts: Sequence[tuple[float, float]], **given: float) -> list[Vehicle]:
    """Vehicles whose search begins at these places, (x, y) m."""
    return [
        Vehicle(at_own_stand(VehicleConfig(**given), Berth(start, [*{*starts} - {start}], SEPARATION_M)))
        for start in starts
    ]


def position(vehicle: Vehicle) -> Ned:
    return vehicle.state(vehicle.now_s).position


def least_until(vehicles: list[Vehicle], until_s: float) -> float:
    """Let time pass; returns the least distance of two vehicles in it, m."""
    least_m, now_s = math.inf, vehicles[0].now_s
    while now_s < until_s:
        now_s += STEP_S
        for vehicle in vehicles:
            vehicle.catch_up(now_s)
        places = [position(vehicle) for vehicle in vehicles]
        least_m = min(least_m, *(math.dist(one, other) for one, other in itertools.combinations(places, 2)))
    return least_m


def up(vehicles: list[Vehicle]) -> None:
    for vehicle in vehicles:
        vehicle.arm(0.0)
        vehicle.take_off(0.0)


@pytest.mark.parametrize("formation", FORMATIONS)
def test_on_the_ground_and_on_their_way_up_they_are_apart(formation: str) -> None:
    vehicles = standing(Fleet(4, formation, SEPARATION_M).starts((2.0, 2.0), 7, AREA))
    up(vehicles)
    assert least_until(vehicles, 5.0) >= SEPARATION_M


@pytest.mark.parametrize("same_altitude", [True, False])
def test_ways_home_that_cross_are_at_different_altitudes(same_altitude: bool) -> None:
    """Two at (20, 20) and (0, 20) return at once to (0, 0) and (20, 0): at one altitude they meet at (10, 10)."""
    vehicles = standing([(0.0, 0.0), (20.0, 0.0)])
    if same_altitude:
        vehicles[0].configure(0.0, replace(vehicles[0].config, return_altitude_m=8.0))
    up(vehicles)
    least_until(vehicles, 5.0)
    for vehicle, (x, y) in zip(vehicles, [(20.0, 20.0), (0.0, 20.0)], strict=True):
        vehicle.setpoint(vehicle.now_s, (y, x, -5.0))
        vehicle.set_mode(vehicle.now_s, Mode.OFFBOARD)
    least_until(vehicles, 30.0)
    for vehicle in vehicles:
        vehicle.set_mode(vehicle.now_s, Mode.RETURN)
    least_m = least_until(vehicles, 80.0)
    assert least_m < 0.5 if same_altitude else least_m >= SEPARATION_M
    assert [position(vehicle) for vehicle in vehicles] == [(0.0, 0.0, 0.0), (0.0, 20.0, 0.0)]
    assert not any(vehicle.armed for vehicle in vehicles)


@pytest.mark.parametrize("behind_m", range(3, 16))
def test_nobody_comes_down_through_the_level_of_one_that_passes(behind_m: int) -> None:
    """The first one's way home, to the area's corner, leads over the second one's stand at (4, 4)."""
    vehicles = standing([(0.0, 0.0), (4.0, 4.0)])
    up(vehicles)
    least_until(vehicles, 5.0)
    for vehicle, along_m in zip(vehicles, (6.0 + behind_m, 6.0), strict=True):
        vehicle.setpoint(vehicle.now_s, (along_m, along_m, -5.0))
        vehicle.set_mode(vehicle.now_s, Mode.OFFBOARD)
    least_until(vehicles, 30.0)
    for vehicle in vehicles:
        vehicle.set_mode(vehicle.now_s, Mode.RETURN)
    assert least_until(vehicles, 80.0) >= SEPARATION_M
    assert not any(vehicle.armed for vehicle in vehicles)


def test_no_way_home_is_above_the_ceiling() -> None:
    vehicles = standing([(0.0, 0.0), (4.0, 0.0), (8.0, 0.0), (12.0, 0.0)], ceiling_m=9.0)
    assert [vehicle.config.return_altitude_m for vehicle in vehicles] == [9.0, 9.0, 9.0, 8.0]
