"""Protects rmw_zenoh's rules to the byte: keys, tokens, attachments, CDR and the hashes of types.

The tokens are the examples of rmw_zenoh's docs/design.md. The hashes are those that ROS 2 itself prints
(`ros2 topic info --verbose`) and that packages of others carry.
"""

import struct
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ground.ros2 import rmw
from ground.ros2.command import DISTRIBUTIONS
from ground.ros2.messages import Messages
from ground.ros2.rmw import Node, Qos
from ground.ros2.topics import COMMANDS, PUBLISHED
from ground.ros2.wire import MOST_BYTES, NO_HASH, BadMessage, Wire
from link.access.roles import ROS_COMMANDS, ros_namespace
from scene.scene import Condition, Craft

STRING = "std_msgs/msg/String"
HASHES = {
    STRING: "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "sensor_msgs/msg/NavSatFix": "62223ab3fe210a15976021da7afddc9e200dc9ec75231c1b6a557fc598a65404",
    "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "sensor_msgs/msg/Illuminance": "b954b25f452fcf81a91c9c2a7e3b3fd85c4c873d452aecb3cfd8fd1da732a22d",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    "geometry_msgs/msg/Vector3Stamped": "d4829622288cbb443886e7ea94ea5671a3b1be6bab4ad04224432a65f7d7887a",
    "nav_msgs/msg/Path": "1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "rosgraph_msgs/msg/Clock": "692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564",
}
ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def wire() -> Wire:
    return Wire("jazzy")


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_the_hashes_of_types_are_those_of_ros_and_humble_has_none(distribution: str) -> None:
    types = Wire(distribution)
    for kind, digest in HASHES.items():
        assert types.hash_of(kind) == (NO_HASH if distribution == "humble" else f"RIHS01_{digest}")


def test_a_node_and_its_subscription_have_the_tokens_of_the_design_document(wire: Wire) -> None:
    node, session = Node(2, "/", "listener"), "aac3178e146ba6f1fc6e6a4085e77f21"
    assert rmw.node_token(node, session) == f"@ros2_lv/2/{session}/0/0/NN/%/%/listener"
    token = rmw.topic_token(node, session, 10, "MS", "/chatter", STRING, wire.hash_of(STRING), Qos())
    assert token == (
        f"@ros2_lv/2/{session}/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/"
        f"RIHS01_{HASHES[STRING]}/::,10:,:,:,,"
    )
    assert rmw.session_of(token) == session


def test_a_publisher_s_name_lies_in_its_namespace_unless_it_begins_with_a_slash() -> None:
    node = Node(0, "/uav_1", "plumeward")
    tokens = [rmw.topic_token(node, "a", 1, "MP", name, STRING, "h", Qos()) for name in ("state", "/tf")]
    assert [token.split("/")[7:10] for token in tokens] == [
        ["%uav_1", "plumeward", "%uav_1%state"],
        ["%uav_1", "plumeward", "%tf"],
    ]


def test_a_key_has_domain_topic_type_and_hash() -> None:
    key = rmw.topic_key(7, "/uav_1/state", STRING, "RIHS01_00")
    assert key == "7/uav_1/state/std_msgs::msg::dds_::String_/RIHS01_00"


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (Qos(), "::,10:,:,:,,"),
        (Qos(depth=42), "::,:,:,:,,"),
        (Qos(depth=1, latched=True), ":1:,1:,:,:,,"),
        (Qos(depth=1, reliable=False), "2::,1:,:,:,,"),
    ],
)
def test_a_token_says_of_the_quality_of_service_what_differs_from_the_usual(qos: Qos, text: str) -> None:
    assert qos.encoded() == text


def test_a_gid_is_the_hash_of_the_token_with_its_low_half_first() -> None:
    # XXH3-128 of nothing, from xxHash's own test vectors: 99aa06d3014798d8 6001c324468d497f
    assert rmw.gid("").hex() == "7f498d4624c30160" + "d8984701d306aa99"


def test_an_attachment_is_sequence_time_length_and_gid_in_33_bytes() -> None:
    data = rmw.attachment(1, 2**40, bytes(range(16)))
    assert data == bytes([1] + [0] * 7 + [0, 0, 0, 0, 0, 1, 0, 0] + [16]) + bytes(range(16))
    assert len(data) == 33
    assert rmw.is_attachment(data)
    assert not rmw.is_attachment(data[:-1])
    assert not rmw.is_attachment(b"")


