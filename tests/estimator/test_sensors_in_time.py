"""Protects the likelihood of sensors in time: it is that of the element's differential equation, and the filter
finds the posterior that a grid gives.
"""

import math

import numpy as np
import pytest

from estimator.filter import Config, assimilate, prior
from estimator.kernels.checks import log_likelihood_of_one_value
from estimator.kernels.densities import log_likelihoods
from estimator.priors import Fixed, Prior
from link.bus.mavlink import Reading
from plume.sensors.instruments import INSTRUMENTS, METHANE_PPM
from plume.sensors.names import parse, sensor_row
from tests.estimator.test_kernels import of_puffs

WIND = (1.5, -0.5)
RATE, DIFFUSIVITY, LIFETIME = 250.0, 3.0, 10.0
SOURCE = (15.0, 12.0)
LEG_S = 2 * math.sqrt(1 / 3)  # of 1 m, from rest to rest at 3 m/s²


def log_normal_density(value: float, mean: float, slope: float, floor: float) -> float:
    """By hand: log N(value; mean, (slope · mean)² + floor²)."""
    variance = (slope * mean) ** 2 + floor**2
    return -0.5 * ((value - mean) ** 2 / variance + math.log(2 * math.pi * variance))


def gas(x: float, y: float, source: tuple[float, float] = SOURCE) -> float:
    """Vergassola et al. 2007, eq. (S5), in plain arithmetic, g/m³."""
    return spread(x - source[0], y - source[1], 0.0)


def spread(east: float, north: float, depth: float) -> float:
    u = math.hypot(*WIND)
    r = math.hypot(east, north, depth)
    length = math.sqrt(DIFFUSIVITY * LIFETIME / (1 + u * u * LIFETIME / (4 * DIFFUSIVITY)))
    along = (east * WIND[0] + north * WIND[1]) / (2 * DIFFUSIVITY)
    return RATE / (4 * math.pi * DIFFUSIVITY * r) * math.exp(-r / length - along)


def of_the_source(sensor: str, *readings: tuple[float, float, float]) -> float:
    """The log-likelihood that the filter gives the last of readings (x, y, gas) for the true source."""
    config = Config(rate=RATE, diffusivity=DIFFUSIVITY, lifetime=LIFETIME, sensor=parse(sensor))
    row = None
    for step, (x, y, value) in enumerate(readings):
        row = config.row(Reading(step, (x, y), 5.0, WIND, value), row)
    assert row is not None
    return float(log_likelihoods(np.array(SOURCE)[:, None], config.model, row)[0])


def test_a_photoionisation_detector_is_between_its_last_reading_and_the_gas() -> None:
    first, then = (18.0, 12.0), (17.0, 12.0)
    value, steps = 0.4, 4000  # of the reading before
    for k in range(steps):
        t = (k + 0.5) / steps * LEG_S
        share = 0.5 * 3 * t * t if t < LEG_S / 2 else 1 - 0.5 * 3 * (LEG_S - t) ** 2
        value += (gas(first[0] - share, first[1]) - value) * LEG_S / steps / 1.3
    value = gas(*then) + (value - gas(*then)) * math.exp(-2.0 / 1.3)
    expected = log_normal_density(1.0, value, 0.1, 0.2)
    assert of_the_source("pid", (*first, 0.4), (*then, 1.0)) == pytest.approx(expected, abs=2e-3)


def test_a_metal_oxide_rises_fast_and_decays_slowly() -> None:
    def ratio(x: float) -> float:
        return min(21.0, 120.6 * (gas(x, 12.0) / METHANE_PPM) ** -0.4877)

    for first, then, before, tau in ((19.0, 18.0, 20.0, 2.96), (18.0, 19.0, 1.0, 15.71)):
        value, steps = before, 4000
        for k in range(steps):
            t = (k + 0.5) / steps * LEG_S
            share = 0.5 * 3 * t * t if t < LEG_S / 2 else 1 - 0.5 * 3 * (LEG_S - t) ** 2
            value += (ratio(first + share * (then - first)) - value) * LEG_S / steps / tau
        value = ratio(then) + (value - ratio(then)) * math.exp(-5.0 / tau)
        expected = log_normal_density(value + 0.1, value, 0.03, 0.01)
        said = of_the_source("tgs2620", (first, 12.0, before), (then, 12.0, value + 0.1))
        assert said == pytest.approx(expected, abs=2e-2)


