"""What a mission says, as messages of ROS 2: metres and ENU by REP-103, frames by REP-105.

Source: https://www.ros.org/reps/rep-0103.html, https://www.ros.org/reps/rep-0105.html, common_interfaces.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ground.ros2.topics import BELIEF, CLOCK, ESTIMATE, ESTIMATE_FIX, FIX, GAS, POSE, STATE, TF, TRACK, WIND
from ground.ros2.wire import Wire
from link.bus.messages import Belief, Stop
from plume.geodesy import to_global
from scene.follow.area import Fix
from scene.scene import Craft, Floats, Point

TIME, HEADER = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"
VECTOR, QUATERNION, TRANSFORM = (
    f"geometry_msgs/msg/{name}" for name in ("Vector3", "Quaternion", "Transform")
)
EARTH = "earth"  # REP-105's frame that joins several maps: ECEF
WGS84_A_M, WGS84_F = 6_378_137.0, 1 / 298.257223563  # half axis at the equator, m, and flattening
FLOAT32 = 7  # PointField's
COVARIANCE_UNKNOWN, COVARIANCE_KNOWN = 0, 3  # NavSatFix's
NO_FIX, HAS_FIX, AUGMENTED = -1, 0, 2  # NavSatStatus's
Place = tuple[float, float, float]  # (x, y, z) m: east, north, up from home
Turn = tuple[float, float, float, float]  # a quaternion (x, y, z, w)
LEVEL: Turn = (0.0, 0.0, 0.0, 1.0)


class SourceClaim(NamedTuple):
    """Where the source is taken to be, from home, and how sure that is."""

    place: Place  # m
    covariance: tuple[float, float, float]  # (xx, xy, yy) m²
    height_variance: float  # m²; 0 if the height is taken to be known


def believed(said: Belief) -> SourceClaim:
    """Return where a belief has the source."""
    unknown = "z" in said.unknowns
    variance = said.stds[said.unknowns.index("z")] ** 2 if unknown else 0.0
    return SourceClaim((*said.mean, said.z), said.covariance, variance)


def claimed(said: Stop, last: SourceClaim | None) -> SourceClaim:
    """Return where a stop has the source; its height is that of the last belief."""
    height, variance = (last.place[2], last.height_variance) if last else (0.0, 0.0)
    return SourceClaim((*said.estimate, height), said.covariance, variance)


def about_up(angle: float) -> Turn:
    """Return the turn by an angle about z, rad, counter-clockwise seen from above."""
    return 0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)


def map_in_earth(home: Fix) -> tuple[Place, Turn]:
    """Return where a map's origin is in ECEF, m, and how its axes east, north, up lie there.

    home: latitude and longitude, degrees, and altitude, m.
    """
    latitude, longitude, altitude = math.radians(home[0]), math.radians(home[1]), home[2]
    squared = WGS84_F * (2 - WGS84_F)  # of the first eccentricity
    normal_m = WGS84_A_M / math.sqrt(1 - squared * math.sin(latitude) ** 2)
    around_m = (normal_m + altitude) * math.cos(latitude)
    place = (
        around_m * math.cos(longitude),
        around_m * math.sin(longitude),
        (normal_m * (1 - squared) + altitude) * math.sin(latitude),
    )
    # From ECEF: turn about z until y points north of the meridian, then about x until z points up.
    about_z, about_x = (longitude + math.pi / 2) / 2, (math.pi / 2 - latitude) / 2
    turn = (
        math.cos(about_z) * math.sin(about_x),
        math.sin(about_z) * math.sin(about_x),
        math.sin(about_z) * math.cos(about_x),
        math.cos(about_z) * math.cos(about_x),
    )
    return place, turn


class Messages:
    """Makes the messages of one vehicle. Stamps are in ns."""

    def __init__(self, wire: Wire, prefix: str) -> None:
        """Take what encodes them, and what its frames begin with: `uav_1`."""
        self._make, self._encode = wire.make, wire.encode
        self.map, self.body = f"{prefix}/map", f"{prefix}/base_link"

    # ---- the vehicle ----

    def fix(self, craft: Craft, fix: Fix, stamp_ns: int) -> bytes:
        """Return the vehicle's position as its autopilot says it."""
        words = craft.condition.gps
        status = NO_FIX if words.startswith("no") else HAS_FIX
        status = AUGMENTED if "RTK" in words or "DGPS" in words else status
        return self._fix(FIX.kind, stamp_ns, self.body, status, fix, [0.0] * 9, COVARIANCE_UNKNOWN)

    def pose(self, craft: Craft, stamp_ns: int) -> bytes:
        """Return place and heading of the vehicle."""
        return self._encode(POSE.kind, self._pose_stamped(*_placed(craft), stamp_ns))

    def transform(self, craft: Craft, stamp_ns: int) -> bytes:
        """Return where the vehicle's frame is in its map."""
        return self._transform(stamp_ns, self.map, self.body, *_placed(craft))

    def earth(self, home: Fix, stamp_ns: int) -> bytes:
        """Return where the vehicle's map is on the earth."""
        return self._transform(stamp_ns, EARTH, self.map, *map_in_earth(home))

    def gas(self, gas: float, stamp_ns: int) -> bytes:
        """Return a gas reading, at the vehicle."""
        return self._encode(GAS.kind, self._make(GAS.kind, self._header(stamp_ns, self.body), gas, 0.0))

    def wind(self, whence: Point, stamp_ns: int) -> bytes:
        """Return the velocity of the air. whence: the wind as readings have it, where it comes from, m/s."""
        air = self._make(VECTOR, -whence[0], -whence[1], 0.0)
        return self._encode(WIND.kind, self._make(WIND.kind, self._header(stamp_ns, self.map), air))

    def track(self, places: Sequence[tuple[Place, int]], stamp_ns: int) -> bytes:
        """Return places with the stamps at which readings were taken there."""
        poses = [self._pose_stamped(place, LEVEL, taken_ns) for place, taken_ns in places]
        return self._encode(TRACK.kind, self._make(TRACK.kind, self._header(stamp_ns, self.map), poses))

    # ---- the source ----

    def source(self, source: SourceClaim, stamp_ns: int) -> bytes:
        """Return the position of the source. Its orientation is the map's: its covariance is left at 0."""
        (xx, xy, yy), covariance = source.covariance, np.zeros(36)
        covariance[[0, 1, 6, 7, 14]] = xx, xy, xy, yy, source.height_variance
        posed = self._make(
            "geometry_msgs/msg/PoseWithCovariance", self._pose(source.place, LEVEL), covariance
        )
        return self._encode(ESTIMATE.kind, self._make(ESTIMATE.kind, self._header(stamp_ns, self.map), posed))

    def source_fix(self, source: SourceClaim, home: Fix, stamp_ns: int) -> bytes:
        """Return the position of the source on the earth."""
        (east, north, up), (xx, xy, yy) = source.place, source.covariance
        fix = *to_global(home[0], home[1], north, east), home[2] + up
        covariance = [xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, source.height_variance]
        return self._fix(ESTIMATE_FIX.kind, stamp_ns, self.map, HAS_FIX, fix, covariance, COVARIANCE_KNOWN)

    def cloud(self, said: Belief, rows: Floats, stamp_ns: int) -> bytes:
        """Return the particles of a belief. rows: (N, unknowns and weight)."""
        known = {"x": said.mean[0], "y": said.mean[1], "z": said.z}
        others = [name for name in said.unknowns if name not in known]
        names = [*known, *others, "weight"]
        points = np.empty((len(rows), len(names)), "<f4")
        for column, name in enumerate(names[:-1]):
            unknown = name in said.unknowns
            points[:, column] = rows[:, said.unknowns.index(name)] if unknown else known[name]
        points[:, -1] = rows[:, -1]
        fields = [
            self._make("sensor_msgs/msg/PointField", name.replace("-", "_"), 4 * column, FLOAT32, 1)
            for column, name in enumerate(names)
        ]
        step, data = 4 * len(names), points.view(np.uint8).reshape(-1)
        cloud = self._make(
            BELIEF.kind,
            self._header(stamp_ns, self.map),
            1,
            len(points),
            fields,
            False,
            step,
            step * len(points),
            data,
            True,
        )
        return self._encode(BELIEF.kind, cloud)

    # ---- the mission ----

    def state(self, words: str) -> bytes:
        """Return what the vehicle is doing."""
        return self._encode(STATE.kind, self._make(STATE.kind, words))

    def clock(self, stamp_ns: int) -> bytes:
        """Return the time of the mission."""
        return self._encode(CLOCK.kind, self._make(CLOCK.kind, self._time(stamp_ns)))

    # ---- parts of messages ----

    def _time(self, stamp_ns: int) -> Any:
        return self._make(TIME, *divmod(stamp_ns, 10**9))

    def _header(self, stamp_ns: int, frame: str) -> Any:
        return self._make(HEADER, self._time(stamp_ns), frame)

    def _pose(self, place: Place, turn: Turn) -> Any:
        return self._make(
            "geometry_msgs/msg/Pose",
            self._make("geometry_msgs/msg/Point", *place),
            self._make(QUATERNION, *turn),
        )

    def _pose_stamped(self, place: Place, turn: Turn, stamp_ns: int) -> Any:
        return self._make(POSE.kind, self._header(stamp_ns, self.map), self._pose(place, turn))

    def _fix(
        self,
        kind: str,
        stamp_ns: int,
        frame: str,
        status: int,
        fix: Fix,
        covariance: Sequence[float],
        covariance_type: int,
    ) -> bytes:
        said = self._make("sensor_msgs/msg/NavSatStatus", status, 0)  # MAVLink does not tell which satellites
        message = self._make(
            kind, self._header(stamp_ns, frame), said, *fix, np.array(covariance), covariance_type
        )
        return self._encode(kind, message)

    def _transform(self, stamp_ns: int, parent: str, child: str, place: Place, turn: Turn) -> bytes:
        moved = self._make(TRANSFORM, self._make(VECTOR, *place), self._make(QUATERNION, *turn))
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped", self._header(stamp_ns, parent), child, moved
        )
        return self._encode(TF.kind, self._make(TF.kind, [stamped]))


def _placed(craft: Craft) -> tuple[Place, Turn]:
    heading = craft.heading if math.isfinite(craft.heading) else 0.0
    return (*craft.position, craft.altitude_m), about_up(heading)
