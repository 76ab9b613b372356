"""The rows of a table as samples: position, gas and wind over short intervals, in units of ours.

A table may have more rows than memory: what is kept grows with the flight, not with the rows.
"""

import contextlib
import math
import re
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ground.logs import columns as names
from ground.logs.columns import LIMITS, SCALES, VALID, ZONE, Columns, LoggedColumn
from ground.logs.table import TextTable, number, read
from ground.tlog.clock import Floats
from ground.tlog.units import STANDARD_C, STANDARD_HPA, GasUnit
from link.cli import BadInput
from link.terminal import printable
from plume.geodesy import EARTH_RADIUS_M

INTERVAL_S = 0.2  # rows within this time are averaged first
MOST_SAMPLES = 4_000_000
LATEST_S = 4_102_444_800.0  # the year 2100
EPOCH_S, EPOCH_MS, EPOCH_US = 1e8, 1e11, 1e14  # a greater number is a time since 1970 in s, ms, µs
DAY_FIRST = re.compile(r"(\d\d?)\.(\d\d?)\.(\d{4})")
LONGEST = 40  # characters of a value that are quoted
EARLIER = "earlier than a row before"  # why a row is left out
# Rows of several vehicles follow each other: far from the row before, and faster than they fly.
FEW, FAR_M, FAST_MPS = 4, 5.0, 20.0
LISTED = 5  # reasons that are listed where no row can be used
QUANTITIES = ("gas", "lat", "lon", "height", "east", "north", "temperature", "pressure", "path")


class Samples(NamedTuple):
    """Means over short intervals, in order of time: arrays (N,), NaN where no row had a value."""

    times_s: Floats  # since 1970, or since the log's own beginning
    gas: Floats  # g/m³, or g/m² along a path
    lat_deg: Floats
    lon_deg: Floats
    height_m: Floats
    wind: Floats  # (N, 2), (x east, y north) m/s, points to where it comes from
    temperature_c: Floats
    pressure_hpa: Floats
    path_m: Floats
    rows: int  # that were read
    used: int
    left_out: list[str]  # what was left out and why, a line a reason
    notes: list[str]
    is_dated: bool  # whether times are since 1970
    has_zone: bool  # whether the log says the time zone


def samples(path: Path, columns: str | None, interval_s: float = INTERVAL_S) -> tuple[Samples, Columns]:
    """Read a table. columns: as of `--columns`; None: those of the preset that its first row is like.

    Also return the columns that were used. Raises BadInput.
    """
    try:
        with path.open("rb") as file:
            table = read(path, file)
            preset = names.guess(table.header)
            if columns is None and not preset:
                raise BadInput(
                    f"{path}: its columns are of none of the presets ({', '.join(names.PRESETS)}); give "
                    "--columns time=COLUMN,lat=COLUMN,lon=COLUMN,gas=COLUMN@UNIT,wind=COLUMN,from=COLUMN of "
                    f"{names.shown(table.header)}"
                )
            wanted = names.parse(columns or preset)
            found = names.in_table(wanted, table.header, path)
            reader = _Reader(path, found, names.gas_unit(wanted["gas"]), interval_s)
            if columns is None:
                reader.notes.append(f"columns: those of {preset}, by the first row")
            reader.notes += [f"{path.name}: {table.told}"] * bool(table.told)
            reader.read(table)
    except OSError as error:
        raise BadInput(f"{path} cannot be read: {error.strerror}") from None
    return reader.result(), {name: column for name, (_, column) in found.items()}


class _Bad(Exception):
    """A row that is left out: the reason, and the row's own words."""

    def __init__(self, reason: str, words: str) -> None:
        self.reason, self.words = reason, words


