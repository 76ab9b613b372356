"""Protects the worlds: each differs from what the estimator is told as its name says and in nothing else,
by formulas written anew here.
"""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import asdict

from plume.randomness import Keyed, keyed
from plume.scenario import AS_MODELLED, Scenario, draw
from plume.sensors.names import GAUSSIAN, Sensor, parse
from plume.sensors.sensor import Gaussian, Hits, Threshold
from plume.worlds.errors import WRONG
from plume.worlds.names import named
from plume.worlds.world import World, readings_of

WORLDS = (AS_MODELLED, *WRONG)
RELEASE = Scenario(source=(12.0, 13.0), q=200.0, u=2.0, phi=0.5, d=3.0, tau=10.0, start=(1.0, 2.0))
PLACE = (11.0, 12.0)
"""Downwind of RELEASE's source."""
MANY = 40_000
SEEDS = range(2000)

FACTORS = {
    "speed-low": ("u", 0.7),
    "speed-high": ("u", 1.4),
    "rate-halved": ("q", 0.5),
    "rate-doubled": ("q", 2.0),
    "tau-halved": ("tau", 0.5),
    "tau-doubled": ("tau", 2.0),
    "d-halved": ("d", 0.5),
    "d-doubled": ("d", 2.0),
}
"""Worlds in which one number of the release is wrong."""
TURNED = {"wind-10": 10.0, "wind-30": 30.0}
ELSEWHERE = {"all-at-once", "source-outside", "source-beyond", "two-sources"}
"""Worlds with tests of their own."""


def formula(
    at: tuple[float, float], source: tuple[float, float], q: float, u: float, phi: float, d: float, tau: float
) -> float:
    """The paper's concentration, written independently of the code."""
    r = max(math.dist(at, source), 0.1)
    psi = -((at[0] - source[0]) * u * math.cos(phi) + (at[1] - source[1]) * u * math.sin(phi)) / (2 * d)
    return q / (4 * math.pi * d * r) * math.exp(-r / math.sqrt(d * tau / (1 + u**2 * tau / (4 * d))) + psi)


def readings(
    name: str, sensor: Sensor = GAUSSIAN, count: int = MANY, first: int = 0, seed: int = 1
) -> np.ndarray:
    """So many readings of one mission at PLACE, from reading `first` on."""
    world = World(RELEASE, seed, sensor, name)
    return many(world, np.tile(PLACE, (count, 1)), first)


def many(world: World, places: np.ndarray, first: int = 0) -> np.ndarray:
    """Readings of one mission at places (M, 2), from reading `first` on."""
    count = len(places)
    return readings_of([world] * count, places, range(first, first + count), np.zeros(count), Keyed())[0]


def turned(a: tuple[float, float], b: tuple[float, float]) -> float:
    """The angle from vector a to b, degrees counter-clockwise."""
    return math.degrees(math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]))


def within(samples: np.ndarray, mean: float, std: float) -> bool:
    """Whether independent samples have this mean and standard deviation, within five standard errors; the
    fourth moment is theirs.
    """
    centred = np.square(samples - mean)
    of_mean, of_variance = std / math.sqrt(len(samples)), float(centred.std()) / math.sqrt(len(samples))
    return abs(samples.mean() - mean) < 5 * of_mean and abs(centred.mean() - std**2) < 5 * of_variance


@pytest.mark.parametrize("name", WORLDS)
def test_what_is_told_is_the_same_in_every_world_and_the_truth_differs_only_as_the_name_says(
    name: str,
) -> None:
    for seed in range(50):
        told = draw(seed)
        world = World(told, seed, name=name)
        assert (world.scenario, world.sensor, world.name) == (told, GAUSSIAN, name)
        assert world.wind == tuple(np.float32(told.wind).tolist())
        assert world.start == tuple(np.float32(told.start).tolist())
        field, factor = FACTORS.get(name, ("", 1.0))
        if name not in ELSEWHERE and name not in TURNED:
            assert asdict(world.truth) == {
                **asdict(told),
                **({field: factor * getattr(told, field)} if field else {}),
            }


def test_the_true_wind_is_to_either_side_of_the_measured_one_by_the_angle_and_as_strong() -> None:
    for name, angle in TURNED.items():
        worlds = [World(draw(seed), seed, name=name) for seed in SEEDS]
        angles = np.array([turned(world.scenario.wind, world.truth.wind) for world in worlds])
        assert np.abs(angles) == pytest.approx(np.full(len(SEEDS), angle))
        assert np.mean(angles > 0) == pytest.approx(0.5, abs=4 * math.sqrt(0.25 / len(SEEDS)))
        assert all(
            world.truth.u == world.scenario.u and world.truth.source == world.scenario.source
            for world in worlds
        )


