"""Protects a fleet that searches together: its starts, its rounds, its distances, and one vehicle as its case."""

import json
import math
import subprocess
import sys
from itertools import combinations, pairwise, permutations, product

import numpy as np
import pytest

from agent.trials.rollout import mission, rollout
from agent.trials.sweep import Sweep, fly
from estimator.filter import assimilate, prior, renewed
from link import cli
from link.bus.messages import LeftAt
from plume.outcome import TracePoint, outcome_text
from plume.polygons.polygons import gaps
from plume.problem import PAPER
from plume.problems.fleet import FORMATIONS, MOST_VEHICLES, Fleet
from plume.randomness import derived_seed
from plume.scenario import draw
from plume.sensors.names import parse
from plume.worlds.world import World

START = draw(3).start


@pytest.mark.parametrize("formation", FORMATIONS)
@pytest.mark.parametrize("vehicles", range(1, MOST_VEHICLES + 1))
def test_vehicles_start_inside_the_area_and_apart(formation: str, vehicles: int) -> None:
    fleet = Fleet(vehicles, formation)
    assert vehicles <= cli.MOST_VEHICLES == MOST_VEHICLES
    for seed in range(20):
        starts = fleet.starts(draw(seed).start, seed)
        assert len(set(starts)) == vehicles
        assert all(0 <= value <= 30 for place in starts for value in place)
        assert all(math.dist(a, b) >= 3 for a, b in combinations(starts, 2))
        assert starts == [tuple(map(float, np.float32(place))) for place in starts]


@pytest.mark.parametrize("formation", ["point", "corners"])
def test_the_first_vehicle_starts_where_one_alone_does(formation: str) -> None:
    alone = World(draw(3), 3).start
    assert [Fleet(n, formation).starts(alone, 3)[0] for n in (1, 2, 4)] == [alone] * 3


def test_a_vehicles_start_does_not_depend_on_how_many_follow() -> None:
    for formation in ("point", "corners"):
        assert Fleet(4, formation).starts(START, 3)[:2] == Fleet(2, formation).starts(START, 3)


@pytest.mark.parametrize("given", [(0,), (9,), (2, "nowhere"), (2, "point", -1.0), (4, "edge", 7.6)])
def test_a_fleet_that_cannot_start_is_refused_in_one_line(given: tuple) -> None:
    with pytest.raises(ValueError, match=r"^(vehicles|formation|separation_m) .* (wanted|room)") as refusal:
        Fleet(*given).within(PAPER)
    assert "\n" not in str(refusal.value)


def test_one_vehicle_is_a_fleet_of_one() -> None:
    alone, trace = rollout(3, particles=200, budget=8)
    one, same = rollout(3, particles=200, budget=8, vehicles=1, separation_m=5.0, formation="corners")
    assert same == trace
    assert (one.distance_m, one.distances_m) == (alone.distance_m, (alone.distance_m,))


def paths(trace: list[TracePoint]) -> dict[int, list[tuple[float, float]]]:
    return {
        vehicle: [point.position for point in trace if point.vehicle == vehicle]
        for vehicle in sorted({point.vehicle for point in trace})
    }


@pytest.mark.parametrize("policy", ["homing", "infotaxis", "greedy", "lookahead", "ppo", "ddpg"])
def test_ways_of_two_vehicles_keep_the_separation_whatever_the_policy(policy: str) -> None:
    result, trace = rollout(5, policy, particles=100, budget=12, vehicles=4, threshold_m=0.01)
    ways = [np.array([*pairwise(path)]) for path in paths(trace).values()]
    assert result.steps == 12
    assert len(ways) == 4
    assert min(gaps(a, b).min() for a, b in combinations(ways, 2)) >= 3
    assert any(len(set(path)) > 1 for path in paths(trace).values())


