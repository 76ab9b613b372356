"""Protects admission: readings that no vehicle can have measured are refused, each for its own reason."""

import math

import pytest

from estimator.admission import greatest_concentration, refusal
from estimator.filter import Config
from estimator.priors import Fixed, Gamma, LogNormal, Normal, Prior, Uniform
from link.bus.mavlink import Reading
from plume.sensors.names import Sensor
from plume.sensors.sensor import Gaussian, Hits, Threshold

GOOD = Reading(2000, (3.0, 4.0), 5.0, (1.0, 0.5), 0.5)


def test_a_new_reading_from_the_area_is_taken() -> None:
    assert refusal(GOOD, None, Config()) is None
    assert refusal(GOOD, GOOD._replace(time_boot_ms=1999), Config()) is None


def test_a_reading_after_the_wrap_of_the_vehicles_time_is_new_and_one_from_before_it_late() -> None:
    before, after = GOOD._replace(time_boot_ms=2**32 - 5), GOOD._replace(time_boot_ms=3)
    assert refusal(after, before, Config()) is None
    assert refusal(before, after, Config()) == ("late", "time_boot_ms 4294967291 is before 3")


@pytest.mark.parametrize(
    ("reading", "kind", "reason"),
    [
        (GOOD._replace(position=(30.5, 4.0)), "outside", "outside the area"),
        (GOOD._replace(position=(3.0, -0.1)), "outside", "outside the area"),
        (GOOD._replace(gas=1e4), "absurd", "gas 10000 is absurd; allowed is -106.116 to 212.219"),
        (GOOD._replace(gas=-3e38), "absurd", "absurd"),
        (
            GOOD._replace(wind=(90.0, -90.0)),
            "absurd",
            "wind (90.0, -90.0) is absurd; allowed is up to 120 m/s",
        ),
        (GOOD._replace(wind=(3e38, 3e38)), "absurd", "absurd"),
        (
            GOOD._replace(altitude_m=-2e4),
            "absurd",
            "altitude -20000 m is absurd; allowed is from -10000 to 10000 m",
        ),
        (GOOD._replace(time_boot_ms=1999), "late", "1999 is before 2000"),
        (GOOD._replace(gas=0.25), "conflicting", "2000 again, with other values"),
        (GOOD, "repeated", "2000 again"),
    ],
)
def test_what_cannot_be_is_refused_with_its_reason(reading: Reading, kind: str, reason: str) -> None:
    refused = refusal(reading, GOOD, Config())
    assert refused is not None
    assert refused[0] == kind
    assert reason in refused[1]


def test_what_is_absurd_depends_on_the_sensor() -> None:
    for config, gas in ((Config(sensor=Hits()), 0.5), (Config(sensor=Threshold()), 0.3)):
        refused = refusal(GOOD._replace(gas=gas), None, config)
        assert refused is not None
        assert refused[0] == "absurd"


def test_the_greatest_concentration_is_that_at_the_surface_of_the_strongest_source() -> None:
    # 300/(4π · 4.5 · 0.1) = 53.05;  500/(4π · 1 · 0.1) = 397.9
    assert greatest_concentration(Config()) == pytest.approx(53.05, abs=0.01)
    assert greatest_concentration(
        Config(priors={"q": Uniform(100, 500), "d": Uniform(1, 8)})
    ) == pytest.approx(397.9, abs=0.1)
    # A gamma(2, 150) rate exceeds its bound with probability below 10⁻⁶: (1 + b) e^−b with b = bound/150
    b = greatest_concentration(Config(priors={"q": Gamma(2, 150)})) * 4 * math.pi * 4.5 * 0.1 / 150
    assert (1 + b) * math.exp(-b) < 1e-6


@pytest.mark.parametrize(
    ("priors", "greatest"),
    [
        # rate/(4π · diffusivity · 0.1): each six standard deviations towards a greater result, never below a
        # thousandth.
        ({"q": Normal(300.0, 50.0)}, 600 / (4 * math.pi * 4.5 * 0.1)),
        ({"d": Normal(4.0, 0.5)}, 300 / (4 * math.pi * 1.0 * 0.1)),
        ({"q": Normal(300.0, 50.0), "d": Normal(4.0, 0.5)}, 600 / (4 * math.pi * 1.0 * 0.1)),
        ({"d": Normal(1.0, 1.0)}, 300 / (4 * math.pi * 0.001 * 0.1)),
        ({"d": Uniform(0.0, 8.0)}, 300 / (4 * math.pi * 0.001 * 0.1)),
        ({"d": Gamma(2.0, 2.0)}, 300 / (4 * math.pi * 0.001 * 0.1)),
        ({"q": Gamma(4.0, 50.0)}, 50 * (4 + 6 * 2 + 20) / (4 * math.pi * 4.5 * 0.1)),
        ({"q": Uniform(100.0, 500.0)}, 500 / (4 * math.pi * 4.5 * 0.1)),
        ({"q": Fixed(900.0), "d": Fixed(2.0)}, 900 / (4 * math.pi * 2.0 * 0.1)),
    ],
    ids=str,
)
def test_the_greatest_concentration_worked_by_hand(priors: dict[str, Prior], greatest: float) -> None:
    assert greatest_concentration(Config(priors=priors)) == pytest.approx(greatest, rel=1e-12)


