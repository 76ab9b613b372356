"""Protects what the belief says of how the gas comes and goes, and the advice how long to hover."""

import math

import numpy as np
import pytest

from agent.trials.rollout import mission
from estimator.dwell import DOWNWIND, NEAR_M, advised_dwell, intermittency, quantiles
from estimator.filter import Config, Posterior, assimilate, prior
from estimator.priors import Fixed
from link.bus.mavlink import Reading
from plume.dispersion import concentration
from plume.sensors.names import parse

READING = Reading(0, (8.0, 6.0), 5.0, (0.0, 2.0), 1.0)


def of(names: dict[str, list[float]], weights: list[float], config: Config) -> Posterior:
    """A posterior after one reading, of particles with these values."""
    values = {name: names.get(name, [1.0] * len(weights)) for name in config.unknowns}
    w = np.array(weights)
    row = config.row(READING)[None]
    return Posterior(
        np.array([*values.values()]), np.log(w), w / w.max(), np.zeros(len(w)), row, np.array([0.5])
    )


def test_a_quantile_is_the_least_value_that_a_share_of_the_weight_reaches() -> None:
    # In order: 1 has reached 4 of 10, 2 has 8, 3 has 9, 10 has 10. Wanted are 0.5, 5 and 9.5 of 10.
    values, weights = np.array([3.0, 1.0, 2.0, 10.0]), np.array([0.25, 1.0, 1.0, 0.25])
    assert quantiles(values, weights) == (1.0, 2.0, 10.0)
    assert quantiles(values, 0.3 * weights) == (1.0, 2.0, 10.0)
    assert quantiles(np.array([5.0, 99.0]), np.array([1.0, 1e-9])) == (5.0, 5.0, 5.0)
    assert quantiles(np.array([5.0]), np.array([1.0])) == (5.0, 5.0, 5.0)


def test_the_order_of_equal_values_does_not_change_a_quantile() -> None:
    """Sums of floating-point numbers depend on their order; a level that one order reaches another misses."""
    rng = np.random.default_rng(1)
    values, weights = rng.integers(0, 20, 1000).astype(float), rng.random(1000)
    for _ in range(20):
        order = rng.permutation(1000)
        assert quantiles(values[order], weights[order]) == quantiles(values, weights)
    # A level that is reached exactly: 0.05 of 1000 equal weights are 50.
    assert quantiles(np.arange(1000.0), np.full(1000, 0.7)) == (49.0, 499.0, 949.0)


def test_each_unknown_of_the_gas_is_told_by_its_name() -> None:
    config = Config(assume="field")
    names = {"cv": [0.1, 0.2], "puff-rate": [5.0, 50.0], "puff-share": [0.9, 0.3], "x": [9.0, 9.0]}
    said = intermittency(of(names, [0.2, 0.8], config), config)
    assert list(said) == [DOWNWIND, "cv", "puff-rate", "puff-share"]
    assert (said["cv"], said["puff-rate"], said["puff-share"]) == (
        (0.1, 0.2, 0.2),
        (5.0, 50.0, 50.0),
        (0.3, 0.3, 0.9),
    )


@pytest.mark.parametrize(
    ("turned", "speed", "share"), [(0.0, 1.0, 0.2), (50.0, 1.0, 0.2), (-120.0, 0.6, 0.05), (0.0, 1.5, 1.0)]
)
def test_the_cv_downwind_is_that_of_campbells_theorem(turned: float, speed: float, share: float) -> None:
    """Summed over the ages of puffs. The particle's wind blows at `speed` times the measured 2 m/s, turned;
    the place lies where that wind carries the gas. Puffs are born without size: the law differs by less than
    1% from the closed form that the filter has (docs/physics.md).
    """
    config = Config(assume="field", rate=300.0, diffusivity=4.5, lifetime=10.0)
    names = {"wind-direction": [turned], "wind-speed": [speed], "cv": [0.4], "puff-rate": [10.0]}
    particle = names | {"puff-share": [share], "q": [300.0], "tau": [10.0], "x": [3.0], "y": [25.0]}
    said = intermittency(of(particle, [1.0], config), config)
    d, tau, rate, u = 4.5, 10.0, 10.0, 2.0 * speed
    age, step = np.linspace(0.0, 40.0, 400_001)[1:], 1e-4
    own, moved = share * d * age, 2 * (1 - share / 2) * d * age
    off = NEAR_M - u * age
    density = np.exp(-off * off / (2 * moved)) / (2 * math.pi * moved) ** 1.5
    variance = (
        (300.0**2 / rate) * np.sum(np.exp(-2 * age / tau) * density / (8 * math.pi * own) ** 1.5) * step
    )
    mean = concentration((NEAR_M, 0.0), (0.0, 0.0), (-u, 0.0), rate=300.0, diffusivity=d, lifetime=tau)
    assert said[DOWNWIND][1] == pytest.approx(math.sqrt(0.4**2 + variance / float(mean) ** 2), rel=0.01)


def test_what_is_known_of_the_gas_is_not_told() -> None:
    config = Config(assume="field", priors={"puff-share": Fixed(0.2)})
    assert list(intermittency(of({}, [1.0], config), config)) == [DOWNWIND, "cv", "puff-rate"]
    for steady in (
        Config(),
        Config(assume="field", sensor=parse("hits")),
        Config(sensor=parse("gaussian:0.3,0.2,1")),
    ):
        posterior = assimilate(prior(steady), READING, steady)
        assert intermittency(posterior, steady) == {}
        assert advised_dwell({}, steady.sensor) == 0.0


def test_a_longer_hover_is_advised_where_gas_surely_comes_and_goes() -> None:
    def advised(least: float, dwell_s: float) -> float:
        return advised_dwell({DOWNWIND: (least, 3.0, 9.0)}, parse(f"gaussian:dwell={dwell_s}"))

    assert [advised(least, 0.0) for least in (0.1, 0.49, 0.5, 1.29, 1.3, 2.29, 2.3, 30.0)] == [
        *(0.0, 0.0),  # it may be steady, however likely it is not
        *(1.0, 1.0, 2.0, 2.0, 5.0, 5.0),
    ]
    # A hover of 2 s leaves 1/1.83 of it: 1 + 2/0.85 is 1.83².
    assert [advised(least, 2.0) for least in (0.5, 1.25, 1.26)] == [0.0, 0.0, 5.0]
    assert advised_dwell({DOWNWIND: (30.0, 30.0, 30.0)}, parse("pid")) == 0.0  # it lags
    # Never a shorter one, and none beyond those that were flown.
    assert [advised(30.0, dwell_s) for dwell_s in (5.0, 600.0)] == [0.0, 0.0]


@pytest.mark.parametrize(
    ("world", "seed", "advised"), [("puffs:share=0.05", 1_000_001, True), ("as-modelled", 1_000_001, False)]
)
def test_a_search_in_small_puffs_is_told_to_hover_and_one_in_steady_gas_is_not(
    world: str, seed: int, advised: bool
) -> None:
    """Of 60 searches 98% and 0% are (docs/trust.md); this is one of them."""
    flown = mission(seed, "homing", 1000, 0.5, 100, world=world, assume="field")
    *_, last = flown.steps
    assert (last.belief.advised_dwell > 0) == advised
