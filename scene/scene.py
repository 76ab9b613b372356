"""The scene: what there is to see of one mission at one moment.

Metres, seconds; x east, y north, from home; angles in rad.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from plume.dispersion import concentration
from plume.outcome import outside_text, verdict
from plume.problem import AREA, Area
from plume.scenario import SURE_OUTSIDE, Scenario, nearest

Point = tuple[float, float]  # (x, y) m
Floats = NDArray[np.float32]

INFO, WARNING, ERROR, STOPPED = "info", "warning", "error", "stop"  # levels of a `Happening`


TURN_DEG = 30.0  # a turn of the wind that people are shown is at least so large
TURN_READINGS = 3  # and has lasted for so many readings
LEAST_WIND_MPS = 0.5  # a weaker wind has no direction worth telling


@dataclass(frozen=True, slots=True)
class Release:
    """The truth of a simulation: where the gas comes from and how it spreads. A real flight has none."""

    source: Point
    wind: tuple[float, float]  # (u cos φ, u sin φ) m/s: points to where the wind comes from
    q: float
    d: float
    tau: float
    height: float = 0.0
    second: Point | None = None  # another source like it

    @classmethod
    def of(cls, scenario: Scenario) -> "Release":
        """Return what there is to see of a scenario."""
        it = scenario
        return cls(it.source, it.wind, it.q, it.d, it.tau, it.height, it.second)

    @property
    def sources(self) -> list[Point]:
        """The sources: one, or two."""
        return [self.source, *([self.second] if self.second else [])]

    def gas(self, area: Area, cells: int) -> Floats:
        """Return the mean gas in the search plane, g/m³, at the centres of cells.

        Its shape is (cells, cells), row 0 in the south; cells are as long as the area by `cells`.
        """
        x, y = np.meshgrid(
            *(
                low + (np.arange(cells) + 0.5) * (length_m / cells)
                for low, length_m in zip(area.low, area.size_m, strict=True)
            )
        )
        places, gas = np.stack([x, y, np.zeros_like(x)], axis=-1), np.zeros_like(x)
        for source in self.sources:
            gas += concentration(
                places,
                (*source, self.height),
                self.wind,
                rate=self.q,
                diffusivity=self.d,
                lifetime=self.tau,
            )
        with np.errstate(over="ignore"):  # a record may say absurd things of its source
            return np.asarray(gas, np.float32)


@dataclass(frozen=True, slots=True)
class Backdrop:
    """What does not change during a mission."""

    vehicle: str  # its namespace, `uav/1`
    area: Area = AREA  # where the search flies
    title: str = ""  # words for people: the policy, the seed; empty if unknown
    release: Release | None = None  # None: a real flight, or a simulation whose truth is not told
    walls: tuple[tuple[Point, ...], ...] = ()  # outlines of buildings and keep-outs, as far as known
    fence: tuple[Point, ...] = ()  # the polygon that no way leaves; empty: the area's edge


@dataclass(frozen=True, slots=True)
class Condition:
    """How the vehicle says it is. What it does not say is unknown."""

    battery: float | None = None  # remaining charge, 0 to 1
    volts: float | None = None
    gps: str = ""  # `3-D fix, 10 satellites`, `no fix`; empty if unknown
    ailing: tuple[str, ...] | None = None  # parts that are on and not healthy, in MAVLink's words
    placed: bool | None = None  # whether its estimator stands by the position
    wind: tuple[float, float] | None = None  # as it estimates it: points to where it comes from, m/s
    lost: float | None = None  # share of what was sent to it that did not arrive whole, 0 to 1
    # Signal strength at the ground's end of its radio link and at its own, 0 to 254 in the radio's units; NaN
    # if that end does not tell. None without RADIO_STATUS.
    radio: tuple[float, float] | None = None

    @property
    def health(self) -> str:
        """`ok`, or what is `not healthy`; empty if unknown."""
        wrong = [*(self.ailing or ()), *["position"] * (self.placed is False)]
        return f"not healthy: {', '.join(wrong)}" if wrong else ("" if self.ailing is None else "ok")


@dataclass(frozen=True, slots=True)
class Craft:
    """The vehicle as it reports itself."""

    time_s: float
    position: Point  # NaN if unknown
    altitude_m: float = 0.0  # above home
    heading: float = math.nan  # where the nose points, counter-clockwise from +x (east); NaN if unknown
    mode: str = ""  # `HOLD`, `OFFBOARD`, ArduCopter's `BRAKE`; empty if unknown
    armed: bool | None = None
    fix: tuple[float, float, float] | None = None  # latitude, longitude, degrees, and altitude above sea, m
    condition: Condition = Condition()
    speed_mps: float = math.nan  # over ground; NaN if unknown
    # Its own: of one that searches with others not the frame's origin; NaN if unknown.
    home: Point = (0.0, 0.0)

    @property
    def home_m(self) -> float:
        """How far it is from its own home in the plane; NaN if unknown."""
        return math.dist(self.position, self.home)


@dataclass(frozen=True, slots=True)
class Gauge:
    """How the sensor's readings are shown, so that the same value always looks the same."""

    unit: str  # as people write it
    # Where one colour ends and the next begins, from little gas to much. What is short of the first is noise:
    # clean air gives it, too.
    edges: tuple[float, ...]
    falls: bool = False  # whether more gas gives lower readings


