"""Protects the background of the map: an image lies where its georeference says, and a wrong one is one line."""

import base64
import io
import math
import os
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, TiffImagePlugin

from ground.findings.background import Background, BackgroundError, background, from_utm, from_web_mercator
from plume.geodesy import to_global
from plume.problem import AREA, Area

HOME = (47.397742, 8.545594)


def image(path: Path, **saved: object) -> Path:
    Image.new("RGB", (40, 20), (10, 120, 60)).save(path, **saved)
    return path


def tagged(
    path: Path, scale: tuple[float, float], tie: tuple[float, float], keys: list[tuple[int, int]]
) -> Path:
    """Write a GeoTIFF whose upper left corner is at `tie`."""
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[33550], tags.tagtype[33550] = (*scale, 0.0), 12
    tags[33922], tags.tagtype[33922] = (0.0, 0.0, 0.0, *tie, 0.0), 12
    words = [1, 1, 0, len(keys)]
    for key, value in keys:
        words += [key, 0, 1, value]
    tags[34735], tags.tagtype[34735] = tuple(words), 3
    return image(path, tiffinfo=tags)


def placed(
    path: Path, bounds: tuple[float, float, float, float] | None = None, area: Area = AREA
) -> Background:
    return background(path, HOME, bounds, area)


def edges() -> tuple[float, float, float, float]:
    south, west = HOME
    north, east = to_global(*HOME, 20.0, 40.0)
    return west, south, east, north


def test_an_image_with_bounds_lies_between_them(tmp_path: Path) -> None:
    found = placed(image(tmp_path / "site.png"), edges())
    a, b, c, d, e, f = found.to_plane
    assert (c, f) == pytest.approx((0.0, 20.0), abs=0.01)  # its upper left corner
    assert (40 * a + 20 * b + c, 40 * d + 20 * e + f) == pytest.approx((40.0, 0.0), abs=0.01)
    assert found.uri.startswith("data:image/")


def test_a_geotiff_in_degrees_and_a_world_file_place_it_alike(tmp_path: Path) -> None:
    west, south, east, north = edges()
    scale = (east - west) / 40, (north - south) / 20
    tiff = tagged(tmp_path / "site.tif", scale, (west, north), [(1024, 2), (1025, 1), (2048, 4326)])
    png = image(tmp_path / "site.png")
    lines = (scale[0], 0.0, 0.0, -scale[1], west + scale[0] / 2, north - scale[1] / 2)
    (tmp_path / "site.pgw").write_text("\n".join(map(repr, lines)))
    wanted = placed(png, edges()).to_plane
    assert placed(tiff).to_plane == pytest.approx(wanted, abs=1e-3)
    assert placed(png).to_plane == pytest.approx(wanted, abs=1e-3)


def test_a_geotiff_in_utm_lies_where_its_corner_is(tmp_path: Path) -> None:
    # EPSG:32632 of HOME: the meridian of zone 32 is 9° east.
    tiff = tagged(tmp_path / "site.tif", (1.0, 1.0), (465_694.0, 5_249_500.0), [(1024, 1), (3072, 32632)])
    a, _, c, _, e, f = placed(tiff).to_plane
    lat, lon = from_utm(32, False, 465_694.0, 5_249_500.0)
    assert to_global(*HOME, f, c) == pytest.approx((lat, lon), abs=1e-7)
    assert (a, -e) == pytest.approx((1.0, 1.0), rel=0.005)  # the sphere is not the ellipsoid


@pytest.mark.parametrize(
    ("zone", "is_south", "east", "north", "lat", "lon"),
    [
        (31, False, 500_000.0, 0.0, 0.0, 3.0),
        (31, True, 500_000.0, 10_000_000.0, 0.0, 3.0),
        (31, False, 448_251.898, 5_411_943.794, 48.85823, 2.29449),  # the Eiffel Tower
    ],
)
def test_utm_is_turned_into_degrees(
    zone: int, is_south: bool, east: float, north: float, lat: float, lon: float
) -> None:
    assert from_utm(zone, is_south, east, north) == pytest.approx((lat, lon), abs=2e-4)


def test_web_mercator_is_turned_into_degrees() -> None:
    assert from_web_mercator(math.pi * 6_378_137.0, math.pi * 6_378_137.0) == pytest.approx(
        (85.05112878, 180.0), abs=1e-6
    )


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: path.write_bytes(b""), "not an image"),
        (lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\nrest"), "not an image"),
        (lambda path: path.mkdir(), "Is a directory"),
        (lambda path: None, "No such file"),
        (lambda path: image(path), "does not say where it lies"),
        (lambda path: os.mkfifo(path), "is not a file"),
    ],
    ids=["empty", "broken", "folder", "missing", "nowhere", "pipe"],
)
def test_a_wrong_image_is_one_line(tmp_path: Path, make: object, said: str) -> None:
    path = tmp_path / "site.png"
    make(path)  # type: ignore[operator]
    with pytest.raises(BackgroundError, match=said) as error:
        placed(path)
    assert "\n" not in str(error.value)


