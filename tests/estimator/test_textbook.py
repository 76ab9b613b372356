"""Protects the fused step of the filter: it is the textbook's (reweight, resample, move), here in plain
NumPy with the same random numbers.
"""

import math

import numpy as np
import pytest

from estimator.filter import Config, Posterior, assimilate, prior, renewed
from estimator.priors import LogNormal, Prior
from link.bus.mavlink import Reading
from plume.dispersion import concentration
from plume.scenario import AREA_M, Scenario, draw
from plume.sensors.names import GAUSSIAN
from plume.worlds.world import World

Array = np.ndarray
SEED, COUNT = 5, 400


def mixed(word: Array) -> Array:
    """The finaliser of SplitMix64."""
    word = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return word ^ (word >> np.uint64(31))


def words(step: int, stage: int, stream: int, first: int, count: int) -> Array:
    """Numbers of the sequence of one (seed, step, stage, stream)."""
    golden = np.uint64(0x9E3779B97F4A7C15)
    key = mixed(np.array([SEED], np.uint64) + golden)
    key = mixed(key ^ np.array([step + 1], np.uint64) * golden)
    key = mixed(key ^ np.array([stage * 1024 + stream + 1], np.uint64) * golden)
    return mixed(key + np.arange(first + 1, first + count + 1, dtype=np.uint64) * golden)


def uniforms(step: int, stage: int, stream: int, first: int, count: int) -> Array:
    return ((words(step, stage, stream, first, count) >> np.uint64(12)) + 0.5) * 2.0**-52


