"""Movies of olfactory-navigation as NumPy files: one array (t, y, x), mapped into memory."""

import mmap
import warnings
from pathlib import Path

import numpy as np

from plume.elementary import Array, Indices
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
            pixels = int(np.prod(self.shape, dtype=object))
            self._wanted, size = begin + pixels * dtype.itemsize, path.stat().st_size
            if size != self._wanted:
                raise ValueError(
                    f"{path}: {size:,} bytes; wanted {self._wanted:,} for {self.shape} of {dtype}"
                )
            self._path, self._file = path, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        flat = np.frombuffer(self._file, dtype, pixels, begin)
        self._frames: Pixels = flat.reshape(self.shape, order="F" if fortran else "C")

    def read(self, first: int, count: int) -> Pixels:
        """Return frames, which lie in the file."""
        return self._frames[first : first + count]

    def check(self) -> None:
        """Raise ValueError if the file has been cut off since: to look at what is gone ends the process."""
        if (size := self._file.size()) < self._wanted:
            raise ValueError(f"{self._path}: {size:,} bytes are left of {self._wanted:,}; wanted all of them")


class MappedMovie(Movie):
    """A movie whose file may be cut off while it is open."""

    def __init__(self, mapped: Mapped) -> None:
        super().__init__("movie of olfactory-navigation (.npy)", mapped, PixelGrid())
        self._mapped = mapped

    def gas(self, places: Array, frames: Indices) -> Array:
        """Return concentrations, as of `Footage`."""
        self._mapped.check()
        return super().gas(places, frames)


def movie(path: Path) -> Movie:
    """Return the movie in a .npy file. Raises ValueError."""
    return MappedMovie(Mapped(path))
