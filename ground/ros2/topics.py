"""The topics: one table of what is published and what may be commanded. docs/ros2.md shows it."""

from dataclasses import dataclass

from ground.ros2.rmw import Qos

LATCHED = Qos(depth=1, latched=True)
POSES_PER_S = 10  # most poses of the vehicle in a second of the stamps


@dataclass(frozen=True)
class Topic:
    """A topic. Its name is within the vehicle's ROS namespace; with a leading slash it is everyone's."""

    name: str
    kind: str  # its type: `sensor_msgs/msg/NavSatFix`
    qos: Qos
    rate: str
    meaning: str


FIX = Topic(
    "fix",
    "sensor_msgs/msg/NavSatFix",
    Qos(),
    f"at most {POSES_PER_S} Hz",
    "where the vehicle is, as its autopilot says; its accuracy is not told (covariance type 0)",
)
POSE = Topic(
    "pose",
    "geometry_msgs/msg/PoseStamped",
    Qos(),
    f"at most {POSES_PER_S} Hz",
    "place and heading of the vehicle; roll and pitch are left out",
)
ESTIMATE = Topic(
    "estimate",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    LATCHED,
    "each belief",
    "the estimated position of the source, and its covariance, m²",
)
ESTIMATE_FIX = Topic(
    "estimate_fix",
    "sensor_msgs/msg/NavSatFix",
    LATCHED,
    "each belief",
    "the same in WGS84, covariance east, north, up, m²; none before the vehicle has told its home",
)
BELIEF = Topic(
    "belief",
    "sensor_msgs/msg/PointCloud2",
    LATCHED,
    "each belief",
    "the particles, float32: x, y, z, each other unknown by its name, with _ for -, and weight",
)
GAS = Topic(
    "gas",
    "sensor_msgs/msg/Illuminance",
    Qos(),
    "each reading",
    "`illuminance` is the gas reading, g/m³ or a count of hits; `variance` 0: not told",
)
WIND = Topic(
    "wind",
    "geometry_msgs/msg/Vector3Stamped",
    Qos(),
    "each reading",
    "the air's velocity as measured, m/s: where the wind goes, not where it comes from",
)
TRACK = Topic(
    "track",
    "nav_msgs/msg/Path",
    LATCHED,
    "each reading",
    "where readings were taken, the newest 1,000, each pose with its own stamp",
)
STOP = Topic(
    "stop",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    LATCHED,
    "once per mission",
    "the search has ceased: the claimed position of the source",
)
STATE = Topic(
    "state",
    "std_msgs/msg/String",
    LATCHED,
    "each change",
    "standby, taking off, searching, paused, returning, holding or landed",
)
TF = Topic("/tf", "tf2_msgs/msg/TFMessage", Qos(depth=100), f"at most {POSES_PER_S} Hz", "map → base_link")
TF_STATIC = Topic(
    "/tf_static",
    "tf2_msgs/msg/TFMessage",
    LATCHED,
    "each change of home",
    "earth (ECEF) → map, which joins several vehicles",
)
CLOCK = Topic(
    "/clock",
    "rosgraph_msgs/msg/Clock",
    Qos(depth=1, reliable=False),
    f"{POSES_PER_S} a simulated second",
    "the time of the mission; simulations only",
)
PUBLISHED = (FIX, POSE, ESTIMATE, ESTIMATE_FIX, BELIEF, GAS, WIND, TRACK, STOP, STATE, TF, TF_STATIC, CLOCK)
OF_A_MISSION = (ESTIMATE, ESTIMATE_FIX, BELIEF, TRACK, STOP)  # latched, until the next mission begins

GOAL = Topic(
    "goal_pose",
    "geometry_msgs/msg/PoseStamped",
    Qos(),
    "as they come",
    "flies there and holds: x east, y north, z up from home, m; z = 0 keeps the height, and the heading "
    "stays",
)
PAUSE = Topic(
    "pause",
    "std_msgs/msg/Bool",
    Qos(),
    "as they come",
    "true: holds; false: gives the vehicle back to the search",
)
ABORT = Topic("abort", "std_msgs/msg/Empty", Qos(), "as they come", "flies home and lands")
COMMANDS = (GOAL, PAUSE, ABORT)
