"""Protects the agent from beliefs that no estimator can mean: each is refused for its own reason, and the
next one is answered.
"""

import dataclasses
import itertools
import math

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from agent import policies, service
from agent.planning.apart import Shared
from agent.policies import choose, reach
from agent.together import choose_all, in_turn, seen_by
from link.bus.keys import DEPARTURE
from link.bus.mavlink import unpack
from link.bus.messages import Belief, Departure, RoundReading, unpack_particles
from link.bus.session import Arrival
from plume.problem import PAPER, Area, Problem
from plume.randomness import seed_of
from tests.fuzz.services import BETWEEN, QuietBus, answered, belief_seeds, until_all_are_taken

POLICY = "space-aware-infotaxis"


def said(**changed: object) -> bytes:
    """A real belief with these changes, and its particles."""
    payload, _, particles = belief_seeds()[0][1:].partition(BETWEEN)
    fields = msgspec.json.decode(payload) | {"ceased": False} | changed
    return msgspec.json.encode(fields) + BETWEEN + particles


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"time_boot_ms": 2**32}, "Expected `int` <= 4294967295 - at `$.time_boot_ms`"),
        ({"step": 10**30}, "Expected `int` <= 4294967295 - at `$.step`"),
        ({"altitude_m": 1e39}, "a number beyond ±1e+12"),
        ({"sensor": "hits:3.5e38,0.1"}, "efficiency is 3.5e+38, wanted a number from 1e-12 up to 1e+12"),
        ({"sensor": "hits:1e12,0.1", "wind": [1e300, 0.0]}, "a number beyond ±1e+12"),
        ({"covariance": [-1.0, 0.0, 1.0]}, "(-1.0, 0.0, 1.0) is not a covariance (xx, xy, yy)"),
        ({"covariance": [1.0, 2.0, 1.0]}, "(1.0, 2.0, 1.0) is not a covariance (xx, xy, yy)"),
        ({"diffusivity": 1e-300}, "one within 1e-12 of 0 that must be above 0"),
    ],
)
def test_a_belief_that_no_estimator_can_mean_is_refused_and_the_next_one_answered(
    changed: dict[str, object], reason: str
) -> None:
    bus = answered("ppo", said(**changed), said())
    assert reason in bus.tally.last_error
    assert bus.tally.refused == {"malformed": 1}
    assert len(bus.published) == 1


def test_particles_that_are_far_apart_need_no_grid_between_them() -> None:
    rows = np.array([[1.0, 1.0, 0.5], [1e6, 1e6, 0.5]], np.float32)  # 10¹² cells of one metre
    fields = msgspec.to_builtins(msgspec.json.decode(said().partition(BETWEEN)[0], type=Belief))
    narrow = fields | {"unknowns": ("x", "y"), "means": (1.0, 1.0), "stds": (0.1, 0.1)}
    for policy in (POLICY, "homing"):
        bus = answered(policy, msgspec.json.encode(narrow) + BETWEEN + rows.tobytes())
        assert len(bus.published) == 1


def test_beliefs_across_the_wrap_of_the_vehicles_time_are_answered_in_order_and_late_ones_are_not() -> None:
    times = [2**32 - 1200, 2**32 - 100, 1000, 2**32 - 100, 2100]  # the fourth comes late
    bus = answered("homing", *(said(time_boot_ms=time, step=step) for step, time in enumerate(times)))
    told = [message.time_boot_ms for _, frames, _ in bus.published for message in unpack(frames)]
    assert told == [2**32 - 1200, 2**32 - 100, 1000, 2100]


def test_an_agent_that_was_told_no_system_id_takes_the_one_of_the_belief_and_1_if_it_tells_none() -> None:
    told = said(system=32, step=1, time_boot_ms=2000)
    bus = answered("homing", said(step=0, time_boot_ms=1000), told, told)
    waypoints = [message for _, answer, _ in bus.published for message in unpack(answer)]
    systems = [(waypoint.get_srcSystem(), waypoint.target_system) for waypoint in waypoints]
    assert systems == [(1, 1), (32, 32), (32, 32)]


def of_two(**changed: object) -> dict[str, object]:
    """The readings of a round of two vehicles, the second one's with these changes."""
    first = {
        "vehicle": 1, "system": 5, "time_boot_ms": 900, "position": [3.0, 4.0], "altitude_m": 5.0, "gas": 0.1
    }  # fmt: skip
    second = {**first, "vehicle": 2, "system": 6, "time_boot_ms": 1000, "position": [9.0, 4.0], "gas": 0.5}
    return {"time_boot_ms": 1000, "readings": [first, {**second, **changed}]}


