"""Protects the fault campaign: a seed gives its faults, and the judge passes nothing that breaks a
promise.
"""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import msgspec
import pytest
from pymavlink.dialects.v20 import common as mavlink

from agent.trials.rollout import Step, mission
from benchmarks.chaos.faults import KINDS, LAST_STEP, MOST_FAULTS, Fault, is_split, plan
from benchmarks.chaos.judge import AS_UNDISTURBED, BROKEN, FAILSAFE, TOLD, Evidence, judge
from benchmarks.chaos.page import Row, page, table
from estimator.belief import stop
from link.bus.keys import BELIEF, MAVLINK_OUT, READING, STOP, WAYPOINT
from link.bus.mavlink import ONBOARD_COMPUTER, Codec, Reading, pack_reading, waypoint_message
from link.bus.messages import pack_particles
from link.record.record import Entry
from link.record.writer import Writer

SEED = 5
"""Its search takes 26 readings."""
GAVE_UP = (
    "error: the uav landed before the search was over; its last words: uav: warning: No setpoint for "
    "600 s: returning home\n"
)


@cache
def steps() -> tuple[tuple[Step, ...], list[dict], object]:
    """The mission in-process, its trace as `fly` prints it, and its stop."""
    flown = mission(SEED, "homing", 1000, 0.5, 300, assume="field")
    taken = tuple(flown.steps)
    said = [step.belief for step in taken]
    trace = [
        {"position": list(b.position), "reading": b.gas, "mean": list(b.mean), "spread": b.spread}
        for b in said
    ]
    return taken, trace, stop(said[-1], flown.config)


Change = Callable[[list[tuple[str, bytes, bytes]]], None]


def record(path: Path, change: Change | None = None, more: tuple[tuple[str, bytes, bytes], ...] = ()) -> Path:
    """Write the record of the mission, each reading taken at 1000 ms times its step; `change` edits its
    messages.
    """
    taken, _, said_stop = steps()
    vehicle, agent = Codec(1, 1), Codec(1, ONBOARD_COMPUTER)
    messages: list[tuple[str, bytes, bytes]] = []
    for number, (belief, cloud, *_) in enumerate(taken):
        at = 1000 * number + 1000
        reading = Reading(at, belief.position, belief.altitude_m, (1.0, 2.0), belief.gas)
        messages.append((READING.name, pack_reading(vehicle, reading), b""))
        if belief.ceased:
            messages.append(
                (STOP.name, msgspec.json.encode(msgspec.structs.replace(said_stop, time_boot_ms=at)), b"")
            )
        timed = msgspec.structs.replace(belief, time_boot_ms=at)
        messages.append((BELIEF.name, msgspec.json.encode(timed), pack_particles(cloud)))
        if not belief.ceased:
            towards = taken[number + 1].belief.position
            messages.append(
                (WAYPOINT.name, agent.pack(waypoint_message(1, at, towards, belief.altitude_m)), b"")
            )
    if change:
        change(messages)
    writer = Writer(path, {})
    for number, (key, payload, attachment) in enumerate((*messages, *more)):
        writer.write(Entry(key, 10**9 * number, 0.0, payload, attachment), 10**9 * number)
    writer.close()
    return path


def evidence(tmp_path: Path, change: Change | None = None, more: tuple = (), **fields: object) -> Evidence:
    """What an undisturbed mission leaves, with changes."""
    _, trace, _ = steps()
    usual = Evidence(
        seed=SEED,
        faults=(),
        done=(),
        status=0,
        out=(json.dumps({"ceased": True, "trace": trace}) + "\n",),
        err=("record run.mcap\n",),
        others={},
        statuses={},
        beside_s={},
        record=record(tmp_path / "run.mcap", change, more),
        left=(),
        wall_s=1.0,
    )
    return msgspec.structs.replace(usual, **fields)


def test_an_undisturbed_mission_passes(tmp_path: Path) -> None:
    verdict = judge(evidence(tmp_path))
    assert (verdict.outcome, verdict.reasons, verdict.steps) == (AS_UNDISTURBED, (), 25)


def test_repeated_messages_are_no_breach(tmp_path: Path) -> None:
    assert judge(evidence(tmp_path, lambda said: said.extend(said[:9]))).reasons == ()


def changed(at: int, key: str, payload: bytes) -> Change:
    """Replace a message of a key; `at` counts those of the key."""

    def change(said: list[tuple[str, bytes, bytes]]) -> None:
        index = [i for i, (name, *_) in enumerate(said) if name == key][at]
        said[index] = (key, payload, said[index][2])

    return change


def without(key: str, at: int) -> Change:
    def change(said: list[tuple[str, bytes, bytes]]) -> None:
        del said[[i for i, (name, *_) in enumerate(said) if name == key][at]]

    return change


