"""A background of the map: an image of the user's with its place on earth, or a GeoTIFF.

Where an image lies is said by a GeoTIFF's own tags, a world file beside it (`site.pgw`, `site.jgw`,
`site.wld`; degrees of WGS84), or the edges that the user gives.
"""

import base64
import io
import math
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from plume.geodesy import to_global, to_local
from plume.problem import Area

# TIFF tags of GeoTIFF 1.1 (OGC 19-008r4), and its keys.
PIXEL_SCALE, TIEPOINT, TRANSFORMATION, KEYS = 33550, 33922, 34264, 34735
MODEL_TYPE, RASTER_TYPE, GEOGRAPHIC, PROJECTED = 1024, 1025, 2048, 3072
PIXEL_IS_POINT, IS_GEOGRAPHIC = 2, 2
WGS84, WEB_MERCATOR = 4326, 3857
GEOGRAPHIC_KNOWN = {WGS84, 4258, 4269}  # ETRS89 and NAD83 differ from WGS84 by less than a metre or two
MOST_PIXELS = 100_000_000
LONGEST_SIDE = 1600  # of the picture in the page, in pixels
SEMI_MAJOR_M, FLATTENING = 6_378_137.0, 1 / 298.257223563
WORLD_FILES = {".png": (".pgw", ".wld"), ".jpg": (".jgw", ".wld"), ".jpeg": (".jgw", ".wld")}
FORMATS = ("PNG", "JPEG", "TIFF")
TO_INSTALL = "pip install 'plumeward[view]'"
Affine = tuple[float, float, float, float, float, float]


class BackgroundError(ValueError):
    """The image cannot be used; the text is one line."""


class Background(NamedTuple):
    """An image for the page."""

    uri: str  # as data
    width: int  # pixels
    height: int
    # From (column, row) of the image's upper left corner on to the plane: x = a·column + b·row + c, m, and
    # y = d·column + e·row + f.
    to_plane: Affine


def background(
    path: Path, home: tuple[float, float], bounds: tuple[float, float, float, float] | None, area: Area
) -> Background:
    """Read an image and place it. Raises BackgroundError, also if it does not meet the area.

    home: latitude and longitude of the plane's origin, degrees. bounds: west, south, east and north edge
    of the image, degrees; None where the image says so itself.
    """
    try:
        from PIL import Image, ImageOps
    except ImportError:
        raise BackgroundError(f"{path} needs Pillow: {TO_INSTALL}") from None
    if path.exists() and not (path.is_file() or path.is_dir()):  # a pipe would be waited for
        raise BackgroundError(f"{path} is not a file; wanted one")
    too_many = f"{path} has too many pixels; wanted at most {MOST_PIXELS:,}"
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=FORMATS) as image:
            if image.width * image.height > MOST_PIXELS:
                raise BackgroundError(too_many)
            tags = dict(image.tag_v2) if hasattr(image, "tag_v2") else {}
            size = image.width, image.height
            corners = _corners(path, size, tags, bounds)
            # Edges are those of the picture as viewers turn it, a world file's those of its pixels.
            uri, shrunk = _picture(ImageOps.exif_transpose(image) if bounds else image)
    except BackgroundError:
        raise
    except Image.DecompressionBombError:
        raise BackgroundError(too_many) from None
    except (OSError, ValueError, SyntaxError, TypeError, KeyError) as error:
        reason = getattr(error, "strerror", None) or "not an image that can be read; wanted PNG, JPEG or TIFF"
        raise BackgroundError(f"{path}: {reason}") from None
    plane = [to_local(*home, lat, lon)[::-1] for lat, lon in corners]
    _check_place(path, np.array(plane), home, area)
    return Background(uri, *shrunk, _affine(plane, shrunk))


