"""Protects a search from false readings: under `field` one is no plume, and costs hardly any way."""

import itertools
import math

import numpy as np
import pytest

from agent.trials.rollout import mission
from estimator.assumptions import SPIKES
from estimator.belief import INCOMPATIBLE, belief, fit
from estimator.filter import Config, Posterior, assimilate, prior
from estimator.kernels.checks import log_likelihood_of_one_value
from estimator.kernels.densities import log_likelihoods
from estimator.priors import Fixed, Prior, Uniform
from link.bus.mavlink import Reading
from plume.dispersion import concentration
from plume.scenario import draw
from plume.sensors.names import GAUSSIAN, Sensor, sensor_row, text
from plume.sensors.sensor import Gaussian, Hits, Threshold
from plume.worlds.errors import WRONG, Errors, Wrong
from tests.estimator.test_kernels import draws, readable

Array = np.ndarray
SHARE = SPIKES["field"]
EXACT: dict[str, Prior] = {
    "q": Fixed(270.0),
    "tau": Fixed(10.0),
    "wind-direction": Fixed(0.0),
    "wind-speed": Fixed(1.0),
    "noise": Fixed(1.0),
    "cv": Fixed(0.0),
    "puff-rate": Fixed(math.inf),
    "puff-share": Fixed(0.2),
}
"""Of `field`, only the place and the spikes are left unknown."""
OF_GAS = ("cv", "puff-rate", "puff-share")
"""Parameters of sensors that read the gas itself."""


def exceeds(size: float, scale: float) -> float:
    """The probability that a spike is greater, whatever its sign."""
    return scale / math.hypot(scale, size)


def probability(gas: float, sensor: Sensor) -> float:
    """Density of a spike, as a difference quotient; or its probability."""
    match sensor:
        case Hits(_, background):
            scale = 7 * math.sqrt(background)
            return exceeds(gas, scale) - exceeds(gas + 1, scale)
        case Threshold(threshold, _, _, floor):
            scale, sides = 7 * floor, 1
            if gas == 0.0:
                return 1 - exceeds(threshold, scale)
        case Gaussian(_, floor):
            scale, sides = 7 * floor, 2
    return (exceeds(abs(abs(gas) - 1e-5), scale) - exceeds(abs(gas) + 1e-5, scale)) / 2e-5 / sides


@pytest.mark.parametrize(
    ("sensor", "gases"),
    [
        (GAUSSIAN, (-40.0, -0.3, 0.1, 3.75, 800.0)),
        (Threshold(), (0.0, 0.6, 3.75, 800.0)),
        (Hits(), (0.0, 1.0, 11.0, 800.0)),
    ],
    ids=["gaussian", "threshold", "hits"],
)
def test_the_likelihood_is_that_of_a_mixture_of_readings_and_spikes(
    sensor: Sensor, gases: tuple[float, ...]
) -> None:
    config = Config(rate=270.0, diffusivity=4.2, sensor=sensor, assume="field")
    particles = draws(config, 300)
    for gas in gases:
        reading = np.array([14.0, 13.0, 0.0, 1.9, 2.6, gas])
        plain = np.exp(readable(config, particles, reading))
        expected = np.log((1 - SHARE) * plain + SHARE * probability(gas, sensor))
        # The table of intermittent gas is right to 0.005 where it is above −60.
        assert log_likelihoods(particles, config.model, reading) == pytest.approx(expected, abs=0.008)


def test_under_paper_no_reading_is_a_spike() -> None:
    config = Config(rate=270.0, diffusivity=4.2)
    particles = draws(config, 300)
    reading = np.array([14.0, 13.0, 0.0, 1.9, 2.6, 800.0])
    assert log_likelihoods(particles, config.model, reading) == pytest.approx(
        readable(config, particles, reading), rel=1e-11
    )


def spike_density(gas: float, sensor: Sensor) -> float:
    """The density of a spike in the kernels: they add it to readings that are impossible without."""
    config = Config(rate=1e-6, diffusivity=4.2, sensor=sensor, assume="field", priors={"q": Fixed(1e-6)})
    nowhere = draws(config, 1)
    if "cv" in config.unknowns:
        nowhere[config.unknowns.index("cv")] = 0.1
        nowhere[config.unknowns.index("puff-rate")] = 1e9
    if "noise" in config.unknowns:
        nowhere[config.unknowns.index("noise")] = 0.01
    row = np.array([14.0, 13.0, 0.0, 1.9, 2.6, gas])
    return math.exp(float(log_likelihoods(nowhere, config.model, row)[0])) / SHARE


