"""Decides from the evidence of a mission whether every promise was kept."""

import itertools
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from agent.trials.rollout import rollout
from benchmarks.chaos.faults import Fault
from link.bus.keys import BELIEF, MAVLINK_OUT, READING, STOP, WAYPOINT
from link.bus.mavlink import BadFrame, unpack, unpack_reading
from link.bus.messages import Belief, Stop
from link.record.reader import RecordError, read
from plume.outcome import TracePoint

AS_UNDISTURBED, FAILSAFE, TOLD, BROKEN = "as undisturbed", "failsafe", "failed, told", "broken"
OUTCOMES = (AS_UNDISTURBED, FAILSAFE, TOLD, BROKEN)
GAVE_UP = "the uav landed before the search was over; its last words: "
START_S = 5.0
"""A second service that ran for less beside the mission, on a core of its own, may not have joined before
the mission's end.
"""
REASON = "No setpoint for "
"""What the vehicle says before it returns home for want of waypoints."""
SILENT = " has said nothing for "
LACKS = (
    "warning: the record lacks the last readings",
    "warning: the recorder hangs and is killed",
    "messages of reading are lost",
)
"""What launcher and recorder say of a record that lacks readings: the flight has priority over its record.
"""
MISSED = "beliefs were not received: of these the trace has the readings"
"""What the launcher says of beliefs that a link dropped."""
UNREACHED = "error: --connect: no router at "
"""What a part says that cannot join: over a link that drops packets this may take longer than its
patience. Then nothing flies.
"""


class Evidence(msgspec.Struct, frozen=True):
    """What a mission has left."""

    seed: int
    faults: tuple[Fault, ...]
    done: tuple[Fault, ...]
    """Those that happened; the search may be over before a fault's step."""
    status: int | None
    """The launcher's exit status; None: it did not end."""
    out: tuple[str, ...]
    err: tuple[str, ...]
    others: Mapping[str, tuple[str, ...]]
    """What the parts wrote that the launcher did not start, by part."""
    statuses: Mapping[str, int]
    beside_s: Mapping[str, float]
    """How long they ran beside the mission, by part."""
    record: Path
    left: tuple[str, ...]
    """Processes, sockets and shared memory that are still there."""
    wall_s: float


class Verdict(msgspec.Struct, frozen=True):
    """The judgement."""

    seed: int
    outcome: str
    """One of OUTCOMES."""
    reasons: tuple[str, ...]
    """What is broken."""
    done: tuple[Fault, ...]
    steps: int
    wall_s: float
    said: tuple[str, ...] = ()
    """The launcher's last lines, where something is broken or failed."""


def judge(evidence: Evidence) -> Verdict:
    """Judge a mission by the same mission flown in-process."""
    outcome, trace = rollout(evidence.seed)
    reasons = [f"left: {each}" for each in evidence.left]
    ended, broken = _ended(evidence, trace, outcome.ceased)
    reasons += broken
    reasons += _second(evidence)
    reasons += _record(evidence, trace, outcome.ceased, ended)
    said = () if ended == AS_UNDISTURBED and not reasons else evidence.err[-6:]
    return Verdict(
        evidence.seed,
        BROKEN if reasons else ended,
        tuple(reasons),
        evidence.done,
        len(trace) - 1,
        evidence.wall_s,
        tuple(said),
    )


def hit(evidence: Evidence, kind: str) -> set[str]:
    """Return the parts that faults of a kind hit."""
    return {fault.part for fault in evidence.done if fault.kind == kind}


