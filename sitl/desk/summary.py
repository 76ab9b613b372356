"""`plumeward log`: a summary of a log, or one of its keys as CSV."""

import argparse
import csv
import json
import math
import statistics
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from itertools import islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

from link import cli
from link.terminal import Column, printable, table, tell, width_of

if TYPE_CHECKING:
    from link.record.reader import Recording
    from link.record.record import Entry

PAUSE_S = 2.0
"""A longer silence of the whole bus is reported, s: telemetry comes every second."""
LISTED = 5
"""Number of items of a kind that are listed; the rest is counted."""
SHORTEST_KEY = 12
"""Characters of a key that a narrow terminal shows at least."""
LONGEST = 120
"""Longest description of an unreadable message, characters."""


class Row(NamedTuple):
    """One message of a table: publication time, simulation time and fields."""

    published_s: float
    simulation_s: float
    fields: dict[str, Any]


class KeyTable(NamedTuple):
    """The messages of one key, or of one type of MAVLink message."""

    name: str
    published_s: list[float]
    simulation_s: list[float]
    repeats: int | None
    """Number of repeated messages; None where repeats mean nothing."""


class Summary(NamedTuple):
    """The summary of a log."""

    head: list[str]
    tables: list[KeyTable]
    tail: list[str]
    fields: dict[str, Any]
    """The same as JSON fields."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.add_argument("log", metavar="LOG", type=Path, help="an .mcap written by a mission or `record`, or any autopilot's .tlog")
    output = parser.add_mutually_exclusive_group()
    output.add_argument(
        "--csv", metavar="KEY", help="print one key as CSV: belief, reading, health/uav, mavlink/out/ATTITUDE; for a .tlog ATTITUDE"
    )
    output.add_argument("--json", action="store_true", help="print the summary as one JSON object on the last line of stdout")


def run(args: argparse.Namespace) -> int:
    """Print the summary or the CSV; returns the exit status: 1 if pieces of the log are missing."""
    from link.record.reader import RecordError, read
    from sitl.replay.source import BadSource, is_recording
    from sitl.tlog.sender import FlightError

    missing = ""
    try:
        if is_recording(args.log):
            recording = read(args.log)
            missing = f"{args.log} {recording.shortcoming}" if recording.damage else ""
            summary, rows = _summary(args.log, recording), _rows(recording.entries, args.csv) if args.csv else []
        else:
            summary, rows = _of_tlog(args.log, args.csv)
    except (RecordError, FlightError, BadSource, _NoSuchKey) as error:
        print(f"error: {error}", file=sys.stderr)
        return cli.BAD_INPUT
    status = cli.FAILED if missing else 0
    if args.csv:
        if missing:
            print(f"warning: {missing}", file=sys.stderr)
        _print_csv(rows)
        return status
    _print(summary, sys.stderr if args.json else sys.stdout)
    if args.json:
        print(json.dumps(summary.fields))
    return status


class _NoSuchKey(ValueError):
    """The log lacks the key asked for; the message is one line."""


# ---- records of the bus ----


def _summary(path: Path, recording: "Recording") -> Summary:
    entries = recording.entries
    tables = [_table(key, [entry for entry in entries if entry.key == key]) for key in sorted({entry.key for entry in entries})]
    said, unreadable = _read_json(entries)
    beliefs = _by_step(said)
    outcome, lines = _outcome(recording.about, beliefs)
    if not beliefs and any(entry.key == "belief" for entry in entries):
        lines = ["no readable belief: the outcome of the search is unknown"]
    gaps = _gaps(entries, beliefs) + _restarts(said) + unreadable
    began = recording.about.get("began", "unknown")
    policy, seed = recording.about.get("policy"), recording.about.get("seed")
    mission = f"{policy}, seed {seed}" if policy is not None else "mission unknown"
    title, versions = _object(recording.about, "mission").get("about"), _object(recording.about, "versions")
    commit, _, dirty = str(recording.about.get("git") or "").partition("-")
    revision = commit[:12] + (f", {dirty}" if dirty else "")
    stopped = recording.about.get("stopped")
    wall_s, simulation_s = _span([entry.published_ns / 1e9 for entry in entries]), _span([entry.simulation_s for entry in entries])
    whole = "complete" if recording.complete else "DAMAGED" if recording.damage else f"CUT OFF{f': {stopped}' if stopped else ''}"
    flown_with = f"plumeward {versions.get('plumeward', 'unknown')}{f' ({revision})' if revision else ''}"
    head = [
        str(path),
        f"{f'{title}, ' if title else ''}{mission}, begun {began}",
        f"{len(entries):,} messages in {wall_s:.1f} s, {simulation_s:.1f} s of simulation; {whole}",
        flown_with,
        *([f"it {recording.shortcoming}"] if recording.damage else []),
    ]
    fields = {
        "log": str(path), "complete": recording.complete, "damage": [place._asdict() for place in recording.damage],
        "messages": len(entries), "duration_s": wall_s, "simulation_s": simulation_s,
        "keys": {table.name: {"messages": len(table.published_s), "repeats": table.repeats} for table in tables},
        "beliefs": len(beliefs), "gaps": gaps, **outcome,
    }  # fmt: skip
    return Summary([printable(line) for line in head], tables, [*(gaps or ["gaps: none"]), *lines], fields)


def _table(key: str, entries: "Sequence[Entry]") -> KeyTable:
    named = [repr((entry.simulation_s, entry.payload)) for entry in entries]
    telling = key in ("reading", "belief", "agdc/stop")
    repeats = len(named) - len(set(named)) if telling else None
    return KeyTable(key, [entry.published_ns / 1e9 for entry in entries], [entry.simulation_s for entry in entries], repeats)


def _span(times: Sequence[float]) -> float:
    return max(times) - min(times) if times else 0.0


def _object(about: dict[str, Any], name: str) -> dict[str, Any]:
    """The object under a name in the log's own description; empty if there is none."""
    value = about.get(name)
    return value if isinstance(value, dict) else {}


