"""Reads the gas values and the wind from a telemetry log."""

import math
from collections import Counter, defaultdict
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog.clock import Floats, VehicleClock
from ground.tlog.frames import Integers
from ground.tlog.sender import Autopilot, FlightError, FlightLog, counted, few
from ground.tlog.track import Told
from link.bus.mavlink import Message
from plume.world import float32

Pair = tuple[float, float]

NAMED = (mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT, mavlink.MAVLINK_MSG_ID_NAMED_VALUE_INT)
WIND_COV, WIND = mavlink.MAVLINK_MSG_ID_WIND_COV, mavlink.MAVLINK_MSG_ID_WIND
MESSAGES = {kind.msgname: kind for kind in mavlink.mavlink_map.values()}
NAME_LENGTH = 10
"""Longest name of a NAMED_VALUE_FLOAT (251) or NAMED_VALUE_INT (252)."""

SAME_CLOCK_MS, OWN_CLOCK_MS = 500.0, 5000.0
"""Largest difference between a sender's time and the vehicle's if both share a clock: of the median, and
by which a single value may be later."""
WIND_AGE_MS = 30_000.0
"""A wind message is valid for this long before and after it was logged."""


class GasSource(NamedTuple):
    """Which message and field of a log carry the gas values."""

    text: str
    message_ids: tuple[int, ...]
    field: str
    name: str | None
    """Name of the NAMED_VALUE_FLOAT or NAMED_VALUE_INT; None for any other message."""
    factor: float


def parse_gas(text: str) -> GasSource:
    """Parse NAME (of a NAMED_VALUE_FLOAT or NAMED_VALUE_INT) or MESSAGE.FIELD, either followed by *FACTOR.
    Raises FlightError.
    """
    what, star, number = text.partition("*")
    try:
        factor = float(number) if star else 1.0
    except ValueError:
        factor = math.nan
    if not 0.0 < factor < math.inf:
        raise FlightError(f"{text!r} is not allowed; wanted a number above 0 after the *")
    message, _, field = what.partition(".")
    if message in MESSAGES and field:
        kind = MESSAGES[message]
        numbers = [name for name in kind.fieldnames if _is_number(kind, name)]
        if field not in numbers:
            raise FlightError(
                f"{text!r} is not allowed; wanted a numeric field of {message}: "
                f"{', '.join(numbers) or 'it has none'}"
            )
        return GasSource(text, (kind.id,), field, None, factor)
    if not 1 <= len(what) <= NAME_LENGTH:
        raise FlightError(
            f"{text!r} is not allowed; wanted the NAME of a NAMED_VALUE_FLOAT, 1 to {NAME_LENGTH} "
            "characters, "
            "or MESSAGE.FIELD such as SCALED_PRESSURE3.temperature, either followed by *FACTOR"
        )
    return GasSource(text, NAMED, "value", what, factor)


def _is_number(kind: Message, field: str) -> bool:
    is_array = kind.array_lengths[kind.ordered_fieldnames.index(field)]
    return not is_array and kind.fieldtypes[kind.fieldnames.index(field)] != "char"


class LoggedGas(NamedTuple):
    """A gas value, or the time for a simulated one."""

    time_ms: int
    """The vehicle's time."""
    logged_us: int
    """The log's time, µs since 1970."""
    gas: float


Air = Callable[[float], Pair | None]
"""Maps the vehicle's time in ms to the wind, (x east, y north) m/s, pointing to where it comes from; None
if unknown.
"""


