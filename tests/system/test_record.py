"""Protects the recorder as a process: it records everything, and its death or a full disk loses at most
the last second.
"""

import json
import os
import resource
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.trials.rollout import rollout
from ground.desk.recorder import BATCH_S, FLUSH_S
from link.bus.keys import BELIEF, MAVLINK_OUT, READING
from link.bus.mavlink import Codec, Reading, pack_reading, unpack
from link.bus.session import Bus
from link.record.reader import Recording, read


def mission_record(folder: Path) -> Recording:
    (path,) = (folder / "runs").glob("*.mcap")
    return read(path)


def steps(recording: Recording) -> list[int]:
    return [json.loads(entry.payload)["step"] for entry in recording.entries if entry.key == "belief"]


def test_a_record_of_several_says_how_many_they_are(
    start, router: str, tmp_path: Path, wait_until: Callable
) -> None:
    """Else a replay of it would look for the keys of one vehicle alone."""
    words = ("--namespace", "search/1", "--vehicles", "2", "--connect", router)
    recorder = start("sitl", "record", str(tmp_path / "two.mcap"), *words)
    wait_until(lambda: recorder.out)
    recorder.process.send_signal(signal.SIGINT)
    recorder.ended()
    assert read(tmp_path / "two.mcap").about["fleet"] == {"vehicles": 2}


def test_parts_for_several_are_in_the_search_unless_another_namespace_is_given(
    start, router: str, tmp_path: Path, wait_until: Callable
) -> None:
    of_several = "--vehicles", "2", "--connect", router
    estimator = start("estimator", *of_several)
    payload = start("sitl", "payload", "--number", "2", "--connect", router)
    recorder = start("sitl", "record", str(tmp_path / "two.mcap"), *of_several)
    estimator.comes_to('mission=search/1 step=-1 event="ready: ')
    payload.comes_to("as search/1/uav/2")
    wait_until(lambda: recorder.out)
    recorder.process.send_signal(signal.SIGINT)
    recorder.ended()
    assert read(tmp_path / "two.mcap").about["namespace"] == "search/1"
    alone = start("estimator", "--vehicles", "2", "--namespace", "uav/1", "--connect", router)
    alone.comes_to('mission=uav/1 step=-1 event="ready: ')


def test_a_vehicle_that_comes_later_and_is_not_recorded_is_named_once(
    start, router: str, tmp_path: Path, wait_until: Callable
) -> None:
    words = ("--namespace", "search/1", "--vehicles", "2", "--connect", router)
    recorder = start("sitl", "record", str(tmp_path / "two.mcap"), *words)
    wait_until(lambda: recorder.out)
    with Bus("uav", router, "search/1", vehicles=(3,)):
        wait_until(lambda: recorder.says("not recorded: uav/3; --vehicles says how many there are"))
    recorder.process.send_signal(signal.SIGINT)
    recorder.ended()
    assert sum("not recorded" in line for line in recorder.err) == 1


@pytest.mark.parametrize(("vehicles", "missed"), [("1", "uav/1, uav/2"), ("2", "")])
def test_vehicles_that_are_there_and_are_not_recorded_are_named(
    start, router: str, tmp_path: Path, wait_until: Callable, vehicles: str, missed: str
) -> None:
    with (
        Bus("uav", router, "search/1", vehicles=(1,)),
        Bus("uav", router, "search/1", vehicles=(2,)),
        Bus("uav", router, "search/2", vehicles=(3,)),
    ):
        words = ("--namespace", "search/1", "--vehicles", vehicles, "--connect", router)
        recorder = start("sitl", "record", str(tmp_path / "two.mcap"), *words)
        wait_until(lambda: recorder.out)
    recorder.process.send_signal(signal.SIGINT)
    recorder.ended()
    said = [line for line in recorder.err if "not recorded" in line]
    assert len(said) == bool(missed)
    assert all(f"not recorded: {missed}; --vehicles says how many there are" in line for line in said)


def test_a_mission_is_recorded_from_its_first_to_its_last_message(start, tmp_path: Path) -> None:
    mission = start(
        "sitl",
        "fly",
        "--seed",
        "3",
        "--policy",
        "homing",
        "--assume",
        "paper",
        "--speedup",
        "0",
        "--json",
        cwd=tmp_path,
    )
    assert mission.ended() == 0
    result, recording = json.loads(mission.out[-1]), mission_record(tmp_path)
    trace = rollout(3, "homing", assume="paper")[1]
    assert recording.complete
    beliefs = [json.loads(entry.payload) for entry in recording.entries if entry.key == "belief"]
    told = {said["step"]: (said["mean"], said["spread"]) for said in beliefs}
    assert [told[step] for step in sorted(told)] == [(list(point.mean), point.spread) for point in trace]
    assert {(said["assume"], said["stop"]) for said in beliefs} == {("paper", "spread:0.5")}
    assert all(len(entry.attachment) == 12 * 1000 for entry in recording.entries if entry.key == "belief")
    keys = {
        "reading",
        "mavlink/out",
        "waypoint",
        "belief",
        "agdc/stop",
        "health/uav",
        "health/estimator",
        "health/agent",
    }
    assert keys <= {entry.key for entry in recording.entries}
    waypoints = {
        m.time_boot_ms
        for entry in recording.entries
        if entry.key == "waypoint"
        for m in unpack(entry.payload)
    }
    assert len(waypoints) == result["steps"]
    about = recording.about
    assert (about["seed"], about["policy"], about["namespace"]) == (3, "homing", "uav/1")
    assert about["scenario"]["source"] == result["source"]
    assert about["mission"]["agent"]["policy"] == "homing"
    assert {"plumeward", "python", "eclipse-zenoh", "numpy", "pymavlink"} <= set(about["versions"])
    assert about["host"]


