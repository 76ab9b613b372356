"""What a gas sensor meets from one reading to the next: on the leg, at the place, and along its ray."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from plume.dispersion import SOURCE_RADIUS_M
from plume.elementary import Array
from plume.flight import leg_s, travelled
from plume.sensors.instruments import Instrument
from plume.sensors.names import Sensor, lags

AVERAGE_HZ = 10.0  # samples a second that a sensor averages that has no rate of its own
MOST_SAMPLES = 2000  # of a leg, or of a hover
RAY_STEP_M = 0.5 * SOURCE_RADIUS_M  # between places along a ray

Ask = Callable[[Array, Array], tuple[Array, Array]]  # the air of one mission, as `plume.worlds.air.Air`


class Before(NamedTuple):
    """The reading before: where, when and what was read."""

    position: tuple[float, float]  # m
    time_s: float  # of the mission, at the end of its dwell
    gas: float  # in the sensor's unit


def is_timed(sensor: Sensor) -> bool:
    """Whether a reading takes more than the gas at one place and time."""
    return isinstance(sensor, Instrument) or sensor.dwell > 0


def met(
    air: Ask,
    sensor: Sensor,
    strength: float,
    position: tuple[float, float],
    time_s: float,
    before: Before | None,
) -> float:
    """Return what a reading's noise is added to, in the unit of an instrument, else the mean gas, g/m³.

    strength: factor on the gas.  time_s: of the mission, when the reading is taken.  before: None if its
    element is in clean air until it hovers.
    """
    rate = sensor.rate if isinstance(sensor, Instrument) else AVERAGE_HZ
    if not lags(sensor):
        before = None
    at, times_s, seconds = _samples(position, time_s, before, sensor.dwell, rate)
    gas = strength * _along_rays(air, sensor, at, times_s)
    if isinstance(sensor, Instrument) and lags(sensor):
        start = float(sensor.settled(0.0)) if before is None else before.gas
        return sensor.follow(start, sensor.settled(gas), seconds)
    mean = math.fsum(gas.tolist()) / len(gas)
    return float(sensor.settled(mean)) if isinstance(sensor, Instrument) else mean


def _samples(
    position: tuple[float, float], time_s: float, before: Before | None, dwell_s: float, rate: float
) -> tuple[Array, Array, Array]:
    """Return the places (M, 2) m, the times (M,) s and the durations (M,) s for which gas is asked.

    What is left of the time since the reading before, after the leg, is spent at the place.
    """
    end = np.array(position)
    if before is None:
        times_s, seconds = _spread(time_s - dwell_s, dwell_s, rate)
        return np.broadcast_to(end, (len(times_s), 2)), times_s, seconds
    start, passed_s = np.array(before.position), max(time_s - before.time_s, 0.0)
    usual_s = float(leg_s(start, end))
    flown_s = min(usual_s, passed_s)
    times_s, seconds = _spread(before.time_s, flown_s, rate)
    pace = usual_s / flown_s if flown_s else 1.0
    shares = travelled(start, end, (times_s - before.time_s) * pace)
    at = start + shares[:, None] * (end - start)
    hover_times_s, hover_seconds = _spread(before.time_s + flown_s, passed_s - flown_s, rate)
    return (
        np.concatenate([at, np.broadcast_to(end, (len(hover_times_s), 2))]),
        np.concatenate([times_s, hover_times_s]),
        np.concatenate([seconds, hover_seconds]),
    )


def _spread(start_s: float, duration_s: float, rate: float) -> tuple[Array, Array]:
    """Return the middles and the lengths of the even parts, 1/rate at most, of a time."""
    number = min(max(math.ceil(duration_s * rate), 1), MOST_SAMPLES)
    part_s = duration_s / number
    return np.asarray(start_s + (np.arange(number) + 0.5) * part_s, np.float64), np.full(number, part_s)


def _along_rays(air: Ask, sensor: Sensor, at: Array, times_s: Array) -> Array:
    """Return the gas at places (M, 2) m, g/m³, or along rays from them, g/m²: (M,)."""
    away_m: Array = np.zeros(1)
    part_m, aim = 1.0, (0.0, 0.0, 0.0)
    if isinstance(sensor, Instrument) and sensor.ray:
        number = min(math.ceil(sensor.ray / RAY_STEP_M), MOST_SAMPLES)
        part_m, aim = sensor.ray / number, sensor.aim
        away_m = np.asarray((np.arange(number) + 0.5) * part_m, np.float64)
    places = np.zeros((len(at), len(away_m), 3))
    places[:, :, :2] = at[:, None]
    places += away_m[:, None] * np.array(aim)
    gas, _ = air(places.reshape(-1, 3), np.repeat(times_s, len(away_m)))
    return np.asarray(part_m * gas.reshape(places.shape[:2]).sum(axis=1))
