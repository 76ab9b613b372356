"""Protects GADEN's results as footage: the gas is what GADEN computes, walls hide it, the wind lies between
its cells, and what is missing in the folder is told.
"""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plume.recorded.opening import opened
from tests.plume.recorded import writers
from tests.plume.recorded.writers import ALL_VERSIONS, CELLS, LOW, SIDE, content, results

WITHOUT_PLACES = ("2.6", "2.9")
RNG = np.random.default_rng(6)
PLACES = RNG.uniform((-1, 0.5, 0), (2, 3, 2), (300, 3))
PPM = RNG.random(CELLS[::-1]).astype(np.float32)
AIR = RNG.normal(size=(*CELLS, 3))
COARSE = 1e-5
"""For what was written in single precision."""


def of(footage: Any, places: Any = PLACES, frame: int = 0) -> np.ndarray:
    places = np.atleast_2d(np.asarray(places, float))
    return np.asarray(footage.gas(places, np.full(len(places), frame)))


def ppm_of(place: Any, filaments: Any = writers.FILAMENTS) -> float:
    """The formula of GADEN's player: moles of gas in a cm³ by a Gaussian in cm, by those of all gases."""
    total = 0.0
    for *centre, sigma in filaments:
        cm = 100 * math.dist(place, centre)
        if cm < 3 * sigma:
            moles = (
                writers.MOLES / (math.sqrt(8 * math.pi**3) * sigma**3) * math.exp(-(cm**2) / (2 * sigma**2))
            )
            total += moles / writers.AIR * 1e6
    return total


@pytest.mark.parametrize("version", ALL_VERSIONS)
def test_the_gas_of_filaments_is_that_of_gadens_formula(tmp_path: Path, version: str) -> None:
    footage = opened(results(tmp_path, [content(version)]))
    wanted = [ppm_of(place) for place in PLACES]
    found = of(footage)
    assert 20 < np.count_nonzero(found) < 300
    near = [
        abs(100 * math.dist(place, fil[:3]) - 3 * fil[3]) < 1e-3
        for place in PLACES
        for fil in writers.FILAMENTS
    ]
    assert not any(near)  # no place at which rounding decides
    assert found == pytest.approx(wanted, rel=COARSE)


def test_the_centre_of_a_filament_has_the_gas_that_its_moles_say() -> None:
    """10 cm wide, 2e-4 mol: 2e-4 / (15.7496 · 1000 cm³) of 4.089e-5 mol/cm³ is 310.56 ppm."""
    assert ppm_of((0.3, 1.6, 1.0), [(0.3, 1.6, 1.0, 10.0)]) == pytest.approx(310.56, abs=0.01)


def test_a_part_in_a_million_weighs_what_the_gas_weighs(tmp_path: Path) -> None:
    """Methane at 298 K and 1 atm: 0.656 mg/m³ a ppm."""
    assert opened(results(tmp_path, [content()])).facts.grams == pytest.approx(0.656e-3, rel=1e-3)
    run = results(tmp_path / "b", [content("2.6")])
    assert opened(run).facts.grams is None
    assert opened(run, gas="carbon dioxide").facts.grams == pytest.approx(1.80e-3, rel=1e-3)
    with pytest.raises(ValueError, match=r"^gas: 'gold'; wanted ethanol, methane, "):
        opened(run, gas="gold")


def test_outside_the_space_and_in_walls_there_is_no_gas(tmp_path: Path) -> None:
    states = np.zeros(CELLS, int)
    states[2, 2, 2] = 1  # x 0 to 0.5, y 1.5 to 2, z 1 to 1.5
    wide = [(0.1, 1.2, 1.2, 200.0)]
    footage = opened(results(tmp_path, [content(filaments=wide)], grid=writers.grid_text(states)))
    free, wall, left, above = (0.1, 1.3, 1.2), (0.1, 1.6, 1.2), (-1.01, 1.3, 1.2), (0.1, 1.3, 2.01)
    found = of(footage, [free, wall, left, above])
    assert found[0] == pytest.approx(ppm_of(free, wide), rel=COARSE)
    assert found[1:].tolist() == [0, 0, 0]


