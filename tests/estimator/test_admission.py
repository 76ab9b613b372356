"""Protects the filter's door: what no vehicle can have measured is refused, each for its own reason."""

import math

import pytest

from estimator.admission import greatest_concentration, refusal
from estimator.filter import Config
from estimator.priors import Gamma, Uniform
from link.bus.mavlink import Reading
from plume.sensor import Hits, Threshold

GOOD = Reading(2000, (3.0, 4.0), 5.0, (1.0, 0.5), 0.5)


def test_a_new_reading_from_the_area_is_taken() -> None:
    assert refusal(GOOD, None, Config()) is None
    assert refusal(GOOD, GOOD._replace(time_boot_ms=1999), Config()) is None


@pytest.mark.parametrize(
    ("reading", "kind", "reason"),
    [
        (GOOD._replace(position=(30.5, 4.0)), "outside", "outside the area"),
        (GOOD._replace(position=(3.0, -0.1)), "outside", "outside the area"),
        (GOOD._replace(gas=1e4), "absurd", "gas 10000 is absurd; allowed is -106.116 to 212.219"),
        (GOOD._replace(gas=-3e38), "absurd", "absurd"),
        (GOOD._replace(time_boot_ms=1999), "late", "1999 is before 2000"),
        (GOOD._replace(gas=0.25), "conflicting", "2000 again, but it is another reading"),
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
    assert greatest_concentration(Config(priors={"q": Uniform(100, 500), "d": Uniform(1, 8)})) == pytest.approx(397.9, abs=0.1)
    # A gamma(2, 150) rate exceeds its bound less often than once in a million: (1 + b) e^−b with b = bound/150
    b = greatest_concentration(Config(priors={"q": Gamma(2, 150)})) * 4 * math.pi * 4.5 * 0.1 / 150
    assert (1 + b) * math.exp(-b) < 1e-6
