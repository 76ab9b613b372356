"""Protects the wind around buildings: no air is made or lost, none goes through walls, and it is the flow of
textbooks and of a sparse solver.
"""

import numpy as np
import pytest

from plume.elementary import Array
from plume.walls.buildings import Building, Buildings, read
from plume.walls.cells import Mask
from plume.walls.flow import EAST, NORTH, PER_WIND, SOUTH, WEST, flow_around, unit_flow


def disc(radius: float, half: float) -> Mask:
    """The free cells around a round building in the middle of a square of 2 half × 2 half cells."""
    at = np.arange(2 * half) + 0.5 - half
    return np.square(at)[:, None] + np.square(at) > radius * radius


def test_no_air_is_made_or_lost_and_none_goes_through_a_wall() -> None:
    cells, flow = flow_around(read("courtyard"))
    assert len(flow) == 3
    for level, each in zip(cells.levels, flow, strict=True):
        free = cells.tops < level
        for wind in (each[..., :PER_WIND], each[..., PER_WIND:]):
            divergence = wind[..., EAST] - wind[..., WEST] + wind[..., NORTH] - wind[..., SOUTH]
            assert np.abs(divergence).max() < 1e-9
            assert (wind[~free] == 0).all()
            assert (wind[1:, :, WEST] == wind[:-1, :, EAST]).all()
            assert (wind[:, 1:, SOUTH] == wind[:, :-1, NORTH]).all()


def test_at_the_edge_it_is_the_given_wind_that_blows_in_and_out() -> None:
    _, flow = flow_around(read("courtyard"))
    for first, across, along in ((0, 1.0, 0.0), (PER_WIND, 0.0, 1.0)):
        assert (flow[:, 0, :, first + WEST] == across).all()
        assert (flow[:, -1, :, first + EAST] == across).all()
        assert (flow[:, :, 0, first + SOUTH] == along).all()
        assert (flow[:, :, -1, first + NORTH] == along).all()


def test_higher_up_the_air_goes_around_fewer_buildings() -> None:
    shed = Building(((0.0, 0.0), (6.0, 0.0), (6.0, 6.0), (0.0, 6.0)), 7.0)
    tower = Building(((10.0, 0.0), (16.0, 0.0), (16.0, 6.0), (10.0, 6.0)), 20.0)
    cells, flow = flow_around(Buildings((shed, tower)))
    alone = (cells.tops == 15.0)[..., None]
    assert (flow[1] == 0).all(axis=-1, keepdims=True)[alone].all()
    assert (flow[1][cells.tops == 2.0] != 0).any(axis=-1).all()  # over the shed's roof
    assert (flow[0][cells.tops == 2.0] == 0).all()


def test_a_closed_yard_has_no_wind() -> None:
    free = np.ones((40, 40), bool)
    free[10:30, 10:30] = False
    free[15:25, 15:25] = True
    assert np.abs(unit_flow(free)[15:25, 15:25]).max() < 1e-9


def reference(free: Mask) -> Array:
    """The speeds at west faces, by SciPy's direct solver with one φ held at 0."""
    from scipy.sparse import lil_matrix
    from scipy.sparse.linalg import spsolve

    nx = len(free)
    number = {cell: n for n, cell in enumerate(map(tuple, np.argwhere(free).tolist()))}
    matrix, right = lil_matrix((len(number), len(number))), np.zeros(len(number))
    for (i, j), n in number.items():
        for there, blows in (((i + 1, j), 1.0), ((i - 1, j), -1.0), ((i, j + 1), 0.0), ((i, j - 1), 0.0)):
            if there in number:
                matrix[n, n] += 1.0
                matrix[n, number[there]] -= 1.0
                right[n] += blows
            elif there[0] in (-1, nx):
                right[n] += blows
    matrix[0, 0] += 1.0
    phi = np.full(free.shape, np.nan)
    phi[free] = spsolve(matrix.tocsc(), right)
    west = np.zeros(free.shape)
    west[1:] = np.nan_to_num(1.0 + phi[1:] - phi[:-1])
    west[0] = free[0]
    return west


def test_it_is_what_a_sparse_direct_solver_finds() -> None:
    rng = np.random.default_rng(1)
    free = np.ones((60, 50), bool)
    for i, j, wide, deep in zip(*rng.integers((5, 5, 2, 2), (50, 40, 9, 9), (6, 4)).T, strict=True):
        free[i : i + wide, j : j + deep] = False
    assert unit_flow(free)[..., WEST] == pytest.approx(reference(free), abs=1e-8)


@pytest.mark.parametrize("radius", [8, 16])
def test_around_a_round_building_it_is_the_potential_flow_of_textbooks(radius: int) -> None:
    """u = 1 − R² (x² − y²)/r⁴, v = −2 R² x y/r⁴; the error halves with the cells."""
    half = 12 * radius
    flow = unit_flow(disc(radius, half))
    at = np.arange(2 * half) + 0.5 - half
    for face, back, across in ((WEST, (0.5, 0.0), False), (SOUTH, (0.0, 0.5), True)):
        x, y = np.meshgrid(at - back[0], at - back[1], indexing="ij")
        r2 = x * x + y * y
        exact = -2 * x * y if across else y * y - x * x
        near = (r2 > (1.5 * radius) ** 2) & (r2 < (3 * radius) ** 2)
        error = flow[..., face] - (not across) - radius**2 * exact / (r2 * r2)
        assert np.abs(error[near]).max() < 0.5 / radius
