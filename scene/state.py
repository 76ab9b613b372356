"""What goes on, in one sentence that an operator understands, and what to watch."""

import math
from collections.abc import Sequence
from itertools import pairwise
from statistics import median
from typing import NamedTuple

from plume.geodesy import to_global
from plume.scenario import INCOMPATIBLE
from scene.scene import Ending, Measurement, Point, Scene

GOOD, CALM, WARN, BAD = "good", "calm", "warn", "bad"
SILENT_S = 3.0  # a vehicle that has said nothing for so long is one whose link is lost
LOW, EMPTY = 0.25, 0.12  # shares of charge
# 95% of a round Gaussian belief lies within this many times its spread, the root of its covariance's trace.
RADIUS_95 = math.sqrt(-math.log(0.05))
SEARCHING = ("searching", "taking off")
NEEDED, GONE = ("estimator", "agent", "payload"), ("missing", "stale")  # parts that a search waits for
# What a flight mode is to a search, where PX4's or ArduCopter's name differs.
MEANINGS = {
    "GUIDED": "OFFBOARD", "BRAKE": "HOLD", "RTL": "RETURN", "SMART_RTL": "RETURN", "AUTO_RTL": "RETURN",
    "PRECISION LAND": "LAND",
}  # fmt: skip
KG_H = 3.6  # kg/h of a g/s
# Moves in which the spread of a belief falls by a factor of e, in flown searches: benchmarks/moves.py
MOVES_PER_E = 7.7


class Situation(NamedTuple):
    """How the search is."""

    kind: str  # waiting, searching, doubtful, paused, pilot, returning, landed, lost, stuck, found, false, …
    level: str  # good, calm, warn, bad
    text: str  # the sentence
    notes: tuple[str, ...] = ()  # what to watch as well, the worst first
    copy: str = ""  # the coordinates of a find, for other programs; empty if there are none
    moves_left: int | None = None  # an estimate; None if it cannot be told
    seconds_left: float | None = None  # of simulation time, for those moves


def state_of(scene: Scene) -> Situation:
    """Return how the search is at this moment."""
    kind, level, text = _said(scene)
    notes = tuple(note for note in notes_of(scene) if note not in text)
    ended = scene.ending is not None or scene.left or kind == "landed"
    moves = None if ended else moves_left(scene.measurements, scene.stop)
    if kind == "searching" and moves is not None:
        text += f"; about {_about(moves)} move{'s' if moves != 1 else ''} more"
    leg_s = _leg_s(scene.measurements)
    left_s = None if moves is None or leg_s is None else moves * leg_s
    copy = _decimal(scene) if kind in ("found", "false") else ""
    return Situation(kind, level, text, notes, copy, moves, left_s)


def meaning(mode: str) -> str:
    """Return what a flight mode is to a search: `HOLD` of BRAKE; itself if only pilots fly it."""
    return MEANINGS.get(mode, mode)


def _said(scene: Scene) -> tuple[str, str, str]:
    """Return kind, level and sentence."""
    uav = next((each for each in scene.services if each.name == "uav"), None)
    if scene.ending:
        return _ended(scene, scene.ending)
    if scene.silent_s is not None and scene.silent_s > SILENT_S:
        return "lost", BAD, f"Lost link: nothing heard from the vehicle for {scene.silent_s:.0f} s"
    if uav and uav.verdict in ("missing", "stale"):
        return "lost", BAD, "Lost link: the part that flies the vehicle does not answer"
    mode, state = meaning(scene.craft.mode if scene.craft else ""), uav.state if uav else ""
    if state == "paused" and mode in ("HOLD", ""):
        return "paused", WARN, f"Paused{_by(scene)}: it stays here and the search waits"
    if state == "paused" and mode not in ("OFFBOARD", "RETURN", "LAND"):
        return "pilot", WARN, f"A pilot flies it ({mode.capitalize()}): the search waits"
    why = "it has left the search" if scene.left else "the search has not found the source"
    if state == "returning" or mode == "RETURN":
        return "returning", WARN, f"Returning home: {why}"
    if mode == "LAND":
        return "landing", WARN, f"Landing: {why}"
    if state == "holding" and scene.left and mode not in ("OFFBOARD", "HOLD", ""):
        return "pilot", WARN, f"A pilot flies it ({mode.capitalize()}): {why}"
    if state == "holding":
        return "holding", WARN, f"It stays here: {why if scene.left else 'the search is over'}"
    if state == "landed":
        return "landed", CALM, f"Landed: {why}"
    if missing := [each for each in scene.services if each.name in NEEDED and each.verdict in GONE]:
        names = " and ".join(each.name for each in missing)
        return "stuck", BAD, f"Waiting: the {names} {'is' if len(missing) == 1 else 'are'} not there"
    if state == "standby" or not scene.measurements:
        on_way = state in SEARCHING and scene.craft is not None
        return (
            ("searching", CALM, "Taking off: no reading yet")
            if on_way
            else ("waiting", CALM, "On the ground: the search has not begun")
        )
    last = scene.measurements[-1]
    if last.p_value < INCOMPATIBLE:
        return (
            "doubtful",
            WARN,
            "Doubtful: the readings do not fit a plume; while they do not, it cannot stop",
        )
    near = near_text(last)
    return "searching", GOOD, f"Searching: the source is within {near} of the cross (95%){_stops(scene)}"


