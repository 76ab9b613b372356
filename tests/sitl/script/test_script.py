"""Protects mission scripts: what they mean, and that a mistake is told with its file, line, field and what is allowed."""

import json
from pathlib import Path

import jsonschema
import pytest
from ruamel.yaml import YAML

from plume.scenario import draw
from sitl.script.script import Script, load, schema
from sitl.script.typed_yaml import FileError

ROOT = Path(__file__).parents[3]
MISSIONS = sorted((ROOT / "missions").glob("*.yaml"))

GOOD = """\
about: all in one
seed: 7
scenario: {phi: 1.5, source: [12, 13]}
sensor: threshold:0.5,0.3
estimator:
  particles: 500
  prior: {q: 'gamma:2,150'}
events:
  - {step: 30, do: wind, phi: 2}
  - {time_s: 10, do: pause}
  - {after_s: 10.5, do: resume}
  - step: 3
    do: lawnmower
    high: [10, 10]
expect: [located, returned home]
"""

MISTAKES = {
    ("seed: 7", "seed: seven"): "2: seed: 'seven' is not allowed; wanted a whole number from 0",
    ("seed: 7", "seed: -1"): "2: seed: -1 is not allowed; wanted a whole number from 0",
    ("seed: 7", "sead: 7"): "2: sead: there is no such field; allowed: about, seed, speedup, scenario, vehicle, sensor, estimator, agent, ",
    ("seed: 7", "seed: 7\nseed: 8"): '3: found duplicate key "seed"',
    ("seed: 7", "seed: [7"): "3: this is no YAML: ",
    ("seed: 7", "speedup: 2000"): "2: speedup: 2000 is not allowed; wanted a number from 0 up to 1000",
    ("phi: 1.5", "phi: 15"): "3: scenario.phi: 15 is not allowed; wanted direction the wind comes from, counter-clockwise from east, ",
    ("phi: 1.5", "fi: 1.5"): "3: scenario.fi: there is no such field; allowed: source, q, u, phi, d, tau, start, height",
    ("[12, 13]", "[12, 31]"): "3: scenario.source[1]: 31 is not allowed; wanted a number from 0 up to 30",
    ("[12, 13]", "12"): "3: scenario.source: 12 is not allowed; wanted (x, y) m, x east, y north, each from 0 to 30",
    ("{phi: 1.5, source: [12, 13]}", "windy"): "3: scenario: 'windy' is not allowed; wanted fields: source, q, u, phi",
    ("threshold:0.5", "treshold:0.5"): "4: sensor: 'treshold:0.5,0.3' is not allowed; wanted gaussian, threshold, hits",
    ("particles: 500", "particles: 5"): "6: estimator.particles: 5 is not allowed; wanted a whole number from 10 up to 1000000",
    ("particles: 500", "particles: 5.5"): "6: estimator.particles: 5.5 is not allowed; wanted a whole number",
    ("{q: 'gamma:2,150'}", "{q: 3}"): "7: estimator.prior: {'q': 3} is not allowed",
    ("do: wind, phi: 2", "do: wind"): "9: events[0]: nothing changes; wanted u, phi or both",
    ("do: wind, phi: 2", "do: winds"): "9: events[0].do: 'winds' is not allowed; wanted one of wind, dropout, stuck, spike, ",
    ("do: wind, ", ""): "9: events[0]: do is missing; wanted one of wind, dropout",
    ("do: wind, phi: 2", "do: stuck"): "9: events[0]: readings is missing; wanted a whole number from 1 up to 1000000",
    ("do: pause", "step: 2, do: pause"): "10: events[1]: when? wanted one of step and time_s",
    ("time_s: 10, ", ""): "10: events[1]: when? wanted one of step and time_s",
    ("after_s: 10.5", "step: 3"): "11: events[2]: when? wanted one of time_s and after_s",
    ("high: [10, 10]", "high: [0, 10]"): "14: events[3].high: [0.0, 10.0] is not allowed; wanted a corner north-east of low, [0.0, 0.0]",
    ("step: 3", "time_s: 3"): "12: events[3].time_s: waypoints answer readings; wanted step",
    ("located, r", "found, r"): "15: expect[0]: 'found' is not allowed; wanted one of ceased, false stop, landed, located, not ceased, ",
    ("expect: [located, returned home]", "expect: lost"): "15: expect: 'lost' is not allowed; wanted one of ceased",
    ("about: all in one", "agent: {policy: none}"): "1: agent.policy: 'none' is not allowed; wanted a policy, or scripted waypoints",
}


@pytest.mark.parametrize(("change", "told"), MISTAKES.items(), ids=[f"{old} -> {new}" for old, new in MISTAKES])
def test_a_mistake_is_one_line_with_file_line_field_and_what_is_allowed(tmp_path: Path, change: tuple[str, str], told: str) -> None:
    path = tmp_path / "mission.yaml"
    assert change[0] in GOOD
    path.write_text(GOOD.replace(*change))
    with pytest.raises(FileError) as error:
        load(path)
    assert str(error.value).startswith(f"{path}:{told}")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"a: &x [*x]", b"- 1\n- 2", b"{", b"\x00", b"3", b"a: !!python/object:os.system {}"])
