"""The outcome of one mission, in the words that all tables use."""

import math
from collections.abc import Mapping, Sequence
from functools import reduce
from itertools import pairwise
from operator import add
from textwrap import wrap
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from plume.elementary import exp, log, quantiles
from plume.geodesy import to_global
from plume.problem import AREA, Area
from plume.scenario import AS_MODELLED, SUCCESS_RADIUS_M, SURE_OUTSIDE, Scenario

Quantiles = tuple[float, float, float]  # 5, 50 and 95%
NOTHING: Mapping[str, Quantiles] = MappingProxyType({})
NOBODY: Mapping[int, int] = MappingProxyType({})  # no vehicle, by its number
# Words for gas, by the least coefficient of variation near the source that they stand for.
BURSTS, COMES_AND_GOES = 1.0, 0.5
ENDS = (0.025, 0.975)  # levels of the ends of a 95% interval
# Puffs a second below which regions and intervals are wider than the belief's own, by the fourth root of how
# much fewer there are. docs/findings.md has how the law was chosen and what it holds.
FEW_PUFFS, GREATEST_WIDTH = 200.0, 2.0
DEGREE_DECIMALS = 8  # of latitude and longitude: a millimetre, the same on all processors
FARTHEST_M = 1e7  # from home
# Gas whose cv may be less than COMES_AND_GOES and also this is not known well enough for a word.
UNKNOWN_CV = 1.5
LINE = 60  # characters of a line for people


# Units of the fields that say none, and what the others' endings mean.
UNITS: Mapping[str, str] = MappingProxyType(
    {
        "estimate": "m",
        "source": "m",
        "*_m": "m",
        "*_m2": "m²",
        "*_s": "s",
        "*_deg": "° (WGS84)",
        "*_gs": "g/s",
        "*_interval_*": "95% interval",
    }
)


class LastWord(NamedTuple):
    """What else the last belief says: the covariance (xx, xy, yy) m², the rate and its 95% interval, g/s."""

    covariance: tuple[float, float, float]
    rate: float
    rate_interval: tuple[float, float] | None = None


def interval(name: str, unknowns: Sequence[str], particles: ArrayLike) -> tuple[float, float] | None:
    """Return the central 95% interval of an unknown in a particle array (N, D + 1), weights last.

    None where it is no unknown of the belief.
    """
    if name not in unknowns:
        return None
    rows = np.asarray(particles, np.float64)
    weights = rows[:, -1]
    low, high = quantiles(rows[:, [*unknowns].index(name)], weights / weights.max(), ENDS)
    return low, high


def width_of_few_puffs(intermittency: Mapping[str, Quantiles]) -> float:
    """Return how many times as wide as the belief's own a 95% interval is, at least 1, by its intermittency.

    The filter takes readings for independent. Where puffs are few, several meet the same one, and the belief
    is surer than it should be.
    """
    _, puffs_per_s, _ = intermittency.get("puff-rate", (FEW_PUFFS,) * 3)
    fewer = FEW_PUFFS / max(puffs_per_s, 1.0)
    return min(math.sqrt(math.sqrt(fewer)), GREATEST_WIDTH) if fewer > 1.0 else 1.0


def rate_interval(
    unknowns: Sequence[str], particles: ArrayLike, intermittency: Mapping[str, Quantiles]
) -> tuple[float, float] | None:
    """Return the 95% interval of the release rate, g/s; None where it is no unknown of the belief.

    particles and intermittency: of the belief. Where puffs are few its logarithm is wider.
    """
    ends, width = interval("q", unknowns, particles), width_of_few_puffs(intermittency)
    if ends is None or width == 1.0 or not 0.0 < ends[0] < ends[1]:
        return ends
    low, high = ends
    further = float(exp((width - 1.0) / 2.0 * log(high / low)))
    return low / further, high * further


class TracePoint(msgspec.Struct, frozen=True, omit_defaults=True):
    """One step of a mission: where a reading was taken, and the belief after it.

    In JSON `vehicle` is left out where it is 1.

    Examples:
        >>> _, trace = plumeward.rollout(seed=4)
        >>> round(trace[-1].reading, 2), round(trace[-1].spread, 2)  # g/m³ and m, at the stop
        (7.07, 0.28)
    """

    position: tuple[float, float]
    reading: float
    mean: tuple[float, float]
    spread: float
    vehicle: int = 1