def png(path: Path, width: int, height: int) -> Path:
    """Write a PNG of this size that is cut off before its pixels."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", b""))
    return path


@pytest.mark.parametrize("side", [9_999, 10_001, 14_000, 100_000])
def test_an_image_of_too_many_pixels_is_refused_for_them_without_a_word_of_the_library(
    tmp_path: Path, side: int
) -> None:
    said = "not an image" if side < 10_000 else "has too many pixels; wanted at most 100,000,000"
    with warnings.catch_warnings(action="error"), pytest.raises(BackgroundError, match=said):
        placed(png(tmp_path / "site.png", side, side), edges())


@pytest.mark.parametrize("system", [(2048, 4326), (3072, 3857), (3072, 32632)])
@pytest.mark.parametrize("scale", [0.0, 1e300, math.inf, math.nan])
def test_a_geotiff_whose_pixels_have_no_size_on_earth_is_refused(
    tmp_path: Path, scale: float, system: tuple[int, int]
) -> None:
    model = 2 if system[0] == 2048 else 1
    tiff = tagged(tmp_path / "site.tif", (scale, scale), (8.5, 47.4), [(1024, model), system])
    with pytest.raises(BackgroundError, match=r"site\.tif lies nowhere on earth: its "):
        placed(tiff)


@pytest.mark.parametrize("number", [2056, 26943])  # Swiss, and California's of NAD83
def test_a_geotiff_of_another_reference_system_is_refused_by_its_number(number: int, tmp_path: Path) -> None:
    tiff = tagged(tmp_path / "site.tif", (1.0, 1.0), (0.0, 0.0), [(1024, 1), (3072, number)])
    with pytest.raises(BackgroundError, match=f"EPSG:{number}"):
        placed(tiff)


def test_an_image_across_the_antimeridian_lies_there(tmp_path: Path) -> None:
    """Its eastern edge is given as above 180°."""
    path = image(tmp_path / "site.png")
    found = background(path, (0.0, -179.9999), (179.9999, 0.0, 180.0002, 0.0002), AREA)
    a, _, c, *_ = found.to_plane
    metre = 1 / math.radians(6_371_000.0)
    assert (c, 40 * a + c) == pytest.approx((-0.0002 / metre, 0.0001 / metre), rel=1e-3)


def test_an_image_that_does_not_meet_the_area_is_refused_in_a_line_that_says_where_each_lies(
    tmp_path: Path,
) -> None:
    path = image(tmp_path / "site.png")
    assert placed(path, edges(), Area((39, 19), (90, 90)))  # a corner of the image is in it
    with pytest.raises(BackgroundError) as error:
        placed(path, (7.4, 46.9, 7.5, 47.0))  # Berne
    said = str(error.value)
    assert said.startswith(f"{path} does not meet the search area: its middle is at 46.9")
    assert ", 7.4" in said
    assert "the area's at 47.39788, 8.54579" in said
    assert said.endswith(" 97 km away")
    with pytest.raises(BackgroundError, match=" 26 m away"):
        placed(path, edges(), Area((41, 0), (51, 20)))


def shown(found: Background) -> np.ndarray:
    """The picture that is laid on the map, (row, column, colour)."""
    data = base64.b64decode(found.uri.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), float)


def test_a_photograph_that_a_camera_turned_lies_as_viewers_show_it_between_bounds_alone(
    tmp_path: Path,
) -> None:
    """Orientation 6 of EXIF: the first row is the right edge of what is seen. The first row is white."""
    pixels = np.zeros((20, 40, 3), np.uint8)
    pixels[:10] = 255
    path, exif = tmp_path / "site.jpg", Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels).save(path, exif=exif)
    found = placed(path, edges())
    assert (found.width, found.height) == (20, 40)
    seen = shown(found)
    assert seen[:, 12:].min() > 200
    assert seen[:, :8].max() < 50
    west, south, east, north = edges()
    lines = ((east - west) / 40, 0.0, 0.0, (south - north) / 20, west, north)
    path.with_suffix(".jgw").write_text("\n".join(map(repr, lines)))
    assert shown(placed(path))[:8].min() > 200


@pytest.mark.parametrize("kind", [np.uint16, np.int32, np.float32])
def test_a_picture_of_16_or_32_bits_is_shown_from_its_least_to_its_greatest(
    kind: type, tmp_path: Path
) -> None:
    values = np.linspace(1000, 5000, 200).reshape(10, 20).astype(kind)
    if kind is np.float32:
        values[0, 0] = np.nan  # no data
    path = tmp_path / "site.tif"
    Image.fromarray(values).save(path)
    data = base64.b64decode(placed(path, edges()).uri.partition(",")[2])
    shown = np.asarray(Image.open(io.BytesIO(data)).convert("L"), float)
    wanted = 255 * (np.nan_to_num(values, nan=1000) - 1000.0) / 4000
    assert shown == pytest.approx(wanted, abs=6)  # JPEG loses some


def test_a_picture_of_16_bits_and_one_value_is_black(tmp_path: Path) -> None:
    path = tmp_path / "site.tif"
    Image.fromarray(np.full((10, 20), 7000, np.uint16)).save(path)
    assert placed(path, edges()).uri
