"""Priors of the unknown parameters of a release."""

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass, fields

import numpy as np

from plume.elementary import Array, Indices, exp, log
from plume.parameters import (
    AROUND,
    BEYOND,
    GAMMA,
    GREATEST_CV,
    KNOWN,
    LOGNORMAL,
    MEASURED,
    MOST,
    NORMAL,
    PARAMETERS,
    UNIFORM,
    X,
    Y,
)
from plume.polygons.parts import area_of, counts
from plume.polygons.polygons import enclosed
from plume.problem import Area, PriorParts
from plume.randomness import standard_gamma, standard_normal

SMALLEST = 1e-6  # lower bound of a positive parameter under every prior, so that it stays above 0
MOST_DRAWS = 10_000  # most draws of a value until one is within its support
POSITIVE = ("q", "d", "tau", "wind-speed", "gain", "noise", "puff-rate", "puff-share")
MOST_OF = {"cv": GREATEST_CV, "puff-share": 1.0}  # of parameters whose greatest value is not MOST
NO_WALLS: Array = np.empty((0, 4))
NOT_NEGATIVE = ("q", "u", "d", "tau", "wind-speed", "gain", "noise", "cv", "puff-rate", "puff-share")


@dataclass(frozen=True)
class Uniform:
    """Equally likely from low to high."""

    low: float
    high: float


@dataclass(frozen=True)
class Normal:
    """Normal with a mean and a standard deviation, truncated to the values that the parameter can have."""

    mean: float
    std: float


@dataclass(frozen=True)
class Gamma:
    """Gamma with a shape and a scale; its mean is shape · scale."""

    shape: float
    scale: float


@dataclass(frozen=True)
class LogNormal:
    """Log-normal with a median; the logarithm's standard deviation is sigma.

    Two thirds lie within a factor of exp(sigma).
    """

    median: float
    sigma: float


@dataclass(frozen=True)
class Fixed:
    """Known value."""

    value: float


Prior = Uniform | Normal | Gamma | LogNormal | Fixed
KINDS: dict[str, type[Uniform] | type[Normal] | type[Gamma] | type[LogNormal] | type[Fixed]] = {
    "uniform": Uniform,
    "normal": Normal,
    "gamma": Gamma,
    "lognormal": LogNormal,
    "fixed": Fixed,
}
FAMILIES: dict[type, float] = {Uniform: UNIFORM, Normal: NORMAL, Gamma: GAMMA}


def parse(text: str) -> tuple[str, Prior]:
    """Read a prior such as `q=gamma:2,150`; raises ValueError with the allowed form."""
    name, equals, rest = text.partition("=")
    kind, _, numbers = rest.partition(":")
    if not equals or name not in PARAMETERS or kind not in KINDS:
        raise ValueError(
            f"{text!r} is not allowed; wanted NAME=KIND:NUMBERS with NAME of {', '.join(PARAMETERS)} and "
            "KIND of uniform:LOW,HIGH normal:MEAN,STD gamma:SHAPE,SCALE lognormal:MEDIAN,SIGMA fixed:VALUE"
        )
    wanted = ",".join(field.name.upper() for field in fields(KINDS[kind]))
    try:
        values = [float(number) for number in numbers.split(",")]
        prior = KINDS[kind](*values)
    except (TypeError, ValueError):
        raise ValueError(f"{text!r} is not allowed; wanted {name}={kind}:{wanted}") from None
    match prior:
        case Uniform(low, high):
            sound, rule = low < high, "LOW below HIGH"
            if name in MOST_OF:
                most = MOST_OF[name]
                sound, rule = 0 <= low < high <= most, f"0 ≤ LOW < HIGH ≤ {most:g} for {name}"
        case Normal(_, std):
            sound, rule = std > 0, "STD above 0"
        case Gamma() | LogNormal():
            sound = min(values) > 0 and name in NOT_NEGATIVE
            rule = f"{wanted.replace(',', ' and ')} above 0, and NAME of {', '.join(NOT_NEGATIVE)}"
        case Fixed(value):
            sound = value >= SMALLEST or name not in POSITIVE
            rule = f"VALUE from {SMALLEST:g} for {', '.join(POSITIVE)}"
            if name in MOST_OF:
                least = SMALLEST if name in POSITIVE else 0
                sound = least <= value <= MOST_OF[name]
                rule = f"VALUE from {least:g} to {MOST_OF[name]:g} for {name}"
    if not (sound and all(abs(value) <= MOST for value in values)):
        raise ValueError(f"{text!r} is not allowed; wanted {rule}, and numbers up to {MOST:g}")
    return name, prior


