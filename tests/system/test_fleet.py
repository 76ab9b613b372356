"""Protects a search by several vehicles on the bus: the same bits as in-process, one stop for all, and no
process that stays behind.
"""

import csv
import json
import math
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader

from agent.trials.rollout import mission, rollout
from ground.view.records import RecordedFleet
from link.bus.keys import BELIEF, DEPARTURE, HEALTH, LATECOMER, STOP
from link.bus.mavlink import message_of, split, unpack_reading
from link.bus.messages import (
    Belief,
    Departure,
    Health,
    Latecomer,
    RoundReading,
    Stop,
    by_number,
    pack_particles,
)
from link.bus.session import Bus, part_of
from link.record.reader import read
from plume.problems.fleet import Fleet
from plume.randomness import derived_seed
from plume.scenario import draw
from scene.follow.history import histories_of
from tests.system.conftest import Part
from tests.system.live import run_agent, run_sitl
from tests.system.pages import Browser, port_of
from tests.system.test_view import belief as one_belief

TO_THE_STOP = ("--vehicles", "2", "--from", "corners", "--seed", "4", "--particles", "300")


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., dict]:
    """Roll a mission out in this process, with the same flags."""

    def rolled(*flags: str) -> dict:
        status, out, err = run_agent(monkeypatch, capsys, "rollout", *flags, "--json", "--trace")
        assert status == 0, err
        return without_times(json.loads(out[-1]))

    return rolled


def without_times(outcome: dict) -> dict:
    assert outcome.pop("search_time_s") > 0  # the one field that is measured, not computed
    return outcome


def flown(start: type[Part], folder: Path, *flags: str) -> tuple[dict, str]:
    """The outcome of a mission flown as processes, and what it said."""
    part = start("sitl", "fly", *flags, "--no-record", "--json", "--trace", cwd=folder)
    assert part.ended() == 0, "".join(part.err)
    return without_times(json.loads(part.out[-1])), "".join(part.err)


def test_two_vehicles_find_a_source_together_as_in_process(
    start: type[Part], tmp_path: Path, in_process: Callable
) -> None:
    bus, said = flown(start, tmp_path, *TO_THE_STOP, "--speedup", "0")
    assert bus == in_process(*TO_THE_STOP)
    assert bus["located"]
    assert {point.get("vehicle", 1) for point in bus["trace"]} == {1, 2}
    assert len(bus["trace"]) == 2 * (bus["steps"] + 1)
    assert "2 vehicles from corners" in said
    assert "returning home" in said


@pytest.mark.full
def test_in_gas_that_moves_three_vehicles_on_the_clock_read_the_same_as_in_process(
    start: type[Part], tmp_path: Path, in_process: Callable
) -> None:
    """The world's time is that of their rounds, whatever the speed-up; a lost reading is taken again."""
    chosen = (
        "--vehicles", "3", "--from", "point", "--separation", "2", "--seed", "6", "--particles", "100", "--budget",
        "4", "--world", "puffs+readings-lost+wind-noisy", "--sensor", "pid:warmup=7.5", "--policy", "random",
    )  # fmt: skip
    bus, _ = flown(start, tmp_path, *chosen, "--speedup", "30", "-I", "4")
    there = in_process(*chosen)
    for each in (bus, there):  # -I moves home, and so the search, but changes nothing in it
        assert each.pop("latitude_deg")
        assert each.pop("longitude_deg")
    assert bus == there


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (("--vehicles", "0"), "'0' is not allowed; wanted a whole number from 1 to 8"),
        (("--vehicles", "nine"), "'nine' is not allowed; wanted a whole number from 1 to 8"),
        (
            ("--vehicles", "2", "--from", "nowhere"),
            "--from: 'nowhere' is not allowed; wanted point, edge or corners",
        ),
        (
            ("--vehicles", "4", "--from", "edge", "--separation", "9"),
            "--separation: 9 is not allowed; 4 vehicles from edge have room for 0 to 7.5 m",
        ),
        (
            ("--vehicles", "2", "--out", "udpout:127.0.0.1:9", "--out", "udpin:127.0.0.1:9"),
            "--out: udpin:127.0.0.1:9 is not allowed for 2 vehicles, which cannot listen at one port; "
            "wanted udpin:127.0.0.1, by which each has its own",
        ),
        (("--vehicles", "2", "lawnmower"), "lawnmower, cannot happen: it is for one vehicle"),
    ],
)
def test_a_fleet_that_cannot_fly_is_refused_in_one_line_before_anything_starts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], flags: tuple[str, ...], reason: str
) -> None:
    status, _, err = run_sitl(monkeypatch, capsys, "fly", *flags)
    assert status == 2
    assert reason in err[-1]


