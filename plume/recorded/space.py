"""The space of a GADEN simulation: which cells are air, in `OccupancyGrid3D.csv`, and its wind, in `*_K`."""

import math
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plume.recorded.footage import content_of
from plume.recorded.iteration import Grid, checked

HEAD = (("#env_min(m)", 3), ("#env_max(m)", 3), ("#num_cells", 3), ("#cell_size(m)", 1))
FREE, WALL, OUTLET = 0, 1, 2
Cells = NDArray[np.uint8]


def occupancy(path: Path) -> tuple[Grid, Cells]:
    """Read an occupancy grid: its grid, and what each cell (z, y, x) is. Raises ValueError.

    Four lines of a head; then for each layer, from the lowest, a line for each x with a number for each y,
    and a line with `;`.
    """
    lines = content_of(path).decode("ascii", "replace").splitlines()
    numbers: list[list[float]] = []
    for number, (name, count) in enumerate(HEAD):
        words = lines[number].split() if number < len(lines) else []
        values = [_number(word) for word in words[1:]]
        if words[:1] != [name] or len(values) != count or not all(map(math.isfinite, values)):
            raise ValueError(
                f"{path}: line {number + 1}: wanted {name} and {count} number{'s' * (count > 1)}"
            )
        numbers.append(values)
    low, high, cells, (side,) = numbers
    if any(count != int(count) for count in cells):
        raise ValueError(f"{path}: line 3: {cells}; wanted whole numbers of cells")
    nx, ny, nz = map(int, cells)
    grid = checked(Grid((nx, ny, nz), (low[0], low[1], low[2]), (high[0], high[1], high[2]), side), f"{path}")
    layers = np.empty((nz, nx, ny), np.uint8)
    at = len(HEAD)
    for z in range(nz):
        for x in range(nx):
            if at >= len(lines):
                raise ValueError(f"{path}: the file ends in layer {z} of {nz}, after {x} of {nx} lines")
            row = lines[at].split()
            if len(row) != ny or not set(row) <= {"0", "1", "2"}:
                raise ValueError(
                    f"{path}: line {at + 1}: {len(row)} numbers; wanted {ny}, each 0 (free), 1 (wall) or "
                    "2 (outlet)"
                )
            layers[z, x] = np.frombuffer("".join(row).encode(), np.uint8) - ord("0")
            at += 1
        if at < len(lines) and lines[at].strip() != ";":
            raise ValueError(f"{path}: line {at + 1}: wanted ; after the {nx} lines of layer {z}")
        at += 1
    if any(line.strip() for line in lines[at:]):
        raise ValueError(f"{path}: line {at + 1}: more than {nz} layers; wanted what line 3 says")
    return grid, np.ascontiguousarray(layers.transpose(0, 2, 1))


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


def wind(path: Path, grid: Grid) -> NDArray[np.float32]:
    """Read how the air moves in each cell, m/s: (z, y, x, 3). Raises ValueError.

    Versions 2 and 3 of two whole numbers, then x, y, z of each cell as float32; before, all x, all y and all
    z as float64, which the size tells.
    """
    new, old = 8 + 12 * grid.total, 24 * grid.total
    try:
        size = path.stat().st_size
        if size not in (new, old):
            raise ValueError(
                f"{path}: {size:,} bytes; wanted {new:,}, or {old:,} of the old kind, for "
                f"{grid.total:,} cells"
            )
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    if size == new:
        major, minor = struct.unpack_from("<2i", data)
        if major not in (2, 3):
            raise ValueError(f"{path}: version: {major}.{minor}; wanted 2.x or 3.x")
        air = np.frombuffer(data, "<f4", offset=8).reshape(grid.total, 3)
    else:
        with np.errstate(over="ignore", invalid="ignore"):  # what is too large is refused below
            air = np.frombuffer(data, "<f8").reshape(3, grid.total).T.astype(np.float32)
    if not (np.abs(air) < 1e6).all():  # false of NaN, too
        cell = int(np.argmin((np.abs(air) < 1e6).all(axis=1)))
        raise ValueError(f"{path}: wind of cell {cell}: {air[cell].tolist()}; wanted numbers below 1e6")
    return np.array(air.reshape(*grid.cells[::-1], 3), np.float32, order="C")