def test_a_fix_has_the_bytes_that_its_definition_gives(wire: Wire) -> None:
    craft = Craft(0.0, (1.0, 2.0), 5.0, condition=Condition(gps="3-D fix, 10 satellites"))
    said = Messages(wire, "uav_1").fix(craft, (47.5, 8.25, 493.0), 1_500_000_000)
    by_hand = b"".join(
        [
            bytes.fromhex("00010000"),  # CDR, little-endian, no options; offsets count from here
            struct.pack("<iI", 1, 500_000_000),  # header.stamp
            struct.pack("<I", 16) + b"uav_1/base_link\0",  # header.frame_id: 15 characters and a zero
            struct.pack("<b", 0),  # status.status, at 28
            b"\0" + struct.pack("<H", 0),  # status.service, at 30
            struct.pack("<3d", 47.5, 8.25, 493.0),  # at 32, a multiple of 8
            bytes(9 * 8),  # position_covariance
            b"\0",  # position_covariance_type: unknown
        ]
    )
    assert said == by_hand


def test_a_track_ends_with_its_last_pose(wire: Wire) -> None:
    said = Messages(wire, "uav_1").track([((1.0, 2.0, 3.0), 0), ((4.0, 5.0, 6.0), 7)], 7)
    assert said.endswith(struct.pack("<7d", 4.0, 5.0, 6.0, 0.0, 0.0, 0.0, 1.0))
    assert struct.pack("<2I", 2, 0) in said  # two poses, the first at 0 s


def test_a_belief_s_cloud_has_the_rows_of_its_particles_as_they_are(wire: Wire) -> None:
    rows = np.array([[1.0, 2.0, 100.0, 0.25], [3.0, 4.0, 200.0, 0.75]], np.float32)
    said = SimpleNamespace(mean=(0.0, 0.0), z=1.5, unknowns=("x", "y", "wind-speed"))
    cloud = Messages(wire, "uav_1").cloud(said, rows, 0)  # type: ignore[arg-type]
    points = struct.pack("<10f", 1.0, 2.0, 1.5, 100.0, 0.25, 3.0, 4.0, 1.5, 200.0, 0.75)
    assert cloud.endswith(struct.pack("<3I", 20, 40, 40) + points + b"\1")  # step, row, bytes; dense
    assert b"wind_speed\0" in cloud


@pytest.mark.parametrize(
    "data", [b"", b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 40, b"\0\1\0\0" + bytes(MOST_BYTES)]
)
def test_bytes_that_are_no_message_are_refused(wire: Wire, data: bytes) -> None:
    for topic in COMMANDS[:1]:
        with pytest.raises(BadMessage):
            wire.decode(topic.kind, data)


@pytest.mark.parametrize(
    ("vehicle", "name"),
    [("uav/1", "/uav_1"), ("site-2/uav/11", "/site_2_uav_11"), ("1", "/vehicle_1"), ("a__b/", "/a_b")],
)
def test_a_vehicle_s_namespace_becomes_a_name_that_ros_allows(vehicle: str, name: str) -> None:
    assert ros_namespace(vehicle) == name


def test_the_router_s_rules_name_the_commands_of_the_table() -> None:
    assert tuple(topic.name for topic in COMMANDS) == ROS_COMMANDS


def test_the_page_has_the_topics_of_the_table() -> None:
    page = (ROOT / "docs" / "ros2.md").read_text()
    for topic in PUBLISHED:
        kind = topic.kind.replace("/msg/", "/") + ", latched" * topic.qos.latched
        assert f"| `{topic.name}` | {kind} | {topic.rate} | {topic.meaning} |\n" in page
    for topic in COMMANDS:
        assert f"| `{topic.name}` | {topic.kind.replace('/msg/', '/')} | {topic.meaning} |\n" in page
    assert page.count("\n| `") == len(PUBLISHED) + len(COMMANDS)


def test_the_extra_has_what_the_refusal_names() -> None:
    extra = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]["ros2"]
    assert {each.partition(">")[0] for each in extra} == {"rosbags", "xxhash"}
