"""Protects what ROS may ask of the vehicle: no command overrides a pilot's, and hostile bytes reach nobody."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from ground.ros2 import rmw
from ground.ros2.orders import MALFORMED, MOST, MOST_TOLD, REFUSED, ROS_IDS, RosOrders
from ground.ros2.topics import ABORT, GOAL, PAUSE
from ground.ros2.wire import Wire
from link.bus.keys import HEALTH, MAVLINK_IN, MAVLINK_OUT, Key
from link.bus.mavlink import Codec, unpack
from link.bus.messages import Health
from link.bus.session import Arrival
from link.bus.tally import Tally
from scene.follow.history import begun

UAV = Codec(1, 1)
ATTACHED = rmw.attachment(1, 0, bytes(16))
HOLD, RETURN, GO_TO = (
    mavlink.MAV_CMD_DO_SET_MODE,
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH,
    mavlink.MAV_CMD_DO_REPOSITION,
)


class Log:
    def __init__(self) -> None:
        self.lines: list[str] = []

    def info(self, line: str) -> None:
        self.lines.append(line)

    warning = info


class Vehicle:
    """What the part knows of a vehicle, and what it sends."""

    def __init__(self) -> None:
        self.tally, self.log, self.sent = Tally(), Log(), []
        self.wire = Wire("jazzy")
        self.orders = RosOrders(self, self.wire)  # type: ignore[arg-type]
        self.history = begun({}, "uav/1")
        self.now_s = 0.0
        position = mavlink.MAVLink_local_position_ned_message(0, 2.0, 1.0, -5.0, 0, 0, 0)
        home = mavlink.MAVLink_home_position_message(
            475000000, 82500000, 488000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0
        )
        beat = mavlink.MAVLink_heartbeat_message(2, 12, 128, 0, 4, 3)
        self.says(beat, home, position)

    def publish(self, key: Key, message: bytes) -> None:
        assert key is MAVLINK_IN
        self.sent += unpack(message)

    def _hears(self, key: Key, name: str, payload: bytes) -> None:
        self.history.take(name, payload, b"", 0.0, 0.0)
        self.orders.hears(Arrival(key, payload, b"", name=name), self.history, self.now_s)

    def says(self, *messages: Any) -> None:
        self._hears(MAVLINK_OUT, MAVLINK_OUT.name, UAV.pack(*messages))

    def tells(self, text: str) -> None:
        self.says(mavlink.MAVLink_statustext_message(4, text.encode()))

    def is_in(self, state: str) -> None:
        import msgspec

        health = Health(
            service="uav", state=state, step=0, compute_s=0.0, uptime_s=1.0, refused={}, warnings=(), system=1
        )
        self._hears(HEALTH, "health/uav", msgspec.json.encode(health))

    def answers(self, result: int = mavlink.MAV_RESULT_ACCEPTED) -> None:
        """Acknowledge the newest command."""
        ack = mavlink.MAVLink_command_ack_message(
            self.sent[-1].command, result, target_system=ROS_IDS[0], target_component=ROS_IDS[1]
        )
        self.says(ack)
        self.orders.go_on(self.now_s + 1e6)

    def ask(self, topic: Any, message: Any, attached: bytes = ATTACHED) -> list[int]:
        """Ask for something; returns the numbers of the commands that went to the vehicle."""
        before = len(self.sent)
        data = self.wire.encode(topic.kind, message)
        self.orders.take(topic, data, attached, self.history, self.now_s)
        return [it.command for it in self.sent[before:]]

    def pause(self, yes: bool = True) -> list[int]:
        return self.ask(PAUSE, self.wire.make(PAUSE.kind, yes))

    def abort(self) -> list[int]:
        return self.ask(ABORT, self.wire.make(ABORT.kind))

    def goal(self, x: float, y: float, z: float, frame: str = "uav_1/map") -> list[int]:
        make = self.wire.make
        stamp = make("builtin_interfaces/msg/Time", 0, 0)
        pose = make(
            "geometry_msgs/msg/Pose",
            make("geometry_msgs/msg/Point", x, y, z),
            make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
        )
        return self.ask(GOAL, make(GOAL.kind, make("std_msgs/msg/Header", stamp, frame), pose))


@pytest.fixture
def searched() -> Vehicle:
    vehicle = Vehicle()
    vehicle.is_in("searching")
    return vehicle


def test_pause_and_abort_are_a_ground_station_s_commands(searched: Vehicle) -> None:
    assert searched.pause() == [HOLD]
    searched.answers()
    assert searched.abort() == [RETURN]
    assert (searched.sent[-1].get_srcSystem(), searched.sent[-1].get_srcComponent()) == ROS_IDS


def test_a_goal_is_a_place_on_the_earth_above_the_sea(searched: Vehicle) -> None:
    assert searched.goal(0.0, 111.1949, 8.0) == [GO_TO]
    sent = searched.sent[-1]
    assert sent.x == pytest.approx(475000000 + 10_000, abs=2)  # 0.001° of a sphere of 6,371 km
    assert (sent.y, sent.z, sent.frame) == (82500000, 496.0, mavlink.MAV_FRAME_GLOBAL)


def test_a_goal_without_a_height_keeps_it(searched: Vehicle) -> None:
    searched.goal(1.0, 1.0, 0.0)
    assert searched.sent[-1].z == 493.0


@pytest.mark.parametrize(
    "goal",
    [
        (float("nan"), 1.0, 1.0),
        (1.0, float("inf"), 1.0),
        (1.0, 1.0, -1.0),
        (1.0, 1.0, 1.0, "odom"),
        (1.7e308, 1.7e308, 1.0),
        (1.0, 1.0, 1e39),
        (40_030_173.0, 0.0, 5.0),  # once around the earth, and home again
    ],
)
def test_a_goal_that_is_nowhere_is_refused(searched: Vehicle, goal: tuple) -> None:
    assert searched.goal(*goal) == []
    assert searched.tally.refused == {REFUSED: 1}


def test_a_goal_too_far_away_is_refused_with_what_is_allowed(searched: Vehicle) -> None:
    searched.goal(100_001.0, 1.0, 1.0)
    said = "refused goal_pose: its position is below home, or not within 100,000 m of it"
    assert searched.log.lines == [said]


def takes(vehicle: Vehicle) -> None:
    vehicle.tells("Search gives way: HOLD by 255/190 on the bus")
    vehicle.is_in("paused")


def goes_on(vehicle: Vehicle) -> None:
    vehicle.pause()
    vehicle.answers()
    vehicle.tells("Search gives way: HOLD by 255/240 on the bus")
    vehicle.is_in("paused")
    vehicle.tells("LAND by a radio or a ground station")


@pytest.mark.parametrize("pilot", [takes, goes_on])
def test_a_pilot_s_command_is_never_overridden(searched: Vehicle, pilot: Callable[[Vehicle], None]) -> None:
    pilot(searched)
    refused = searched.tally.refused[REFUSED]
    assert [searched.pause(), searched.pause(False), searched.abort(), searched.goal(1.0, 1.0, 1.0)] == [
        []
    ] * 4
    assert searched.tally.refused[REFUSED] == refused + 4
    searched.tells("Search resumed by 255/190 on the bus")
    searched.is_in("searching")
    assert searched.pause() == [HOLD]


def test_a_vehicle_that_was_taken_before_we_came_is_a_pilot_s() -> None:
    vehicle = Vehicle()
    vehicle.is_in("paused")
    assert vehicle.pause(False) == []
    vehicle.is_in("returning")
    assert vehicle.abort() == []


def test_a_pause_whose_text_was_lost_is_a_pilot_s(searched: Vehicle) -> None:
    searched.is_in("paused")
    assert searched.pause(False) == []


def test_what_we_paused_we_may_resume(searched: Vehicle) -> None:
    searched.pause()
    searched.answers()
    searched.is_in("paused")
    assert searched.pause(False) == [HOLD]  # a change of mode, to OFFBOARD
    assert searched.sent[-1].param2 == 6


def test_nothing_is_asked_of_a_vehicle_that_does_not_fly(searched: Vehicle) -> None:
    searched.is_in("landed")
    assert searched.goal(1.0, 1.0, 1.0) == []
    assert "the search flies nothing" in searched.log.lines[-1]


def test_a_refusal_of_the_vehicle_is_told_with_its_reason(searched: Vehicle) -> None:
    searched.goal(1.0, 400.0, 5.0)
    ack = mavlink.MAVLink_command_ack_message(
        GO_TO, mavlink.MAV_RESULT_DENIED, target_system=255, target_component=240
    )
    searched.says(ack)
    searched.tells("Go-to refused: outside the area")
    searched.orders.go_on(0.1)
    assert searched.log.lines[-1].endswith("Go-to refused: outside the area")


def test_a_command_is_sent_again_until_it_is_acknowledged(searched: Vehicle) -> None:
    searched.pause()
    searched.orders.go_on(1.0)
    assert [it.confirmation for it in searched.sent] == [0, 1]


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0", b"\xff" * 5000, b"\0\1\0\0" + b"\xff" * 60])
def test_hostile_bytes_are_counted_told_and_dropped(searched: Vehicle, data: bytes) -> None:
    searched.orders.take(GOAL, data, ATTACHED, searched.history, searched.now_s)
    assert searched.sent == []
    assert searched.tally.refused == {MALFORMED: 1}
    assert searched.log.lines[-1].startswith("refused goal_pose: ")


def test_a_message_without_ros_s_attachment_is_dropped(searched: Vehicle) -> None:
    assert searched.ask(PAUSE, searched.wire.make(PAUSE.kind, True), b"") == []
    assert searched.tally.refused == {MALFORMED: 1}


def test_a_flood_of_commands_is_refused_but_an_abort_is_not(searched: Vehicle) -> None:
    assert [searched.pause() for _ in range(MOST + 1)] == [[HOLD]] * MOST + [[]]
    assert searched.abort() == [RETURN]


def test_a_command_that_is_refused_fifty_times_a_second_is_told_every_ten_seconds(searched: Vehicle) -> None:
    searched.is_in("landed")
    for tick in range(50 * 25):
        searched.now_s = tick / 50
        searched.pause()
    assert searched.tally.refused == {REFUSED: 50 * 25}
    assert len(searched.log.lines) == 3  # at 0, 10 and 20 s


def test_refusals_that_all_differ_do_not_flood_the_log(searched: Vehicle) -> None:
    for i in range(1000):
        searched.goal(1.0, 1.0, 1.0, frame=f"frame {i}")
    assert len(searched.log.lines) == MOST_TOLD
    searched.now_s = 10.0
    searched.goal(1.0, 1.0, 1.0, frame="another frame")
    assert "another frame" in searched.log.lines[-1]


def test_the_search_of_a_real_vehicle_gets_the_commands(searched: Vehicle) -> None:
    searched.history = SimpleNamespace(own=searched.history.own, is_real=True)  # type: ignore[assignment]
    assert searched.pause() == [mavlink.MAV_CMD_DO_PAUSE_CONTINUE]
    assert searched.sent[-1].target_component == 191
