"""Reads the telemetry log of any ArduPilot or PX4 vehicle: the readings of a search, and all frames that
the vehicle sent.
"""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog import clock as clocks
from ground.tlog import sender, track
from ground.tlog.clock import Floats, VehicleClock
from ground.tlog.recorded import Recorded
from ground.tlog.samples import Air, LoggedGas, Pair, parse_gas, read_gas, read_wind, steady
from ground.tlog.sender import AUTOPILOT, Autopilot, FlightError, FlightLog, counted, few
from ground.tlog.track import Anchor, FlownPath, Place
from link.bus.keys import MAVLINK_OUT, READING
from link.bus.mavlink import GAS_NAME, WRAP_MS, Codec, Reading, pack_reading
from link.record.record import Entry
from plume.geodesy import to_global
from plume.scenario import AREA_M
from plume.world import World, float32

MARGIN_M = 2.0
"""Between the path and the edge of a search area that is fitted to it."""
STRONGEST_MPS = 100.0
EVERY_S = 1.0
LEAST_EVERY_S = 0.001
"""Reading times are whole milliseconds."""


class Origin(NamedTuple):
    """The south-west corner of the search area."""

    north_m: float
    """North and east of the origin of the log's local frame."""
    east_m: float
    lat_deg: float | None
    """None if no message ties the local frame to the globe."""
    lon_deg: float | None


class Flight(NamedTuple):
    """A flight as a mission: the readings for an estimator, and all frames that the vehicle sent."""

    entries: list[Entry]
    """The readings and every original frame of the vehicle, in order of time."""
    system: int
    """The vehicle's system id; the readings' frames carry it too."""
    area_m: float
    """Side of the search area."""
    origin: Origin
    notes: list[str]
    """What was read, what was left out and why, in lines for people."""


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
) -> Flight:
    """Read a flight; raises FlightError if it yields no readings or an argument is not allowed.

    system: the vehicle's system id; default: the autopilot with the most positions. gas: see `parse_gas`.
    wind: (speed in m/s, direction it comes from in degrees clockwise from north), instead of the log's
    wind.
    every_s: at most one reading per this time; default: `EVERY_S`, but all readings of a search's own
    record.
    plume: a simulated world to take gas and wind from, instead of the log. origin: (north, east) in m of
    the search area's south-west corner in the log's local frame;
    default: home if all readings lie in the area then, else around the path. area_m: the side of the area.
    """
    source = parse_gas(gas)
    _check(wind, every_s, origin, area_m, plume)
    log, notes = open_log(path)
    autopilot = sender.choose(log, system)
    notes += sender.notes_on_senders(log, autopilot)
    clock, told = clocks.vehicle_clock(log, autopilot)
    notes += told
    own = Recorded(log, autopilot, clock)
    flown, told = track.flown(log, autopilot, clock, own.fixes)
    notes += told
    flying, told = track.flying(log, autopilot, clock)
    notes += told
    home = track.home(log, autopilot, clock, flying, flown.anchor)
    left_out: Counter[str] = Counter()
    at: Where = flown.at
    air: Air
    every = every_s or EVERY_S
    if own.samples and not plume and wind is None and gas == GAS_NAME:
        samples, air, told = own.samples, own.air, ["gas, wind and positions: readings of a search"]
        home = home or (0.0, 0.0)
        at, every = own.around(home), every_s or LEAST_EVERY_S
    elif plume:
        samples, told = _along(flown, clock, every)
        air = steady(plume.wind)
    else:
        samples, told = read_gas(log, autopilot, clock, source, left_out)
        notes += told
        air, told = read_wind(log, autopilot, clock, wind)
    notes += told
    taken = _take(samples, every, flying, at, air, left_out)
    side_m, corner = _area([place for _, place, _ in taken], origin, area_m, plume is not None, home)
    readings = _readings(taken, corner, side_m, plume, left_out)
    if not readings:
        raise FlightError(
            f"{path}: none of the {len(samples):,} samples can be a reading; left out: "
            f"{_listed(left_out) or 'none'}"
        )
    where = _where(corner, flown.anchor)
    notes += _notes_on_readings([reading for reading, _ in readings], left_out, every, side_m, where)
    return Flight(_entries(log, autopilot, clock, readings), autopilot.system, side_m, where, notes)


def _check(
    wind: Pair | None, every_s: float | None, origin: Pair | None, area_m: float | None, plume: World | None
) -> None:
    if wind is not None and plume is not None:
        raise FlightError("a wind is not allowed with a plume, which has its own")
    if wind is not None and not (0.0 <= wind[0] <= STRONGEST_MPS and abs(wind[1]) <= 360.0):
        wanted = f"a speed from 0 to {STRONGEST_MPS:g} m/s and a direction within ±360°"
        raise FlightError(f"wind {wind[0]:g},{wind[1]:g} is not allowed; wanted {wanted}")
    if every_s is not None and not LEAST_EVERY_S <= every_s < math.inf:
        raise FlightError(
            f"a reading every {every_s:g} s is not allowed; wanted a number from {LEAST_EVERY_S:g}"
        )
    if origin is not None and not all(map(math.isfinite, origin)):
        raise FlightError(f"origin {origin[0]:g},{origin[1]:g} is not allowed; wanted m north and m east")
    if area_m is not None and not 0.0 < area_m < math.inf:
        raise FlightError(f"an area of {area_m:g} m is not allowed; wanted a number above 0")


