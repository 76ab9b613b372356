"""The drawing of scenes: one figure with the map of the search and the curves of spread and gas.

A figure for print shows a whole mission and the beliefs at chosen steps; the same figure, shown scene by
scene, is an animation.
"""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Ellipse, FancyArrowPatch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator
from numpy.typing import NDArray

from plume.problem import Area
from scene.scene import Measurement, Release, Scatter, Scene, WindShift, ellipse, turns

# Settings of matplotlib while a picture is made and saved.
STYLE: Any = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same letters everywhere
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
UNDATED = dict.fromkeys(("Creator", "Date", "Format", "Type"))  # SVG metadata that would differ each time
SIZE_IN = 9.6, 5.4
LEGEND_ROWS = 3  # there is room for below the map
FRAME_DPI = 100  # dots per inch of an animation: 960 × 540 pixels
MAP = 0.065, 0.2, 0.39, 0.39 * SIZE_IN[0] / SIZE_IN[1]  # left, bottom, width, height; shares of the figure
DOT = 5.0  # area of a particle of mean weight, square points
MANY = 1000  # with more particles dots are smaller; with more than a tenth as many readings, no dots
WIDE, HIGH = 0.13, 0.07  # of a name, by the map's sides
CELLS = 120  # along a side of the area, for the plume
GAS = (0.1, 100.0)  # range of concentrations shown, g/m³; it begins at half the noise in clean air
PLUME = LinearSegmentedColormap.from_list(
    "plume", ["#ffffff", "#fde3b8", "#fac06c", "#ee8f33", "#b9500f"]
).with_extremes(bad="#ffffff")
INK = "#222222"
WALL = "#cfcfcf"  # buildings
# Of the ways and the gas of several vehicles: the second's, the third's, …; the first's is INK.
OTHERS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#a6761d", "#882255")
# Colours of the beliefs shown, of Okabe and Ito's palette but for the last.
BELIEFS = ("#56b4e9", "#009e73", "#0072b2", "#cc79a7", "#882255")
PATH: dict[str, Any] = {"color": INK, "linewidth": 1.2}
CURVE: dict[str, Any] = PATH | {"marker": ".", "markersize": 4, "animated": True}
START: dict[str, Any] = {
    "marker": "o",
    "markersize": 7,
    "markerfacecolor": "white",
    "linestyle": "none",
    "clip_on": False,
    "zorder": 5,
}
SOURCE: dict[str, Any] = {
    "marker": "*",
    "markersize": 14,
    "color": "black",
    "markeredgecolor": "white",
    "linestyle": "none",
    "zorder": 4,
}
ESTIMATE: dict[str, Any] = {
    "marker": "X",
    "markersize": 8,
    "color": "white",
    "markeredgecolor": INK,
    "linestyle": "none",
    "zorder": 5,
}
VEHICLE: dict[str, Any] = {
    "marker": "^",
    "color": "#d55e00",
    "markeredgecolor": "white",
    "markersize": 12,
    "linestyle": "none",
}
TURNED = "#7b3294"  # where the wind turned
WIND: dict[str, Any] = {  # an arrow to where the air flows
    "arrowstyle": "-|>",
    "mutation_scale": 11,
    "linewidth": 1.6,
    "shrinkA": 0,
    "shrinkB": 0,
    "zorder": 3.8,
    "visible": False,
    "animated": True,
}
WIND_LENGTH = 0.09  # of such an arrow, by the longer side of the area
READINGS: dict[str, Any] = {
    "s": 16,
    "cmap": PLUME,
    "norm": LogNorm(*GAS, clip=True),
    "edgecolors": INK,
    "linewidths": 0.7,
}
NO_SCATTER = Scatter(np.empty((0, 2), np.float32), np.empty(0, np.float32))


def ticks(axis: Axis, values: Iterable[float], form: str = "{:g}") -> None:
    """Put ticks at these values and nowhere else."""
    axis.set_major_locator(FixedLocator(sorted(values)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: form.format(value)))


def plume(ax: Axes, release: Release, area: Area) -> AxesImage:
    """Shade the mean gas of a plume on a log scale."""
    return ax.imshow(
        np.maximum(release.gas(area, CELLS), GAS[0]),
        norm=LogNorm(*GAS),
        cmap=PLUME,
        origin="lower",
        extent=(area.low[0], area.high[0], area.low[1], area.high[1]),
        interpolation="bilinear",
    )


