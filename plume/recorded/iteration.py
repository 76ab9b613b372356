"""One `iteration_K` of GADEN's results: a zlib stream with the filaments, or the concentrations, of a moment.

| version | space | source | constants | each filament |
|---|---|---|---|---|
| 1 | float64 | place, gas | float64 | index, then x, y, z, σ as float64: 36 bytes |
| 2.0 to 2.5 | float32 | place, gas | float64 | the same 36 bytes |
| 2.6 and later | float32 | none | float32 | index, then x, y, z, σ as float32: 20 bytes |
| 3.x | float32 | shape, its sizes, place, gas | float32 | x, y, z, σ as float32, and four bytes |

Little-endian, without gaps. 3.x says in a text of which length follows, "filaments" or "concentrations", and
counts them; before, filaments fill the rest. Source: MAPIRlab/gaden, branches ros1 and ros2, and
MAPIRlab/gaden_core.
"""

import math
import struct
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plume.elementary import Array
from plume.recorded.footage import MOST_BYTES, content_of

SHAPES = {"point": "", "box": "3f", "line": "3f", "sphere": "f", "cylinder": "2f"}  # and their sizes
GASES = (
    *("ethanol", "methane", "hydrogen", "propanol", "chlorine", "fluorine", "acetone", "neon", "helium"),
    *("biogas", "butane", "carbon dioxide", "carbon monoxide", "smoke"),
)
LONGEST_TEXT = 32
WITH_INDEX_64 = np.dtype([("index", "<i4"), ("place", "<f8", 3), ("sigma", "<f8")])
WITH_INDEX_32 = np.dtype([("index", "<i4"), ("place", "<f4", 3), ("sigma", "<f4")])
WITHOUT_INDEX = np.dtype([("place", "<f4", 3), ("sigma", "<f4"), ("active", "<i4")])


class Grid(NamedTuple):
    """The cells of a space: how many along x, y, z, where they begin and end, and their side, m."""

    cells: tuple[int, int, int]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    side: float

    @property
    def total(self) -> int:
        """How many cells there are."""
        return self.cells[0] * self.cells[1] * self.cells[2]


class Moment(NamedTuple):
    """What an iteration says."""

    version: str
    grid: Grid
    shape: str  # of the source, "" where the file does not say
    source: tuple[float, float, float] | None
    gas: str  # "" where the file does not say
    moles: float  # of the gas in a filament
    air: float  # moles of all gases in a cm³
    wind: int  # number of its wind
    filaments: Array | None  # (N, 4): x, y, z in m, σ in cm
    ppm: NDArray[np.float32] | None  # (z, y, x)