def read_gas(
    log: FlightLog, autopilot: Autopilot, clock: VehicleClock, source: GasSource, left_out: Counter[str]
) -> tuple[list[LoggedGas], list[str]]:
    """Return the gas values in order of time, and notes; raises FlightError if there are none."""
    said: list[tuple[int, int, int]] = []
    values: list[float] = []
    told: set[tuple[int, ...]] = set()
    boots = clock.boots(np.arange(len(log)))
    for index, m in log.messages(log.select(autopilot.system, source.message_ids)):
        if source.name is not None and m.name != source.name:
            continue
        component, boot_ms, value = (
            m.get_srcComponent(),
            getattr(m, "time_boot_ms", 0),
            getattr(m, source.field),
        )
        if boot_ms and (taken := (component, int(boots[index]), boot_ms, value)) in told:
            left_out["repeated"] += 1  # a value that was taken once is said again until there is another
            continue
        if boot_ms:
            told.add(taken)
        said.append((index, component, boot_ms))
        values.append(value)
    if not said:
        raise FlightError(_no_gas(log, autopilot, source))
    notes = [f"gas: {counted(len(said), 'value')} of {source.text}"]
    records, components, boot_ms = np.array(said, np.int64).T
    times_ms, by_log = _timed(clock, records, components, boot_ms)
    if by_log:
        notes.append(
            f"gas values from senders without the vehicle's clock: {by_log:,}; their log times are used"
        )
    with np.errstate(over="ignore"):
        gas = (np.array(values, np.float64) * source.factor).astype(np.float32).tolist()
    samples: list[LoggedGas] = []
    order = np.argsort(times_ms, kind="stable")
    for number, logged_us in zip(
        order.tolist(), np.maximum.accumulate(log.times_us[records[order]]).tolist(), strict=True
    ):
        sample = LoggedGas(round(float(times_ms[number])), logged_us, gas[number])
        if not math.isfinite(sample.gas):
            left_out["not finite"] += 1
        elif samples and samples[-1].time_ms == sample.time_ms:
            left_out["repeated" if samples[-1].gas == sample.gas else "with the time of another value"] += 1
        else:
            samples.append(sample)
    return samples, notes


def _timed(
    clock: VehicleClock, records: Integers, components: Integers, boot_ms: Integers
) -> tuple[Floats, int]:
    """Return the vehicle's times of gas values, and how many come from the log because their sender has
    another clock or none.

    Where a sender has the vehicle's clock, what is older was lost at first, and came when it was said
    again.
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
    there = (
        few([name if name.isprintable() else repr(name) for name in sorted(names[autopilot.system])])
        or "none"
    )
    elsewhere = "".join(f"; system {system} did" for system in sorted(names) if source.name in names[system])
    return (
        f"system {autopilot.system} sent no {source.text}{elsewhere}; its named values: {there}; "
        "choose one with --gas, or simulate a plume along its path with --plume MISSION.yaml"
    )


def read_wind(
    log: FlightLog, autopilot: Autopilot, clock: VehicleClock, wind: Pair | None
) -> tuple[Air, list[str]]:
    """Return the wind that was given, else WIND_COV (231), else ArduPilot's WIND (168), and notes; raises
    FlightError if none exists.
    """
    if wind is not None:
        return steady(_from_compass(*wind)), [f"wind: {wind[0]:g} m/s from {wind[1]:g}°, as given"]
    for message_id, toward in ((WIND_COV, _wind_cov), (WIND, _wind)):
        said = [(index, toward(m)) for index, m in log.messages(log.select(autopilot.system, (message_id,)))]
        said = [(index, pair) for index, pair in said if all(map(math.isfinite, pair))]
        if said:
            told = Told(
                clock.logged_ms(np.array([index for index, _ in said], np.int64)), [pair for _, pair in said]
            )
            return _changing(told), [f"wind: {len(said):,} {mavlink.mavlink_map[message_id].msgname}"]
    raise FlightError(
        f"system {autopilot.system} sent no wind (WIND_COV or WIND); give it with --wind SPEED,FROM"
    )


def _from_compass(speed: float, from_deg: float) -> Pair:
    return float32(speed * math.sin(math.radians(from_deg))), float32(
        speed * math.cos(math.radians(from_deg))
    )


def _wind_cov(m: Message) -> Pair:
    """WIND_COV (231) carries the air's velocity, north and east."""
    return -m.wind_y, -m.wind_x


def _wind(m: Message) -> Pair:
    """ArduPilot's WIND (168) carries the direction that the wind comes from."""
    return _from_compass(m.speed, m.direction)


def steady(wind: Pair) -> Air:
    """Return a wind that never changes."""
    return lambda _: wind


def _changing(told: Told) -> Air:
    """Return the latest wind message at each time, while it is valid."""

    def air(time_ms: float) -> Pair | None:
        last = told.last(time_ms)
        if abs(time_ms - told.times_ms[last]) > WIND_AGE_MS:
            return None
        x, y = told.values[last].tolist()
        return x, y

    return air
