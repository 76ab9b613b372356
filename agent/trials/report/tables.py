"""The report's tables: our figures by setting, and the paper's figures beside ours."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.trials.figures import COLUMNS, UNKNOWN, cell
from agent.trials.report.published import PUBLISHED, Published
from agent.trials.report.results import Key, Results, Setting
from plume.scenario import BUDGET_STEPS, LIFETIME_S, SUCCESS_RADIUS_M, draw


@dataclass(frozen=True)
class Table:
    """A table of text with notes."""

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str]

    def markdown(self) -> str:
        """Return it as a section of Markdown."""
        lines = ["| " + " | ".join(row) + " |" for row in (self.heads, ["---"] * len(self.heads), *self.rows)]
        return "\n".join([f"## {self.title}", "", *lines, "", *(f"{note}\n" for note in self.notes)])


def tables(results: Results) -> list[Table]:
    """Return all tables of the report."""
    return [
        against_paper(results),
        ours(
            results,
            results.along("particles"),
            f"Our figures at ζ = {results.threshold_m:g} m, assume {results.assume}",
        ),
        by_threshold(results),
    ]


def by_threshold(results: Results) -> Table:
    """Return the share located and the distance at the usual N, one row per policy and one column per ζ."""
    found = {
        (key[0], key[1].threshold_m): " / ".join(
            cell(results.figures[key], of) for of in ("located", "mtd_m")
        )
        for key in results.along("threshold_m")
    }
    limits_m = sorted({limit_m for _, limit_m in found})
    rows = [
        [policy, *(found.get((policy, limit_m), UNKNOWN) for limit_m in limits_m)]
        for policy in dict.fromkeys(policy for policy, _ in found)
    ]
    title = f"Located, % / MTD, m, at N = {results.particles:,}, by ζ, assume {results.assume}"
    return Table(title, ["policy", *(f"{limit_m:g} m" for limit_m in limits_m)], rows, [])


def ours(results: Results, keys: Sequence[Key], title: str) -> Table:
    """Return our figures, one row per policy and setting, without stalls where no row counts them."""
    columns = [
        name
        for name in COLUMNS
        if name != "stalls" or any(results.figures[key][name] is not None for key in keys)
    ]
    rows = [
        [
            str(setting.particles),
            f"{setting.threshold_m:g}",
            policy,
            str(results.figures[policy, setting]["missions"]),
            *(cell(results.figures[policy, setting], figure) for figure in columns),
        ]
        for policy, setting in sorted(keys, key=lambda key: key[1])  # policies stay in their order
    ]
    notes = [
        "In brackets: 95% intervals, Wilson's for shares and bootstrap for means. *ceased*: a stop was "
        "declared within the step budget."
        f" *located*: ceased, and the estimate is within {SUCCESS_RADIUS_M:g} m of the source. *false stop*: "
        "ceased but not located, as a"
        " share of ceased. *MTD*: mean distance travelled over ceased missions. *floors*: MTD as a multiple "
        "of the mean information floor"
        " of the same missions. *NEES*: normalised estimation error squared at the stop; its mean is 2 for "
        "an honest belief. *ST*: mean"
        " processor time of estimator and agent over a ceased mission; compare ratios, which depend less on "
        "the machine than seconds."
        + " *stalls*: readings of a mission, on average, after which the search repeated itself."
        * ("stalls" in columns)
        + " *decision*: mean processor time of the agent per decision. *update*: mean processor time of the "
        "estimator per reading.",
    ]
    return Table(
        title, ["N", "ζ, m", "policy", "missions", *(COLUMNS[name][0] for name in columns)], rows, notes
    )


def against_paper(results: Results) -> Table:
    """Return the paper's figures with ours of the same meaning, at the setting that it states."""
    rows = []
    below = []
    for it in PUBLISHED:
        setting = _same(it, results)
        floor_m = results.floor_m(setting.threshold_m)
        if it.figure == "mtd_m" and floor_m is not None and it.value < floor_m:
            below.append((it, setting, floor_m))
            comparable = "no: below the floor (4)"
        else:
            comparable = {
                "ceased": "in part (1, 2)",
                "mtd_m": "in part (1, 3)",
                "search_time_s": "ratios only (5)",
            }[it.figure]
        rows.append(
            [
                COLUMNS[it.figure][0],
                _stated(it),
                it.method,
                f"{'< ' if it.below else ''}{it.value * COLUMNS[it.figure][1]:g}",
                f"{setting.particles}, {setting.threshold_m:g}",
                _beside(results, it.policy, setting, it.figure),
                _beside(results, results.best(setting, results.policies), setting, it.figure),
                comparable,
            ]
        )
    heads = [
        "figure",
        "the paper's setting",
        "method",
        "the paper",
        "our N, ζ",
        "ours, same method",
        "ours, best",
        "comparable",
    ]
    return Table(
        "The paper's figures beside ours",
        heads,
        rows,
        [
            "In brackets: 95% intervals. In parentheses: missions. *best*: the policy with the lowest MTD "
            "among those whose ceased share is"
            " within one point of the highest. –: not flown, or no mission ceased.",
            f"(1) The paper states no τ, step budget, prior or success radius. Ours are τ = {LIFETIME_S:g} "
            f"s, {BUDGET_STEPS} steps,"
            f" a uniform prior over the area and {SUCCESS_RADIUS_M:g} m. Its scenarios may be easier or "
            "harder. Where it states N only, our"
            f" figure is at ζ = {results.threshold_m:g} m; where it states ζ only, at N = "
            f"{results.particles:,}.",
            '(2) The paper\'s "success rate" is the share of missions that ceased. It does not say how many '
            "of these stops were false. Ours"
            " adds the share located.",
            "(3) A mean over ceased missions only: for a method that ceases less often, it covers its easier "
            "missions.",
            *([_below_the_floor(results, below)] if below else []),
            "(5) Compute times of different code on different machines; of ours, several missions ran side "
            "by side.",
        ],
    )


