"""Protects gas among buildings: puffs keep out of them, are seen or not, and are the paper's plume in the open."""

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from plume.dispersion import concentration
from plume.elementary import Array
from plume.scenario import NoRelease, Scenario, draw
from plume.walls.buildings import read
from plume.walls.cells import CELL_M, FREE, cells_of
from plume.walls.making import walls

OPEN = Scenario(source=(15.0, 15.0), q=100.0, u=2.0, phi=0.6, d=2.0, tau=2.0, start=(1.0, 1.0))


def site(folder: Path, *boxes: tuple[float, float, float, float, float]) -> str:
    """A file of buildings: west, south, east and north in whole cells, and the height above the plane."""
    footprints = [[[w, s], [e, s], [e, n], [w, n]] for w, s, e, n, _ in boxes]
    buildings = [
        {"footprint": footprint, "height": 5 + box[4]}
        for footprint, box in zip(footprints, boxes, strict=True)
    ]
    path = folder / "site.yaml"
    path.write_bytes(msgspec.json.encode({"buildings": buildings}))  # JSON is YAML
    return str(path)


def inside(places: Array, boxes: "list[tuple[float, float, float, float, float]]") -> "np.ndarray":
    """Whether places (3, …) are in a building."""
    x, y, z = places
    found = np.zeros(x.shape, bool)
    for west, south, east, north, top in boxes:
        found |= (west <= x) & (x < east) & (south <= y) & (y < north) & (z < top)
    return found


@pytest.mark.full
def test_in_the_open_the_mean_is_the_papers_plume() -> None:
    """Places near and far, upwind, across and above; 1,000 missions, of which each is asked six times."""
    s = OPEN
    blown = -np.array(s.wind) / s.u
    aside = np.array([-blown[1], blown[0]])
    offsets = np.array(
        [[1, 0, 0], [2, 0, 0], [4, 0, 0], [2, 1, 0], [2, -1, 0.5], [0, 1.5, 0], [-1, 0, 0], [1, 0, 1.5]]
    )
    places = np.array([15.0, 15.0, 0.0]) + np.column_stack(
        [offsets[:, :1] * blown + offsets[:, 1:2] * aside, offsets[:, 2]]
    )
    total = np.zeros(len(places))
    for seed in range(1000):
        air = walls(s, seed, rate=20.0, size=0.05)
        for time_s in (0.0, 3.3, 6.6, 9.9, 13.2, 16.5):
            gas, wind = air(places, np.full(len(places), time_s))
            total += gas
            assert (wind == s.wind).all()
    exact = concentration(places, (*s.source, 0.0), s.wind, rate=s.q, diffusivity=s.d, lifetime=s.tau)
    assert total / 6000 == pytest.approx(exact, rel=0.03)


def test_no_puff_is_ever_inside_a_building() -> None:
    cells = cells_of(read("courtyard"))
    nx, ny = cells.tops.shape
    met = 0
    for seed in range(12):
        air = walls(draw(seed), seed, file="courtyard", share=0.1)
        for time_s in np.arange(0.0, 8.0, 0.37):
            x, y, z, _, _ = air.puffs(time_s)
            i, j = (
                np.floor((x - cells.west) / CELL_M).astype(int),
                np.floor((y - cells.south) / CELL_M).astype(int),
            )
            there = (i >= 0) & (i < nx) & (j >= 0) & (j < ny)
            tops = np.full(len(x), FREE)
            tops[there] = cells.tops[i[there], j[there]]
            assert (z >= tops).all()
            met += int((tops > FREE).sum())
    assert met > 0  # some are over roofs


def test_without_eddies_a_puff_follows_the_wind_around_a_building(tmp_path: Path) -> None:
    """The wind at a place is integrated by SciPy, from the source on."""
    from scipy.integrate import solve_ivp

    file = site(tmp_path, (15.0, 12.0, 19.0, 17.0, 5.0))
    s = Scenario(source=(12.3, 14.7), q=100.0, u=2.0, phi=math.pi, d=1.0, tau=2.0, start=(1.0, 1.0))
    air = walls(s, 1, file=file, share=1.0, rate=5.0)

    def velocity(_: float, place: Array) -> Array:
        return -air(np.array([[*place, 0.0]]), np.zeros(1))[1][0]

    x, y, z, variance, _ = air.puffs(20.0)
    ages = (variance - 0.01) / 2.0
    assert len(ages) > 3
    way = solve_ivp(
        velocity, (0.0, 10.0), s.source, max_step=0.01, t_eval=np.sort(ages), rtol=1e-7, atol=1e-7
    )
    order = np.argsort(ages)
    assert np.column_stack([x, y])[order] == pytest.approx(way.y.T, abs=5e-3)
    assert (z == 0).all()
    assert y.max() > 17.0  # around its northern end


