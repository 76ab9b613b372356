"""Protects mission scripts end to end: every shipped mission meets its expectations, and events change
only what they state.
"""

import json
import math
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from agent.trials.rollout import rollout
from link.bus.mavlink import Reading
from link.record.reader import Recording, read
from plume.randomness import keyed
from plume.scenario import draw
from plume.sensors.names import GAUSSIAN
from plume.worlds.world import World
from tests.system.conftest import Part
from tests.system.live import run_sitl

MISSIONS = Path(__file__).parents[2] / "missions"
UNDISTURBED = (
    "bad-radio",
    "crashing-services",
    "link-cut",
    "operator-hold",
    "router-restart",
    "sensor-dropout",
)
"""Missions of seed 2 whose events cost time and nothing else."""


class Flown(NamedTuple):
    """A mission that was flown as processes: its exit status, its result, the lines of its stderr, its
    record and its script.
    """

    status: int
    result: dict[str, Any]
    said: list[str]
    record: Recording
    script: Path

    @property
    def trace(self) -> list[dict[str, Any]]:
        return self.result["trace"]

    def readings(self) -> list[Reading]:
        """The recorded readings by time, each once."""
        readings = [unpack(entry.payload) for entry in self.record.entries if entry.key == "reading"]
        return [
            reading for _, reading in sorted({reading.time_boot_ms: reading for reading in readings}.items())
        ]


def unpack(payload: bytes) -> Reading:
    """The contents of a reading, also of one without a value."""
    position, wind, gas = mavlink.MAVLink(None).parse_buffer(payload)
    return Reading(
        position.time_boot_ms, (position.y, position.x), -position.z, (-wind.wind_y, -wind.wind_x), gas.value
    )


def flown(folder: Path, mission: Path | str, *flags: str) -> Flown:
    """Fly a script, of which a text is written to a file first."""
    script = mission if isinstance(mission, Path) else folder / "mission.yaml"
    if isinstance(mission, str):
        script.write_text(mission)
    part = Part("sitl", "fly", str(script), "--speedup", "0", "--json", "--trace", *flags, cwd=folder)
    status = part.ended()
    assert part.out, part.err
    (record,) = (folder / "runs").glob("*.mcap")
    return Flown(status, json.loads(part.out[-1]), part.err, read(record), script)


@pytest.fixture(scope="module")
def undisturbed() -> list[dict]:
    """The trace of seed 2 in-process."""
    return [
        {
            "position": list(point.position),
            "reading": point.reading,
            "mean": list(point.mean),
            "spread": point.spread,
        }
        for point in rollout(2, "homing")[1]
    ]


QUICK = "survey-then-search"
"""Of the shipped missions the one that `make test` flies: an operator leads it first."""


@pytest.mark.parametrize(
    "mission",
    [
        stem if stem == QUICK else pytest.param(stem, marks=pytest.mark.full)
        for stem in sorted(path.stem for path in MISSIONS.glob("*.yaml"))
    ],
)
def test_every_mission_of_ours_meets_what_it_expects(
    tmp_path: Path, undisturbed: list[dict], mission: str
) -> None:
    flight = flown(tmp_path, MISSIONS / f"{mission}.yaml")
    assert flight.status == 0, flight.said
    assert flight.result["expectations"]
    assert all(flight.result["expectations"].values())
    assert not [line for line in flight.said if "did not happen" in line]
    if mission in UNDISTURBED:
        assert flight.trace == undisturbed


# ---- a mission that misses what it expects ----


