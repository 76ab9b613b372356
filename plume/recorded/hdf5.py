"""Movies in HDF5 files: of olfactory-navigation, a dataset for each frame; of plume_nav_sim, with a sidecar.

The file is opened for each read, so that no handle outlives it or goes through a fork.
"""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from plume.mistakes.bounded_yaml import value_of
from plume.recorded.footage import MOST_BYTES, content_of, one_line
from plume.recorded.movies import Movie, PixelGrid, Pixels, checked

SIDECAR = ".plume-movie.yaml"
LONGEST = 64 * 2**10  # bytes of a sidecar
LISTED = 5  # names that are listed
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
T = TypeVar("T")


class MovieSidecar(msgspec.Struct, forbid_unknown_fields=True):
    """What plume_nav_sim's NAME.h5.plume-movie.yaml says."""

    fps: float
    spatial_unit: str
    h5_dataset: str
    pixels_per_unit: tuple[float, float] | None = None  # (y, x)
    version: int = 1
    path: str | None = None


class Numbered:
    """The frames of a file with the datasets "0", "1", …"""

    together = 1

    def __init__(self, path: Path) -> None:
        self._path = path

        def look(file: Any) -> tuple[int, tuple[int, ...], Any, tuple[str, ...]]:
            count = 0
            while str(count) in file:
                count += 1
            if not count:
                raise ValueError(
                    f"{path}: no dataset '0' and no {path.name}{SIDECAR}; wanted a dataset for each frame, "
                    "'0', '1', …, or that file"
                )
            others = sorted(set(file) - set(map(str, range(count))))
            first = _dataset(path, file, "0")
            if skipped := [name for name in others if name.isdecimal()]:
                raise ValueError(f"{path}: no dataset '{count}', but {few(skipped)}; wanted every frame")
            return count, first.shape, first.dtype, tuple(f"dataset {name!r}" for name in others)

        count, shape, self._dtype, self.unread = _opened(path, look)
        self.shape = checked(path, (count, *shape), self._dtype)

    def read(self, first: int, count: int) -> Pixels:
        """Return frames."""

        def look(file: Any) -> Pixels:
            frames = [_dataset(self._path, file, str(number)) for number in range(first, first + count)]
            for number, frame in enumerate(frames, first):
                if (frame.shape, frame.dtype) != (self.shape[1:], self._dtype):
                    raise ValueError(
                        f"{self._path}: frame {number}: {frame.shape} of {frame.dtype}; "
                        f"wanted {self.shape[1:]} of {self._dtype} as in frame 0"
                    )
            return np.stack([frame[()] for frame in frames])

        return _opened(self._path, look)


class Stacked:
    """The frames of a file with one dataset (t, y, x)."""

    def __init__(self, path: Path, name: str) -> None:
        self._path, self._name = path, name

        def look(file: Any) -> tuple[Any, Any, Any]:
            dataset = _dataset(path, file, name)
            return dataset.shape, dataset.dtype, dataset.chunks

        shape, dtype, chunks = _opened(path, look)
        self.shape = checked(path, shape, dtype)
        self.together = min(chunks[0] if chunks else 1, self.shape[0])
        if self.together * self.shape[1] * self.shape[2] * dtype.itemsize > MOST_BYTES:
            self.together = 1

    def read(self, first: int, count: int) -> Pixels:
        """Return frames."""
        return _opened(
            self._path,
            lambda file: np.asarray(_dataset(self._path, file, self._name)[first : first + count]),
        )


def movie(path: Path) -> Movie:
    """Return the movie in a .h5 file. Raises ValueError."""
    if path.with_name(path.name + SIDECAR).exists():
        return _with_sidecar(path)
    reel = Numbered(path)
    return Movie("movie of olfactory-navigation (.h5)", reel, PixelGrid(), unread=reel.unread)


def _with_sidecar(path: Path) -> Movie:
    sidecar = path.with_name(path.name + SIDECAR)
    said = told(sidecar)
    if not 0 < said.fps < float("inf"):
        raise ValueError(f"{sidecar}: fps: {said.fps:g}; wanted a number above 0")
    pixel, length = (1.0, 1.0), "pixels"
    if said.spatial_unit != "pixel":
        per = said.pixels_per_unit
        if per is None or not (0 < per[0] < float("inf") and 0 < per[1] < float("inf")):
            raise ValueError(f"{sidecar}: pixels_per_unit: {per}; wanted two numbers above 0, of y and x")
        metres = METRES.get(said.spatial_unit, 1.0)
        length = "m" if said.spatial_unit in METRES else said.spatial_unit
        pixel = metres / per[1], metres / per[0]
    reel = Stacked(path, said.h5_dataset)
    return Movie("movie of plume_nav_sim (.h5)", reel, PixelGrid(pixel, length=length, fps=said.fps))


def told(path: Path) -> MovieSidecar:
    """Return what a sidecar says. Raises ValueError."""
    content = content_of(path, LONGEST)
    try:
        with warnings.catch_warnings(action="ignore"):  # of anchors that are defined twice
            value = value_of(content)
    except Exception as error:  # ruamel raises many kinds
        raise ValueError(f"{path}: not valid YAML: {one_line(error)}") from None
    try:
        return msgspec.convert(value, MovieSidecar)
    except msgspec.ValidationError as error:
        raise ValueError(f"{path}: {one_line(error)}") from None


def few(names: list[str]) -> str:
    """List the first few of many names."""
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join(map(repr, names[:LISTED])) + more


def _opened(path: Path, look: Callable[[Any], T]) -> T:
    """Return what `look` finds in a file. Raises ValueError."""
    try:
        import h5py
    except ImportError:
        raise ValueError(f"{path}: needs h5py: pip install 'plumeward[plumes]'") from None
    try:
        with h5py.File(path, "r") as file:
            return look(file)
    except ValueError as error:
        if str(error).startswith(f"{path}: "):
            raise
        raise ValueError(f"{path}: HDF5: {one_line(error)}") from None
    except Exception as error:  # of a broken file h5py raises OSError, RuntimeError, KeyError and others
        raise ValueError(f"{path}: HDF5: {one_line(error)}") from None


def _dataset(path: Path, file: Any, name: str) -> Any:
    """Return a dataset that lies in this file itself, and whose chunks fit into memory. Raises ValueError."""
    import h5py

    parts = [part for part in name.split("/") if part]
    for count in range(1, len(parts) + 1):
        within = "/".join(parts[:count])
        if not isinstance(file.get(within, getlink=True), h5py.HardLink):
            raise ValueError(f"{path}: no dataset {name!r} in the file itself; it has {few(list(file))}")
    dataset = file[name] if parts else None
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"{path}: {name!r} is no dataset; wanted one with the frames")
    if dataset.is_virtual or dataset.external:
        raise ValueError(f"{path}: dataset {name!r} lies in other files; wanted one in the file itself")
    chunk = int(np.prod(dataset.chunks or (1,), dtype=object)) * dataset.dtype.itemsize
    if chunk > MOST_BYTES:
        raise ValueError(
            f"{path}: dataset {name!r}: chunks of {chunk:,} bytes; wanted {MOST_BYTES:,} at most"
        )
    return dataset
