"""What a flight that found nothing would have seen: the smallest release rate, place by place.

By the likelihood: at each place a source of some rate is supposed, and the readings that it would have given
along the flown track are simulated, with wind, lifetime, noise and intermittency as the last belief has them.
A source counts as seen if these readings are more probable with it than in clean air by CLEAR nats, the limit
that the estimator has for a stop. The smallest rate is that at which 90% of the simulated flights see it. The
track stays as it was: a search would have turned towards the gas.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ground.findings.assumed import Told
from ground.findings.flight import Flight
from ground.findings.verdict import CLEAR
from plume.dispersion import SOURCE_RADIUS_M, concentration
from plume.parameters import BLANK, LIMITS, NEUTRAL
from plume.problem import Area
from plume.sensors.instruments import Instrument
from plume.sensors.names import Sensor
from plume.sensors.sensor import Gaussian, Hits, Threshold
from scene.scene import Point

Array = NDArray[np.float64]
Place = Sequence[float]
Watch = Callable[[Sequence[Point]], Iterable[Point]]  # gives places one by one, and may say how far it is
PROBABILITY = 0.9
CELLS = 15  # along a side of the area
FLIGHTS = 200  # simulated for each place
HALVINGS = 14  # of the logarithm of the rate's range: to 0.2%
RATES = 1e-3, LIMITS["q"][1]  # g/s; a place that needs more is not seen
MOST_READINGS = 5000  # of longer flights every n-th reading counts, which makes the rates too great
SPIKE_SIZE = 7.0  # as `estimator/kernels/spikes.py` has it
RAY_NODES = 16
GREATEST_SQUARE = 9.0  # of a coefficient of variation: of stronger gas hardly a reading has any
SMALLEST = 1e-300


class Smallest(NamedTuple):
    """The smallest rates over the area."""

    area: Area
    rates_gs: Array  # (CELLS, CELLS), by y, then x; infinite where no rate would have been seen
    every: int  # every so manyth reading counted

    @property
    def seen(self) -> Array:
        """The finite rates."""
        return self.rates_gs[np.isfinite(self.rates_gs)]

    @property
    def cell_m(self) -> tuple[float, float]:
        """Width and height of a cell."""
        width_m, height_m = self.area.size_m
        return width_m / CELLS, height_m / CELLS

    def cells(self) -> Iterator[tuple[Point, float]]:
        """Yield the middle of each cell, (x, y) m, and its rate, g/s."""
        yield from zip(middles(self.area), self.rates_gs.ravel().tolist(), strict=True)

    def as_json(self, on_earth: Callable[[Place], tuple[float, float] | None]) -> dict[str, Any]:
        """Return it as JSON-able values; places have latitude and longitude if they are known."""
        cells = []
        for (x, y), rate in self.cells():
            place = on_earth((x, y)) or (None, None)
            cells.append(
                {
                    "x_m": x,
                    "y_m": y,
                    "latitude_deg": place[0],
                    "longitude_deg": place[1],
                    "rate_gs": rate if math.isfinite(rate) else None,
                }
            )
        seen, median = self.seen, float(np.median(self.rates_gs))
        return {
            "probability": PROBABILITY,
            "method": METHOD,
            "cell_m": self.cell_m,
            "share_of_the_area_seen": len(seen) / self.rates_gs.size,
            "least_gs": float(seen.min()) if len(seen) else None,
            "median_gs": median if math.isfinite(median) else None,  # of all cells
            "greatest_gs": float(seen.max()) if len(seen) else None,
            "cells": cells,
        }


METHOD = (
    f"by the likelihood: {FLIGHTS} flights along the flown track simulated for each place; a source counts "
    f"as seen if the readings are more probable with it than in clean air by {CLEAR:g} nats"
)


def smallest_rates(
    flight: Flight, told: Told, area: Area, flights: int = FLIGHTS, watch: Watch = iter
) -> Smallest | None:
    """Return the smallest rates that a flight would have seen; None for a sensor that is not known.

    Of thousands of readings it takes minutes: `watch` gives the places in their order.
    """
    if told.sensor is None:
        return None
    every = -(-len(flight.samples) // MOST_READINGS)
    supposed = Supposed(flight, told.sensor, told.spikes, flights, every)
    rates = np.array([smallest_rate(supposed, place) for place in watch(middles(area))])
    return Smallest(area, rates.reshape(CELLS, CELLS), every)


def middles(area: Area) -> list[Point]:
    """Return the middles of an area's cells, (x, y) m, by y, then x."""
    x, y = (
        (low + (np.arange(CELLS) + 0.5) * (length_m / CELLS)).tolist()
        for low, length_m in zip(area.low, area.size_m, strict=True)
    )
    return [(east, north) for north in y for east in x]


