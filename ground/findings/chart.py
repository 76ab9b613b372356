"""The maps of the findings, drawn as SVG: north is up, metres from home."""

import math
from collections.abc import Callable, Iterable, Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from ground.findings.background import Background
from ground.findings.figures import Findings
from ground.findings.flight import FlownReading
from ground.findings.numbers import significant
from ground.findings.region import places_of
from link.terminal import printable

WIDTH = 720.0  # of the drawing, in its own units
LEFT, BELOW, ABOVE, RIGHT = 46.0, 34.0, 12.0, 96.0  # around the map
FLATTEST, TALLEST = 0.46, 1.6  # a map's height by its width: the legend fits beside it, and it on a page
NAME = 36.0, 12.0  # width and height of a vehicle's name
FURTHEST = 3.0  # what lies further beyond the area, in sides of it, is cut off
MOST_POINTS = 4000  # of a track; of a longer one every n-th
MOST_DOTS = 1000  # particles that are drawn
INK, FAINT, RULE = "#1a2129", "#56616d", "#d5dbe1"
REGION, ESTIMATE = "#0072b2", "#d55e00"
# Of the tracks of the vehicles, by number.
TRACKS = ("#3b4652", "#009e73", "#a8447f", "#8a6d00", "#0072b2", "#882255", "#4d9de0", "#7a4b2a")
WALL = "#c4c9cf"
GAS = ("#fff3d6", "#fac06c", "#ee8f33", "#b9500f", "#5e2404")  # of readings, from least to greatest
RATES = ("#f1f7fb", "#bcdcee", "#6fb1d6", "#2b7cb3", "#0b3c66")
NEVER = "#8b8f94"  # a place where no rate would have been seen


class View(NamedTuple):
    """The part of the plane that a map shows, m."""

    west: float
    south: float
    east: float
    north: float

    @property
    def scale(self) -> float:
        """Units of the drawing a metre."""
        return (WIDTH - LEFT - RIGHT) / (self.east - self.west)

    @property
    def height(self) -> float:
        """Height of the whole drawing."""
        return ABOVE + (self.north - self.south) * self.scale + BELOW

    def x(self, east: float) -> float:
        """Return where a place is in the drawing."""
        return LEFT + (east - self.west) * self.scale

    def y(self, north: float) -> float:
        """Return where a place is in the drawing."""
        return ABOVE + (self.north - north) * self.scale

    def path(self, places: Iterable[Sequence[float]]) -> str:
        """Return places as the points of a path."""
        return " L".join(f"{self.x(x):.1f} {self.y(y):.1f}" for x, y in places)


def whole_map(it: Findings, background: Background | None = None) -> str:
    """Return the map of the flight: area, track, readings, estimate and its region."""
    view = _view(it)
    gas = np.array([sample.gas for sample in it.flight.samples])
    parts = [
        *_ground(view, background),
        *_area(view, it),
        *_tracks(view, it),
        *_readings(view, it),
        *_region(view, it),
        *_names(view, it),
    ]
    legend = _legend(GAS, float(gas.min()), float(gas.max()), f"gas, {it.unit}", _root)
    return _drawing(view, "Map of the flight", parts, [*legend, *_compass(it)])


def near_map(it: Findings) -> str:
    """Return the map of the estimate: particles, ellipse and contour."""
    x, y = it.last.mean
    half = max(2.2 * it.ellipse.longer_m, 0.2)
    if it.contour:
        places = np.concatenate(it.contour.rings)
        half = max(half, 1.15 * float(np.abs(places - np.array([x, y])).max()))
    view = View(x - half, y - half, x + half, y + half)
    parts = [*_ground(view, None), *_area(view, it), *_particles(view, it), *_region(view, it)]
    return _drawing(view, "Map of the estimate and its 95% region", parts, _compass(it))


def rates_map(it: Findings) -> str:
    """Return the map of the smallest rates that would have been seen; empty if there are none."""
    if it.smallest is None:
        return ""
    view = _framed(it.area.low, it.area.high)
    seen = it.smallest.seen
    low, high = (float(seen.min()), float(seen.max())) if len(seen) else (1.0, 10.0)
    width, height = (length * view.scale for length in it.smallest.cell_m)
    cells = []
    for (x, y), rate in it.smallest.cells():
        colour = _colour(RATES, _log_share(rate, low, high)) if math.isfinite(rate) else NEVER
        told = f"{significant(rate, 2)} g/s" if math.isfinite(rate) else "at no rate"
        cells.append(
            f'<rect x="{view.x(x) - width / 2:.1f}" y="{view.y(y) - height / 2:.1f}" '
            f'width="{width + 0.3:.1f}" height="{height + 0.3:.1f}" fill="{colour}">'
            f"<title>{told}</title></rect>"
        )
    parts = [*cells, *_grid(view), *_area(view, it), *_tracks(view, it), *_names(view, it)]
    legend = _legend(RATES, low, high, "rate, g/s", _log_share)
    return _drawing(view, "Map of the smallest rates", parts, [*legend, *_compass(it)])


