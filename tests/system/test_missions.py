"""Protects mission scripts end to end: every shipped mission meets its expectations, and events change only what they state."""

import json
import math
from collections import Counter
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from agent.trials.rollout import rollout
from link.bus.mavlink import Reading
from link.record.reader import read
from plume.randomness import keyed
from plume.scenario import draw
from plume.sensor import GAUSSIAN
from plume.world import World

MISSIONS = Path(__file__).parents[2] / "missions"
UNDISTURBED = ("bad-radio", "crashing-services", "link-cut", "operator-pause", "router-restart", "sensor-dropout")
"""Missions of seed 2 whose events cost time and nothing else."""


def flown(start, folder: Path, mission: Path | str, *flags: str) -> tuple[int, dict, list[str]]:
    part = start("sitl", "fly", str(mission), "--speedup", "0", "--json", "--trace", *flags, cwd=folder)
    status = part.ended(timeout_s=100)
    return status, json.loads(part.out[-1]) if part.out else {}, part.err


def written(folder: Path, text: str) -> Path:
    path = folder / "mission.yaml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def undisturbed() -> list[dict]:
    """The trace of seed 2 in-process."""
    return [
        {"position": list(point.position), "reading": point.reading, "mean": list(point.mean), "spread": point.spread}
        for point in rollout(2, "homing")[1]
    ]


@pytest.mark.parametrize("mission", sorted(path.stem for path in MISSIONS.glob("*.yaml")))
def test_every_mission_of_ours_meets_what_it_expects(start, tmp_path: Path, undisturbed: list[dict], mission: str) -> None:
    status, result, said = flown(start, tmp_path, MISSIONS / f"{mission}.yaml")
    assert status == 0, said
    assert result["expectations"]
    assert all(result["expectations"].values())
    assert not [line for line in said if "did not happen" in line]
    if mission in UNDISTURBED:
        assert result["trace"] == undisturbed


def test_an_expectation_that_does_not_hold_is_told_and_is_status_1(start, tmp_path: Path) -> None:
    script = "agent: {policy: random, budget: 3}\nexpect: [not ceased, located]\n"
    status, result, said = flown(start, tmp_path, written(tmp_path, script))
    assert status == 1
    assert result["expectations"] == {"not ceased": True, "located": False}
    assert said[-2:] == ["expected not ceased: yes\n", "expected located: NO\n"]


def test_flags_beside_a_script_win(start, tmp_path: Path) -> None:
    path = written(tmp_path, "seed: 5\nagent: {policy: random, budget: 7}\nestimator: {particles: 50}\n")
    _, result, _ = flown(start, tmp_path, path, "--seed", "6", "--budget", "4")
    assert (result["seed"], result["policy"], result["steps"]) == (6, "random", 4)
    in_process = rollout(6, "random", particles=50, budget=4)[1]
    assert [point["mean"] for point in result["trace"]] == [list(point.mean) for point in in_process]


def test_the_wind_turns_with_the_reading_that_it_says_and_the_plume_with_it(start, tmp_path: Path) -> None:
    path = written(tmp_path, "seed: 9\nagent: {policy: random, budget: 6}\nevents: [{step: 3, do: wind, u: 3.5, phi: 1.0}]\n")
    _, result, _ = flown(start, tmp_path, path)
    release = draw(9)
    for step, point in enumerate(result["trace"]):
        u, phi = (release.u, release.phi) if step < 3 else (3.5, 1.0)
        # The paper's equation with numbers: gas lies downwind.
        dx, dy = point["position"][0] - release.source[0], point["position"][1] - release.source[1]
        r = max(math.hypot(dx, dy), 0.1)
        decay = math.sqrt(release.d * release.tau / (1 + u * u * release.tau / (4 * release.d)))
        psi = -(dx * u * math.cos(phi) + dy * u * math.sin(phi)) / (2 * release.d)
        mean = release.q / (4 * math.pi * release.d * r) * math.exp(-r / decay + psi)
        assert point["reading"] == pytest.approx(float(GAUSSIAN.measure(mean, keyed(9, "sensor", step))), rel=1e-5)


