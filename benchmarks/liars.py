"""How often a lying sensor of a fleet is named, an honest one wrongly, and what leaving it out does.

    python -m benchmarks.liars                              # the table of docs/fleet.md, from results/
    python -m benchmarks.liars --fly --missions 100         # flies what the rows lack, and adds them

Three vehicles from different corners; the sensor of one of them, 1, 2 or 3 in turn, lies in a way of its own.
Each search is flown as if nobody was named, and watched. Where the watch names a vehicle before the stop, the
search is flown once more, and the vehicle is left out from the next round on, its readings forgotten.
"""

import argparse
from collections import defaultdict
from collections.abc import Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from agent.trials import rounds
from agent.trials.evaluate import FIRST_TEST_SEED
from agent.trials.figures import wilson
from agent.trials.rollout import mission
from benchmarks.rows import append, read
from estimator.belief import stuck
from estimator.filter import assimilate, prior, renewed
from estimator.watch import SensorWatch
from link import cli
from link.terminal import tell
from plume.outcome import verdict
from plume.problems.fleet import Fleet
from plume.worlds.rounds import RoundTime

ROWS = Path("results/liars/missions.csv")
VEHICLES = 3
BUDGET = 100
# What is wrong with the sensor of one vehicle, as errors of a world.
LIES: Mapping[str, dict[str, Any]] = {
    "none": {},
    "hums at 1 ± 0.2": {"stuck_from": 0, "stuck_at": 1.0, "stuck_std": 0.2},
    "dead: 0 ± 0.2": {"stuck_from": 0, "stuck_std": 0.2},
    "stuck at 0 from reading 5 on": {"stuck_from": 5},
    "reads 5 times the gas": {"gain": 5.0},
    "reads a fifth of the gas": {"gain": 0.2},
}


class Searched(msgspec.Struct, frozen=True):
    """A row: one search, and the same once more without whom the watch names."""

    lie: str
    seed: int
    liar: int
    named: int  # 0: nobody
    step: int  # at which it is named; -1
    verdict: str
    moves: int
    verdict_without: str  # of the search that leaves it out; empty where nobody is named
    moves_without: int


def fly(seed: int, lie: str) -> Searched:
    """Fly one seed with a lie."""
    liar = 1 + seed % VEHICLES
    named, step, ended, moves = _searched(seed, lie, liar, {})
    without, fewer = "", -1
    if named:
        _, _, without, fewer = _searched(seed, lie, liar, {named: step + 1})
    return Searched(lie, seed, liar, named, step, ended, moves, without, fewer)


def _searched(seed: int, lie: str, liar: int, leaving: Mapping[int, int]) -> tuple[int, int, str, int]:
    """Return who is named first, at which step, how the search has ended, and after how many moves."""

    class Lying(RoundTime):
        """The rounds of a fleet of which one sensor lies."""

        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            own = copy(self.worlds[liar - 1])
            own.errors = own.errors._replace(**LIES[lie])
            self.worlds[liar - 1] = own

    replaced: Any = rounds  # the name that it uses
    replaced.RoundTime = Lying
    try:
        flown = mission(
            seed, "homing", 1000, 0.5, BUDGET, fleet=Fleet(VEHICLES, "corners"), leaving=leaving,
            forgotten=tuple(leaving), assume="field",
        )  # fmt: skip
        watch, before, named, at = SensorWatch(flown.config, VEHICLES), prior(flown.config), 0, -1
        for number, step in enumerate(flown.steps):
            if not leaving and not named:
                doubted = [*stuck(step.posterior, flown.config), *watch.doubted]
                if doubted and not step.belief.ceased:
                    named, at = doubted[0], number
                before = renewed(before, flown.config)
                for reading in step.readings:
                    after = assimilate(before, reading, flown.config)
                    watch.take(before, after, reading)
                    before = after
                watch.look()
    finally:
        replaced.RoundTime = RoundTime
    said = step.belief
    ended = verdict(said.ceased, said.mean, flown.scenario.source, said.outside)
    return named, at, ended, number


def table(rows: Sequence[Searched]) -> str:
    """Return the table, as Markdown."""
    by_lie: dict[str, list[Searched]] = defaultdict(list)
    for row in rows:
        by_lie[row.lie].append(row)
    lines = [
        "| the sensor of one of three | missions | named before the stop | another named | median step "
        "| false stops | not ceased | false stops if it is left out | not ceased |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for lie in [lie for lie in LIES if lie in by_lie]:
        own = by_lie[lie]
        right = [row for row in own if row.named == row.liar and lie != "none"]
        wrong = [row for row in own if row.named and row not in right]
        ends = [row.verdict for row in own]
        left = [row.verdict_without or row.verdict for row in own]
        steps = f"{np.median([row.step for row in right]):.0f}" if right else ""
        cells = [lie, str(len(own))]
        cells += ["" if lie == "none" else _share(len(right), len(own)), _share(len(wrong), len(own)), steps]
        for those in (ends, left):
            ceased = len(those) - those.count("not ceased")
            cells += [_share(those.count("FALSE STOP"), ceased), _share(len(those) - ceased, len(those))]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _share(count: int, of: int) -> str:
    if not of:
        return "none ceased"
    share = wilson(count, of)
    return f"{100 * count / of:.0f}% [{100 * share.low:.0f}, {100 * share.high:.0f}]"


def main() -> None:
    """Fly what is missing, if wanted, and print the table."""
    parser = cli.Parser(prog="python -m benchmarks.liars", description=__doc__ and __doc__.splitlines()[0])
    parser.add_argument("--fly", action="store_true", help="fly what the rows lack")
    parser.add_argument(
        "--missions", type=cli.whole(1, 100_000), default=100, metavar="N", help="of each lie"
    )
    parser.add_argument("--lies", type=cli.listed(str), metavar="LIE,LIE", help="only those that begin so")
    args: argparse.Namespace = parser.parse_args()
    rows = read(ROWS, Searched)
    if args.fly:
        known = {(row.lie, row.seed) for row in rows}
        wanted = [lie for lie in LIES if not args.lies or lie.startswith(tuple(args.lies))]
        for lie in wanted:
            for seed in range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.missions):
                if (lie, seed) not in known:
                    rows.append(fly(seed, lie))
                    append(rows[-1:], ROWS)
            tell(f"{lie}: {args.missions} missions")
    print(table(rows))


if __name__ == "__main__":
    cli.run(main)