def _view(it: Findings) -> View:
    """Return a view of the area, and of what was flown and found about it."""
    low, high = np.array(it.area.low), np.array(it.area.high)
    places = [
        np.stack([low, high]),
        np.array([sample.place for sample in it.flight.samples]),
        *it.flight.tracks.values(),
        it.ellipse.outline,
        *(it.contour.rings if it.contour else []),
    ]
    reach = FURTHEST * max(it.area.size_m)
    every = np.concatenate(places)
    every = np.clip(every[np.isfinite(every).all(axis=1)], low - reach, high + reach)
    return _framed(every.min(axis=0).tolist(), every.max(axis=0).tolist())


def _framed(low: Sequence[float], high: Sequence[float]) -> View:
    """Return a view of a rectangle and what is around it."""
    (west, south), (east, north) = low, high
    pad = 0.04 * max(east - west, north - south)
    width, height = east - west + 2 * pad, north - south + 2 * pad
    beside = pad + max(height / TALLEST - width, 0.0) / 2
    below = pad + max(width * FLATTEST - height, 0.0) / 2
    return View(west - beside, south - below, east + beside, north + below)


# ---- parts ----


def _drawing(view: View, title: str, inside: Iterable[str], outside: Iterable[str]) -> str:
    name = title.lower().replace(" ", "-").replace("%", "")
    width, height = WIDTH - LEFT - RIGHT, view.height - ABOVE - BELOW
    box = f'x="{LEFT}" y="{ABOVE}" width="{width:.1f}" height="{height:.1f}"'
    return (
        f'<svg viewBox="0 0 {WIDTH:.0f} {view.height:.0f}" role="img" aria-label="{escape(title)}" '
        f'xmlns="http://www.w3.org/2000/svg" font-family="system-ui, sans-serif" font-size="11">\n'
        f'<defs><clipPath id="{name}"><rect {box}/></clipPath></defs>\n'
        f'<rect {box} fill="#fff"/>\n'
        f'<g clip-path="url(#{name})">\n{_joined(inside)}\n</g>\n<rect {box} fill="none" stroke="{RULE}"/>\n'
        f"{_joined(outside)}\n{_joined(_axes(view))}\n{_scale_bar(view)}\n</svg>"
    )


def _joined(parts: Iterable[str]) -> str:
    return "\n".join(filter(None, parts))