def _check_place(path: Path, corners: Any, home: tuple[float, float], area: Area) -> None:
    """Raise BackgroundError if the rectangle around an image does not meet the area. corners: (3, 2) m."""
    every = np.concatenate([corners, corners[1:2] + corners[2:] - corners[:1]])
    if (every.min(axis=0) <= area.high).all() and (every.max(axis=0) >= area.low).all():
        return
    middles = every.mean(axis=0), np.mean([area.low, area.high], axis=0)
    image, searched = (
        "{:.5f}, {:.5f}".format(*to_global(*home, float(north), float(east))) for east, north in middles
    )
    away_m = math.dist(*middles)
    away = f"{away_m:.0f} m" if away_m < 10_000 else f"{away_m / 1000:,.0f} km"
    raise BackgroundError(
        f"{path} does not meet the search area: its middle is at {image}, the area's at {searched}, {away} "
        "away"
    )


def _picture(image: Any) -> tuple[str, tuple[int, int]]:
    """Return an image as a data URI, no larger than a page needs, and its size."""
    from PIL import Image

    if image.mode[0] in "IF":  # 16 or 32 bits: their range is shown from black to white
        values = np.asarray(image, np.float32)
        finite = values[np.isfinite(values)]
        low, high = (finite.min(), finite.max()) if finite.size else (0.0, 0.0)
        grey = np.clip((values - low) * (255.0 / ((high - low) or 1.0)), 0.0, 255.0)
        image = Image.fromarray(np.nan_to_num(grey).astype(np.uint8))
    image = image.convert("RGBA" if image.mode in ("RGBA", "LA", "P") else "RGB")
    image.thumbnail((LONGEST_SIDE, LONGEST_SIDE))
    data, form = io.BytesIO(), "PNG" if image.mode == "RGBA" else "JPEG"
    image.save(data, form, **({"quality": 85} if form == "JPEG" else {"optimize": True}))
    text = base64.b64encode(data.getvalue()).decode()
    return f"data:image/{form.lower()};base64,{text}", image.size


def _affine(corners: Sequence[Sequence[float]], size: tuple[int, int]) -> Affine:
    """Return the map from pixels to the plane that takes three corners where they are.

    corners: upper left, upper right and lower left, (x, y) m. Over a kilometre it is right to centimetres.
    """
    (x0, y0), (x1, y1), (x2, y2) = corners
    width, height = size
    return ((x1 - x0) / width, (x2 - x0) / height, x0, (y1 - y0) / width, (y2 - y0) / height, y0)


def _corners(
    path: Path,
    size: tuple[int, int],
    tags: dict[int, Any],
    bounds: tuple[float, float, float, float] | None,
) -> list[tuple[float, float]]:
    """Return latitude and longitude of an image's upper left, upper right and lower left corner."""
    width, height = size
    if bounds:
        west, south, east, north = bounds
        return [(north, west), (north, east), (south, west)]
    if model := _model(tags):
        to_earth = _projection(path, tags)
    elif model := _world_file(path):
        to_earth = _from_degrees
    else:
        raise BackgroundError(
            f"{path} does not say where it lies; wanted a GeoTIFF, a world file beside it, or --bounds "
            "WEST,SOUTH,EAST,NORTH"
        )
    a, b, c, d, e, f = model
    if a * e == b * d:
        raise BackgroundError(f"{path} lies nowhere on earth: its pixels have no width or no height")
    corners = []
    with suppress(OverflowError, ValueError):  # what no projection takes
        corners = [
            to_earth(a * column + b * row + c, d * column + e * row + f)
            for column, row in ((0, 0), (width, 0), (0, height))
        ]
    if not corners or not all(abs(lat) <= 90 and abs(lon) <= 540 for lat, lon in corners):
        raise BackgroundError(f"{path} lies nowhere on earth: its upper left corner is at {c:g}, {f:g}")
    return corners


def _from_degrees(x: float, y: float) -> tuple[float, float]:
    return y, x


def _model(tags: dict[int, Any]) -> Affine | None:
    """Return the map from pixels to the coordinates of a GeoTIFF; None if it is none."""
    half = 0.5 if _keys(tags).get(RASTER_TYPE) == PIXEL_IS_POINT else 0.0
    if matrix := tags.get(TRANSFORMATION):
        a, b, _, c, d, e, _, f = (float(value) for value in matrix[:8])
    elif (scale := tags.get(PIXEL_SCALE)) and (tie := tags.get(TIEPOINT)):
        column, row, _, x, y = (float(value) for value in tie[:5])
        a, b, d, e = float(scale[0]), 0.0, 0.0, -float(scale[1])
        c, f = x - a * column, y - e * row
    else:
        return None
    return a, b, c - half * (a + b), d, e, f - half * (d + e)


