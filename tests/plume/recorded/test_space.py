"""Protects the walls and the wind of GADEN: cells lie where they were written, and a wrong file is one line."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from plume.recorded.iteration import Grid
from plume.recorded.space import occupancy, wind
from tests.plume.recorded import writers
from tests.plume.recorded.writers import CELLS, LOW, SIDE

GRID = Grid(CELLS, LOW, (2.0, 3.0, 2.0), SIDE)
LINES = writers.grid_text().splitlines()


def refused(read: Callable[[], object], path: Path) -> str:
    with pytest.raises(ValueError, match=path.name) as raised:
        read()
    line = str(raised.value)
    assert len(line.splitlines()) == 1
    return line.removeprefix(f"{path}: ")


def test_every_cell_lies_where_it_was_written(tmp_path: Path) -> None:
    states = np.random.default_rng(3).integers(0, 3, CELLS)
    path = tmp_path / "OccupancyGrid3D.csv"
    path.write_text(writers.grid_text(states))
    grid, cells = occupancy(path)
    assert grid == GRID
    assert all(cells[z, y, x] == states[x, y, z] for x, y, z in np.ndindex(*CELLS))
    path.write_text(writers.grid_text(states).removesuffix(";\n"))  # the last ; may be missing
    assert (occupancy(path)[1] == cells).all()


@pytest.mark.parametrize(
    ("number", "line", "told"),
    [
        (0, "#env_min 0 0 0", "line 1: wanted #env_min(m) and 3 numbers"),
        (0, "#env_min(m) 0 0", "line 1: wanted #env_min(m) and 3 numbers"),
        (1, "#env_max(m) 2 3 high", "line 2: wanted #env_max(m) and 3 numbers"),
        (1, "#env_max(m) 9 3 2", "corners: -1 to 9 along x; wanted 6 cells of 0.5 m"),
        (2, "#num_cells 6 5.5 4", "line 3: [6.0, 5.5, 4.0]; wanted whole numbers of cells"),
        (2, "#num_cells 0 5 4", "cells: (0, 5, 4); wanted at least 1 each, 16,777,216 in all"),
        (2, "#num_cells 1e6 1e6 1e6", "cells: (1000000, 1000000, 1000000); wanted at least 1 each"),
        (3, "#cell_size(m) -0.5", "side of a cell: -0.5; wanted a number above 0"),
        (3, "#cell_size(m)", "line 4: wanted #cell_size(m) and 1 number"),
        (4, "0 0 0 0", "line 5: 4 numbers; wanted 5, each 0 (free), 1 (wall) or 2 (outlet)"),
        (4, "0 0 0 0 3", "line 5: 5 numbers; wanted 5, each 0 (free), 1 (wall) or 2 (outlet)"),
        (4, "0 0 x 0 0", "line 5: 5 numbers; wanted 5, each 0 (free), 1 (wall) or 2 (outlet)"),
        (10, "0 0 0 0 0", "line 11: wanted ; after the 6 lines of layer 0"),
        (9, ";", "line 10: 1 numbers; wanted 5, each 0 (free), 1 (wall) or 2 (outlet)"),
    ],
)
def test_a_line_that_is_wrong_is_named(tmp_path: Path, number: int, line: str, told: str) -> None:
    path = tmp_path / "OccupancyGrid3D.csv"
    path.write_text("\n".join([*LINES[:number], line, *LINES[number + 1 :]]))
    assert refused(lambda: occupancy(path), path).startswith(told)


def test_every_line_after_which_the_walls_may_be_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "OccupancyGrid3D.csv"
    for count in range(len(LINES) - 1):
        path.write_text("\n".join(LINES[:count]))
        told = refused(lambda: occupancy(path), path)
        layer, x = divmod(count - 4, 7)
        if count < 4:
            assert told.startswith(f"line {count + 1}: wanted #")
        else:
            layer, x = (layer + 1, 0) if x == 6 else (layer, x)
            assert told == f"the file ends in layer {layer} of 4, after {x} of 6 lines"
    path.write_text("\n".join([*LINES, "0 0 0 0 0"]))
    assert refused(lambda: occupancy(path), path) == "line 33: more than 4 layers; wanted what line 3 says"


@pytest.mark.parametrize("version", ["old", "2.6", "3.0"])
def test_the_wind_of_every_cell_is_what_was_written(tmp_path: Path, version: str) -> None:
    air = np.random.default_rng(4).normal(size=(*CELLS, 3))
    path = tmp_path / "wind_iteration_0"
    path.write_bytes(writers.wind_bytes(air, version))
    found = wind(path, GRID)
    assert all((found[z, y, x] == air[x, y, z].astype(np.float32)).all() for x, y, z in np.ndindex(*CELLS))


def test_a_wind_of_the_old_kind_may_begin_like_a_new_one(tmp_path: Path) -> None:
    """GADEN looks at the first four bytes, which of a float64 may be anything: 3, and it takes it for 3.x."""
    air = np.zeros((*CELLS, 3))
    air[0, 0, 0, 0] = struct.unpack("<d", struct.pack("<ii", 3, 0x3FE00000))[0]
    path = tmp_path / "wind_iteration_0"
    path.write_bytes(writers.wind_bytes(air, "old"))
    assert wind(path, GRID)[0, 0, 0].tolist() == [0.5, 0.0, 0.0]


def test_a_wind_that_is_wrong_says_what_was_expected(tmp_path: Path) -> None:
    path = tmp_path / "wind_iteration_0"
    for size in (0, 7, 1447, 1449, 2879, 2881):
        path.write_bytes(bytes(size))
        assert refused(lambda: wind(path, GRID), path) == (
            f"{size:,} bytes; wanted 1,448, or 2,880 of the old kind, for 120 cells"
        )
    path.write_bytes(struct.pack("<2i", 999, 0) + bytes(1440))
    assert refused(lambda: wind(path, GRID), path) == "version: 999.0; wanted 2.x or 3.x"
    air = np.zeros((*CELLS, 3))
    air[2, 0, 0, 1] = np.nan
    for version in ("old", "3.0"):
        path.write_bytes(writers.wind_bytes(air, version))
        assert refused(lambda: wind(path, GRID), path) == (
            "wind of cell 2: [0.0, nan, 0.0]; wanted numbers below 1e6"
        )
