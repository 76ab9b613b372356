"""The bus contract: one table of keys, from which publishers, subscribers and docs/bus.md are made."""

from dataclasses import dataclass

from link.bus.messages import Belief, Health, Stop

FRAMES = "MAVLink 2 frames"


@dataclass(frozen=True)
class Delivery:
    """How messages of a key travel."""

    reliable: bool = True
    blocking: bool = False
    """Under congestion the publisher waits; otherwise the message is dropped."""
    realtime: bool = False
    """Overtakes all that waits with a lower priority."""
    express: bool = False
    """Sent at once, never batched with later messages."""
    kept: int = 0
    """The publisher keeps this many messages for those who subscribe late or come back."""


@dataclass(frozen=True)
class Key:
    """One row of the contract. `name` is relative to the vehicle's namespace (`uav/<id>`)."""

    name: str
    payload: type | str
    source: str
    target: str
    delivery: Delivery
    rate: str
    meaning: str


MAVLINK_OUT = Key(
    "mavlink/out", FRAMES, "vehicle", "bridges, viewers, logs",
    Delivery(reliable=False),
    "PX4's onboard rates",
    "All that the vehicle says. Newest wins: frames are dropped rather than queued for a slow reader.",
)  # fmt: skip
MAVLINK_IN = Key(
    "mavlink/in", FRAMES, "agent, GCS bridge", "vehicle",
    Delivery(blocking=True, express=True),
    "1 a belief; commands as they come",
    "Waypoints (SET_POSITION_TARGET_LOCAL_NED) and commands to the vehicle.",
)  # fmt: skip
READING = Key(
    "reading", FRAMES, "vehicle", "estimator",
    Delivery(blocking=True, express=True, kept=100_000),
    "1 a waypoint; again while unanswered",
    "One sample: LOCAL_POSITION_NED, WIND_COV, NAMED_VALUE_FLOAT `gas`, of one time_boot_ms. All of them are kept for late joiners.",
)  # fmt: skip
BELIEF = Key(
    "belief", Belief, "estimator", "agent, viewers",
    Delivery(express=True, kept=1),
    "1 a reading",
    "What is believed after a reading; the attachment is the particle array. A reader needs only the newest.",
)  # fmt: skip
STOP = Key(
    "agdc/stop", Stop, "estimator", "all",
    Delivery(blocking=True, realtime=True, express=True, kept=1),
    "once a mission",
    "The search has ceased. Kept for late joiners.",
)  # fmt: skip
HEALTH = Key(
    "health/<service>", Health, "all", "all",
    Delivery(kept=1),
    "1 a step, 1 a second at least",
    "How a service is doing. A liveliness token on the same key says that its process is there.",
)  # fmt: skip

KEYS = (MAVLINK_OUT, MAVLINK_IN, READING, BELIEF, STOP, HEALTH)

SEARCHERS = frozenset({"estimator", "agent"})
"""The search begins when these services are there."""
RESEND_FIRST_S, RESEND_LAST_S = 0.25, 2.0
"""Real time after which an unanswered reading is sent again; doubled each time."""
