"""Protects the meaning of a learned policy's actions: hand-worked waypoints, in the observation's frame
and inside the area.
"""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from agent.planning.apart import Shared
from agent.planning.moves import HeadingAndStep, Headings, Move, Reach
from plume.problem import AREA, square
from tests.agent.planners.test_planners import belief_at

EAST, NORTH, SLANTED = (1.0, 0.0, 1.0), (0.0, 1.0, 1.0), (0.6, 0.8, 1.0)
EAST_MIRRORED, NORTH_MIRRORED, SLANTED_MIRRORED = (1.0, 0.0, -1.0), (0.0, 1.0, -1.0), (0.6, 0.8, -1.0)


def lead(
    move: Move, position: tuple[float, float], frame: tuple[float, float, float], action: object
) -> list[float]:
    """The waypoint of one action."""
    place = move.waypoints(np.array([position]), np.array([frame]), np.array([action]), AREA)
    assert place.shape == (1, 2)
    return place[0].tolist()


@pytest.mark.parametrize(
    ("frame", "action", "expected"),
    [
        (EAST, 0, (11, 10)),
        (EAST, 1, (10, 11)),
        (EAST, 2, (9, 10)),
        (EAST, 3, (10, 9)),
        (NORTH, 0, (10, 11)),
        (NORTH, 1, (9, 10)),
        (NORTH, 3, (11, 10)),
        (EAST_MIRRORED, 0, (11, 10)),
        (EAST_MIRRORED, 1, (10, 9)),
        (EAST_MIRRORED, 3, (10, 11)),
        (NORTH_MIRRORED, 0, (10, 11)),
        (NORTH_MIRRORED, 1, (11, 10)),
        (SLANTED, 0, (10.6, 10.8)),
        (SLANTED, 1, (9.2, 10.6)),
        (SLANTED_MIRRORED, 1, (10.8, 9.4)),
    ],
)
def test_headings_go_round_from_the_frames_x_axis_the_other_way_in_a_mirror(
    frame: tuple, action: int, expected: tuple
) -> None:
    assert lead(Headings(4), (10.0, 10.0), frame, action) == pytest.approx(expected, abs=1e-6)


def test_headings_are_evenly_spaced() -> None:
    diagonal = math.sqrt(0.5)
    assert lead(Headings(8), (10.0, 10.0), EAST, 1) == pytest.approx([10 + diagonal, 10 + diagonal], abs=1e-6)
    assert lead(Headings(3), (10.0, 10.0), EAST, 1) == pytest.approx([9.5, 10 + math.sqrt(0.75)], abs=1e-6)


@pytest.mark.parametrize(
    ("frame", "action", "expected"),
    [
        (EAST, (0.0, 1.0), (11, 10)),
        (EAST, (0.5, 1.0), (10, 11)),
        (EAST, (-0.5, 1.0), (10, 9)),
        (EAST, (1.0, 1.0), (9, 10)),
        (EAST, (-1.0, 1.0), (9, 10)),
        (EAST, (0.0, -1.0), (10, 10)),
        (EAST, (0.0, 0.0), (10.5, 10)),
        (EAST, (0.0, -0.5), (10.25, 10)),
        (NORTH, (0.5, 0.0), (9.5, 10)),
        (EAST_MIRRORED, (0.5, 1.0), (10, 9)),
        (NORTH_MIRRORED, (0.5, 1.0), (11, 10)),
        (SLANTED_MIRRORED, (0.5, 0.0), (10.4, 9.7)),
        (EAST, (7.0, 7.0), (9, 10)),
        (EAST, (0.0, -7.0), (10, 10)),  # outputs beyond the bounds are clipped
    ],
)
def test_a_heading_and_a_step_lead_where_they_say(frame: tuple, action: tuple, expected: tuple) -> None:
    assert lead(HeadingAndStep(), (10.0, 10.0), frame, action) == pytest.approx(expected, abs=1e-6)


def test_a_step_is_as_long_as_it_is_set() -> None:
    assert lead(Headings(4, 0.25), (10.0, 10.0), EAST, 1) == [10.0, 10.25]
    assert lead(HeadingAndStep(2.0), (10.0, 10.0), EAST, (0.5, 0.0)) == pytest.approx([10.0, 11.0])


@pytest.mark.parametrize(
    ("move", "action", "to"),
    [
        (Headings(4, 2.0), 1, 2.0),
        (HeadingAndStep(2.0), (0.5, 1.0), 2.0),
        (HeadingAndStep(2.0), (0.5, 0.0), 1.0),
    ],
    ids=str,
)
@pytest.mark.parametrize("unit_m", [1.0, 4.0])  # a frame may be as long as a move
def test_a_step_that_fits_is_no_longer_than_the_belief_allows(
    move: Move, action: object, to: float, unit_m: float
) -> None:
    fitting = msgspec.structs.replace(move, fits=True)
    longest = np.array([0.5, 3.0 * unit_m, np.inf])
    start, frames = np.full((3, 2), 10.0), np.array([[0.0, unit_m, 1.0]] * 3)  # y axis: to the west
    for flown, whole_m in ((fitting, [0.5, 2 * unit_m, 2 * unit_m]), (move, [2 * unit_m] * 3)):
        places = flown.waypoints(start, frames, np.array([action] * 3), square(30), longest)
        assert (10.0 - places[:, 0]).tolist() == pytest.approx([each * to / 2 for each in whole_m], abs=1e-5)


