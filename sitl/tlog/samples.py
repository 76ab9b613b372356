"""The gas values and the wind of a telemetry log."""

import math
from collections import Counter, defaultdict
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from link.bus.mavlink import Message
from plume.world import float32
from sitl.tlog.clock import Floats, VehicleClock
from sitl.tlog.frames import Integers
from sitl.tlog.sender import Autopilot, FlightError, FlightLog, counted
from sitl.tlog.track import Told

Pair = tuple[float, float]

NAMED = (mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT, mavlink.MAVLINK_MSG_ID_NAMED_VALUE_INT)
WIND_COV, WIND = mavlink.MAVLINK_MSG_ID_WIND_COV, mavlink.MAVLINK_MSG_ID_WIND
MESSAGES = {kind.msgname: kind for kind in mavlink.mavlink_map.values()}
NAME_LENGTH = 10
"""Characters of the name of a NAMED_VALUE_FLOAT."""

SAME_CLOCK_MS, OWN_CLOCK_MS = 500.0, 5000.0
"""A sender's clock is the vehicle's where they differ by this at most, in the median; one value of it by the second."""
WIND_AGE_MS = 30_000.0
"""So long before or after it was told a wind is believed."""


class GasSource(NamedTuple):
    """Where in a log the gas values are."""

    text: str
    message_ids: tuple[int, ...]
    field: str
    name: str | None
    """Of a NAMED_VALUE_FLOAT or NAMED_VALUE_INT; None: the message is no such value."""
    factor: float


def parse_gas(text: str) -> GasSource:
    """Read NAME, of a NAMED_VALUE_FLOAT or NAMED_VALUE_INT, or MESSAGE.FIELD; either with *FACTOR behind it. Raises FlightError."""
    what, star, number = text.partition("*")
    try:
        factor = float(number) if star else 1.0
    except ValueError:
        factor = math.nan
    if not 0.0 < factor < math.inf:
        raise FlightError(f"{text!r} is not allowed; wanted a number above 0 behind the *")
    message, _, field = what.partition(".")
    if message in MESSAGES and field:
        kind = MESSAGES[message]
        numbers = [name for name in kind.fieldnames if _is_number(kind, name)]
        if field not in numbers:
            raise FlightError(
                f"{text!r} is not allowed; wanted a field of {message} that is one number: {', '.join(numbers) or 'it has none'}"
            )
        return GasSource(text, (kind.id,), field, None, factor)
    if not 1 <= len(what) <= NAME_LENGTH:
        raise FlightError(
            f"{text!r} is not allowed; wanted the NAME of a NAMED_VALUE_FLOAT, 1 to {NAME_LENGTH} characters, "
            "or MESSAGE.FIELD such as SCALED_PRESSURE3.temperature, either with *FACTOR behind it"
        )
    return GasSource(text, NAMED, "value", what, factor)


def _is_number(kind: Message, field: str) -> bool:
    is_array = kind.array_lengths[kind.ordered_fieldnames.index(field)]
    return not is_array and kind.fieldtypes[kind.fieldnames.index(field)] != "char"


class Sample(NamedTuple):
    """A gas value, or a place for one that will be simulated."""

    time_ms: int
    """The vehicle's time."""
    logged_us: int
    gas: float


Air = Callable[[float], Pair | None]
"""The wind at a time of the vehicle: to where it comes from, m/s."""