class Statement(NamedTuple):
    """A readable JSON message."""

    key: str
    message: Any


def _read_json(entries: "Sequence[Entry]") -> tuple[list[Statement], list[str]]:
    """Return the readable JSON messages, and one line for each kind of unreadable ones (not JSON, or of another version)."""
    import msgspec

    from link.bus.messages import Belief, Stop

    class Alive(msgspec.Struct):
        """The fields used of a health message."""

        uptime_s: float

    said: list[Statement] = []
    reasons: dict[str, list[str]] = defaultdict(list)
    for entry in entries:
        for prefix, name, kind in (("belief", "belief", Belief), ("agdc/stop", "stop", Stop), ("health/", "health message", Alive)):
            if entry.key.startswith(prefix):
                try:
                    said.append(Statement(entry.key, msgspec.json.decode(entry.payload, type=kind)))
                except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                    reasons[name].append(_line(str(error)))
    return said, [
        f"{len(told)} {name}{'s' * (len(told) > 1)} could not be read: {_few(list(dict.fromkeys(told)))}" for name, told in reasons.items()
    ]


def _line(text: str) -> str:
    """Return an error text that may quote a message, made safe for a terminal."""
    plain = printable(text)
    return plain if len(plain) <= LONGEST else f"{plain[:LONGEST]} ..."


def _by_step(said: Sequence[Statement]) -> dict[int, Any]:
    """Return the first belief of each step, in order."""
    beliefs: dict[int, Any] = {}
    for key, message in said:
        if key == "belief":
            beliefs.setdefault(message.step, message)
    return dict(sorted(beliefs.items()))


