"""Protects the priors: draws follow them, and a bad prior is refused with a clear message."""

import math

import numpy as np
import pytest

from estimator.filter import Config, prior
from estimator.priors import Fixed, Gamma, LogNormal, Normal, Prior, Uniform, parse, text
from plume.problem import square

EIGHT: dict[str, Prior] = {
    "z": Uniform(0.0, 5.0),
    "q": Gamma(2.0, 150.0),
    "u": Normal(2.5, 0.5),
    "phi": Normal(1.0, 0.2),
    "d": Uniform(1.0, 8.0),
    "tau": Uniform(5.0, 20.0),
}


FIELD: dict[str, Prior] = {
    "wind-direction": Normal(0.0, 20.0),
    "wind-speed": LogNormal(1.0, 0.5),
    "gain": LogNormal(2.0, 0.3),
    "noise": LogNormal(1.0, 0.4),
    "cv": Normal(0.0, 1.2),
    "puff-rate": LogNormal(100.0, 2.0),
    "puff-share": Uniform(0.02, 1.0),
}
SPREADS = {"wind-speed": (1.0, 0.5), "gain": (2.0, 0.3), "noise": (1.0, 0.4), "puff-rate": (100.0, 2.0)}
"""Median and sigma of those that are log-normal."""


def drawn(config: Config) -> dict[str, np.ndarray]:
    return dict(zip(config.unknowns, prior(config).particles, strict=True))


def test_by_default_x_and_y_are_unknown_and_uniform_over_the_area() -> None:
    config = Config(particles=4000, seed=3)
    assert config.unknowns == ("x", "y")
    counts, _, _ = np.histogram2d(*prior(config).particles, bins=5, range=[[0, 30], [0, 30]])
    assert counts.sum() == 4000
    # A low-discrepancy lattice is more even than chance: 160 expected per cell; independent draws would have
    # a standard deviation of 12.
    assert np.abs(counts - 160).max() < 12


def test_under_field_the_source_may_be_outside_the_area_where_it_is_less_likely() -> None:
    config = Config(particles=20_000, seed=3, assume="field")
    x, y = prior(config).particles[:2]
    # A coordinate is inside with the probability 30 / (30 + 2 · 10 · 0.2) = 15/17. A lattice is more even than
    # chance, of which the standard error would be 0.0023.
    for each in (x, y):
        assert each.min() >= -10
        assert each.max() <= 40
        assert np.mean((each >= 0) & (each <= 30)) == pytest.approx(15 / 17, abs=0.002)
        assert np.mean((each > 30) & (each < 35)) == pytest.approx(1 / 34, abs=0.001)
    counts, _, _ = np.histogram2d(x, y, bins=5, range=[[0, 30], [0, 30]])
    assert counts == pytest.approx(np.full((5, 5), 20_000 * (3 / 17) ** 2), rel=0.05)


@pytest.mark.parametrize(
    ("more", "ends"),
    [
        ({"assume": "paper"}, (0, 30)),
        ({"assume": "paper", "margin_m": 4.0}, (-4, 34)),
        ({"assume": "field", "margin_m": 0.0}, (0, 30)),
        ({"assume": "field", "area": square(90.0)}, (-30, 120)),
        ({"assume": "field", "priors": {"x": Uniform(-30, 25)}}, (-10, 25)),
    ],
)
def test_how_far_outside_is_the_margin(more: dict[str, object], ends: tuple[float, float]) -> None:
    config = Config(particles=4000, **more)  # type: ignore[arg-type]
    x = prior(config).particles[0]
    assert (x.min(), x.max()) == pytest.approx(ends, abs=0.2)
    assert ends[0] <= x.min()
    assert x.max() <= ends[1]


