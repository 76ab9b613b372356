"""Protects recorded plumes in a mission: the source and the wind land on the scenario's, the movie starts by
the seed and goes round, and every answer has the same bits whatever is asked before or beside it.
"""

import math
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plume.recorded.air import recorded
from plume.scenario import Scenario, WorldError, draw
from plume.worlds.world import World
from tests.plume.recorded import writers

SCENARIO = Scenario(source=(12.0, 17.0), q=1.0, u=2.0, phi=math.pi / 2, d=1.0, tau=1.0, start=(0.0, 0.0))
"""The wind comes from the north: gas lies to the south."""
TOLD = {"fps": "2", "source_x": "1", "source_y": "2", "wind": "180"}
"""In the movie the wind comes from −x: gas lies to the right of the source."""


@pytest.fixture
def movie(tmp_path: Path) -> Path:
    """Gas at one pixel, (3, 2), 2 to the right of the source; as much as the number of the frame, from 1."""
    frames = np.zeros((4, 5, 6))
    frames[:, 2, 3] = [1, 2, 3, 4]
    return writers.npy(tmp_path / "m.npy", frames)


def gas_at(air: Any, place: tuple[float, ...], time_s: float) -> float:
    return float(air(np.array([[*place, 0.0][:3]]), np.array([time_s]))[0][0])


def begins_early(file: Path, **others: Any) -> Any:
    """The air with a seed for which the movie begins between its first two frames, and where there."""
    for seed in range(100):
        plain = recorded(SCENARIO, seed, file=str(file), **TOLD)
        start = gas_at(plain, (12.0, 15.0), 0.0) - 1
        if start < 1 and gas_at(plain, (12.0, 15.0), 0.5) == pytest.approx(start + 2):
            return recorded(SCENARIO, seed, file=str(file), **(TOLD | others)), start
    raise AssertionError


def test_the_source_and_the_wind_land_on_those_of_the_scenario(movie: Path) -> None:
    air = recorded(SCENARIO, 1, file=str(movie), **TOLD)
    places = np.array([(x, y, 0.0) for x in np.arange(5, 20, 0.5) for y in np.arange(10, 25, 0.5)])
    gas, wind = air(places, np.zeros(len(places)))
    assert places[gas.argmax(), :2].tolist() == [12.0, 15.0]  # 2 m south of the source
    assert np.hypot(*(places[gas > 1e-9, :2] - (12, 15)).T).max() < 2**0.5
    assert wind == pytest.approx(np.tile(SCENARIO.wind, (len(places), 1)))


@pytest.mark.parametrize("seed", range(5))
def test_wherever_the_source_and_the_wind_are(movie: Path, seed: int) -> None:
    scenario = draw(seed)
    air = recorded(scenario, seed, file=str(movie), **TOLD, scale=1.5)
    away = 3.0 * np.array([math.cos(scenario.phi), math.sin(scenario.phi)])
    spot = tuple((np.array(scenario.source) - away).tolist())  # 2 pixels of 1.5 m downwind
    shifted = [
        gas_at(air, (spot[0] + dx, spot[1] + dy), 0.0)
        for dx, dy in ((0.1, 0), (-0.1, 0), (0, 0.1), (0, -0.1))
    ]
    assert gas_at(air, spot, 0.0) > max(shifted)
    assert 1 <= gas_at(air, spot, 0.0) <= 4


def test_the_movie_goes_on_with_time_and_its_last_frame_goes_over_into_the_first(movie: Path) -> None:
    air, start = begins_early(movie)
    for time_s in np.arange(0, 9, 0.137):
        frame = (start + 2 * time_s) % 4
        wanted = frame + 1 if frame <= 3 else 4 - 3 * (frame - 3)
        assert gas_at(air, (12.0, 15.0), time_s) == pytest.approx(wanted, abs=1e-9)