def test_a_round_is_answered_by_a_waypoint_for_each_vehicle_in_one_payload() -> None:
    payload = said(**of_two())
    bus = answered("homing", payload, payload)
    told, again = (unpack(answer) for _, answer, _ in bus.published)
    assert [each.to_dict() for each in told] == [each.to_dict() for each in again]
    assert [(each.target_system, each.time_boot_ms) for each in told] == [(5, 900), (6, 1000)]
    summary, _, attached = payload.partition(BETWEEN)
    belief = msgspec.json.decode(summary, type=Belief)
    particles = unpack_particles(attached, len(belief.unknowns))
    chosen = choose_all(
        "homing", belief, particles, 3, reach("homing"), [(3.0, 4.0), (9.0, 4.0)], [0.1, 0.5], 3.0
    )
    assert [(each.y, each.x) for each in told] == chosen


@pytest.mark.parametrize("name", ["homing", "lookahead"])
def test_what_vehicles_of_a_round_have_in_common_changes_no_choice(name: str) -> None:
    summary, _, attached = said(**of_two()).partition(BETWEEN)
    belief = msgspec.json.decode(summary, type=Belief)
    particles = unpack_particles(attached, len(belief.unknowns))
    places, gases = [(3.0, 4.0), (9.0, 4.0)], [0.1, 0.5]

    def decide(vehicle: int, free: Shared) -> tuple[float, float]:
        seen = seen_by(belief, places[vehicle], gases[vehicle], vehicle + 1)
        return choose(name, seen, particles, seed_of(3, vehicle + 1), dataclasses.replace(free, common={}))

    stands = [each.place for each in belief.stands or ()]
    wanted = in_turn(reach(name), places, 3.0, decide, stands=stands)
    assert choose_all(name, belief, particles, 3, reach(name), places, gases, 3.0) == wanted


def test_of_several_vehicles_the_one_that_repeats_itself_goes_elsewhere_and_the_others_as_before() -> None:
    summary, _, attached = said(**of_two()).partition(BETWEEN)
    belief = msgspec.json.decode(summary, type=Belief)
    particles = unpack_particles(attached, len(belief.unknowns))

    def chosen(belief: Belief) -> list[tuple[float, float]]:
        places, gases = [(3.0, 4.0), (9.0, 4.0)], [0.1, 0.5]
        return choose_all("homing", belief, particles, 3, reach("homing"), places, gases, 3.0)

    first, second = chosen(belief)
    again = chosen(msgspec.json.decode(msgspec.json.encode(replace(belief, backs={2: second})), type=Belief))
    assert again[0] == first
    assert math.dist(again[1], second) > 0.5


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"vehicle": 1}, "of vehicles 1 1; wanted each once, in their order, up to 8"),
        ({"vehicle": 9}, "of vehicles 1 9; wanted each once"),
        ({"system": 0}, "Expected `int` >= 1"),
        ({"time_boot_ms": 999}, "not that of the last reading of its round"),
        ({"position": [9.0, 41.0]}, "position (9.0, 41.0) is outside the area"),
        ({"gas": 1e39}, "a number beyond"),
    ],
)
def test_a_round_that_no_estimator_can_mean_is_refused(changed: dict[str, object], reason: str) -> None:
    bus = answered("homing", said(**of_two(**changed)), said(**of_two()))
    assert reason in bus.tally.last_error
    assert len(bus.published) == 1


@pytest.mark.parametrize(
    ("stands", "reason"),
    [
        ({1: [3.0, 4.0]}, "the stands of a round are of vehicles 1; wanted 1 2, as the readings"),
        ({2: [3.0, 4.0], 1: [3.0, 4.0]}, "are of vehicles 2 1; wanted 1 2"),
        ({1: [3.0, 4.0], 2: [9.0, 41.0]}, "position (9.0, 41.0) is outside the area"),
    ],
)
def test_stands_that_no_estimator_can_mean_are_refused(stands: dict[int, list[float]], reason: str) -> None:
    def standing(at: dict[int, list[float]]) -> bytes:
        told = [{"vehicle": vehicle, "place": place} for vehicle, place in at.items()]
        return said(**of_two(), stands=told)

    bus = answered("homing", standing(stands), standing({1: [3.0, 4.0], 2: [9.0, 4.0]}))
    assert reason in bus.tally.last_error
    assert len(bus.published) == 1


def test_the_stand_of_each_vehicle_is_closed_to_the_other_and_open_to_itself() -> None:
    """Both head for (9, 4), where the second stands: from 3.5 m west of it, and from 3.6 m east."""
    places = [(5.5, 4.0), (12.6, 4.0)]

    def towards_the_stand(vehicle: int, moves: Shared) -> tuple[float, float]:
        return min(moves.moves(places[vehicle]).tolist(), key=lambda place: math.dist(place, (9.0, 4.0)))

    first, second = in_turn(reach("homing"), places, 3.0, towards_the_stand, stands=[(1.0, 4.0), (9.0, 4.0)])
    assert math.dist(first, (9.0, 4.0)) >= 3.0
    assert second == pytest.approx((11.6, 4.0), abs=1e-5)


