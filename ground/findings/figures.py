"""The findings of a flight as figures: what all its documents show."""

import math
import platform
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ground.findings.assumed import Told, calibration, command_line, stop_text, told_of, unit_of
from ground.findings.flight import Flight, FlownReading
from ground.findings.numbers import utc
from ground.findings.region import Contour95, Ellipse95, contour_95, ellipse_95, places_of, scale_of
from ground.findings.unseen import Smallest, Watch, smallest_rates
from ground.findings.verdict import DOUBTFUL, NOT_FOUND, OUTSIDE, Judgement, verdict
from link.bus.messages import Belief
from plume import __version__
from plume.geodesy import to_global
from plume.outcome import gas_lines, interval, rate_interval
from plume.problem import Area
from plume.scenario import Scenario
from plume.sensors.instruments import Instrument
from scene.follow.described import problem_of
from scene.scene import Point

KG_H = 3.6  # kg/h of 1 g/s
Z_95 = 1.959963984540054
FARTHEST_M = 1e7  # a place further from home is none: a damaged record may say anything


class Ranged(NamedTuple):
    """A figure and its 95% interval; without one, it was told and not estimated."""

    value: float
    low: float | None = None
    high: float | None = None

    def times(self, factor: float) -> "Ranged":
        """Return it in another unit."""
        ends = (None if end is None else factor * end for end in (self.low, self.high))
        return Ranged(factor * self.value, *ends)


class FlownWind(NamedTuple):
    """The wind as measured, and what the belief made of it.

    Directions are those it comes from, degrees clockwise from north.
    """

    speed_mps: float  # mean of the measured speeds
    speed_std_mps: float
    from_deg: float  # of the mean vector
    from_std_deg: float  # Yamartino 1984
    believed_speed: Ranged | None = None  # m/s; None: the measured one was taken as true
    believed_from: Ranged | None = None
    one_wind_p: float = 1.0  # p-value that all readings had one wind


@dataclass(frozen=True)
class Findings:
    """All figures of a flight. Lengths in metres, x east, y north of home."""

    flight: Flight
    told: Told
    verdict: Judgement
    area: Area
    scale: float  # of the region, by the belief's own
    ellipse: Ellipse95
    contour: Contour95 | None
    height: Ranged | None  # of the source above home, m; None if it was taken to be known
    rate: Ranged  # g/s
    wind: FlownWind
    gas: dict[str, tuple[float, float, float]]  # 5, 50 and 95% quantiles, as of `Belief.intermittency`
    smallest: Smallest | None  # the smallest rates that would have been seen; None where a source was found
    made_ns: int = field(default=0)

    @property
    def last(self) -> Belief:
        """The last belief."""
        return self.flight.last

    @property
    def path_m(self) -> float:
        """How far below the vehicle a sensor looks along a path, m; 0 of one that meets the gas."""
        sensor = self.told.sensor
        if not isinstance(sensor, Instrument):
            return 0.0
        return sensor.ray * -math.sin(math.radians(sensor.pitch))

    @property
    def height_m(self) -> float:
        """Height of the source above home, as it was taken to be: of a path's gas that of its end."""
        at_the_vehicle = self.height is None and self.last.z == self.last.altitude_m
        return self.last.z - (self.path_m if at_the_vehicle else 0.0)

    @property
    def unit(self) -> str:
        """The unit of the readings."""
        return unit_of(self.told.sensor)

    def on_earth(self, place: Sequence[float]) -> tuple[float, float] | None:
        """Return latitude and longitude of a place (x, y) m, degrees; None if they cannot be told."""
        east, north = map(float, place)
        if self.flight.home is None or not (abs(east) <= FARTHEST_M and abs(north) <= FARTHEST_M):
            return None
        return to_global(*self.flight.home, north, east)


def findings_of(flight: Flight, watch: Watch = iter) -> Findings:
    """Return the findings of a flight; `watch` as `smallest_rates` takes it."""
    last = flight.last
    told = told_of(last, flight.about)
    judged = verdict(flight, told)
    area = problem_of(flight.about).area
    contour, scale = None, scale_of(last)
    if flight.particles is not None:
        contour = contour_95(*places_of(flight.particles, last.unknowns, last.mean), scale)
    not_found = judged.kind in (NOT_FOUND, OUTSIDE) or (judged.kind == DOUBTFUL and not last.ceased)
    return Findings(
        flight=flight,
        told=told,
        verdict=judged,
        area=area,
        scale=scale,
        ellipse=ellipse_95(last.mean, last.covariance, scale),
        contour=contour,
        height=_ranged("z", last.z, flight) if "z" in last.unknowns else None,
        rate=_rate(flight),
        wind=_wind(flight),
        gas=last.intermittency,
        smallest=smallest_rates(flight, told, area, watch=watch) if not_found else None,
        made_ns=int(datetime.now(UTC).timestamp() * 1e9),
    )


