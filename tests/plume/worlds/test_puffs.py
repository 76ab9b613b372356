"""Protects gas in puffs: its mean is the paper's plume, its variance Campbell's, its law at one time that of
puffs in Brownian motion, its wind an Ornstein–Uhlenbeck process, and each answer the same whatever was asked
before.
"""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from plume.dispersion import concentration
from plume.scenario import Scenario, draw
from plume.worlds.air import Air
from plume.worlds.puffs import puffs

RELEASE = Scenario(source=(12.0, 13.0), q=200.0, u=2.0, phi=0.5, d=3.0, tau=10.0, start=(1.0, 2.0))
# Downwind, crosswind and upwind of the source, near and far, in the plane and above it.
PLACES = np.array(
    [
        *[(11.0, 12.5, 0.0), (9.0, 11.0, 0.0), (5.0, 9.0, 0.0), (1.0, 7.0, 0.0), (7.0, 13.0, 0.0)],
        *[(10.0, 8.0, 0.0), (13.0, 13.5, 0.0), (12.0, 14.0, 0.0), (12.0, 13.0, 1.0), (8.0, 11.0, 2.0)],
        *[(12.5, 12.5, 0.5), (6.0, 7.0, 0.0)],
    ]
)
SEEDS = range(2000)
TIMES_S = (0.0, 40.0, 80.0)  # the gas is new after 5 τ, nearly after 40 s


def asked(air: Air, time_s: float, places: np.ndarray = PLACES) -> np.ndarray:
    return air(places, np.full(len(places), time_s))[0]


def gas_of(**parameters: float) -> np.ndarray:
    """The gas at PLACES in many missions, at three times each: (2000 · 3, 12)."""
    airs = [puffs(RELEASE, seed, **parameters) for seed in SEEDS]
    return np.array([asked(air, time_s) for air in airs for time_s in TIMES_S])


def campbell(share: float, rate: float, size: float) -> np.ndarray:
    """The variance at PLACES of shot noise: the rate times the integral over ages of the mean square of a
    puff (Campbell 1909). Squared, a normal puff of variance s² is one of variance s²/2.
    """
    s, ages = RELEASE, np.geomspace(1e-5, 5 * RELEASE.tau, 200_001)[:, None]
    own = size**2 + 2 * share * s.d * ages
    moved = np.maximum(2 * s.d * ages - own, 0.0)
    wide = own / 2 + moved
    flown = PLACES[None, :, :2] - np.array(s.source) + ages[..., None] * np.array(s.wind)
    squares = (flown**2).sum(axis=-1) + (PLACES[:, 2] - s.height) ** 2
    square_of_one = (
        (s.q / rate) ** 2
        * np.exp(-2 * ages / s.tau - squares / (2 * wide))
        / ((4 * np.pi * own) ** 1.5 * (2 * np.pi * wide) ** 1.5)
    )
    return rate * np.trapezoid(square_of_one, ages[:, 0], axis=0)


@pytest.mark.full
def test_the_mean_over_missions_is_the_papers_plume() -> None:
    """Within 3%: the standard errors of these shares, rates and places are at most 1.2%."""
    plume = concentration(
        PLACES,
        (*RELEASE.source, 0.0),
        RELEASE.wind,
        rate=RELEASE.q,
        diffusivity=RELEASE.d,
        lifetime=RELEASE.tau,
    )
    for parameters in (
        {"share": 0.5, "rate": 10.0},
        {"share": 0.2, "rate": 40.0},
        {"share": 1.0, "rate": 5.0},
    ):
        gas = gas_of(**parameters)
        assert (gas.std(axis=0) / plume / math.sqrt(len(gas))).max() < 0.012, parameters
        assert gas.mean(axis=0) == pytest.approx(plume, rel=0.03), parameters


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("share", "rate", "size"), [(0.5, 10.0, 0.1), (0.2, 10.0, 0.5), (1.0, 2.0, 1.0)])
def test_the_variance_over_missions_is_that_of_shot_noise(share: float, rate: float, size: float) -> None:
    """Within five standard errors, of missions: the three times of one are alike."""
    variance = campbell(share, rate, size)
    squares = np.square(gas_of(share=share, rate=rate, size=size))
    means = np.sqrt(squares).mean(axis=0)
    found = squares.mean(axis=0) - means**2
    errors = np.square(np.sqrt(squares) - means).std(axis=0) / math.sqrt(len(SEEDS))
    assert np.abs(found - variance).max() > 0  # it is drawn, not computed
    assert (np.abs(found - variance) < 5 * errors).all()
    assert (errors < 0.35 * variance).all()  # so that this says something


