"""What is read of recorded plumes: GADEN's iterations, walls and winds, movies of NumPy and Zarr, sidecars. HDF5
is read by its own library.
"""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from plume.recorded import npy, zarr
from plume.recorded.footage import Footage
from plume.recorded.hdf5 import told
from plume.recorded.iteration import Grid, read
from plume.recorded.space import occupancy, wind
from tests.fuzz.files import FOLDER, written
from tests.plume.recorded import writers

FRAMES = np.arange(12, dtype=np.float32).reshape(3, 2, 2)
BLOSC = {"id": "blosc", "cname": "lz4", "clevel": 1, "shuffle": 1, "blocksize": 0}
CODECS = (None, {"id": "zlib"}, {"id": "gzip"}, {"id": "zstd"}, BLOSC)
GRID = Grid(writers.CELLS, writers.LOW, (2.0, 3.0, 2.0), writers.SIDE)


def _refused_or_read(path: Path, reads: Callable[[], object]) -> None:
    """It is read, or refused in one line that names the file."""
    try:
        reads()
    except ValueError as error:
        text = str(error)
        assert text.startswith(f"{path}")
        assert len(text.splitlines()) == 1
        assert len(text) < 2000


def _looked_at(footage: Footage) -> None:
    """Every frame gives numbers from 0."""
    frames = np.arange(min(footage.facts.frames, 10))
    gas = footage.gas(np.zeros((len(frames), 3)), frames)
    assert np.isfinite(gas).all()
    assert (gas >= 0).all()


# ---- GADEN ----


def iteration_seeds() -> list[bytes]:
    ppm = np.ones(writers.CELLS[::-1])
    return [
        *map(writers.content, writers.ALL_VERSIONS),
        writers.content("3.0", ppm=ppm, shape="box", sizes=(1, 2, 3)),
    ]


def iteration(data: bytes) -> None:
    """What is in an iteration is read or refused."""
    path = written("iteration_0", writers.packed(data))
    _refused_or_read(path, lambda: read(path))


def packed_iteration_seeds() -> list[bytes]:
    return [writers.packed(writers.content("2.6")), writers.packed(writers.content("3.0", filaments=[]))]


def packed_iteration(data: bytes) -> None:
    """An iteration is one zlib stream, or refused."""
    path = written("iteration_0", data)
    _refused_or_read(path, lambda: read(path))


def walls_seeds() -> list[bytes]:
    states = np.arange(8).reshape(2, 2, 2) % 3
    return [writers.grid_text(states, cells=(2, 2, 2)).encode(), writers.grid_text().encode()]


def walls(data: bytes) -> None:
    """Walls are read or refused."""
    path = written("OccupancyGrid3D.csv", data)
    _refused_or_read(path, lambda: occupancy(path))


def wind_seeds() -> list[bytes]:
    air = writers.steady((1.0, 0.5, 0.0))
    return [writers.wind_bytes(air, version) for version in ("old", "2.6", "3.0")]


def gaden_wind(data: bytes) -> None:
    """A wind is read or refused."""
    path = written("wind_iteration_0", data)
    _refused_or_read(path, lambda: wind(path, GRID))


# ---- movies ----


@cache
def npy_seeds() -> list[bytes]:
    return [
        writers.npy(FOLDER / "seed.npy", FRAMES.astype(kind)).read_bytes() for kind in ("<f4", "<f8", "u1")
    ]


def npy_movie(data: bytes) -> None:
    """A NumPy movie is read or refused."""
    path = written("fuzzed.npy", data)
    _refused_or_read(path, lambda: _looked_at(npy.movie(path)))


@cache
def _zarr_movie(number: int) -> Path:
    folder = FOLDER / f"{number}.zarr"
    return (
        folder
        if folder.exists()
        else writers.zarr(folder, FRAMES, chunks=(2, 2, 2), compressor=CODECS[number])
    )


def zarr_array_seeds() -> list[bytes]:
    return [(_zarr_movie(number) / "concentration" / ".zarray").read_bytes() for number in range(len(CODECS))]


def zarr_array(data: bytes) -> None:
    """What .zarray says is read or refused."""
    folder = FOLDER / "array.zarr"
    if not folder.exists():
        writers.zarr(folder, FRAMES, chunks=(2, 2, 2))
    (folder / "concentration" / ".zarray").write_bytes(data)
    _refused_or_read(folder, lambda: _looked_at(zarr.movie(folder)))


def zarr_attributes_seeds() -> list[bytes]:
    said = writers.attributes(FRAMES.shape, source_location_px=[1, 1], pixel_to_grid=1.0, extent=2.0)
    return [json.dumps(each).encode() for each in (said, writers.attributes(FRAMES.shape))]


def zarr_attributes(data: bytes) -> None:
    """What .zattrs says is read or refused."""
    folder = FOLDER / "attributes.zarr"
    if not folder.exists():
        writers.zarr(folder, FRAMES, chunks=(2, 2, 2))
    (folder / ".zattrs").write_bytes(data)
    _refused_or_read(folder, lambda: _looked_at(zarr.movie(folder)))


def zarr_chunk_seeds() -> list[bytes]:
    """Return chunks with the number of their codec before them."""
    return [
        bytes([number]) + (_zarr_movie(number) / "concentration" / "0.0.0").read_bytes()
        for number in range(len(CODECS))
    ]


def zarr_chunk(data: bytes) -> None:
    """A chunk is read or refused."""
    number = (data[0] if data else 0) % len(CODECS)
    folder = _zarr_movie(number)
    path = folder / "concentration" / "0.0.0"
    before = path.read_bytes()
    path.write_bytes(data[1:])
    try:
        _refused_or_read(folder, lambda: _looked_at(zarr.movie(folder)))
    finally:
        path.write_bytes(before)


def sidecar_seeds() -> list[bytes]:
    return [
        b"version: 1\npath: a.h5\nfps: 15.0\nspatial_unit: mm\npixels_per_unit:\n  - 2.0\n  - 4.0\n"
        b"h5_dataset: 'a/b'\n",
        b"{fps: 1e0, spatial_unit: pixel, h5_dataset: &a a, path: *a}\n",
    ]


def sidecar(data: bytes) -> None:
    """A sidecar is read or refused."""
    path = written("fuzzed.h5.plume-movie.yaml", data)
    _refused_or_read(path, lambda: told(path))
