"""The leaderboard: policies by problems and worlds, and which is best over all of them."""

import json
import math
import statistics
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from agent.policies import DEFAULT, OURS, bundle_path
from agent.trials.evaluate import read_csv
from agent.trials.figures import UNKNOWN, USUAL_SENSOR, MissionRow, bootstrap, cell, figures
from agent.trials.report.results import USUAL, Results
from agent.trials.report.tables import Table

FOLDER = "leaderboard"  # of a folder of results: rows of `evaluate --missions`
SHOWN = ("located", "false_stop", "mtd_m", "stalls", "decision_ms")
Missions = Mapping[str, Sequence[MissionRow]]  # the missions of each policy on one board


@dataclass(frozen=True)
class Leaderboard:
    """The missions of each policy, by problem and world."""

    boards: Mapping[str, Missions]

    @property
    def policies(self) -> list[str]:
        """Each policy once: the best over all first, then those that were not flown everywhere."""
        names = {policy for missions in self.boards.values() for policy in missions}
        return sorted(names, key=lambda name: (self.overall(name), *_place(name)))

    def overall(self, policy: str) -> float:
        """Return how many times as far as the best one a policy flies for a find.

        It is the geometric mean over all problems and worlds; infinite where it was not flown in all of
        them, or found nothing in one.
        """
        ratios = [found.get(policy, math.inf) / min(found.values()) for found in self.found.values()]
        return statistics.geometric_mean(ratios)

    @cached_property
    def found(self) -> Mapping[str, Mapping[str, float]]:
        """`metres_a_find` of each policy, by problem and world."""
        return {
            board: {policy: metres_a_find(rows) for policy, rows in missions.items()}
            for board, missions in self.boards.items()
        }

    def tables(self) -> list[Table]:
        """Return who is best over all, and all figures."""
        return [self._standings(), self._figures()] if self.boards else []

    def _standings(self) -> Table:
        rows = []
        for policy in self.policies:
            found = [found.get(policy, math.inf) for found in self.found.values()]
            rows.append([policy, *map(_number, (self.overall(policy), *found))])
        return Table(
            "Leaderboard",
            ["policy", "over all", *(f"{board}, m a find" for board in self.boards)],
            rows,
            [
                "*m a find*: metres flown in all missions, those without a stop and with a false one "
                "included, for each source located. *over all*: how many times the best policy's that is, "
                f"the geometric mean over all columns. –: not flown in all, or nothing found. `{DEFAULT}` "
                "is what `plumeward fly` takes by default. docs/policies.md says how to enter one of your "
                "own.",
            ],
        )

    def _figures(self) -> Table:
        rows = []
        for board, missions in self.boards.items():
            for policy in (name for name in self.policies if name in missions):
                said = figures(missions[policy])
                ceased = np.array([row.distance_m for row in missions[policy] if row.ceased])
                last = bootstrap(ceased, lambda samples: np.quantile(samples, 0.99, axis=1))
                shown = [cell(said, figure) for figure in SHOWN]
                shown.insert(3, UNKNOWN if math.isnan(last.value) else last.text(1.0, 0))
                rows.append([board, policy, str(len(missions[policy])), *shown, trained(policy)])
        return Table(
            "The leaderboard's figures",
            [
                "problem and world",
                "policy",
                "missions",
                "located, %",
                "false stop, %",
                "MTD, m",
                "99th percentile, m",
                "stalls",
                "decision, ms",
                "trained, moves",
            ],
            rows,
            [
                "At N = 1,000 and ζ = 0.5 m. In brackets: 95% intervals. *99th percentile*: of the distances "
                "of ceased missions. *stalls*: readings of a mission, on average, after which the search "
                "repeated itself; – for missions that were flown before these were counted. *trained*: moves "
                "in training, as the bundle says.",
            ],
        )


def metres_a_find(rows: Sequence[MissionRow]) -> float:
    """Return the metres flown in all missions for each source located; infinite where none was."""
    found = sum(row.located for row in rows)
    return sum(row.distance_m for row in rows) / found if found else math.inf


def trained(policy: str) -> str:
    """Return for how many moves a learned policy was trained, as its bundle says."""
    path = bundle_path(policy)
    if path is None or not path.is_file():
        return UNKNOWN
    with zipfile.ZipFile(path) as bundle:
        steps = json.loads(bundle.read("bundle.json"))["training"].get("steps")
    return f"{steps:,}" if isinstance(steps, int) else UNKNOWN


def read_boards(folder: Path, results: Results) -> Leaderboard:
    """Return the leaderboard of a folder of results: that of the paper, and those of its FOLDER.

    Raises ValueError. A problem that is not `paper` is called as its file.
    """
    boards: dict[str, dict[str, dict[int, MissionRow]]] = {}
    paper = {policy: rows for (policy, at), rows in results.rows.items() if at == USUAL}
    for policy, rows in paper.items():
        boards.setdefault(f"paper, {results.assume}", {})[policy] = {row.seed: row for row in rows}
    others = folder / FOLDER
    for path in sorted(others.glob("*.csv*")) if others.is_dir() else ():
        for row in read_csv(path):
            _check(path, row)
            place = "paper" if row.problem == "paper" else path.name.partition(".")[0]
            told = [place, row.assume, *([row.world] if row.world != "as-modelled" else [])]
            boards.setdefault(", ".join(told), {}).setdefault(row.policy, {})[row.seed] = row
    return Leaderboard(
        {
            board: {
                policy: [rows[seed] for seed in sorted(rows)]
                for policy, rows in sorted(missions.items(), key=lambda it: _place(it[0]))
            }
            for board, missions in boards.items()
        }
        if others.is_dir()
        else {}
    )


def _check(path: Path, row: MissionRow) -> None:
    """Refuse a mission that cannot be compared with the others. Raises ValueError."""
    wanted = {
        "particles": USUAL.particles,
        "threshold_m": USUAL.threshold_m,
        "sensor": USUAL_SENSOR,
        "vehicles": 1,
    }
    for name, value in wanted.items():
        if (flown := getattr(row, name)) != value:
            raise ValueError(
                f"{path}: {row.policy} was flown with {name} {flown}; a leaderboard takes {value}"
            )


def _place(policy: str) -> tuple[int, str]:
    return (OURS.index(policy), "") if policy in OURS else (len(OURS), policy)


def _number(value: float) -> str:
    return UNKNOWN if math.isinf(value) else f"{value:.2f}" if value < 10 else f"{value:.1f}"