class Left(msgspec.Struct, frozen=True):
    """A vehicle that has left the search by several, and why."""

    vehicle: int  # its number, from 1
    step: int  # the first round that it took no part in
    reason: str
    forgotten: bool = False  # whether its readings from before do not count either


class Joined(msgspec.Struct, frozen=True):
    """A vehicle that has joined the search by several when the others had begun."""

    vehicle: int  # its number, from 1
    step: int  # the first round that it took part in


class DoubtedOf(msgspec.Struct, frozen=True):
    """A vehicle whose sensor seemed to lie."""

    vehicle: int  # its number, from 1
    step: int  # of the first belief that names it


class MeasuredBy(msgspec.Struct, frozen=True):
    """What one vehicle has measured."""

    vehicle: int  # its number, from 1
    readings: int
    largest: float | None  # of its readings, in the sensor's unit; None without any


class Outcome(msgspec.Struct, frozen=True):
    """The result of a mission; `fly` and `rollout` print it as JSON. Lengths in metres, times in seconds.

    Examples:
        >>> outcome, _ = plumeward.rollout(seed=4)
        >>> outcome.ceased, outcome.located, round(outcome.distance_m, 1)
        (True, True, 31.2)
    """

    seed: int
    policy: str
    ceased: bool  # AGDC declared a stop within the step budget
    # Ceased, and the estimate is within the success radius of the source. None, as the next ones, if nobody
    # knows where that is.
    located: bool | None
    estimate: tuple[float, float]
    source: tuple[float, float] | None
    scenario: Scenario | None  # the truth; in most worlds it differs from what the estimator assumes
    error_m: float | None
    spread_m: float
    steps: int  # moves of each vehicle
    distance_m: float  # of all vehicles
    search_time_s: float  # compute time of estimator and agent, summed over the mission
    assume: str  # what the estimator took to be known
    stop: str  # the stop criterion, in the form of --stop
    world: str = AS_MODELLED
    outside: bool = False  # the stop says that the source is outside the area, and that is not false
    outside_share: float = 0.0  # of the belief, at the end
    outside_to: str = ""  # where the estimate is outside: north, north-east, …
    # 5, 50 and 95% quantiles of what the belief says of how the gas comes and goes, as of `Belief`.
    intermittency: dict[str, Quantiles] = {}
    advised_dwell_s: float | None = None  # how long to hover for a reading in such gas; None: as long as now
    latitude_deg: float | None = None  # of the estimate, WGS84; None, as longitude_deg, if home is not known
    longitude_deg: float | None = None
    covariance_m2: tuple[float, float, float] | None = None  # (xx, xy, yy) of the source's position
    rate_gs: float | None = None  # the release rate that was believed, or told if it was known
    rate_interval_gs: tuple[float, float] | None = None  # its 95% interval; None if it was known
    units: dict[str, str] = {}  # by the ending of a field's name
    distances_m: tuple[float, ...] = ()  # of each vehicle, in their order
    measured: tuple[MeasuredBy, ...] = ()  # by each vehicle, in their order
    left: tuple[Left, ...] = ()  # who has left the search before its end, in the order in which they did
    doubted: tuple[DoubtedOf, ...] = ()  # whose sensor seemed to lie, in the order in which they were named
    joined: tuple[Joined, ...] = ()  # who has joined late, in the order in which they did

    @property
    def vehicles(self) -> int:
        """How many vehicles flew it."""
        return len(self.distances_m)


def verdict(
    ceased: bool,
    estimate: tuple[float, float],
    source: tuple[float, float] | None,
    outside_share: float,
    area: Area = AREA,
) -> str:
    """Return how a search has ended.

    It is `located`, `outside`, `FALSE STOP`, `ceased` where nobody knows the source, or `not ceased`. A stop
    with most of the belief outside the area (SURE_OUTSIDE) claims only that the source is outside, and is
    false if that is inside and further from the estimate than the success radius.
    """
    if not ceased:
        return "not ceased"
    says_outside = outside_share >= SURE_OUTSIDE
    if source is None:
        return "outside" if says_outside else "ceased"
    if math.dist(estimate, source) <= SUCCESS_RADIUS_M:
        return "outside" if says_outside else "located"
    return "outside" if says_outside and area.beyond(source) else "FALSE STOP"


