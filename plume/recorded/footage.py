"""What every reader of recorded plumes gives: facts about the file, and its gas and wind at places in it."""

import stat
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import RLock
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from plume.elementary import Array, Indices

MOST_BYTES = 64 * 2**20  # of one frame, decoded: more is refused
PPM = "ppm"  # parts per million by volume, a unit of concentrations
KEPT_BYTES = 128 * 2**20  # of decoded frames that a file keeps in memory
T = TypeVar("T")


@dataclass(frozen=True)
class Facts:
    """What a file says of itself. Places are in its own coordinates, in `length`."""

    kind: str
    frames: int
    fps: float | None  # frames a second; None where the file does not say
    cells: tuple[int, ...]  # along x, y, and z where there is one
    cell: tuple[float, ...]  # distance between their centres
    low: tuple[float, ...]  # the corner of the recorded space
    high: tuple[float, ...]  # the corner opposite
    length: str  # unit of places
    unit: str  # unit of concentrations
    grams: float | None  # g/m³ of one unit of concentration; None where the file does not say
    source: tuple[float, ...] | None  # None where the file does not say
    windy: bool  # whether there is a wind in the file
    remarks: tuple[str, ...] = ()  # more that people may want to know
    unread: tuple[str, ...] = ()  # what is in the file and not read


class Footage(Protocol):
    """A recorded plume. What it answers depends on the question alone."""

    @property
    def facts(self) -> Facts:
        """What the file says of itself."""

    def gas(self, places: Array, frames: Indices) -> Array:
        """Return the concentration (M,), in the file's unit, at places (M, 3) in these frames (M,).

        It is 0 outside the recorded space. Movies have no z. Raises ValueError on a broken file.
        """

    def wind(self, places: Array, frames: Indices) -> tuple[Array, NDArray[np.bool_]]:
        """Return how the air moves (M, 2), and whether that is known (M,).

        In the file's lengths a second. Raises ValueError on a broken file.
        """

    def walls(self, z: float) -> NDArray[np.bool_] | None:
        """Return which cells (y, x) are no air at this height; None if the file has none."""


class LastRead(Generic[T]):
    """What was read last, by its number, up to so many bytes; the newest is kept whatever its size."""

    def __init__(self, read: Callable[[int], T], size: Callable[[T], int], most: int = KEPT_BYTES) -> None:
        self._read, self._size, self._most = read, size, most
        self._kept: OrderedDict[int, T] = OrderedDict()
        self._bytes = 0
        self._lock = RLock()

    def __getitem__(self, number: int) -> T:
        with self._lock:
            if number in self._kept:
                self._kept.move_to_end(number)
                return self._kept[number]
            item = self._kept[number] = self._read(number)
            self._bytes += self._size(item)
            while self._bytes > self._most and len(self._kept) > 1:
                self._bytes -= self._size(self._kept.popitem(last=False)[1])
            return item


def between(coordinates: Array, count: int) -> tuple[Indices, Indices, Array, NDArray[np.bool_]]:
    """Return between which cells lie coordinates (M,), of which cell i has its centre at i.

    Returns the lower and the upper cell, the share of the upper one, and whether the cells reach so far:
    half a cell beyond the outermost centres, where those alone count.
    """
    inside = (coordinates >= -0.5) & (coordinates <= count - 0.5)
    clipped = np.minimum(np.maximum(coordinates, 0.0), count - 1.0)
    lower = np.minimum(clipped.astype(np.int64), max(count - 2, 0))
    return lower, lower + (count > 1), clipped - lower, inside


def blend(one: Array, other: Array, share: Array) -> Array:
    """Return what lies between two values, linearly, `share` of the way to the other."""
    return one * (1.0 - share) + other * share


def content_of(path: Path, most: int = MOST_BYTES) -> bytes:
    """Return the content of a file of at most so many bytes. Raises ValueError."""
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):  # a pipe would be waited for, and a device might never end
            raise ValueError(f"{path}: not a file; wanted one")
        if found.st_size > most:
            raise ValueError(f"{path}: {found.st_size:,} bytes; wanted at most {most:,}")
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None


def one_line(error: Exception) -> str:
    """Return what another library says of an error, in one short line."""
    return " ".join(str(error).split())[:200] or type(error).__name__