def smallest_rate(supposed: "Supposed", place: tuple[float, float]) -> float:
    """Return the smallest rate of a source at a place that would have been seen, g/s; infinity if none."""
    at = supposed.at(place)
    low, high = map(math.log, RATES)
    if at.share_seen(RATES[1]) < PROBABILITY:
        return math.inf
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if at.share_seen(math.exp(middle)) >= PROBABILITY:
            high = middle
        else:
            low = middle
    return math.exp(high)


class Supposed:
    """The flown track, with what the last belief says of all but the source: K draws from it."""

    def __init__(
        self, flight: Flight, sensor: Sensor, spikes: float, flights: int, every: int = 1, seed: int = 0
    ) -> None:
        """Draw `flights` of them; every `every`th reading counts."""
        last, samples = flight.last, flight.samples[::every]
        rng = np.random.default_rng(seed)
        drawn: dict[str, Array] = {}
        if flight.particles is not None:
            weights = flight.particles[:, -1].astype(np.float64)
            chosen = rng.choice(len(weights), flights, p=weights / weights.sum())
            drawn = {
                name: flight.particles[chosen, column].astype(np.float64)
                for column, name in enumerate(last.unknowns)
            }
        known = {**NEUTRAL, "cv": getattr(sensor, "cv", 0.0), "d": last.diffusivity, "tau": last.lifetime}
        self.of: dict[str, Array] = {
            name: drawn.get(name, np.full(flights, value)) for name, value in known.items()
        }
        self.sensor, self.spikes = sensor, spikes
        self.places = np.array([(*sample.place, 0.0) for sample in samples])
        heights = np.array([sample.altitude_m for sample in samples])
        self.heights = np.zeros((len(samples), 1))  # of the readings above the source, (T, 1) or (T, K)
        if "z" in drawn:
            self.heights = heights[:, None] - drawn["z"]
        elif abs(last.z - last.altitude_m) > 1e-9:
            self.heights = heights[:, None] - last.z
        self.winds = self._winds(np.array([sample.wind for sample in samples]), drawn)
        shape = len(samples), flights
        self.normals = rng.standard_normal(shape)
        self.gas_normals, self.uniforms = rng.standard_normal(shape), rng.random(shape)
        self.blanks = rng.random(shape)

    def _winds(self, measured: Array, drawn: dict[str, Array]) -> Array:
        """Return the winds that carry the gas, (T, K, 2) m/s, of the measured ones (T, 2)."""
        speed = np.hypot(measured[:, 0], measured[:, 1])[:, None]
        angle = np.arctan2(measured[:, 1], measured[:, 0])[:, None]
        speed = np.broadcast_to(drawn["u"], (len(measured), len(drawn["u"]))) if "u" in drawn else speed
        angle = drawn["phi"] if "phi" in drawn else angle + np.radians(self.of["wind-direction"])
        speed = speed if "u" in drawn else speed * self.of["wind-speed"]
        speed, angle = np.broadcast_arrays(speed, angle)
        return np.stack([speed * np.cos(angle), speed * np.sin(angle)], axis=-1)

    def at(self, place: tuple[float, float]) -> "SupposedSource":
        """Suppose a source at a place, (x, y) m."""
        return SupposedSource(self, place)


