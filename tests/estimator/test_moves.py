"""Protects the moves: they leave the posterior given all readings invariant, and take exactly the
decisions of Metropolis–Hastings.
"""

import math

import numpy as np
import pytest
from numba import njit

from estimator.filter import Config
from estimator.kernels.densities import log_likelihoods, log_priors
from estimator.kernels.moves import move
from estimator.priors import Fixed, Gamma, LogNormal, Normal, Prior, Uniform
from plume.dispersion import concentration
from plume.draws import key_of, uniform
from plume.sensors.names import GAUSSIAN, Sensor, text
from plume.sensors.sensor import Gaussian, Hits, Threshold

Array = np.ndarray
CONFIG = Config(rate=270.0, diffusivity=4.2)
READINGS = np.array(
    [
        [8.0, 8.0, 0.0, 1.9, 2.6, 0.9, 1.0],
        [12.0, 9.0, 0.0, 1.9, 2.6, 2.5, 1.0],
        [11.0, 12.0, 0.0, 1.9, 2.6, 1.1, 1.0],
    ]
)
SEED = 9

Shares = tuple[float, float, float]
WHOLE: Shares = (1.0, 1.0, 1.0)
"""The exponents of the likelihoods of READINGS."""
NONE: Shares = (0.0, 0.0, 0.0)
"""With these the posterior is the prior."""


def shared(shares: Shares) -> Array:
    """READINGS with these shares."""
    readings = READINGS.copy()
    readings[:, 6] = shares
    return readings


def targets_of(particles: Array, config: Config, readings: Array) -> Array:
    """Log posterior density up to a constant."""
    targets = log_priors(particles, config.model)
    for row in readings:
        targets += row[6] * log_likelihoods(particles, config.model, row)
    return targets


def moved(start: Array, config: Config, readings: Array, sweeps: int, rounds: int = 1) -> tuple[Array, int]:
    """The particles after some rounds of at most so many sweeps, without resampling, and the number of
    accepted moves.
    """
    particles, targets, accepted = start.copy(), targets_of(start, config, readings), 0
    for stage in range(rounds):
        accepted += move(particles, targets, readings, config.model, sweeps, SEED, stage)
    # The densities that the particles carry along are those of where they are now.
    assert targets == pytest.approx(targets_of(particles, config, readings), rel=1e-9, abs=1e-7)
    return particles, accepted


@njit
def first_uniforms(seed: int, step: int, stage: int, stream: int, count: int) -> Array:
    key = key_of(np.uint64(seed), step, stage, stream)
    result = np.empty(count)
    for i in range(count):
        result[i] = uniform(key, i)
    return result


def grid_density(shares: Shares, cells: int) -> tuple[Array, Array]:
    """Cell centres (2, M) and probabilities of the exact posterior of the place, from the readable
    formulas.
    """
    axis = (np.arange(cells) + 0.5) * 30.0 / cells
    places = np.stack(np.meshgrid(axis, axis, indexing="ij")).reshape(2, -1)
    log_density = np.zeros(places.shape[1])
    for share, row in zip(shares, READINGS, strict=True):
        mean = concentration(row[:2], places.T, row[3:5], rate=270.0, diffusivity=4.2, lifetime=10.0)
        log_density += share * GAUSSIAN.log_likelihood(row[5], mean)
    density = np.exp(log_density - log_density.max())
    return places, density / density.sum()


def agree(particles: Array, mean: Array, std: Array, errors: float = 4.0) -> None:
    """Independent chains: 4 standard errors of the mean and of the standard deviation (the latter doubled
    for heavy tails).
    """
    count = particles.shape[1]
    assert np.all(np.abs(particles.mean(axis=1) - mean) < errors * std / math.sqrt(count))
    assert np.all(np.abs(particles.std(axis=1) - std) < errors * std * 2 / math.sqrt(2 * count))


@pytest.mark.one_in(5)
@pytest.mark.parametrize("sweeps", [1, 3])  # the first does not depend on where the particles are
@pytest.mark.parametrize("shares", [WHOLE, (1.0, 1.0, 0.4), (0.3, 1.0, 0.6)], ids=str)
def test_moves_leave_the_posterior_given_all_readings_invariant(shares: Shares, sweeps: int) -> None:
    places, probability = grid_density(shares, 600)
    rng = np.random.default_rng(3)
    count = 20_000
    start = places[:, rng.choice(places.shape[1], count, p=probability)] + rng.uniform(
        -0.025, 0.025, (2, count)
    )  # exact draws
    particles, accepted = moved(start, CONFIG, shared(shares), sweeps, 10)
    assert accepted > 2 * count
    assert particles.min() >= 0.0
    assert particles.max() <= 30.0
    mean = places @ probability
    agree(particles, mean, np.sqrt(places**2 @ probability - mean**2))