# ---- the file ----


def open_log(path: Path) -> tuple[FlightLog, list[str]]:
    """Return a log's records and notes about the file; raises FlightError if it cannot be read or contains
    no MAVLink frame.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FlightError(f"{path} cannot be read: {error.strerror}") from None
    log = FlightLog(data)
    if not len(log):
        raise FlightError(
            f"{path} contains no MAVLink 1 or 2 frame; wanted a telemetry log (.tlog), as ground stations "
            "write it"
        )
    return log, _notes_on_file(path.name, log)


def _notes_on_file(name: str, log: FlightLog) -> list[str]:
    records, clock = log.records, log.clock
    version_1 = sum(log.data[start] == mavlink.PROTOCOL_MARKER_V1 for start in records.starts.tolist())
    versions = " and ".join(
        version for version, count in (("1", version_1), ("2", len(log) - version_1)) if count
    )
    began = datetime.fromtimestamp(int(log.times_us[0]) / 1e6, UTC)
    span = f" in {log.seconds(-1):,.1f} s from {began:%Y-%m-%d %H:%M:%S} UTC" if log.is_timed else ""
    notes = [f"{name}: {counted(len(log), 'frame')} of MAVLink {versions}{span}"]
    if records.garbage:
        amount, first = sum(count for _, count in records.garbage), min(records.garbage[0][0], len(log) - 1)
        runs = counted(len(records.garbage), "run")
        notes.append(
            f"skipped: {counted(amount, 'byte')} of garbage in {runs}, "
            f"the first at {log.seconds(first):.1f} s"
        )
    if records.refused:
        notes.append(
            "among them, frames with a wrong checksum (damaged or from another dialect): "
            f"{few(_by_message(records.refused))}"
        )
    if records.unknown:
        notes.append(
            "frames of unknown messages, whose checksums cannot be verified: "
            f"{few(_by_message(records.unknown))}"
        )
    if records.cut_off:
        notes.append(f"the last record is cut off after {counted(records.cut_off, 'byte')}")
    if log.is_timed and clock.damaged:
        notes.append(
            f"frames with a missing or impossible time: {clock.damaged:,}; each takes the time of the frame "
            "before it"
        )
    if clock.jumps:
        jumps = [f"{back_us / 1e6:,.1f} s at {log.seconds(index):.1f} s" for index, back_us in clock.jumps]
        notes.append(f"the log's clock jumps back by {few(jumps)}: later times are corrected")
    return notes


def _by_message(counts: Counter[int]) -> list[str]:
    known = mavlink.mavlink_map
    return [
        f"{count:,} {known[number].msgname if number in known else f'of id {number}'}"
        for number, count in counts.most_common()
    ]


# ---- readings ----


Where = Callable[[float], Place | None]
"""Maps the vehicle's time in ms to its place; None if unknown."""


class Taken(NamedTuple):
    """A sample that can become a reading, with its place and wind."""

    sample: LoggedGas
    place: Place
    wind: Pair


def _along(path: FlownPath, clock: VehicleClock, every_s: float) -> tuple[list[LoggedGas], list[str]]:
    """Return samples for simulated readings: every `every_s`, wherever the path has fixes."""
    every_ms = 1000.0 * every_s
    lines = [line for track in path.tracks for line in track.lines()]
    first = min(begin for begin, _ in lines)
    numbers = [
        np.arange(math.ceil((begin - first) / every_ms), math.floor((end - first) / every_ms) + 1)
        for begin, end in lines
    ]
    times_ms: Floats = first + every_ms * np.unique(np.concatenate(numbers)).astype(np.float64)
    samples = [
        LoggedGas(round(time), us, 0.0)
        for time, us in zip(times_ms.tolist(), clock.logged_us(times_ms).tolist(), strict=True)
    ]
    return samples, ["gas and wind: simulated along the path"]


def _take(
    samples: Sequence[LoggedGas],
    every_s: float,
    flying: Callable[[float], bool],
    at: Where,
    air: Air,
    left_out: Counter[str],
) -> list[Taken]:
    """Return the first sample of each interval that was taken in the air, at a known place and in a known
    wind.
    """
    taken: list[Taken] = []
    interval = None
    for sample in samples:
        number = math.floor((sample.time_ms - samples[0].time_ms) / (1000.0 * every_s))
        if number == interval:
            left_out[f"extra within {every_s:g} s"] += 1
        elif not flying(sample.time_ms):
            left_out["not in the air"] += 1
        elif (place := at(sample.time_ms)) is None:
            left_out["without a position"] += 1
        elif (wind := air(sample.time_ms)) is None:
            left_out["without a wind"] += 1
        else:
            interval = number
            taken.append(Taken(sample, place, wind))
    return taken