class Textbook:
    """A particle filter as in Chopin and Papaspiliopoulos (2020), chapters 10 and 17, tempered as by Del
    Moral et al. (2006).
    """

    def __init__(self, scenario: Scenario, config: Config) -> None:
        self.scenario, self.config = scenario, config
        self.particles, self.log_weights = prior(config).particles, np.zeros(config.particles)
        self.readings: list[tuple[Reading, float]] = []

    def log_likelihood(self, particles: Array, reading: Reading) -> Array:
        s = self.scenario
        rate = particles[2] if len(particles) > 2 else s.q
        known = {"rate": rate, "diffusivity": s.d, "lifetime": s.tau}
        return GAUSSIAN.log_likelihood(
            reading.gas, concentration(reading.position, particles[:2].T, reading.wind, **known)
        )

    def log_target(self, particles: Array) -> Array:
        """Of the prior and the readings so far; −∞ outside the area."""
        target = np.where(((particles[:2] >= 0) & (particles[:2] <= AREA_M)).all(axis=0), 0.0, -np.inf)
        if len(particles) > 2:
            target = target - 0.5 * (np.log(particles[2] / 250.0) / 0.6) ** 2
        return target + sum(
            share * self.log_likelihood(particles, reading) for reading, share in self.readings
        )

    def size(self, log_weights: Array) -> float:
        weights = np.exp(log_weights - log_weights.max())
        return float(weights.sum() ** 2 / (weights @ weights))

    def share(self, log_likelihood: Array, left: float, least: float) -> float:
        """As much of the likelihood as leaves four fifths of `least` effective, to 20%, by bisection."""
        low, high, count = 0.0, left, 2 * least * len(log_likelihood)
        size = self.size(self.log_weights + left * log_likelihood)
        share = left
        while size < 0.4 * count or (share < left and size > 1.2 * 0.4 * count):
            low, high = (low, share) if size < 0.4 * count else (share, high)
            share = 0.5 * (low + high)
            size = self.size(self.log_weights + share * log_likelihood)
        return share

    def assimilate(self, reading: Reading, least: float = 0.5) -> None:
        exponent, stage, step = 0.0, 0, len(self.readings)
        self.readings.append((reading, 0.0))
        while exponent < 1.0:
            log_likelihood = self.log_likelihood(self.particles, reading)
            share = self.share(log_likelihood, 1.0 - exponent, least)
            exponent = 1.0 if share == 1.0 - exponent else exponent + share
            self.readings[-1] = reading, exponent
            self.log_weights = self.log_weights + share * log_likelihood
            if self.size(self.log_weights) < least * COUNT:
                self.resample(float(uniforms(step, stage, 0, 0, 1)[0]))
                self.move(step, stage)
            stage += 1

    def renew(self) -> None:
        """After a round resample and move three times, but if the weights are nearly equal."""
        if self.size(self.log_weights) >= 0.8 * COUNT:
            return
        step = len(self.readings) - 1
        self.resample(float(uniforms(step, 40, 0, 0, 1)[0]))
        for stage in (40, 41, 42):
            self.move(step, stage)

    def resample(self, offset: float) -> None:
        weights = np.exp(self.log_weights - self.log_weights.max())
        points = (np.arange(COUNT) + offset) / COUNT * weights.sum()
        self.particles = self.particles[:, np.searchsorted(np.cumsum(weights), points, side="right")]
        self.log_weights = np.zeros(COUNT)

    def move(self, step: int, stage: int) -> None:
        pool, done = self.particles.copy(), 0.0
        for sweep in range(self.config.sweeps):
            now, stream, enough = self.particles, 2 * sweep + 1, 1.0
            if len(now) == 2:
                enough = 0.5
            if sweep == 0 and len(now) == 2:
                proposals, correction = self.places(step, stage, stream)
            elif sweep % 3 == 0 and len(now) > 2:
                enough = 0.8
                proposals, correction = self.draws(pool, step, stage, stream)
            else:
                proposals, correction = self.steps(pool, step, stage, stream), 0.0
            chance = np.log(uniforms(step, stage, stream + 1, 0, COUNT))
            good = self.log_target(proposals) >= self.log_target(now) + chance + correction
            self.particles = np.where(good, proposals, now)
            done += int(good.sum()) / enough
            if done >= COUNT and (sweep % 3 or len(now) == 2):
                break

    def places(self, step: int, stage: int, stream: int) -> tuple[Array, Array]:
        """Student's t with 4 degrees of freedom, and the log-ratio of its densities there and here."""
        chance = uniforms(step, stage, stream, 0, 2 * COUNT).reshape(-1, 2).T
        mean, covariance = self.particles.mean(axis=1), np.cov(self.particles, ddof=0)
        square = 4 * (1 / np.sqrt(chance[0]) - 1)
        circle = np.sqrt(square) * [np.cos(2 * np.pi * chance[1]), np.sin(2 * np.pi * chance[1])]
        off = self.particles - mean[:, None]
        here = np.einsum("in,ij,jn->n", off, np.linalg.inv(covariance), off)
        return mean[:, None] + np.linalg.cholesky(covariance) @ circle, 3 * np.log((4 + here) / (4 + square))

    def draws(self, pool: Array, step: int, stage: int, stream: int) -> tuple[Array, Array]:
        """The same for all unknowns, of a rate in logs: a normal draw over the root of a chi-square."""
        pool, now = pool.copy(), self.particles.copy()
        pool[2:], now[2:] = np.log(pool[2:]), np.log(now[2:])
        chance = uniforms(step, stage, stream, 0, 6 * COUNT)
        stretch = np.sqrt(4 / (-2 * np.log(chance[: 2 * COUNT]).reshape(-1, 2).sum(axis=1)))
        pairs = chance[2 * COUNT :].reshape(2, COUNT, 2)
        radius, angle = np.sqrt(-2 * np.log(pairs[:, :, 0])), 2 * np.pi * pairs[:, :, 1]
        normal = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1).reshape(4, COUNT)[:3]
        mean, root = pool.mean(axis=1)[:, None], np.linalg.cholesky(np.cov(pool, ddof=0))
        here, there = np.linalg.solve(root, now - mean), normal * stretch
        proposals = mean + root @ there
        proposals[2:] = np.exp(proposals[2:])
        squares = (here * here).sum(axis=0), (there * there).sum(axis=0)
        return proposals, 3.5 * np.log((4 + squares[0]) / (4 + squares[1]))

    def steps(self, pool: Array, step: int, stage: int, stream: int) -> Array:
        """Differential evolution: scaled differences of two particles, and some noise; of a rate in logs."""
        pairs = words(step, stage, stream, 0, 2 * COUNT)[::2]
        ones = [int(word >> np.uint64(32)) * COUNT >> 32 for word in pairs]
        others = [int(word & np.uint64(0xFFFFFFFF)) * COUNT >> 32 for word in pairs]
        chance = 3 * uniforms(step, stage, stream, 0, 2 * COUNT)[1::2]
        scale = (
            2.38 / math.sqrt(2 * len(pool)) * np.select([chance < 1, chance < 2], [0.7, 0.35], default=0.12)
        )
        pool, now = pool.copy(), self.particles.copy()
        pool[2:], now[2:] = np.log(pool[2:]), np.log(now[2:])
        noise = 0.17 * (uniforms(step, stage, stream, 2 * COUNT, pool.size).reshape(pool.shape) - 0.5)
        now += scale * (pool[:, ones] - pool[:, others]) + noise * pool.std(axis=1)[:, None]
        now[2:] = np.exp(now[2:])
        return now