class _Cursor:
    """Takes one field of a file after the other."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.path, self._data, self._at = path, data, 0

    @property
    def left(self) -> int:
        return len(self._data) - self._at

    def take(self, form: str, field: str) -> tuple[Any, ...]:
        size = struct.calcsize(f"<{form}")
        if size > self.left:
            raise self.error(field, f"wanted {size} bytes, but the file ends after {self.left}")
        self._at += size
        return struct.unpack_from(f"<{form}", self._data, self._at - size)

    def numbers(self, form: str, field: str) -> tuple[Any, ...]:
        found = self.take(form, field)
        if not all(math.isfinite(number) and abs(number) < 1e30 for number in found):
            raise self.error(field, f"{found}; wanted finite numbers")
        return found

    def text(self, field: str) -> str:
        (length,) = self.take("Q", f"length of the {field}")
        if length > LONGEST_TEXT:
            raise self.error(f"length of the {field}", f"{length:,}; wanted at most {LONGEST_TEXT}")
        return str(self.take(f"{length}s", field)[0], "latin-1")

    def items(self, kind: np.dtype[Any], field: str, count: int | None = None) -> NDArray[Any]:
        """Take so many items, which end the file; without a count, as many as there are."""
        wanted = self.left // kind.itemsize if count is None else count
        if self.left != wanted * kind.itemsize:
            each = f"{kind.itemsize} bytes for each {field}"
            raise self.error(
                f"{field}s",
                f"{self.left:,} bytes are left; wanted "
                + (
                    f"{wanted * kind.itemsize:,}, {each} of {wanted:,}"
                    if count is not None
                    else f"{each}, and no rest"
                ),
            )
        return np.frombuffer(self._data, kind, wanted, self._at)

    def error(self, field: str, text: str) -> ValueError:
        return ValueError(f"{self.path}: {field}: {text}")


def inflated(path: Path) -> bytes:
    """Return the content of a file that is one zlib stream. Raises ValueError."""
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(content_of(path), MOST_BYTES)
    except zlib.error as error:
        raise ValueError(f"{path}: {str(error)[:100]}; wanted one zlib stream") from None
    if stream.unconsumed_tail:
        raise ValueError(f"{path}: more than {MOST_BYTES // 2**20} MiB in it; wanted fewer")
    if not stream.eof:
        raise ValueError(f"{path}: the zlib stream is cut off, after {len(content):,} bytes of its content")
    if stream.unused_data:
        raise ValueError(f"{path}: {len(stream.unused_data):,} bytes follow the zlib stream; wanted none")
    return content


def read(path: Path) -> Moment:
    """Read an iteration. Raises ValueError with the field that is wrong and what was expected."""
    cursor = _Cursor(path, inflated(path))
    (major,) = cursor.take("i", "version")
    minor = 0 if major == 1 else cursor.take("i", "minor version")[0]
    if major not in (1, 2, 3) or not 0 <= minor < 1000:
        raise cursor.error("version", f"{major}.{minor}; wanted 1, 2.x or 3.x")
    shape, source, gas = "", None, ""
    if major == 1:
        low, high = cursor.numbers("3d", "lowest corner"), cursor.numbers("3d", "highest corner")
        cells, side = cursor.take("3i", "cells"), cursor.numbers("3d", "side of a cell")[0]
    else:
        cells = cursor.take("3i", "cells")
        low, high = cursor.numbers("3f", "lowest corner"), cursor.numbers("3f", "highest corner")
        (side,) = cursor.numbers("f", "side of a cell")
    grid = checked(Grid(cells, low, high, side), f"{path}")
    if major == 3:
        shape = cursor.text("shape of the source")
        if shape not in SHAPES:
            raise cursor.error("shape of the source", f"{shape!r}; wanted {', '.join(SHAPES)}")
        cursor.numbers(SHAPES[shape], "size of the source")
    elif (major, minor) < (2, 6):
        shape = "point"
    if shape:
        place = cursor.numbers("3d" if major == 1 else "3f", "place of the source")
        source = (place[0], place[1], place[2])
        (code,) = cursor.take("i", "gas")
        if not -1 <= code < len(GASES):
            raise cursor.error("gas", f"{code}; wanted -1 to {len(GASES) - 1}")
        gas = "" if code < 0 else GASES[code]
    moles, air = cursor.numbers("2d" if (major, minor) < (2, 6) else "2f", "moles of a filament and of air")
    if moles < 0 or air <= 0:
        raise cursor.error("moles of a filament and of air", f"{moles:g} and {air:g}; wanted numbers above 0")
    (wind,) = cursor.take("i", "number of the wind")
    filaments, ppm = None, None
    if major < 3:
        filaments = _filaments(cursor, WITH_INDEX_64 if (major, minor) < (2, 6) else WITH_INDEX_32)
    else:
        mode = cursor.text("mode")
        if mode not in ("filaments", "concentrations"):
            raise cursor.error("mode", f"{mode!r}; wanted 'filaments' or 'concentrations'")
        (count,) = cursor.take("Q", f"number of {mode}")
        if mode == "filaments":
            filaments = _filaments(cursor, WITHOUT_INDEX, count)
        elif count != grid.total:
            raise cursor.error("number of concentrations", f"{count:,}; wanted {grid.total:,}, one a cell")
        else:
            ppm = cursor.items(np.dtype("<f4"), "concentration", count)
            if not (np.isfinite(ppm) & (ppm >= 0)).all():
                raise cursor.error("concentrations", "wanted finite numbers from 0")
            ppm = np.array(ppm.reshape(cells[::-1]), np.float32)
    version = "1" if major == 1 else f"{major}.{minor}"
    return Moment(version, grid, shape, source, gas, moles, air, wind, filaments, ppm)


def checked(grid: Grid, where: str) -> Grid:
    """Return a grid that is one. Raises ValueError."""
    if min(grid.cells) < 1 or grid.total * 4 > MOST_BYTES:
        raise ValueError(f"{where}: cells: {grid.cells}; wanted at least 1 each, {MOST_BYTES // 4:,} in all")
    if not grid.side > 0:
        raise ValueError(f"{where}: side of a cell: {grid.side:g}; wanted a number above 0")
    for axis, low, high, count in zip("xyz", grid.low, grid.high, grid.cells, strict=True):
        # GADEN rounds the number of cells up, in single precision.
        if not abs(high - low - count * grid.side) < 1.5 * grid.side:
            raise ValueError(
                f"{where}: corners: {low:g} to {high:g} along {axis}; wanted {count} cells of {grid.side:g} m"
            )
    return grid


def _filaments(cursor: _Cursor, kind: np.dtype[Any], count: int | None = None) -> Array:
    items = cursor.items(kind, "filament", count)
    filaments = np.empty((len(items), 4))
    with np.errstate(invalid="ignore"):  # of signalling NaNs
        filaments[:, :3], filaments[:, 3] = items["place"], items["sigma"]
    good = np.isfinite(filaments).all(axis=1) & (np.abs(filaments) < 1e9).all(axis=1) & (filaments[:, 3] > 0)
    if not good.all():
        number = int(np.argmin(good))
        raise cursor.error(
            f"filament {number}",
            f"x, y, z, σ: {filaments[number].tolist()}; wanted finite numbers, σ above 0",
        )
    return filaments
