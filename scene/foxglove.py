"""Scenes as messages of Foxglove's schemas, in protobuf, for records and viewers: Foxglove, Lichtblick,
Rerun.

The frame `map` has its origin at home, x east, y north, z up; `vehicle` is the vehicle's own, its nose
along x. Metres, and degrees where a schema wants them. What the scene knows only in the plane lies at z =
0.

| topic | schema | holds | at |
|---|---|---|---|
| `scene/transforms` | FrameTransforms | the vehicle's place and heading | at most 10 a simulated second |
| `scene/vehicle` | SceneUpdate | the vehicle, an arrow in its own frame | once |
| `scene/area` | SceneUpdate | the search area | once |
| `scene/path` | PosesInFrame | where readings were taken | each reading |
| `scene/particles` | PointCloud | the belief's particles: x, y, z, weight | each belief |
| `scene/estimate` | SceneUpdate | the estimate, and its 2σ ellipse | each belief |
| `scene/waypoint` | SceneUpdate | the next waypoint | each waypoint |
| `scene/fix/vehicle` | LocationFix | the vehicle's fix, as it reports it | as `scene/transforms` |
| `scene/fix/estimate` | LocationFix | latitude, longitude and covariance of the estimate | each belief |
| `scene/log` | Log | what happened | each |
| `scene/source` | SceneUpdate | the true source; simulations only | once |
| `scene/plume` | Grid | the true mean gas, g/m³; simulations only | once |

Each message holds all of its topic, so a viewer that jumps to a time needs only the last one.
"""

import math
from collections import deque
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
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from plume.geodesy import to_global
from scene.scene import ERROR, WARNING, Craft, Happening, Measurement, Place, Release, Scatter, Scene, ellipse

TOPICS = "scene/"
"""All topics begin with it."""
MAP, VEHICLE, ESTIMATE = "map", "vehicle", "estimate"
POSES_PER_S = 10
"""Most poses of the vehicle in a second of simulation time."""
LONGEST_PATH = 1000
"""Most readings of the path: the newest ones."""
PLUME_CELLS = 60
ORANGE, BLUE, GREEN, VERMILION, GREY = (
    (0.90, 0.62, 0.0),
    (0.34, 0.71, 0.91),
    (0.0, 0.62, 0.45),
    (0.84, 0.37, 0.0),
    (0.6, 0.6, 0.6),
)
"""Colours of Okabe and Ito, which colour-blind people tell apart: vehicle, estimate, waypoint, source; and
the area.
"""
ON_GROUND_M = 0.1
DISC_M = 0.02
"""Thickness of the ellipse."""

T = TypeVar("T")


class Encoded(NamedTuple):
    """One message for viewers."""

    topic: str
    kind: Any
    """Its protobuf class."""
    data: bytes
    """The message, encoded."""


