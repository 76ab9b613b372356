"""Protects the sensors in time: how their elements follow the gas, what they read in it, and their names."""

import math
import re

import numpy as np
import pytest

from plume.sensors.instruments import INSTRUMENTS, METHANE_PPM
from plume.sensors.names import Sensor, parse, text
from plume.worlds.exposure import met


def after(sensor: str, start: float, gas: list[float], seconds: float) -> float:
    instrument = INSTRUMENTS[sensor]
    return instrument.follow(start, np.array(gas), np.full(len(gas), seconds))


def test_a_reading_is_63_percent_of_a_step_after_one_time_constant() -> None:
    assert after("pid", 0.0, [2.0], 1.3) == pytest.approx(2.0 * (1 - math.exp(-1)))
    assert after("pid", 2.0, [0.0], 1.3) == pytest.approx(2.0 * math.exp(-1))


def test_a_metal_oxide_rises_with_a_falling_resistance_and_decays_with_a_growing_one() -> None:
    assert after("tgs2620", 21.0, [3.0], 2.96) == pytest.approx(3.0 + 18.0 * math.exp(-1))
    assert after("tgs2620", 3.0, [21.0], 15.71) == pytest.approx(21.0 - 18.0 * math.exp(-1))


def test_a_ramp_is_followed_as_by_small_steps_of_euler() -> None:
    gas = np.linspace(0.0, 4.0, 400)
    value, step = 0.0, 1e-5
    for target in gas:
        for _ in range(1000):
            value += (target - value) / 1.3 * step
    assert after("pid", 0.0, gas.tolist(), 0.01) == pytest.approx(value, rel=1e-4)


def test_it_does_not_matter_how_a_time_in_steady_gas_is_parted() -> None:
    assert after("tgs2600", 1.0, [0.6] * 7, 0.5) == pytest.approx(
        after("tgs2600", 1.0, [0.6], 3.5), rel=1e-12
    )


@pytest.mark.parametrize(("sensor", "ppm", "ratio"), [("tgs2620", 1000, 4.1556), ("tgs2611", 5000, 0.9974)])
def test_a_metal_oxide_reads_the_line_of_its_data_sheet(sensor: str, ppm: float, ratio: float) -> None:
    line = {"tgs2620": 120.6 * ppm**-0.4877, "tgs2611": 38.46 * ppm**-0.4289}[sensor]
    assert line == pytest.approx(ratio, rel=1e-3)
    assert float(INSTRUMENTS[sensor].settled(ppm * METHANE_PPM)) == pytest.approx(line, rel=1e-9)


@pytest.mark.parametrize(("sensor", "air"), [("tgs2600", 1.0), ("tgs2611", 8.8), ("tgs2620", 21.0)])
def test_a_metal_oxide_never_reads_more_than_in_clean_air(sensor: str, air: float) -> None:
    assert INSTRUMENTS[sensor].settled([0.0, 1e-9]).tolist() == [air, air]


