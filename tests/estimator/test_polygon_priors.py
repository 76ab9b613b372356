"""Protects priors that are polygons: no belief outside of one, and in it the exact posterior of a grid."""

import numpy as np
import pytest

from agent.trials.rollout import mission
from estimator.filter import Config, Posterior, assimilate, prior
from estimator.priors import Normal
from link.bus.mavlink import Reading
from plume.problem import Area, PolygonArea, Problem
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
        assert PolygonArea.of(pipe).held(places).all()


def test_a_problem_with_a_polygon_as_prior_is_what_its_text_says() -> None:
    from plume.problems.names import named

    problem = Problem(prior=[list(corner) for corner in TRIANGLE])  # type: ignore[arg-type]
    assert named(problem.text) == problem
    assert named(problem.told.text).support == problem.support
    assert named({"prior": [[6, 5], [27, 8], [12, 26]]}) == problem


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
            "prior: the polygon of 3 corners in [1, 40] x [1, 9] m is not allowed; wanted a rectangle or a polygon "
            "in the area, [0, 30] x [0, 30] m",
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
