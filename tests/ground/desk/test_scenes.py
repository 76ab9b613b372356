"""Protects the scene in records: viewers find it, readers of ours see no difference, and no message is
lost because of it.
"""

import functools
import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from pymavlink.dialects.v20 import common as mavlink

from ground.desk.scenes import RecordedScene
from link.bus.keys import MAVLINK_OUT
from link.bus.mavlink import Codec, unpack
from link.bus.messages import unpack_particles
from link.cli import MOST_VEHICLES
from link.record.reader import Recording, read
from link.record.record import Entry
from link.record.writer import Writer
from scene.follow.history import History
from scene.foxglove import schema_of
from scene.scene import Backdrop

ROOT = Path(__file__).parents[3]
GOLDEN = ROOT / "tests" / "golden" / "homing-gaussian-field.mcap"
LAYOUT = ROOT / "docs" / "viewers" / "plumeward.json"


def record(path: Path, flown: Recording, scene: RecordedScene | None) -> Path:
    """Write a record of messages, as the recorder does."""
    writer = Writer(path, flown.about)
    for entry in flown.entries:
        writer.write(entry, entry.published_ns)
        for topic, kind, data in scene.take(entry, entry.published_ns) if scene else ():
            writer.write_for_viewers(topic, functools.partial(schema_of, kind), data, entry.published_ns)
    writer.close()
    return path


@pytest.fixture(scope="module")
def flown() -> Recording:
    """A golden record without what was said twice: a scene shows it once."""
    recording = read(GOLDEN)
    said: set[bytes] = set()
    once = [
        entry
        for entry in recording.entries
        if entry.key != "belief" or not (entry.payload in said or said.add(entry.payload))
    ]
    return recording._replace(entries=once)


