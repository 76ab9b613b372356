"""Protects flight between obstacles: no way into one, and distances that are those of the way around."""

import math
from heapq import heappop, heappush
from itertools import pairwise

import numpy as np
import pytest

from agent.learn.env import SourceSearch
from agent.planning.around import around, distances_to
from agent.planning.moves import Reach, lengths
from agent.trials.rollout import mission
from benchmarks.obstacles import among_buildings
from plume.polygons.obstacles import HAIR_M, Obstacles
from plume.problem import AREA, Problem
from plume.problems.fleet import Fleet

HOUSE = ((10.0, 10.0), (20.0, 10.0), (20.0, 20.0), (10.0, 20.0))
TOWER = ((4.0, 22.0), (6.0, 22.0), (6.0, 26.0), (4.0, 26.0))
PROBLEM = Problem(keep_out=(HOUSE, TOWER), clearance_m=1.0)
GROUND = PROBLEM.ground
OBSTACLES = GROUND.obstacles
assert OBSTACLES


def reach(step: float = 1.0, headings: int = 8) -> Reach:
    return Reach(headings=headings, step=step, area=GROUND)


def is_free(start: tuple[float, float], end: tuple[float, float]) -> bool:
    assert OBSTACLES
    return bool(OBSTACLES.are_free(np.array([start, end])))


def test_moves_never_enter_a_grown_obstacle_wherever_the_vehicle_is() -> None:
    assert OBSTACLES
    rng, shortened = np.random.default_rng(1), 0
    for position in rng.random((400, 2)).astype(np.float32).astype(float) * 30:
        place = (float(position[0]), float(position[1]))
        if not OBSTACLES.are_clear(position):
            continue
        for move in reach(3.0).moves(place):
            assert is_free(place, tuple(move))
            assert GROUND.holds(move)
            shortened += lengths(move - position) < 2.99
    assert shortened > 50


def test_far_from_obstacles_moves_are_those_of_the_open_area() -> None:
    moves = reach().moves((5.0, 5.0))
    assert (moves[:8] == Reach(headings=8).moves((5.0, 5.0))).all()


def test_moves_lead_to_the_corners_in_sight_too_so_there_is_one_along_each_wall() -> None:
    """From close to the middle of the house's western wall, its north-western corner is in sight."""
    position = (8.98, 16.0)
    moves = reach().moves(position).tolist()
    assert sum(8.982 < x < 8.984 and 16.999 < y < 17.001 for x, y in moves) == 1  # 1 m of 4.2 m, to x = 8.99
    assert all(math.dist(place, position) < 1.001 for place in moves)
    close = reach().moves((8.98, 20.0))  # the corner is nearer than a step: no move goes beyond it
    assert any(0.1 < math.dist(place, (8.98, 20.0)) < 0.5 for place in close)


def test_a_step_towards_a_wall_is_halved_until_it_is_free() -> None:
    """From 2.5 m before the wall, with a clearance of 1 m, a step of 2 m east is 1 m; from 1.1 m none."""
    assert [8.5, 15.0] in reach(2.0).moves((7.5, 15.0)).tolist()
    near = np.float32(8.9).item()
    moves = reach(2.0).moves((near, 15.0)).tolist()
    assert all(x < 9 for x, _ in moves)
    assert sum(x > near for x, _ in moves) == 2  # towards the two corners, along the wall


def test_who_has_no_free_way_stays() -> None:
    assert reach().moves((15.0, 15.0)).tolist() == [[15.0, 15.0]]
    assert reach().freed((15.0, 15.0), (16.0, 15.0)) == (15.0, 15.0)


def test_a_policy_that_heads_into_a_wall_is_turned_aside_and_others_are_left_alone() -> None:
    assert reach().freed((5.0, 5.0), (6.0, 5.5)) == (6.0, 5.5)
    start = (8.5, 15.0)
    turned = reach().freed(start, (9.5, 15.0))
    assert is_free(start, turned)
    assert math.dist(start, turned) == pytest.approx(1.0)


def test_places_further_ahead_are_the_moves_ends_where_a_wall_is_between() -> None:
    moves = reach().moves((7.5, 15.0))
    ahead = reach().ahead((7.5, 15.0), moves, 2.0)
    for place in ahead:
        assert is_free((7.5, 15.0), tuple(place))
    assert [8.5, 15.0] in ahead.tolist()
    assert [5.5, 15.0] in ahead.tolist()
    both = reach().ahead((7.5, 15.0), moves, np.array([2.0, 4.0]))
    assert both.shape == (len(moves), 2, 2)
    assert (both[:, 0] == ahead).all()


