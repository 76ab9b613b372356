"""Protects the uav's wait for a real vehicle and its services: it says what for all the time, and ends."""

from typing import Any

import pytest

from aircraft.remote.command import real_uav
from aircraft.search.command import Orders
from aircraft.search.uav import Equipment, Speaker
from aircraft.state import VehicleFailed
from link.bus.keys import PAYLOAD_IN, Key
from link.bus.session import LivelinessChange
from plume.scenario import draw
from plume.sensor import Gaussian
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


@pytest.mark.parametrize("missing", ["payload", "estimator", "agent"])
def test_a_service_that_is_not_there_is_named(missing: str) -> None:
    bus = Others()
    bus.due.remove(LivelinessChange(missing, True))
    last, _ = waited(Cockpit("ardupilot", wait_s=30.0), bus)
    assert f"(--wait): no {missing}: " in last
