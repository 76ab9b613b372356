"""The report's pictures: pure functions from results or flights to a matplotlib figure."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from matplotlib.transforms import ScaledTranslation
from numpy.typing import NDArray

from agent.trials.report.published import PUBLISHED, Published
from agent.trials.report.results import Key, Results, Setting
from plume.dispersion import concentration
from plume.outcome import Outcome, TracePoint
from plume.scenario import AREA_M, SUCCESS_RADIUS_M

Array = NDArray[np.float64]
Flight = tuple[Outcome, list[TracePoint]]

STYLE: Any = {
    "font.size": 10.0,
    "axes.titlesize": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "savefig.dpi": 150,
    "svg.hashsalt": "plumeward",  # the same picture gives the same file
}
"""Settings of matplotlib while a picture is made and saved."""
WIDTH_IN = 10.0
LOOKS = {
    "infotaxis": ("#0072b2", "o"),
    "infotaxis-variance": ("#56b4e9", "s"),
    "space-aware-infotaxis": ("#332288", "d"),
    "entrotaxis": ("#009e73", "^"),
    "entrotaxis-belief": ("#44aa99", "v"),
    "dcee": ("#d55e00", "P"),
    "thompson": ("#cc79a7", "X"),
    "greedy": ("#e69f00", "<"),
    "random": ("#8c564b", ">"),
    "lookahead": ("#f0e442", "H"),
    "homing": ("#e41a1c", "D"),
    "ppo": ("#000000", "*"),
    "dqn": ("#882255", "h"),
    "ddpg": ("#999933", "p"),
}
"""Colour and marker of each policy in all pictures. Policies of similar colours have different markers."""
OTHER_LOOK = ("#777777", "8")
PANELS = (("ceased", "ceased, %", 100.0), ("mtd_m", "MTD, m", 1.0), ("search_time_s", "ST, s", 1.0))
"""(figure, label, scale)."""
GAS = (0.1, 100.0)
"""Range of concentrations shown, g/m³; it begins at half the noise in clean air."""
START: dict[str, Any] = {"marker": "o", "markersize": 7, "markerfacecolor": "white", "linestyle": "none", "clip_on": False, "zorder": 5}
ESTIMATE: dict[str, Any] = {"marker": "x", "markersize": 9, "markeredgewidth": 2.2, "linestyle": "none", "zorder": 5}
SOURCE: dict[str, Any] = {"marker": "*", "markersize": 13, "color": "black", "markeredgecolor": "white", "linestyle": "none", "zorder": 4}
PLUME = LinearSegmentedColormap.from_list("plume", ["white", "#666666"])
COLOURS = ("#0072b2", "#d55e00", "#009e73")
NAMED = (("position", "UAV", COLOURS[0]), ("mean", "belief mean", COLOURS[1]))
LAST_STEPS = 10
APART_IN = 0.025
"""Distance between the points of two policies at one setting."""
LEAST_DISTANCE_M = 0.05
"""Shorter distances are drawn at this value."""


def against_particles(results: Results) -> Figure:
    """Ceased, MTD and ST against the number of particles, at one ζ."""
    keys = [key for key in results.rows if key[1].threshold_m == results.threshold_m]
    figure = _panels(results, keys, lambda it: it.particles)
    for ax in figure.axes:
        ax.set(xlabel="particles", xscale="log")
        _ticks(ax.xaxis, {key[1].particles for key in keys}, "{:,.0f}")
        ax.tick_params(axis="x", labelrotation=45)
    return figure


def against_thresholds(results: Results) -> Figure:
    """Ceased, MTD and ST against ζ, with one number of particles."""
    keys = [key for key in results.rows if key[1].particles == results.particles]
    figure = _panels(results, keys, lambda it: it.threshold_m)
    for ax in figure.axes:
        ax.set(xlabel="ζ, m")
        _ticks(ax.xaxis, {key[1].threshold_m for key in keys}, "{:g}")
    return figure


def _panels(results: Results, keys: Sequence[Key], x_of: Callable[[Setting | Published], float | None]) -> Figure:
    """One panel per figure, one curve per policy; the paper's figures are hollow."""
    figure = Figure(figsize=(WIDTH_IN, 4.8), layout="constrained")
    policies = [policy for policy in results.policies if policy in {key[0] for key in keys}]
    for ax, (name, label, scale) in zip(figure.subplots(1, 3), PANELS, strict=True):
        ax.set(ylabel=label, xmargin=0.1)
        for i, policy in enumerate(policies):
            said = [(x_of(key[1]), results.figures[key]) for key in keys if key[0] == policy]
            curve = [(x, it[name], *it[f"{name}_interval"]) for x, it in said if it[name] is not None]
            x, value, low, high = np.array(sorted(curve)).reshape(-1, 4).T * [[1], [scale], [scale], [scale]]
            bars = np.maximum((value - low, high - value), 0)  # rounding can put an end of the interval past the value
            beside = ScaledTranslation((i - (len(policies) - 1) / 2) * APART_IN, 0, figure.dpi_scale_trans)
            colour, marker = LOOKS.get(policy, OTHER_LOOK)
            style: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 5, "linewidth": 1.2}
            ax.errorbar(x, value, bars, label=policy, transform=ax.transData + beside, **style)
            ax.update_datalim(np.stack([np.tile(x, 2), np.concatenate([low, high])], axis=1))  # autoscaling ignores shifted points
        for it in PUBLISHED:
            if it.figure == name and (at := x_of(it)) is not None:
                colour, marker = LOOKS[it.policy]
                style = {"color": colour, "marker": marker, "markersize": 9, "markerfacecolor": "white", "linestyle": "none", "zorder": 5}
                ax.plot(at, scale * it.value, label=f"paper: {it.method}", **style)
    ceased, mtd, st = figure.axes
    ceased.set_yscale("function", functions=(_stretched, _unstretched))
    ceased.set_ylim(0, 100.3)
    _ticks(ceased.yaxis, (0, 50, 80, 90, 95, 98, 99, 100), "{:g}")
    floors = sorted({(x_of(key[1]), floor_m) for key in keys if (floor_m := results.floor_m(key[1].threshold_m)) is not None})
    if floors:
        mtd.plot(*zip(*floors, strict=True), "--", color="black", linewidth=1.2, label="information floor")
    mtd.set_yscale("log")
    _ticks(mtd.yaxis, (10, 15, 20, 30, 50, 100, 150, 200, 300), "{:g}")
    st.set_yscale("log")
    _ticks(st.yaxis, [digit * 10**power for power in (-3, -2, -1, 0, 1) for digit in (1, 2, 5)], "{:g}")
    entries = {label: handle for ax in figure.axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    order = [*policies, *(label for label in entries if label not in policies)]
    figure.legend([entries[label] for label in order], order, loc="outside lower center", ncols=4)
    return figure


def _stretched(percent: Array) -> Array:
    """Stretch the scale towards 100%, where most policies are."""
    height: Array = -np.log10(101 - np.minimum(percent, 100.9))
    return height


def _unstretched(height: Array) -> Array:
    percent: Array = 101 - 10**-height
    return percent


def _ticks(axis: Axis, values: Iterable[float], form: str) -> None:
    axis.set_major_locator(FixedLocator(sorted(values)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: form.format(value)))


def trajectories(flights: Sequence[Flight]) -> Figure:
    """One panel per policy, all on one scenario."""
    columns = 3 if len(flights) <= 9 else 4
    rows = -(-len(flights) // columns)
    figure = Figure(figsize=(WIDTH_IN, 0.9 + rows * (0.5 + 0.78 * WIDTH_IN / columns)), layout="compressed")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for ax, (result, trace) in zip(grid.ravel(), flights, strict=False):
        plume = _plume(ax, result)
        colour, _ = LOOKS.get(result.policy, OTHER_LOOK)
        ax.plot(*_places(trace, "position").T, color=colour, linewidth=1.6)
        ax.plot(*trace[0].position, color=colour, **START)
        ax.plot(*result.source, **SOURCE)
        ax.plot(*result.estimate, color=colour, **ESTIMATE)
        ax.set(xlim=(0, AREA_M), ylim=(0, AREA_M), aspect="equal")
        ax.set_title(f"{result.policy}\n{_verdict(result)}")
        ax.grid(visible=False)
    for ax in grid.ravel()[len(flights) :]:
        ax.set_axis_off()
    for ax in grid[-1]:
        ax.set_xlabel("east, m")
    for ax in grid[:, 0]:
        ax.set_ylabel("north, m")
    bar = figure.colorbar(plume, ax=grid, label="mean gas concentration, g/m³", shrink=0.5, aspect=40)
    _ticks(bar.ax.yaxis, (0.1, 1, 10, 100), "{:g}")
    styles = {"start": START, "path": {}, "estimate at the end": ESTIMATE, "source": SOURCE}
    entries = [Line2D([], [], **{"color": "#555555", "label": label} | style) for label, style in styles.items()]
    figure.legend(handles=entries, loc="outside lower center", ncols=4)
    return figure


def _plume(ax: Axes, result: Outcome) -> AxesImage:
    it = result.scenario
    side = AREA_M / 90
    axis = np.arange(side / 2, AREA_M, side)
    places = np.stack(np.meshgrid(axis, axis), axis=-1)
    gas = concentration(places, result.source, it.wind, rate=it.q, diffusivity=it.d, lifetime=it.tau)
    return ax.imshow(gas, norm=LogNorm(*GAS), cmap=PLUME, origin="lower", extent=(0, AREA_M, 0, AREA_M), interpolation="bilinear")


def _verdict(result: Outcome) -> str:
    verdict = ("ceased, located" if result.located else "ceased, FALSE STOP") if result.ceased else "not ceased"
    return f"{verdict}, {result.distance_m:.0f} m"


def many(flights: Sequence[Flight]) -> Figure:
    """Paths of UAV and belief mean in many missions, with the source at the origin; below, their last steps."""
    figure = Figure(figsize=(WIDTH_IN, 9.6), layout="constrained")
    grid = figure.subplots(2, 2, sharex="row", sharey="row")
    for (whole, last), (name, what, colour) in zip(grid.T, NAMED, strict=True):
        for result, trace in flights:
            path = _places(trace, name) - result.source
            whole.plot(*path.T, color=colour, linewidth=0.7, alpha=0.4)
            last.plot(*path[-LAST_STEPS - 1 :].T, color=colour, linewidth=0.7, alpha=0.4)
            for ax in (whole, last):
                ax.plot(*path[-1], "o", color=colour, markersize=4, markeredgecolor="white", markeredgewidth=0.4, zorder=3)
        whole.set(title=f"{what}, whole missions")
        last.set(title=f"{what}, the last {LAST_STEPS} steps", xlim=(-4, 4), ylim=(-4, 4))
        last.add_patch(Circle((0, 0), SUCCESS_RADIUS_M, fill=False, linestyle="--", linewidth=1.2, zorder=4))
        for ax in (whole, last):
            ax.plot(0, 0, **SOURCE)
            ax.set(aspect="equal", xlabel="east of the source, m", ylabel="north of the source, m")
    return figure


def distances(flights: Sequence[Flight]) -> Figure:
    """Distances at each step of many missions with median and quartiles, and the number of missions still flying.

    Median and quartiles include ended missions with their last distance.
    """
    figure = Figure(figsize=(WIDTH_IN, 7.0), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True).ravel()
    lengths = np.array([len(trace) for _, trace in flights])
    steps = np.arange(lengths.max())
    for ax, label, colour in zip(panels, ("UAV to source, m", "UAV to estimate, m", "estimate to source, m"), COLOURS, strict=False):
        held = []
        for result, trace in flights:
            ends = {"UAV": _places(trace, "position"), "estimate": _places(trace, "mean"), "source": np.array(result.source)}
            one, other = label.removesuffix(", m").split(" to ")
            distance = np.maximum(np.linalg.norm(ends[one] - ends[other], axis=-1), LEAST_DISTANCE_M)
            ax.plot(distance, color=colour, linewidth=0.5, alpha=0.3)
            ax.plot(len(distance) - 1, distance[-1], "o", color=colour, markersize=2.5)
            held.append(np.pad(distance, (0, len(steps) - len(distance)), mode="edge"))
        low, median, high = np.quantile(held, (0.25, 0.5, 0.75), axis=0)
        ax.fill_between(steps, low, high, color=colour, alpha=0.25, linewidth=0, label="quartiles")
        ax.plot(steps, median, color="black", linewidth=2, label="median")
        ax.set(ylabel=label, yscale="log", ylim=(LEAST_DISTANCE_M, AREA_M * 2**0.5))
        _ticks(ax.yaxis, (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 40), "{:g}")
    panels[0].legend()
    panels[3].step(steps, (lengths > steps[:, None]).sum(axis=1), where="post", color="#555555")
    panels[3].set(ylabel="missions still flying", ylim=(0, len(flights) * 1.03))
    for ax in panels[2:]:
        ax.set(xlabel="step")
    return figure


def _places(trace: Sequence[TracePoint], name: str) -> Array:
    """(steps, 2) m."""
    return np.array([getattr(point, name) for point in trace])