def test_small_shares_leave_blanks_and_bursts() -> None:
    whole, small = gas_of(share=1.0, rate=2.0), gas_of(share=0.05, rate=2.0)
    far = 3
    assert np.mean(small[:, far] < 0.1 * small[:, far].mean()) > 0.2
    assert np.mean(whole[:, far] < 0.1 * whole[:, far].mean()) == 0.0


FEW = PLACES[[1, 3, 4, 9]]


def walked(share: float, rate: float, lag_s: float) -> np.ndarray:
    """The gas at FEW places at two times so far apart, in as many missions: (2, missions, places).

    Each puff walks: its displacement is a sum of independent steps.
    """
    rng, s, size, substeps = np.random.default_rng(1), RELEASE, 0.1, 8
    oldest_s = 5 * s.tau
    many = rng.poisson(rate * (oldest_s + lag_s), len(SEEDS))
    times_s = rng.uniform(-oldest_s, lag_s, (len(SEEDS), many.max()))
    leaves = np.arange(many.max()) < many[:, None]
    position, before = np.zeros((*times_s.shape, 3)), np.zeros(times_s.shape)
    said = []
    for now_s in (0.0, lag_s):
        age = np.maximum(now_s - times_s, 0.0)
        passed = np.linspace(before, age, substeps + 1)
        variances = np.diff(np.maximum(2 * s.d * (1 - share) * passed - size**2, 0.0), axis=0)
        for step in np.sqrt(variances):
            position += step[..., None] * rng.standard_normal(position.shape)
        before = age
        own = size**2 + 2 * share * s.d * age
        grams = s.q / rate * np.exp(-age / s.tau) * (leaves & (times_s <= now_s) & (age <= oldest_s))
        centre = position + np.array([*s.source, s.height]) - age[..., None] * np.array([*s.wind, 0.0])
        squares = [((centre - place) ** 2).sum(axis=-1) for place in FEW]
        said.append(
            [(grams * np.exp(-r / (2 * own)) / (2 * np.pi * own) ** 1.5).sum(axis=1) for r in squares]
        )
    return np.array(said).transpose(0, 2, 1)


@pytest.mark.parametrize("rate", [0.1, 2.0])  # at most one puff is near, or many are
def test_at_one_time_the_gas_has_the_law_of_puffs_in_brownian_motion(rate: float) -> None:
    """Two-sample Kolmogorov–Smirnov tests: over 2,000 missions each they tell laws 0.06 apart."""
    from scipy.stats import ks_2samp, spearmanr

    brownian = walked(0.2, rate, 1.0)
    airs = [puffs(RELEASE, seed, share=0.2, rate=rate) for seed in SEEDS]
    ours = np.array([[asked(air, time_s, FEW) for air in airs] for time_s in (0.0, 1.0)])
    for k in range(len(FEW)):
        for when in (0, 1):
            assert ks_2samp(ours[when, :, k], brownian[when, :, k]).pvalue > 0.002
        if rate > 1:  # but a walk forgets sooner than a displacement that grows with the age
            kept, forgotten = (spearmanr(*gas[:, :, k]).statistic for gas in (ours, brownian))
            assert kept - forgotten > 0.1


