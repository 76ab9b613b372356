"""`plumeward log`: a summary of a log, or one of its keys as CSV."""

import argparse
import csv
import json
import math
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import msgspec

from ground.desk.survey import KeyTable, Survey
from ground.tlog.log import NAMES, FlightLog, open_log
from link import cli
from link.bus.keys import row_name
from link.bus.mavlink import BadFrame
from link.record.decoded import decode, decode_reading
from link.record.reader import LogFile, RecordError, is_record
from link.record.record import Entry, has_frames
from link.terminal import Column, printable, table, tell, width_of
from plume.outcome import Left, assumed_text, gas_lines, outcome, outcome_text, outside_text, verdict
from plume.scenario import AS_MODELLED, Scenario
from scene.follow.described import problem_of

SHORTEST_KEY = 12  # characters of a key that a narrow terminal shows at least


Row = dict[str, Any]  # of a table: its cells by the names of their columns
Messages = Iterator[tuple[str, Callable[[], Row]]]  # by their keys, with what makes their rows


class Summary(NamedTuple):
    """The summary of a log."""

    head: list[str]
    tables: list[KeyTable]
    tail: list[str]
    fields: dict[str, Any]  # the same as JSON fields


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.add_argument(
        "log",
        metavar="LOG",
        type=cli.path,
        help="an .mcap written by a mission or `record`, or any autopilot's .tlog, .bin or .ulg",
    )
    output = parser.add_mutually_exclusive_group()
    output.add_argument(
        "--csv",
        metavar="KEY",
        help="print one key as CSV: belief, reading, health/uav, mavlink/out/ATTITUDE; for a .tlog ATTITUDE",
    )
    output.add_argument(
        "--json", action="store_true", help="print the summary as one JSON object on the last line of stdout"
    )


