"""Reads the gas values and the wind from a log."""

import math
from collections import Counter, defaultdict
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog import units
from ground.tlog.background import clean_air
from ground.tlog.clock import Floats, VehicleClock
from ground.tlog.frames import Integers
from ground.tlog.log import LOCAL, NAMES, Autopilot, FlightLog, counted, few
from ground.tlog.onboard import NAME_LENGTH
from ground.tlog.track import NorthEastUp, Reported
from ground.tlog.units import STANDARD_C, STANDARD_HPA, GasUnit
from link.bus.mavlink import BadFrame, Message, unpack_reading
from link.cli import BadInput
from plume.elementary import float32

Pair = tuple[float, float]
# Maps the vehicle's time in ms to the wind, (x east, y north) m/s, pointing to where it comes from; None if
# unknown.
Air = Callable[[float], Pair | None]

NAMED = (mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT, mavlink.MAVLINK_MSG_ID_NAMED_VALUE_INT)
WIND_COV, WIND = mavlink.MAVLINK_MSG_ID_WIND_COV, mavlink.MAVLINK_MSG_ID_WIND
READING_IDS = (LOCAL, WIND_COV, NAMED[0])  # of one reading: consecutive, from one sender, with one time
MESSAGES = {kind.msgname: kind for kind in mavlink.mavlink_map.values()}
# Largest difference between a sender's time and the vehicle's if both share a clock: of the median, and by
# which a single value may be later.
SAME_CLOCK_MS, OWN_CLOCK_MS = 500.0, 5000.0
WIND_AGE_MS = 30_000.0  # a wind message is valid for this long before and after it was logged


class GasSource(NamedTuple):
    """Which message and field of a log carry the gas values."""

    text: str
    message_ids: tuple[int, ...]
    field: str
    name: str | None  # of the NAMED_VALUE_FLOAT or NAMED_VALUE_INT; None for any other message
    factor: float
    unit: GasUnit | None = None  # None: that of the estimator's sensor


def parse_gas(text: str, is_onboard: bool = False) -> GasSource:
    """Parse NAME (of a NAMED_VALUE_FLOAT or NAMED_VALUE_INT) or MESSAGE.FIELD, either with *FACTOR or @UNIT.

    A unit is converted in the standard atmosphere. Of an on-board log, the message has become a named value
    already. Raises BadInput.
    """
    what, at, said = text.partition("@")
    if at:
        try:
            unit = units.parse(said)
        except ValueError as error:
            raise BadInput(f"{text!r} is not allowed: {error}") from None
        if unit.is_along_path:
            raise BadInput(f"{text!r} is not allowed: {unit.name} is of a path; wanted a table (.csv) for it")
        return parse_gas(what, is_onboard)._replace(text=text, factor=unit.factor(), unit=unit)
    what, star, number = text.partition("*")
    try:
        factor = float(number) if star else 1.0
    except ValueError:
        factor = math.nan
    if not 0.0 < factor < math.inf:
        raise BadInput(f"{text!r} is not allowed; wanted a number above 0 after the *")
    message, _, field = what.partition(".")
    if is_onboard:
        return GasSource(text, NAMED, "value", what[:NAME_LENGTH], factor)
    if message in MESSAGES and field:
        kind = MESSAGES[message]
        numbers = [name for name in kind.fieldnames if _is_number(kind, name)]
        if field not in numbers:
            known = ", ".join(numbers) or "it has none"
            raise BadInput(f"{text!r} is not allowed; wanted a numeric field of {message}: {known}")
        return GasSource(text, (kind.id,), field, None, factor)
    if not 1 <= len(what) <= NAME_LENGTH:
        raise BadInput(
            f"{text!r} is not allowed; wanted the NAME of a NAMED_VALUE_FLOAT, 1 to {NAME_LENGTH} "
            "characters, or MESSAGE.FIELD such as SCALED_PRESSURE3.temperature, either with *FACTOR or @UNIT"
        )
    return GasSource(text, NAMED, "value", what, factor)


def _is_number(kind: Message, field: str) -> bool:
    is_array = kind.array_lengths[kind.ordered_fieldnames.index(field)]
    return not is_array and kind.fieldtypes[kind.fieldnames.index(field)] != "char"


