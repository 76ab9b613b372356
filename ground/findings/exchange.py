"""The findings for other programs: GeoJSON (RFC 7946), KML 2.2, CSV and JSON."""

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any
from xml.sax.saxutils import escape

from ground.findings.figures import KG_H, Findings, as_json
from ground.findings.numbers import utc
from ground.findings.words import place_name, place_text, rate_name, rate_text
from link.terminal import printable
from scene.scene import Point

Position = list[float]  # longitude, latitude: GeoJSON's and KML's order
Path = list[Sequence[float]]  # (east, north) of home, degrees; of a ring the first place is the last, too
DECIMALS = 8  # of degrees: a millimetre


# ---- GeoJSON ----


def geojson(it: Findings) -> str:
    """Return a FeatureCollection: source, regions, track, readings, area, and the smallest rates if any.

    Without a home there are no positions, and the geometries are null.
    """
    last, figures = it.last, as_json(it)
    source = {
        name: figures[name]
        for name in (
            *("verdict", "sentence", "reasons", "latitude_deg", "longitude_deg", "covariance_m2", "spread_m"),
            *("rate_gs", "rate_interval_gs", "rate_kgh", "rate_interval_kgh", "height_m"),
            *("assume", "began_utc", "ended_utc", "units"),
        )
    }
    source["record_sha256"] = it.flight.sha256
    features = [
        _feature("source", _point(it, last.mean), source),
        _feature("region_95_ellipse", _polygons(it, [it.ellipse.outline.tolist()]), {"share": 0.95}),
    ]
    if it.contour:
        rings = [ring.tolist() for ring in it.contour.rings]
        features.append(_feature("region_95_contour", _polygons(it, rings), {"share": 0.95}))
    area = {"low_m": it.area.low, "high_m": it.area.high}
    features.append(_feature("area", _polygons(it, [_rectangle(it.area.low, it.area.high)]), area))
    features += [_feature("keep_out", _around(it, wall), {}) for wall in it.flight.walls]
    if it.flight.fence:
        features.append(_feature("keep_in", _around(it, it.flight.fence), {}))
    for number, track in it.flight.tracks.items():
        if len(track) > 1:
            of = {"points": len(track), "vehicle": number}
            features.append(_feature("track", _line(it, track.tolist()), of))
    for sample in it.flight.samples:
        told = {
            "step": sample.step,
            "time_utc": utc(sample.utc_ns),
            "gas": sample.gas,
            "unit": it.unit,
            "altitude_m": sample.altitude_m,
            "wind_east_mps": sample.wind[0],
            "wind_north_mps": sample.wind[1],
            "spread_m": sample.spread_m,
            "vehicle": sample.vehicle,
        }
        features.append(_feature("reading", _point(it, sample.place), told))
    if it.smallest:
        features += _cells(it)
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False)


def _feature(kind: str, geometry: dict[str, Any] | None, properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "Feature",
        "geometry": geometry,
        "properties": {"kind": kind, **_finite(properties)},
    }


def _finite(value: Any) -> Any:
    """Return a JSON-able value with null for what JSON cannot say."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(name): _finite(inner) for name, inner in value.items()}
    return [_finite(inner) for inner in value] if isinstance(value, list | tuple) else value


def _position(it: Findings, place: Sequence[float]) -> Position | None:
    there = it.on_earth(place)
    return None if there is None else [round(there[1], DECIMALS), round(there[0], DECIMALS)]


def _point(it: Findings, place: Sequence[float]) -> dict[str, Any] | None:
    there = _position(it, place)
    return None if there is None else {"type": "Point", "coordinates": there}


def _line(it: Findings, places: Iterable[Sequence[float]]) -> dict[str, Any] | None:
    return _geometry("LineString", _ways(it, places))


def _polygons(it: Findings, rings: Iterable[Sequence[Sequence[float]]]) -> dict[str, Any] | None:
    return _geometry("Polygon", _shapes(it, rings))


def _geometry(kind: str, parts: Sequence[Any]) -> dict[str, Any] | None:
    """Return a geometry of its parts' coordinates; None if it has none."""
    if len(parts) == 1:
        return {"type": kind, "coordinates": parts[0]}
    return {"type": f"Multi{kind}", "coordinates": parts} if parts else None


