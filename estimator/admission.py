"""Admission: decides which readings reach the filter, and gives the reason for each refusal."""

import math

from estimator.filter import Config
from estimator.priors import Fixed, Gamma, Normal, Prior, Uniform
from link.bus.mavlink import Reading
from plume.dispersion import SOURCE_RADIUS_M


def refusal(reading: Reading, latest: Reading | None, config: Config) -> tuple[str, str] | None:
    """Return kind and text of the reason to refuse a reading; None if it is admitted. `latest` is the last reading admitted."""
    if not all(0.0 <= value <= config.area_m for value in reading.position):
        area = f"[0, {config.area_m:g}] x [0, {config.area_m:g}] m"
        return "outside", f"position {reading.position} is outside the area {area}"
    absurd = config.sensor.refusal(reading.gas, greatest_concentration(config))
    if absurd:
        return "absurd", absurd
    if latest is None or reading.time_boot_ms > latest.time_boot_ms:
        return None
    if reading.time_boot_ms < latest.time_boot_ms:
        return "late", f"time_boot_ms {reading.time_boot_ms} is before {latest.time_boot_ms}"
    if reading != latest:
        return "conflicting", f"time_boot_ms {reading.time_boot_ms} again, with other values"
    return "repeated", f"time_boot_ms {reading.time_boot_ms} again"


def greatest_concentration(config: Config) -> float:
    """Return the concentration at the surface of the strongest source that the priors allow, g/m³."""
    known: dict[str, Prior] = {"q": Fixed(config.rate), "d": Fixed(config.diffusivity)}
    _, rate = _likely_range({**known, **config.priors}["q"])
    diffusivity, _ = _likely_range({**known, **config.priors}["d"])
    return rate / (4 * math.pi * diffusivity * SOURCE_RADIUS_M)


def _likely_range(prior: Prior) -> tuple[float, float]:
    """Return the ends of a range that holds at least 1 − 10⁻⁶ of a positive parameter's prior."""
    smallest = 1e-3
    match prior:
        case Fixed(value):
            return value, value
        case Uniform(low, high):
            return max(low, smallest), high
        case Normal(mean, std):
            return max(mean - 6 * std, smallest), mean + 6 * std
        case Gamma(shape, scale):
            return smallest, scale * (shape + 6 * math.sqrt(shape) + 20)
