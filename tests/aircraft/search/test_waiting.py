"""Protects the uav's wait for a real vehicle and its services: it says what for all the time, and ends."""

import math
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from aircraft.remote.command import real_uav
from aircraft.search.command import Orders
from aircraft.search.uav import Equipment, Speaker
from aircraft.state import VehicleFailed
from aircraft.together import Berth, misfit
from link.bus.keys import HEALTH, JOIN, LATECOMER, PAYLOAD_IN, Key
from link.bus.mavlink import unpack_reading
from link.bus.messages import Health, Latecomer
from link.bus.session import Arrival, LivelinessChange
from plume.scenario import draw
from plume.sensors.sensor import Gaussian
from plume.worlds.world import World
from tests.aircraft.remote.cockpit import Cockpit
from tests.aircraft.remote.test_leaving import InStep
from tests.aircraft.remote.test_real import Others, Told, of_a_command

__all__ = ["of_a_command"]
KINDS = ("ardupilot", "px4")
both = pytest.mark.parametrize("kind", KINDS)


class Speechless(Others):
    """A bus whose payload is there and never answers."""

    def publish(self, key: Key, message: Any, attachment: bytes | None = None) -> None:
        if key is not PAYLOAD_IN:
            super().publish(key, message, attachment)


class Ignored(Others):
    """A bus whose estimator refuses each reading of more than 1 g/m³, and whose payload measures this after
    its first value.
    """

    def __init__(self, gas: float) -> None:
        super().__init__()
        self.then = gas

    def publish(self, key: Key, message: Any, attachment: bytes | None = None) -> None:
        super().publish(key, message, attachment)
        if key is PAYLOAD_IN:
            self.gas = self.then

    def answer(self, payload: bytes) -> None:
        if unpack_reading(payload).gas <= 1.0:
            super().answer(payload)


class Searched(Others):
    """A bus whose estimator says what it runs with."""

    def __init__(self, about: str) -> None:
        super().__init__()
        self.about = about

    def kept(self, key: Key, service: str = "*") -> list[Arrival]:
        said = Health("estimator", "ready", -1, 0.0, 9.0, {}, about=self.about)
        return [Arrival(HEALTH, msgspec.json.encode(said), b"", name=f"health/{service}")]


def waited(cockpit: Cockpit, bus: Others) -> tuple[str, list[str]]:
    """Run the uav service until it gives up; returns its last line, and what its health has said
    meanwhile.
    """
    warnings: dict[str, None] = {}

    def over() -> bool:
        assert cockpit.now_s < 300.0, "not within 300 s"
        warnings.update(dict.fromkeys(bus.tally.warnings))
        return False

    world = World(draw(1_000_000), 1, Gaussian())
    equipment = Equipment(InStep(cockpit), Told(bus, over), bus, Speaker(bus.log))
    uav = real_uav(cockpit.vehicle, Orders(world), equipment)
    with pytest.raises(VehicleFailed) as failure:
        uav.run()
    assert not cockpit.ap.armed
    return str(failure.value), [*warnings]


@both
def test_a_vehicle_that_is_not_there_is_said_in_its_health_and_at_the_end(kind: str) -> None:
    """The health is what `fly` shows."""
    last, warnings = waited(Cockpit(kind, "mute", wait_s=20.0), Others())
    assert last.startswith("the search has not begun in 20 s (--wait): no HEARTBEAT")
    assert warnings == ["Waiting for the autopilot: no HEARTBEAT"]


@both
def test_a_position_that_does_not_come_is_said_in_its_health_and_at_the_end(kind: str) -> None:
    last, warnings = waited(Cockpit(kind, ready_s=1e6, wait_s=20.0), Others())
    assert "no position yet" in last
    assert "no position yet" in warnings[-1]


@both
def test_a_payload_that_never_answers_is_said_in_its_health_and_at_the_end(kind: str) -> None:
    last, warnings = waited(Cockpit(kind, wait_s=40.0), Speechless())
    assert last.endswith("(--wait): the payload has not answered yet whether it measures the wind")
    assert "the payload has not answered yet" in warnings[-1]


@both
def test_a_payload_without_a_value_is_asked_again_and_nothing_takes_off(kind: str) -> None:
    bus = Others()
    bus.gas = math.nan
    last, warnings = waited(Cockpit(kind, wait_s=40.0), bus)
    assert last.endswith("(--wait): the payload's sensor has no value")
    assert warnings[-1] == "Waiting for the autopilot: the payload's sensor has no value"
    assert bus.questions > 1
    assert not bus.readings