def _ranged(name: str, value: float, flight: Flight) -> Ranged:
    """Return an unknown with its interval: of the particles, or without them of mean and deviation."""
    last = flight.last
    if name not in last.unknowns:
        return Ranged(value)
    if flight.particles is not None and (ends := interval(name, last.unknowns, flight.particles)):
        return Ranged(value, *ends)
    half = Z_95 * last.stds[last.unknowns.index(name)]
    least = 0.0 if name in ("q", "tau", "u", "wind-speed", "noise") else -math.inf
    return Ranged(value, max(value - half, least), value + half)


def _rate(flight: Flight) -> Ranged:
    last, particles = flight.last, flight.particles
    ends = None if particles is None else rate_interval(last.unknowns, particles, last.intermittency)
    return Ranged(last.rate, *ends) if ends else _ranged("q", last.rate, flight)


def _wind(flight: Flight) -> FlownWind:
    east, north = np.array([sample.wind for sample in flight.samples]).T
    speeds = np.hypot(east, north)
    mean_east, mean_north = float(east.mean()), float(north.mean())
    from_deg = math.degrees(math.atan2(mean_east, mean_north)) % 360.0
    moving = speeds > 0
    std_deg = 0.0
    if moving.any():
        sine = float((east[moving] / speeds[moving]).mean())
        cosine = float((north[moving] / speeds[moving]).mean())
        epsilon = math.sqrt(max(1.0 - sine * sine - cosine * cosine, 0.0))
        std_deg = math.degrees(math.asin(min(epsilon, 1.0)) * (1 + 0.1547 * epsilon**3))
    wind = FlownWind(
        float(speeds.mean()), float(speeds.std()), from_deg, std_deg, one_wind_p=flight.last.wind_p_value
    )
    return wind._replace(
        believed_speed=_believed_speed(flight, wind.speed_mps), believed_from=_believed_from(flight, from_deg)
    )


def _believed_speed(flight: Flight, measured_mps: float) -> Ranged | None:
    last = flight.last
    for name, factor in (("u", 1.0), ("wind-speed", measured_mps)):
        if name in last.unknowns:
            return _ranged(name, last.means[last.unknowns.index(name)], flight).times(factor)
    return None


def _believed_from(flight: Flight, measured_deg: float) -> Ranged | None:
    """Return the believed direction, whence, degrees clockwise from north; its ends may pass 0 or 360."""
    last = flight.last
    if "wind-direction" in last.unknowns:  # counter-clockwise, which a compass counts down
        it = _ranged("wind-direction", last.means[last.unknowns.index("wind-direction")], flight)
        base = measured_deg
    elif "phi" in last.unknowns:
        it = _ranged("phi", last.means[last.unknowns.index("phi")], flight).times(180 / math.pi)
        base = 90.0
    else:
        return None
    low, high = (0.0 if end is None else end for end in (it.low, it.high))
    return Ranged(base - it.value, base - high, base - low)


# ---- as JSON ----

UNITS = {
    "*_deg": "degrees (WGS84; directions clockwise from north, wind: where it comes from)",
    "*_m": "metres",
    "*_m2": "square metres",
    "*_gs": "grams per second",
    "*_kgh": "kilograms per hour",
    "*_mps": "metres per second",
    "*_s": "seconds",
    "*_utc": "ISO 8601, UTC",
}


