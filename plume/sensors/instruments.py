"""Instruments: gas sensors in time, which lag, saturate, drift and warm up, or look along a ray."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from plume.dispersion import SOURCE_RADIUS_M
from plume.elementary import Array, direction, exp, log
from plume.sensors.sensor import Gaussian, normal_cdf

# At 20 °C and 1 atm a mole of any gas takes 24.055 litres, so 1 ppm of methane (16.04 g/mol) is so many g/m³,
# and 1 ppm of isobutylene (56.11 g/mol), by which photoionisation detectors are calibrated, so many.
METHANE_PPM, ISOBUTYLENE_PPM = 16.04e-3 / 24.055, 56.11e-3 / 24.055


@dataclass(frozen=True)
class Instrument(Gaussian):
    """A gas sensor in time.

    Its element follows the settled reading g of the gas: y' = (g − y)/τ, with one time constant while the gas
    grows and another while it falls. The reading is z = y + v, v ~ N(0, (α y)² + β²); the noise is the
    element's own, so that from one reading to the next the element starts at what it last read. `measure`
    takes values y of the element; a reading beyond saturation is then shown as that.

    The numbers of the noise are in the unit of the reading: g/m³; g/m² of an open path, whose gas is summed
    along a ray; none of a metal oxide, which reads its resistance by that in clean air of its data sheet.
    """

    kind: str = field(default="pid", kw_only=True)  # its name
    rise: float = field(default=0.0, kw_only=True)  # τ while the gas grows, s: 63% of a step; 0 is at once
    decay: float = field(default=0.0, kw_only=True)  # τ while it falls, s
    saturation: float = field(default=math.inf, kw_only=True)  # greatest reading
    warmup: float = field(default=0.0, kw_only=True)  # s of the mission before which it has no value
    # Standard deviation of the share by which its readings are too high after an hour; the error grows evenly
    drift: float = field(default=0.0, kw_only=True)
    rate: float = field(default=10.0, kw_only=True)  # samples of the gas, a second
    # Of a metal oxide: RS/R0 = min(air, factor · ppm^power) in methane; air is 0 if it reads the gas itself.
    air: float = field(default=0.0, kw_only=True)
    factor: float = field(default=1.0, kw_only=True)
    power: float = field(default=1.0, kw_only=True)
    ray: float = field(default=0.0, kw_only=True)  # length of an open path from the vehicle on, m; else 0
    # Where an open path looks, as a gimbal does: degrees above level, and clockwise from north.
    pitch: float = field(default=-90.0, kw_only=True)
    azimuth: float = field(default=0.0, kw_only=True)

    @property
    def factor_of_gas(self) -> float:
        """The factor of RS/R0 = factor · c^power with c in g/m³."""
        return self.factor * float(exp(-self.power * log(METHANE_PPM)))

    @property
    def aim(self) -> tuple[float, float, float]:
        """The direction of its ray, a unit vector east, north, up."""
        level, up = direction(self.pitch / 360.0)
        north, east = direction(self.azimuth / 360.0)
        return float(level * east), float(level * north), float(up)

    def settled(self, gas: ArrayLike) -> Array:
        """Return what it reads, without noise, after long in this gas (...), g/m³ or along its ray g/m²."""
        gas = np.asarray(gas, np.float64)
        if not self.air:
            return gas
        return np.asarray(
            np.minimum(self.factor_of_gas * exp(self.power * log(np.maximum(gas, 1e-300))), self.air)
        )

    def follow(self, start: float, settled: Array, seconds: Array) -> float:
        """Return where the element is after gas of settled readings (M,), each for its seconds (M,)."""
        rise, decay = (
            exp(-seconds / tau) if tau else np.zeros(len(seconds)) for tau in (self.rise, self.decay)
        )
        value = start
        for target, rising, falling in zip(settled.tolist(), rise.tolist(), decay.tolist(), strict=True):
            grows = (target > value) != bool(self.air)  # gas lowers a metal oxide's resistance
            value = target + (value - target) * (rising if grows else falling)
        return value

    def log_likelihood(self, reading: ArrayLike, mean: ArrayLike) -> Array:
        """Log-density of a reading around a value of the element, both in its unit.

        Of a reading at saturation the log-probability of one so great.
        """
        reading, mean = np.asarray(reading, np.float64), np.asarray(mean, np.float64)
        beyond = normal_cdf((mean - self.saturation) / self.noise_std(mean))
        return np.where(
            reading >= self.saturation,
            np.log(np.maximum(beyond, 1e-300)),
            super().log_likelihood(np.minimum(reading, self.saturation), mean),
        )

    def is_noisy(self, reading: float) -> bool:
        """True if noise makes two bit-identical readings of this value in a row practically impossible."""
        return reading < float(np.float32(self.saturation))

    def refusal(self, reading: float, greatest_mean: float) -> str | None:
        """Reason why this sensor cannot give this reading; None if it can.

        No concentration exceeds `greatest_mean`, g/m³. A lag only brings readings nearer to each other.
        """
        greatest = self.air or greatest_mean * self._most_along_the_ray()
        absurd = super().refusal(reading, greatest)
        if absurd is None and np.float32(reading) > np.float32(self.saturation):
            return f"gas {reading:g} is absurd; the sensor saturates at {self.saturation:g}"
        return absurd and absurd.removesuffix("/m³" if self.air else "").removesuffix(" g")

    def _most_along_the_ray(self) -> float:
        """Return how much gas there may be along the ray, by the concentration at the source's surface, m."""
        if not self.ray:
            return 1.0
        ends = self.ray / SOURCE_RADIUS_M
        return 2.0 * SOURCE_RADIUS_M * float(log(ends + math.sqrt(ends * ends + 1.0)))


def _metal_oxide(
    kind: str, dwell: float, rise: float, decay: float, air: float, factor: float, power: float
) -> Instrument:
    return Instrument(
        0.03,
        0.01,
        kind=kind,
        rise=rise,
        decay=decay,
        dwell=dwell,
        drift=0.02,
        air=air,
        factor=factor,
        power=power,
    )


# The instruments, by name. Time constants, resistances in clean air and in methane of the metal oxides are
# those of GADEN (Monroy et al. 2017), which has them from experiments and from Figaro's data sheets.
INSTRUMENTS: Mapping[str, Instrument] = MappingProxyType(
    {
        # 90% of a step in 3 s, so 63% in 1.3 s; up to 4,000 ppm of isobutylene.
        "pid": Instrument(
            0.1, 0.2, rise=1.3, decay=1.3, dwell=2.0, drift=0.05, saturation=4000 * ISOBUTYLENE_PPM
        ),
        "tgs2600": _metal_oxide("tgs2600", 5.0, 4.8, 18.75, 1.0, 1.018, -0.07284),
        "tgs2611": _metal_oxide("tgs2611", 2.0, 3.44, 6.35, 8.8, 38.46, -0.4289),
        "tgs2620": _metal_oxide("tgs2620", 5.0, 2.96, 15.71, 21.0, 120.6, -0.4877),
        # Answers in 0.1 s; up to 50,000 ppm·m of methane. 5 m is the usual flight height.
        "tdlas": Instrument(0.1, 0.2, kind="tdlas", dwell=2.0, saturation=50_000 * METHANE_PPM, ray=5.0),
    }
)
