"""`plumeward evaluate`: the figures of policies over many missions.

If interrupted, the same command resumes.
"""

import argparse
import csv
import errno
import gzip
import json
import math
import os
import re
import sys
import zlib
from collections.abc import Iterator, Sequence
from itertools import filterfalse, groupby
from operator import attrgetter
from pathlib import Path
from typing import IO, Any, TextIO, cast, get_type_hints

import msgspec

from agent.policies import add_policy_argument, bundle_path, reach
from agent.trials.figures import COLUMNS, OF_FLEETS, MissionRow, cell, figures
from agent.trials.workers import WorkerLost
from estimator.criterion import short
from estimator.options import add_sensor_argument, criteria, knowledge
from link import cli
from link.files import obstacle, whole
from link.terminal import Column, table, tell, width_of
from plume.problems.names import PROBLEMS
from plume.problems.options import add_fleet_arguments, add_problem_argument, problem_of
from plume.randomness import MAX_SEED
from plume.scenario import AS_MODELLED, SUCCESS_RADIUS_M
from plume.worlds.names import ABOUT, check, kinds, separate

FIRST_TEST_SEED = 1_000_000
KEPT_IN = Path("runs")
EXACT = ("threshold_m", "step_m", "margin_m", "separation_m")  # columns that --resume compares with settings
PLACES = ("estimate_x", "estimate_y", "source_x", "source_y")
# The least number of each column of numbers.
LEAST = {
    name: -math.inf if name in PLACES else float(name in ("particles", "vehicles"))
    for name, kind in get_type_hints(MissionRow).items()
    if kind in (int, float, int | None, float | None)
}
NUMBERS = attrgetter(*LEAST)
LONGEST_LINE, MOST_ROWS = 10_000, 1_000_000
MOST_SCENARIOS, MOST_WORKERS = 10_000_000, 4096
# Figures in the table: (rank, name), of which a narrow terminal leaves out the highest ranks first. All are
# in the JSON.
SHOWN = {
    "ceased": (3, "ceased"),
    "located": (0, "located"),
    "outside": (1, "outside"),
    "false_stop": (1, "false stop"),
    "moves": (2, "moves"),
    "mtd_m": (2, "MTD"),
    "mtd_floors": (4, "MTD in floors"),
    "stalls": (4, "stalls"),
    "search_time_s": (5, "ST"),
    "decision_ms": (6, "decision"),
}
# How the line above the table says a setting that all rows share.
SHARED = {
    "world": "world {}",
    "N": "N = {}",
    "ζ, m": "ζ = {} m",
    "stop": "stop {}",
    "assume": "assume {}",
    "vehicles": "{} vehicles",
    "missions": "{} missions each",
}
SETTINGS = re.compile(" (?:world|particles|stop)=")  # where the settings in a key of `named` begin
SHORTEST_NAME = 16  # least characters of a policy's name, on a narrow terminal
SHORTEST_WORLD = 8  # the same of a world's


def address(text: str) -> str:
    """Argument type: the address of a Ray cluster."""
    host, _, port = text.rpartition(":")
    if text != "auto" and not (host and port.isdecimal() and 0 < int(port) < 65536):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not allowed; wanted HOST:PORT of a Ray cluster's head, or auto"
        )
    return text