@pytest.mark.parametrize(
    ("sensor", "aim", "length"),
    [
        ("tdlas", (0.0, 0.0, -1.0), 5.0),
        ("tdlas:pitch=0,azimuth=90", (1.0, 0.0, 0.0), 5.0),
        ("tdlas:pitch=-30,azimuth=60,ray=8", (0.75, math.sqrt(3) / 4, -0.5), 8.0),
    ],
    ids=["down", "east", "slanting"],
)
@pytest.mark.parametrize("away", [(-0.2, 0.0), (-3.0, 0.3), (-3.0, -2.0), (4.0, 4.0)])
def test_gas_is_summed_along_a_ray(
    sensor: str, aim: tuple[float, float, float], length: float, away: tuple[float, float]
) -> None:
    """The source is at the origin, the vehicle in its plane."""
    from scipy.integrate import quad

    def gas(along: float) -> float:
        r = max(math.dist((*away, 0.0), [-along * part for part in aim]), 0.1)
        return math.exp(-r / 4.0) / r

    def air(places: np.ndarray, _times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r = np.maximum(np.linalg.norm(places, axis=1), 0.1)
        return np.exp(-r / 4.0) / r, np.zeros((len(r), 2))

    summed = met(air, parse(sensor), 1.0, away, 30.0, None)
    expected = quad(gas, 0.0, length, points=[length / 2, min(math.hypot(*away), length)], limit=200)[0]
    assert summed == pytest.approx(expected, rel=5e-3)  # places half a source's radius apart


def test_a_reading_at_saturation_has_the_probability_of_all_beyond() -> None:
    from scipy.integrate import quad

    sensor = parse("pid:saturation=5")
    wide = parse("pid:saturation=1e12")
    beyond = quad(lambda z: math.exp(float(wide.log_likelihood(z, 4.8))), 5.0, 12.0)[0]
    assert float(sensor.log_likelihood(5.0, 4.8)) == pytest.approx(math.log(beyond))
    assert float(sensor.log_likelihood(4.0, 4.8)) == float(wide.log_likelihood(4.0, 4.8))


def test_a_sensor_is_stuck_that_repeats_itself_below_its_saturation_only() -> None:
    sensor = INSTRUMENTS["pid"]
    assert sensor.is_noisy(1.0)
    assert not sensor.is_noisy(float(np.float32(sensor.saturation)))


def test_what_no_gas_can_make_it_read_is_refused() -> None:
    assert INSTRUMENTS["pid"].refusal(9.4, 50.0) == "gas 9.4 is absurd; the sensor saturates at 9.33028"
    assert INSTRUMENTS["tgs2620"].refusal(21.5, 50.0) is None
    assert INSTRUMENTS["tgs2620"].refusal(40.0, 50.0) == "gas 40 is absurd; allowed is -0.1 to 27.3008"
    # All of the ray at the surface of the source: 50 · 2 · 0.1 asinh(5/0.1) = 46 g/m², and noise of 10 · 4.6
    assert INSTRUMENTS["tdlas"].refusal(33.0, 50.0) is None


@pytest.mark.parametrize(
    "said",
    [
        "pid",
        "tdlas:ray=20.0,pitch=-45.0,azimuth=90.0",
        "tgs2620:dwell=10.0,drift=0.0",
        "gaussian:0.3,0.2,dwell=2.0",
        "hits:3.0,0.1,dwell=1.0",
    ],
)
def test_the_text_of_a_sensor_reads_back(said: str) -> None:
    assert text(parse(said)) == said
    assert parse(text(parse(said))) == parse(said)


def test_the_first_numbers_need_no_name() -> None:
    assert parse("pid:0.2,0.1,dwell=3") == parse("pid:dwell=3,environment_noise=0.1,sensor_noise=0.2")
    given: Sensor = parse("threshold:0.6,missed=0.1")
    assert text(given) == "threshold:0.6,0.1,0.3,0.2"


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ("pid:dwell=-1", "dwell is -1, wanted a number from 0 to 600"),
        ("pid:dwell=nan", "dwell is nan, wanted a number from 0 to 600"),
        ("pid:rate=0", "rate is 0, wanted a number from 0.1 to 100"),
        ("pid:ray=5", "wanted pid or pid:sensor_noise,environment_noise,cv,dwell=…,rise=…"),
        ("tgs2620:cv=1", "wanted tgs2620 or tgs2620:sensor_noise,environment_noise,dwell=…"),
        ("tgs2620:power=1", "power is 1, wanted a number from -10 to -0.001"),
        ("gaussian:0.3,0.2,0,5", "wanted gaussian or gaussian:sensor_noise,environment_noise,cv,dwell=…"),
        ("gaussian:cv=1,cv=1", "wanted gaussian or"),
        ("pid:dwell=1,0.2", "wanted pid or pid:"),
        ("mox", "wanted gaussian, threshold, hits, pid, tgs2600, tgs2611, tgs2620, tdlas"),
    ],
)
def test_a_sensor_that_is_not_allowed_is_refused_in_one_line(said: str, why: str) -> None:
    with pytest.raises(ValueError, match=re.escape(why)) as caught:
        parse(said)
    assert "\n" not in str(caught.value)
