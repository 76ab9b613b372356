"""Protects the filter with further unknowns: wind direction and height against exact grids, targets
against formulas.
"""

import math

import numpy as np
import pytest

from estimator.filter import Config, Posterior, assimilate, prior
from estimator.kernels.densities import log_likelihoods
from estimator.kernels.moves import move
from estimator.priors import Fixed, Gamma, Normal, Prior, Uniform
from link.bus.mavlink import Reading
from plume.dispersion import concentration
from plume.sensors.names import GAUSSIAN, Sensor
from plume.sensors.sensor import Hits, Threshold
from tests.estimator.exact import log_likelihood

Array = np.ndarray
TURN = 2 * math.pi
SOURCE, Q, D, TAU, SPEED = (13.0, 12.0), 270.0, 4.2, 10.0, 2.0
ROUND = [(13 + 4 * math.cos(a), 12 + 4 * math.sin(a)) for a in np.arange(6)]
"""Places 4 m from the source, in no special direction."""


def mean_at(place: tuple[float, float], phi: float, height: float = 0.0) -> float:
    """Concentration at a place, at a `height` above or below the source: the paper's section 2, with λ and
    ψ.
    """
    dx, dy = place[0] - SOURCE[0], place[1] - SOURCE[1]
    r = math.sqrt(dx * dx + dy * dy + height * height)
    lam = math.sqrt(D * TAU / (1 + SPEED**2 * TAU / (4 * D)))
    psi = -SPEED * (dx * math.cos(phi) + dy * math.sin(phi)) / (2 * D)
    return Q / (4 * math.pi * D * r) * math.exp(-r / lam + psi)


def around(low: float) -> Config:
    """The source's place is known, the wind direction is unknown; angles start at `low`."""
    known = {"x": Fixed(SOURCE[0]), "y": Fixed(SOURCE[1])}
    return Config(
        particles=4000,
        seed=3,
        rate=Q,
        diffusivity=D,
        lifetime=TAU,
        priors={**known, "phi": Uniform(low, low + TURN)},
    )


def readings_of(phi: float) -> list[Reading]:
    """Noiseless readings at some places. The wind direction that they carry is not the true one."""
    return [Reading(k, place, 5.0, (0.0, SPEED), mean_at(place, phi)) for k, place in enumerate(ROUND)]


def exact_directions(low: float, readings: list[Reading]) -> tuple[Array, Array]:
    """Directions (2000,) on a grid and their probabilities."""
    phi = low + (np.arange(2000) + 0.5) * TURN / 2000
    x, y = np.array([[SOURCE[0]]]), np.array([[SOURCE[1]]])
    log_density = np.array(
        [
            sum(
                log_likelihood(
                    x, y, (*r.position, SPEED * math.cos(p), SPEED * math.sin(p), r.gas), Q, D, TAU
                )[0, 0]
                for r in readings
            )
            for p in phi
        ]
    )
    probability = np.exp(log_density - log_density.max())
    return phi, probability / probability.sum()


SEAMS = [(0.0, 0.05), (1.0, TURN + 0.95), (-math.pi, math.pi - 0.05), (0.0, 2.0)]
"""Pairs of the angle where the range starts and the true wind direction: just before, just after or far
from the start.
"""


@pytest.mark.parametrize(("low", "truth"), SEAMS)
def test_a_wind_from_anywhere_is_believed_as_on_an_exact_grid(low: float, truth: float) -> None:
    config, readings = around(low), readings_of(truth)
    posterior = prior(config)
    for reading in readings:
        posterior = assimilate(posterior, reading, config)
    phi, probability = exact_directions(low, readings)
    (said,), weights = posterior.particles, posterior.weights / posterior.weights.sum()
    assert low <= said.min() <= said.max() <= low + TURN
    for of in (np.cos, np.sin, lambda angle: np.cos(2 * angle), lambda angle: angle < low + math.pi):
        mean = of(phi) @ probability
        std = math.sqrt(of(phi) ** 2 @ probability - mean**2)
        # The particles are worth a tenth as many independent draws, 400: 4 standard errors.
        assert of(said) @ weights == pytest.approx(mean, abs=4 * std / 20)


@pytest.mark.parametrize(("low", "truth"), SEAMS[:3])
def test_a_direction_is_moved_across_the_seam_of_its_circle(low: float, truth: float) -> None:
    """All particles begin on one side of the seam; without wrapping, none would ever reach the other side."""
    config, readings = around(low), readings_of(truth)
    phi, probability = exact_directions(low, readings)
    other = float(probability[phi < low + math.pi].sum())
    assert 0.2 < other < 0.8
    rows = np.array([config.row(reading) for reading in readings])
    for start in (low + 0.2, low + TURN - 0.2):
        particles = np.random.default_rng(1).uniform(start - 0.2, start + 0.2, (1, 4000))
        targets = sum(log_likelihoods(particles, config.model, row) for row in rows)
        for stage in range(60):
            move(particles, targets, rows, config.model, 3, 5, stage)
        assert low <= particles.min() <= particles.max() <= low + TURN
        # Steps depend on the population, so the chains are not quite independent: twice the 4 standard
        # errors.
        assert np.mean(particles < low + math.pi) == pytest.approx(other, abs=8 * 0.5 / math.sqrt(4000))


