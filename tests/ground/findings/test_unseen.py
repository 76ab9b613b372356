"""Protects the smallest rates that a flight would have seen: the physics is the estimator's, and of sources of
such a rate, drawn by other code, nine in ten are seen.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.kernels.spikes import spike_density as kernel_of_spikes
from ground.findings.flight import Flight
from ground.findings.page import sentence
from ground.findings.unseen import CLEAR, Smallest, Supposed, smallest_rate, smallest_rates, spike_density
from ground.findings.verdict import NOT_FOUND, Judgement
from ground.findings.words import smallest_text
from plume.dispersion import concentration
from plume.parameters import KNOWN, MEASURED, NEUTRAL, PARAMETERS
from plume.problem import AREA
from plume.sensors.names import GAUSSIAN, KINDS, parse, sensor_row
from plume.sensors.response import settled_readings
from tests.ground.findings.records import FOUND, GOLDEN, findings

SOURCE = (14.0, 17.0)


def flight(record: str = "") -> Flight:
    return findings(GOLDEN / f"{record}.mcap" if record else FOUND).flight


def crosswind(count: int = 30) -> Flight:
    """A flight across the wind, 4 m downwind of SOURCE, whose wind, lifetime and noise are known."""
    known = flight("homing-gaussian")
    sample = known.samples[0]
    places = [(8.0 + 0.4 * step, SOURCE[1] - 4.0) for step in range(count)]
    samples = [sample._replace(step=step, place=place, wind=(0.0, 2.0)) for step, place in enumerate(places)]
    return known._replace(samples=samples)


@pytest.mark.parametrize("name", KINDS)
def test_the_mean_readings_are_those_that_the_estimator_predicts(name: str) -> None:
    of, sensor = crosswind(), parse(name)
    supposed = Supposed(of, sensor, 0.0, 3)
    rows = np.zeros((len(PARAMETERS), 5))
    known = {**NEUTRAL, "cv": 0.0, "z": 0.0, "q": 200.0, "d": of.last.diffusivity, "tau": of.last.lifetime}
    for index, parameter in enumerate(PARAMETERS):
        rows[index] = (
            (MEASURED, 0, 0, 0, 0)
            if parameter in ("u", "phi")
            else (KNOWN, known.get(parameter, 0.0), 0, 0, 0)
        )
    rows[0, 0] = rows[1, 0] = 1.0
    readings = np.array([[*it.place, 0.0, *it.wind] for it in of.samples])
    wanted = settled_readings(
        np.array([[SOURCE[0]], [SOURCE[1]]]), np.array([0, 1]), rows, readings, sensor_row(sensor)
    )
    means = supposed.at(SOURCE).means(200.0)
    assert means[:, 0] == pytest.approx(wanted[:, 0], rel=2e-3)


@pytest.mark.parametrize("name", ["gaussian", "hits", "threshold", "tgs2620"])
def test_spikes_are_the_estimators(name: str) -> None:
    sensor = parse(name)
    values = np.array([0.0, 1.0, 2.0, 7.0, 60.0])
    wanted = [kernel_of_spikes(value, sensor_row(sensor)) for value in values.tolist()]
    assert spike_density(values, sensor) == pytest.approx(wanted, rel=1e-9)


def test_of_sources_of_the_smallest_rate_nine_in_ten_are_seen() -> None:
    """Their readings are drawn by the plume's definition and the sensor itself."""
    of, rng = crosswind(), np.random.default_rng(11)
    places = np.array([it.place for it in of.samples])
    seen = []
    for x, y in [(14.0, 17.0), (11.0, 16.0), (17.0, 20.0), (14.0, 14.0), (10.0, 24.0), (19.0, 15.0)]:
        rate = smallest_rate(Supposed(of, GAUSSIAN, 0.05, 400), (x, y))
        assert math.isfinite(rate)
        known = {"rate": rate, "diffusivity": of.last.diffusivity, "lifetime": of.last.lifetime}
        means = concentration(places, (x, y), (0.0, 2.0), **known)
        draws = np.stack([GAUSSIAN.measure(means, rng) for _ in range(400)], axis=1)
        other = Supposed(of, GAUSSIAN, 0.05, 400, seed=5).at((x, y))
        seen.append((other.advantages(draws, rate) >= CLEAR).mean())
    assert np.mean(seen) == pytest.approx(0.9, abs=0.04)


def test_a_weaker_source_is_seen_less_often_and_clean_air_hardly_ever() -> None:
    at = Supposed(crosswind(), GAUSSIAN, 0.05, 400).at(SOURCE)
    rate = smallest_rate(Supposed(crosswind(), GAUSSIAN, 0.05, 400), SOURCE)
    assert at.share_seen(rate / 2) < 0.75
    assert at.share_seen(3 * rate) > 0.98
    clean = np.random.default_rng(3).normal(0.0, 0.2, (30, 400))
    assert (at.advantages(clean, rate) >= CLEAR).mean() < 0.02  # 5 nats: at most 1 in 148


def test_upwind_of_the_track_little_is_needed_and_downwind_much() -> None:
    supposed = Supposed(crosswind(), GAUSSIAN, 0.05, 200)
    assert smallest_rate(supposed, (14.0, 15.0)) < 0.1 * smallest_rate(supposed, (14.0, 8.0))


def test_more_readings_see_weaker_sources() -> None:
    few, many = (smallest_rate(Supposed(crosswind(n), GAUSSIAN, 0.05, 200), SOURCE) for n in (20, 30))
    assert many < few


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", KINDS)
def test_there_is_a_map_for_every_sensor(name: str) -> None:
    it = findings()
    found = smallest_rates(crosswind(), it.told._replace(sensor=parse(name)), AREA, flights=20)
    assert found
    assert found.rates_gs.shape == (15, 15)
    assert np.isfinite(found.rates_gs).any()
    assert (found.rates_gs > 0).all()


def cells(*rates: float) -> Smallest:
    """Return a map of 225 cells with these rates; the others see none."""
    values = np.full(225, math.inf)
    values[: len(rates)] = rates
    return Smallest(AREA, values.reshape(15, 15), 1)


def test_the_median_rate_suffices_in_half_of_the_area_and_is_null_where_that_sees_none() -> None:
    few = cells(*range(1, 50))
    told = few.as_json(lambda place: None)
    assert (told["least_gs"], told["median_gs"], told["greatest_gs"]) == (1, None, 49)
    assert "or less" not in sentence(replace(findings(), smallest=few, verdict=Judgement(NOT_FOUND, "None.")))
    most = cells(*range(1, 201))
    assert most.as_json(lambda place: None)["median_gs"] == 113  # 112 below, 112 above or none
    said = sentence(replace(findings(), smallest=most, verdict=Judgement(NOT_FOUND, "None.")))
    assert "; in half of the area 110 g/s (410 kg/h) or less." in said
    assert "In 11% of the area no rate would have been seen." in said
    for seen, share in ((224, "0.4%"), (1, "99.6%")):  # 1/225 and 224/225
        nearly = replace(findings(), smallest=cells(*range(1, seen + 1)))
        assert f"In {share} of the area no rate would have been seen." in smallest_text(nearly)


@pytest.mark.full
def test_a_long_flight_is_thinned_and_says_so() -> None:
    of, it = crosswind(), findings()
    long = of._replace(samples=of.samples * 400)
    found = smallest_rates(long, it.told, AREA, flights=2)
    assert found
    assert found.every == 3
