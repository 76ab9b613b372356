"""Protects the maps of the findings: all that they say can be seen, whatever the shape of the area."""

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from ground.findings.chart import rates_map, whole_map
from ground.findings.figures import Findings
from ground.findings.unseen import Smallest
from plume.problem import Area
from tests.ground.findings.records import findings

SVG = "{http://www.w3.org/2000/svg}"
SHAPES = [(300.0, 20.0), (30.0, 30.0), (20.0, 300.0)]


def over(it: Findings, area: Area, *vehicles: tuple[float, float]) -> Findings:
    """The findings of a flight over another area, in which each of these vehicles read once, at its place."""
    x, y = area.size_m
    sample = it.flight.samples[0]
    samples = [sample._replace(place=place, vehicle=k) for k, place in enumerate(vehicles, 1)]
    tracks = {k: np.array([place, (x / 2, y / 2)], np.float32) for k, place in enumerate(vehicles, 1)}
    return replace(it, flight=it.flight._replace(samples=samples, tracks=tracks), area=area)


def texts(drawing: str) -> list[tuple[float, float, str]]:
    """Where the texts of a map begin or have their middle, but that along the axis, and what they say."""
    told = ElementTree.fromstring(drawing).iter(f"{SVG}text")
    return [(float(it.get("x", 0)), float(it.get("y", 0)), it.text or "") for it in told if it.get("x")]


def sides(drawing: str) -> tuple[float, float]:
    """Width and height of a map, in its own units."""
    width, height = re.search(r'viewBox="0 0 (\d+) (\d+)"', drawing).groups()  # type: ignore[union-attr]
    return float(width), float(height)


@pytest.mark.parametrize("size", SHAPES, ids=str)
def test_a_map_of_any_shape_shows_its_legend_and_fits_on_a_page(size: tuple[float, float]) -> None:
    """A4 has 182 x 269 mm within its edges; a map is 165 mm wide there and has a caption below."""
    it = over(findings(), Area((0.0, 0.0), size), (0.0, 0.0), size)
    rates = Smallest(it.area, np.geomspace(1.0, 900.0, 225).reshape(15, 15), 1)
    for drawing in (whole_map(it), rates_map(replace(it, smallest=rates))):
        width, height = sides(drawing)
        assert height / width * 165 < 240
        said = texts(drawing)
        assert {"N"} < {text for *_, text in said}
        assert any(text.startswith(("gas", "rate")) for *_, text in said)
        assert all(0 < x < width and 0 < y < height for x, y, _ in said)


def test_names_of_vehicles_that_begin_side_by_side_or_at_an_edge_can_be_read() -> None:
    """A name is drawn 11 units high; a letter is at most as wide as high, and its six are narrower."""
    for corner in ((0.0, 0.0), (30.0, 0.0), (30.0, 30.0)):
        beside = [(abs(corner[0] - 0.3 * k), corner[1]) for k in range(8)]
        drawing = whole_map(over(findings(), Area((0.0, 0.0), (30.0, 30.0)), *beside))
        names = {text: (x, y) for x, y, text in texts(drawing) if text.startswith("uav/")}
        assert sorted(names) == [f"uav/{k}" for k in range(1, 9)]
        width, height = sides(drawing)
        boxes = list(names.values())
        for k, (x, y) in enumerate(boxes):
            assert x + 30 < width - 90  # of the frame's right edge
            assert 20 < y < height - 30
            assert all(abs(x - a) > 30 or abs(y - b) > 11 for a, b in boxes[:k])
