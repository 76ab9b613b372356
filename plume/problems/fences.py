"""Fences from files of latitudes and longitudes (WGS84): KML, GeoJSON, and plans of QGroundControl.

A fence is a polygon to keep in, polygons to keep out of, and home, where the vehicle takes off.
"""

import json
import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from plume.geodesy import to_local
from plume.polygons.obstacles import Obstacles
from plume.polygons.polygons import outline
from plume.problem import CLEARANCE_M, FARTHEST_M, Area, Corners, Place, Problem, in_area

MOST_BYTES = 1_000_000
MOST_SHAPES = 1_000  # of a file
DEEPEST = 50  # elements of KML within each other: each level is read once more
DIGITS = 3  # metres are rounded to millimetres: the last bits of sines depend on the processor
# Beginnings of the names of polygons to keep out of, without blanks and hyphens.
OUT = ("keepout", "exclusion", "nofly")
NAMES = "a name that begins with keep-out, exclusion or no-fly"
NOT_READ = ("Point", "MultiPoint", "LineString", "MultiLineString")  # geometries of GeoJSON; but home is
CELLS = 24  # along a side of the area, of places that are tried as a start

LatLon = tuple[float, float]
Ring = Sequence[LatLon]


class GroundFence(NamedTuple):
    """What a file says; latitudes and longitudes in degrees."""

    home: LatLon
    keep_in: Ring
    keep_out: Sequence[Ring]


class Shape(NamedTuple):
    """A polygon of a file, or its home, with its name; the first ring of a polygon is the outer one."""

    name: str
    rings: Sequence[Ring]
    point: LatLon | None = None


def problem_of(content: bytes, kind: str) -> Problem:
    """Return the problem that a file describes; kind: its ending, one of READERS. Raises ValueError."""
    if len(content) > MOST_BYTES:
        raise ValueError(f"more than {MOST_BYTES:,} bytes are not allowed")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"not text in UTF-8: {error.reason} at byte {error.start}") from None
    fence = READERS[kind](text)
    keep_in = _metres("the polygon to keep in", fence.keep_in, fence.home)
    keep_out = [
        _metres(f"polygon {number} to keep out of", ring, fence.home)
        for number, ring in enumerate(fence.keep_out, 1)
    ]
    corners = np.array(keep_in)
    (west, south), (east, north) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    within = in_area(Area((west, south), (east, north)))
    obstacles = Obstacles(keep_out, keep_in, CLEARANCE_M, within.area.low, within.area.high)
    start = _start(obstacles)
    return within.changed(keep_in=keep_in, keep_out=tuple(keep_out), start=start, home=fence.home)


def _start(obstacles: Obstacles) -> Place:
    """Return home if a search may begin there, else the nearest such place of an even grid; home if none."""
    shares = (np.arange(CELLS) + 0.5) / CELLS
    low, size_m = np.array(obstacles.low), np.subtract(obstacles.high, obstacles.low)
    grid = low + size_m * np.stack(np.meshgrid(shares, shares), axis=-1).reshape(-1, 2)
    grid = grid[np.argsort(np.square(grid).sum(axis=1), kind="stable")]
    places = np.concatenate([np.zeros((1, 2)), np.round(grid, DIGITS)])
    x, y = places[obstacles.may_begin(places).argmax()].tolist()
    return x, y


def _metres(what: str, ring: Ring, home: LatLon) -> Corners:
    """Return the corners of a ring, (x, y) m from home, each once. Raises ValueError."""
    corners = []
    for lat, lon in ring:
        north, east = to_local(*home, lat, lon)
        away_m = math.sqrt(north * north + east * east)
        if not away_m <= FARTHEST_M:
            raise ValueError(
                f"{what}: {lat:.7f}, {lon:.7f} is {away_m / 1000:,.0f} km from home; wanted up to "
                f"{FARTHEST_M / 1000:g} km"
            )
        corners.append((round(east, DIGITS), round(north, DIGITS)))
    each: list[Place] = [(x, y) for x, y in outline(corners).tolist()]
    if len(each) < 3:
        raise ValueError(f"{what}: {len(each)} corners are not allowed; wanted at least 3")
    return tuple(each)


def _lat_lon(where: str, lat: Any, lon: Any) -> LatLon:
    """Return a latitude and longitude. Raises ValueError."""
    numbers = all(isinstance(part, int | float) and not isinstance(part, bool) for part in (lat, lon))
    if not numbers or not (abs(lat) <= 90 and abs(lon) <= 180):
        raise ValueError(
            f"{where}: latitude {lat!r:.40} and longitude {lon!r:.40} are not allowed; wanted degrees, "
            "-90 to 90 and -180 to 180"
        )
    return float(lat), float(lon)