def test_a_fleets_mission_is_a_function_of_its_seed_and_counts_the_metres_of_all() -> None:
    result, trace = rollout(3, particles=200, vehicles=3, formation="corners", budget=6, threshold_m=0.01)
    assert rollout(3, particles=200, vehicles=3, formation="corners", budget=6, threshold_m=0.01)[1] == trace
    flown = [sum(math.dist(*leg) for leg in pairwise(path)) for path in paths(trace).values()]
    assert result.distances_m == pytest.approx(flown)
    assert result.distance_m == pytest.approx(sum(flown))
    assert (result.steps, result.vehicles, len(trace)) == (6, 3, 21)
    assert [point.vehicle for point in trace] == [1, 2, 3] * 7
    assert "6 steps of 3 vehicles" in outcome_text(result)


def test_the_belief_takes_the_readings_by_round_then_vehicle() -> None:
    flown = mission(3, "homing", 100, 0.01, 3, fleet=Fleet(2, "corners"), assume="field")
    posterior = prior(flown.config)
    for number, step in enumerate(flown.steps):
        assert [reading.vehicle for reading in step.readings] == [1, 2]
        posterior = renewed(posterior, flown.config)
        for reading in step.readings:
            posterior = assimilate(posterior, reading, flown.config)
        assert (posterior.particles == step.posterior.particles).all()
        assert step.belief.step == number
        assert len(step.posterior.readings) == 2 * (number + 1)


def test_the_others_keep_clear_of_where_one_has_left() -> None:
    """By 3 m and a step of 1 m, or they go away from there: a way's least distance is then its begin's."""
    flown = mission(2, "homing", 200, 0.5, 15, fleet=Fleet(3, "corners"), leaving={2: 5}, assume="field")
    steps = list(flown.steps)
    places = [{each.vehicle: each.position for each in step.readings} for step in steps]
    assert all(not step.belief.left_at for step in steps[:5])
    gone = places[0][2], places[4][2]
    assert {step.belief.left_at for step in steps[5:]} == {(LeftAt(2, *gone),)}
    for before, after in pairwise(places[5:]):
        for vehicle, there in product(before, gone):
            way = np.array([before[vehicle], after[vehicle]])
            least_m = float(gaps(way, np.array([there, there])))
            assert least_m >= min(4.0, math.dist(before[vehicle], there)) - 1e-6


@pytest.mark.parametrize("policy", ["homing", "thompson", "ppo"])
def test_nobody_comes_nearer_to_anothers_stand_than_the_separation(policy: str) -> None:
    """From a point, where they stand beside each other, and one may still fly between two others."""
    nearest_m = math.inf
    for seed in range(4):
        flown = mission(seed, policy, 100, 0.01, 25, fleet=Fleet(5, "point"), assume="field")
        places = [[reading.position for reading in step.readings] for step in flown.steps]
        for before, after in pairwise(places):
            for one, other in permutations(range(5), 2):
                way = np.array([before[one], after[one]])
                nearest_m = min(nearest_m, float(gaps(way, np.array([places[0][other]] * 2))))
    assert 3 <= nearest_m < 4.5


def test_one_that_joins_late_reads_at_its_start_from_its_round_on_and_the_others_keep_clear_of_it() -> None:
    fleet, joining = Fleet(3, "point"), {3: (4, 9)}
    flown = mission(4, "homing", 200, 0.01, 12, fleet=fleet, joining=joining, assume="field")
    steps = list(flown.steps)
    assert [[each.vehicle for each in step.readings] for step in steps] == [[1, 2]] * 9 + [[1, 2, 3]] * 4
    start = fleet.starts(draw(4).start, 4)[2]
    assert steps[9].readings[2].position == start
    kept_clear = [step.belief.left_at == (LeftAt(3, start, start),) for step in steps]
    assert kept_clear == [4 <= number < 9 for number in range(13)]
    places = [{each.vehicle: each.position for each in step.readings} for step in steps]
    for before, after in pairwise(places[4:9]):  # by 3 m and a step of 1 m, or they go away from there
        for vehicle, there in before.items():
            way = np.array([there, after[vehicle]])
            assert float(gaps(way, np.array([start, start]))) >= min(4.0, math.dist(there, start)) - 1e-6


