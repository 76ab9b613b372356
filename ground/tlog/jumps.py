"""Where a receiver has jumped: places that the vehicle cannot have been at."""

import numpy as np
from numpy.typing import NDArray

from ground.tlog.clock import Floats

FASTEST_MPS = 100.0  # no vehicle that carries a gas sensor flies faster
LEAST_M = 20.0  # and what a fix may be wrong by
STILL_M = 1e-3  # a place that is said again within it has not been measured anew
MOST = 0.25  # share of the places
OUT_OF_REACH = f"out of reach at {FASTEST_MPS:g} m/s"


def jumped(times_s: Floats, places: Floats, notes: list[str]) -> NDArray[np.bool_]:
    """Return which places (N, 2) m, at times (N,), a receiver has jumped to: (N,).

    Where that would be more than MOST of them, it is none, and a note says so: then times are wrong, or
    places are of two vehicles.
    """
    away = _away(times_s, places)
    if np.count_nonzero(away) <= MOST * len(away):
        return away
    notes.append(
        f"{np.count_nonzero(away):,} of {len(away):,} places are {OUT_OF_REACH} from the others, and none is "
        "left out: are times wrong, or are there two vehicles in it? wanted the flight of one"
    )
    return np.zeros(len(away), np.bool_)


def _away(times_s: Floats, places: Floats) -> NDArray[np.bool_]:
    """Return which places are out of reach.

    The longest stretch without a jump is taken to be right. From its ends on a place counts if the vehicle
    could have flown there since the last one that counts: a receiver that comes back loses what it said
    meanwhile, and one that stays where it jumped to is right again as soon as the vehicle can be there.
    """
    away = np.zeros(len(times_s), np.bool_)
    if len(away) < 2:
        return away
    steps_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
    # Since when the vehicle is said to be there: some loggers hold a place for seconds.
    moved = np.where(steps_m > STILL_M, np.arange(1, len(times_s)), 0)
    since_s = times_s[np.maximum.accumulate(np.concatenate([[0], moved]))]
    ends = np.flatnonzero(steps_m > _reach_m(times_s[1:] - since_s[:-1])) + 1
    stretches = np.split(np.arange(len(times_s)), ends)
    longest = max(range(len(stretches)), key=lambda number: len(stretches[number]))

    last = int(stretches[longest][-1])
    for after in stretches[longest + 1 :]:
        ways_m = np.linalg.norm(places[after] - places[last], axis=1)
        there = np.flatnonzero(ways_m <= _reach_m(times_s[after] - since_s[last]))
        away[after[: there[0]] if len(there) else after] = True
        last = int(after[-1]) if len(there) else last
    first = int(stretches[longest][0])
    for before in reversed(stretches[:longest]):
        ways_m = np.linalg.norm(places[before] - places[first], axis=1)
        there = np.flatnonzero(ways_m <= _reach_m(times_s[first] - since_s[before]))
        away[before[there[-1] + 1 :] if len(there) else before] = True
        first = int(before[0]) if len(there) else first
    return away


def _reach_m(long_s: Floats) -> Floats:
    """Return how far the vehicle may have come."""
    return LEAST_M + FASTEST_MPS * np.abs(long_s)