def test_a_script_that_asks_for_too_many_vehicles_is_refused_with_the_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "nine.yaml"
    for text, reason in (
        (
            "seed: 1\nfleet:\n  vehicles: 9\n",
            "nine.yaml:3: fleet.vehicles: 9 is not allowed; wanted a whole number",
        ),
        ("fleet: {vehicles: 4, formation: edge, separation_m: 9}", "fleet.separation_m: 9 is not allowed"),
        (
            "{fleet: {vehicles: 2}, events: [{step: 1, do: return, vehicle: 3}]}",
            "events[0].vehicle: 3 is not allowed; wanted 1 to 2",
        ),
    ):
        path.write_text(text)
        status, _, err = run_sitl(monkeypatch, capsys, "fly", str(path))
        assert status == 2
        assert reason in err[-1]


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def has_ended(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


@pytest.mark.full
def test_ctrl_c_ends_all_vehicles_and_leaves_nothing_behind(
    start: type[Part], tmp_path: Path, wait_until: Callable
) -> None:
    part = start(
        "sitl", "fly", "--vehicles", "2", "--policy", "random", "--speedup", "4", "--particles", "100", cwd=tmp_path
    )  # fmt: skip
    part.comes_to("step   0")
    parts = children(part.process.pid)
    assert len(parts) == 6  # router, recorder, estimator, agent and two vehicles
    part.process.send_signal(signal.SIGINT)
    assert part.ended() == 130
    wait_until(lambda: all(map(has_ended, parts)))


def test_a_vehicle_that_dies_before_the_search_is_left_behind(start: type[Part], tmp_path: Path) -> None:
    part = start(
        "sitl", "fly", "--vehicles", "2", "--policy", "random", "--budget", "8", "--particles", "100", "--no-record",
        "--assume", "paper", cwd=tmp_path,
    )  # fmt: skip
    vehicles: dict[str, int] = {}
    while len(vehicles) < 2:
        vehicles = processes_of(part)
    os.kill(vehicles["2"], signal.SIGKILL)
    assert part.ended() == 0, "".join(part.err)
    assert "warning: uav/2 has left the search at step 0: was killed by signal 9" in "".join(part.err)


def processes_of(part: Part) -> dict[str, int]:
    """The processes of the vehicles of a mission, by their numbers."""
    found = {}
    for pid in children(part.process.pid):
        words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
        if "--number" in words:
            found[words[words.index("--number") + 1]] = pid
    return found


# ---- vehicles that leave ----

LEAVING = {2: 6, 3: 4}  # the first round without a vehicle
LOSING = """
seed: 4
speedup: 0
fleet: {vehicles: 3, formation: corners}
estimator: {particles: 300}
events:
  - {step: 3, do: return, vehicle: 3}
  - {step: 5, do: return, vehicle: 2}
"""


class Lost(NamedTuple):
    """What came of a mission of three, of which one is called home and then another."""

    outcome: dict
    said: str
    record: Path


@pytest.fixture(scope="module")
def lost(tmp_path_factory: pytest.TempPathFactory) -> Lost:
    folder = tmp_path_factory.mktemp("lost")
    (folder / "losing.yaml").write_text(LOSING)
    part = Part("sitl", "fly", "losing.yaml", "--record", "lost.mcap", "--json", "--trace", cwd=folder)
    assert part.ended() == 0, "".join(part.err)
    return Lost(json.loads(part.out[-1]), "".join(part.err), folder / "lost.mcap")


def test_those_that_are_left_find_the_source_as_in_process(lost: Lost) -> None:
    steps = mission(
        4, "homing", 300, 0.5, fleet=Fleet(3, "corners"), leaving=LEAVING, assume="field"
    ).steps  # fmt: skip
    expected = [
        {
            "position": [*taken.position],
            "reading": taken.gas,
            "mean": [*step.belief.mean],
            "spread": step.belief.spread,
            "vehicle": taken.vehicle,
        }
        for step in steps
        for taken in step.readings
    ]
    assert [{"vehicle": 1, **point} for point in lost.outcome["trace"]] == expected
    assert lost.outcome["located"]


def test_the_outcome_names_who_left_when_and_why_and_who_measured_what(lost: Lost) -> None:
    assert {each["vehicle"]: each["step"] for each in lost.outcome["left"]} == LEAVING
    assert all("RETURN" in each["reason"] for each in lost.outcome["left"])
    readings = [[p["reading"] for p in lost.outcome["trace"] if p.get("vehicle", 1) == n] for n in (1, 2, 3)]
    assert [(each["readings"], each["largest"]) for each in lost.outcome["measured"]] == [
        (len(own), max(own)) for own in readings
    ]
    assert "warning: uav/3 has left the search at step 4: " in lost.said
    assert "left at step 6: " in lost.said
    assert lost.said.count("has left the search") == 2
    assert "refused" not in lost.said  # who has left is not told of waypoints that are for others


@pytest.mark.full
def test_the_record_of_a_search_that_was_left_is_verified_and_told_as_it_was(
    lost: Lost, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    status, out, err = run_sitl(monkeypatch, capsys, "replay", str(lost.record), "--verify", "--speedup", "0")
    assert status == 0, err
    steps = lost.outcome["steps"]
    assert f"verified: {steps + 1} beliefs, 1 stop, {steps} waypoints" in "\n".join([*out, *err])
    assert run_sitl(monkeypatch, capsys, "log", str(lost.record), "--json")[0] == 0
    status, out, _ = run_sitl(monkeypatch, capsys, "log", str(lost.record), "--json")
    assert json.loads(out[-1])["left"] == lost.outcome["left"]
    status, _, err = run_sitl(
        monkeypatch, capsys, "findings", str(lost.record), "--out", str(tmp_path / "found")
    )
    assert status == 0, err
    rows = (tmp_path / "found" / "readings.csv").read_text().splitlines()
    assert len(rows) == 1 + len(lost.outcome["trace"])


# ---- a sensor that lies, and one that dies on the ground ----

LYING = """
{seed: 4, speedup: 0, fleet: {vehicles: 3, formation: corners}, estimator: {particles: 300, doubted: leave-out},
agent: {budget: 14},
events: [{step: 3, do: stuck, readings: 1000, vehicle: 2}, {step: 12, do: leave-out, vehicle: 2}]}
"""


@pytest.mark.full
def test_a_sensor_that_lies_is_named_and_left_out_and_the_record_is_verified(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "lying.yaml").write_text(LYING)
    part = Part("sitl", "fly", "lying.yaml", "--record", "lying.mcap", "--json", "--trace", cwd=tmp_path)
    assert part.ended() == 0, "".join(part.err)
    outcome = json.loads(part.out[-1])
    # It repeats its reading 2, so that reading 4 is the third of the same value. The order comes too late.
    assert outcome["doubted"] == [{"vehicle": 2, "step": 4}]
    reason = "its readings do not fit those of the others"
    assert outcome["left"] == [{"vehicle": 2, "step": 5, "reason": reason, "forgotten": True}]
    assert "the readings of uav/2 do not fit those of the others" in "".join(part.err)
    status, out, err = run_sitl(
        monkeypatch, capsys, "replay", str(tmp_path / "lying.mcap"), "--verify", "--speedup", "0"
    )
    assert status == 0, err
    assert f"verified: {outcome['steps'] + 1} beliefs" in "\n".join([*out, *err])


@pytest.mark.full
def test_one_that_dies_on_the_ground_is_left_behind(
    start: type[Part], router: str, watched: "Watched", wait_until: Callable
) -> None:
    parts = commands(router, overdue="2")
    dying = start(*parts["uav/2"])
    start(*parts["estimator"])
    # The estimator has to see it before it dies: for one that it has never seen all wait without end.
    wait_until(lambda: watched.take() == -1 and {"uav/2", "estimator"} <= set(watched.states))
    dying.kill()
    for part in ("agent", "uav/1"):
        start(*parts[part])
    while not watched.points:
        watched.take()
    (left,) = watched.left.values()
    assert (left.vehicle, left.step, left.forgotten) == (2, 0, False)
    assert len(watched.points[0]) == 1


@pytest.mark.full
def test_an_operators_order_leaves_a_vehicle_out(
    start: type[Part],
    router: str,
    watched: "Watched",
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for words in commands(router).values():
        start(*words)
    while watched.take() < 3:
        pass
    status, _, err = run_sitl(monkeypatch, capsys, "leave-out", "3", "-e", router)
    assert (status, "wanted one of uav/1, uav/2" in "".join(err)) == (2, True)
    status, out, _ = run_sitl(monkeypatch, capsys, "leave-out", "2", "-e", router)
    assert status == 0
    assert "uav/2 has left the search at step" in out[0]
    status, _, err = run_sitl(monkeypatch, capsys, "leave-out", "1", "-e", router)
    assert (status, "the estimator has refused leave-out: uav/1 is the only one left" in "".join(err)) == (
        1,
        True,
    )


def test_the_estimator_of_one_vehicle_leaves_none_out(
    start: type[Part],
    router: str,
    wait_until: Callable,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    estimator = start("estimator", "--connect", router, "--namespace", "search/1")
    wait_until(lambda: estimator.says("ready"))
    for late in ([], ["--late"]):
        status, _, err = run_sitl(monkeypatch, capsys, "leave-out", "1", *late, "-e", router)
        assert (status, err) == (2, ["error: K: 1 is not allowed; the estimator is for 1 vehicle"])


def test_a_vehicle_that_is_not_of_the_search_stays_on_the_ground_and_says_why(
    start: type[Part], router: str
) -> None:
    parts, stranger = commands(router), commands(router, vehicles=3)["uav/3"]
    start(*parts["estimator"])
    uav = start(*stranger)  # whichever of the two is there first
    assert uav.ended() == 1
    line = "error: the estimator is for 2 vehicles, and 3 would fly: start it with --vehicles 3\n"
    assert uav.err[-1] == line
    again = start(*stranger)
    assert again.ended() == 1
    assert again.err[-1] == line


# ---- services that die ----

SEED = 4
SEARCH = ("--namespace", "search/1")


class Watched:
    """The beliefs of a search, as somebody hears them who looks on."""

    def __init__(self, router: str) -> None:
        self.bus = Bus("viewer", router, "search/1", announced=False, vehicles=(1, 2, 3))
        self.bus.subscribe(BELIEF, STOP, DEPARTURE, LATECOMER, HEALTH)
        self.left: dict[int, Departure] = {}
        self.late: Latecomer | None = None  # what says most
        self.points: dict[int, list[tuple]] = {}
        self.stops: list[Stop] = []
        self.states: dict[str, str] = {}
        self.ceased = False

    def take(self) -> int:
        """Take what comes; returns the newest step."""
        item: Any = self.bus.receive(400.0)
        if item.key is BELIEF and (said := self.bus.decode(item, Belief)):
            seen = [(each.position, each.gas, each.mean, each.spread) for each in by_number(said).values()]
            assert self.points.setdefault(said.step, seen) == seen  # a repeated belief is the same
            self.ceased = said.ceased
        elif item.key is STOP and (stop := self.bus.decode(item, Stop)):
            self.stops.append(stop)
        elif item.key is DEPARTURE and (left := self.bus.decode(item, Departure)):
            assert self.left.setdefault(left.vehicle, left) == left  # it is said again as it was
        elif item.key is LATECOMER and (late := self.bus.decode(item, Latecomer)):
            self.late = max(self.late or late, late, key=lambda said: said.says)
        elif item.key is HEALTH and (health := self.bus.decode(item, Health)):
            self.states[part_of(item.name)] = health.state
        return max(self.points, default=-1)


@pytest.fixture
def watched(router: str) -> Iterator[Watched]:
    looking_on = Watched(router)
    with looking_on.bus:
        yield looking_on


def commands(
    router: str, overdue: str = "20", vehicles: int = 2, policy: str = "homing"
) -> dict[str, tuple[str, ...]]:
    """What starts the parts of the search, without a launcher."""
    truth, several = draw(SEED), ("--vehicles", str(vehicles))
    joining, fleet = ("-e", router, *SEARCH), (*several, "--from", "corners")
    return {
        "estimator": (
            "estimator", *joining, *several, "--particles", "300", "--rate", repr(truth.q), "--diffusivity",
            repr(truth.d), "--lifetime", repr(truth.tau), "--seed", str(derived_seed(SEED, "estimator")),
            "--overdue", overdue,
        ),
        "agent": ("agent", *joining, "--policy", policy, "--seed", str(derived_seed(SEED, "agent"))),
        **{
            f"uav/{number}": (
                "sitl", "uav", *joining, *fleet, "-I", str(number - 1), "--seed", str(SEED), "--speedup", "20"
            )
            for number in range(1, vehicles + 1)
        },
    }  # fmt: skip


def undisturbed() -> list[list[tuple]]:
    _, trace = rollout(SEED, "homing", 300, vehicles=2, formation="corners")
    points = [(point.position, point.reading, point.mean, point.spread) for point in trace]
    return [points[at : at + 2] for at in range(0, len(points), 2)]


@pytest.mark.full
@pytest.mark.parametrize("victim", ["estimator", "agent"])
def test_a_service_that_is_killed_and_started_again_goes_on_with_the_same_search(
    start: type[Part], router: str, watched: Watched, wait_until: Callable, victim: str
) -> None:
    parts = commands(router)
    running = {part: start(*words) for part, words in parts.items() if part != "uav/2"}
    wait_until(lambda: watched.take() == -1 and watched.states.get("uav/1") == "standby")
    start(*parts["uav/2"])  # who comes late is waited for, on the ground
    killed = False
    while not (watched.ceased and watched.stops):
        if watched.take() >= 6 and not killed:
            running[victim].kill()
            start(*parts[victim])
            killed = True
    expected = undisturbed()
    assert [watched.points[step] for step in sorted(watched.points)] == expected
    assert watched.stops[0].estimate == expected[-1][0][2]
    wait_until(lambda: watched.take() and [watched.states.get(f"uav/{n}") for n in (1, 2)] == ["landed"] * 2)


def test_a_vehicle_that_dies_is_left_behind_and_an_estimator_that_starts_again_knows_it(
    start: type[Part], router: str, watched: Watched, wait_until: Callable
) -> None:
    """Its readings have died with it: the agent, which heard of it, brings them back."""
    parts = commands(router, overdue="2")
    running = {part: start(*words) for part, words in parts.items()}
    stages = [
        (3, lambda: running["uav/1"].process.send_signal(signal.SIGKILL)),
        (9, lambda: running["estimator"].kill()),
        (9, lambda: start(*parts["estimator"])),
    ]
    while not (watched.ceased and watched.stops):
        step = watched.take()
        while stages and step >= stages[0][0]:
            stages.pop(0)[1]()
    (left,) = watched.left.values()
    assert (left.vehicle, left.reason) == (1, "gone from the bus for 2 s")
    steps = mission(
        SEED, "homing", 300, 0.5, fleet=Fleet(2, "corners"), leaving={1: left.step}, assume="field"
    ).steps  # fmt: skip
    expected = [
        [(each.position, each.gas, step.belief.mean, step.belief.spread) for each in step.readings]
        for step in steps
    ]
    assert [watched.points[step] for step in sorted(watched.points)] == expected


@pytest.mark.full
def test_one_that_comes_late_joins_and_an_estimator_that_starts_again_knows_it(
    start: type[Part],
    router: str,
    watched: Watched,
    wait_until: Callable,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The others wander on while it starts, however long that takes; what counts is when it was let in."""
    parts = commands(router, vehicles=3, policy="random")
    running = {part: start(*parts[part]) for part in ("estimator", "agent", "uav/1")}
    wait_until(lambda: watched.take() == -1 and {"estimator", "uav/1"} <= set(watched.states))
    status, _, err = run_sitl(monkeypatch, capsys, "leave-out", "1", "--late", "-e", router)
    assert (status, "uav/1 is there" in "".join(err)) == (2, True)
    status, _, err = run_sitl(monkeypatch, capsys, "leave-out", "4", "--late", "-e", router)
    assert (status, err) == (2, ["error: K: 4 is not allowed; the estimator is for 3 vehicles"])
    status, out, _ = run_sitl(monkeypatch, capsys, "leave-out", "2", "--late", "-e", router)
    assert (status, out) == (0, ["uav/2 comes late: the others begin"])
    start(*parts["uav/3"])
    while watched.take() < 2:
        pass
    start(*parts["uav/2"])
    while len(watched.points[watched.take()]) < 3:
        pass
    running["estimator"].kill()
    start(*parts["estimator"])
    last = watched.take() + 2
    while watched.take() < last:
        pass
    assert watched.late
    assert isinstance(watched.late.step, int)
    assert watched.late.since < watched.late.step
    flown = mission(
        SEED, "random", 300, 0.5, last, fleet=Fleet(3, "corners"), assume="field", ends=False,
        joining={2: (watched.late.since, watched.late.step)},
    )  # fmt: skip
    expected = [
        [(each.position, each.gas, step.belief.mean, step.belief.spread) for each in step.readings]
        for step in flown.steps
    ]
    assert [len(points) for points in expected] == [2] * watched.late.step + [3] * (
        last + 1 - watched.late.step
    )
    assert [watched.points[step] for step in range(last + 1)] == expected


LATE = """
{seed: 4, speedup: 4, fleet: {vehicles: 3, formation: corners}, estimator: {particles: 300, threshold_m: 0.01},
agent: {policy: random, budget: 40}, expect: [not ceased, returned home], events: [{step: 2, do: join, vehicle: 3}]}
"""


@pytest.mark.full
def test_a_script_lets_a_vehicle_join_and_its_record_is_verified_and_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "late.yaml").write_text(LATE)
    part = Part("sitl", "fly", "late.yaml", "--record", "late.mcap", "--json", "--trace", cwd=tmp_path)
    assert part.ended() == 0, "".join(part.err)
    outcome = json.loads(part.out[-1])
    (joined,) = outcome["joined"]
    assert joined["vehicle"] == 3
    assert 2 < joined["step"] <= 40
    own = [point for point in outcome["trace"] if point.get("vehicle") == 3]
    assert len(own) == outcome["measured"][2]["readings"] == 41 - joined["step"]
    record = str(tmp_path / "late.mcap")
    status, out, err = run_sitl(monkeypatch, capsys, "replay", record, "--verify", "--speedup", "0")
    assert status == 0, err
    assert "verified: 41 beliefs" in "\n".join([*out, *err])
    status, out, _ = run_sitl(monkeypatch, capsys, "log", record, "--json")
    assert json.loads(out[-1])["joined"] == [joined]
    third = histories_of(read(Path(record)))[2].at()
    assert [each.step for each in third.measurements] == list(range(joined["step"], 41))
    assert [each.position for each in third.measurements] == [tuple(point["position"]) for point in own]


# ---- what is shown of it ----


def of_a_round() -> Belief:
    """A belief of two vehicles, after the first round."""
    readings = tuple(
        RoundReading(number, number, 1000 + number, (10.0 * number, 2.0), 5.0, 0.5 * number)
        for number in (1, 2)
    )
    alone = one_belief(0)
    return msgspec.structs.replace(alone, position=(20.0, 2.0), time_boot_ms=1002, readings=readings)


def test_a_page_shows_each_vehicle_of_a_search_with_their_belief(
    start: type[Part], router: str, wait_until: Callable
) -> None:
    view = start("sitl", "view", "--port", "0", "--connect", router)
    names = {"search/1/uav/1", "search/1/uav/2"}
    with (
        Bus("estimator", router, "search/1", vehicles=(1, 2)) as estimator,
        Bus("uav", router, "search/1", vehicles=(1,)),
        Bus("uav", router, "search/1", vehicles=(2,)),
        Browser(port_of(view, wait_until)) as page,
    ):
        page.until(lambda: set(page.vehicles) == names)
        page.show(*sorted(names))
        particles = np.full((7, 3), 1 / 7, np.float32)
        estimator.publish(BELIEF, of_a_round(), pack_particles(particles))
        page.until(lambda: all(page.particles.get(name) == 7 for name in names))


def test_status_has_a_row_for_each_vehicle_of_a_search_and_for_its_services(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], router: str
) -> None:
    with (
        Bus("uav", router, "search/1", vehicles=(1,)) as first,
        Bus("uav", router, "search/1", vehicles=(2,)) as second,
        Bus("estimator", router, "search/1", vehicles=(1, 2)) as estimator,
        Bus("agent", router, "search/1") as agent,
        Bus("bridge", router, "search/1/uav/1") as bridge,
        Bus("ros2", router, "search/1/uav/2") as ros2,
        ExitStack() as stack,
    ):
        parts, over = (first, second, estimator, agent, bridge, ros2), threading.Event()

        def keep_speaking() -> None:
            while not over.wait(0.1):
                for bus in parts:
                    bus.publish_health()

        speaking = threading.Thread(target=keep_speaking)
        speaking.start()
        stack.callback(speaking.join)
        stack.callback(over.set)
        for flags in ((), ("--namespace", "search/1")):
            status, out, _ = run_sitl(monkeypatch, capsys, "status", "-e", router, *flags)
            assert status == 0
            assert out[0] == f"search/1 at {router}"
            rows = [line.split()[:2] for line in out[2:]]
            assert rows[:5] == [[part, "ok"] for part in ("router", "uav/1", "uav/2", "estimator", "agent")]
            assert sorted(rows[5:]) == [["bridge/1", "ok"], ["ros2/2", "ok"]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The record of a short mission of two vehicles, which a script describes; the wind turns on the way."""
    folder = tmp_path_factory.mktemp("fleet")
    (folder / "two.yaml").write_text(
        "{seed: 4, speedup: 0, fleet: {vehicles: 2, formation: corners}, estimator: {particles: 100}, "
        "agent: {budget: 4}, events: [{step: 2, do: wind, phi: 1.0}]}"
    )
    part = Part("sitl", "fly", "two.yaml", "--record", "two.mcap", cwd=folder)
    assert part.ended() == 0, "".join(part.err)
    return folder / "two.mcap"


def test_a_record_has_the_readings_of_all_vehicles_under_their_keys(recorded: Path) -> None:
    log = read(recorded)
    assert log.complete
    assert log.about["fleet"] == {"vehicles": 2, "formation": "corners", "separation_m": 3.0}
    for number in (1, 2):
        times = [
            unpack_reading(entry.payload, number).time_boot_ms
            for entry in log.entries
            if entry.key == f"uav/{number}/reading"
        ]
        assert len(set(times)) == 5
    keys = {entry.key for entry in log.entries}
    assert {"belief", "waypoint", "uav/1/mavlink/out", "uav/2/mavlink/out", "uav/2/health/uav"} <= keys


def test_each_vehicle_takes_off_and_lands_where_it_reads_first(recorded: Path) -> None:
    log = read(recorded)
    for number in (1, 2):
        own = {key: [entry.payload for entry in log.entries if entry.key == f"uav/{number}/{key}"]
               for key in ("reading", "mavlink/out")}  # fmt: skip
        east, north = unpack_reading(own["reading"][0], number).position
        frames = [frame for payload in own["mavlink/out"] for frame in split(payload)]
        said = [message_of(frame) for frame in frames if frame.message_id == 32]  # LOCAL_POSITION_NED
        stand = pytest.approx((north, east, 0.0), abs=0.01)
        assert (said[0].x, said[0].y, said[0].z) == (said[-1].x, said[-1].y, said[-1].z) == stand
        assert min(each.z for each in said) < -4.9


def test_a_replayed_record_gives_the_same_beliefs_and_waypoints(
    recorded: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = run_sitl(monkeypatch, capsys, "replay", str(recorded), "--verify", "--speedup", "0")
    assert status == 0, err
    assert "verified: 5 beliefs, 0 stops, 4 waypoints" in "\n".join([*out, *err])


def test_a_log_and_findings_have_all_readings_and_all_metres(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, _ = run_sitl(monkeypatch, capsys, "log", str(recorded))
    assert status == 0
    assert any(line.startswith("not ceased after 4 steps of 2 vehicles") for line in out)
    status, _, err = run_sitl(
        monkeypatch, capsys, "findings", str(recorded), "--out", str(tmp_path / "found")
    )
    assert status == 0, err
    rows = list(csv.DictReader((tmp_path / "found" / "readings.csv").read_text().splitlines()))
    assert [row["vehicle"] for row in rows] == ["1", "2"] * 5
    found = json.loads((tmp_path / "found" / "findings.json").read_text())
    ways = [
        [(float(row["x_m"]), float(row["y_m"])) for row in rows if row["vehicle"] == vehicle]
        for vehicle in ("1", "2")
    ]
    flown_m = sum(math.dist(a, b) for way in ways for a, b in pairwise(way))
    assert (found["vehicles"], found["distance_m"]) == (2, pytest.approx(flown_m))
    features = json.loads((tmp_path / "found" / "findings.geojson").read_text())["features"]
    tracks = [each for each in features if each["properties"]["kind"] == "track"]
    assert [each["properties"]["vehicle"] for each in tracks] == [1, 2]
    page = (tmp_path / "found" / "findings.html").read_text()
    assert "5 readings of each of 2 vehicles" in page
    assert page.count(">uav/1</text>") == page.count(">uav/2</text>") >= 1
    assert run_sitl(monkeypatch, capsys, "draw", str(recorded), "--out", str(tmp_path / "two.png"))[0] == 0


def test_viewers_find_each_vehicle_in_a_record_and_once_what_they_share(recorded: Path) -> None:
    with recorded.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        topics = {channel.topic for channel in summary.channels.values()}
    own = {f"scene/{name}" for name in ("vehicle", "path", "readings", "waypoint", "transforms", "state")}
    shared = {f"scene/{name}" for name in ("particles", "estimate", "area", "plume", "source")}
    assert own | shared <= topics
    assert {f"uav/2/{topic}" for topic in own} <= topics
    assert not {f"uav/2/{topic}" for topic in shared} & topics


def test_a_record_tells_of_each_vehicle_on_one_clock(recorded: Path) -> None:
    one, two = histories_of(read(recorded), "two")
    assert [one.backdrop.vehicle, two.backdrop.vehicle] == ["two uav/1", "two uav/2"]
    assert [len(each.measurements.values) for each in (one, two)] == [5, 5]
    for first, second in zip(one.measurements.values, two.measurements.values, strict=True):
        assert (first.estimate, first.time_s) == (second.estimate, second.time_s)
        assert first.position != second.position
        for history, measured in ((one, first), (two, second)):  # a vehicle is where it has read
            craft = history.at(measured.time_s).craft
            assert craft is not None
            assert math.dist(craft.position, measured.position) < 1.1


def test_the_page_of_a_record_has_each_vehicle_and_shows_the_search_once(recorded: Path) -> None:
    fleet = RecordedFleet([recorded, recorded])
    rows = [vehicle.entry() for vehicle in fleet.vehicles.values()]
    assert [(row["name"], row["search"]) for row in rows] == [
        *(("two uav/1", "two"), ("two uav/2", "two")),
        *(("two (2) uav/1", "two (2)"), ("two (2) uav/2", "two (2)")),
    ]