def outside_text(outside_share: float, to: str) -> str:
    """Return the claim that the source is outside, in words."""
    return f"outside{f', to the {to}' if to else ''} ({100 * outside_share:.0f}%)"


def outcome(
    seed: int,
    policy: str,
    scenario: Scenario | None,
    trace: Sequence[TracePoint],
    ceased: bool,
    search_time_s: float,
    assume: str,
    stop: str,
    world: str = AS_MODELLED,
    outside_share: float = 0.0,
    area: Area = AREA,
    intermittency: Mapping[str, Quantiles] = NOTHING,
    advised_dwell_s: float = 0.0,
    last_word: LastWord | None = None,
    home: tuple[float, float] | None = None,
    left: Sequence[Left] = (),
    doubted: Mapping[int, int] = NOBODY,
    joined: Mapping[int, int] = NOBODY,
) -> Outcome:
    """Judge a mission by its true scenario, None if it is not known, and its trace.

    The trace's first point is the reading before any move.  outside_share, intermittency and advised_dwell_s
    are of the last belief; the last is 0 if as long as now.  home: latitude and longitude of the area's
    corner, degrees, if it is known.  left: who has left a search of several.
    doubted: by the number of a vehicle whose sensor seemed to lie, the step at which it was named.
    joined: by the number of a vehicle that joined late, the first round that it took part in.
    """
    last = trace[-1]
    source = scenario.nearest(last.mean) if scenario else None
    ended = verdict(ceased, last.mean, source, outside_share, area)
    error_m = math.dist(last.mean, source) if source else None
    latitude_deg, longitude_deg = on_earth(home, last.mean)
    vehicles = max(*(point.vehicle for point in trace), *(each.vehicle for each in left), 1)
    own = [[point for point in trace if point.vehicle == number] for number in range(1, vehicles + 1)]
    paths = [[point.position for point in points] for points in own]
    # `sum` differs between Pythons
    distances_m = [reduce(add, (math.dist(a, b) for a, b in pairwise(path)), 0.0) for path in paths]
    return Outcome(
        seed=seed,
        policy=policy,
        ceased=ceased,
        located=None if error_m is None else ended == "located",
        estimate=last.mean,
        source=source,
        scenario=scenario,
        error_m=error_m,
        spread_m=last.spread,
        steps=max(joined.get(number, 0) + len(path) for number, path in enumerate(paths, 1)) - 1,
        distance_m=reduce(add, distances_m),
        search_time_s=search_time_s,
        assume=assume,
        stop=stop,
        world=world,
        outside=ended == "outside",
        outside_share=outside_share,
        outside_to=area.beyond(last.mean),
        intermittency=dict(intermittency),
        advised_dwell_s=advised_dwell_s or None,
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        covariance_m2=last_word and last_word.covariance,
        rate_gs=last_word and last_word.rate,
        rate_interval_gs=last_word and last_word.rate_interval,
        units=dict(UNITS),
        distances_m=tuple(distances_m),
        measured=tuple(
            MeasuredBy(number, len(points), max((point.reading for point in points), default=None))
            for number, points in enumerate(own, 1)
        ),
        left=tuple(left),
        doubted=tuple(DoubtedOf(vehicle, step) for vehicle, step in doubted.items()),
        joined=tuple(Joined(vehicle, step) for vehicle, step in joined.items()),
    )


def on_earth(
    home: tuple[float, float] | None, place: tuple[float, float]
) -> tuple[float, float] | tuple[None, None]:
    """Return latitude and longitude of a place (x, y) m from home, degrees, to a millimetre.

    None for both if nobody knows where home is, or the place is further than FARTHEST_M.
    """
    if home is None or not (abs(place[0]) <= FARTHEST_M and abs(place[1]) <= FARTHEST_M):
        return None, None
    lat, lon = to_global(*home, place[1], place[0])
    return round(lat, DEGREE_DECIMALS), round(lon, DEGREE_DECIMALS)


def outcome_json(
    result: Outcome, trace: Sequence[TracePoint] | None, more: Mapping[str, Any] = MappingProxyType({})
) -> str:
    """One line of JSON, with the trace if given, and `more` fields."""
    fields = {**msgspec.to_builtins(result), **more}
    if result.scenario:
        del fields["scenario"]["source"]  # it stands beside the estimate
    if trace is not None:
        fields["trace"] = trace
    return msgspec.json.encode(fields).decode()


