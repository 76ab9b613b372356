"""Protects the compiled kernels: each equals the readable formula."""

import math
import subprocess
import sys

import numpy as np
import pytest
from numba import njit

from estimator.belief import FEWEST, RECENT
from estimator.filter import Config
from estimator.kernels.checks import uniformity_p_value
from estimator.kernels.densities import greatest_log_density, is_a_normal_density, log_likelihoods
from estimator.kernels.weights import effective_sample_size, moments, systematic
from estimator.priors import Fixed, Gamma, LogNormal, Normal, Prior, Uniform
from plume import numerics
from plume.dispersion import concentration
from plume.draws import key_of, uniform
from plume.parameters import CV
from plume.sensors.names import GAUSSIAN, Sensor, sensor_row, text
from plume.sensors.sensor import Gaussian, Hits, Threshold
from tests.estimator.exact_cells import gas_density

CONFIG = Config(rate=270.0, diffusivity=4.2)
READING = np.array([14.0, 13.0, 0.0, 1.9, 2.6, 3.75])
EIGHT: dict[str, Prior] = {
    "z": Uniform(0.0, 5.0),
    "q": Gamma(2.0, 150.0),
    "u": Normal(2.5, 0.5),
    "phi": Normal(1.0, 0.2),
    "d": Uniform(1.0, 8.0),
    "tau": Uniform(5.0, 20.0),
}
ERRORS: dict[str, Prior] = {
    "wind-direction": Normal(0.0, 20.0),
    "wind-speed": LogNormal(1.0, 0.5),
    "gain": LogNormal(1.0, 0.5),
    "noise": LogNormal(1.0, 0.5),
}
PUFFS: dict[str, Prior] = {
    "cv": Normal(0.0, 1.2),
    "puff-rate": LogNormal(100.0, 2.0),
    "puff-share": Uniform(0.02, 1.0),
}


def draws(config: Config, count: int, seed: int = 1) -> np.ndarray:
    """Particles (D, count) spread widely over the unknowns."""
    ranges = {
        "x": (0, 30),
        "y": (0, 30),
        "z": (0, 5),
        "q": (50, 900),
        "u": (0.5, 4),
        "phi": (-7, 7),
        "d": (1, 8),
        "tau": (5, 20),
        "wind-direction": (-400, 400),
        "wind-speed": (0.3, 3),
        "gain": (0.3, 3),
        "noise": (0.3, 3),
        "cv": (0.1, 3),
        "puff-rate": (1, 300),
        "puff-share": (0.05, 1),
    }
    rng = np.random.default_rng(seed)
    return np.array([rng.uniform(*ranges[name], count) for name in config.unknowns])


def readable(config: Config, particles: np.ndarray, reading: np.ndarray) -> np.ndarray:
    """Log-likelihoods by the formulas of plume/."""
    value = dict(zip(config.unknowns, particles, strict=True))
    x, y, z = np.broadcast_arrays(value["x"], value["y"], value.get("z", 0.0))
    speed = value.get("u", value.get("wind-speed", 1.0) * math.hypot(reading[3], reading[4]))
    direction = value.get(
        "phi", math.atan2(reading[4], reading[3]) + np.radians(value.get("wind-direction", 0.0))
    )
    wind = np.stack(np.broadcast_arrays(speed * np.cos(direction), speed * np.sin(direction)), axis=-1)
    mean = concentration(
        reading[:3],
        np.stack([x, y, z], axis=-1),
        wind,
        rate=value.get("q", config.rate),
        diffusivity=value.get("d", config.diffusivity),
        lifetime=value.get("tau", config.lifetime),
    )
    mean = mean * value.get("gain", 1.0)
    if not {"noise", "cv", "puff-rate"} & set(value):
        return config.sensor.log_likelihood(reading[5], mean)
    if "puff-rate" in value and isinstance(config.sensor, Gaussian):
        offset = np.stack([reading[0] - x, reading[1] - y, reading[2] - z], axis=-1)
        return in_puffs(config, value, reading[5], mean, of_puffs(config, value, offset, wind))
    noise, cv = (
        np.broadcast_to(value.get(name, default), mean.shape)
        for name, default in (("noise", 1.0), ("cv", 0.0))
    )
    sensors = [noisier(config.sensor, *each) for each in zip(noise.tolist(), cv.tolist(), strict=True)]
    return np.array(
        [float(sensor.log_likelihood(reading[5], m)) for sensor, m in zip(sensors, mean, strict=True)]
    )


