"""The report's pictures: pure functions from results or flights to a matplotlib figure."""

from collections.abc import Sequence
from operator import attrgetter
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.transforms import ScaledTranslation

from agent.policies import OURS
from agent.trials.report.published import PUBLISHED
from agent.trials.report.results import Results
from plume.elementary import Array
from plume.outcome import Outcome, TracePoint
from plume.problem import AREA
from plume.scenario import AREA_M, SUCCESS_RADIUS_M
from scene.drawing import ESTIMATE, INK, SOURCE, START, plume, ticks
from scene.scene import Release

Trial = tuple[Outcome, list[TracePoint]]

WIDTH_IN = 10.0
# Colour and marker of each policy in all pictures. Those of `FIVE` are of Okabe and Ito's palette.
LOOKS = {
    "infotaxis": ("#0072b2", "o"),
    "infotaxis-variance": ("#56b4e9", "s"),
    "space-aware-infotaxis": ("#009e73", "d"),
    "entrotaxis": ("#332288", "^"),
    "entrotaxis-belief": ("#44aa99", "v"),
    "dcee": ("#e69f00", "P"),
    "thompson": ("#cc79a7", "X"),
    "greedy": ("#e41a1c", "<"),
    "random": ("#8c564b", ">"),
    "lookahead": ("#f0e442", "H"),
    "homing": ("#d55e00", "D"),
    "ppo": ("#000000", "*"),
    "dqn": ("#882255", "h"),
    "ddpg": ("#999933", "p"),
}
OTHER_LOOK = ("#777777", "8")
# The policies that pictures compare: the classic, the best published planner, the one of dual control, our
# default, and the best learned.
#
# The others fly much as one of them does (entrotaxis as infotaxis, lookahead as homing, dqn and ddpg as ppo),
# or find few sources.
FIVE = ("infotaxis", "space-aware-infotaxis", "dcee", "homing", "ppo")
PATH: dict[str, Any] = {"color": INK, "linewidth": 1.2, "marker": ".", "markersize": 3.5}
# (figure, label, scale).
PANELS = (("ceased", "ceased, %", 100.0), ("mtd_m", "MTD, m", 1.0), ("search_time_s", "ST, s", 1.0))
COLOURS = ("#0072b2", "#d55e00", "#009e73")
PATHS = (("position", "UAV", COLOURS[0]), ("mean", "belief mean", COLOURS[1]))
# (label, scale, form of its numbers, degrees by which they are turned).
AXES = {"particles": ("particles", "log", "{:,.0f}", 45), "threshold_m": ("ζ, m", "linear", "{:g}", 0)}
LAST_STEPS = 10
BEHIND = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}  # a figure on a bar
APART_IN = 0.025  # distance between the points of two policies at one setting
LEAST_DISTANCE_M = 0.05  # shorter distances are drawn at this value


def compared(policies: Sequence[str]) -> list[str]:
    """Return the policies that one picture shows: up to five, else `FIVE` and those that do not ship."""
    if len(policies) <= len(FIVE):
        return list(policies)
    return [policy for policy in policies if policy in FIVE or policy not in OURS] or list(
        policies[: len(FIVE)]
    )