PRIORS = pytest.mark.parametrize(
    "priors", [{}, {"q": LogNormal(250.0, 0.6)}], ids=lambda priors: " ".join(priors)
)


def search(priors: dict[str, Prior]) -> tuple[Config, Textbook, list[Reading]]:
    """Both filters, and readings on the way to a source."""
    s = draw(11)
    config = Config(COUNT, seed=SEED, rate=s.q, diffusivity=s.d, lifetime=s.tau, priors=priors)
    world, readings = World(s, 11), []
    for step, share in enumerate(np.linspace(0.0, 1.0, 25)):
        x, y = (np.array(s.start) + share * (np.array(s.source) - s.start)).astype(np.float32).tolist()
        readings.append(Reading(step, (x, y), 5.0, world.wind, world.gas((x, y), step)))
    return config, Textbook(s, config), readings


def assert_alike(posterior: Posterior, textbook: Textbook) -> None:
    """To 1e-9 of the area: sums differ in their order. A decision that differs would move a particle by
    far more.
    """
    assert posterior.particles == pytest.approx(textbook.particles, rel=1e-7, abs=1e-8)
    assert posterior.log_weights - posterior.log_weights.max() == pytest.approx(
        textbook.log_weights - textbook.log_weights.max(), abs=1e-7
    )
    assert posterior.readings[-1, 6] == pytest.approx(textbook.readings[-1][1], abs=1e-12)


@PRIORS
def test_the_fused_step_is_the_textbooks(priors: dict[str, Prior]) -> None:
    config, textbook, readings = search(priors)
    posterior = prior(config)
    for reading in readings:
        before = posterior.particles
        posterior = assimilate(posterior, reading, config)
        textbook.assimilate(reading)
        assert_alike(posterior, textbook)
    assert not np.array_equal(before, posterior.particles)  # it has moved, to the last reading


@PRIORS
def test_within_a_round_of_several_the_weights_degenerate_further_and_then_the_sample_is_renewed(
    priors: dict[str, Prior],
) -> None:
    """Five vehicles, so five rounds: down to a fiftieth of the particles within each."""
    config, textbook, readings = search(priors)
    posterior, least, moves, kept = prior(config), 1.0, 0, 0
    for number, reading in enumerate(readings):
        if number and number % 5 == 0:
            before = posterior.particles
            posterior = renewed(posterior, config)
            textbook.renew()
            assert_alike(posterior, textbook)
            kept += np.array_equal(before, posterior.particles)
        before = posterior.particles
        posterior = assimilate(posterior, reading._replace(vehicle=1 + number % 5), config)
        textbook.assimilate(reading, 0.02 if number else 0.5)
        assert_alike(posterior, textbook)
        moves += not np.array_equal(before, posterior.particles)
        least = min(least, textbook.size(textbook.log_weights) / COUNT)
    assert least < 0.4  # one vehicle's are never so few
    assert moves >= 1  # within a round, too
    assert 1 <= kept < 4  # after a round that told little nothing moves


def test_of_one_vehicle_nothing_is_renewed() -> None:
    config, _, readings = search({})
    posterior = assimilate(prior(config), readings[0], config)
    assert renewed(posterior, config) is posterior
