"""Protects a command on a link that loses messages: it is sent until it is done, carried out once, and
answered.
"""

from collections.abc import Callable, Iterator
from itertools import count

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.operator import OPERATOR_IDS, CommandRun, command
from aircraft.state import Result
from link.bus.mavlink import Message
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.protocol import MavlinkProtocol
from sitl.autopilot.vehicle import Vehicle

RETURN = mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH
TRIES, EVERY_S, STEP_S = 5, 0.5, 0.1


class Flight:
    """The built-in vehicle in the air, on a link that loses what a test says, and what is seen of it once
    a second.
    """

    def __init__(self) -> None:
        self.vehicle = Vehicle(VehicleConfig())
        self.protocol = MavlinkProtocol(self.vehicle)
        self.vehicle.arm(0.0)
        self.vehicle.take_off(0.0, 5.0)
        self.vehicle.advance(20.0)
        self.seen = self.reason = ""
        self.sent: list[Message] = []
        self.run = CommandRun(command(1, RETURN), lambda: self.seen == "RETURN", lambda: self.reason, EVERY_S)

    def answer(
        self, loses: Callable[[int], bool] = lambda _: False, deaf: Callable[[int], bool] = lambda _: False
    ) -> Result:
        """What becomes of the command. loses: whether the link loses copy n; deaf: whether it loses the
        answer to copy n.
        """
        for step in count():
            now_s = 20.0 + STEP_S * step
            if copy := self.run.send(now_s):
                self.sent.append(copy)
                copy.pack(mavlink.MAVLink(None, *OPERATOR_IDS))
                answers = [] if loses(copy.confirmation) else self.protocol.receive(copy, now_s)
                for said in [] if deaf(copy.confirmation) else answers:
                    if said.get_type() == "COMMAND_ACK":
                        self.run.acknowledged(said.command, said.result, now_s)
                    else:
                        self.reason = said.text
            if step % 10 == 9:
                self.seen = self.vehicle.mode.name
            if result := self.run.over(now_s):
                return result
        raise AssertionError


@pytest.fixture
def flight() -> Flight:
    return Flight()


def test_a_command_is_sent_once_where_nothing_is_lost(flight: Flight) -> None:
    assert flight.answer().accepted
    assert [copy.confirmation for copy in flight.sent] == [0]


def test_lost_copies_are_sent_again_with_their_number_until_one_is_acknowledged(flight: Flight) -> None:
    assert flight.answer(loses=lambda copy: copy < 3).accepted
    assert [copy.confirmation for copy in flight.sent] == [0, 1, 2, 3]
    assert flight.vehicle.mode.name == "RETURN"


def test_lost_acknowledgements_are_made_up_for_by_what_is_seen(flight: Flight) -> None:
    assert flight.answer(deaf=lambda _: True).accepted
    assert len(flight.sent) == 2  # it is seen after a second


def test_a_refusal_whose_first_acknowledgement_is_lost_comes_with_its_reason(flight: Flight) -> None:
    flight.vehicle.set_mode(20.0, flight.vehicle.mode.LAND)
    flight.vehicle.advance(60.0)
    flight.vehicle = Vehicle(VehicleConfig())  # it stands on the ground
    flight.protocol = MavlinkProtocol(flight.vehicle)
    answer = flight.answer(deaf=lambda copy: copy < 2)
    assert (answer.accepted, answer.reason) == (False, "Return refused: on the ground")
    assert len(flight.sent) == 3


def test_a_command_that_nobody_hears_is_given_up_and_not_sent_again(flight: Flight) -> None:
    assert flight.answer(loses=lambda _: True).reason == "no answer"
    assert len(flight.sent) == TRIES
    assert flight.run.send(1000.0) is None


# ---- answers by hand ----


@pytest.fixture
def run() -> Iterator[CommandRun]:
    yield (run := CommandRun(command(1, RETURN), lambda: False, lambda: "", EVERY_S))
    assert run.send(1e6) is None


def test_what_is_acknowledged_and_never_seen_is_not_done(run: CommandRun) -> None:
    run.send(0.0)
    run.acknowledged(RETURN, mavlink.MAV_RESULT_ACCEPTED, 0.1)
    assert run.over(3.0) is None
    assert run.over(3.2).reason == "acknowledged, and not done"


def test_progress_is_waited_for_without_copies_and_the_next_result_counts(run: CommandRun) -> None:
    run.send(0.0)
    run.acknowledged(RETURN, mavlink.MAV_RESULT_IN_PROGRESS, 0.1)
    assert run.send(1.0) is None
    assert run.over(9.9) is None
    run.acknowledged(RETURN, mavlink.MAV_RESULT_FAILED, 10.0)
    assert run.over(10.2) is None  # a reason may come
    assert run.over(10.4).reason == "the vehicle could not do it"


def test_the_first_result_counts_and_that_of_another_command_does_not(run: CommandRun) -> None:
    run.send(0.0)
    run.acknowledged(mavlink.MAV_CMD_NAV_LAND, mavlink.MAV_RESULT_ACCEPTED, 0.1)
    run.acknowledged(RETURN, mavlink.MAV_RESULT_DENIED, 0.2)
    run.acknowledged(RETURN, mavlink.MAV_RESULT_ACCEPTED, 0.2)
    assert run.over(0.6).reason == "the vehicle refuses it"
    assert not run.over(0.6).accepted