def _nice(length: float) -> float:
    """Return the greatest of 1, 2 and 5 times a power of ten that is not above a length."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length * (1 + 1e-9))


def _ticks(low: float, high: float, step: float) -> list[float]:
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [number * step for number in range(first, last + 1)]


def _step(view: View) -> float:
    return _nice((view.east - view.west) / 4)


def _ground(view: View, background: Background | None) -> list[str]:
    if background is None:
        return _grid(view)
    a, b, c, d, e, f = background.to_plane  # x = a·column + b·row + c, y = d·column + e·row + f
    s = view.scale
    matrix = (s * a, -s * d, s * b, -s * e, view.x(c), view.y(f))
    told = " ".join(f"{value:.9g}" for value in matrix)
    return [
        f'<image width="{background.width}" height="{background.height}" preserveAspectRatio="none" '
        f'transform="matrix({told})" href="{background.uri}"/>'
    ]


def _grid(view: View) -> list[str]:
    step = _step(view)
    lines = [
        f"M{view.x(x):.1f} {ABOVE} V{view.height - BELOW:.1f}" for x in _ticks(view.west, view.east, step)
    ]
    lines += [f"M{LEFT} {view.y(y):.1f} H{WIDTH - RIGHT}" for y in _ticks(view.south, view.north, step)]
    return [f'<path d="{" ".join(lines)}" stroke="#e7ebef" fill="none"/>']


def _axes(view: View) -> list[str]:
    step, bottom = _step(view), view.height - BELOW
    texts = [_text(view.x(x), bottom + 14, f"{x:.10g}", "middle") for x in _ticks(view.west, view.east, step)]
    texts += [
        _text(LEFT - 5, view.y(y) + 4, f"{y:.10g}", "end") for y in _ticks(view.south, view.north, step)
    ]
    texts.append(_text((LEFT + WIDTH - RIGHT) / 2, bottom + 29, "m east of home", "middle"))
    middle = (ABOVE + bottom) / 2
    texts.append(
        f'<text transform="translate(12 {middle:.1f}) rotate(-90)" text-anchor="middle" fill="{FAINT}">'
        "m north of home</text>"
    )
    return texts


def _text(
    x: float, y: float, text: str, anchor: str = "start", colour: str = FAINT, *, on_map: bool = False
) -> str:
    """Return a text; on_map: with an edge of white, so that it can be read on anything."""
    words, edge = escape(printable(text)), ' stroke="#fff" stroke-width="3" paint-order="stroke"' * on_map
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}"{edge}>{words}</text>'


def _scale_bar(view: View) -> str:
    length = _nice((view.east - view.west) / 5)
    x, y = WIDTH - RIGHT - 12 - length * view.scale, view.height - BELOW - 12
    return (
        f'<rect x="{x - 6:.1f}" y="{y - 20:.1f}" width="{length * view.scale + 12:.1f}" height="26" '
        'fill="#fff" fill-opacity="0.5"/>'
        f'<path d="M{x:.1f} {y - 5:.1f} V{y:.1f} H{x + length * view.scale:.1f} V{y - 5:.1f}" fill="none" '
        f'stroke="{INK}" stroke-width="1.5"/>'
        + _text(x + length * view.scale / 2, y - 7, f"{length:.10g} m", "middle", INK)
    )


def _compass(it: Findings) -> list[str]:
    """Return the north arrow, and an arrow with the mean wind."""
    x, y = WIDTH - RIGHT / 2, ABOVE + 8
    deg = it.wind.from_deg + 180.0  # where it goes
    return [
        f'<path d="M{x:.1f} {y:.1f} l8 24 l-8 -6 l-8 6 Z" fill="{INK}"/>'
        f"{_text(x, y + 38, 'N', 'middle', INK)}",
        f'<g transform="translate({x:.1f} {y + 74:.1f}) rotate({deg:.1f})"><path d="M0 18 V-14 M-5 -7 L0 -16 '
        f'L5 -7" fill="none" stroke="{REGION}" stroke-width="2"/></g>',
        _text(x, y + 108, f"wind {it.wind.speed_mps:.1f} m/s", "middle", REGION),
    ]


def _area(view: View, it: Findings) -> list[str]:
    """Return the area's edge, what is to be kept out of, and what no way might leave."""
    width, height = (length * view.scale for length in it.area.size_m)
    left, top = view.x(it.area.low[0]), view.y(it.area.high[1])
    parts = [
        f'<path d="M{view.path(wall)} Z" fill="{WALL}" fill-opacity="0.8" stroke="{INK}" stroke-width="0.8">'
        "<title>building, or kept out of</title></path>"
        for wall in it.flight.walls
    ]
    if it.flight.fence:
        parts.append(
            f'<path d="M{view.path(it.flight.fence)} Z" fill="none" stroke="{INK}" '
            'stroke-dasharray="9 3 2 3"><title>no way might leave it</title></path>'
        )
    return [
        *parts,
        f'<rect x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" height="{height:.1f}" '
        f'fill="none" stroke="{FAINT}" stroke-dasharray="6 4"/>',
    ]


def _tracks(view: View, it: Findings) -> list[str]:
    return [
        f'<path d="M{view.path(track[:: -(-len(track) // MOST_POINTS)].tolist())}" fill="none" '
        f'stroke="{_track_colour(number)}" stroke-width="1.2" stroke-opacity="0.7"/>'
        for number, track in it.flight.tracks.items()
        if len(track) >= 2
    ]


def _names(view: View, it: Findings) -> list[str]:
    """Return the names of several vehicles, each at its first reading."""
    if len(it.flight.tracks) == 1:
        return []
    first = {sample.vehicle: sample.place for sample in reversed(it.flight.samples)}
    width, height = NAME
    names: list[str] = []
    taken: list[tuple[float, float]] = []
    for number in sorted(first.keys() & it.flight.tracks.keys()):
        x, y = view.x(first[number][0]) + 7, view.y(first[number][1]) - 7
        x = min(x, WIDTH - RIGHT - width)
        on = -height if y > view.height / 2 else height  # away from the names that are there, into the map
        while any(abs(x - left) < width and abs(y - base) < height for left, base in taken):
            y += on
        taken.append((x, y))
        names.append(_text(x, y, f"uav/{number}", colour=_track_colour(number), on_map=True))
    return names


def _track_colour(number: int) -> str:
    return TRACKS[(number - 1) % len(TRACKS)]


