"""Protects the 95% region: the ellipse and the contour hold what they say, outlines are closed and oriented,
and that of a stop has the width that gas like this asks for.
"""

import html
import math

import numpy as np
import pytest
from msgspec.structs import replace

from ground.findings.figures import as_json
from ground.findings.page import page
from ground.findings.region import Contour95, contour_95, ellipse_95, scale_of
from tests.ground.findings.records import findings

RNG = np.random.default_rng(5)


def gaussian(
    count: int, covariance: list[list[float]], mean: tuple[float, float] = (10.0, 20.0)
) -> np.ndarray:
    return RNG.multivariate_normal(mean, covariance, count)


def twice_area(ring: np.ndarray) -> float:
    x, y = ring.T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))


def contour_of(places: np.ndarray, weights: np.ndarray | None = None) -> Contour95:
    found = contour_95(places, np.ones(len(places)) if weights is None else weights)
    assert found
    return found


def test_the_ellipse_holds_95_percent_of_a_gaussian() -> None:
    covariance = [[4.0, 1.5], [1.5, 1.0]]
    ellipse = ellipse_95((10.0, 20.0), (4.0, 1.5, 1.0))
    offsets = gaussian(200_000, covariance) - (10.0, 20.0)
    cosine, sine = math.cos(ellipse.angle), math.sin(ellipse.angle)
    along = (offsets @ (cosine, sine)) / ellipse.longer_m
    across = (offsets @ (-sine, cosine)) / ellipse.shorter_m
    assert np.mean(along**2 + across**2 <= 1) == pytest.approx(0.95, abs=0.002)


def test_the_bearing_of_the_longer_axis_is_clockwise_from_north() -> None:
    assert ellipse_95((0.0, 0.0), (1.0, 0.0, 4.0)).bearing_deg == pytest.approx(0.0)  # along north
    assert ellipse_95((0.0, 0.0), (4.0, 0.0, 1.0)).bearing_deg == pytest.approx(90.0)  # along east
    assert ellipse_95((0.0, 0.0), (2.0, 1.0, 2.0)).bearing_deg == pytest.approx(45.0)  # north-east


def test_the_outline_is_closed_and_runs_counter_clockwise() -> None:
    ellipse = ellipse_95((10.0, 20.0), (4.0, 1.5, 1.0))
    outline = ellipse.outline
    assert (outline[0] == outline[-1]).all()
    inside = math.pi * ellipse.longer_m * ellipse.shorter_m
    assert twice_area(outline) / 2 == pytest.approx(inside, rel=0.01)


def test_the_contour_of_a_gaussian_is_near_its_ellipse() -> None:
    places = gaussian(20_000, [[4.0, 1.5], [1.5, 1.0]])
    contour = contour_of(places)
    ellipse = ellipse_95((10.0, 20.0), (4.0, 1.5, 1.0))
    [ring] = contour.rings
    wanted = math.pi * ellipse.longer_m * ellipse.shorter_m
    assert twice_area(ring) / 2 == pytest.approx(wanted, rel=0.12)
    fresh = gaussian(2_000, [[4.0, 1.5], [1.5, 1.0]])
    assert np.mean([contour.contains((x, y)) for x, y in fresh.tolist()]) == pytest.approx(0.95, abs=0.03)


def test_a_region_of_another_scale_has_the_same_middle_and_shape() -> None:
    places = gaussian(20_000, [[4.0, 1.5], [1.5, 1.0]])
    own, [ring] = ellipse_95((10.0, 20.0), (4.0, 1.5, 1.0)), contour_of(places).rings
    half, found = ellipse_95((10.0, 20.0), (4.0, 1.5, 1.0), 0.5), contour_95(places, np.ones(20_000), 0.5)
    assert found
    [small] = found.rings
    assert (half.longer_m, half.shorter_m) == pytest.approx((own.longer_m / 2, own.shorter_m / 2))
    assert half.bearing_deg == own.bearing_deg
    assert twice_area(small) == pytest.approx(twice_area(ring) / 4, rel=1e-6)
    assert small.mean(axis=0) == pytest.approx((ring.mean(axis=0) + places.mean(axis=0)) / 2, abs=1e-6)


