"""The bus contract: one table of keys. Publishers, subscribers and docs/bus.md are made from it."""

from dataclasses import dataclass

from link.access.roles import AGENT, BRIDGE, ESTIMATOR, EVERYBODY, OPERATOR, PAYLOAD, ROS2, VEHICLE
from link.bus.messages import Belief, Departure, Health, Join, Latecomer, LeaveOut, Stop

FRAMES = "MAVLink 2 frames"
OF_VEHICLE = "uav/"  # the keys of a vehicle of a search begin with it, and with the vehicle's number
OF_A_VEHICLE = frozenset({"uav", "payload"})  # the services of which each vehicle of a search has its own
MIB = 2**20


@dataclass(frozen=True)
class Delivery:
    """How the messages of a key are delivered."""

    reliable: bool = True
    blocking: bool = False  # under congestion the publisher waits; if False, the message is dropped
    realtime: bool = False  # overtakes waiting messages of lower priority
    express: bool = False  # sent at once, never batched with later messages
    kept: int = 0  # the publisher keeps this many messages for late and returning subscribers
    # It keeps this many for subscribers that find a gap, such as those whose link was down. Late ones do not
    # get them.
    recovered: int = 0


@dataclass(frozen=True)
class Key:
    """One row of the contract. `name` is relative to the vehicle's namespace (`uav/<id>`).

    In the namespace of a search (`search/<id>`) each vehicle has its own keys below `uav/<number>`.
    """

    name: str
    payload: type | str
    source: str
    target: str
    delivery: Delivery
    rate: str
    meaning: str
    # The roles that may publish it and receive it, with --secure; operators and observers always receive it.
    writers: tuple[str, ...] = ()
    readers: tuple[str, ...] = ()
    most_mib: int = 1  # most MiB of a message and its attachment: the router drops a larger one
    own: bool = False  # whether each vehicle of a search has its own; else the search has one

    def named(self, service: str = "*", vehicle: int | None = None) -> str:
        """Return its name with a service in it; `*`: all of them.  vehicle: whose it is in a search."""
        name = self.name.replace("<service>", service)
        return name if vehicle is None else f"{OF_VEHICLE}{vehicle}/{name}"


def vehicle_of(name: object) -> str:
    """Return the number of the vehicle of a search whose key this is; empty if it is nobody's own."""
    number, _, rest = str(name).removeprefix(OF_VEHICLE).partition("/")
    return number if rest and str(name).startswith(OF_VEHICLE) and number.isdecimal() else ""


def row_name(name: str) -> str:
    """Return the name of a key without the vehicle of a search whose it is."""
    return name.removeprefix(f"{OF_VEHICLE}{number}/") if (number := vehicle_of(name)) else name


