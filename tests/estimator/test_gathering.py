"""Protects the order of the readings of a search by several vehicles: by round, then by vehicle, whatever
order they come in; and who takes part in a round, whenever it is heard that a vehicle has left or joins.
"""

import itertools
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from estimator import roll, service
from estimator.belief import belief
from estimator.filter import Config, Posterior, assimilate, prior, renewed
from estimator.roll import Attendance
from link.bus.keys import BELIEF, DEPARTURE, HEALTH, JOIN, LATECOMER, LEAVE_OUT, READING
from link.bus.mavlink import Codec, Reading, pack_reading
from link.bus.messages import (
    Belief,
    Departure,
    Health,
    Join,
    Latecomer,
    LeaveOut,
    LeftAt,
    Stand,
    pack_particles,
)
from link.bus.session import Arrival, LivelinessChange
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


def after(posterior: Posterior, number: int, *vehicles: int) -> Posterior:
    """The posterior after a round of these vehicles."""
    posterior = renewed(posterior, CONFIG)
    for vehicle in vehicles:
        posterior = assimilate(posterior, taken(vehicle, number), CONFIG)
    return posterior


def said(bus: QuietBus) -> list[Belief]:
    return [msgspec.json.decode(message, type=Belief) for key, message, _ in bus.published if key is BELIEF]


IN_ORDER = [arrival(vehicle, number) for number in range(3) for vehicle in (1, 2)]


def test_a_round_is_one_belief_of_all_its_readings_in_the_order_of_the_vehicles() -> None:
    posterior, expected = prior(CONFIG), []
    for number in range(3):
        posterior = after(posterior, number, 1, 2)
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


def test_readings_are_assimilated_as_they_come_and_again_only_after_one_that_has_left() -> None:
    one, two, three = (taken(vehicle, 0) for vehicle in (1, 2, 3))
    ahead = service.Ahead(prior(CONFIG))
    ahead.take([one, two], CONFIG)
    of_two = ahead.posteriors[2]
    ahead.take([one, two, three], CONFIG)
    assert ahead.posteriors[2] is of_two
    ahead.take([two, three], CONFIG)
    first = assimilate(prior(CONFIG), two, CONFIG)
    for found, wanted in zip(ahead.posteriors[1:], (first, assimilate(first, three, CONFIG)), strict=True):
        np.testing.assert_array_equal(found.particles, wanted.particles)
        np.testing.assert_array_equal(found.log_weights, wanted.log_weights)


def test_whether_a_sample_is_renewed_while_vehicles_fly_or_at_the_next_reading_changes_nothing() -> None:
    """And it is renewed once."""
    last, reading = after(prior(CONFIG), 0, 1, 2), taken(1, 1)
    early, late = service.Ahead(last), service.Ahead(last)
    early.renew(CONFIG)
    assert not np.array_equal(early.begin.particles, last.particles)
    for ahead in (early, late):
        ahead.take([reading], CONFIG)
        ahead.renew(CONFIG)
    wanted = assimilate(renewed(last, CONFIG), reading, CONFIG)
    for found in (early.posteriors[1], late.posteriors[1]):
        np.testing.assert_array_equal(found.particles, wanted.particles)
    np.testing.assert_array_equal(early.begin.particles, late.begin.particles)


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


# ---- vehicles that leave ----


def departure(vehicle: int, step: int, *readings: Arrival) -> Arrival:
    message = msgspec.json.encode(Departure(vehicle, step, "it returned"))
    return Arrival(DEPARTURE, message, b"".join(each.payload for each in readings), name="departure")


OF_THREE = [arrival(vehicle, number) for number in range(4) for vehicle in (1, 2, 3)]
WITHOUT_3 = [each for k, each in enumerate(OF_THREE) if each.vehicle < 3 or k < 6]


def test_rounds_are_of_those_that_are_left() -> None:
    bus = estimated(3, *WITHOUT_3[:8], departure(3, 2), *WITHOUT_3[8:])
    vehicles = [[taken.vehicle for taken in each.readings or ()] for each in said(bus)]
    assert vehicles == [[1, 2, 3], [1, 2, 3], [1, 2], [1, 2]]
    assert [each.step for each in said(bus)] == [0, 1, 2, 3]
    assert "without uav/3" in bus.tally.about


