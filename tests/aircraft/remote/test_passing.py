"""Protects what a real vehicle's clients see and may do: its autopilot's own frames, as it said them, and
theirs handed on to it.
"""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.operator import SEARCH, CommandName, command, order
from aircraft.search.search import PAUSED, SEARCHING
from link.bus.mavlink import POSITION_ONLY, Codec, Message
from tests.aircraft.remote.cockpit import Cockpit

KINDS = ("ardupilot", "px4")
both = pytest.mark.parametrize("kind", KINDS)
ACCEPTED, REJECTED, UNSUPPORTED = 0, 1, 3


def searching(kind: str, *faults: str, **settings: Any) -> Cockpit:
    """A search that has taken its first reading."""
    cockpit = Cockpit(kind, *faults, **settings)
    cockpit.reads(1)
    return cockpit


@contextmanager
def station() -> Iterator[socket.socket]:
    """A ground station's socket."""
    with socket.socket(type=socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        one.setblocking(False)
        yield one


def out(one: socket.socket) -> str:
    return f"udpout:127.0.0.1:{one.getsockname()[1]}"


def received(one: socket.socket) -> list[bytes]:
    """All datagrams that have come."""
    came = []
    while True:
        try:
            came.append(one.recv(65535))
        except BlockingIOError:
            return came


def of(component: int, frames: list[bytes]) -> list[bytes]:
    return [frame for frame in frames if frame[6] == component]


def decoded(frames: list[bytes], kind: str) -> list[Message]:
    messages = [mavlink.MAVLink(None).decode(bytearray(frame)) for frame in frames]
    return [message for message in messages if message.get_type() == kind]


@both
def test_what_the_autopilot_says_reaches_the_bus_and_every_out_byte_for_byte_under_its_own_id(
    kind: str,
) -> None:
    """It has lost its GPS, does not know its battery, and is tilted: so it is seen."""
    with station() as one, station() as other:
        cockpit = Cockpit(kind, "gps@+6", instance=31, outs=(out(one), out(other)))
        cockpit.ap.battery_percent = -1
        cockpit.until(lambda: cockpit.ap.armed)
        for number, rate_hz in ((24, 5.0), (33, 5.0)):  # as a ground station asks
            cockpit.tell(command(32, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / rate_hz))
        cockpit.until(lambda: cockpit.ap.faults.on("gps"))
        cockpit.run(2.0)
        came = received(one)
        said = of(1, came)
        assert said == cockpit.radio.said == cockpit.bus.frames(1) == of(1, received(other))
    assert {(frame[5], frame[6]) for frame in came} == {(32, 1), (32, 191)}
    fix = decoded(said, "GPS_RAW_INT")[-1]
    assert (fix.fix_type, fix.satellites_visible) == (0, 0)
    assert decoded(said, "SYS_STATUS")[-1].battery_remaining == -1
    assert any(message.roll and message.pitch for message in decoded(said, "ATTITUDE"))
    assert not decoded(came, "ALTITUDE"), "what the autopilot does not say is not there"
    assert len(cockpit.bus.published) < len(came) / 2, "what has come at a time is one publication"


@both
def test_nothing_is_said_in_the_name_of_a_vehicle_that_is_not_there_yet(kind: str) -> None:
    cockpit = Cockpit(kind, "mute")
    cockpit.run(5.0)
    cockpit.clients.tell(4, "Waiting")
    assert cockpit.tell(order("hold", 1, SEARCH)) == []
    assert cockpit.clients.system == 0
    assert cockpit.bus.published == []


@both
def test_beside_the_autopilot_the_search_is_an_onboard_controller(kind: str) -> None:
    cockpit = searching(kind, instance=31)
    beats = [message for message in cockpit.bus.heard() if message.get_type() == "HEARTBEAT"]
    assert {(beat.get_srcSystem(), beat.get_srcComponent()) for beat in beats} == {(32, 191)}
    assert {(beat.type, beat.autopilot) for beat in beats} == {
        (mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID)
    }
    cockpit.clients.tell(4, "a word")
    assert cockpit.bus.heard()[-1].text == "a word"


def test_the_parameters_of_the_autopilot_are_a_stations_on_out() -> None:
    with station() as one:
        cockpit = searching("ardupilot", outs=(out(one),))
        _, link = one.recvfrom(65535)
        received(one)
        one.sendto(
            Codec(255, 190).pack(mavlink.MAVLink_param_request_read_message(1, 1, b"RTL_ALT", -1)), link
        )
        cockpit.until(
            lambda: [value for value in decoded(received(one), "PARAM_VALUE") if value.param_id == "RTL_ALT"],
            10.0,
        )


WAYS = (
    mavlink.MAVLink_param_request_list_message(1, 1),
    mavlink.MAVLink_param_request_list_message(1, 0),
    mavlink.MAVLink_mission_count_message(1, 1, 3, 0),
    command(1, mavlink.MAV_CMD_DO_REPOSITION, -1.0),
    mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
)
"""What is for the autopilot, or for all."""


@pytest.mark.parametrize("message", WAYS, ids=lambda message: message.get_type())
def test_what_is_for_the_autopilot_or_for_all_is_handed_on_unchanged(message: Message) -> None:
    cockpit = searching("ardupilot")
    cockpit.radio.forwarded.clear()
    frame = Codec(250, 42).pack(message)
    cockpit.hear(frame)
    assert cockpit.radio.forwarded == [frame]
    assert cockpit.bus.frames(42) == [], "it does not go back to where it came from"


@pytest.mark.parametrize(
    ("message", "sender"),
    [
        (mavlink.MAVLink_param_request_list_message(2, 1), (250, 42)),
        (mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), (1, 1)),
        (mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), (1, 191)),
        (mavlink.MAVLink_setup_signing_message(1, 1, [0] * 32, 0), (250, 42)),
        (mavlink.MAVLink_param_request_list_message(1, 191), (250, 42)),
    ],
    ids=["another vehicle's", "as the autopilot", "as the search", "a key", "for the search"],
)
def test_what_is_not_for_the_autopilot_or_comes_in_its_name_is_not_handed_on(
    message: Message, sender: tuple[int, int]
) -> None:
    cockpit = searching("ardupilot")
    cockpit.radio.forwarded.clear()
    cockpit.tell(message, sender)
    assert cockpit.radio.forwarded == []