def test_a_wall_hides_the_filaments_behind_it_and_no_others(tmp_path: Path) -> None:
    states = np.zeros(CELLS, int)
    states[3, :4, :] = 1  # x 0.5 to 1, open from y 2.5 on
    filament = [(-0.2, 1.1, 1.0, 100.0)]
    footage = opened(results(tmp_path, [content(filaments=filament)], grid=writers.grid_text(states)))
    hidden, beside, before = (1.6, 1.1, 1.0), (0.4, 2.9, 1.0), (0.3, 1.1, 1.0)
    found = of(footage, [hidden, beside, before])
    assert found[0] == 0
    assert found[1:] == pytest.approx([ppm_of(place, filament) for place in (beside, before)], rel=COARSE)


def test_a_filament_in_a_wall_or_an_outlet_is_seen_from_nowhere(tmp_path: Path) -> None:
    for state in (1, 2):
        states = np.zeros(CELLS, int)
        states[2, 2, 2] = state
        run = results(
            tmp_path / str(state),
            [content(filaments=[(0.3, 1.6, 1.2, 100.0)])],
            grid=writers.grid_text(states),
        )
        assert not of(opened(run)).any()


def test_concentrations_and_wind_lie_linearly_between_the_centres_of_cells(tmp_path: Path) -> None:
    from scipy.interpolate import RegularGridInterpolator

    winds = [writers.wind_bytes(AIR), writers.wind_bytes(2 * AIR, "old")]
    footage = opened(results(tmp_path, [content(ppm=PPM), content(ppm=2 * PPM, wind=1)], winds=winds))
    centres = [low + SIDE * (np.arange(count) + 0.5) for low, count in zip(LOW, CELLS, strict=True)]
    clipped = np.clip(PLACES, [axis[0] for axis in centres], [axis[-1] for axis in centres])
    for frame in (0, 1):
        gas = RegularGridInterpolator(centres, (1 + frame) * PPM.transpose(2, 1, 0).astype(float))(clipped)
        assert of(footage, frame=frame) == pytest.approx(gas, rel=1e-6)
        air, known = footage.wind(PLACES, np.full(len(PLACES), frame))
        assert known.all()
        wanted = RegularGridInterpolator(centres, (1 + frame) * AIR)(clipped)[:, :2]
        assert air == pytest.approx(wanted, abs=1e-6)
    air, known = footage.wind(np.array([[-1.1, 1.0, 1.0], [0.0, 1.0, 2.1]]), np.array([0, 1]))
    assert (air.tolist(), known.tolist()) == ([[0, 0], [0, 0]], [False, False])
    assert of(footage, [-1.1, 1.0, 1.0]).tolist() == [0]


def test_frames_and_places_in_any_order_give_the_same_bits(tmp_path: Path) -> None:
    moments = [content(filaments=RNG.uniform((-1, 0.5, 0, 5), (2, 3, 2, 60), (50, 4))) for _ in range(5)]
    run = results(tmp_path, moments, winds=[writers.wind_bytes(AIR)])
    frames = RNG.integers(0, 5, len(PLACES))
    together = opened(run).gas(PLACES, frames)
    footage = opened(run)
    alone = [footage.gas(PLACES[n : n + 1], frames[n : n + 1])[0] for n in reversed(range(len(PLACES)))]
    assert together.tolist() == alone[::-1]
    assert together.any()


def test_a_file_says_what_it_holds_and_what_is_not_read(tmp_path: Path) -> None:
    run = results(
        tmp_path,
        [content("3.0", shape="sphere", sizes=[0.2])] * 3,
        winds=[writers.wind_bytes(AIR)] * 2,
    )
    (run / "notes.txt").touch()
    facts = opened(run).facts
    assert facts.kind == "results of GADEN 3.0, filaments"
    assert (facts.frames, facts.fps, facts.cells, facts.unit, facts.windy) == (3, None, CELLS, "ppm", True)
    assert (facts.low, facts.high, facts.source) == (LOW, (2.0, 3.0, 2.0), writers.SOURCE)
    assert facts.remarks == (
        "gas: methane",
        f"walls: {tmp_path / 'OccupancyGrid3D.csv'}",
        "wind: 2 files",
        "the source is a sphere; its place counts as the source",
    )
    assert facts.unread == ("upward wind", "file 'notes.txt'")