@pytest.mark.parametrize(
    "order",
    [
        lambda left: [left, *OF_THREE],  # first of all, though its readings are still to come
        lambda left: [*WITHOUT_3[:2], left, *OF_THREE[2:]],
        lambda left: [*OF_THREE[0::3], *OF_THREE[1::3], left, *OF_THREE[2::3]],  # all of one after the other
        lambda left: [departure(3, 2, *OF_THREE[2:6:3]), *(each for each in OF_THREE if each.vehicle < 3)],
    ],
    ids=["first", "on the way", "last", "with the readings of one that is dead"],
)
def test_when_it_is_heard_that_a_vehicle_has_left_changes_nothing(order: Callable) -> None:
    undisturbed = estimated(3, *WITHOUT_3[:8], departure(3, 2), *WITHOUT_3[8:])
    bus = estimated(3, *order(departure(3, 2)))
    assert [next(group) for _, group in itertools.groupby(answers(bus))] == answers(undisturbed)


def answers(bus: QuietBus) -> list[tuple]:
    return [each for each in bus.published if each[0] is not DEPARTURE]


def test_a_departure_that_is_heard_is_said_again_once_as_it_was() -> None:
    told = departure(3, 2, *OF_THREE[2:6:3])
    bus = estimated(3, told, *OF_THREE, told)
    assert [each for each in bus.published if each[0] is DEPARTURE] == [
        (DEPARTURE, told.payload, told.attachment)
    ]


def test_a_reading_of_who_has_left_is_refused_and_the_first_one_told() -> None:
    bus = estimated(3, departure(3, 2), *OF_THREE)
    assert dict(bus.tally.refused) == {"left": 2}
    assert bus.tally.last_error == "refused reading: uav/3 has left the search"


def test_a_departure_that_cannot_be_is_refused() -> None:
    bus = estimated(3, *OF_THREE, departure(3, 2), departure(4, 2), departure(2, 4), departure(2, 5))
    assert dict(bus.tally.refused) == {"conflicting": 1, "other vehicle": 1}


def test_the_last_one_that_is_left_searches_on_under_its_number() -> None:
    alone = [arrival(2, number) for number in range(3)]
    bus = estimated(3, departure(1, 0), departure(3, 0), *alone)
    assert [[taken.vehicle for taken in each.readings or ()] for each in said(bus)] == [[2]] * 3


def test_a_search_that_all_have_left_waits() -> None:
    assert answers(estimated(2, departure(1, 0), departure(2, 0), *IN_ORDER)) == []


# ---- who holds up a round ----


def health(state: str, last_error: str = "") -> Health:
    return Health("uav", state, 3, 0.0, 9.0, {}, last_error=last_error)


def test_who_holds_up_a_round_is_waited_for_and_then_leaves() -> None:
    attendance = Attendance(20.0, present={1, 2}, health={2: health("searching", "Gas sensor silent")})
    assert attendance.look(100.0, [2]) == []
    assert attendance.look(119.9, [2]) == []
    assert attendance.look(120.0, [2]) == [(2, "no reading for 20 s: Gas sensor silent")]


def test_the_waiting_begins_anew_with_each_reading() -> None:
    attendance = Attendance(20.0, present={1, 2})
    assert attendance.look(100.0, [2]) == attendance.look(115.0, []) == attendance.look(116.0, [2]) == []
    assert attendance.look(130.0, [2]) == []
    assert attendance.look(136.0, [2])


@pytest.mark.parametrize(
    ("present", "state", "waited_s", "why"),
    [
        (True, "returning", 0.0, "Battery empty: landing"),  # it says so itself: nobody waits for it
        (True, "landed", 0.0, "Battery empty: landing"),
        (True, "paused", 19.0, None),  # a pilot may give it back
        (True, "paused", 20.0, "paused for 20 s: Battery empty: landing"),
        (False, "searching", 19.0, None),  # its link may come back
        (False, "searching", 20.0, "gone from the bus for 20 s"),
    ],
)
def test_why_it_leaves(present: bool, state: str, waited_s: float, why: str | None) -> None:
    attendance = Attendance(20.0, {2} if present else set(), {2: health(state, "Battery empty: landing")})
    attendance.look(0.0, [] if waited_s == 0.0 else [2])
    assert attendance.look(waited_s, [2]) == ([(2, why)] if why else [])


def test_an_estimator_that_is_told_who_leaves_lets_nobody_leave_by_itself() -> None:
    attendance = Attendance(0.0, health={2: health("landed")})
    attendance.look(0.0, [2])
    assert attendance.look(1e6, [2]) == []