def against(results: Results, axis: str) -> Figure:
    """Ceased, MTD and ST against `particles` or `threshold_m`: a curve for each policy.

    Of one setting alone there are no curves: bars. The paper's figures are hollow.
    """
    if results.is_one_along(axis):
        return of_one_setting(results, axis)
    label, scale, form, turned = AXES[axis]
    x_of, keys = attrgetter(axis), results.along(axis)
    figure = Figure(figsize=(WIDTH_IN, 4.8), layout="constrained")
    policies = [policy for policy in compared(results.policies) if policy in {key[0] for key in keys}]
    for ax, (name, of, factor) in zip(figure.subplots(1, 3), PANELS, strict=True):
        ax.set(ylabel=of, xmargin=0.1)
        for i, policy in enumerate(policies):
            said = [(x_of(key[1]), results.figures[key]) for key in keys if key[0] == policy]
            curve = [(x, it[name], *it[f"{name}_interval"]) for x, it in said if it[name] is not None]
            x, value, low, high = np.array(sorted(curve)).reshape(-1, 4).T * [
                [1],
                [factor],
                [factor],
                [factor],
            ]
            # Rounding can put an end of the interval past the value.
            bars = np.maximum((value - low, high - value), 0)
            beside = ScaledTranslation((i - (len(policies) - 1) / 2) * APART_IN, 0, figure.dpi_scale_trans)
            colour, marker = LOOKS.get(policy, OTHER_LOOK)
            style: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 5, "linewidth": 1.2}
            ax.errorbar(x, value, bars, label=policy, transform=ax.transData + beside, **style)
            # Autoscaling ignores shifted points.
            ax.update_datalim(np.stack([np.tile(x, 2), np.concatenate([low, high])], axis=1))
        for it in PUBLISHED:
            if it.figure == name and it.policy in policies and (at := x_of(it)) is not None:
                colour, marker = LOOKS[it.policy]
                style = {
                    "color": colour,
                    "marker": marker,
                    "markersize": 9,
                    "markerfacecolor": "white",
                    "linestyle": "none",
                    "zorder": 5,
                }
                ax.plot(at, factor * it.value, label=f"paper: {it.method}", **style)
    ceased, mtd, st = figure.axes
    ceased.set_yscale("function", functions=(_stretched, _unstretched))
    ceased.set_ylim(0, 100.3)
    ticks(ceased.yaxis, (0, 50, 80, 90, 95, 98, 99, 100), "{:g}")
    floors = sorted(
        {
            (x_of(key[1]), floor_m)
            for key in keys
            if (floor_m := results.floor_m(key[1].threshold_m)) is not None
        }
    )
    if floors:
        mtd.plot(*zip(*floors, strict=True), "--", color="black", linewidth=1.2, label="information floor")
    mtd.set_yscale("log")
    ticks(mtd.yaxis, (10, 15, 20, 25, 30, 40, 50, 70, 100, 150, 200, 300), "{:g}")
    st.set_yscale("log")
    ticks(st.yaxis, [digit * 10**power for power in (-3, -2, -1, 0, 1) for digit in (1, 2, 5)], "{:g}")
    for ax in figure.axes:
        ax.set(xlabel=label, xscale=scale)
        ticks(ax.xaxis, {x_of(key[1]) for key in keys}, form)
        ax.tick_params(axis="x", labelrotation=turned)
    entries = {
        label: handle
        for ax in figure.axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    order = [*policies, *(label for label in entries if label not in policies)]
    figure.legend([entries[label] for label in order], order, loc="outside lower center", ncols=4)
    return figure


def of_one_setting(results: Results, axis: str) -> Figure:
    """Ceased, MTD and ST of one setting: a bar for each policy, with its interval and its figure."""
    keys = results.along(axis)
    setting = keys[0][1]
    policies = [policy for policy in compared(results.policies) if (policy, setting) in keys]
    figure = Figure(figsize=(WIDTH_IN, 1.6 + 0.42 * len(policies)), layout="constrained")
    labels: dict[str, Any] = {}
    for ax, (name, of, factor) in zip(figure.subplots(1, 3, sharey=True), PANELS, strict=True):
        ax.set(xlabel=of, ylim=(len(policies) - 0.4, -0.6))  # the first one is on top
        for place, policy in enumerate(policies):
            said = results.figures[policy, setting]
            if said[name] is None:
                continue
            value, low, high = (factor * it for it in (said[name], *said[f"{name}_interval"]))
            colour, _ = LOOKS.get(policy, OTHER_LOOK)
            ax.barh(place, value, height=0.62, color=colour, alpha=0.75)
            ax.errorbar(
                value, place, xerr=[[max(value - low, 0)], [max(high - value, 0)]], color=INK, capsize=3
            )
            ax.annotate(
                f"{value:.3g}",
                (0, place),
                (4, 0),
                textcoords="offset points",
                va="center",
                size=9,
                bbox=BEHIND,
            )
        for it in PUBLISHED:
            if it.figure == name and it.policy in policies and attrgetter(axis)(it) == getattr(setting, axis):
                colour, marker = LOOKS[it.policy]
                style = {"color": colour, "marker": marker, "markersize": 9, "markerfacecolor": "white"}
                (point,) = ax.plot(
                    factor * it.value, policies.index(it.policy), linestyle="none", zorder=5, **style
                )
                labels[f"paper: {it.method}"] = point
        ax.set_xlim(0, 100 if name == "ceased" else None)
        ax.grid(visible=False, axis="y")
        ax.set_yticks(range(len(policies)), policies)
    floor_m = results.floor_m(setting.threshold_m)
    if floor_m is not None:
        labels["information floor"] = figure.axes[1].axvline(
            floor_m, color="black", linestyle="--", linewidth=1.2
        )
    if labels:
        figure.legend(list(labels.values()), list(labels), loc="outside lower center", ncols=4)
    return figure


def _stretched(percent: Array) -> Array:
    """Stretch the scale towards 100%, where most policies are."""
    return np.asarray(-np.log10(101 - np.minimum(percent, 100.9)))


def _unstretched(height: Array) -> Array:
    return 101 - 10**-height


def trajectories(flights: Sequence[Trial]) -> Figure:
    """One panel per policy, all on one scenario."""
    columns = 3
    rows = -(-(len(flights) + 1) // columns)  # the last panel is the legend's
    figure = Figure(figsize=(WIDTH_IN, 0.4 + rows * (0.5 + 0.86 * WIDTH_IN / columns)), layout="compressed")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for ax, (result, trace) in zip(grid.ravel(), flights, strict=False):
        assert result.scenario is not None  # an in-process mission knows it
        assert result.source is not None
        shades = plume(ax, Release.of(result.scenario), AREA)
        ax.plot(*_places(trace, "position").T, **PATH)
        ax.plot(*trace[0].position, color=INK, **START)
        ax.plot(*result.source, **SOURCE)
        ax.plot(*result.estimate, **ESTIMATE)
        ax.set(xlim=(0, AREA_M), ylim=(0, AREA_M), aspect="equal")
        stop = "ceased, located" if result.located else "ceased, FALSE STOP"
        ax.set_title(f"{result.policy}\n{stop if result.ceased else 'not ceased'}, {result.distance_m:.0f} m")
        ax.grid(visible=False)
    for i, ax in enumerate(grid.ravel()):
        lowest = i + columns >= len(flights)
        ax.set(xlabel="east, m" if lowest else "", ylabel="" if i % columns else "north, m")
        ax.tick_params(labelbottom=lowest)
        if i >= len(flights):
            ax.set_axis_off()
    bar = figure.colorbar(shades, ax=grid, label="mean gas concentration, g/m³", shrink=0.5, aspect=40)
    ticks(bar.ax.yaxis, (0.1, 1, 10, 100))
    styles = {
        "start": START | {"color": INK},
        "path and readings": PATH,
        "estimate at the end": ESTIMATE,
        "source": SOURCE,
    }
    grid.ravel()[-1].legend(
        handles=[Line2D([], [], label=label, **style) for label, style in styles.items()], loc="center"
    )
    return figure


def many(flights: Sequence[Trial]) -> Figure:
    """Paths of UAV and belief mean in many missions, with the source at the origin; below, the last steps."""
    figure = Figure(figsize=(WIDTH_IN, 9.6), layout="constrained")
    grid = figure.subplots(2, 2, sharex="row", sharey="row")
    for (whole, last), (name, what, colour) in zip(grid.T, PATHS, strict=True):
        for result, trace in flights:
            assert result.source is not None
            path = _places(trace, name) - result.source
            whole.plot(*path.T, color=colour, linewidth=0.7, alpha=0.4)
            last.plot(*path[-LAST_STEPS - 1 :].T, color=colour, linewidth=0.7, alpha=0.4)
            for ax in (whole, last):
                ax.plot(
                    *path[-1],
                    "o",
                    color=colour,
                    markersize=4,
                    markeredgecolor="white",
                    markeredgewidth=0.4,
                    zorder=3,
                )
        whole.set(title=f"{what}, whole missions")
        last.set(title=f"{what}, the last {LAST_STEPS} steps", xlim=(-4, 4), ylim=(-4, 4))
        last.add_patch(Circle((0, 0), SUCCESS_RADIUS_M, fill=False, linestyle="--", linewidth=1.2, zorder=4))
        for ax in (whole, last):
            ax.plot(0, 0, **SOURCE)
            ax.set(aspect="equal", xlabel="east of the source, m", ylabel="north of the source, m")
    return figure


def distances(flights: Sequence[Trial]) -> Figure:
    """Distances at each step of many missions, and the number of missions still flying.

    Median and quartiles include ended missions with their last distance.
    """
    figure = Figure(figsize=(WIDTH_IN, 7.0), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True).ravel()
    lengths = np.array([len(trace) for _, trace in flights])
    steps = np.arange(lengths.max())
    for ax, label, colour in zip(
        panels, ("UAV to source, m", "UAV to estimate, m", "estimate to source, m"), COLOURS, strict=False
    ):
        held = []
        for result, trace in flights:
            ends = {
                "UAV": _places(trace, "position"),
                "estimate": _places(trace, "mean"),
                "source": np.array(result.source),
            }
            one, other = label.removesuffix(", m").split(" to ")
            distance = np.maximum(np.linalg.norm(ends[one] - ends[other], axis=-1), LEAST_DISTANCE_M)
            ax.plot(distance, color=colour, linewidth=0.5, alpha=0.3)
            ax.plot(len(distance) - 1, distance[-1], "o", color=colour, markersize=2.5)
            held.append(np.pad(distance, (0, len(steps) - len(distance)), mode="edge"))
        low, median, high = np.quantile(held, (0.25, 0.5, 0.75), axis=0)
        ax.fill_between(steps, low, high, color=colour, alpha=0.25, linewidth=0, label="quartiles")
        ax.plot(steps, median, color="black", linewidth=2, label="median")
        ax.set(ylabel=label, yscale="log", ylim=(LEAST_DISTANCE_M, AREA_M * 2**0.5))
        ticks(ax.yaxis, (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 40), "{:g}")
    panels[0].legend()
    panels[3].step(steps, (lengths > steps[:, None]).sum(axis=1), where="post", color="#555555")
    panels[3].set(ylabel="missions still flying", ylim=(0, len(flights) * 1.03))
    for ax in panels[2:]:
        ax.set(xlabel="step")
    return figure


def _places(trace: Sequence[TracePoint], name: str) -> Array:
    return np.array([getattr(point, name) for point in trace])