class SupposedSource:
    """A source at a place, of any rate."""

    def __init__(self, supposed: Supposed, place: tuple[float, float]) -> None:
        self._of = supposed
        self._means = self._unit_means(place)  # (T, K), of 1 g/s, times the gain
        self.squares = squares = self._squares(place)  # squared coefficient of variation of the gas, (T, K)
        blank = BLANK * squares / (1 + squares)
        self._there, self._square = 1 / (1 - blank), (1 - blank) * (1 + squares) - 1
        self._blank = blank
        gas = self._there * _inverse_gaussian(self._square, supposed.gas_normals, supposed.uniforms)
        self._factor = np.where(supposed.blanks < blank, 0.0, gas)

    def share_seen(self, rate: float) -> float:
        """Return the share of the simulated flights that see it at a rate, g/s."""
        return float((self.advantages(self.readings(rate), rate) >= CLEAR).mean())

    def means(self, rate: float) -> Array:
        """Return what the sensor would read on average, long after the gas came, (T, K)."""
        gas, sensor = rate * self._means, self._of.sensor
        return sensor.settled(gas) if isinstance(sensor, Instrument) else gas

    def readings(self, rate: float) -> Array:
        """Return simulated readings (T, K)."""
        of, sensor = self._of, self._of.sensor
        gas = rate * self._means * self._factor
        if isinstance(sensor, Hits):
            expected = np.minimum(sensor.efficiency * gas + sensor.background, 1e15)
            return np.random.default_rng(1).poisson(expected).astype(np.float64)
        settled = sensor.settled(gas) if isinstance(sensor, Instrument) else gas
        read = settled + self._std(settled) * of.normals
        if isinstance(sensor, Threshold):
            seen = (np.random.default_rng(1).random(read.shape) >= sensor.missed) & (read >= sensor.threshold)
            return np.where(seen, read, 0.0)
        return np.minimum(read, sensor.saturation) if isinstance(sensor, Instrument) else read

    def advantages(self, readings: Array, rate: float) -> Array:
        """Return by how many nats readings (T, K) are more probable with it than in clean air, (K,)."""
        spikes = self._of.spikes
        with_it = (1 - spikes) * self._density(readings, rate * self._means)
        without = (1 - spikes) * self._density(readings, np.zeros_like(self._means))
        if spikes:
            of_spikes = spikes * spike_density(readings, self._of.sensor)
            with_it, without = with_it + of_spikes, without + of_spikes
        # Not the logarithm of the ratio, which may overflow.
        result: Array = (np.log(np.maximum(with_it, SMALLEST)) - np.log(np.maximum(without, SMALLEST))).sum(
            axis=0
        )
        return result

    def _std(self, settled: Array) -> Array:
        """Return the standard deviation of the noise, (T, K)."""
        sensor = self._of.sensor
        assert not isinstance(sensor, Hits)
        slope, floor = sensor.sensor_noise, sensor.environment_noise
        return np.asarray(self._of.of["noise"] * np.sqrt(np.square(slope * settled) + floor * floor))

    def _density(self, readings: Array, gas: Array) -> Array:
        """Return the probability, or its density, of readings in gas of a mean (T, K).

        The law of intermittent gas is taken as a normal one beside the blanks.
        """
        sensor = self._of.sensor
        if isinstance(sensor, Hits):
            return _of_counts(readings, sensor.efficiency * gas + sensor.background)
        if isinstance(sensor, Instrument) and sensor.air:
            settled = sensor.settled(gas)
            return _normal(readings, settled, self._std(settled))
        there = gas * self._there
        std = np.sqrt(np.square(self._std(there)) + self._square * there * there)
        blank = self._blank
        if isinstance(sensor, Threshold):
            below = _below(sensor.threshold, there, std)
            silent = sensor.missed + (1 - sensor.missed) * below
            return np.where(readings == 0, silent, (1 - sensor.missed) * _normal(readings, there, std))
        result = (1 - blank) * _normal(readings, there, std)
        if blank.any():
            result += blank * _normal(readings, 0.0, self._std(gas))
        return result

    def _unit_means(self, place: tuple[float, float]) -> Array:
        of, sensor = self._of, self._of.sensor
        known = {"rate": of.of["gain"], "diffusivity": of.of["d"], "lifetime": of.of["tau"]}
        if not (isinstance(sensor, Instrument) and sensor.ray):
            return concentration(self._offsets(place), np.zeros(3), of.winds, **known)
        total = np.zeros(of.winds.shape[:2])
        for along, weight in self._ray(place, sensor):
            there = self._offsets(place) + along[..., None] * np.array(sensor.aim)
            total += weight * concentration(there, np.zeros(3), of.winds, **known)
        return total

    def _offsets(self, place: tuple[float, float]) -> Array:
        """Return where the readings were taken, from the source, (T, 1 or K, 3) m."""
        of = self._of
        offsets = np.zeros((*of.heights.shape, 3))
        offsets[..., :2] = (of.places[:, :2] - place)[:, None]
        offsets[..., 2] = of.heights
        return offsets

    def _ray(self, place: tuple[float, float], sensor: Instrument) -> list[tuple[Array, Array]]:
        """Return places along the ray, m from the vehicle, and their weights, m: as the sensor's response."""
        offsets, aim = self._offsets(place), np.array(sensor.aim)
        past = offsets @ aim
        near = np.sqrt(np.maximum(np.square(offsets).sum(axis=-1) - past * past, SOURCE_RADIUS_M**2))
        low, high = np.arcsinh(past / near), np.arcsinh((past + sensor.ray) / near)
        nodes, weights = np.polynomial.legendre.leggauss(RAY_NODES)
        result = []
        for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
            at = 0.5 * (low + high) + 0.5 * (high - low) * node
            result.append((near * np.sinh(at) - past, weight * 0.5 * (high - low) * near * np.cosh(at)))
        return result

    def _squares(self, place: tuple[float, float]) -> Array:
        """Return the squared coefficient of variation of the gas, (T, K): as `plume/kernels.py` has it."""
        of = self._of
        squares = np.broadcast_to(np.square(of.of["cv"]), of.winds.shape[:2])
        if np.isinf(of.of["puff-rate"]).all():
            return np.asarray(np.minimum(squares, GREATEST_SQUARE))
        d, tau, share = of.of["d"], of.of["tau"], of.of["puff-share"]
        strength = d * np.sqrt((1 - 0.5 * share) / share**3) / (math.pi * math.sqrt(2) * of.of["puff-rate"])
        offsets = self._offsets(place)
        square = np.maximum(np.square(offsets).sum(axis=-1), SOURCE_RADIUS_M**2)
        distance, width = np.sqrt(square), 1 / (2 - share)
        drift = np.hypot(of.winds[..., 0], of.winds[..., 1]) / (2 * d)
        along = (offsets[..., :2] * of.winds).sum(axis=-1) / (2 * d)
        z = 2 * distance * np.sqrt(width * (1 / (d * tau) + width * drift * drift))
        exponent = 2 * (distance * np.sqrt(1 / (d * tau) + drift * drift) + (1 - width) * along) - z
        bessel = np.sqrt(4 + z * (8 + z * (5.9 + z * (0.5 * math.pi))))
        puffs = strength * bessel / square * np.exp(np.minimum(exponent, 50.0))
        return np.asarray(np.minimum(squares + puffs, GREATEST_SQUARE))