def test_a_wall_reflects_what_eddies_would_bring_through_it(tmp_path: Path) -> None:
    """A long high wall 1 m east of the source, no wind: the distance to it is |1 + N(0, 2 d a)|, folded."""
    file = site(tmp_path, (16.0, -30.0, 20.0, 60.0, 900.0))
    s = msgspec.structs.replace(OPEN, u=0.0)
    distances, exact = [], []
    for seed in range(60):
        x, _, _, _, mass = walls(s, seed, file=file, share=0.0, rate=20.0, size=0.01).puffs(5.0)
        distances += (16.0 - x).tolist()
        for age in (-s.tau * np.log(mass * 20.0 / s.q)).tolist():
            std = math.sqrt(max(2 * s.d * age - 1e-4, 1e-12))
            tail = 0.5 * math.erfc(1.0 / (std * math.sqrt(2)))
            exact.append(std * math.sqrt(2 / math.pi) * math.exp(-0.5 / std**2) + 1 - 2 * tail)
    assert min(distances) > 0
    assert np.mean(distances) == pytest.approx(np.mean(exact), rel=0.02)


def test_a_place_has_the_gas_of_the_puffs_that_it_can_see(tmp_path: Path) -> None:
    """Lines of sight are looked at in 4,000 places each; one that only just touches a corner counts for little."""
    boxes = [(17.0, 10.0, 18.0, 16.0, 3.0), (12.0, 17.0, 16.0, 19.0, 20.0), (20.0, 14.0, 22.0, 20.0, 0.5)]
    s = msgspec.structs.replace(OPEN, u=0.3)
    air = walls(s, 4, file=site(tmp_path, *boxes), share=0.3)
    share = np.linspace(0.0, 1.0, 4001)
    hidden = 0
    for place in np.random.default_rng(2).uniform((10.0, 8.0, -2.0), (24.0, 22.0, 4.0), (40, 3)):
        x, y, z, variance, mass = air.puffs(3.0)
        ways = place[:, None, None] + share * (np.array([x, y, z]) - place[:, None])[..., None]
        seen = ~inside(ways, boxes).any(axis=1)
        squared = ((np.array([x, y, z]) - place[:, None]) ** 2).sum(axis=0)
        each = mass * np.exp(-squared / (2 * variance)) / (2 * math.pi * variance) ** 1.5
        hidden += int((~seen & (each > 1e-4)).sum())
        gas, _ = air(place[None], np.array([3.0]))
        assert gas[0] == pytest.approx(each[seen].sum(), rel=1e-6, abs=1e-6)
    assert hidden > 50


def test_behind_walls_that_close_a_yard_there_is_nothing_and_no_gas_gets_lost_in_it(tmp_path: Path) -> None:
    ring = [
        (10.0, 10.0, 20.0, 11.0, 900.0),
        (10.0, 19.0, 20.0, 20.0, 900.0),
        (10.0, 10.0, 11.0, 20.0, 900.0),
        (19.0, 10.0, 20.0, 20.0, 900.0),
    ]
    air = walls(OPEN, 8, file=site(tmp_path, *ring))
    outside = np.array([[9.5, 15.0, 0.0], [20.5, 15.0, 0.0], [15.0, 9.0, 0.0], [3.0, 3.0, 2.0]])
    within = np.array([[13.0, 15.0, 0.0], [18.5, 18.5, 0.0]])
    for time_s in (0.0, 5.0, 60.0):
        x, y, _, _, _ = air.puffs(time_s)
        assert ((x > 11) & (x < 19) & (y > 11) & (y < 19)).all()
        assert (air(outside, np.full(4, time_s))[0] == 0).all()
        assert (air(within, np.full(2, time_s))[0] > 0).all()


def test_as_much_gas_is_in_the_air_as_leaves_and_decays() -> None:
    """q τ (1 − e^(−A/τ)) on average, A = 5 τ."""
    masses = [
        walls(draw(seed), seed, file="courtyard").puffs(time_s)[4].sum() / draw(seed).q
        for seed in range(20)
        for time_s in (0.0, 20.0, 40.0, 60.0)
    ]
    exact = 10.0 * (1 - math.exp(-5.0))
    assert np.mean(masses) == pytest.approx(exact, abs=4 * np.std(masses) / math.sqrt(len(masses)))


