"""A problem: where a search flies, what it knows beforehand, and what its missions are drawn from.

Metres, x east and y north of home. `paper` is the paper's Table 1, and the default everywhere.
"""

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Annotated, Any, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from plume.elementary import Array
from plume.mistakes.explained import dotted, explained
from plume.parameters import LIMITS
from plume.polygons.obstacles import Obstacles
from plume.polygons.parts import area_of, held, octagon
from plume.polygons.polygons import crosses_itself, outline
from plume.randomness import keyed, uniform
from plume.scenario import (
    AREA_M,
    AS_MODELLED,
    BUDGET_STEPS,
    DIFFUSIVITIES,
    LIFETIME_S,
    RATES,
    SOURCE_HIGH_M,
    SOURCE_LOW_M,
    STEP_M,
    WIND_FROM,
    WIND_SPEEDS,
)

FARTHEST_M = 100_000.0  # greatest coordinate: further out, float32 on the wire is coarser than a centimetre
SHORTEST_M = 1.0  # least side of an area
MOST_STEPS = 1_000_000
LONGEST_DWELL_S = 600.0
CEILING_M = 120.0  # highest altitude of a search above home
ALTITUDE_M = 5.0
PARTS = 3  # a step is at most this part of the area's shorter side: from everywhere there is a way to go
CLEARANCE_M = (
    2.0  # distance that ways keep from a polygon's sides: as well as a satellite receiver knows its place
)
WIDEST_CLEARANCE_M = 1000.0
MOST_POLYGONS, MOST_CORNERS = 50, 200  # MOST_CORNERS of all polygons together
PLACE_RADIUS_M = 2.0  # how far from a place where it is expected a source may be
LEAST_WEIGHT, MOST_WEIGHT = 1e-6, 1e6
THINNEST = 0.001  # least share of the rectangle around a polygon that it fills, if the source may be in it
MOST_DRAWS = 100_000  # most draws of a place until one is allowed
STOP = re.compile(r"spread:[^,]+|within:[^,]+,[^,]+")  # the form of --stop; `estimator.criterion` reads it

Coordinate = Annotated[
    float, Meta(ge=-FARTHEST_M, le=FARTHEST_M, description="a number from -100000 to 100000, m")
]
Place = Annotated[tuple[Coordinate, Coordinate], Meta(description="(x, y) m")]
Degrees = Annotated[float, Meta(ge=-180, le=180, description="a number, degrees")]
Corners = Annotated[
    tuple[Place, ...],
    Meta(
        min_length=3,
        max_length=MOST_CORNERS,
        description=f"the corners of a polygon in order, (x, y) m, 3 to {MOST_CORNERS}",
    ),
]
Number = Annotated[float, Meta(description="a number")]
Span = Number | tuple[Number, Number]  # a value, or the least and the greatest of a uniform distribution


