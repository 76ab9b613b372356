"""Protects `plumeward ros2` against a ROS 2 of others: PyZeROS hears a mission as the record has it, and
commands the vehicle. It runs in an environment of its own; rmw_zenoh_cpp itself is not tried.
"""

import json
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ground.ros2.topics import COMMANDS, PUBLISHED
from link.bus.frames import fields_of
from link.bus.keys import BELIEF, MAVLINK_OUT, READING, STOP
from link.bus.mavlink import split, unpack_reading
from link.record.reader import Recording, read
from tests.clients.installed import HERE, python_of

pytestmark = pytest.mark.full
GLOBAL, HOME = 33, 242


class Peer:
    """The node of others."""

    def __init__(self, router: str, domain: int, namespace: str = "/uav_1") -> None:
        python = python_of("pyzeros")
        cache = str(Path(python).parents[1] / "cydr")  # the messages that it has compiled
        self._process = subprocess.Popen(
            [python, str(HERE / "ros2_peer.py"), router, str(domain), namespace],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "CYDR_CACHE_DIR": cache, "CFLAGS": "-O0"},  # unoptimised, they compile sooner
        )
        assert self._process.stdout
        assert self._process.stdout.readline() == "ready\n"

    def order(self, *words: object) -> None:
        assert self._process.stdin
        print(*words, file=self._process.stdin, flush=True)

    def end(self) -> dict[str, Any]:
        """What it has heard."""
        out, _ = self._process.communicate("end\n", timeout=400)
        assert self._process.returncode == 0
        return dict(json.loads(out))

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()


@pytest.fixture
def peer(router: str) -> Iterator[Callable[..., Peer]]:
    peers: list[Peer] = []

    def begin(domain: int = 0) -> Peer:
        peers.append(Peer(router, domain))
        return peers[-1]

    yield begin
    for one in peers:
        one.kill()


def said(recording: Recording, key: str) -> list[tuple[bytes, bytes]]:
    return [(entry.payload, entry.attachment) for entry in recording.entries if entry.key == key]


def telemetry(recording: Recording, kind: int) -> list[dict[str, Any]]:
    frames = (frame for payload, _ in said(recording, MAVLINK_OUT.name) for frame in split(payload))
    return [fields_of(frame) for frame in frames if frame.message_id == kind]


def stamp(message: dict[str, Any]) -> float:
    at = message["header"]["stamp"]
    return float(at["sec"] + at["nanosec"] / 1e9)


