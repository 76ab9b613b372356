"""Protects files of buildings: what they may say, and one clear line about each that is wrong."""

import os
from pathlib import Path

import pytest

from plume.scenario import SOURCE_HIGH_M, SOURCE_LOW_M
from plume.walls.buildings import MOST_BYTES, Building, Buildings, outline, read
from plume.walls.cells import CELL_M, FREE, cells_of

SQUARE = "[[0, 0], [4, 0], [4, 4], [0, 4]]"


def written(folder: Path, text: str) -> str:
    path = folder / "site.yaml"
    path.write_text(text)
    return str(path)


def test_a_file_says_footprints_heights_and_the_altitude_of_the_search_plane(tmp_path: Path) -> None:
    file = written(tmp_path, f"altitude: 8\nbuildings: [{{height: 6.5, footprint: {SQUARE}}}]")
    corners = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))
    assert read(file) == Buildings((Building(corners, 6.5),), 8.0)


def test_without_a_file_there_are_no_buildings_and_a_file_may_have_none(tmp_path: Path) -> None:
    assert read("") == read(written(tmp_path, "buildings: []")) == Buildings()


@pytest.mark.parametrize("footprint", ["[0, 0], [4, 0], [4, 4], [0, 0]", "[0, 0], [4, 0], [4, 0], [4, 4]"])
def test_a_corner_may_be_given_twice_in_a_row_around_it(footprint: str, tmp_path: Path) -> None:
    (building,) = read(written(tmp_path, f"buildings: [{{height: 3, footprint: [{footprint}]}}]")).buildings
    assert outline(building).tolist() in ([[0, 0], [4, 0], [4, 4]], [[4, 0], [4, 4], [0, 0]])


def test_the_shipped_courtyard_leaves_every_source_of_table_1_in_the_open() -> None:
    cells = cells_of(read("courtyard"))
    low = [int((SOURCE_LOW_M - edge) / CELL_M) for edge in (cells.west, cells.south)]
    high = [int((SOURCE_HIGH_M - edge) / CELL_M) + 1 for edge in (cells.west, cells.south)]
    assert (cells.tops[low[0] : high[0], low[1] : high[1]] == FREE).all()
    assert cells.levels.tolist() == [2.0, 7.0, 15.0]  # 5 m above the ground


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("buildings: [{height: 3, footprint: [[0, 0], [4, 4], [4, 0], [0, 4]]}]", "sides 1 and 3 meet"),
        ("buildings: [{height: 3, footprint: [[0, 0], [4, 0], [2, 0], [2, 3]]}]", "sides 1 and 2 meet"),
        ("buildings: [{height: 3, footprint: [[0, 0], [4, 0], [8, 0]]}]", "crosses or touches itself"),
        ("buildings: [{height: 3, footprint: [[0, 0], [4, 4], [0, 0]]}]", "crosses or touches itself"),
        ("buildings: [{height: 3, footprint: [[0, 0], [4, 4]]}]", "buildings[0].footprint"),
        ("buildings: [{height: 3, footprint: [[0, 0], [4, 0], [.nan, 4]]}]", "the corner [nan, 4.0]"),
        ("buildings: [{height: 3, footprint: [[0, 0], [4, 0], [.inf, 4]]}]", "within ±1000"),
        ("buildings: [{height: 3, footprint: [[0, 0], [4, 0], [4, 2000]]}]", "within ±1000"),
        (
            f"buildings: [{{height: 0, footprint: {SQUARE}}}]",
            "buildings[0].height is 0; wanted metres above 0",
        ),
        (f"buildings: [{{height: -2, footprint: {SQUARE}}}]", "buildings[0].height is -2"),
        (f"buildings: [{{height: .nan, footprint: {SQUARE}}}]", "buildings[0].height is nan"),
        (f"buildings: [{{height: tall, footprint: {SQUARE}}}]", "buildings[0].height"),
        (f"buildings: [{{height: 1{'0' * 400}, footprint: {SQUARE}}}]", "buildings[0].height"),
        (f"buildings: [{{height: 3, footprint: {SQUARE}, colour: red}}]", "colour"),
        (f"buildings: [{{footprint: {SQUARE}}}]", "height"),
        ("altitude: 0", "altitude is 0"),
        ("[1, 2]", "the file: Expected `object`"),
        ("", "the file: Expected `object`"),
        ("buildings: [", "not valid YAML"),
        ("buildings: [1]\nbuildings: [2]", "not valid YAML"),
        ("[" * 1500, "not valid YAML"),
        (
            f"buildings: [{', '.join(f'{{height: 3, footprint: {SQUARE}}}' for _ in range(51))}]",
            "length <= 50",
        ),
        (
            f"buildings: [{', '.join(f'{{height: {k + 1}, footprint: {SQUARE}}}' for k in range(9))}]",
            "more than 8 different heights",
        ),
        (f"buildings: [{{height: 3, footprint: [{', '.join(['[0, 0]'] * 101)}]}}]", "length <= 100"),
        ("buildings: [{height: 3, footprint: [[0, 0], [101, 0], [4, 4]]}]", "extend over 101 m; wanted 100"),
        (f"# {'x' * MOST_BYTES}", "more than 100,000 bytes"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(text: str, said: str, tmp_path: Path) -> None:
    file = written(tmp_path, text)
    with pytest.raises(ValueError, match=r".") as refused:
        read(file)
    line = str(refused.value)
    assert line.startswith(f"{file}: ")
    assert said in line
    assert "\n" not in line
    assert len(line) < 600 + len(file)


@pytest.mark.timeout(400)
@pytest.mark.parametrize(("first", "form"), [("[1]", "[{}]"), ("{{x: 1}}", "{{<<: [{}]}}")])
def test_aliases_that_expand_to_millions_of_values_are_refused_at_once(
    first: str, form: str, tmp_path: Path
) -> None:
    lists = "\n".join(f"  - &a{k + 1} {form.format(', '.join([f'*a{k}'] * 40))}" for k in range(9))
    with pytest.raises(ValueError, match="more than 20,000 values, with aliases expanded, are not allowed"):
        read(written(tmp_path, f"buildings:\n  - &a0 {first.format()}\n{lists}\n"))


@pytest.mark.timeout(400)
def test_a_folder_or_a_pipe_that_nobody_writes_to_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    for path in (tmp_path, tmp_path / "pipe.yaml"):
        with pytest.raises(ValueError, match="cannot be read: a folder, a pipe or a device; wanted"):
            read(str(path))


def test_a_file_that_is_not_there_or_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'factory'; wanted a path or one of courtyard"):
        read("factory")
    with pytest.raises(ValueError, match="cannot be read"):
        read(str(tmp_path / "factory.yaml"))
    with pytest.raises(ValueError, match="cannot be read"):
        read(str(tmp_path))
    with pytest.raises(ValueError, match="cannot be read"):
        read("a\0b.yaml")
    path = tmp_path / "site.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="not valid YAML"):
        read(str(path))
