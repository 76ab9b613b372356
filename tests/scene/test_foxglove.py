"""Protects the scene's messages for viewers: official schemas, hand-worked values, and nothing said twice."""

import math
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from scene.foxglove import LONGEST_PATH, Encoded, SceneEncoder, schema_of
from scene.scene import (
    STOPPED,
    WARNING,
    Backdrop,
    Condition,
    Craft,
    Happening,
    Measurement,
    Release,
    Scatter,
    Scene,
)

STAMP_NS = 1_763_800_000_123_456_789
METRE_DEG = 180.0 / (math.pi * 6_371_000.0)
"""Degrees of latitude of a metre."""
RELEASE = Release((15.0, 20.0), (2.0, 0.0), 10.0, 1.0, 10.0)
FIRST = Measurement(0, 10.0, (3.0, 4.0), 0.5, 2.0, (12.0, 9.0), (3.0, 1.0, 3.0))
"""Its covariance has the eigenvalues 4 along (1, 1) and 2 along (1, -1)."""
SCENE = Scene(
    Backdrop("uav/1", release=RELEASE),
    time_s=10.0,
    craft=Craft(
        10.0,
        (3.0, 4.0),
        5.0,
        heading=math.pi / 2,
        fix=(60.0 + 4.0 * METRE_DEG, 10.0 + 6.0 * METRE_DEG, 105.0),
    ),
    measurements=(FIRST,),
    scatter=Scatter(np.array([[1.5, 2.5], [3.0, -4.0]], np.float32), np.array([0.25, 0.75], np.float32)),
    waypoint=(4.0, 4.0),
    wind=(0.0, 3.0),
    happenings=(
        Happening(9.0, WARNING, "estimator", "odd readings"),
        Happening(10.0, STOPPED, "estimator", "source found"),
    ),
)
ALL = {
    "transforms",
    "vehicle",
    "area",
    "path",
    "readings",
    "wind",
    "state",
    "particles",
    "estimate",
    "waypoint",
    "fix/vehicle",
    "fix/estimate",
    "log",
    "source",
    "plume",
}


def decoded(messages: list[Encoded]) -> dict[str, Any]:
    """The messages by topic, each decoded with nothing but the schema that would stand in a record; of
    several the last.
    """
    return {topic.removeprefix("scene/"): decode(kind, data) for topic, kind, data in messages}


def decode(kind: Any, data: bytes) -> Any:
    name, schema = schema_of(kind)
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(schema).file:
        pool.Add(file)  # raises if a file comes before one that it needs
    return GetMessageClass(pool.FindMessageTypeByName(name)).FromString(data)


@pytest.fixture
def said() -> dict[str, Any]:
    return decoded(SceneEncoder().encode(SCENE, STAMP_NS))


def test_the_first_scene_says_all_there_is_to_see(said: dict[str, Any]) -> None:
    assert set(said) == ALL
    for topic in ALL - {"transforms", "vehicle", "area", "estimate", "waypoint", "source", "wind"}:
        assert said[topic].timestamp.ToNanoseconds() == STAMP_NS, topic
    for topic in ("vehicle", "area", "estimate", "waypoint", "source"):
        assert {entity.timestamp.ToNanoseconds() for entity in said[topic].entities} == {STAMP_NS}, topic
        assert all(entity.id and entity.frame_id for entity in said[topic].entities)


def test_the_schemas_are_the_official_ones() -> None:
    from foxglove import messages

    for _, kind, _ in SceneEncoder().encode(SCENE, STAMP_NS):
        name, schema = schema_of(kind)
        official = getattr(messages, kind.DESCRIPTOR.name).get_schema()
        assert (name, "protobuf") == (official.name, official.encoding)
        assert files(schema) == files(official.data), name


def files(schema: bytes) -> dict[str, FileDescriptorProto]:
    """The files of a schema, without the names of their fields in JSON, which follow from the fields' own
    and may be left out.
    """
    described = FileDescriptorSet.FromString(schema)
    for file in described.file:
        for message in file.message_type:
            for part in (message, *message.nested_type):
                for field in part.field:
                    field.ClearField("json_name")
    return {file.name: file for file in described.file}


