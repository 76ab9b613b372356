"""Writes recorded plumes byte by byte from their formats: nothing here comes from a file of others, or from
our readers.
"""

import json
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

ALL_VERSIONS = ("1", "2.0", "2.3", "2.5", "2.6", "2.9", "3.0", "3.1")
CELLS, LOW, SIDE = (6, 5, 4), (-1.0, 0.5, 0.0), 0.5
SOURCE = (0.25, 1.5, 1.0)
METHANE = 1
MOLES, AIR = 2e-4, 4.089e-5
"""Moles of the gas in a filament, and of all gases in a cm³ at 298 K and 1 atm."""
FILAMENTS = [(0.3, 1.6, 1.0, 10.0), (0.8, 1.4, 1.1, 20.0), (1.1, 1.2, 0.9, 40.0)]
"""x, y, z in m, σ in cm."""


def high(cells: Sequence[int], low: Sequence[float], side: float) -> list[float]:
    return [start + count * side for start, count in zip(low, cells, strict=True)]


def _text(text: str) -> bytes:
    return struct.pack("<Q", len(text)) + text.encode()


def content(
    version: str = "3.0",
    *,
    cells: Sequence[int] = CELLS,
    low: Sequence[float] = LOW,
    side: float = SIDE,
    shape: str = "point",
    sizes: Sequence[float] = (),
    source: Sequence[float] = SOURCE,
    gas: int = METHANE,
    moles: float = MOLES,
    air: float = AIR,
    wind: int = 0,
    filaments: Sequence[Sequence[float]] = FILAMENTS,
    ppm: Any = None,
    mode: str | None = None,
) -> bytes:
    """What is in an iteration file, as GADEN writes it. `ppm` (z, y, x): concentrations in place of filaments."""
    major, minor = (int(part) for part in f"{version}.0".split(".")[:2])
    top = high(cells, low, side)
    if major == 1:
        data = struct.pack(
            "<i6d3i3d3di2di", 1, *low, *top, *cells, *[side] * 3, *source, gas, moles, air, wind
        )
        return data + b"".join(
            struct.pack("<i4d", 7 + number, *each) for number, each in enumerate(filaments)
        )
    data = struct.pack("<2i3i7f", major, minor, *cells, *low, *top, side)
    if major == 2 and minor <= 5:
        data += struct.pack("<3fi2di", *source, gas, moles, air, wind)
        return data + b"".join(
            struct.pack("<i4d", 7 + number, *each) for number, each in enumerate(filaments)
        )
    if major == 2:
        data += struct.pack("<2fi", moles, air, wind)
        return data + b"".join(
            struct.pack("<i4f", 7 + number, *each) for number, each in enumerate(filaments)
        )
    data += _text(shape) + struct.pack(f"<{len(sizes)}f", *sizes) + struct.pack("<3fi", *source, gas)
    data += struct.pack("<2fi", moles, air, wind)
    if ppm is None:
        data += _text(mode or "filaments") + struct.pack("<Q", len(filaments))
        return data + b"".join(struct.pack("<4f?3x", *each, True) for each in filaments)
    flat = np.asarray(ppm, "<f4").ravel()
    return data + _text(mode or "concentrations") + struct.pack("<Q", len(flat)) + flat.tobytes()


def packed(data: bytes) -> bytes:
    """One zlib stream."""
    return zlib.compress(data)


def grid_text(
    states: Any = None, *, cells: Sequence[int] = CELLS, low: Sequence[float] = LOW, side: float = SIDE
) -> str:
    """An OccupancyGrid3D.csv; states (x, y, z), all free without."""
    nx, ny, nz = cells
    states = np.zeros(cells, int) if states is None else states
    lines = [
        "#env_min(m) " + " ".join(f"{number:g}" for number in low),
        "#env_max(m) " + " ".join(f"{number:g}" for number in high(cells, low, side)),
        f"#num_cells {nx} {ny} {nz}",
        f"#cell_size(m) {side:g}",
    ]
    for z in range(nz):
        lines += ["".join(f"{states[x, y, z]} " for y in range(ny)) for x in range(nx)]
        lines.append(";")
    return "\n".join(lines) + "\n"


def wind_bytes(air: Any, version: str = "3.0") -> bytes:
    """A wind file; air (x, y, z, 3) in m/s. Version "old": three arrays of float64."""
    flat = np.asarray(air, float).transpose(2, 1, 0, 3).reshape(-1, 3)
    if version == "old":
        return flat.T.astype("<f8").tobytes()
    major, minor = map(int, version.split("."))
    return struct.pack("<2i", major, minor) + flat.astype("<f4").tobytes()


def steady(velocity: Sequence[float], cells: Sequence[int] = CELLS) -> Any:
    """The same wind in each cell."""
    return np.broadcast_to(np.asarray(velocity, float), (*cells, 3))