def test_scripted_waypoints_are_flown_and_then_the_agent_goes_on(start, tmp_path: Path) -> None:
    points = [[4.25, 5.5], [6.75, 5.5], [6.1, 8.3]]
    path = written(
        tmp_path, f"seed: 9\nagent: {{policy: random, budget: 6}}\nevents: [{{step: 1, do: waypoints, points: {json.dumps(points)}}}]\n"
    )
    _, result, _ = flown(start, tmp_path, path)
    positions = [point["position"] for point in result["trace"]]
    assert positions[2:5] == [[float(np.float32(value)) for value in point] for point in points]
    for before, after in ((positions[0], positions[1]), (positions[4], positions[5])):
        assert math.dist(before, after) == pytest.approx(1.0, abs=1e-5)


def test_a_scenario_that_is_given_is_the_one_that_is_flown(start, tmp_path: Path) -> None:
    given = "{source: [20.5, 11.25], q: 200, u: 2, phi: 0.5, d: 3, tau: 12, start: [1.5, 2.5]}"
    _, result, _ = flown(start, tmp_path, written(tmp_path, f"scenario: {given}\nagent: {{budget: 2}}\n"))
    assert result["source"] == [20.5, 11.25]
    assert result["scenario"] == {"q": 200, "u": 2, "phi": 0.5, "d": 3, "tau": 12, "start": [1.5, 2.5]}
    assert result["trace"][0]["position"] == [1.5, 2.5]


def recorded_readings(folder: Path) -> list[Reading]:
    """The readings of the only record, repeats included."""
    (path,) = (folder / "runs").glob("*.mcap")
    return [unpack(entry.payload) for entry in read(path).entries if entry.key == "reading"]


def unpack(payload: bytes) -> Reading:
    """The contents of a reading, also of one without a value."""
    position, wind, gas = mavlink.MAVLink(None).parse_buffer(payload)
    return Reading(position.time_boot_ms, (position.y, position.x), -position.z, (-wind.wind_y, -wind.wind_x), gas.value)


def test_a_pause_takes_as_long_as_it_says(start, tmp_path: Path) -> None:
    events = "[{step: 2, do: pause}, {after_s: 45, do: resume}]"
    flown(start, tmp_path, written(tmp_path, f"agent: {{policy: random, budget: 5}}\nevents: {events}\n"))
    times = sorted({reading.time_boot_ms for reading in recorded_readings(tmp_path)})
    legs = [after - before for before, after in pairwise(times)]
    leg_ms = 1000 * 2 * math.sqrt(1 / 3)  # time of 1 m from rest to rest at 3 m/s²
    assert legs == pytest.approx([leg_ms, leg_ms, leg_ms + 45_000, leg_ms, leg_ms], abs=2)


def test_a_silent_sensor_says_nan_each_second_and_the_reading_comes_after_it(start, tmp_path: Path) -> None:
    flown(start, tmp_path, written(tmp_path, "agent: {policy: random, budget: 2}\nevents: [{step: 1, do: dropout, for_s: 2.5}]\n"))
    readings = sorted({reading.time_boot_ms: reading for reading in recorded_readings(tmp_path)}.items())
    assert [math.isnan(reading.gas) for _, reading in readings] == [False, True, True, True, False, False]
    assert [after - before for before, after in pairwise(time for time, _ in readings[1:5])] == [1000, 1000, 1000]
    assert len({reading.position for _, reading in readings[1:5]}) == 1