def of_puffs(
    config: Config, value: dict[str, np.ndarray], offset: np.ndarray, wind: np.ndarray
) -> np.ndarray:
    """Campbell's variance by the squared mean (test_fluctuations.py), with ∫ a⁻³ e^(−A/a − B a) da = 2 (B/A)
    K₂(2 √(A B)).
    """
    from scipy import special

    share, d = value["puff-share"], value.get("d", config.diffusivity)
    spread = 4 * (1 - share / 2) * d  # the mean square of a puff spreads as e^(−r²/(spread a))
    square = np.maximum((offset**2).sum(axis=-1), 0.01)
    a = square / spread
    b = 2 / value.get("tau", config.lifetime) + (wind**2).sum(axis=-1) / spread
    along = offset[..., 0] * wind[..., 0] + offset[..., 1] * wind[..., 1]
    z = 2 * np.sqrt(a * b)
    mean_square = 2 * b / a * special.kve(2, z) / (np.pi * spread * 8 * np.pi * share * d) ** 1.5
    inverse_length = np.sqrt(
        1 / (d * value.get("tau", config.lifetime)) + (wind**2).sum(axis=-1) / (4 * d * d)
    )
    log_mean = -np.sqrt(square) * inverse_length - along / (2 * d) - np.log(4 * np.pi * d * np.sqrt(square))
    return mean_square / value["puff-rate"] * np.exp(-z - 2 * along / spread - 2 * log_mean)


def in_puffs(
    config: Config, value: dict[str, np.ndarray], gas: float, mean: np.ndarray, puffs: np.ndarray
) -> np.ndarray:
    """Log-density of a reading in gas of the intermittency cv, and in puffs (test_intermittency.py)."""
    factor = np.square(value.get("noise", 1.0))
    slope, floor = (
        factor * number**2 for number in (config.sensor.sensor_noise, config.sensor.environment_noise)
    )
    even = np.square(value.get("cv", float(config.prior_rows[CV, 1])))
    square = np.minimum(even + puffs, 900.0)
    blank = 0.4 * square / (1 + square)
    there, mean_square = mean / (1 - blank), (1 + square) / (1 - blank)
    own = mean_square * (1 - blank) ** 2 - 1
    normal = slope / (slope + own) * slope
    of_gas = own + slope * (1 + own) - normal
    silent = slope * mean**2 + floor
    nothing = np.exp(-0.5 * gas**2 / silent) / np.sqrt(2 * np.pi * silent)
    something = gas_density(gas, there, np.sqrt(normal * there**2 + floor), np.minimum(of_gas, 900.0))
    with np.errstate(divide="ignore"):
        return np.log(blank * nothing + (1 - blank) * something)


def noisier(sensor: Sensor, noise: float, cv: float) -> Sensor:
    """The sensor whose two noises are greater by a factor, in gas of this intermittency."""
    match sensor:
        case Gaussian(slope, floor):
            return Gaussian(noise * slope, noise * floor, cv)
        case Threshold(threshold, missed, slope, floor):
            return Threshold(threshold, missed, noise * slope, noise * floor)
    return sensor


@njit
def exp_and_log(values: np.ndarray) -> np.ndarray:
    """e^v and ln |v| as the kernels compute them."""
    result = np.empty((2, len(values)))
    for i in range(len(values)):
        result[0, i] = numerics.exp(values[i])
        result[1, i] = numerics.log(abs(values[i]))
    return result


@njit
def directions(turns: np.ndarray) -> np.ndarray:
    """cos and sin of 2π · turns as the kernels compute them."""
    result = np.empty((2, len(turns)))
    for i in range(len(turns)):
        result[0, i], result[1, i] = numerics.direction(turns[i])
    return result


@njit
def uniforms(seed: int, step: int, count: int) -> np.ndarray:
    """The first draws of a sequence."""
    key = key_of(np.uint64(seed), step, 0, 0)
    result = np.empty(count)
    for i in range(count):
        result[i] = uniform(key, i)
    return result


def fused(config: Config, particles: np.ndarray, reading: np.ndarray) -> np.ndarray:
    return log_likelihoods(particles, config.model, reading)