class LoggedGas(NamedTuple):
    """A gas value, or the time for a simulated one."""

    time_ms: int  # the vehicle's time
    logged_us: int  # the log's time, µs since 1970
    gas: float
    place: NorthEastUp | None = None  # from home, m; None where the log's positions say it
    wind: Pair | None = None  # None where the log's wind messages say it


def recorded(log: FlightLog, autopilot: Autopilot, clock: VehicleClock) -> tuple[list[LoggedGas], list[int]]:
    """Return the readings of a search that a log holds as they were said on its bus, each once.

    Also return the records of their LOCAL_POSITION_NEDs: these are m from home, wherever the vehicle has the
    origin of its own frame.
    """
    fixes: list[int] = []
    samples: dict[int, LoggedGas] = {}
    for first in log.select(autopilot.system, READING_IDS[:1]).tolist():
        three = slice(first, first + 3)
        if tuple(log.records.message_ids[three]) != READING_IDS or len(log.senders(three)) > 1:
            continue
        try:
            said = unpack_reading(b"".join(log.frame(index) for index in range(first, first + 3)))
        except BadFrame as error:
            if error.kind == "not finite":  # its sensor had no value
                fixes.append(first)
        else:
            fixes.append(first)
            time_ms = round(float(clock.own_ms(np.array([first]), np.array([said.time_boot_ms]))[0]))
            place = said.position[1], said.position[0], said.altitude_m
            sample = LoggedGas(time_ms, int(log.times_us[first]), said.gas, place, said.wind)
            samples.setdefault(time_ms, sample)
    return [samples[time_ms] for time_ms in sorted(samples)], fixes


def read_gas(
    log: FlightLog, autopilot: Autopilot, clock: VehicleClock, source: GasSource, left_out: Counter[str]
) -> list[LoggedGas]:
    """Return the gas values in order of time; raises BadInput if there are none."""
    said: list[tuple[int, int, int, float]] = []
    taken: set[tuple[int, ...]] = set()
    boots = clock.boots(np.arange(len(log)))
    for index, m in log.messages(log.select(autopilot.system, source.message_ids)):
        if source.name is not None and m.name != source.name:
            continue
        component, boot_ms = m.get_srcComponent(), getattr(m, "time_boot_ms", 0)
        value = getattr(m, source.field)
        this = component, int(boots[index]), boot_ms, value
        if boot_ms and this in taken:  # a value that was taken once is said again until there is another
            left_out["repeated"] += 1
        else:
            taken.add(this)
            said.append((index, component, boot_ms, value))
    if not said:
        raise BadInput(_no_gas(log, autopilot, source))
    log.notes.append(f"gas: {counted(len(said), 'value')} of {source.text}")
    records, components, own_ms = np.array([sent[:3] for sent in said], np.int64).T
    times_ms, by_log = _timed(clock, records, components, own_ms)
    if by_log:
        log.notes.append(
            f"gas values from senders without the vehicle's clock: {by_log:,}; their log times are used"
        )
    with np.errstate(over="ignore"):
        gas = (np.array([value for *_, value in said], np.float64) * source.factor).astype(np.float32)
    order = np.argsort(times_ms, kind="stable")
    logged_us = np.maximum.accumulate(log.times_us[records[order]])
    samples: list[LoggedGas] = []
    for time_ms, us, value in zip(
        times_ms[order].tolist(), logged_us.tolist(), gas[order].tolist(), strict=True
    ):
        sample = LoggedGas(round(time_ms), us, value)
        if not math.isfinite(value):
            left_out["not finite"] += 1
        elif source.unit and abs(value) > units.GREATEST * source.factor:
            left_out[f"beyond ±{units.GREATEST:g} {source.unit.name}"] += 1
        elif samples and samples[-1].time_ms == sample.time_ms:
            left_out["repeated" if samples[-1].gas == value else "with the time of another value"] += 1
        else:
            samples.append(sample)
    return samples