def test_each_answer_has_the_same_bits_in_any_order_and_batch() -> None:
    rng = np.random.default_rng(3)
    places = np.column_stack([rng.uniform(0, 30, (60, 2)), np.zeros(60)])
    times = np.concatenate([rng.uniform(0, 50, 40), np.arange(20) * 0.25])
    s = draw(11)
    at_once = walls(s, 11, file="courtyard")(places, times)
    for order in (np.argsort(times), np.argsort(-times), rng.permutation(60)):
        air = walls(s, 11, file="courtyard")
        alone = [air(places[k : k + 1], times[k : k + 1]) for k in order]
        assert np.array([gas[0] for gas, _ in alone]).tolist() == at_once[0][order].tolist()
        assert np.array([wind[0] for _, wind in alone]).tolist() == at_once[1][order].tolist()


def test_what_is_long_past_has_the_same_bits_when_it_is_asked_again() -> None:
    s, place = msgspec.structs.replace(draw(11), tau=1.0), np.array([[15.0, 15.0, 0.0]])
    air = walls(s, 11, file="courtyard", rate=2.0)
    times = np.array([3.1, 700.0, 1500.0])
    before = [air(place, times[k : k + 1])[0].tolist() for k in range(3)]
    assert [air(place, times[k : k + 1])[0].tolist() for k in (2, 0, 1)] == [before[2], before[0], before[1]]


def test_a_leap_in_time_has_the_same_bits_as_each_second_on_the_way() -> None:
    """Gas is in the air for 10 s; a day of it would take hours to follow."""
    s, places = msgspec.structs.replace(draw(11), tau=2.0), np.tile([[15.0, 15.0, 0.0]], (140, 1))
    times = np.arange(140.0) * 0.7
    stepwise = walls(s, 11, file="courtyard")(places, times)[0].tolist()
    for k in (139, 60, 15):
        air = walls(s, 11, file="courtyard")
        assert air(places[:1], times[k : k + 1])[0].tolist() == stepwise[k : k + 1]
        assert air(places[:1], np.array([5e6]))[0].shape == (1,)
        for again in (k, 3, 100):
            assert air(places[:1], times[again : again + 1])[0].tolist() == stepwise[again : again + 1]


def test_other_seeds_have_other_puffs() -> None:
    s = draw(11)
    assert walls(s, 1).puffs(0.0).tolist() != walls(s, 2).puffs(0.0).tolist()


def test_in_a_building_there_is_neither_gas_nor_wind_and_around_it_the_wind_turns(tmp_path: Path) -> None:
    air = walls(OPEN, 3, file=site(tmp_path, (17.0, 12.0, 20.0, 18.0, 4.0)))
    places = np.array([[18.0, 15.0, 0.0], [18.0, 15.0, 4.5], [17.0 - 0.01, 15.0, 0.0], [-500.0, 3.0, 0.0]])
    gas, wind = air(places, np.zeros(4))
    assert gas[0] == 0
    assert wind[0].tolist() == [0.0, 0.0]
    assert wind[1].tolist() == list(OPEN.wind)  # over the roof
    assert abs(wind[2][0]) < 0.05 * OPEN.u  # along the wall
    assert wind[3].tolist() == list(OPEN.wind)


def test_a_source_inside_a_building_is_refused_and_one_on_its_roof_is_not(tmp_path: Path) -> None:
    file = site(tmp_path, (14.0, 14.0, 16.0, 16.0, 2.0))
    with pytest.raises(NoRelease, match=r"the source \(15, 15\) is inside a building"):
        walls(OPEN, 1, file=file)
    walls(msgspec.structs.replace(OPEN, height=2.5), 1, file=file)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"share": 1.5}, "share is 1.5; wanted a number from 0 to 1"),
        ({"rate": 0.0}, "rate is 0; wanted a number from 0.1 to 100"),
        ({"size": math.nan}, "size is nan; wanted a number from 0.01 to 10"),
        ({"file": "no-such-place"}, "no file of buildings"),
    ],
)
def test_a_parameter_that_is_not_allowed_is_refused(given: dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        walls(OPEN, 1, **given)  # type: ignore[arg-type]