def add_world_argument(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Add the flag that chooses the world, or with `several` the worlds."""
    world = cli.checked(check)
    argument = parser.add_argument(
        "--world",
        type=cli.listed(world, separate) if several else world,
        metavar="NAME,NAME" if several else "NAME",
        help=f"{ABOUT} (default: the problem's, {AS_MODELLED})",
    )
    cli.completed(argument, kinds)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `evaluate`."""
    add_policy_argument(parser, several=True)
    parser.add_argument(
        "--scenarios",
        type=cli.whole(1, MOST_SCENARIOS),
        default=1000,
        metavar="N",
        help="number of missions (default: %(default)s)",
    )
    parser.add_argument(
        "--first-seed",
        type=cli.whole(0, MAX_SEED),
        default=FIRST_TEST_SEED,
        metavar="S",
        help="seed of the first mission; the others follow (default: %(default)s)",
    )
    cli.add_reach_arguments(parser)
    cli.completed(add_problem_argument(parser), lambda: PROBLEMS, "yaml", "yml")
    cli.add_filter_arguments(parser, several=True)
    add_sensor_argument(parser)
    add_world_argument(parser, several=True)
    add_fleet_arguments(parser)
    parser.add_argument(
        "--missions",
        type=cli.path,
        metavar="FILE.csv",
        help="write one row per mission to this file; FILE.csv.gz compresses",
    )
    cli.add_output_guard(parser)
    parser.add_argument(
        "--resume", action="store_true", help="keep the rows that --missions has, and fly only what it lacks"
    )
    parser.add_argument(
        "--workers",
        type=cli.whole(1, MOST_WORKERS),
        default=os.cpu_count() or 1,
        metavar="W",
        help="worker processes (default: all cores, %(default)s)",
    )
    parser.add_argument(
        "--ray",
        type=address,
        metavar="ADDRESS",
        help="fly on this Ray cluster, HOST:PORT or auto: this machine is a node of it, all nodes have the "
        "same plumeward, numpy and numba",
    )
    parser.add_argument(
        "--json", action="store_true", help="print the figures as one JSON object on the last line of stdout"
    )


def choose_problem(args: argparse.Namespace) -> None:
    """Set problem, knowledge, stops and worlds, from the problem and the flags that override it.

    Raises ValueError with what is allowed.
    """
    problem = args.problem = problem_of(args)
    args.knowledge, args.stops = knowledge(args, problem), criteria(args, problem)
    args.worlds = args.world or [problem.world]
    for world in args.worlds if isinstance(args.worlds, list) else [args.worlds]:
        check(world, problem)


def run(args: argparse.Namespace) -> int:
    """Fly the missions and print their figures; returns the exit status. Raises BadInput."""
    if args.first_seed > (last := MAX_SEED + 1 - args.scenarios):
        raise cli.BadInput(
            f"--first-seed: {args.first_seed} is not allowed with --scenarios {args.scenarios}; "
            f"wanted {last} at most"
        )
    try:
        for name in args.policy:
            reach(name, cli.reach_given(args), args.problem)
    except ValueError as error:
        raise cli.BadInput(str(error)) from error
    if args.resume and not args.missions:
        raise cli.BadInput("--resume: needs --missions FILE.csv, the table whose rows it keeps")
    if args.missions and (
        refusal := cli.unwritable("--missions", [args.missions], args.force or args.resume)
    ):
        raise cli.BadInput(refusal)
    try:
        there = _there(args)
    except (OSError, ValueError) as error:
        raise cli.BadInput(f"--missions: {error}") from error
    return _evaluate(there, args)


def _there(args: argparse.Namespace) -> list[MissionRow]:
    """Return the rows of the table that stay: without --resume and --force another command's, which made it.

    Raises OSError or ValueError.
    """
    keeps = args.missions and (args.resume or not args.force)
    return read_csv(args.missions) if keeps and args.missions.is_file() else []


def _evaluate(there: Sequence[MissionRow], args: argparse.Namespace) -> int:
    # Here, because they load the kernels, which help does not need.
    from agent.trials.cluster import join, on_cluster
    from agent.trials.sweep import Sweep, answers, complete, flown, journal_of, kept, on_cores

    if args.ray:
        tell(f"joining the Ray cluster at {args.ray}")
        join(args.ray)
    sweep = Sweep(
        args.policy,
        range(args.first_seed, args.first_seed + args.scenarios),
        args.particles,
        args.stops,
        None,
        cli.reach_given(args),
        args.knowledge,
        worlds=args.worlds,
        problem=args.problem,
        fleet=args.fleet,
    )
    journal = journal_of(sweep, KEPT_IN)
    try:
        KEPT_IN.mkdir(exist_ok=True)
    except OSError as error:
        raise cli.BadInput(f"no folder {str(KEPT_IN)!r} to keep missions in: {error.strerror}") from None
    if reason := obstacle(journal):
        raise cli.BadInput(f"{str(journal)!r}, which keeps missions, {reason}")
    workers = f"{args.workers} worker{'s' * (args.workers > 1)}"
    flyer, starting = (
        (on_cluster, "starting on Ray") if args.ray else (on_cores(args.workers), f"starting {workers}")
    )

    def saved() -> str:
        flights = complete(sweep, there) | kept(sweep, journal)
        return f"{len(flights)} of {sweep.count} missions are saved. Run the command again: it resumes"

    try:
        rows = flown(sweep, journal, flyer, "missions", starting, there)
    except KeyboardInterrupt:
        tell(f"interrupted: {saved()}")
        raise
    except (WorkerLost, OSError) as error:
        if isinstance(error, OSError) and error.errno == errno.EMFILE:
            raise
        return cli.failed(f"{error}; {saved()}")
    if args.missions and len(complete(sweep, there)) < sweep.count:  # a file that has all stays as it is
        try:
            # Read again: another command may have made it, or added rows to it, meanwhile.
            write_csv([*filterfalse(answers(sweep), _there(args)), *rows], args.missions)
        except (OSError, ValueError) as error:
            raise cli.BadInput(
                f"--missions: {error}; the missions are saved: run the command again with another file"
            ) from error
    result = named(rows)
    taken = args.json or (args.missions and _is_stdout(args.missions))
    print_table(result, sys.stderr if taken else sys.stdout, "--json")
    if args.json:
        print(json.dumps(result), flush=True)
    journal.unlink(missing_ok=True)  # a second process may have flown the same sweep
    return 0


def named(rows: Sequence[MissionRow]) -> dict[str, Any]:
    """Return the figures by policy.

    Where worlds differ, the key names the world too; so it is with particles, thresholds and stops.
    """
    told = [
        (policy, figures(list(group)))
        for (policy, *_), group in groupby(
            rows, key=lambda row: (row.policy, row.world, row.particles, row.threshold_m, row.stop)
        )
    ]
    several_worlds, several_counts, several_stops = (
        len({said[key] for _, said in told}) > 1 for key in ("world", "particles", "stop")
    )
    spreads = all(said["threshold_m"] is not None for _, said in told)

    def key(policy: str, said: dict[str, Any]) -> str:
        name = policy + f" world={said['world']}" * several_worlds
        if spreads and (several_counts or several_stops):
            return f"{name} particles={said['particles']} threshold={said['threshold_m']:g}"
        return (
            name
            + f" particles={said['particles']}" * several_counts
            + f" stop={said['stop']}" * several_stops
        )

    return {key(policy, said): said for policy, said in told}


def write_csv(rows: Sequence[MissionRow], path: Path) -> None:
    """Write a header and one row per mission: settings read back exactly, figures have six digits.

    A name that ends in .gz is compressed.

    An existing file stays as it is until the new one is complete.
    """
    with whole(path) as partial, _open(partial, "wt", compressed=path.suffix == ".gz") as file:
        writer = csv.writer(file)
        writer.writerow(MissionRow.__struct_fields__)
        for row in rows:
            writer.writerow(
                (short(value) if name in EXACT else f"{value:.6g}") if isinstance(value, float) else value
                for name, value in msgspec.structs.asdict(row).items()
            )


def read_csv(path: Path) -> list[MissionRow]:
    """Read a file that this or an older version of `write_csv` wrote. Raises ValueError on anything else."""
    if path.exists() and not path.is_file():
        raise ValueError(f"{path}: not a file; wanted one")
    with _open(path, "rt", compressed=path.suffix == ".gz") as file:
        reader = csv.reader(_lines(file))
        try:
            columns = next(reader, [])
            if "policy" not in columns:
                raise ValueError("this is no table of missions: its first line has no column policy")
            return [_row(columns, values) for values in reader if values]
        except (ValueError, csv.Error, OSError, EOFError, zlib.error) as error:
            raise ValueError(f"{path}: line {max(reader.line_num, 1)}: {error}") from error


def _lines(file: IO[str]) -> Iterator[str]:
    """Yield the lines of a file; raises ValueError on more than such a file can have.

    A small .gz file may hold gigabytes.
    """
    for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), "")):
        if len(line) == LONGEST_LINE or number > MOST_ROWS:
            raise ValueError(
                f"wanted lines of less than {LONGEST_LINE:,} characters, and at most {MOST_ROWS:,} missions"
            )
        yield line