def _ended(evidence: Evidence, trace: list[TracePoint], ceased: bool) -> tuple[str, list[str]]:
    """Return how the mission ended, and what is wrong with that."""
    last = evidence.err[-1].strip() if evidence.err else ""
    killed = hit(evidence, "kill")
    if evidence.status == 0:
        flown = json.loads(evidence.out[-1])
        wanted = json.loads(json.dumps(msgspec.to_builtins(trace)))
        if any(MISSED in line for line in evidence.err):
            for one, other in zip(flown["trace"], wanted, strict=False):
                if one["spread"] is None:  # its belief did not come: the reading stands alone
                    other |= {"mean": [None, None], "spread": None}
        if flown["trace"] != wanted or flown["ceased"] != ceased:
            at = next(
                (
                    i
                    for i, (one, other) in enumerate(zip(flown["trace"], wanted, strict=False))
                    if one != other
                ),
                len(wanted),
            )
            return BROKEN, [f"the trace differs from step {at} on"]
        return AS_UNDISTURBED, []
    if evidence.status == -9 and "launcher" in killed:
        return TOLD, []
    if last.startswith(UNREACHED) and hit(evidence, "loss"):
        return TOLD, []
    if GAVE_UP in last:
        return FAILSAFE, [] if REASON in last else [f"it landed for no documented reason: {last}"]
    if any(f"error: {part} was killed by signal 9" in last for part in killed):
        return TOLD, []
    if SILENT in last and last.startswith("error: the "):
        part = last.split()[2]
        silenced = hit(evidence, "hang") | hit(evidence, "unplug") | hit(evidence, "cut")
        return TOLD, [] if part in silenced or "router" in silenced or hit(evidence, "loss") else [
            f"a part hangs by itself: {last}"
        ]
    return BROKEN, [f"status {evidence.status}: {last or 'no last words'}"]


def _second(evidence: Evidence) -> list[str]:
    """A second service is refused in one line, unless the mission ended while it started."""
    wrong = []
    for part in hit(evidence, "second"):
        said, status = evidence.others[f"second {part}"], evidence.statuses[f"second {part}"]
        refused = f"error: another {part} is already on uav/1"
        too_late = status in (-15, 130) and evidence.beside_s[f"second {part}"] < START_S
        if not (status == 2 and said and said[-1].startswith(refused)) and not too_late:
            wrong.append(f"the second {part} was not refused: status {status}, {''.join(said[-2:])}")
    return wrong


def _record(evidence: Evidence, trace: list[TracePoint], ceased: bool, ended: str) -> list[str]:
    """Return what the record shows that must not be, and what it must show and lacks."""
    wounded = "recorder" in hit(evidence, "kill") | hit(evidence, "hang") or "launcher" in hit(
        evidence, "kill"
    )
    full = bool(hit(evidence, "disk"))
    unreached = ended == TOLD and any(line.startswith(UNREACHED) for line in evidence.err)
    try:
        recording = read(evidence.record)
    except RecordError as error:
        return [] if wounded or full or unreached else [f"record: {error}"]
    payloads: dict[str, list[bytes]] = {}
    wrong: list[str] = []
    link_lost = hit(evidence, "unplug") | hit(evidence, "loss") | hit(evidence, "cut") or "router" in hit(
        evidence, "kill"
    ) | hit(evidence, "hang")
    for entry in recording.entries:
        if reason := _unreadable(entry.key, entry.payload):
            wrong += [] if link_lost else [f"a message on {entry.key} cannot be read: {reason}"]
        else:
            payloads.setdefault(entry.key, []).append(entry.payload)
    told = any(words in line for words in LACKS for line in evidence.err)
    unlike, readings = _readings(payloads.get(READING.name, []), trace, gaps=told)
    wrong += unlike
    wrong += _beliefs(payloads.get(BELIEF.name, []), trace)
    wrong += _waypoints(payloads.get(WAYPOINT.name, []), readings, trace)
    wrong += _stops(payloads.get(STOP.name, []), trace, ceased)
    if wounded:
        return wrong
    if full and not recording.complete:
        return (
            wrong
            if any("recording stopped" in line for line in evidence.err)
            else [*wrong, "the full disk is not told"]
        )
    if not (recording.complete or told):
        wrong.append("the record is not complete")
    if ended == AS_UNDISTURBED and len(readings) != len(trace) and not told:
        wrong.append(f"the record has {len(readings)} of {len(trace)} readings")
    if ended == FAILSAFE and not any(REASON in text for text in _texts(payloads.get(MAVLINK_OUT.name, []))):
        wrong.append("the reason of the failsafe is not on record")
    return wrong


