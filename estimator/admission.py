"""Admission: decides which readings reach the filter, and gives the reason for each refusal."""

import math
from dataclasses import replace

from estimator.filter import Config
from estimator.priors import Fixed, Gamma, LogNormal, Normal, Prior, Uniform
from link.bus.mavlink import Reading, elapsed_ms
from plume.dispersion import SOURCE_RADIUS_M
from plume.elementary import exp
from plume.parameters import GREATEST_CV, PARAMETERS
from plume.sensors.names import Sensor
from plume.sensors.sensor import Hits

# No instrument has measured more outside of tornadoes: 113 m/s on Barrow Island (WMO, 1996).
STRONGEST_WIND_MPS = 120.0
HIGHEST_M = 10_000.0  # altitude above or below home. Drones fly lower, and gas is nowhere near.
LEAST = 1e-3  # of any positive parameter


def refusal(reading: Reading, latest: Reading | None, config: Config) -> tuple[str, str] | None:
    """Return kind and text of the reason to refuse a reading; None if it is admitted.

    `latest` is the last reading admitted.
    """
    if not config.area.holds(reading.position):
        return "outside", f"position {reading.position} is outside the area {config.area.text}"
    east, north = reading.wind
    if east * east + north * north > STRONGEST_WIND_MPS * STRONGEST_WIND_MPS:
        return "absurd", f"wind {reading.wind} is absurd; allowed is up to {STRONGEST_WIND_MPS:g} m/s"
    if abs(reading.altitude_m) > HIGHEST_M:
        return (
            "absurd",
            f"altitude {reading.altitude_m:g} m is absurd; allowed is from {-HIGHEST_M:g} to {HIGHEST_M:g} m",
        )
    if absurd := _noisiest(config).refusal(reading.gas, greatest_concentration(config)):
        return "absurd", absurd
    if latest is None or (later := elapsed_ms(latest.time_boot_ms, reading.time_boot_ms)) > 0:
        return None
    if later < 0:
        return "late", f"time_boot_ms {reading.time_boot_ms} is before {latest.time_boot_ms}"
    if reading != latest:
        return "conflicting", f"time_boot_ms {reading.time_boot_ms} again, with other values"
    return "repeated", f"time_boot_ms {reading.time_boot_ms} again"


def greatest_concentration(config: Config) -> float:
    """Return the greatest concentration that the sensor may report, g/m³.

    It is that at the surface of the strongest source that the priors allow. It grows with the sensor's gain,
    and with intermittency, whose gusts exceed the plume's mean.
    """
    mean = _likely(config, "q")[1] / (4 * math.pi * _likely(config, "d")[0] * SOURCE_RADIUS_M)
    cv = min(_likely(config, "cv")[1], GREATEST_CV)
    gust = _likely_range(Gamma(1 / (cv * cv), cv * cv))[1] if cv > 0 else 1.0
    return mean * _likely(config, "gain")[1] * gust


def _noisiest(config: Config) -> Sensor:
    """Return the sensor with the greatest noise that the prior of its factor allows.

    That of hits is Poisson's and has no factor.
    """
    if isinstance(config.sensor, Hits):
        return config.sensor
    factor, sensor = _likely(config, "noise")[1], config.sensor
    return replace(
        sensor, sensor_noise=factor * sensor.sensor_noise, environment_noise=factor * sensor.environment_noise
    )


def _likely(config: Config, name: str) -> tuple[float, float]:
    """Return `_likely_range` of a positive parameter, known or unknown."""
    known = float(config.prior_rows[PARAMETERS.index(name), 1])
    return _likely_range(config.effective_priors.get(name, Fixed(known)))


def _likely_range(prior: Prior) -> tuple[float, float]:
    """Return the ends of a range that holds at least 1 − 10⁻⁶ of a positive parameter's prior."""
    match prior:
        case Fixed(value):
            return value, value
        case Uniform(low, high):
            return max(low, LEAST), high
        case Normal(mean, std):
            return max(mean - 6 * std, LEAST), mean + 6 * std
        case Gamma(shape, scale):
            return LEAST, scale * (shape + 6 * math.sqrt(shape) + 20)
        case LogNormal(median, sigma):
            factor = float(exp(4.9 * sigma))
            return median / factor, median * factor