def run(args: argparse.Namespace) -> int:
    """Print the summary or the CSV; returns the exit status: 1 if pieces of the log are missing.

    Raises BadInput.
    """
    missing = ""
    try:
        if is_record(args.log):
            log = LogFile(args.log)
            if args.csv:
                names, rows = _table(_of_record(log), _of_record(LogFile(args.log), args.csv), args.csv)
            else:
                summary = _summary(args.log, log, Survey(log))
            missing = f"{args.log} {log.shortcoming}" if log.damage else ""
        else:
            flown = open_log(args.log)
            if args.csv:
                names, rows = _table(_of_flight(flown), _of_flight(flown), args.csv)
            else:
                summary = _summary_of_flight(args.log, flown)
    except RecordError as error:
        raise cli.BadInput(str(error)) from None
    if args.csv:
        if missing:
            print(f"warning: {missing}", file=sys.stderr)
        # Columns are left out that came since they were listed: the log may still be written.
        writer = csv.DictWriter(sys.stdout, names, restval="", extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    else:
        _print(summary, sys.stderr if args.json else sys.stdout)
    if args.json:
        print(json.dumps(summary.fields))
    return cli.FAILED if missing else 0


# ---- records of the bus ----


def _summary(path: Path, log: LogFile, survey: Survey) -> Summary:
    tables = survey.tables
    ending, lines = _outcome(log.about, survey, bool(log.shortcoming))
    gaps = survey.gaps() + survey.unreadable
    policy = log.about.get("policy")
    mission = f"{policy}, seed {log.about.get('seed')}" if policy is not None else "mission unknown"
    title, versions = _object(log.about, "mission").get("about"), _object(log.about, "versions")
    commit, _, dirty = str(log.about.get("git") or "").partition("-")
    revision = commit[:12] + (f", {dirty}" if dirty else "")
    stopped = log.about.get("stopped")
    count = sum(len(table.published_s) for table in tables)
    wall_s, simulation_s = _span(it.published_s for it in tables), _span(it.simulation_s for it in tables)
    whole = "DAMAGED" if log.damage else "complete" if log.complete else "CUT OFF"
    if whole == "CUT OFF" and stopped:
        whole += f": {stopped}"
    flown_with = f"plumeward {versions.get('plumeward', 'unknown')}{f' ({revision})' if revision else ''}"
    head = [
        str(path),
        f"{f'{title}, ' if title else ''}{mission}, begun {log.about.get('began', 'unknown')}",
        f"{count:,} messages in {wall_s:.1f} s, {simulation_s:.1f} s of simulation; {whole}",
        flown_with,
        *([f"it {log.shortcoming}"] if log.damage else []),
    ]
    fields = {
        "log": str(path),
        "complete": log.complete,
        "damage": [place._asdict() for place in log.damage],
        "messages": count,
        "duration_s": wall_s,
        "simulation_s": simulation_s,
        "keys": {
            table.name: {"messages": len(table.published_s), "repeats": table.repeats} for table in tables
        },
        "beliefs": len(survey.trace),
        "gaps": gaps,
        **ending,
    }
    return Summary([printable(line) for line in head], tables, [*(gaps or ["gaps: none"]), *lines], fields)


def _span(times: Iterable[Sequence[float]]) -> float:
    """Return the time between the first and the last of all."""
    some = [each for each in times if each]
    return max(map(max, some)) - min(map(min, some)) if some else 0.0


def _object(about: dict[str, Any], name: str) -> dict[str, Any]:
    """The object under a name in the log's own description; empty if there is none."""
    value = about.get(name)
    return value if isinstance(value, dict) else {}


def _outcome(about: dict[str, Any], survey: Survey, cut: bool) -> tuple[dict[str, Any], list[str]]:
    """Return the outcome as fields and lines; compared with the true source if the log has it."""
    last = survey.last
    if last is None:
        unread = "no readable belief: the outcome of the search is unknown"
        none = f"no belief: {'the log is cut off before the first' if cut else 'there was no search'}"
        return {"ceased": None}, [unread if "belief" in survey.published_s else none]
    estimate = f"estimate ({last.mean[0]:.2f}, {last.mean[1]:.2f}) ± {last.spread:.2f} m"
    area, world = problem_of(about).area, _object(about, "mission").get("world")
    world = world if isinstance(world, str) else AS_MODELLED  # records of other versions may lack it
    plain = {
        "ceased": last.ceased,
        "estimate": last.mean,
        "spread_m": last.spread,
        "steps": last.step,
        "assume": last.assume,
        "stop": last.stop,
        "world": world,
        "outside_share": last.outside,
        "intermittency": last.intermittency,
        "advised_dwell_s": last.advised_dwell or None,
    }
    left = [Left(each.vehicle, each.step, each.reason, each.forgotten) for each in survey.left.values()]
    if left:
        plain["left"] = msgspec.to_builtins(left)
    if survey.joined:
        plain["joined"] = [{"vehicle": each, "step": step} for each, step in survey.joined.items()]
    if survey.doubted:
        plain["doubted"] = [{"vehicle": each, "step": step} for each, step in survey.doubted.items()]
    try:
        scenario = msgspec.convert(about["scenario"], Scenario)
    except (KeyError, msgspec.ValidationError):
        ended = verdict(last.ceased, last.mean, None, last.outside, area)
        if ended == "outside":
            ended = f"{outside_text(last.outside, area.beyond(last.mean))},"
        lines = [f"{ended} after {last.step} steps", estimate]
        gas = gas_lines(last.intermittency, last.advised_dwell)
        return plain, [*lines, assumed_text(last.assume, last.stop, world), *gas]
    trace = [point for _, points in sorted(survey.trace.items()) for point in points]
    # It has no seed, policy and search time.
    result = outcome(
        0,
        "",
        scenario,
        trace,
        last.ceased,
        0.0,
        last.assume,
        last.stop,
        world,
        last.outside,
        area,
        intermittency=last.intermittency,
        advised_dwell_s=last.advised_dwell,
        left=left,
        doubted=survey.doubted,
        joined=survey.joined,
    )
    judged = {
        "located": result.located,
        "outside": result.outside,
        "error_m": result.error_m,
        "distance_m": result.distance_m,
        "source": result.source,
    }
    return plain | judged, outcome_text(result).splitlines()


def _of_record(entries: Iterable[Entry], only: str = "") -> Messages:
    """Yield the messages of a record; `only` leaves out what cannot be of this key."""
    for entry in entries:
        if only.startswith(entry.key) or not only:
            for key, fields in _decoded(entry):
                yield key, partial(_row, entry.published_ns / 1e9, entry.simulation_s, fields)


def _decoded(entry: Entry) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield (export name, fields) of a message; nothing for a message that breaks the bus contract."""
    with suppress(BadFrame, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        if row_name(entry.key) == "reading":
            yield entry.key, msgspec.structs.asdict(decode_reading(entry.payload))
        elif has_frames(entry.key):
            for kind, fields in decode(entry.payload):
                yield f"{entry.key}/{kind}", json.loads(fields)
        else:
            yield entry.key, msgspec.json.decode(entry.payload, type=dict[str, Any])


# ---- logs of autopilots ----


def _summary_of_flight(path: Path, log: FlightLog) -> Summary:
    seconds: dict[str, list[float]] = defaultdict(list)
    for index, message_id in enumerate(log.records.message_ids.tolist()):
        seconds[NAMES.get(message_id, f"unknown {message_id}")].append(log.seconds(index))
    tables = [KeyTable(kind, times, [], None) for kind, times in sorted(seconds.items())]
    span_s = _span(seconds.values())
    senders = ", ".join(f"{system}/{component}" for system, component in sorted(log.senders()))
    head = [f"{path}: MAVLink of system/component {senders}", f"{len(log):,} messages in {span_s:.1f} s"]
    fields = {
        "log": str(path),
        "messages": len(log),
        "duration_s": span_s,
        "keys": {table.name: {"messages": len(table.published_s)} for table in tables},
        "notes": log.notes,
    }
    return Summary(head, tables, log.notes, fields)


def _of_flight(log: FlightLog) -> Messages:
    for index, message_id in enumerate(log.records.message_ids.tolist()):
        if message_id in NAMES:
            yield NAMES[message_id], partial(_row_of_flight, log, index)


def _row_of_flight(log: FlightLog, index: int) -> Row:
    message = log.message(index)
    fields = {name: getattr(message, name) for name in message.get_fieldnames()}
    return _row(float(log.times_us[index]) / 1e6, math.nan, {**fields, "system": message.get_srcSystem()})


# ---- one table as CSV ----


def _table(first: Messages, again: Messages, name: str) -> tuple[list[str], Iterator[Row]]:
    """Return the columns and the rows of a key, from two ways through the log: the rows are not kept.

    Raises BadInput that lists the keys.
    """
    columns: dict[str, Any] = {}
    keys = set()
    for key, row in first:
        keys.add(key)
        if key == name:
            columns |= row()
    if name not in keys:
        known = ", ".join(sorted(keys)) or "nothing: the log is empty"
        raise cli.BadInput(f"--csv: {name!r} is not allowed; wanted one of {known}")
    return list(columns), (row() for key, row in again if key == name)


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
    span_s = _span([times])
    return f"{(len(times) - 1) / span_s:,.2f}" if span_s > 0 else ""


def _row(published_s: float, simulation_s: float, fields: dict[str, Any]) -> Row:
    """Return the row of a message: its times, and the values within its fields."""
    times = {"published_s": repr(published_s), "simulation_s": _cell(simulation_s)}
    return times | dict(_flattened("", fields))


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