class _Cloud:
    """One belief in its colour: particles and ellipse on the map, and its marks on the curves."""

    def __init__(self, drawing: "Drawing", colour: str) -> None:
        self.colour = colour
        # Rasterized: a thousand dots as vectors would be most of an SVG.
        self.dots = drawing.map.scatter(
            [], [], s=[], color=colour, alpha=0.55, linewidths=0, zorder=2, rasterized=True, animated=True
        )
        self.ring = Ellipse(
            (0, 0),
            1,
            1,
            fill=False,
            edgecolor=colour,
            linewidth=1.8,
            zorder=3.5,
            visible=False,
            animated=True,
        )
        drawing.map.add_patch(self.ring)
        (self.spread,), (self.gas,) = (
            chart.plot(
                [], [], color=colour, marker="o", markersize=7, linestyle="none", zorder=4, animated=True
            )
            for chart in (drawing.spread, drawing.gas)
        )

    def show(self, scene: Scene) -> None:
        """Show the newest belief of a scene, if it has one."""
        last = scene.measurements[-1] if scene.measurements else None
        cloud = scene.scatter or NO_SCATTER
        areas = DOT * min(len(cloud.weights), MANY) * cloud.weights  # as the weights
        self.dots.set_offsets(cloud.places)
        self.dots.set_sizes(np.minimum(areas, 20 * DOT))
        self.ring.set_visible(last is not None)
        if last:
            longer, shorter, angle = ellipse(last.covariance)
            self.ring.set(
                center=last.estimate, width=2 * longer, height=2 * shorter, angle=math.degrees(angle)
            )
        self.spread.set_data(*([last.step], [last.spread_m]) if last else ([], []))
        self.gas.set_data(*([last.step], [last.gas]) if last else ([], []))


class _Vehicle:
    """One vehicle in its colour: its way and its start on the map, and the gas that it has read."""

    def __init__(self, drawing: "Drawing", colour: str, name: str) -> None:
        self.colour, self._map = colour, drawing.map
        line = PATH | {"color": colour, "animated": True}
        (self.path,) = drawing.map.plot([], [], zorder=2.5, label="path", **line)
        (self._start,) = drawing.map.plot([], [], color=colour, animated=True, **START)
        (self._craft,) = drawing.map.plot([], [], zorder=6, animated=True, **VEHICLE)
        (self.gases,) = drawing.gas.plot([], [], **CURVE | {"color": colour})
        self.name = drawing.map.annotate(
            name, (0, 0), (6, 6), textcoords="offset points", color=colour, size=9, zorder=6, animated=True
        )
        self.name.set_path_effects([withStroke(linewidth=2.5, foreground="white")])

    def show(self, scene: Scene, *, crafts: bool) -> None:
        """Show a scene of it; crafts: with the vehicle where it is."""
        taken = scene.measurements
        places = np.array([it.position for it in taken], np.float64).reshape(-1, 2)
        self.path.set_data(*places.T)
        self._start.set_data(*places[:1].T)
        self.gases.set_marker(_dot(taken))
        self.gases.set_data([it.step for it in taken], [it.gas for it in taken])
        shown = scene.craft if crafts else None
        self._craft.set_data(*([shown.position[0]], [shown.position[1]]) if shown else ([], []))
        if shown:
            self._craft.set_marker(_nose(shown.heading))
        at = shown.position if shown else places[0] if len(places) else None
        self.name.set_visible(at is not None and bool(np.isfinite(at).all()))
        if at is not None:
            self.name.xy = float(at[0]), float(at[1])
            self._turn_name(places)

    def _turn_name(self, way: NDArray[np.float64]) -> None:
        """Write the name beside its place, away from the way; near the map's edge, inwards."""
        along, up = self._map.transLimits.transform(self.name.xy)
        is_right, is_below = along < 1 - WIDE, len(way) > 0 and way[:, 1].mean() > self.name.xy[1]
        is_above = up < HIGH or (up < 1 - HIGH and not is_below)
        self.name.set(ha="left" if is_right else "right", va="bottom" if is_above else "top")
        self.name.set_position((6 if is_right else -6, 6 if is_above else -6))