def _ways(it: Findings, places: Iterable[Sequence[float]]) -> list[list[Position]]:
    """Return a way in parts that do not cross the antimeridian, each of two different places at least.

    Places that are not on earth are left out.
    """
    path = _path(it, filter(it.on_earth, places))
    parts = [
        _positions(it, part, turn)
        for is_west, edge, turn in _sides(it)
        for part in _parts(path, edge, is_west)
    ]
    return [part for part in parts if any(place != part[0] for place in part)]


def _shapes(it: Findings, rings: Iterable[Sequence[Sequence[float]]]) -> list[list[list[Position]]]:
    """Return polygons that do not cross the antimeridian, each an outer ring and the holes within it.

    rings: (x, y) m; outer ones run counter-clockwise. There are no polygons without a home, if the rings lie
    nowhere on earth, or around a pole, which has no outline in degrees.
    """
    paths = [_path(it, ring) for ring in rings]
    return [
        [_positions(it, ring, turn) for ring in polygon]
        for is_west, edge, turn in _sides(it)
        for polygon in grouped(_half(paths, edge, is_west))
        if all(paths)
    ]


def _path(it: Findings, places: Iterable[Sequence[float]]) -> Path:
    """Return places in degrees east and north of home; none if one is nowhere, or if a pole is in the way."""
    found: Path = []
    for place in places:
        there = it.on_earth(place)
        if there is None or it.flight.home is None:
            return []
        found.append((math.remainder(there[1] - it.flight.home[1], 360.0), there[0] - it.flight.home[0]))
    return [] if any(abs(a[0] - b[0]) >= 180.0 for a, b in pairwise(found)) else found


def _sides(it: Findings) -> list[tuple[bool, float, float]]:
    """Return both sides of the antimeridian (RFC 7946, 3.1.9): whether it is west of it, where that is in
    degrees east of home, and what is added to its longitudes.
    """
    if it.flight.home is None:
        return []
    edge = math.copysign(180.0, it.flight.home[1])
    return [
        (is_west, edge - it.flight.home[1], 360.0 * (is_west - (edge > 0.0))) for is_west in (True, False)
    ]


def _positions(it: Findings, path: Iterable[Sequence[float]], turn: float) -> list[Position]:
    assert it.flight.home
    lat, lon = it.flight.home
    return [[round(lon + turn + east, DECIMALS), round(lat + north, DECIMALS)] for east, north in path]


def _parts(path: Path, edge: float, is_west: bool) -> list[Path]:
    """Return the parts of a path on one side of a meridian, in order; the first and the last may be empty."""
    parts: list[Path] = [[]]
    for a, b in pairwise([*path, *path[-1:]]):
        is_here, is_next = ((place[0] <= edge) == is_west for place in (a, b))
        if is_here:
            parts[-1].append(a)
        if is_here != is_next:
            parts[-1].append((edge, a[1] + (edge - a[0]) / (b[0] - a[0]) * (b[1] - a[1])))
            if is_here:
                parts.append([])
    return parts


def _half(rings: Iterable[Path], edge: float, is_west: bool) -> list[Path]:
    """Return the rings around what lies within rings and on one side of a meridian."""
    closed: list[Path] = []
    ways: list[Path] = []  # from the meridian to the meridian
    for ring in rings:
        first, *others = _parts(ring, edge, is_west)
        if others:
            ways += [others[-1][:-1] + first, *others[:-1]]
        elif first:
            closed.append(first)
    # Along the meridian the inside is between the end of a way and the beginning of one.
    ends, starts = (sorted(ways, key=lambda way: way[at][1]) for at in (-1, 0))
    following = {id(end): start for end, start in zip(ends, starts, strict=True)}
    for way in ways:
        ring = []
        while on := following.pop(id(way), None):
            ring, way = ring + on, on
        if ring:
            closed.append([*ring, ring[0]])
    return closed


