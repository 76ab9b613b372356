"""Protects the loop against loss: whichever message is lost or service dies, the mission continues with
identical results.
"""

import json
import math
import os
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import pytest

from agent.trials.rollout import Step, mission, rollout
from estimator.belief import stop
from estimator.filter import Config
from link.bus.keys import BELIEF, READING, STOP, WAYPOINT
from link.bus.mavlink import unpack, unpack_reading
from link.bus.messages import Belief, Stop, pack_particles
from link.bus.session import Arrival, Bus
from plume.randomness import derived_seed
from plume.scenario import BUDGET_STEPS, draw
from tests.system.stranger import Stranger, belief, messages

SEED = 1
SCENARIO = draw(SEED)
ESTIMATOR = (
    "--rate",
    repr(SCENARIO.q),
    "--diffusivity",
    repr(SCENARIO.d),
    "--lifetime",
    repr(SCENARIO.tau),
    "--seed",
    str(derived_seed(SEED, "estimator")),
    "--assume",
    "paper",
)
AGENT = ("--policy", "infotaxis", "--seed", str(derived_seed(SEED, "agent")))


@cache
def in_process(assume: str) -> list[tuple[tuple[float, float], float, tuple[float, float], float]]:
    """The beliefs of the same mission in-process."""
    return [
        (point.position, point.reading, point.mean, point.spread)
        for point in rollout(SEED, "infotaxis", assume=assume)[1]
    ]


@pytest.fixture
def undisturbed() -> list[tuple[tuple[float, float], float, tuple[float, float], float]]:
    """With the paper's assumption."""
    return in_process("paper")


def point_of(said: dict) -> tuple:
    return tuple(said["position"]), said["gas"], tuple(said["mean"]), said["spread"]


@pytest.mark.parametrize(
    ("victim", "kill_at", "assume"),
    [
        ("estimator", 9, "field"),
        ("agent", 9, "paper"),
        *(
            pytest.param(victim, kill_at, "paper", marks=pytest.mark.full)
            for victim, kill_at in (("estimator", 0), ("estimator", 9), ("agent", 0))
        ),
    ],
)
def test_a_killed_service_resumes_with_the_same_belief(
    start, router: str, victim: str, kill_at: int, assume: str
) -> None:
    with Stranger(router) as viewer:
        beliefs, stops = viewer.subscribe("belief"), viewer.subscribe("agdc/stop")
        estimator = ("estimator", "-e", router, *ESTIMATOR, "--assume", assume)
        commands = {"estimator": estimator, "agent": ("agent", "-e", router, *AGENT)}
        running = {name: start(*command) for name, command in commands.items()}
        start("sitl", "uav", "-e", router, "--seed", str(SEED), "--speedup", "20")
        seen: dict[int, tuple] = {}
        said: dict = {"ceased": False}
        while not said["ceased"]:
            said = belief(beliefs.get(timeout=400))
            assert seen.setdefault(said["step"], point_of(said)) == point_of(
                said
            )  # a repeated belief is the same
            if victim in running and said["step"] == kill_at:
                running.pop(victim).kill()
                start(*commands[victim])
        assert [seen[step] for step in range(len(seen))] == in_process(assume)
        assert json.loads(stops.get(timeout=400).payload.to_bytes())["estimate"] == said["mean"]


def test_a_mission_with_lost_doubled_and_late_messages_equals_an_undisturbed_one(
    start, router: str, undisturbed: list
) -> None:
    """A stranger acts as the agent: of every three waypoints one is lost, one duplicated, one followed by
    an old one.
    """
    with Stranger(router, "health/agent") as stranger:
        beliefs = stranger.subscribe("belief")
        start("estimator", "-e", router, *ESTIMATOR)
        start("sitl", "uav", "-e", router, "--seed", str(SEED), "--speedup", "0")
        publish = stranger.publisher("waypoint")
        path = [point[0] for point in undisturbed]
        heard: dict[int, int] = {}
        seen: dict[int, tuple] = {}
        old = None
        while len(seen) < len(undisturbed):
            said = belief(beliefs.get(timeout=400))
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
        readings, out, health = (
            viewer.subscribe("reading"),
            viewer.subscribe("mavlink/out"),
            viewer.subscribe("health/uav"),
        )
        start("estimator", "-e", router)
        start("sitl", "uav", "-e", router, "--speedup", "20", "--silence", "1")
        readings.get(timeout=400)
        states: list[str] = []
        while not states or states[-1] != "landed":
            states.append(json.loads(health.get(timeout=400).payload.to_bytes())["state"])
        assert [state for n, state in enumerate(states) if n == 0 or state != states[n - 1]][-3:] == [
            "searching",
            "returning",
            "landed",
        ]
        last: dict = {}
        deadline = time.monotonic() + 30
        while not {"LOCAL_POSITION_NED", "HEARTBEAT"} <= set(last) or last["HEARTBEAT"].base_mode & 128:
            last |= messages(out.get(timeout=400))
            assert time.monotonic() < deadline
        assert (last["LOCAL_POSITION_NED"].x, last["LOCAL_POSITION_NED"].y, last["LOCAL_POSITION_NED"].z) == (
            0,
            0,
            0,
        )