class _TurnedWind:
    """One turn of the wind: two arrows at its place, before and after, and a line in the charts."""

    def __init__(self, drawing: "Drawing", turn: WindShift, length_m: float) -> None:
        self.step = turn.step
        x, y = turn.place
        self.artists: list[Artist] = []
        for (east, north), line in ((turn.before, ":"), (turn.after, "-")):
            share = length_m / math.hypot(east, north)
            head = x - east * share, y - north * share  # air flows away from where the wind comes from
            arrow = FancyArrowPatch((x, y), head, color=TURNED, linestyle=line, **WIND)
            self.artists.append(drawing.map.add_patch(arrow))
        for chart in (drawing.spread, drawing.gas):
            self.artists.append(
                chart.axvline(
                    turn.step, color=TURNED, linewidth=1, linestyle=":", visible=False, animated=True
                )
            )
        self.artists.append(
            drawing.spread.text(
                turn.step,
                1.02,
                f"wind {turn.degrees:.0f}°",
                transform=drawing.spread.get_xaxis_transform(),
                color=TURNED,
                size=8,
                ha="center",
                visible=False,
                animated=True,
            )
        )

    def show(self, turned: bool) -> None:
        """Show it, or not yet."""
        for artist in self.artists:
            artist.set_visible(turned)


