"""Protects a script's problem: it says what the mission is, and the script's own fields and flags come first."""

import argparse
from pathlib import Path

import pytest

from link import cli
from link.cli import BadInput
from plume.problem import PAPER, Area, Problem
from plume.problems.names import named
from plume.scenario import draw
from sitl.launch.mission import Launch, agent_arguments, estimator_arguments
from sitl.script.options import add_mission_arguments, blamed, script_of
from sitl.script.script import Script, load

FIELD = """
problem:
  area: {low: [-20, 0], high: [80, 50]}
  step_m: 2
  prior: {low: [30, 0], high: [80, 50]}
  budget: 70
  sensor: "hits:3,0.1"
  altitude_m: 8
"""
PROBLEM = Problem(
    area=Area((-20, 0), (80, 50)),
    step_m=2,
    prior=Area((30, 0), (80, 50)),
    budget=70,
    sensor="hits:3,0.1",
    altitude_m=8,
)


def written(folder: Path, text: str) -> Path:
    path = folder / "field.yaml"
    path.write_text(text)
    return path


def parsed(*words: str) -> argparse.Namespace:
    parser = cli.Parser()
    add_mission_arguments(parser)
    cli.add_reach_arguments(parser)
    cli.add_filter_arguments(parser)
    return argparse.Namespace(speedup=1.0, **vars(parser.parse_given(list(words))))


def of(*words: str) -> Script:
    return script_of(parsed(*words))


def test_a_script_flies_its_problem(tmp_path: Path) -> None:
    script = load(written(tmp_path, f"seed: 3{FIELD}"))
    assert script.problem == PROBLEM
    assert script.release() == draw(3, PROBLEM)
    config = script.vehicle_config(1)
    assert (config.area, config.takeoff_altitude_m) == (PROBLEM.area, 8.0)
    assert config.flown == Area((-20, 0), (80, 50))
    assert (script.sensor, script.budget, script.agent.step_m) == ("hits:3,0.1", 70, 2.0)


def test_a_scripts_own_fields_come_before_its_problem(tmp_path: Path) -> None:
    path = written(
        tmp_path, f"agent: {{budget: 9}}\nsensor: gaussian\nestimator: {{threshold_m: 0.4}}{FIELD}"
    )
    problem = load(path).problem
    assert (problem.budget, problem.sensor, problem.stop) == (9, "gaussian", "spread:0.4")


def test_flags_come_before_both(tmp_path: Path) -> None:
    path = written(tmp_path, f"agent: {{budget: 9}}{FIELD}")
    problem = of(str(path), "--budget", "5", "--step", "3", "--stop", "within:1,0.9").problem
    assert (problem.budget, problem.step_m, problem.stop) == (5, 3.0, "within:1,0.9")
    assert problem.area == PROBLEM.area
    other = of(str(path), "--problem", "paper")
    assert other.problem == PAPER
    assert (other.sensor, other.agent.step_m, other.budget) == ("gaussian", None, 300)


def test_a_script_of_old_says_the_same_as_before() -> None:
    script = Script().changed({"sensor": "hits:3,0.1", "agent.step_m": 2.0})
    assert script.problem == Problem(sensor="hits:3,0.1", step_m=2.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("problem: {step_m: 20}", "1: problem.step_m: 20.0 is not allowed; wanted above 0 up to 10 m"),
        ("problem: {stepm: 2}", "1: problem.stepm: unknown field; did you mean 'step_m'"),
        ("agent: {step_m: 20}", "1: agent.step_m: 20.0 is not allowed; wanted above 0 up to 10 m"),
        (f"scenario: {{start: [90, 0]}}{FIELD}", r"1: scenario.start: \[90.0, 0.0\] is not allowed"),
        (f"events: [{{step: 0, do: waypoints, points: [[90, 1]]}}]{FIELD}", r"1: events\[0\].points\[0\]:"),
    ],
)
def test_what_a_problem_does_not_allow_is_refused_with_its_line(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=said) as refused:
        load(written(tmp_path, text))
    assert "\n" not in str(refused.value)