@dataclass(frozen=True, slots=True)
class Measurement:
    """One reading, and the belief after it."""

    step: int
    time_s: float
    position: Point
    gas: float  # NaN: no reading, since the vehicle has left its search
    spread_m: float
    estimate: Point
    covariance: tuple[float, float, float]  # (xx, xy, yy) m²
    ceased: bool = False
    # How the gas comes and goes, and how long to hover for it, s: as of `Belief`.
    intermittency: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    advised_dwell_s: float = 0.0
    radius_95_m: float = math.nan  # 95% of the belief lies within it around the estimate; NaN if unknown
    rate: tuple[float, float, float] | None = None  # of release: 5, 50 and 95% quantiles, g/s; None if told
    wind: Point | None = None  # of the belief: points to where the wind comes from, m/s
    p_value: float = 1.0  # near 0 if the recent readings do not fit the model
    evidence: float = 0.0  # for gas, nats
    effective_sample_size: float = math.nan
    outside: float = 0.0  # share of the belief outside the area
    measured_wind: Point | None = None  # with the reading: points to where it comes from, m/s
    stretch: float = 1.0  # a stop allows for errors that are so many times wider than the belief


@dataclass(frozen=True, slots=True)
class Scatter:
    """The belief's particles."""

    places: Floats  # (N, 2) m
    weights: Floats  # (N,), which sum to one


@dataclass(frozen=True, slots=True)
class Service:
    """One service and how it is doing."""

    name: str
    verdict: str  # `ok`, `missing`, `starting`, `stale` or `refusing`, as `plumeward status` says it
    state: str = ""
    about: str = ""
    step: int = -1
    latency_s: float = 0.0
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Happening:
    """Something that people want to know of: a change of mode, a refusal, a warning, the stop."""

    time_s: float
    level: str
    who: str  # `uav`, `estimator`, `agent`, or who said it
    text: str


@dataclass(frozen=True, slots=True)
class Ending:
    """How the search ended."""

    verdict: str  # as of `plume.outcome.verdict`
    text: str  # a line or more for people


