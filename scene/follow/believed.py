"""What a belief says, as there is to see of it."""

import math
from functools import lru_cache

import numpy as np

from link.bus.messages import Belief, Particles
from plume.scenario import stretch
from plume.sensors.instruments import Instrument
from plume.sensors.names import Sensor, parse
from plume.sensors.sensor import Hits, Threshold
from scene.scene import Floats, Gauge, Measurement, Point, Scatter

SHARE = 0.95  # of the belief, within the radius that people are told
NOISE = 2.0  # standard deviations in clean air that count as noise: 98% of its readings are less
STEPS = (1.0, 3.0, 10.0, 30.0, 100.0)  # edges of a gauge, by its least
FALLING = (0.7, 0.5, 0.3, 0.2)  # edges of one that falls, by clean air's reading


def measured(said: Belief, cloud: Particles | None, time_s: float, wind: Point | None = None) -> Measurement:
    """Return a reading and its belief, with particles (N, D + 1) or without, at a simulation time.

    wind: as it was measured with the reading.
    """
    rate = None
    if cloud is not None and "q" in said.unknowns:
        low, middle, high = quantiles(cloud[:, said.unknowns.index("q")], cloud[:, -1], (0.05, 0.5, 0.95))
        rate = low, middle, high
    return Measurement(
        said.step,
        time_s,
        said.position,
        said.gas,
        said.spread,
        said.mean,
        said.covariance,
        said.ceased,
        said.intermittency,
        said.advised_dwell,
        radius_95_m=math.nan if cloud is None else radius(scatter(said, cloud), said.mean),
        rate=rate,
        wind=said.wind,
        p_value=said.p_value,
        evidence=said.evidence,
        effective_sample_size=said.effective_sample_size,
        outside=said.outside,
        measured_wind=wind,
        stretch=stretch(dict(zip(said.unknowns, said.means, strict=False)).get("cv", 0.0)),
    )


def scatter(said: Belief, cloud: Particles) -> Scatter:
    """Return a belief's particles in the plane; a known x or y is the estimate's own."""
    places = np.empty((len(cloud), 2), np.float32)
    for column, name in enumerate("xy"):
        known = name not in said.unknowns
        with np.errstate(over="ignore"):  # a record may say absurd things
            places[:, column] = said.mean[column] if known else cloud[:, said.unknowns.index(name)]
    return Scatter(places, cloud[:, -1].copy())


def quantiles(values: Floats, weights: Floats, shares: tuple[float, ...]) -> list[float]:
    """Return the quantiles of weighted values (N,); NaN if there are none."""
    if not len(values):
        return [math.nan] * len(shares)
    order = np.argsort(values)
    up_to = np.cumsum(weights[order], dtype=np.float64)
    found = np.searchsorted(up_to, np.array(shares) * up_to[-1]).clip(max=len(order) - 1)
    return [float(value) for value in values[order[found]]]


def radius(scatter: Scatter, middle: tuple[float, float]) -> float:
    """Return within which distance, m, of a place `SHARE` of the belief lies."""
    away = np.hypot(*(scatter.places - np.array(middle)).T)  # in float64: a belief may say absurd things
    return quantiles(away, scatter.weights, (SHARE,))[0]


@lru_cache(maxsize=64)
def gauge_of(sensor: str) -> Gauge | None:
    """Return how the readings of a sensor, in the form of --sensor, are shown; None if it is not known."""
    try:
        it = parse(sensor)
    except ValueError:
        return None
    return _gauge(it)


def _gauge(sensor: Sensor) -> Gauge:
    if isinstance(sensor, Hits):
        least = max(1.0, sensor.background + NOISE * math.sqrt(sensor.background))
        return Gauge("hits", tuple(least * step for step in STEPS))
    if isinstance(sensor, Threshold):
        return Gauge("g/m³", tuple(sensor.threshold * step for step in STEPS))
    if isinstance(sensor, Instrument) and sensor.air:
        clean = sensor.air - NOISE * float(sensor.noise_std(sensor.air))
        further = [part * sensor.air for part in FALLING if part * sensor.air < clean]
        return Gauge("RS/R0", (clean, *further), True)
    unit = "g/m²" if isinstance(sensor, Instrument) and sensor.ray else "g/m³"
    return Gauge(unit, tuple(NOISE * sensor.environment_noise * step for step in STEPS))
