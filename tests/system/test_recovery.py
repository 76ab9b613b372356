"""Protects the loop against loss: whatever message is lost and whichever service dies, the mission goes on to the same bits."""

import json
import os
import signal
import time
from collections.abc import Callable

import pytest

from agent.rollout import rollout
from plume.randomness import derived_seed
from plume.scenario import draw
from tests.system.stranger import Stranger, belief, messages

SEED = 2
SCENARIO = draw(SEED)
ESTIMATOR = (
    "--rate", repr(SCENARIO.q), "--diffusivity", repr(SCENARIO.d), "--lifetime", repr(SCENARIO.tau),
    "--seed", str(derived_seed(SEED, "estimator")),
)  # fmt: skip
AGENT = ("--seed", str(derived_seed(SEED, "agent")))


@pytest.fixture(scope="module")
def undisturbed() -> list[tuple[tuple[float, float], float, tuple[float, float], float]]:
    """The beliefs of the same mission in-process."""
    return [(point.position, point.reading, point.mean, point.spread) for point in rollout(SEED, "infotaxis")[1]]


def point_of(said: dict) -> tuple:
    return tuple(said["position"]), said["gas"], tuple(said["mean"]), said["spread"]


@pytest.mark.parametrize("victim", ["estimator", "agent"])
@pytest.mark.parametrize("kill_at", [0, 9])
def test_a_killed_service_resumes_with_the_same_belief(start, router: str, undisturbed: list, victim: str, kill_at: int) -> None:
    with Stranger(router) as viewer:
        beliefs, stops = viewer.subscribe("belief"), viewer.subscribe("agdc/stop")
        commands = {"estimator": ("estimator", "-e", router, *ESTIMATOR), "agent": ("agent", "-e", router, *AGENT)}
        running = {name: start(*command) for name, command in commands.items()}
        start("sitl", "uav", "-e", router, "--seed", str(SEED), "--speedup", "20")
        seen: dict[int, tuple] = {}
        said: dict = {"ceased": False}
        while not said["ceased"]:
            said = belief(beliefs.get(timeout=60))
            assert seen.setdefault(said["step"], point_of(said)) == point_of(said)  # said again, it is the same
            if victim in running and said["step"] == kill_at:
                running.pop(victim).kill()
                start(*commands[victim])
        assert [seen[step] for step in range(len(seen))] == undisturbed
        assert json.loads(stops.get(timeout=60).payload.to_bytes())["estimate"] == said["mean"]


def test_a_mission_with_lost_doubled_and_late_messages_equals_an_undisturbed_one(start, router: str, undisturbed: list) -> None:
    """A stranger is the agent: of each three waypoints one is lost, one doubled, one followed by an old one."""
    with Stranger(router, "health/agent") as stranger:
        beliefs = stranger.subscribe("belief")
        start("estimator", "-e", router, *ESTIMATOR)
        start("sitl", "uav", "-e", router, "--seed", str(SEED), "--speedup", "0")
        publish = stranger.publisher("mavlink/in")
        path = [point[0] for point in undisturbed]
        heard: dict[int, int] = {}
        seen: dict[int, tuple] = {}
        old = None
        while len(seen) < len(undisturbed):
            said = belief(beliefs.get(timeout=60))
            step = said["step"]
            heard[step] = heard.get(step, 0) + 1
            seen[step] = point_of(said)
            if step + 1 == len(path) or (step % 3 == 0 and heard[step] == 1):
                continue  # lost
            frames = stranger.waypoint(said["time_boot_ms"], north=path[step + 1][1], east=path[step + 1][0])
            publish(frames)
            if step % 3 == 1:
                publish(frames)
            elif old:
                publish(old)
            old = frames
        assert [seen[step] for step in range(len(seen))] == undisturbed


def test_a_vehicle_that_gets_no_waypoints_returns_home_and_lands(start, router: str) -> None:
    with Stranger(router, "health/agent") as viewer:
        readings, out, health = viewer.subscribe("reading"), viewer.subscribe("mavlink/out"), viewer.subscribe("health/uav")
        start("estimator", "-e", router)
        start("sitl", "uav", "-e", router, "--speedup", "20", "--silence", "1")
        readings.get(timeout=60)
        states: list[str] = []
        while not states or states[-1] != "landed":
            states.append(json.loads(health.get(timeout=60).payload.to_bytes())["state"])
        assert [state for n, state in enumerate(states) if n == 0 or state != states[n - 1]][-3:] == ["searching", "returning", "landed"]
        last: dict = {}
        deadline = time.monotonic() + 30
        while not {"LOCAL_POSITION_NED", "HEARTBEAT"} <= set(last) or last["HEARTBEAT"].base_mode & 128:
            last |= messages(out.get(timeout=30))
            assert time.monotonic() < deadline
        assert (last["LOCAL_POSITION_NED"].x, last["LOCAL_POSITION_NED"].y, last["LOCAL_POSITION_NED"].z) == (0, 0, 0)


def test_the_launcher_says_so_when_the_vehicle_gives_up(start, family, wait_until: Callable, tmp_path) -> None:
    mission = start("sitl", "fly", "--speedup", "20", "--silence", "1", cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    agent = family(mission.process.pid)["agent"]
    os.kill(agent, signal.SIGSTOP)  # alive, but silent
    assert mission.ended() == 1
    assert (
        "error: the uav has landed before the search was over; its last words: uav: No setpoint for 20 s: returning home" in mission.err[-1]
    )