def test_the_density_of_spikes_is_one_in_all() -> None:
    from scipy import integrate

    sides = [(-np.inf, -1.0), (1.0, np.inf)]  # within ±1 g/m³ there are readings of clean air
    total = sum(integrate.quad(spike_density, *ends, args=(GAUSSIAN,), limit=200)[0] for ends in sides)
    assert total == pytest.approx(exceeds(1.0, 1.4), rel=1e-5)
    above = integrate.quad(spike_density, 1.0, np.inf, args=(Threshold(),), limit=200)[0]
    assert above == pytest.approx(exceeds(1.0, 1.4), rel=1e-5)
    assert sum(spike_density(float(k), Hits()) for k in range(20, 3000)) == pytest.approx(
        exceeds(20.0, 7 * math.sqrt(0.1)) - exceeds(3000.0, 7 * math.sqrt(0.1)), rel=1e-5
    )


def test_the_belief_with_a_spike_in_it_is_the_exact_posterior() -> None:
    """Only the place is unknown, which may be up to 10 m outside the area, where it is a fifth as likely for
    each coordinate. The exact posterior is a sum over 390,625 places.
    """
    s = draw(11)
    axis = 0.08 * (np.arange(625) + 0.5) - 10
    places = np.stack(np.meshgrid(axis, axis, indexing="ij")).reshape(2, -1)
    known = {**EXACT, "q": Fixed(s.q), "tau": Fixed(s.tau)}
    config = Config(8000, seed=3, diffusivity=s.d, priors=known, assume="field")
    assert config.unknowns == ("x", "y")
    posterior, log_density = prior(config), math.log(0.2) * ((places < 0) | (places > 30)).sum(axis=0)
    rng = np.random.default_rng(4)
    ways = np.linspace(s.start, s.source, 15)[:11].astype(np.float32).tolist()
    for step, (x, y) in enumerate(ways):
        how = {"rate": s.q, "diffusivity": s.d, "lifetime": s.tau}
        gas = float(GAUSSIAN.measure(concentration((x, y), s.source, s.wind, **how), rng))
        gas = gas + 8.0 if step == 3 else gas
        posterior = assimilate(posterior, Reading(step, (x, y), 5.0, s.wind, gas), config)
        said = GAUSSIAN.log_likelihood(gas, concentration((x, y), places.T, s.wind, **how))
        log_density += np.log((1 - SHARE) * np.exp(said) + SHARE * probability(gas, GAUSSIAN))
        if step < 3:
            continue
        mass = np.exp(log_density - log_density.max())
        mass /= mass.sum()
        mean = places @ mass
        std = np.sqrt(np.square(places) @ mass - mean**2)
        weights = posterior.weights / posterior.weights.sum()
        found = posterior.particles @ weights
        # 8,000 particles err by about a tenth of a standard deviation where two places are likely.
        assert np.all(np.abs(found - mean) < 0.15 * std), step
        assert np.sqrt(np.square(posterior.particles) @ weights - found**2) == pytest.approx(std, rel=0.15)


