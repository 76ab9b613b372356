"""Protects the uav service of a real vehicle in step with a double: its ids, its readings' times, and its
script's operator.
"""

import os
import re
import signal
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import pytest

from aircraft.payload.messages import Sample, pack_answer, unpack_question
from aircraft.remote.command import real_uav
from aircraft.search.command import Orders
from aircraft.search.events import Dropout, Hold, Land, OnBoard, Resume, Return
from aircraft.search.search import RETURNING
from aircraft.search.uav import Equipment, Speaker
from link.bus.inbox import Inbox
from link.bus.keys import PAYLOAD_IN, PAYLOAD_OUT, READING, WAYPOINT, Key
from link.bus.mavlink import BadFrame, Codec, split, unpack, unpack_reading, waypoint_message
from link.bus.session import Arrival, LivelinessChange
from link.interrupts import on_end
from plume.scenario import draw
from plume.sensors.sensor import Gaussian
from plume.worlds.world import World
from tests.aircraft.remote.cockpit import Cockpit
from tests.aircraft.remote.test_leaving import InStep
from tests.fuzz.services import QuietBus

Air = tuple[float, float] | None
MEASURED = (1.5, -0.5)


class Others(QuietBus):
    """A bus with a payload and an agent: they answer at once what is asked on it."""

    def __init__(self, wind: Callable[[int], Air] = lambda _: MEASURED) -> None:
        super().__init__()
        self.gas = 0.25
        self.wind = wind
        """What the payload measures of the wind, by the number of the question; the first one is asked on
        the ground.
        """
        self.questions = 0
        self.due: deque[Any] = deque(
            LivelinessChange(name, True) for name in ("payload", "estimator", "agent")
        )
        self.systems: list[int] = []
        """The vehicle's system id, each time that its health was told."""

    def publish_health(self) -> None:
        self.systems.append(self.tally.system)

    def publish(self, key: Key, message: Any, attachment: bytes | None = None) -> None:
        super().publish(key, message, attachment)
        if key is PAYLOAD_IN:
            asked = unpack_question(message)
            self.due.append(
                Arrival(
                    PAYLOAD_OUT,
                    pack_answer(
                        asked.system, Sample(asked.time_boot_ms, self.gas, self.wind(self.questions))
                    ),
                    b"",
                )
            )
            self.questions += 1
        elif key is READING:
            with suppress(BadFrame):  # one without a value
                self.answer(message)

    def answer(self, payload: bytes) -> None:
        """Answer a reading as the agent does, with a waypoint 1 m further east."""
        said, system = unpack_reading(payload), split(payload)[0].system
        place = min(said.position[0] + 1.0, 29.0), said.position[1]
        self.due.append(
            Arrival(
                WAYPOINT,
                Codec(system, 191).pack(waypoint_message(system, said.time_boot_ms, place, 5.0)),
                b"",
            )
        )

    @property
    def readings(self) -> list[bytes]:
        """Each reading once."""
        return [*dict.fromkeys(message for key, message, _ in self.published if key is READING)]


class Told(Inbox):
    """An inbox of what is due on the bus; a signal comes once something holds."""

    def __init__(self, bus: Others, holds: Callable[[], object]) -> None:
        super().__init__()
        self._bus, self._holds = bus, holds

    def get(self, timeout: float | None = None) -> Any:
        if self._holds():
            os.kill(os.getpid(), signal.SIGTERM)
            return None
        return self._bus.due.popleft() if self._bus.due else None


def fly(
    cockpit: Cockpit,
    holds: Callable[[Others], object],
    *events: OnBoard,
    wind: Callable[[int], Air] = lambda _: MEASURED,
    given: Air = None,
) -> Others:
    """Run the uav service until something holds; wind: what the payload measures; given: --wind."""
    bus = Others(wind)

    def over() -> object:
        assert cockpit.now_s < 300.0, "not within 300 s"
        return holds(bus)

    world = World(draw(1_000_000), 1, Gaussian())
    equipment = Equipment(InStep(cockpit), Told(bus, over), bus, Speaker(bus.log))
    uav = real_uav(cockpit.vehicle, Orders(world, events=events), equipment, given)
    with pytest.raises(KeyboardInterrupt):
        uav.run()
    return bus


