"""Protects the units of gas: the ideal gas law by hand, and names that are not known are refused."""

import pytest

from ground.tlog.units import UNITS, parse
from plume.sensors.instruments import METHANE_PPM


def test_a_ppm_of_methane_is_what_the_sensors_take_it_for() -> None:
    assert parse("ppm").factor(20.0, 1013.25) == pytest.approx(METHANE_PPM, rel=1e-3)


def test_a_mole_of_gas_at_0_degrees_and_1_atmosphere_fills_22_4_litres() -> None:
    assert parse("%:co2").factor(0.0, 1013.25) == pytest.approx(0.01 * 44.009 / 0.022414, rel=1e-4)


@pytest.mark.parametrize(
    ("text", "same"), [("PPM", "ppm:ch4"), ("ppm·m", "ppm*m"), ("ppm-m", "ppm*m"), ("µg/m³", "ug/m3")]
)
def test_a_unit_has_several_spellings(text: str, same: str) -> None:
    assert parse(text) == parse(same)


def test_masses_do_not_depend_on_the_air() -> None:
    assert [parse(unit).is_by_air for unit in UNITS] == [True] * 3 + [False] * 3 + [True] * 2
    assert parse("mg/m3").factor(-40.0, 500.0) == 1e-3


@pytest.mark.parametrize("text", ["", "lel", "ppm:xe", "ppm:ch4:co2", ":ch4"])
def test_what_is_no_unit_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="wanted"):
        parse(text)