def results(
    folder: Path,
    iterations: Sequence[bytes],
    *,
    grid: str | None = None,
    winds: Sequence[bytes] = (),
) -> Path:
    """A folder of results as GADEN leaves it: the walls and the wind lie beside `simulations`."""
    run = folder / "simulations" / "sim1"
    run.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(iterations):
        (run / f"iteration_{number}").write_bytes(packed(data))
    (folder / "OccupancyGrid3D.csv").write_text(grid_text() if grid is None else grid)
    if winds:
        (folder / "wind").mkdir(exist_ok=True)
    for number, data in enumerate(winds):
        (folder / "wind" / f"wind_iteration_{number}").write_bytes(data)
    return run


def npy(path: Path, frames: Any) -> Path:
    """A movie of olfactory-navigation: one array (t, y, x)."""
    frames = np.ascontiguousarray(frames)
    head = f"{{'descr': {frames.dtype.str!r}, 'fortran_order': False, 'shape': {frames.shape}, }}"
    head = head.ljust(117) + "\n"
    path.write_bytes(b"\x93NUMPY\1\0" + struct.pack("<H", len(head)) + head.encode() + frames.tobytes())
    return path


def numbered(path: Path, frames: Any) -> Path:
    """A movie of olfactory-navigation: a dataset for each frame."""
    import h5py

    with h5py.File(path, "w") as file:
        for number, frame in enumerate(frames):
            file[str(number)] = frame
    return path


def with_sidecar(path: Path, frames: Any, sidecar: str | None = None, **options: Any) -> Path:
    """A movie of plume_nav_sim in HDF5: 2 pixels a mm up and 4 to the right, 15 frames a second."""
    import h5py

    with h5py.File(path, "w") as file:
        file.create_dataset("Plume Data/dataset_001", data=frames, **options)
    text = sidecar or (
        f"version: 1\npath: elsewhere/{path.name}\nfps: 15.0\nspatial_unit: mm\npixels_per_unit:\n  - 2.0\n"
        "  - 4.0\nh5_dataset: 'Plume Data/dataset_001'\n"
    )
    path.with_name(path.name + ".plume-movie.yaml").write_text(text)
    return path


def attributes(shape: Sequence[int], **others: Any) -> dict[str, Any]:
    """The attributes of a movie of plume_nav_sim: a pixel is 2 high and 0.5 wide."""
    said = {
        "schema_version": "1.0.0",
        "fps": 4.0,
        "source_dtype": "float32",
        "pixel_to_grid": [2.0, 0.5],
        "origin": [10.0, -3.0],
        "extent": [2.0 * shape[1], 0.5 * shape[2]],
        "dims": ["t", "y", "x"],
    }
    return {name: value for name, value in (said | others).items() if value is not None}


def zarr(
    folder: Path,
    frames: Any,
    *,
    chunks: Sequence[int] = (2, 3, 2),
    compressor: dict[str, Any] | None = None,
    said: dict[str, Any] | None = None,
    order: str = "C",
    separator: str = ".",
    **array: Any,
) -> Path:
    """A movie of plume_nav_sim in Zarr, version 2."""
    frames = np.asarray(frames)
    inside = folder / "concentration"
    inside.mkdir(parents=True)
    (folder / ".zgroup").write_text('{"zarr_format": 2}')
    (folder / ".zattrs").write_text(json.dumps(attributes(frames.shape) if said is None else said))
    about = {
        "zarr_format": 2,
        "shape": list(frames.shape),
        "chunks": list(chunks),
        "dtype": frames.dtype.str,
        "compressor": compressor,
        "fill_value": 0.0,
        "filters": None,
        "order": order,
    }
    if separator != ".":
        about["dimension_separator"] = separator
    (inside / ".zarray").write_text(json.dumps(about | array))
    counts = [-(-size // step) for size, step in zip(frames.shape, chunks, strict=True)]
    for number in np.ndindex(*counts):
        begin = [place * step for place, step in zip(number, chunks, strict=True)]
        part = frames[tuple(slice(at, at + step) for at, step in zip(begin, chunks, strict=True))]
        chunk = np.zeros(chunks, frames.dtype)
        chunk[tuple(map(slice, part.shape))] = part
        path = inside / separator.join(map(str, number))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(compressed(chunk.tobytes(order=order), compressor))
    return folder


def compressed(data: bytes, compressor: dict[str, Any] | None) -> bytes:
    """A chunk as a compressor of Zarr's packs it."""
    match compressor and compressor["id"]:
        case None:
            return data
        case "zlib":
            return zlib.compress(data)
        case "gzip":
            import gzip

            return gzip.compress(data)
        case "zstd":
            import zstandard

            return zstandard.ZstdCompressor().compress(data)
        case "blosc":
            from numcodecs.blosc import Blosc

            return bytes(Blosc(cname="zstd", clevel=3, shuffle=1).encode(data))
    raise AssertionError(compressor)