@pytest.fixture(scope="module")
def path(flown: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record with its scene."""
    scene = RecordedScene(flown.about, "uav/1")
    written = record(tmp_path_factory.mktemp("record") / "run.mcap", flown, scene)
    assert scene.failure == ""
    return written


@pytest.fixture(scope="module")
def shown(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """By topic: (log time, message) of the scene, decoded by mcap-protobuf-support."""
    messages: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        topics = [
            channel.topic
            for channel in reader.get_summary().channels.values()
            if channel.topic.startswith("scene/")
        ]
        for _, channel, message, decoded in reader.iter_decoded_messages(topics=topics):
            messages.setdefault(channel.topic, []).append((message.log_time, decoded))
    return messages


def beliefs(entries: Iterable[Entry]) -> list[dict[str, Any]]:
    return [json.loads(entry.payload) for entry in entries if entry.key == "belief"]


def test_a_reader_of_ours_sees_no_difference(flown: Recording, path: Path, tmp_path: Path) -> None:
    with_scene, without = read(path), read(record(tmp_path / "run.mcap", flown, None))
    assert with_scene == without
    assert with_scene.entries == flown.entries
    assert path.with_suffix(".tlog").read_bytes() == (tmp_path / "run.tlog").read_bytes()


def test_each_belief_is_a_cloud_of_its_particles_and_a_mark_at_its_mean(
    flown: Recording, shown: dict[str, Any]
) -> None:
    entries = [entry for entry in flown.entries if entry.key == "belief"]
    assert len(shown["scene/particles"]) == len(entries) > 10
    for entry, said, (time_ns, cloud) in zip(
        entries, beliefs(entries), shown["scene/particles"], strict=True
    ):
        rows = unpack_particles(entry.attachment, len(said["unknowns"]))
        column = said["unknowns"].index
        points = np.frombuffer(cloud.data, "<f4").reshape(-1, 4)
        assert np.array_equal(points[:, 0], rows[:, column("x")])
        assert np.array_equal(points[:, 1], rows[:, column("y")])
        assert np.array_equal(points[:, 3], rows[:, -1])
        assert (
            time_ns == cloud.timestamp.ToNanoseconds()
        )  # viewers show a message at its log time, in frames of its timestamp
    means = [
        (mark.pose.position.x, mark.pose.position.y)
        for _, update in shown["scene/estimate"]
        for mark in update.entities[0].spheres
    ]
    assert means == [tuple(said["mean"]) for said in beliefs(entries)]


def test_the_path_ends_with_all_readings(flown: Recording, shown: dict[str, Any]) -> None:
    path = shown["scene/path"][-1][1]
    assert [(pose.position.x, pose.position.y) for pose in path.poses] == [
        tuple(said["position"]) for said in beliefs(flown.entries)
    ]


def test_the_vehicle_is_where_it_said_and_so_is_home(flown: Recording, shown: dict[str, Any]) -> None:
    told = {}
    for entry in flown.entries:
        for message in unpack(entry.payload) if entry.key == "mavlink/out" else ():
            if message.get_type() == "LOCAL_POSITION_NED":
                told[entry.published_ns] = (message.y, message.x, -message.z)
    shown_at = [(at, update.transforms[0].translation) for at, update in shown["scene/transforms"]]
    assert len(shown_at) > 10
    assert all((place.x, place.y, place.z) == told[at] for at, place in shown_at)
    home = flown.about["mission"].get("vehicle", {})
    first = shown["scene/fix/estimate"][0][1]
    assert first.latitude == pytest.approx(
        home.get("home_lat_deg", 47.397742), abs=30 / 111_000
    )  # the area's side


def test_the_truth_comes_from_the_description_of_the_run(flown: Recording, shown: dict[str, Any]) -> None:
    ((_, update),) = shown["scene/source"]
    place = update.entities[0].spheres[0].pose.position
    assert [place.x, place.y] == list(flown.about["scenario"]["source"])
    assert len(shown["scene/plume"]) == 1
    scene = RecordedScene({}, "uav/1")
    assert not {topic for entry in flown.entries for topic, _, _ in scene.take(entry, 1)} & {
        "scene/source",
        "scene/plume",
    }


def test_a_record_that_is_cut_off_anywhere_is_read_up_to_there(
    flown: Recording, path: Path, tmp_path: Path
) -> None:
    whole, cut = path.read_bytes(), tmp_path / "cut.mcap"
    for part in (0.3, 0.6, 0.9, 0.999):
        cut.write_bytes(whole[: int(part * len(whole))])
        recording = read(cut)
        assert not recording.complete
        assert recording.entries == flown.entries[: len(recording.entries)]
    assert recording.entries  # the last cut loses the index at most


def test_a_scene_that_fails_is_left_out_and_said_once(
    flown: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = RecordedScene(flown.about, "uav/1")
    asked = []

    def at(_self: History) -> None:
        asked.append(1)
        raise MemoryError("no room")

    monkeypatch.setattr(History, "at", at)
    assert [scene.take(entry, 1) for entry in flown.entries[:50]] == [[]] * 50
    assert scene.failure == "no more scenes are recorded for viewers: MemoryError: no room"
    assert len(asked) == 1


@pytest.mark.parametrize("payload", [b"", b"nonsense", b"\xfd\xff", b"{}", b'{"step": 1e400}'])
@pytest.mark.parametrize("key", ["belief", "agdc/stop", "health/uav", "reading", "waypoint", "mavlink/out"])
def test_messages_that_break_the_contract_are_no_failure(key: str, payload: bytes) -> None:
    scene = RecordedScene({"scenario": {"source": "here"}, "budget": "none"}, "uav/1")
    scene.take(Entry(key, 1, 1.0, payload, b"odd"), 1)
    assert scene.failure == ""


def test_fast_telemetry_gives_ten_poses_a_second_with_the_newest_place() -> None:
    codec, scene, poses = Codec(1, 1), RecordedScene({}, "uav/1"), []
    for number in range(400):  # 200 Hz for 2 s of simulation
        time_s = number / 200
        place = codec.pack(_local(round(1000 * time_s), time_s))
        said = scene.take(Entry(MAVLINK_OUT.name, number, time_s, place), number)
        poses += [
            kind.FromString(data).transforms[0].translation.x
            for topic, kind, data in said
            if topic == "scene/transforms"
        ]
    assert poses == pytest.approx([n / 10 for n in range(20)])


def _local(time_boot_ms: int, east: float) -> Any:
    return mavlink.MAVLink_local_position_ned_message(time_boot_ms, 0.0, east, -5.0, 0.0, 0.0, 0.0)


def test_a_days_long_recording_keeps_a_bounded_history(
    flown: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scene.follow.history.MOST", 8)
    history = History(Backdrop("uav/1"), whole=False)
    belief = next(entry for entry in flown.entries if entry.key == "belief")
    counts = []
    for step in range(30):
        payload = json.dumps({**json.loads(belief.payload), "step": step}).encode()
        assert history.take("belief", payload, belief.attachment, float(step), 0.0)
        counts.append(len(history.at().measurements))
        assert history.at().measurements[-1].step == step
    assert max(counts) == 8
    assert min(counts[8:]) == 4  # the older half goes


# ---- what viewers need ----


def test_rerun_finds_particles_path_and_fixes(path: Path, flown: Recording) -> None:
    """The importer runs in a process of its own: it keeps threads."""
    code = """
import json, sys
from rerun.chunk import McapReader
found = {}
for chunk in McapReader(sys.argv[1]).stream():
    batch = chunk.to_record_batch()
    for name in ("Points3D:positions", "InstancePoses3D:translations", "GeoPoints:positions", "TextLog:text", "Transform3D:translation"):
        if name in batch.schema.names and chunk.entity_path.startswith("/scene"):
            found.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(batch.column(name).to_pylist())
print(json.dumps(found))
"""
    ran = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, timeout=400, check=True
    )
    found = json.loads(ran.stdout)
    said = beliefs(flown.entries)
    particles = found["/scene/particles"]["Points3D:positions"]
    assert [len(points) for points in particles] == [100] * len(said)
    assert np.isfinite(particles[-1]).all()
    path_places = found["/scene/path"]["InstancePoses3D:translations"][-1]
    assert np.array_equal(
        np.array(path_places)[:, :2], np.array([belief["position"] for belief in said], np.float32)
    )
    for fixes in ("vehicle", "estimate"):
        latitude, longitude = found[f"/scene/fix/{fixes}"]["GeoPoints:positions"][-1][0]
        assert (latitude, longitude) == pytest.approx((47.3977, 8.5456), abs=0.001)
    assert found["/scene/log"]["TextLog:text"]
    assert found["/scene/transforms"]["Transform3D:translation"]


def panels(node: Any) -> list[str]:
    """The panels of a layout's tree."""
    return [node] if isinstance(node, str) else [*panels(node["first"]), *panels(node["second"])]


def test_the_layout_shows_only_what_is_recorded_and_each_of_its_panels_is_placed(
    path: Path, shown: dict[str, Any]
) -> None:
    layout = json.loads(LAYOUT.read_text())
    assert {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"} <= set(layout)
    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    kinds = {name.partition("!")[0] for name in layout["configById"]}
    assert kinds == {"3D", "Plot", "RosOut", "map"}  # a log panel is called RosOut
    configs = {name.partition("!")[0]: config for name, config in layout["configById"].items()}
    aside = ("scene/fix", "scene/log", "scene/state", "scene/transforms")
    marks = {topic for topic in shown if not topic.startswith(aside)}
    others = [f"uav/{number}" for number in range(2, MOST_VEHICLES + 1)]
    own = {f"scene/{mark}" for mark in ("vehicle", "path", "readings", "waypoint")}
    assert set(configs["3D"]["topics"]) == marks | {f"{name}/{mark}" for name in others for mark in own}
    assert not configs["3D"]["topics"]["scene/plume"]["visible"]  # the truth is off until asked for
    assert not configs["3D"]["topics"]["scene/source"]["visible"]
    assert configs["RosOut"]["topicToRender"] in shown
    fields = beliefs(read(path).entries)[-1]
    for name, config in layout["configById"].items():
        for line in config.get("paths", ()):
            key, _, field = line["value"].partition(".")
            of, of_another = key.removeprefix(f"{key[:5]}/"), key[:5] in others
            assert of == "belief" or (of_another and of == "reading/decoded"), name
            assert field in fields