SURFACE = 300 / (4 * math.pi * 4.5 * 0.1)
"""Concentration at the surface of a source of 300 g/s, g/m³."""


@pytest.mark.parametrize(
    ("priors", "at_least", "at_most"),
    [
        # A standard normal exceeds 4.753 with probability 10⁻⁶; the bound may be a little wider.
        ({"q": LogNormal(300.0, 0.7)}, math.exp(4.753 * 0.7), math.exp(5.2 * 0.7)),
        ({"gain": LogNormal(1.0, 0.5)}, math.exp(4.753 * 0.5), math.exp(5.2 * 0.5)),
        ({"gain": Fixed(2.0)}, 2.0, 2.0),
        # With cv = 1 the gas is exponential: it exceeds 13.8 times its mean with probability 10⁻⁶.
        ({"cv": Fixed(1.0)}, 13.8, 30.0),
        ({"cv": Fixed(0.0)}, 1.0, 1.0),
        # With cv = √½, gamma with shape 2 and mean 1: (1 + 2 b) e^(−2 b) is 10⁻⁶ at b = 8.35.
        ({"cv": Fixed(math.sqrt(0.5))}, 8.3, 20.0),
    ],
    ids=str,
)
def test_the_greatest_reading_grows_with_gain_rate_and_gusts(
    priors: dict[str, Prior], at_least: float, at_most: float
) -> None:
    ratio = greatest_concentration(Config(priors=priors)) / SURFACE
    assert at_least * (1 - 1e-9) <= ratio <= at_most * (1 + 1e-9)


def test_gusts_of_an_unknown_intermittency_are_those_of_the_strongest_that_the_sensor_model_covers() -> None:
    for prior in (Normal(0.0, 0.8), Uniform(0.0, 3.0), Normal(0.0, 5.0)):
        assert greatest_concentration(Config(priors={"cv": prior})) == greatest_concentration(
            Config(priors={"cv": Fixed(3.0)})
        )
    assert greatest_concentration(Config(sensor=Gaussian(cv=0.5))) == greatest_concentration(
        Config(priors={"cv": Fixed(0.5)})
    )


def test_a_gust_in_the_field_is_no_absurd_reading() -> None:
    gust = GOOD._replace(gas=2000.0)
    assert refusal(gust, None, Config()) is not None
    assert refusal(gust, None, Config(assume="field")) is None
    assert refusal(GOOD._replace(gas=1e9), None, Config(assume="field")) is not None


def test_a_strong_reading_is_taken_where_a_prior_allows_for_it() -> None:
    # 300 ± 50 g/s: at most 106.1 g/m³, plus 10 standard deviations of the sensor of 0.3 · 106.1 each: 4 ·
    # 106.1 = 424.4.
    wide, known = Config(priors={"q": Normal(300.0, 50.0)}), Config()
    for gas, refused_by in ((212.0, []), (213.0, [known]), (424.0, [known]), (425.0, [known, wide])):
        assert [
            config for config in (known, wide) if refusal(GOOD._replace(gas=gas), None, config)
        ] == refused_by


@pytest.mark.parametrize(
    ("prior", "factors"),
    [
        (Fixed(100.0), (100.0, 100.0)),
        (Fixed(0.5), (0.5, 0.5)),
        (Uniform(0.5, 4.0), (4.0, 4.0)),
        # A standard normal exceeds 4.753 with probability 10⁻⁶; the bound may be a little wider.
        (LogNormal(1.0, 0.5), (math.exp(4.753 * 0.5), math.exp(5.2 * 0.5))),
    ],
    ids=str,
)
@pytest.mark.parametrize(
    "sensor", [Gaussian(0.3, 0.2), Threshold(0.5, 0.3, 0.3, 0.2)], ids=["gaussian", "threshold"]
)
def test_what_is_absurd_grows_with_the_noise_that_its_prior_allows(
    prior: Prior, factors: tuple[float, float], sensor: Sensor
) -> None:
    # 10 standard deviations of factor · √((0.3 · 53.05)² + 0.2²) beyond the concentration at the surface.
    config = Config(sensor=sensor, priors={"noise": prior})
    taken, refused = (SURFACE + 10 * factor * math.hypot(0.3 * SURFACE, 0.2) for factor in factors)
    assert refusal(GOOD._replace(gas=taken * (1 - 1e-6)), None, config) is None
    assert refusal(GOOD._replace(gas=refused * (1 + 1e-6)), None, config) is not None


def test_the_edge_of_the_area_is_inside() -> None:
    for position in ((0.0, 0.0), (30.0, 30.0), (0.0, 30.0)):
        assert refusal(GOOD._replace(position=position), None, Config()) is None
