"""Results of GADEN: the folder of `iteration_0`, `iteration_1`, …, with its walls and its wind."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plume.elementary import Array, Indices
from plume.recorded.footage import PPM, Facts, LastRead
from plume.recorded.iteration import Grid, Moment, read
from plume.recorded.space import FREE, Cells, occupancy, wind

OCCUPANCY = "OccupancyGrid3D.csv"
ABOVE = 3  # folders above the results in which GADEN keeps walls and wind
# Molar masses, g/mol; of mixtures, GADEN's specific gravity times that of air.
MOLAR = {
    "ethanol": 46.07,
    "methane": 16.04,
    "hydrogen": 2.016,
    "propanol": 60.10,
    "chlorine": 70.90,
    "fluorine": 38.00,
    "acetone": 58.08,
    "neon": 20.18,
    "helium": 4.003,
    "biogas": 0.8 * 28.97,
    "butane": 58.12,
    "carbon dioxide": 44.01,
    "carbon monoxide": 28.01,
    "smoke": 0.89 * 28.97,
}


class GadenRun:
    """The results of one simulation as footage; concentrations in ppm."""

    def __init__(self, folder: Path, gas: str = "") -> None:
        self._folder = folder
        numbers = sorted(_numbered(folder, "iteration"))
        if numbers[:1] != [0]:
            raise ValueError(f"{folder}: no iteration_0; wanted iteration_0, iteration_1, …")
        if missing := next((n for n, number in enumerate(numbers) if n != number), None):
            raise ValueError(f"{folder}: no iteration_{missing}, but iteration_{numbers[-1]}; wanted all")
        first = self._first = read(folder / "iteration_0")
        self._grid = first.grid
        self._low = np.array(first.grid.low)
        places = [folder, *folder.resolve().parents[:ABOVE]]
        walls = next((place / OCCUPANCY for place in places if (place / OCCUPANCY).is_file()), None)
        self._cells = self._walls(walls) if walls else None
        if first.filaments is not None and self._cells is None:
            raise ValueError(f"{folder}: no {OCCUPANCY} here or in the {ABOVE} folders above; wanted it")
        self._winds = next((found for place in places if (found := _numbered(place / "wind", ""))), {})
        self._moments = LastRead(self._moment, _size)
        self._airs = LastRead(lambda number: wind(self._winds[number], self._grid), lambda air: air.nbytes)
        gas = gas or first.gas
        if gas not in (*MOLAR, ""):
            raise ValueError(f"gas: {gas!r}; wanted {', '.join(MOLAR)}")
        mode = "filaments" if first.filaments is not None else "concentrations"
        remarks = [f"gas: {gas}" if gas else "the gas is not said", f"walls: {walls or 'none'}"]
        remarks.append(
            f"wind: {len(self._winds)} file{'s' * (len(self._winds) > 1)}" if self._winds else "no wind"
        )
        if first.shape not in ("", "point"):
            remarks.append(f"the source is a {first.shape}; its place counts as the source")
        unread = ["upward wind"] if self._winds else []
        unread += [
            f"file {path.name!r}"
            for path in sorted(folder.iterdir())
            if path.name not in ("wind", OCCUPANCY) and not re.fullmatch(r"iteration_\d+", path.name)
        ]
        self.facts = Facts(
            kind=f"results of GADEN {first.version}, {mode}",
            frames=len(numbers),
            fps=None,
            cells=self._grid.cells,
            cell=(self._grid.side,) * 3,
            low=self._grid.low,
            high=self._grid.high,
            length="m",
            unit=PPM,
            grams=first.air * MOLAR[gas] if gas else None,
            source=first.source,
            windy=bool(self._winds),
            remarks=tuple(remarks),
            unread=tuple(unread),
        )

    def gas(self, places: Array, frames: Indices) -> Array:
        """Return concentrations, as of `Footage`: of filaments exactly, else linearly between cells."""
        from plume.recorded.kernels import among_cells, moles_at  # which loads the compiler

        result = np.empty((len(places), 1))
        there = (places - self._low) / self._grid.side
        for number, those in _each(frames):
            moment, part = self._moments[number], np.empty((np.count_nonzero(those), 1))
            if moment.ppm is not None:
                among_cells(there[those], moment.ppm[..., None], part, np.empty(len(part), np.uint8))
            elif moment.filaments is not None and self._cells is not None:
                moles_at(there[those], moment.filaments, self._cells, part[:, 0])
                part = part / moment.air * 1e6
            result[those] = part
        return result[:, 0]

    def wind(self, places: Array, frames: Indices) -> tuple[Array, NDArray[np.bool_]]:
        """Return how the air moves, as of `Footage`, linearly between cells."""
        from plume.recorded.kernels import among_cells

        there = (places - self._low) / self._grid.side
        air, known = np.zeros((len(places), 3)), np.zeros(len(places), np.uint8)
        for number, those in _each(frames) if self._winds else ():
            which = self._moments[number].wind
            if which not in self._winds:
                raise ValueError(
                    f"{self._folder / f'iteration_{number}'}: number of the wind: {which}; "
                    f"wanted that of a file, {min(self._winds)} to {max(self._winds)}"
                )
            part, inside = np.empty((np.count_nonzero(those), 3)), np.empty(np.count_nonzero(those), np.uint8)
            among_cells(there[those], self._airs[which], part, inside)
            air[those], known[those] = part, inside
        return air[:, :2], known.astype(np.bool_)

    def walls(self, z: float) -> NDArray[np.bool_] | None:
        """Return which cells are no air, as of `Footage`."""
        if self._cells is None:
            return None
        layer = int(np.clip((z - self._grid.low[2]) / self._grid.side, 0, self._grid.cells[2] - 1))
        return np.asarray(self._cells[layer] != FREE)

    def _moment(self, number: int) -> Moment:
        path = self._folder / f"iteration_{number}"
        moment = read(path)
        if (moment.grid, moment.filaments is None) != (self._grid, self._first.filaments is None):
            raise ValueError(f"{path}: another grid or mode than in iteration_0; wanted the same")
        if moment.filaments is None:
            return moment
        from plume.recorded.kernels import prepared

        return moment._replace(filaments=prepared(moment.filaments, self._low, self._grid.side, moment.moles))

    def _walls(self, path: Path) -> Cells:
        grid, cells = occupancy(path)
        if not _alike(grid, self._grid):
            raise ValueError(
                f"{path}: {grid.cells} cells of {grid.side:g} m from {grid.low}; wanted, as in iteration_0, "
                f"{self._grid.cells} of {self._grid.side:g} m from {self._grid.low}"
            )
        return cells


def _each(frames: Indices) -> Iterator[tuple[int, NDArray[np.bool_]]]:
    """Yield each frame, and which elements are of it."""
    for number in sorted(set(frames.tolist())):
        yield number, frames == number


def _alike(one: Grid, other: Grid) -> bool:
    """Whether two grids are the same to the six digits that GADEN writes."""
    near = zip((*one.low, one.side), (*other.low, other.side), strict=True)
    return one.cells == other.cells and all(abs(a - b) <= 0.01 * other.side for a, b in near)


def _numbered(folder: Path, name: str) -> dict[int, Path]:
    """Return the files NAME_K of a folder by K; with no name, those of any."""
    if not folder.is_dir():
        return {}
    named = ((re.fullmatch(rf"{name or '.*'}_(\d{{1,9}})", path.name), path) for path in folder.iterdir())
    return {int(match[1]): path for match, path in named if match and path.is_file()}


def _size(moment: Moment) -> int:
    return sum(part.nbytes for part in (moment.filaments, moment.ppm) if part is not None) + 1024
