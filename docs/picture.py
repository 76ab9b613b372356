"""Draws docs/mission.svg: the plume of one mission, the path that was flown through it, and what was believed at the stop."""

import argparse
import math
from pathlib import Path

import numpy as np

from agent.trials.rollout import rollout
from plume.dispersion import concentration
from plume.scenario import AREA_M

SCALE = 16  # pixels a metre
CELL_M = 0.75
WIND_LENGTH_M = 2.5


def at(x: float, y: float) -> str:
    """SVG coordinates of a place; SVG's y points down."""
    return f"{x * SCALE:.1f},{(AREA_M - y) * SCALE:.1f}"


def drawing(seed: int, policy: str) -> str:
    """Return the whole drawing of a mission."""
    result, trace = rollout(seed, policy)
    s = result.scenario
    size = AREA_M * SCALE
    axis = np.arange(CELL_M / 2, AREA_M, CELL_M)
    places = np.stack(np.meshgrid(axis, axis), axis=-1)
    gas = concentration(places, s.source, s.wind, rate=s.q, diffusivity=s.d, lifetime=s.tau)
    shade = np.clip(np.log10(gas / 0.1) / 2.5, 0, 1)  # from 0.1 g/m³, half the noise in clean air, upwards
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size:g} {size:g}" width="{size:g}"'
        ' font-family="sans-serif" font-size="14">',
        f'<rect width="{size:g}" height="{size:g}" fill="#fbfaf7"/>',
    ]
    side = CELL_M * SCALE
    for (x, y), depth in zip(places.reshape(-1, 2), shade.ravel(), strict=True):
        if depth > 0.01:
            x_px, y_px = at(x - CELL_M / 2, y + CELL_M / 2).split(",")
            parts.append(f'<rect x="{x_px}" y="{y_px}" width="{side:g}" height="{side:g}" fill="#d9822b" fill-opacity="{depth:.2f}"/>')
    path = " ".join(at(*point.position) for point in trace)
    parts.append(f'<polyline points="{path}" fill="none" stroke="#1f4e79" stroke-width="2.5" stroke-linejoin="round"/>')
    for place, label, below_px, colour in (
        (trace[0].position, "start", 4, "#1f4e79"),
        (result.source, "source", 18, "#000"),
        (trace[-1].position, "stop", -10, "#1f4e79"),
    ):
        x_px, y_px = at(*place).split(",")
        parts.append(f'<circle cx="{x_px}" cy="{y_px}" r="5" fill="{colour}"/>')
        parts.append(f'<text x="{float(x_px) + 9:.1f}" y="{float(y_px) + below_px:.1f}" fill="{colour}">{label}</text>')
    x_px, y_px = at(*result.estimate).split(",")
    radius = 2 * result.spread_m * SCALE
    parts.append(f'<circle cx="{x_px}" cy="{y_px}" r="{radius:.1f}" fill="none" stroke="#b00020" stroke-width="2"/>')
    parts.append(f'<text x="{float(x_px) - 150:.1f}" y="{float(y_px) + 52:.1f}" fill="#b00020">estimate ± 2 spreads</text>')
    tail = (4.0, AREA_M - 3.5)
    head = (tail[0] - WIND_LENGTH_M * math.cos(s.phi), tail[1] - WIND_LENGTH_M * math.sin(s.phi))
    parts.append('<marker id="a" orient="auto" markerWidth="7" markerHeight="7" refX="4" refY="3"><path d="M0,0L6,3L0,6z"/></marker>')
    x1, y1 = at(*tail).split(",")
    x2, y2 = at(*head).split(",")
    parts.append(f'<line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}" stroke="#000" stroke-width="2" marker-end="url(#a)"/>')
    parts.append(f'<text x="{float(x1) + 10:.1f}" y="{y1}">wind {s.u:.1f} m/s</text>')
    caption = f"{AREA_M:g} m x {AREA_M:g} m, seed {seed}, {policy}, {result.steps} steps"
    parts.append(f'<text x="{size - 8:g}" y="{size - 8:g}" text-anchor="end">{caption}</text></svg>')
    return "\n".join(parts) + "\n"


def main() -> None:
    """Write the drawing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--policy", default="homing")
    parser.add_argument("--file", type=Path, default=Path(__file__).with_name("mission.svg"))
    args = parser.parse_args()
    args.file.write_text(drawing(args.seed, args.policy))


if __name__ == "__main__":
    main()
