"""A table of a flight as a mission: its readings, and the telemetry of a vehicle that flew it."""

import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from ground.logs.columns import Columns, gas_unit
from ground.logs.samples import INTERVAL_S, Samples, samples, spread_over
from ground.tlog.background import clean_air
from ground.tlog.clock import Floats
from ground.tlog.flight import FARTHEST_M, LoggedFlight, Origin, Sensed, check, fitted_area, note_on_readings
from ground.tlog.jumps import OUT_OF_REACH, jumped
from ground.tlog.log import AUTOPILOT, counted
from ground.tlog.samples import WIND_AGE_MS, Pair
from link.bus.keys import MAVLINK_OUT, READING
from link.bus.mavlink import WRAP_MS, Codec, Message, Reading, pack_reading
from link.cli import BadInput
from link.record.record import Entry
from plume.elementary import float32
from plume.geodesy import EARTH_RADIUS_M, to_global, to_local

SYSTEM = 1  # the vehicle's MAVLink system id
USUAL_EVERY_S = 1.0
LEAST_EVERY_S = 0.05
ENOUGH = 20  # readings that tell their noise; of fewer it is that of a row
MOST_READINGS = 300  # unless --every is given: a belief's moves weigh all readings before
SPACING_M = 1.0  # a vehicle that stays this near to where a reading began
HOVER_S = 10.0  # gives one reading in this time
GAP_S = 5.0  # a reading ends at a longer silence
VELOCITY_S = 1.0  # a velocity is taken from places this long before and after
TELEMETRY_S = 0.5  # between two positions of the vehicle


def read(
    path: Path,
    *,
    columns: str | None = None,
    wind: Pair | None = None,
    every_s: float | None = None,
    background: float | None = None,
    ray_m: float | None = None,
    origin: Pair | None = None,
    area_m: float | None = None,
) -> LoggedFlight:
    """Read a table; raises BadInput if it yields no readings or an argument is not allowed.

    columns: see `columns.parse`; default: those of the preset that its first row is like. wind: (speed in
    m/s, direction it comes from in degrees clockwise from north), instead of the table's. every_s: a reading
    is the mean of the rows of at least this time. background: of the gas, in the table's unit; default: that
    of clean air in the flight. ray_m: length of the path that a sensor in ppm*m looks along, straight down;
    default: the table's. origin: (north, east) in m of the search area's south-west corner from the table's
    first position; default: so that the flight lies in the middle. area_m: the side of the area.
    """
    if every_s is not None and every_s < LEAST_EVERY_S:
        raise BadInput(
            f"--every: {every_s:g} s is not allowed with {path}; wanted {LEAST_EVERY_S:g} s or more"
        )
    check(wind, every_s, origin, area_m)
    took, used = samples(path, columns, min(every_s or INTERVAL_S, INTERVAL_S))
    notes = [_note_on_rows(path, took), *took.notes]
    notes += [f"left out: {line}" for line in took.left_out]
    background_g, noise, ray_m = _gas(path, took, used, background, ray_m, notes)
    winds = _winds(path, took, used, wind, notes)
    height_m = np.nan_to_num(spread_over(took.times_s, took.height_m, math.inf))

    fit = _usable(took, winds, notes)
    if not len(fit):
        raise BadInput(
            f"{path}: none of its {took.used:,} samples has a place and a wind; give --wind SPEED,FROM"
        )
    every = every_s or max(USUAL_EVERY_S, math.ceil(_length_s(took.times_s[fit]) / MOST_READINGS))
    pieces = [fit[piece] for piece in _pieces(took.times_s[fit], _flat(took)[fit], every)]
    lat, lon, gas, up, at_s = (
        np.array([values[piece].mean() for piece in pieces])
        for values in (took.lat_deg, took.lon_deg, took.gas - background_g, height_m, took.times_s)
    )
    air = np.array([winds[piece].mean(axis=0) for piece in pieces])

    zero = float(took.lat_deg[0]), _within(float(took.lon_deg[0]))
    ground = [to_local(*zero, *each) for each in zip(lat.tolist(), map(_within, lon.tolist()), strict=True)]
    side_m, corner = fitted_area([(*each, 0.0) for each in ground], origin, area_m, None)
    home = to_global(*zero, *corner)
    origin_s = float(took.times_s[0])
    late = int(np.count_nonzero(at_s - origin_s >= WRAP_MS / 1000.0))
    if 2 * late > len(pieces):
        raise BadInput(
            f"{path}: {late:,} of its {len(pieces):,} readings are later than 49 days after the first row, "
            f"{_clock_text(took)}; wanted one flight, and its first rows with the right time"
        )
    readings: list[Reading] = []
    for index in range(len(pieces)):
        north, east = to_local(*home, float(lat[index]), _within(float(lon[index])))
        x, y = float32(east), float32(north)
        time_ms = round(1000.0 * (float(at_s[index]) - origin_s))
        if 0.0 <= x <= side_m and 0.0 <= y <= side_m and time_ms < WRAP_MS:
            wind_here = float32(air[index, 0]), float32(air[index, 1])
            readings.append(Reading(time_ms, (x, y), float32(up[index]), wind_here, float32(gas[index])))
    if outside := len(pieces) - len(readings):
        notes.append(f"left out: {counted(outside, 'reading')} outside the area, or later than 49 days")
    if not readings:
        raise BadInput(
            f"{path}: none of its {len(pieces):,} readings lies in the area; wanted another "
            "--origin or --area"
        )
    if len(gas) >= ENOUGH:
        noise = clean_air(gas).noise
    notes.append(f"{note_on_readings(readings, 0.0)}; noise of a reading {noise:.2g}")
    notes.append(
        f"a reading is the mean of the rows of {every:g} s, longer where the vehicle moved less than "
        f"{SPACING_M:g} m, up to {HOVER_S:g} s"
    )
    notes.append(f"area: side {side_m:g} m, south-west corner at {home[0]:.7f}, {home[1]:.7f}")
    entries = _entries(took, home, height_m, readings)
    return LoggedFlight(entries, SYSTEM, side_m, Origin(*corner, *home), notes, Sensed(noise, ray_m))