def test_a_direction_that_is_known_to_a_part_of_the_circle_stays_there() -> None:
    known = {"x": Fixed(SOURCE[0]), "y": Fixed(SOURCE[1])}
    config = Config(
        particles=1000,
        seed=3,
        rate=Q,
        diffusivity=D,
        lifetime=TAU,
        priors={**known, "phi": Uniform(0.5, 3.0)},
    )
    posterior, readings = prior(config), readings_of(0.4)
    for reading in readings:
        posterior = assimilate(posterior, reading, config)
    assert 0.5 <= posterior.particles.min() <= posterior.particles.max() <= 3.0
    phi, probability = exact_directions(0.0, readings)
    phi, probability = (
        phi[(phi > 0.5) & (phi < 3.0)],
        probability[(phi > 0.5) & (phi < 3.0)] / probability[(phi > 0.5) & (phi < 3.0)].sum(),
    )
    mean = phi @ probability
    assert posterior.particles[0] @ posterior.weights / posterior.weights.sum() == pytest.approx(
        mean, abs=4 * math.sqrt((phi - mean) ** 2 @ probability / 100)
    )


def test_an_unknown_height_is_believed_as_on_an_exact_grid() -> None:
    """The source is 3.5 m above home; two flights at different altitudes resolve whether it is above or
    below.
    """
    known = {"x": Fixed(SOURCE[0]), "y": Fixed(SOURCE[1])}
    config = Config(
        particles=4000, seed=3, rate=Q, diffusivity=D, lifetime=TAU, priors={**known, "z": Uniform(0.0, 10.0)}
    )
    wind = (SPEED * math.cos(1.0), SPEED * math.sin(1.0))
    altitudes = (2.0, 6.0, 2.0, 6.0, 2.0)
    readings = [
        Reading(k, (13.0 - k / 4, 12.5), altitude, wind, mean_at((13.0 - k / 4, 12.5), 1.0, altitude - 3.5))
        for k, altitude in enumerate(altitudes)
    ]
    posterior = prior(config)
    for reading in readings:
        posterior = assimilate(posterior, reading, config)
    z = (np.arange(4000) + 0.5) * 10 / 4000
    log_density = np.zeros(4000)
    for r in readings:
        means = np.array([mean_at(r.position, 1.0, r.altitude_m - height) for height in z])
        variance = 0.09 * means**2 + 0.04
        log_density -= 0.5 * ((r.gas - means) ** 2 / variance + np.log(variance))
    probability = np.exp(log_density - log_density.max())
    probability /= probability.sum()
    mean = z @ probability
    std = math.sqrt(z**2 @ probability - mean**2)
    assert 0.1 < std < 2.0
    (said,), weights = posterior.particles, posterior.weights / posterior.weights.sum()
    assert said @ weights == pytest.approx(mean, abs=4 * std / 20)
    assert math.sqrt((said - said @ weights) ** 2 @ weights) == pytest.approx(std, rel=0.2)


def test_a_known_height_is_not_the_one_that_is_flown_at() -> None:
    # 3.5 m below the vehicle, with q = 270, d = 4.2 and the wind from (1.2, 1.6), u = 2: the expected value
    # is mean_at's.
    config = Config(rate=Q, diffusivity=D, lifetime=TAU, priors={"z": Fixed(1.5)})
    row = config.row(Reading(0, (14.0, 13.5), 5.0, (1.2, 1.6), 1.0))
    assert row.tolist() == [14.0, 13.5, 5.0, 1.2, 1.6, 1.0, 1.0]
    said = log_likelihoods(np.array([[13.0], [12.0]]), config.model, row)
    mean = mean_at((14.0, 13.5), math.atan2(1.6, 1.2), 3.5)
    assert said[0] == pytest.approx(float(GAUSSIAN.log_likelihood(1.0, mean)), rel=1e-12)
    # By default the source lies in the flight plane.
    assert Config().row(Reading(0, (14.0, 13.5), 5.0, (1.2, 1.6), 1.0))[2] == 0.0


def test_more_unknowns_take_more_sweeps() -> None:
    one = {"x": Fixed(13.0)}
    eight: dict[str, Prior] = {name: Uniform(1.0, 2.0) for name in ("z", "q", "u", "phi", "d", "tau")}
    assert [Config(priors=priors).sweeps for priors in (one, {}, {"q": Gamma(2.0, 150.0)}, eight)] == [
        3,
        3,
        6,
        21,
    ]


