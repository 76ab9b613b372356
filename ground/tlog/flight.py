"""Reads the log of a vehicle as a flight: the readings of a search, and all frames that the vehicle sent."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ground.tlog import track
from ground.tlog.clock import Floats, VehicleClock, vehicle_clock
from ground.tlog.jumps import OUT_OF_REACH, jumped
from ground.tlog.log import AUTOPILOT, Autopilot, FlightLog, choose, open_log
from ground.tlog.samples import (
    Air,
    LoggedGas,
    Pair,
    parse_gas,
    read_gas,
    read_wind,
    recorded,
    steady,
    without_background,
)
from ground.tlog.track import FlownPath, NorthEastUp
from link.bus.keys import MAVLINK_OUT, READING
from link.bus.mavlink import GAS_NAME, WRAP_MS, Codec, Reading, pack_reading
from link.cli import BadInput
from link.record.record import Entry
from plume.elementary import float32
from plume.scenario import AREA_M
from plume.worlds.exposure import Before
from plume.worlds.world import World

MARGIN_M = 2.0  # between the path and the edge of a search area that is fitted to it
FARTHEST_M = 20_000.0  # from the middle of the flight
STRONGEST_MPS = 100.0
EVERY_S = 1.0
LEAST_EVERY_S = 0.001  # reading times are whole milliseconds


class Origin(NamedTuple):
    """The south-west corner of the search area."""

    north_m: float  # from the origin of the log's local frame
    east_m: float
    lat_deg: float | None  # None if no message ties the local frame to the globe
    lon_deg: float | None


class Sensed(NamedTuple):
    """What a flight says of its sensor."""

    noise: float  # in clean air, in the unit of the readings
    ray_m: float = 0.0  # length of the path that it looks along, straight down; 0: it meets the gas itself


class LoggedFlight(NamedTuple):
    """A flight as a mission."""

    entries: list[Entry]  # the readings and every original frame of the vehicle, in order of time
    system: int  # the vehicle's system id; the readings' frames carry it too
    area_m: float  # side of the search area
    origin: Origin
    notes: list[str]  # what was read, what was left out and why, in lines for people
    sensed: Sensed | None = None  # None: the readings are of the sensor that the estimator is told


def read(
    path: Path,
    *,
    system: int | None = None,
    gas: str = GAS_NAME,
    wind: Pair | None = None,
    every_s: float | None = None,
    origin: Pair | None = None,
    area_m: float | None = None,
    plume: World | None = None,
    background: float | None = None,
) -> LoggedFlight:
    """Read a flight; raises BadInput if it yields no readings or an argument is not allowed.

    system: the vehicle's system id; default: the autopilot with the most positions. gas: see `parse_gas`.
    wind: (speed in m/s, direction it comes from in degrees clockwise from north), instead of the log's
    wind. every_s: at most one reading per this time; default: `EVERY_S`, but all readings of a search's own
    record. plume: a simulated world to take gas and wind from, instead of the log. origin: (north, east) in m
    of the search area's south-west corner in the log's local frame; default: home if all readings lie in the
    area then, else around the path. area_m: the side of the area. background: of gas whose unit `gas` names,
    in that unit; default: that of clean air in the flight.
    """
    check(wind, every_s, origin, area_m, plume)
    log = open_log(path, gas)
    source = parse_gas(gas, log.is_onboard)
    if background is not None and source.unit is None:
        raise BadInput("--background: only allowed where --gas names a unit: --gas NAME@UNIT")
    autopilot = choose(log, system)
    clock = vehicle_clock(log, autopilot)
    own, foreign = recorded(log, autopilot, clock)
    flown = track.flown(log, autopilot, clock, foreign)
    flying = track.flying(log, autopilot, clock)
    home = track.home(log, autopilot, clock, flying, flown)
    left_out: Counter[str] = Counter()
    sensed: Sensed | None = None
    every, air = every_s or EVERY_S, steady((0.0, 0.0))
    if own and not plume and wind is None and gas == GAS_NAME:
        home = home or (0.0, 0.0)
        every, samples = every_s or LEAST_EVERY_S, [_in_local_frame(each, home) for each in own]
        log.notes.append("gas, wind and positions: readings of a search")
    elif plume:
        air, samples = steady(plume.wind), _along(flown, clock, every)
        log.notes.append("gas and wind: simulated along the path")
    else:
        samples = read_gas(log, autopilot, clock, source, left_out)
        if source.unit and samples:
            samples, noise = without_background(samples, source, background, log.notes)
            sensed = Sensed(noise)
        air = read_wind(log, autopilot, clock, wind)
    taken = _near(_take(samples, every, flying, flown, air, left_out), left_out, log.notes)
    fitted = (area_m or AREA_M, None) if plume else (area_m, home)
    side_m, corner = fitted_area([place for _, place, _ in taken], origin, *fitted)
    readings = _readings(taken, corner, side_m, plume, left_out)
    out = ", ".join(f"{count:,} {what}" for what, count in left_out.items())
    if not readings:
        raise BadInput(
            f"{path}: none of the {len(samples):,} samples can be a reading; left out: {out or 'none'}"
        )
    where = Origin(*corner, *(flown.anchor.globe(*corner) if flown.anchor else (None, None)))
    log.notes.append(note_on_readings([reading for reading, _ in readings], every))
    log.notes += [f"left out: {out}"] * bool(out)
    globe = "" if where.lat_deg is None else f" ({where.lat_deg:.7f}, {where.lon_deg:.7f})"
    log.notes.append(
        f"area: side {side_m:g} m, south-west corner {where.north_m:g} m north and {where.east_m:g} m east "
        f"of the local origin{globe}"
    )
    return LoggedFlight(
        _entries(log, autopilot, clock, readings), autopilot.system, side_m, where, log.notes, sensed
    )


def check(
    wind: Pair | None,
    every_s: float | None,
    origin: Pair | None,
    area_m: float | None,
    plume: World | None = None,
) -> None:
    """Refuse what nobody can mean of a log's wind, m/s and degrees, of its readings, s, and of its area, m.

    Raises BadInput.
    """
    if wind is not None and plume is not None:
        raise BadInput("a wind is not allowed with a plume, which has its own")
    if wind is not None and not (0.0 <= wind[0] <= STRONGEST_MPS and abs(wind[1]) <= 360.0):
        raise BadInput(
            f"wind {wind[0]:g},{wind[1]:g} is not allowed; wanted a speed from 0 to {STRONGEST_MPS:g} m/s "
            "and a direction within ±360°"
        )
    if every_s is not None and not LEAST_EVERY_S <= every_s < math.inf:
        raise BadInput(
            f"a reading every {every_s:g} s is not allowed; wanted a number from {LEAST_EVERY_S:g}"
        )
    if origin is not None and not all(map(math.isfinite, origin)):
        raise BadInput(f"origin {origin[0]:g},{origin[1]:g} is not allowed; wanted m north and m east")
    if area_m is not None and not 0.0 < area_m < math.inf:
        raise BadInput(f"an area of {area_m:g} m is not allowed; wanted a number above 0")


class Taken(NamedTuple):
    """A sample that can become a reading, with its place in the local frame and its wind."""

    sample: LoggedGas
    place: NorthEastUp
    wind: Pair


def _in_local_frame(sample: LoggedGas, home: Pair) -> LoggedGas:
    """Return a recorded reading with its place from the local frame's origin instead of from home."""
    assert sample.place is not None
    north, east, up = sample.place
    return sample._replace(place=(home[0] + north, home[1] + east, up))