# ---- gas ----


def _gas(
    path: Path, took: Samples, used: Columns, background: float | None, ray_m: float | None, notes: list[str]
) -> tuple[float, float, float]:
    """Return the background and a row's noise, as `Samples.gas`, and the length of the path, m; 0: none."""
    unit = gas_unit(used["gas"])
    factor = unit.factor(float(took.temperature_c.mean()), float(took.pressure_hpa.mean()))
    clean = clean_air(took.gas)
    subtracted = clean.background if background is None else background * factor
    how = f"that of clean air, {100 * clean.share:.0f}% of the flight" if background is None else "as given"
    to = "g/m²" if unit.is_along_path else "g/m³"
    text = f"gas: {used['gas'].name} in {unit.text()}; 1 {unit.name} is {factor:.4g} {to}"
    if unit.is_by_air:
        told = [name for name in ("temperature", "pressure") if name in used]
        mean = f"{took.temperature_c.mean():.4g} °C and {took.pressure_hpa.mean():.6g} hPa"
        text += f" at {mean}" + (" on average" if told else ", which the table does not say")
    notes.append(text)
    notes.append(
        f"background: {subtracted / factor:.4g} {unit.name} ({subtracted:.4g} {to}) is subtracted, {how}; "
        f"the noise of a row is {clean.noise / factor:.2g} {unit.name}"
    )
    if not unit.is_along_path:
        if ray_m is not None:
            raise BadInput(f"--ray: not allowed with gas in {unit.name}; wanted only with ppm*m")
        return subtracted, clean.noise, 0.0
    if ray_m is None:
        rays = took.path_m[took.path_m > 0.0]
        if not len(rays):
            no_path = "no column says how long the path is"
            lacks = f"{used['path'].name} is above 0 in no row" if "path" in used else no_path
            raise BadInput(
                f"{path}: {used['gas'].name} is in {unit.name} and {lacks}; "
                "give --ray M, the height of the sensor above the ground"
            )
        ray_m = float(np.median(rays))
        notes.append(f"path: {ray_m:.3g} m straight down, the median of {used['path'].name}")
    else:
        notes.append(f"path: {ray_m:g} m straight down, as given")
    return subtracted, clean.noise, ray_m