class _Reader:
    """Reads rows one by one and keeps means over intervals."""

    def __init__(
        self, path: Path, found: dict[str, tuple[int, LoggedColumn]], unit: GasUnit, interval_s: float
    ) -> None:
        self._path, self._unit, self._interval_s = path, unit, interval_s
        self._found = found
        self._places = [place for name, (place, _) in found.items() if name not in ("time", "date")]
        self._last_cells: list[str] = []
        self._newest_s = -math.inf
        self._first_s = self._first_lon = math.nan
        self._number = -1  # of the interval
        self._sums = [0.0] * (1 + len(QUANTITIES))
        self._counts = [0] * (1 + len(QUANTITIES))
        self._means: list[list[float]] = []
        self._out: dict[str, tuple[int, str]] = {}  # by reason: how many, and the first
        self._rows = self._used = self._repeated = self._to_and_fro = 0
        self._newest: deque[tuple[float, float, float]] = deque(maxlen=FEW)  # time, latitude, longitude
        self._is_dated = self._has_zone = False
        self._factor = unit.factor()
        self.notes: list[str] = []
        self._time = _time_of(found)

    def read(self, table: TextTable) -> None:
        """Read all rows."""
        width = len(table.header)
        for row, cells in table.rows:
            self._rows += 1
            try:
                if len(cells) > width and any(map(str.strip, cells[width:])):
                    reason = f"{len(cells)} cells; wanted {width} (has it decimal commas without quotes?)"
                    raise _Bad("too long", f"row {row} has {reason}")
                self._take(row, [cell.strip() for cell in cells])
            except _Bad as bad:
                count, first = self._out.get(bad.reason, (0, bad.words))
                self._out[bad.reason] = count + 1, first
        self._close()

    def _take(self, row: int, cells: list[str]) -> None:
        short = max(place for place, _ in self._found.values())
        if len(cells) <= short:
            lacks = next(column.name for place, column in self._found.values() if place >= len(cells))
            raise _Bad(
                "too short", f"row {row} has {len(cells)} cells and no {lacks}; wanted {short + 1} or more"
            )
        at_s = self._seconds(row, cells)
        if at_s < self._newest_s:
            reason = f"is {self._newest_s - at_s:.3f} s before the row before; wanted times that go on"
            raise _Bad(EARLIER, f"row {row}: {self._names('time')} {reason}")
        this = [cells[place] for place in self._places]
        if this == self._last_cells:
            self._repeated += 1
            return
        values = self._values(row, cells)
        self._last_cells = this
        if math.isnan(self._first_s):
            self._first_s, self._first_lon = at_s, values[QUANTITIES.index("lon")]
        self._newest_s = at_s
        self._follow(at_s, *values[1:3])
        if (now := math.floor((at_s - self._first_s) / self._interval_s + 1e-6)) != self._number:
            self._close()
            self._number = now
        lon = QUANTITIES.index("lon")  # around the first one: beyond 180° they go on
        values[lon] = self._first_lon + math.remainder(values[lon] - self._first_lon, 360.0)
        for index, value in enumerate((at_s, *values)):
            if value == value:
                self._sums[index] += value
                self._counts[index] += 1
        self._used += 1

    def _follow(self, at_s: float, lat_deg: float, lon_deg: float) -> None:
        """Count a row that is far from the row before, and near to one before that."""
        shrink = math.cos(math.radians(lat_deg))

        def way_m(then: tuple[float, float, float]) -> float:
            east_deg = shrink * math.remainder(then[2] - lon_deg, 360.0)
            return EARTH_RADIUS_M * math.radians(math.hypot(then[1] - lat_deg, east_deg))

        *earlier, last = self._newest or [(at_s, lat_deg, lon_deg)]
        step_m = way_m(last)
        if step_m > max(FAR_M, FAST_MPS * (at_s - last[0])):
            self._to_and_fro += any(4.0 * way_m(then) < step_m for then in earlier)
        self._newest.append((at_s, lat_deg, lon_deg))

    def _values(self, row: int, cells: list[str]) -> list[float]:
        """Return a row's quantities; raises _Bad where it has no position or no valid gas."""
        lat, lon = self._value("lat", row, cells), self._value("lon", row, cells)
        if lat == lon == 0.0:
            raise _Bad(
                "at 0, 0", f"row {row}: {self._names('lat', 'lon')} are 0, 0: no fix; wanted a position"
            )
        if "status" in self._found:
            self._value("status", row, cells)
        gas = self._value("gas", row, cells)
        air = STANDARD_C, STANDARD_HPA
        if self._unit.is_by_air and ("temperature" in self._found or "pressure" in self._found):
            air = (
                self._value("temperature", row, cells) if "temperature" in self._found else STANDARD_C,
                self._value("pressure", row, cells) if "pressure" in self._found else STANDARD_HPA,
            )
            gas *= self._unit.factor(*air)
        else:
            gas *= self._factor
        east = north = math.nan
        if "wind" in self._found:
            speed, toward = self._optional("wind", row, cells), self._optional("from", row, cells)
            if "heading" in self._found:
                toward += self._optional("heading", row, cells)
            east = speed * math.sin(math.radians(toward))
            north = speed * math.cos(math.radians(toward))
        height, ray = (
            self._optional(name, row, cells) if name in self._found else math.nan
            for name in ("height", "path")
        )
        return [gas, lat, lon, height, east, north, *air, ray]

    def _value(self, name: str, row: int, cells: list[str]) -> float:
        """Return a number of a row in the usual unit; raises _Bad."""
        place, column = self._found[name]
        text = cells[place]
        with contextlib.suppress(ValueError):
            value = number(text, beside=cells[self._found["lat"][0]])
            if name == "status" and value in VALID:
                return value
            if name != "status":
                factor, offset = SCALES[name][column.unit] if name in SCALES else (1.0, 0.0)
                low, high = LIMITS[name]
                if low <= (scaled := factor * value + offset) <= high:
                    return scaled
        raise _bad(name, column, row, text)

    def _optional(self, name: str, row: int, cells: list[str]) -> float:
        """Return a number of a row; NaN where it has none, which is counted."""
        try:
            return self._value(name, row, cells)
        except _Bad as bad:
            reason = f"{bad.reason}, used without it"
            count, first = self._out.get(reason, (0, bad.words))
            self._out[reason] = count + 1, first
            return math.nan

    def _seconds(self, row: int, cells: list[str]) -> float:
        """Return a row's time; raises _Bad."""
        text = cells[self._found["time"][0]]
        if "date" in self._found:
            text = f"{cells[self._found['date'][0]]} {text}"
        try:
            at_s, is_dated, has_zone = self._time(text)
        except (ValueError, OverflowError):
            at_s, is_dated, has_zone = math.nan, False, False
        if not (0.0 if is_dated else -LATEST_S) <= at_s < LATEST_S:
            wanted = "a time such as 2026-11-26T12:00:00.5Z, or a number of seconds"
            name = self._names("date", "time") if "date" in self._found else self._names("time")
            raise _Bad(f"without {name}", f"row {row}: {name} is {_quoted(text)}; wanted {wanted}")
        self._is_dated |= is_dated
        self._has_zone |= has_zone
        return at_s

    def _names(self, *roles: str) -> str:
        return " and ".join(self._found[role][1].name for role in roles)

    def _close(self) -> None:
        """Keep the means of the interval that is over."""
        if self._counts[0]:
            if len(self._means) >= MOST_SAMPLES:
                raise BadInput(
                    f"{self._path}: it holds more than {MOST_SAMPLES:,} intervals of {self._interval_s:g} s; "
                    "wanted a part of it"
                )
            pairs = zip(self._sums, self._counts, strict=True)
            self._means.append([total / count if count else math.nan for total, count in pairs])
        self._sums = [0.0] * len(self._sums)
        self._counts = [0] * len(self._counts)

    def result(self) -> Samples:
        """Return what was read; raises BadInput if no row could be used."""
        told = [
            f"{count:,} {'row' if count == 1 else 'rows'} {reason}: first {words}"
            for reason, (count, words) in self._out.items()
        ]
        if not self._means:
            why = printable("; ".join(told[:LISTED])) or "it has no rows after the first"
            raise BadInput(f"{self._path}: none of its {self._rows:,} rows can be a sample; {why}")
        if (earlier := self._out.get(EARLIER, (0, ""))) and earlier[0] > self._used:
            raise BadInput(
                f"{self._path}: {earlier[0]:,} of its {self._rows:,} rows are {EARLIER}: first "
                f"{printable(earlier[1])} (is the time of a row before it wrong?)"
            )
        if self._repeated:
            self.notes.append(
                "1 row that repeats the row before but for the time counts once"
                if self._repeated == 1
                else f"{self._repeated:,} rows that repeat the row before but for the time count once"
            )
        if 3 * self._to_and_fro > self._used:
            self.notes.append(
                f"{self._to_and_fro:,} of {self._used:,} rows are far from the row before and near to one "
                "before that: are there two vehicles in the table? wanted the rows of one"
            )
        columns = dict(zip(("time", *QUANTITIES), np.array(self._means).T, strict=True))
        return Samples(
            columns["time"],
            columns["gas"],
            columns["lat"],
            columns["lon"],
            columns["height"],
            np.stack([columns["east"], columns["north"]], axis=1),
            columns["temperature"],
            columns["pressure"],
            columns["path"],
            self._rows,
            self._used,
            [printable(line) for line in told],
            self.notes,
            self._is_dated,
            self._has_zone,
        )