def _same(it: Published, results: Results) -> Setting:
    if it.particles is None and it.threshold_m is None:
        return results.usual
    return Setting(it.particles or results.particles, it.threshold_m or results.threshold_m)


def _stated(it: Published) -> str:
    stated = [
        *([f"N = {it.particles}"] if it.particles else []),
        *([f"ζ = {it.threshold_m:g} m"] if it.threshold_m else []),
    ]
    return ", ".join(stated) or UNKNOWN


def _beside(results: Results, policy: str | None, setting: Setting, figure: str) -> str:
    said = results.figures.get((policy or "", setting))
    if said is None or said[figure] is None:
        return UNKNOWN
    more = {"ceased": f", located {cell(said, 'located')}", "mtd_m": f", {cell(said, 'mtd_floors')} floors"}
    return f"{policy}: {cell(said, figure)}{more.get(figure, '')} ({said['missions']})"


def _below_the_floor(results: Results, below: Sequence[tuple[Published, Setting, float]]) -> str:
    values = " and ".join(f"{it.value:g} m" for it, _, _ in below)
    floors = ", ".join(f"{floor_m:.1f} m at ζ = {setting.threshold_m:g} m" for _, setting, floor_m in below)
    seeds = sorted({row.seed for rows in results.rows.values() for row in rows})
    straight_m = np.mean([math.dist(it.start, it.source) for it in map(draw, seeds)])
    return (
        f"(4) {values} cannot be reached with this noise, these starts and these sources. They are below the "
        "mean information floor"
        f" ({floors}): even an oracle that knows the source and flies the best path cannot expect the spread "
        "to be below ζ earlier. The"
        f" mean distance to the source is {straight_m:.1f} m over {len(seeds):,} seeds. docs/floor.md "
        "derives the floor."
    )