# ---- wind and place ----


def _winds(path: Path, took: Samples, used: Columns, wind: Pair | None, notes: list[str]) -> Floats:
    """Return the wind of each sample, (N, 2), (x east, y north) m/s; NaN where it is not known."""
    if wind is not None:
        speed, from_deg = wind
        notes.append(f"wind: {speed:g} m/s from {from_deg:g}°, as given")
        toward = math.radians(from_deg)
        return np.tile([speed * math.sin(toward), speed * math.cos(toward)], (len(took.times_s), 1))
    if "wind" not in used:
        raise BadInput(
            f"{path}: no column says the wind; name it with --columns wind=COLUMN,from=COLUMN, or give "
            "--wind SPEED,FROM"
        )
    winds = spread_over(took.times_s, took.wind, WIND_AGE_MS / 1000.0)
    how = "over the ground, degrees clockwise from north"
    if "heading" in used:
        how = f"as the moving vehicle meets it, from its nose ({used['heading'].name})"
        winds = winds - _velocity(took)
    notes.append(f"wind: {used['wind'].name} and {used['from'].name}, {how}")
    return winds


def _flat(took: Samples) -> Floats:
    """Return places, (N, 2) m east and north of the flight's middle, good enough to compare them."""
    lat, lon = np.radians(took.lat_deg), np.radians(took.lon_deg)
    middle_lat, middle_lon = np.median(lat), np.median(lon)
    east = EARTH_RADIUS_M * (lon - middle_lon) * np.cos(middle_lat)
    return np.stack([east, EARTH_RADIUS_M * (lat - middle_lat)], axis=1)


def _velocity(took: Samples) -> Floats:
    """Return the vehicle's velocity over the ground, (N, 2) m/s east and north."""
    times_s, places = took.times_s, _flat(took)
    before = np.searchsorted(times_s, times_s - VELOCITY_S)
    after = np.searchsorted(times_s, times_s + VELOCITY_S, side="right") - 1
    took_s = np.maximum(times_s[after] - times_s[before], 1e-3)
    return np.asarray((places[after] - places[before]) / took_s[:, np.newaxis])


def _usable(took: Samples, winds: Floats, notes: list[str]) -> "np.ndarray[tuple[int], np.dtype[np.int64]]":
    """Return the indices of the samples with a wind and a place where the vehicle can have been."""
    places = _flat(took)
    is_far = np.linalg.norm(places, axis=1) > FARTHEST_M
    near = np.flatnonzero(~is_far)
    is_away = np.zeros(len(places), np.bool_)
    is_away[near] = jumped(took.times_s[near], places[near], notes)
    is_calm = np.isnan(winds).any(axis=1)
    is_lost = is_far | is_away
    for which, what in (
        (is_far, f"more than {FARTHEST_M / 1000:g} km from the middle of the flight"),
        (is_away, OUT_OF_REACH),
        (is_calm & ~is_lost, f"without a wind in the {WIND_AGE_MS / 1000:g} s before"),
    ):
        if count := int(np.count_nonzero(which)):
            first = int(np.argmax(which))
            at_s = took.times_s[first] - took.times_s[0]
            notes.append(f"left out: {counted(count, 'sample')} {what}, the first at {at_s:.1f} s")
    return np.flatnonzero(~is_lost & ~is_calm)


def _length_s(times_s: Floats) -> float:
    """Return how long a flight is without its gaps."""
    return float(np.minimum(np.diff(times_s), GAP_S).sum())


