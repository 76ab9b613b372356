"""What a sensor in time costs: searches with each, by how long the vehicle hovers for a reading.

    python -m benchmarks.sensors     # the table of docs/sensors.md

Missions are flown in-process as `plumeward rollout` flies them, from the test seeds, under `field`: as
modelled, and in gas that moves.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing import Pool
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agent.trials.evaluate import FIRST_TEST_SEED
from agent.trials.figures import wilson
from agent.trials.rollout import mission
from benchmarks.pages import placed, table
from benchmarks.trust import BUDGET, DEFAULT, PARTICLES
from estimator.criterion import USUAL_THRESHOLD_M
from link import cli
from link.files import whole
from plume.flight import leg_s
from plume.scenario import AS_MODELLED, SUCCESS_RADIUS_M
from plume.sensors.instruments import INSTRUMENTS
from plume.sensors.names import GAUSSIAN, lags, parse, text

PAGE = Path(__file__).parents[1] / "docs" / "sensors.md"
MISSIONS = 300
DWELLS_S = {AS_MODELLED: (0.0, 1.0, 2.0, 5.0, 10.0, 20.0), "puffs:share=0.2": (0.0, 2.0, 5.0)}


class Search(NamedTuple):
    """How a search ended."""

    ceased: bool
    located: bool
    distance_m: float
    time_s: float  # legs and hovers, by the vehicle's own motion


def search(world: str, sensor: str, seed: int) -> Search:
    """Fly one mission."""
    known: dict[str, Any] = {"sensor": parse(sensor), "assume": "field"}
    flown = mission(seed, DEFAULT, PARTICLES, USUAL_THRESHOLD_M, BUDGET, world=world, **known)
    said = [step.belief for step in flown.steps]
    places = np.array([it.position for it in said])
    legs_m = np.sqrt(np.square(np.diff(places, axis=0)).sum(axis=1))
    time_s = float(leg_s(places[:-1], places[1:]).sum()) + len(said) * parse(sensor).dwell
    last = said[-1]
    is_near = math.dist(last.mean, flown.scenario.source) <= SUCCESS_RADIUS_M
    return Search(last.ceased, last.ceased and is_near, float(legs_m.sum()), time_s)


def line(world: str, sensor: str, searches: Sequence[Search]) -> list[str]:
    """Return a row of the table: what became of the searches with a sensor in a world."""
    count, ceased = len(searches), [it for it in searches if it.ceased]
    located = sum(it.located for it in ceased)
    return [
        world,
        f"`{sensor.partition(':')[0]}`",
        f"{parse(sensor).dwell:g}",
        f"{100 * len(ceased) / count:.1f}",
        wilson(located, count).text(100.0, 1),
        wilson(len(ceased) - located, len(ceased)).text(100.0, 1) if ceased else "–",
        f"{np.mean([it.distance_m for it in ceased]):.1f}" if ceased else "–",
        f"{np.mean([it.time_s for it in ceased]):.0f}" if ceased else "–",
    ]


def chosen() -> list[tuple[str, str]]:
    """Return the worlds and sensors of the table: each with its usual dwell, most with others, too."""
    cells = []
    for world, dwells_s in DWELLS_S.items():
        for usual in (GAUSSIAN, *INSTRUMENTS.values()):
            of_this = {usual.dwell, *(dwells_s if lags(usual) or world != AS_MODELLED else ())}
            cells += [(world, text(replace(usual, dwell=dwell_s))) for dwell_s in sorted(of_this)]
    return cells


def main() -> None:
    """Fly all searches and write the table."""
    parser = cli.Parser(prog="python -m benchmarks.sensors", description="The table of docs/sensors.md.")
    parser.add_argument(
        "--missions", type=cli.whole(1, 100_000), default=MISSIONS, metavar="N", help="(default: %(default)s)"
    )
    parser.add_argument("--workers", type=cli.whole(1, 64), default=2, metavar="W", help="(default: 2)")
    args = parser.parse_args()
    seeds, lines = range(FIRST_TEST_SEED, FIRST_TEST_SEED + args.missions), []
    with Pool(args.workers) as pool:
        for cell in chosen():
            lines.append(line(*cell, pool.starmap(search, [(*cell, seed) for seed in seeds])))
            print(" ".join(lines[-1]), flush=True)
    heads = [
        "world",
        "sensor",
        "dwell, s",
        "ceased, %",
        "located, %",
        "false, %",
        "MTD, m",
        "time to the stop, s",
    ]
    made = placed(PAGE.read_text(), "dwells", table(heads, lines))
    with whole(PAGE) as partial:
        partial.write_text(made)
    print(PAGE)


if __name__ == "__main__":
    cli.run(main)