def outcome_text(result: Outcome) -> str:
    """Lines for people, each within 60 characters: three, with the source four.

    `gas_lines` and `vehicle_lines` follow.
    """
    ended = "not ceased"
    if result.outside:
        ended = f"{outside_text(result.outside_share, result.outside_to)},"
    elif result.ceased:
        ended = {True: "located", False: "FALSE STOP", None: "ceased"}[result.located]
    x, y = result.estimate
    source = (
        f"source   ({result.source[0]:.2f}, {result.source[1]:.2f}), error {result.error_m:.2f} m\n"
        if result.source
        else ""
    )
    of_all = f" of {result.vehicles} vehicles" if result.vehicles > 1 else ""
    return (
        f"{ended} after {result.steps} steps{of_all}, {result.distance_m:.1f} m\n"
        f"estimate ({x:.2f}, {y:.2f}) ± {result.spread_m:.2f} m\n"
        f"{source}{assumed_text(result.assume, result.stop, result.world)}"
    ) + "".join(
        f"\n{line}"
        for line in [*gas_lines(result.intermittency, result.advised_dwell_s), *vehicle_lines(result)]
    )


def vehicle_lines(result: Outcome) -> list[str]:
    """Lines for people, each within 60 characters: what each of several has measured, who has joined or left.

    And whose sensor seemed to lie.
    """
    lines, left = [], {each.vehicle: each for each in result.left}
    joined = {each.vehicle: each.step for each in result.joined}
    doubted = {each.vehicle: each.step for each in result.doubted}
    for each in result.measured if result.vehicles > 1 else ():
        count = f"{each.readings} reading{'' if each.readings == 1 else 's'}"
        most = "" if each.largest is None else f", at most {_short(each.largest, 2)}"
        lines.append(f"{f'uav/{each.vehicle}':<9}{count}{most}")
        if each.vehicle in joined:
            lines.append(f"{'':9}joined at step {joined[each.vehicle]}")
        if each.vehicle in doubted:
            lines.append(f"{'':9}doubted from step {doubted[each.vehicle]}: does not fit the others")
        if gone := left.get(each.vehicle):
            counts = ", its readings forgotten" if gone.forgotten and each.readings else ""
            why = f"left at step {gone.step}{counts}: {gone.reason}"
            lines += wrap(why, LINE, initial_indent=" " * 9, subsequent_indent=" " * 9)
    return lines


def assumed_text(assume: str, stop: str, world: str) -> str:
    """One line for people: what the estimator took to be known, and when it stops.

    The world follows if it differs from the model.
    """
    return f"assumed  {assume}, stop {stop}" + ("" if world == AS_MODELLED else f", world {world}")


def gas_lines(intermittency: Mapping[str, Quantiles], advised_dwell_s: float | None) -> list[str]:
    """Lines for people, each within 60 characters: how the gas comes and goes, and how long to hover for it.

    With medians and 90% intervals; of puffs where it comes and goes. No lines where it is taken to be known.
    """
    lines, puffs = [], []
    if "downwind" in intermittency:
        low, cv, high = intermittency["downwind"]
        how = "comes in bursts" if cv >= BURSTS else "comes and goes" if cv >= COMES_AND_GOES else "is steady"
        if low < COMES_AND_GOES and high >= UNKNOWN_CV:
            how = "may come and go"
        elif cv >= COMES_AND_GOES:
            puffs = [
                f"{words}{_told(intermittency[name], 1, unit)}"
                for name, words, unit in (("puff-rate", "", "/s"), ("puff-share", "share ", ""))
                if name in intermittency
            ]
        lines.append(f"gas      {how}: cv {_told(intermittency['downwind'], 2)} near source")
    if puffs:
        lines.append(f"puffs    {', '.join(puffs)}")
    if dwell_s := advised_dwell_s:
        lines.append(f"advice   hover {dwell_s:g} s for a reading of such gas: --dwell {dwell_s:g}")
    return lines


def _told(quantiles: Quantiles, digits: int, unit: str = "") -> str:
    """Median and 90% interval with so many significant digits: `0.2 (0.05 to 0.6)`."""
    low, middle, high = (_short(value, digits) for value in quantiles)
    return f"{middle}{unit} ({low} to {high})"


def _short(value: float, digits: int) -> str:
    """A number with so many significant digits."""
    number = float(f"{value:.{digits}g}")
    return f"{number:g}" if number < 1e5 else f"{number:.0e}"