def test_in_the_open_a_distance_is_straight() -> None:
    goals = np.random.default_rng(2).random((2, 50)) * 30
    far = Obstacles((((90.0, 90.0), (91.0, 90.0), (91.0, 91.0)),), (), 1.0, (0.0, 0.0), (100.0, 100.0))
    places = np.array([[1.0, 2.0], [20.0, 3.0]])
    assert around(places, goals, far) == pytest.approx(lengths(places[:, None] - goals.T))
    assert (distances_to(goals[:, 0], places, AREA) == lengths(places - goals[:, 0])).all()


def test_a_distance_leads_around_the_house_by_its_corners() -> None:
    """A string pulled tight around the house, a metre off: straight to the arc around a corner, along it, on."""
    tangent = math.sqrt(math.dist((5, 15), (10, 10)) ** 2 - 1)
    arc = math.radians(270 - 135) - math.acos(1 / math.dist((5, 15), (10, 10)))
    for goal, length_m in (
        ((25.0, 15.0), 2 * (tangent + arc) + 10),
        ((15.0, 9.5), tangent + arc + 5 + 0.5),  # in the clearance: along the wall, and in
    ):
        found = around(np.array([5.0, 15.0]), np.array(goal)[:, None], OBSTACLES)[0]
        assert length_m < found < 1.005 * length_m


def test_a_source_inside_is_as_far_as_the_crow_flies() -> None:
    assert around(np.array([5.0, 15.0]), np.array([[15.0], [15.0]]), OBSTACLES).tolist() == [10.0]


def test_ways_around_are_as_long_as_those_of_a_fine_grid() -> None:
    """Against Dijkstra's ways over a grid of half a metre, which are up to 8.3% longer than straight ones."""
    assert OBSTACLES
    cells = np.stack(np.meshgrid(np.arange(61), np.arange(61), indexing="ij"), axis=-1) / 2
    clear = OBSTACLES.are_clear(cells)
    lengths_m = {(10, 30): 0.0}
    queue = [(0.0, (10, 30))]
    while queue:
        length, (i, j) = heappop(queue)
        for east, north in ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)):
            to = (i + east, j + north)
            on = length + math.hypot(east, north) / 2
            if min(to) >= 0 and max(to) <= 60 and clear[to] and on < lengths_m.get(to, math.inf):
                lengths_m[to] = on
                heappush(queue, (on, to))
    goals = [*lengths_m]
    found = around(np.array([5.0, 15.0]), np.array(goals).T / 2, OBSTACLES)
    longer = np.array([lengths_m[goal] for goal in goals]) / np.maximum(found, 0.5)
    assert len(goals) > 2500
    assert longer.max() < 1.1
    assert longer[found > 2].min() > 0.97  # corners of the visibility graph are cut square


@pytest.mark.parametrize("seed", range(5))
def test_nobody_is_nearer_to_a_goal_by_more_than_the_metres_flown(seed: int) -> None:
    """A search whose moves promise more goes to and fro between two places.

    In a few places a passage is as wide as two clearances, and ways by corners miss it.
    """
    obstacles, rng = among_buildings(seed).ground.obstacles, np.random.default_rng(seed)
    places = rng.random((400, 2)) * 30
    places = places[obstacles.are_clear(places)]
    others = places + rng.normal(0, 0.7, places.shape)
    free = obstacles.are_free(np.stack([places, others], axis=1))
    places, others = places[free], others[free]
    goals = rng.random((2, 500)) * 30
    goals = goals[:, ~obstacles.enclose(goals.T)]
    assert 20 < (~obstacles.are_clear(goals.T)).sum() < 400
    gained = np.abs(around(places, goals, obstacles) - around(others, goals, obstacles))
    assert len(gained) > 50
    assert (gained > lengths(others - places)[:, None] + 2 * HAIR_M).mean() < 1e-4


@pytest.mark.parametrize("continuous", [False, True])
def test_an_environment_turns_actions_aside(continuous: bool) -> None:
    env = SourceSearch(problem=PROBLEM, particles=50, continuous=continuous)
    rng = np.random.default_rng(3)
    _, info = env.reset(seed=4)
    for _ in range(150):
        before = tuple(info["position"])
        action = np.array([rng.uniform(-0.5, 0.1), 1.0]) if continuous else rng.integers(0, 3)
        _, _, ended, cut, info = env.step(action.astype(np.float32) if continuous else action)
        assert is_free(before, tuple(info["position"]))
        if ended or cut:
            _, info = env.reset()


@pytest.mark.one_in(2)
@pytest.mark.parametrize("policy", ["random", "ppo", "homing", "dcee", "thompson", "space-aware-infotaxis"])
def test_a_search_does_not_enter_an_obstacle(policy: str) -> None:
    for vehicles in (1, 2):
        for seed in (1, 2):
            steps = list(
                mission(seed, policy, 100, 0.5, problem=PROBLEM, budget=60, fleet=Fleet(vehicles)).steps
            )
            for before, after in pairwise(steps):
                for start, end in zip(before.readings, after.readings, strict=True):
                    assert is_free(start.position, end.position)
