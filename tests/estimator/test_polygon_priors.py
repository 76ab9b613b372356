"""Protects priors that are polygons: no belief outside of one, and in it the exact posterior of a grid."""

import re

import numpy as np
import pytest

from agent.trials.rollout import mission, rollout
from estimator.batch import Batch
from estimator.filter import Config, Posterior, assimilate, prior
from estimator.priors import Normal
from link.bus.mavlink import Reading
from plume.problem import Area, PriorPart, PriorParts, Problem
from plume.scenario import draw

TRIANGLE = ((6.0, 5.0), (27.0, 8.0), (12.0, 26.0))
HOLLOW = (
    (2.0, 2.0),
    (28.0, 2.0),
    (28.0, 28.0),
    (20.0, 28.0),
    (20.0, 8.0),
    (10.0, 8.0),
    (10.0, 28.0),
    (2.0, 28.0),
)
"""A U: its middle, from (10, 8) upwards, is not in it."""
HOUSE = ((8.0, 1.0), (14.0, 1.0), (14.0, 12.0), (8.0, 12.0))
READINGS = [
    Reading(1000 * step, (3.0 + 2 * step, 4.0 + step), 5.0, (2.0, 1.0), gas)
    for step, gas in enumerate((0.1, 0.3, 0.0, 0.9, 1.4, 0.8, 2.2, 0.6))
]


def in_triangle(places: np.ndarray) -> np.ndarray:
    """By the signs of three cross products, as a place is on the same side of each of the sides."""
    corners = np.array(TRIANGLE)
    sides = np.roll(corners, -1, axis=0) - corners
    to = places[:, None] - corners
    return (sides[:, 0] * to[..., 1] - sides[:, 1] * to[..., 0] > 0).all(axis=1)


def in_hollow(places: np.ndarray) -> np.ndarray:
    x, y = places.T
    return (x > 2) & (x < 28) & (y > 2) & (y < 28) & ~((x > 10) & (x < 20) & (y > 8))


def config_of(problem: Problem, count: int = 1000, **further: object) -> Config:
    return Config(count, area=problem.ground, expected=problem.support, **further)  # type: ignore[arg-type]


def after(config: Config) -> Posterior:
    posterior = prior(config)
    for reading in READINGS:
        posterior = assimilate(posterior, reading, config)
    return posterior


@pytest.mark.parametrize("assume", ["paper", "field"])
@pytest.mark.parametrize(("corners", "inside"), [(TRIANGLE, in_triangle), (HOLLOW, in_hollow)])
def test_no_source_is_believed_to_be_outside_of_the_polygon(corners, inside, assume: str) -> None:
    config = config_of(Problem(prior=corners), 2000, assume=assume)
    assert inside(prior(config).particles[:2].T).all()
    assert inside(after(config).particles[:2].T).all()


def test_a_prior_is_even_over_its_polygon() -> None:
    drawn = prior(config_of(Problem(prior=TRIANGLE[::-1]), 20_000)).particles[:2].T
    assert drawn.mean(axis=0) == pytest.approx(np.mean(TRIANGLE, axis=0), abs=0.1)  # its centroid
    cut = np.array(TRIANGLE).mean(axis=0)[1]  # half of the mass is in each of three, from corner to centroid
    below = drawn[drawn[:, 1] < cut]
    assert 0.3 < len(below) / len(drawn) < 0.6


def test_the_belief_in_it_is_that_of_the_open_area_cut_off_at_its_sides() -> None:
    said, free = after(config_of(Problem(prior=TRIANGLE), 8000)), after(Config(8000))
    weights = free.weights * in_triangle(free.particles[:2].T)
    for axis in (0, 1):
        expected = np.average(free.particles[axis], weights=weights)
        assert np.average(said.particles[axis], weights=said.weights) == pytest.approx(expected, abs=0.4)