def targets_by_formula(posterior: Posterior, config: Config) -> Array:
    """Log posterior density at each particle: Σ share · log-likelihood + log prior, by the formulas of
    plume/, up to a constant.
    """
    values = dict(zip(config.unknowns, posterior.particles, strict=True))
    total = np.zeros(config.particles)
    for name, prior_of in config.priors.items():
        match prior_of:
            case Normal(mean, std):
                total -= (values[name] - mean) ** 2 / (2 * std**2)
            case Gamma(shape, scale):
                total += (shape - 1) * np.log(values[name]) - values[name] / scale
    for x, y, height, wind_x, wind_y, gas, share in posterior.readings:
        speed, direction = (
            values.get("u", math.hypot(wind_x, wind_y)),
            values.get("phi", math.atan2(wind_y, wind_x)),
        )
        wind = np.stack(np.broadcast_arrays(speed * np.cos(direction), speed * np.sin(direction)), axis=-1)
        source = np.stack(np.broadcast_arrays(values["x"], values["y"], values.get("z", 0.0)), axis=-1)
        rate, diffusivity, lifetime = values.get("q", Q), values.get("d", D), values.get("tau", TAU)
        mean = concentration(
            (x, y, height), source, wind, rate=rate, diffusivity=diffusivity, lifetime=lifetime
        )
        total += share * config.sensor.log_likelihood(gas, mean)
    return total


def flight(config: Config, gases: dict[int, float] | None = None, steps: int = 25) -> Posterior:
    """The posterior after a flight towards the source; `gases` replaces drawn gas values, by step."""
    posterior, rng = prior(config), np.random.default_rng(8)
    for k, (x, y) in enumerate(np.linspace((4.0, 5.0), (12.0, 12.5), steps).tolist()):
        gas = float(config.sensor.measure(mean_at((x, y), 0.7), rng))
        reading = Reading(
            k, (x, y), 3.0, (SPEED * math.cos(0.7), SPEED * math.sin(0.7)), (gases or {}).get(k, gas)
        )
        posterior = assimilate(posterior, reading, config)
    return posterior


EIGHT: dict[str, Prior] = {
    "z": Uniform(0.0, 5.0),
    "q": Gamma(2.0, 150.0),
    "u": Normal(2.0, 0.5),
    "phi": Normal(0.7, 0.2),
    "d": Uniform(1.0, 8.0),
    "tau": Uniform(5.0, 20.0),
}


@pytest.mark.parametrize(
    ("priors", "sensor"),
    [
        ({}, GAUSSIAN),
        ({}, Threshold(2.0)),
        ({}, Hits()),
        ({"z": Normal(2.0, 1.0)}, GAUSSIAN),
        (EIGHT, GAUSSIAN),
        (EIGHT, Hits()),
        ({"phi": Uniform(0.0, TURN), "q": Normal(250.0, 60.0)}, Threshold(0.5)),
    ],
    ids=str,
)
def test_every_particle_knows_its_posterior_density(priors: dict[str, Prior], sensor: Sensor) -> None:
    config = Config(particles=500, seed=4, rate=Q, diffusivity=D, lifetime=TAU, priors=priors, sensor=sensor)
    posterior = flight(config)
    assert (posterior.readings[:, 6] == 1.0).all()
    expected = targets_by_formula(posterior, config)
    assert posterior.log_targets - posterior.log_targets[0] == pytest.approx(
        expected - expected[0], rel=1e-9, abs=1e-7
    )
    assert posterior.weights == pytest.approx(
        np.exp(posterior.log_weights - posterior.log_weights.max()), rel=1e-12
    )


def test_weights_before_any_move_are_the_likelihoods() -> None:
    config = Config(particles=500, seed=4, rate=Q, diffusivity=D, lifetime=TAU)
    posterior = prior(config)
    for k, gas in enumerate((0.05, -0.1)):  # upwind of nearly all particles, so that weights stay even
        posterior = assimilate(posterior, Reading(k, (1.0 + k, 1.0), 3.0, (-1.2, -1.6), gas), config)
    assert np.array_equal(posterior.particles, prior(config).particles)
    assert posterior.log_weights == pytest.approx(targets_by_formula(posterior, config), abs=1e-9)
    assert np.array_equal(posterior.log_weights, posterior.log_targets)
    assert posterior.weights == pytest.approx(
        np.exp(posterior.log_weights - posterior.log_weights.max()), rel=1e-12
    )


@pytest.mark.parametrize("gas", [1e4, -1e6])
def test_an_absurd_reading_is_taken_in_part_for_good(gas: float) -> None:
    """The part of a reading that is left after forty stages is never assimilated: later moves use the same
    share.
    """
    config = Config(
        particles=500, seed=4, rate=Q, diffusivity=D, lifetime=TAU, priors={"q": Gamma(2.0, 150.0)}
    )
    posterior = flight(config, {12: gas})
    shares = posterior.readings[:, 6]
    assert 0 < shares[12] < 0.1
    assert np.delete(shares, 12).tolist() == [1.0] * 24
    expected = targets_by_formula(posterior, config)
    assert posterior.log_targets - posterior.log_targets[0] == pytest.approx(
        expected - expected[0], rel=1e-6, abs=1e-4
    )
    assert posterior.weights.sum() ** 2 / (posterior.weights**2).sum() >= 250