def _pieces(times_s: Floats, places: Floats, every_s: float) -> list[slice]:
    """Return the samples of each reading: those of `every_s`, of a hover those of up to `HOVER_S`.

    times_s: (N,); places: (N, 2) m.
    """
    pieces, begin = [], 0
    for now in range(1, len(times_s) + 1):
        if now < len(times_s) and times_s[now] - times_s[now - 1] <= max(GAP_S, every_s):
            long_s = times_s[now] - times_s[begin]
            if long_s < every_s - 1e-6:
                continue
            if long_s < HOVER_S and math.dist(places[now], places[begin]) < SPACING_M:
                continue
        pieces.append(slice(begin, now))
        begin = now
    return pieces


def _within(lon_deg: float) -> float:
    return lon_deg if abs(lon_deg) <= 180.0 else math.remainder(lon_deg, 360.0)


# ---- what is said of it ----


def _note_on_rows(path: Path, took: Samples) -> str:
    zone = "UTC" if took.has_zone else "(no time zone given, taken as UTC)"
    began = f" from {_clock_text(took)} {zone}" if took.is_dated else ""
    long_s = float(took.times_s[-1] - took.times_s[0])
    return f"{path.name}: {counted(took.rows, 'row')}, {took.used:,} used, in {long_s:,.1f} s{began}"


def _clock_text(took: Samples) -> str:
    """Return when a flight began."""
    first_s = float(took.times_s[0])
    return f"{datetime.fromtimestamp(first_s, UTC):%Y-%m-%d %H:%M:%S}" if took.is_dated else f"{first_s:g} s"


def _entries(took: Samples, home: Pair, height_m: Floats, readings: list[Reading]) -> list[Entry]:
    """Return the readings and the telemetry of a vehicle that flies along the table's places, by time.

    Its home is the search area's corner, as a search's is.
    """
    codec, first_s = Codec(SYSTEM, AUTOPILOT), float(took.times_s[0])
    dated_s = first_s if took.is_dated else 0.0
    entries = []

    def add(key: str, time_ms: int, payload: bytes) -> None:
        entries.append(Entry(key, round(1e9 * dated_s) + 1_000_000 * time_ms, time_ms / 1000.0, payload))

    def said(time_ms: int, *messages: Message) -> None:
        add(MAVLINK_OUT.name, time_ms, codec.pack(*messages))

    home_e7 = round(home[0] * 1e7), round(home[1] * 1e7)
    said(
        0,
        mavlink.MAVLink_gps_global_origin_message(*home_e7, 0, 0),
        mavlink.MAVLink_home_position_message(
            *home_e7, 0, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0
        ),
    )
    next_s = -math.inf
    armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    for index, at_s in enumerate((took.times_s - first_s).tolist()):
        if at_s < next_s:
            continue
        next_s, time_ms = at_s + TELEMETRY_S, round(1000.0 * at_s)
        if time_ms >= WRAP_MS:
            break
        lat, lon, up = float(took.lat_deg[index]), _within(float(took.lon_deg[index])), float(height_m[index])
        north, east = to_local(*home, lat, lon)
        up_mm = round(1000.0 * up)
        place_e7 = round(lat * 1e7), round(lon * 1e7)
        said(
            time_ms,
            mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_GENERIC, armed, 0, 4, 3
            ),
            mavlink.MAVLink_system_time_message(
                round(1e6 * (dated_s + at_s)) if took.is_dated else 0, time_ms
            ),
            mavlink.MAVLink_local_position_ned_message(time_ms, north, east, -up, 0.0, 0.0, 0.0),
            mavlink.MAVLink_global_position_int_message(time_ms, *place_e7, up_mm, up_mm, 0, 0, 0, 65535),
        )
    for reading in readings:
        add(READING.name, reading.time_boot_ms, pack_reading(codec, reading))
    return sorted(entries, key=lambda entry: entry.published_ns)