def test_buildings_in_it_and_across_its_sides_are_left_out() -> None:
    problem = Problem(prior=TRIANGLE, keep_out=(HOUSE,), clearance_m=0.5, start=(2.0, 20.0))
    for posterior in (prior(config_of(problem)), after(config_of(problem))):
        places = posterior.particles[:2].T
        x, y = places.T
        assert in_triangle(places).all()
        assert not ((x > 8) & (x < 14) & (y > 1) & (y < 12)).any()


def test_a_prior_of_x_replaces_the_polygon() -> None:
    config = config_of(Problem(prior=TRIANGLE), priors={"x": Normal(15.0, 2.0)})
    assert not in_triangle(prior(config).particles[:2].T).all()


def test_sources_are_drawn_in_the_polygon() -> None:
    problem = Problem(prior=HOLLOW)
    sources = np.array([draw(seed, problem).source for seed in range(400)])
    assert in_hollow(sources).all()
    elsewhere = problem.changed(source=Area((12.0, 12.0), (18.0, 18.0)))  # as one that is not expected
    assert not in_hollow(np.array([draw(seed, elsewhere).source for seed in range(20)])).any()


def test_a_thin_corridor_along_a_pipe_is_searched() -> None:
    pipe = ((-100.0, 20.0), (-98.0, 16.0), (99.0, 96.0), (98.0, 100.0))
    problem = Problem(area=Area((-110.0, 0.0), (110.0, 110.0)), step_m=4.0, prior=pipe, start=(-100.0, 5.0))
    for step in mission(3, "homing", 200, 0.5, budget=6, problem=problem, assume="field").steps:
        places = step.posterior.particles[:2].T
        assert PriorParts.of(PriorPart(corners=pipe)).held(places).all()


def test_a_problem_with_a_polygon_as_prior_is_what_its_text_says() -> None:
    from plume.problems.names import named

    problem = Problem(prior=[list(corner) for corner in TRIANGLE])  # type: ignore[arg-type]
    assert named(problem.text) == problem
    assert named(problem.told.text).support == problem.support
    assert named({"prior": [[6, 5], [27, 8], [12, 26]]}) == problem


# ---- several parts ----

VALVES = (
    PriorPart(place=(6.0, 20.0), radius_m=2.0, weight=3.0),
    PriorPart(place=(24.0, 9.0), radius_m=1.0, weight=1.0),
)
WEST = ((1.0, 1.0), (11.0, 1.0), (11.0, 29.0), (1.0, 29.0))
EAST = ((14.0, 4.0), (28.0, 4.0), (28.0, 14.0), (14.0, 14.0))


def near(places: np.ndarray, valve: PriorPart) -> np.ndarray:
    assert valve.place is not None
    return np.hypot(*(places - np.array(valve.place)).T) <= valve.radius_m


def in_rectangle(places: np.ndarray, corners: tuple[tuple[float, float], ...]) -> np.ndarray:
    low, high = np.array(corners[0]), np.array(corners[2])
    return ((places > low) & (places < high)).all(axis=1)


def test_places_are_believed_by_their_weights_however_small_they_are() -> None:
    places = prior(config_of(Problem(prior=VALVES), 4000)).particles[:2].T
    one, other = (near(places, valve) for valve in VALVES)
    assert (one | other).all()
    assert one.mean() == pytest.approx(0.75, abs=0.005)  # drawn evenly: far closer than 4,000 free draws


def test_sources_are_drawn_by_the_weights_too() -> None:
    sources = np.array([draw(seed, Problem(prior=VALVES)).source for seed in range(800)])
    one, other = (near(sources, valve) for valve in VALVES)
    assert (one | other).all()
    assert one.mean() == pytest.approx(0.75, abs=0.046)  # three standard errors of 800


def test_polygons_without_weights_are_one_even_prior() -> None:
    parts = PriorPart(corners=WEST), PriorPart(corners=EAST)
    places = prior(config_of(Problem(prior=parts), 4000)).particles[:2].T
    west, east = in_rectangle(places, WEST), in_rectangle(places, EAST)
    assert (west | east).all()
    assert west.mean() == pytest.approx(280 / 420, abs=0.01)  # 10 x 28 m and 14 x 10 m