def _fence(shapes: Sequence[Shape]) -> GroundFence:
    """Return the fence of named polygons and a point `home`. Raises ValueError."""
    homes = [shape.point for shape in shapes if shape.point]
    if len(homes) != 1:
        raise ValueError(f"{len(homes)} points named home; wanted one, where the vehicle takes off")
    polygons = [shape for shape in shapes if shape.rings]
    outs = [shape for shape in polygons if re.sub(r"[\s_-]", "", shape.name).lower().startswith(OUT)]
    ins = _uncut([shape for shape in polygons if shape not in outs])
    if len(ins) != 1:
        names = ", ".join(repr(shape.name[:40]) for shape in ins[:5])
        raise ValueError(
            f"{len(ins)} polygons to keep in{f' ({names})' * bool(ins)}; wanted one, and {NAMES} for "
            "polygons to keep out of"
        )
    for shape in outs:
        if len(shape.rings) > 1:
            raise ValueError(
                f"the polygon {shape.name[:40]!r} to keep out of has a hole; wanted one without: no way "
                "leads into it"
            )
    (home,), (within,) = homes, ins
    return GroundFence(home, within.rings[0], [*within.rings[1:], *(shape.rings[0] for shape in outs)])


def _uncut(shapes: Sequence[Shape]) -> Sequence[Shape]:
    """Return two polygons with a common side at longitude ±180° as one: RFC 7946 has them cut there."""
    begun = [ring for shape in shapes if (ring := _from_antimeridian(shape.rings[0]))]
    if len(shapes) != 2 or len(begun) != 2:
        return shapes
    one, other = begun
    if one[0][0] == other[0][0]:  # they run opposite ways around
        other = other[::-1]
    if [one[-1], one[0]] != [(lat, -lon) for lat, lon in (other[0], other[-1])]:
        return shapes
    holes = [hole for shape in shapes for hole in shape.rings[1:]]
    return [Shape(shapes[0].name, [[*one, *other[1:-1]], *holes])]


def _from_antimeridian(ring: Ring) -> Ring:
    """Return the corners of a ring from the end of its one side at longitude ±180° to the side's beginning.

    Empty if it has none there, or several.
    """
    corners = ring[:-1] if ring[:1] == ring[-1:] else ring
    at = [k for k in range(len(corners)) if abs(corners[k - 1][1]) == abs(corners[k][1]) == 180]
    return [*corners[at[0] :], *corners[: at[0]]] if len(at) == 1 else []


def of_kml(text: str) -> GroundFence:
    """Read a KML document: placemarks with polygons, and one with a point named home. Raises ValueError."""
    if found := re.search(r"<!(?!--|\[CDATA\[)\w*", text):
        raise ValueError(f"{found[0]} is not allowed; wanted KML without a document type and entities")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise ValueError(f"not valid XML: {error}") from None
    if _local(root) != "kml":
        raise ValueError(f"its root is <{_local(root)[:40]}>; wanted <kml>")
    level = [root]
    for _ in range(DEEPEST):
        level = [inner for each in level for inner in each]
    if level:
        raise ValueError(f"elements nested more than {DEEPEST} deep are not allowed")
    shapes: list[Shape] = []
    for mark in root.iter():
        if _local(mark) != "Placemark":
            continue
        name = next((each.text or "" for each in mark if _local(each) == "name"), "").strip()
        for each in mark.iter():
            if _local(each) == "Point" and _is_home(name):
                shapes.append(Shape(name, (), _ring(name, each)[0]))
            elif _local(each) == "Polygon":
                edges = {"outerBoundaryIs": [], "innerBoundaryIs": []}  # type: dict[str, list[Ring]]
                for edge in each:
                    if _local(edge) in edges:
                        edges[_local(edge)].append(_ring(name, edge))
                if len(edges["outerBoundaryIs"]) != 1:
                    raise ValueError(f"polygon {name[:40]!r}: wanted one outerBoundaryIs")
                shapes.append(Shape(name, edges["outerBoundaryIs"] + edges["innerBoundaryIs"]))
        if len(shapes) > MOST_SHAPES:
            raise ValueError(f"more than {MOST_SHAPES:,} polygons are not allowed")
    return _fence(shapes)


def _is_home(name: str) -> bool:
    return name.strip().lower() == "home"


def _local(element: ElementTree.Element) -> str:
    """Return an element's name without its namespace."""
    return str(element.tag).rpartition("}")[2]


def _ring(name: str, element: ElementTree.Element) -> Ring:
    """Return the coordinates in a KML element, at least one: lon,lat or lon,lat,altitude, between blanks."""
    said = next((each.text or "" for each in element.iter() if _local(each) == "coordinates"), "")
    where, ring = f"placemark {name[:40]!r}", []
    for word in said.split():
        parts = word.split(",")
        try:
            lon, lat = (float(part) for part in parts[:2])
        except ValueError:
            raise ValueError(
                f"{where}: coordinates {word[:40]!r} are not allowed; wanted longitude,latitude or "
                "longitude,latitude,altitude"
            ) from None
        ring.append(_lat_lon(where, lat, lon))
    if not ring:
        raise ValueError(f"{where}: no coordinates; wanted longitude,latitude")
    return ring