def test_publish_times_are_the_publishers_own(
    start, router: str, tmp_path: Path, wait_until: Callable
) -> None:
    recorder = start("sitl", "record", str(tmp_path / "run.mcap"), "--connect", router)
    wait_until(lambda: recorder.out)
    with Bus("uav", router) as bus:
        before = time.time_ns()
        bus.publish(READING, pack_reading(Codec(1, 1), Reading(1000, (3.0, 4.0), 5.0, (2.0, -1.0), 0.5)))
        after = time.time_ns()
        bus.settle(30.0)
        recorder.process.send_signal(signal.SIGTERM)
        assert recorder.ended() == 0
    (entry,) = (entry for entry in read(tmp_path / "run.mcap").entries if entry.key == "reading")
    assert (
        before - 1_000_000 <= entry.published_ns <= after + 1_000_000
    )  # Zenoh's clock may run ahead of the system's by less than this
    assert entry.simulation_s == 1.0


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT])
def test_what_was_said_before_it_is_told_to_end_is_in_the_file(
    start, router: str, tmp_path: Path, wait_until: Callable, end: int
) -> None:
    recorder = start("sitl", "record", str(tmp_path / "run.mcap"), "--connect", router)
    wait_until(lambda: recorder.out)
    assert recorder.out == [f"recording to {tmp_path / 'run.mcap'}\n"]
    with Bus("uav", router) as bus:
        bus.publish(MAVLINK_OUT, b"first")
        bus.publish(BELIEF, b"what is no belief is recorded, too", b"attached")
        bus.publish(MAVLINK_OUT, b"last")
        bus.settle(30.0)  # the router has passed it on
        recorder.process.send_signal(end)
        assert recorder.ended() == 0
    recording = read(tmp_path / "run.mcap")
    assert recording.complete
    said = [
        (entry.key, entry.payload, entry.attachment)
        for entry in recording.entries
        if not entry.key.startswith("health")
    ]
    assert sorted(said) == sorted(
        [
            ("mavlink/out", b"first", b""),
            ("belief", b"what is no belief is recorded, too", b"attached"),
            ("mavlink/out", b"last", b""),
        ]
    )


def test_what_was_recorded_is_on_disk_at_once_and_outlives_a_recorder_that_is_killed(
    start, router: str, tmp_path: Path, wait_until: Callable
) -> None:
    path = tmp_path / "run.mcap"
    recorder = start("sitl", "record", str(path), "--connect", router)
    wait_until(lambda: recorder.out)
    wanted = [b"%d" % number for number in range(100)]

    def there() -> list[bytes]:
        return [entry.payload for entry in read(path).entries if entry.key == "reading"]

    with Bus("uav", router) as bus:
        for payload in wanted:
            bus.publish(READING, payload)
        wait_until(lambda: there() == wanted)  # far too little to fill a chunk, and nothing comes after it
        more = [b"%d" % number for number in range(100, 200)]
        for payload in more:
            bus.publish(READING, payload)
        recorder.kill()
    assert not read(path).complete
    assert there()[:100] == wanted
    assert there() == (wanted + more)[: len(there())]
    assert BATCH_S + FLUSH_S < 1.0  # so that a second is lost at most
    tlog_bytes = path.with_suffix(".tlog").stat().st_size
    assert tlog_bytes == 0  # none of it was MAVLink


@pytest.mark.full
def test_a_full_disk_stops_the_record_with_a_line_and_not_the_mission(
    start, family: Callable, wait_until: Callable, tmp_path: Path
) -> None:
    mission = start(
        "sitl", "fly", "--policy", "random", "--budget", "25", "--speedup", "20", "--json", cwd=tmp_path
    )
    wait_until(lambda: "record" in family(mission.process.pid))
    limit = 40_000  # largest file size in bytes: a write beyond it fails as on a full disk
    resource.prlimit(family(mission.process.pid)["record"], resource.RLIMIT_FSIZE, (limit, limit))
    assert mission.ended() == 0
    assert json.loads(mission.out[-1])["steps"] == 25
    (line,) = (
        line
        for line in mission.err
        if "record stopped" in line and "warning: the recording stopped" not in line
    )
    assert line.startswith("recorder: warning: record stopped: File too large (runs/")
    (path,) = (tmp_path / "runs").glob("*.mcap")
    assert 0 < path.stat().st_size <= limit
    recording = read(path)
    assert not recording.complete
    assert recording.about["stopped"] == "File too large"
    assert recording.shortcoming == "ends early: File too large"
    assert steps(recording) == list(range(len(steps(recording))))


def test_a_place_that_cannot_be_written_is_one_line_and_status_2(start, router: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    recorder = start("sitl", "record", str(tmp_path / "file" / "run.mcap"), "--connect", router)
    assert recorder.ended() == 2
    (line,) = recorder.err
    assert line.startswith("error: ")
    assert str(tmp_path / "file" / "run.mcap") in line


@pytest.mark.full
def test_records_survive_a_router_that_comes_back(start, tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("seed: 3\nagent: {policy: homing}\nevents: [{step: 6, do: kill, part: router}]\n")
    mission = start("sitl", "fly", str(path), "--speedup", "0", "--json", cwd=tmp_path)
    assert mission.ended() == 0
    recording = mission_record(tmp_path)
    assert recording.complete
    readings = {entry.simulation_s for entry in recording.entries if entry.key == "reading"}
    assert len(readings) == json.loads(mission.out[-1])["steps"] + 1
    assert os.path.getsize(next((tmp_path / "runs").glob("*.tlog"))) > 0
