"""`python -m agent evaluate`: the figures of any policies over many missions, with a progress bar; interrupted, it goes on where it was."""

import argparse
import csv
import gzip
import json
import os
import sys
import zlib
from collections.abc import Sequence
from contextlib import closing
from itertools import groupby
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import msgspec
from rich.console import Console
from rich.table import Table

from agent.policies import add_policy_argument, bundle_path, reach
from agent.trials.figures import COLUMNS, MissionRow, cell, figures
from agent.trials.files import whole
from agent.trials.progress import progress_bar
from agent.trials.workers import WorkerLost
from estimator.options import add_sensor_argument
from link import cli
from plume.randomness import MAX_SEED
from plume.scenario import BUDGET_STEPS

if TYPE_CHECKING:
    from agent.trials.sweep import Sweep

FIRST_TEST_SEED = 1_000_000
KEPT_IN = Path("runs")
CUT_OFF = "\0"
"""Read for a value that a line of a table does not have."""
SHOWN = ("ceased", "located", "false_stop", "mtd_m", "mtd_floors", "search_time_s", "decision_ms")
"""Figures in the table; all are in the JSON."""


def address(text: str) -> str:
    """Argument type: where a Ray cluster is."""
    host, _, port = text.rpartition(":")
    if text != "auto" and not (host and port.isdecimal() and 0 < int(port) < 65536):
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted HOST:PORT of a Ray cluster's head, or auto")
    return text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `evaluate`."""
    add_policy_argument(parser, several=True)
    parser.add_argument("--scenarios", type=cli.whole(1, 10_000_000), default=1000, metavar="N", help="missions (default: %(default)s)")
    parser.add_argument(
        "--first-seed", type=cli.whole(0, MAX_SEED), default=FIRST_TEST_SEED, metavar="S", help="of the first one (default: %(default)s)"
    )
    cli.add_reach_arguments(parser, BUDGET_STEPS)
    cli.add_filter_arguments(parser, several=True)
    add_sensor_argument(parser)
    parser.add_argument("--missions", type=Path, metavar="FILE.csv", help="write a row a mission there; FILE.csv.gz compresses")
    cli.add_output_guard(parser)
    parser.add_argument(
        "--workers",
        type=cli.whole(1, 4096),
        default=os.cpu_count() or 1,
        metavar="W",
        help="processes that fly (default: all cores, %(default)s)",
    )
    parser.add_argument(
        "--ray", type=address, metavar="ADDRESS",
        help="fly on the Ray cluster there, HOST:PORT or auto: this machine is in it, each node has the same plumeward, numpy and numba",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the figures as one JSON object on the last line of stdout")


def run(args: argparse.Namespace) -> int:
    """Fly what is asked for and print its figures."""
    from agent.trials.cluster import ClusterError, join  # here, and below: they load the kernels, which help does not need
    from agent.trials.sweep import Sweep

    sweep = Sweep(
        args.policy, range(args.first_seed, args.first_seed + args.scenarios), args.particles, args.threshold, args.budget,
        cli.reach_given(args), args.knowledge,
    )  # fmt: skip
    try:
        for name in args.policy:
            reach(name, cli.reach_given(args))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return cli.BAD_INPUT
    if args.missions and not args.missions.parent.is_dir():
        print(f"error: --missions: no folder {str(args.missions.parent)!r} to write in", file=sys.stderr)
        return cli.BAD_INPUT
    if args.missions and args.missions.is_dir():
        print(f"error: --missions: {str(args.missions)!r} is a folder; wanted a file", file=sys.stderr)
        return cli.BAD_INPUT
    files = [args.missions] if args.missions and args.missions.is_file() else []  # a pipe or a device holds nothing to lose
    if refusal := cli.existing("--missions", files, args.force):
        print(f"error: {refusal}", file=sys.stderr)
        return cli.BAD_INPUT
    try:
        if args.ray:
            join(args.ray)
        return _evaluate(sweep, args)
    except ClusterError as error:
        print(f"error: --ray: {error}", file=sys.stderr)
        return cli.BAD_INPUT


def _evaluate(sweep: "Sweep", args: argparse.Namespace) -> int:
    from agent.trials.cluster import on_cluster
    from agent.trials.sweep import fly_all, journal_of, on_cores, ordered

    journal = journal_of(sweep, KEPT_IN)
    rows: list[MissionRow] = []

    def kept() -> str:
        return f"{len(rows) // len(args.threshold)} of {sweep.count} missions are kept; the same command goes on from there"

    try:
        flights = fly_all(sweep, journal, on_cluster if args.ray else on_cores(args.workers))
        with progress_bar() as progress, closing(flights):
            task = progress.add_task("missions", total=sweep.count)
            for flown in flights:
                rows += flown
                progress.advance(task)
    except KeyboardInterrupt:
        print(f"interrupted: {kept()}", file=sys.stderr)
        raise
    except (WorkerLost, OSError) as error:
        print(f"error: {error}; {kept()}", file=sys.stderr)
        return cli.FAILED
    rows = ordered(rows, sweep)
    if args.missions:
        try:
            write_csv(rows, args.missions)
        except OSError as error:
            print(f"error: --missions: {error}; what was flown is kept: name another file in the same command", file=sys.stderr)
            return cli.BAD_INPUT
    result = named(rows)
    print_table(result)
    if args.json:
        print(json.dumps(result))
    journal.unlink(missing_ok=True)  # the same sweep may have ended beside this one
    return 0


def named(rows: Sequence[MissionRow]) -> dict[str, Any]:
    """Figures by policy; where particles or thresholds differ, by policy and those."""
    groups = [(key, list(group)) for key, group in groupby(rows, key=lambda row: (row.policy, row.particles, row.threshold_m))]
    single = len({key[1:] for key, _ in groups}) == 1
    return {
        name if single else f"{name} particles={count} threshold={threshold_m:g}": figures(group)
        for (name, count, threshold_m), group in groups
    }


def write_csv(rows: Sequence[MissionRow], path: Path) -> None:
    """Write a row a mission, under a row of names, to six significant digits; a name that ends in .gz is compressed.

    What was there stays until all is written.
    """
    with whole(path) as partial, _open(partial, "wt", compressed=path.suffix == ".gz") as file:
        writer = csv.writer(file)
        writer.writerow(MissionRow.__struct_fields__)
        for row in rows:
            writer.writerow(f"{value:.6g}" if isinstance(value, float) else value for value in msgspec.structs.astuple(row))


def read_csv(path: Path) -> list[MissionRow]:
    """Read what `write_csv` wrote, this version's or an older one's. Raises ValueError on anything else."""
    with _open(path, "rt", compressed=path.suffix == ".gz") as file:
        reader = csv.DictReader(file, restval=CUT_OFF)
        try:
            return [_row(said) for said in reader]
        except (ValueError, csv.Error, OSError, EOFError, zlib.error) as error:
            raise ValueError(f"{path}: line {reader.line_num}: {error}") from error


def _row(said: dict[str | None, str]) -> MissionRow:
    if None in said or CUT_OFF in said.values():
        raise ValueError("it has not as many values as there are columns")
    row = msgspec.convert({name: value or None for name, value in said.items()}, MissionRow, strict=False)
    # Older versions wrote a planner's numbers here for learned policies too.
    return msgspec.structs.replace(row, headings=None, measurements=None) if bundle_path(row.policy) else row


def _open(path: Path, mode: str, *, compressed: bool) -> IO[str]:
    opener = gzip.open if compressed else open
    return cast(IO[str], opener(path, mode, newline=""))


def print_table(result: dict[str, Any]) -> None:
    """Print the figures of `named` as a table, for people."""
    table = Table(*("policy", "N", "ζ, m", "missions"), *(COLUMNS[key][0] for key in SHOWN), box=None, header_style="bold")
    for column in table.columns[1:]:
        column.justify = "right"
    for name, said in result.items():
        figures_and_intervals = (cell(said, key).replace(" ", "\n", 1) for key in SHOWN)
        policy = name.split(" particles=")[0]
        table.add_row(policy, f"{said['particles']:,}", f"{said['threshold_m']:g}", f"{said['missions']:,}", *figures_and_intervals)
    Console(stderr=True, width=None if sys.stderr.isatty() else 160).print(table)