def _outcome(about: dict[str, Any], beliefs: dict[int, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the outcome as fields and lines; compared with the true source if the log has it."""
    import msgspec

    from plume.outcome import TracePoint, assumed_text, outcome, outcome_text
    from plume.scenario import Scenario
    from plume.worlds import AS_MODELLED

    if not beliefs:
        return {"ceased": None}, ["no belief: there was no search"]
    last = beliefs[max(beliefs)]
    estimate = f"estimate ({last.mean[0]:.2f}, {last.mean[1]:.2f}) ± {last.spread:.2f} m"
    world = _object(about, "mission").get("world")
    world = world if isinstance(world, str) else AS_MODELLED  # records of other versions may lack it
    plain = {
        "ceased": last.ceased, "estimate": last.mean, "spread_m": last.spread, "steps": last.step, "assume": last.assume, "stop": last.stop,
        "world": world,
    }  # fmt: skip
    try:
        scenario = msgspec.convert(about["scenario"], Scenario)
    except (KeyError, msgspec.ValidationError):
        verdict = f"{'ceased' if last.ceased else 'not ceased'} after {last.step} steps"
        return plain, [verdict, estimate, assumed_text(last.assume, last.stop, world)]
    trace = [TracePoint(belief.position, belief.gas, belief.mean, belief.spread) for belief in beliefs.values()]
    result = outcome(0, "", scenario, trace, last.ceased, 0.0, last.assume, last.stop, world)  # no seed, policy, search time
    told = {**plain, "located": result.located, "error_m": result.error_m, "distance_m": result.distance_m, "source": result.source}
    return told, outcome_text(result).splitlines()


def _gaps(entries: "Sequence[Entry]", beliefs: dict[int, Any]) -> list[str]:
    """Return a line for each kind of gap: unanswered readings, missing steps, pauses."""
    lines = []
    answered = {belief.time_boot_ms for belief in beliefs.values()}
    asked = {round(entry.simulation_s * 1000) for entry in entries if entry.key == "reading"}
    if unanswered := sorted(asked - answered):
        times = [f"{time_boot_ms / 1000:.2f} s" for time_boot_ms in unanswered]
        lines.append(f"{len(unanswered)} readings without a belief, at {_few(times)} of simulation")
    if missing := max(beliefs, default=-1) + 1 - len(beliefs):  # counted, not listed: a foreign message may have any step
        steps = (str(step) for before, after in pairwise([-1, *beliefs]) for step in range(before + 1, after))
        lines.append(f"{missing} beliefs missing, of step {_few(list(islice(steps, LISTED)), missing)}")
    published_s = sorted(entry.published_ns / 1e9 for entry in entries)
    pauses = [
        f"{after - before:.1f} s at {before - published_s[0]:.1f} s" for before, after in pairwise(published_s) if after - before > PAUSE_S
    ]
    if pauses:
        lines.append(f"{len(pauses)} pauses of the whole bus: {_few(pauses)}")
    return lines


def _restarts(said: Sequence[Statement]) -> list[str]:
    """Return a line for each service that was restarted: its uptime went back."""
    up_s: dict[str, float] = {}
    restarts: Counter[str] = Counter()
    for key, message in said:
        if key.startswith("health/"):
            restarts[key.removeprefix("health/")] += message.uptime_s < up_s.get(key, -math.inf)
            up_s[key] = message.uptime_s
    return [f"{service} was restarted {count} time{'s' * (count > 1)}" for service, count in sorted(restarts.items()) if count]


def _few(texts: Sequence[str], count: int = 0) -> str:
    """Return the first few texts as a list and the number of the others; `count` is their total if not all are given."""
    more = max(len(texts), count) - LISTED
    return ", ".join(texts[:LISTED]) + (f" and {more:,} more" if more > 0 else "")


def _rows(entries: "Sequence[Entry]", name: str) -> list[Row]:
    """Return a key's messages with their fields; raises _NoSuchKey that lists the keys."""
    tables: dict[str, list[Row]] = defaultdict(list)
    for entry in entries:
        for key, fields in _decoded(entry):
            tables[key].append(Row(entry.published_ns / 1e9, entry.simulation_s, fields))
    if name not in tables:
        raise _NoSuchKey(f"--csv: {name!r} is not allowed; wanted one of {', '.join(sorted(tables)) or 'nothing: the log is empty'}")
    return tables[name]


def _decoded(entry: "Entry") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield (export name, fields) of a message; nothing for a message that breaks the bus contract."""
    from link.bus.mavlink import BadFrame, flat_reading
    from link.record.decoded import decode

    if entry.key in ("reading", "mavlink/out", "mavlink/in"):
        try:
            messages = decode(entry.payload)
        except BadFrame:
            return
        if entry.key == "reading":
            fields = {message.kind: json.loads(message.fields) for message in messages}
            yield "reading", flat_reading(fields)
        else:
            yield from ((f"{entry.key}/{message.kind}", json.loads(message.fields)) for message in messages)
        return
    try:
        fields = json.loads(entry.payload)
    except (ValueError, RecursionError):
        return
    if isinstance(fields, dict):
        yield entry.key, fields


# ---- logs of autopilots ----


def _of_tlog(path: Path, name: str | None) -> tuple[Summary, list[Row]]:
    """Return a summary of a .tlog by message type and, with a name, the rows of that type."""
    from pymavlink.dialects.v20 import all as mavlink

    from sitl.tlog.flight import open_log

    log, notes = open_log(path)
    kinds = {message_id: message.msgname for message_id, message in mavlink.mavlink_map.items()}
    seconds: dict[str, list[float]] = defaultdict(list)
    for index, message_id in enumerate(log.records.message_ids.tolist()):
        seconds[kinds.get(message_id, f"unknown {message_id}")].append(log.seconds(index))
    tables = [KeyTable(kind, times, [], None) for kind, times in sorted(seconds.items())]
    span_s = _span([time for times in seconds.values() for time in times])
    senders = ", ".join(f"{system}/{component}" for system, component in sorted(log.senders()))
    head = [f"{path}: MAVLink of system/component {senders}", f"{len(log):,} messages in {span_s:.1f} s"]
    counts = {table.name: {"messages": len(table.published_s)} for table in tables}
    summary = Summary(head, tables, notes, {"log": str(path), "messages": len(log), "duration_s": span_s, "keys": counts, "notes": notes})
    if name is None:
        return summary, []
    if name not in set(kinds.values()) & set(seconds):
        raise _NoSuchKey(f"--csv: {name!r} is not allowed; wanted one of {', '.join(sorted(set(kinds.values()) & set(seconds)))}")
    chosen = log.select(None, [message_id for message_id, kind in kinds.items() if kind == name])
    rows = []
    for index, message in log.messages(chosen):
        fields = message.to_dict()
        del fields["mavpackettype"]
        rows.append(Row(float(log.times_us[index]) / 1e6, math.nan, {**fields, "system": message.get_srcSystem()}))
    return summary, rows


# ---- printing ----


def _print(summary: Summary, stream: TextIO) -> None:
    tables = summary.tables
    pauses = [[after - before for before, after in pairwise(sorted(it.published_s))] for it in tables]
    columns = [
        Column("key", [it.name for it in tables], left=True, least=SHORTEST_KEY, keeps_end=True),
        Column("messages", [f"{len(it.published_s):,}" for it in tables]),
        Column("per s", [_rate(it.published_s) for it in tables], rank=2),
        Column("per simulated s", [_rate(it.simulation_s) for it in tables], rank=3),
        Column("repeats", ["" if it.repeats is None else str(it.repeats) for it in tables], rank=4),
        Column("longest pause, s", [f"{max(each):.2f}" if each else "" for each in pauses], rank=1),
    ]
    told = [column for column in columns if any(column.cells) or column.rank < 3]
    for line in summary.head:
        tell(line, stream)
    tell(table(told, width_of(stream), "--json", below=summary.tail), stream)


def _rate(times: Sequence[float]) -> str:
    """Messages per second: one over the mean time between two."""
    steps = [after - before for before, after in pairwise(sorted(times))]
    mean_s = statistics.fmean(steps) if steps else 0.0
    return f"{1 / mean_s:,.2f}" if mean_s > 0 else ""


def _print_csv(rows: Sequence[Row]) -> None:
    flat = [
        {"published_s": repr(row.published_s), "simulation_s": _cell(row.simulation_s), **dict(_flattened("", row.fields))} for row in rows
    ]
    names = list(dict.fromkeys(name for row in flat for name in row))
    writer = csv.DictWriter(sys.stdout, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)


def _flattened(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the values within lists and objects with their names: mean[0], refused.late."""
    if isinstance(value, dict):
        for field, inner in value.items():
            yield from _flattened(f"{name}.{field}" if name else field, inner)
    elif isinstance(value, list | tuple):
        for number, inner in enumerate(value):
            yield from _flattened(f"{name}[{number}]", inner)
    else:
        yield name, _cell(value)


def _cell(value: Any) -> Any:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    return repr(value) if isinstance(value, float) else value