def _around(it: Findings, outline: Sequence[Point]) -> dict[str, Any] | None:
    """Return a polygon from its corners in either order."""
    return _polygons(it, [_ring(outline)])


def _ring(outline: Sequence[Point]) -> list[Point]:
    """Return corners as a closed ring, counter-clockwise."""
    ring = [*outline, outline[0]]
    return ring if _twice_area(ring) > 0 else ring[::-1]


def grouped(rings: Sequence[Sequence[Sequence[float]]]) -> list[list[Sequence[Sequence[float]]]]:
    """Return outer rings, which run counter-clockwise, each with its holes after it."""
    outer = [[ring] for ring in rings if _twice_area(ring) > 0]
    outer.sort(key=lambda group: _twice_area(group[0]))
    for hole in (ring for ring in rings if _twice_area(ring) <= 0):
        for group in outer:  # the smallest around it
            if _is_within(hole[0], group[0]):
                group.append(hole)
                break
    return outer


def _twice_area(ring: Sequence[Sequence[float]]) -> float:
    return math.fsum(a[0] * b[1] - b[0] * a[1] for a, b in pairwise(ring))


def _is_within(place: Sequence[float], ring: Sequence[Sequence[float]]) -> bool:
    x, y = place
    crossings = 0
    for (x0, y0), (x1, y1) in pairwise(ring):
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0):
            crossings += 1
    return crossings % 2 == 1


def _cells(it: Findings) -> list[dict[str, Any]]:
    assert it.smallest
    width_m, height_m = it.smallest.cell_m
    features = []
    for (x, y), rate in it.smallest.cells():
        ring = _rectangle((x - width_m / 2, y - height_m / 2), (x + width_m / 2, y + height_m / 2))
        features.append(_feature("smallest_rate", _polygons(it, [ring]), {"rate_gs": rate}))
    return features


def _rectangle(low: Point, high: Point) -> list[Point]:
    """Return the ring around it, from its south-west corner."""
    (west, south), (east, north) = low, high
    return [(west, south), (east, south), (east, north), (west, north), (west, south)]


# ---- KML ----

KML_STYLES = {
    "source": "<IconStyle><color>ff005ed5</color></IconStyle>",
    "region": "<LineStyle><color>ffb27200</color><width>2</width></LineStyle>"
    "<PolyStyle><color>33b27200</color></PolyStyle>",
    "area": "<LineStyle><color>ff7d6b5b</color><width>1</width></LineStyle>"
    "<PolyStyle><fill>0</fill></PolyStyle>",
    "wall": "<LineStyle><color>ff292119</color><width>1</width></LineStyle>"
    "<PolyStyle><color>99cfc9c4</color></PolyStyle>",
    "track": "<LineStyle><color>ff292119</color><width>2</width></LineStyle>",
    "reading": "<IconStyle><color>ff009fe6</color><scale>0.4</scale></IconStyle>"
    "<LabelStyle><scale>0</scale></LabelStyle>",
}