def test_a_flag_that_the_problem_does_not_allow_is_named() -> None:
    with pytest.raises(BadInput, match=r"--step: 20.0 is not allowed; wanted above 0 up to 10 m"):
        of("--step", "20")


@pytest.mark.parametrize(
    ("text", "words", "said"),
    [
        ("seed: 2\nproblem:\n  stop: spread:-1", ["SCRIPT"], "SCRIPT:3: problem.stop: no"),
        (
            "problem: {stop: spread:2}\nestimator: {stop: spread:-1}",
            ["SCRIPT"],
            "SCRIPT:2: estimator.stop: no",
        ),
        ("stop: spread:-1", ["--problem", "SCRIPT"], "--problem: stop: no"),
        ("stop: spread:-1", ["--problem", "SCRIPT", "--stop", "spread:-2"], "--stop: no"),
        ("problem: {stop: spread:-1}", ["SCRIPT", "--stop", "spread:-2"], "--stop: no"),
    ],
)
def test_a_stop_that_the_estimator_refuses_is_named_where_it_was_chosen(
    text: str, words: list[str], said: str, tmp_path: Path
) -> None:
    path = str(written(tmp_path, text))
    args = parsed(*[path if word == "SCRIPT" else word for word in words])
    assert str(blamed(args, "--stop", "no")) == said.replace("SCRIPT", path)


def test_the_services_are_told_area_and_prior_and_nothing_of_the_source(tmp_path: Path) -> None:
    text = FIELD + "  source: [44.25, 7.75]\n  world: wind-30\n"
    mission = Launch(script=load(written(tmp_path, text)))
    for words in (estimator_arguments(mission), agent_arguments(mission)):
        told = words[words.index("--problem") + 1]
        assert "[30.0,0.0]" in told
        assert "44.25" not in " ".join(words)
        assert "wind-30" not in " ".join(words)
    assert "--problem" not in estimator_arguments(Launch(script=Script()))


KEPT_OUT = """
problem:
  keep_out:
    - [[8, 8], [14, 8], [14, 14], [8, 14]]
  clearance_m: 1
"""


def test_a_script_tells_its_vehicle_and_both_services_what_is_kept_out_of(tmp_path: Path) -> None:
    script = load(written(tmp_path, KEPT_OUT))
    ground = script.problem.ground
    assert ground.obstacles
    assert script.vehicle_config(1).area == ground
    launch = Launch(script=script, uav_arguments=(), record=tmp_path / "record.mcap")
    for arguments in (agent_arguments(launch), estimator_arguments(launch)):
        assert named(arguments[arguments.index("--problem") + 1]).ground == ground


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("scenario: {start: [7.5, 7.5]}", "scenario.start: .7.5, 7.5. is not allowed; wanted .* clear of"),
        ("scenario: {start: [20, 20]}", "scenario.start: .20.0, 20.0. is not allowed; wanted .* clear of"),
        (
            "events: [{do: waypoints, step: 0, points: [[4, 11], [20, 11]]}]",
            r"events\[0\].points\[1\]: the way to \[20.0, 11.0\] is not allowed; wanted ways that cross no keep_out",
        ),
    ],
)
def test_a_script_may_not_send_its_vehicle_through_what_is_kept_out_of(
    more: str, said: str, tmp_path: Path
) -> None:
    with pytest.raises(BadInput, match=said):
        load(written(tmp_path, KEPT_OUT + more))


@pytest.mark.parametrize("part", ["problem", "scenario"])
def test_a_script_may_not_put_its_source_inside_a_building(part: str, tmp_path: Path) -> None:
    path = written(tmp_path, f"world: walls:file=courtyard\n{part}: {{source: [7.5, 10]}}")
    with pytest.raises(BadInput, match=r"field.yaml:1: world: the source \(7.5, 10\) is inside a building"):
        of(str(path))
