"""Protects keyed randomness and the world: a reading depends only on (seed, step, position)."""

from math import dist
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from plume.dispersion import concentration
from plume.problem import Area, Problem
from plume.randomness import Keyed, derived_seed, keyed
from plume.scenario import draw
from plume.sensors.names import GAUSSIAN, Sensor, text
from plume.sensors.sensor import Gaussian, Hits, Threshold
from plume.worlds.world import World, readings_of


def test_a_reading_does_not_depend_on_the_readings_before_it() -> None:
    world = World(draw(5), 5)
    in_order = [world.gas((3.0, 4.0), step) for step in range(10)]
    backwards = [World(draw(5), 5).gas((3.0, 4.0), step) for step in reversed(range(10))]
    assert in_order == backwards[::-1]


def test_readings_of_different_steps_and_seeds_have_different_noise() -> None:
    readings = {World(draw(5), seed).gas((3.0, 4.0), step) for seed in range(20) for step in range(20)}
    assert len(readings) == 400


def test_readings_scatter_around_the_concentration_at_the_position() -> None:
    s = draw(5)
    position = (s.source[0] - 1.0, s.source[1])
    mean = float(concentration(position, s.source, s.wind, rate=s.q, diffusivity=s.d, lifetime=s.tau))
    readings = np.array([World(s, seed).gas(position, 0) for seed in range(4000)])
    assert readings.mean() == pytest.approx(
        mean, abs=4 * float(GAUSSIAN.noise_std(mean)) / np.sqrt(4000)
    )  # 4 standard errors


def test_readings_start_and_wind_are_exact_float32_values() -> None:
    world = World(draw(9), 9)
    for value in (world.gas((1.0, 2.0), 3), *world.start, *world.wind):
        assert value == float(np.float32(value))


@pytest.mark.parametrize(
    "sensor", [GAUSSIAN, Gaussian(0.6, 0.1), Threshold(0.3, 0.4), Hits(50.0, 3.0)], ids=text
)
def test_a_reading_among_others_is_the_reading_alone_to_the_bit(sensor: Sensor) -> None:
    seeds, steps = [*range(12), 2**63 - 1], [7 * seed % 5 for seed in range(13)]
    worlds = [World(draw(seed % 50), seed, sensor) for seed in seeds]
    places = np.array([draw(seed % 50).source for seed in seeds]) + np.linspace(0, 9, 26).reshape(13, 2)
    alone = [
        World(draw(seed % 50), seed, sensor).gas((x, y), k)
        for seed, (x, y), k in zip(seeds, places.tolist(), steps, strict=True)
    ]
    assert readings_of(worlds, places, steps, np.zeros(len(steps)), Keyed())[0].tolist() == alone
    assert (
        readings_of(worlds[::-1], places[::-1], steps[::-1], np.zeros(len(steps)), Keyed())[0].tolist()
        == alone[::-1]
    )
    assert len(set(alone)) > 4  # not all of them read 0


def test_a_reading_is_what_the_sensor_makes_of_the_concentration_with_the_noise_of_its_step() -> None:
    for seed in range(5):
        s = draw(seed)
        position = (s.source[0] - 2.0, s.source[1] + 1.0)
        mean = concentration(position, s.source, s.wind, rate=s.q, diffusivity=s.d, lifetime=s.tau)
        for sensor in (GAUSSIAN, Threshold(0.1, 0.2), Hits()):
            expected = float(sensor.measure(mean, keyed(seed, "sensor", 3)))
            assert World(s, seed, sensor).gas(position, 3) == np.float32(expected)


