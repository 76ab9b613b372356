"""The fault campaign: flies seeded missions with faults, judges each, and writes the table of
docs/faults.md.

    python -m benchmarks.chaos                                                      # 200 missions, two at
    a time python -m benchmarks.chaos --missions 1 --first-seed 17 --only hang --json      # one of them
    again; writes nothing

Each mission is reproducible from its seed. results/faults/missions.csv has a row for each; those flown
again replace their earlier ones. docs/faults.md keeps its prose.
"""

import argparse
import concurrent.futures
import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.chaos.arena import ISOLATED, UNSHARE, lacking
from benchmarks.chaos.faults import KINDS, is_split, plan, text
from benchmarks.chaos.judge import BROKEN
from benchmarks.chaos.page import COLUMNS, Row, page, read
from link import cli
from link.files import whole

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results" / "faults" / "missions.csv"
PAGE = ROOT / "docs" / "faults.md"
LIMIT_S = 400.0


def cannot(seed: int, only: str | None, missing: Mapping[str, str]) -> str:
    """Return why a mission cannot be flown on this system, or an empty text."""
    faults = plan(seed, only)
    wanted = [fault.kind for fault in faults] + ["split"] * is_split(faults)
    return next((missing[kind] for kind in wanted if kind in missing), "")


def fly(seed: int, only: str | None, isolated: bool) -> dict[str, Any]:
    """Fly one mission in a process of its own; returns its verdict as JSON gives it."""
    command = [*UNSHARE] * isolated + [
        sys.executable,
        "-m",
        "benchmarks.chaos.mission",
        str(seed),
        *([only] if only else []),
    ]
    env = {**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"} | (
        {ISOLATED: "1"} if isolated else {}
    )
    try:
        ran = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            cwd=ROOT,
            env=env,
            check=False,
        )
        if not ran.returncode and ran.stdout.strip():
            return dict(json.loads(ran.stdout.splitlines()[-1]))
        reason = (ran.stderr.strip() or "no last words").splitlines()[-1]
    except subprocess.TimeoutExpired:
        reason = f"not over after {LIMIT_S:g} s"
    words = " + ".join(map(text, plan(seed, only)))
    return {
        "seed": seed,
        "words": words,
        "outcome": BROKEN,
        "reasons": [reason],
        "done": [],
        "steps": 0,
        "wall_s": 0.0,
        "said": [],
    }


def fly_all(seeds: Sequence[int], only: str | None, workers: int, isolated: bool) -> Iterator[dict[str, Any]]:
    """Fly missions side by side; yields each verdict when it is there."""
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        flights = [pool.submit(fly, seed, only, isolated) for seed in seeds]
        try:
            for flight in concurrent.futures.as_completed(flights):
                yield flight.result()
        finally:
            for flight in flights:
                flight.cancel()


def main() -> int:
    """Fly, judge, and write the table."""
    parser = cli.Parser(
        prog="python -m benchmarks.chaos",
        description="Fly missions with faults and write the table of docs/faults.md.",
    )
    parser.add_argument(
        "--missions", type=cli.whole(1, 100_000), default=200, metavar="N", help="(default: %(default)s)"
    )
    parser.add_argument(
        "--first-seed",
        type=cli.whole(0, 2**62),
        default=0,
        metavar="S",
        help="seed of the first (default: %(default)s)",
    )
    parser.add_argument(
        "--only",
        type=cli.checked(_is_kind, KINDS),
        metavar="FAULT",
        help=f"one fault each, of {', '.join(KINDS)}",
    )
    parser.add_argument(
        "--workers",
        type=cli.whole(1, 64),
        default=2,
        metavar="W",
        help="missions side by side (default: %(default)s)",
    )
    parser.add_argument(
        "--results", type=Path, default=RESULTS, metavar="FILE.csv", help="the rows (default: %(default)s)"
    )
    parser.add_argument(
        "--page",
        type=Path,
        default=PAGE,
        metavar="FILE.md",
        help="the page of the table (default: %(default)s)",
    )
    parser.add_argument(
        "--json", action="store_true", help="print a JSON object for each mission, and write no files"
    )
    args = parser.parse_args()
    missing = lacking()
    isolated = "" not in missing
    for kind, reason in missing.items():
        print(
            f"warning: {kind or 'missions side by side share ports and shared memory'}: {reason}",
            file=sys.stderr,
        )
    seeds = [
        seed
        for seed in range(args.first_seed, args.first_seed + args.missions)
        if not _skipped(seed, args.only, missing)
    ]
    broken = 0
    for number, said in enumerate(fly_all(seeds, args.only, args.workers if isolated else 1, isolated), 1):
        broken += said["outcome"] == BROKEN
        _tell(number, len(seeds), said, args)
        if not args.json:
            _keep(Row.of(said, args.only or ""), args.results, args.page)
    return cli.FAILED if broken else 0


def _skipped(seed: int, only: str | None, missing: Mapping[str, str]) -> bool:
    if reason := cannot(seed, only, missing):
        print(f"seed {seed} is not flown: {reason}", file=sys.stderr)
    return bool(reason)


def _tell(number: int, count: int, said: Mapping[str, Any], args: argparse.Namespace) -> None:
    if args.json:
        print(json.dumps(said), flush=True)
    again = (
        "python -m benchmarks.chaos --missions 1 --first-seed "
        f"{said['seed']}{' --only ' + args.only if args.only else ''} --json"
    )
    print(
        f"{number}/{count} seed {said['seed']}: {said['words']}: {said['outcome']}, {said['wall_s']:.0f} s",
        file=sys.stderr,
        flush=True,
    )
    if said["outcome"] == BROKEN:
        for line in (*said["reasons"], *said["said"], again):
            print(f"    {line.strip()}", file=sys.stderr, flush=True)


def _keep(row: Row, results: Path, document: Path) -> None:
    """Write a row in place of its earlier one, and the page."""
    rows = read(results) | {(row.seed, row.only): row}
    results.parent.mkdir(parents=True, exist_ok=True)
    with whole(results) as partial, partial.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(rows[key].cells() for key in sorted(rows))
    text = page(document.read_text(), rows.values())
    with whole(document) as partial:
        partial.write_text(text)


def _is_kind(name: str) -> None:
    if name not in KINDS:
        raise ValueError(f"{name!r} is not allowed; wanted one of {', '.join(KINDS)}")


if __name__ == "__main__":
    cli.run(main)