def read_gas(
    log: FlightLog, autopilot: Autopilot, clock: VehicleClock, source: GasSource, left_out: Counter[str]
) -> tuple[list[Sample], list[str]]:
    """The gas values in order of time."""
    said: list[tuple[int, int, int]] = []
    values = []
    for index, m in log.messages(log.select(autopilot.system, source.message_ids)):
        if source.name is None or m.name == source.name:
            said.append((index, m.get_srcComponent(), getattr(m, "time_boot_ms", 0)))
            values.append(getattr(m, source.field))
    if not said:
        raise FlightError(_no_gas(log, autopilot, source))
    notes = [f"gas: {counted(len(said), 'value')} of {source.text}"]
    records, components, boot_ms = np.array(said, np.int64).T
    times_ms, by_log = _timed(clock, records, components, boot_ms)
    if by_log:
        notes.append(f"gas values that have the time at which they were logged, since theirs is not the vehicle's: {by_log:,}")
    with np.errstate(over="ignore"):
        gas = (np.array(values, np.float64) * source.factor).astype(np.float32).tolist()
    samples: list[Sample] = []
    order = np.argsort(times_ms, kind="stable")
    for number, logged_us in zip(order.tolist(), np.maximum.accumulate(log.times_us[records[order]]).tolist(), strict=True):
        sample = Sample(round(float(times_ms[number])), logged_us, gas[number])
        if not math.isfinite(sample.gas):
            left_out["not finite"] += 1
        elif samples and samples[-1].time_ms == sample.time_ms:
            left_out["said again" if samples[-1].gas == sample.gas else "other values of the same time"] += 1
        else:
            samples.append(sample)
    return samples, notes


def _timed(clock: VehicleClock, records: Integers, components: Integers, boot_ms: Integers) -> tuple[Floats, int]:
    """The vehicle's times of gas values, and how many of them are by the log: those of senders that have another clock, or none."""
    logged_ms, own_ms = clock.logged_ms(records), clock.own_ms(records, boot_ms)
    apart_ms = np.abs(own_ms - logged_ms)
    is_own = apart_ms <= OWN_CLOCK_MS
    for component in np.unique(components):
        if np.median(apart_ms[components == component]) > SAME_CLOCK_MS:
            is_own[components == component] = False
    return np.where(is_own, own_ms, logged_ms), int(np.count_nonzero(~is_own))


def _no_gas(log: FlightLog, autopilot: Autopilot, source: GasSource) -> str:
    names: dict[int, set[str]] = defaultdict(set)
    for _, m in log.messages(log.select(None, NAMED)):
        names[m.get_srcSystem()].add(m.name)
    there = ", ".join(sorted(names[autopilot.system])) or "none"
    elsewhere = "".join(f"; system {system} has it" for system in sorted(names) if source.name in names[system])
    return (
        f"system {autopilot.system} told no {source.text}{elsewhere}; named values that it told: {there}; "
        "choose one with --gas, or lay a simulated plume over its path with --plume MISSION.yaml"
    )


def read_wind(log: FlightLog, autopilot: Autopilot, clock: VehicleClock, wind: Pair | None) -> tuple[Air, list[str]]:
    """The wind that was asked for, else WIND_COV, else ArduPilot's WIND; raises FlightError where there is none."""
    if wind is not None:
        return steady(_from_compass(*wind)), [f"wind: {wind[0]:g} m/s from {wind[1]:g}°, as asked for"]
    for message_id, toward in ((WIND_COV, _wind_cov), (WIND, _wind)):
        said = [(index, toward(m)) for index, m in log.messages(log.select(autopilot.system, (message_id,)))]
        said = [(index, pair) for index, pair in said if all(map(math.isfinite, pair))]
        if said:
            told = Told(clock.logged_ms(np.array([index for index, _ in said], np.int64)), [pair for _, pair in said])
            return _changing(told), [f"wind: {len(said):,} of {mavlink.mavlink_map[message_id].msgname}"]
    raise FlightError(f"system {autopilot.system} told no wind: neither WIND_COV nor WIND; give it with --wind SPEED,FROM")


def _from_compass(speed: float, from_deg: float) -> Pair:
    return float32(speed * math.sin(math.radians(from_deg))), float32(speed * math.cos(math.radians(from_deg)))


def _wind_cov(m: Message) -> Pair:
    """WIND_COV has the air's velocity, north and east."""
    return -m.wind_y, -m.wind_x


def _wind(m: Message) -> Pair:
    """ArduPilot's WIND has the direction that it comes from."""
    return _from_compass(m.speed, m.direction)


def steady(wind: Pair) -> Air:
    """Return a wind that never changes."""
    return lambda _: wind


def _changing(told: Told) -> Air:
    """The wind that was told last, as long as it is believed."""

    def air(time_ms: float) -> Pair | None:
        last = told.last(time_ms)
        if abs(time_ms - told.times_ms[last]) > WIND_AGE_MS:
            return None
        x, y = told.values[last].tolist()
        return x, y

    return air
