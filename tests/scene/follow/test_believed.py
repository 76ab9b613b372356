"""Protects what is shown of a belief: its 95% radius, its rate, and the colours of readings."""

import math

import msgspec
import numpy as np
import pytest

from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from estimator.priors import Uniform
from link.bus.mavlink import Reading
from scene.follow.believed import gauge_of, measured, quantiles, radius
from scene.scene import Scatter


def test_quantiles_are_of_the_weights() -> None:
    values, weights = np.array([3.0, 1.0, 2.0], np.float32), np.array([0.1, 0.6, 0.3], np.float32)
    assert quantiles(values, weights, (0.05, 0.5, 0.8, 0.95, 1.0)) == [1.0, 1.0, 2.0, 3.0, 3.0]
    assert math.isnan(quantiles(values[:0], weights[:0], (0.5,))[0])


def test_a_stop_allows_for_half_of_the_cv_that_the_belief_expects() -> None:
    for config in (Config(particles=50, priors={"cv": Uniform(0.2, 0.4)}), Config(particles=50)):
        reading = Reading(0, (8.0, 9.0), 5.0, (1.5, -0.5), 1.3)
        said, cloud = belief(assimilate(prior(config), reading, config), reading, config)
        alike = sum(said.means[2:]) / 2  # of cv, the third unknown, if it is one
        assert measured(said, cloud, 0.0).stretch == pytest.approx(math.sqrt((1 + alike) / (1 - alike)))


@pytest.mark.parametrize(("cv", "wider"), [(-3.0, 1.0), (0.0, 1.0), (1e308, math.sqrt(1.4 / 0.6))])
def test_whatever_cv_a_belief_tells_there_is_something_to_show(cv: float, wider: float) -> None:
    config, reading = Config(particles=50), Reading(0, (8.0, 9.0), 5.0, (1.5, -0.5), 1.3)
    said, _ = belief(assimilate(prior(config), reading, config), reading, config)
    absurd = msgspec.structs.replace(said, unknowns=("cv",), means=(cv,))
    assert measured(absurd, None, 0.0).stretch == pytest.approx(wider)


def test_the_radius_holds_95_of_100_even_particles() -> None:
    places = np.column_stack([np.arange(1, 101), np.zeros(100)]).astype(np.float32)
    assert radius(Scatter(places, np.full(100, 0.01, np.float32)), (0.0, 0.0)) == pytest.approx(95, abs=1)


def test_of_a_round_gaussian_it_is_the_textbooks() -> None:
    places = np.random.default_rng(1).normal(5.0, 2.0, (20_000, 2)).astype(np.float32)
    scatter = Scatter(places, np.full(20_000, 1 / 20_000, np.float32))
    assert radius(scatter, (5.0, 5.0)) == pytest.approx(2.0 * math.sqrt(-2 * math.log(0.05)), rel=0.02)


@pytest.mark.parametrize(
    ("sensor", "unit", "first"),
    [
        ("gaussian", "g/m³", 0.4),
        ("gaussian:0.3,0.1", "g/m³", 0.2),
        ("hits", "hits", 1.0),
        ("threshold", "g/m³", 0.5),
    ],
)
def test_the_scale_begins_above_the_noise_of_clean_air(sensor: str, unit: str, first: float) -> None:
    gauge = gauge_of(sensor)
    assert gauge is not None
    assert (gauge.unit, gauge.edges[0], gauge.falls) == (unit, pytest.approx(first), False)
    assert list(gauge.edges) == sorted(gauge.edges)


def test_gas_lowers_a_metal_oxides_reading() -> None:
    gauge = gauge_of("tgs2620")
    assert gauge is not None
    assert gauge.falls
    assert list(gauge.edges) == sorted(gauge.edges, reverse=True)
    assert gauge.edges[0] < 21.0  # in clean air
    assert (gauge_of("tdlas") or gauge).unit == "g/m²"
    assert gauge_of("no such sensor") is None