def test_no_move_leads_out_of_the_area() -> None:
    assert lead(Headings(4), (0.25, 10.0), EAST, 2) == [0.0, 10.0]
    assert lead(Headings(4), (29.5, 29.75), SLANTED, 0) == [30.0, 30.0]
    assert lead(HeadingAndStep(), (10.0, 0.5), EAST, (-0.5, 1.0)) == [10.0, 0.0]


def moves_of(count: int) -> list[tuple[Move, np.ndarray, np.ndarray, np.ndarray]]:
    """Both kinds of moves, each with `count` positions, frames and actions."""
    rng = np.random.default_rng(count)
    positions = rng.uniform(2, 28, (count, 2)).astype(np.float32).astype(np.float64)
    angles = rng.uniform(-np.pi, np.pi, count)
    frames = np.stack([np.cos(angles), np.sin(angles), rng.choice([-1.0, 1.0], count)], axis=1)
    return [
        (Headings(16), positions, frames, rng.integers(16, size=count)),
        (HeadingAndStep(), positions, frames, rng.uniform(-1, 1, (count, 2)).astype(np.float32)),
    ]


def test_waypoints_are_float32_values_as_the_wire_carries_them() -> None:
    for move, positions, frames, actions in moves_of(100):
        places = move.waypoints(positions, frames, actions, AREA)
        assert places.dtype == np.float64
        assert (places.astype(np.float32) == places).all()


def test_moves_are_as_long_as_they_say() -> None:
    for move, positions, frames, actions in moves_of(100):
        lengths = np.linalg.norm(move.waypoints(positions, frames, actions, AREA) - positions, axis=1)
        expected = np.ones(100) if actions.ndim == 1 else (actions[:, 1] + 1) / 2
        assert lengths == pytest.approx(expected, abs=1e-5)


def test_one_move_leads_to_the_same_bits_as_among_many() -> None:
    for move, positions, frames, actions in moves_of(261):
        together = move.waypoints(positions, frames, actions, AREA)
        alone = [move.waypoints(positions[[i]], frames[[i]], actions[[i]], AREA)[0] for i in range(261)]
        assert together.tobytes() == np.array(alone).tobytes()


def test_a_network_says_how_good_each_heading_is_or_the_action_itself() -> None:
    assert (Headings(8).outputs, HeadingAndStep().outputs) == (8, 2)
    assert Headings(3).action(np.array([[0.1, 0.5, 0.2], [2.0, -1.0, 1.0]])).tolist() == [1, 0]
    said = np.array([[0.25, -0.5]])
    assert HeadingAndStep().action(said).tolist() == said.tolist()


@pytest.mark.parametrize(
    "move",
    [Headings(16), Headings(4, 0.5), HeadingAndStep(), HeadingAndStep(2.0), Headings(16, fits=True)],
    ids=str,
)
def test_what_actions_mean_is_told_in_json(move: Move) -> None:
    assert msgspec.json.decode(msgspec.json.encode(move), type=Move) == move


@pytest.mark.parametrize(
    ("area_m", "step_m", "spread_m", "flown_m"),
    [
        (30, 10, 8, 2.0),  # a quarter of the spread
        (30, 10, 1, 0.5),  # a sixtieth of the side
        (30, 10, 0.1, 0.4),  # four spreads
        (30, 10, 60, 10.0),  # a step
        (30, 1, 8, 1.0),
        (30, 1, 0.25, 0.5),
        (30, 1, 3, 0.75),
        (30, 0.25, 1, 0.25),
        (30, 1, 1e-9, 0.1),  # a three-hundredth of the side
        (30, 1, 0.0, 1.0),  # the place is known
        (300, 10, 80, 10.0),
        (300, 10, 0.9, 3.6),
    ],
)
def test_moves_are_short_where_the_belief_is_narrow(
    area_m: float, step_m: float, spread_m: float, flown_m: float
) -> None:
    belief = msgspec.structs.replace(belief_at((5.0, 6.0)), spread=spread_m)
    reach = Reach(headings=8, step=step_m, area=square(area_m))
    assert reach.fitted(belief).step == step_m
    assert replace(reach, fits=True).fitted(belief) == replace(
        reach, fits=True, step=pytest.approx(flown_m, rel=1e-12)
    )


def test_a_fleet_makes_moves_twice_as_long_where_the_belief_is_narrow() -> None:
    belief = msgspec.structs.replace(belief_at((5.0, 6.0)), spread=1.0)
    assert Reach(step=10.0, fits=True).fitted(belief).step == pytest.approx(0.5, rel=1e-12)
    assert Shared(step=10.0, fits=True).fitted(belief).step == pytest.approx(1.0, rel=1e-12)


def test_a_search_that_repeats_itself_goes_elsewhere() -> None:
    belief = msgspec.structs.replace(belief_at((5.0, 6.0)), spread=8.0, back=(6.0, 6.0))
    reach = Reach(fits=True).fitted(belief)
    assert reach.moves((5.0, 6.0)).tolist() == [[5.0, 7.0], [4.0, 6.0], [5.0, 5.0]]
    assert reach.moves((5.0, 5.0)).tolist() == [[6.0, 5.0], [5.0, 6.0], [4.0, 5.0], [5.0, 4.0]]
    assert Reach().fitted(belief) == Reach()  # as its paper has it
    corner = Reach(fits=True, area=square(0.5)).fitted(msgspec.structs.replace(belief, back=(0.5, 0.25)))
    assert corner.avoided == (0.5, 0.25)
    assert replace(corner, headings=1, step=0.25).moves((0.25, 0.25)).tolist() == [[0.5, 0.25]]  # no other
