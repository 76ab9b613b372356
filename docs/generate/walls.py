"""The generator of docs/walls.png: the shipped courtyard, the wind in it, its puffs, and the gas of one moment.

`python -m docs.generate.walls` writes it.
"""

from pathlib import Path

import matplotlib
import numpy as np

from plume.scenario import Scenario
from plume.walls.buildings import outline, read
from plume.walls.making import walls

PICTURE = Path(__file__).parents[1] / "walls.png"


def draw() -> None:
    """Draw the picture."""
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    scenario = Scenario(source=(14.0, 17.0), q=200.0, u=2.0, phi=np.pi, d=1.0, tau=10.0, start=(1.0, 1.0))
    air = walls(scenario, 1, file="courtyard")
    at = np.linspace(0.0, 40.0, 161)
    x, y = np.meshgrid(at, at)
    places = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    gas, wind = air(places, np.full(x.size, 60.0))
    figure, axes = plt.subplots(figsize=(7, 6.4), layout="constrained")
    shown = axes.pcolormesh(
        x, y, np.log10(np.maximum(gas, 1e-3)).reshape(x.shape), cmap="YlOrRd", vmin=-3, vmax=1.5
    )
    figure.colorbar(shown, label="gas at the search plane, log₁₀ g/m³")
    axes.streamplot(
        at, at, *(-wind.T).reshape(2, *x.shape), color="tab:blue", linewidth=0.5, density=1.6, arrowsize=0.7
    )
    for building in read("courtyard").buildings:
        axes.fill(*outline(building).T, color="0.35", alpha=0.9)
        axes.annotate(
            f"{building.height:g} m",
            outline(building)[[0, 2]].mean(axis=0),
            ha="center",
            va="center",
            color="white",
            fontsize=8,
        )
    axes.plot(*air.puffs(60.0)[:2], ".", color="0.2", markersize=3, label="centres of puffs, at any height")
    axes.plot(*scenario.source, "k*", markersize=12, label="source")
    axes.set(xlim=(0, 40), ylim=(0, 40), aspect="equal", xlabel="x east, m", ylabel="y north, m")
    axes.legend(loc="upper right", fontsize=8)
    figure.savefig(PICTURE, dpi=110, metadata={"Software": ""})


if __name__ == "__main__":
    draw()
