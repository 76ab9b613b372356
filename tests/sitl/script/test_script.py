"""Protects mission scripts: what they mean, and that an error names file, line, field and what is allowed."""

import json
import math
import re
from pathlib import Path

import jsonschema
import pytest
from ruamel.yaml import YAML

from aircraft.search.events import Hold, Land, Resume, Return
from docs.generate.schema import schema
from link.cli import BadInput
from plume.scenario import draw
from plume.sensors.sensor import Hits
from sitl.script.script import Script, load

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
  - {time_s: 10, do: hold}
  - {after_s: 10.5, do: resume}
  - step: 3
    do: lawnmower
    high: [10, 10]
expect: [located, returned home]
"""

MISTAKES = {
    ("seed: 7", "seed: seven"): "2: seed: 'seven' is not allowed; wanted a whole number from 0",
    ("seed: 7", "seed: -1"): "2: seed: -1 is not allowed; wanted a whole number from 0",
    (
        "seed: 7",
        "sead: 7",
    ): "2: sead: unknown field; did you mean 'seed'? Allowed: about, seed, speedup, problem, scenario, vehicle, ",
    ("seed: 7", "seed: 7\nseed: 8"): '3: found duplicate key "seed"',
    ("seed: 7", "seed: [7"): "3: not valid YAML: ",
    ("seed: 7", "speedup: 2000"): "2: speedup: 2000 is not allowed; wanted a number from 0 up to 1000",
    (
        "phi: 1.5",
        "phi: 15",
    ): "3: scenario.phi: 15 is not allowed; wanted direction the wind comes from, counter-clockwise from "
    "east, ",
    (
        "phi: 1.5",
        "q: 1e308",
    ): "3: scenario.q: 1e+308 is not allowed; wanted release rate, a number from 0.001 up to 1000000, g/s",
    (
        "phi: 1.5",
        "d: 1e-9",
    ): "3: scenario.d: 1e-09 is not allowed; wanted effective diffusivity, a number from 0.001 up to 10000, "
    "m²/s",
    (
        "particles: 500",
        "rate: 1e7",
    ): "6: estimator.rate: 10000000.0 is not allowed; wanted release rate assumed by the estimator, by ",
    (
        "threshold:0.5,0.3",
        "gaussian:1e300",
    ): "4: sensor: 'gaussian:1e300' is not allowed; sensor_noise is 1e+300, wanted a number from 0 ",
    (
        "phi: 1.5",
        "fi: 1.5",
    ): "3: scenario.fi: unknown field; allowed: source, q, u, phi, d, tau, start, height",
    (
        "[12, 13]",
        "[12, 61]",
    ): "3: scenario.source: [12.0, 61.0] is not allowed; wanted (x, y) m, up to an area's side beyond",
    (
        "[12, 13]",
        "12",
    ): "3: scenario.source: 12 is not allowed; wanted (x, y) m, x east, y north; up to",
    (
        "{phi: 1.5, source: [12, 13]}",
        "windy",
    ): "3: scenario: 'windy' is not allowed; wanted fields: source, q, u, phi",
    (
        "threshold:0.5",
        "treshold:0.5",
    ): "4: sensor: 'treshold:0.5,0.3' is not allowed; wanted gaussian, threshold, hits",
    (
        "seed: 7",
        "world: wind-3",
    ): "2: world: no world 'wind-3'; did you mean 'wind-30'? Wanted as-modelled, puffs, walls, recorded, wind-10, wind-30, ",
    ("seed: 7", "world: 30"): "2: world: 30 is not allowed; wanted a world in the format of --world, ",
    (
        "particles: 500",
        "particles: 5",
    ): "6: estimator.particles: 5 is not allowed; wanted a whole number from 10 up to 1000000",
    (
        "particles: 500",
        "assume: feild",
    ): "6: estimator.assume: 'feild' is not allowed; did you mean 'field'? Wanted one of field, paper",
    (
        "particles: 500",
        "threshold_m: 0.5\n  stop: spread:1",
    ): "5: estimator: wanted at most one of threshold_m and stop",
    ("particles: 500", "threshold_m: 0"): "6: estimator.threshold_m: 0 is not allowed; wanted ",
    ("particles: 500", "particles: 5.5"): "6: estimator.particles: 5.5 is not allowed; wanted a whole number",
    (
        "{q: 'gamma:2,150'}",
        "{q: 3}",
    ): "7: estimator.prior: {'q': 3} is not allowed; wanted priors by name, in the ",
    ("do: wind, phi: 2", "do: wind"): "9: events[0]: no change is given; wanted u, phi or both",
    (
        "do: wind, phi: 2",
        "do: winds",
    ): "9: events[0].do: 'winds' is not allowed; did you mean 'wind'? Wanted one of wind, dropout, stuck, ",
    ("do: wind, ", ""): "9: events[0]: do is missing; wanted one of wind, dropout",
    (
        "do: wind, phi: 2",
        "do: stuck",
    ): "9: events[0]: readings is missing; wanted a whole number from 1 up to 1000000",
    ("do: hold", "step: 2, do: hold"): "10: events[1]: wanted exactly one of step and time_s",
    ("time_s: 10, ", ""): "10: events[1]: wanted exactly one of step and time_s",
    ("after_s: 10.5", "step: 3"): "11: events[2]: wanted exactly one of time_s and after_s",
    (
        "high: [10, 10]",
        "high: [0, 10]",
    ): "14: events[3].high: [0.0, 10.0] is not allowed; wanted a corner north-east of low, [0.0, 0.0]",
    (
        "step: 3",
        "time_s: 3",
    ): "12: events[3].time_s: not allowed for waypoints, which answer readings; wanted step",
    (
        "located, r",
        "seen, r",
    ): "15: expect[0]: 'seen' is not allowed; wanted one of ceased, false stop, landed, located, not "
    "ceased, ",
    (
        "expect: [located, returned home]",
        "expect: lost",
    ): "15: expect: 'lost' is not allowed; did you mean 'located'? Wanted one of ceased",
    ("seed: 7", "seed: 5.0"): "2: seed: 5.0 is not allowed; wanted a whole number from 0",
    ("seed: 7", "seed: yes"): "2: seed: 'yes' is not allowed; wanted a whole number from 0",
    ("seed: 7", "seed: true"): "2: seed: True is not allowed; wanted a whole number from 0",
    ("seed: 7", "seed: 0x" + "f" * 5000): "2: a number of 5,002 digits is not allowed; wanted 1,000 at most",
    ("seed: 7", "7: seed"): "2: 7 is not allowed as a field name; wanted text",
    ("seed: 7", "? [seed]\n: 7"): "2: a list or an object is not allowed as a field name; wanted text",
    ("seed: 7", '"se\\ned": 7'): "2: 'se\\ned': unknown field",
    ("seed: 7", "agent: {headings: 8.0}"): "2: agent.headings: 8.0 is not allowed; wanted one of 4, 8",
    ("seed: 7", "seed: !!bool perhaps"): ": not valid YAML: a value does not match its tag",
    ("seed: 7", "seed: 2020-99-99"): ": not valid YAML: month must be in 1..12",
    (
        "[12, 13]",
        "[12]",
    ): "3: scenario.source: [12] is not allowed; wanted (x, y) m, x east, y north; up to",
    (
        "[12, 13]",
        "[12, 13, 14]",
    ): "3: scenario.source: [12, 13, 14] is not allowed; wanted (x, y) m, x east, y north; up to",
    (
        "do: wind, phi: 2",
        "do: [wind]",
    ): "9: events[0].do: ['wind'] is not allowed; wanted one of wind, dropout",
    (
        "do: wind, phi: 2",
        "do: stuck, reading: 2",
    ): "9: events[0].reading: unknown field; did you mean 'readings'? Allowed: do, readings, step, time_s, vehicle",
    (
        "{step: 30, do: wind, phi: 2}",
        "hold",
    ): "9: events[0]: 'hold' is not allowed; wanted fields with do: one of wind, dropout",
    (
        "after_s: 10.5",
        "after_s: -1",
    ): "11: events[2].after_s: -1 is not allowed; wanted a number from 0 up to 1e+12: simulation time, s",
    (
        "{step: 30, do: wind, phi: 2}",
        "{step: 30, do: leave-out, vehicle: 0}",
    ): "9: events[0].vehicle: 0 is not allowed; wanted a whole number from 1: the vehicle, of several, that",
    (
        "{step: 30, do: wind, phi: 2}",
        "{time_s: 1e300, do: return}",
    ): "9: events[0].time_s: 1e+300 is not allowed; wanted a number from 0 up to 1e+12: simulation time, s",
    (
        "do: lawnmower\n    high: [10, 10]",
        "do: waypoints\n    points: []",
    ): "14: events[3].points: [] is not allowed; wanted a list of one place",
    (
        "do: lawnmower\n    high: [10, 10]",
        "do: waypoints\n    points:\n    - [1, 2]\n    - [3, 31]",
    ): "16: events[3].points[1]: [3.0, 31.0] is not allowed; wanted places in the area, [0, 30] x [0, 30] m",
    (
        "about: all in one",
        "agent: {policy: none}",
    ): "1: agent.policy: 'none' is not allowed; wanted a policy, or scripted waypoints",
}


@pytest.mark.parametrize(
    ("change", "told"), MISTAKES.items(), ids=[f"{old} -> {new}" for old, new in MISTAKES]
)
def test_a_mistake_is_one_line_with_file_line_field_and_what_is_allowed(
    tmp_path: Path, change: tuple[str, str], told: str
) -> None:
    path = tmp_path / "mission.yaml"
    assert change[0] in GOOD
    path.write_text(GOOD.replace(*change))
    with pytest.raises(BadInput) as error:
        load(path)
    assert str(error.value).startswith(f"{path}:{told}".replace("::", ":"))
    assert "\n" not in str(error.value)


NOT_FINITE = {
    "speedup: .nan": "speedup: nan",
    "speedup: .inf": "speedup: inf",
    "vehicle: {speed_mps: .inf}": "vehicle.speed_mps: inf",
    "vehicle: {endurance_s: .nan}": "vehicle.endurance_s: nan",
    "vehicle: {endurance_s: -.inf}": "vehicle.endurance_s: -inf",
    "scenario: {q: .inf}": "scenario.q: inf",
    "scenario: {q: 1e400}": "scenario.q: inf",
    "scenario: {height: .nan}": "scenario.height: nan",
    "scenario: {source: [3, .nan]}": "scenario.source[1]: nan",
    "events: [{do: spike, step: 1, gas: .nan}]": "events[0].gas: nan",
    "events: [{do: hold, time_s: .inf}]": "events[0].time_s: inf",
}


@pytest.mark.parametrize(("text", "told"), NOT_FINITE.items(), ids=list(NOT_FINITE))
def test_a_number_that_is_none_or_has_no_end_is_refused(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(f"about: finite\n{text}\n")
    with pytest.raises(BadInput, match=re.escape(f"{path}:2: {told} is not allowed; wanted ") + ".*number.*"):
        load(path)


def test_a_battery_and_a_patience_without_end_are_allowed(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("vehicle: {endurance_s: .inf, silence_s: .inf}\n")
    config = load(path).vehicle_config(sysid=1)
    assert (config.endurance_s, config.silence_s) == (math.inf, math.inf)


@pytest.mark.parametrize(("speedup", "stream_s"), [(0, 1.0), (1, 1.0), (3, 3.0)])
def test_a_strict_vehicle_loses_a_stream_after_a_second_of_real_time(
    tmp_path: Path, speedup: float, stream_s: float
) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(f"speedup: {speedup}\nvehicle: {{strict: true}}\n")
    config = load(path).vehicle_config(sysid=1)
    assert (config.stream_s, config.silence_s) == (stream_s, 30.0 * stream_s)
    path.write_text("about: kind\n")
    assert load(path).vehicle_config(sysid=1).stream_s == math.inf


def test_of_several_mistakes_the_first_is_told_but_a_wrong_name_before_the_one_that_it_stands_for(
    tmp_path: Path,
) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("events:\n- step: 1\n  do: stuck\n  reading: 3\nexpect: [lost]\nseed: x\n")
    with pytest.raises(
        BadInput,
        match=r"mission.yaml:4: events\[0\].reading: unknown field; did you mean 'readings'\? Allowed: do, readings, step, time_s, vehicle$",
    ):
        load(path)


@pytest.mark.parametrize(
    "content",
    [b"\xff\xfe\x00", b"a: &x [*x]", b"- 1\n- 2", b"{", b"\x00", b"3", b"a: !!python/object:os.system {}"],
)
def test_what_is_no_mission_at_all_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mission.yaml"
    path.write_bytes(content)
    with pytest.raises(BadInput) as error:
        load(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_a_missing_file_and_a_folder_are_one_line(tmp_path: Path) -> None:
    for path in (tmp_path / "none.yaml", tmp_path, tmp_path / ("long" * 100)):
        with pytest.raises(BadInput, match=f"^{path}: .*$"):
            load(path)


@pytest.mark.parametrize("path", MISSIONS, ids=lambda path: path.stem)
def test_a_shipped_mission_is_found_by_its_name_from_anywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / path.stem).mkdir()  # a folder is not a mission, even with a mission's name
    assert load(path.stem) == load(path.name) == load(path)


def test_a_file_that_is_there_wins_over_a_shipped_mission_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("wind-shift.yaml").write_text("about: mine")
    assert load("wind-shift.yaml").about == "mine"
    assert load("wind-shift") == load(ROOT / "missions" / "wind-shift.yaml")
    Path("wind-shift").write_text("about: mine without a suffix")
    assert load("wind-shift").about == "mine without a suffix"


@pytest.mark.parametrize(
    ("name", "near"),
    [("wnd-shift", "wind-shift"), ("missions/wind-shift.yaml", "wind-shift"), ("qqq", ""), ("./qqq.yml", "")],
)
def test_a_name_that_is_none_is_told_with_those_that_ship_and_the_nearest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, near: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadInput) as error:
        load(name)
    then = f"did you mean {near!r}? Wanted" if near else "wanted"
    shipped = ", ".join(path.stem for path in MISSIONS)
    told = f"{name}: no such file and no shipped mission; {then} a mission script, or one of {shipped}"
    assert str(error.value) == told


def test_what_the_scenario_leaves_out_is_drawn_by_the_seed(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(GOOD)
    release, drawn = load(path).release(), draw(7)
    assert (release.source, release.phi) == ((12.0, 13.0), 1.5)
    assert (release.q, release.u, release.d, release.tau, release.start) == (
        drawn.q,
        drawn.u,
        drawn.d,
        drawn.tau,
        drawn.start,
    )


def test_a_world_that_is_named_is_simulated_and_the_release_stays_what_is_told(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("world: tau-doubled\nscenario: {tau: 4, phi: 1}\nsensor: hits:5,0.2\n")
    script = load(path)
    world = script.simulated()
    assert (world.name, world.sensor, world.seed) == ("tau-doubled", Hits(5.0, 0.2), 1)
    assert (script.release().tau, world.truth.tau, world.truth.phi) == (4, 8, 1)
    assert load_text(tmp_path, "seed: 3\n").simulated().truth == draw(3)


def load_text(folder: Path, text: str) -> Script:
    (folder / "text.yaml").write_text(text)
    return load(folder / "text.yaml")


def test_words_of_yaml_1_1_stay_words(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("about: no\nscenario: {q: 1e2}\n")
    assert load(path).about == "no"
    assert load(path).release().q == 100.0


def test_a_lawnmower_mows_rows_to_and_fro_and_ends_on_the_edges(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(
        "events:\n- {step: 2, do: lawnmower, low: [1, 2], high: [4, 5], spacing_m: 2, step_m: 1.5}\n"
    )
    points = [(1, 2), (2.5, 2), (4, 2), (4, 4), (2.5, 4), (1, 4), (1, 5), (2.5, 5), (4, 5)]
    assert load(path).scripted() == dict(enumerate(points, start=2))


def test_what_the_operator_does_has_the_words_of_the_page(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mission.yaml"
    events = (
        "{step: 1, do: hold}",
        "{after_s: 2, do: resume}",
        "{step: 3, do: return}",
        "{time_s: 4, do: land}",
    )
    path.write_text("events:\n" + "".join(f"- {event}\n" for event in events))
    assert load(path).events == [Hold(step=1), Resume(after_s=2), Return(step=3), Land(time_s=4)]
    assert capfd.readouterr().err == ""


def test_the_words_of_older_scripts_mean_what_they_meant_and_are_warned_of_once(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "old.yaml"
    path.write_text(
        "events:\n- {step: 1, do: pause}\n- {after_s: 2, do: resume}\n- {step: 5, do: pause}\n- {time_s: 90, "
        "do: abort}\n"
    )
    for _ in range(2):
        assert load(path).events == [Hold(step=1), Resume(after_s=2), Hold(step=5), Return(time_s=90)]
    assert (
        capfd.readouterr().err
        == f"warning: {path}: 'pause' is an old word, read as 'hold', 'abort' is an old word, read as "
        "'return'\n"
    )


UNENDED = "no resume follows this hold: it lasts until an operator ends it"
UNBEGUN = "there is no hold from which this resume counts: it does not happen"


@pytest.mark.parametrize(
    ("events", "told"),
    [
        ("{step: 1, do: hold}", {0: UNENDED}),
        ("{after_s: 2, do: resume}", {0: UNBEGUN}),
        ("{step: 1, do: hold}, {after_s: 2, do: resume}", {}),
        ("{step: 1, do: hold}, {step: 4, do: hold}, {after_s: 2, do: resume}", {1: UNENDED}),
        ("{step: 1, do: hold}, {step: 4, do: hold}, {time_s: 90, do: land}", {}),
        ("{step: 1, do: hold}, {after_s: 2, do: resume}, {after_s: 2, do: resume}", {2: UNBEGUN}),
        ("{step: 1, do: hold, vehicle: 2}, {after_s: 2, do: resume}", {}),
        ("{step: 1, do: hold}, {after_s: 2, do: resume, vehicle: 2}", {0: UNENDED}),
        (
            "{step: 1, do: hold, vehicle: 1}, {after_s: 2, do: resume, vehicle: 2}",
            {0: UNENDED, 1: UNBEGUN},
        ),
    ],
)
def test_a_hold_without_a_resume_and_a_resume_without_a_hold_are_warned_of(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], events: str, told: dict[int, str]
) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(f"fleet: {{vehicles: 2}}\nevents: [{events}]\n")
    load(path)
    assert capfd.readouterr().err.splitlines() == [
        f"warning: {path}: events[{number}]: {what}" for number, what in told.items()
    ]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            "events: [{do: abort, sep: 1}]",
            "events[0].sep: unknown field; did you mean 'step'? Allowed: do, step, time_s",
        ),
        ("events: [{do: [abort]}]", "events[0].do: ['abort'] is not allowed; wanted one of wind, "),
        ("events: [abort]", "events[0]: 'abort' is not allowed; wanted fields with do: "),
        ("events: abort", "events: 'abort' is not allowed"),
        ("[abort]", "['abort'] is not allowed"),
    ],
)
def test_a_mistake_beside_an_old_word_is_named(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(f"{text}\n")
    with pytest.raises(BadInput, match=re.escape(f"{path}:1: {told}")):
        load(path)


def test_without_a_policy_the_search_ends_with_the_waypoints(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(
        "agent: {policy: none}\nevents:\n- {step: 0, do: waypoints, points: [[1, 2], [2, 2], [3, 2]]}\n"
    )
    assert load(path).budget == 3


def test_more_waypoints_than_a_command_line_holds_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("events:\n- {step: 0, do: lawnmower, spacing_m: 0.1, step_m: 0.1}\n")
    with pytest.raises(
        BadInput,
        match=r"mission.yaml:1: events: 90,601 scripted waypoints are not allowed; wanted 1,000 at most",
    ):
        load(path)


def test_two_waypoints_for_one_step_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    event = "- {step: %d, do: waypoints, points: [[1, 2], [2, 2]]}\n"
    path.write_text("events:\n" + event % 0 + event % 1)
    with pytest.raises(
        BadInput, match=r"mission.yaml:3: events\[1\]: events\[0\] already has a waypoint for step 1"
    ):
        load(path)


def test_the_published_schema_is_up_to_date_and_a_schema() -> None:
    published = json.loads((ROOT / "missions" / "mission.schema.json").read_text())
    assert published == json.loads(json.dumps(schema()))
    jsonschema.Draft202012Validator.check_schema(published)


def test_the_schema_and_the_reader_agree(tmp_path: Path) -> None:
    """The schema accepts all shipped missions and finds each mistake that lies in one field, as an editor
    uses it.
    """
    validator = jsonschema.Draft202012Validator(schema())
    for path in MISSIONS:
        validator.validate(YAML(typ="safe", pure=True).load(path.read_text()))
        load(path)
    assert validator.is_valid(YAML(typ="safe", pure=True).load(GOOD))
    for change, told in MISTAKES.items():
        beyond = (
            "corner",
            "sensor:",
            "agent.policy",
            "field name",
            "digits",
            "5.0",
            "8.0",
            "beyond",  # depends on the problem's area
            "in the area",
        )  # in JSON, 5.0 is a whole number
        if " is not allowed" in told and not any(word in told for word in beyond):
            assert not validator.is_valid(YAML(typ="safe", pure=True).load(GOOD.replace(*change))), change
