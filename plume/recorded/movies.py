"""Movies of plumes: frames of pixels, of which only those that are asked for are read."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from plume.elementary import Array, Indices
from plume.recorded.footage import MOST_BYTES, Facts, LastRead, between, blend

OWN = "of its own unit"
Pixels = NDArray[np.generic]


class Reel(Protocol):
    """The frames of a file."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""

    @property
    def together(self) -> int:
        """How many frames are read at once."""

    def read(self, first: int, count: int) -> Pixels:
        """Return some frames (count, rows, columns). Raises ValueError on a broken file."""


@dataclass(frozen=True)
class PixelGrid:
    """Where the pixels of a movie lie: the centre of row j and column i is at origin + (i, j) · pixel."""

    pixel: tuple[float, float] = (1.0, 1.0)  # (x, y)
    origin: tuple[float, float] = (0.0, 0.0)  # (x, y)
    length: str = "pixels"
    fps: float | None = None
    source: tuple[float, float] | None = None


class Movie:
    """A movie as footage: interpolated linearly between pixels.

    A negative value, or one that is no finite number, counts as 0: such values mark walls, and rounding.
    """

    def __init__(
        self,
        kind: str,
        reel: Reel,
        grid: PixelGrid,
        remarks: tuple[str, ...] = (),
        unread: tuple[str, ...] = (),
    ) -> None:
        self._reel, self._grid = reel, grid
        frames, *size = reel.shape
        rows, columns = size
        (width, height), (x, y) = grid.pixel, grid.origin
        self.facts = Facts(
            kind=kind,
            frames=frames,
            fps=grid.fps,
            cells=(columns, rows),
            cell=grid.pixel,
            low=(x - width / 2, y - height / 2),
            high=(x + (columns - 0.5) * width, y + (rows - 0.5) * height),
            length=grid.length,
            unit=OWN,
            grams=None,
            source=grid.source,
            windy=False,
            remarks=remarks,
            unread=unread,
        )
        self._blocks = LastRead(self._block, lambda block: block.nbytes)

    def gas(self, places: Array, frames: Indices) -> Array:
        """Return concentrations, as of `Footage`."""
        _, rows, columns = self._reel.shape
        (width, height), (x, y) = self._grid.pixel, self._grid.origin
        left, right, share_x, inside_x = between((places[:, 0] - x) / width, columns)
        low, high, share_y, inside_y = between((places[:, 1] - y) / height, rows)
        corners = np.empty((4, len(places)))
        together = self._reel.together
        blocks = frames // together
        for number in set(blocks.tolist()):
            those = blocks == number
            block = self._blocks[number]
            frame = frames[those] - number * together
            for corner, (row, column) in enumerate(((low, left), (low, right), (high, left), (high, right))):
                with np.errstate(invalid="ignore"):  # of signalling NaNs
                    corners[corner, those] = block[frame, row[those], column[those]]
        corners = np.where(np.isfinite(corners), np.maximum(corners, 0.0), 0.0)
        lower, upper = blend(corners[0], corners[1], share_x), blend(corners[2], corners[3], share_x)
        return np.where(inside_x & inside_y, blend(lower, upper, share_y), 0.0)

    def wind(self, places: Array, _frames: Indices) -> tuple[Array, NDArray[np.bool_]]:
        """Return that nothing is known of the wind."""
        return np.zeros((len(places), 2)), np.zeros(len(places), np.bool_)

    def walls(self, _z: float) -> None:
        """Return None: a movie has no walls."""

    def _block(self, number: int) -> Pixels:
        first = number * self._reel.together
        return self._reel.read(first, min(self._reel.together, self._reel.shape[0] - first))


def checked(file: object, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> tuple[int, int, int]:
    """Return the shape of a movie. Raises ValueError if it is none, or if one frame is too large."""
    if len(shape) != 3 or min(shape) < 1:
        raise ValueError(f"{file}: shape: {shape}; wanted (frames, rows, columns), each at least 1")
    if dtype.kind not in "fiub" or dtype.itemsize > 8:
        raise ValueError(f"{file}: type: {dtype}; wanted float16 to float64, or whole numbers")
    frames, rows, columns = map(int, shape)
    if rows * columns * dtype.itemsize > MOST_BYTES:
        raise ValueError(f"{file}: shape: {shape}; wanted at most {MOST_BYTES // 2**20} MiB a frame")
    return frames, rows, columns