def test_the_start_is_drawn_by_the_seed_over_the_whole_movie(movie: Path) -> None:
    airs = [recorded(SCENARIO, seed, file=str(movie), **TOLD) for seed in range(200)]
    seen = np.array([gas_at(air, (12.0, 15.0), 0.0) for air in airs])
    again = [
        gas_at(recorded(SCENARIO, seed, file=str(movie), **TOLD), (12.0, 15.0), 0.0) for seed in range(200)
    ]
    assert seen.tolist() == again
    assert len(set(seen.tolist())) == 200
    assert seen.mean() == pytest.approx(2.5, abs=0.25)  # as of the frames; 4 standard errors


def test_what_is_skipped_is_never_played(movie: Path) -> None:
    times = np.arange(0, 20, 0.1)
    for seed in range(5):
        air = recorded(SCENARIO, seed, file=str(movie), **TOLD, skip=1.0)  # the first two frames
        gas = [gas_at(air, (12.0, 15.0), time_s) for time_s in times]
        assert min(gas) >= 3
        assert max(gas) > 3.5


def test_gain_and_scale_stretch_the_gas_and_the_lengths(movie: Path) -> None:
    air, start = begins_early(movie)
    grown, _ = begins_early(movie, gain=10.0, scale=0.5)
    assert gas_at(grown, (12.0, 16.0), 0.0) == pytest.approx(10 * (start + 1))
    assert gas_at(air, (12.0, 16.0), 0.0) == 0
    faster, start = begins_early(movie, fps="20")
    assert gas_at(faster, (12.0, 15.0), 0.05) == pytest.approx(start + 2)


def test_outside_the_movie_there_is_no_gas_and_the_wind_of_the_scenario(movie: Path) -> None:
    air = recorded(SCENARIO, 1, file=str(movie), **TOLD)
    gas, wind = air(np.array([[500.0, 500.0, 0.0]]), np.array([3.0]))
    assert (gas.tolist(), wind.tolist()) == ([0.0], [list(SCENARIO.wind)])


def test_a_movie_is_the_same_at_every_height(movie: Path) -> None:
    air = recorded(SCENARIO, 1, file=str(movie), **TOLD)
    assert gas_at(air, (12.0, 15.0, 0.0), 1.0) == gas_at(air, (12.0, 15.0, 9.0), 1.0) > 0


# ---- GADEN ----


def room(folder: Path, velocity: Any = (0.3, 0.4, 0.1), **options: Any) -> Path:
    winds = [writers.wind_bytes(writers.steady(velocity))]
    return writers.results(folder, [writers.content(**options)] * 2, winds=winds)


def test_gadens_wind_at_the_source_is_turned_to_that_of_the_scenario(tmp_path: Path) -> None:
    air = recorded(SCENARIO, 1, file=str(room(tmp_path)), fps="1", scale=2.0)
    gas, wind = air(np.array([[12.0, 17.0, 0.0], [100.0, 100.0, 0.0]]), np.zeros(2))
    # 0.5 m/s in a room twice as large; from the north
    assert wind[0] == pytest.approx([0.0, 1.0], abs=1e-6)
    assert wind[1] == pytest.approx(SCENARIO.wind)
    assert gas[0] > 0
    assert gas[1] == 0


def test_gadens_gas_is_placed_in_grams_at_the_height_of_the_source(tmp_path: Path) -> None:
    """One filament 0.5 m downwind of the source, 0.1 m above it: so it is in the mission, at twice the size."""
    above = (0.25 + 0.3, 1.5 + 0.4, 1.1, 10.0)
    run = room(tmp_path, filaments=[above])
    scenario = Scenario(**{**{f: getattr(SCENARIO, f) for f in SCENARIO.__struct_fields__}, "height": 2.0})
    air = recorded(scenario, 1, file=str(run), fps="1", scale=2.0, gain=3.0)
    # 1 m south of the source, 0.2 m above it. 310.56 ppm of methane at 0.656 mg/m³ each, by hand; three times.
    assert gas_at(air, (12.0, 16.0, 2.2), 0.0) == pytest.approx(3 * 310.56 * 0.656e-3, rel=1e-3)
    # 10 cm beside its middle in the file, one σ
    assert gas_at(air, (12.2, 16.0, 2.2), 0.0) == pytest.approx(
        3 * 310.56 * 0.656e-3 * math.exp(-0.5), rel=1e-3
    )
    assert gas_at(air, (12.0, 16.0, 7.0), 0.0) == 0  # above the room


