"""Protects the order of the readings of a search by several vehicles: by round, then by vehicle, whatever
order they come in.
"""

import itertools

import msgspec
import pytest

from estimator import service
from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from link.bus.keys import BELIEF, READING
from link.bus.mavlink import Codec, Reading, pack_reading
from link.bus.messages import Belief, pack_particles
from link.bus.session import Arrival
from tests.fuzz.services import QuietBus, until_all_are_taken

CONFIG = Config(50)


def taken(vehicle: int, number: int) -> Reading:
    """Reading `number` of a vehicle, each by its own clock."""
    place = (2.0 + 3 * vehicle + number, 3.0 + vehicle)
    return Reading(1000 * vehicle + 700 * number, place, 5.0, (1.5, 0.5), 0.25 * vehicle, vehicle)


def arrival(vehicle: int, number: int, system: int | None = None) -> Arrival:
    frames = pack_reading(Codec(system or 10 + vehicle, 1), taken(vehicle, number))
    return Arrival(READING, frames, b"", name=f"uav/{vehicle}/reading")


def estimated(vehicles: int, *arrivals: Arrival) -> QuietBus:
    bus = QuietBus(*arrivals)
    until_all_are_taken(lambda: service.run(bus, CONFIG, [None] * vehicles))
    return bus


def said(bus: QuietBus) -> list[Belief]:
    return [msgspec.json.decode(message, type=Belief) for key, message, _ in bus.published if key is BELIEF]


IN_ORDER = [arrival(vehicle, number) for number in range(3) for vehicle in (1, 2)]


def test_a_round_is_one_belief_of_all_its_readings_in_the_order_of_the_vehicles() -> None:
    posterior, expected = prior(CONFIG), []
    for number in range(3):
        for vehicle in (1, 2):
            posterior = assimilate(posterior, taken(vehicle, number), CONFIG)
        summary, array = belief(posterior, taken(2, number), CONFIG)
        expected.append((summary.mean, summary.step, pack_particles(array)))
    bus = estimated(2, *IN_ORDER)
    assert [(each.mean, each.step) for each in said(bus)] == [row[:2] for row in expected]
    assert [attached for _, _, attached in bus.published] == [row[2] for row in expected]


def test_a_belief_says_whose_readings_it_answers() -> None:
    last = said(estimated(2, *IN_ORDER))[-1]
    assert last.time_boot_ms == 3400
    assert last.position == (10.0, 5.0)
    assert last.readings
    assert [
        (each.vehicle, each.system, each.time_boot_ms, each.position, each.gas) for each in last.readings
    ] == [
        (1, 11, 2400, (7.0, 4.0), 0.25),
        (2, 12, 3400, (10.0, 5.0), 0.5),
    ]


@pytest.mark.parametrize(
    "order",
    [
        sorted(
            range(6), key=lambda k: (k % 2, k)
        ),  # all of one vehicle first: so a restarted estimator hears it
        [1, 0, 3, 2, 5, 4],
        [1, 1, 0, 0, 3, 1, 2, 5, 4],  # some come twice
    ],
)
def test_the_order_in_which_readings_come_changes_nothing(order: list[int]) -> None:
    undisturbed = estimated(2, *IN_ORDER).published
    published = estimated(2, *(IN_ORDER[k] for k in order)).published
    assert [next(group) for _, group in itertools.groupby(published)] == undisturbed


def test_a_repeated_reading_is_answered_again_only_once_its_round_is_whole() -> None:
    first, second = IN_ORDER[:2]
    assert estimated(2, first, first, first).published == []
    bus = estimated(2, first, second, first)
    assert len(bus.published) == 2
    assert bus.published[0] == bus.published[1]


def test_who_missed_its_waypoint_is_answered_again_although_another_has_gone_on() -> None:
    bus = estimated(2, *IN_ORDER[:2], arrival(2, 1), IN_ORDER[0])
    assert [each.step for each in said(bus)] == [0, 0]


def test_a_reading_from_before_its_vehicles_newest_one_is_late_and_refused() -> None:
    bus = estimated(2, *IN_ORDER[:4], arrival(1, 0))
    assert dict(bus.tally.refused) == {"late": 1}
    assert [each.step for each in said(bus)] == [0, 1]


def test_each_vehicle_keeps_the_system_id_of_its_first_reading() -> None:
    bus = estimated(2, *IN_ORDER[:2], arrival(2, 1, system=11))
    assert dict(bus.tally.refused) == {"other vehicle": 1}


def test_a_belief_about_one_vehicle_does_not_speak_of_readings() -> None:
    bus = estimated(1, Arrival(READING, pack_reading(Codec(1, 1), taken(1, 0)), b""))
    assert b"readings" not in bus.published[0][1]