def _row(columns: Sequence[str], values: Sequence[str]) -> MissionRow:
    if len(values) != len(columns):
        raise ValueError("the number of values differs from the number of columns")
    said = {name: value or None for name, value in zip(columns, values, strict=True)}
    row = msgspec.convert(said, MissionRow, strict=False)
    _check(row)
    # Files of older versions have a planner's numbers for learned policies too.
    return msgspec.structs.replace(row, headings=None, measurements=None) if bundle_path(row.policy) else row


def _check(row: MissionRow) -> None:
    """Raise ValueError on a row that no mission can have had: a hand, or another program, has changed it."""
    for value, (name, least) in zip(NUMBERS(row), LEAST.items(), strict=True):
        if value is not None and not (least <= value < math.inf and value > -math.inf):
            wanted = "a finite number" if name in PLACES else f"a number from {least:g}"
            raise ValueError(f"{name} {value} is not allowed; wanted {wanted}")
    if row.located and row.outside:
        raise ValueError("located and outside are both True; wanted one of them at most")
    if not row.ceased and (row.located or row.outside):
        raise ValueError("it has not ceased, and yet is located or outside")
    if row.located and row.error_m > SUCCESS_RADIUS_M:
        raise ValueError(f"located, with error_m {row.error_m:g}; wanted {SUCCESS_RADIUS_M:g} at most")
    if row.steps > row.budget:
        raise ValueError(f"steps {row.steps} is not allowed; wanted {row.budget} at most, the budget")