def test_a_given_wind_turns_gaden_instead(tmp_path: Path) -> None:
    air = recorded(SCENARIO, 1, file=str(room(tmp_path)), fps="1", wind="0")
    # From +x is turned to from the north: by a quarter to the left; the air moves by (−0.4, 0.3).
    assert air(np.array([[12.0, 17.0, 0.0]]), np.zeros(1))[1][0] == pytest.approx([0.4, -0.3], abs=1e-6)


@pytest.mark.parametrize("kind", ["movie", "zarr", "gaden"])
def test_every_answer_has_the_same_bits_in_any_order_and_batch(tmp_path: Path, kind: str) -> None:
    rng = np.random.default_rng(2)
    told: dict[str, Any] = dict(TOLD)
    if kind == "gaden":
        moments = [
            writers.content(filaments=rng.uniform((-1, 0.5, 0, 5), (2, 3, 2, 60), (40, 4))) for _ in range(6)
        ]
        file = writers.results(
            tmp_path, moments, winds=[writers.wind_bytes(rng.normal(size=(*writers.CELLS, 3)))]
        )
        told = {"fps": "2"}
    else:
        frames = rng.random((6, 5, 6))
        file = writers.npy(tmp_path / "m.npy", frames)
        if kind == "zarr":
            file = writers.zarr(tmp_path / "m.zarr", frames, said=writers.attributes(frames.shape, origin=0))
    scenario = draw(4)
    places = np.column_stack([rng.normal(0, 2, (150, 2)) + scenario.source, rng.uniform(-0.5, 0.5, 150)])
    times_s = rng.uniform(0, 3600, 150)
    gas, wind = recorded(scenario, 9, file=str(file), **told)(places, times_s)
    assert np.count_nonzero(gas) > 20
    air = recorded(scenario, 9, file=str(file), **told)
    for n in rng.permutation(150):
        alone, its_wind = air(places[n : n + 1], times_s[n : n + 1])
        assert (alone[0], *its_wind[0]) == (gas[n], *wind[n])
    half, _ = air(places[::-2], times_s[::-2])
    assert half.tolist() == gas[::-2].tolist()


# ---- parameters ----


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"file": ""}, "file is missing; wanted recorded:file=PATH"),
        ({"scale": 0.0}, "scale is 0; wanted a number above 0"),
        ({"gain": -1.0}, "gain is -1; wanted a number above 0"),
        ({"skip": -1.0}, "skip is -1; wanted a number from 0"),
        ({"skip": 1.6}, "skip is 1.6; wanted less than the 2 s that are recorded"),
        ({"fps": "fast"}, "fps is 'fast'; wanted a number"),
        ({"fps": "nan"}, "fps is 'nan'; wanted a number"),
        ({"fps": "0"}, "fps is 0; wanted a number above 0"),
        ({"source_x": "1e999"}, "source_x is '1e999'; wanted a number"),
        ({"source_x": "5.6"}, r"source_x is 5.6; wanted -0.5 to 5.5, the space of .*m\.npy"),
        ({"source_z": "3"}, "source_z is '3'; wanted it of GADEN's results only"),
        ({"wind": "north"}, "wind is 'north'; wanted a number"),
        ({"gas": "methane"}, "gas is 'methane'; wanted it of GADEN's results only: gain turns a movie into"),
        ({"source_y": ""}, r".*m\.npy does not say source_y; wanted source_y=…"),
        (
            dict.fromkeys(TOLD, ""),
            r".*m\.npy does not say fps and source_x and source_y and wind; "
            "wanted fps=…,source_x=…,source_y=…,wind=…",
        ),
    ],
    ids=str,
)
def test_a_parameter_that_is_wrong_is_one_line(movie: Path, given: Any, told: str) -> None:
    with pytest.raises(ValueError, match=f"^{told}"):
        recorded(SCENARIO, 1, **({"file": str(movie)} | TOLD | given))