@pytest.mark.parametrize(
    "name", [name for name in WORLDS if not name.startswith(("cv", "spike", "stuck", "all", "two"))]
)
def test_a_reading_is_of_the_true_gas_with_the_true_noise_of_its_step(name: str) -> None:
    gain = {"gain-halved": 0.5, "gain-doubled": 2.0}.get(name, 1.0)
    factor = {"noise-halved": 0.5, "noise-doubled": 2.0}.get(name, 1.0)
    for seed in range(20):
        world = World(draw(seed), seed, name=name)
        s = world.truth
        place = (s.source[0] - 1.5, s.source[1] + 0.5)
        mean = gain * formula(place, s.source, s.q, s.u, s.phi, s.d, s.tau)
        noise = keyed(seed, "sensor", 4).standard_normal() * factor * math.sqrt((0.3 * mean) ** 2 + 0.2**2)
        assert world.gas(place, 4) == pytest.approx(mean + noise, rel=1e-6, abs=1e-6)


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("name", "gain", "noise", "cv"),
    [
        ("as-modelled", 1, 1, 0),
        ("noise-doubled", 1, 2, 0),
        ("noise-halved", 1, 0.5, 0),
        ("gain-halved", 0.5, 1, 0),
        ("gain-doubled", 2, 1, 0),
        ("cv-0.6", 1, 1, 0.6),
        ("cv-1", 1, 1, 1),
        ("cv-2", 1, 1, 2),
    ],
)
def test_readings_have_the_mean_and_the_variance_of_their_world(
    name: str, gain: float, noise: float, cv: float
) -> None:
    m = gain * formula(PLACE, RELEASE.source, RELEASE.q, RELEASE.u, RELEASE.phi, RELEASE.d, RELEASE.tau)
    assert within(readings(name), m, math.sqrt((noise * 0.3 * m) ** 2 + (noise * 0.2) ** 2 + (cv * m) ** 2))
    # Counts: Poisson around the gas, whose noise has no factor.
    assert within(readings(name, Hits(2.0, 0.5)), 2 * m + 0.5, math.sqrt(2 * m + 0.5 + (2 * cv * m) ** 2))


def test_a_count_of_hits_has_no_noise_to_double() -> None:
    assert readings("noise-doubled", Hits(), 100).tolist() == readings("as-modelled", Hits(), 100).tolist()


def test_a_threshold_meets_intermittent_gas_too() -> None:
    sensor = Threshold(threshold=2.0, missed=0.2)
    m = formula(PLACE, RELEASE.source, RELEASE.q, RELEASE.u, RELEASE.phi, RELEASE.d, RELEASE.tau)
    std = math.sqrt((0.3 * m) ** 2 + 0.2**2)

    def normal(x: float) -> float:
        return 0.5 * math.erfc(-x / math.sqrt(2))

    # Exponential gas plus normal noise: the exponentially modified Gaussian distribution.
    below = normal(2 / std) - math.exp(-2 / m + std**2 / (2 * m**2)) * normal(2 / std - std / m)
    silent = 0.2 + 0.8 * below
    assert np.mean(readings("cv-1", sensor) == 0) == pytest.approx(
        silent, abs=4 * math.sqrt(silent * (1 - silent) / MANY)
    )
    assert np.mean(readings("as-modelled", sensor) == 0) != pytest.approx(silent, abs=0.02)


def test_an_intermittent_sensor_meets_its_own_gas_where_the_world_says_nothing_of_it() -> None:
    sensor = Gaussian(0.3, 0.2, 1.5)
    m = formula(PLACE, RELEASE.source, RELEASE.q, RELEASE.u, RELEASE.phi, RELEASE.d, RELEASE.tau)
    # Noise goes with the gas that is there, 1 + cv² times as much in square on average, and with that of the mean
    # in blanks.
    squares = 1 + 1.5**2 + 0.4 * 1.5**2 / (1 + 1.5**2)
    for name, cv, noise, more in (
        ("as-modelled", 1.5, 1, squares),
        ("noise-doubled", 1.5, 2, squares),
        ("cv-0.6", 0.6, 1, 1.0),
    ):
        variance = (noise * 0.3 * m) ** 2 * more + (noise * 0.2) ** 2 + (cv * m) ** 2
        assert within(readings(name, sensor), m, math.sqrt(variance))
    expected = float(sensor.measure(m, keyed(1, "sensor", 0)))
    assert readings("as-modelled", sensor, 1)[0] == pytest.approx(expected, rel=1e-6)


