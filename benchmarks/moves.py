"""How well the page tells how many moves are left: its estimate at each reading of flown searches.

    python -m benchmarks.moves        # the figures of docs/missions.md, in about ten minutes on one core

The searches are flown in-process as `plumeward rollout` flies them, under `field`. The rate at which a
belief shrinks was chosen by seeds 500 to 509; these are others.
"""

import argparse
from statistics import median

from agent.trials.rollout import mission
from scene.follow.believed import measured
from scene.state import moves_left

FIRST, SEARCHES, BUDGET, PARTICLES = 510, 30, 150, 2000
POLICIES = ("homing", "infotaxis")
STOP = "spread:0.5"
FROM = 4  # the first reading that counts


def left_and_told(seed: int, policy: str) -> list[tuple[int, int]]:
    """Return the moves that were left and were told to be left, at each reading of a search that ceased."""
    said = [step.belief for step in mission(seed, policy, PARTICLES, 0.5, BUDGET, assume="field").steps]
    if not said[-1].ceased:
        return []
    readings = [measured(belief, None, float(belief.step)) for belief in said]
    pairs = [(len(said) - 1 - at, moves_left(readings[: at + 1], STOP)) for at in range(FROM, len(said) - 1)]
    return [(left, told) for left, told in pairs if told is not None]


def main() -> None:
    """Fly them and print the figures."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    told = "of each policy (default: %(default)s)"
    parser.add_argument("--searches", type=int, default=SEARCHES, metavar="N", help=told)
    searches = parser.parse_args().searches
    for policy in POLICIES:
        pairs = [pair for seed in range(FIRST, FIRST + searches) for pair in left_and_told(seed, policy)]
        error = median(abs(left - told) for left, told in pairs)
        near = sum(0.5 <= told / left <= 2 for left, told in pairs) / len(pairs)
        middle = median(left for left, _ in pairs)
        print(
            f"{policy}: {len(pairs)} readings, {middle:g} moves left (median): wrong by {error:g} (median), "
            f"within a factor of two at {100 * near:.0f}%"
        )


if __name__ == "__main__":
    main()