@dataclass(frozen=True, slots=True)
class Scene:
    """What there is to see at one moment. Lists hold everything from the beginning until then."""

    backdrop: Backdrop
    time_s: float = 0.0  # simulation time
    craft: Craft | None = None
    track: Floats = field(default_factory=lambda: np.empty((0, 2), np.float32))  # (K, 2) m: where it was
    measurements: Sequence[Measurement] = ()
    scatter: Scatter | None = None
    waypoint: Point | None = None
    wind: tuple[float, float] | None = None  # as measured, at first as the vehicle estimates it; whence, m/s
    stop: str = ""  # the stop criterion, in the form of --stop
    assume: str = ""
    services: Sequence[Service] = ()
    happenings: Sequence[Happening] = ()
    ending: Ending | None = None
    home: tuple[float, float, float] | None = None  # latitude and longitude, degrees, and m above sea
    silent_s: float | None = None  # since the vehicle was last heard, by the clock; None in a record
    gauge: Gauge | None = None
    left: bool = False  # whether the vehicle has left the search by several

    @property
    def threshold_m(self) -> float | None:
        """ζ of the stop `spread:ζ`; None with another criterion."""
        kind, _, rest = self.stop.partition(":")
        with suppress(ValueError):
            return float(rest) if kind == "spread" else None
        return None


def judged(
    step: int,
    estimate: Point,
    spread_m: float,
    outside_share: float,
    release: Release | None,
    area: Area = AREA,
) -> Ending:
    """Return how a search that was stopped has ended.

    Only a simulation can tell whether the stop is right.  outside_share: of the belief.
    """
    at = f"({estimate[0]:.2f}, {estimate[1]:.2f}) ± {spread_m:.2f} m after {step} steps"
    said = outside_text(outside_share, area.beyond(estimate))
    words = f"source {said}, near {at}" if outside_share >= SURE_OUTSIDE else f"source found at {at}"
    source = nearest(estimate, release.source, release.second) if release else None
    if source:
        words += f"; error {math.dist(estimate, source):.2f} m"
    return Ending(verdict(True, estimate, source, outside_share, area), words)


@dataclass(frozen=True, slots=True)
class WindShift:
    """The wind turned, as measured: from this reading on it is another."""

    step: int
    place: Point
    before: Point  # the wind, which points to where it comes from, m/s
    after: Point

    @property
    def degrees(self) -> float:
        """By how much it turned, 0 to 180."""
        (east, north), (other_east, other_north) = self.before, self.after
        across, along = east * other_north - north * other_east, east * other_east + north * other_north
        return abs(math.degrees(math.atan2(across, along)))


def turns(measurements: Sequence[Measurement]) -> list[WindShift]:
    """Return where the wind turned: its means of a few readings before and after differ by TURN_DEG or more.

    A turn that did not last for TURN_READINGS readings is none.
    """
    known = [it for it in measurements if it.measured_wind]
    winds = np.array([it.measured_wind for it in known], np.float64).reshape(-1, 2)
    found: list[WindShift] = []
    last = -1  # the newest reading that counted towards a turn
    for i in range(TURN_READINGS, len(known) - TURN_READINGS + 1):
        before, after = winds[i - TURN_READINGS : i].mean(axis=0), winds[i : i + TURN_READINGS].mean(axis=0)
        turn = WindShift(known[i].step, known[i].position, _point(before), _point(after))
        is_weak = min(np.hypot(*before), np.hypot(*after)) < LEAST_WIND_MPS
        is_before = np.hypot(*(winds[i] - before)) < np.hypot(*(winds[i] - after))
        if turn.degrees < TURN_DEG or is_weak or is_before:
            continue
        if found and i - last == 1:  # the same turn: it is where the two differ most
            found[-1] = max(found[-1], turn, key=lambda it: it.degrees)
        else:
            found.append(turn)
        last = i
    return found


def _point(vector: NDArray[np.float64]) -> Point:
    return float(vector[0]), float(vector[1])


def ellipse(covariance: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the 2σ ellipse of a covariance (xx, xy, yy) m².

    Its half axes, m, the longer first, and the longer one's angle, ccw from +x. A Gaussian in the plane lies
    within it with a probability of 86.5%.
    """
    xx, xy, yy = covariance
    middle, half = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    longer, shorter = (2.0 * math.sqrt(max(middle + sign * half, 0.0)) for sign in (1, -1))
    return longer, shorter, math.atan2(2 * xy, xx - yy) / 2