def exponential_gap(samples: np.ndarray) -> float:
    """The Kolmogorov-Smirnov distance of samples from the exponential distribution of mean 1."""
    cdf, count = 1 - np.exp(-np.sort(samples)), len(samples)
    return float(max(np.max(np.arange(1, count + 1) / count - cdf), np.max(cdf - np.arange(count) / count)))


def test_correlated_gas_is_exponential_and_its_correlation_is_0_7_to_the_power_of_the_lag() -> None:
    m = formula(PLACE, RELEASE.source, RELEASE.q, RELEASE.u, RELEASE.phi, RELEASE.d, RELEASE.tau)
    exact = Gaussian(0.0, 1e-9)
    gas = readings("cv-1-correlated", exact) / m
    for lag in range(1, 6):
        assert np.corrcoef(gas[:-lag], gas[lag:])[0, 1] == pytest.approx(
            0.7**lag, abs=0.04
        )  # about five standard errors
    # 1.95/√n is exceeded once in a thousand; correlation leaves (1 − 0.7)/(1 + 0.7) of the readings' number.
    assert exponential_gap(gas) < 1.95 / math.sqrt(MANY * 0.3 / 1.7)
    # Of many missions the readings are independent.
    across = np.array([World(RELEASE, seed, exact, "cv-1-correlated").gas(PLACE, 6) for seed in SEEDS]) / m
    assert exponential_gap(across) < 1.95 / math.sqrt(len(SEEDS))
    alone = readings("cv-1", exact) / m
    assert exponential_gap(alone) < 1.95 / math.sqrt(MANY)
    assert np.corrcoef(alone[:-1], alone[1:])[0, 1] == pytest.approx(0.0, abs=5 / math.sqrt(MANY))


def test_correlated_gas_depends_on_the_step_alone_not_on_what_was_asked_before() -> None:
    in_order = [World(RELEASE, 3, name="cv-1-correlated").gas(PLACE, step) for step in range(30)]
    world = World(RELEASE, 3, name="cv-1-correlated")
    for step in (29, 3, 17, 3, 0):
        assert world.gas(PLACE, step) == in_order[step]


def test_all_at_once_draws_each_error_from_its_range_and_none_with_another() -> None:
    drawn = [named("all-at-once").errors(seed) for seed in SEEDS]
    numbers = {
        "direction": [it.direction_deg / 30 for it in drawn],
        "speed": [2 * math.log(it.speed / 0.7) / math.log(2) - 1 for it in drawn],
        **{
            name: [math.log2(getattr(it, name)) for it in drawn]
            for name in ("noise", "gain", "q", "tau", "d")
        },
        "cv": [2 * (it.cv or 0.0) - 1 for it in drawn],
    }
    for name, values in numbers.items():  # each is uniform from −1 to 1, with variance 1/3
        assert -1 <= min(values) < -0.98, name
        assert 0.98 < max(values) <= 1, name
        assert within(np.array(values), 0.0, math.sqrt(1 / 3)), name
    correlations = np.corrcoef(list(numbers.values())) - np.eye(len(numbers))
    assert np.abs(correlations).max() < 5 / math.sqrt(len(SEEDS))
    assert named("all-at-once").errors(7) == named("all-at-once").errors(7)


def test_in_all_at_once_every_error_shows() -> None:
    wrong = named("all-at-once").errors(5)
    told = draw(5)
    world = World(told, 5, name="all-at-once")
    truth = world.truth
    for name, factor in (("q", wrong.q), ("u", wrong.speed), ("d", wrong.d), ("tau", wrong.tau)):
        assert getattr(truth, name) == pytest.approx(factor * getattr(told, name))
    assert turned(told.wind, truth.wind) == pytest.approx(wrong.direction_deg)
    assert wrong.cv is not None
    place = (told.source[0] - 1.0, told.source[1])
    m = wrong.gain * formula(place, told.source, truth.q, truth.u, truth.phi, truth.d, truth.tau)
    taken = many(world, np.tile(place, (MANY, 1)))
    assert within(taken, m, math.sqrt((wrong.cv * m) ** 2 + wrong.noise**2 * ((0.3 * m) ** 2 + 0.2**2)))


