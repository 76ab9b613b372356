"""Protects fences from files: their metres are those worked out by hand, and what is wrong is said in one line.

At 60° north a thousandth of a degree is 111.195 m of latitude (π · 6,371,000 m / 180,000) and half of that, 55.597 m,
of longitude.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plume.problem import Problem
from plume.problems.names import named

HOME = (60.0, 10.0)
NORTH_M, EAST_M = 111.195, 55.597
# Places in thousandths of a degree east and north of home, and the same in metres.
FIELD, HALL = [(0, 0), (4, 0), (4, 2), (0, 2)], [(1, 1), (2, 1), (2, 1.5), (1, 1.5)]


def lon_lat(places: list[tuple[float, float]]) -> list[list[float]]:
    return [[round(HOME[1] + x / 1000, 7), round(HOME[0] + y / 1000, 7)] for x, y in places]


def kml(field: str = "field", more: str = "", head: str = "") -> str:
    def polygon(name: str, places: list, inner: str = "") -> str:
        said = " ".join(f"{lon},{lat},0" for lon, lat in lon_lat([*places, places[0]]))
        return (
            f"<Placemark><name>{name}</name><Polygon><outerBoundaryIs><LinearRing><coordinates>{said}"
            f"</coordinates></LinearRing></outerBoundaryIs>{inner}</Polygon></Placemark>"
        )

    return (
        f'<?xml version="1.0" encoding="UTF-8"?>{head}<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
        f"{polygon(field, FIELD)}{polygon('Keep-out: hall', HALL)}{more}"
        "<Placemark><name>Home</name><Point><coordinates>10,60,12</coordinates></Point></Placemark>"
        "</Document></kml>"
    )


def geojson(**changes: Any) -> str:
    def feature(name: str, kind: str, places: Any) -> dict:
        return {
            "type": "Feature",
            "properties": {"name": name},
            "geometry": {"type": kind, "coordinates": places},
        }

    features = [
        feature("field", "Polygon", [lon_lat([*FIELD, FIELD[0]])]),
        feature("no-fly zone", "Polygon", [lon_lat([*HALL, HALL[0]])]),
        feature("home", "Point", [10.0, 60.0]),
    ]
    return json.dumps({"type": "FeatureCollection", "features": features} | changes)


def plan(**changes: Any) -> str:
    def polygon(places: list, inclusion: bool) -> dict:
        return {"inclusion": inclusion, "polygon": [[lat, lon] for lon, lat in lon_lat(places)], "version": 1}

    fence = {"circles": [], "polygons": [polygon(FIELD, True), polygon(HALL, False)], "version": 2} | changes
    return json.dumps(
        {
            "fileType": "Plan",
            "geoFence": fence,
            "groundStation": "QGroundControl",
            "mission": {"items": [], "plannedHomePosition": [60.0, 10.0, 12.0], "version": 2},
            "rallyPoints": {"points": [], "version": 2},
            "version": 1,
        }
    )


def of(folder: Path, name: str, text: str) -> Problem:
    path = folder / name
    path.write_text(text)
    return named(str(path))


@pytest.mark.parametrize(
    ("name", "text"),
    [("yard.kml", kml()), ("yard.geojson", geojson()), ("yard.json", geojson()), ("yard.PLAN", plan())],
)
def test_a_fence_is_in_metres_from_its_home(name: str, text: str, tmp_path: Path) -> None:
    problem = of(tmp_path, name, text)
    (hall,) = problem.keep_out
    for corners, places in ((problem.keep_in, FIELD), (hall, HALL)):
        assert np.array(corners) == pytest.approx(
            np.array(places) * (EAST_M, NORTH_M), abs=0.015
        )  # meridians meet
    assert problem.area.low == pytest.approx((0, 0), abs=0.02)
    assert problem.area.high == pytest.approx((4 * EAST_M, 2 * NORTH_M), abs=0.02)
    assert problem.step_m == 1.0
    assert problem.home == (60.0, 10.0)
    assert named(problem.text) == problem
    assert problem.ground.obstacles
    # Home is a corner of the field, so the search begins at the nearest place that is clear.
    assert problem.start
    assert 0 < problem.start[0] < 10  # type: ignore[index,operator]


def test_a_hole_in_the_polygon_to_keep_in_is_kept_out_of(tmp_path: Path) -> None:
    features = json.loads(geojson())["features"]
    features[0]["geometry"]["coordinates"].append(lon_lat([(3, 1), (3.5, 1), (3.5, 1.5)]))
    problem = of(tmp_path, "yard.geojson", geojson(features=features))
    assert [len(polygon) for polygon in problem.keep_out] == [3, 4]


# The field and a hole in each half, in thousandths of a degree from 180°, 60° N: the halves that RFC 7946 cuts.
WEST, EAST = [(-2, 0), (0, 0), (0, 2), (-2, 2)], [(0, 0), (2, 0), (2, 2), (0, 2)]
WEST_HOLE, EAST_HOLE = ([(x, 0.5), (x + 0.5, 0.5), (x + 0.5, 1.5)] for x in (-1.5, 1))


def halves(east: list[tuple[float, float]]) -> str:
    def ring(places: list[tuple[float, float]], side: int) -> list[list[float]]:
        return [[round(side * 180 + x / 1000, 7), 60 + y / 1000] for x, y in (*places, places[0])]

    west = [ring(WEST, 1), ring(WEST_HOLE, 1)]
    features = [
        geometry("MultiPolygon", [west, [ring(east, -1), ring(EAST_HOLE, -1)]]),
        geometry("Point", [-179.9999, 60.0]) | {"properties": {"name": "home"}},
    ]
    return geojson(features=features)


@pytest.mark.parametrize("east", [EAST, EAST[::-1], EAST[2:] + EAST[:2]], ids=["same", "against", "turned"])
def test_a_fence_that_is_cut_at_the_antimeridian_is_whole(
    east: list[tuple[float, float]], tmp_path: Path
) -> None:
    """Home is a tenth of a thousandth of a degree, 5.56 m, east of it."""
    problem = of(tmp_path, "yard.geojson", halves(east))
    assert problem.area.low == pytest.approx((-2.1 * EAST_M, 0), abs=0.02)
    assert problem.area.high == pytest.approx((1.9 * EAST_M, 2 * NORTH_M), abs=0.02)
    x, y = np.array(problem.keep_in).T
    around = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2  # Gauss's area formula
    assert abs(around) == pytest.approx(4 * EAST_M * 2 * NORTH_M, rel=1e-3)
    assert [len(polygon) for polygon in problem.keep_out] == [3, 3]


def test_a_polygon_without_corners_beside_another_is_one_of_two(tmp_path: Path) -> None:
    features = [geometry("MultiPolygon", [[[]], [lon_lat(FIELD)]]), json.loads(geojson())["features"][-1]]
    with pytest.raises(ValueError, match="2 polygons to keep in"):
        of(tmp_path, "yard.geojson", geojson(features=features))


def test_polygons_that_only_touch_the_antimeridian_stay_two(tmp_path: Path) -> None:
    """The eastern one has its side 0.1 thousandths of a degree further north."""
    with pytest.raises(ValueError, match="2 polygons to keep in"):
        of(tmp_path, "yard.geojson", halves([(x, y + 0.1) for x, y in EAST]))


def geometry(kind: str, places: Any) -> dict:
    return {"type": "Feature", "properties": None, "geometry": {"type": kind, "coordinates": places}}


@pytest.mark.parametrize(
    "other",
    [
        geometry("LineString", lon_lat(FIELD)),
        geometry("MultiLineString", [lon_lat(FIELD)]),
        geometry("MultiPoint", lon_lat(FIELD)),
        geometry("Point", []),
        geometry("Point", [500, 0]),
        {"type": "Feature", "properties": {"name": "notes"}, "geometry": None},
    ],
    ids=lambda other: str(other["geometry"] and other["geometry"]["type"]),
)
def test_lines_other_points_and_features_of_no_place_are_read_past(other: dict, tmp_path: Path) -> None:
    features = json.loads(geojson())["features"]
    usual = of(tmp_path, "yard.geojson", geojson())
    assert of(tmp_path, "yard.geojson", geojson(features=[other, *features, other])) == usual


@pytest.mark.parametrize("name", ["", "<name>a valve</name>"])
@pytest.mark.parametrize("inside", ["", "<coordinates/>", "<coordinates>here</coordinates>"])
def test_other_points_of_a_kml_are_read_past(name: str, inside: str, tmp_path: Path) -> None:
    more = f"<Placemark>{name}<Point>{inside}</Point></Placemark>"
    assert of(tmp_path, "yard.kml", kml(more=more)) == of(tmp_path, "yard.kml", kml())


def test_a_corner_given_twice_in_a_row_is_one(tmp_path: Path) -> None:
    twice = [
        [lon, lat] for lon, lat in lon_lat([FIELD[0], FIELD[0], FIELD[1], FIELD[1], *FIELD[2:], FIELD[0]])
    ]
    twice[1][0] += 1e-9  # a tenth of a millimetre: the same in a file that rounds
    features = json.loads(geojson())["features"]
    features[0]["geometry"]["coordinates"] = [twice]
    usual = of(tmp_path, "yard.geojson", geojson())
    assert of(tmp_path, "yard.geojson", geojson(features=features)) == usual


def test_home_may_be_in_the_middle_and_is_then_the_start(tmp_path: Path) -> None:
    features = json.loads(geojson())["features"]
    features[2]["geometry"]["coordinates"] = [10.0005, 60.0005]
    problem = of(tmp_path, "yard.geojson", geojson(features=features))
    assert problem.start == (0.0, 0.0)
    assert problem.area.low == pytest.approx((-EAST_M / 2, -NORTH_M / 2), abs=0.02)


def polygons(*inclusions: bool) -> dict:
    some = json.loads(plan())["geoFence"]["polygons"]
    return {"polygons": [some[0] | {"inclusion": inclusion} for inclusion in inclusions]}


REFUSED = [
    ("a.kml", "", "not valid XML: no element found"),
    ("a.kml", "<kml><Document>", "not valid XML"),
    (
        "a.kml",
        kml(more="<Folder>" * 48 + "</Folder>" * 48 + "<Placemark>" * 49 + "</Placemark>" * 49),
        "elements nested more than 50 deep are not allowed",  # thousands would be read for hours
    ),
    ("a.kml", "<gpx/>", "its root is <gpx>; wanted <kml>"),
    (
        "a.kml",
        kml(head='<!DOCTYPE kml [<!ENTITY a "aaaa">]>'),
        "<!DOCTYPE is not allowed; wanted KML without a document type and entities",
    ),
    ("a.kml", kml(field="Keep out of this"), "0 polygons to keep in; wanted one"),
    (
        "a.kml",
        kml().replace("Keep-out: hall", "hall"),
        r"2 polygons to keep in \('field', 'hall'\); wanted one",
    ),
    ("a.kml", kml().replace("<name>Home</name>", ""), "0 points named home; wanted one, where the vehicle"),
    ("a.kml", kml().replace("10,60,12", "10;60"), "placemark 'Home': coordinates '10;60' are not allowed"),
    ("a.kml", kml().replace("10,60,12", ""), "placemark 'Home': no coordinates"),
    (
        "a.kml",
        kml().replace("10,60,12", "10,nan"),
        "placemark 'Home': latitude nan and longitude 10.0 are not",
    ),
    (
        "a.kml",
        kml().replace("10,60,12", "10,50"),
        "the polygon to keep in: 60.0.* is 1,112 km from home; wanted up",
    ),
    ("a.geojson", "[]", "not a JSON object"),
    ("a.geojson", "{", "not valid JSON"),
    ("a.geojson", "[" * 100_000, "not valid JSON"),
    ("a.plan", plan()[:-1] + ', "geoFence": {}}', "not valid JSON: the name 'geoFence' is there twice"),
    ("a.geojson", "{}", "wanted a FeatureCollection of up to 1,000 features"),
    ("a.geojson", geojson(features=[{}] * 1001), "wanted a FeatureCollection of up to 1,000 features"),
    ("a.geojson", geojson(features=[3]), r"features\[0\]: wanted a feature with a geometry"),
    (
        "a.geojson",
        geojson(features=[{"geometry": {"type": "GeometryCollection"}}]),
        r"features\[0\]: 'GeometryCollection' is not allowed; wanted Point, Polygon",
    ),
    (
        "a.geojson",
        geojson(features=[{"geometry": {"type": "Polygon", "coordinates": [[["a", 3]]]}}]),
        r"features\[0\]: latitude 3 and longitude 'a' are not allowed; wanted degrees",
    ),
    (
        "a.geojson",
        json.dumps(
            {
                "type": "FeatureCollection",
                "features": [
                    *json.loads(geojson())["features"][::2],
                    geometry("Polygon", [lon_lat(HALL), lon_lat([(1.2, 1.1), (1.5, 1.1), (1.5, 1.3)])])
                    | {"properties": {"name": "no-fly: hall"}},
                ],
            }
        ),
        "the polygon 'no-fly: hall' to keep out of has a hole; wanted one without",
    ),
    (
        "a.kml",
        kml(field="Exclusion")
        .replace("Keep-out: hall", "field")
        .replace(
            "</outerBoundaryIs>",
            "</outerBoundaryIs><innerBoundaryIs><LinearRing><coordinates>10.001,60.0005 10.002,60.0005 "
            "10.002,60.001</coordinates></LinearRing></innerBoundaryIs>",
            1,
        ),
        "the polygon 'Exclusion' to keep out of has a hole; wanted one without",
    ),
    ("a.plan", "{}", "fileType is None; wanted 'Plan'"),
    ("a.plan", plan(circles=[{"circle": {}}]), "geoFence.circles: circles are not allowed; wanted polygons"),
    ("a.plan", plan(**polygons(False)), "geoFence: 0 polygons with inclusion; wanted one"),
    ("a.plan", plan(**polygons(True, True)), "geoFence: 2 polygons with inclusion; wanted one"),
    ("a.plan", plan(polygons=[{"polygon": [[1, 2]]}]), r"geoFence.polygons\[0\]: wanted `polygon`, a list"),
    (
        "a.plan",
        plan(polygons=[{"polygon": [5], "inclusion": True}]),
        r"polygons\[0\]: 5 is not allowed; wanted",
    ),
    (
        "a.plan",
        plan(polygons=[{"polygon": [[60, 10], [60.001, 10]], "inclusion": True}]),
        "the polygon to keep in: 2 corners are not allowed; wanted at least 3",
    ),
    (
        "a.plan",
        plan(
            polygons=[
                {"polygon": [[60, 10], [60.002, 10.002], [60.002, 10], [60, 10.002]], "inclusion": True}
            ]
        ),
        "keep_in: its sides 1 and 3 meet",
    ),
]


@pytest.mark.parametrize(("name", "text", "said"), REFUSED, ids=range(len(REFUSED)))
def test_a_file_that_is_no_fence_is_refused_in_one_line_that_names_it(
    name: str, text: str, said: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=said) as refusal:
        of(tmp_path, name, text)
    assert str(refusal.value).startswith(str(tmp_path / name))
    assert "\n" not in str(refusal.value)


def test_a_file_that_is_too_large_or_not_there_or_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="more than 1,000,000 bytes are not allowed"):
        of(tmp_path, "a.kml", kml() + " " * 1_000_000)
    (tmp_path / "zip.kml").write_bytes(b"PK\x03\x04\xff\xfe")
    with pytest.raises(ValueError, match=r"zip\.kml: not text in UTF-8: invalid start byte at byte 4"):
        named(str(tmp_path / "zip.kml"))
    with pytest.raises(ValueError, match="No such file or directory"):
        named(str(tmp_path / "none.kml"))
    with pytest.raises(ValueError, match=r"field\.kmz: a \.kmz is a zip file; wanted the \.kml in it"):
        named(str(tmp_path / "field.kmz"))