def test_all_eight_are_drawn_from_their_priors() -> None:
    values = drawn(Config(particles=40_000, priors=EIGHT))
    assert tuple(values) == ("x", "y", "z", "q", "u", "phi", "d", "tau")
    # name: mean and standard deviation, by hand: uniform (a + b)/2, (b − a)/√12; gamma kθ, √k θ
    expected = {
        "x": (15, 30 / math.sqrt(12)),
        "z": (2.5, 5 / math.sqrt(12)),
        "q": (300, math.sqrt(2) * 150),
        "u": (2.5, 0.5),
        "phi": (1.0, 0.2),
        "d": (4.5, 7 / math.sqrt(12)),
        "tau": (12.5, 15 / math.sqrt(12)),
    }
    for name, (mean, std) in expected.items():
        # 4 standard errors; that of a standard deviation is at most σ/√n here (gamma, kurtosis 6).
        assert values[name].mean() == pytest.approx(mean, abs=4 * std / 200)
        assert values[name].std() == pytest.approx(std, abs=4 * std / 200)
    correlations = np.corrcoef(list(values.values())) - np.eye(8)
    assert np.abs(correlations).max() < 4 / 200


def test_what_a_measurement_gets_wrong_is_drawn_from_its_priors() -> None:
    values = drawn(Config(particles=40_000, priors=FIELD))
    assert tuple(values) == (
        "x",
        "y",
        "wind-direction",
        "wind-speed",
        "gain",
        "noise",
        "cv",
        "puff-rate",
        "puff-share",
    )
    assert values["wind-direction"].std() == pytest.approx(20.0, abs=4 * 20 / math.sqrt(2 * 40_000))
    for name, (median, sigma) in SPREADS.items():
        logarithms = np.log(values[name] / median)
        # 4 standard errors: σ/√n of the mean, σ/√(2n) of the standard deviation; half lie below the median:
        # ½/√n.
        assert logarithms.mean() == pytest.approx(0.0, abs=4 * sigma / 200)
        assert logarithms.std() == pytest.approx(sigma, abs=4 * sigma / math.sqrt(2 * 40_000))
        assert np.mean(values[name] < median) == pytest.approx(0.5, abs=4 * 0.5 / 200)
        # The mean is that of a log-normal variable, median · exp(σ²/2), not the median; it errs by √(exp(σ²) −
        # 1) of itself by √n.
        error = math.sqrt(math.expm1(sigma**2)) / 200
        assert values[name].mean() == pytest.approx(median * math.exp(sigma**2 / 2), rel=4 * error)
    # Half-normal, cut off at 3, which is 2.5 standard deviations: mean 1.2 √(2/π) (1 − exp(−3.125))/(2 Φ(2.5)
    # − 1) = 0.92690
    assert 0 <= values["cv"].min() < values["cv"].max() <= 3.0
    assert values["cv"].mean() == pytest.approx(0.92690, abs=4 * 0.7 / 200)
    assert 0.02 <= values["puff-share"].min() < values["puff-share"].max() <= 1.0
    assert values["puff-share"].mean() == pytest.approx(0.51, abs=4 * 0.29 / 200)


def test_a_log_normal_intermittency_is_cut_off_too() -> None:
    values = drawn(Config(particles=4000, priors={"cv": LogNormal(1.0, 1.0)}))
    assert 0 < values["cv"].min() < values["cv"].max() <= 3.0
    # ln cv is N(0, 1) below ln 3 = 1.0986: mean −φ(1.0986)/Φ(1.0986) = −0.218185/0.864031 = −0.252520
    assert np.log(values["cv"]).mean() == pytest.approx(-0.252520, abs=4 * 0.85 / math.sqrt(4000))


def test_the_kernels_table_holds_the_logarithm_of_a_log_normals_median() -> None:
    rows = Config(priors={"q": LogNormal(300.0, 0.7)}).prior_rows
    # 300 exp(±8 · 0.7) = 300 · 270.4264 and its inverse
    assert rows[3].tolist() == pytest.approx(
        [5.0, math.log(300.0), 0.7, 300 / 270.4264, 300 * 270.4264], rel=1e-6
    )
    assert rows[8:, :2].tolist() == [
        [0, 0],
        [0, 1],
        [0, 1],
        [0, 1],
        [0, 0],
        [0, math.inf],
        [0, 0.2],
    ]  # a faultless anemometer and sensor, steady gas