def _area(
    places: Sequence[Place], origin: Pair | None, area_m: float | None, usual: bool, home: Pair | None
) -> tuple[float, Pair]:
    """Return the area's side and (north, east) corner in m.

    As given, else at home if all of it lies north and east of that, as a search's does; else centred on
    the path. The side is the default, or a larger one that holds the path.
    """
    low, high = (end(np.array(places or [(0.0, 0.0, 0.0)])[:, :2], axis=0) for end in (np.min, np.max))
    if (
        origin is None
        and home is not None
        and not usual
        and all(low >= home)
        and all(high <= np.add(home, area_m or AREA_M))
    ):
        origin = home
    span = float(np.max(high - (low if origin is None else origin))) + MARGIN_M * (2 if origin is None else 1)
    side_m = area_m or (AREA_M if usual or span <= AREA_M else float(math.ceil(span)))
    north, east = ((low + high - side_m) / 2).round(2).tolist()
    return side_m, origin or (north, east)


def _readings(
    taken: Sequence[Taken], corner: Pair, side_m: float, plume: World | None, left_out: Counter[str]
) -> list[tuple[Reading, LoggedGas]]:
    """Return the readings inside the area, with times shifted if they do not fit MAVLink's 32-bit
    time_boot_ms.
    """
    fits = bool(taken) and taken[0].sample.time_ms >= 0 and taken[-1].sample.time_ms < WRAP_MS
    first_ms = 0 if fits or not taken else taken[0].sample.time_ms
    readings: list[tuple[Reading, LoggedGas]] = []
    for sample, (north, east, up), wind in taken:
        if sample.time_ms - first_ms >= WRAP_MS:
            left_out["later than time_boot_ms can say"] += 1
            continue
        position = float32(east - corner[1]), float32(north - corner[0])
        if not all(0.0 <= value <= side_m for value in position):
            left_out["outside the area"] += 1
            continue
        gas = plume.gas(position, len(readings)) if plume else sample.gas
        readings.append((Reading(sample.time_ms - first_ms, position, float32(up), wind, gas), sample))
    return readings


def _listed(left_out: Counter[str]) -> str:
    return ", ".join(f"{count:,} {what}" for what, count in left_out.items())


def _where(corner: Pair, anchor: Anchor | None) -> Origin:
    north, east = corner
    if anchor is None:
        return Origin(north, east, None, None)
    return Origin(
        north, east, *to_global(anchor.lat_deg, anchor.lon_deg, north - anchor.north_m, east - anchor.east_m)
    )


def _notes_on_readings(
    readings: Sequence[Reading], left_out: Counter[str], every_s: float, side_m: float, origin: Origin
) -> list[str]:
    gas = [reading.gas for reading in readings]
    x, y = np.mean([reading.wind for reading in readings], axis=0).tolist()
    most = f", at most one per {every_s:g} s" * (every_s > LEAST_EVERY_S)
    globe = "" if origin.lat_deg is None else f" ({origin.lat_deg:.7f}, {origin.lon_deg:.7f})"
    notes = [
        f"readings: {len(readings):,}{most}, gas from {min(gas):g} to {max(gas):g}; "
        f"mean wind {math.hypot(x, y):.1f} m/s from {math.degrees(math.atan2(x, y)) % 360:.0f}°"
    ]
    if left_out:
        notes.append(f"left out: {_listed(left_out)}")
    corner = f"{origin.north_m:g} m north and {origin.east_m:g} m east of the local origin{globe}"
    return [*notes, f"area: side {side_m:g} m, south-west corner {corner}"]


def _entries(
    log: FlightLog, autopilot: Autopilot, clock: VehicleClock, readings: Sequence[tuple[Reading, LoggedGas]]
) -> list[Entry]:
    """Return the readings and the vehicle's frames in order of time; at equal times the frames come first."""
    own = np.flatnonzero(log.records.systems == autopilot.system)
    shift_ms = readings[0][0].time_boot_ms - readings[0][1].time_ms
    times_s = (clock.logged_ms(own) + shift_ms) / 1000.0
    entries = [
        Entry(MAVLINK_OUT.name, 1000 * logged_us, time_s, log.frame(index))
        for index, logged_us, time_s in zip(
            own.tolist(), log.times_us[own].tolist(), times_s.tolist(), strict=True
        )
    ]
    codec = Codec(autopilot.system, AUTOPILOT)
    entries += [
        Entry(
            READING.name, 1000 * sample.logged_us, reading.time_boot_ms / 1000.0, pack_reading(codec, reading)
        )
        for reading, sample in readings
    ]
    return sorted(entries, key=lambda entry: entry.published_ns)
