"""Protects the statistics of gas in puffs: figures of series that are known, the laws that are fitted, rows
that obey Campbell's theorem, and a page that shows them.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks import puffs
from benchmarks.puffs import EVERY_S, EXCEEDED, FIGURES, PAGE, PICTURE, RELEASE, WORLDS, law, page, read
from plume.worlds.names import named

pytestmark = pytest.mark.full


def test_gas_that_is_there_a_quarter_of_the_time_has_the_figures_worked_by_hand() -> None:
    """Gas 4 in one of four times: mean 1, mean square 4, cv √3; (3, −1, −1, −1)/√3 has the third moment
    6/(3 √3) and the fourth 21/9.
    """
    gas = np.zeros((40, 1000))
    gas[::4] = 4.0
    said = puffs.statistics(gas)
    assert (said["mean"], said["present"]) == (1.0, 0.25)
    assert said["cv"] == pytest.approx(math.sqrt(3))
    assert said["skewness"] == pytest.approx(6 / (3 * math.sqrt(3)))
    assert said["kurtosis"] == pytest.approx(21 / 9)
    assert said["exceeded"] == tuple(4.0 if p < 0.25 else 0.0 for p in EXCEEDED)


def test_the_correlation_of_an_autoregressive_series_is_found() -> None:
    rng, kept = np.random.default_rng(0), 0.98
    gas = np.empty((300, 1000))
    gas[:, 0] = rng.standard_normal(300)
    for k in range(1, 1000):
        gas[:, k] = kept * gas[:, k - 1] + math.sqrt(1 - kept**2) * rng.standard_normal(300)
    said = puffs.statistics(10.0 + gas)
    assert said["correlation_s"] == pytest.approx(-EVERY_S / math.log(kept), rel=0.05)
    assert said["after_step"] == pytest.approx(kept ** round(puffs.STEP_S / EVERY_S), abs=0.02)


@pytest.mark.parametrize(("shape", "shift"), [(0.4, 0.05), (1.5, 0.7), (4.0, 3.0)])
def test_the_clipped_gamma_law_is_found_from_its_moments(shape: float, shift: float) -> None:
    """Moments by quadrature of max(G − shift, 0), G of the gamma law of scale 1."""
    from scipy import integrate, stats

    gamma = stats.gamma(shape)
    first, second = (
        integrate.quad(lambda g, n=n: (g - shift) ** n * gamma.pdf(g), shift, np.inf)[0] for n in (1, 2)
    )
    found = law(math.sqrt(second / first**2 - 1), float(gamma.sf(shift)))
    assert found == pytest.approx((shape, 1 / first, shift / first), rel=1e-5)
    at = np.array([0.0, 0.5, 3.0])
    assert found.below(at) == pytest.approx(gamma.cdf(first * at + shift), rel=1e-6)


def test_what_is_drawn_from_a_law_is_close_to_it_and_far_from_the_other() -> None:
    """The threshold is above the gas at which the laws differ most, at 0."""
    rng = np.random.default_rng(1)
    gamma, normal = rng.standard_gamma(0.5, (100, 1000)), rng.uniform(0.0, 1.0, (100, 1000))
    clipped = np.maximum(rng.standard_gamma(2.0, (100, 1000)) - 2.5, 0.0)
    assert puffs.statistics(gamma)["gamma"] < 0.01
    assert puffs.statistics(normal)["gamma"] > 0.05
    said = puffs.statistics(clipped)
    assert said["clipped"] < 0.02 < said["gamma"]


def cumulants(parameters: dict[str, float], place: tuple[float, float]) -> list[float]:
    """Cumulants 1 to 3 of shot noise at a place: the rate times the integral over ages of the mean n-th power
    of a puff (Campbell 1909; Rice 1944). Its n-th power is a normal puff of variance s²/n.
    """
    s, ages = RELEASE, np.geomspace(1e-5, 5 * RELEASE.tau, 100_001)
    rate, share, size = parameters["rate"], parameters["share"], parameters["size"]
    own = size**2 + 2 * share * s.d * ages
    moved = np.maximum(2 * s.d * ages - own, 0.0)
    square = (place[0] - s.u * ages) ** 2 + place[1] ** 2
    said = []
    for n in (1, 2, 3):
        wide = own / n + moved
        power = (s.q / rate * np.exp(-ages / s.tau) / (2 * np.pi * own) ** 1.5) ** n * (own / n / wide) ** 1.5
        said.append(float(rate * np.trapezoid(power * np.exp(-square / (2 * wide)), ages)))
    return said


@pytest.mark.parametrize("world", [world for world in WORLDS if "meander" not in world])
def test_the_rows_that_are_kept_obey_campbells_theorem(world: str) -> None:
    """Within four standard errors of so many independent times as the correlation leaves; the third moment,
    of which the fourth says too little, within a quarter where the gas is not too bursty.
    """
    parameters = {"rate": 10.0, "size": 0.1} | dict(named(world).parameters)
    rows = [row for row in read(FIGURES) if row.world == world]
    assert len(rows) == len(puffs.places())
    for row in rows:
        mean, variance, third = cumulants(parameters, (row.downwind_m, row.crosswind_m))
        independent = puffs.MISSIONS * puffs.LENGTH_S / (2 * row.correlation_s)
        assert row.mean == pytest.approx(mean, rel=4 * row.cv / math.sqrt(independent))
        error = 0.5 * math.sqrt((row.kurtosis - 1) / independent) + row.cv / math.sqrt(independent)
        assert row.cv == pytest.approx(math.sqrt(variance) / mean, rel=4 * error)
        if row.kurtosis < 10:
            assert row.skewness == pytest.approx(third / variance**1.5, rel=0.25)


def test_the_page_shows_the_rows_that_are_kept() -> None:
    text = PAGE.read_text()
    assert page(text, read(FIGURES)) == text
    assert f"]({PICTURE})" in text
    with pytest.raises(ValueError, match="no lines <!-- puffs -->"):
        page("# Worlds\n", [])


def test_rows_that_are_written_are_read_again_and_a_picture_is_drawn(tmp_path: Path) -> None:
    rows = puffs.rows_of(WORLDS[0], missions=2, length_s=4.0)
    assert [(row.downwind_m, row.crosswind_m > 0) for row in rows[::6]] == [(3.0, False), (3.0, True)]
    again = [row._replace(world=world) for world in WORLDS for row in rows]
    puffs.keep(again, tmp_path / "new" / "figures.csv")
    for said, was in zip(read(tmp_path / "new" / "figures.csv"), again, strict=True):
        assert said.world == was.world
        assert np.hstack(said[1:]) == pytest.approx(np.hstack(was[1:]), rel=1e-5, nan_ok=True)
    document = tmp_path / "worlds.md"
    document.write_text("# Worlds\n\n<!-- puffs -->\n<!-- end -->\nMore.\n")
    puffs.write(again, document)
    assert document.read_text().startswith("# Worlds\n\n<!-- puffs -->\n\n| world |")
    assert document.read_text().endswith("<!-- end -->\nMore.\n")
    assert (tmp_path / PICTURE).read_bytes().startswith(b"\x89PNG")


def test_a_reading_in_four_hundred_puffs_is_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(puffs, "READINGS", 20)
    puffs_ms, modelled_ms = puffs.reading_ms()
    assert modelled_ms > 0
    assert 0 < puffs_ms < 100


def test_what_it_does_not_know_it_says_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["puffs", "--missions", "0"])
    with pytest.raises(SystemExit, match="2"):
        puffs.main()
    [line] = capsys.readouterr().err.splitlines()
    assert "--missions" in line