def _along(path: FlownPath, clock: VehicleClock, every_s: float) -> list[LoggedGas]:
    """Return samples for simulated readings: every `every_s`, wherever the path has fixes."""
    every_ms = 1000.0 * every_s
    lines = [line for track in path.tracks for line in track.lines()]
    first = min(begin for begin, _ in lines)
    numbers = [
        np.arange(math.ceil((begin - first) / every_ms), math.floor((end - first) / every_ms) + 1)
        for begin, end in lines
    ]
    times_ms: Floats = first + every_ms * np.unique(np.concatenate(numbers)).astype(np.float64)
    pairs = zip(times_ms.tolist(), clock.logged_us(times_ms).tolist(), strict=True)
    return [LoggedGas(round(time), us, 0.0) for time, us in pairs]


def _take(
    samples: Sequence[LoggedGas],
    every_s: float,
    flying: Callable[[float], bool],
    path: FlownPath,
    air: Air,
    left_out: Counter[str],
) -> list[Taken]:
    """Return the first sample of each interval.

    It was taken in the air, at a known place and in a known wind.
    """
    taken: list[Taken] = []
    interval = None
    for sample in samples:
        number = math.floor((sample.time_ms - samples[0].time_ms) / (1000.0 * every_s))
        if number == interval:
            left_out[f"extra within {every_s:g} s"] += 1
        elif not flying(sample.time_ms):
            left_out["not in the air"] += 1
        elif (place := sample.place or path.at(sample.time_ms)) is None:
            left_out["without a position"] += 1
        elif (wind := sample.wind or air(sample.time_ms)) is None:
            left_out["without a wind"] += 1
        else:
            interval = number
            taken.append(Taken(sample, place, wind))
    return taken