def test_who_has_left_and_whose_readings_never_come_does_not_leave_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ticks = itertools.count(0, 10)
    monkeypatch.setattr(roll, "now_s", lambda: float(next(ticks)))
    left = Arrival(DEPARTURE, msgspec.json.encode(Departure(2, 9, "it returned")), b"", name="departure")
    bus = QuietBus(arrival(1, 0), left, *[arrival(1, number) for number in range(1, 8)])
    until_all_are_taken(lambda: service.run(bus, CONFIG, [None, None], 20.0))
    # The round still waits, and nobody is said to have left once more, but for what was heard.
    assert bus.published == [(DEPARTURE, left.payload, b"")]


# ---- vehicles that are left out ----


def left_out(vehicle: int) -> Arrival:
    return Arrival(LEAVE_OUT, msgspec.json.encode(LeaveOut(vehicle, "left out by an operator")), b"")


def departures(bus: QuietBus) -> list[Departure]:
    return [
        msgspec.json.decode(message, type=Departure) for key, message, _ in bus.published if key is DEPARTURE
    ]


def test_who_is_left_out_leaves_from_the_next_round_on_and_its_readings_are_forgotten() -> None:
    bus = estimated(3, *OF_THREE[:8], left_out(3), *OF_THREE[8:])
    assert departures(bus) == [Departure(3, 2, "left out by an operator", forgotten=True)]
    vehicles = [[taken.vehicle for taken in each.readings or ()] for each in said(bus)]
    assert vehicles == [[1, 2, 3], [1, 2, 3], [1, 2], [1, 2]]
    posterior, expected = prior(CONFIG), []
    for number in range(4):
        posterior = after(posterior, number, 1, 2)
        expected.append(belief(posterior, taken(2, number), CONFIG)[0].mean)
    means = [each.mean for each in said(bus)]
    assert means[2:] == expected[2:]  # as if it had never been there
    assert means[:2] != expected[:2]


def test_a_reading_of_who_is_left_out_that_waits_for_its_round_is_in_no_belief() -> None:
    undisturbed = said(estimated(3, *OF_THREE[:6], left_out(3), *OF_THREE[6:]))
    bus = estimated(3, *OF_THREE[:6], OF_THREE[8], left_out(3), *OF_THREE[6:])
    assert [each.mean for each in said(bus)] == [each.mean for each in undisturbed]


@pytest.mark.parametrize("vehicle", [1, 2, 3])
def test_an_estimator_that_starts_again_says_the_same_of_a_search_that_one_was_left_out_of(
    vehicle: int,
) -> None:
    bus = estimated(3, *OF_THREE[:8], left_out(vehicle), *OF_THREE[8:])
    message, frames = next(said for key, *said in bus.published if key is DEPARTURE)
    told = Arrival(DEPARTURE, message, frames, name="departure")
    others = [each for each in OF_THREE if each.vehicle != vehicle]
    again = estimated(3, told, *others, left_out(vehicle))
    assert [each for each in again.published if each[0] is BELIEF] == [
        each for each in bus.published if each[0] is BELIEF
    ]


def test_an_order_that_cannot_be_is_refused() -> None:
    bus = estimated(2, left_out(3), *IN_ORDER[:2], left_out(1), left_out(2), left_out(1), *IN_ORDER[2:])
    assert [each.vehicle for each in departures(bus)] == [1]  # said again it is no news
    assert dict(bus.tally.refused) == {"order": 2, "left": 2}


# ---- one that is lost before all have taken off ----


def alive(vehicle: int, is_alive: bool = True) -> LivelinessChange:
    return LivelinessChange(f"uav/{vehicle}", is_alive)


def test_who_was_there_and_is_gone_is_not_waited_for_on_the_ground_without_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ticks = itertools.count(0, 3)
    monkeypatch.setattr(roll, "now_s", lambda: float(next(ticks)))
    nothing = [Arrival(HEALTH, b"", b"", name="health/none")] * 20
    bus = QuietBus(alive(1), alive(2), alive(2, False), *nothing)
    until_all_are_taken(lambda: service.run(bus, CONFIG, [None] * 3, 20.0))
    assert departures(bus) == [Departure(2, 0, "gone from the bus for 20 s")]  # the third may still come


# ---- vehicles that come late ----

STAND = (20.0, 25.0)