def _ended(scene: Scene, ending: Ending) -> tuple[str, str, str]:
    last = scene.measurements[-1] if scene.measurements else None
    if last is None:
        return "found", CALM, ending.text
    where = f"{_where(scene, last.estimate)}, ± {near_text(last)} (95%){_rate(last)}"
    match ending.verdict:
        case "located":
            return "found", GOOD, f"Found: {where}"
        case "FALSE STOP":
            return "false", BAD, f"False stop: the source is not at {where}"
        case "outside":
            return "outside", WARN, f"Outside: the source is not in the area; most likely at {where}"
        case "not ceased":
            near = f"the source is within {near_text(last)} of the cross (95%)"
            return "spent", WARN, f"Not found: the moves are spent; {near}"
        case _:
            return "found", CALM, f"Found: {where}"


def notes_of(scene: Scene) -> list[str]:
    """Return what to watch, in words, the worst first."""
    notes = []
    it = scene.craft.condition if scene.craft else None
    if it and it.battery is not None and it.battery <= LOW:
        notes.append(f"battery {100 * it.battery:.0f}%")
    if it and it.gps.startswith("no "):
        notes.append(f"GPS: {it.gps}")
    if it and it.health not in ("", "ok"):
        notes.append(it.health)
    wrong = [each for each in scene.services if each.verdict not in ("ok", "starting")]
    notes += [f"{each.name} is {each.verdict}" for each in wrong]
    notes += [words for each in scene.services for words in each.warnings]
    if scene.ending and scene.backdrop.release:
        notes.append(f"{scene.ending.verdict}: {scene.ending.text}")
    return notes


# ---- words ----


def _by(scene: Scene) -> str:
    """Return who paused the search, as the vehicle says it."""
    for each in reversed(scene.happenings):
        if each.text.startswith("Search gives way"):
            _, by, who = each.text.rpartition(" by ")
            return f" by {'the operator' if who.startswith('255/') else who}" if by else ""
        if each.text == "searching":
            break
    return ""


def near_text(last: Measurement) -> str:
    """Return within how many metres of the estimate 95% of a belief lies."""
    radius_m = last.radius_95_m if math.isfinite(last.radius_95_m) else RADIUS_95 * last.spread_m
    return f"{radius_m:.0f} m" if radius_m >= 9.95 else f"{radius_m:.1f} m"


def _stops(scene: Scene) -> str:
    target_m = target_radius_m(scene.stop, scene.measurements[-1].stretch)
    return "" if target_m is None else f"; stops at about {target_m:.2g} m"


def _about(moves: int) -> int:
    """Return a number of moves as exact as it is known."""
    return moves if moves < 10 else 5 * round(moves / 5)


def _where(scene: Scene, place: Point) -> str:
    if scene.home is None:
        return f"{place[0]:.1f} m east, {place[1]:.1f} m north of home"
    latitude, longitude = to_global(*scene.home[:2], place[1], place[0])
    return (
        f"{abs(latitude):.6f} {'N' if latitude >= 0 else 'S'}, "
        f"{abs(longitude):.6f} {'E' if longitude >= 0 else 'W'}"
    )


def _decimal(scene: Scene) -> str:
    """Return the estimate as programs read it: signed degrees, WGS84."""
    if scene.home is None or not scene.measurements:
        return ""
    x, y = scene.measurements[-1].estimate
    return "{:.7f}, {:.7f}".format(*to_global(*scene.home[:2], y, x))


def _rate(last: Measurement) -> str:
    if last.rate is None:
        return ""
    rates = [KG_H * value for value in last.rate]
    low, middle, high = (f"{rate:.2g}" if rate < 100 else f"{rate:.0f}" for rate in rates)
    return f"; {middle} kg/h (90%: {low} to {high})"


# ---- how long still ----


def target_radius_m(stop: str, wider: float = 1.0) -> float | None:
    """Return within how many metres 95% of a round belief lies once it meets a stop criterion.

    wider: so many times wider than the belief its errors may be.  None if that is not known.
    """
    kind, _, rest = stop.partition(":")
    try:
        numbers = [float(number) for number in rest.split(",")]
    except ValueError:
        return None
    match kind, numbers:
        case "spread", [threshold_m] if threshold_m > 0:
            return RADIUS_95 * threshold_m / wider
        case "within", [radius_m, share] if radius_m > 0 and 0 < share < 1:
            return radius_m / wider * math.sqrt(math.log(0.05) / math.log1p(-share))
    return None


def _leg_s(measurements: Sequence[Measurement]) -> float | None:
    """Return how long a move takes, reading included."""
    times = [each.time_s for each in measurements[-11:]]
    return median(b - a for a, b in pairwise(times)) if len(times) > 1 else None


def moves_left(measurements: Sequence[Measurement], stop: str) -> int | None:
    """Return about how many moves are left until a search stops; None if that cannot be told.

    On average a belief shrinks by the same factor with each move. How it shrank lately says less: it hardly
    does until the gas is found, and then fast. None while the readings do not fit: then there is no stop.
    """
    if not measurements or measurements[-1].p_value < INCOMPATIBLE:
        return None
    target_m = target_radius_m(stop, measurements[-1].stretch)
    if target_m is None:
        return None
    spread_m = measurements[-1].spread_m
    if not math.isfinite(spread_m) or spread_m <= 0:
        return None
    return max(1, round(MOVES_PER_E * math.log(max(1.0, RADIUS_95 * spread_m / target_m))))