def spike_density(readings: Array, sensor: Sensor) -> Array:
    """Return the density of spikes of these values, of counts their probability: as the estimator has it."""
    if isinstance(sensor, Hits):
        scale = SPIKE_SIZE * math.sqrt(sensor.background)
        return _exceeds(readings, scale) - _exceeds(readings + 1, scale)
    scale = SPIKE_SIZE * sensor.environment_noise
    clean = sensor.air if isinstance(sensor, Instrument) else 0.0
    ratio = np.abs(readings - clean) / scale
    density = (0.5 if isinstance(sensor, Gaussian) else 1.0) * ratio * (1 + ratio * ratio) ** -1.5 / scale
    if isinstance(sensor, Threshold):
        return np.where(readings == 0, 1 - _exceeds(np.array(sensor.threshold), scale), density)
    return np.asarray(density)


def _exceeds(size: Array, scale: float) -> Array:
    return np.asarray(1 / np.sqrt(1 + np.square(size / scale)))


def _normal(value: Array, mean: Array | float, std: Array) -> Array:
    return np.asarray(np.exp(-0.5 * np.square((value - mean) / std)) / (std * math.sqrt(2 * math.pi)))


CDF_AT = np.linspace(-9.0, 9.0, 18_001)
CDF = np.array([0.5 * math.erfc(-at / math.sqrt(2)) for at in CDF_AT.tolist()])


def _below(limit: float, mean: Array, std: Array) -> Array:
    return np.asarray(np.interp((limit - mean) / std, CDF_AT, CDF))


def _of_counts(counts: Array, expected: Array) -> Array:
    """Poisson probabilities, but for the factor 1/k! that all hypotheses have."""
    return np.asarray(np.exp(np.clip(counts * np.log(expected) - expected, -600.0, 600.0)))


def _inverse_gaussian(square: Array, normals: Array, uniforms: Array) -> Array:
    """Draw from the inverse Gaussian law of mean 1 and a squared cv (Michael et al. 1976)."""
    chi = np.square(normals)
    half = 0.5 * square * chi
    low = 1 / (1 + half + np.sqrt(half * (2 + half)))
    return np.asarray(np.where(uniforms * (1 + low) <= 1, low, 1 / low))