def test_a_lost_reading_has_no_value_and_is_taken_again_a_second_later(start, tmp_path: Path) -> None:
    path = written(tmp_path, "seed: 9\nworld: readings-lost\nagent: {policy: random, budget: 12}\n")
    _, result, _ = flown(start, tmp_path, path)
    assert result["world"] == "readings-lost"
    readings = [reading for _, reading in sorted({reading.time_boot_ms: reading for reading in recorded_readings(tmp_path)}.items())]
    lost = [step for step in range(1, 13) if keyed(9, "lost reading", step).random() < 0.2]
    assert lost
    expected = [missing for step in range(13) for missing in ([True, False] if step in lost else [False])]
    assert [math.isnan(reading.gas) for reading in readings] == expected
    for before, after in pairwise(readings):
        if math.isnan(before.gas):
            assert (after.time_boot_ms - before.time_boot_ms, after.position) == (1000, before.position)
    assert [point["reading"] for point in result["trace"]] == [point.reading for point in rollout(9, "random", budget=12)[1]]


def test_the_wind_of_a_script_is_the_measured_one_and_the_true_one_stays_as_wrong(start, tmp_path: Path) -> None:
    path = written(
        tmp_path, "seed: 9\nworld: speed-high\nagent: {policy: random, budget: 4}\nevents: [{step: 2, do: wind, u: 3, phi: 1.0}]\n"
    )
    _, result, _ = flown(start, tmp_path, path)
    told = draw(9)
    for step, point in enumerate(result["trace"]):
        changed = told if step < 2 else msgspec.structs.replace(told, u=3.0, phi=1.0)
        assert point["reading"] == World(msgspec.structs.replace(changed, u=1.4 * changed.u), 9).gas(tuple(point["position"]), step)
    assert result["scenario"]["u"] == 1.4 * told.u  # as it was at the start
    (record,) = (tmp_path / "runs").glob("*.mcap")
    about = read(record).about
    assert (about["mission"]["world"], about["scenario"]["u"]) == ("speed-high", 1.4 * told.u)
    measured = [reading.wind for reading in sorted(recorded_readings(tmp_path), key=lambda it: it.time_boot_ms)]
    assert measured[0] == pytest.approx(told.wind, rel=1e-6)
    assert measured[-1] == pytest.approx((3 * math.cos(1), 3 * math.sin(1)), rel=1e-6)


def test_doubled_readings_are_there_as_often_as_it_says(start, tmp_path: Path) -> None:
    path = written(tmp_path, "agent: {policy: random, budget: 4}\nevents: [{step: 1, do: duplicate, readings: 2, copies: 3}]\n")
    flown(start, tmp_path, path)
    counted = Counter(reading.time_boot_ms for reading in recorded_readings(tmp_path))
    counts = [counted[time] for time in sorted(counted)]
    assert len(counts) == 5
    assert [count % 4 == 0 for count in counts[1:3]] == [True, True]  # per transmission: on a busy machine a reading may be sent twice


def test_an_event_that_comes_too_late_is_told(start, tmp_path: Path) -> None:
    path = written(tmp_path, "agent: {policy: random, budget: 2}\nevents: [{step: 5, do: spike, gas: 1}]\n")
    status, _, said = flown(start, tmp_path, path)
    assert status == 0
    assert "warning: events[0] of step 5 did not happen: the search ended at step 2\n" in said


@pytest.mark.parametrize(
    ("script", "told"),
    [
        ("sead: 3\n", "1: sead: unknown field; allowed: "),
        ("seed: 3\nagent:\n  policy: foo\n", "3: agent.policy: 'foo' is not allowed; wanted infotaxis, "),
        ("estimator:\n  particles: 50\n  prior: {q: 'gama:2,3'}\n", "3: estimator.prior: 'q=gama:2,3' is not allowed; wanted "),
        ("estimator:\n  stop_on: luck\n", "2: estimator.stop_on: 'luck' is not allowed; wanted "),
    ],
)
def test_a_bad_script_is_one_line_and_status_2_and_leaves_nothing(start, tmp_path: Path, script: str, told: str) -> None:
    path = written(tmp_path, script)
    status, _, said = flown(start, tmp_path, path)
    assert status == 2
    assert said[-1].startswith(f"error: {path}:{told}")
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == [path]
