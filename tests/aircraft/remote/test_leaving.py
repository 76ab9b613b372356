"""Protects a real vehicle from the end of its program: whatever signals come, it is told to return home."""

import os
import signal
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.remote import passing
from aircraft.remote.command import real_uav
from aircraft.remote.passing import RealClients
from aircraft.remote.vehicle import RemoteVehicle
from aircraft.search.clock import Clock
from aircraft.search.command import Orders
from aircraft.search.uav import Equipment, Speaker
from aircraft.state import VehicleFailed
from link.bus.inbox import Inbox
from link.bus.mavlink import Message
from link.interrupts import on_end
from plume.scenario import draw
from plume.sensor import Gaussian
from plume.worlds.world import World
from tests.aircraft.remote.cockpit import STEPS, Cockpit
from tests.autopilots.body import DT_S
from tests.fuzz.services import QuietBus


class InStep(Clock):
    """A clock of a cockpit: each look at it lets some time pass there."""

    def __init__(self, cockpit: Cockpit) -> None:
        super().__init__(1.0)
        self._cockpit = cockpit

    def now_s(self) -> float:
        self._cockpit.radio.advance()
        self._cockpit.now_s += STEPS * DT_S
        return self._cockpit.now_s

    def stream_s(self) -> float:
        return self._cockpit.now_s


class Struck(Inbox):
    """An inbox in whose wait a signal comes."""

    def get(self, timeout: float | None = None) -> None:
        strike()


def strike() -> None:
    os.kill(os.getpid(), signal.SIGTERM)


def fly_until_struck(cockpit: Cockpit) -> None:
    """Run the uav service until its first signal."""
    bus = QuietBus()
    world = World(draw(1_000_000), 1, Gaussian())
    equipment = Equipment(InStep(cockpit), Struck(), bus, Speaker(bus.log))
    uav = real_uav(cockpit.vehicle, Orders(world), equipment)
    with pytest.raises(KeyboardInterrupt):
        uav.run()


@pytest.fixture(autouse=True)
def of_a_command() -> Iterator[None]:
    """Signals as in a command of ours."""

    def interrupted(_: int) -> None:
        raise KeyboardInterrupt

    before = on_end(interrupted)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_a_second_and_a_third_signal_do_not_keep_a_vehicle_from_being_sent_home(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A launcher with threads that is killed can cause several signals: one in the loop, others before and
    after the vehicle is told.
    """
    cockpit = Cockpit(kind)
    cockpit.reads(1)
    end, told = RealClients.end, RemoteVehicle.leave

    def end_struck(*args) -> None:
        strike()
        end(*args)

    def told_struck(vehicle: RemoteVehicle) -> str:
        strike()
        return told(vehicle)

    monkeypatch.setattr(RealClients, "end", end_struck)
    monkeypatch.setattr(RemoteVehicle, "leave", told_struck)
    fly_until_struck(cockpit)
    assert cockpit.vehicle.left
    assert cockpit.ap.mode == "RTL"


def test_a_vehicle_is_told_to_return_until_it_obeys(monkeypatch: pytest.MonkeyPatch) -> None:
    """The link loses the first two commands, which are a second apart."""
    cockpit = Cockpit("ardupilot")
    cockpit.reads(1)
    monkeypatch.setattr(
        passing, "time", SimpleNamespace(monotonic=lambda: cockpit.now_s, sleep=lambda _: None)
    )
    send, lost = cockpit.radio.send, []

    def losing(message: Message) -> None:
        if getattr(message, "command", None) == mavlink.MAV_CMD_DO_SET_MODE and len(lost) < 2:
            lost.append(message)
        else:
            send(message)

    monkeypatch.setattr(cockpit.radio, "send", losing)
    fly_until_struck(cockpit)
    assert len(lost) == 2
    assert cockpit.ap.mode == "RTL"


def leave_when(cockpit: Cockpit, monkeypatch: pytest.MonkeyPatch, happens: Callable[[], None]) -> None:
    """End the service; while it leaves the vehicle something happens at each look."""
    monkeypatch.setattr(
        passing, "time", SimpleNamespace(monotonic=lambda: cockpit.now_s, sleep=lambda _: happens())
    )
    end = RealClients.end

    def troubled(*args) -> None:
        happens()
        end(*args)

    monkeypatch.setattr(RealClients, "end", troubled)
    fly_until_struck(cockpit)


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_an_unfit_heartbeat_while_the_vehicle_is_left_does_not_keep_it_from_being_sent_home(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    cockpit = Cockpit(kind)
    cockpit.reads(1)
    gimbal = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_GIMBAL, mavlink.MAV_AUTOPILOT_GENERIC, 0, 0, 4, 3
    )
    leave_when(cockpit, monkeypatch, lambda: cockpit.radio.hear(gimbal))
    assert cockpit.ap.mode == "RTL"


@pytest.mark.parametrize(
    "failure",
    [VehicleFailed("it is gone"), KeyError("a fault"), OSError("no link")],
    ids=lambda it: type(it).__name__,
)
@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_a_vehicle_whose_words_cannot_be_read_is_sent_home_all_the_same(
    kind: str, failure: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And again and again: the first command is lost."""
    cockpit = Cockpit(kind)
    cockpit.reads(1)
    send, lost = cockpit.radio.send, []

    def losing(message: Message) -> None:
        if getattr(message, "command", None) == mavlink.MAV_CMD_DO_SET_MODE and not lost:
            lost.append(message)
        else:
            send(message)

    def unread() -> list[Message]:
        raise failure

    def happens() -> None:
        monkeypatch.setattr(cockpit.radio, "send", losing)
        monkeypatch.setattr(cockpit.radio, "poll", unread)

    leave_when(cockpit, monkeypatch, happens)
    assert lost
    assert cockpit.ap.mode == "RTL"
