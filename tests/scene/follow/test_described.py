"""Protects what is drawn of a run's own description: also of older ones, and of those that make no sense."""

from pathlib import Path
from typing import Any

import pytest

from plume.problem import AREA, Area, square
from scene.follow.described import backdrop_of, outlines

FENCE = ((-20.0, 0.0), (80.0, 0.0), (30.0, 50.0))
TOWER = ((4.0, 4.0), (8.0, 4.0), (8.0, 9.0))


def test_the_area_and_what_to_keep_out_of_are_those_of_the_problem() -> None:
    problem = {"area": {"low": [-20, 0], "high": [80, 50]}, "step_m": 2, "keep_out": [TOWER]}
    problem["keep_in"] = FENCE
    backdrop, _ = backdrop_of({"problem": problem})
    assert backdrop.area == Area((-20.0, 0.0), (80.0, 50.0))
    assert [tuple(map(tuple, wall)) for wall in backdrop.walls] == [TOWER]
    assert tuple(map(tuple, backdrop.fence)) == FENCE


def test_buildings_are_those_that_a_record_holds_and_no_file_of_this_machine(tmp_path: Path) -> None:
    file = tmp_path / "secret.yaml"
    file.write_text("buildings: [{footprint: [[0, 0], [1, 0], [1, 1.004]], height: 3}]")
    flown = {"mission": {"world": f"walls:file={file}"}}
    assert outlines(flown["mission"]["world"]) == ((((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))),)
    assert backdrop_of(flown)[0].walls == ()
    assert backdrop_of({**flown, "walls": [TOWER]})[0].walls == (TOWER,)
    assert backdrop_of({"mission": {"world": "walls:file=courtyard"}})[0].walls != ()  # an example that ships


@pytest.mark.parametrize(
    "walls", ["a house", [[1, 2]], [[[0, 0], [1, 0]]], [[[0, 0], [1, 0], [1, 1e300]]], [TOWER] * 51, None]
)
def test_buildings_that_make_no_sense_are_left_out(walls: Any) -> None:
    assert backdrop_of({"walls": walls})[0].walls == ()


def test_a_replay_that_was_kept_before_there_were_problems_has_its_area() -> None:
    backdrop, _ = backdrop_of({"area_m": 55.0})
    assert backdrop.area == square(55.0)


@pytest.mark.parametrize(
    "about",
    [
        {},
        {"area_m": "wide"},
        {"area_m": -3.0},
        {"area_m": float("nan")},
        {"area_m": [1]},
        {"problem": {"area": 3}},
    ],
)
def test_of_a_description_that_says_nothing_sound_the_area_is_that_of_the_paper(
    about: dict[str, Any],
) -> None:
    backdrop, _ = backdrop_of(about)
    assert backdrop.area == AREA
    assert backdrop.walls == ()
