"""A search that repeats itself: it flies to and fro between two places and reads nothing new."""

import numpy as np

from plume.elementary import Array

REPEATS = 10  # readings at two places in turn: of 240 searches in gas as modelled, none had so many
SAME = 1 / 4  # of the way between the two: places that are nearer to each other are one


def way_back(places: Array) -> tuple[float, float] | None:
    """Return where a search that repeats itself would go next; None if it does not.

    places: (T, 2) m, where the readings were taken. The search repeats itself if the last REPEATS of them
    were taken at two places in turn. A vehicle that stays at one place does not.
    """
    last = places[-REPEATS:]
    if len(last) < REPEATS:
        return None
    moved = np.square(last[2:] - last[1:-1]).sum(axis=1)
    apart = np.square(last[2:] - last[:-2]).sum(axis=1)
    if not (apart < SAME * SAME * moved).all():
        return None
    x, y = last[-2].tolist()
    return x, y