class Area(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A rectangle along the axes. Raises ValueError, one line, if its corners are not allowed.

    Examples:
        >>> plumeward.Area(low=(-50, 0), high=(150, 80)).size_m  # from west to east, and from south to north
        (200, 80)
    """

    low: Annotated[Place, Meta(description="its south-west corner, (x, y) m, each from -100000 to 100000")]
    high: Annotated[Place, Meta(description="its north-east corner, (x, y) m, each from -100000 to 100000")]

    def __post_init__(self) -> None:
        for name, corner in (("low", self.low), ("high", self.high)):
            if len(corner) != 2 or not all(-FARTHEST_M <= part <= FARTHEST_M for part in corner):
                raise ValueError(
                    f"{name}: {_listed(corner)} is not allowed; wanted (x, y), each from {-FARTHEST_M:g} to "
                    f"{FARTHEST_M:g} m"
                )
        if not (self.low[0] < self.high[0] and self.low[1] < self.high[1]):
            raise ValueError(
                f"high: {_listed(self.high)} is not allowed; wanted a corner north-east of low, "
                f"{_listed(self.low)}"
            )

    @property
    def size_m(self) -> tuple[float, float]:
        """Its extent from west to east and from south to north."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]

    @property
    def side_m(self) -> float:
        """The side of a square that is as large."""
        width_m, height_m = self.size_m
        return math.sqrt(width_m * height_m)

    @property
    def obstacles(self) -> Obstacles | None:
        """What is in the way in it; None if all of it is free."""
        return None

    @property
    def text(self) -> str:
        """In words: `[0, 30] x [0, 30] m`."""
        ends = zip(self.low, self.high, strict=True)
        return " x ".join(f"[{low:g}, {high:g}]" for low, high in ends) + " m"

    def holds(self, place: Sequence[float]) -> bool:
        """Whether a place, (x, y) m, is inside; its edges are. NaN is not."""
        return all(low <= along <= high for low, along, high in zip(self.low, place, self.high, strict=True))

    def held(self, places: Array) -> NDArray[np.bool_]:
        """Return which of these places (..., 2) m are inside: (...)."""
        return np.asarray(((places >= self.low) & (places <= self.high)).all(axis=-1))

    def clipped(self, places: ArrayLike) -> Array:
        """Return the places inside that are nearest to these (..., 2) m: (..., 2)."""
        return np.clip(places, self.low, self.high)

    def beyond(self, place: Sequence[float]) -> str:
        """Return beyond which edges a place is: north, north-east, …; empty if it is inside."""
        x, y = place
        north = "north" if y > self.high[1] else "south" if y < self.low[1] else ""
        east = "east" if x > self.high[0] else "west" if x < self.low[0] else ""
        return "-".join(filter(None, (north, east)))

    def on_the_wire(self) -> "Area":
        """Return the greatest area within it whose edges are float32 values, as the wire carries them."""
        low = [_rounded(part, part, 1) for part in self.low]
        high = [_rounded(part, part, -1) for part in self.high]
        return Area((low[0], low[1]), (high[0], high[1]))


class Fenced(Area, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A rectangle with what is in the way in it: the `ground` of a problem."""

    keep_out: tuple[Corners, ...] = ()
    keep_in: Corners | None = None
    clearance_m: float = CLEARANCE_M
    source_inside: bool = False  # whether the source may be inside a polygon to keep out of

    @property
    def obstacles(self) -> Obstacles:
        """What is in the way in it."""
        return _obstacles(self)


class PriorPart(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the source is expected, in part: in a polygon, or about a place.

    Raises ValueError, one line, if it is neither or both.

    Examples:
        >>> one = plumeward.PriorPart(place=(8, 20), weight=3)
        >>> valves = [one, plumeward.PriorPart(place=(24, 11), weight=1)]
        >>> plumeward.Problem(prior=valves).expected.text
        '2 parts in [6, 26] x [9, 22] m'
    """

    corners: Annotated[Corners | None, Meta(description="a polygon: its corners in order, (x, y) m")] = None
    place: Annotated[Place | None, Meta(description="a place, (x, y) m, instead of corners")] = None
    radius_m: Annotated[
        float, Meta(description="how far from the place it may be, a number above 0 up to 1000, m")
    ] = PLACE_RADIUS_M
    weight: Annotated[
        float | None,
        Meta(
            description="how likely it is there, relative to the other parts, a number above 0 up to "
            f"{MOST_WEIGHT:g}; default: if no part has one, all are equally likely everywhere in them"
        ),
    ] = None

    def __post_init__(self) -> None:
        if (self.corners is None) == (self.place is None):
            raise ValueError("a part of a prior has either corners or a place")
        if self.corners is not None:
            msgspec.structs.force_setattr(self, "corners", tuple(map(tuple, self.corners)))
        if not 0.0 < self.radius_m <= WIDEST_CLEARANCE_M:
            raise ValueError(
                f"radius_m: {self.radius_m!r} is not allowed; wanted above 0 up to {WIDEST_CLEARANCE_M:g} m"
            )
        if self.weight is not None and not LEAST_WEIGHT <= self.weight <= MOST_WEIGHT:
            raise ValueError(
                f"weight: {self.weight!r} is not allowed; wanted {LEAST_WEIGHT:g} to {MOST_WEIGHT:g}"
            )

    @property
    def polygon(self) -> Corners:
        """Its corners; of a place those of the octagon around it."""
        return octagon(self.place, self.radius_m) if self.place else self.corners or ()


class PriorParts(Area, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Polygons and places where the source is expected, and the rectangle around them.

    It holds what is in them.
    """

    parts: tuple[PriorPart, ...]

    @classmethod
    def of(cls, *parts: PriorPart) -> "PriorParts":
        """Return them together."""
        ends = zip(*(corner for part in parts for corner in part.polygon), strict=True)
        (west, east), (south, north) = ((min(along), max(along)) for along in ends)
        return cls((west, south), (east, north), parts=parts)

    @property
    def text(self) -> str:
        """In words."""
        around = Area(self.low, self.high).text
        if len(self.parts) == 1 and (corners := self.parts[0].corners):
            return f"the polygon of {len(outline(corners))} corners in {around}"
        return f"{len(self.parts)} part{'s' * (len(self.parts) > 1)} in {around}"

    @property
    def polygons(self) -> list[Corners]:
        """The corners of each part."""
        return [part.polygon for part in self.parts]

    @property
    def shares(self) -> Array:
        """How likely the source is in each part, (P,). They add up to 1."""
        weights = np.array([part.weight or area_of(part.polygon) for part in self.parts])
        return np.asarray(weights / weights.sum())

    @property
    def densities(self) -> Array:
        """The prior's density in each part, as a share of the greatest, (P,). Those that overlap add up."""
        densities = self.shares / [area_of(polygon) for polygon in self.polygons]
        return np.asarray(densities / densities.max())

    def drawn(self, rng: np.random.Generator, first: Place | None = None) -> Place:
        """Draw a place from the parts by their weights.

        first: of one part, what stands for the first draw.
        """
        polygon = self
        if len(self.parts) > 1:
            part = int(np.searchsorted(np.cumsum(self.shares)[:-1], rng.random(), side="right"))
            polygon, first = PriorParts.of(self.parts[part]), None
        place = first or _uniform(rng, polygon)
        for _ in range(MOST_DRAWS):
            if polygon.holds(place):
                break
            place = _uniform(rng, polygon)
        return place

    def holds(self, place: Sequence[float]) -> bool:
        """Whether a place, (x, y) m, is inside. NaN is not."""
        return bool(self.held(np.array(place, np.float64)))

    def held(self, places: Array) -> NDArray[np.bool_]:
        """Return which of these places (..., 2) m are inside: (...)."""
        return held(places, self.polygons)


@lru_cache(64)
def _obstacles(ground: Fenced) -> Obstacles:
    return Obstacles(ground.keep_out, ground.keep_in or (), ground.clearance_m, ground.low, ground.high)


def square(side_m: float) -> Area:
    """Return the square with its south-west corner at home."""
    return Area((0.0, 0.0), (side_m, side_m))


AREA = square(AREA_M)  # Table 1's
SOURCES = Area((SOURCE_LOW_M, SOURCE_LOW_M), (SOURCE_HIGH_M, SOURCE_HIGH_M))  # where Table 1 has them


class Problem(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is to be searched: the same for scripts, flags, functions and environments.

    What is left out is that of the paper's Table 1. Raises ValueError, one line that names the field, the
    value and what is allowed.

    Examples:
        >>> field = plumeward.Problem(area=plumeward.Area((-50, 0), (150, 80)), step_m=3)
        >>> outcome, trace = plumeward.rollout(seed=1, problem=field)
        >>> outcome.located
        True
    """

    area: Annotated[Area, Meta(description="where the search flies")] = AREA
    home: Annotated[
        tuple[Degrees, Degrees] | None,
        Meta(
            description="latitude and longitude of home, from which all metres count, degrees; a real "
            "vehicle takes off nowhere else; default: wherever the vehicle takes off"
        ),
    ] = None
    altitude_m: Annotated[
        float, Meta(description="height of the search above home, a number above 0 up to 120, m")
    ] = ALTITUDE_M
    step_m: Annotated[
        float, Meta(description="length of a move, above 0 up to a third of the area's shorter side, m")
    ] = STEP_M
    dwell_s: Annotated[
        float | None,
        Meta(description="hover so long for a reading, 0 to 600 s; default: as the sensor wants"),
    ] = None
    start: Annotated[
        Area | Place | None,
        Meta(
            description="where searches begin: (x, y) m, or a rectangle from which the seed draws it; "
            "default: the south-western sixth of the area"
        ),
    ] = None
    keep_out: Annotated[
        tuple[Corners, ...],
        Meta(
            max_length=MOST_POLYGONS,
            description="polygons that no way may enter, such as buildings: lists of their corners in order, "
            f"(x, y) m, at least 3 each and {MOST_CORNERS} together",
        ),
    ] = ()
    keep_in: Annotated[
        Corners | None,
        Meta(
            description="a polygon that no way may leave: its corners in order, (x, y) m; default: all of "
            "the area"
        ),
    ] = None
    clearance_m: Annotated[
        float,
        Meta(
            description="how far ways stay from the sides of keep_out and keep_in, a number from 0 to 1000, m"
        ),
    ] = CLEARANCE_M
    source_inside: Annotated[
        bool, Meta(description="whether the source may be inside a polygon of keep_out: true or false")
    ] = False
    prior: Annotated[
        Area | tuple[Place | PriorPart, ...] | None,
        Meta(
            description="where the estimator expects the source: a rectangle in the area; or a polygon, its "
            "corners in order, (x, y) m; or a list of parts; default: the area"
        ),
    ] = None
    source: Annotated[
        Area | Place | None,
        Meta(
            description="where it is: (x, y) m, or a rectangle from which the seed draws it; default: where "
            "it is expected, in Table 1's area Table 1's square, from (10, 10) to (25, 25)"
        ),
    ] = None
    q: Annotated[Span, Meta(description="release rate, or its least and greatest, g/s")] = RATES
    u: Annotated[Span, Meta(description="wind speed, or its least and greatest, m/s")] = WIND_SPEEDS
    phi: Annotated[
        Span,
        Meta(description="direction the wind comes from, or its ends, counter-clockwise from east, rad"),
    ] = WIND_FROM
    d: Annotated[Span, Meta(description="diffusivity, or its least and greatest, m²/s")] = DIFFUSIVITIES
    tau: Annotated[Span, Meta(description="lifetime of the gas, or its least and greatest, s")] = LIFETIME_S
    sensor: Annotated[str, Meta(description="the gas sensor, in the form of --sensor")] = "gaussian"
    world: Annotated[str, Meta(description="how gas moves and the truth differs, in the form of --world")] = (
        AS_MODELLED
    )
    budget: Annotated[int, Meta(description="most moves of a mission, a whole number from 1")] = BUDGET_STEPS
    stop: Annotated[str, Meta(description="the stop criterion, in the form of --stop")] = "spread:0.5"

    def __post_init__(self) -> None:
        for name, value in msgspec.structs.asdict(_typed(self)).items():
            msgspec.structs.force_setattr(self, name, value)
        if self.prior is not None and not isinstance(self.prior, Area):
            _check_prior(self.prior)
        if self.home and not (abs(self.home[0]) <= 90 and abs(self.home[1]) <= 180):
            raise ValueError(
                f"home: {_listed(self.home)} is not allowed; wanted latitude, -90 to 90, and longitude, "
                "-180 to 180"
            )
        if not min(self.area.size_m) >= SHORTEST_M:
            raise ValueError(
                f"area: {self.area.text} is not allowed; wanted sides of at least {SHORTEST_M:g} m"
            )
        longest_m = self.longest_step_m
        for name, sound, wanted in (
            ("altitude_m", 0.0 < self.altitude_m <= CEILING_M, f"above 0 up to {CEILING_M:g} m"),
            (
                "step_m",
                0.0 < self.step_m <= longest_m,
                f"above 0 up to {longest_m:g} m, a third of the area's shorter side",
            ),
            (
                "clearance_m",
                0.0 <= self.clearance_m <= WIDEST_CLEARANCE_M,
                f"0 to {WIDEST_CLEARANCE_M:g} m",
            ),
            ("dwell_s", 0.0 <= (self.dwell_s or 0.0) <= LONGEST_DWELL_S, f"0 to {LONGEST_DWELL_S:g} s"),
            ("budget", 1 <= self.budget <= MOST_STEPS, f"a whole number from 1 to {MOST_STEPS:,}"),
            ("stop", bool(STOP.fullmatch(self.stop)), "spread:Z, metres, or within:R,P, metres and a share"),
        ):
            if not sound:
                raise ValueError(f"{name}: {getattr(self, name)!r} is not allowed; wanted {wanted}")
        for name in ("q", "u", "phi", "d", "tau"):
            low, high = span(getattr(self, name))
            least, most = LIMITS.get(name, (-math.tau, math.tau))
            if not least <= low <= high <= most:
                raise ValueError(
                    f"{name}: {_listed(getattr(self, name))} is not allowed; wanted a number, or the least "
                    f"and the greatest, from {least:.12g} to {most:.12g}"
                )
        for name, place in (("start", self.start), ("prior", self.support)):
            if place is not None and not all(map(self.area.holds, _ends(place))):
                what = "a place or a rectangle" if name == "start" else "a rectangle, a polygon or parts"
                raise ValueError(
                    f"{name}: {_said(place)} is not allowed; wanted {what} in the area, {self.area.text}"
                )
        if self.source is not None and not all(
            math.isfinite(part) and abs(part) <= FARTHEST_M for end in _ends(self.source) for part in end
        ):
            raise ValueError(
                f"source: {_said(self.source)} is not allowed; wanted (x, y), each from {-FARTHEST_M:g} to "
                f"{FARTHEST_M:g} m"
            )
        if isinstance(self.ground, Fenced):
            _check_ways(self.ground, self.starts, self.expected, self.sources)

    @property
    def longest_step_m(self) -> float:
        """The longest move that is allowed."""
        return min(self.area.size_m) / PARTS

    @property
    def ground(self) -> Area:
        """The area, with what is in the way in it."""
        if not (self.keep_out or self.keep_in):
            return self.area
        return Fenced(
            self.area.low,
            self.area.high,
            keep_out=self.keep_out,
            keep_in=self.keep_in,
            clearance_m=self.clearance_m,
            source_inside=self.source_inside,
        )

    @property
    def starts(self) -> Area | Place:
        """Where searches begin."""
        if self.start is not None:
            return self.start
        (x, y), (width_m, height_m) = self.area.low, self.area.size_m
        return Area(self.area.low, (x + width_m / 6, y + height_m / 6))

    @property
    def sources(self) -> Area | Place:
        """Where the source is drawn."""
        if self.source is not None:
            return self.source
        return SOURCES if self.area == AREA and self.prior is None else self.expected

    @property
    def support(self) -> Area | None:
        """The part of the area in which alone the estimator expects the source; None: there is none."""
        if self.prior is None or isinstance(self.prior, Area):
            return self.prior
        parts = [part for part in self.prior if isinstance(part, PriorPart)]
        return PriorParts.of(*(parts or [PriorPart(corners=self.prior)]))  # type: ignore[arg-type]  # either all or none

    @property
    def expected(self) -> Area:
        """Where the estimator expects the source."""
        return self.support or self.area

    @property
    def spans(self) -> tuple[Array, Array]:
        """Least and greatest (8,) of the source's x and y, q, u, φ, d, and the start's x and y."""
        (source_low, source_high), (start_low, start_high) = _ends(self.sources), _ends(self.starts)
        release = np.array([span(value) for value in (self.q, self.u, self.phi, self.d)]).T
        return (
            np.concatenate([source_low, release[0], start_low]),
            np.concatenate([source_high, release[1], start_high]),
        )

    @property
    def text(self) -> str:
        """The text that `plume.problems.names` reads back: `paper`, or what differs from it, as JSON."""
        told = msgspec.convert(msgspec.to_builtins(self), Problem)  # whole numbers become floats
        changed = {
            name: value
            for name, usual in zip(self.__struct_fields__, msgspec.structs.astuple(PAPER), strict=True)
            if (value := getattr(told, name)) != usual
        }
        return msgspec.json.encode(changed).decode() if changed else "paper"

    @property
    def told(self) -> "Problem":
        """What services may know of it: not where the source is drawn, nor how the truth differs."""
        told = in_area(self.area, self.prior)
        if self.ground == self.area:
            return told
        return told.changed(
            start=self.start,
            source=None if self.prior else self.area,
            keep_out=self.keep_out,
            keep_in=self.keep_in,
            clearance_m=self.clearance_m,
            source_inside=self.source_inside,
        )

    @property
    def site(self) -> "Problem":
        """It without what tables have columns of their own for: step, sensor, world, budget, stop."""
        usual = PAPER
        return self.changed(
            step_m=min(usual.step_m, self.longest_step_m),
            sensor=usual.sensor,
            dwell_s=None,
            world=usual.world,
            budget=usual.budget,
            stop=usual.stop,
        )

    def allowed(self, seed: int, source: Place, start: Place) -> tuple[Place, Place]:
        """Return a source and a start that a seed has drawn, drawn anew while they are not allowed.

        A source has to be where one may be, `may_leak`, a start where a vehicle may be
        that comes straight from home.
        """
        sources, obstacles = self.sources, self.ground.obstacles
        rng = keyed(seed, "source again")
        if isinstance(sources, PriorParts):
            source = sources.drawn(rng, source)
        for _ in range(MOST_DRAWS):
            if self.may_leak(source):
                break
            source = sources.drawn(rng) if isinstance(sources, PriorParts) else _uniform(rng, sources)
        rng = keyed(seed, "start again")
        for _ in range(MOST_DRAWS):
            if obstacles is None or obstacles.may_begin(np.array(start, np.float32).astype(np.float64)):
                break
            start = _uniform(rng, self.starts)
        return source, start

    def may_leak(self, place: Place) -> bool:
        """Whether a source may be at a place: not inside a polygon to keep out of, unless `source_inside`."""
        obstacles = self.ground.obstacles
        return self.source_inside or obstacles is None or not obstacles.enclose(np.array(place))

    def changed(self, **changes: Any) -> "Problem":
        """Return it with other fields. Raises ValueError as a new one does."""
        return msgspec.structs.replace(self, **changes)


# The fields alone, of the right kinds; what their numbers may be is said by the checks of `Problem`.
_Fields = msgspec.defstruct("_Fields", [*get_type_hints(Problem).items()])


def _typed(problem: Problem) -> msgspec.Struct:
    """Return the fields of a problem, with lists as tuples. Raises ValueError if one is of a wrong kind."""
    fields = msgspec.structs.asdict(problem)
    with suppress(msgspec.ValidationError, OverflowError):
        return msgspec.convert(fields, _Fields)
    try:
        return msgspec.convert({name: _plain(value) for name, value in fields.items()}, _Fields)
    except (msgspec.ValidationError, OverflowError) as error:
        where, said = explained(error, fields, Problem)
        raise ValueError(f"{dotted(where)}: {said}") from None


def _plain(value: Any, depth: int = 4) -> Any:
    """Return NumPy's numbers and arrays as Python's, in lists too."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return [_plain(part, depth - 1) for part in value] if depth and isinstance(value, list | tuple) else value


def in_area(area: Area, prior: Area | tuple[Place | PriorPart, ...] | None = None) -> Problem:
    """Return the paper's problem in another area, with a step that fits. Raises ValueError."""
    return Problem(area=area, prior=prior, step_m=min(STEP_M, min(area.size_m) / PARTS))


@lru_cache(64)
def _check_ways(ground: Fenced, starts: Area | Place, expected: Area, sources: Area | Place) -> None:
    """Raise ValueError if a polygon is none, or polygons leave no start, no source or no way between them."""
    if len(ground.keep_out) > MOST_POLYGONS:
        raise ValueError(
            f"keep_out: {len(ground.keep_out)} polygons are not allowed; wanted up to {MOST_POLYGONS}"
        )
    polygons = {f"keep_out[{number}]": polygon for number, polygon in enumerate(ground.keep_out)}
    _check_polygons(polygons | ({"keep_in": ground.keep_in} if ground.keep_in else {}))
    obstacles, begins = ground.obstacles, _grid(starts, 6)
    begins = begins[obstacles.may_begin(begins)]
    if not len(begins):
        raise ValueError(
            f"start: {_said(starts)} is in keep_out, out of keep_in, within {ground.clearance_m:g} m of a "
            "side of them, or behind keep_out as seen from home, (0, 0); wanted a place or a rectangle that "
            "is free, at least in part"
        )
    for name, place in (("prior", expected), ("source", sources)):
        if not ground.source_inside and obstacles.enclose(_grid(place, 64)).all():
            raise ValueError(
                f"{name}: {_said(place)} is inside keep_out, where no source is; wanted a place or a "
                "rectangle outside, at least in part, or source_inside: true"
            )
    goals = _grid(expected, 12)
    goals = goals[obstacles.are_clear(goals)]
    if len(goals) and not obstacles.join(begins, goals).all():
        raise ValueError(
            f"keep_out: it leaves no way from all of the start, {_said(starts)}, to where the source is "
            f"expected, {_said(expected)}; wanted gaps wider than twice clearance_m, {ground.clearance_m:g} m"
        )


def _check_prior(prior: Sequence[Place | PriorPart]) -> None:
    """Raise ValueError if a prior is neither a polygon nor parts."""
    parts = [part for part in prior if isinstance(part, PriorPart)]
    if not parts:
        corners: Corners = tuple(prior)  # type: ignore[arg-type]
        _check_polygons({"prior": corners})
        _check_thickness({"prior": corners})
        return
    if len(parts) < len(prior):
        raise ValueError(
            "prior: wanted either the corners of one polygon or parts, each with corners or a place"
        )
    polygons = {f"prior[{number}]": part.polygon for number, part in enumerate(parts)}
    _check_polygons(polygons)
    _check_thickness(polygons)
    if len({part.weight is None for part in parts}) > 1:
        raise ValueError("prior: wanted a weight for each part, or for none")


def _check_polygons(polygons: Mapping[str, Corners]) -> None:
    """Raise ValueError, which names the field, if a polygon is none or there are too many corners."""
    if sum(map(len, polygons.values())) > MOST_CORNERS:
        count, name = sum(map(len, polygons.values())), next(iter(polygons)).partition("[")[0]
        raise ValueError(
            f"{name}: {count} corners are not allowed; wanted up to {MOST_CORNERS} in all"
            + ", those of keep_in included" * (name == "keep_out")
        )
    for name, polygon in polygons.items():
        for corner in polygon:
            if len(corner) != 2 or not all(-FARTHEST_M <= part <= FARTHEST_M for part in corner):
                raise ValueError(
                    f"{name}: the corner {_listed(corner)} is not allowed; wanted (x, y), each from "
                    f"{-FARTHEST_M:g} to {FARTHEST_M:g} m"
                )
        corners = outline(polygon)
        if len(corners) < 3:
            raise ValueError(f"{name}: {len(corners)} corners are not allowed; wanted at least 3")
        if crossing := crosses_itself(corners):
            sides = " and ".join(str(number + 1) for number in crossing)
            raise ValueError(f"{name}: its sides {sides} meet; wanted the corners in order around it")


def _check_thickness(polygons: Mapping[str, Corners]) -> None:
    """Raise ValueError, which names the field, if a polygon is so thin that hardly a draw would be in it."""
    for name, polygon in polygons.items():
        width_m, height_m = PriorParts.of(PriorPart(corners=polygon)).size_m
        if not area_of(polygon) >= THINNEST * width_m * height_m:
            raise ValueError(
                f"{name}: the polygon is too thin; wanted one that fills at least {THINNEST:g} of the "
                "rectangle around it"
            )


def _grid(place: Area | Place, count: int) -> Array:
    """Return the middles of count x count cells of a rectangle, or the place itself: (N, 2).

    Of a polygon they are those in it, and its corners.
    """
    if not isinstance(place, Area):
        return np.array([place])
    shares = (np.arange(count) + 0.5) / count
    (x, y), (width_m, height_m) = place.low, place.size_m
    cells = np.array([(x + east * width_m, y + north * height_m) for east in shares for north in shares])
    return (
        np.concatenate([cells[place.held(cells)], *place.polygons])
        if isinstance(place, PriorParts)
        else cells
    )


def _uniform(rng: np.random.Generator, place: Area | Place) -> Place:
    low, high = _ends(place)
    x, y = uniform(rng, np.array(low), np.array(high)).tolist()
    return x, y


def span(value: Span) -> tuple[float, float]:
    """Return the least and the greatest value."""
    return value if isinstance(value, tuple) else (value, value)


def _ends(place: Area | Place) -> tuple[Place, Place]:
    return (place.low, place.high) if isinstance(place, Area) else (place, place)


def _said(place: Area | Place) -> str:
    return place.text if isinstance(place, Area) else _listed(place)


def _listed(value: float | Sequence[float]) -> str:
    return f"{value:g}" if isinstance(value, int | float) else f"[{', '.join(f'{part:g}' for part in value)}]"


def _rounded(value: float, bound: float, inwards: int) -> float:
    """Return the float32 nearest to a value that is not beyond `bound`; inwards: 1 is greater, -1 less."""
    near = np.float32(value)
    beyond = float(near) < bound if inwards > 0 else float(near) > bound
    return float(np.nextafter(near, np.float32(inwards * np.inf)) if beyond else near)


PAPER = Problem()