def test_walls_are_those_at_a_height(tmp_path: Path) -> None:
    states = np.zeros(CELLS, int)
    states[3, 1, 2] = 1
    walls = opened(results(tmp_path, [content()], grid=writers.grid_text(states))).walls
    assert np.argwhere(walls(1.2)).tolist() == [[1, 3]]
    assert not walls(0.9).any()


# ---- folders in which something is missing or wrong ----


def asked(run: Path, frame: int, wind: bool) -> None:
    footage, when = opened(run), np.full(len(PLACES), frame)
    footage.wind(PLACES, when) if wind else footage.gas(PLACES, when)


def refused(run: Path, frame: int = 0, wind: bool = False) -> str:
    with pytest.raises(ValueError, match=re.escape(f"{run.parents[1]}")) as raised:
        asked(run, frame, wind)
    line = str(raised.value)
    assert len(line.splitlines()) == 1
    return line


def test_an_iteration_that_is_missing_is_named(tmp_path: Path) -> None:
    run = results(tmp_path, [content()] * 4)
    (run / "iteration_2").unlink()
    assert refused(run) == f"{run}: no iteration_2, but iteration_3; wanted all"
    (run / "iteration_0").unlink()
    assert refused(run) == f"{run}: no iteration_0; wanted iteration_0, iteration_1, …"


def test_filaments_need_the_walls_and_concentrations_do_not(tmp_path: Path) -> None:
    run = results(tmp_path / "a", [content()])
    (tmp_path / "a" / "OccupancyGrid3D.csv").unlink()
    assert refused(run) == f"{run}: no OccupancyGrid3D.csv here or in the 3 folders above; wanted it"
    run = results(tmp_path / "b", [content(ppm=PPM)])
    (tmp_path / "b" / "OccupancyGrid3D.csv").unlink()
    assert of(opened(run)).all()
    assert opened(run).walls(1.0) is None


def test_walls_of_another_space_are_refused(tmp_path: Path) -> None:
    other = writers.grid_text(cells=(6, 5, 4), low=(-1.0, 0.5, 0.25))
    run = results(tmp_path, [content()], grid=other)
    assert refused(run) == (
        f"{tmp_path / 'OccupancyGrid3D.csv'}: (6, 5, 4) cells of 0.5 m from (-1.0, 0.5, 0.25); wanted, as in "
        "iteration_0, (6, 5, 4) of 0.5 m from (-1.0, 0.5, 0.0)"
    )


def test_an_iteration_unlike_the_first_is_refused(tmp_path: Path) -> None:
    run = results(tmp_path, [content(), content(ppm=PPM)])
    assert refused(run, frame=1) == (
        f"{run / 'iteration_1'}: another grid or mode than in iteration_0; wanted the same"
    )


def test_a_wind_that_no_file_has_is_told(tmp_path: Path) -> None:
    run = results(tmp_path, [content(wind=5)], winds=[writers.wind_bytes(AIR)] * 2)
    assert refused(run, wind=True) == (
        f"{run / 'iteration_0'}: number of the wind: 5; wanted that of a file, 0 to 1"
    )


def test_without_wind_files_nothing_is_known_of_the_wind(tmp_path: Path) -> None:
    footage = opened(results(tmp_path, [content()]))
    assert not footage.facts.windy
    assert not footage.wind(PLACES, np.zeros(len(PLACES), np.int64))[1].any()


def test_gas_is_said_of_gaden_alone(tmp_path: Path) -> None:
    path = writers.npy(tmp_path / "m.npy", np.zeros((1, 2, 2)))
    with pytest.raises(ValueError, match=r"^gas is 'methane'; wanted it of GADEN's results only"):
        opened(path, gas="methane")