def schema_of(kind: Any) -> tuple[str, bytes]:
    """Return the name of a protobuf class and its schema: an encoded FileDescriptorSet, each file after
    those that it needs.
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
    schema: bytes = described.SerializeToString()
    return str(kind.DESCRIPTOR.full_name), schema


def pose_slot(time_s: float) -> int:
    """Return the number of the slot that a simulation time lies in: one pose is said of each."""
    return math.floor(time_s * POSES_PER_S + 1e-6)


class SceneEncoder:
    """Encodes the scenes of one vehicle: of each only what has changed since the one before."""

    def __init__(self, prefix: str = "") -> None:
        """Begin. `prefix` is put before topics and frames, where one connection shows several vehicles."""
        self._prefix = prefix
        self._said: dict[str, bytes] = {}
        self._slot = -1
        self._origin: tuple[float, float, float] | None = None
        """Latitude and longitude of home, degrees, and its altitude above mean sea level, m."""
        self._release: Release | None = None
        self._measurement: Measurement | None = None
        self._path: deque[bytes] = deque(maxlen=LONGEST_PATH)
        self._happening: Happening | None = None

    def encode(self, scene: Scene, stamp_ns: int) -> list[Encoded]:
        """Return what changed. `stamp_ns` is the messages' timestamp, ns since the Unix epoch: viewers
        compare it with their clock.
        """
        return [
            *self._once(scene, stamp_ns),
            *self.encode_pose(scene.craft, stamp_ns),
            *self._readings(scene.measurements, stamp_ns),
            *self._scatter(scene.scatter, stamp_ns),
            *self.encode_waypoint(scene.waypoint, stamp_ns),
            *self._happenings(scene.happenings, stamp_ns),
        ]

    def encode_pose(self, craft: Craft | None, stamp_ns: int) -> Iterator[Encoded]:
        """Yield where the vehicle is, unless that was said of this slot of time."""
        if (
            craft is None
            or (slot := pose_slot(craft.time_s)) == self._slot
            or not all(map(math.isfinite, craft.position))
        ):
            return
        self._slot = slot
        message = FrameTransforms()
        transform = message.transforms.add(
            parent_frame_id=self._prefix + MAP, child_frame_id=self._prefix + VEHICLE
        )
        transform.translation.x, transform.translation.y = craft.position
        transform.translation.z = craft.altitude_m
        _turn(transform.rotation, craft.heading if math.isfinite(craft.heading) else 0.0)
        yield from self._say("transforms", message, stamp_ns)
        if craft.fix is not None:
            if (
                self._origin is None or craft.altitude_m < ON_GROUND_M
            ):  # until the take-off home may be set anew
                self._origin = _origin(craft, craft.fix)
            fix = LocationFix(frame_id=self._prefix + VEHICLE, position_covariance=[0.0] * 9)
            fix.latitude, fix.longitude, fix.altitude = craft.fix
            yield from self._say("fix/vehicle", fix, stamp_ns)

    def encode_waypoint(self, place: Place | None, stamp_ns: int) -> Iterator[Encoded]:
        """Yield the next waypoint, unless that was said."""
        yield from self._marks("waypoint", [_ball("waypoint", place, 0.5, GREEN)] if place else [], stamp_ns)

    def _once(self, scene: Scene, stamp_ns: int) -> Iterator[Encoded]:
        """Yield what does not change, once."""
        release = scene.backdrop.release
        if "area" not in self._said:
            yield from self._marks("area", [_square(scene.backdrop.area_m)], stamp_ns)
            yield from self._marks("vehicle", [_arrow()], stamp_ns, VEHICLE)
        if release != self._release:
            self._release = release
            yield from self._marks(
                "source", [_ball("source", release.source, 0.6, VERMILION)] if release else [], stamp_ns
            )
            yield from self._say("plume", self._grid(release, scene.backdrop.area_m), stamp_ns)

    def _readings(self, measurements: Sequence[Measurement], stamp_ns: int) -> Iterator[Encoded]:
        """Yield the path, and the estimate after its last reading."""
        new = _after(measurements, self._measurement)
        if new is None:  # another mission, or an earlier time
            self._path.clear()
            new = measurements
        if not new and (measurements or "path" not in self._said):
            return
        last = self._measurement = measurements[-1] if measurements else None
        for measurement in new[-LONGEST_PATH:]:
            pose = PosesInFrame()
            position = pose.poses.add(orientation={"w": 1.0}).position
            position.x, position.y = measurement.position
            self._path.append(pose.SerializeToString())
        yield from self._say(
            "path", PosesInFrame(frame_id=self._prefix + MAP), stamp_ns, b"".join(self._path)
        )
        marks = [_ball("estimate", last.estimate, 0.3, BLUE), _ellipse(last)] if last else []
        yield from self._marks("estimate", marks, stamp_ns)
        if last and self._origin:
            (east, north), (xx, xy, yy) = last.estimate, last.covariance
            fix = LocationFix(frame_id=self._prefix + ESTIMATE, position_covariance_type=LocationFix.KNOWN)
            fix.latitude, fix.longitude = to_global(*self._origin[:2], north, east)
            fix.altitude = self._origin[2]
            fix.position_covariance[:] = [xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, 0.0]  # east, north, up
            yield from self._say("fix/estimate", fix, stamp_ns)

    def _scatter(self, scatter: Scatter | None, stamp_ns: int) -> Iterator[Encoded]:
        if scatter is None and "particles" not in self._said:
            return
        places = np.empty((0, 2), np.float32) if scatter is None else scatter.places
        weights = np.empty(0, np.float32) if scatter is None else scatter.weights
        rows = np.column_stack((places, np.zeros_like(weights), weights)).astype("<f4", copy=False)
        cloud = PointCloud(frame_id=self._prefix + MAP, point_stride=16, data=rows.tobytes())
        cloud.pose.orientation.w = 1.0
        for number, name in enumerate(("x", "y", "z", "weight")):
            cloud.fields.add(name=name, offset=4 * number, type=PackedElementField.FLOAT32)
        yield from self._say("particles", cloud, stamp_ns)

    def _grid(self, release: Release | None, area_m: float) -> Any:
        cells = PLUME_CELLS if release else 0
        grid = Grid(frame_id=self._prefix + MAP, column_count=cells, row_stride=4 * cells, cell_stride=4)
        grid.pose.orientation.w = 1.0
        grid.cell_size.x = grid.cell_size.y = area_m / PLUME_CELLS
        grid.fields.add(name="gas", type=PackedElementField.FLOAT32)
        if release:
            grid.data = release.gas(area_m, cells).astype("<f4", copy=False).tobytes()
        return grid

    def _happenings(self, happenings: Sequence[Happening], stamp_ns: int) -> Iterator[Encoded]:
        new = _after(happenings, self._happening)
        self._happening = happenings[-1] if happenings else None
        levels = {WARNING: Log.WARNING, ERROR: Log.ERROR}
        for happening in new or ():
            log = Log(level=levels.get(happening.level, Log.INFO), name=happening.who, message=happening.text)
            log.timestamp.FromNanoseconds(stamp_ns)
            yield self._encoded("log", log)

    def _marks(self, topic: str, entities: list[Any], stamp_ns: int, frame: str = MAP) -> Iterator[Encoded]:
        """Yield marks in a frame; none of them delete those that were there."""
        if not entities and topic not in self._said:
            return
        for entity in entities:
            entity.frame_id, entity.frame_locked = self._prefix + frame, True
        message = SceneUpdate(entities=entities)
        if not entities:
            message.deletions.add(type=SceneEntityDeletion.ALL)
        yield from self._say(topic, message, stamp_ns)

    def _say(self, topic: str, message: Any, stamp_ns: int, more: bytes = b"") -> Iterator[Encoded]:
        """Yield a message with its timestamp, unless it is what was said last. `more` is an encoded rest
        of the message.
        """
        body = message.SerializeToString() + more
        if body == self._said.get(topic):
            return
        self._said[topic] = body
        for part in _stamped(message):
            part.timestamp.FromNanoseconds(stamp_ns)
        yield self._encoded(topic, message, more)

    def _encoded(self, topic: str, message: Any, more: bytes = b"") -> Encoded:
        return Encoded(f"{self._prefix}{TOPICS}{topic}", type(message), message.SerializeToString() + more)


def _after(values: Sequence[T], last: T | None) -> Sequence[T] | None:
    """Return the values after the last known one; all if none is known, None if it is not among them."""
    if last is None:
        return values
    for count, value in enumerate(reversed(values)):
        if value is last:
            return values[len(values) - count :]
    return None


def _origin(craft: Craft, fix: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return latitude, longitude and altitude of home, from a vehicle that knows both its place and its
    fix.
    """
    east, north = craft.position
    return *to_global(fix[0], fix[1], -north, -east), fix[2] - craft.altitude_m


