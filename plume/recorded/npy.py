"""Movies of olfactory-navigation as NumPy files: one array (t, y, x), mapped into memory."""

import warnings
from pathlib import Path

import numpy as np

from plume.recorded.movies import Movie, PixelGrid, Pixels, checked

# The readers of a file's head, by its format's version. Version 3 is for names that no movie has.
HEADS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class Mapped:
    """The frames of a .npy file. The system reads the pages that are looked at."""

    together = 1

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            try:
                head = HEADS[np.lib.format.read_magic(file)]
                with warnings.catch_warnings(action="ignore"):  # of files that Python 2 wrote
                    shape, fortran, dtype = head(file)
            except Exception:  # the head is Python text, and parsing that can raise anything
                raise ValueError(f"{path}: head: not that of an array; wanted a .npy file") from None
            begin = file.tell()
        self.shape = checked(path, shape, dtype)
        wanted, size = begin + int(np.prod(self.shape, dtype=object)) * dtype.itemsize, path.stat().st_size
        if size != wanted:
            raise ValueError(f"{path}: {size:,} bytes; wanted {wanted:,} for {self.shape} of {dtype}")
        order = "F" if fortran else "C"
        mapped = np.memmap(path, dtype, "r", begin, self.shape, order)  # type: ignore[call-overload]
        self._frames: Pixels = np.asarray(mapped)

    def read(self, first: int, count: int) -> Pixels:
        """Return frames, which lie in the file."""
        return self._frames[first : first + count]


def movie(path: Path) -> Movie:
    """Return the movie in a .npy file. Raises ValueError."""
    return Movie("movie of olfactory-navigation (.npy)", Mapped(path), PixelGrid())