@pytest.mark.one_in(3)
@both
@pytest.mark.parametrize(
    ("gas", "lacks"),
    [(math.nan, "the sensor has no value for reading 0"), (1e12, "reading 0 (1e+12) has no answer")],
)
def test_a_flight_without_waypoints_says_at_its_end_what_its_reading_lacked(
    kind: str, gas: float, lacks: str
) -> None:
    last, _ = waited(Cockpit(kind), Ignored(gas))
    assert last == f"No waypoint for 30 s; {lacks}"


@pytest.mark.parametrize("missing", ["payload", "estimator", "agent"])
def test_a_service_that_is_not_there_is_named(missing: str) -> None:
    bus = Others()
    bus.due.remove(LivelinessChange(missing, True))
    last, _ = waited(Cockpit("ardupilot", wait_s=30.0), bus)
    assert f"(--wait): no {missing}: " in last


@both
def test_a_vehicle_stays_on_the_ground_if_the_estimator_is_for_another_number_of_vehicles(kind: str) -> None:
    last, _ = waited(Cockpit(kind), Searched("300 particles, assume field, stop spread:0.5, 2 vehicles"))
    assert last == "the estimator is for 2 vehicles, and 1 would fly: start it without --vehicles"


def test_an_estimator_that_does_not_say_for_how_many_vehicles_it_is_may_be_for_any() -> None:
    assert not misfit("somebody's own filter", 3)
    assert not misfit("300 particles, assume field, stop spread:0.5, 3 vehicles, without uav/2", 3)
    assert misfit("300 particles, assume field, stop spread:0.5", 3).startswith(
        "is for 1 vehicle, and 3 would"
    )


class Begun(Others):
    """A bus of a search by two that has begun without vehicle 2."""

    vehicle = 2

    def __init__(self) -> None:
        super().__init__()
        self.due.extend(LivelinessChange(name, True) for name in ("payload/2", "uav/1"))

    def kept(self, key: Key, service: str = "*") -> list[Arrival]:
        late = Arrival(LATECOMER, msgspec.json.encode(Latecomer(2)), b"")
        return [late] if key is LATECOMER else []

    def announce(self) -> None: ...


class Standing(InStep):
    """A clock that goes on while the bus is waited for, and not by itself."""

    def now_s(self) -> float:
        return self.stream_s()

    def go_on(self) -> None:
        super().now_s()


class Timed(Told):
    """Keeps how long each wait for the bus may take, s."""

    def __init__(self, bus: Others, clock: Standing, holds: Callable[[], object]) -> None:
        super().__init__(bus, holds)
        self._clock, self.waits_s = clock, list[float]()

    def get(self, timeout: float | None = None) -> Any:
        self.waits_s.append(timeout or 0.0)
        self._clock.go_on()
        return super().get(timeout)


@pytest.mark.parametrize(("ready_s", "east_m"), [(1e6, 0.0), (None, 8.0)], ids=["no position", "astray"])
def test_a_latecomer_that_cannot_ask_for_its_part_yet_waits_without_haste_and_says_why_once(
    ready_s: float | None, east_m: float, caplog: pytest.LogCaptureFixture
) -> None:
    """Its start is where it stands, or further to the east; without a pause it would use up a processor."""
    cockpit, bus = Cockpit("ardupilot", ready_s=ready_s, wait_s=math.inf), Begun()
    clock = Standing(cockpit)
    inbox = Timed(bus, clock, lambda: cockpit.now_s > 60.0)
    equipment = Equipment(clock, inbox, bus, Speaker(bus.log))
    berth = Berth((0.5 + east_m, 0.5), [(25.0, 25.0)], 3.0)
    orders = Orders(World(draw(1_000_000), 1, Gaussian()), number=2, berth=berth)
    with pytest.raises(KeyboardInterrupt):
        real_uav(cockpit.vehicle, orders, equipment).run()
    assert not any(key is JOIN for key, *_ in bus.published)
    assert sum(wait_s > 0.0 for wait_s in inbox.waits_s) > 0.5 * len(inbox.waits_s)
    told = [said for said in caplog.messages if said.startswith("to join late it has to stand within 1 m")]
    assert len(told) == (east_m > 0.0)