@pytest.mark.slow
def test_the_polynomials_are_exp_and_log() -> None:
    values = np.concatenate(
        [
            np.linspace(-700, 700, 200_001),
            np.geomspace(1e-300, 1e300, 100_001),
            -np.geomspace(1e-12, 1, 10_001),
        ]
    )
    exp, log = exp_and_log(values)
    inside = np.abs(values) <= 700
    assert np.abs(exp[inside] / np.exp(values[inside]) - 1).max() < 4.5e-16  # two units in the last place
    nonzero = values != 0
    expected = np.log(np.abs(values[nonzero]))
    assert np.all(np.abs(log[nonzero] - expected) <= 4.5e-16 * np.maximum(np.abs(expected), 1))


@pytest.mark.slow
def test_a_direction_is_cos_and_sin() -> None:
    turns = np.concatenate([np.linspace(0, 1, 100_001)[:-1], [0.25, 0.5, 0.75, 1 - 2.0**-53]])
    expected = np.cos(2 * math.pi * turns), np.sin(2 * math.pi * turns)
    assert np.abs(directions(turns) - expected).max() < 1e-15


@pytest.mark.slow
def test_what_is_drawn_is_uniform_and_uncorrelated() -> None:
    draws = uniforms(5, 7, 1_000_000)
    assert 0 < draws.min() < draws.max() < 1
    counts = np.histogram(draws, 1000, (0, 1))[0]
    chi_square = np.sum((counts - 1000) ** 2 / 1000)
    assert abs(chi_square - 999) < 4 * math.sqrt(2 * 999)  # 4 standard deviations
    for lag in (1, 2, 4):
        assert abs(np.corrcoef(draws[:-lag], draws[lag:])[0, 1]) < 4 / 1000
    other = uniforms(5, 8, 1_000_000)
    assert abs(np.corrcoef(draws, other)[0, 1]) < 4 / 1000


KNOWLEDGE: list[dict[str, Prior]] = [
    {},
    {"q": Gamma(2.0, 150.0)},
    {"u": Normal(2.5, 0.5)},
    {"phi": Uniform(0, 6.2)},
    EIGHT,
    ERRORS,
    {"noise": LogNormal(1.0, 0.5)},
    {"wind-direction": Normal(0.0, 20.0), "u": Normal(2.5, 0.5)},
    {"wind-speed": LogNormal(1.0, 0.5), "z": Uniform(0.0, 5.0)},
]


@pytest.mark.parametrize("priors", KNOWLEDGE, ids=lambda priors: ",".join(priors))
@pytest.mark.parametrize(
    ("sensor", "gas"),
    [(GAUSSIAN, 3.75), (Threshold(), 3.75), (Threshold(), 0.0), (Hits(), 11.0), (Hits(), 0.0)],
)
def test_the_fused_likelihood_equals_the_readable_one(
    priors: dict[str, Prior], sensor: Sensor, gas: float
) -> None:
    if isinstance(sensor, Hits):  # their noise is Poisson's
        priors = {name: prior for name, prior in priors.items() if name != "noise"}
    config = Config(rate=270.0, diffusivity=4.2, priors=priors, sensor=sensor)
    particles = draws(config, 1000)
    reading = np.array([14.0, 13.0, 5.0 if "z" in priors else 0.0, 1.9, 2.6, gas])
    assert fused(config, particles, reading) == pytest.approx(
        readable(config, particles, reading), rel=1e-11, abs=1e-11
    )


@pytest.mark.parametrize("cv", [Normal(0.0, 1.2), LogNormal(1.0, 0.5)], ids=["normal", "lognormal"])
@pytest.mark.parametrize("gas", [-0.4, 0.1, 3.75])
def test_the_fused_likelihood_in_intermittent_gas_equals_the_readable_one(cv: Prior, gas: float) -> None:
    config = Config(rate=270.0, diffusivity=4.2, priors={**ERRORS, "cv": cv})
    particles = draws(config, 300)
    reading = np.array([14.0, 13.0, 0.0, 1.9, 2.6, gas])
    expected = readable(config, particles, reading)
    probable = expected > -40
    assert probable.sum() > 100
    # The kernel's table is right to 0.005 where a reading is likely, and far from that to 0.02.
    found = fused(config, particles, reading)
    assert found[probable] == pytest.approx(expected[probable], abs=0.02)
    assert found[expected > -8] == pytest.approx(expected[expected > -8], abs=0.006)