class Drawing:
    """One figure that shows scenes of one mission, one after the other.

    What does not change is drawn once.
    """

    def __init__(
        self, scene: Scene, beliefs: Sequence[Scene] = (), steps: int = 20, beside: Sequence[Scene] = ()
    ) -> None:
        """Draw what does not change.

        beliefs: for print, up to 5 scenes whose newest beliefs are shown; else each scene's own belief is,
        with the vehicle. The charts begin with room for `steps`.
        beside: the scenes of the other vehicles of the search.
        """
        self._backdrop = scene.backdrop
        self._names = [it.backdrop.vehicle for it in (scene, *beside)]
        self._is_print = bool(beliefs)
        # Of the charts: steps, gas below 0, gas; and of the map, m around the area.
        self._room = [float(max(steps, 1)), 0.5, 10.0, 0.0]
        self._moving: list[Any] = []  # what changes
        self._still: Any = None  # the picture without what changes; None while it is not up to date
        with matplotlib.rc_context(STYLE):
            self.figure = Figure(figsize=SIZE_IN, dpi=FRAME_DPI)
            self._canvas: Any = FigureCanvasAgg(self.figure)  # has no types
            self.map = self.figure.add_axes(MAP)
            self.spread = self.figure.add_axes((0.665, 0.565, 0.315, 0.328))
            self.gas = self.figure.add_axes((0.665, 0.2, 0.315, 0.328))
            self._compass = self.figure.add_axes((0.475, 0.77, 0.07, 0.07 * SIZE_IN[0] / SIZE_IN[1]))
            self._lay_map()
            self._lay_charts(scene)
            self._begin(max(len(beliefs), 1))
            for cloud, believed in zip(self._clouds, beliefs, strict=False):
                cloud.show(believed)
            self._turns = self._lay_turns(scene)
            said = [it.measurements[-1].step for it in beliefs if it.measurements]
            self._lay_legend([f" at step {step}" for step in said] or [""])

    def show(self, scene: Scene, beside: Sequence[Scene] = ()) -> "Drawing":
        """Show a scene, and those of the other vehicles of the search; returns itself."""
        with matplotlib.rc_context(STYLE):
            self._make_room(scene, beside)
            self._show_readings([scene, *beside])
            for vehicle, its in zip(self.vehicles, (scene, *beside), strict=True):
                vehicle.show(its, crafts=not self._is_print)
            self._show_search(scene)
            self._show_wind(scene)
            if not self._is_print:
                self._clouds[0].show(scene)
            verdict = scene.ending.verdict if scene.ending else ""
            self._title.set_text(": ".join(filter(None, (self._backdrop.title, verdict))))
            self._text.set_text(_state(scene))
        return self

    def pixels(self) -> NDArray[np.uint8]:
        """Return what is shown as an image, (540, 960, 3), in red, green and blue."""
        with matplotlib.rc_context(STYLE):
            if self._still is None:
                self._canvas.draw()
                self._still = self._canvas.copy_from_bbox(self.figure.bbox)
            self._canvas.restore_region(self._still)
            for artist in self._moving:
                artist.axes.draw_artist(artist)
            return np.array(self._canvas.buffer_rgba())[..., :3].copy()

    def save(self, path: Path, form: str) -> None:
        """Write what is shown as a `png` or an `svg`. The same scenes give the same file."""
        with matplotlib.rc_context(STYLE):
            self.figure.savefig(path, format=form, metadata=UNDATED if form == "svg" else None)

    # ---- what does not change ----

    def _lay_map(self) -> None:
        area, release = self._backdrop.area, self._backdrop.release
        (west, south), (east, north) = area.low, area.high
        self.map.grid(visible=False)
        self.map.spines[["top", "right"]].set_visible(True)
        shades = plume(self.map, release, area) if release else ScalarMappable(LogNorm(*GAS), PLUME)
        for source in release.sources if release else ():
            self.map.plot(*source, **SOURCE)
        self.map.plot(
            (west, east, east, west, west),
            (south, south, north, north, south),
            color=INK,
            linewidth=1,
            zorder=1,
        )
        for outline in self._backdrop.walls:
            self.map.fill(*np.array(outline).T, facecolor=WALL, edgecolor=INK, linewidth=0.8, zorder=1)
        if fence := self._backdrop.fence:
            self.map.fill(*np.array(fence).T, fill=False, edgecolor=INK, linestyle="--", zorder=1)
        self.map.set(aspect="equal", xlabel="east, m", ylabel="north, m")
        bar = self.figure.colorbar(shades, cax=self.figure.add_axes((0.475, MAP[1], 0.014, 0.5)))
        bar.set_label("gas, mean and measured, g/m³" if release else "gas measured, g/m³")
        ticks(bar.ax.yaxis, (0.1, 1, 10, 100))
        self._compass.set(xlim=(-1, 1), ylim=(-1, 1))
        self._compass.set_axis_off()

    def _lay_charts(self, scene: Scene) -> None:
        zeta_m = scene.threshold_m
        self.spread.set(
            ylabel="spread, m",
            yscale="log",
            ylim=(min(0.1, (zeta_m or 1) / 4), max(20, self._backdrop.area.side_m * 2 / 3)),
        )
        ticks(self.spread.yaxis, (0.1, 0.3, 1, 3, 10, 30, 100, 300, 1000))
        self.spread.tick_params(labelbottom=False)
        if zeta_m is not None:
            self.spread.axhline(zeta_m, color=INK, linestyle="--", linewidth=1)
            self.spread.text(  # below the line, where there is no spread before the stop
                0.015,
                zeta_m * 0.93,
                f"ζ = {zeta_m:g} m",
                transform=self.spread.get_yaxis_transform(),
                va="top",
                size=9,
            )
        self.gas.set(xlabel="step", ylabel="gas, g/m³")
        self.gas.set_yscale("symlog", linthresh=1)
        ticks(self.gas.yaxis, (0, 1, 10, 100, 1000))
        for chart in (self.spread, self.gas):
            chart.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        self._lay_limits()

    def _lay_limits(self) -> None:
        steps, below, above, around_m = self._room
        area = self._backdrop.area
        longer_m = max(area.size_m)  # the map is square, whatever the area is
        ends = [
            (low - off_m - around_m, high + off_m + around_m)
            for low, high in zip(area.low, area.high, strict=True)
            for off_m in [(longer_m - (high - low)) / 2]
        ]
        self.map.set(xlim=ends[0], ylim=ends[1])
        for chart in (self.spread, self.gas):
            chart.set_xlim(-0.02 * steps, 1.02 * steps)
        self.gas.set_ylim(-1.2 * below, 1.6 * above)
        self._still = None

    def _lay_turns(self, scene: Scene) -> list[_TurnedWind]:
        """Lay the marks where the wind turns, which are shown once it has."""
        length_m = WIND_LENGTH * max(self._backdrop.area.size_m)
        marks = [_TurnedWind(self, turn, length_m) for turn in turns(scene.measurements)]
        self._moving = sorted(self.figure.findobj(Artist.get_animated), key=Artist.get_zorder)
        return marks

    def _make_room(self, scene: Scene, beside: Sequence[Scene]) -> None:
        """Widen charts and map if a scene has more steps or gas, or an estimate further out, than fits."""
        every = [it.gas for each in (scene, *beside) for it in each.measurements]
        gas = [value for value in every if math.isfinite(value)]
        steps = [it.step for it in scene.measurements]
        release, area = self._backdrop.release, self._backdrop.area
        places = [*(it.estimate for it in scene.measurements[-1:]), *(release.sources if release else ())]
        edges = [*zip(area.low, area.high, strict=True)]
        beyond_m = max(
            (
                max(low - along, along - high)
                for place in places
                for along, (low, high) in zip(place, edges, strict=True)
            ),
            default=0.0,
        )
        beyond_m = min(beyond_m, area.side_m)  # a record may say absurd things
        needed = max(steps, default=0), -min(gas, default=0.0), max(gas, default=0.0), beyond_m
        room = [had if need <= had else 2.0 * need for had, need in zip(self._room, needed, strict=True)]
        if room != self._room:
            self._room = room
            self._lay_limits()

    def _lay_legend(self, beliefs: Sequence[str]) -> None:
        """Lay the legend, with words for each belief."""
        names = self._names if len(self._names) > 1 else ["path and readings"]
        dots = {"marker": "o", "markersize": 4.5, "markerfacecolor": PLUME(0.4)}
        styles: dict[str, Any] = {
            name: PATH | dots | {"color": vehicle.colour}
            for name, vehicle in zip(names, self.vehicles, strict=True)
        }
        styles |= {
            "start": START | {"color": INK},
            "estimate": ESTIMATE,
        }
        if self._backdrop.release:
            styles["true source"] = SOURCE
        if not self._is_print:
            styles["vehicle"] = VEHICLE
        if self._turns:
            styles["wind turns; dotted: before"] = {
                "color": TURNED,
                "linestyle": (0, (1, 1)),
                "linewidth": 1.6,
            }
        for cloud, words in zip(self._clouds, beliefs, strict=False):
            mark = {"color": cloud.colour, "marker": "o", "markersize": 6, "linewidth": 1.8}
            styles[f"belief{words}: particles, 2 σ"] = mark
        self.figure.legend(
            handles=[Line2D([], [], **{"label": label} | style) for label, style in styles.items()],
            loc="lower center",
            ncols=max(4 if self._is_print else 6, math.ceil(len(styles) / LEGEND_ROWS)),
            fontsize=9,
            columnspacing=1.6,
        )

    # ---- what changes ----

    def _begin(self, beliefs: int) -> None:
        """Make the artists that scenes change."""
        colours = BELIEFS[max(3 - beliefs, 0) :][:beliefs]  # of up to three, the last is dark
        self._clouds = [_Cloud(self, colour) for colour in colours]
        inks = (INK, *OTHERS)
        self.vehicles = [
            _Vehicle(self, inks[i % len(inks)], name if len(self._names) > 1 else "")
            for i, name in enumerate(self._names)
        ]
        self.readings = self.map.scatter([], [], c=[], zorder=3, animated=True, **READINGS)
        (self._estimate,) = self.map.plot([], [], animated=True, **ESTIMATE)
        (self.spreads,) = self.spread.plot([], [], **CURVE)
        self._arrow = FancyArrowPatch(
            (0, 0), (1, 0), color=INK, linewidth=1.6, arrowstyle="-|>", mutation_scale=13, animated=True
        )
        self._compass.add_patch(self._arrow)
        self._wind = self._compass.text(0.95, 0, "", va="center", size=9, animated=True)
        above: dict[str, Any] = {"transform": self.map.transAxes, "animated": True}
        self._title = self.map.text(0, 1.075, "", weight="bold", **above)
        self._text = self.map.text(0, 1.025, "", size=9, **above)

    def _show_readings(self, scenes: Sequence[Scene]) -> None:
        taken = [it for scene in scenes for it in scene.measurements if not math.isnan(it.gas)]
        self.readings.set_offsets(np.array([it.position for it in taken], np.float64).reshape(-1, 2))
        self.readings.set_array(np.array([it.gas for it in taken]))

    def _show_search(self, scene: Scene) -> None:
        """Show what all vehicles of a search share: the spread, and the estimate."""
        taken = scene.measurements
        self.spreads.set_marker(_dot(taken))
        self.spreads.set_data([it.step for it in taken], [it.spread_m for it in taken])
        self._estimate.set_data(*np.array([it.estimate for it in taken[-1:]]).reshape(-1, 2).T)

    def _show_wind(self, scene: Scene) -> None:
        for mark in self._turns:
            mark.show(mark.step in {turn.step for turn in turns(scene.measurements)})
        wind = scene.wind
        speed = math.hypot(*wind) if wind else 0.0
        self._arrow.set_visible(speed > 0)
        self._wind.set_text("" if wind is None else f"wind\n{speed:.1f} m/s")
        if wind and speed:
            x, y = (0.85 * component / speed for component in wind)
            self._arrow.set_positions((x, y), (-x, -y))


def _nose(heading: float) -> MarkerStyle:
    """Return a triangle whose tip is ahead; a diamond where the heading is not known."""
    return MarkerStyle((3, 0, math.degrees(heading) - 90) if math.isfinite(heading) else "D")


def _dot(taken: Sequence[Measurement]) -> str:
    """Return the mark of a reading on a curve; none where there are many."""
    return "." if len(taken) <= MANY // 10 else ""


def _state(scene: Scene) -> str:
    """Return a line on how the search stands."""
    if scene.ending:
        return scene.ending.text
    if not scene.measurements:
        return "no reading yet"
    last = scene.measurements[-1]
    return (
        f"step {last.step}: estimate ({last.estimate[0]:.2f}, {last.estimate[1]:.2f}) ± {last.spread_m:.2f} m"
    )
