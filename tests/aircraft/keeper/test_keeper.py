"""Protects a vehicle in the air from a uav that hangs or is killed: its keeper sends it home, and leaves a
pilot's vehicle alone.
"""

import math
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from aircraft.keeper.keeper import GIVEN_UP_S, SILENT_S, Keeper
from aircraft.operator import companion_heartbeat
from link.bus.frames import FrameStream
from link.bus.mavlink import ONBOARD_COMPUTER, Codec, Message
from tests.aircraft.remote.cockpit import STEPS, Cockpit, Radio
from tests.autopilots.body import DT_S
from tests.autopilots.wire import Wire

KINDS = ("ardupilot", "px4")
PATIENT: dict[str, dict[str, float]] = {"ardupilot": {}, "px4": {"COM_OF_LOSS_T": 60.0}}
"""Parameters with which an autopilot does nothing itself when its companion falls silent."""


class KeptRadio(Radio):
    """A radio with a keeper between both sides."""

    def __init__(self, wire: Wire) -> None:
        super().__init__(wire)
        self.stacks = 0
        """How often the keeper has asked the uav for its stack."""
        self.keeper = Keeper(self._of_the_keeper, lambda _, text: self.told.append(text), self._asked)
        self.told: list[str] = []
        self.commands: list[int] = []
        """What the keeper has commanded."""
        self.now_s = 0.0
        self._keepers = Codec(1, ONBOARD_COMPUTER)
        self._from_uav, self._from_autopilot = FrameStream(), FrameStream()

    @property
    def sent_home(self) -> str:  # type: ignore[override]
        return self.keeper.acted

    def send(self, message: Message) -> None:
        self.sent.append(message)
        self.forward(self._codec.pack(message))

    def forward(self, frame: bytes) -> None:
        for said in self._from_uav.take(frame):
            if self.keeper.passes(said, self.now_s):
                self.wire.hear(said.data)

    def _of_the_keeper(self, message: Message) -> None:
        self.commands.append(message.command)
        self.wire.hear(self._keepers.pack(message))

    def _asked(self) -> None:
        self.stacks += 1

    def lose(self) -> None:
        """What has come is lost: a link holds so much only."""
        self._heard.clear()

    def advance(self) -> None:
        self.now_s += STEPS * DT_S
        for frame in self.wire.advance(STEPS):
            for said in self._from_autopilot.take(frame):
                self.keeper.hear(said, self.now_s)
            self._heard += self._parser.parse_buffer(frame) or ()
        self.keeper.look(self.now_s)


class Kept(Cockpit):
    """A cockpit whose uav may hang or end."""

    radio: KeptRadio

    def __init__(self, kind: str, *faults: str, **settings: Any) -> None:
        super().__init__(kind, *faults, **settings)
        self.radio = KeptRadio(self.wire)
        self.vehicle.flight.commander.radio = self.radio

    @property
    def keeper(self) -> Keeper:
        return self.radio.keeper

    def hangs(self, seconds: float) -> None:
        """The uav does nothing for so long."""
        for _ in range(round(seconds / (STEPS * DT_S))):
            self.radio.advance()
            self.now_s += STEPS * DT_S

    def hangs_until(self, holds: Callable[[], object], most_s: float = 120.0) -> None:
        """The uav does nothing until something holds."""
        until_s = self.now_s + most_s
        while not holds():
            assert self.now_s < until_s, f"not true within {most_s:g} s; the keeper said: {self.radio.told}"
            self.hangs(STEPS * DT_S)

    @property
    def from_home_m(self) -> float:
        return math.dist(self.ap.body.position, self.ap.home)


def before_arming(kept: Kept) -> None:
    kept.until(lambda: kept.vehicle.flight.commander.system)


def arming(kept: Kept) -> None:
    kept.until(lambda: kept.ap.armed)


def taking_off(kept: Kept) -> None:
    kept.until(lambda: kept.ap.body.position[2] < kept.ap.home[2] - 1.0)


def on_the_way(kept: Kept) -> None:
    kept.reads(1)
    targets = kept.ap.targets
    kept.until(lambda: kept.ap.targets > targets)


def measuring(kept: Kept) -> None:
    kept.answers = lambda _: None
    kept.reads(1)


def returning(kept: Kept) -> None:
    kept.reads(1)
    kept.finds()
    kept.until(lambda: kept.ap.mode == "RTL")