def _stamped(message: Any) -> Sequence[Any]:
    """Return the parts of a message that have a timestamp."""
    if isinstance(message, SceneUpdate):
        return [*message.entities, *message.deletions]
    return message.transforms if isinstance(message, FrameTransforms) else [message]


def _turn(rotation: Any, angle: float) -> None:
    """Set a quaternion to a turn about z."""
    rotation.z, rotation.w = math.sin(angle / 2), math.cos(angle / 2)


def _colour(color: Any, rgb: tuple[float, float, float], alpha: float = 1.0) -> None:
    color.r, color.g, color.b = rgb
    color.a = alpha


def _ball(name: str, place: Place, diameter_m: float, rgb: tuple[float, float, float]) -> Any:
    entity = SceneEntity(id=name)
    ball = entity.spheres.add()
    ball.pose.position.x, ball.pose.position.y = place
    ball.pose.orientation.w = 1.0
    ball.size.x = ball.size.y = ball.size.z = diameter_m
    _colour(ball.color, rgb)
    return entity


def _ellipse(measurement: Measurement) -> Any:
    """Return the covariance of an estimate as a flat disc; its axes are twice the half axes of 2 standard
    deviations.
    """
    longer, shorter, angle = ellipse(measurement.covariance)
    entity = SceneEntity(id="covariance")
    disc = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
    disc.pose.position.x, disc.pose.position.y = measurement.estimate
    _turn(disc.pose.orientation, angle)
    disc.size.x, disc.size.y, disc.size.z = 2 * longer, 2 * shorter, DISC_M
    _colour(disc.color, BLUE, 0.3)
    return entity


def _square(side_m: float) -> Any:
    entity = SceneEntity(id="area")
    line = entity.lines.add(type=1, thickness=2.0, scale_invariant=True)  # a closed line, 2 pixels wide
    line.pose.orientation.w = 1.0
    for x, y in ((0.0, 0.0), (side_m, 0.0), (side_m, side_m), (0.0, side_m)):
        line.points.add(x=x, y=y)
    _colour(line.color, GREY)
    return entity


def _arrow() -> Any:
    entity = SceneEntity(id="vehicle")
    arrow = entity.arrows.add(shaft_length=0.6, shaft_diameter=0.2, head_length=0.4, head_diameter=0.5)
    arrow.pose.orientation.w = 1.0
    _colour(arrow.color, ORANGE)
    return entity
