"""Protects the comparison of laws on exact grids: Bayes' rule worked by hand, densities that are densities,
the cv of Campbell's theorem, and a page that shows the rows that are kept.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks import laws
from benchmarks.laws import CELL_M, FIGURES, LAWS, PAGE, SENSOR, Row, Search, page, read
from plume.dispersion import concentration
from plume.parameters import CV
from plume.scenario import AREA_M, draw

pytestmark = pytest.mark.full

CELLS = np.array([[1.0, 2.0, 4.0], [3.0, 3.0, 7.0]])


def test_the_belief_is_bayes_rule_worked_by_hand() -> None:
    """Densities 0.1, 0.3, 0.6, then 0.8, 0.2, 0.1: products 0.08, 0.06, 0.06, so 0.4, 0.3, 0.3."""
    places, logs = laws.updated(CELLS, np.zeros(3), np.log([0.1, 0.3, 0.6]))
    places, logs = laws.updated(places, logs, np.log([0.8, 0.2, 0.1]))
    assert np.exp(logs) / np.exp(logs).sum() == pytest.approx([0.4, 0.3, 0.3])
    mean, covariance = laws.moments(places, logs)
    assert mean == pytest.approx((0.4 * 1 + 0.3 * 2 + 0.3 * 4, 0.7 * 3 + 0.3 * 7))  # 2.2, 4.2
    xx = 0.4 * 1.2**2 + 0.3 * 0.2**2 + 0.3 * 1.8**2
    xy = 0.4 * 1.2 * 1.2 + 0.3 * 0.2 * 1.2 + 0.3 * 1.8 * 2.8
    yy = 0.7 * 1.2**2 + 0.3 * 2.8**2
    within = CELL_M**2 / 12  # the variance of an even density in a cell
    assert covariance == pytest.approx((xx + within, xy, yy + within))


def test_only_cells_without_hope_are_left_out() -> None:
    places, logs = laws.updated(CELLS, np.zeros(3), np.array([0.0, -59.0, -61.0]))
    assert places.tolist() == [[1.0, 2.0], [3.0, 3.0]]
    assert logs.tolist() == [0.0, -59.0]


@pytest.mark.parametrize("law", LAWS)
def test_a_law_is_a_density_whose_mean_is_that_of_the_plume(law: str) -> None:
    """By the trapezoid rule over readings. The inverse Gaussian law is approximate: docs/physics.md has its
    error of up to 0.005 for these cv.
    """
    scenario = draw(1_000_003)
    kind, of_puffs = LAWS[law]
    is_gamma = kind == laws.GAMMA
    priors = laws.known("puffs:share=0.2", scenario)[of_puffs]
    for far_m in (2.0, 6.0):
        place = np.array(scenario.source) - far_m * np.array(scenario.wind) / scenario.u
        mean = float(
            concentration(
                place,
                scenario.source,
                scenario.wind,
                rate=scenario.q,
                diffusivity=scenario.d,
                lifetime=scenario.tau,
            )
        )
        tail = np.geomspace(1.0, 300.0 * mean, 6000)
        gas = np.concatenate([np.linspace(-8.0 * (0.3 * mean + 0.2), 1.0, 4000)[:-1], tail])
        source = np.array(scenario.source)[:, None]
        logs = [
            laws.log_densities(
                kind, source, np.array([*place, 0.0, *scenario.wind, z]), priors, SENSOR
            ).item()
            for z in gas.tolist()
        ]
        assert np.trapezoid(np.exp(logs), gas) == pytest.approx(1.0, abs=1e-4 if is_gamma else 0.01)
        assert np.trapezoid(gas * np.exp(logs), gas) == pytest.approx(mean, rel=1e-3 if is_gamma else 0.02)


@pytest.mark.parametrize("cv", [0.1, 0.5, 1.0, 3.0, 8.0])
@pytest.mark.parametrize(("mean", "std"), [(0.5, 0.25), (3.0, 0.9), (0.01, 0.2)])
def test_the_gamma_law_with_noise_is_the_mean_over_its_quantiles(cv: float, mean: float, std: float) -> None:
    """Over the middles of 400,000 equal shares: their own error is below 1e-4 here."""
    from scipy import stats

    shares = (np.arange(400_000) + 0.5) / 400_000
    quantiles = stats.gamma(1 / cv**2, scale=mean * cv**2).ppf(shares)
    for z in (-std, 0.0, mean, mean + 2 * std + 2 * cv * mean):
        told = laws.gamma_density(z, mean, std * std, cv * cv)
        assert told == pytest.approx(math.log(stats.norm(quantiles, std).pdf(z).mean()), abs=1e-4)


@pytest.mark.parametrize(("share", "rate"), [(0.2, 10.0), (0.05, 3.0)])
def test_one_cv_is_campbells_downwind_of_the_source(share: float, rate: float) -> None:
    """The variance by numerical integration over ages, of puffs that have no size when they leave. The
    model's closed form is right to a percent.
    """
    s = draw(1_000_004)
    ages = np.geomspace(1e-6, 50.0, 200_001)
    far = laws.ONE_CV_M
    own, moved = 2 * share * s.d * ages, 2 * (1 - share) * s.d * ages
    wide = own / 2 + moved
    puffs = (s.q / rate * np.exp(-ages / s.tau)) ** 2 / (4 * np.pi * own) ** 1.5
    there = np.exp(-((far - s.u * ages) ** 2) / (2 * wide)) / (2 * np.pi * wide) ** 1.5
    variance = rate * np.trapezoid(puffs * there, ages)
    place = np.array(s.source) - far * np.array(s.wind) / s.u
    mean = concentration(place, s.source, s.wind, rate=s.q, diffusivity=s.d, lifetime=s.tau)
    one, puffs_too = laws.known(f"puffs:share={share},rate={rate}", s)
    assert one[CV, 1] == pytest.approx(math.sqrt(variance) / float(mean), rel=0.01)
    assert puffs_too[CV, 1] == 0
    told = laws.known("cv-1", s)
    assert (told[0][CV, 1], told[1][CV, 1]) == (1.0, 1.0)


def test_a_step_goes_towards_the_goal_and_stays_in_the_area() -> None:
    half = math.sqrt(0.5)
    assert laws.moved((5.0, 5.0), np.array([9.0, 9.5])) == pytest.approx((5 + half, 5 + half))
    assert laws.moved((5.0, 5.0), np.array([0.0, 4.0])) == pytest.approx((4.0, 5.0))
    assert laws.moved((AREA_M, 5.0), np.array([40.0, 4.0])) == pytest.approx((AREA_M, 4.0))


def test_a_search_in_steady_gas_finds_the_source() -> None:
    found = laws.search("as-modelled", "inverse Gaussian, puffs", 1_000_000)
    assert found.ceased
    assert found.error_m < 1.0
    assert found.readings == found.distance_m + 1


def test_rows_say_what_is_counted_by_hand() -> None:
    one = Search(True, 0.5, 1.0, 30.0, (-1.0, -2.0, -3.0, -4.0, -5.0), 10)
    other = Search(True, 1.5, 5.0, 50.0, (-1.0, -2.0, -3.0, -4.0, -5.0), 30)
    lost = Search(False, 9.0, 99.0, 600.0, (-2.0, -4.0, -6.0, -8.0, -9.0), 60)
    rows = laws.rows_of(
        "cv-1", {"gamma, one cv": [one, other, lost], "clipped inverse Gaussian, one cv": [lost]}
    )
    # Readings of both: 160; scores of the first law −6, of the third −18.
    assert rows[0] == Row("cv-1", "gamma, one cv", 3, pytest.approx(2 / 3), 0.5, 3.0, 3.0, 40.0, -6 / 160)
    assert rows[1][:4] == ("cv-1", "clipped inverse Gaussian, one cv", 1, 0.0)
    assert all(math.isnan(value) for value in rows[1][4:8])
    assert rows[1].score == -18 / 160
    assert laws.laws("cv-1") == ["gamma, one cv", "clipped inverse Gaussian, one cv"]
    assert laws.laws("puffs:share=0.2") == [*LAWS]


def test_the_page_shows_the_rows_that_are_kept() -> None:
    text = PAGE.read_text()
    assert page(text, read(FIGURES)) == text
    with pytest.raises(ValueError, match="no lines <!-- laws -->"):
        page("# Physics\n", [])


def test_one_world_is_flown_and_the_rows_of_others_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, figures = tmp_path / "physics.md", tmp_path / "figures.csv"
    document.write_text("# Physics\n\n<!-- laws -->\n<!-- end -->\nMore.\n")
    kept = Row("cv-1", "gamma, one cv", 7, 1.0, 0.25, 3.0, 2.0, 40.0, -1.5)
    laws.keep([kept], figures)
    monkeypatch.setattr(laws, "PAGE", document)
    monkeypatch.setattr(laws, "FIGURES", figures)
    asked = ["--worlds", "puffs:share=0.5", "--missions", "1", "--workers", "1"]
    monkeypatch.setattr("sys.argv", ["laws", *asked])
    laws.main()
    rows = read(figures)
    assert rows[-1] == kept
    assert [(row.world, row.law) for row in rows[:-1]] == [("puffs:share=0.5", law) for law in LAWS]
    assert "| `cv-1` | gamma, one cv | 25.0 | 100.0 | 3.0 (2.0) | 40.0 | -1.500 |" in document.read_text()
    assert document.read_text().endswith("<!-- end -->\nMore.\n")


def test_what_it_does_not_know_it_says_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["laws", "--worlds", "stuck"])
    with pytest.raises(SystemExit, match="2"):
        laws.main()
    [line] = capsys.readouterr().err.splitlines()
    assert "puffs:share=0.05" in line