def test_the_vehicle_stands_where_it_is_and_looks_where_it_heads(said: dict[str, Any]) -> None:
    (transform,) = said["transforms"].transforms
    assert (transform.parent_frame_id, transform.child_frame_id) == ("map", "vehicle")
    assert transform.timestamp.ToNanoseconds() == STAMP_NS
    assert (transform.translation.x, transform.translation.y, transform.translation.z) == (3.0, 4.0, 5.0)
    half = math.sqrt(0.5)  # a quarter turn: sin and cos of 45°
    assert (transform.rotation.x, transform.rotation.y) == (0.0, 0.0)
    assert (transform.rotation.z, transform.rotation.w) == pytest.approx((half, half))


def test_an_unknown_heading_is_no_turn() -> None:
    scene = replace(SCENE, craft=Craft(10.0, (3.0, 4.0)))
    (transform,) = decoded(SceneEncoder().encode(scene, STAMP_NS))["transforms"].transforms
    assert (transform.rotation.z, transform.rotation.w) == (0.0, 1.0)


def test_the_fixes_are_in_degrees_about_the_home_that_the_vehicle_tells(said: dict[str, Any]) -> None:
    # 4 m north and 3 m east of home at 60° north, where a metre east is two of a metre's degrees: home is at
    # 60°, 10°.
    vehicle, estimate = said["fix/vehicle"], said["fix/estimate"]
    assert (vehicle.latitude, vehicle.longitude, vehicle.altitude) == SCENE.craft.fix
    assert vehicle.position_covariance_type == 0  # unknown
    assert estimate.latitude == pytest.approx(60.0 + 9.0 * METRE_DEG, abs=0.001 * METRE_DEG)
    assert estimate.longitude == pytest.approx(10.0 + 2 * 12.0 * METRE_DEG, abs=0.001 * METRE_DEG)
    assert estimate.altitude == 100.0
    assert list(estimate.position_covariance) == [3.0, 1.0, 0.0, 1.0, 3.0, 0.0, 0.0, 0.0, 0.0]
    assert estimate.position_covariance_type == 3  # known


def test_without_a_fix_there_is_no_place_on_the_globe() -> None:
    scene = replace(SCENE, craft=replace(SCENE.craft, fix=None))
    assert set(decoded(SceneEncoder().encode(scene, STAMP_NS))) == ALL - {"fix/vehicle", "fix/estimate"}


def test_a_particle_is_four_floats(said: dict[str, Any]) -> None:
    cloud = said["particles"]
    assert (cloud.frame_id, cloud.point_stride) == ("map", 16)
    assert [(field.name, field.offset, field.type) for field in cloud.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("weight", 12, 7),
    ]
    assert cloud.data == struct.pack("<8f", 1.5, 2.5, 0.0, 0.25, 3.0, -4.0, 0.0, 0.75)
    assert cloud.pose.orientation.w == 1.0


def test_the_ellipse_is_two_standard_deviations_along_the_axes_of_the_covariance(
    said: dict[str, Any],
) -> None:
    estimate, covariance = said["estimate"].entities
    (ball,), (disc,) = estimate.spheres, covariance.cylinders
    for mark in (ball, disc):
        assert (mark.pose.position.x, mark.pose.position.y) == (12.0, 9.0)
    # The deviations are 2 and √2 m; an axis has four of them.
    assert (disc.size.x, disc.size.y) == pytest.approx((8.0, 4.0 * math.sqrt(2.0)))
    assert (disc.pose.orientation.z, disc.pose.orientation.w) == pytest.approx(
        (math.sin(math.pi / 8), math.cos(math.pi / 8))
    )  # 45°


def test_the_area_is_a_closed_square_and_the_marks_stand_in_the_map(said: dict[str, Any]) -> None:
    (line,) = said["area"].entities[0].lines
    assert [(point.x, point.y) for point in line.points] == [
        (0.0, 0.0),
        (30.0, 0.0),
        (30.0, 30.0),
        (0.0, 30.0),
    ]
    assert line.type == 1  # LINE_LOOP
    for topic, place in (("waypoint", (4.0, 4.0)), ("source", (15.0, 20.0))):
        (entity,) = said[topic].entities
        assert entity.frame_id == "map"
        assert (entity.spheres[0].pose.position.x, entity.spheres[0].pose.position.y) == place
    assert said["vehicle"].entities[0].frame_id == "vehicle"


