"""Protects the belief outside of buildings: no source is expected inside one, and the rest stays as it was."""

import numpy as np
import pytest

from agent.trials.rollout import mission
from estimator.batch import Batch
from estimator.filter import Config, Posterior, assimilate, prior
from estimator.priors import Fixed, Normal
from link.bus.mavlink import Reading
from plume.problem import Fenced, Problem

HOUSE = ((12.0, 12.0), (18.0, 12.0), (18.0, 20.0), (12.0, 20.0))
TURNED = ((20.0, 22.0), (24.0, 26.0), (22.0, 28.0), (18.0, 24.0))[::-1]
PROBLEM = Problem(keep_out=(HOUSE, TURNED), clearance_m=1.0)
GROUND = PROBLEM.ground
READINGS = [
    Reading(1000 * step, (3.0 + 2 * step, 4.0 + step), 5.0, (2.0, 1.0), gas)
    for step, gas in enumerate((0.1, 0.3, 0.0, 0.9, 1.4, 0.8, 2.2, 0.6))
]


def inside(posterior: Posterior) -> np.ndarray:
    assert isinstance(GROUND, Fenced)
    return GROUND.obstacles.enclose(posterior.particles[:2].T)


def after(config: Config) -> Posterior:
    posterior = prior(config)
    for reading in READINGS:
        posterior = assimilate(posterior, reading, config)
    return posterior


@pytest.mark.parametrize("assume", ["paper", "field"])
def test_no_source_is_believed_to_be_inside_a_building(assume: str) -> None:
    config = Config(2000, area=GROUND, assume=assume)
    assert not inside(prior(config)).any()
    said, free = after(config), after(Config(2000, assume=assume))
    assert not inside(said).any()
    assert inside(free).mean() > 0.01


def test_the_rest_of_the_belief_is_that_of_the_open_area_outside_of_the_buildings() -> None:
    said, free = after(Config(8000, area=GROUND)), after(Config(8000))
    weights = free.weights * ~inside(free)
    for axis in (0, 1):
        expected = np.average(free.particles[axis], weights=weights)
        assert np.average(said.particles[axis], weights=said.weights) == pytest.approx(expected, abs=0.4)


def test_if_sources_may_be_inside_the_belief_is_that_of_the_open_area() -> None:
    told = PROBLEM.changed(source_inside=True).ground
    one, other = after(Config(300, area=told)), after(Config(300))
    assert (one.particles == other.particles).all()
    assert (one.weights == other.weights).all()


@pytest.mark.parametrize("priors", [{"x": Fixed(15.0)}, {"x": Normal(15.0, 2.0)}])
def test_priors_of_other_kinds_are_outside_too(priors: dict) -> None:
    config = Config(500, area=GROUND, priors=priors)
    drawn = prior(config).particles
    x = np.full(500, 15.0) if config.unknowns == ("y",) else drawn[0]
    assert isinstance(GROUND, Fenced)
    assert not GROUND.obstacles.enclose(np.stack([x, drawn[-1]], axis=1)).any()


def test_missions_of_a_batch_with_other_buildings_are_those_flown_alone() -> None:
    grounds = [Problem().area, GROUND, PROBLEM.changed(keep_out=(TURNED,)).ground]
    configs = [Config(200, seed=number, area=ground) for number, ground in enumerate(grounds)]
    batch = Batch(configs[:1] * 3)
    for number, config in enumerate(configs):
        batch.begin(number, config)
    for reading in READINGS:
        batch.assimilate(np.array([config.row(reading) for config in configs]))
    for number, config in enumerate(configs):
        assert (batch.particles[number] == after(config).particles).all()


def test_a_search_among_buildings_expects_no_source_inside() -> None:
    for step in mission(5, "homing", 200, 0.5, budget=15, problem=PROBLEM, assume="field").steps:
        assert not inside(step.posterior).any()