def as_json(it: Findings) -> dict[str, Any]:
    """Return all figures as JSON-able values; names end in their unit, as `units` says."""
    last, flight, about = it.last, it.flight, it.flight.about
    place = it.on_earth(last.mean)
    versions = about.get("versions")
    return {
        "verdict": it.verdict.kind,
        "sentence": it.verdict.sentence,
        "reasons": list(it.verdict.reasons),
        "latitude_deg": None if place is None else place[0],
        "longitude_deg": None if place is None else place[1],
        "estimate": list(last.mean),
        "covariance_m2": list(last.covariance),
        "spread_m": last.spread,
        "region_95": {
            "scale": it.scale,
            "ellipse": {
                "longer_half_axis_m": it.ellipse.longer_m,
                "shorter_half_axis_m": it.ellipse.shorter_m,
                "bearing_of_longer_deg": it.ellipse.bearing_deg,
            },
            "contour": None
            if it.contour is None
            else [[list(it.on_earth(p) or p) for p in ring.tolist()] for ring in it.contour.rings],
            "contour_points": "latitude_deg, longitude_deg" if place else "x_m, y_m",
        },
        "height_m": _json(it.height) if it.height else {"value": it.height_m, "interval_95": None},
        "rate_gs": last.rate,
        "rate_interval_gs": _ends(it.rate),
        "rate_kgh": KG_H * last.rate,
        "rate_interval_kgh": _ends(it.rate.times(KG_H)),
        "rate_is_relative_to_diffusivity_m2s": last.diffusivity,
        "lifetime_s": last.lifetime,
        "wind": {
            "speed_mps": it.wind.speed_mps,
            "speed_std_mps": it.wind.speed_std_mps,
            "from_deg": it.wind.from_deg,
            "from_std_deg": it.wind.from_std_deg,
            "believed_speed_mps": _json(it.wind.believed_speed),
            "believed_from_deg": _json(it.wind.believed_from),
            "one_wind_p_value": it.wind.one_wind_p,
        },
        "gas": {
            "quantiles_5_50_95": {name: list(values) for name, values in it.gas.items()},
            "words": gas_lines(it.gas, last.advised_dwell or None),
            "advised_dwell_s": last.advised_dwell or None,
        },
        "sensor": {
            "name": last.sensor,
            "unit": it.unit,
            "calibration": calibration(it.told.sensor) if it.told.sensor else None,
        },
        "assume": last.assume,
        "stop": {"criterion": last.stop, "words": stop_text(last.stop), "met": last.ceased},
        "priors": [row._asdict() for row in it.told.priors],
        "margin_m": it.told.margin_m,
        "estimator_flags": command_line(about),
        "area": {"low_m": it.area.low, "high_m": it.area.high},
        "keep_out_m": flight.walls,
        "keep_in_m": flight.fence or None,
        "home": {"place_deg": flight.home, "said_by": flight.home_by},
        "checks": {
            "p_value": last.p_value,
            "evidence_nats": last.evidence,
            "outside_share": last.outside,
            "effective_sample_size": last.effective_sample_size,
        },
        "smallest_rate": None if it.smallest is None else it.smallest.as_json(it.on_earth),
        "warnings": [
            {"time_utc": utc(said.utc_ns), "who": said.who, "text": said.text} for said in flight.warnings
        ],
        "vehicles": len(flight.tracks),
        "readings": len(flight.samples),
        "steps": last.step,
        "distance_m": _distance(flight.samples),
        "began_utc": utc(flight.began_ns),
        "ended_utc": utc(flight.ended_ns),
        "record": {
            "file": flight.path.name,
            "sha256": flight.sha256,
            "remark": flight.remark,
            "versions": versions if isinstance(versions, dict) else {},
            "git": about.get("git"),
            "seed": about.get("seed"),
            "policy": about.get("policy"),
            "world": _world(about),
        },
        "simulated": None
        if (source := simulated_source(it)) is None
        else {"source": list(source), "error_m": math.dist(source, last.mean)},
        "made_by": {
            "plumeward": __version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "made_utc": utc(it.made_ns),
        },
        "units": UNITS,
    }


def _world(about: dict[str, Any]) -> str | None:
    """Return the simulated world that was flown in; None of a real flight."""
    mission = about.get("mission")
    world = mission.get("world") if isinstance(mission, dict) and "vehicle" not in about else None
    return world if isinstance(world, str) else None


def simulated_source(it: Findings) -> Point | None:
    """Return the source of a simulated plume, (x, y) m, if the record has it; of two the nearer one."""
    with suppress(KeyError, msgspec.ValidationError):
        return msgspec.convert(it.flight.about["scenario"], Scenario).nearest(it.last.mean)
    return None


def _distance(samples: Sequence[FlownReading]) -> float:
    of: dict[int, list[Point]] = {}
    for sample in samples:
        of.setdefault(sample.vehicle, []).append(sample.place)
    return math.fsum(math.dist(a, b) for places in of.values() for a, b in pairwise(places))


def _ends(it: Ranged) -> list[float] | None:
    return None if it.low is None or it.high is None else [it.low, it.high]


def _json(it: Ranged | None) -> dict[str, Any] | None:
    return None if it is None else {"value": it.value, "interval_95": _ends(it)}
