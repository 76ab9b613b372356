"""Protects the mission's clock: how long a leg takes, by hand-worked values and by the vehicle's own motion."""

import math

import numpy as np
import pytest

from plume.flight import leg_s, profile, usual_s
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.motion import Trajectory


@pytest.mark.parametrize(
    ("length_m", "duration_s"),
    [
        (0.0, 0.0),
        (1.0, 2 * math.sqrt(1 / 3)),  # half of it at 3 m/s², half at −3 m/s²
        (12.0, 2 * 5 / 3 + (12 - 25 / 3) / 5),  # 25/3 m of speeding up and slowing down, the rest at 5 m/s
        (25 / 3, 2 * 5 / 3),  # just reaches 5 m/s
    ],
)
def test_a_leg_takes_what_speeding_up_cruising_and_slowing_down_take(
    length_m: float, duration_s: float
) -> None:
    assert float(profile(length_m).duration_s) == pytest.approx(duration_s)
    assert float(leg_s((3.0, 4.0), (3.0, 4.0 + length_m))) == pytest.approx(duration_s)


def test_many_legs_take_what_each_takes_alone_to_the_bit_and_as_long_as_the_vehicle_flies() -> None:
    ends = np.random.default_rng(5).uniform(0, 30, (200, 2))
    together, limits = leg_s(ends[:-1], ends[1:]), VehicleConfig().limits
    for (x, y), (to_x, to_y), duration_s in zip(ends[:-1], ends[1:], together, strict=True):
        assert float(leg_s((x, y), (to_x, to_y))) == duration_s
        flown = Trajectory(0.0, (y, x, -5.0)).to((to_y, to_x, -5.0), limits)
        assert flown.end_s == pytest.approx(duration_s, rel=1e-12)


def test_a_usual_search_steps_by_1_m() -> None:
    assert usual_s(3) == pytest.approx(3 * 2 * math.sqrt(1 / 3))
