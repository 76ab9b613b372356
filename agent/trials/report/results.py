"""Raw results: the missions in all files of a folder, and the figures of each policy, N and ζ."""

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agent.policies import OURS
from agent.trials.evaluate import read_csv
from agent.trials.figures import MissionRow, figures
from plume.scenario import AS_MODELLED

AS_GOOD = 0.01  # policies whose ceased shares differ by at most this much are compared by their MTD

# Columns that must be equal in all missions of one figure.
ALIKE = ("budget", "headings", "step_m", "measurements", "sensor", "prior", "stop_on", "margin_m")
WAY = attrgetter(*ALIKE)


class Setting(NamedTuple):
    """Settings of the filter and its stop."""

    particles: int
    threshold_m: float


Key = tuple[str, Setting]  # (policy, setting)
USUAL = Setting(1000, 0.5)  # the defaults of `rollout` and `evaluate`


@dataclass(frozen=True)
class Results:
    """All missions flown. Policies are in the order of the registry, unknown ones last."""

    rows: Mapping[Key, list[MissionRow]]
    figures: Mapping[Key, dict[str, Any]]  # the result of `agent.trials.figures.figures` for the rows
    assume: str = "paper"  # what the estimator took to be known in all of them

    @property
    def policies(self) -> list[str]:
        """Each policy once."""
        return list(dict.fromkeys(policy for policy, _ in self.rows))

    @property
    def threshold_m(self) -> float:
        """The ζ of most missions, at which numbers of particles are compared."""
        return Counter(setting.threshold_m for _, setting in self.rows).most_common(1)[0][0]

    @property
    def particles(self) -> int:
        """The N of most missions, at which thresholds are compared."""
        return Counter(setting.particles for _, setting in self.rows).most_common(1)[0][0]

    def along(self, axis: str) -> list[Key]:
        """Return the keys along `particles` or `threshold_m`, with the other one of most missions."""
        fixed = "threshold_m" if axis == "particles" else "particles"
        return [key for key in self.rows if getattr(key[1], fixed) == getattr(self, fixed)]

    def is_one_along(self, axis: str) -> bool:
        """Whether all keys along `particles` or `threshold_m` are of one setting."""
        return len({setting for _, setting in self.along(axis)}) == 1

    @property
    def usual(self) -> Setting:
        """The setting flown that is nearest to `USUAL`, first in N, then in ζ."""
        return min(
            {setting for _, setting in self.rows},
            key=lambda it: (abs(it.particles - USUAL.particles), abs(it.threshold_m - USUAL.threshold_m)),
        )

    def best(self, setting: Setting, of: Collection[str]) -> str | None:
        """Return the policy with the lowest MTD within one point of the highest ceased share.

        None if none ceased.
        """
        said = {
            policy: it
            for (policy, flown), it in self.figures.items()
            if flown == setting and policy in of and it["ceased"]
        }
        most = max((it["ceased"] for it in said.values()), default=0.0)
        return min(
            (policy for policy in said if said[policy]["ceased"] >= most - AS_GOOD),
            key=lambda it: said[it]["mtd_m"],
            default=None,
        )

    def floor_m(self, threshold_m: float) -> float | None:
        """Mean information floor of the scenarios flown at ζ, m; None where it is not known."""
        floors = {
            row.seed: row.floor_m
            for (_, setting), rows in self.rows.items()
            if setting.threshold_m == threshold_m
            for row in rows
            if row.floor_m is not None
        }
        return float(np.mean(list(floors.values()))) if floors else None

    def behind(self, keys: Collection[Key]) -> str:
        """Return in words the number of missions and the seeds of these figures."""
        counts = sorted(len(self.rows[key]) for key in keys)
        seeds = {row.seed for key in keys for row in self.rows[key]}
        each = f"{counts[0]:,}" if counts[0] == counts[-1] else f"{counts[0]:,} to {counts[-1]:,}"
        return f"{each} missions per policy and setting, seeds {min(seeds)} to {max(seeds)}"


def read(folder: Path) -> Results:
    """Read every .csv and .csv.gz file of a folder; a mission in two files counts once. Raises ValueError."""
    if not folder.is_dir():
        raise ValueError(
            f"no such folder: {str(folder)!r}; `plumeward evaluate --missions FILE.csv` writes results"
        )
    missions: dict[Key, dict[int, MissionRow]] = {}
    assumed: dict[str, Path] = {}
    for path in sorted(path for path in folder.iterdir() if path.name.endswith((".csv", ".csv.gz"))):
        for row in read_csv(path):
            if row.world != AS_MODELLED:
                raise ValueError(
                    f"{path}: missions in the world {row.world!r}; a report takes those of {AS_MODELLED!r} "
                    "alone"
                )
            if row.problem != "paper":
                raise ValueError(
                    f"{path}: missions of the problem {row.problem:.60}; a report takes those of paper, "
                    "its folder leaderboard takes others"
                )
            if row.threshold_m is None:
                raise ValueError(
                    f"{path}: {row.policy} was flown with --stop {row.stop}; a report compares missions of "
                    "--stop spread:Z"
                )
            if row.vehicles != 1:
                raise ValueError(
                    f"{path}: missions of {row.vehicles} vehicles; a report takes those of one alone"
                )
            assumed.setdefault(row.assume, path)
            if len(assumed) > 1:
                one, other = (f"{name} in {file.name}" for name, file in assumed.items())
                raise ValueError(
                    f"{str(folder)!r} holds missions of both assumptions, {one} and {other}; wanted a folder "
                    "for each"
                )
            same = missions.setdefault((row.policy, Setting(row.particles, row.threshold_m)), {})
            if WAY(same.setdefault(row.seed, row)) != WAY(next(iter(same.values()))):
                raise ValueError(
                    f"{path}: {row.policy} was flown with other settings there ({', '.join(ALIKE)})"
                )
    if not missions:
        raise ValueError(
            f"no missions in {str(folder)!r}; `plumeward evaluate --missions FILE.csv` writes them"
        )
    rank = {policy: i for i, policy in enumerate(OURS)}
    order = sorted(missions, key=lambda key: (rank.get(key[0], len(rank)), key))
    rows = {key: [missions[key][seed] for seed in sorted(missions[key])] for key in order}
    return Results(rows, {key: figures(of) for key, of in rows.items()}, *assumed)