def _open(path: Path, mode: str, *, compressed: bool) -> IO[str]:
    # A spreadsheet may have begun the table with a byte order mark.
    encoding = "utf-8-sig" if mode == "rt" else "utf-8"
    return cast(IO[str], (gzip.open if compressed else open)(path, mode, encoding=encoding, newline=""))


def print_table(result: dict[str, Any], stream: TextIO, elsewhere: str = "") -> None:
    """Print the figures of `named` as a table, for people.

    `elsewhere` says how to see what a narrow terminal leaves out.
    """
    said = list(result.values())
    # ζ tells the stop, unless a row has another criterion.
    stops = (
        {"stop": [row["stop"] for row in said]}
        if any(row["threshold_m"] is None for row in said)
        else {"ζ, m": [f"{row['threshold_m']:g}" for row in said]}
    )
    settings = {
        "world": [row["world"] for row in said],
        "N": [f"{row['particles']:,}" for row in said],
        **stops,
        "assume": [row["assume"] for row in said],
        "vehicles": [str(row["vehicles"]) for row in said],
        "missions": [f"{row['missions']:,}" for row in said],
    }
    shared = [
        SHARED[name].format(cells[0])
        for name, cells in settings.items()
        if len(set(cells)) == 1 and cells[0] != AS_MODELLED and (name, cells[0]) != ("vehicles", "1")
    ]
    columns = [
        Column(
            "policy",
            [SETTINGS.split(name)[0] for name in result],
            left=True,
            least=SHORTEST_NAME,
            keeps_end=True,
        ),
        *(
            Column(name, cells, left=name == "world", least=SHORTEST_WORLD if name == "world" else None)
            for name, cells in settings.items()
            if len(set(cells)) > 1
        ),
        *(
            Column((COLUMNS | OF_FLEETS)[key][0], [cell(row, key) for row in said], rank, name, stacks=True)
            for key, (rank, name) in SHOWN.items()
            if key != "outside" or any(row[key] for row in said)
            if key != "moves" or any(row["vehicles"] > 1 for row in said)
        ),
    ]
    tell(table(columns, width_of(stream), elsewhere, above=[", ".join([*shared, "[95% interval]"])]), stream)


def _is_stdout(path: Path) -> bool:
    """Whether a file is what stdout goes to, as /dev/stdout is."""
    try:
        return os.path.samestat(path.stat(), os.fstat(sys.stdout.fileno()))
    except (OSError, ValueError):
        return False