def of_geojson(text: str) -> GroundFence:
    """Read GeoJSON (RFC 7946): features with polygons, and one with a point named home. Raises ValueError."""
    document = _json(text)
    features = document.get("features") if document.get("type") == "FeatureCollection" else None
    if not isinstance(features, list) or len(features) > MOST_SHAPES:
        raise ValueError(f"wanted a FeatureCollection of up to {MOST_SHAPES:,} features")
    return _fence([shape for number, feature in enumerate(features) for shape in _shapes(number, feature)])


def _shapes(number: int, feature: Any) -> Iterator[Shape]:
    where = f"features[{number}]"
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    if isinstance(feature, dict) and geometry is None and "geometry" in feature:
        return
    if not isinstance(geometry, dict):
        raise ValueError(f"{where}: wanted a feature with a geometry")
    properties, inside = feature.get("properties"), geometry.get("coordinates")
    name = str(properties.get("name", "")) if isinstance(properties, dict) else ""
    match geometry.get("type"):
        case "Point" if _is_home(name):
            yield Shape(name, (), _position(where, inside))
        case kind if kind in NOT_READ:
            return
        case "Polygon":
            yield Shape(name, _rings(where, inside))
        case "MultiPolygon" if isinstance(inside, list):
            yield from (Shape(name, _rings(where, polygon)) for polygon in inside)
        case kind:
            raise ValueError(f"{where}: {kind!r:.40} is not allowed; wanted Point, Polygon or MultiPolygon")


def _rings(where: str, inside: Any) -> Sequence[Ring]:
    if not isinstance(inside, list) or not inside or not all(isinstance(ring, list) for ring in inside):
        raise ValueError(f"{where}: wanted coordinates of rings, lists of [longitude, latitude]")
    return [[_position(where, place) for place in ring] for ring in inside]


def _position(where: str, place: Any) -> LatLon:
    if not isinstance(place, list) or len(place) < 2:
        raise ValueError(f"{where}: {place!r:.40} is not allowed; wanted [longitude, latitude]")
    return _lat_lon(where, place[1], place[0])


def of_plan(text: str) -> GroundFence:
    """Read a plan of QGroundControl: the polygons of its fence, and its planned home. Raises ValueError."""
    document = _json(text)
    if document.get("fileType") != "Plan":
        raise ValueError(f"fileType is {document.get('fileType')!r:.40}; wanted 'Plan'")
    mission, fence = document.get("mission"), document.get("geoFence")
    home = mission.get("plannedHomePosition") if isinstance(mission, dict) else None
    if not isinstance(home, list) or len(home) < 2:
        raise ValueError("mission.plannedHomePosition: wanted [latitude, longitude, altitude]")
    polygons = fence.get("polygons") if isinstance(fence, dict) else None
    if not isinstance(fence, dict) or not isinstance(polygons, list) or len(polygons) > MOST_SHAPES:
        raise ValueError(f"geoFence.polygons: wanted a list of up to {MOST_SHAPES:,} polygons")
    if fence.get("circles"):
        raise ValueError("geoFence.circles: circles are not allowed; wanted polygons")
    ins: list[Ring] = []
    outs: list[Ring] = []
    for number, each in enumerate(polygons):
        where = f"geoFence.polygons[{number}]"
        corners, inclusion = (
            (each.get("polygon"), each.get("inclusion")) if isinstance(each, dict) else (0, 0)
        )
        if not isinstance(corners, list) or not isinstance(inclusion, bool):
            raise ValueError(f"{where}: wanted `polygon`, a list of [latitude, longitude], and `inclusion`")
        for place in corners:
            if not isinstance(place, list) or len(place) < 2:
                raise ValueError(f"{where}: {place!r:.40} is not allowed; wanted [latitude, longitude]")
        (ins if inclusion else outs).append([_lat_lon(where, lat, lon) for lat, lon, *_ in corners])
    if len(ins) != 1:
        raise ValueError(f"geoFence: {len(ins)} polygons with inclusion; wanted one")
    return GroundFence(_lat_lon("mission.plannedHomePosition", *home[:2]), ins[0], outs)


def each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the JSON object of these names and values. Raises ValueError if a name is there twice."""
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise ValueError(f"the name {name!r:.60} is there twice")
        found[name] = value
    return found


def _json(text: str) -> dict[str, Any]:
    try:
        document = json.loads(text, object_pairs_hook=each_once)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not valid JSON: {str(error)[:200]}") from None
    if not isinstance(document, dict):
        raise ValueError("not a JSON object")
    return document


READERS = {".kml": of_kml, ".geojson": of_geojson, ".plan": of_plan}
