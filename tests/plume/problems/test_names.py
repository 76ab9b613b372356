"""Protects how problems are named: a name, a file, JSON; and that a bad one is refused in a line."""

from itertools import pairwise
from pathlib import Path

import pytest

from plume.problem import PAPER, Area, Problem
from plume.problems.names import named, with_arguments

FIELD = Problem(area=Area((-20, 0), (80, 50)), step_m=2, prior=Area((30, 0), (80, 50)), q=250, u=(1, 2))


def test_a_problem_is_read_back_from_its_text() -> None:
    assert named(FIELD.text) == FIELD
    assert named("paper") is PAPER
    assert named(FIELD.text).text == FIELD.text  # whole numbers or not


def test_a_problem_comes_from_a_file_or_a_script(tmp_path: Path) -> None:
    path = tmp_path / "field.yaml"
    path.write_text("area: {low: [-20, 0], high: [80, 50]}\nstep_m: 2\n")
    assert named(str(path)) == Problem(area=Area((-20, 0), (80, 50)), step_m=2)
    path.write_text("seed: 3\nproblem: {step_m: 2}\n")
    assert named(str(path)) == Problem(step_m=2)
    path.write_text("area: &all {low: [0, 0], high: [30, 30]}\nprior: *all\n")
    assert named(str(path)) == Problem(prior=Area((0, 0), (30, 30)))


def laughing(form: str) -> str:
    """Ten lines, each of ten times the one before: ten billion values."""
    lines = ["a: &a {x: 1}"]
    for before, name in pairwise("abcdefghij"):
        lines.append(f"{name}: &{name} {form.format(', '.join([f'*{before}'] * 10))}")
    return "\n".join([*lines, "z: &z [*j]", ""])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("stepm: 3", "unknown field 'stepm'; did you mean 'step_m'"),
        ("step_m: fast", "step_m: 'fast' is not allowed; wanted length of a move"),
        ("step_m: 20", "step_m: 20.0 is not allowed; wanted above 0 up to 10 m"),
        ("area: 30", "area: 30 is not allowed; wanted where the search flies, fields: low, high"),
        ("area: {low: [0, 0]}", "area: high is missing; wanted its north-east corner"),
        ("area: {low: [0, 0], hihg: [9, 9]}", "area.hihg: unknown field; did you mean 'high'"),
        ("area: {low: [0, 0], high: [30, x]}", r"area.high\[1\]: 'x' is not allowed; wanted a number from"),
        ("keep_out: [[[1, 1], [2, 2], [3, a]]]", r"keep_out\[0\]\[2\]\[1\]: 'a' is not allowed"),
        ("keep_in: [[1, 1], [2, 2], [3]]", r"keep_in\[2\]: \[3\] is not allowed; wanted \(x, y\) m"),
        ("area: {1: 2}", "area: {1: 2} is not allowed; wanted where the search flies"),
        ('area: {"x - at `$.y`": 2}', r"area.x - at `\$.y`: unknown field; allowed: low, high"),
        ("home: [north, 8]", r"home\[0\]: 'north' is not allowed; wanted a number, degrees"),
        ("prior: [{place: [3, 4], radius_m: 0}]", r"prior\[0\].radius_m: 0.0 is not allowed; wanted above 0"),
        ("prior: [{plce: [3, 4]}]", r"prior\[0\].plce: unknown field; did you mean 'place'"),
        ("prior: [{place: [3, 4], weight: heavy}]", r"prior\[0\].weight: 'heavy' is not allowed; wanted how"),
        (
            "area: {low: [0, 0], high: [0, 9]}",
            r"area.high: \[0, 9\] is not allowed; wanted a corner north-east",
        ),
        ("area: {low: [0, 0], high: [.nan, 9]}", r"area.high\[0\]: .*nan.* is not allowed; wanted"),
        ("sensor: nose", "sensor: .*nose"),
        ("world: nowhere", "world: .*nowhere"),
        ("{area: {low: [0, 0], high: [9, 9]}, world: source-outside}", "world: source-outside is not for"),
        ("- 3", "is not allowed; wanted fields"),
        ("a: [", "not valid YAML"),
        ("area: &a [*a]", "not valid YAML|is not allowed"),
        *(
            (text, "there is nothing in it; wanted fields: area, ")
            for text in ("", "# later", "null", "problem:")
        ),
        (laughing("[{}]"), "more than 20,000 values, with aliases expanded, are not allowed"),
        (laughing("[{}]") + "keep_out: *z\n", "more than 20,000 values"),
        (laughing("{{<<: [{}]}}"), "more than 20,000 values"),
    ],
)
def test_a_file_that_is_none_is_refused_in_a_line(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "field.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=said) as refused:
        named(str(path))
    assert str(refused.value).startswith(f"{path}:")
    assert "\n" not in str(refused.value)


def test_a_name_that_is_none_says_what_is_allowed(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'papr' is no problem and no file; did you mean 'paper'"):
        named("papr")
    for name in ("", "wide field", "a\0b", "x" * 5000):
        with pytest.raises(ValueError, match=r"^'.{,60} is no problem and no file; wanted paper, a YAML"):
            named(name)
    with pytest.raises(ValueError, match="unknown field 'type'; wanted fields"):  # not: did you mean 'stop'?
        named({"type": "FeatureCollection"})
    with pytest.raises(ValueError, match="not valid JSON"):
        named("{area")
    for text in ('{"step_m": 1, "step_m": 2}', '{"area": {"low": [0, 0], "high": [9, 9], "low": [1, 1]}}'):
        with pytest.raises(ValueError, match=r"not valid JSON: the name '(step_m|low)' is there twice"):
            named(text)
    with pytest.raises(ValueError, match="step_m: nan is not allowed"):
        named('{"step_m": NaN}')
    with pytest.raises(ValueError, match=r"Is a directory|a pipe or a device"):
        named(str(tmp_path))
    (tmp_path / "huge.yaml").write_bytes(b"#" * 200_000)
    with pytest.raises(ValueError, match="bytes are not allowed"):
        named(str(tmp_path / "huge.yaml"))


def test_a_file_may_be_given_as_a_path(tmp_path: Path) -> None:
    (tmp_path / "field.yaml").write_text("step_m: 2")
    assert named(tmp_path / "field.yaml") == with_arguments(tmp_path / "field.yaml") == Problem(step_m=2)


def test_an_argument_comes_before_the_problem() -> None:
    assert with_arguments(FIELD, budget=7, world=None) == FIELD.changed(budget=7)
