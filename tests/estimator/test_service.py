"""Protects what an estimator says first, and which vehicle it listens to that was told no system id."""

import msgspec
import pytest

from estimator import service
from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from link.bus.keys import BELIEF, READING
from link.bus.mavlink import Codec, Reading, pack_reading, unpack_reading
from link.bus.messages import Belief
from link.bus.session import Arrival
from plume.sensors.names import KINDS, parse
from tests.fuzz.services import QuietBus, until_all_are_taken


def reading(system: int, time_boot_ms: int, x: float = 2.0, gas: float = 0.5) -> Arrival:
    said = Reading(time_boot_ms, (x, 3.0), 5.0, (1.5, 0.5), gas)
    return Arrival(READING, pack_reading(Codec(system, 1), said), b"")


def estimated(*readings: Arrival) -> QuietBus:
    bus = QuietBus(*readings)
    until_all_are_taken(lambda: service.run(bus, Config(20), [None]))
    return bus


def test_it_keeps_to_the_system_of_the_first_reading_that_it_takes_and_does_so_again_after_a_restart() -> (
    None
):
    outside = reading(7, 500, x=-4.0)
    said = outside, reading(32, 1000), reading(7, 2000), reading(32, 3000)
    bus = estimated(*said)
    assert [key for key, _, _ in bus.published] == [BELIEF, BELIEF]
    assert dict(bus.tally.refused) == {"outside": 1, "other vehicle": 1}
    assert estimated(*said).published == bus.published


def test_its_beliefs_tell_the_agent_which_system_has_read_unless_it_is_the_first_one() -> None:
    """So no waypoint waits for the health of the vehicle, which a busy router drops."""
    for system, told in ((32, 32), (1, None)):
        bus = estimated(reading(system, 1000), reading(system, 2000))
        assert [msgspec.json.decode(said).get("system") for _, said, _ in bus.published] == [told, told]


@pytest.mark.parametrize("name", KINDS)
def test_whatever_the_sensor_the_first_belief_is_that_of_the_first_reading_alone(name: str) -> None:
    """It rehearses with a reading that nobody took."""
    came = reading(1, 1000, gas=1.0)
    config, bus, read = Config(20, sensor=parse(name)), QuietBus(came), unpack_reading(came.payload, 1)
    until_all_are_taken(lambda: service.run(bus, config, [None]))
    wanted, _ = belief(assimilate(prior(config), read, config), read, config)
    (_, said, _), *_ = bus.published
    assert msgspec.json.decode(said, type=Belief).means == pytest.approx(wanted.means, rel=1e-6)
