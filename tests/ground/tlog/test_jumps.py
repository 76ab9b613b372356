"""Protects what a jump of a receiver costs: its own places, and nothing of a true flight."""

import numpy as np
import pytest

from ground.tlog.jumps import jumped

TIMES_S = np.arange(100) / 5.0
FLIGHT = np.stack([4.0 * TIMES_S, np.sin(TIMES_S)], axis=1)
"""4 m/s to the east."""


def out(times_s: np.ndarray, places: np.ndarray) -> list[int]:
    """Return the numbers of the places that are left out, without a word."""
    notes: list[str] = []
    left_out = np.flatnonzero(jumped(times_s, places, notes)).tolist()
    assert not notes
    return left_out


@pytest.mark.parametrize("seed", range(20))
def test_of_a_true_flight_nothing_is_left_out(seed: int) -> None:
    """Up to 95 m/s, with gaps, several places within a moment, noise of metres, and places that a logger
    holds for seconds.
    """
    rng = np.random.default_rng(seed)
    times_s = np.cumsum(rng.choice([0.0, 0.001, 0.2, 1.0, 30.0], 500))
    speed, turn = rng.uniform(0, 95, 500), np.cumsum(rng.normal(0, 0.5, 500))
    steps = np.diff(times_s, prepend=0.0) * speed
    true = np.cumsum(np.stack([steps * np.cos(turn), steps * np.sin(turn)], axis=1), axis=0)
    assert out(times_s, true + rng.normal(0, 2.0, true.shape)) == []
    held = np.maximum.accumulate(np.where(rng.random(500) < 0.2, np.arange(500), 0))
    assert out(times_s, true[held]) == []


@pytest.mark.parametrize("numbers", [[0], [50], [99], [0, 1], [50, 51, 52], [98, 99], [10, 60]])
def test_places_that_the_receiver_jumped_to_are_left_out(numbers: list[int]) -> None:
    places = FLIGHT.copy()
    places[numbers] += (0.0, 300.0)
    assert out(TIMES_S, places) == numbers


def test_a_receiver_that_stays_where_it_jumped_is_right_once_the_vehicle_can_be_there() -> None:
    places = FLIGHT.copy()
    places[60:] += (0.0, 150.0)  # 1.5 s at 100 m/s; a place is told each 0.2 s
    assert out(TIMES_S, places) == [60, 61, 62, 63, 64, 65]
    assert out(TIMES_S, places[::-1]) == [34, 35, 36, 37, 38, 39]  # the longer part is right


@pytest.mark.parametrize("faster", [1.0, 40.0])
def test_where_many_would_be_jumps_none_is_and_that_is_told(faster: float) -> None:
    """Two vehicles in turn, or a flight whose times are wrong."""
    places, notes = FLIGHT.copy(), list[str]()
    if faster == 1.0:
        places[1::2] += (0.0, 300.0)
    assert not jumped(TIMES_S / faster, faster * places, notes).any()
    (note,) = notes
    assert note.endswith("are times wrong, or are there two vehicles in it? wanted the flight of one")


def test_one_place_or_none_is_no_jump() -> None:
    assert out(TIMES_S[:1], FLIGHT[:1]) == out(TIMES_S[:0], FLIGHT[:0]) == []