RATES: list[Prior] = [Normal(250.0, 80.0), Gamma(2.0, 150.0), Uniform(100.0, 500.0), LogNormal(250.0, 0.5)]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("prior", RATES, ids=lambda prior: type(prior).__name__)
def test_moves_leave_a_posterior_with_an_unknown_rate_invariant(prior: Prior) -> None:
    """x fixed, y and q unknown: the exact posterior on a grid of y and q."""
    config = Config(diffusivity=4.2, priors={"x": Fixed(13.0), "q": prior})
    y, q = np.meshgrid((np.arange(400) + 0.5) * 30 / 400, (np.arange(800) + 0.5) * 1600 / 800, indexing="ij")
    grid = np.stack([y.ravel(), q.ravel()])
    match prior:
        case Normal(a, b):
            log_density = -0.5 * ((grid[1] - a) / b) ** 2
        case Gamma(a, b):
            log_density = (a - 1) * np.log(grid[1]) - grid[1] / b
        case LogNormal(a, b):
            log_density = -0.5 * (np.log(grid[1] / a) / b) ** 2 - np.log(grid[1])
        case Uniform(a, b):
            log_density = np.where((grid[1] > a) & (grid[1] < b), 0.0, -np.inf)
    for row in READINGS:
        mean = concentration(
            row[:2],
            np.stack([np.full(len(grid[0]), 13.0), grid[0]], axis=-1),
            row[3:5],
            rate=grid[1],
            diffusivity=4.2,
            lifetime=10.0,
        )
        log_density = log_density + GAUSSIAN.log_likelihood(row[5], mean)
    probability = np.exp(log_density - log_density.max())
    probability /= probability.sum()
    rng = np.random.default_rng(4)
    count = 20_000
    start = grid[:, rng.choice(grid.shape[1], count, p=probability)] + rng.uniform(-1, 1, (2, count)) * [
        [0.0375],
        [1.0],
    ]
    particles, accepted = moved(start, config, shared(WHOLE), 3, 10)
    assert accepted > 2 * count
    mean = grid @ probability
    agree(particles, mean, np.sqrt(grid**2 @ probability - mean**2))


def test_moves_from_a_wrong_start_reach_the_posterior() -> None:
    places, probability = grid_density(WHOLE, 600)
    start = np.random.default_rng(5).uniform(0, 30, (2, 4000))
    particles, _ = moved(start, CONFIG, shared(WHOLE), 3, 35)
    mean = places @ probability
    # Steps depend on the population, so the chains are not quite independent: twice the 4 standard errors.
    agree(particles, mean, np.sqrt(places**2 @ probability - mean**2), 8.0)


KNOWLEDGE: list[dict[str, Prior]] = [
    {},
    {"x": Fixed(13.0), "q": LogNormal(250.0, 0.6)},
    {"noise": LogNormal(1.0, 0.7)},
    {
        "wind-direction": Normal(0.0, 20.0),
        "q": LogNormal(250.0, 0.6),
        "tau": LogNormal(10.0, 0.5),
        "noise": LogNormal(1.0, 0.5),
    },
]