def test_a_prior_is_cut_off_where_the_parameter_makes_no_sense() -> None:
    values = drawn(
        Config(particles=4000, priors={"u": Normal(0.2, 1.0), "d": Normal(0.5, 1.0), "x": Normal(1.0, 5.0)})
    )
    assert values["u"].min() >= 0
    assert values["d"].min() > 0
    assert 0 <= values["x"].min() < values["x"].max() <= 30
    # N(0.2, 1) above 0: mean 0.2 + φ(0.2)/Φ(0.2) = 0.2 + 0.39104/0.57926 = 0.8751
    assert values["u"].mean() == pytest.approx(0.8751, abs=4 * 0.6 / math.sqrt(4000))


def test_what_is_fixed_is_known() -> None:
    config = Config(priors={"y": Fixed(12.0), "q": Fixed(250.0)})
    assert config.unknowns == ("x",)
    assert config.prior_rows[3, 1] == 250.0


@pytest.mark.parametrize(
    "prior", [Uniform(0.0, 1 / 3), Normal(2.0, 0.1), Gamma(2.0, 150.0), LogNormal(3.0, 1 / 3), Fixed(3.0)]
)
def test_a_priors_text_reads_back_as_the_prior(prior: Prior) -> None:
    for name in ("q", "wind-speed", "gain", "noise"):
        assert parse(text(name, prior)) == (name, prior)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ("q", "wanted NAME=KIND:NUMBERS"),
        ("w=fixed:1", "NAME of x, y, z, q, u, phi, d, tau"),
        ("q=beta:1,2", "KIND of uniform"),
        ("q=uniform:1", "wanted q=uniform:LOW,HIGH"),
        ("q=gamma:1,2,3", "wanted q=gamma:SHAPE,SCALE"),
        ("q=uniform:5,5", "LOW below HIGH"),
        ("u=normal:1,0", "STD above 0"),
        ("phi=gamma:1,1", "NAME of q, u, d, tau"),
        ("d=fixed:0", "VALUE from 1e-06"),
        ("q=normal:nan,1", "wanted"),
        ("q=lognormal:1", "wanted q=lognormal:MEDIAN,SIGMA"),
        ("q=lognormal:0,1", "MEDIAN and SIGMA above 0"),
        ("q=lognormal:1,0", "MEDIAN and SIGMA above 0"),
        ("wind-direction=lognormal:1,1", "NAME of q, u, d, tau, wind-speed, gain, noise, cv"),
        ("noise=fixed:0", "VALUE from 1e-06 for q, d, tau, wind-speed, gain, noise"),
        ("cv=fixed:3.1", "VALUE from 0 to 3 for cv"),
        ("cv=uniform:0,9", "0 ≤ LOW < HIGH ≤ 3 for cv"),
        (
            "direction=fixed:1",
            "NAME of x, y, z, q, u, phi, d, tau, wind-direction, wind-speed, gain, noise, cv",
        ),
    ],
)
def test_a_bad_prior_is_named_with_what_is_allowed(bad: str, reason: str) -> None:
    with pytest.raises(ValueError, match=f"is not allowed; wanted.*{reason}|is not allowed; {reason}"):
        parse(bad)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"priors": {"x": Fixed(1.0), "y": Fixed(2.0)}}, "nothing is unknown"),
        ({"priors": {"x": Uniform(40.0, 50.0)}}, "prior of x excludes every possible value"),
        ({"stop_limits": {"q": 5.0}}, "a stop cannot wait for q"),
        ({"stop_on_location": False}, "a stop needs a criterion"),
    ],
)
def test_a_config_that_cannot_be_is_refused(fields: dict, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        Config(**fields)
