"""Protects the distance between vehicles of one fleet: ways that are free, and what is left where none are."""

import math

import numpy as np
import pytest

from agent.planning.apart import Shared
from agent.planning.moves import Reach
from plume.polygons.polygons import gaps


def sampled_gap(way: np.ndarray, other: np.ndarray) -> float:
    """The least distance between 400 places on each of two ways."""
    share = np.linspace(0, 1, 400)[:, None]
    one, two = (start + share * (end - start) for start, end in (way, other))
    return float(np.sqrt(np.square(one[:, None] - two).sum(axis=2)).min())


def test_the_gap_of_two_ways_is_the_least_distance_between_their_places() -> None:
    rng = np.random.default_rng(3)
    ways, others = rng.random((60, 2, 2)) * 10, rng.random((60, 2, 2)) * 10
    ways[:5, 1], others[5:10, 1] = ways[:5, 0], others[5:10, 0]  # some stay where they are
    expected = [sampled_gap(way, other) for way, other in zip(ways, others, strict=True)]
    assert gaps(ways, others) == pytest.approx(expected, abs=0.05)
    assert (gaps(ways, others) == 0).any()  # some cross
    assert (gaps(ways, others) == gaps(others, ways)).all()


def test_two_that_stay_are_as_far_apart_as_their_places() -> None:
    assert gaps(np.array([[1.0, 1.0]] * 2), np.array([[4.0, 5.0]] * 2)) == 5.0


def shared(chosen: list, waiting: list, separation_m: float = 3.0) -> Shared:
    return Shared.of(
        Reach(headings=8), np.array(chosen).reshape(-1, 2, 2), np.array(waiting).reshape(-1, 2), separation_m
    )


def test_alone_all_moves_are_free() -> None:
    assert (shared([], []).moves((5.0, 5.0)) == Reach(headings=8).moves((5.0, 5.0))).all()


def test_moves_keep_away_from_ways_that_are_chosen_and_from_who_has_yet_to_choose() -> None:
    for reach in (shared([[[8.5, 5.0], [8.5, 6.0]]], []), shared([], [[8.5, 5.0]])):
        free = reach.moves((5.0, 5.0)).tolist()
        assert [6.0, 5.0] not in free  # 2.5 m away
        assert [4.0, 5.0] in free
        assert [5.0, 6.0] in free


