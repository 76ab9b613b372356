"""Protects the sensors: each likelihood is the density of the readings that the same sensor draws."""

import math

import numpy as np
import pytest

from plume.parameters import MOST
from plume.sensors.names import GAUSSIAN, Sensor, parse, text
from plume.sensors.sensor import Gaussian, Hits, Threshold

DRAWS = 200_000
MEANS = [0.0, 0.4, 1.0, 10.0]


@pytest.mark.parametrize(("mean", "std"), [(0.0, 0.2), (1.0, math.sqrt(0.13)), (10.0, math.sqrt(9.04))])
def test_the_noise_has_the_moments_that_the_two_noises_add_up_to(mean: float, std: float) -> None:
    readings = GAUSSIAN.measure(np.full(DRAWS, mean), np.random.default_rng(1))
    # Margins are 4 standard errors: σ/√n for the mean, σ/√(2n) for the standard deviation.
    assert readings.mean() == pytest.approx(mean, abs=4 * std / math.sqrt(DRAWS))
    assert readings.std() == pytest.approx(std, abs=4 * std / math.sqrt(2 * DRAWS))


def kolmogorov_smirnov(readings: np.ndarray, sensor: Sensor, mean: float, low: float, high: float) -> float:
    """√n times the greatest distance between the empirical distribution and the integrated likelihood,
    from `low` to `high`.
    """
    grid = np.linspace(low, high, 400_001)
    density = np.exp(sensor.log_likelihood(grid, mean))
    cumulative = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(grid))])
    empirical = np.searchsorted(np.sort(readings), grid, side="right") / len(readings)
    return float(np.abs(empirical - cumulative / cumulative[-1]).max() * math.sqrt(len(readings)))


@pytest.mark.parametrize("mean", [0.0, 0.4, 1.0, 3.9, 4.1, 10.0, 100.0])
@pytest.mark.parametrize(
    "sensor", [GAUSSIAN, Threshold(), Threshold(2.0, 0.0), Hits(), Hits(1.0, 5.0)], ids=text
)
def test_the_entropy_is_the_expected_log_likelihood_with_its_sign_turned(sensor: Sensor, mean: float) -> None:
    if isinstance(sensor, Hits):
        values, steps = np.arange(0.0, 1000.0), np.ones(1000)
    else:
        low = sensor.threshold if isinstance(sensor, Threshold) else mean - 12 * (0.3 * mean + 0.2)
        values = np.linspace(low, max(mean, low) + 12 * (0.3 * mean + 0.2), 400_001)
        steps = np.full(len(values), values[1] - values[0])
        steps[[0, -1]] /= 2
    if isinstance(sensor, Threshold):
        values, steps = np.append(values, 0.0), np.append(steps, 1.0)
    log_likelihood = sensor.log_likelihood(values, mean)
    assert sensor.entropy(mean) == pytest.approx(
        -float(steps @ (np.exp(log_likelihood) * log_likelihood)), abs=2e-5
    )


@pytest.mark.parametrize("mean", MEANS)
def test_the_gaussian_likelihood_is_the_density_of_its_readings(mean: float) -> None:
    readings = GAUSSIAN.measure(np.full(DRAWS, mean), np.random.default_rng(2))
    # The Kolmogorov distribution exceeds 2.0 with probability 1/1,500.
    assert kolmogorov_smirnov(readings, GAUSSIAN, mean, mean - 40, mean + 40) < 2.0


@pytest.mark.parametrize("mean", MEANS)
def test_the_threshold_likelihood_is_the_density_of_its_readings(mean: float) -> None:
    sensor = Threshold(threshold=0.5, missed=0.3)
    readings = sensor.measure(np.full(DRAWS, mean), np.random.default_rng(3))
    silent = float(np.exp(sensor.log_likelihood(0.0, mean)))
    share = float(np.mean(readings == 0.0))
    assert share == pytest.approx(
        silent, abs=4 * math.sqrt(silent * (1 - silent) / DRAWS)
    )  # 4 standard deviations
    heard = readings[readings > 0]
    assert heard.min() >= 0.5
    assert kolmogorov_smirnov(heard, sensor, mean, 0.5, mean + 40) < 2.0


@pytest.mark.parametrize("mean", MEANS)
def test_the_likelihood_of_hits_is_the_frequency_of_its_counts(mean: float) -> None:
    sensor = Hits(efficiency=3.0, background=0.1)
    counts = np.bincount(
        sensor.measure(np.full(DRAWS, mean), np.random.default_rng(4)).astype(int), minlength=100
    )
    probability = np.exp(sensor.log_likelihood(np.arange(len(counts)), mean))
    often = probability * DRAWS > 10
    chi_square = np.sum((counts[often] - DRAWS * probability[often]) ** 2 / (DRAWS * probability[often]))
    degrees = int(often.sum())
    assert chi_square < degrees + 4 * math.sqrt(2 * degrees)  # 4 standard deviations above its mean