def test_the_first_reading_follows_clean_air() -> None:
    value = gas(17.0, 12.0) * (1 - math.exp(-2.0 / 1.3))
    expected = log_normal_density(1.0, value, 0.1, 0.2)
    assert of_the_source("pid", (17.0, 12.0, 1.0)) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("sensor", "aim", "length"),
    [
        ("tdlas", (0.0, 0.0, -1.0), 5.0),
        ("tdlas:pitch=0,azimuth=270,ray=10", (-1.0, 0.0, 0.0), 10.0),
        ("tdlas:pitch=-30,azimuth=240", (-0.75, -math.sqrt(3) / 4, -0.5), 5.0),
    ],
    ids=["down", "west", "slanting"],
)
@pytest.mark.parametrize("away", [(0.3, 0.4), (1.0, 0.8), (5.0, -2.0), (13.0, 4.0), (-6.0, 0.5)])
def test_an_open_path_sums_the_gas_along_its_ray(
    sensor: str, aim: tuple[float, float, float], length: float, away: tuple[float, float]
) -> None:
    from scipy.integrate import quad

    def met(along: float) -> float:
        return spread(away[0] + along * aim[0], away[1] + along * aim[1], along * aim[2])

    nearest = min(max(-away[0] * aim[0] - away[1] * aim[1], 0.0), length)
    column = quad(met, 0.0, length, points=[nearest], limit=200)[0]
    expected = log_normal_density(1.1 * column, column, 0.1, 0.2)
    place = (SOURCE[0] + away[0], SOURCE[1] + away[1])
    assert of_the_source(sensor, (*place, 1.1 * column)) == pytest.approx(expected, abs=5e-3)


def test_a_saturated_reading_has_the_probability_of_all_beyond() -> None:
    limit = float(np.float32(INSTRUMENTS["pid"].saturation))
    value = gas(15.4, 12.0) * (1 - math.exp(-2.0 / 1.3))
    std = math.sqrt((0.1 * value) ** 2 + 0.2**2)
    beyond = 0.5 * math.erfc((limit - value) / std / math.sqrt(2))
    assert of_the_source("pid", (15.4, 12.0, limit)) == pytest.approx(math.log(beyond), abs=1e-3)


def densities_of_the_source(
    sensor: str, priors: dict[str, Prior], place: tuple[float, float], values: np.ndarray
) -> np.ndarray:
    """Those of values (Z,) at a place, one step after a reading of 3 at another; where the sensor is saturated,
    the probability.
    """
    config = Config(
        rate=RATE, diffusivity=DIFFUSIVITY, lifetime=LIFETIME, sensor=parse(sensor), priors=priors
    )
    row = config.row(Reading(0, (14.0, 12.0), 5.0, WIND, 3.0), None)
    row = config.row(Reading(1, place, 5.0, WIND, 1.0), row)
    result = np.empty(len(values))
    for i, value in enumerate(values.tolist()):
        row[5] = value
        result[i] = log_likelihoods(np.array(SOURCE)[:, None], config.model, row)[0]
    return np.exp(result)


@pytest.mark.parametrize("sensor", ["pid", "pid:rise=0,decay=0", "tdlas"])
@pytest.mark.parametrize(
    "priors",
    [
        {"cv": Fixed(1.0)},
        {"cv": Fixed(0.5), "puff-rate": Fixed(20.0)},
        {"cv": Fixed(0.0), "puff-rate": Fixed(3.0)},
    ],
    ids=["even", "both", "puffs"],
)
@pytest.mark.parametrize("place", [(15.4, 12.0), (14.0, 13.0)])
def test_in_intermittent_gas_readings_below_saturation_and_beyond_are_one_in_all(
    sensor: str, priors: dict[str, Prior], place: tuple[float, float]
) -> None:
    limit = float(np.float32(INSTRUMENTS[sensor.partition(":")[0]].saturation))
    values = np.append(np.linspace(-6.0, limit - 1e-6, 3001), limit)
    *below, beyond = densities_of_the_source(sensor, priors, place, values)
    assert beyond > 0.01
    # The probability beyond is summed over shares of the gas, and right to about 0.01.
    assert np.trapezoid(below, values[:-1]) + beyond == pytest.approx(1.0, abs=0.015)