@pytest.mark.parametrize("gas", [-0.4, 0.1, 3.75, 20.0])
def test_the_fused_likelihood_in_puffs_equals_the_readable_one(gas: float) -> None:
    config = Config(
        rate=270.0,
        diffusivity=4.2,
        priors={**ERRORS, "d": Uniform(1.0, 8.0), "tau": Uniform(5.0, 20.0), "q": Gamma(2.0, 150.0), **PUFFS},
    )
    particles = draws(config, 2000)
    reading = np.array([14.0, 13.0, 0.0, 1.9, 2.6, gas])
    expected = readable(config, particles, reading)
    probable, likely = expected > -40, expected > -8
    assert probable.sum() > 500
    assert likely.sum() > 100
    error = np.abs(fused(config, particles, reading) - expected)
    # Far from where a reading is likely, of the rarest puffs, the kernel's table may err by a quarter.
    assert error[probable].max() < 0.3
    assert np.quantile(error[probable], 0.95) < 0.006
    assert error[likely].max() < 0.016


def test_a_known_error_of_what_measures_is_corrected() -> None:
    """The place alone is unknown, but the anemometer is off by 30° and a third, the sensor reads half, in
    gas of known intermittency.
    """
    off: dict[str, Prior] = {
        "wind-direction": Fixed(30.0),
        "wind-speed": Fixed(1.5),
        "gain": Fixed(0.5),
        "noise": Fixed(2.0),
    }
    for sensor, tolerance in ((GAUSSIAN, 1e-10), (Gaussian(cv=0.8), 0.002)):
        config = Config(rate=270.0, diffusivity=4.2, priors=off, sensor=sensor)
        assert config.unknowns == ("x", "y")
        particles = draws(config, 200)
        turned, faster = math.atan2(2.6, 1.9) + math.pi / 6, 1.5 * math.hypot(1.9, 2.6)
        wind = faster * np.array([math.cos(turned), math.sin(turned)])
        mean = 0.5 * concentration(
            (14.0, 13.0), particles.T, wind, rate=270.0, diffusivity=4.2, lifetime=10.0
        )
        expected = noisier(sensor, 2.0, sensor.cv).log_likelihood(3.75, mean)
        assert fused(config, particles, READING) == pytest.approx(expected, rel=tolerance, abs=tolerance)


@pytest.mark.parametrize("sensor", [GAUSSIAN, Gaussian(cv=1.0), Threshold(), Hits()], ids=text)
@pytest.mark.parametrize("noise", [None, 0.4, 2.5, 40.0])
@pytest.mark.parametrize("assume", ["paper", "field"])
def test_no_likelihood_exceeds_its_bound(sensor: Sensor, noise: float | None, assume: str) -> None:
    """The bound that early rejection relies on, for a known or an unknown factor on the noise, with and
    without spikes.
    """
    noise = None if isinstance(sensor, Hits) else noise  # theirs is Poisson's
    known: dict[str, Prior] = {"wind-direction": Fixed(0.0), "wind-speed": Fixed(1.0), "q": Fixed(270.0)}
    if isinstance(sensor, Gaussian):
        known |= {"cv": Fixed(sensor.cv), "puff-rate": Fixed(20.0), "puff-share": Fixed(0.2)}
    if not isinstance(sensor, Hits):
        known["noise"] = Fixed(1.0)
    known = {**known, "tau": Fixed(10.0)} if assume == "field" else {}
    config = Config(
        rate=270.0,
        diffusivity=4.2,
        priors=known if noise is None else {**known, "noise": LogNormal(1.0, 0.5)},
        sensor=sensor,
        assume=assume,
    )
    particles = draws(CONFIG, 4000)
    if noise is not None:
        particles = np.vstack([particles, np.full((1, 4000), noise)])
    assert len(config.unknowns) == len(particles)
    places = [(14.0, 13.0), (2.0, 28.0)]
    for gas in (0.0, 1.0, 3.0, 20.0) if isinstance(sensor, Hits) else (0.0, 0.6, 3.0, 20.0, 60.0):
        greatest, spike = greatest_log_density(gas, config.model)
        factor = noise if noise and is_a_normal_density(gas, sensor_row(sensor)) else 1.0
        bound = greatest + math.log(1 / factor + spike)
        greatest = max(
            fused(config, particles, np.array([*place, 0.0, 1.9, 2.6, gas])).max() for place in places
        )
        assert greatest <= bound + 1e-9
        if gas == 0.0:
            assert greatest > bound - 0.5  # and it says something


