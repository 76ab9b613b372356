"""Protects what a command sends, and that the page shows the vehicle's own answer and reason."""

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.operator import AUTOPILOT, OPERATOR_IDS, SEARCH, CommandName
from ground.view.control import Awaited, CommandAnswer
from link.bus.mavlink import Codec
from link.modes import Mode
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.protocol import MavlinkProtocol
from sitl.autopilot.vehicle import Vehicle

RTL, LAND = mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH, mavlink.MAV_CMD_NAV_LAND
ACCEPTED, DENIED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
UAV = Codec(1, 1)


def ack(number: int, result: int, target: tuple[int, int] = OPERATOR_IDS) -> object:
    return mavlink.MAVLink_command_ack_message(
        number, result, target_system=target[0], target_component=target[1]
    )


def text(words: str) -> object:
    return mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_WARNING, words.encode())


def beat(mode: Mode, armed: bool = True) -> object:
    flags = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
    return mavlink.MAVLink_heartbeat_message(2, 12, flags, mode.custom_mode, 4, 3)


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
        awaited = Awaited(name, system=1)
        said = awaited.run.send(0.0)
        assert said is not None
        said.pack(mavlink.MAVLink(None, *OPERATOR_IDS))
        awaited.hears(UAV.pack(*self.protocol.receive(said, self.now_s)), 0.1)
        awaited.hears(UAV.pack(beat(self.mode, self.vehicle.armed)), 0.2)
        return awaited.over(0.5)

    @property
    def mode(self) -> Mode:
        return self.vehicle.state(self.now_s).mode


def awaited(name: CommandName = "return") -> Awaited:
    """A command that has been sent once."""
    command = Awaited(name, system=1)
    assert command.run.send(0.0)
    return command


def test_a_vehicle_is_held_and_resumed_at_its_last_waypoint() -> None:
    uav, waypoint = Flying(), (3.0, 4.0, -5.0)
    uav.vehicle.setpoint(uav.now_s, waypoint)
    assert uav.told("resume") == CommandAnswer(True)
    assert uav.mode is Mode.OFFBOARD
    assert uav.told("hold") == CommandAnswer(True)
    assert uav.mode is Mode.HOLD
    assert uav.told("resume") == CommandAnswer(True)
    assert uav.mode is Mode.OFFBOARD
    assert uav.vehicle.waypoint == waypoint


@pytest.mark.parametrize(("name", "mode"), [("return", Mode.RETURN), ("land", Mode.LAND)])
def test_return_flies_home_and_land_lands_here(name: CommandName, mode: Mode) -> None:
    uav = Flying()
    assert uav.told(name) == CommandAnswer(True)
    assert uav.mode is mode


def test_a_refusal_comes_with_the_vehicles_reason() -> None:
    assert Flying().told("resume") == CommandAnswer(False, "Offboard refused: no setpoint received yet")
    assert Flying(altitude_m=0.0).told("return") == CommandAnswer(False, "Return refused: on the ground")


def test_a_long_reason_is_joined_from_its_chunks() -> None:
    command, words = awaited(), "Return refused: " + "the reason goes on " * 5
    said = MavlinkProtocol(Vehicle(VehicleConfig())).statustext(mavlink.MAV_SEVERITY_WARNING, words)
    assert len(said) == 3  # 111 characters, 50 in each
    command.hears(UAV.pack(ack(RTL, DENIED), *said), 0.1)
    assert command.over(0.1) == CommandAnswer(False, words)


def test_a_reason_may_come_a_little_later_and_may_be_missing() -> None:
    command = awaited()
    command.hears(UAV.pack(text("Battery low"), ack(RTL, DENIED)), 0.1)
    assert command.over(0.1) is None
    command.hears(UAV.pack(text("Return refused: no home")), 0.2)
    assert command.over(0.2) == CommandAnswer(False, "Return refused: no home")
    command = awaited()
    command.hears(UAV.pack(ack(RTL, mavlink.MAV_RESULT_UNSUPPORTED)), 0.1)
    assert command.over(0.3) is None
    assert command.over(0.45) == CommandAnswer(False, "the vehicle does not know this command")


