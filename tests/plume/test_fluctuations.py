"""Protects how strongly gas fluctuates at a place: as puffs do by Campbell's theorem and in the simulated
worlds, not at all if they are infinitely many, and along a ray as at the place nearest to the source.
"""

import itertools
import math

import numpy as np
import pytest
from numba import njit

from plume.dispersion import concentration
from plume.kernels import DERIVED, derive, squares_of_puffs
from plume.parameters import (
    EAST,
    KNOWN,
    MEASURED,
    NEUTRAL,
    NORTH,
    PARAMETERS,
    PHI,
    RAY,
    UP,
    Q,
    U,
)
from plume.scenario import Scenario
from plume.sensors.names import GAUSSIAN, sensor_row
from plume.worlds.puffs import puffs

Array = np.ndarray
RELEASE = Scenario(source=(12.0, 13.0), q=200.0, u=2.0, phi=0.5, d=3.0, tau=10.0, start=(1.0, 2.0))
SOURCE = np.array([*RELEASE.source, 0.0])
MOST = 900.0
"""Greatest square: of a cv of 30."""


@njit
def kernel_squares(particles: Array, unknowns: Array, priors: Array, readings: Array, sensor: Array) -> Array:
    """Squared coefficients of variation at the place of each reading (T, 5), by particle (D, N): (T, N)."""
    count = particles.shape[1]
    derived, result = np.empty((DERIVED, count)), np.empty((len(readings), count))
    derive(particles, count, unknowns, priors, derived)
    for t in range(len(readings)):
        squares_of_puffs(derived, count, readings[t], priors, sensor, result[t])
    return result


def squares(
    places: Array,
    wind: tuple[float, float] = RELEASE.wind,
    ray: tuple[float, float, float] | None = None,
    **known: float,
) -> Array:
    """Those of gas of the release at places (M, 3). wind: m/s.

    ray: from the place to its other end.  known: parameters, with _ for -.
    """
    s = RELEASE
    values = {"x": s.source[0], "y": s.source[1], "z": 0.0, "d": s.d, "tau": s.tau, "cv": 0.0, **NEUTRAL}
    values |= {name.replace("_", "-"): value for name, value in known.items()}
    priors = np.array([[KNOWN, values.get(name, 0.0), 0.0, 0.0, 0.0] for name in PARAMETERS])
    priors[[U, PHI], 0] = MEASURED
    sensor = sensor_row(GAUSSIAN)
    if ray is not None:
        sensor[RAY] = math.hypot(*ray)
        sensor[[EAST, NORTH, UP]] = np.array(ray) / sensor[RAY]
    readings = np.column_stack([places, np.broadcast_to(wind, (len(places), 2))])
    found = kernel_squares(np.array([[s.q, 2 * s.q]]), np.array([Q]), priors, readings, sensor)
    assert (found[:, 0] == found[:, 1]).all()  # of twice the gas, twice the fluctuations
    return found[:, 0]


def campbell(place: Array, wind: tuple[float, float], share: float, rate: float) -> float:
    """The variance by the squared mean: the rate times the integral over ages of the mean square of a puff
    (Campbell 1909). Squared, a normal puff of the variance 2 s d a is one of half of that.
    """
    from scipy import integrate

    s = RELEASE
    offset = place - SOURCE
    mean = concentration(place, SOURCE, wind, rate=s.q, diffusivity=s.d, lifetime=s.tau)

    def of_age(log_age: float) -> float:
        age = math.exp(log_age)
        own, moved = 2 * share * s.d * age, 2 * (1 - share) * s.d * age
        flown = offset + age * np.array([*wind, 0.0])
        wide = own / 2 + moved
        centred = -flown @ flown / (2 * wide) - 1.5 * math.log(2 * math.pi * wide)
        grams = 2 * math.log(s.q / rate) - 2 * age / s.tau - 1.5 * math.log(4 * math.pi * own)
        return rate * math.exp(centred + grams - 2 * math.log(mean) + log_age)

    ends = np.log(np.geomspace(1e-6, 600.0, 25))
    return sum(
        integrate.quad(of_age, low, high, epsabs=0, epsrel=1e-8, limit=200)[0]
        for low, high in itertools.pairwise(ends.tolist())
    )


def around(wind: tuple[float, float]) -> Array:
    """Places (M, 3) from 0.3 to 20 m from the source: downwind, beside, upwind, askew and above."""
    along = -np.array(wind) / math.hypot(*wind) if any(wind) else np.array([1.0, 0.0])
    beside = np.array([-along[1], along[0]])
    ways = [(*along, 0.0), (*beside, 0.0), (*-along, 0.0), (*(0.8 * along - 0.6 * beside), 0.0)]
    ways.append((*(0.6 * along), 0.8))
    return np.array([SOURCE + r * np.array(way) for way in ways for r in (0.3, 1.0, 3.0, 8.0, 20.0)])


