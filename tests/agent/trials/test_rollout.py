"""Protects missions flown in-process, and the honesty of the stop over many of them."""

import math
import subprocess
import sys
from itertools import pairwise, product

import numpy as np
import pytest
from msgspec.structs import replace

from agent.trials.rollout import mission, rollout
from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from link.bus.mavlink import Reading
from plume.dispersion import concentration
from plume.outcome import outcome_text
from plume.parameters import LIMITS
from plume.problem import PAPER
from plume.scenario import AS_MODELLED, Scenario, draw
from plume.sensors.names import KINDS, parse
from plume.worlds.errors import WRONG
from plume.worlds.world import World
from plumeward.evaluation import evaluate


def test_a_rollout_is_a_function_of_its_seed() -> None:
    first, trace = rollout(3, "infotaxis", particles=300)
    second, again = rollout(3, "infotaxis", particles=300)
    assert trace == again
    assert (first.estimate, first.steps) == (second.estimate, second.steps)
    assert rollout(4, "infotaxis", particles=300)[1] != trace


@pytest.mark.parametrize("world", [AS_MODELLED, *WRONG])
def test_in_every_world_the_estimator_is_told_the_same_and_the_mission_is_judged_by_the_truth(
    world: str,
) -> None:
    usual, ready = (mission(3, "random", 100, 0.5, 5, world=name) for name in ("as-modelled", world))
    assert ready.config == usual.config
    for said, modelled in zip(ready.steps, usual.steps, strict=True):
        assert said.belief.wind == modelled.belief.wind or world == "wind-noisy"
        assert (said.belief.rate, said.belief.diffusivity, said.belief.lifetime) == (
            draw(3).q,
            draw(3).d,
            draw(3).tau,
        )
    result, trace = rollout(3, "random", particles=100, budget=5, world=world)
    there = World(draw(3), 3, name=world)
    assert (result.world, result.scenario, result.source) == (world, there.truth, there.truth.source)
    assert [point.reading for point in trace] == [
        there.gas(point.position, step) for step, point in enumerate(trace)
    ]
    assert result.error_m == pytest.approx(math.dist(trace[-1].mean, there.truth.source))


@pytest.mark.one_in(3)
@pytest.mark.slow
@pytest.mark.parametrize("assume", ["paper", "field"])
@pytest.mark.parametrize("kind", KINDS)
def test_at_the_limits_of_what_may_be_given_gas_and_belief_stay_finite(kind: str, assume: str) -> None:
    """A belief is where the source may be: its spread is above 0 and within the area, and nothing
    overflows on the way.
    """
    q, u, d, tau, height = (LIMITS[name] for name in ("q", "u", "d", "tau", "z"))
    for release in product(q, u, d, tau, (0.0, *height)):
        scenario = Scenario(
            (10.0, 10.0), release[0], release[1], 0.0, *release[2:4], (12.0, 10.0), release[4]
        )
        world = World(scenario, 1, parse(kind))
        config = Config(
            100,
            rate=scenario.q,
            diffusivity=scenario.d,
            lifetime=scenario.tau,
            sensor=world.sensor,
            assume=assume,
        )
        posterior = prior(config)
        for step, position in enumerate([(12.0, 10.0), (9.0, 10.0), (10.0, 10.0), (10.0, 11.0)]):
            reading = Reading(step, position, 5.0, world.wind, world.gas(position, step))
            posterior = assimilate(posterior, reading, config)
            assert 0 <= belief(posterior, reading, config)[0].spread < 30, release


@pytest.mark.parametrize(("sensor", "alike"), [("gaussian", True), ("pid", False)])
def test_where_readings_are_lost_the_values_taken_later_are_the_same_unless_the_sensor_lags(
    sensor: str, alike: bool
) -> None:
    lost, usual = (
        rollout(4, "homing", 100, budget=30, world=world, sensor=parse(sensor))[1]
        for world in ("readings-lost", AS_MODELLED)
    )
    assert (lost == usual) is alike


def test_a_world_that_is_none_is_told_with_those_that_are() -> None:
    with pytest.raises(
        ValueError, match=r"no world 'windy'; did you mean 'wind-noisy'\? Wanted as-modelled, "
    ):
        rollout(1, world="windy")


def test_the_budget_counts_moves() -> None:
    result, trace = rollout(1, "random", particles=100, budget=7)
    assert not result.ceased
    assert (result.steps, len(trace)) == (7, 8)


def test_the_outcome_says_what_was_assumed_and_when_it_stops() -> None:
    brief = {"policy": "random", "particles": 50, "budget": 1}
    for given, said in (
        ({}, ("field", "spread:0.5")),
        ({"assume": "paper", "stop": "within:1,0.99"}, ("paper", "within:1,0.99")),
    ):
        result, _ = rollout(1, **brief, **given)
        assert (result.assume, result.stop) == said
        assert f"\nassumed  {said[0]}, stop {said[1]}" in outcome_text(result)
    with pytest.raises(ValueError, match="wanted paper or field"):
        rollout(1, **brief, assume="feild")
    with pytest.raises(ValueError, match=r"stop 'spread:1' is not allowed with threshold_m 0\.3"):
        rollout(1, **brief, threshold_m=0.3, stop="spread:1")


