"""The picture of a recorded plume: one frame, and the mean of many."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator
from numpy.typing import NDArray

from scene.drawing import INK, PLUME, SOURCE, STYLE

SIZE_IN = 9.6, 5.0
DECADES = 1e3  # from the greatest concentration to the least that is shown
LEAST, MOST = 1e-200, 1e200  # a scale of colours cannot be of smaller numbers, nor of greater ones
WALL = ListedColormap(["#9a9a9a"])
ARROW = 0.12  # length of the wind's arrow, of the width of the map


class Still(NamedTuple):
    """A map of gas."""

    title: str
    gas: NDArray[np.float64]  # (y, x)


class Sight(NamedTuple):
    """What the picture shows, in the coordinates of the file."""

    title: str
    stills: Sequence[Still]
    extent: tuple[float, float, float, float]  # x from, to, y from, to
    length: str  # unit of places
    unit: str  # of the gas
    source: tuple[float, float] | None
    walls: NDArray[np.bool_] | None  # (y, x)
    wind: tuple[float, float] | None  # how the air moves at the source


def draw(sight: Sight, path: Path) -> None:
    """Write a picture as PNG. The same sight gives the same file."""
    greatest = max(float(still.gas.max()) for still in sight.stills) or 1.0
    greatest = min(max(greatest, LEAST), MOST)
    least = greatest / DECADES
    norm = LogNorm(least, greatest)
    left, right, low, high = sight.extent
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=SIZE_IN, layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(sight.title, size=10)
        axes = figure.subplots(1, len(sight.stills), sharey=True, squeeze=False)[0]
        for ax, still in zip(axes, sight.stills, strict=True):
            shades = ax.imshow(
                np.clip(still.gas, least, MOST), norm=norm, cmap=PLUME, origin="lower", extent=sight.extent
            )
            if sight.walls is not None:
                walls = np.ma.masked_equal(sight.walls.astype(float), 0.0)
                ax.imshow(walls, cmap=WALL, origin="lower", extent=sight.extent, interpolation="nearest")
            if sight.source:
                ax.plot(*sight.source, **SOURCE)
            if sight.wind:
                _arrow(ax, sight)
            ax.grid(visible=False)
            ax.set(xlim=(left, right), ylim=(low, high), title=still.title, xlabel=f"x, {sight.length}")
            for axis in (ax.xaxis, ax.yaxis):
                axis.set_major_locator(MaxNLocator(5))
        axes[0].set_ylabel(f"y, {sight.length}")
        bar = figure.colorbar(shades, ax=list(axes), shrink=0.8)
        bar.set_label(f"gas, {sight.unit}")
        bar.ax.yaxis.set_minor_locator(NullLocator())
        figure.savefig(path, format="png")


def _arrow(ax: "matplotlib.axes.Axes", sight: Sight) -> None:
    """Draw how the air moves, in a corner."""
    assert sight.wind
    x, y = sight.wind
    speed = float(np.hypot(x, y)) or 1.0
    left, right, _, high = sight.extent
    length = ARROW * (right - left)
    middle = left + length, high - 1.2 * length
    half = length * x / speed / 2, length * y / speed / 2
    ax.annotate(
        "",
        xy=(middle[0] + half[0], middle[1] + half[1]),
        xytext=(middle[0] - half[0], middle[1] - half[1]),
        arrowprops={"arrowstyle": "->", "color": INK, "linewidth": 1.4},
    )
    ax.annotate("wind", xy=(middle[0], middle[1] + length / 2), ha="center", va="bottom", size=9, color=INK)
