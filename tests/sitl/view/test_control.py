"""Protects what a command sends, and that the page shows the vehicle's own answer and reason."""

import pytest
from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import Codec
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.operator import OPERATOR
from sitl.autopilot.state import Mode
from sitl.autopilot.vehicle import Vehicle
from sitl.protocol.protocol import MavlinkProtocol
from sitl.view.control import Awaited, CommandAnswer, CommandName, message

HOLD, RTL, LAND = mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, mavlink.MAV_CMD_NAV_LAND
UAV = Codec(1, 1)


def ack(number: int, result: int, target: tuple[int, int] = OPERATOR) -> object:
    return mavlink.MAVLink_command_ack_message(number, result, target_system=target[0], target_component=target[1])


def text(words: str) -> object:
    return mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_WARNING, words.encode())


class Flying:
    """The built-in vehicle, and what it answers to the page's commands."""

    def __init__(self, altitude_m: float = 5.0) -> None:
        self.vehicle = Vehicle(VehicleConfig())
        self.protocol = MavlinkProtocol(self.vehicle)
        self.now_s = 0.0
        if altitude_m:
            self.vehicle.arm(0.0)
            self.vehicle.take_off(0.0, altitude_m)
            self.now_s = 20.0
            self.vehicle.advance(self.now_s)

    def told(self, name: CommandName) -> CommandAnswer | None:
        said = message(name, system=1)
        said.pack(mavlink.MAVLink(None, *OPERATOR))
        awaited = Awaited(said.command, 0.0)
        return awaited.hears(UAV.pack(*self.protocol.receive(said, self.now_s)), 0.1) or awaited.over(0.1 + 0.3)

    @property
    def mode(self) -> Mode:
        return self.vehicle.state(self.now_s).mode


def test_a_vehicle_is_paused_and_resumed_at_its_last_waypoint() -> None:
    uav, waypoint = Flying(), (3.0, 4.0, -5.0)
    uav.vehicle.setpoint(uav.now_s, waypoint)
    assert uav.told("resume") == CommandAnswer(True)
    assert uav.mode is Mode.OFFBOARD
    assert uav.told("pause") == CommandAnswer(True)
    assert uav.mode is Mode.HOLD
    assert uav.told("resume") == CommandAnswer(True)
    assert uav.mode is Mode.OFFBOARD
    assert uav.vehicle.waypoint == waypoint


@pytest.mark.parametrize(("name", "mode"), [("return", Mode.RETURN), ("abort", Mode.LAND)])
def test_return_flies_home_and_abort_lands_here(name: CommandName, mode: Mode) -> None:
    uav = Flying()
    assert uav.told(name) == CommandAnswer(True)
    assert uav.mode is mode


def test_a_refusal_comes_with_the_vehicles_reason() -> None:
    assert Flying().told("resume") == CommandAnswer(False, "Offboard refused: no setpoint received yet")
    assert Flying(altitude_m=0.0).told("return") == CommandAnswer(False, "Return refused: on the ground")


def test_a_long_reason_is_joined_from_its_chunks() -> None:
    awaited, words = Awaited(RTL, 0.0), "Return refused: " + "the reason goes on " * 5
    said = MavlinkProtocol(Vehicle(VehicleConfig())).statustext(mavlink.MAV_SEVERITY_WARNING, words)
    assert len(said) == 3  # 111 characters, 50 in each
    assert awaited.hears(UAV.pack(ack(RTL, mavlink.MAV_RESULT_DENIED), *said), 0.1) == CommandAnswer(False, words)


def test_a_reason_may_come_a_little_later_and_may_be_missing() -> None:
    awaited = Awaited(RTL, 0.0)
    assert awaited.hears(UAV.pack(ack(RTL, mavlink.MAV_RESULT_DENIED)), 0.1) is None
    assert awaited.hears(UAV.pack(text("Return refused: no home")), 0.2) == CommandAnswer(False, "Return refused: no home")
    awaited = Awaited(RTL, 0.0)
    awaited.hears(UAV.pack(ack(RTL, mavlink.MAV_RESULT_UNSUPPORTED)), 0.1)
    assert awaited.over(0.3) is None
    assert awaited.over(0.45) == CommandAnswer(False, "the vehicle does not know this command")


def test_answers_to_other_commands_and_stations_and_other_texts_are_not_ours() -> None:
    awaited = Awaited(RTL, 0.0)
    accepted = mavlink.MAV_RESULT_ACCEPTED
    for said in (ack(LAND, accepted), ack(RTL, accepted, (254, 190)), ack(RTL, accepted, (255, 1)), text("Landed"),
                    ack(RTL, mavlink.MAV_RESULT_IN_PROGRESS)):  # fmt: skip
        assert awaited.hears(UAV.pack(said), 0.1) is None
    assert awaited.hears(b"\xfd garbage", 0.1) is None
    assert awaited.hears(UAV.pack(ack(RTL, accepted)), 0.1) == CommandAnswer(True)


def test_a_vehicle_that_says_nothing_has_not_accepted() -> None:
    awaited = Awaited(HOLD, 10.0)
    assert awaited.over(11.9) is None
    assert awaited.over(12.0) == CommandAnswer(False, "no answer within 2 s")