def _near(taken: list[Taken], left_out: Counter[str], notes: list[str]) -> list[Taken]:
    """Return what lies where the vehicle can have been, or where a search was.

    A receiver may jump anywhere.
    """
    if not taken:
        return taken
    ground = np.array([place[:2] for _, place, _ in taken])
    away_m = np.linalg.norm(ground - np.median(ground, axis=0), axis=1)
    is_own = np.array([each.sample.place is not None for each in taken])
    near = np.flatnonzero(is_own | (away_m <= FARTHEST_M))
    if far := len(taken) - len(near):
        left_out[f"more than {FARTHEST_M / 1000:g} km from the middle of the flight"] = far
    times_s = np.array([taken[index].sample.time_ms / 1000.0 for index in near.tolist()])
    there = near[is_own[near] | ~jumped(times_s, ground[near], notes)]
    if away := len(near) - len(there):
        left_out[OUT_OF_REACH] = away
    return [taken[index] for index in there.tolist()]


def fitted_area(
    places: Sequence[NorthEastUp], origin: Pair | None, area_m: float | None, home: Pair | None
) -> tuple[float, Pair]:
    """Return the area's side and (north, east) corner in m, from places (N, 3) m.

    As given, else at home if all of it lies north and east of that, as a search's does; else centred on
    the path. The side is the default, or a larger one that holds the path.
    """
    ground = np.array(places or [(0.0, 0.0, 0.0)])[:, :2]
    low, high = ground.min(axis=0), ground.max(axis=0)
    at_home = home is not None and all(low >= home) and all(high <= np.add(home, area_m or AREA_M))
    if origin is None and at_home:
        origin = home
    margins_m = MARGIN_M * (2 if origin is None else 1)
    span_m = float(np.max(high - (low if origin is None else origin))) + margins_m
    side_m = area_m or max(AREA_M, float(math.ceil(span_m)))
    north, east = ((low + high - side_m) / 2).round(2).tolist()
    return side_m, origin or (north, east)


def _readings(
    taken: Sequence[Taken], corner: Pair, side_m: float, plume: World | None, left_out: Counter[str]
) -> list[tuple[Reading, LoggedGas]]:
    """Return the readings inside the area.

    Their times are shifted if they do not fit MAVLink's 32-bit time_boot_ms.
    """
    fits = bool(taken) and taken[0].sample.time_ms >= 0 and taken[-1].sample.time_ms < WRAP_MS
    first_ms = 0 if fits or not taken else taken[0].sample.time_ms
    readings: list[tuple[Reading, LoggedGas]] = []
    before: Before | None = None  # the reading before, of a simulated plume
    for sample, (north, east, up), wind in taken:
        position = float32(east - corner[1]), float32(north - corner[0])
        if sample.time_ms - first_ms >= WRAP_MS:
            left_out["later than time_boot_ms can say"] += 1
        elif not all(0.0 <= value <= side_m for value in position):
            left_out["outside the area"] += 1
        else:
            gas = sample.gas
            if plume:
                at_s = (sample.time_ms - taken[0].sample.time_ms) / 1000.0
                gas, wind = plume.measure(position, len(readings), at_s, before)
                before = Before(position, at_s, gas)
            readings.append((Reading(sample.time_ms - first_ms, position, float32(up), wind, gas), sample))
    return readings


def note_on_readings(readings: Sequence[Reading], every_s: float) -> str:
    """Say how many readings there are, and between which values."""
    gas = [reading.gas for reading in readings]
    x, y = np.mean([reading.wind for reading in readings], axis=0).tolist()
    most = f", at most one per {every_s:g} s" * (every_s > LEAST_EVERY_S)
    return (
        f"readings: {len(readings):,}{most}, gas from {min(gas):g} to {max(gas):g}; "
        f"mean wind {math.hypot(x, y):.1f} m/s from {math.degrees(math.atan2(x, y)) % 360:.0f}°"
    )


def _entries(
    log: FlightLog, autopilot: Autopilot, clock: VehicleClock, readings: Sequence[tuple[Reading, LoggedGas]]
) -> list[Entry]:
    """Return the readings and the vehicle's frames in order of time; at equal times the frames come first."""
    own = np.flatnonzero(log.records.systems == autopilot.system)
    shift_ms = readings[0][0].time_boot_ms - readings[0][1].time_ms
    times_s = ((clock.logged_ms(own) + shift_ms) / 1000.0).tolist()
    entries = [
        Entry(MAVLINK_OUT.name, 1000 * logged_us, time_s, log.frame(index))
        for index, logged_us, time_s in zip(own.tolist(), log.times_us[own].tolist(), times_s, strict=True)
    ]
    codec = Codec(autopilot.system, AUTOPILOT)
    for reading, sample in readings:
        time_s, payload = reading.time_boot_ms / 1000.0, pack_reading(codec, reading)
        entries.append(Entry(READING.name, 1000 * sample.logged_us, time_s, payload))
    return sorted(entries, key=lambda entry: entry.published_ns)
