"""A scene as the page reads it: one binary message with a JSON header and float32 arrays.

It has only what the page does not have yet.
"""

import math
import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np

from plume.problem import Area
from scene.scene import Craft, Floats, Measurement, Release, Scatter, Scene, ellipse
from scene.state import meaning, state_of

UNKNOWN = (math.nan,) * 3
PLUME_CELLS = 96  # the true plume is sent as this many cells by this many


@dataclass
class Sent:
    """What was sent of one vehicle to one page."""

    number: int = -1
    at_s: float = -math.inf
    drawn: bool = True
    what: object = None  # identifies the scene
    mission: object = None  # which mission it is of; another one is sent from its beginning
    measurements: int = 0
    happenings: int = 0
    track: int = 0
    scatter: Scatter | None = None
    release: Release | None = None


def packed(
    scene: Scene,
    sent: Sent,
    mission: object,
    number: int,
    *,
    truth: bool = False,
    published_ms: float | None = None,
    aside: bool = False,
) -> bytes:
    """Return a scene as a message, without what the page has, and note in `sent` that the page has it now.

    The message: uint32, little-endian, the length of the header; the header in JSON, padded with spaces so
    that both have a multiple of 4 bytes; the arrays, little-endian float32, in the order that the header
    lists them. Numbers that are not finite are null.

    mission: identifies the mission that the scene is of.  truth: whether the page asked for the true plume
    and source.  aside: whether the page shows the vehicle only on the map of another one: without particles.
    """
    arrays: list[tuple[dict[str, Any], Floats]] = []
    begins = sent.mission != mission
    if begins:
        sent.mission, sent.scatter, sent.release = mission, None, None
        sent.measurements = sent.happenings = sent.track = 0
    if not aside and (begins or scene.scatter is not sent.scatter):
        arrays.append(({"name": "particles"}, _particles(scene.scatter)))
    track_from = min(sent.track, len(scene.track))
    arrays.append(({"name": "track", "from": track_from}, scene.track[track_from:]))
    shown = scene.backdrop.release if truth else None
    if shown is not None and shown != sent.release:
        arrays.append(({"name": "plume"}, plume(shown, scene.backdrop.area)))
    header = _header(scene, sent) | {
        "number": number,
        "published_ms": published_ms,
        "truth": None if shown is None else {"sources": shown.sources},
        "walls": scene.backdrop.walls if begins else None,
        "fence": scene.backdrop.fence if begins else None,
        "arrays": [{**about, "shape": array.shape} for about, array in arrays],
    }
    sent.measurements, sent.happenings = len(scene.measurements), len(scene.happenings)
    sent.track, sent.release = len(scene.track), shown
    sent.scatter = sent.scatter if aside else scene.scatter
    return framed(header, [array for _, array in arrays])


def framed(header: dict[str, Any], arrays: list[Floats]) -> bytes:
    """Return a header and arrays as one message."""
    text = msgspec.json.encode(header)
    text += b" " * (-len(text) % 4)
    return b"".join(
        [struct.pack("<I", len(text)), text, *(array.astype("<f4", copy=False).tobytes() for array in arrays)]
    )


def _header(scene: Scene, sent: Sent) -> dict[str, Any]:
    measured = min(sent.measurements, len(scene.measurements))
    happened = min(sent.happenings, len(scene.happenings))
    return {
        "vehicle": scene.backdrop.vehicle,
        "time_s": scene.time_s,
        "area": [*scene.backdrop.area.low, *scene.backdrop.area.high],
        "title": scene.backdrop.title,
        "stop": scene.stop,
        "threshold_m": scene.threshold_m,
        "assume": scene.assume,
        "craft": _craft(scene.craft) if scene.craft else None,
        "estimate": _estimate(scene.measurements[-1]) if scene.measurements else None,
        "gas": _gas(scene.measurements[-1]) if scene.measurements else None,
        "waypoint": scene.waypoint,
        "wind": scene.wind,
        "measurements": {"from": measured, "rows": [_row(each) for each in scene.measurements[measured:]]},
        "happenings": {
            "from": happened,
            "rows": [(each.time_s, each.level, each.who, each.text) for each in scene.happenings[happened:]],
        },
        "services": scene.services,
        "ending": scene.ending,
        "state": state_of(scene)._asdict(),
        "home": scene.home,
        "silent_s": scene.silent_s,
        "gauge": scene.gauge,
        "left": scene.left,
    }


def _craft(craft: Craft) -> dict[str, Any]:
    (x, y), it = craft.position, craft.condition
    return {
        "x": x,
        "y": y,
        "altitude_m": craft.altitude_m,
        "heading": craft.heading,
        "mode": craft.mode,
        "means": meaning(craft.mode),
        "armed": craft.armed,
        "battery": it.battery,
        "speed_mps": craft.speed_mps,
        "home_m": craft.home_m,
        "home": craft.home,
        "volts": it.volts,
        "gps": it.gps,
        "health": it.health,
        "lost": it.lost,
        "radio": it.radio,
    }


def _estimate(last: Measurement) -> dict[str, Any]:
    x, y = last.estimate
    return {
        "x": x,
        "y": y,
        "spread_m": last.spread_m,
        "radius_95_m": last.radius_95_m,
        "ellipse": ellipse(last.covariance),
    }


def _gas(last: Measurement) -> dict[str, Any] | None:
    """How the gas comes and goes, by the belief; None where that is taken to be known."""
    if not last.intermittency:
        return None
    return {"intermittency": last.intermittency, "advised_dwell_s": last.advised_dwell_s}


def _row(each: Measurement) -> tuple[float, ...]:
    return (
        *(each.step, each.time_s, *each.position, each.gas, each.spread_m, *each.estimate),
        *(each.radius_95_m, *(each.wind or UNKNOWN[:2]), *(each.rate or UNKNOWN)),
        *(each.p_value, each.evidence, each.effective_sample_size),
    )


def _particles(scatter: Scatter | None) -> Floats:
    if scatter is None:
        return np.empty((0, 3), np.float32)
    return np.column_stack([scatter.places, scatter.weights])


@lru_cache(maxsize=8)
def plume(release: Release, area: Area) -> Floats:
    """Return the true plume, g/m³: (PLUME_CELLS, PLUME_CELLS), row 0 in the south."""
    return release.gas(area, PLUME_CELLS)
