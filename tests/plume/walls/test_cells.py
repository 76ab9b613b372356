"""Protects the cells that stand for buildings: right where walls are, and without holes."""

import math

import numpy as np
import pytest

from plume.walls.buildings import Building, Buildings
from plume.walls.cells import CELL_M, FREE, Cells, cells_of


def cells(*footprints: tuple[tuple[float, float], ...], height: float = 10.0) -> Cells:
    return cells_of(Buildings(tuple(Building(footprint, height) for footprint in footprints)))


def built(found: Cells) -> set[tuple[float, float]]:
    """The centres of the cells with buildings, m."""
    return {
        (found.west + (i + 0.5) * CELL_M, found.south + (j + 0.5) * CELL_M)
        for i, j in np.argwhere(found.tops > FREE).tolist()
    }


def test_a_rectangle_covers_the_cells_that_it_holds() -> None:
    found = cells(((2.0, 3.0), (4.0, 3.0), (4.0, 6.0), (2.0, 6.0)))
    assert built(found) == {(2.25 + 0.5 * i, 3.25 + 0.5 * j) for i in range(4) for j in range(6)}
    assert set(found.tops[found.tops > FREE].tolist()) == {5.0}  # 10 m above the ground


def test_which_way_round_the_corners_go_does_not_matter() -> None:
    corners = ((2.0, 3.0), (8.0, 1.0), (9.0, 7.0), (5.0, 4.0))
    assert built(cells(corners)) == built(cells(corners[::-1])) == built(cells(corners[2:] + corners[:2]))


def test_a_round_building_covers_its_area() -> None:
    around = [2 * math.pi * k / 64 for k in range(64)]
    found = cells(tuple((10 * math.cos(angle), 10 * math.sin(angle)) for angle in around))
    assert len(built(found)) * CELL_M**2 == pytest.approx(math.pi * 100, rel=0.02)


@pytest.mark.parametrize("turn_deg", [0, 1, 30, 45, 80, 90])
@pytest.mark.parametrize("thick", [0.01, 0.3])
def test_a_thin_wall_has_no_holes(turn_deg: float, thick: float) -> None:
    """A closed ring of four thin walls: whoever goes from cell to cell does not get out."""
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))

    def wall(*corners: tuple[float, float]) -> tuple[tuple[float, float], ...]:
        return tuple((0.13 + c * x - s * y, 0.27 + s * x + c * y) for x, y in corners)

    r, t = 6.0, thick
    found = cells(
        wall((-r, r - t), (r, r - t), (r, r), (-r, r)),
        wall((-r, -r), (r, -r), (r, t - r), (-r, t - r)),
        wall((-r, -r), (t - r, -r), (t - r, r), (-r, r)),
        wall((r - t, -r), (r, -r), (r, r), (r - t, r)),
    )
    reached = {(int(-found.west / CELL_M), int(-found.south / CELL_M))}
    to_do = [*reached]
    while to_do:
        i, j = to_do.pop()
        for there in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if there not in reached and found.tops[there] == FREE:
                reached.add(there)
                to_do.append(there)
    assert len(reached) * CELL_M**2 == pytest.approx(144.0, rel=0.15)


def test_where_buildings_overlap_the_higher_one_counts() -> None:
    square = ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0))
    found = cells_of(Buildings((Building(square, 20.0), Building(square, 10.0)), altitude=4.0))
    assert found.levels.tolist() == [16.0]


def test_the_grid_has_a_margin_of_the_buildings_size_from_20_to_40_m() -> None:
    for size, margin in ((2.0, 20.0), (30.0, 30.0), (60.0, 40.0)):
        found = cells(((0.0, 0.0), (size, 0.0), (size, size), (0.0, size)))
        assert (found.west, found.south) == (-margin, -margin)
        assert found.tops.shape == (2 * (size + 2 * margin), 2 * (size + 2 * margin))