# ---- the search and its clients ----


def word(cockpit: Cockpit, name: CommandName) -> int:
    """Say a word to the search; returns the result that it acknowledges with."""
    (ack,) = [answer for answer in cockpit.tell(order(name, 1, SEARCH)) if answer.get_type() == "COMMAND_ACK"]
    assert (ack.get_srcSystem(), ack.get_srcComponent(), ack.target_system, ack.target_component) == (
        1,
        191,
        255,
        190,
    )
    return int(ack.result)


@both
def test_the_four_words_are_obeyed(kind: str) -> None:
    cockpit = searching(kind)
    assert word(cockpit, "hold") == ACCEPTED
    cockpit.until(lambda: cockpit.ap.mode in ("BRAKE", "HOLD"), 10.0)
    cockpit.run(2.0)
    assert cockpit.search.state == PAUSED
    assert cockpit.heard("Search gives way: HOLD by 255/190 on the bus")
    assert word(cockpit, "resume") == ACCEPTED
    cockpit.reads(len(cockpit.readings) + 1)
    assert cockpit.search.state == SEARCHING
    assert cockpit.heard("Search resumed by 255/190 on the bus")
    assert word(cockpit, "return") == ACCEPTED
    cockpit.until(lambda: cockpit.ap.mode in ("RTL", "RETURN"), 10.0)
    assert word(cockpit, "land") == ACCEPTED
    cockpit.until(lambda: cockpit.ap.mode == "LAND", 10.0)


def test_what_the_search_cannot_do_is_refused_with_a_reason() -> None:
    cockpit = Cockpit("ardupilot")
    cockpit.until(lambda: cockpit.clients.system)
    assert word(cockpit, "hold") == REJECTED
    assert "the search flies nothing" in "".join(
        said.text for said in cockpit.bus.heard() if said.get_type() == "STATUSTEXT"
    )
    for number in (mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_CMD_DO_PAUSE_CONTINUE):
        assert cockpit.tell(command(1, number, 7.0, component=191))[0].result == UNSUPPORTED


def test_who_changed_the_mode_over_the_bus_is_named() -> None:
    cockpit = searching("ardupilot", radio=True)
    cockpit.tell(command(1, mavlink.MAV_CMD_DO_SET_MODE, 1.0, 5.0), (250, 42))
    cockpit.until(lambda: cockpit.search.state == PAUSED, 10.0)
    assert cockpit.ap.mode == "LOITER"
    assert cockpit.heard("Search gives way: LOITER by 250/42 on the bus")


@pytest.mark.parametrize(
    "asked",
    [
        command(1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0),  # no mode comes of it
        command(1, mavlink.MAV_CMD_DO_SET_MODE, 1.0, 99.0),  # the autopilot refuses it: there is no such mode
    ],
    ids=["arm", "refused"],
)
def test_a_failsafe_is_not_taken_for_a_client_whose_command_changes_no_mode(asked: Any) -> None:
    """A client that asks again and again: else the vehicle would hover outside its fence for ever."""
    cockpit = searching("ardupilot", "fence@#3", parameters={"FENCE_ACTION": 4})

    def has_failed() -> str:
        cockpit.tell(asked, (250, 42))
        return cockpit.vehicle.failure

    cockpit.until(has_failed)
    assert "by its failsafe" in cockpit.vehicle.failure
    cockpit.until(lambda: cockpit.ap.landed)


def test_setpoints_of_others_are_refused_while_the_search_leads_and_handed_on_when_it_does_not() -> None:
    cockpit = searching("ardupilot")
    setpoint = mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, POSITION_ONLY, 1.0, 1.0, -5.0, *[0.0] * 8
    )
    cockpit.radio.forwarded.clear()
    (said,) = cockpit.tell(setpoint)
    assert said.text == "Setpoint refused: the search leads, HOLD stops it"
    assert cockpit.tell(setpoint) == [], "told once a second"
    assert cockpit.radio.forwarded == []
    word(cockpit, "hold")
    cockpit.tell(setpoint)
    assert len(cockpit.radio.forwarded) == 1


def test_an_acknowledgement_for_a_client_is_not_taken_for_one_for_the_search() -> None:
    """The client's change of mode is refused while that of the search is under way."""
    cockpit = searching("ardupilot", "mode@#3:4")
    cockpit.until(lambda: cockpit.ap.faults.on("mode"))
    cockpit.tell(command(1, mavlink.MAV_CMD_DO_SET_MODE, 1.0, 4.0), (250, 42))
    cockpit.finds()
    cockpit.until(lambda: not cockpit.ap.armed)
    assert not cockpit.heard("refused")