@pytest.mark.parametrize(
    ("cv", "scale"),
    # √(1.5 cv): in steady gas 0.3 is believed, with few puffs 1.5; never narrower than half, wider than twice
    [(0.3, 0.670820), (2 / 3, 1.0), (1.5, 1.5), (0.1, 0.5), (20.0, 2.0)],
)
def test_the_region_of_a_stop_is_wider_the_more_the_gas_came_and_went(cv: float, scale: float) -> None:
    last = replace(
        findings().last, ceased=True, intermittency={"downwind": (cv / 2, cv, 2 * cv), "cv": (0.0, 0.1, 9.0)}
    )
    assert scale_of(last) == pytest.approx(scale, rel=1e-5)
    assert scale_of(replace(last, ceased=False)) == 1.0  # it was measured at stops
    assert scale_of(replace(last, intermittency={})) == 1.0  # what the gas is like was told


@pytest.mark.parametrize(
    ("puffs_per_s", "wider"), [(900.0, 1.0), (200.0, 1.0), (200 / 16, 2.0), (200 / 1.4641, 1.1), (1e-9, 2.0)]
)
def test_it_is_wider_still_the_fewer_puffs_there_were(puffs_per_s: float, wider: float) -> None:
    gas = {"downwind": (0.3, 2 / 3, 0.9), "puff-rate": (1e-9, puffs_per_s, 1e9)}
    assert scale_of(replace(findings().last, ceased=True, intermittency=gas)) == pytest.approx(wider)


def test_findings_say_how_much_wider_their_region_is() -> None:
    it = findings()
    _, cv, _ = it.last.intermittency["downwind"]
    _, puffs_per_s, _ = it.last.intermittency["puff-rate"]
    scale = math.sqrt(1.5 * cv) * max(200 / puffs_per_s, 1.0) ** 0.25
    assert as_json(it)["region_95"]["scale"] == pytest.approx(scale)
    own = ellipse_95(it.last.mean, it.last.covariance)
    assert it.ellipse.longer_m == pytest.approx(scale * own.longer_m)
    assert it.contour
    [ring] = it.contour.rings
    assert abs(twice_area(ring)) / 2 == pytest.approx(
        math.pi * it.ellipse.longer_m * it.ellipse.shorter_m,
        rel=0.5,  # of 100 particles, which are no normal distribution
    )
    assert f"{scale:.2f} times as wide as the belief's own" in html.unescape(page(it))


def test_the_contour_holds_95_percent_of_the_weight_and_not_of_the_count() -> None:
    near, far = (
        gaussian(1000, [[1.0, 0.0], [0.0, 1.0]]),
        gaussian(1000, [[1.0, 0.0], [0.0, 1.0]], (30.0, 20.0)),
    )
    weights = np.concatenate([np.full(1000, 1.0), np.full(1000, 1e-6)])
    contour = contour_of(np.concatenate([near, far]), weights)
    assert contour.contains((10.0, 20.0))
    assert not contour.contains((30.0, 20.0))


def test_two_places_have_two_outlines_and_what_lies_between_them_is_outside() -> None:
    places = np.concatenate(
        [gaussian(2000, [[0.04, 0.0], [0.0, 0.04]]), gaussian(2000, [[0.04, 0.0], [0.0, 0.04]], (14.0, 23.0))]
    )
    contour = contour_of(places)
    assert len(contour.rings) == 2
    assert not contour.contains((12.0, 21.5))


def test_a_ring_of_particles_has_an_outline_and_a_hole() -> None:
    angle = RNG.uniform(0, 2 * math.pi, 20_000)
    radius = RNG.normal(5.0, 0.3, 20_000)
    places = np.stack([10 + radius * np.cos(angle), 20 + radius * np.sin(angle)], axis=1)
    contour = contour_of(places)
    areas = sorted(twice_area(ring) for ring in contour.rings)
    assert areas[0] < 0 < areas[-1]
    assert not contour.contains((10.0, 20.0))
    assert all((ring[0] == ring[-1]).all() for ring in contour.rings)


def test_particles_on_a_line_or_in_one_place_have_no_contour() -> None:
    line = np.stack([np.linspace(0, 10, 100), np.full(100, 3.0)], axis=1)
    assert contour_95(line, np.ones(100)) is None
    assert contour_95(np.full((50, 2), 7.0), np.ones(50)) is None