def test_the_fused_likelihood_clamps_the_distance_too() -> None:
    at_the_source = np.array([[14.0, 14.0], [13.0, 13.1]])
    assert fused(CONFIG, at_the_source, READING) == pytest.approx(
        readable(CONFIG, at_the_source, READING), rel=1e-12
    )


def test_effective_sample_size_counts_equal_weights_and_ignores_a_common_factor() -> None:
    assert effective_sample_size(np.full(8, 1e-200) ** 0.5) == pytest.approx(8.0)
    assert effective_sample_size(np.array([0.5, 0.5, 1e-300])) == pytest.approx(2.0)
    assert effective_sample_size(np.array([8.0, 2.0])) == pytest.approx(1 / (0.64 + 0.04))


def test_moments_equal_the_hand_worked_values() -> None:
    particles = np.array([[0.0, 4.0, 0.0], [0.0, 0.0, 2.0]])
    mean, covariance = moments(particles, np.array([2.0, 1.0, 1.0]))
    # mean (1, 0.5);  xx = 4 − 1, xy = 0 − 0.5, yy = 1 − 0.25
    assert mean == pytest.approx([1.0, 0.5])
    assert covariance == pytest.approx(np.array([[3.0, -0.5], [-0.5, 0.75]]))


@pytest.mark.parametrize("count", [1, 7, 8, 1001])
def test_moments_of_any_number_of_particles_equal_numpys(count: int) -> None:
    rng = np.random.default_rng(6)
    particles, weights = rng.normal(5, 2, (3, count)), rng.random(count)
    mean, covariance = moments(particles, weights)
    assert mean == pytest.approx(np.average(particles, axis=1, weights=weights))
    assert covariance == pytest.approx(np.cov(particles, aweights=weights, ddof=0).reshape(3, 3), abs=1e-12)


def test_systematic_resampling_copies_each_particle_its_expected_number_of_times_rounded() -> None:
    weights = np.random.default_rng(2).dirichlet(np.full(50, 0.3))
    for offset in (0.0, 0.25, 0.999):
        copies = np.bincount(systematic(3 * weights, offset), minlength=50)
        assert copies.sum() == 50
        assert np.all(np.abs(copies - 50 * weights) < 1)


def test_systematic_resampling_is_exact_at_its_edges() -> None:
    assert systematic(np.array([0.25, 0.25, 0.25, 0.25]), 0.0).tolist() == [0, 1, 2, 3]
    assert systematic(np.array([0.0, 0.0, 1.0]), 0.0).tolist() == [2, 2, 2]
    assert systematic(np.array([1.0, 0.0, 0.0]), 0.999).tolist() == [0, 0, 0]


def test_a_rank_is_uniform_where_the_model_is_right() -> None:
    """Anderson–Darling p-values of uniform ranks are uniform, and small if ranks pile up."""
    rng = np.random.default_rng(7)
    for count in (8, 30):
        p_values = np.array([uniformity_p_value(rng.random(count)) for _ in range(20_000)])
        for level in (0.5, 0.1, 0.01, 0.001):
            margin = 4 * math.sqrt(level * (1 - level) / 20_000) + 0.003 * (
                level > 0.05
            )  # 4 standard deviations, the formula's own error
            assert np.mean(p_values < level) == pytest.approx(level, abs=margin)
    for count in range(FEWEST, RECENT + 1):  # evenly spread: nothing can fit better
        assert 0.99 < uniformity_p_value((np.arange(count) + 0.5) / count) <= 1.0
    assert uniformity_p_value(np.full(30, 0.5)) < 1e-4
    assert uniformity_p_value(np.linspace(0.9, 1.0, 30)) < 1e-6


CACHE_MISSES = """
import numba, sys
from estimator import batch
rooms = [module for name, module in sys.modules.items() if name.startswith(("estimator.kernels.", "plume.kernels"))]
compiled = {id(f): f for room in rooms for f in vars(room).values() if isinstance(f, numba.core.dispatcher.Dispatcher)}.values()
print(sum(sum(f.stats.cache_hits.values()) for f in compiled), sum(sum(f.stats.cache_misses.values()) for f in compiled))
"""


@pytest.mark.slow
def test_a_second_start_compiles_nothing() -> None:
    run = [sys.executable, "-c", CACHE_MISSES]
    subprocess.run(run, check=True, capture_output=True, timeout=300)
    hits, misses = subprocess.run(run, check=True, capture_output=True, text=True, timeout=300).stdout.split()
    assert int(hits) > 5
    assert misses == "0"