@pytest.mark.parametrize("weights", [(1.0, 9.0), (9.0, 1.0)])
def test_the_belief_in_parts_is_that_of_the_open_area_weighed_by_their_densities(weights) -> None:
    """Each part's posterior share, by importance sampling from the open area's belief."""
    parts = [PriorPart(corners=corners, weight=w) for corners, w in zip((WEST, EAST), weights, strict=True)]
    few = READINGS[:2]
    said, free = prior(config := config_of(Problem(prior=parts), 8000)), prior(Config(20_000))
    for reading in few:
        said, free = assimilate(said, reading, config), assimilate(free, reading, Config(20_000))
    density = sum(
        w / area * in_rectangle(free.particles[:2].T, corners)
        for w, area, corners in zip(weights, (280, 140), (WEST, EAST), strict=True)
    )
    expected = np.average(in_rectangle(free.particles[:2].T, WEST), weights=free.weights * density)
    west = np.average(in_rectangle(said.particles[:2].T, WEST), weights=said.weights)
    assert 0.02 < expected < 0.98  # the readings leave both possible
    assert west == pytest.approx(expected, abs=0.03)


def test_moves_weigh_the_parts_too() -> None:
    """As readings move particles, the share of a part stays what the weights and the likelihood say."""
    parts = PriorPart(corners=WEST, weight=1.0), PriorPart(corners=EAST, weight=9.0)
    config, open_area = config_of(Problem(prior=parts), 8000), Config(20_000)
    said, free = after(config), prior(open_area)
    for reading in READINGS:
        free = assimilate(free, reading, open_area)
    density = (
        in_rectangle(free.particles[:2].T, WEST) / 280 + 9 * in_rectangle(free.particles[:2].T, EAST) / 140
    )
    weights = free.weights * density
    for axis in (0, 1):
        expected = np.average(free.particles[axis], weights=weights)
        assert np.average(said.particles[axis], weights=said.weights) == pytest.approx(expected, abs=0.5)


def test_parts_that_overlap_add_up() -> None:
    twice = prior(config_of(Problem(prior=(PriorPart(corners=WEST), PriorPart(corners=WEST))), 2000))
    inner = ((1.0, 1.0), (11.0, 1.0), (11.0, 15.0), (1.0, 15.0))  # half of it
    more = PriorPart(corners=WEST, weight=1.0), PriorPart(corners=inner, weight=1.0)
    places = prior(config_of(Problem(prior=more), 4000)).particles[:2].T
    assert in_rectangle(twice.particles[:2].T, WEST).all()
    assert in_rectangle(places, inner).mean() == pytest.approx(0.75, abs=0.01)


def test_a_building_in_a_part_takes_its_share_from_that_part() -> None:
    parts = PriorPart(corners=WEST), PriorPart(corners=EAST)
    house = ((1.0, 9.0), (11.0, 9.0), (11.0, 29.0), (1.0, 29.0))  # leaves 10 x 8 m of it
    problem = Problem(prior=parts, keep_out=(house,), clearance_m=0.5, start=(20.0, 2.0))
    places = prior(config_of(problem, 4000)).particles[:2].T
    west = in_rectangle(places, WEST)
    assert not in_rectangle(places, house).any()
    assert west.mean() == pytest.approx(80 / 220, abs=0.01)


def test_missions_of_a_batch_may_have_different_parts() -> None:
    """Each is what it is alone, to the last bit."""
    configs = [
        config_of(Problem(prior=prior_), 300, seed=seed)
        for seed, prior_ in enumerate(
            [VALVES, None, TRIANGLE, (*VALVES, PriorPart(corners=EAST, weight=2.0))]
        )
    ]
    batch = Batch(configs)
    alone = [prior(config) for config in configs]
    for reading in READINGS:
        batch.assimilate(np.stack([config.row(reading) for config in configs]))
        alone = [assimilate(one, reading, config) for one, config in zip(alone, configs, strict=True)]
    for mission_, one in enumerate(alone):
        assert (batch.particles[mission_] == one.particles).all()
        assert (batch.weights[mission_] == one.weights).all()


