"""Protects the shapes of the findings at the antimeridian and at the poles, as RFC 7946 (3.1.9) has them."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from ground.findings.exchange import geojson, kml
from ground.findings.figures import Findings
from plume.geodesy import to_global
from plume.problem import Area
from tests.ground.findings.records import findings

KML = "{http://www.opengis.net/kml/2.2}"
LAT = -17.0
U_SHAPED = (
    (20.0, 2.0),
    (28.0, 2.0),
    (28.0, 5.0),
    (23.0, 5.0),
    (23.0, 7.0),
    (28.0, 7.0),
    (28.0, 10.0),
    (20.0, 10.0),
)
Ring = list[list[float]]


@pytest.fixture(scope="module")
def found() -> Findings:
    it = findings()
    return replace(it, flight=it.flight._replace(walls=(U_SHAPED, U_SHAPED[::-1]), fence=U_SHAPED))


def at(it: Findings, lat: float, lon: float) -> Findings:
    return replace(it, flight=it.flight._replace(home=(lat, lon)))


def astride(it: Findings, x: float) -> Findings:
    """Return a flight with the antimeridian so many metres east of home."""
    return at(it, LAT, to_global(LAT, 180.0, 0.0, -x)[1])


def shapes(it: Findings) -> list[tuple[str, dict[str, Any]]]:
    said = json.loads(geojson(it))["features"]
    return [(each["properties"]["kind"], each["geometry"]) for each in said]


def polygons(shape: dict[str, Any]) -> list[list[Ring]]:
    return shape["coordinates"] if shape["type"].startswith("Multi") else [shape["coordinates"]]


def lines(shape: dict[str, Any]) -> Iterator[Ring]:
    for part in polygons(shape):
        if "Polygon" in shape["type"]:
            yield from part
        elif "Line" in shape["type"]:
            yield part  # type: ignore[misc]


def twice_area(rings: list[Ring]) -> float:
    (x, y) = rings[0][0]
    return math.fsum(
        (a[0] - x) * (b[1] - y) - (b[0] - x) * (a[1] - y) for ring in rings for a, b in pairwise(ring)
    )


def length(ring: Ring) -> float:
    return math.fsum(math.dist(a, b) for a, b in pairwise(ring))


EDGES = [21.3, 24.0, 28.0, 20.0, 0.0, 30.0, -1.0]  # m east of home; the source is at (21.2, 13.1)


@pytest.mark.parametrize("x", EDGES)
def test_shapes_across_the_antimeridian_are_cut_there_and_nothing_of_them_is_lost(
    found: Findings, x: float
) -> None:
    there, usual = shapes(astride(found, x)), shapes(at(found, LAT, 10.0))
    assert [kind for kind, _ in there] == [kind for kind, _ in usual]
    for (kind, shape), (_, whole) in zip(there, usual, strict=True):
        if shape["type"] == "Point":
            assert abs(shape["coordinates"][0]) <= 180.0
            continue
        for line in lines(shape):
            assert all(abs(lon) <= 180.0 for lon, _ in line), kind
            assert all(abs(a[0] - b[0]) < 1.0 for a, b in pairwise(line)), kind
            if "Polygon" in shape["type"]:
                assert line[0] == line[-1]
        if "Polygon" in shape["type"]:
            assert all(twice_area(rings) > -1e-14 for rings in polygons(shape)), kind
            assert math.fsum(map(twice_area, polygons(shape))) == pytest.approx(
                math.fsum(map(twice_area, polygons(whole))), rel=1e-2, abs=1e-14
            ), kind
        else:
            assert math.fsum(map(length, lines(shape))) == pytest.approx(
                math.fsum(map(length, lines(whole))), abs=1e-6
            )


@pytest.mark.parametrize("lon", [180.0, -180.0])
def test_home_on_the_antimeridian_has_longitudes_within_180_degrees(found: Findings, lon: float) -> None:
    it = at(found, LAT, lon)
    it = replace(it, area=Area((-20.0, 0.0), (30.0, 30.0)))
    for _, shape in shapes(it):
        assert all(abs(lon) <= 180.0 for line in lines(shape) for lon, _ in line)
    [area] = [shape for kind, shape in shapes(it) if kind == "area"]
    assert sorted(max(lon for lon, _ in rings[0]) > 0 for rings in polygons(area)) == [False, True]


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["east", "west"])
def test_a_track_that_begins_at_the_antimeridian_is_one_line_on_its_side(
    found: Findings, side: float
) -> None:
    track = np.array([(0.0, 0.0), (side * 5.0, 1.0), (side * 9.0, 2.0)], np.float32)
    it = at(replace(found, flight=found.flight._replace(tracks={1: track})), LAT, 180.0)
    [line] = [shape for kind, shape in shapes(it) if kind == "track"]
    assert line["type"] == "LineString"
    assert [math.copysign(1.0, lon) for lon, _ in line["coordinates"][1:]] == [-side, -side]


def test_a_vehicle_that_stood_still_has_no_track(found: Findings) -> None:
    it = at(replace(found, flight=found.flight._replace(tracks={1: np.ones((3, 2), np.float32)})), LAT, 10.0)
    assert dict(shapes(it))["track"] is None


def test_a_shape_that_crosses_twice_has_its_parts_on_each_side(found: Findings) -> None:
    """East of 24 m the U has two arms; west of it, one piece."""
    it = astride(found, 24.0)
    for kind in ("keep_out", "keep_in"):
        [shape, *_] = [shape for each, shape in shapes(it) if each == kind]
        longitudes = [[lon for lon, _ in rings[0]] for rings in polygons(shape)]
        assert sorted(max(each) > 0 for each in longitudes) == [False, False, True]
        assert [180.0 in map(abs, each) for each in longitudes] == [True, True, True]


def test_a_hole_across_the_antimeridian_is_cut_out_of_both_parts(found: Findings) -> None:
    outer = [(20, 10), (24, 10), (24, 14), (20, 14), (20, 10)]
    hole = [(21, 11), (21, 13), (23, 13), (23, 11), (21, 11)]
    contour: Any = SimpleNamespace(rings=[np.array(ring, float) for ring in (outer, hole)])
    it = astride(replace(found, contour=contour), 22.0)
    [shape] = [shape for kind, shape in shapes(it) if kind == "region_95_contour"]
    assert [len(rings) for rings in polygons(shape)] == [1, 1]
    square_degree_m2 = math.radians(6_371_000.0) ** 2 * math.cos(math.radians(LAT))
    areas_m2 = [square_degree_m2 * twice_area(rings) / 2 for rings in polygons(shape)]
    assert areas_m2 == pytest.approx([6.0, 6.0], rel=0.01)


@pytest.mark.parametrize("x", EDGES)
def test_the_kml_has_the_parts_of_the_geojson(found: Findings, x: float) -> None:
    it = astride(found, x)
    told = [
        [[float(part) for part in word.split(",")] for word in (each.text or "").split()]
        for each in ElementTree.fromstring(kml(it)).iter(f"{KML}coordinates")
    ]
    for _, shape in shapes(it):
        for line in lines(shape):
            assert line in told


def test_what_lies_around_a_pole_has_no_outline_and_what_lies_beside_it_has(found: Findings) -> None:
    north = math.degrees(13.0 / 6_371_000.0)
    it = at(found, 90.0 - north, 20.0)  # the pole is 13 m north of home, within the area
    kinds = dict(shapes(it))
    assert kinds["area"] is None
    assert kinds["source"]["type"] == "Point"
    assert kinds["keep_out"]["type"] == "Polygon"
    ElementTree.fromstring(kml(it))
    assert all(shape for _, shape in shapes(at(found, 90.0 - 10 * north, 20.0)))