IN_FLIGHT = (taking_off, on_the_way, measuring)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("phase", IN_FLIGHT)
def test_a_vehicle_whose_uav_hangs_in_flight_is_sent_home(kind: str, phase: Callable[[Kept], None]) -> None:
    kept = Kept(kind, parameters=PATIENT[kind])
    phase(kept)
    kept.hangs(SILENT_S - 1.0)
    assert not kept.radio.commands
    kept.hangs_until(lambda: kept.ap.mode == "RTL", 5.0)
    assert kept.radio.told == ["The keeper sends the vehicle home: the uav was silent for 3 s"]
    assert kept.radio.stacks == 1
    kept.hangs_until(lambda: not kept.ap.armed)
    assert kept.from_home_m < 0.5
    assert kept.radio.told[1] == f"The vehicle is left in {'RTL' if kind == 'ardupilot' else 'RETURN'}"


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("phase", IN_FLIGHT)
def test_a_vehicle_whose_uav_is_killed_in_flight_is_sent_home_at_once(
    kind: str, phase: Callable[[Kept], None]
) -> None:
    kept = Kept(kind)
    phase(kept)
    kept.keeper.gone()
    kept.hangs_until(lambda: kept.ap.mode == "RTL", 2.0)
    kept.hangs_until(lambda: kept.keeper.over, 2.0)
    assert kept.radio.told[0] == "The keeper sends the vehicle home: the uav has ended"
    assert not kept.radio.stacks
    kept.hangs_until(lambda: not kept.ap.armed)
    assert kept.from_home_m < 0.5


def beat_of(system: int, state: int) -> bytes:
    """A HEARTBEAT of another vehicle's companion computer."""
    return Codec(system, ONBOARD_COMPUTER).pack(companion_heartbeat(state))


@pytest.mark.parametrize("ends", [False, True], ids=["hangs", "killed"])
def test_companions_of_other_vehicles_hide_neither_the_uavs_silence_nor_its_vehicle(ends: bool) -> None:
    """Their HEARTBEATs come through the uav, from a router say, the last of them after its own last one."""
    kept = Kept("ardupilot")
    kept.reads(2)
    strangers = [beat_of(42, mavlink.MAV_STATE_ACTIVE), beat_of(7, mavlink.MAV_STATE_STANDBY)]
    for frame in strangers:
        kept.radio.forward(frame)
    if ends:
        kept.keeper.gone()
    kept.hangs_until(lambda: kept.ap.mode == "RTL", 5.0)
    assert [kept.keeper.passes(each, 0.0) for each in FrameStream().take(b"".join(strangers))] == [True, True]