def test_a_search_among_valves_finds_the_one_that_leaks() -> None:
    found = [rollout(seed=seed, problem=Problem(prior=VALVES))[0].located for seed in range(12)]
    assert sum(found) >= 11


def test_parts_are_what_their_text_says() -> None:
    from plume.problems.names import named

    problem = Problem(prior=[*VALVES])  # type: ignore[arg-type]  # a list, as in Python's own
    assert named(problem.text) == problem
    assert named(problem.told.text).support == problem.support
    places = [{"place": [6, 20], "weight": 3}, {"place": [24, 9], "radius_m": 1, "weight": 1}]
    assert named({"prior": places}) == problem


@pytest.mark.parametrize(
    ("prior_", "line"),
    [
        ([{"weight": 2}], "a part of a prior has either corners or a place"),
        (
            [{"place": [5, 5], "corners": [[1, 1], [2, 1], [2, 2]]}],
            "a part of a prior has either corners or a place",
        ),
        ([{"place": [5, 5], "radius_m": 0}], "radius_m: 0.0 is not allowed; wanted above 0 up to 1000 m"),
        ([{"place": [5, 5], "weight": -1}], "weight: -1.0 is not allowed; wanted 1e-06 to 1e+06"),
        ([{"place": [5, 5], "weight": 1}, {"place": [9, 5]}], "wanted a weight for each part, or for none"),
        ([{"place": [5, 5]}, [9, 5]], "wanted either the corners of one polygon or parts"),
        ([{"place": [29, 5]}], "1 part in [27, 31] x [3, 7] m is not allowed"),
        ([{"corners": [[1, 1], [9, 9], [9, 1], [1, 9]]}], "prior[0]: its sides 1 and 3 meet"),
        ([{"place": [5, 5], "radius": 1}], "radius"),
        ([{"corners": [[1, 1], [29, 29], [29, 29.02]]}], "prior[0]: the polygon is too thin"),
    ],
)
def test_what_are_no_parts_is_refused_in_one_line(prior_, line: str) -> None:
    from plume.problems.names import named

    with pytest.raises(ValueError, match=re.escape(line)) as refused:
        named({"prior": prior_})
    assert "\n" not in str(refused.value)


# ---- what is refused ----


@pytest.mark.parametrize(
    ("prior_", "line"),
    [
        (((1, 1), (5, 5)), "prior: 2 corners are not allowed; wanted at least 3"),
        (
            ((1, 1), (9, 9), (9, 1), (1, 9)),
            "prior: its sides 1 and 3 meet; wanted the corners in order around it",
        ),
        (
            ((1, 1), (40, 1), (1, 9)),
            "prior: the polygon of 3 corners in [1, 40] x [1, 9] m is not allowed; wanted a rectangle, a polygon or "
            "parts in the area, [0, 30] x [0, 30] m",
        ),
        (
            ((1.0, 1.0), *((2.0, 1.0 + i / 100) for i in range(200))),
            "prior: 201 corners are not allowed; wanted up to 200 in all",
        ),
    ],
)
def test_what_is_no_polygon_in_the_area_is_refused(prior_, line: str) -> None:
    with pytest.raises(ValueError, match=r"^prior: ") as refused:
        Problem(prior=prior_)
    assert str(refused.value) == line


def test_fields_of_a_part_are_read_as_one() -> None:
    assert Problem(prior=[{"place": (5, 5)}]) == Problem(prior=(PriorPart(place=(5, 5)),))  # type: ignore[list-item]
    with pytest.raises(ValueError, match="prior: wanted either the corners of one polygon or parts"):
        Problem(prior=[{"place": (5, 5)}, (5, 5)])  # type: ignore[list-item]