def kml(it: Findings) -> str:
    """Return a KML document with the source, its regions, the area, the track and the readings."""
    source = _lines(it.verdict.sentence, place_text(it), f"{rate_name(it)}: {rate_text(it)}")
    marks = []
    if it.flight.home is not None:
        marks += [
            _placemark("source", place_name(it), source, _kml_point(it, it.last.mean)),
            _placemark("region", "95% region: ellipse", "", _kml_polygon(it, [it.ellipse.outline.tolist()])),
        ]
        if it.contour:
            rings = [ring.tolist() for ring in it.contour.rings]
            marks.append(_placemark("region", "95% region: particles", "", _kml_polygon(it, rings)))
        ring = _rectangle(it.area.low, it.area.high)
        marks.append(_placemark("area", "Search area", "", _kml_polygon(it, [ring])))
        several = len(it.flight.tracks) > 1
        polygons = [("wall", "Keep out", wall) for wall in it.flight.walls]
        polygons += [("area", "Keep in", it.flight.fence)] if it.flight.fence else []
        marks += [
            _placemark(style, name, "", _kml_polygon(it, [_ring(outline)]))
            for style, name, outline in polygons
        ]
        for number, track in it.flight.tracks.items():
            if len(track) > 1:
                line = _kml_line(it, track.tolist())
                marks.append(_placemark("track", f"Track of uav/{number}" if several else "Track", "", line))
        marks += [
            _placemark(
                "reading",
                f"Reading {sample.step}" + (f" of uav/{sample.vehicle}" if several else ""),
                _lines(f"{sample.gas:.4g} {it.unit}", utc(sample.utc_ns)),
                _kml_point(it, sample.place),
                when=utc(sample.utc_ns),
            )
            for sample in it.flight.samples
        ]
    styles = "".join(f'<Style id="{name}">{style}</Style>\n' for name, style in KML_STYLES.items())
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n<Document>\n'
        f"<name>{_xml(f'Plumeward: {it.flight.path.name}')}</name>\n"
        f"<description>{_xml(_lines(it.verdict.sentence))}</description>\n{styles}{''.join(marks)}</Document>\n</kml>\n"
    )


def _xml(text: str) -> str:
    return escape(printable(text))


def _lines(*lines: str) -> str:
    """Return the text of a description, which viewers show as HTML."""
    return "\n".join(escape(printable(line)) for line in lines)


def _placemark(style: str, name: str, about: str, geometry: str, when: str = "") -> str:
    stamp = f"<TimeStamp><when>{when}</when></TimeStamp>" if when and when != "unknown" else ""
    described = f"<description>{escape(about)}</description>" if about else ""
    return (
        f"<Placemark><name>{_xml(name)}</name>{described}{stamp}<styleUrl>#{style}</styleUrl>"
        f"{geometry}</Placemark>\n"
    )


def _coordinates(places: Iterable[Position]) -> str:
    told = " ".join(f"{lon:.{DECIMALS}f},{lat:.{DECIMALS}f}" for lon, lat in places)
    return f"<coordinates>{told}</coordinates>"


def _kml_point(it: Findings, place: Point) -> str:
    there = _position(it, place)
    return f"<Point>{_coordinates([there])}</Point>" if there else ""


def _kml_line(it: Findings, places: Sequence[Sequence[float]]) -> str:
    return _together("LineString", map(_coordinates, _ways(it, places)))


def _kml_polygon(it: Findings, rings: Sequence[Sequence[Sequence[float]]]) -> str:
    return _together("Polygon", map(_boundaries, _shapes(it, rings)))


def _boundaries(rings: Sequence[Iterable[Position]]) -> str:
    edges = ["outerBoundaryIs", *["innerBoundaryIs"] * (len(rings) - 1)]
    return "".join(
        f"<{edge}><LinearRing>{_coordinates(ring)}</LinearRing></{edge}>"
        for edge, ring in zip(edges, rings, strict=True)
    )


def _together(kind: str, parts: Iterable[str]) -> str:
    told = [f"<{kind}><tessellate>1</tessellate>{part}</{kind}>" for part in parts]
    return told[0] if len(told) == 1 else f"<MultiGeometry>{''.join(told)}</MultiGeometry>" if told else ""


# ---- CSV ----

SMALLEST = (
    ("least_gs", "at the best place", "g/s"),
    ("median_gs", "median over the area", "g/s"),
    ("share_of_the_area_seen", "share of the area that has one", "1"),
)