def begin_without(vehicle: int) -> Arrival:
    return Arrival(LEAVE_OUT, msgspec.json.encode(LeaveOut(vehicle, "comes later", late=True)), b"")


def asks(vehicle: int, clear: bool = False, place: tuple[float, float] = STAND) -> Arrival:
    return Arrival(JOIN, msgspec.json.encode(Join(place, clear)), b"", name=f"uav/{vehicle}/join")


def latecomer(vehicle: int, place: tuple | None = None, since: int = 0, step: int | None = None) -> Latecomer:
    unset = msgspec.UNSET
    return Latecomer(vehicle, place or unset, since, unset if step is None else step)


def latecomers(bus: QuietBus) -> list[Latecomer]:
    return [
        msgspec.json.decode(message, type=Latecomer) for key, message, _ in bus.published if key is LATECOMER
    ]


BY_TWO = [each for each in OF_THREE if each.vehicle < 3]  # four rounds of vehicles 1 and 2
LATE = [arrival(3, 0), arrival(3, 1)]
# Two rounds without it; then it asks, and after one more round it is clear and reads.
JOINING = [begin_without(3), *BY_TWO[:4], asks(3), *BY_TWO[4:6], asks(3, clear=True), *BY_TWO[6:8], LATE[0]]


def test_the_others_begin_without_one_that_comes_late_and_it_joins_them() -> None:
    bus = estimated(3, *JOINING)
    assert latecomers(bus) == [latecomer(3), latecomer(3, STAND, 2), latecomer(3, STAND, 2, 3)]
    vehicles = [[taken.vehicle for taken in each.readings or ()] for each in said(bus)]
    assert vehicles == [[1, 2], [1, 2], [1, 2], [1, 2, 3]]
    assert [each.step for each in said(bus)] == [0, 1, 2, 3]
    posterior = prior(CONFIG)
    for number in range(4):
        posterior = after(posterior, number, 1, 2)
    posterior = assimilate(posterior, taken(3, 0), CONFIG)
    assert said(bus)[-1].mean == belief(posterior, taken(3, 0), CONFIG)[0].mean


def test_a_belief_says_where_each_of_its_round_has_read_first() -> None:
    stands = {vehicle: Stand(vehicle, taken(vehicle, 0).position) for vehicle in (1, 2, 3)}
    told = [each.stands for each in said(estimated(3, *JOINING))]
    assert told == [(stands[1], stands[2])] * 3 + [tuple(stands.values())]
    left = said(estimated(2, *IN_ORDER[:2], left_out(1), *IN_ORDER[2:]))
    assert [each.stands for each in left][:2] == [(stands[1], stands[2]), (stands[2],)]


def test_the_others_are_told_to_keep_clear_of_where_it_takes_off_until_it_reads() -> None:
    away = [each.left_at for each in said(estimated(3, *JOINING))]
    assert away == [msgspec.UNSET, msgspec.UNSET, (LeftAt(3, STAND, STAND),), msgspec.UNSET]


@pytest.mark.parametrize(
    "order",
    [
        lambda told: [told, *BY_TWO, *LATE],  # first of all
        lambda told: [told, LATE[0], *BY_TWO],  # all its readings before those of the others
        lambda told: [begin_without(3), *BY_TWO[:2], told, *BY_TWO[2:], LATE[0]],
    ],
    ids=["first", "its readings first", "on the way"],
)
def test_when_it_is_heard_that_a_vehicle_joins_changes_nothing(order: Callable) -> None:
    told = Arrival(LATECOMER, msgspec.json.encode(latecomer(3, STAND, 2, 3)), b"", name="latecomer")
    beliefs = [each for each in estimated(3, *order(told)).published if each[0] is BELIEF]
    assert beliefs == [each for each in estimated(3, *JOINING).published if each[0] is BELIEF]


def test_it_may_only_take_off_after_a_belief_that_keeps_the_others_clear() -> None:
    bus = estimated(3, begin_without(3), *BY_TWO[:2], asks(3), asks(3, clear=True), *BY_TWO[2:4])
    assert latecomers(bus) == [latecomer(3), *[latecomer(3, STAND, 1)] * 2]  # asked again it is said again


def test_a_reading_of_one_that_has_no_round_yet_is_refused() -> None:
    bus = estimated(3, begin_without(3), *BY_TWO[:2], LATE[0], asks(3), LATE[0])
    assert dict(bus.tally.refused) == {"late": 2}
    assert bus.tally.last_error == "refused reading: uav/3 has no round yet"


