"""Which column of a table holds what, in which unit: `--columns`, and the presets."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ground.tlog import units
from link.cli import BadInput
from link.terminal import printable

# What a column can hold, with its units: the value of one, in the unit that is listed first.
SCALES: Mapping[str, Mapping[str, tuple[float, float]]] = {
    # name: {unit: (factor, offset)}
    "lat": {"deg": (1.0, 0.0), "rad": (57.29577951308232, 0.0), "1e7": (1e-7, 0.0)},
    "lon": {"deg": (1.0, 0.0), "rad": (57.29577951308232, 0.0), "1e7": (1e-7, 0.0)},
    "height": {"m": (1.0, 0.0), "ft": (0.3048, 0.0)},
    "wind": {"m/s": (1.0, 0.0), "km/h": (1 / 3.6, 0.0), "kn": (0.514444, 0.0), "mph": (0.44704, 0.0)},
    "from": {"deg": (1.0, 0.0)},
    "heading": {"deg": (1.0, 0.0)},
    "temperature": {"C": (1.0, 0.0), "K": (1.0, -273.15), "F": (5 / 9, -160 / 9)},
    "pressure": {"hPa": (1.0, 0.0), "Pa": (0.01, 0.0), "kPa": (10.0, 0.0), "bar": (1000.0, 0.0)},
    "path": {"m": (1.0, 0.0), "ft": (0.3048, 0.0)},
    "status": {"": (1.0, 0.0)},
}
# What is allowed of each, in the unit that is listed first.
LIMITS: Mapping[str, tuple[float, float]] = {
    "lat": (-90.0, 90.0),
    "lon": (-180.0, 180.0),
    "height": (-1000.0, 9000.0),
    "wind": (0.0, 100.0),
    "from": (-360.0, 360.0),
    "heading": (-360.0, 360.0),
    "temperature": (-90.0, 70.0),
    "pressure": (300.0, 1100.0),
    "path": (0.0, 1000.0),
    "gas": (-units.GREATEST, units.GREATEST),
}
TIMES = ("auto", "s", "ms", "us")  # of a number; text says itself what it is
NAMES = ("time", "date", "lat", "lon", "gas", *(name for name in SCALES if name not in ("lat", "lon")))
NEEDED = ("time", "lat", "lon", "gas")
VALID = (0.0, 1.0)  # of a status
LISTED, LONGEST = 20, 40  # names of columns that are listed, and the characters of one
ZONE = re.compile(r"([+-])([01]\d|2[0-3]):?([0-5]\d)")


class LoggedColumn(NamedTuple):
    """A column of a table."""

    name: str  # as the table's first row has it
    unit: str = ""  # empty: the usual one
    is_optional: bool = False  # a preset's that some tables lack

    def text(self) -> str:
        """Return it as `--columns` takes it."""
        return f"{self.name}@{self.unit}" if self.unit else self.name


Columns = Mapping[str, LoggedColumn]

PRESETS: Mapping[str, Columns] = {
    # SPH Engineering's SkyHub, with the laser of Pergam: https://github.com/ugcs/positiondata
    "skyhub": {
        "date": LoggedColumn("Date"),
        "time": LoggedColumn("Time"),
        "lat": LoggedColumn("Latitude"),
        "lon": LoggedColumn("Longitude"),
        "height": LoggedColumn("Altitude", is_optional=True),
        "gas": LoggedColumn("GAS:Methane", "ppm*m"),
        "status": LoggedColumn("GAS:Status", is_optional=True),
        "wind": LoggedColumn("AIR:Speed", is_optional=True),
        "from": LoggedColumn("AIR:Direction", is_optional=True),
        "path": LoggedColumn("ALT:Altitude", is_optional=True),
    },
    # The package gasflux: https://github.com/gasflux/gasflux
    "gasflux": {
        "time": LoggedColumn("timestamp"),
        "lat": LoggedColumn("latitude"),
        "lon": LoggedColumn("longitude"),
        "height": LoggedColumn("height_ato"),
        "wind": LoggedColumn("windspeed"),
        "from": LoggedColumn("winddir"),
        "temperature": LoggedColumn("temperature"),
        "pressure": LoggedColumn("pressure"),
        "gas": LoggedColumn("ch4", "ppm"),
    },
}
ALLOWED = (
    f"{', '.join(PRESETS)}, or NAME=COLUMN or NAME=COLUMN@UNIT between commas, where NAME is "
    f"{', '.join(NAMES)}"
)


def parse(text: str) -> Columns:
    """Read `--columns`: a preset, NAME=COLUMN or NAME=COLUMN@UNIT between commas; later ones replace earlier.

    Raises BadInput.
    """
    columns: dict[str, LoggedColumn] = {}
    for item in text.split(","):
        name, equals, column = item.partition("=")
        if not equals and name in PRESETS:
            columns |= PRESETS[name]
        elif not equals or name not in NAMES:
            raise BadInput(f"--columns: {item!r} is not allowed; wanted {ALLOWED}")
        elif not column:
            columns.pop(name, None)
        else:
            called, _, unit = column.rpartition("@") if "@" in column else (column, "", "")
            columns[name] = LoggedColumn(called, unit)
    columns = {name: _checked(name, column) for name, column in columns.items()}
    if missing := [name for name in NEEDED if name not in columns]:
        raise BadInput(f"--columns: {missing[0]} has no column; wanted {missing[0]}=COLUMN")
    if ("wind" in columns) != ("from" in columns):
        lacks, has = ("from", "wind") if "wind" in columns else ("wind", "from")
        raise BadInput(
            f"--columns: {has}={columns[has].name} has no {lacks}; wanted wind=COLUMN, its speed, and "
            "from=COLUMN, the direction it comes from"
        )
    if "heading" in columns and "wind" not in columns:
        raise BadInput("--columns: heading is of no use without wind; wanted wind=COLUMN and from=COLUMN")
    return columns


def guess(header: Sequence[str]) -> str:
    """Return the preset that a table's first row is like; empty if none."""
    return next(
        (
            preset
            for preset, columns in PRESETS.items()
            if all(column.name in header or column.is_optional for column in columns.values())
        ),
        "",
    )