@pytest.mark.parametrize("sensor", [GAUSSIAN, Gaussian(cv=0.7), Threshold(0.5), Hits()], ids=text)
@pytest.mark.parametrize("priors", KNOWLEDGE, ids=lambda priors: ",".join(priors))
@pytest.mark.parametrize("assume", ["paper", "field"])
def test_early_rejection_changes_no_decision(priors: dict[str, Prior], sensor: Sensor, assume: str) -> None:
    """Particles of no density at all accept everything: that shows the proposals, and then which of them
    must be accepted.
    """
    if isinstance(sensor, Hits):  # their noise is Poisson's
        priors = {name: prior for name, prior in priors.items() if name != "noise"}
    config = Config(rate=270.0, diffusivity=4.2, priors=priors, sensor=sensor, assume=assume)
    rng, count = np.random.default_rng(6), 3000
    readings = np.tile(READINGS, (5, 1))
    readings[:, :2] += rng.uniform(-3, 3, (15, 2))
    readings[:, 5] = (
        rng.poisson(readings[:, 5]) if isinstance(sensor, Hits) else readings[:, 5] * (rng.random(15) < 0.6)
    )
    readings[3, 6] = 0.3
    readings[7, 5] = 40.0  # under `field`, perhaps a spike
    near = {
        "x": (8, 18),
        "y": (8, 18),
        "q": (100, 500),
        "noise": (0.3, 3),
        "wind-direction": (-40, 40),
        "tau": (5, 20),
        "wind-speed": (0.5, 2),
        "cv": (0.1, 2),
        "puff-rate": (10, 400),
        "puff-share": (0.05, 1),
    }
    start = np.array([rng.uniform(*near[name], count) for name in config.unknowns])
    targets, how = targets_of(start, config, readings), (readings, config.model, 1, SEED, 0)
    proposals, said = start.copy(), np.full(count, -1e300)
    move(proposals, said, *how)
    needed = targets + np.log(first_uniforms(SEED, len(readings) - 1, 0, 2, count))
    # Proposals do not depend on the particle: Student's t with 4 degrees of freedom, of log-normal unknowns
    # in their logarithm. Its density is (1 + r²/4)^−(4 + D)/2.
    logs = [isinstance(config.effective_priors.get(name), LogNormal) for name in config.unknowns]
    here, there = start.copy(), proposals.copy()
    for places in (here, there):
        places[logs] = np.log(places[logs])
    precision = np.linalg.inv(np.cov(here, ddof=0).reshape(len(logs), -1))
    for sign, places in ((1, there), (-1, here)):
        off = places - here.mean(axis=1)[:, None]
        density = np.log(1 + np.einsum("in,ij,jn->n", off, precision, off) / 4)
        needed += sign * -0.5 * (4 + len(logs)) * density
    left = (proposals == start).all(axis=0)  # outside the support
    wanted = (targets_of(proposals, config, readings) >= needed) & ~left
    particles, carried = start.copy(), targets.copy()
    accepted = move(particles, carried, *how)
    assert 20 < accepted == wanted.sum() < count - 20
    assert np.array_equal(particles, np.where(wanted, proposals, start))


@pytest.mark.full
@pytest.mark.slow
def test_correlated_unknowns_stay_posterior_at_the_ends_of_their_support() -> None:
    """Readings tell q · gain alone, and both ends of that curve are cut off: reflected steps would not be
    symmetric there.
    """
    config = Config(
        diffusivity=4.2,
        priors={"x": Fixed(13.0), "y": Fixed(13.0), "q": Uniform(300.0, 1200.0), "gain": Uniform(0.5, 1.5)},
    )
    q, gain = np.meshgrid(300 + (np.arange(900) + 0.5), 0.5 + (np.arange(1000) + 0.5) / 1000, indexing="ij")
    grid = np.stack([q.ravel(), gain.ravel()])
    log_density = np.zeros(grid.shape[1])
    readings = np.tile(READINGS, (20, 1))
    for row in readings:
        mean = concentration(row[:2], (13.0, 13.0), row[3:5], rate=1.0, diffusivity=4.2, lifetime=10.0)
        log_density += GAUSSIAN.log_likelihood(row[5], grid[0] * grid[1] * mean)
    probability = np.exp(log_density - log_density.max())
    probability /= probability.sum()
    rng, count = np.random.default_rng(4), 40_000
    start = grid[:, rng.choice(grid.shape[1], count, p=probability)] + rng.uniform(-1, 1, (2, count)) * [
        [0.5],
        [0.0005],
    ]
    particles, accepted = moved(start, config, readings, 6, 15)
    assert accepted > 5 * count
    mean = grid @ probability
    agree(particles, mean, np.sqrt(grid**2 @ probability - mean**2))
    correlation = (
        ((grid[0] - mean[0]) * (grid[1] - mean[1]))
        @ probability
        / np.prod(np.sqrt(grid**2 @ probability - mean**2))
    )
    assert correlation < -0.5
    assert np.corrcoef(particles)[0, 1] == pytest.approx(correlation, abs=4 / math.sqrt(count))