def test_the_plume_has_its_first_cell_in_the_south_west(said: dict[str, Any]) -> None:
    grid = said["plume"]
    assert (grid.frame_id, grid.column_count, grid.cell_stride, grid.row_stride) == ("map", 60, 4, 240)
    assert (grid.cell_size.x, grid.cell_size.y) == (0.5, 0.5)
    assert (grid.pose.position.x, grid.pose.position.y, grid.pose.orientation.w) == (0.0, 0.0, 1.0)
    assert [(field.name, field.offset, field.type) for field in grid.fields] == [("gas", 0, 7)]
    gas = np.frombuffer(grid.data, "<f4").reshape(60, 60)
    row, column = np.unravel_index(np.argmax(gas), gas.shape)
    assert abs((column + 0.5) / 2 - 15.0) <= 0.5  # the source's own place
    assert abs((row + 0.5) / 2 - 20.0) <= 0.5
    assert gas[40, 10] > gas[40, 50]  # the wind comes from the east


def test_happenings_are_lines_of_a_log() -> None:
    lines = [
        decode(kind, data)
        for topic, kind, data in SceneEncoder().encode(SCENE, STAMP_NS)
        if topic == "scene/log"
    ]
    told = [(line.level, line.name, line.message) for line in lines]
    assert told == [(3, "estimator", "odd readings"), (2, "estimator", "source found")]  # WARNING, INFO


def test_a_scene_is_not_said_twice() -> None:
    encoder = SceneEncoder()
    encoder.encode(SCENE, STAMP_NS)
    assert (
        encoder.encode(
            replace(SCENE, scatter=Scatter(SCENE.scatter.places.copy(), SCENE.scatter.weights)), STAMP_NS + 1
        )
        == []
    )


def test_only_what_changed_is_said() -> None:
    encoder = SceneEncoder()
    encoder.encode(SCENE, STAMP_NS)
    assert set(decoded(encoder.encode(replace(SCENE, waypoint=(5.0, 4.0)), STAMP_NS))) == {"waypoint"}
    second = replace(FIRST, step=1, position=(4.0, 4.0))
    scene = replace(SCENE, measurements=(FIRST, second), waypoint=(5.0, 4.0))
    said = decoded(encoder.encode(scene, STAMP_NS))
    assert set(said) == {"path", "readings"}  # the estimate is the same
    assert [(pose.position.x, pose.position.y, pose.orientation.w) for pose in said["path"].poses] == [
        (3.0, 4.0, 1.0),
        (4.0, 4.0, 1.0),
    ]


def test_the_pose_is_said_ten_times_a_second_of_simulation_time() -> None:
    encoder = SceneEncoder()
    times = [
        time_s
        for time_s in (n / 100 for n in range(200))
        if [*encoder.encode_pose(Craft(time_s, (time_s, 0.0)), STAMP_NS)]
    ]
    assert times == [n / 10 for n in range(20)]


def test_a_path_keeps_its_newest_readings() -> None:
    many = tuple(replace(FIRST, step=n, position=(float(n), 0.0)) for n in range(LONGEST_PATH + 500))
    encoder = SceneEncoder()
    for count in (10, LONGEST_PATH - 1, LONGEST_PATH + 500):
        said = decoded(encoder.encode(replace(SCENE, measurements=many[:count]), STAMP_NS))
        newest = list(range(max(count - LONGEST_PATH, 0), count))
        assert [pose.position.x for pose in said["path"].poses] == newest


def test_a_vehicle_that_has_left_adds_no_reading() -> None:
    encoder = SceneEncoder()
    encoder.encode(SCENE, STAMP_NS)
    after = replace(FIRST, step=1, gas=math.nan, estimate=(1.0, 1.0))
    said = decoded(encoder.encode(replace(SCENE, measurements=(FIRST, after)), STAMP_NS))
    assert set(said) == {"estimate", "fix/estimate"}


