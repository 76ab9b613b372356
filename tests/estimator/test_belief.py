"""Protects the estimator's messages: the summary of its particles, the stop criterion, and the check that
readings fit the model.
"""

import math

import numpy as np
import pytest

from estimator.batch import Batch
from estimator.belief import CLEAR, belief, may_claim, stop
from estimator.filter import Config, Posterior, assimilate, prior
from estimator.priors import Fixed, LogNormal, Normal, Prior, Uniform
from link.bus.mavlink import Reading
from plume.sensors.sensor import Hits, Threshold

READING = Reading(77, (1.0, 2.0), 5.0, (1.0, 0.0), 0.5)


def posterior_of(
    particles: list[list[float]], weights: list[float], ranks: list[float] | None = None
) -> Posterior:
    """A posterior after three readings, which its particles explain far better than one value does."""
    w, readings = np.array(weights), np.zeros((3, 7))
    readings[:, 5] = 0.5, 0.25, 0.125
    return Posterior(
        np.array(particles), np.log(w), w / w.max(), np.full(len(w), 50.0), readings, np.array(ranks or [0.5])
    )


TWO = posterior_of([[1.0, 3.0], [2.0, 2.0]], [0.75, 0.25])


def test_what_is_published_is_what_the_particles_say() -> None:
    summary, particles = belief(TWO, READING, Config(threshold_m=0.9))
    # mean 1.5, variance 0.75·0.25 + 0.25·2.25 = 0.75
    assert summary.mean == pytest.approx((1.5, 2.0))
    assert summary.covariance == pytest.approx((0.75, 0.0, 0.0))
    assert summary.spread == pytest.approx(math.sqrt(0.75))
    assert summary.effective_sample_size == pytest.approx(1 / (0.5625 + 0.0625))
    assert particles.tolist() == [[1.0, 2.0, 0.75], [3.0, 2.0, 0.25]]
    assert (summary.time_boot_ms, summary.step) == (77, 2)
    assert (summary.rate, summary.diffusivity, summary.lifetime, summary.z, summary.wind) == (
        300.0,
        4.5,
        10.0,
        5.0,
        (1.0, 0.0),
    )


def test_it_stops_when_the_spread_is_below_the_threshold() -> None:
    assert belief(TWO, READING, Config(threshold_m=0.9))[0].ceased  # the spread is 0.866
    assert not belief(TWO, READING, Config(threshold_m=0.8))[0].ceased
    claim = stop(belief(TWO, READING, Config(threshold_m=0.9))[0], Config(threshold_m=0.9))
    assert claim.estimate == pytest.approx((1.5, 2.0))
    assert (claim.threshold, claim.time_boot_ms) == (0.9, 77)


@pytest.mark.parametrize(
    ("asked", "ceased"),
    [
        ({"threshold_m": 0.9}, True),
        ({"threshold_m": 0.9, "stop_limits": {"q": 60.0}}, True),
        ({"threshold_m": 0.9, "stop_limits": {"q": 30.0}}, False),
        ({"threshold_m": 0.1, "stop_limits": {"q": 60.0}}, False),
        ({"threshold_m": 0.1, "stop_limits": {"q": 60.0}, "stop_on_location": False}, True),
        ({"threshold_m": 0.1, "stop_limits": {"q": 60.0, "x": 0.5}, "stop_on_location": False}, False),
    ],
)
def test_a_stop_can_be_asked_on_chosen_parameters(asked: dict, ceased: bool) -> None:
    # q is 100 with weight ¾ and 200 with ¼: its mean is 125, its standard deviation 100 √(3/16) = 43.3.
    posterior = posterior_of([[1.0, 3.0], [2.0, 2.0], [100.0, 200.0]], [0.75, 0.25])
    summary, _ = belief(posterior, READING, Config(priors={"q": Uniform(50.0, 500.0)}, **asked))
    assert summary.unknowns == ("x", "y", "q")
    assert summary.means == pytest.approx((1.5, 2.0, 125.0))
    assert summary.stds == pytest.approx((math.sqrt(0.75), 0.0, 100 * math.sqrt(3 / 16)))
    assert summary.rate == pytest.approx(125.0)
    assert summary.ceased == ceased


