"""Protects who is named when the sensor of one of several vehicles lies: the one that does, and nobody if none
does.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest

from estimator.filter import Config, Posterior, assimilate, forget, prior
from estimator.watch import SCALE, SHAPE, WORTH, Hum, SensorWatch
from link.bus.mavlink import Reading
from plume.scenario import draw
from plume.sensors.names import parse
from plume.worlds.world import World

SEED = 4
ROUNDS = 12
Lie = Callable[[float, int], float]  # of a gas value and the number of its round


def config(sensor: str = "gaussian") -> Config:
    told = draw(SEED)
    return Config(300, 0.5, 1, told.q, told.d, told.tau, assume="field", sensor=parse(sensor))


def rounds(liar: int, lie: Lie, sensor: str = "gaussian", vehicles: int = 3) -> list[list[Reading]]:
    """Three vehicles that fly towards the source from three sides, of which one lies."""
    told = draw(SEED)
    world = World(told, SEED, parse(sensor))
    x, y = told.source
    taken = []
    for number in range(ROUNDS):
        here = []
        for vehicle in range(1, vehicles + 1):
            angle, away = 2.1 * vehicle, 13.0 - number
            place = (x + away * math.cos(angle) / 1.5, y + away * math.sin(angle) / 1.5)
            gas, wind = world.of_vehicle(vehicle).measure(place, number)
            said = float(np.float32(lie(gas, number))) if vehicle == liar else gas
            here.append(Reading(number, place, 5.0, wind, said, vehicle))
        taken.append(here)
    return taken


def named(taken: list[list[Reading]], told: Config, vehicles: int = 3) -> list[tuple[int, ...]]:
    """Whom a watch names after each round."""
    watch, posterior, said = SensorWatch(told, vehicles), prior(told), []
    for here in taken:
        posterior = look(watch, posterior, here, told)
        said.append(tuple(watch.doubted))
    return said


def look(watch: SensorWatch, posterior: Posterior, here: list[Reading], told: Config) -> Posterior:
    """Assimilate the readings of a round, and let the watch look; returns the posterior after them."""
    for reading in here:
        before, posterior = posterior, assimilate(posterior, reading, told)
        watch.take(before, posterior, reading)
    watch.look()
    return posterior


def honest(gas: float, _number: int) -> float:
    return gas


def hums(_gas: float, number: int) -> float:
    return 1.0 + 0.2 * math.sin(7.0 * number * number)


@pytest.mark.parametrize("liar", [1, 2, 3])
def test_a_sensor_that_hums_at_one_value_is_named_and_no_other(liar: int) -> None:
    said = named(rounds(liar, hums), config())
    assert said[0] == ()  # one reading proves nothing
    assert said[-1] == (liar,)
    assert {each for each in said if each} == {(liar,)}


def test_of_sound_sensors_none_is_named() -> None:
    assert set(named(rounds(1, honest), config())) == {()}


def test_a_sensor_that_reads_ten_times_the_gas_of_the_others_at_their_places_is_named() -> None:
    """All read at the same places, so that nothing but the gain tells them apart."""
    taken = [
        [
            each._replace(position=here[0].position, gas=0.1 * here[0].gas, vehicle=v)
            for v, each in enumerate(here, 1)
        ]
        for here in rounds(1, honest)
    ]
    for here in taken:
        here[2] = here[2]._replace(gas=100 * here[2].gas)
    assert named(taken, config())[-1] == (3,)


def test_sensors_that_count_are_watched_too() -> None:
    dead = named(rounds(2, lambda *_: 0.0, "hits:3,0.1"), config("hits:3,0.1"))
    assert set(dead) <= {(), (2,)}


def test_who_is_forgotten_is_named_no_more() -> None:
    told, taken = config(), rounds(2, hums)
    watch, posterior = SensorWatch(told, 3), prior(told)
    for number, here in enumerate(taken):
        if number == 10:
            posterior = forget(posterior, {2}, told)
            watch.forget({2})
        left = [each for each in here if number < 10 or each.vehicle != 2]
        posterior = look(watch, posterior, left, told)
        assert watch.doubted == () or number < 10


def test_a_vehicle_alone_is_held_against_nobody() -> None:
    assert set(named(rounds(1, hums, vehicles=1), config(), vehicles=1)) == {()}


def test_the_density_of_a_hum_is_that_of_students_t() -> None:
    """Normal-inverse-gamma, its predictive density step by step, by the textbook's formulas."""
    from scipy import stats  # takes long to load

    hum, gases = Hum(SCALE * 0.04), [0.7, -0.1, 1.3, 1.1]
    mean, worth, shape, scale, expected = 0.0, WORTH, SHAPE, SCALE * 0.04, 0.0
    for gas in gases:
        width = math.sqrt(scale * (worth + 1) / (shape * worth))
        expected += float(stats.t.logpdf(gas, 2 * shape, loc=mean, scale=width))
        scale += 0.5 * worth * (gas - mean) ** 2 / (worth + 1)
        mean, worth, shape = (worth * mean + gas) / (worth + 1), worth + 1, shape + 0.5
        hum.read(gas)
    assert hum.log_density == pytest.approx(expected, rel=1e-12)
