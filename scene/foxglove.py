"""Scenes as messages of Foxglove's schemas, for records and viewers: Foxglove, Lichtblick, Rerun.

They are protobuf. The frame `map` has its origin at home, x east, y north, z up; `vehicle` is the vehicle's
own, its nose along x. Metres, and degrees where a schema wants them. What the scene knows only in the plane
lies at z = 0.

| topic | schema | holds | at |
|---|---|---|---|
| `scene/transforms` | FrameTransforms | the vehicle's place and heading | at most 10 a simulated second |
| `scene/vehicle` | SceneUpdate | the vehicle: an arrow, its name, mode and battery | each change |
| `scene/area` | SceneUpdate | the search area, home, buildings and keep-outs, the polygon to keep in | once |
| `scene/path` | PosesInFrame | where readings were taken | each reading |
| `scene/readings` | PointCloud | the readings: x, y, z, gas | each reading |
| `scene/wind` | SceneUpdate | an arrow to where the air flows, and its speed | each change |
| `scene/state` | Log | how the search is, in a sentence, and what to watch | each change |
| `scene/particles` | PointCloud | the belief's particles: x, y, z, weight | each belief |
| `scene/estimate` | SceneUpdate | the estimate, its 2σ ellipse, how near 95% of the belief is | each belief |
| `scene/waypoint` | SceneUpdate | the next waypoint | each waypoint |
| `scene/fix/vehicle` | LocationFix | the vehicle's fix, as it reports it | as `scene/transforms` |
| `scene/fix/estimate` | LocationFix | latitude, longitude and covariance of the estimate | each belief |
| `scene/log` | Log | what happened | each |
| `scene/source` | SceneUpdate | the true source; simulations only | once |
| `scene/plume` | Grid | the true mean gas, g/m³; simulations only | once |

Each message holds all of its topic, so a viewer that jumps to a time needs only the last one. Of several
vehicles the first has these topics and frames, those of the others begin with their names:
`uav/2/scene/path`. `uav/2/map` lies in `map` where its home does. What the vehicles of one search share,
such as the particles, only the first one's topics have.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from plume.geodesy import home_from, to_global
from scene.scene import (
    ERROR,
    WARNING,
    Backdrop,
    Craft,
    Floats,
    Happening,
    Measurement,
    Point,
    Release,
    Scatter,
    Scene,
    ellipse,
)
from scene.state import BAD, WARN, near_text, state_of

TOPICS = "scene/"  # all topics begin with it
MAP_FRAME, VEHICLE_FRAME, ESTIMATE_FRAME = "map", "vehicle", "estimate"
POSES_PER_S = 10  # most poses of the vehicle in a second of simulation time
LONGEST_PATH = 1000  # readings of the path: the newest ones
PLUME_CELLS = 60
# Of Okabe and Ito, which colour-blind people tell apart; (red, green, blue).
COLOURS = {
    "vehicle": (0.90, 0.62, 0.0),
    "estimate": (0.34, 0.71, 0.91),
    "waypoint": (0.0, 0.62, 0.45),
    "source": (0.84, 0.37, 0.0),
    "area": (0.6, 0.6, 0.6),
    "wall": (0.8, 0.47, 0.65),
    "wind": (0.94, 0.89, 0.26),
    "text": (0.5, 0.5, 0.5),
}
FLOAT32 = PackedElementField.FLOAT32
LINE_LOOP = 1  # LinePrimitive's type: a closed line
LEVELS = {WARNING: Log.WARNING, ERROR: Log.ERROR}
ON_GROUND_M = 0.1
DISC_M = 0.02  # thickness of the ellipse
TEXT_PX, TEXT_ABOVE_M = 14.0, 0.8
WIND_PART = 0.1  # length of the wind's arrow, of the area's longer side
STATES = {WARN: Log.WARNING, BAD: Log.ERROR}  # levels of a search's state
Fix = tuple[float, float, float]  # latitude and longitude, degrees, and altitude above sea, m
Part = Any  # a part of a protobuf message, or its fields, which its constructor takes as well

T = TypeVar("T")


class Encoded(NamedTuple):
    """One message for viewers."""

    topic: str
    kind: Any  # its protobuf class
    data: bytes


def schema_of(kind: Any) -> tuple[str, bytes]:
    """Return the name of a protobuf class and its schema, an encoded FileDescriptorSet.

    Each file in it comes after those that it needs.
    """
    files: dict[str, FileDescriptor] = {}

    def visit(file: FileDescriptor) -> None:
        if file.name not in files:
            for needed in file.dependencies:
                visit(needed)
            files[file.name] = file

    visit(kind.DESCRIPTOR.file)
    described = FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(described.file.add())
    return str(kind.DESCRIPTOR.full_name), described.SerializeToString()


def pose_slot(time_s: float) -> int:
    """Return the number of the slot that a simulation time lies in: one pose is said of each."""
    return math.floor(time_s * POSES_PER_S + 1e-6)


class SceneEncoder:
    """Encodes the scenes of one vehicle: of each only what has changed since the one before."""

    def __init__(self, prefix: str = "", *, aside: bool = False) -> None:
        """Begin.

        prefix: put before topics and frames, where several vehicles are shown.
        aside: another encoder says what the vehicles of the search share.
        """
        self._prefix, self._aside = prefix, aside
        self._away: Point = (0.0, 0.0)  # of its home from that of the first vehicle
        self._map = prefix + MAP_FRAME
        self._said: dict[str, bytes] = {}
        self._slot = -1
        self._home: tuple[float, float, float] | None = None  # as a fix: degrees, and m above mean sea level
        self._release: Release | None = None
        self._measurement: Measurement | None = None
        self._path = PosesInFrame(frame_id=self._map)
        self._gas: list[tuple[float, float, float, float]] = []  # x, y, z, gas of the readings of the path
        self._happening: Happening | None = None

    def encode(self, scene: Scene, stamp_ns: int, first_home: Fix | None = None) -> list[Encoded]:
        """Return what changed.

        `stamp_ns` is the messages' timestamp, ns since the Unix epoch: viewers compare it with their
        clock.  first_home: where the home of the first vehicle is, whose frame is the map's.
        """
        if first_home and scene.home:
            north, east, _ = home_from(first_home, scene.home)
            self._away = east, north
        return [
            *self._backdrop(scene, stamp_ns),
            *self._vehicle(scene, stamp_ns),
            *self.encode_pose(scene.craft, stamp_ns),
            *self._readings(scene.measurements, stamp_ns),
            *(() if self._aside else self._scatter(scene.scatter, stamp_ns)),
            *(() if self._aside else self._wind(scene, stamp_ns)),
            *self.encode_waypoint(scene.waypoint, stamp_ns),
            *self._state(scene, stamp_ns),
            *self._happenings(scene.happenings, stamp_ns),
        ]

    def encode_pose(self, craft: Craft | None, stamp_ns: int) -> Iterator[Encoded]:
        """Yield where the vehicle is, unless that was said of this slot of time."""
        if (
            craft is None
            or pose_slot(craft.time_s) == self._slot
            or not all(map(math.isfinite, craft.position))
        ):
            return
        self._slot = pose_slot(craft.time_s)
        transform: Part = {
            "parent_frame_id": self._map,
            "child_frame_id": self._prefix + VEHICLE_FRAME,
            "translation": {**_at(craft.position), "z": craft.altitude_m},
            "rotation": _turn(craft.heading if math.isfinite(craft.heading) else 0.0),
        }
        home: Part = {
            "parent_frame_id": MAP_FRAME,
            "child_frame_id": self._map,
            "translation": _at(self._away),
            "rotation": _turn(0.0),
        }
        told = [home, transform] if self._prefix else [transform]
        yield from self._say("transforms", FrameTransforms(transforms=told), stamp_ns)
        if craft.fix is not None:
            latitude, longitude, altitude = craft.fix
            if self._home is None or craft.altitude_m < ON_GROUND_M:  # it may be set anew until the take-off
                east, north = craft.position
                self._home = *to_global(latitude, longitude, -north, -east), altitude - craft.altitude_m
            fix = LocationFix(
                frame_id=self._prefix + VEHICLE_FRAME,
                latitude=latitude,
                longitude=longitude,
                altitude=altitude,
                position_covariance=[0.0] * 9,
            )
            yield from self._say("fix/vehicle", fix, stamp_ns)

    def encode_waypoint(self, place: Point | None, stamp_ns: int) -> Iterator[Encoded]:
        """Yield the next waypoint, unless that was said."""
        yield from self._marks("waypoint", [_ball("waypoint", place, 0.5)] if place else [], stamp_ns)

    def _backdrop(self, scene: Scene, stamp_ns: int) -> Iterator[Encoded]:
        """Yield what hardly changes, once."""
        release, area = scene.backdrop.release, scene.backdrop.area
        if self._aside:
            return
        if "area" not in self._said:
            yield from self._marks("area", _grounds(scene.backdrop), stamp_ns)
        if release != self._release:
            self._release = release
            source = [_ball("source", release.source, 0.6)] if release else []
            yield from self._marks("source", source, stamp_ns)
            cells = PLUME_CELLS if release else 0
            yield from self._say(
                "plume",
                Grid(
                    frame_id=self._map,
                    column_count=cells,
                    row_stride=4 * cells,
                    cell_stride=4,
                    pose=_pose(area.low),
                    cell_size=_at((area.size_m[0] / PLUME_CELLS, area.size_m[1] / PLUME_CELLS)),
                    fields=_floats("gas"),
                    data=release.gas(area, cells).astype("<f4", copy=False).tobytes() if release else b"",
                ),
                stamp_ns,
            )

    def _vehicle(self, scene: Scene, stamp_ns: int) -> Iterator[Encoded]:
        """Yield the vehicle as it looks in its own frame, and in words what a pilot looks for."""
        craft, battery = scene.craft, scene.craft.condition.battery if scene.craft else None
        charge = "" if battery is None else f"{100 * battery:.0f}%"
        words = filter(None, (scene.backdrop.vehicle, craft.mode if craft else "", charge))
        yield from self._marks("vehicle", [_arrow(" · ".join(words))], stamp_ns, VEHICLE_FRAME)

    def _wind(self, scene: Scene, stamp_ns: int) -> Iterator[Encoded]:
        """Yield the wind beside the north-western corner of the area."""
        x, y = scene.wind or (0.0, 0.0)
        marks = []
        if x or y:
            area, length = scene.backdrop.area, WIND_PART * max(scene.backdrop.area.size_m)
            place = area.low[0] - length, area.high[1]
            marks = [_flow(place, math.atan2(-y, -x), length, f"wind {math.hypot(x, y):.1f} m/s")]
        yield from self._marks("wind", marks, stamp_ns)

    def _state(self, scene: Scene, stamp_ns: int) -> Iterator[Encoded]:
        """Yield how the search is."""
        state = state_of(scene)
        log = Log(
            level=STATES.get(state.level, Log.INFO),
            name=scene.backdrop.vehicle,
            message=" · ".join([state.text, *state.notes]),
        )
        yield from self._say("state", log, stamp_ns)

    def _readings(self, measurements: Sequence[Measurement], stamp_ns: int) -> Iterator[Encoded]:
        """Yield the path, and the estimate after its last reading."""
        new = _after(measurements, self._measurement)
        if new is None:  # another mission, or an earlier time
            del self._path.poses[:], self._gas[:]
            new = measurements
        if not new and (measurements or "path" not in self._said):
            return
        for measurement in [it for it in new if not math.isnan(it.gas)][-LONGEST_PATH:]:
            self._path.poses.add(**_pose(measurement.position))
            self._gas.append((*measurement.position, 0.0, measurement.gas))
        del self._path.poses[:-LONGEST_PATH], self._gas[:-LONGEST_PATH]
        self._path.ClearField("timestamp")
        yield from self._say("path", self._path, stamp_ns)
        yield from self._points("readings", "gas", np.array(self._gas, "<f4").reshape(-1, 4), stamp_ns)
        last = self._measurement = measurements[-1] if measurements else None
        if self._aside:
            return
        marks = [_ball("estimate", last.estimate, 0.3), _disc(last)] if last else []
        yield from self._marks("estimate", marks, stamp_ns)
        if last and self._home:
            (east, north), (xx, xy, yy) = last.estimate, last.covariance
            latitude, longitude = to_global(*self._home[:2], north, east)
            fix = LocationFix(
                frame_id=self._prefix + ESTIMATE_FRAME,
                latitude=latitude,
                longitude=longitude,
                altitude=self._home[2],
                position_covariance_type=LocationFix.KNOWN,
                position_covariance=[xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, 0.0],  # east, north, up
            )
            yield from self._say("fix/estimate", fix, stamp_ns)

    def _scatter(self, scatter: Scatter | None, stamp_ns: int) -> Iterator[Encoded]:
        rows = np.empty((0, 4), "<f4")
        if scatter is not None:
            rows = np.column_stack((scatter.places, np.zeros_like(scatter.weights), scatter.weights))
        elif "particles" not in self._said:
            return
        yield from self._points("particles", "weight", rows, stamp_ns)

    def _points(self, topic: str, value: str, rows: Floats, stamp_ns: int) -> Iterator[Encoded]:
        """Yield points (N, 4): x, y, z and a value."""
        cloud = PointCloud(
            frame_id=self._map,
            point_stride=16,
            pose=_pose(),
            fields=_floats("x", "y", "z", value),
            data=rows.astype("<f4", copy=False).tobytes(),
        )
        yield from self._say(topic, cloud, stamp_ns)

    def _happenings(self, happenings: Sequence[Happening], stamp_ns: int) -> Iterator[Encoded]:
        new = _after(happenings, self._happening)
        self._happening = happenings[-1] if happenings else None
        for it in new or ():
            log = Log(level=LEVELS.get(it.level, Log.INFO), name=it.who, message=it.text)
            log.timestamp.FromNanoseconds(stamp_ns)
            yield self._encoded("log", log)

    def _marks(
        self, topic: str, entities: list[Part], stamp_ns: int, frame: str = MAP_FRAME
    ) -> Iterator[Encoded]:
        """Yield marks in a frame; none of them delete those that were there."""
        placed: Part = [
            {**entity, "frame_id": self._prefix + frame, "frame_locked": True} for entity in entities
        ]
        if placed:
            yield from self._say(topic, SceneUpdate(entities=placed), stamp_ns)
        elif topic in self._said:
            all_of_it = SceneEntityDeletion(type=SceneEntityDeletion.ALL)
            yield from self._say(topic, SceneUpdate(deletions=[all_of_it]), stamp_ns)

    def _say(self, topic: str, message: Any, stamp_ns: int) -> Iterator[Encoded]:
        """Yield a message with its timestamp, unless it is what was said last."""
        body = message.SerializeToString()
        if body == self._said.get(topic):
            return
        self._said[topic] = body
        for part in _stamped(message):
            part.timestamp.FromNanoseconds(stamp_ns)
        yield self._encoded(topic, message)

    def _encoded(self, topic: str, message: Any) -> Encoded:
        return Encoded(f"{self._prefix}{TOPICS}{topic}", type(message), message.SerializeToString())


def _after(values: Sequence[T], last: T | None) -> Sequence[T] | None:
    """Return the values after the last known one; all if none is known, None if it is not among them."""
    if last is None:
        return values
    for count, value in enumerate(reversed(values)):
        if value is last:
            return values[len(values) - count :]
    return None


def _stamped(message: Any) -> Sequence[Any]:
    """Return the parts of a message that have a timestamp."""
    if isinstance(message, SceneUpdate):
        return [*message.entities, *message.deletions]
    return message.transforms if isinstance(message, FrameTransforms) else [message]


# ---- parts of messages ----


def _at(place: Point) -> Part:
    return {"x": place[0], "y": place[1]}


def _turn(angle: float) -> Part:
    """Return the quaternion of a turn about z."""
    return {"z": math.sin(angle / 2), "w": math.cos(angle / 2)}


def _pose(place: Point = (0.0, 0.0), angle: float = 0.0) -> Part:
    return {"position": _at(place), "orientation": _turn(angle)}


def _floats(*names: str) -> Part:
    """Return the fields of a record of floats."""
    return [{"name": name, "offset": 4 * n, "type": FLOAT32} for n, name in enumerate(names)]


def _colour(name: str, alpha: float = 1.0) -> Part:
    return dict(zip("rgba", (*COLOURS[name], alpha), strict=True))


def _ball(name: str, place: Point, diameter_m: float) -> Part:
    return {
        "id": name,
        "spheres": [{"pose": _pose(place), "size": dict.fromkeys("xyz", diameter_m), "color": _colour(name)}],
    }


def _disc(measurement: Measurement) -> Part:
    """Return the 2σ ellipse of an estimate as a flat disc; its axes are twice the half axes."""
    longer, shorter, angle = ellipse(measurement.covariance)
    return {
        "id": "covariance",
        "cylinders": [
            {
                "pose": _pose(measurement.estimate, angle),
                "size": {"x": 2 * longer, "y": 2 * shorter, "z": DISC_M},
                "color": _colour("estimate", 0.3),
                "bottom_scale": 1.0,
                "top_scale": 1.0,
            }
        ],
        "texts": [_text(f"95% within {near_text(measurement)}", measurement.estimate)],
    }


def _text(words: str, place: Point = (0.0, 0.0)) -> Part:
    """Return words above a place, as large on the screen from near and from far."""
    return {
        "pose": {**_pose(place), "position": {**_at(place), "z": TEXT_ABOVE_M}},
        "billboard": True,
        "font_size": TEXT_PX,
        "scale_invariant": True,
        "color": _colour("text"),
        "text": words,
    }


def _grounds(backdrop: Backdrop) -> list[Part]:
    """Return the area and what lies in it."""
    (west, south), (east, north) = backdrop.area.low, backdrop.area.high
    edge = (west, south), (east, south), (east, north), (west, north)
    parts = [
        {"id": "area", "lines": [_loop(edge, "area")]},
        {"id": "home", "texts": [_text("home")]},
    ]
    if backdrop.walls:
        parts.append({"id": "walls", "lines": [_loop(wall, "wall", 3.0) for wall in backdrop.walls]})
    if backdrop.fence:
        parts.append({"id": "keep_in", "lines": [_loop(backdrop.fence, "wall", 1.5)]})
    return parts


def _loop(corners: Sequence[Point], colour: str, thickness_px: float = 2.0) -> Part:
    return {
        "type": LINE_LOOP,
        "pose": _pose(),
        "thickness": thickness_px,
        "scale_invariant": True,  # pixels
        "points": [_at(corner) for corner in corners],
        "color": _colour(colour),
    }


def _flow(place: Point, angle: float, length_m: float, words: str) -> Part:
    return {
        "id": "wind",
        "arrows": [
            {
                "pose": _pose(place, angle),
                "shaft_length": 0.7 * length_m,
                "shaft_diameter": 0.08 * length_m,
                "head_length": 0.3 * length_m,
                "head_diameter": 0.2 * length_m,
                "color": _colour("wind"),
            }
        ],
        "texts": [_text(words, place)],
    }


def _arrow(words: str) -> Part:
    return {
        "id": "vehicle",
        "texts": [_text(words)],
        "arrows": [
            {
                "pose": _pose(),
                "shaft_length": 0.6,
                "shaft_diameter": 0.2,
                "head_length": 0.4,
                "head_diameter": 0.5,
                "color": _colour("vehicle"),
            }
        ],
    }