def test_an_answer_is_the_same_to_the_bit_in_any_order_alone_or_together() -> None:
    rng = np.random.default_rng(0)
    times_s = np.concatenate([rng.uniform(0, 900, 60), rng.uniform(0, 60, 40), [1e5, 0.0, 900.0]])
    places = np.column_stack([rng.uniform(0, 30, (len(times_s), 2)), np.zeros(len(times_s))])
    for seed, parameters in ((1, {}), (2, {"meander": 20.0, "gusts": 0.3, "wander": 5.0, "rate": 3.0})):
        air = puffs(draw(seed), seed, **parameters)
        alone = [air(places[i : i + 1], times_s[i : i + 1]) for i in range(len(times_s))]
        gas, wind = np.concatenate([one[0] for one in alone]), np.concatenate([one[1] for one in alone])
        for order in (np.argsort(times_s), np.argsort(-times_s)):
            again = puffs(draw(seed), seed, **parameters)(places[order], times_s[order])
            assert again[0].tobytes() == gas[order].tobytes()
            assert again[1].tobytes() == wind[order].tobytes()


def test_another_seed_has_other_puffs_and_another_place_of_the_source_the_same_ones_there() -> None:
    moved = replace(RELEASE, source=(14.0, 13.0))
    beside = PLACES + np.array([2.0, 0.0, 0.0])
    assert asked(puffs(moved, 7), 5.0, beside) == pytest.approx(asked(puffs(RELEASE, 7), 5.0), rel=1e-9)
    assert (asked(puffs(RELEASE, 8), 5.0) != asked(puffs(RELEASE, 7), 5.0)).all()


def test_direction_and_speed_wander_as_ornstein_uhlenbeck_processes() -> None:
    """Standard deviations and correlations within four standard errors of some 1,600 times apart."""
    times_s = np.arange(0.0, 20_000.0, 2.5)
    air = puffs(RELEASE, 3, meander=15.0, gusts=0.2, wander=10.0, rate=0.1)
    wind = air(np.tile(PLACES[0], (len(times_s), 1)), times_s)[1]
    turned = np.degrees(np.arctan2(wind[:, 1], wind[:, 0]) - RELEASE.phi)
    speed = np.hypot(wind[:, 0], wind[:, 1]) / RELEASE.u - 1
    independent = len(times_s) * (1 - math.exp(-0.25)) / (1 + math.exp(-0.25))
    for values, std in ((turned, 15.0), (speed, 0.2)):
        assert abs(values.mean()) < 4 * std / math.sqrt(independent)
        assert values.std() == pytest.approx(std, rel=4 * math.sqrt(0.5 / independent))
        for lag in (1, 4, 8):
            found = float(np.corrcoef(values[:-lag], values[lag:])[0, 1])
            assert found == pytest.approx(math.exp(-0.25 * lag), abs=4 / math.sqrt(independent))
    assert abs(np.corrcoef(turned, speed)[0, 1]) < 4 / math.sqrt(independent)


def test_without_a_meander_the_wind_is_the_releases_own() -> None:
    _, wind = puffs(RELEASE, 3)(PLACES, np.linspace(0, 100, len(PLACES)))
    assert wind == pytest.approx(np.tile(RELEASE.wind, (len(PLACES), 1)), rel=1e-14)


def test_puffs_go_where_the_wind_blows() -> None:
    """Between two releases the centroid of all gas moves with the air, and the gas decays: on a grid that
    holds all of a wide, slow puff.
    """
    calm = replace(RELEASE, u=1.0, d=0.01, tau=4.0, source=(15.0, 15.0))
    air = puffs(calm, 5, share=1.0, rate=0.1, size=1.0, meander=40.0, gusts=0.4, wander=3.0)
    x, y = np.meshgrid(np.arange(-25.0, 55.0, 0.5), np.arange(-25.0, 55.0, 0.5))
    grid = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    seen = 0
    for begin_s in np.arange(0.0, 60.0, 1.0):
        before, after = asked(air, begin_s, grid), asked(air, begin_s + 0.5, grid)
        if not 0 < after.sum() == pytest.approx(before.sum() * math.exp(-0.5 / 4.0), rel=0.005):
            continue  # a puff has left, or none is there
        (_, (wind,)) = air(grid[:1], np.array([begin_s]))
        moved = (after @ grid / after.sum() - before @ grid / before.sum())[:2]
        assert moved == pytest.approx(-0.5 * wind, abs=0.01)
        seen += 1
    assert seen > 20