def test_pyzeros_hears_the_mission_that_the_record_has(
    start, router: str, peer: Callable[..., Peer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    node = peer(7)
    ros = start("sitl", "ros2", "--connect", router)
    ros.comes_to("is /uav_1 in ROS domain 7")
    start("estimator", "--connect", router, "--assume", "paper")
    start("agent", "--connect", router, "--policy", "homing")
    mission = start("sitl", "fly", "--seed", "3", "--speedup", "10", "--connect", router, cwd=tmp_path)
    assert mission.ended() == 0
    (path,) = (tmp_path / "runs").glob("*.mcap")
    seen, recording = node.end(), read(path)
    heard = seen["heard"]

    readings = {
        it.time_boot_ms: it
        for payload, _ in said(recording, READING.name)
        for it in [unpack_reading(payload)]
    }
    assert [(round(1e3 * stamp(it)), it["illuminance"]) for it in heard["gas"]] == [
        (it.time_boot_ms, it.gas) for it in readings.values()
    ]
    assert [(it["vector"]["x"], it["vector"]["y"]) for it in heard["wind"]] == [
        (-it.wind[0], -it.wind[1]) for it in readings.values()
    ]

    beliefs = {
        json.loads(payload)["step"]: (json.loads(payload), rows)
        for payload, rows in said(recording, BELIEF.name)
    }
    told = [(it["pose"]["pose"]["position"], it["pose"]["covariance"]) for it in heard["estimate"]]
    assert [(it["x"], it["y"]) for it, _ in told] == [tuple(it["mean"]) for it, _ in beliefs.values()]
    assert [[c[0], c[1], c[7]] for _, c in told] == [it["covariance"] for it, _ in beliefs.values()]

    (stop,), claim = heard["stop"], json.loads(said(recording, STOP.name)[0][0])
    assert [stop["pose"]["pose"]["position"][axis] for axis in "xy"] == claim["estimate"]
    home = telemetry(recording, HOME)[0]
    east_m, north_m = claim["estimate"]
    fix = heard["estimate_fix"][-1]
    assert fix["latitude"] == pytest.approx(home["latitude"] / 1e7 + north_m / 111_194.9, abs=1e-7)
    width_m = 111_194.9 * np.cos(np.radians(home["latitude"] / 1e7))
    assert fix["longitude"] == pytest.approx(home["longitude"] / 1e7 + east_m / width_m, abs=1e-7)

    places = {(it["lat"] / 1e7, it["lon"] / 1e7, it["alt"] / 1e3) for it in telemetry(recording, GLOBAL)}
    fixes = {(it["latitude"], it["longitude"], it["altitude"]) for it in heard["fix"]}
    assert len(fixes & places) > 0.9 * len(fixes) > 50  # the record may lack one that was dropped
    states = [it["data"] for it in heard["state"]]
    assert states[:3] == ["standby", "taking off", "searching"]
    assert {"returning", "landed"} & set(states)
    clocks = [it["clock"]["sec"] + it["clock"]["nanosec"] / 1e9 for it in heard["/clock"]]
    assert clocks == sorted(clocks)
    assert len(clocks) > 50

    for topic, attached in seen["attached"].items():
        numbers, gids = [it[0] for it in attached], {it[2] for it in attached}
        assert len(gids) == 1, topic
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), topic
    ours = [token.split("/") for token in seen["tokens"] if "/plumeward" in token]
    assert {(it[5], it[9].replace("%", "/")) for it in ours if it[5] != "NN"} == {
        ("MP", topic.name if topic.name.startswith("/") else f"/uav_1/{topic.name}") for topic in PUBLISHED
    }
    assert [it[6:] for it in ours if it[5] == "NN"] == [["%", "%uav_1", "plumeward"]]


def test_pyzeros_commands_the_vehicle_only_where_that_was_allowed(
    start, router: str, peer: Callable[..., Peer], tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    node, deaf = peer(0), peer(5)
    ros = start("sitl", "ros2", "--connect", router, "--commands")
    ros.comes_to("it obeys commands")
    start("estimator", "--connect", router, "--assume", "paper")
    start("agent", "--connect", router, "--policy", "random")  # it is still searching when the orders come
    mission = start(
        "sitl", "fly", "--seed", "3", "--speedup", "2", "--no-record", "--connect", router, cwd=tmp_path
    )
    mission.comes_to("step  10")
    deaf.order("pause", "true")  # in another domain
    node.order("raw", "pause", "00010000")
    ros.comes_to("refused pause: Could not deserialize")
    node.order("pause", "true")
    mission.comes_to("Search gives way: HOLD by 255/240 on the bus")
    ros.comes_to("the vehicle obeys: hold")
    node.order("goal_pose", 3, 4, 8)
    ros.comes_to("the vehicle obeys: go to (3.00, 4.00) m, 8.00 m up")
    node.order("goal_pose", 3, 400, 8)
    ros.comes_to("refused go to (3.00, 400.00) m")
    node.order("pause", "false")
    ros.comes_to("the vehicle obeys: resume")
    node.order("abort")
    ros.comes_to("the vehicle obeys: return")
    assert mission.ended() == 1
    assert mission.says("ended by the pilot: RETURN by 255/240 on the bus")
    tokens = [token for token in node.end()["tokens"] if "/plumeward/" in token and "/MS/" in token]
    assert len(tokens) == len(COMMANDS)