@pytest.mark.full
def test_the_launcher_says_so_when_the_vehicle_gives_up(
    start, family, wait_until: Callable, tmp_path
) -> None:
    mission = start("sitl", "fly", "--speedup", "20", "--silence", "1", cwd=tmp_path)
    wait_until(lambda: mission.says("step   0"))
    agent = family(mission.process.pid)["agent"]
    os.kill(agent, signal.SIGSTOP)  # alive, but silent
    assert mission.ended() == 1
    assert (
        "error: the uav landed before the search was over; its last words: uav: warning: No setpoint for 20 "
        "s: returning home" in mission.err[-1]
    )


LAST = 29
"""The step at which infotaxis ceases in this mission. The filter resamples there, and at steps 11, 15, 23
and 27.
"""


@cache
def undisturbed_mission(policy: str, budget: int) -> tuple[Config, list[Step]]:
    """The configuration and steps of the same mission in-process."""
    flown = mission(SEED, policy, 1000, 0.5, budget)
    return flown.config, list(flown.steps)


class Viewer:
    """Watches a mission: every message must equal that of an undisturbed mission bit for bit, except for
    the vehicle's times.
    """

    def __init__(self, router: str, policy: str = "infotaxis", budget: int = BUDGET_STEPS) -> None:
        self._config, self._undisturbed = undisturbed_mission(policy, budget)
        self._bus = Bus("viewer", router)
        self._bus.subscribe(BELIEF, STOP, WAYPOINT, READING)
        self.beliefs: dict[int, int] = {}
        """time_boot_ms by step."""
        self._readings: dict[int, bytes] = {}
        """By time_boot_ms, as the next two."""
        self._waypoints: dict[int, tuple[float, float]] = {}
        self._stops: set[int] = set()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.close()

    def watch_until(self, holds: Callable[[], object]) -> None:
        deadline = time.monotonic() + 400.0
        while not holds():
            assert time.monotonic() < deadline, (
                f"seen are beliefs {self.beliefs}, readings {list(self._readings)}, stops {self._stops}"
            )
            if arrival := self._bus.receive(timeout_s=0.05):
                self._take(arrival)

    def _take(self, arrival: Arrival) -> None:
        if arrival.key is BELIEF:
            said = msgspec.json.decode(arrival.payload, type=Belief)
            assert self.beliefs.setdefault(said.step, said.time_boot_ms) == said.time_boot_ms
            expected, cloud = self._undisturbed[said.step][:2]
            assert arrival.payload == msgspec.json.encode(
                msgspec.structs.replace(expected, time_boot_ms=said.time_boot_ms)
            )
            assert arrival.attachment == pack_particles(cloud)
        elif arrival.key is STOP:
            time_boot_ms = msgspec.json.decode(arrival.payload, type=Stop).time_boot_ms
            ceased = msgspec.structs.replace(self._undisturbed[-1].belief, time_boot_ms=time_boot_ms)
            assert arrival.payload == msgspec.json.encode(stop(ceased, self._config))
            self._stops.add(time_boot_ms)
        elif arrival.key is READING:
            time_boot_ms = unpack_reading(arrival.payload, 1).time_boot_ms
            assert self._readings.setdefault(time_boot_ms, arrival.payload) == arrival.payload
        else:
            (answer,) = unpack(arrival.payload)
            assert self._waypoints.setdefault(answer.time_boot_ms, (answer.y, answer.x)) == (
                answer.y,
                answer.x,
            )

    @property
    def has_seen_the_end(self) -> bool:
        """True once the last belief, its reading, and the stop (if there is one) have arrived."""
        last = self.beliefs.get(len(self._undisturbed) - 1)
        return last in self._readings and bool(self._stops) == self._undisturbed[-1].belief.ceased

    @property
    def has_seen_all(self) -> bool:
        """True once all beliefs have arrived as well."""
        return self.has_seen_the_end and len(self.beliefs) == len(self._undisturbed)

    def check(self) -> None:
        """Check that each reading was taken once at the right place, each waypoint led there, and each
        belief belongs to its reading.
        """
        taken = [unpack_reading(frames, 1) for frames in self._readings.values()]
        assert [(reading.position, reading.gas) for reading in taken] == [
            (said.position, said.gas) for said, *_ in self._undisturbed
        ]
        times = [reading.time_boot_ms for reading in taken]
        assert times == sorted(times)
        assert self.beliefs == {step: times[step] for step in self.beliefs}
        assert self._stops <= {times[-1]}
        for answered, waypoint in self._waypoints.items():
            assert waypoint == taken[times.index(answered) + 1].position


