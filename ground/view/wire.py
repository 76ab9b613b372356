"""A scene as the page reads it: one binary message with a JSON header and float32 arrays, and only what
the page does not have yet.
"""

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np

from scene.scene import Craft, Floats, Measurement, Release, Scatter, Scene, ellipse

PLUME_CELLS = 96
"""The true plume is sent as so many by so many cells."""
NOBODY: Floats = np.empty((0, 3), np.float32)


@dataclass
class Cursor:
    """What a page has of one vehicle."""

    mission: object = None
    """Which mission it is of; another one is sent from its beginning."""
    measurements: int = 0
    happenings: int = 0
    track: int = 0
    scatter: Scatter | None = None
    release: Release | None = None

    def begin(self, mission: object) -> None:
        """Start anew with another mission."""
        self.mission, self.scatter, self.release = mission, None, None
        self.measurements = self.happenings = self.track = 0


def packed(
    scene: Scene,
    cursor: Cursor,
    mission: object,
    number: int,
    *,
    truth: bool = False,
    published_ms: float | None = None,
) -> bytes:
    """Return a scene as a message, without what the page has, and note in the cursor that the page has it
    now.

    The message: uint32, little-endian, the length of the header; the header in JSON, padded with spaces so
    that both have a multiple of 4 bytes; the arrays, little-endian float32, in the order that the header
    lists them. Numbers that are not finite are null.

    mission: identifies the mission that the scene is of.  truth: whether the page asked for the true plume
    and source.
    """
    anew = cursor.mission != mission
    if anew:
        cursor.begin(mission)
    shown = scene.backdrop.release if truth else None
    arrays: list[tuple[dict[str, Any], Floats]] = []
    if anew or scene.scatter is not cursor.scatter:
        arrays.append(({"name": "particles"}, _particles(scene.scatter)))
    track_from = min(cursor.track, len(scene.track))
    arrays.append(({"name": "track", "from": track_from}, scene.track[track_from:]))
    if shown is not None and shown != cursor.release:
        arrays.append(({"name": "plume"}, plume(shown, scene.backdrop.area_m)))
    header = _header(scene, cursor) | {
        "number": number,
        "published_ms": published_ms,
        "truth": None if shown is None else {"source": shown.source},
        "arrays": [{**about, "shape": array.shape} for about, array in arrays],
    }
    cursor.measurements, cursor.happenings, cursor.track = (
        len(scene.measurements),
        len(scene.happenings),
        len(scene.track),
    )
    cursor.scatter, cursor.release = scene.scatter, shown
    return framed(header, [array for _, array in arrays])


def framed(header: dict[str, Any], arrays: list[Floats]) -> bytes:
    """Return a header and arrays as one message."""
    text = msgspec.json.encode(header)
    text += b" " * (-len(text) % 4)
    return b"".join(
        [struct.pack("<I", len(text)), text, *(array.astype("<f4", copy=False).tobytes() for array in arrays)]
    )


def _header(scene: Scene, cursor: Cursor) -> dict[str, Any]:
    last = scene.measurements[-1] if scene.measurements else None
    measured, happened = (
        min(cursor.measurements, len(scene.measurements)),
        min(cursor.happenings, len(scene.happenings)),
    )
    return {
        "vehicle": scene.backdrop.vehicle,
        "time_s": scene.time_s,
        "area_m": scene.backdrop.area_m,
        "title": scene.backdrop.title,
        "stop": scene.stop,
        "threshold_m": scene.threshold_m,
        "assume": scene.assume,
        "craft": _craft(scene.craft),
        "estimate": None if last is None else _estimate(last),
        "waypoint": scene.waypoint,
        "wind": scene.wind,
        "measurements": {"from": measured, "rows": [_row(each) for each in scene.measurements[measured:]]},
        "happenings": {
            "from": happened,
            "rows": [(each.time_s, each.level, each.who, each.text) for each in scene.happenings[happened:]],
        },
        "services": scene.services,
        "ending": scene.ending,
    }


def _craft(craft: Craft | None) -> dict[str, Any] | None:
    if craft is None:
        return None
    (x, y), it = craft.position, craft.condition
    return {
        "x": x,
        "y": y,
        "altitude_m": craft.altitude_m,
        "heading": craft.heading,
        "mode": craft.mode,
        "armed": craft.armed,
        "battery": it.battery,
        "volts": it.volts,
        "gps": it.gps,
        "health": it.health,
    }


def _estimate(last: Measurement) -> dict[str, Any]:
    x, y = last.estimate
    return {"x": x, "y": y, "spread_m": last.spread_m, "ellipse": ellipse(last.covariance)}


def _row(each: Measurement) -> tuple[float, ...]:
    return (each.step, each.time_s, *each.position, each.gas, each.spread_m, *each.estimate)


def _particles(scatter: Scatter | None) -> Floats:
    return NOBODY if scatter is None else np.column_stack([scatter.places, scatter.weights])


@lru_cache(maxsize=8)
def plume(release: Release, area_m: float) -> Floats:
    """Return the true plume, g/m³: (PLUME_CELLS, PLUME_CELLS), row 0 in the south."""
    return release.gas(area_m, PLUME_CELLS)