def _keys(tags: dict[int, Any]) -> dict[int, int]:
    """Return the GeoTIFF keys with short values."""
    words = [int(word) for word in tags.get(KEYS, ())]
    rows = [words[i : i + 4] for i in range(4, len(words) - 3, 4)]
    return {key: value for key, place, _, value in rows if place == 0}


def _projection(path: Path, tags: dict[int, Any]) -> Any:
    """Return what turns a GeoTIFF's coordinates into latitude and longitude."""
    keys = _keys(tags)
    code = keys.get(PROJECTED)
    if keys.get(MODEL_TYPE) == IS_GEOGRAPHIC or (code is None and GEOGRAPHIC in keys):
        code = keys.get(GEOGRAPHIC, WGS84)
        if code in GEOGRAPHIC_KNOWN:
            return _from_degrees
    elif code == WEB_MERCATOR:
        return from_web_mercator
    elif code is not None and (zone := _utm_zone(code)):
        number, is_south = zone
        return lambda x, y: from_utm(number, is_south, x, y)
    raise BackgroundError(
        f"{path} has the reference system {f'EPSG:{code}' if code else 'of nobody'}; wanted WGS84 "
        "(EPSG:4326), UTM (EPSG:326.., 327.., 258..) or Web Mercator (EPSG:3857)"
    )


def _utm_zone(code: int) -> tuple[int, bool] | None:
    """Return zone and hemisphere of a UTM reference system; None if it is another one."""
    bases = ((32600, 60, False), (32700, 60, True), (25800, 60, False), (26900, 23, False))
    for base, zones, is_south in bases:  # NAD83 has UTM's first 23 zones; its other numbers are states'
        if 1 <= code - base <= zones:
            return code - base, is_south
    return None


def from_web_mercator(x: float, y: float) -> tuple[float, float]:
    """Return latitude and longitude, degrees, of Web Mercator's metres."""
    return math.degrees(math.atan(math.sinh(y / SEMI_MAJOR_M))), math.degrees(x / SEMI_MAJOR_M)


def from_utm(zone: int, is_south: bool, x: float, y: float) -> tuple[float, float]:
    """Return latitude and longitude, degrees, of UTM's easting and northing, m (Krüger 1912, to n³)."""
    n = FLATTENING / (2 - FLATTENING)
    radius = SEMI_MAJOR_M / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    xi, eta = (
        (y - (10_000_000.0 if is_south else 0.0)) / (0.9996 * radius),
        (x - 500_000.0) / (0.9996 * radius),
    )
    betas = (n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96, n**2 / 48 + n**3 / 15, 17 * n**3 / 480)
    deltas = (2 * n - 2 * n**2 / 3 - 2 * n**3, 7 * n**2 / 3 - 8 * n**3 / 5, 56 * n**3 / 15)
    north, east = xi, eta
    for j, beta in enumerate(betas, 1):
        north -= beta * math.sin(2 * j * xi) * math.cosh(2 * j * eta)
        east -= beta * math.cos(2 * j * xi) * math.sinh(2 * j * eta)
    chi = math.asin(math.sin(north) / math.cosh(east))
    lat = chi + sum(delta * math.sin(2 * j * chi) for j, delta in enumerate(deltas, 1))
    lon = math.radians(6 * zone - 183) + math.atan2(math.sinh(east), math.cos(north))
    return math.degrees(lat), math.degrees(lon)


def _world_file(path: Path) -> Affine | None:
    """Return the map from pixels to degrees of the world file beside an image; None if there is none."""
    for ending in (*WORLD_FILES.get(path.suffix.lower(), ()), ".tfw"):
        beside = path.with_suffix(ending)
        if beside.is_file():
            try:
                a, d, b, e, c, f = (float(line) for line in beside.read_text().split()[:6])
            except (ValueError, UnicodeDecodeError):
                raise BackgroundError(f"{beside} is not a world file; wanted six numbers") from None
            return a, b, c - 0.5 * (a + b), d, e, f - 0.5 * (d + e)  # it places the first pixel's middle
    return None