def _unreadable(key: str, payload: bytes) -> str:
    """Return why a message is not of its key's type; empty if it is, or if any is allowed.

    Where a link is lost and joined again, Zenoh may hand the last messages of the old one to a wrong key.
    All who receive refuse them.
    """
    try:
        if key == READING.name:
            unpack_reading(payload)
        elif key in (BELIEF.name, STOP.name):
            msgspec.json.decode(payload, type={BELIEF.name: Belief, STOP.name: Stop}[key])
    except (BadFrame, msgspec.DecodeError, UnicodeDecodeError) as error:
        return str(error)
    return ""


def _readings(
    payloads: list[bytes], trace: list[TracePoint], *, gaps: bool
) -> tuple[list[str], dict[int, int]]:
    """Each reading is taken once, where the undisturbed mission took it; returns their steps by time as
    well.

    gaps: the record may lack some, as it has told.
    """
    by_time: dict[int, bytes] = {}
    wrong = []
    for payload in payloads:
        time_boot_ms = unpack_reading(payload, 1).time_boot_ms
        if by_time.setdefault(time_boot_ms, payload) != payload:
            wrong.append(f"the reading of {time_boot_ms} ms was published with two contents")
    steps: dict[int, int] = {}
    step = 0
    for number, time_boot_ms in enumerate(sorted(by_time)):
        reading = unpack_reading(by_time[time_boot_ms], 1)
        while (
            gaps
            and step < len(trace)
            and (reading.position, reading.gas) != (trace[step].position, trace[step].reading)
        ):
            step += 1
        if step >= len(trace) or (reading.position, reading.gas) != (
            trace[step].position,
            trace[step].reading,
        ):
            return [
                *wrong,
                f"reading {number} is not that of the undisturbed mission: a waypoint was lost or flown "
                "twice",
            ], steps
        steps[time_boot_ms] = step
        step += 1
    return wrong, steps


def _beliefs(payloads: list[bytes], trace: list[TracePoint]) -> list[str]:
    for payload in payloads:
        said = msgspec.json.decode(payload, type=Belief)
        if (
            said.step >= len(trace)
            or TracePoint(said.position, said.gas, said.mean, said.spread) != trace[said.step]
        ):
            return [f"a belief of step {said.step} is not that of the undisturbed mission"]
    return []


def _waypoints(payloads: Iterable[bytes], steps: Mapping[int, int], trace: list[TracePoint]) -> list[str]:
    """Every answer to a reading leads where the undisturbed mission went."""
    wrong = []
    for message in itertools.chain.from_iterable(map(_messages, payloads)):
        step = (
            steps.get(message.time_boot_ms) if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED" else None
        )
        if step is not None and (
            step + 1 >= len(trace) or (message.y, message.x) != trace[step + 1].position
        ):
            wrong.append(f"a waypoint of step {step} is not that of the undisturbed mission")
    return wrong[:1]


def _stops(payloads: list[bytes], trace: list[TracePoint], ceased: bool) -> list[str]:
    stops = [msgspec.json.decode(payload, type=Stop) for payload in payloads]
    return ["a wrong stop"] if any(not ceased or stop.estimate != trace[-1].mean for stop in stops) else []


def _texts(payloads: list[bytes]) -> Iterable[str]:
    for message in itertools.chain.from_iterable(map(_messages, payloads)):
        if message.get_type() == "STATUSTEXT":
            yield message.text


def _messages(payload: bytes) -> list[Any]:
    try:
        return unpack(payload)
    except BadFrame:
        return []
