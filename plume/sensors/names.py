"""Gas sensors by name: `gaussian:0.3,0.2` or `tgs2620:dwell=10,drift=0`, as --sensor takes them."""

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from plume.elementary import Array
from plume.parameters import (
    CLEAN,
    DECAY,
    DWELL,
    EAST,
    FACTOR,
    FLOOR,
    GAUSSIAN_KIND,
    GREATEST_CV,
    HITS_KIND,
    KIND,
    MISSED,
    MOST,
    NORTH,
    POWER,
    RAY,
    RISE,
    SATURATION,
    SENSOR_NUMBERS,
    SLOPE,
    THRESHOLD,
    THRESHOLD_KIND,
    UP,
)
from plume.sensors.instruments import INSTRUMENTS, Instrument
from plume.sensors.sensor import Gaussian, Hits, Threshold

Sensor = Gaussian | Threshold | Hits
GAUSSIAN = Gaussian()
# The sensors with their usual numbers, by name.
KINDS: Mapping[str, Sensor] = MappingProxyType(
    {"gaussian": GAUSSIAN, "threshold": Threshold(), "hits": Hits(), **INSTRUMENTS}
)
LONGEST_DWELL_S = 600.0
# Least and greatest value of a number of a sensor; of the others, from 10^-12 to 10^12.
LIMITS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "missed": (0.0, 1.0),
        # A reading drawn with more noise could lie beyond ±MOST, and no belief about that is taken.
        "sensor_noise": (0.0, 1000.0),
        "environment_noise": (1 / MOST, 1e10),
        "background": (1 / MOST, 1e10),
        "cv": (0.0, GREATEST_CV),
        "dwell": (0.0, LONGEST_DWELL_S),
        "rise": (0.0, 3600.0),
        "decay": (0.0, 3600.0),
        "warmup": (0.0, 3600.0),
        "drift": (0.0, 10.0),
        "rate": (0.1, 100.0),
        "power": (-10.0, -1e-3),
        "ray": (0.1, 1000.0),
        "pitch": (-90.0, 90.0),
        "azimuth": (-360.0, 360.0),
    }
)
OF_METAL_OXIDES = ("air", "factor", "power")


def fluctuates(sensor: Sensor) -> bool:
    """Whether intermittency of the gas is modelled for this sensor."""
    return isinstance(sensor, Gaussian) and not (isinstance(sensor, Instrument) and sensor.air)


def lags(sensor: Sensor) -> bool:
    """Whether a reading depends on the one before."""
    return isinstance(sensor, Instrument) and bool(sensor.rise or sensor.decay)


def numbers(sensor: Sensor) -> dict[str, float]:
    """Return the numbers of a sensor that may be given, by name."""
    left_out = {"kind"}
    if isinstance(sensor, Instrument):
        left_out |= {"cv", "saturation"} if sensor.air else set(OF_METAL_OXIDES)
        left_out |= set() if sensor.ray else {"ray", "pitch", "azimuth"}
    return {field.name: getattr(sensor, field.name) for field in fields(sensor) if field.name not in left_out}


@lru_cache(16)
def parse(text: str) -> Sensor:
    """Read a sensor from `kind` or `kind:number,name=number…`, as on command lines. Raises ValueError.

    Numbers without a name come first, in the order of the sensor's.
    """
    name, _, said = text.partition(":")
    if name not in KINDS:
        raise ValueError(
            f"{text!r} is not allowed; wanted {', '.join(KINDS)}, optionally with numbers: "
            "KIND:NUMBER,NAME=NUMBER"
        )
    usual = numbers(KINDS[name])
    places = [field.name for field in fields(KINDS[name]) if field.name in usual and not field.kw_only]
    given: dict[str, float] = {}
    try:
        for item in said.split(",") if said else ():
            key, equals, number = item.rpartition("=")
            by_place = not equals and [*given] == places[: len(given)]
            key = places[len(given)] if by_place else key
            if key in given or key not in usual:
                raise ValueError
            given[key] = float(number)
    except (IndexError, ValueError):
        wanted = ",".join([*places, *(f"{key}=…" for key in usual if key not in places)])
        raise ValueError(f"{text!r} is not allowed; wanted {name} or {name}:{wanted}") from None
    for key, value in given.items():
        low, high = LIMITS.get(key, (1 / MOST, MOST))
        if low <= value <= high and (key != "missed" or value < high):
            continue
        to = "to below" if key == "missed" else "up to" if high == MOST else "to"
        wanted = f"a number from {low:g} {to} {high:g}"
        raise ValueError(f"{text!r} is not allowed; {key} is {value:g}, wanted {wanted}")
    changes: dict[str, Any] = dict(given)
    return replace(KINDS[name], **changes)


def dwelling(text_of_sensor: str, dwell_s: float | None) -> str:
    """Return the text of a sensor for which the vehicle hovers so long; None: as long as it says.

    Raises ValueError.
    """
    sensor = parse(text_of_sensor)
    if dwell_s is None:
        return text_of_sensor
    if not 0 <= dwell_s <= LONGEST_DWELL_S:
        raise ValueError(f"a dwell of {dwell_s:g} s is not allowed; wanted 0 to {LONGEST_DWELL_S:g} s")
    return text(replace(sensor, dwell=dwell_s))


def text(sensor: Sensor) -> str:
    """Return the text of a sensor that `parse` reads back.

    Of an instrument it says what differs from the usual; of the others all numbers, but for an intermittency
    and a dwell of 0.
    """
    if isinstance(sensor, Instrument):
        usual = numbers(INSTRUMENTS[sensor.kind])
        said = [f"{key}={value!r}" for key, value in numbers(sensor).items() if value != usual[key]]
        return ":".join(filter(None, (sensor.kind, ",".join(said))))
    name = next(name for name, usual in KINDS.items() if type(sensor) is type(usual))
    values = numbers(sensor)
    dwell, cv = values.pop("dwell"), values.get("cv")
    if cv == 0:
        del values["cv"]
    dwells = f",dwell={dwell!r}" if dwell else ""
    return f"{name}:{','.join(map(repr, values.values()))}{dwells}"


def sensor_row(sensor: Sensor) -> Array:
    """Return a sensor as compiled loops take it, (SENSOR_NUMBERS,): see `plume.parameters`."""
    result = np.zeros(SENSOR_NUMBERS)
    result[SATURATION] = math.inf
    match sensor:
        case Gaussian(slope, floor):
            result[[KIND, SLOPE, FLOOR]] = GAUSSIAN_KIND, slope, floor
        case Threshold(threshold, missed, slope, floor):
            result[[KIND, SLOPE, FLOOR, THRESHOLD, MISSED]] = THRESHOLD_KIND, slope, floor, threshold, missed
        case Hits(efficiency, background):
            result[[KIND, SLOPE, FLOOR]] = HITS_KIND, efficiency, background
    if isinstance(sensor, Instrument):
        result[[RISE, DECAY, DWELL]] = sensor.rise, sensor.decay, sensor.dwell
        result[SATURATION] = np.float32(sensor.saturation)  # as a reading is rounded
        result[[CLEAN, FACTOR, POWER]] = sensor.air, sensor.factor_of_gas, sensor.power
        result[[RAY, EAST, NORTH, UP]] = sensor.ray, *sensor.aim
    return result
