"""Protects the stop criterion: its text form, and what within:R,P asks of a belief, one alone and in a
batch.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.batch import Batch
from estimator.belief import belief, met, stop
from estimator.criterion import Criterion, chosen, parse
from estimator.filter import Config, Posterior, assimilate, prior
from estimator.priors import Fixed, Uniform
from link.bus.mavlink import Reading
from plume.randomness import keyed
from plume.scenario import Scenario
from plume.sensors.names import GAUSSIAN
from plume.worlds.world import World

GUSTS = {"threshold_m": 3.0, "priors": {"cv": Fixed(0.5)}}
READING = Reading(77, (1.0, 2.0), 5.0, (1.0, 0.0), 0.5)


def posterior_of(particles: list[list[float]], weights: list[float]) -> Posterior:
    """A posterior after three readings, which its particles explain far better than one value does."""
    w, readings = np.array(weights), np.zeros((3, 7))
    readings[:, 5] = 0.5, 0.25, 0.125
    return Posterior(
        np.array(particles), np.log(w), w / w.max(), np.full(len(w), 50.0), readings, np.array([0.5])
    )


@pytest.mark.parametrize(
    ("text", "criterion"),
    [
        ("spread:0.5", Criterion(0.5)),
        ("spread:1e-09", Criterion(1e-9)),
        ("within:1,0.99", Criterion(within=(1.0, 0.99))),
        ("within:0.123456789,1", Criterion(within=(0.123456789, 1.0))),
    ],
)
def test_a_criterion_is_read_and_written_in_the_form_of_the_flag(text: str, criterion: Criterion) -> None:
    assert parse(text) == criterion
    assert criterion.text == text


@pytest.mark.parametrize(
    "text",
    [
        "",
        "spread",
        "spread:",
        "spread:0",
        "spread:-1",
        "spread:nan",
        "spread:inf",
        "spread:0.5,1",
        "near:1",
        "within:1",
        "within:0,0.9",
        "within:1,0",
        "within:1,1.01",
        "within:1,99",
        "within:x,0.9",
        "within:1,0.9,3",
        "within:101,0.9",
        "0.5",
    ],
)
def test_other_criteria_are_refused_with_what_is_wanted(text: str) -> None:
    with pytest.raises(ValueError, match="is not allowed; wanted "):
        parse(text)


def test_one_of_a_threshold_and_a_criterion_can_be_given() -> None:
    assert chosen(0.3, None, "spread:9") == Criterion(0.3)
    assert chosen(0.5, None, "spread:9") == Criterion(0.5)  # as of a problem that says nothing, but given
    assert chosen(None, "within:2,0.9", "spread:9") == Criterion(within=(2.0, 0.9))
    assert chosen(None, None, "spread:9") == Criterion(9.0)
    for threshold_m in (0.3, 0.5):
        with pytest.raises(ValueError, match=rf"'spread:1' is not allowed with threshold_m {threshold_m};"):
            chosen(threshold_m, "spread:1", "spread:9")


# Weights 0.7, 0.2, 0.1 at x = 10, 11, 14, y = 5: the mean is x = 10.6, so they lie 0.6, 0.4 and 3.4 m from
# the estimate.
THREE = posterior_of([[10.0, 11.0, 14.0], [5.0, 5.0, 5.0]], [0.7, 0.2, 0.1])


@pytest.mark.parametrize(
    ("within", "ceased"),
    [
        ((0.5, 0.15), True),
        ((0.5, 0.25), False),
        ((1.0, 0.89), True),
        ((1.0, 0.91), False),
        ((3.5, 1.0), True),
        ((3.3, 0.95), False),
    ],
)
def test_it_stops_when_the_share_of_the_belief_near_the_estimate_is_large_enough(
    within: tuple[float, float], ceased: bool
) -> None:
    config = Config(threshold_m=1e-9, within=within)
    said, _ = belief(THREE, READING, config)
    assert said.ceased == ceased
    assert said.stop == f"within:{within[0]:g},{within[1]:g}"
    claim = stop(said, config)
    assert (claim.stop, claim.threshold) == (said.stop, 0.0)


def test_by_default_it_is_the_spread_and_the_messages_say_so() -> None:
    config = Config(threshold_m=2.0)
    said, _ = belief(THREE, READING, config)
    assert (said.assume, said.stop) == ("paper", "spread:2")
    assert (stop(said, config).stop, stop(said, config).threshold) == ("spread:2", 2.0)
    assert (
        belief(
            posterior_of([[10.0, 11.0]] * 2 + [[1.0, 1.0]] * 8, [1.0, 1.0]), READING, Config(assume="field")
        )[0].assume
        == "field"
    )


def test_limits_and_the_fit_of_the_readings_still_apply() -> None:
    # q is 100 with weight 0.7, 200 with 0.3: its standard deviation is 100 √0.21 = 45.8.
    posterior = posterior_of([[10.0, 10.2], [5.0, 5.0], [100.0, 200.0]], [0.7, 0.3])
    near = {"priors": {"q": Uniform(50.0, 500.0)}, "within": (1.0, 0.99)}
    assert belief(posterior, READING, Config(**near))[0].ceased
    assert not belief(posterior, READING, Config(**near, stop_limits={"q": 45.0}))[0].ceased
    assert belief(posterior, READING, Config(**near, stop_limits={"q": 46.0}))[0].ceased
    fields = ("particles", "log_weights", "weights", "log_targets", "readings")
    misfit = Posterior(*[getattr(THREE, name) for name in fields], np.full(30, 0.999))
    assert not belief(misfit, READING, Config(within=(5.0, 0.5)))[0].ceased


# Readings are as alike as half of cv, up to 0.4: errors may be √(1.15 / 0.85) = 1.163 times wider than the belief
# for a cv of 0.3, and √(1.4 / 0.6) = 1.528 times from 0.8 on.
@pytest.mark.parametrize(
    ("cv", "criterion", "ceased"),
    [
        # The spread of `THREE` is 1.2 m.
        (0.0, {"threshold_m": 1.19}, False),
        (0.0, {"threshold_m": 1.21}, True),
        (0.3, {"threshold_m": 1.39}, False),
        (0.3, {"threshold_m": 1.40}, True),
        (0.8, {"threshold_m": 1.83}, False),
        (0.8, {"threshold_m": 1.84}, True),
        (2.0, {"threshold_m": 1.84}, True),
        # Its shares lie 0.4, 0.6 and 3.4 m from the estimate: 0.611, 0.917 and 5.194 m where errors may be 1.528
        # times wider.
        (0.8, {"within": (0.61, 0.15)}, False),
        (0.8, {"within": (0.62, 0.15)}, True),
        (0.8, {"within": (0.91, 0.85)}, False),
        (0.8, {"within": (0.92, 0.85)}, True),
        (0.8, {"within": (5.1, 0.95)}, False),
        (0.8, {"within": (5.2, 1.0)}, True),
        (0.0, {"within": (3.5, 1.0)}, True),
    ],
)
def test_in_gas_that_comes_and_goes_a_stop_waits_until_the_belief_is_narrower(
    cv: float, criterion: dict, ceased: bool
) -> None:
    config = Config(priors={"cv": Fixed(cv)}, **criterion)
    said, _ = belief(THREE, READING, config)
    assert said.ceased == ceased
    assert met(THREE, said, config) == ceased


def test_where_it_is_unknown_how_much_the_gas_comes_and_goes_the_beliefs_mean_counts() -> None:
    """Its cv is 0.3 on the mean: 0.24 with weight 0.7, 0.44 with 0.3."""
    particles = np.vstack([THREE.particles, [0.24, 0.44, 0.44]])
    for threshold_m, ceased in ((1.39, False), (1.40, True)):
        posterior = replace(THREE, particles=particles)
        said, _ = belief(posterior, READING, Config(threshold_m=threshold_m, priors={"cv": Uniform(0, 2)}))
        assert said.ceased == ceased


def test_a_known_coordinate_is_where_the_estimate_is() -> None:
    posterior = posterior_of([[1.0, 3.0]], [0.5, 0.5])  # y, one metre to either side of its mean
    for radius_m, ceased in ((0.99, False), (1.01, True)):
        said, _ = belief(posterior, READING, Config(priors={"x": Fixed(4.0)}, within=(radius_m, 0.9)))
        assert said.mean == (4.0, 2.0)
        assert said.ceased == ceased


def test_a_batch_ceases_at_the_same_readings_as_its_missions_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """With both criteria, and missions of different seeds; the shares differ in few places, so any
    difference would show.
    """
    monkeypatch.setattr(
        "estimator.belief.CLEAR", -np.inf
    )  # no plume is needed, so that the criterion alone decides
    rng = keyed(5, "places")
    release = Scenario((10.0, 10.0), q=300.0, u=0.7, phi=math.pi / 4, d=4.5, tau=10.0, start=(0.0, 0.0))
    world = World(release, 1, GAUSSIAN)
    for criterion in (
        {"within": (3.0, 0.8)},
        {"threshold_m": 3.0},
        {"within": (3.0, 0.7), "stop_limits": {"x": 1.5}},
        GUSTS,
    ):
        configs = [Config(particles=60, seed=seed, **criterion) for seed in range(6)]
        batch, alone = Batch(configs), [prior(config) for config in configs]
        ceased = []
        for step in range(15):
            places = [(8 + 4 * rng.random(), 8 + 4 * rng.random()) for _ in configs]
            readings = [Reading(step, place, 5.0, world.wind, world.gas(place, step)) for place in places]
            batch.assimilate(
                np.array([config.row(reading) for config, reading in zip(configs, readings, strict=True)])
            )
            alone = [assimilate(*each) for each in zip(alone, readings, configs, strict=True)]
            said = [belief(*each)[0].ceased for each in zip(alone, readings, configs, strict=True)]
            assert [batch.has_ceased(mission) for mission in range(len(configs))] == said
            ceased += said
        assert {True, False} == set(ceased)
