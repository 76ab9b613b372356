"""Protects `plumeward worlds show`: what it says of a recorded plume is what was written into it, in 80 columns;
the picture shows it; a file that is wrong is one line.
"""

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plume.worlds.names import named
from sitl.__main__ import main
from tests.plume.recorded import writers


def shown(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, str]:
    """What is said, by the label of each row."""
    assert main(arguments=["worlds", "show", *map(str, words)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    rows = re.findall(r"^(\S.{14}) (.*(?:\n {16}.*)*)", out, re.MULTILINE)
    assert max(map(len, out.splitlines())) <= 80 or "/" in out  # a path is not broken
    return {label.strip(): " ".join(text.split()) for label, text in rows}


def movie(folder: Path, **said: Any) -> Path:
    frames = np.zeros((40, 4, 5), np.float32)
    frames[:, 2, 1] = np.arange(1, 41)
    frames[20:, 0, 0] = 0.5
    return writers.zarr(folder / "m.zarr", frames, said=writers.attributes(frames.shape, **said))


def test_a_movie_is_said_in_its_own_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    movie(tmp_path, source_location_px=[1, 2], camera="blue")
    monkeypatch.chdir(tmp_path)
    assert shown(capsys, "m.zarr") == {
        "kind": "movie of plume_nav_sim (Zarr 2)",
        "frames": "40; 4 a second, 10 s in all",
        "grid": "5 × 4 cells of 0.5 × 2, in units of its grid",
        "extent": "x -3.25 to -0.75, y 9 to 17",
        # Every 2.6th frame: pixels of 1, 4, 6, 9, 11, … 40, and 8 of 0.5: 24 of 320, 10 in the middle.
        "concentration": "greatest 40 of its own unit, in frame 39; typical 10 of its own unit; above 0 at 8% "
        "of places and times. Of 16 frames",
        "source": "x -2.5, y 14",
        "wind": "not in the file",
        "not read": "attribute 'camera', attribute 'source_dtype'",
        "to fly in it": "--world 'recorded:file=m.zarr,wind=…'",
    }


def test_results_of_gaden_are_said_in_ppm_and_grams_with_their_wind(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = writers.results(
        tmp_path,
        [writers.content(filaments=[(0.25, 1.75, 1.0, 10.0)])] * 3,
        winds=[writers.wind_bytes(writers.steady((0.0, 0.5, 0.0)))],
    )
    said = shown(capsys, run)
    assert said["kind"] == "results of GADEN 3.0, filaments"
    assert said["frames"] == "3; how many a second is not said"
    assert said["source"] == "x 0.25, y 1.5, z 1"
    assert said["wind"] == "at the source 0.5 m/s, from 270° (counter-clockwise from +x)"
    # 310.56 ppm at the middle of the filament, which is the centre of a cell, at 0.656 mg/m³ each
    assert said["concentration"].startswith("greatest 311 ppm, which is 0.204 g/m³, in frame 0;")
    assert said["not read"] == "upward wind"
    assert said["to fly in it"] == f"--world 'recorded:file={run},fps=…'"


def test_what_the_file_does_not_say_is_left_open_for_whoever_flies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    writers.npy(tmp_path / "a b.npy", np.zeros((2, 3, 3)))
    said = shown(capsys, "a b.npy")
    assert said["to fly in it"] == "--world 'recorded:file=a b.npy,fps=…,source_x=…,source_y=…,wind=…'"
    assert said["concentration"].startswith(
        "greatest 0 of its own unit, in frame 0; typical 0 of its own unit"
    )
    run = writers.results(tmp_path, [writers.content("2.6")])
    said = shown(capsys, run.relative_to(tmp_path))
    assert said["to fly in it"] == (
        "--world 'recorded:file=simulations/sim1,fps=…,source_x=…,source_y=…,source_z=…,wind=…,gas=…'"
    )


@pytest.mark.parametrize("name", ["a,b.npy", "a+b.npy"])
def test_a_path_that_no_world_can_name_is_told_as_such(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    writers.npy(tmp_path / name, np.ones((2, 3, 4), np.float32))
    assert shown(capsys, name)["to fly in it"] == "under another name: a path with , or + cannot be told"
    with pytest.raises(ValueError, match="wanted"):
        named(f"recorded:file={name},fps=1,source_x=1,source_y=1,wind=180")


@pytest.mark.slow
def test_the_picture_shows_gas_walls_and_source_where_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from PIL import Image

    states = np.zeros(writers.CELLS, int)
    states[5, :, :] = 1
    run = writers.results(
        tmp_path, [writers.content(filaments=[(-0.5, 2.5, 1.0, 15.0)])], grid=writers.grid_text(states)
    )
    picture = tmp_path / "room.png"
    assert "kind" in shown(capsys, run, "-o", picture)
    image = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    wall = (abs(image - 0x9A).max(axis=2) < 3).sum()
    orange = (image[..., 0] > image[..., 2] + 100).sum()
    assert wall > 10_000
    assert orange > 5_000
    before = picture.read_bytes()
    assert main(arguments=["worlds", "show", str(run), "-o", str(picture)]) == 2
    assert capsys.readouterr().err == f"error: --out: '{picture}' exists; wanted another name, or --force\n"
    assert shown(capsys, run, "-o", picture, "--force")
    assert picture.read_bytes() == before  # the same plume is the same file


@pytest.mark.slow
@pytest.mark.parametrize("value", [1.7e308, 5e-324, -0.0, np.inf])
def test_a_plume_of_numbers_that_no_gas_has_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], value: float
) -> None:
    movie, picture = writers.npy(tmp_path / "m.npy", np.full((3, 4, 5), value)), tmp_path / "m.png"
    with warnings.catch_warnings(action="error"):
        greatest = shown(capsys, movie, "-o", picture)["concentration"]
    assert greatest.startswith(f"greatest {value if 0 < value < np.inf else 0:.3g} of its own unit")
    assert picture.stat().st_size > 1000


def test_a_file_that_is_wrong_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = writers.results(tmp_path, [writers.content()])
    (run / "iteration_0").write_bytes(writers.packed(writers.content()[:100]))
    for path, told in (
        (run, f"{run / 'iteration_0'}: mode: wanted 9 bytes, but the file ends after 3"),
        (
            tmp_path / "gone",
            f"{tmp_path / 'gone'}: no such file; wanted a .npy or .h5 movie, a folder of Zarr, or",
        ),
    ):
        assert main(arguments=["worlds", "show", str(path)]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert err.startswith(f"error: {told}")
        assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["worlds"], "the following arguments are required: what, FILE"),
        (["worlds", "list", "m.npy"], "what: 'list' is not allowed; wanted show"),
        (
            ["worlds", "show", "m.npy", "-o", "m.gif"],
            "-o/--out: 'm.gif' is not allowed; wanted a file that ends in",
        ),
    ],
)
def test_words_that_are_wrong_are_one_line(
    capsys: pytest.CaptureFixture[str], words: list[str], told: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments=words)
    assert ended.value.code == 2
    assert told in capsys.readouterr().err
