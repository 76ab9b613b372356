"""rmw_zenoh's rules: by which keys, tokens and attachments ROS 2 nodes find and hear each other on Zenoh.

Source: `docs/design.md` of https://github.com/ros2/rmw_zenoh, and of `rmw_zenoh_cpp/src/detail`
`liveliness_utils.cpp`, `attachment_helpers.cpp`, `rmw_publisher_data.cpp` and `rmw_subscription_data.cpp`.
"""

import struct
from dataclasses import dataclass
from typing import Any, NamedTuple

import xxhash
import zenoh
import zenoh.ext

from link.access.roles import ROS_TOKENS

USUAL_DEPTH = 42  # the depth that tokens leave out
GID_BYTES = 16
HEAD = struct.Struct("<qqB")  # of an attachment: sequence number, time of publishing in ns, length of the gid
ATTACHMENT_BYTES = HEAD.size + GID_BYTES
HEARTBEAT_S = 0.5  # how often a latched topic says which message was its last, if that has changed
PUBLISHER, SUBSCRIPTION = "MP", "MS"  # kinds of entities, as tokens name them


@dataclass(frozen=True)
class Qos:
    """A topic's quality of service. History is KEEP_LAST, all else is ROS's default."""

    depth: int = 10
    reliable: bool = True
    latched: bool = False  # TRANSIENT_LOCAL: late subscriptions get the last `depth` messages

    def encoded(self) -> str:
        """Return it as the last part of a token, which leaves out rmw_zenoh's defaults.

        Its parts are reliability, durability, history and depth, deadline, lifespan, and liveliness.
        """
        reliability = "" if self.reliable else "2"
        durability = "1" if self.latched else ""
        depth = "" if self.depth == USUAL_DEPTH else str(self.depth)
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


class Node(NamedTuple):
    """A node of the ROS graph. Its namespace is absolute, such as `/uav_1`."""

    domain: int
    namespace: str
    name: str

    def absolute(self, topic: str) -> str:
        """Return a topic's full name; one with a leading slash has it already."""
        return topic if topic.startswith("/") else f"{self.namespace}/{topic}"


def dds_name(kind: str) -> str:
    """Return the name in keys of a type: `std_msgs::msg::dds_::String_` of `std_msgs/msg/String`."""
    package, folder, name = kind.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def topic_key(domain: int, topic: str, kind: str, type_hash: str) -> str:
    """Return the key that the messages of a topic are published on."""
    return f"{domain}/{topic.strip('/')}/{dds_name(kind)}/{type_hash}"


def node_token(node: Node, zid: str) -> str:
    """Return the key of the token that shows a node. zid: the session's id."""
    return f"{ROS_TOKENS}/{node.domain}/{zid}/0/0/NN/%/{_mangled(node.namespace)}/{node.name}"


def topic_token(
    node: Node, zid: str, number: int, entity: str, topic: str, kind: str, type_hash: str, qos: Qos
) -> str:
    """Return the key of the token of a publisher or a subscription. number: its own in the session."""
    who = f"{ROS_TOKENS}/{node.domain}/{zid}/0/{number}/{entity}/%/{_mangled(node.namespace)}/{node.name}"
    return f"{who}/{_mangled(node.absolute(topic))}/{dds_name(kind)}/{type_hash}/{qos.encoded()}"


def publishers_of(domain: int, topic: str) -> str:
    """Return the key expression of the tokens of all publishers of a topic, by its absolute name."""
    return f"{ROS_TOKENS}/{domain}/*/*/*/{PUBLISHER}/*/*/*/{_mangled(topic)}/**"


def session_of(token: str) -> str:
    """Return the id of the session that a token is of."""
    return token.split("/")[2]


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def gid(token: str) -> bytes:
    """Return the id of an entity: XXH3-128 of its token, the low half first, each little-endian."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(GID_BYTES, "little")


def attachment(sequence: int, time_ns: int, of: bytes) -> bytes:
    """Return what goes with a message; without it ROS drops the message.

    sequence: counts a publisher's messages from 1; time_ns: of publishing, since the Unix epoch; of: the
    publisher's gid.
    """
    return HEAD.pack(sequence, time_ns, GID_BYTES) + of


def is_attachment(data: bytes) -> bool:
    """Whether a message came with what ROS attaches."""
    return len(data) == ATTACHMENT_BYTES and data[HEAD.size - 1] == GID_BYTES


def declare_publisher(session: zenoh.Session, key: str, qos: Qos) -> Any:
    """Return a publisher of a topic; a latched one has a cache that rmw_zenoh's subscriptions ask."""
    options: dict[str, Any] = {
        "encoding": zenoh.Encoding.APPLICATION_CDR,
        "reliability": zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT,
        "congestion_control": zenoh.CongestionControl.DROP,
    }
    if not qos.latched:
        return session.declare_publisher(key, **options)
    return zenoh.ext.declare_advanced_publisher(
        session,
        key,
        cache=zenoh.ext.CacheConfig(max_samples=qos.depth),
        publisher_detection=True,
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S),
        **options,
    )
