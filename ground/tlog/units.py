"""Units of gas: what a sensor's ppm, or ppm along a path, is in g/m³ or g/m²."""

from typing import NamedTuple

STANDARD_C, STANDARD_HPA = 15.0, 1013.25  # the air of the International Standard Atmosphere at sea level
GAS_CONSTANT = 8.314462618  # J/(mol K)
KELVIN = 273.15
MOLAR_MASSES = {  # g/mol
    "ch4": 16.043,
    "c2h6": 30.069,
    "c3h8": 44.096,
    "co": 28.010,
    "co2": 44.009,
    "h2": 2.016,
    "h2s": 34.08,
    "n2o": 44.013,
    "nh3": 17.031,
    "no2": 46.006,
    "so2": 64.06,
}
SHARES = {"ppb": 1e-9, "ppm": 1e-6, "%": 1e-2}  # of the air's volume
MASSES = {"g/m3": 1.0, "mg/m3": 1e-3, "ug/m3": 1e-6}  # g/m³
PATHS = {"ppm*m": 1e-6, "ppb*m": 1e-9}  # shares of the air's volume, summed along a path in m
GREATEST = 1e9  # value that is taken for one, of any unit
UNITS = (*SHARES, *MASSES, *PATHS)


class GasUnit(NamedTuple):
    """A unit of a gas, such as `ppm` of methane."""

    name: str
    gas: str = "ch4"

    @property
    def is_along_path(self) -> bool:
        """Whether values are sums along a path: they become g/m², not g/m³."""
        return self.name in PATHS

    @property
    def is_by_air(self) -> bool:
        """Whether the conversion depends on the air's temperature and pressure."""
        return self.name not in MASSES

    def text(self) -> str:
        """Return the unit in words."""
        return f"{self.name} of {self.gas}" if self.is_by_air else self.name

    def factor(self, temperature_c: float = STANDARD_C, pressure_hpa: float = STANDARD_HPA) -> float:
        """Return g/m³, or g/m² of a sum along a path, for one of this unit.

        By the ideal gas law: a share x of the air is x p M / (R T) g/m³.
        """
        if self.name in MASSES:
            return MASSES[self.name]
        moles_per_m3 = 100.0 * pressure_hpa / (GAS_CONSTANT * (temperature_c + KELVIN))
        return (SHARES | PATHS)[self.name] * moles_per_m3 * MOLAR_MASSES[self.gas]


def parse(text: str) -> GasUnit:
    """Read UNIT or UNIT:GAS, such as `ppm` (of methane) or `ppm:co2`. Raises ValueError."""
    name, _, gas = text.lower().partition(":")
    unit = GasUnit(name.replace("³", "3").replace("µ", "u").replace("·", "*").replace("ppm-m", "ppm*m"))
    unit = unit._replace(gas=gas or unit.gas)
    if unit.name not in UNITS:
        raise ValueError(f"{text!r} is not a unit of gas; wanted {', '.join(UNITS)}, or UNIT:GAS")
    if unit.gas not in MOLAR_MASSES:
        raise ValueError(f"{text!r} names no gas that is known; wanted {', '.join(MOLAR_MASSES)}")
    return unit