def test_a_vehicle_without_a_free_way_may_stay() -> None:
    reach = shared(
        [], [[5.0 + 3 * east, 5.0 + 3 * north] for east, north in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    )
    assert reach.moves((5.0, 5.0)).tolist() == [[5.0, 5.0]]
    assert reach.freed((5.0, 5.0), (5.5, 5.0)) == (5.0, 5.0)


def test_a_way_that_is_not_free_is_turned_aside_and_a_free_one_is_left_alone() -> None:
    reach = shared([[[8.5, 5.0], [8.5, 5.0]]], [])
    aside = reach.freed((5.0, 5.0), (6.0, 5.0))
    assert math.dist(aside, (5.0, 5.0)) == pytest.approx(1.0)
    assert reach.are_free((5.0, 5.0), np.array([aside])).all()
    assert reach.freed((5.0, 5.0), (4.1, 5.0)) == (4.1, 5.0)


def test_those_who_have_chosen_are_foreseen_on_their_way_and_inside_the_area() -> None:
    reach = shared([[[8.0, 5.0], [9.0, 5.0]], [[29.5, 5.0], [30.0, 5.0]]], [[1.0, 1.0]])
    assert reach.foreseen(2.0).tolist() == [[10.0, 5.0], [30.0, 5.0]]
    assert Reach().foreseen().shape == (0, 2)


def test_those_ways_are_free_whose_gaps_to_all_others_are_no_less_than_the_separation() -> None:
    """At separations that are small and large; some ways cross, some only stay."""
    rng = np.random.default_rng(5)
    free = 0
    for separation_m in (0.0, 0.5, 3.0, 8.0) * 50:
        chosen, waiting = rng.random((3, 2, 2)) * 30, rng.random((2, 2)) * 30
        chosen[:, 1] = chosen[:, 0] + rng.normal(0, 1, (3, 2))
        reach, here = shared(chosen, waiting, separation_m), rng.random(2) * 30
        places = here + rng.normal(0, 1, (6, 2))
        ways = np.stack([np.broadcast_to(here, (6, 2)), places], axis=1)[:, None]
        others = np.concatenate([chosen, np.repeat(waiting[:, None], 2, axis=1)])
        expected = (gaps(ways, others) >= separation_m).all(axis=1)
        assert (reach.are_free(tuple(here), places) == expected).all()
        free += expected.sum()
    assert 200 < free < 1000  # of 1,200: some are and some are not


def test_a_way_that_begins_near_a_stand_or_one_that_has_left_is_free_if_it_leads_away() -> None:
    """Against the same rule in NumPy, with three stands and two that have left. It is not so of ways that are flown."""
    rng = np.random.default_rng(6)
    leading, nobody = 0, np.empty((0, 2))
    for _ in range(200):
        here, stands, left = rng.random(2) * 12, rng.random((3, 2)) * 12, rng.random((2, 2)) * 12
        places = here + rng.normal(0, 1, (6, 2))
        reach = Shared.of(Reach(headings=8), nobody.reshape(0, 2, 2), nobody, 2.0, left, stands)
        there, clear_m = np.concatenate([left, stands]), np.array([3.0, 3.0, 2.0, 2.0, 2.0])
        ways = np.stack([np.broadcast_to(here, (6, 2)), places], axis=1)[:, None]
        clear = gaps(ways, np.repeat(there[:, None], 2, axis=1)) >= clear_m
        now, then = (np.linalg.norm(there - from_there, axis=-1) for from_there in (here, places[:, None]))
        away = (now < clear_m) & (then - now >= 0.7 * np.linalg.norm(places - here, axis=1)[:, None])
        expected = (clear | away).all(axis=1)
        assert (reach.are_free(tuple(here), places) == expected).all()
        leading += (expected & ~clear.all(axis=1)).sum()
    assert leading > 50
    flown = shared([[[8.5, 5.0], [8.5, 5.0]]], [[1.5, 5.0]])
    # 2 m from a way, and 2.5 m from who has yet to choose: no way is free, even if it leads away.
    assert flown.moves((6.5, 5.0)).tolist() == [[6.5, 5.0]]
    assert not flown.are_free((4.0, 5.0), np.array([[5.0, 5.0]])).any()


@pytest.mark.parametrize(("others", "draws"), [(0, 100), (3, 100), (4, 80), (7, 50)])
def test_more_than_four_vehicles_share_the_draws_of_four(others: int, draws: int) -> None:
    chosen, waiting = [[[9.0, 9.0], [9.0, 9.0]]] * (others // 2), [[20.0, 20.0]] * (others - others // 2)
    assert shared(chosen, waiting).fewer(100) == draws
    assert Reach().fewer(100) == 100


def test_what_vehicles_have_in_common_is_computed_once() -> None:
    nobody, common, counts = np.empty((0, 2)), {}, iter(range(9))
    first, second = (
        Shared.of(Reach(fits=True), nobody.reshape(0, 2, 2), nobody, 3.0, common=common) for _ in range(2)
    )
    assert [each.once("spread", lambda: next(counts)) for each in (first, second, first)] == [0, 0, 0]
    assert second.once("hypotheses", lambda: next(counts)) == 1
    assert shared([], []).once("spread", lambda: next(counts)) == 2  # of another round


def after_leaving(*left_at: tuple[float, float]) -> Shared:
    nobody = np.empty((0, 2))
    return Shared.of(Reach(headings=8), nobody.reshape(0, 2, 2), nobody, 3.0, np.array(left_at))


def test_ways_keep_a_step_more_than_the_separation_from_where_one_has_left() -> None:
    reach = after_leaving((10.0, 5.0))
    assert reach.are_free((5.0, 5.0), np.array([[6.0, 5.0], [6.01, 5.0]])).tolist() == [True, False]


def test_who_is_near_one_that_has_left_goes_away_from_it_or_stays() -> None:
    """3.5 m east of it the free ways lead east, north-east and south-east: no more than 45° aside."""
    free = after_leaving((10.0, 5.0)).moves((13.5, 5.0))
    assert free == pytest.approx(
        np.array([[14.5, 5.0], [13.5 + 0.5**0.5, 5.0 + 0.5**0.5], [13.5 + 0.5**0.5, 5.0 - 0.5**0.5]]),
        abs=1e-5,
    )
    assert after_leaving((10.0, 5.0)).are_free((13.5, 5.0), np.array([[13.5, 5.0]])).all()
    between = after_leaving((10.0, 5.0), (16.0, 5.0))
    assert between.moves((13.0, 5.0)).tolist() == [[13.0, 5.0]]


def test_ways_keep_the_separation_from_the_stands_of_the_others() -> None:
    nobody = np.empty((0, 2))
    stand = np.array([[9.0, 5.0]])
    reach = Shared.of(Reach(headings=8), nobody.reshape(0, 2, 2), nobody, 3.0, stands=stand)
    assert reach.are_free((5.0, 5.0), np.array([[6.0, 5.0], [6.01, 5.0]])).tolist() == [True, False]
    inside = reach.moves((7.0, 5.0)).tolist()  # 2 m away: it leaves, no more than 45° aside
    assert [6.0, 5.0] in inside
    assert not any(place[0] > 7.0 for place in inside)