def test_what_gadens_results_do_not_say_is_asked_for(tmp_path: Path) -> None:
    run = writers.results(tmp_path, [writers.content("2.6")])
    with pytest.raises(
        ValueError, match="does not say fps and source_x and source_y and source_z and wind and gas"
    ):
        recorded(SCENARIO, 1, file=str(run))
    told = {"fps": "1", "source_x": "0.3", "source_y": "1.6", "source_z": "1", "wind": "0", "gas": "methane"}
    air = recorded(SCENARIO, 1, file=str(run), **told)
    assert gas_at(air, (12.0, 17.0, 0.0), 0.0) > 310 * 0.656e-3


def test_a_calm_at_the_source_tells_no_direction(tmp_path: Path) -> None:
    run = room(tmp_path, velocity=(0, 0, 1))
    with pytest.raises(ValueError, match=r"^the wind at the source of .* is 0 m/s; wanted wind=…"):
        recorded(SCENARIO, 1, file=str(run), fps="1")


def test_a_broken_frame_is_one_line_when_it_is_played(tmp_path: Path) -> None:
    run = room(tmp_path)
    (run / "iteration_1").write_bytes(b"")
    air = recorded(SCENARIO, 1, file=str(run), fps="1")
    with pytest.raises(ValueError, match=r"iteration_1: the zlib stream is cut off"):
        air(np.tile([12.0, 16.0, 0.0], (3, 1)), np.arange(3.0))


@pytest.mark.parametrize("value", [1.7e308, 5e-324, -0.0, np.inf, np.nan])
def test_numbers_that_no_gas_has_give_no_warning(tmp_path: Path, value: float) -> None:
    path = writers.npy(tmp_path / "m.npy", np.full((3, 4, 5), value))
    name = f"recorded:file={path},fps=1,source_x=2,source_y=2,wind=180,gain=50"
    world = World(SCENARIO, 1, name=name)
    with warnings.catch_warnings(action="error"):
        if value == 1.7e308:
            with pytest.raises(
                WorldError, match=r" said gas inf and wind .+; wanted gas from 0 to 1e\+12 g/m³"
            ):
                world.measure(SCENARIO.source, 0)
        else:
            assert abs(world.measure(SCENARIO.source, 0)[0]) < 2  # noise


def test_a_file_that_has_changed_is_read_anew(movie: Path) -> None:
    before = gas_at(recorded(SCENARIO, 1, file=str(movie), **TOLD), (12.0, 15.0), 0.0)
    frames = np.zeros((4, 5, 7))
    frames[:, 2, 3] = [10, 20, 30, 40]
    writers.npy(movie, frames)
    after = gas_at(recorded(SCENARIO, 1, file=str(movie), **TOLD), (12.0, 15.0), 0.0)
    assert after == pytest.approx(10 * before)


def test_a_movie_is_flown_in_without_the_compiler(movie: Path) -> None:
    code = (
        "import sys, numpy as np; from plume.recorded.air import recorded; from plume.scenario import draw\n"
        f"air = recorded(draw(1), 1, file={str(movie)!r}, **{TOLD})\n"
        "air(np.zeros((1, 3)), np.zeros(1)); print({'numba', 'h5py', 'numcodecs', 'scipy'} & set(sys.modules))"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=400, check=True
    )
    assert ran.stdout == "set()\n"