def test_answers_to_other_commands_and_stations_and_those_of_other_systems_are_not_ours() -> None:
    command = awaited()
    for said in (ack(LAND, DENIED), ack(RTL, DENIED, (254, 190)), ack(RTL, DENIED, (255, 1)), text("Landed")):
        command.hears(UAV.pack(said), 0.1)
    command.hears(b"\xfd garbage", 0.1)
    for sender in ((42, 1), (1, 191)):
        command.hears(Codec(*sender).pack(ack(RTL, DENIED), beat(Mode.RETURN)), 0.1)
    assert command.over(1.0) is None
    assert command.run.send(1.0)  # nobody has acknowledged it


def test_it_is_done_when_telemetry_shows_it_or_what_comes_of_it() -> None:
    command = awaited()
    command.hears(UAV.pack(ack(RTL, ACCEPTED)), 0.1)
    assert command.over(1.0) is None
    command.hears(UAV.pack(beat(Mode.HOLD)), 1.0)
    assert command.over(1.0) is None
    command.hears(UAV.pack(beat(Mode.LAND)), 1.2)  # it was nearly home
    assert command.over(1.2) == CommandAnswer(True)
    command = awaited("land")
    command.hears(UAV.pack(beat(Mode.HOLD, armed=False)), 0.1)
    assert command.over(0.1) is None  # it stands, and may refuse
    command.hears(UAV.pack(ack(LAND, ACCEPTED)), 0.1)
    assert command.over(0.1) == CommandAnswer(True)


def test_a_vehicle_that_says_nothing_has_not_accepted() -> None:
    command = Awaited("hold", system=1)
    sent_s = [ms / 1000 for ms in range(3000) if command.run.send(ms / 1000)]
    assert sent_s == pytest.approx([0.0, 0.4, 0.8, 1.2, 1.6], abs=0.01)
    assert command.over(1.9) is None
    assert command.over(2.01) == CommandAnswer(False, "no answer within 2 s")


# ---- the search that flies a real autopilot ----

COPTER, SEARCHER = Codec(32, AUTOPILOT), Codec(32, SEARCH)
PAUSE = mavlink.MAV_CMD_DO_PAUSE_CONTINUE


def copter_beat(custom_mode: int, armed: bool = True) -> bytes:
    return COPTER.pack(
        mavlink.MAVLink_heartbeat_message(
            2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 128 * armed + 1, custom_mode, 4, 3
        )
    )


@pytest.mark.parametrize(
    ("name", "number", "first"),
    [("hold", PAUSE, 0.0), ("resume", PAUSE, 1.0), ("return", RTL, 0.0), ("land", LAND, 0.0)],
)
def test_a_real_vehicles_search_gets_the_word_and_answers_it(
    name: CommandName, number: int, first: float
) -> None:
    command = Awaited(name, system=32, component=SEARCH)
    said = command.run.send(0.0)
    assert said is not None
    assert (said.target_system, said.target_component, said.command, said.param1) == (32, 191, number, first)
    command.hears(COPTER.pack(ack(number, DENIED)), 0.1)  # the autopilot was not asked
    assert command.over(0.2) is None
    command.hears(SEARCHER.pack(ack(number, DENIED), text(f"{name} refused: not now")), 0.3)
    assert command.over(0.3) == CommandAnswer(False, f"{name} refused: not now")


@pytest.mark.parametrize(
    ("name", "number", "custom_mode"),
    [("hold", PAUSE, 17), ("return", RTL, 6), ("land", LAND, 9), ("resume", PAUSE, 4)],
)
def test_a_word_is_done_when_the_copter_is_in_the_firmwares_mode_of_it(
    name: CommandName, number: int, custom_mode: int
) -> None:
    command = Awaited(name, system=32, component=SEARCH)
    assert command.run.send(0.0)
    command.hears(copter_beat(5), 0.1)  # LOITER is none of them
    command.hears(SEARCHER.pack(ack(number, ACCEPTED)), 0.1)
    assert command.over(1.0) is None
    command.hears(copter_beat(custom_mode), 1.1)
    assert command.over(1.1) == CommandAnswer(True)


def test_a_copter_in_guided_is_not_given_back_before_its_search_says_so() -> None:
    command = Awaited("resume", system=32, component=SEARCH)
    assert command.run.send(0.0)
    command.hears(copter_beat(4), 0.1)  # a pilot's own go-to
    assert command.over(0.2) is None
    command.hears(SEARCHER.pack(ack(PAUSE, ACCEPTED)), 0.3)
    assert command.over(0.3) == CommandAnswer(True)