def test_the_source_is_uniform_over_the_area_outside_table_1() -> None:
    sources = np.array([World(draw(seed), seed, name="source-outside").truth.source for seed in SEEDS])
    assert ((sources >= 0) & (sources <= 30)).all()
    assert not ((sources >= 10) & (sources <= 25)).all(axis=1).any()
    for axis in (0, 1):  # of the area of 675 m²: 300 m² below 10 m, 150 m² above 25 m
        for share, sought in (
            (np.mean(sources[:, axis] < 10), 300 / 675),
            (np.mean(sources[:, axis] > 25), 150 / 675),
        ):
            assert share == pytest.approx(sought, abs=4 * math.sqrt(sought * (1 - sought) / len(SEEDS)))
    assert World(draw(7), 7, name="source-outside").scenario.source == draw(7).source


def test_a_source_beyond_is_2_to_6_m_off_one_edge_and_uniform_along_it() -> None:
    sources = np.array([World(draw(seed), seed, name="source-beyond").truth.source for seed in SEEDS])
    off = np.maximum(-sources, sources - 30)
    assert ((off > 0).sum(axis=1) == 1).all()
    offs, alongs = off[off > 0], sources[off <= 0]
    # Means of uniform ones, within four standard errors: (b − a)/√12 each.
    assert offs.mean() == pytest.approx(4, abs=4 * 4 / math.sqrt(12 * len(SEEDS)))
    assert alongs.mean() == pytest.approx(15, abs=4 * 30 / math.sqrt(12 * len(SEEDS)))
    assert offs.min() >= 2
    assert offs.max() <= 6
    for edge in (sources[:, 0] < 0, sources[:, 0] > 30, sources[:, 1] < 0, sources[:, 1] > 30):
        assert edge.mean() == pytest.approx(0.25, abs=4 * math.sqrt(0.25 * 0.75 / len(SEEDS)))


def test_two_sources_give_the_gas_of_both_and_are_5_to_15_m_apart() -> None:
    for seed in range(50):
        world = World(draw(seed), seed, name="two-sources")
        s = world.truth
        assert s.second is not None
        assert 5 <= math.dist(s.source, s.second) <= 15
        assert min(s.second) >= 0
        assert max(s.second) <= 30
        place = (s.second[0] - 1.5, s.second[1] + 0.5)
        mean = sum(formula(place, each, s.q, s.u, s.phi, s.d, s.tau) for each in (s.source, s.second))
        noise = keyed(seed, "sensor", 4).standard_normal() * math.sqrt((0.3 * mean) ** 2 + 0.2**2)
        assert world.gas(place, 4) == pytest.approx(mean + noise, rel=1e-6, abs=1e-6)
        assert s.nearest(place) == s.second


def test_a_fifth_of_the_readings_is_lost_but_not_the_first_and_what_is_then_taken_is_the_same() -> None:
    lost, modelled = (World(draw(3), 3, name=name) for name in ("readings-lost", "as-modelled"))
    assert np.mean([lost.loses(step) for step in range(1, 5001)]) == pytest.approx(
        0.2, abs=4 * math.sqrt(0.16 / 5000)
    )
    assert not any(World(draw(seed), seed, name="readings-lost").loses(0) for seed in range(200))
    assert not any(modelled.loses(step) for step in range(200))
    assert [lost.gas(PLACE, step) for step in range(50)] == [modelled.gas(PLACE, step) for step in range(50)]


@pytest.mark.parametrize(("name", "count"), [("spike", 1), ("spikes-3", 3)])
def test_spikes_are_among_the_first_30_readings_and_log_uniform_from_a_half_to_100(
    name: str, count: int
) -> None:
    drawn = [named(name).errors(seed).spikes for seed in SEEDS]
    assert all(len({number for number, _ in spikes}) == count for spikes in drawn)
    numbers = np.array([number for spikes in drawn for number, _ in spikes])
    assert set(numbers.tolist()) == set(range(30))
    assert within(numbers, 14.5, math.sqrt((30**2 - 1) / 12))
    sizes = np.log([size / 0.5 for spikes in drawn for _, size in spikes]) / math.log(200)
    assert 0 <= sizes.min() < sizes.max() <= 1
    assert within(sizes, 0.5, math.sqrt(1 / 12))
    assert abs(np.corrcoef(numbers, sizes)[0, 1]) < 5 / math.sqrt(len(sizes))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("sensor", [GAUSSIAN, Threshold(1.1), Hits()])
def test_a_spike_is_added_to_its_reading_alone_and_shows_only_what_its_kind_can_say(sensor: Sensor) -> None:
    for seed in range(300):
        spiked, modelled = World(draw(seed), seed, sensor, "spikes-3"), World(draw(seed), seed, sensor)
        amounts = dict(named("spikes-3").errors(seed).spikes)
        for step in range(0, 31, 5):
            gas, amount = modelled.gas(PLACE, step), amounts.get(step, 0.0)
            shown = gas + amount
            if isinstance(sensor, Hits):
                shown = round(shown)
            if isinstance(sensor, Threshold) and shown < sensor.threshold:
                shown = 0.0
            assert spiked.gas(PLACE, step) == pytest.approx(shown, rel=1e-6)
            assert sensor.refusal(spiked.gas(PLACE, step), 100.0) is None