SIZES = (0.5, 2.0, 8.0, 50.0, 1000.0, -8.0)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("step", [0, 6, 14], ids=["at-the-start", "in-clean-air", "later"])
def test_a_mission_with_a_false_reading_ceases_at_the_source(
    size: float, step: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(WRONG, "spiked", Wrong("", lambda *_: Errors(spikes=((step, size),))))
    flown = mission(1_000_003, "homing", 1000, 0.5, 100, world="spiked", assume="field")
    *_, last = flown.steps
    assert last.belief.ceased
    assert math.dist(last.belief.mean, flown.scenario.source) <= 1.0


@pytest.mark.parametrize("sensor", [Threshold(), Hits()], ids=text)
def test_other_sensors_may_spike_too(sensor: Sensor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(WRONG, "spiked", Wrong("", lambda *_: Errors(spikes=((6, 8.0), (9, 30.0)))))
    flown = mission(1_000_003, "homing", 1000, 0.5, 120, world="spiked", assume="field", sensor=sensor)
    *_, last = flown.steps
    assert last.belief.ceased
    assert math.dist(last.belief.mean, flown.scenario.source) <= 1.0


@pytest.mark.one_in(3)
@pytest.mark.parametrize("sensor", [GAUSSIAN, Gaussian(cv=1.0), Threshold(), Hits()], ids=text)
def test_ranks_of_readings_are_uniform_if_their_share_of_spikes_is_as_assumed(sensor: Sensor) -> None:
    known = {
        name: value for name, value in EXACT.items() if isinstance(sensor, Gaussian) or name not in OF_GAS
    }
    if isinstance(sensor, Gaussian):
        known["cv"] = Fixed(sensor.cv)
    if isinstance(sensor, Hits):
        known.pop("noise")
    known |= {"x": Uniform(12.0, 12.001), "y": Fixed(13.0)}
    config = Config(1, rate=270.0, diffusivity=4.2, priors=known, sensor=sensor, assume="field")
    rng, count, ranks = np.random.default_rng(5), 3000, []
    where = (13.0, 11.5)
    mean = concentration(where, (12.0, 13.0), (1.9, 2.6), rate=270.0, diffusivity=4.2, lifetime=10.0)
    scale = 7 * (math.sqrt(0.1) if isinstance(sensor, Hits) else 0.2)
    for number in range(count):
        gas = float(sensor.measure(mean, rng))
        if rng.random() < SHARE:  # by inversion of the probability to exceed a size
            gas = scale * math.sqrt(rng.random() ** -2 - 1)
            match sensor:
                case Hits():
                    gas = math.floor(gas)
                case Threshold(threshold):
                    gas = gas if gas >= threshold else 0.0
                case _:
                    gas *= rng.choice([-1, 1])
        one = Config(**{**vars_of(config), "seed": number})
        reading = Reading(0, where, 5.0, (1.9, 2.6), gas)
        ranks.append(assimilate(prior(one), reading, one).ranks[0])
    ordered = np.sort(ranks)
    gap = np.abs(ordered - (np.arange(count) + 0.5) / count).max()
    assert gap < 1.95 / math.sqrt(count)  # exceeded once in a thousand


def vars_of(config: Config) -> dict:
    """The fields that a configuration was made with."""
    names = ("particles", "rate", "diffusivity", "priors", "sensor", "assume")
    return {name: getattr(config, name) for name in names}


def fits(spikes: int) -> bool:
    """Whether 30 readings fit the model if so many of them are spikes of 8 g/m³ and the others as expected."""
    rest = np.linspace(0.02, 0.98, 30 - spikes)
    rank = (1 - SHARE) + SHARE * (1 - 0.5 * exceeds(8.0, 1.4))
    posterior = Posterior(
        np.ones((2, 1)),
        np.zeros(1),
        np.ones(1),
        np.zeros(1),
        np.zeros((0, 7)),
        np.append(rest, [rank] * spikes),
    )
    return fit(posterior, Config(assume="field")) >= INCOMPATIBLE


def test_a_few_spikes_do_not_withhold_a_stop_but_many_do() -> None:
    assert fits(1)
    assert fits(3)
    assert not fits(15)


def best_of_one_value(gas: list[float]) -> float:
    """The greatest log-likelihood of one value plus noise, whichever readings, up to half, are spikes."""
    best = -math.inf
    for count in range(len(gas) // 2 + 1):
        for spiked in itertools.combinations(range(len(gas)), count):
            kept = np.delete(gas, spiked)
            of_spikes = sum(math.log(SHARE * probability(gas[i], GAUSSIAN)) for i in spiked)
            normal = -len(kept) * (math.log(max(kept.std(), 1e-3)) + 0.5 * math.log(2 * math.pi) + 0.5)
            best = max(best, of_spikes + normal + len(kept) * math.log(1 - SHARE))
    return best


@pytest.mark.parametrize(
    "gas",
    [
        [1.0, 1.2, 0.9, 1.1, 0.8, 1.05, 0.95, 1.15],
        [1.0, 1.2, 0.9, 30.0, 0.8, 1.05, 0.95, 1.15],
        [0.1, -0.2, 0.05, 8.0, 0.2, 8.1, -0.1, 7.9, -60.0, 0.15],
    ],
    ids=["none", "one", "four"],
)
def test_one_value_plus_noise_may_have_spikes_as_well(gas: list[float]) -> None:
    readings = np.zeros((len(gas), 7))
    readings[:, 5] = gas
    found = log_likelihood_of_one_value(readings, sensor_row(GAUSSIAN), SHARE)
    assert found == pytest.approx(best_of_one_value(gas), rel=1e-6)


def test_a_sensor_that_hums_is_never_believed_because_it_spikes() -> None:
    rng = np.random.default_rng(8)
    config = Config(particles=300, threshold_m=100.0, assume="field")
    posterior = prior(config)
    for step in range(60):
        place = (2.0 + 2 * (step % 12), 3.0 + 5 * (step // 12))
        gas = float(rng.normal(1.0, 0.2)) + (30.0 if step in (8, 20, 33) else 0.0)
        posterior = assimilate(posterior, Reading(step, place, 5.0, (1.0, 0.5), gas), config)
        assert not belief(posterior, Reading(step, place, 5.0, (1.0, 0.5), gas), config)[0].ceased