@pytest.mark.parametrize("ends", [False, True], ids=["hangs", "killed"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_vehicle_whose_uav_stops_while_it_arms_is_disarmed_on_the_ground(kind: str, ends: bool) -> None:
    kept = Kept(kind)
    arming(kept)
    if ends:
        kept.keeper.gone()
    kept.hangs_until(lambda: not kept.ap.armed, SILENT_S + 3.0)  # both autopilots do it themselves after 10 s
    assert mavlink.MAV_CMD_DO_SET_MODE not in kept.radio.commands
    assert kept.ap.landed
    assert kept.radio.told[0].startswith("The keeper stops the motors: the uav ")


def test_a_uav_that_is_killed_just_as_it_arms_leaves_no_motors_running() -> None:
    kept = Kept("ardupilot")
    kept.until(
        lambda: any(
            getattr(message, "command", 0) == mavlink.MAV_CMD_COMPONENT_ARM_DISARM
            for message in kept.radio.sent
        )
    )
    kept.keeper.gone()
    kept.hangs_until(lambda: kept.keeper.over, 20.0)
    assert not kept.ap.armed


@pytest.mark.parametrize("kind", KINDS)
def test_a_keeper_has_nothing_to_do_before_arming_and_ends_with_the_uav(kind: str) -> None:
    kept = Kept(kind, "arm")
    before_arming(kept)
    kept.hangs(60.0)
    assert (kept.radio.commands, kept.radio.told, kept.keeper.over) == ([], [], False)
    kept.run(5.0)
    assert not kept.radio.sent_home
    kept.keeper.gone()
    kept.hangs_until(lambda: kept.keeper.over, 6.0)


@pytest.mark.parametrize("ends", [False, True], ids=["hangs", "killed"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_vehicle_that_returns_already_is_left_to_it(kind: str, ends: bool) -> None:
    kept = Kept(kind)
    returning(kept)
    kept.run(1.5)  # the HEARTBEAT says so
    if ends:
        kept.keeper.gone()
    kept.hangs_until(lambda: not kept.ap.armed)
    assert not kept.radio.commands
    assert kept.keeper.over == ends


@pytest.mark.parametrize("kind", KINDS)
def test_a_pilot_who_flies_it_when_the_uav_hangs_is_left_alone(kind: str) -> None:
    kept = Kept(kind, "pilot@+15")
    kept.until(lambda: kept.ap.mode in ("LOITER", "POSCTL"))
    kept.run(1.5)
    kept.hangs(60.0)
    assert kept.ap.mode in ("LOITER", "POSCTL")
    assert not kept.radio.commands
    kept.keeper.gone()
    kept.hangs_until(lambda: kept.keeper.over, 1.0)


def test_a_uav_that_has_given_way_in_guided_leaves_the_vehicle_to_its_pilot_also_when_it_hangs() -> None:
    kept = Kept("ardupilot")
    on_the_way(kept)
    kept.vehicle.flight.taken_over = True  # a ground station has sent another target: no mode has changed
    kept.run(0.2)
    kept.hangs(30.0)
    assert kept.ap.mode == "GUIDED"
    assert not kept.radio.commands


def test_a_vehicle_that_a_pilot_arms_after_the_uav_has_hung_on_the_ground_is_the_pilots() -> None:
    kept = Kept("ardupilot", "arm:40")
    kept.until(lambda: kept.heard("Arming refused"))
    kept.hangs(40.0)
    arm = mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1.0, *[0.0] * 6)
    kept.wire.hear(Codec(255, 190).pack(arm))
    kept.hangs(5.0)
    assert kept.ap.armed
    assert not kept.radio.commands


def test_a_pilot_may_take_over_from_the_keeper_also_through_a_uav_that_has_come_back() -> None:
    kept = Kept("ardupilot")
    on_the_way(kept)
    kept.hangs_until(lambda: kept.ap.mode == "RTL")
    kept.run(1.5)
    loiter = mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, 1.0, 5.0, *[0.0] * 5)
    kept.radio.forward(Codec(255, 190).pack(loiter))
    kept.run(30.0)
    assert kept.ap.mode == "LOITER"


@pytest.mark.parametrize("kind", KINDS)
def test_a_uav_that_comes_back_sees_that_its_search_is_over_and_does_not_fight_the_keeper(kind: str) -> None:
    kept = Kept(kind, parameters=PATIENT[kind])
    on_the_way(kept)
    kept.hangs_until(lambda: kept.ap.mode == "RTL")
    kept.hangs(1.5)
    kept.hangs(70.0)  # longer than a link may be lost
    kept.radio.lose()
    assert kept.fails() == "the uav was silent for 3 s"
    assert kept.ap.mode == ("RTL" if kind == "ardupilot" else "HOLD")  # a disarmed PX4 holds
    assert kept.from_home_m < 0.5
    assert len(kept.readings) == 1


def test_a_hold_that_the_uav_asked_for_is_not_a_pilots() -> None:
    kept = Kept("ardupilot", after_stop="hold")
    kept.reads(1)
    kept.finds()
    kept.until(lambda: kept.ap.mode == "BRAKE")
    kept.run(1.5)
    kept.hangs_until(lambda: kept.ap.mode == "RTL", SILENT_S + 2.0)


def test_a_px4_that_only_holds_when_the_setpoints_stop_is_sent_home() -> None:
    kept = Kept("px4", parameters={"COM_OBL_RC_ACT": 5.0})
    on_the_way(kept)
    kept.hangs_until(lambda: kept.ap.mode == "HOLD", 2.0)
    kept.hangs_until(lambda: kept.ap.mode == "RTL", SILENT_S + 2.0)


def test_a_return_that_is_refused_becomes_a_landing() -> None:
    kept = Kept("ardupilot")
    on_the_way(kept)
    command = kept.ap.command

    def refusing(number: int, values: list[float]) -> int:
        return 4 if number == mavlink.MAV_CMD_DO_SET_MODE and values[1] == 6.0 else command(number, values)

    kept.ap.command = refusing
    kept.hangs_until(lambda: kept.ap.mode == "LAND", SILENT_S + 2.0)
    kept.hangs_until(lambda: not kept.ap.armed)


def test_it_is_told_again_and_again_until_it_obeys() -> None:
    kept = Kept("ardupilot", "deaf@+20:15")
    kept.until(lambda: kept.ap.faults.on("deaf"))
    kept.hangs_until(lambda: kept.ap.mode == "RTL", 20.0)
    assert kept.radio.commands.count(mavlink.MAV_CMD_DO_SET_MODE) > 5
    kept.hangs_until(lambda: not kept.ap.armed)


def test_a_flight_that_the_uav_has_not_begun_is_none_of_the_keepers_business() -> None:
    kept, pilot = Kept("ardupilot"), Codec(255, 190)
    kept.hangs(10.0)  # the uav is started later
    for number, value in (
        (mavlink.MAV_CMD_DO_SET_MODE, 4.0),
        (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0),
        (mavlink.MAV_CMD_NAV_TAKEOFF, 0.0),
    ):
        kept.wire.hear(
            pilot.pack(
                mavlink.MAVLink_command_long_message(1, 1, number, 0, 1.0, value, 0.0, 0.0, 0.0, 0.0, 10.0)
            )
        )
    kept.hangs(10.0)
    kept.run(10.0)
    assert kept.ap.mode == "GUIDED"
    assert not kept.ap.landed
    kept.hangs(30.0)
    assert not kept.radio.commands
    kept.keeper.gone()
    kept.hangs_until(lambda: kept.keeper.over, 1.0)


def test_time_in_which_the_keeper_itself_was_held_up_is_no_silence() -> None:
    kept = Kept("ardupilot")
    on_the_way(kept)
    kept.radio.now_s += 60.0  # the machine was suspended
    kept.run(10.0)
    assert not kept.radio.commands


def test_an_autopilot_that_is_not_heard_any_more_is_given_up() -> None:
    kept = Kept("ardupilot", "silence@+20")
    kept.until(lambda: kept.ap.faults.on("silence"))
    kept.keeper.gone()
    kept.hangs(GIVEN_UP_S - 5.0)
    assert not kept.keeper.over
    kept.hangs_until(lambda: kept.keeper.over, 10.0)
    assert kept.radio.told[-1] == "The autopilot is not heard for 60 s: its own failsafe is in charge"