MAVLINK_OUT = Key(
    "mavlink/out",
    FRAMES,
    "vehicle",
    "bridges, viewers, logs",
    Delivery(reliable=False),
    "PX4's onboard rates",
    "All MAVLink output of the vehicle. Newest wins: frames are dropped rather than queued for a slow "
    "reader. So may be a command's "
    "acknowledgement: send the command again until one comes, or until HEARTBEAT shows its mode. A bridge "
    "may bring other systems; the "
    "vehicle is the one that `health/uav` tells. Of a real vehicle these are its autopilot's own frames, "
    "unchanged, RADIO_STATUS of the radio on its link, and, as component 191, those of its search.",
    writers=(VEHICLE, BRIDGE),
    readers=(BRIDGE, ROS2),
    own=True,
)
MAVLINK_IN = Key(
    "mavlink/in",
    FRAMES,
    "operator, GCS bridge",
    "vehicle",
    Delivery(blocking=True, express=True),
    "as they come",
    "Commands to the vehicle, and setpoints of whoever flies it in the search's place. A bridge passes "
    "MAVLink 1 frames as they are. "
    "A real vehicle's autopilot gets them unchanged; commands to component 191 are for its search.",
    writers=(BRIDGE, OPERATOR, ROS2),
    readers=(VEHICLE, BRIDGE),
    own=True,
)
WAYPOINT = Key(
    "waypoint",
    FRAMES,
    "agent",
    "vehicle",
    Delivery(blocking=True, express=True),
    "1 per belief",
    "The answer to a reading: one SET_POSITION_TARGET_LOCAL_NED with the reading's time_boot_ms. All else on "
    "this key is refused, and "
    "nothing on another key answers a reading. In a search, one such frame for each vehicle.",
    writers=(AGENT,),
    readers=(VEHICLE,),
)
READING = Key(
    "reading",
    FRAMES,
    "vehicle",
    "estimator",
    Delivery(blocking=True, express=True, kept=100_000),
    "1 per waypoint; repeated while unanswered",
    "One sample: LOCAL_POSITION_NED, WIND_COV, NAMED_VALUE_FLOAT `gas`, with one time_boot_ms, of a real "
    "vehicle the autopilot's. All readings are kept for late joiners.",
    writers=(VEHICLE,),
    readers=(ESTIMATOR, ROS2),
    own=True,
)
PAYLOAD_IN = Key(
    "payload/in",
    FRAMES,
    "vehicle",
    "payload",
    Delivery(blocking=True, express=True),
    "1 per waypoint; repeated while unanswered",
    "Of a real autopilot only: measure here, now. LOCAL_POSITION_NED, WIND_COV if the autopilot reports a "
    "wind, and NAMED_VALUE_INT "
    "`sample`, the number of the reading, with one time_boot_ms.",
    writers=(VEHICLE,),
    readers=(PAYLOAD,),
    own=True,
)
PAYLOAD_OUT = Key(
    "payload/out",
    FRAMES,
    "payload",
    "vehicle",
    Delivery(blocking=True, express=True),
    "1 per question",
    "The answer, with the question's time_boot_ms: NAMED_VALUE_FLOAT `gas`, NaN for no value, and WIND_COV "
    "if the payload knows the wind.",
    writers=(PAYLOAD,),
    readers=(VEHICLE,),
    own=True,
)
BELIEF = Key(
    "belief",
    Belief,
    "estimator",
    "agent, viewers",
    Delivery(express=True, kept=1, recovered=32),
    "1 per reading",
    "The belief after a reading; the attachment is the particle array. A subscriber needs only the newest.",
    writers=(ESTIMATOR,),
    readers=(AGENT, VEHICLE, ROS2),
    most_mib=64,
)
STOP = Key(
    "agdc/stop",
    Stop,
    "estimator",
    "all",
    Delivery(blocking=True, realtime=True, express=True, kept=1),
    "once per mission",
    "The search has ceased. Kept for late joiners.",
    writers=(ESTIMATOR,),
    readers=(VEHICLE, AGENT, PAYLOAD, BRIDGE, ROS2),
)
DEPARTURE = Key(
    "departure",
    Departure,
    "estimator",
    "all",
    Delivery(blocking=True, express=True, kept=8),
    "once per vehicle that leaves",
    "In a search by several only: a vehicle has left it. The attachment is the frames of its readings that "
    "count, in their order, if they have at most 1,000,000 bytes. The agent says it again on the same key, "
    "so that an estimator that starts again learns of it.",
    writers=(ESTIMATOR, AGENT),
    readers=(ESTIMATOR, AGENT, VEHICLE),
)
LEAVE_OUT = Key(
    "leave-out",
    LeaveOut,
    "operator",
    "estimator",
    Delivery(blocking=True, express=True, kept=8),
    "as they come",
    "In a search by several only: an order to let a vehicle leave it, or to begin without one that comes "
    "late. The estimator answers with its departure, or that it comes late.",
    writers=(OPERATOR,),
    readers=(ESTIMATOR,),
)
JOIN = Key(
    "join",
    Join,
    "vehicle",
    "estimator",
    Delivery(blocking=True, express=True),
    "4 per second until it takes part",
    "In a search by several only: a vehicle that comes late asks for its part in it. The estimator answers "
    "that it comes late: first where it takes off, then the round from which on it takes part.",
    writers=(VEHICLE,),
    readers=(ESTIMATOR,),
    own=True,
)
LATECOMER = Key(
    "latecomer",
    Latecomer,
    "estimator",
    "all",
    Delivery(blocking=True, express=True, kept=24),
    "3 per vehicle that comes late",
    "In a search by several only: a vehicle comes late. The others begin without it, keep clear of where it "
    "takes off, and wait for it from its round on. The agent says it again on the same key, so that an "
    "estimator that starts again learns of it.",
    writers=(ESTIMATOR, AGENT),
    readers=(ESTIMATOR, AGENT, VEHICLE),
)
HEALTH = Key(
    "health/<service>",
    Health,
    "all",
    "all",
    Delivery(kept=1),
    "1 per step, at least 1 per second",
    "The status of a service. A liveliness token on the same key shows that its process is running.",
    writers=EVERYBODY,
    readers=EVERYBODY,
)

KEYS = (
    *(MAVLINK_OUT, MAVLINK_IN, WAYPOINT, READING, PAYLOAD_IN, PAYLOAD_OUT),
    *(BELIEF, STOP, DEPARTURE, LEAVE_OUT, JOIN, LATECOMER, HEALTH),
)

SEARCHERS = frozenset({"estimator", "agent"})  # the search begins when these services have joined the bus
# First and longest real time after which an unanswered reading is sent again; it doubles each time.
RESEND_FIRST_S, RESEND_LAST_S = 0.25, 2.0