@pytest.mark.parametrize(("cv", "rate"), [(1.0, math.inf), (0.5, 20.0), (0.0, 3.0)])
def test_of_a_sensor_that_lags_only_fresh_gas_is_intermittent(cv: float, rate: float) -> None:
    """The mean and the variance of a reading: what is left of the one before keeps."""
    priors: dict[str, Prior] = {"cv": Fixed(cv), "puff-rate": Fixed(rate), "puff-share": Fixed(0.2)}
    values = np.concatenate([np.linspace(-6.0, 20.0, 4001), np.geomspace(20.0, 3000.0, 3001)[1:]])
    fresh = gas(14.0, 13.0) * (1 - math.exp(-2.0 / 1.3))
    steady = densities_of_the_source("pid:saturation=1e6", {"noise": Fixed(1.0)}, (14.0, 13.0), values)
    older = float(np.trapezoid(values * steady, values)) - fresh
    density = densities_of_the_source("pid:saturation=1e6", priors, (14.0, 13.0), values)
    assert np.trapezoid(density, values) == pytest.approx(1.0, abs=0.002)
    mean = float(np.trapezoid(values * density, values))
    assert mean == pytest.approx(older + fresh, rel=0.003)
    # The square of the gas's cv: cv² and Campbell's variance of puffs (test_kernels.py).
    config = Config(rate=RATE, diffusivity=DIFFUSIVITY, lifetime=LIFETIME)
    puffs = of_puffs(
        config, {"puff-share": 0.2, "puff-rate": rate}, np.array([-1.0, 1.0, 0.0]), np.array(WIND)
    )
    square = cv**2 + float(puffs)
    blank = 0.4 * square / (1 + square)
    # The noise is 0.1 of all gas that is there; of a blank, of the mean.
    noise = (1 - blank) * older**2 + 2 * older * fresh + (1 + square) * fresh**2 + blank * mean**2
    variance = square * fresh**2 + 0.01 * noise + 0.04
    found = np.trapezoid((values - mean) ** 2 * density, values)
    assert found == pytest.approx(variance, rel=0.01)


def test_readings_at_saturation_are_no_value_that_a_faulty_sensor_repeats() -> None:
    limit = float(np.float32(INSTRUMENTS["pid"].saturation))
    gas = [0.3, 0.1, 0.7, 0.4, *[limit] * 12]
    readings = np.array([(20.0, 12.0, 0.0, *WIND, value, 1.0, 20.0, 12.0, limit, 1.0) for value in gas])
    readings[:4, 9] = 0.0, 0.3, 0.1, 0.7
    kept = math.exp(-(1.0 + 2.0) / 1.3)
    fits = []
    for rest in (np.array(gas[:4]), np.array(gas[:4]) - kept * readings[:4, 9]):
        normal = -4 * (math.log(rest.std()) + 0.5 * math.log(2 * math.pi) + 0.5)
        fits.append(normal + 4 * math.log(4 / 16) + 12 * math.log(12 / 16))
    found = log_likelihood_of_one_value(readings, sensor_row(INSTRUMENTS["pid"]), 0.0)
    assert found == pytest.approx(max(fits), rel=1e-9)


def test_the_filter_finds_the_posterior_of_a_grid_with_a_sensor_that_lags() -> None:
    config = Config(4000, rate=RATE, diffusivity=DIFFUSIVITY, lifetime=LIFETIME, sensor=parse("pid"))
    posterior, row = prior(config), None
    cells = (np.arange(300) + 0.5) / 10
    grid = np.stack(np.meshgrid(cells, cells)).reshape(2, -1)
    total, value = np.zeros(grid.shape[1]), 0.0
    for step in range(12):
        place = (22.0 - 0.5 * step, 11.0 + 0.25 * (step % 3))
        value = float(np.float32(value + (gas(*place) - value) * 0.8))
        reading = Reading(step, place, 5.0, WIND, value)
        posterior = assimilate(posterior, reading, config)
        row = config.row(reading, row)
        total += log_likelihoods(grid, config.model, row)
    shares = np.exp(total - total.max())
    shares /= shares.sum()
    mean = grid @ shares
    std = np.sqrt(np.square(grid - mean[:, None]) @ shares)
    weights = posterior.weights / posterior.weights.sum()
    assert posterior.particles @ weights == pytest.approx(mean, abs=0.1 * float(std.max()))
    found = np.sqrt(np.square(posterior.particles - mean[:, None]) @ weights)
    assert found == pytest.approx(std, rel=0.12)
