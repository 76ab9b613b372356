"""Missions among six buildings: whether a way enters one, how much further they are, what a decision costs.

`python benchmarks/obstacles.py` flies each mission twice: among buildings that its seed places, and with the
same source and start in the open field. It prints one JSON object.
"""

import argparse
import json
import math
import time
from itertools import pairwise

import numpy as np

from agent.trials.rollout import Mission, mission
from plume.problem import Place, Problem
from plume.randomness import keyed, uniform
from plume.scenario import draw

BUILDINGS = 6
CLEARANCE_M = 1.0
SIDES_M = np.array([3.0, 7.0])  # least and greatest side of a building


def building(rng: np.random.Generator) -> tuple[Place, ...]:
    """Draw a rectangle in Table 1's area that is turned any way, or an L of two of its sides."""
    (x, y), (along, across) = uniform(rng, np.full(2, 4.0), 26.0), uniform(rng, *SIDES_M * np.ones((2, 2)).T)
    angle = math.pi * rng.random()
    east, north = math.cos(angle), math.sin(angle)
    shape = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
    if rng.random() < 0.3:
        shape = [(0.0, 0.0), (1.0, 0.0), (1.0, 0.4), (0.4, 0.4), (0.4, 1.0), (0.0, 1.0)]
    corners = [((a - 0.5) * along, (b - 0.5) * across) for a, b in shape]
    return tuple((x + a * east - b * north, y + a * north + b * east) for a, b in corners)


def among_buildings(seed: int) -> Problem:
    """Return Table 1's problem with six buildings, drawn until the search has a start and a way."""
    rng = keyed(seed, "buildings")
    while True:
        try:
            return Problem(keep_out=tuple(building(rng) for _ in range(BUILDINGS)), clearance_m=CLEARANCE_M)
        except ValueError:
            continue


def crossings(flight: Mission, problem: Problem) -> tuple[int, float, bool, bool, float]:
    """Fly a mission: its ways that are not free, metres, whether it ceased and located, s of a decision."""
    steps = list(flight.steps)
    places = np.array([step.readings[0].position for step in steps])
    ways = np.stack([places[:-1], places[1:]], axis=1)
    obstacles = problem.ground.obstacles
    crossed = int((~obstacles.are_free(ways)).sum()) if obstacles else 0
    length_m = sum(math.dist(start, end) for start, end in pairwise(places.tolist()))
    last = steps[-1].belief
    located = last.ceased and math.dist(last.mean, flight.scenario.source) <= 1.0
    return (
        crossed,
        length_m,
        last.ceased,
        located,
        sum(step.decision_s for step in steps) / max(len(steps), 1),
    )


def main() -> None:
    """Fly the missions and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--missions", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=1_000_000)
    parser.add_argument("--policy", default="homing")
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--assume", default="field")
    args = parser.parse_args()
    rows: dict[str, list[tuple[int, float, bool, bool, float]]] = {"buildings": [], "free": []}
    read_s = []
    for seed in range(args.first_seed, args.first_seed + args.missions):
        began = time.process_time()
        walled = among_buildings(seed)
        read_s.append(time.process_time() - began)
        told = draw(seed, walled)
        free = Problem(source=told.source, start=told.start)
        for name, problem in (("buildings", walled), ("free", free)):
            flight = mission(seed, args.policy, args.particles, 0.5, problem=problem, assume=args.assume)
            rows[name].append(crossings(flight, problem))
    figures: dict[str, object] = {"missions": args.missions, "policy": args.policy}
    for name, flown in rows.items():
        crossed, lengths_m, ceased, located, decision_s = (
            np.array(each) for each in zip(*flown, strict=True)
        )
        figures[name] = {
            "crossings": int(crossed.sum()),
            "ceased": float(ceased.mean()),
            "located": float(located.mean()),
            "mtd_m": float(lengths_m[ceased].mean()),
            "distance_m": float(lengths_m.mean()),
            "decision_ms": 1000 * float(decision_s.mean()),
        }
    figures["to_read_ms"] = 1000 * float(np.median(read_s))
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