@pytest.mark.parametrize("name", ["tgs2600", "tgs2611", "tgs2620"])
def test_a_spike_of_a_metal_oxide_is_hardly_more_than_it_shows_in_clean_air(name: str) -> None:
    """Resistances in clean air, by that in a reference gas: the data sheets' 1, 8.8 and 21."""
    sensor = parse(name)
    in_air = {"tgs2600": 1.0, "tgs2611": 8.8, "tgs2620": 21.0}[name]
    for seed in range(100):
        world = World(draw(seed), seed, sensor, "spikes-3")
        for step in sorted(dict(named("spikes-3").errors(seed).spikes)):
            gas = world.gas(PLACE, step)
            assert gas <= 1.1 * in_air  # it drifts by percents
            assert sensor.refusal(gas, 100.0) is None


def test_a_stuck_sensor_repeats_one_value_from_reading_10_on_wherever_it_is() -> None:
    world, modelled = World(draw(3), 3, name="stuck"), World(draw(3), 3)
    assert [world.gas(PLACE, step) for step in range(10)] == [modelled.gas(PLACE, step) for step in range(10)]
    (value,) = {world.gas((float(step % 30), 5.0), step) for step in range(10, 60)}
    assert 0 <= value <= 3
    assert within(
        np.array([World(RELEASE, seed, name="stuck").gas(PLACE, 10) for seed in SEEDS]), 1.5, math.sqrt(0.75)
    )


def test_a_noisy_stuck_sensor_reads_about_1_from_the_start_wherever_it_is() -> None:
    world = World(draw(3), 3, name="stuck-noisy")
    places = np.random.default_rng(0).uniform(0, 30, (MANY, 2))
    assert within(many(world, places), 1.0, 0.2)
    assert world.gas((1.0, 1.0), 0) == world.gas(world.truth.source, 0)


@pytest.mark.parametrize("sensor", [GAUSSIAN, Threshold(), Threshold(1.1), Hits()])
def test_a_stuck_sensor_says_only_what_its_kind_can_say(sensor: Sensor) -> None:
    for name in ("stuck", "stuck-noisy"):
        taken = {World(draw(seed), seed, sensor, name).gas(PLACE, 12) for seed in range(300)}
        assert [sensor.refusal(value, 100.0) for value in taken] == [None] * len(taken)
        assert len(taken) > 1


def test_a_reading_among_others_is_the_reading_alone_to_the_bit_whatever_their_worlds_and_sensors() -> None:
    kinds = [
        (name, sensor)
        for name in WORLDS
        for sensor in (GAUSSIAN, Threshold(0.1, 0.2), Hits(), Gaussian(0.1, 0.3, 0.8))
    ]
    steps = [(7 * number) % 31 for number in range(len(kinds))]
    places = np.array([np.add(draw(number).source, (-1.0, 0.5)) for number in range(len(kinds))])

    def worlds() -> list[World]:
        return [World(draw(number), number, sensor, name) for number, (name, sensor) in enumerate(kinds)]

    alone = [
        world.gas((x, y), step) for world, (x, y), step in zip(worlds(), places.tolist(), steps, strict=True)
    ]
    assert readings_of(worlds(), places, steps, np.zeros(len(steps)), Keyed())[0].tolist() == alone
    assert (
        readings_of(worlds()[::-1], places[::-1], steps[::-1], np.zeros(len(steps)), Keyed())[0].tolist()
        == alone[::-1]
    )
    assert all(value == np.float32(value) for value in alone)


def test_the_page_on_worlds_lists_the_wrong_assumptions() -> None:
    page = (Path(__file__).parents[3] / "docs" / "worlds.md").read_text()
    section = page.partition("## Wrong assumptions")[2].partition("\n\n| world |")[2].partition("\n\n")[0]
    named = [name for row in section.splitlines() for name in re.findall(r"`([^`]+)`", row.split("|")[1])]
    assert named == list(WORLDS)


def test_a_name_that_is_none_is_told_with_those_that_are() -> None:
    with pytest.raises(
        ValueError,
        match=r"^no world 'wind-3'; did you mean 'wind-30'\? Wanted as-modelled, puffs, walls, recorded, wind-10, wind-30, .*, stuck-noisy",
    ):
        World(draw(1), 1, name="wind-3")