def support(name: str, prior: Prior, area: Area, margin_m: float) -> tuple[float, float]:
    """Return the ends of a parameter's range under its prior. Raises ValueError if there is no range."""
    low = SMALLEST if name in POSITIVE else 0.0 if name in ("u", "cv") else -MOST
    high = MOST_OF.get(name, MOST)
    if name in ("x", "y"):
        axis = "xy".index(name)
        low, high = area.low[axis] - margin_m, area.high[axis] + margin_m
    match prior:
        case Uniform(a, b):
            low, high = max(low, a), min(high, b)
        case Normal(mean, std):
            low, high = max(low, mean - 8 * std), min(high, mean + 8 * std)
        case Gamma():
            low = max(low, SMALLEST)
        case LogNormal(median, sigma):
            low, high = max(low, median / float(exp(8 * sigma))), min(high, median * float(exp(8 * sigma)))
    if not low < high:
        raise ValueError(f"the prior of {name} excludes every possible value")
    return low, high


def table(
    priors: Mapping[str, Prior],
    known: Mapping[str, float],
    area: Area,
    margin_m: float = 0.0,
    expected: Area | None = None,
) -> Array:
    """Return the priors as the kernels take them, (15, 5): kind, two numbers, ends of the support.

    The numbers of LOGNORMAL are log median and sigma. A parameter in neither `priors` nor `known` (u, φ) is
    measured. Without a prior, x and y are uniform over the area, and BEYOND times as dense up to margin_m
    beyond its edges; where the source is `expected` in a part of the area, uniform over that.
    """
    rows = np.zeros((len(PARAMETERS), 5))
    inner, off_m = (expected, 0.0) if expected else (area, margin_m)
    kind, ends = AROUND if off_m else UNIFORM, zip(inner.low, inner.high, strict=True)
    anywhere = [(kind, low, high, low - off_m, high + off_m) for low, high in ends]
    for index, name in enumerate(PARAMETERS):
        match priors.get(name, Fixed(known[name]) if name in known else None):
            case None:
                rows[index] = anywhere[index] if index in (X, Y) else (MEASURED, 0, 0, 0, 0)
            case Fixed(value):
                rows[index] = KNOWN, value, 0, value, value
            case LogNormal(median, sigma) as prior:
                rows[index] = LOGNORMAL, float(log(median)), sigma, *support(name, prior, area, margin_m)
            case prior:
                rows[index] = FAMILIES[type(prior)], *astuple(prior), *support(name, prior, area, margin_m)
    return rows


def draw(
    rows: Array,
    unknowns: Indices,
    count: int,
    rng: np.random.Generator,
    walls: Array = NO_WALLS,
    parts: PriorParts | None = None,
) -> Array:
    """Draw particles (D, count) from the priors, those of the place from `parts` if there are any.

    All are outside polygons with these sides, (W, 4).
    Raises ValueError if a prior hardly ever gives a value that its parameter can have.
    """
    if not (len(walls) or parts):
        return _drawn(rows, unknowns, count, rng)
    free: list[Array] = []
    for _ in range(MOST_DRAWS):
        # Draws that are kept are the first ones of a lattice, which are as even as all of it.
        for drawn in (
            _drawn_of_parts(rows, unknowns, count, rng, parts)
            if parts
            else [_drawn(rows, unknowns, count, rng)]
        ):
            outside = ~enclosed(_places(rows, unknowns, drawn), walls.reshape(-1, 2, 2))
            free.append(drawn[:, outside])
        if (found := sum(each.shape[1] for each in free)) >= count:
            # Those of parts stand one after the other: each has to lose its share.
            kept = np.arange(count) * found // count if parts and len(parts.parts) > 1 else np.arange(count)
            return np.ascontiguousarray(np.concatenate(free, axis=1)[:, kept])
    raise ValueError("prior: nearly no place where the source is expected is in it, and outside keep_out")