def _bad(name: str, column: LoggedColumn, row: int, text: str) -> _Bad:
    """Return why a cell is not taken, in the unit of its column."""
    try:
        value = number(text)
    except ValueError:
        value = math.nan
    kind = f"with a {column.name} that is not allowed" if math.isfinite(value) else f"without {column.name}"
    wanted, hint = "a number", ""
    if name == "status":
        wanted = " or ".join(f"{each:g}" for each in VALID)
    elif name in SCALES:
        factor, offset = SCALES[name][column.unit]
        low, high = ((limit - offset) / factor for limit in LIMITS[name])
        wanted = f"a number from {low:g} to {high:g} {column.unit}"
    elif math.isfinite(value):
        wanted = "a number from {:g} to {:g}".format(*LIMITS[name])
    if name == "lat" and 90.0 < abs(value) <= 180.0:
        hint = " (are latitude and longitude swapped?)"
    return _Bad(kind, f"row {row}: {column.name} is {_quoted(text)}; wanted {wanted}{hint}")


def _time_of(found: dict[str, tuple[int, LoggedColumn]]) -> Callable[[str], tuple[float, bool, bool]]:
    """Return a function from the text of a time to (s, whether since 1970, whether with a zone)."""
    unit = found["time"][1].unit
    zone = UTC
    if match := ZONE.fullmatch(unit):
        sign, hours, minutes = match.groups()
        zone = timezone((1 if sign == "+" else -1) * timedelta(hours=int(hours), minutes=int(minutes)))
    scale = {"s": 1.0, "ms": 1e-3, "us": 1e-6}.get(unit)
    has_date = "date" in found

    def seconds(text: str) -> tuple[float, bool, bool]:
        if not has_date:
            try:
                value = number(text)
            except ValueError:
                if scale:
                    raise
            else:
                size = abs(value)
                factor = scale or (1e-6 if size > EPOCH_US else 1e-3 if size > EPOCH_MS else 1.0)
                return value * factor, size * factor > EPOCH_S, size * factor > EPOCH_S
        said = datetime.fromisoformat(_iso(text))
        with_zone = said.tzinfo is not None or bool(match)
        return (said if said.tzinfo else said.replace(tzinfo=zone)).timestamp(), True, with_zone

    return seconds


def _iso(text: str) -> str:
    """Return a date and time as ISO 8601 has them: 2026/11/26 and 26.11.2026 are dates, too."""
    text = text.strip().replace("/", "-").replace(",", ".")
    if match := DAY_FIRST.match(text):
        day, month, year = match.groups()
        text = f"{year}-{month:0>2}-{day:0>2}{text[match.end() :]}"
    return text.replace(" UTC", "Z").replace(" Z", "Z")


def _quoted(text: str) -> str:
    """Quote a cell for one line of a terminal."""
    return repr(text if len(text) <= LONGEST else f"{text[:LONGEST]}…") if text else "empty"


def spread_over(times_s: Floats, values: Floats, age_s: float) -> Floats:
    """Return values with gaps filled by the last one before, at most `age_s` old; NaN elsewhere.

    values: (N,) or (N, 2), NaN where there is none.
    """
    there = np.flatnonzero(~np.isnan(values.reshape(len(values), -1)).any(axis=1))
    if not len(there):
        return values
    last = there[np.maximum(np.searchsorted(there, np.arange(len(values)), side="right") - 1, 0)]
    filled: Floats = values[last].copy()
    filled[np.abs(times_s - times_s[last]) > age_s] = math.nan
    return filled