def test_what_is_gone_is_deleted() -> None:
    encoder = SceneEncoder()
    encoder.encode(SCENE, STAMP_NS)
    said = decoded(encoder.encode(Scene(Backdrop("uav/1")), STAMP_NS))
    for topic in ("estimate", "waypoint", "source"):
        assert (len(said[topic].entities), [deletion.type for deletion in said[topic].deletions]) == (
            0,
            [1],
        )  # all of the topic
    assert (said["particles"].data, said["plume"].data, len(said["path"].poses)) == (b"", b"", 0)


def test_an_operator_of_a_real_flight_sees_no_truth() -> None:
    real = replace(SCENE, backdrop=replace(SCENE.backdrop, release=None))
    assert set(decoded(SceneEncoder().encode(real, STAMP_NS))) == ALL - {"source", "plume"}


def test_a_prefix_keeps_vehicles_apart() -> None:
    messages = SceneEncoder("uav/2/").encode(SCENE, STAMP_NS)
    assert all(topic.startswith("uav/2/scene/") for topic, _, _ in messages)
    home, transform = next(
        decode(kind, data) for topic, kind, data in messages if topic.endswith("transforms")
    ).transforms
    assert (home.parent_frame_id, home.child_frame_id, home.translation.x) == ("map", "uav/2/map", 0.0)
    assert (transform.parent_frame_id, transform.child_frame_id) == ("uav/2/map", "uav/2/vehicle")


def test_a_vehicle_with_another_home_lies_there() -> None:
    scene = replace(SCENE, home=(60.0, 10.0, 100.0))
    messages = SceneEncoder("uav/2/").encode(scene, STAMP_NS, (60.0 - 7.0 * METRE_DEG, 10.0, 100.0))
    home, _ = decode(*next(each[1:] for each in messages if each.topic.endswith("transforms"))).transforms
    assert (home.translation.x, home.translation.y) == pytest.approx((0.0, 7.0), abs=1e-6)


def test_beside_the_first_vehicle_of_a_search_another_one_says_only_what_is_its_own() -> None:
    said = {
        topic.rpartition("scene/")[2] for topic, _, _ in SceneEncoder("uav/2/", aside=True).encode(SCENE, 1)
    }
    shared = {"area", "source", "plume", "particles", "estimate", "fix/estimate", "wind"}
    assert said == ALL - shared


def test_what_a_pilot_looks_for_stands_at_the_vehicle_and_the_state_is_a_sentence() -> None:
    craft = replace(SCENE.craft, mode="OFFBOARD", condition=Condition(battery=0.2))
    said = decoded(SceneEncoder().encode(replace(SCENE, craft=craft), STAMP_NS))
    assert said["vehicle"].entities[0].texts[0].text == "uav/1 · OFFBOARD · 20%"
    assert said["state"].message.startswith("Searching: the source is within 3.5 m of the cross (95%)")
    assert said["state"].message.endswith("battery 20%")
    assert said["estimate"].entities[1].texts[0].text == "95% within 3.5 m"


def test_readings_are_points_with_their_gas_and_the_wind_is_an_arrow_to_where_air_flows(
    said: dict[str, Any],
) -> None:
    points = np.frombuffer(said["readings"].data, "<f4").reshape(-1, 4)
    assert points.tolist() == [[3.0, 4.0, 0.0, 0.5]]
    turn = said["wind"].entities[0].arrows[0].pose.orientation
    assert (turn.z, turn.w) == pytest.approx((math.sin(-math.pi / 4), math.cos(math.pi / 4)))  # southwards


def test_buildings_and_the_polygon_to_keep_in_are_closed_lines() -> None:
    wall, fence = ((4.0, 4.0), (8.0, 4.0), (8.0, 9.0)), ((1.0, 1.0), (28.0, 1.0), (28.0, 28.0))
    backdrop = replace(SCENE.backdrop, walls=(wall,), fence=fence)
    said = decoded(SceneEncoder().encode(replace(SCENE, backdrop=backdrop), STAMP_NS))
    lines = {entity.id: [line for line in entity.lines] for entity in said["area"].entities}
    for name, outline in (("walls", wall), ("keep_in", fence)):
        assert [(line.type, [(at.x, at.y) for at in line.points]) for line in lines[name]] == [
            (1, list(outline))
        ]