def test_who_is_hemmed_in_between_a_stand_and_one_that_has_left_flies_on_between_them() -> None:
    """3.3 m from both no way leads away from the one without coming nearer than 3 m to the other."""
    moves: list[list[float]] = []

    def east(vehicle: int, free: Shared) -> tuple[float, float]:
        moves.extend(sorted(free.moves((10.0, 8.3)).tolist()))
        return 11.0, 8.3

    places, stands = [(10.0, 8.3), (25.0, 25.0)], [(1.0, 1.0), (10.0, 11.6)]
    first, _ = in_turn(reach("homing"), places, 3.0, east, [(10.0, 5.0)], stands)
    assert moves[:2] == [pytest.approx([9.0, 8.3]), pytest.approx([11.0, 8.3])]
    assert first == (11.0, 8.3)


def test_who_has_left_is_said_again_once_with_the_readings_for_an_estimator_that_starts_again() -> None:
    gone, frames = msgspec.json.encode(Departure(2, 1, "lost")), b"its readings"
    other = msgspec.json.encode(Departure(1, 4, "its battery"))
    nobody = msgspec.json.encode(Departure(9, 4, "one of nine"))
    heard = [
        Arrival(DEPARTURE, *each) for each in ((gone, frames), (gone, frames), (nobody, b""), (other, b""))
    ]
    bus = QuietBus(*heard)
    until_all_are_taken(lambda: service.run(bus, "homing", 3, 300, None, reach("homing")))
    assert bus.published == [(DEPARTURE, gone, frames), (DEPARTURE, other, b"")]


def test_who_is_left_is_planned_for_with_the_draws_of_its_own_number() -> None:
    left = {**of_two(vehicle=3), "step": 7}
    bus = answered("random", said(**left))
    summary, _, attached = said(**left).partition(BETWEEN)
    belief = msgspec.json.decode(summary, type=Belief)
    particles = unpack_particles(attached, len(belief.unknowns))
    places, gases, within = [(3.0, 4.0), (9.0, 4.0)], [0.1, 0.5], reach("random")
    told = [(each.y, each.x) for each in unpack(bus.published[0][1])]
    assert told == choose_all("random", belief, particles, 3, within, places, gases, 3.0, [1, 3])
    assert any(
        choose_all("random", belief, particles, seed, within, places, gases, 3.0, [1, 3])
        != choose_all("random", belief, particles, seed, within, places, gases, 3.0)
        for seed in range(9)
    )


def test_a_round_is_answered_although_the_clock_of_its_last_vehicle_is_behind_that_of_one_that_has_left() -> (
    None
):
    """The time of a belief is that of the last vehicle of its round: it goes back when that has left."""
    alone = msgspec.to_builtins(RoundReading(1, 5, 800, (3.0, 4.0), 5.0, 0.1))
    after = said(time_boot_ms=800, step=3, position=[3.0, 4.0], gas=0.1, readings=[alone])
    before = said(**of_two(), step=2)
    bus = answered("homing", before, after, before, after)
    frames = [unpack(answer) for _, answer, _ in bus.published]
    assert [[each.time_boot_ms for each in told] for told in frames] == [[900, 1000], [800], [800]]


YARD = ((10.0, 10.0), (29.0, 10.0), (29.0, 29.0), (10.0, 29.0))
PROBLEMS = {
    "paper": PAPER,
    "far away": Problem(area=Area((-900.0, -900.0), (-200.0, -300.0)), step_m=20.0),
    "no room": Problem(area=Area((0.0, 0.0), (2.0, 2.0)), step_m=0.5),
    "corners that are fenced off": Problem(keep_in=YARD, start=(15.0, 15.0)),
}


@pytest.mark.parametrize(
    ("policy", "problem"), [*itertools.product(policies.registry.PLANNERS, PROBLEMS), ("ppo", "paper")]
)
def test_nothing_is_answered_before_the_first_belief(policy: str, problem: str) -> None:
    """It rehearses with a belief that nobody has said."""
    bus = QuietBus()
    within = reach(policy, problem=PROBLEMS[problem])
    until_all_are_taken(lambda: service.run(bus, policy, 3, 300, None, within))
    assert [key for key, _, _ in bus.published] == []


def test_a_policy_of_others_is_first_asked_about_the_first_belief(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def policy(belief: Belief, *_: object) -> tuple[float, float]:
        asked.append(belief.step)
        return 3.0, 4.0

    monkeypatch.setitem(policies.loaded, "theirs", ((), policy))
    answered("theirs", said(step=7))
    assert asked == [7]