@pytest.mark.parametrize(
    ("prior", "of"),
    [
        (Uniform(100.0, 200.0), "q"),
        (LogNormal(1.0, 1.0), "cv"),
        (Normal(0.0, 1.2), "cv"),
        (Uniform(0.02, 1.0), "puff-share"),
    ],
    ids=str,
)
def test_moves_stay_in_the_support(prior: Prior, of: str) -> None:
    """The posterior is the prior, cut off at its ends; proposals beyond them are rejected."""
    config = Config(priors={"y": Fixed(13.0), of: prior})
    low, high = config.prior_rows[config.unknown_indices[1], 3:5]
    rng, count = np.random.default_rng(7), 20_000
    match prior:
        case Uniform(a, b):
            value = rng.uniform(a, b, count)
        case LogNormal():
            value = np.exp(rng.normal(0.0, 1.0, 4 * count))
        case _:
            value = rng.normal(0.0, 1.2, 4 * count)
    start = np.stack([rng.uniform(0, 30, count), value[(value > low) & (value < high)][:count]])
    particles, _ = moved(start, config, shared(NONE), 6, 10)
    assert low <= particles[1].min() <= particles[1].max() <= high
    assert 0 <= particles[0].min() <= particles[0].max() <= 30
    # Independent chains: a share of a tenth errs by √(0.1 · 0.9/n), the start's share by as much: 4 standard
    # errors.
    edges = np.quantile(start[1], np.linspace(0, 1, 11))
    edges[[0, -1]] = low, high
    assert np.histogram(particles[1], edges)[0] / count == pytest.approx(
        np.full(10, 0.1), abs=4 * math.sqrt(2 * 0.09 / count)
    )


def test_a_log_normal_unknown_steps_in_its_logarithm() -> None:
    """Its steps are as long in the logarithm whether it is small or large, so that small values move as
    often as large ones.
    """
    config = Config(priors={"x": Fixed(13.0), "y": Fixed(13.0), "q": LogNormal(200.0, 1.5)})
    rng, count = np.random.default_rng(8), 20_000
    start = np.exp(rng.normal(math.log(200.0), 1.5, (1, count)))
    particles, _ = moved(start, config, shared(NONE), 1)
    steps = np.abs(np.log(particles / start)[0])
    small = start[0] < 200.0 * math.exp(-1.5)
    large = start[0] > 200.0 * math.exp(1.5)
    # 3,200 draws each; the mean of |steps|, of which a part is 0, errs by less than its own size / √3200 ·
    # 1.5.
    assert steps[small].mean() == pytest.approx(steps[large].mean(), rel=4 * 1.5 * math.sqrt(2 / 3200))
    agree(
        np.log(moved(start, config, shared(NONE), 1, 20)[0]),
        np.array([math.log(200.0)]),
        np.array([1.5]),
        4 * math.sqrt(2),
    )


def test_an_unknown_place_and_others_take_turns_and_stay_in_their_support() -> None:
    """With more than three unknowns, a sweep moves everything, the place or the rest. The posterior is the
    prior, which stays.
    """
    rest: dict[str, Prior] = {
        "q": LogNormal(250.0, 0.7),
        "wind-direction": Normal(0.0, 20.0),
        "cv": Normal(0.0, 1.2),
        "noise": LogNormal(1.0, 0.5),
    }
    for priors in (
        rest,
        {"x": Fixed(3.0), "y": Fixed(4.0), **rest},
    ):  # without a place there is nothing to move of it
        config = Config(priors=priors)
        rng, count = np.random.default_rng(9), 5000
        cv = np.abs(rng.normal(0.0, 1.2, 2 * count))
        values = {
            "x": rng.uniform(0, 30, count),
            "y": rng.uniform(0, 30, count),
            "q": np.exp(rng.normal(math.log(250.0), 0.7, count)),
            "wind-direction": rng.normal(0.0, 20.0, count),
            "noise": np.exp(rng.normal(0.0, 0.5, count)),
            "cv": cv[cv < 3.0][:count],
        }
        start = np.array([values[name] for name in config.unknowns])
        particles, _ = moved(start, config, shared(NONE), 3, 20)
        assert (
            (particles >= config.prior_rows[config.unknown_indices, 3:4])
            & (particles <= config.prior_rows[config.unknown_indices, 4:5])
        ).all()
        assert (particles != start).all(axis=1).sum() == 0 or (particles != start).mean() > 0.99
        # Two samples of the same distribution: √2 more.
        agree(particles, start.mean(axis=1), start.std(axis=1), 4 * math.sqrt(2))
        assert np.abs(np.corrcoef(particles) - np.eye(len(particles))).max() < 4 / math.sqrt(count)


def test_a_sweep_without_a_place_still_moves() -> None:
    config = Config(
        priors={
            "x": Fixed(3.0),
            "y": Fixed(4.0),
            **{name: Uniform(1.0, 2.0) for name in ("q", "d", "tau", "noise")},
        }
    )
    start = np.random.default_rng(9).uniform(1.0, 2.0, (4, 500))
    for stage in range(2):
        particles, targets = start.copy(), targets_of(start, config, shared(WHOLE)) + 1e6
        # No proposal reaches these densities: nothing is accepted, neither is a move to the same place
        # counted.
        assert move(particles, targets, shared(WHOLE), config.model, 3, SEED, stage) == 0
        assert np.array_equal(particles, start)