ELSEWHERE = pack_reading(Codec(1, 1), Reading(5500, (1.0, 1.0), 5.0, (1.0, 2.0), 0.5))
WRONG_WAY = Codec(1, ONBOARD_COMPUTER).pack(waypoint_message(1, 4000, (1.0, 1.0), 5.0))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (without(READING.name, -1), "the record has 25 of 26 readings"),
        (without(READING.name, 4), "reading 4 is not that of the undisturbed mission"),
        (
            lambda said: said.append((READING.name, ELSEWHERE, b"")),
            "reading 5 is not that of the undisturbed mission",
        ),
        (changed(3, WAYPOINT.name, WRONG_WAY), "a waypoint of step 3 is not that of the undisturbed mission"),
    ],
    ids=["the last reading is lost", "a reading is lost", "a reading too many", "another waypoint"],
)
def test_a_record_of_another_flight_is_broken(tmp_path: Path, change: Change, reason: str) -> None:
    verdict = judge(evidence(tmp_path, change))
    assert verdict.outcome == BROKEN
    assert any(said.startswith(reason) for said in verdict.reasons), verdict.reasons


def test_a_record_may_lack_readings_where_that_is_told(tmp_path: Path) -> None:
    told = {
        "err": (
            "recorder: warning: 1 messages of reading are lost: no publisher has kept them\n",
            "record run.mcap\n",
        )
    }
    assert judge(evidence(tmp_path, without(READING.name, 4), **told)).reasons == ()
    verdict = judge(evidence(tmp_path, lambda said: said.append((READING.name, ELSEWHERE, b"")), **told))
    assert (
        verdict.reasons[0]
        == "reading 5 is not that of the undisturbed mission: a waypoint was lost or flown twice"
    )
    verdict = judge(evidence(tmp_path, changed(3, WAYPOINT.name, WRONG_WAY), **told))
    assert verdict.reasons == ("a waypoint of step 3 is not that of the undisturbed mission",)


def test_a_message_on_a_wrong_key_is_a_breach_unless_a_link_was_lost(tmp_path: Path) -> None:
    belief = msgspec.json.encode(steps()[0][3].belief)
    for key in (READING.name, STOP.name):
        stray = {"more": ((key, belief, b""),)}
        verdict = judge(evidence(tmp_path, **stray))
        assert verdict.outcome == BROKEN
        assert verdict.reasons[0].startswith(f"a message on {key} cannot be read: ")
        assert (
            judge(evidence(tmp_path, done=(Fault("unplug", 15, "uav", 1.5),), **stray)).outcome
            == AS_UNDISTURBED
        )


def test_a_trace_may_stand_on_readings_where_beliefs_were_lost_and_that_is_told(tmp_path: Path) -> None:
    trace = [dict(point) for point in steps()[1]]
    trace[4] |= {"mean": [None, None], "spread": None}
    out = {"out": (json.dumps({"ceased": True, "trace": trace}) + "\n",)}
    told = {
        "err": (
            "warning: 1 of 19 beliefs were not received: of these the trace has the readings\n",
            "record run.mcap\n",
        )
    }
    assert judge(evidence(tmp_path, **out, **told)).outcome == AS_UNDISTURBED
    assert judge(evidence(tmp_path, **out)).reasons == ("the trace differs from step 4 on",)
    trace[4] |= {"reading": 9.0}
    out = {"out": (json.dumps({"ceased": True, "trace": trace}) + "\n",)}
    assert judge(evidence(tmp_path, **out, **told)).reasons == ("the trace differs from step 4 on",)


def test_who_cannot_join_over_a_bad_link_says_so(tmp_path: Path) -> None:
    said = {
        "status": 2,
        "err": ("error: --connect: no router at tcp/10.99.0.1:7447 (start one with: plumeward router)\n",),
    }
    nowhere = tmp_path / "nothing" / "run.mcap"
    bad_link = Fault("loss", -1, "uav", 0.0, 0.275)
    assert judge(evidence(tmp_path, done=(bad_link,), record=nowhere, **said)).outcome == TOLD
    assert judge(evidence(tmp_path, record=nowhere, **said)).outcome == BROKEN


def test_a_wrong_stop_and_another_belief_are_broken(tmp_path: Path) -> None:
    taken, _, said_stop = steps()
    wrong = msgspec.json.encode(msgspec.structs.replace(said_stop, time_boot_ms=19000, estimate=(1.0, 1.0)))
    assert judge(evidence(tmp_path, changed(0, STOP.name, wrong))).reasons == ("a wrong stop",)
    other = msgspec.json.encode(msgspec.structs.replace(taken[2].belief, mean=(1.0, 1.0)))
    assert judge(evidence(tmp_path, changed(2, BELIEF.name, other))).reasons == (
        "a belief of step 2 is not that of the undisturbed mission",
    )


def test_another_trace_is_broken(tmp_path: Path) -> None:
    _, trace, _ = steps()
    other = [dict(point) for point in trace]
    other[7]["spread"] += 1e-9
    verdict = judge(evidence(tmp_path, out=(json.dumps({"ceased": True, "trace": other}),)))
    assert verdict.reasons == ("the trace differs from step 7 on",)


def test_what_is_left_behind_is_broken(tmp_path: Path) -> None:
    assert judge(evidence(tmp_path, left=("process python -m agent",))).reasons == (
        "left: process python -m agent",
    )