def check_from_the_end(router: str, policy: str = "infotaxis", budget: int = BUDGET_STEPS) -> None:
    """A viewer that joins after the end receives the last belief, the stop, and every reading."""
    with Viewer(router, policy, budget) as late:
        late.watch_until(lambda: late.has_seen_the_end)
        late.check()


def parts(router: str, speedup: int) -> dict[str, tuple[str, ...]]:
    """The services of the mission as commands; the vehicle waits longer than a busy machine needs to start
    them anew.
    """
    flags = ("--seed", str(SEED), "--speedup", str(speedup), "--silence", "600")
    return {
        "uav": ("sitl", "uav", "-e", router, *flags),
        "estimator": ("estimator", "-e", router, *ESTIMATOR),
        "agent": ("agent", "-e", router, *AGENT),
    }


@pytest.mark.full
@pytest.mark.parametrize(
    "deaths",
    [
        # The second and the third process die while they rebuild from the first reading.
        pytest.param(["before:belief:0", "after:belief:0", "before:belief:0"], id="at the start"),
        # At a resampling step, while rebuilding after it, at another resampling step, and between two of
        # them.
        pytest.param(
            ["before:belief:11", "before:belief:4", "before:belief:15", "after:belief:21"], id="midway"
        ),
        pytest.param(["before:agdc/stop:0"], id="before the stop"),
        # The stop may or may not have been sent by the first process; the second is about to publish its
        # belief.
        pytest.param(["after:agdc/stop:0", f"before:belief:{LAST}"], id="between the stop and its belief"),
        pytest.param([f"after:belief:{LAST}"], id="after the last belief"),
    ],
)
def test_an_estimator_that_dies_at_any_step_goes_on_as_if_it_had_not(
    start, router: str, deaths: list[str]
) -> None:
    services = parts(router, speedup=0)
    with Viewer(router) as viewer:  # joins before the first belief, to see all of them
        start(*services["uav"])
        start(*services["agent"])
        for death in deaths:
            assert (
                start("tests.system.dies", "self", death, *services["estimator"]).ended() == -signal.SIGKILL
            )
        heir = start(*services["estimator"])
        viewer.watch_until(lambda: viewer.has_seen_all and heir.says("ceased"))
        viewer.check()
        check_from_the_end(router)


@pytest.mark.full
@pytest.mark.parametrize(
    ("policy", "budget", "deaths"),
    [
        ("infotaxis", BUDGET_STEPS, ["before:waypoint:0", "after:waypoint:0", f"before:waypoint:{LAST - 1}"]),
        ("thompson", BUDGET_STEPS, ["before:waypoint:5", "after:waypoint:6"]),
        ("random", 12, ["after:waypoint:4", "before:waypoint:11"]),
        ("ppo", BUDGET_STEPS, ["before:waypoint:7", "after:waypoint:18"]),
    ],
)
def test_an_agent_that_dies_at_any_step_goes_on_as_if_it_had_not(
    start, router: str, policy: str, budget: int, deaths: list[str]
) -> None:
    services = parts(router, speedup=0)
    agent = (*services["agent"], "--policy", policy, "--budget", str(budget))
    with Viewer(router, policy, budget) as viewer:
        start(*services["uav"])
        start(*services["estimator"])
        for death in deaths:
            assert start("tests.system.dies", "self", death, *agent).ended() == -signal.SIGKILL
        start(*agent)
        viewer.watch_until(lambda: viewer.has_seen_all)
        viewer.check()
        check_from_the_end(router, policy, budget)