@pytest.mark.parametrize("name", ["source-outside", "source-beyond", "two-sources"])
def test_a_source_that_is_wrong_or_second_is_drawn_anew_as_it_was_drawn_where_a_building_is(
    tmp_path: Path, name: str
) -> None:
    footprints = [[[-9, y], [39, y], [39, y + 5], [-9, y + 5]] for y in (-4, 6, 16, 26)]
    file = tmp_path / "rows.yaml"
    file.write_text(f"buildings: [{', '.join(f'{{footprint: {each}, height: 9}}' for each in footprints)}]")
    anew = 0
    for seed in range(20):
        plain = World(draw(seed), seed, name=name).truth
        among = World(draw(seed), seed, name=f"walls:file={file}+{name}").truth
        for first, place in ((plain.source, among.source), (plain.second, among.second)):
            if first is None or place is None:
                assert first == place
                continue
            is_inside = (first[1] + 4) % 10 < 5
            assert (place[1] + 4) % 10 >= 5
            assert is_inside or place == first
            anew += is_inside
        x, y = among.source
        if name == "source-beyond":
            assert 2 <= max(-x, x - 30, -y, y - 30) <= 6
        elif name == "source-outside":
            assert min(x, y) >= 0
            assert max(x, y) <= 30
            assert not (10 <= x <= 25 and 10 <= y <= 25)
        else:
            assert among.second
            assert 5 <= dist(among.source, among.second) <= 15 or among.source != plain.source
    assert anew > 3


def test_a_source_that_is_drawn_anew_is_where_the_problem_expects_it(tmp_path: Path) -> None:
    """The prior is the half of a square below its diagonal, less what is kept out of."""
    problem = Problem(
        area=Area((0.0, 0.0), (30.0, 30.0)),
        prior=((5.0, 5.0), (25.0, 5.0), (25.0, 25.0)),
        keep_out=(((21.0, 6.0), (24.0, 6.0), (24.0, 12.0), (21.0, 12.0)),),
    )
    file = tmp_path / "site.yaml"
    file.write_text("buildings: [{footprint: [[10, 4], [18, 4], [18, 20], [10, 20]], height: 9}]")
    anew = 0
    for seed in range(40):
        scenario = draw(seed, problem)
        x, y = World(scenario, seed, name=f"walls:file={file}", problem=problem).truth.source
        anew += (x, y) != scenario.source
        assert 5 <= y <= x <= 25
        assert not (21 < x < 24 and 6 < y < 12)
        assert not (10 <= x < 18 and y < 20)
    assert anew > 5


def test_streams_of_one_seed_are_uncorrelated() -> None:
    one, other = keyed(1, "sensor").standard_normal(20_000), keyed(1, "move").standard_normal(20_000)
    assert abs(np.corrcoef(one, other)[0, 1]) < 4 / np.sqrt(20_000)


def test_services_get_seeds_that_differ_from_the_missions_and_from_each_other() -> None:
    assert len({7, derived_seed(7, "estimator"), derived_seed(7, "agent"), derived_seed(8, "estimator")}) == 4


def test_one_generator_set_from_place_to_place_draws_as_a_new_one_each() -> None:
    places = [
        (seed, stream, step)
        for seed in (0, 5, 2**63 - 1)
        for stream in ("sensor", "scenario")
        for step in (0, 1, 299)
    ]
    one = Keyed()
    for place in places + places[::-1]:
        drawn = one.at(*place)
        drawn.integers(7, dtype=np.uint32)  # leaves half a word buffered, which the next draw must not use
        assert one.at(*place).standard_normal(5).tolist() == keyed(*place).standard_normal(5).tolist()


def test_a_source_that_was_drawn_inside_a_building_is_drawn_anew_and_one_that_is_given_is_refused(
    tmp_path: Path,
) -> None:
    """The building covers the south of Table 1's square, up to y = 20 m: two thirds of it."""
    file = tmp_path / "hall.yaml"
    file.write_text("buildings: [{height: 12, footprint: [[9, 9], [26, 9], [26, 20], [9, 20]]}]\n")
    name, moved = f"walls:file={file}", []
    for seed in range(60):
        world = World(draw(seed), seed, name=name)
        assert world.scenario == draw(seed)
        if draw(seed).source[1] > 20.0:
            assert world.truth == draw(seed)
        else:
            assert 20.0 <= world.truth.source[1] <= 25.0
            assert world.truth == replace(draw(seed), source=world.truth.source)
            moved.append(world.truth.source)
    assert 25 < len(moved) == len(set(moved))
    with pytest.raises(
        ValueError, match=r"^the source \(15, 15\) is inside a building; wanted one in the open$"
    ):
        World(replace(draw(3), source=(15.0, 15.0)), 3, name=name)