def readings_csv(it: Findings) -> str:
    """Return the readings as CSV: a row each, with the unit in the name of each column."""
    heads = [
        *("step", "time_utc", "latitude_deg", "longitude_deg", "x_m", "y_m", "altitude_m"),
        *("gas", "gas_unit", "wind_east_mps", "wind_north_mps", "spread_m", "vehicle"),
    ]
    rows = []
    for sample in it.flight.samples:
        lat, lon = it.on_earth(sample.place) or (math.nan, math.nan)
        rows.append(
            [
                sample.step,
                utc(sample.utc_ns),
                *(f"{value:.{DECIMALS}f}" if math.isfinite(value) else "" for value in (lat, lon)),
                *(_plain(value) for value in (*sample.place, sample.altitude_m, sample.gas)),
                it.unit,
                *(_plain(value) for value in (*sample.wind, sample.spread_m)),
                sample.vehicle,
            ]
        )
    return _written(heads, rows)


def figures_csv(it: Findings) -> str:
    """Return the figures as CSV: name, value, ends of the 95% interval, unit."""
    last, rate = it.last, it.rate
    lat, lon = it.on_earth(last.mean) or (None, None)
    flight, smallest = it.flight, it.smallest.as_json(it.on_earth) if it.smallest else {}
    of_area = SMALLEST if smallest else ()
    rows: list[list[Any]] = [
        ["verdict", it.verdict.kind, None, None, ""],
        ["sentence", it.verdict.sentence, None, None, ""],
        ["latitude", lat, None, None, "deg"],
        ["longitude", lon, None, None, "deg"],
        ["x", last.mean[0], None, None, "m"],
        ["y", last.mean[1], None, None, "m"],
        *([f"covariance {name}", value, None, None, "m²"] for name, value in _covariance(it)),
        ["ellipse, longer half axis", it.ellipse.longer_m, None, None, "m"],
        ["ellipse, shorter half axis", it.ellipse.shorter_m, None, None, "m"],
        ["ellipse, bearing of the longer half axis", it.ellipse.bearing_deg, None, None, "deg"],
        ["height", *(it.height or (it.height_m, None, None)), "m"],
        ["rate", *rate, "g/s"],
        ["rate", *rate.times(KG_H), "kg/h"],
        ["wind speed, measured", it.wind.speed_mps, None, None, "m/s"],
        ["wind direction, measured, from", it.wind.from_deg, None, None, "deg"],
        *([["wind speed, believed", *it.wind.believed_speed, "m/s"]] if it.wind.believed_speed else []),
        *(
            [["wind direction, believed, from", *it.wind.believed_from, "deg"]]
            if it.wind.believed_from
            else []
        ),
        *([f"smallest rate, {name}", smallest[key], None, None, unit] for key, name, unit in of_area),
        ["diffusivity, told", last.diffusivity, None, None, "m²/s"],
        ["sensor", last.sensor, None, None, it.unit],
        ["assumption", last.assume, None, None, ""],
        ["stop", last.stop, None, None, ""],
        ["began", utc(flight.began_ns), None, None, "UTC"],
        ["ended", utc(flight.ended_ns), None, None, "UTC"],
        ["record", flight.path.name, None, None, ""],
        ["record SHA-256", flight.sha256, None, None, ""],
        *(["warning", f"{utc(it.utc_ns)} {it.who}: {it.text}", None, None, ""] for it in flight.warnings),
    ]
    return _written(["figure", "value", "low_95", "high_95", "unit"], rows)


def _covariance(it: Findings) -> list[tuple[str, float]]:
    return list(zip(("xx", "xy", "yy"), it.last.covariance, strict=True))


def _plain(value: float) -> str:
    return f"{value:.10g}" if math.isfinite(value) else ""


def _written(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(heads)
    writer.writerows([cell(value) for value in row] for row in rows)
    return text.getvalue()


def cell(value: Any) -> Any:
    """Return a value as a cell. A text that a spreadsheet would take for a formula gets an apostrophe."""
    if value is None or isinstance(value, int):
        return "" if value is None else value
    if isinstance(value, float):
        return _plain(value)
    text = printable(str(value))
    try:
        float(text)
    except ValueError:
        return f"'{text}" if text.lstrip()[:1] in ("=", "+", "-", "@") else text
    return text


def figures_json(it: Findings) -> str:
    """Return all figures as one JSON object."""
    return json.dumps(_finite(as_json(it)), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