@pytest.mark.parametrize("mean", MEANS)
@pytest.mark.parametrize(
    "sensor", [GAUSSIAN, Gaussian(0.1, 1.0), Threshold(), Threshold(0.2, 0.0), Hits(), Hits(0.5, 2.0)]
)
def test_every_likelihood_sums_to_one(sensor: Sensor, mean: float) -> None:
    if isinstance(sensor, Hits):
        total = np.exp(sensor.log_likelihood(np.arange(500), mean)).sum()
    elif isinstance(sensor, Threshold):
        readings = np.linspace(sensor.threshold, 80.0, 2_000_001)
        total = np.exp(sensor.log_likelihood(0.0, mean)) + np.trapezoid(
            np.exp(sensor.log_likelihood(readings, mean)), readings
        )
    else:
        readings = np.linspace(-60.0, 80.0, 2_000_001)
        total = np.trapezoid(np.exp(sensor.log_likelihood(readings, mean)), readings)
    assert total == pytest.approx(1.0, abs=1e-8)


def test_the_likelihoods_equal_hand_worked_values() -> None:
    # m = 2, z = 3: σ² = 0.36 + 0.04 = 0.4;  log p = −1/0.8 − ½ log(0.4) − ½ log(2π) = −1.25 + 0.4581454 −
    # 0.9189385
    assert GAUSSIAN.log_likelihood(3.0, 2.0) == pytest.approx(-1.7107932, abs=1e-7)
    assert GAUSSIAN.noise_std(2.0) == pytest.approx(math.sqrt(0.4))
    # The same reading, not missed: plus log 0.7.  P(0) at m = 0.5, the threshold: 0.3 + 0.7 · ½ = 0.65
    assert Threshold(0.5, 0.3).log_likelihood(3.0, 2.0) == pytest.approx(-1.7107932 + math.log(0.7), abs=1e-7)
    assert Threshold(0.5, 0.3).log_likelihood(0.0, 0.5) == pytest.approx(math.log(0.65))
    # μ = 3 · 0.5 + 0.5 = 2, k = 3: e⁻² 2³/3! = 0.1804470
    assert Hits(3.0, 0.5).log_likelihood(3.0, 0.5) == pytest.approx(math.log(0.1804470), abs=1e-6)


@pytest.mark.parametrize(
    ("sensor", "allowed", "refused"),
    [
        (
            GAUSSIAN,
            [-6.2, 0.0, 5.0, 12.2],
            [-6.3, 12.3, 1e3, 3e38],
        ),  # 3 ± 10 sqrt((0.3 · 3)² + 0.2²) = 3 ± 9.22
        (Threshold(0.5), [0.0, 0.5, 5.0], [0.3, -0.1, 1e3]),
        (Hits(), [0.0, 1.0, 20.0], [-1.0, 0.5, 1e3, 3e38]),
    ],
    ids=["gaussian", "threshold", "hits"],
)
def test_a_reading_that_the_sensor_cannot_have_given_is_refused(
    sensor: Sensor, allowed: list[float], refused: list[float]
) -> None:
    assert [sensor.refusal(gas, 3.0) for gas in allowed] == [None] * len(allowed)
    assert all("absurd" in str(sensor.refusal(gas, 3.0)) for gas in refused)


def test_no_reading_of_strong_gas_is_refused_as_noise_that_cannot_be() -> None:
    """Close to a strong source a reading below 0 is rare but genuine."""
    readings = GAUSSIAN.measure(np.full(100_000, 40.0), np.random.default_rng(6))
    assert readings.min() < -5.0  # 10 β is 2
    assert all(GAUSSIAN.refusal(float(gas), 50.0) is None for gas in readings)


def test_a_threshold_that_is_no_float32_still_admits_its_own_readings() -> None:
    sensor = Threshold(threshold=0.7)
    readings = sensor.measure(np.full(20_000, 0.7), np.random.default_rng(5)).astype(np.float32)
    assert all(sensor.refusal(float(gas), 5.0) is None for gas in (*readings, np.float32(0.7)))


@pytest.mark.parametrize("sensor", [GAUSSIAN, Gaussian(0.1, 1.0), Threshold(0.1, 0.25), Hits(2.0)])
def test_a_sensors_text_reads_back_as_the_sensor(sensor: Sensor) -> None:
    assert parse(text(sensor)) == sensor


def test_a_sensors_name_alone_means_its_defaults() -> None:
    assert (parse("gaussian"), parse("threshold"), parse("hits:2")) == (Gaussian(), Threshold(), Hits(2.0))


@pytest.mark.parametrize(
    "bad",
    [
        "",
        "laser",
        "hits:0",
        "hits:1,2,3",
        "hits:x",
        "gaussian:0.3,0",
        "threshold:0.5,1",
        "threshold:nan",
        "gaussian:inf,1",
    ],
)
def test_a_bad_sensor_is_named_with_what_is_allowed(bad: str) -> None:
    with pytest.raises(ValueError, match="is not allowed"):
        parse(bad)


@pytest.mark.parametrize(
    ("noisiest", "beyond"),
    [
        ("gaussian:1000,1e10", "gaussian:1001"),
        ("threshold:0.5,0,1000,1e10", "threshold:0.5,0,0.3,1.1e10"),
        ("hits:3,1e10", "hits:3,1.1e10"),
        ("pid:1000,1e10,saturation=1e12", "pid:0.1,1.1e10"),
    ],
)
def test_the_noisiest_sensor_reads_what_a_belief_may_be_about(noisiest: str, beyond: str) -> None:
    """Else a flight with it would end because the agent takes no such belief."""
    readings = parse(noisiest).measure(np.full(DRAWS, 1e6), np.random.default_rng(7))
    assert np.abs(readings).max() < MOST
    with pytest.raises(ValueError, match=r"wanted a number from \S+ to "):
        parse(beyond)