def _readings(view: View, it: Findings) -> list[str]:
    samples = it.flight.samples[:: -(-len(it.flight.samples) // MOST_POINTS)]
    gas = [sample.gas for sample in samples]
    low, high = min(gas), max(gas)
    return [
        f'<circle cx="{view.x(sample.place[0]):.1f}" cy="{view.y(sample.place[1]):.1f}" r="4" stroke="{INK}" '
        f'stroke-width="0.6" fill="{_colour(GAS, _root(sample.gas, low, high))}">'
        f"<title>{_whose(sample, it)}reading {sample.step}: {sample.gas:.4g} {escape(it.unit)}</title>"
        "</circle>"
        for sample in samples
    ]


def _whose(sample: FlownReading, it: Findings) -> str:
    return f"uav/{sample.vehicle}, " if len(it.flight.tracks) > 1 else ""


def _particles(view: View, it: Findings) -> list[str]:
    if it.flight.particles is None:
        return []
    places, weights = places_of(it.flight.particles, it.last.unknowns, it.last.mean)
    every = -(-len(places) // MOST_DOTS)
    mean = float(weights[::every].mean()) or 1.0
    return [
        f'<circle cx="{view.x(x):.1f}" cy="{view.y(y):.1f}" r="{min(1.6 * math.sqrt(w / mean), 5):.2f}" '
        f'fill="{REGION}" fill-opacity="0.28"/>'
        for (x, y), w in zip(places[::every].tolist(), weights[::every].tolist(), strict=True)
        if w > 0 and view.west <= x <= view.east and view.south <= y <= view.north
    ]


def _region(view: View, it: Findings) -> list[str]:
    x, y = view.x(it.last.mean[0]), view.y(it.last.mean[1])
    parts = [
        f'<path d="M{view.path(it.ellipse.outline.tolist())} Z" fill="none" stroke="{REGION}" '
        'stroke-width="1.6" stroke-dasharray="5 3"><title>95% ellipse</title></path>'
    ]
    if it.contour:
        rings = " ".join(f"M{view.path(ring.tolist())} Z" for ring in it.contour.rings)
        parts.append(
            f'<path d="{rings}" fill="{REGION}" fill-opacity="0.12" fill-rule="evenodd" stroke="{REGION}" '
            'stroke-width="1.6"><title>95% of the particles</title></path>'
        )
    parts.append(
        f'<path d="M{x - 6:.1f} {y - 6:.1f} l12 12 M{x - 6:.1f} {y + 6:.1f} l12 -12" stroke="#fff" '
        f'stroke-width="5"/><path d="M{x - 6:.1f} {y - 6:.1f} l12 12 M{x - 6:.1f} {y + 6:.1f} l12 -12" '
        f'stroke="{ESTIMATE}" stroke-width="2.6"><title>estimate</title></path>'
    )
    return parts


# ---- colours ----


def _root(value: float, low: float, high: float) -> float:
    """Return the share of a value's way from low to high, by its root: weak gas shows, too."""
    return math.sqrt(min(max((value - low) / (high - low), 0.0), 1.0)) if high > low else 0.0


def _log_share(value: float, low: float, high: float) -> float:
    if not high > low > 0:
        return 0.0
    return min(max(math.log(value / low) / math.log(high / low), 0.0), 1.0)


def _colour(scale: Sequence[str], share: float) -> str:
    at = min(max(share, 0.0), 1.0) * (len(scale) - 1)
    index = min(int(at), len(scale) - 2)
    ends = [[int(scale[i][k : k + 2], 16) for k in (1, 3, 5)] for i in (index, index + 1)]
    mixed = [round(a + (at - index) * (b - a)) for a, b in zip(*ends, strict=True)]
    return "#" + "".join(f"{part:02x}" for part in mixed)


def _legend(
    scale: Sequence[str],
    low: float,
    high: float,
    title: str,
    share: Callable[[float, float, float], float],
) -> list[str]:
    """Return a bar of colours with its values, to the right of the map."""
    x, top, length, steps = WIDTH - RIGHT + 12, ABOVE + 160.0, 130.0, 40
    bar = [
        f'<rect x="{x}" y="{top + length * (1 - (number + 1) / steps):.1f}" width="14" '
        f'height="{length / steps + 0.4:.1f}" fill="{_colour(scale, (number + 0.5) / steps)}"/>'
        for number in range(steps)
    ]
    values = [low, high]
    if high > low:
        inner = [low + at * (high - low) for at in (0.0625, 0.25, 0.5625)]
        if share is _log_share and low > 0:
            inner = [low * (high / low) ** at for at in (0.25, 0.5, 0.75)]
        values += inner
    texts = [
        _text(x + 18, top + length * (1 - share(value, low, high)) + 4, significant(value, 2))
        for value in dict.fromkeys(values)
    ]
    return [*bar, *texts, _text(x - 6, top - 10, title)]