@pytest.mark.parametrize(
    ("priors", "wind"),
    [
        ({"u": Fixed(3.0)}, (3 * 0.8, 3 * 0.6)),
        ({"phi": Fixed(math.pi / 2)}, (0.0, 5.0)),
        ({"u": Fixed(2.0), "phi": Fixed(math.pi)}, (-2.0, 0.0)),
    ],
)
def test_what_is_known_of_the_wind_is_not_taken_from_the_reading(
    priors: dict[str, Prior], wind: tuple[float, float]
) -> None:
    summary, _ = belief(TWO, READING._replace(wind=(4.0, 3.0)), Config(priors=priors))
    assert summary.wind == pytest.approx(wind, abs=1e-12)


def test_an_unknown_wind_is_published_as_its_mean() -> None:
    posterior = posterior_of([[1.0, 3.0], [2.0, 2.0], [2.0, 4.0]], [0.5, 0.5])
    summary, _ = belief(posterior, READING._replace(wind=(0.0, 1.0)), Config(priors={"u": Normal(3.0, 1.0)}))
    assert summary.wind == pytest.approx((0.0, 3.0))


@pytest.mark.parametrize(
    ("ranks", "fits"),
    [
        ([0.999] * 7, True),  # too few for a test
        ([0.999] * 8, False),
        (list(np.linspace(0.02, 0.98, 30)), True),
        ([0.5] * 30, False),  # too good to be true: a sensor that always reads what is expected
        ([0.999] * 30 + list(np.linspace(0.02, 0.98, 30)), True),  # old readings do not count
    ],
)
def test_the_p_value_tells_whether_the_recent_readings_fit_the_model(ranks: list[float], fits: bool) -> None:
    summary, _ = belief(posterior_of([[1.0, 3.0], [2.0, 2.0]], [0.75, 0.25], ranks), READING, Config())
    assert (summary.p_value > 0.05) == fits
    assert fits or summary.p_value < 1e-4


def after(gases: list[float], **knowledge: object) -> float:
    """The p-value after readings of these gas values."""
    readings = np.zeros((len(gases), 7))
    readings[:, 5] = gases
    posterior = Posterior(
        np.array([[1.0, 3.0], [2.0, 2.0]]),
        np.zeros(2),
        np.ones(2),
        np.zeros(2),
        readings,
        np.full(len(gases), 0.5),
    )
    return belief(posterior, READING, Config(threshold_m=2.0, **knowledge))[0].p_value


def test_a_noisy_sensor_that_repeats_itself_to_the_last_bit_is_stuck() -> None:
    assert after([1.0, 0.5, 0.5]) == 1.0
    assert after([1.0, 0.5, 0.5, 0.5]) == 0.0
    assert after([0.0, 0.0, 0.0]) == 0.0
    assert after([0.5, 0.5, 0.5, 0.75]) == 1.0
    assert after([0.0, 0.0, 0.0], sensor=Threshold()) == 1.0
    assert after([0.75, 0.75, 0.75], sensor=Threshold()) == 0.0
    assert after([1.0, 1.0, 1.0], sensor=Hits()) == 1.0


def test_nothing_is_claimed_while_the_readings_do_not_fit_the_model() -> None:
    fitting, stuck = TWO, posterior_of([[1.0, 3.0], [2.0, 2.0]], [0.75, 0.25], [0.999] * 30)
    assert belief(fitting, READING, Config(threshold_m=0.9))[0].ceased
    assert not belief(stuck, READING, Config(threshold_m=0.9))[0].ceased


def test_nothing_is_claimed_before_as_many_readings_as_would_show_a_stuck_sensor() -> None:
    two_readings = Posterior(
        TWO.particles, TWO.log_weights, TWO.weights, TWO.log_targets, TWO.readings[:2], TWO.ranks
    )
    summary, _ = belief(two_readings, READING, Config(threshold_m=0.9))
    assert summary.spread < 0.9
    assert not summary.ceased