def test_what_is_no_mission_at_all_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mission.yaml"
    path.write_bytes(content)
    with pytest.raises(FileError) as error:
        load(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_a_missing_file_and_a_folder_are_one_line(tmp_path: Path) -> None:
    for path in (tmp_path / "none.yaml", tmp_path, tmp_path / ("long" * 100)):
        with pytest.raises(FileError, match=f"^{path}: .*$"):
            load(path)


@pytest.mark.parametrize("path", MISSIONS, ids=lambda path: path.stem)
def test_a_shipped_mission_is_found_by_its_name_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / path.stem).mkdir()  # a folder is no mission, whatever it is called
    assert load(path.stem) == load(path.name) == load(path)


def test_a_file_that_is_there_wins_over_a_shipped_mission_of_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("wind-shift.yaml").write_text("about: mine")
    assert load("wind-shift.yaml").about == "mine"
    assert load("wind-shift") == load(ROOT / "missions" / "wind-shift.yaml")
    Path("wind-shift").write_text("about: mine without a suffix")
    assert load("wind-shift").about == "mine without a suffix"


@pytest.mark.parametrize("name", ["wnd-shift", "missions/wind-shift.yaml", "./wind-shift", "wind-shift.yml"])
def test_a_name_that_is_none_is_told_with_those_that_ship(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileError) as error:
        load(name)
    shipped = ", ".join(path.stem for path in MISSIONS)
    assert str(error.value) == f"{name}: no such file and no shipped mission; wanted a mission script, or one of {shipped}"


def test_an_empty_script_is_the_usual_mission(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("# nothing\n")
    assert load(path) == Script()


def test_what_the_scenario_leaves_out_is_drawn_by_the_seed(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(GOOD)
    release, drawn = load(path).release(), draw(7)
    assert (release.source, release.phi) == ((12.0, 13.0), 1.5)
    assert (release.q, release.u, release.d, release.tau, release.start) == (drawn.q, drawn.u, drawn.d, drawn.tau, drawn.start)


def test_words_of_yaml_1_1_stay_words(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("about: no\nscenario: {q: 1e2}\n")
    assert load(path).about == "no"
    assert load(path).release().q == 100.0


def test_a_lawnmower_mows_rows_to_and_fro_and_ends_on_the_edges(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("events:\n- {step: 2, do: lawnmower, low: [1, 2], high: [4, 5], spacing_m: 2, step_m: 1.5}\n")
    points = [(1, 2), (2.5, 2), (4, 2), (4, 4), (2.5, 4), (1, 4), (1, 5), (2.5, 5), (4, 5)]
    assert load(path).scripted() == dict(enumerate(points, start=2))


def test_without_a_policy_the_search_ends_with_the_waypoints(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("agent: {policy: none}\nevents:\n- {step: 0, do: waypoints, points: [[1, 2], [2, 2], [3, 2]]}\n")
    assert load(path).budget == 3


def test_more_waypoints_than_a_command_line_holds_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("events:\n- {step: 0, do: lawnmower, spacing_m: 0.1, step_m: 0.1}\n")
    with pytest.raises(FileError, match=r"mission.yaml:1: events: 90,601 scripted waypoints are not allowed; wanted 1,000 at most"):
        load(path)


def test_two_waypoints_for_one_step_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    event = "- {step: %d, do: waypoints, points: [[1, 2], [2, 2]]}\n"
    path.write_text("events:\n" + event % 0 + event % 1)
    with pytest.raises(FileError, match=r"mission.yaml:3: events\[1\]: step 1 has its waypoint from events\[0\]"):
        load(path)


def test_the_published_schema_is_up_to_date_and_a_schema() -> None:
    published = json.loads((ROOT / "missions" / "mission.schema.json").read_text())
    assert published == json.loads(json.dumps(schema()))
    jsonschema.Draft202012Validator.check_schema(published)


def test_the_schema_and_the_reader_agree(tmp_path: Path) -> None:
    """As an editor sees it: the schema passes all our missions, and finds each mistake that lies in one field."""
    validator = jsonschema.Draft202012Validator(schema())
    for path in MISSIONS:
        validator.validate(YAML(typ="safe", pure=True).load(path.read_text()))
        load(path)
    assert validator.is_valid(YAML(typ="safe", pure=True).load(GOOD))
    for change, told in MISTAKES.items():
        if " is not allowed" in told and not any(word in told for word in ("corner", "sensor:", "agent.policy")):
            assert not validator.is_valid(YAML(typ="safe", pure=True).load(GOOD.replace(*change))), change