def _drawn_of_parts(
    rows: Array, unknowns: Indices, count: int, rng: np.random.Generator, parts: PriorParts
) -> list[Array]:
    """Draw particles from the priors, places in each part by its weight: (D, at most count) together."""
    each = [PriorParts.of(part) for part in parts.parts]
    boxes = np.array([part.size_m[0] * part.size_m[1] for part in each])
    tried = parts.shares * boxes / [area_of(*part.polygons) for part in each]  # draws of its rectangle
    result = []
    for part, tries in zip(each, counts(tried / tried.sum(), count), strict=True):
        own = rows.copy()
        own[[X, Y], 1:] = [(low, high, low, high) for low, high in zip(part.low, part.high, strict=True)]
        drawn = _drawn(own, unknowns, tries, rng)
        result.append(drawn[:, part.held(_places(own, unknowns, drawn))])
    return result


def _places(rows: Array, unknowns: Indices, particles: Array) -> Array:
    """Return the places (N, 2) m of particles (D, N), of which x or y may be known."""
    row_of = {index: row for row, index in enumerate(unknowns.tolist())}
    known = np.broadcast_to(rows[[X, Y], 1, None], (2, particles.shape[1]))
    return np.stack([particles[row_of[axis]] if axis in row_of else known[axis] for axis in (X, Y)], axis=1)


def _drawn(rows: Array, unknowns: Indices, count: int, rng: np.random.Generator) -> Array:
    """Draw particles (D, count) from the priors.

    Uniform priors use a low-discrepancy lattice with a random shift (the R sequence, Roberts 2018): each
    draw is uniform, and together they leave no gaps. Raises ValueError if a prior hardly ever gives a
    value that its parameter can have.
    """
    power, ratio = len(unknowns) + 1, 1.5
    for _ in range(20):  # the positive root of x^(D+1) = x + 1 (Newton)
        slope = math.prod([ratio] * (power - 1))
        ratio -= (slope * ratio - ratio - 1) / (power * slope - 1)
    shift = rng.random(len(unknowns))
    result = np.empty((len(unknowns), count))
    for row, index in enumerate(unknowns):
        kind, a, b, low, high = rows[index]
        if kind in (UNIFORM, AROUND):
            even = (np.arange(count) / math.prod([ratio] * (row + 1)) + shift[row]) % 1.0
            result[row] = low + even * (high - low) if kind == UNIFORM else _around(even, a, b, high - b)
            continue
        missing = np.arange(count)
        for _ in range(MOST_DRAWS):  # redraw values outside the support
            drawn = (
                b * standard_gamma(rng, a, (len(missing),))
                if kind == GAMMA
                else a + b * standard_normal(rng, len(missing))
            )
            result[row, missing] = exp(drawn) if kind == LOGNORMAL else drawn
            missing = missing[(result[row, missing] < low) | (result[row, missing] > high)]
            if not len(missing):
                break
        else:
            raise ValueError(f"the prior of {PARAMETERS[index]} excludes nearly every possible value")
    return result


def _around(even: Array, low: float, high: float, margin_m: float) -> Array:
    """Return draws of the prior AROUND from even ones in [0, 1), by inversion."""
    side = high - low
    along = even * (side + 2 * BEYOND * margin_m) - BEYOND * margin_m
    beyond = along - np.clip(along, 0.0, side)
    return np.asarray(low + along + beyond * (1 / BEYOND - 1))


def text(name: str, prior: Prior) -> str:
    """Write a prior so that `parse` reads it back."""
    kind = next(kind for kind, of in KINDS.items() if type(prior) is of)
    return f"{name}={kind}:{','.join(map(repr, astuple(prior)))}"