def test_a_batch_judges_as_a_single_mission_does() -> None:
    """One value plus noise explains two readings well, but not three that differ as much as these."""
    config = Config(particles=1000, threshold_m=100.0)
    posterior, batch = prior(config), Batch([config])
    said = []
    for step, (place, gas) in enumerate(
        (((3.0, 3.0), 0.0), ((8.0, 8.0), 5.0), ((9.0, 9.0), 30.0), ((20.0, 20.0), 0.1))
    ):
        reading = Reading(step, place, 5.0, (1.0, 0.0), gas)
        posterior = assimilate(posterior, reading, config)
        batch.assimilate(config.row(reading)[None])
        summary, _ = belief(posterior, reading, config)
        assert summary.p_value == 1.0
        assert summary.ceased == batch.may_claim(0) == batch.has_ceased(0)
        said.append(summary.evidence >= CLEAR)
    assert said == [False, False, True, True]


def test_what_may_be_claimed_hangs_on_the_number_of_readings_their_fit_and_what_else_could_explain_them() -> (
    None
):
    assert [may_claim(1.0, 50.0, readings) for readings in (1, 2, 3, 4)] == [False, False, True, True]
    assert [may_claim(p_value, 50.0, 50) for p_value in (0.0, 0.99e-4, 1e-4, 1.01e-4)] == [
        False,
        False,
        True,
        True,
    ]
    assert [may_claim(1.0, better, 50) for better in (-3.0, 4.99, 5.0)] == [False, False, True]


def test_evidence_is_the_mean_log_likelihood_less_that_of_the_best_single_value() -> None:
    # Under the normal distribution with their own mean, 7/24, and variance, 7/288: three readings have -3/2
    # (log 2π·7/288 + 1).
    one_value = -1.5 * (math.log(2 * math.pi * 7 / 288) + 1)
    uneven = Posterior(
        TWO.particles, TWO.log_weights, TWO.weights, np.array([8.0, 4.0]), TWO.readings, TWO.ranks
    )
    summary, _ = belief(uneven, READING, Config())
    assert summary.evidence == pytest.approx(0.75 * 8.0 + 0.25 * 4.0 - one_value)
    # A log-normal prior of q is no likelihood: log N(log 100; log 300, 1) without its constant is taken off.
    known = {"x": Fixed(1.0), "y": Fixed(2.0), "q": LogNormal(300.0, 1.0)}
    alone = Posterior(np.array([[100.0]]), np.zeros(1), np.ones(1), np.array([8.0]), TWO.readings, TWO.ranks)
    summary, _ = belief(alone, READING, Config(priors=known))
    assert summary.evidence == pytest.approx(8.0 + 0.5 * math.log(3) ** 2 - one_value)


@pytest.mark.parametrize("assume", ["paper", "field"])
def test_a_sensor_that_hums_at_one_value_is_never_believed(assume: str) -> None:
    """A narrow belief far from any source: 60 readings of 1 g/m³ with noise of 0.2, along a lawnmower's
    rows.
    """
    rng = np.random.default_rng(8)
    config = Config(particles=300, threshold_m=100.0, assume=assume)
    posterior = prior(config)
    for step in range(60):
        place = (2.0 + 2 * (step % 12), 3.0 + 5 * (step // 12))
        reading = Reading(step, place, 5.0, (1.0, 0.5), float(rng.normal(1.0, 0.2)))
        posterior = assimilate(posterior, reading, config)
        summary, _ = belief(posterior, reading, config)
        assert not summary.ceased
    assert summary.spread < 100.0


def test_a_spread_that_is_the_threshold_is_no_stop() -> None:
    # Two equally likely places, half a metre to either side: the deviation and the spread are exactly 0.5.
    even = posterior_of([[1.0, 2.0], [2.0, 2.0]], [0.5, 0.5])
    assert belief(even, READING, Config(threshold_m=0.5))[0].spread == 0.5
    assert not belief(even, READING, Config(threshold_m=0.5))[0].ceased
    assert not belief(even, READING, Config(threshold_m=9.0, stop_limits={"x": 0.5}))[0].ceased
    assert belief(even, READING, Config(threshold_m=0.5 + 1e-9, stop_limits={"x": 0.5 + 1e-9}))[0].ceased


def test_exactly_thirty_readings_are_looked_at_together() -> None:
    recent = list(np.random.default_rng(2).random(30))
    said = [
        belief(posterior_of([[1.0, 3.0], [2.0, 2.0]], [0.75, 0.25], ranks), READING, Config())[0].p_value
        for ranks in (recent, [0.999, *recent], recent[1:])
    ]
    assert said[0] == said[1] != said[2]