@pytest.fixture(autouse=True)
def of_a_command() -> Iterator[None]:
    """Signals as in a command of ours."""

    def interrupted(_: int) -> None:
        raise KeyboardInterrupt

    before = on_end(interrupted)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def places(cockpit: Cockpit) -> dict[int, tuple[float, float]]:
    """Where the autopilot said to be, (x, y) m from home, by its own clock."""
    said = [
        message
        for frame in cockpit.wire.said
        for message in unpack(frame)
        if message.get_type() == "LOCAL_POSITION_NED"
    ]
    north, east, _ = cockpit.ap.home
    return {at.time_boot_ms: (at.y - east, at.x - north) for at in said}


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_readings_have_the_autopilots_id_and_its_clock_at_the_place_that_it_told_then(kind: str) -> None:
    cockpit = Cockpit(kind, instance=31)
    for _ in range(50):  # it has been on for a while
        cockpit.wire.advance(4)
    bus = fly(cockpit, lambda bus: len(bus.readings) >= 4)
    told = places(cockpit)
    for payload in bus.readings:
        assert split(payload)[0].system == 32
        reading = unpack_reading(payload)
        assert reading.position == pytest.approx(told[reading.time_boot_ms], abs=0.02)
    assert [*dict.fromkeys(bus.systems)] == [0, 32]


def test_a_reading_that_is_taken_again_is_taken_where_the_vehicle_is_then() -> None:
    cockpit = Cockpit("ardupilot")
    bus = fly(cockpit, lambda bus: len(bus.readings) >= 3, Dropout(step=0, for_s=2.5))
    told, tried = places(cockpit), [unpack(payload)[0] for payload in bus.readings[:3]]
    assert tried[-1].time_boot_ms - tried[0].time_boot_ms >= 2000
    for place in tried:
        assert (place.y, place.x) == pytest.approx(told[place.time_boot_ms], abs=0.02)


def test_the_scripts_operator_holds_resumes_and_lands(caplog: pytest.LogCaptureFixture) -> None:
    cockpit = Cockpit("ardupilot")
    modes: list[str] = []

    def landed(bus: Others) -> bool:
        if not modes or modes[-1] != cockpit.ap.mode:
            modes.append(cockpit.ap.mode)
        return modes[-1] == "LAND"

    events = Hold(step=1), Resume(after_s=4.0), Land(step=3)
    bus = fly(cockpit, landed, *events)
    assert modes == ["STABILIZE", "GUIDED", "BRAKE", "GUIDED", "LAND"]
    assert len(bus.readings) == 4
    (resumes,) = [said for said in caplog.messages if "Script: resume" in said]
    assert re.fullmatch(r"Script: resume time_s [0-9.]{1,7}", resumes), "six digits at most"


def test_the_scripts_operator_sends_it_home() -> None:
    cockpit = Cockpit("px4")
    bus = fly(cockpit, lambda _: cockpit.ap.mode == "RTL", Return(step=1))
    assert len(bus.readings) == 2


def test_the_last_error_of_a_vehicle_that_has_failed_is_why_and_not_that_it_returns() -> None:
    """By it the estimator says why it leaves a search of several."""
    cockpit = Cockpit("px4", "low@+15")
    said: dict[str, str] = {}

    def returns(bus: Others) -> object:
        said[bus.tally.state] = bus.tally.last_error
        return bus.tally.state == RETURNING

    fly(cockpit, returns)
    assert said[RETURNING] == "Battery low: 14%"


def test_a_warning_from_the_ground_is_not_the_last_error_of_a_flight() -> None:
    cockpit = Cockpit("ardupilot")
    errors: list[str] = []

    def has_read(bus: Others) -> object:
        errors.append(bus.tally.last_error)
        return bus.readings

    fly(cockpit, has_read)
    assert any("if this computer fails: warning" in error for error in errors)
    assert errors[-1] == ""