@pytest.mark.one_in(4)
@pytest.mark.parametrize("wind", [(0.0, 0.0), (1.8, 0.9), (-4.0, 3.0)], ids=["calm", "breeze", "wind"])
@pytest.mark.parametrize("share", [0.05, 0.2, 0.5, 1.0])
def test_the_square_is_campbells_integral(share: float, wind: tuple[float, float]) -> None:
    places, rate = around(wind), 1e6
    expected = np.array([campbell(place, wind, share, rate) for place in places])
    assert np.mean(expected < MOST) > 0.8  # far upwind in a wind only the rarest puff arrives
    found = squares(places, wind, puff_rate=rate, puff_share=share)
    # The kernel's Bessel function is the root of a polynomial, right to 0.1%.
    assert found == pytest.approx(np.minimum(expected, MOST), rel=0.002)


def test_gas_that_fluctuates_everywhere_adds_to_its_puffs() -> None:
    places = around(RELEASE.wind)
    even = squares(places, puff_rate=1e6, puff_share=0.2, cv=1.5) - squares(
        places, puff_rate=1e6, puff_share=0.2
    )
    assert even == pytest.approx(np.full(len(places), 1.5**2))


@pytest.mark.parametrize("cv", [0.0, 0.7, 3.0])
def test_infinitely_many_puffs_are_steady_but_for_what_fluctuates_everywhere(cv: float) -> None:
    for wind in ((0.0, 0.0), RELEASE.wind, (-120.0, 0.0)):
        places = np.vstack([around(wind), [[-300.0, 13.0, 0.0], [330.0, 13.0, 0.0]]])
        for share in (0.02, 1.0):
            assert (squares(places, wind, puff_rate=math.inf, puff_share=share, cv=cv) == cv**2).all()


def test_no_square_is_above_the_greatest_nor_grows_within_the_source() -> None:
    near = SOURCE + np.array([[1e-9, 0.0, 0.0], [0.0, 0.05, 0.0], [0.0, 0.0, 0.1]])
    calm = squares(near, (0.0, 0.0), puff_rate=1e6)
    assert calm == pytest.approx(np.full(3, campbell(near[2], (0.0, 0.0), 0.2, 1e6)), rel=0.002)
    assert (squares(near, puff_rate=0.1) == MOST).all()
    assert (squares(np.array([[300.0, 170.0, 0.0]]), (100.0, 50.0), puff_rate=1.0) == MOST).all()


def test_an_anemometers_error_turns_and_changes_the_wind_that_carries_the_puffs() -> None:
    places, angle = around(RELEASE.wind), RELEASE.phi + math.radians(40.0)
    true_wind = 3.0 * math.cos(angle), 3.0 * math.sin(angle)
    found = squares(places, puff_rate=1e6, wind_direction=40.0, wind_speed=1.5)
    assert found == pytest.approx(squares(places, true_wind, puff_rate=1e6), rel=1e-9)


def test_along_a_ray_it_is_that_of_the_place_nearest_to_the_source() -> None:
    place = SOURCE + np.array([-6.0, 2.0, 5.0])
    nearest = {
        (8.0, 0.0, 0.0): (0.0, 2.0, 5.0),  # passes the source
        (3.0, 0.0, 0.0): (-3.0, 2.0, 5.0),  # ends before it does
        (-8.0, 0.0, 0.0): (-6.0, 2.0, 5.0),  # looks away
        (0.0, 0.0, -9.0): (-6.0, 2.0, 0.0),  # looks down
    }
    for ray, closest in nearest.items():
        found = squares(place[None], ray=ray, puff_rate=1e4)
        assert found == pytest.approx(squares(SOURCE[None] + np.array(closest), puff_rate=1e4), rel=1e-12)


@pytest.mark.one_in(2)
@pytest.mark.slow
@pytest.mark.parametrize(("share", "rate"), [(0.5, 10.0), (0.2, 40.0)])
def test_simulated_puffs_fluctuate_as_strongly(share: float, rate: float) -> None:
    """At one time, downwind and beside the source, in 4,000 missions: within four standard errors."""
    places, count = np.array([[9.0, 11.0, 0.0], [10.0, 15.5, 0.0]]), 4000
    now = np.full(2, 20.0)
    gas = np.array(
        [puffs(RELEASE, seed, share=share, rate=rate, size=0.01)(places, now)[0] for seed in range(count)]
    )
    mean = concentration(
        places, SOURCE, RELEASE.wind, rate=RELEASE.q, diffusivity=RELEASE.d, lifetime=RELEASE.tau
    )
    deviations = np.square(gas / mean - 1)
    expected = squares(places, puff_rate=rate, puff_share=share)
    errors = deviations.std(axis=0) / math.sqrt(count)
    assert (np.abs(deviations.mean(axis=0) - expected) < 4 * errors).all()
    assert (errors < 0.06 * expected).all()  # so that this says something