def test_the_place_on_earth_is_counted_from_the_home_of_the_problem() -> None:
    said, _ = rollout(4, "greedy", particles=50, problem=replace(PAPER, home=(51.4496, -2.6021), budget=3))
    x, y = said.estimate
    north_m, east_m = (said.latitude_deg - 51.4496) * 111_195, (said.longitude_deg + 2.6021) * 69_297
    assert (east_m, north_m) == pytest.approx((x, y), rel=1e-3)  # of a sphere of 6,371 km, at 51.45°


def test_a_spread_is_the_same_stop_in_its_short_and_its_long_form() -> None:
    short, long = (
        rollout(3, "greedy", 100, 2.0, assume="paper"),
        rollout(3, "greedy", 100, stop="spread:2", assume="paper"),
    )
    assert short[1] == long[1]
    assert short[0].ceased


def test_a_given_threshold_comes_before_the_stop_of_a_problem() -> None:
    """That is so of the paper's, too, which is the one of a problem that does not say its own."""
    brief, problem = {"particles": 50, "budget": 1}, {"stop": "spread:9"}
    for given, stop in (({}, "spread:9"), ({"threshold_m": 0.5}, "spread:0.5")):
        assert rollout(1, **brief, problem=problem, **given)[0].stop == stop
        (figures,) = evaluate("greedy", 1, **brief, problem=problem, **given).values()
        assert figures["stop"] == stop


def test_a_stop_within_a_radius_comes_when_enough_particles_are_there() -> None:
    """Counted here from the particles as they are published."""
    steps = list(mission(8, "greedy", 300, 0.5, 80, within=(2.0, 0.9)).steps)
    shares = []
    for said, particles, *_ in steps:
        away = np.hypot(*(particles[:, :2].astype(float) - said.mean).T)
        shares.append(particles[away <= 2.0, 2].sum(dtype=float))
        assert said.ceased == (shares[-1] >= 0.9 and said.step >= 2)
    assert steps[-1].belief.ceased
    assert min(shares) < 0.5


def test_every_move_is_a_metre_inside_the_area() -> None:
    _, trace = rollout(5, "random", particles=100)
    for a, b in pairwise(trace):
        assert math.dist(a.position, b.position) == pytest.approx(1.0, abs=1e-5)
        assert min(b.position) >= 0
        assert max(b.position) <= 30


@pytest.mark.full
@pytest.mark.slow
def test_infotaxis_finds_the_source_and_its_stop_can_be_believed() -> None:
    results = [
        rollout(seed, "infotaxis", particles=1000, assume="paper")[0] for seed in range(1_000_000, 1_000_060)
    ]
    assert all(result.ceased for result in results)
    # An honest stop is located in about 98% of missions; fewer than 54 of 60 would come by chance once in
    # 2,000 such tests.
    assert sum(result.located for result in results) >= 54
    assert sum(result.distance_m for result in results) / 60 < 70


@pytest.mark.one_in(3)
@pytest.mark.slow
@pytest.mark.parametrize(
    "module",
    [
        "agent.trials.rollout",
        "agent.service",
        "estimator.service",
        "aircraft.search.uav",
        "sitl.launch.launcher",
        "agent.planners.infotaxis",
    ],
)
def test_flying_needs_no_torch(module: str) -> None:
    code = f"import sys; sys.modules['torch'] = None; import {module}; assert 'gymnasium' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)


def strongest(s: Scenario) -> float:
    """The greatest mean gas in the area, g/m³."""
    axis = np.linspace(0.0, 30.0, 61)
    places = np.stack([*np.meshgrid(axis, axis), np.zeros((61, 61))], axis=-1)
    release = {"rate": s.q, "diffusivity": s.d, "lifetime": s.tau}
    return float(concentration(places, (*s.source, s.height), s.wind, **release).max())


@pytest.mark.full
def test_sources_outside_are_told_as_outside_where_their_gas_shows_and_none_is_claimed_inside() -> None:
    """Where the mean gas is twice the noise of clean air somewhere in the area, the flight could know."""
    shows, told = [], []
    for seed in range(2_000_000, 2_000_010):
        result, trace = rollout(seed, world="source-beyond", budget=300)
        assert result.outside or not result.ceased, seed
        assert result.scenario is not None
        assert not result.located
        shows.append(strongest(result.scenario) > 0.4)
        told.append(result.outside)
        if result.outside:
            assert result.outside_to
            assert result.outside_share >= 0.95
            assert all(min(point.position) >= 0 and max(point.position) <= 30 for point in trace)
    assert sum(shows) >= 5
    # Of 60 other missions all were told where it shows.
    assert np.mean(np.array(told)[shows]) >= 0.8


def test_a_belief_says_what_share_of_it_is_outside() -> None:
    (*_, last) = mission(2_000_003, "homing", 300, 0.5, 8, assume="field").steps
    x, y, weights = last.particles[:, 0], last.particles[:, 1], last.particles[:, -1].astype(float)
    outside = (x < 0) | (x > 30) | (y < 0) | (y > 30)
    assert 0 < last.belief.outside < 0.95
    assert last.belief.outside == pytest.approx(weights[outside].sum(), abs=1e-5)
