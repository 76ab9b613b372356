"""Buildings: prisms on the ground, read from a small YAML file in metres of the search plane."""

import re
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from ruamel.yaml.error import YAMLError

from plume.elementary import Array
from plume.mistakes.bounded_yaml import value_of
from plume.polygons import polygons
from plume.polygons.polygons import crosses_itself

ALTITUDE_M = 5.0  # height of the search plane above the ground, where a file does not say it
MOST_BYTES = 100_000
MOST_BUILDINGS, MOST_CORNERS, MOST_HEIGHTS = 50, 100, 8
FARTHEST_M = 1000.0  # greatest coordinate
WIDEST_M = 100.0  # the buildings together, west to east and south to north
SHIPPED = Path(__file__).parent

Corner = tuple[float, float]


class Building(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A prism from the ground up."""

    # Its corners in order, (x, y) m; the last is joined to the first.
    footprint: Annotated[tuple[Corner, ...], Meta(min_length=3, max_length=MOST_CORNERS)]
    height: float  # above the ground, m


class Buildings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All buildings, as a file has them."""

    buildings: Annotated[tuple[Building, ...], Meta(max_length=MOST_BUILDINGS)] = ()
    altitude: float = ALTITUDE_M  # of the search plane above the ground, m


def read(file: str) -> Buildings:
    """Return the buildings of a file, or of a shipped example by its name; none if the text is empty.

    Raises ValueError: one line that names the file, what is wrong and what is allowed.
    """
    if not file:
        return Buildings()
    path = Path(file)
    if re.fullmatch(r"[\w-]+", file) and not path.exists():
        path = SHIPPED / f"{file}.yaml"
        if not path.exists():
            names = ", ".join(sorted(each.stem for each in SHIPPED.glob("*.yaml")))
            raise ValueError(f"no file of buildings {file!r}; wanted a path or one of {names}")
    if path.exists() and not path.is_file():
        raise ValueError(f"{file}: cannot be read: a folder, a pipe or a device; wanted a file")
    try:
        with path.open("rb") as opened:
            content = opened.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        raise ValueError(f"{file}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(content) > MOST_BYTES:
        raise ValueError(f"{file}: more than {MOST_BYTES:,} bytes are not allowed")
    try:
        return parsed(content)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


@lru_cache(16)
def parsed(content: bytes) -> Buildings:
    """Return the buildings that the bytes of a file describe. Raises ValueError, a line without the file."""
    try:
        value = value_of(content.decode())
    except (YAMLError, ValueError, RecursionError, LookupError) as error:
        what = getattr(error, "problem", None) or str(error).split("\n")[0]
        mark = getattr(error, "problem_mark", None)
        raise ValueError(f"{f'line {mark.line + 1}: ' if mark else ''}not valid YAML: {what}") from None
    try:
        found = msgspec.convert(value, Buildings)
    except (msgspec.ValidationError, OverflowError) as error:
        what, _, where = str(error).partition(" - at ")
        where = where.strip("`$").lstrip(".") or "the file"
        raise ValueError(
            f"{where}: {what[:200]}; wanted `buildings`, a list of objects with `footprint: [[x, y], …]` "
            "and `height`, and perhaps `altitude`"
        ) from None
    _check(found)
    return found


def _check(found: Buildings) -> None:
    if not 0 < found.altitude <= FARTHEST_M:
        raise ValueError(f"altitude is {found.altitude:g}; wanted metres above 0, at most {FARTHEST_M:g}")
    for number, building in enumerate(found.buildings):
        where = f"buildings[{number}]"
        if not 0 < building.height <= FARTHEST_M:
            raise ValueError(
                f"{where}.height is {building.height:g}; wanted metres above 0, at most {FARTHEST_M:g}"
            )
        for corner in building.footprint:
            if not all(abs(part) <= FARTHEST_M for part in corner):
                raise ValueError(
                    f"{where}.footprint has the corner {list(corner)}; wanted metres within ±{FARTHEST_M:g}"
                )
        if crossing := crosses_itself(outline(building)):
            one, other = crossing
            raise ValueError(
                f"{where}.footprint crosses or touches itself: its sides {one + 1} and {other + 1} meet; "
                "wanted the corners in order around it"
            )
    if len({building.height for building in found.buildings}) > MOST_HEIGHTS:
        raise ValueError(f"more than {MOST_HEIGHTS} different heights are not allowed")
    if found.buildings:
        corners = np.vstack([outline(building) for building in found.buildings])
        wide = (corners.max(axis=0) - corners.min(axis=0)).max()
        if wide > WIDEST_M:
            raise ValueError(f"the buildings extend over {wide:g} m; wanted {WIDEST_M:g} m at most")


def outline(building: Building) -> Array:
    """Return the corners (K, 2) of a footprint, without those that are where the next one is, around it."""
    return polygons.outline(building.footprint)
