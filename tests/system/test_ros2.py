"""Protects `plumeward ros2` as a process: what late nodes get, what is subscribed, routers that go, two
vehicles, certificates, and how it ends.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh.ext
from pymavlink.dialects.v20 import common as mavlink

from ground.ros2 import rmw
from ground.ros2.topics import CLOCK, COMMANDS, PAUSE, STATE, STOP, TF, TF_STATIC, Topic
from ground.ros2.wire import Wire
from link.access.authority import make
from link.bus.keys import MAVLINK_IN, MAVLINK_OUT
from link.bus.keys import STOP as CEASED
from link.bus.mavlink import Codec, unpack
from link.bus.messages import Stop
from link.bus.opening import open_router
from link.bus.session import Bus
from tests.link.access.certificates import session

pytestmark = pytest.mark.slow
WIRE = Wire("jazzy")


def key_of(topic: Topic, namespace: str = "uav_1", domain: int = 0) -> str:
    name = topic.name if topic.name.startswith("/") else f"/{namespace}/{topic.name}"
    return rmw.topic_key(domain, name, topic.kind, WIRE.hash_of(topic.kind))


class Uav(Bus):
    """A vehicle that stands, and says so."""

    def __init__(self, router: str, vehicle: int = 1, secure: Path | None = None) -> None:
        super().__init__("uav", router, f"uav/{vehicle}", log_level="error", secure=secure)
        self._codec, self._ms = Codec(vehicle, 1), 0
        self.tally.system, self.tally.state = vehicle, "searching"
        self.commands: list[Any] = []
        self.on(MAVLINK_IN, lambda arrival: self.commands.extend(unpack(arrival.payload)))

    def beat(self) -> bool:
        """Say who and where it is; returns False, to be used in a condition that is polled."""
        self._ms += 100
        beat = mavlink.MAVLink_heartbeat_message(2, 12, 128, 0, 4, 3)
        home = mavlink.MAVLink_home_position_message(
            475000000, 82500000, 488000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0
        )
        place = mavlink.MAVLink_local_position_ned_message(self._ms, 2.0, 1.0, -5.0, 0, 0, 0)
        self.publish(MAVLINK_OUT, self._codec.pack(beat, home, place))
        self.publish_health()
        return False


class Node:
    """A node of ROS that listens as rmw_zenoh does."""

    def __init__(self, joined: zenoh.Session) -> None:
        self.session = joined
        self.heard: dict[str, list[Any]] = {}
        self._held: list[Any] = []

    def hear(self, topic: Topic, namespace: str = "uav_1") -> None:
        key = key_of(topic, namespace)
        heard = self.heard.setdefault(key, [])

        def received(sample: zenoh.Sample) -> None:
            assert rmw.is_attachment(sample.attachment.to_bytes() if sample.attachment else b"")
            heard.append(WIRE.decode(topic.kind, sample.payload.to_bytes()))

        if topic.qos.latched:
            latched = {
                "history": zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=topic.qos.depth),
                "recovery": zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
                "subscriber_detection": True,
            }
            self._held.append(
                zenoh.ext.declare_advanced_subscriber(self.session, key, received, **latched)  # type: ignore[call-overload]
            )
        else:
            self._held.append(self.session.declare_subscriber(key, received))

    def of(self, topic: Topic, namespace: str = "uav_1") -> list[Any]:
        return self.heard[key_of(topic, namespace)]

    def say(self, topic: Topic, *fields: Any) -> None:
        data = WIRE.encode(topic.kind, WIRE.make(topic.kind, *fields))
        self.session.put(key_of(topic), data, attachment=rmw.attachment(1, time.time_ns(), bytes(16)))

    def tokens(self) -> list[str]:
        return [str(it.ok.key_expr) for it in self.session.liveliness().get("@ros2_lv/**") if it.ok]


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def node(router: str, stack: ExitStack) -> Node:
    return Node(stack.enter_context(session(router, None, None)))


def stop() -> Stop:
    return Stop(
        time_boot_ms=100, step=3, estimate=(7.0, 9.0), covariance=(0.1, 0.0, 0.2), spread=0.5, threshold=0.5
    )


def test_a_late_node_gets_the_stop_the_state_and_where_the_map_is(
    start, router: str, node: Node, stack: ExitStack, wait_until: Callable[..., None]
) -> None:
    uav, estimator = stack.enter_context(Uav(router)), stack.enter_context(Bus("estimator", router))
    start("sitl", "ros2", "--connect", router).comes_to("is /uav_1 in ROS domain 0")
    node.hear(TF)
    estimator.publish(CEASED, stop())
    wait_until(lambda: node.of(TF) or uav.beat())
    for topic in (STOP, STATE, TF_STATIC):
        node.hear(topic)
        wait_until(lambda topic=topic: node.of(topic))
    place = node.of(STOP)[0].pose.pose.position
    assert (place.x, place.y, node.of(STATE)[-1].data) == (7.0, 9.0, "searching")
    (earth,) = node.of(TF_STATIC)[-1].transforms
    assert (earth.header.frame_id, earth.child_frame_id) == ("earth", "uav_1/map")
    (moved,) = node.of(TF)[-1].transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("uav_1/map", "uav_1/base_link")
    assert (moved.transform.translation.x, moved.transform.translation.y) == (1.0, 2.0)
    assert moved.transform.translation.z == 5.0


@pytest.mark.parametrize("allowed", [False, True])
def test_commands_are_heard_only_where_they_are_allowed(
    start, router: str, node: Node, stack: ExitStack, wait_until: Callable[..., None], allowed: bool
) -> None:
    uav = stack.enter_context(Uav(router))
    ros = start("sitl", "ros2", "--connect", router, *["--commands"] * allowed)
    ros.comes_to("it obeys commands" if allowed else "it takes no commands")
    node.hear(TF)
    wait_until(lambda: node.of(TF) or uav.beat())
    listens = [token for token in node.tokens() if "/MS/" in token and "/plumeward/" in token]
    assert len(listens) == len(COMMANDS) * allowed
    node.say(PAUSE, True)
    if allowed:
        wait_until(lambda: uav.commands)
        assert uav.commands[0].command == mavlink.MAV_CMD_DO_SET_MODE
    else:
        before = len(node.of(TF))
        wait_until(lambda: len(node.of(TF)) > before + 3 or uav.beat())
        assert uav.commands == []


def test_a_router_that_is_started_again_finds_it_as_it_was(
    start, stack: ExitStack, wait_until: Callable[..., None]
) -> None:
    first, endpoint = open_router("tcp/127.0.0.1:0")
    uav = stack.enter_context(Uav(endpoint))
    ros = start("sitl", "ros2", "--connect", endpoint)
    before = Node(stack.enter_context(session(endpoint, None, None)))
    before.hear(TF)
    wait_until(lambda: before.of(TF) or uav.beat())
    first.close()
    ros.comes_to("the router is gone")
    second, _ = open_router(endpoint)
    stack.callback(second.close)
    ros.comes_to("the router is back")
    after = Node(stack.enter_context(session(endpoint, None, None)))
    after.hear(STATE)
    after.hear(TF)
    wait_until(lambda: (after.of(STATE) and after.of(TF)) or uav.beat())
    assert any("/NN/" in token for token in after.tokens())


def test_two_vehicles_have_names_of_their_own_and_one_tells_the_time(
    start, router: str, node: Node, stack: ExitStack, wait_until: Callable[..., None]
) -> None:
    uavs = [stack.enter_context(Uav(router, number)) for number in (1, 2)]
    for number in (1, 2):
        ros = start("sitl", "ros2", "--connect", router, "--namespace", f"uav/{number}")
        ros.comes_to(f"is /uav_{number} in")
        node.hear(STATE, f"uav_{number}")
    node.hear(TF)

    def clocks() -> list[str]:  # two that begin at once both offer it, until one leaves it to the other
        return [token.split("/")[7] for token in node.tokens() if "%clock" in token]

    def both() -> bool:
        children = {it.transforms[0].child_frame_id for it in node.of(TF)}
        return children == {"uav_1/base_link", "uav_2/base_link"}

    wait_until(lambda: both() or any([uav.beat() for uav in uavs]))
    names = "uav_1", "uav_2"
    wait_until(lambda: all(node.of(STATE, name) for name in names) or any([uav.beat() for uav in uavs]))
    wait_until(lambda: clocks() in (["%uav_1"], ["%uav_2"]) or any([uav.beat() for uav in uavs]))


def test_with_certificates_it_does_its_work_and_has_no_other_rights(
    start, stack: ExitStack, tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    make(tmp_path, [1, 2])
    router, endpoint = open_router("tcp/127.0.0.1:0", tmp_path)
    stack.callback(router.close)
    uav = stack.enter_context(Uav(endpoint, 1, tmp_path))
    ros = start("sitl", "ros2", "--connect", endpoint, "--secure", str(tmp_path), "--commands")
    ros.comes_to("is /uav_1 in ROS domain 0")
    node = Node(stack.enter_context(session(endpoint, tmp_path, "ros")))
    for topic in (TF, STATE, TF_STATIC, CLOCK):
        node.hear(topic)
    wait_until(lambda: all(map(node.of, (TF, STATE, TF_STATIC, CLOCK))) or uav.beat())
    assert any("/NN/" in token for token in node.tokens())
    node.say(PAUSE, True)
    wait_until(lambda: uav.commands)
    assert not any("has no right" in line for line in ros.err)

    part = stack.enter_context(session(endpoint, tmp_path, "uav/1/ros2"))
    witness = stack.enter_context(session(endpoint, tmp_path, "operator"))
    other = Node(stack.enter_context(session(endpoint, tmp_path, "ros")))
    heard: list[str] = []
    other.session.declare_subscriber("0/**", lambda it: heard.append(str(it.key_expr)))
    witness.declare_subscriber("uav/**", lambda it: heard.append(str(it.key_expr)))
    for one in (other.session, witness, part):
        list(one.get("uav/1/nobody", timeout=60))
    forbidden = ["uav/1/belief", "uav/2/mavlink/in", "uav/1/mavlink/out", "0/uav_2/fix/a/b", "0/rosout/a/b"]
    for key in [*forbidden, "0/uav_1/fix/a/b"]:
        part.put(key, b"x", congestion_control=zenoh.CongestionControl.BLOCK)
    for key in ("uav/1/mavlink/in", "uav/1/waypoint", "uav/1/belief"):
        node.session.put(key, b"x", congestion_control=zenoh.CongestionControl.BLOCK)
    node.session.put("0/uav_1/mark/a/b", b"x", congestion_control=zenoh.CongestionControl.BLOCK)
    wait_until(lambda: {"0/uav_1/fix/a/b", "0/uav_1/mark/a/b"} <= set(heard))
    assert not set(heard) & {*forbidden, "uav/1/mavlink/in", "uav/1/waypoint"}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_when_it_is_told_to_and_its_node_goes(
    start, router: str, node: Node, wait_until: Callable[..., None], number: int
) -> None:
    ros = start("sitl", "ros2", "--connect", router)
    ros.comes_to("is /uav_1 in")
    wait_until(lambda: any("/plumeward" in token for token in node.tokens()))
    ros.process.send_signal(number)
    assert ros.ended() == 0
    wait_until(lambda: not any("/plumeward" in token for token in node.tokens()))
    assert not ros.says("Traceback")


def test_a_second_one_for_the_same_vehicle_is_refused(start, router: str) -> None:
    start("sitl", "ros2", "--connect", router).comes_to("is /uav_1 in")
    second = start("sitl", "ros2", "--connect", router)
    assert second.ended() == 2
    assert second.err == ["error: another ros2 is already on uav/1\n"]


@pytest.mark.parametrize("late", [False, True])
def test_of_a_search_by_several_it_says_how_it_shows_one_vehicle(
    start, router: str, stack: ExitStack, late: bool
) -> None:
    def search() -> None:
        for number in (2, 3):
            stack.enter_context(Bus("uav", router, "search/1", vehicles=(number,)))

    if not late:
        search()
    ros = start("sitl", "ros2", "--connect", router, "--namespace", "search/1")
    ros.comes_to("is /search_1 in ROS domain 0")
    if late:
        assert not ros.says("is a search by several")
        search()
    ros.comes_to("search/1 is a search by several; --namespace search/1/uav/")


@pytest.mark.parametrize(
    ("words", "environment", "told"),
    [
        (["--domain", "233"], {}, "--domain: '233' is not allowed; wanted a whole number from 0 to 232"),
        (
            [],
            {"ROS_DOMAIN_ID": "x"},
            "ROS_DOMAIN_ID: 'x' is not allowed; wanted a whole number from 0 to 232",
        ),
        (["--distro", "foxy"], {}, "--distro: 'foxy' is not allowed"),
        (["--connect", "tcp/127.0.0.1:1"], {}, "no router"),
    ],
)
def test_bad_input_is_one_line(words: list[str], environment: dict[str, str], told: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sitl", "ros2", *words],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert told in done.stderr
    assert done.stderr.count("\n") == 1


def test_without_its_packages_it_says_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "rosbags.py").write_text("raise ModuleNotFoundError(name='rosbags')")
    done = subprocess.run(
        [sys.executable, "-m", "sitl", "ros2"],
        env={**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr == (
        "error: ros2 needs the package rosbags: install it with: pip install 'plumeward[ros2]'\n"
    )