@pytest.fixture(scope="module")
def missed(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """A mission with flags beside its script, an event that comes too late and an expectation that does
    not hold.
    """
    script = (
        "seed: 5\nagent: {policy: random, budget: 7}\nestimator: {particles: 50}\n"
        "events: [{step: 5, do: spike, gas: 1}, {time_s: 900, do: kill, part: agent}, {time_s: 900, do: land}, "
        "{time_s: 3, do: duplicate, readings: 1}]\n"
        "expect: [not ceased, located]\n"
    )
    return flown(tmp_path_factory.mktemp("missed"), script, "--seed", "6", "--budget", "4")


@pytest.mark.full
def test_an_expectation_that_does_not_hold_is_told_and_is_status_1(missed: Flown) -> None:
    assert missed.status == 1
    assert missed.result["expectations"] == {"not ceased": True, "located": False}
    assert missed.said[-2:] == ["expected not ceased: yes\n", "expected located: NO\n"]


def test_flags_beside_a_script_win(missed: Flown) -> None:
    assert [missed.result[name] for name in ("seed", "policy", "steps")] == [6, "random", 4]
    in_process = rollout(6, "random", particles=50, budget=4)[1]
    assert [point["mean"] for point in missed.trace] == [list(point.mean) for point in in_process]


def test_an_event_that_comes_too_late_is_told(missed: Flown) -> None:
    told = [line for line in missed.said if "did not happen" in line]
    assert told == [
        "warning: events[0] of step 5 did not happen: the search ended at step 4\n",
        "warning: events[1] of time 900 s did not happen: the search ended at step 4\n",
        "warning: events[2] of time 900 s did not happen: the search ended at step 4\n",
    ]


# ---- what the operator does ----


@pytest.mark.parametrize(
    ("word", "ends"),
    [
        ("land", "landed"),
        *(pytest.param(word, "returned home", marks=pytest.mark.full) for word in ("return", "abort")),
    ],
)
def test_the_operators_words_end_the_search_where_they_say(tmp_path: Path, word: str, ends: str) -> None:
    script = (
        f"seed: 2\nagent: {{policy: random}}\nevents: [{{step: 5, do: {word}}}]\nexpect: [not ceased, "
        "landed, returned home]\n"
    )
    flight = flown(tmp_path, script)
    assert flight.result["expectations"] == {
        "not ceased": True,
        "landed": True,
        "returned home": ends == "returned home",
    }
    assert flight.result["steps"] == 5
    old = f"warning: {flight.script}: 'abort' is an old word, read as 'return'\n"
    assert flight.said.count(old) == (word == "abort")


# ---- a mission with many events ----

TURNS, LED, HELD, SILENT, DOUBLED = 2, 4, 8, 10, 12
"""The steps of the events, far enough from each other not to meet."""
POINTS = [[4.25, 5.5], [6.75, 5.5], [6.1, 8.3]]


@pytest.fixture(scope="module")
def eventful(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    script = f"""
seed: 9
agent: {{policy: random, budget: 14}}
events:
  - {{step: {TURNS}, do: wind, u: 3.5, phi: 1.0}}
  - {{step: {LED}, do: waypoints, points: {json.dumps(POINTS)}}}
  - {{step: {HELD}, do: hold}}
  - {{after_s: 45, do: resume}}
  - {{step: {SILENT}, do: dropout, for_s: 2.5}}
  - {{step: {DOUBLED}, do: duplicate, readings: 2, copies: 3}}
"""
    return flown(tmp_path_factory.mktemp("eventful"), script)


@pytest.mark.full
def test_the_wind_turns_with_the_reading_that_it_says_and_the_plume_with_it(eventful: Flown) -> None:
    release = draw(9)
    assert len(eventful.trace) == 15
    for step, point in enumerate(eventful.trace):
        u, phi = (release.u, release.phi) if step < TURNS else (3.5, 1.0)
        # The paper's equation with numbers: gas lies downwind.
        dx, dy = point["position"][0] - release.source[0], point["position"][1] - release.source[1]
        r = max(math.hypot(dx, dy), 0.1)
        decay = math.sqrt(release.d * release.tau / (1 + u * u * release.tau / (4 * release.d)))
        psi = -(dx * u * math.cos(phi) + dy * u * math.sin(phi)) / (2 * release.d)
        mean = release.q / (4 * math.pi * release.d * r) * math.exp(-r / decay + psi)
        assert point["reading"] == pytest.approx(
            float(GAUSSIAN.measure(mean, keyed(9, "sensor", step))), rel=1e-5
        )


def test_scripted_waypoints_are_flown_and_then_the_agent_goes_on(eventful: Flown) -> None:
    positions = [point["position"] for point in eventful.trace]
    assert positions[LED + 1 : LED + 4] == [[float(np.float32(value)) for value in point] for point in POINTS]
    for before, after in (positions[LED - 1 : LED + 1], positions[LED + 3 : LED + 5]):
        assert math.dist(before, after) == pytest.approx(1.0, abs=1e-5)


def test_a_hold_takes_as_long_as_it_says(eventful: Flown) -> None:
    times = [reading.time_boot_ms for reading in eventful.readings()][HELD - 1 : HELD + 3]
    leg_ms = 1000 * 2 * math.sqrt(1 / 3)  # time of 1 m from rest to rest at 3 m/s²
    assert [after - before for before, after in pairwise(times)] == pytest.approx(
        [leg_ms, leg_ms + 45_000, leg_ms], abs=2
    )


def test_a_silent_sensor_says_nan_each_second_and_the_reading_comes_after_it(eventful: Flown) -> None:
    readings = eventful.readings()
    assert [number for number, reading in enumerate(readings) if math.isnan(reading.gas)] == [
        SILENT,
        SILENT + 1,
        SILENT + 2,
    ]
    there = readings[SILENT : SILENT + 4]
    assert [after.time_boot_ms - before.time_boot_ms for before, after in pairwise(there)] == [
        1000,
        1000,
        1000,
    ]
    assert len({reading.position for reading in there}) == 1


def test_doubled_readings_are_there_as_often_as_it_says(eventful: Flown) -> None:
    counted = Counter(
        unpack(entry.payload).time_boot_ms for entry in eventful.record.entries if entry.key == "reading"
    )
    counts = [counted[reading.time_boot_ms] for reading in eventful.readings() if not math.isnan(reading.gas)]
    assert len(counts) == 15
    assert [count % 4 for count in counts[DOUBLED : DOUBLED + 2]] == [
        0,
        0,
    ]  # per transmission: on a busy machine a reading may be sent twice


# ---- other worlds ----


@pytest.mark.full
def test_a_lost_reading_has_no_value_and_is_taken_again_a_second_later(tmp_path: Path) -> None:
    flight = flown(tmp_path, "seed: 9\nworld: readings-lost\nagent: {policy: random, budget: 12}\n")
    assert flight.result["world"] == "readings-lost"
    readings = flight.readings()
    lost = [step for step in range(1, 13) if keyed(9, "lost reading", step).random() < 0.2]
    assert lost
    expected = [missing for step in range(13) for missing in ([True, False] if step in lost else [False])]
    assert [math.isnan(reading.gas) for reading in readings] == expected
    for before, after in pairwise(readings):
        if math.isnan(before.gas):
            assert (after.time_boot_ms - before.time_boot_ms, after.position) == (1000, before.position)
    assert [point["reading"] for point in flight.trace] == [
        point.reading for point in rollout(9, "random", budget=12)[1]
    ]


RELEASE = {"q": 200, "u": 2, "phi": 0.5, "d": 3, "tau": 12, "start": [1.5, 2.5]}


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """A given release in a world where it blows faster than is measured, and the wind turns at step 2."""
    given = json.dumps({"source": [20.5, 11.25], **RELEASE})
    script = (
        f"seed: 9\nscenario: {given}\nworld: speed-high\nagent: {{policy: random, budget: 4}}\n"
        "events: [{step: 2, do: wind, u: 3, phi: 1.0}]\n"
    )
    return flown(tmp_path_factory.mktemp("wrong"), script)


@pytest.mark.full
def test_a_scenario_that_is_given_is_the_one_that_is_flown(wrong: Flown) -> None:
    assert wrong.result["source"] == [20.5, 11.25]
    assert wrong.result["scenario"] == RELEASE | {"u": 1.4 * 2}  # as it was at the start
    assert wrong.trace[0]["position"] == [1.5, 2.5]


def test_the_wind_of_a_script_is_the_measured_one_and_the_true_one_stays_as_wrong(wrong: Flown) -> None:
    told = msgspec.structs.replace(draw(9), source=(20.5, 11.25), **(RELEASE | {"start": (1.5, 2.5)}))
    for step, point in enumerate(wrong.trace):
        changed = told if step < 2 else msgspec.structs.replace(told, u=3.0, phi=1.0)
        assert point["reading"] == World(msgspec.structs.replace(changed, u=1.4 * changed.u), 9).gas(
            tuple(point["position"]), step
        )
    about = wrong.record.about
    assert (about["mission"]["world"], about["scenario"]["u"]) == ("speed-high", 1.4 * told.u)
    measured = [reading.wind for reading in wrong.readings()]
    assert measured[0] == pytest.approx(told.wind, rel=1e-6)
    assert measured[-1] == pytest.approx((3 * math.cos(1), 3 * math.sin(1)), rel=1e-6)


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("script", "told"),
    [
        ("sead: 3\n", "1: sead: unknown field; did you mean 'seed'? Allowed: "),
        ("seed: 3\nagent:\n  policy: foo\n", "3: agent.policy: 'foo' is not allowed; wanted infotaxis, "),
        (
            "estimator:\n  particles: 50\n  prior: {q: 'gama:2,3'}\n",
            "3: estimator.prior: 'q=gama:2,3' is not allowed; wanted ",
        ),
        ("estimator:\n  stop_on: luck\n", "2: estimator.stop_on: 'luck' is not allowed; wanted "),
    ],
)
def test_a_bad_script_is_one_line_and_status_2_and_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    script: str,
    told: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "mission.yaml"
    path.write_text(script)
    status, _, said = run_sitl(monkeypatch, capsys, "fly", str(path))
    assert status == 2
    assert said[-1].startswith(f"error: {path}:{told}")
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == [path]
