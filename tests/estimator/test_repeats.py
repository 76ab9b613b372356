"""Protects the notice that a search repeats itself: what counts, and where it would go back to."""

import msgspec
import numpy as np
import pytest

from estimator.belief import REPEATS, belief, way_back
from estimator.filter import Config, assimilate, prior
from link.bus.mavlink import Reading

HERE, THERE = (3.0, 4.0), (6.0, 8.0)
HOPS = [HERE, THERE] * (REPEATS // 2)


def test_two_places_in_turn_for_ten_readings_are_a_repeat() -> None:
    assert way_back(np.array(HOPS)) == HERE
    assert way_back(np.array(HOPS[1:])) is None
    assert way_back(np.array([(0.0, 0.0), *HOPS])) == HERE
    assert way_back(np.array([*HOPS, (9.0, 12.0)])) is None


@pytest.mark.parametrize("off", [1.2, 1.3])
def test_places_that_differ_by_less_than_a_quarter_of_the_way_are_one(off: float) -> None:
    assert (way_back(np.array([(3.0 + off, 4.0), *HOPS[1:]])) == HERE) is (off < 5 / 4)


def test_a_vehicle_that_hovers_and_one_that_flies_on_do_not_repeat_themselves() -> None:
    assert way_back(np.full((20, 2), 5.0)) is None
    assert way_back(np.arange(40.0).reshape(-1, 2)) is None
    assert way_back(np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] * 5)) is None
    assert way_back(np.empty((0, 2))) is None


def test_the_verdict_is_the_same_in_other_units() -> None:
    for scale in (0.125, 1024.0):
        assert way_back(scale * np.array(HOPS)) == (scale * HERE[0], scale * HERE[1])


def test_of_several_vehicles_the_belief_names_each_that_repeats_itself() -> None:
    config = Config(particles=50)
    posterior, said = prior(config), []
    for step, hop in enumerate(HOPS):
        for vehicle, place in ((1, (20.0, 1.0 + step)), (2, hop)):
            reading = Reading(step, place, 5.0, (1.0, 0.0), 0.0, vehicle=vehicle)
            posterior = assimilate(posterior, reading, config)
        said.append(belief(posterior, reading, config)[0])
    assert said[-1].backs == {2: HERE}
    assert all(each.backs is msgspec.UNSET for each in said[:-1])
    assert said[-1].back is msgspec.UNSET  # that is of a vehicle alone