def test_one_that_joins_late_has_the_noise_of_its_round() -> None:
    flown = mission(4, "homing", 100, 0.01, 6, fleet=Fleet(2, "corners"), joining={2: (3, 5)})
    *_, last = flown.steps
    world = World(flown.scenario, 4).of_vehicle(2)
    assert last.readings[1].gas == world.gas(last.readings[1].position, 6)


def test_the_last_of_a_search_may_be_one_that_joined_late() -> None:
    """Steps are rounds, whoever flies them."""
    flown = mission(4, "random", 50, 0.01, 6, fleet=Fleet(2, "corners"), joining={2: (1, 3)}, leaving={1: 4})
    steps = list(flown.steps)
    assert [step.belief.step for step in steps] == list(range(7))
    assert [each.vehicle for each in steps[-1].readings] == [2]


def test_each_vehicle_has_its_own_noise_and_the_first_that_of_one_alone() -> None:
    world = World(draw(3), 3)
    place = (10.0, 10.0)
    said = [world.of_vehicle(vehicle).gas(place, 4) for vehicle in (1, 2, 3)]
    assert said[0] == world.gas(place, 4)
    assert len(set(said)) == 3
    assert said[1] == World(draw(3), derived_seed(3, "vehicle 2")).gas(place, 4)  # same air, other noise


def test_a_sensor_that_lags_follows_its_own_readings_not_another_vehicles() -> None:
    sensor = parse("tgs2611")
    flown = mission(3, "homing", 100, 0.01, 2, fleet=Fleet(2, "corners"), sensor=sensor)
    *_, last = flown.steps
    rows = last.posterior.readings
    assert (rows[2:, 7:9] == rows[:-2, :2]).all()  # where the reading before was taken


def test_one_stuck_sensor_of_a_fleet_ends_no_search() -> None:
    flown = mission(3, "homing", 100, 0.01, 3, fleet=Fleet(2, "corners"))
    *_, last = flown.steps
    posterior, config = last.posterior, flown.config
    from dataclasses import replace

    from estimator.belief import fit

    stuck = posterior.readings.copy()
    assert fit(posterior, config) > 0
    stuck[1::2, 5] = 0.75
    assert fit(replace(posterior, readings=stuck), config) == 0


def test_a_mission_of_a_sweep_equals_the_same_flown_alone() -> None:
    fleet = Fleet(3, "corners")
    sweep = Sweep(("homing", "infotaxis"), range(4, 6), (100,), budget=5, fleet=fleet)
    flights = [flight for flight in sweep.flights if flight[2] == 5]
    rows = {row.policy: row for of_flight in fly(sweep, flights) for row in of_flight}
    for policy, row in rows.items():
        result, _ = rollout(5, policy, 100, budget=5, vehicles=3, formation="corners", assume="paper")
        assert (row.estimate_x, row.estimate_y) == result.estimate
        assert (row.steps, row.vehicles, row.start_from, row.separation_m) == (5, 3, "corners", 3.0)
        assert row.distance_m == pytest.approx(result.distance_m)


def test_the_command_flies_a_fleet() -> None:
    command = (
        "rollout --vehicles 2 --from corners --separation 4 --particles 50 --budget 2 --seed 3 --json --trace"
    )
    ran = subprocess.run(
        [sys.executable, "-m", "agent", *command.split()], capture_output=True, text=True, check=True
    )
    said = json.loads(ran.stdout)
    result, trace = rollout(3, particles=50, budget=2, vehicles=2, formation="corners", separation_m=4.0)
    assert said["distances_m"] == list(result.distances_m)
    assert [tuple(point["position"]) for point in said["trace"]] == [point.position for point in trace]


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    "flags", ["--vehicles 0", "--vehicles 9", "--from nowhere", "--vehicles 8 --from edge --separation 4"]
)
def test_a_wrong_fleet_is_refused_with_status_2(flags: str) -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "agent", "rollout", *flags.split()],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 2
    assert len(ran.stderr.strip().splitlines()) == 1