@pytest.mark.full
def test_estimator_and_agent_may_die_in_the_same_round_trip(start, router: str) -> None:
    services = parts(router, speedup=0)
    with Viewer(router) as viewer:
        start(*services["uav"])
        estimator = start(*services["estimator"])
        assert (
            start("tests.system.dies", "self", "before:waypoint:11", *services["agent"]).ended()
            == -signal.SIGKILL
        )
        estimator.kill()
        start(*services["estimator"])
        start(*services["agent"])
        viewer.watch_until(lambda: viewer.has_seen_all)
        viewer.check()


@pytest.fixture
def listen(start, wait_until: Callable, tmp_path: Path) -> Callable:
    """Start a router as a process, on the same port each time; the file `router` holds its id."""
    # Below the ephemeral ports: a client that connects to one of those may connect to itself.
    ports = range(20_000 + os.getpid() % 10_000, 32_000)
    endpoint = f"tcp/127.0.0.1:{next(filter(is_free, ports))}"

    def listen():
        router = start("sitl", "router", "--listen", endpoint)
        (tmp_path / "router").write_text(str(router.process.pid))
        wait_until(lambda: router.out)
        return router

    return listen


def is_free(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) != 0


@pytest.mark.parametrize(
    ("service", "deaths"),
    [
        pytest.param(
            "uav",
            ["after:health/<service>:-1", "before:reading:8"],
            id="before the search, a reading",
            marks=pytest.mark.full,
        ),
        pytest.param("agent", ["before:waypoint:5", "after:waypoint:12"], id="waypoints"),
        pytest.param(
            "estimator",
            ["before:belief:0", "after:belief:11", "before:agdc/stop:0"],
            id="beliefs, the stop",
            marks=pytest.mark.full,
        ),
        pytest.param(
            "estimator",
            [f"before:belief:{LAST}"],
            id="between the stop and its belief",
            marks=pytest.mark.full,
        ),
        pytest.param(
            "estimator", [f"after:belief:{LAST}"], id="after the last belief", marks=pytest.mark.full
        ),
    ],
)
def test_a_mission_survives_its_router_whatever_the_cut_swallows(
    start, listen: Callable, tmp_path: Path, service: str, deaths: list
) -> None:
    """A service kills the router just before or just after it publishes a message."""
    router = listen()
    endpoint = router.out[0].strip()
    services = parts(endpoint, speedup=20)
    services[service] = ("tests.system.dies", str(tmp_path / "router"), ",".join(deaths), *services[service])
    with Viewer(endpoint) as viewer:
        for command in services.values():
            start(*command)
        for _ in deaths:
            assert router.ended() == -signal.SIGKILL
            router = listen()
        viewer.watch_until(lambda: viewer.has_seen_the_end)
        viewer.check()
        check_from_the_end(endpoint)


@pytest.mark.full
def test_a_mission_survives_its_router_while_the_vehicle_is_moving(start, listen: Callable) -> None:
    router = listen()
    endpoint = router.out[0].strip()
    with Viewer(endpoint) as viewer:
        for command in parts(endpoint, speedup=20).values():
            start(*command)
        for step in (4, 14):
            viewer.watch_until(lambda step=step: step in viewer.beliefs)
            with Stranger(endpoint) as witness:
                out = witness.subscribe("mavlink/out")
                speed = 0.0
                while speed < 1.0:
                    place = messages(out.get(timeout=400)).get("LOCAL_POSITION_NED")
                    speed = math.hypot(place.vx, place.vy) if place else 0.0
                router.kill()
            router = listen()
        viewer.watch_until(lambda: viewer.has_seen_the_end)
        viewer.check()
        check_from_the_end(endpoint)


def test_missing_readings_are_not_given_up_while_the_router_is_away(
    listen: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("link.bus.sequence.GIVE_UP_S", 1.0)
    forgetful = replace(READING, delivery=replace(READING.delivery, kept=1))
    router = listen()
    endpoint = router.out[0].strip()
    with Bus("uav", endpoint) as uav, Bus("estimator", endpoint) as estimator:
        for frames in (b"first", b"second", b"third"):
            uav.publish(forgetful, frames)
        uav.settle(30.0)  # a message still on its way to the router would reach the next subscriber
        estimator.subscribe(READING)
        assert estimator.receive(timeout_s=0.1) is None  # it has received the third, and asks for the others
        router.kill()
        assert estimator.receive(timeout_s=1.5) is None
        listen()
        assert estimator.receive(timeout_s=30.0).payload == b"third"