def _timed(
    clock: VehicleClock, records: Integers, components: Integers, boot_ms: Integers
) -> tuple[Floats, int]:
    """Return the vehicle's times of gas values, and how many come from the log.

    They do where a sender has another clock or none. Where it has the vehicle's clock, an older value was
    lost at first, and came when it was repeated.
    """
    logged_ms, own_ms = clock.logged_ms(records), clock.own_ms(records, boot_ms)
    is_own = own_ms - logged_ms <= OWN_CLOCK_MS
    for component in np.unique(components):
        if np.median(np.abs(own_ms - logged_ms)[components == component]) > SAME_CLOCK_MS:
            is_own[components == component] = False
    is_own &= (boot_ms > 0) | (np.abs(own_ms - logged_ms) <= OWN_CLOCK_MS)
    return np.where(is_own, own_ms, logged_ms), int(np.count_nonzero(~is_own))


def _no_gas(log: FlightLog, autopilot: Autopilot, source: GasSource) -> str:
    names: dict[int, set[str]] = defaultdict(set)
    for _, m in log.messages(log.select(None, NAMED)):
        names[m.get_srcSystem()].add(m.name)
    own = [name if name.isprintable() else repr(name) for name in sorted(names[autopilot.system])]
    elsewhere = "".join(f"; system {system} did" for system in sorted(names) if source.name in names[system])
    return (
        f"system {autopilot.system} sent no {source.text}{elsewhere}; its named values: "
        f"{few(own) or 'none'}; choose one with --gas, or simulate a plume along its path with "
        "--plume MISSION.yaml"
    )


def without_background(
    samples: list[LoggedGas], source: GasSource, background: float | None, notes: list[str]
) -> tuple[list[LoggedGas], float]:
    """Return samples whose unit is named without the background, and the noise in clean air, g/m³.

    background: in that unit; None: that of clean air.
    """
    assert source.unit
    clean = clean_air(np.array([sample.gas for sample in samples]))
    subtracted = clean.background if background is None else background * source.factor
    how = (
        "as given" if background is not None else f"that of clean air, {100 * clean.share:.0f}% of the values"
    )
    notes.append(
        f"gas: {source.unit.text()}; 1 {source.unit.name} is {source.factor:.4g} g/m³ at {STANDARD_C:g} °C "
        f"and {STANDARD_HPA:g} hPa; {subtracted / source.factor:.4g} {source.unit.name} is subtracted, {how}"
    )
    return [sample._replace(gas=float32(sample.gas - subtracted)) for sample in samples], clean.noise


def read_wind(log: FlightLog, autopilot: Autopilot, clock: VehicleClock, wind: Pair | None) -> Air:
    """Return the wind that was given, else WIND_COV (231), else ArduPilot's WIND (168).

    Raises BadInput if none exists.
    """
    if wind is not None:
        log.notes.append(f"wind: {wind[0]:g} m/s from {wind[1]:g}°, as given")
        return steady(_from_compass(*wind))
    for message_id, toward in WINDS.items():
        told = log.messages(log.select(autopilot.system, (message_id,)))
        said = [(index, pair) for index, m in told if all(map(math.isfinite, pair := toward(m)))]
        if said:
            log.notes.append(f"wind: {len(said):,} {NAMES[message_id]}")
            return partial(_reported, Reported(clock, said))
    raise BadInput(
        f"system {autopilot.system} sent no wind (WIND_COV or WIND); give it with --wind SPEED,FROM"
    )


def _from_compass(speed: float, from_deg: float) -> Pair:
    heading = math.radians(from_deg)
    return float32(speed * math.sin(heading)), float32(speed * math.cos(heading))


WINDS: dict[int, Callable[[Message], Pair]] = {
    # The velocity of the air, north and east.
    WIND_COV: lambda m: (-m.wind_y, -m.wind_x),
    # ArduPilot's: the direction that the wind comes from.
    WIND: lambda m: _from_compass(m.speed, m.direction),
}


def steady(wind: Pair) -> Air:
    """Return a wind that never changes."""
    return lambda _: wind


def _reported(winds: Reported, time_ms: float) -> Pair | None:
    """Return the latest wind message at a time, while it is valid."""
    last = winds.last(time_ms)
    x, y = winds.values[last].tolist()
    return (x, y) if abs(time_ms - winds.times_ms[last]) <= WIND_AGE_MS else None