def shown(header: Sequence[str]) -> str:
    """Return the first names of a table's columns, for one line."""
    names = ", ".join(name if len(name) <= LONGEST else f"{name[:LONGEST]}…" for name in header[:LISTED])
    return printable(names) + (f" and {len(header) - LISTED:,} more" if len(header) > LISTED else "")


def in_table(columns: Columns, header: Sequence[str], path: object) -> dict[str, tuple[int, LoggedColumn]]:
    """Return the place of each column in the rows of a table. Raises BadInput if the table lacks one."""
    found: dict[str, tuple[int, LoggedColumn]] = {}
    for name, column in columns.items():
        many = header.count(column.name)
        if many > 1:
            raise BadInput(f"{path}, row 1: {column.name!r} is the name of {many} columns; wanted one")
        if many:
            found[name] = header.index(column.name), column
        elif not column.is_optional:
            raise BadInput(
                f"{path}, row 1: no column {column.name!r} for {name}; wanted one of {shown(header)}"
            )
    if "wind" not in found or "from" not in found:
        for name in ("wind", "from", "heading"):
            found.pop(name, None)
    return found


def gas_unit(column: LoggedColumn) -> units.GasUnit:
    """Return the unit of a gas column. Raises BadInput if it has none that is known."""
    try:
        return units.parse(column.unit)
    except ValueError as error:
        reason = str(error) if column.unit else f"wanted gas={column.name}@UNIT, {', '.join(units.UNITS)}"
        raise BadInput(f"--columns: gas={column.text()} is not allowed: {reason}") from None


def _checked(name: str, column: LoggedColumn) -> LoggedColumn:
    """Return a column with its unit, the usual one if it has none. Raises BadInput."""
    if name == "gas":
        gas_unit(column)
        return column
    allowed = TIMES if name == "time" else (*SCALES.get(name, ("",)),)
    if (unit := column.unit or allowed[0]) in allowed or (name == "time" and ZONE.fullmatch(unit)):
        return column._replace(unit=unit)
    more = ", or a zone such as +02:00" if name == "time" else ""
    wanted = f"@{', @'.join(allowed)}{more}" if any(allowed) else "no unit"
    raise BadInput(f"--columns: {name}={column.text()} is not allowed; wanted {wanted}")