def test_one_that_joins_and_dies_leaves_from_the_round_that_waits_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ticks = itertools.count(0, 3)
    monkeypatch.setattr(roll, "now_s", lambda: float(next(ticks)))
    nothing = [Arrival(HEALTH, b"", b"", name="health/none")] * 20
    bus = QuietBus(*JOINING[:-1], alive(3), alive(3, False), *nothing)
    until_all_are_taken(lambda: service.run(bus, CONFIG, [None] * 3, 20.0))
    assert departures(bus) == [Departure(3, 3, "gone from the bus for 20 s")]
    assert [each.vehicle for each in said(bus)[-1].readings or ()] == [1, 2]
    assert said(bus)[-1].step == 3


def test_one_whose_payload_has_no_value_leaves_for_that_whatever_it_said_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ticks = itertools.count(0, 3)
    monkeypatch.setattr(roll, "now_s", lambda: float(next(ticks)))
    payload = Health("payload", "ready", 0, 0.0, 9.0, {}, warnings=("the sensor has no value",))
    told = [
        Arrival(HEALTH, msgspec.json.encode(each), b"", name=f"uav/2/health/{each.service}")
        for each in (health("searching", "said long ago"), payload)
    ]
    nothing = [Arrival(HEALTH, b"", b"", name="health/none")] * 20
    bus = QuietBus(*IN_ORDER[:3], alive(1), alive(2), *told, *nothing)
    until_all_are_taken(lambda: service.run(bus, CONFIG, [None] * 2, 20.0))
    assert departures(bus) == [Departure(2, 1, "no reading for 20 s: the sensor has no value")]


def test_the_readings_of_a_latecomer_count_from_its_round_on_when_it_leaves() -> None:
    left = departure(3, 4)
    bus = estimated(3, *JOINING, left, *[arrival(vehicle, 4) for vehicle in (1, 2)], arrival(3, 1))
    vehicles = [[taken.vehicle for taken in each.readings or ()] for each in said(bus)]
    assert vehicles[3:] == [[1, 2, 3], [1, 2]]
    assert dict(bus.tally.refused) == {"left": 1}


def test_an_estimator_that_starts_again_says_the_same_of_a_search_that_one_has_joined_and_left() -> None:
    bus = estimated(3, *JOINING, departure(3, 4), *[arrival(vehicle, 4) for vehicle in (1, 2)])
    kept = [Arrival(LATECOMER, msgspec.json.encode(each), b"") for each in latecomers(bus)]
    rest = *BY_TWO, LATE[0], *[arrival(vehicle, 4) for vehicle in (1, 2)], begin_without(3), asks(3)
    again = estimated(3, *kept, departure(3, 4), *rest)
    assert said(again) == said(bus)


def test_what_the_bus_says_of_a_latecomer_and_cannot_be_is_refused() -> None:
    said_of = (latecomer(4), latecomer(3, (99.0, 3.0), 0), latecomer(2, STAND, 0, 0))
    bus = estimated(3, *OF_THREE[:3], *[Arrival(LATECOMER, msgspec.json.encode(it), b"") for it in said_of])
    assert dict(bus.tally.refused) == {"other vehicle": 1, "malformed": 1, "conflicting": 1}
    assert latecomers(bus) == []


@pytest.mark.parametrize(
    ("before", "order", "why"),
    [
        ([], begin_without(4), "uav/4 is none of the 3 vehicles"),
        ([alive(3)], begin_without(3), "uav/3 has come"),
        (OF_THREE[:3], begin_without(3), "the search has begun"),
        ([departure(1, 0), departure(2, 0)], begin_without(3), "uav/3 is the only one left"),
        ([begin_without(3), *BY_TWO[:2]], left_out(3), "uav/3 takes no part yet"),
        ([], asks(3), "uav/3 does not come late"),
        ([begin_without(3)], asks(3, place=(99.0, 3.0)), "(99.0, 3.0) is outside the area"),
    ],
)
def test_what_cannot_be_of_one_that_comes_late_is_refused(before: list, order: Arrival, why: str) -> None:
    bus = estimated(3, *before, order)
    assert dict(bus.tally.refused) == {"order": 1}
    assert why in bus.tally.last_error
    assert [each for each in latecomers(bus) if each.says] == []