def test_a_failsafe_needs_its_reason_on_record(tmp_path: Path) -> None:
    text = Codec(1, 1).pack(mavlink.MAVLink_statustext_message(4, b"No setpoint for 600 s: returning home"))
    end = {"status": 1, "err": (GAVE_UP,)}
    assert judge(evidence(tmp_path, more=((MAVLINK_OUT.name, text, b""),), **end)).outcome == FAILSAFE
    verdict = judge(evidence(tmp_path, **end))
    assert verdict.reasons == ("the reason of the failsafe is not on record",)


def test_a_failed_mission_must_name_a_part_that_a_fault_has_hit(tmp_path: Path) -> None:
    said = ("error: uav was killed by signal 9; its last words: none\n",)
    assert judge(evidence(tmp_path, status=1, err=said, done=(Fault("kill", 3, "uav"),))).outcome == TOLD
    assert (
        judge(evidence(tmp_path, status=1, err=said, done=(Fault("kill", 3, "station"),))).outcome == BROKEN
    )
    silent = ("error: the agent has said nothing for 30 s (--patience S waits longer)\n",)
    assert (
        judge(evidence(tmp_path, status=1, err=silent, done=(Fault("hang", 3, "agent", 20.0),))).outcome
        == TOLD
    )
    assert (
        judge(evidence(tmp_path, status=1, err=silent, done=(Fault("deaf", 3),)))
        .reasons[0]
        .startswith("a part hangs by itself")
    )


def test_a_mission_that_does_not_end_is_broken(tmp_path: Path) -> None:
    assert judge(evidence(tmp_path, status=None)).outcome == BROKEN


def test_a_second_service_that_is_not_refused_is_broken(tmp_path: Path) -> None:
    done = (Fault("second", 3, "agent"),)
    refused = {"second agent": ("error: another agent is already on uav/1\n",)}
    assert judge(evidence(tmp_path, done=done, others=refused, statuses={"second agent": 2})).reasons == ()
    served = {"second agent": ("ready: random\n",)}
    long, short = (
        {"statuses": {"second agent": 130}, "beside_s": {"second agent": beside_s}} for beside_s in (5.1, 4.9)
    )
    assert judge(evidence(tmp_path, done=done, others=served, **long)).outcome == BROKEN
    assert (
        judge(evidence(tmp_path, done=done, others=served, **short)).reasons == ()
    )  # the mission ended while it started


def test_a_seed_gives_its_faults_and_two_hundred_give_every_kind_and_part() -> None:
    plans = [plan(seed) for seed in range(200)]
    assert plans == [plan(seed) for seed in range(200)]
    faults = [fault for faults in plans for fault in faults]
    hit = {(fault.kind, fault.part) for fault in faults}
    assert hit == {(name, part) for name, kind in KINDS.items() for part in kind.parts or ("",)}
    assert {len(faults) for faults in plans} == set(range(1, MOST_FAULTS + 1))
    for fault in faults:
        kind = KINDS[fault.kind]
        assert kind.for_s[0] <= fault.for_s <= kind.for_s[1]
        assert kind.amount[0] <= abs(fault.amount) <= kind.amount[1]
        assert fault.step == -1 if kind.from_start else 0 <= fault.step <= LAST_STEP


def test_a_mission_has_one_lossy_link_at_most_and_no_relay_beside_it() -> None:
    for seed in range(200):
        kinds = [fault.kind for fault in plan(seed)]
        assert sum(KINDS[kind].split for kind in kinds) <= 1
        assert not (is_split(plan(seed)) and "cut" in kinds)
        assert len(set(kinds)) == len(kinds)


@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_that_is_asked_for_is_the_only_one(kind: str) -> None:
    assert [fault.kind for fault in plan(7, kind)] == [kind]


def test_the_table_counts_a_mission_in_the_row_of_each_fault_that_happened() -> None:
    rows = [
        Row(1, "", "hang uav at 3 2 s + deaf at 4", "hang uav;deaf", AS_UNDISTURBED, 20, 9.0),
        Row(2, "", "hang uav at 3 2 s", "hang uav", FAILSAFE, 20, 9.0),
        Row(3, "", "hang agent at 9 2 s", "", AS_UNDISTURBED, 8, 9.0),
    ]
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table(rows).splitlines()]
    lines = {line[0]: line for line in cells if line}
    assert [int(cell) for cell in lines["`hang`"][-5:]] == [2, 1, 1, 0, 0]
    assert {"uav 2", "agent 0"} <= set(lines["`hang`"][2].split(", "))
    assert [int(cell) for cell in lines["`deaf`"][-5:]] == [1, 1, 0, 0, 0]
    assert [int(cell) for cell in lines["all"][-5:]] == [3, 2, 1, 0, 0]


def test_the_prose_of_the_page_stays() -> None:
    text = "before\n<!-- campaign -->\nformer\n<!-- end -->\nafter\n"
    made = page(text, [])
    assert made.startswith("before\n<!-- campaign -->\n")
    assert made.endswith("<!-- end -->\nafter\n")
    assert "former" not in made
    with pytest.raises(ValueError, match="no lines <!-- campaign --> and <!-- end -->"):
        page("before\n", [])
