"""Named assumptions: what the estimator takes to be known, and the priors of the rest."""

from collections.abc import Mapping

from estimator.priors import Fixed, LogNormal, Normal, Prior, Uniform
from plume.parameters import PARAMETERS
from plume.problem import Area
from plume.sensors.names import Sensor, fluctuates
from plume.sensors.sensor import Hits

# The assumptions, and one line about each.
ASSUMPTIONS: Mapping[str, str] = {
    "paper": "all but the source's position x, y is known",
    "field": "wind, release rate, lifetime, noise and the gas's intermittency are known roughly; each has a "
    "prior",
}

# A compass and an anemometer on a drone are each wrong by several degrees, and the wind that carries the gas
# differs from that at the drone. Two thirds of missions within 20° covers that.
WIND_DIRECTION_STD_DEG = 20.0
# Two thirds of missions within a factor of 1.65. Rotors disturb an anemometer on board, and a station is at
# another height: 0.3. Only speed by diffusivity shapes the plume, so the factor stands for a wrong
# diffusivity, too: 0.4. Both add in quadrature.
WIND_SPEED_SIGMA = 0.5
# Two thirds within a factor of 2: leak rates are estimated by their order of magnitude, from a hole and a
# pressure. A wrong gain of the sensor is the same as a wrong rate, so this covers it.
RATE_SIGMA = 0.7
# Two thirds within a factor of 2: how fast gas rises, deposits or reacts is tabulated for other weather.
LIFETIME_SIGMA = 0.7
# Two thirds within a factor of 1.65: sensors age, and data sheets quote noise in still, dry air.
NOISE_SIGMA = 0.5
# Half-normal: open plumes have been measured with fluctuations of half to twice their mean, less where a
# sensor averages; steady gas stays the most likely value. It is that of gas that comes and goes alike
# everywhere; puffs come and go more the nearer the source is.
CV_STD = 1.2
# Puffs a second: two thirds within a factor of 7.4. Many are steady gas. Few make blanks and bursts, and so
# does a small share of the diffusivity that widens a puff, of which hardly anything is known.
PUFF_RATE, PUFF_RATE_SIGMA = 100.0, 2.0
PUFF_SHARES = (0.02, 1.0)

# Share of the readings that say nothing of the source, by assumption. A twentieth is one or two false ones
# in a search. With a smaller share a few count as gusts of a thin plume, and the search follows them; with a
# greater one true gusts count as spikes, and a search in intermittent gas takes longer.
SPIKES: Mapping[str, float] = {"paper": 0.0, "field": 0.05}

# A leak may be beyond the fence: the source may be up to this share of the area's side beyond its edges.
# There a place is less likely (`plume.parameters.BEYOND`): all of them together 22%.
MARGIN: Mapping[str, float] = {"paper": 0.0, "field": 1 / 3}

# Absolute priors of the wind: the measured value is then ignored, so an error of its measurement means
# nothing.
REPLACED = {"u": "wind-speed", "phi": "wind-direction"}


def effective_priors(
    assume: str, given: Mapping[str, Prior], rate: float, lifetime: float, sensor: Sensor
) -> dict[str, Prior]:
    """Return the priors of an assumption by name of `PARAMETERS`, each replaced by a given one.

    `rate` (g/s) and `lifetime` (s) are what the estimator is told. A given prior of u or phi also removes
    the assumption's prior of the measured wind speed or direction. Intermittency is modelled for sensors
    that read the gas itself, and noise has a factor for all but hits, whose noise is Poisson's.

    Raises:
        ValueError: There is no such assumption or parameter, or two given priors exclude each other, or
        one means nothing for the sensor.
    """
    if assume not in ASSUMPTIONS:
        raise ValueError(f"assume {assume!r} is not allowed; wanted {' or '.join(ASSUMPTIONS)}")
    _check(given, sensor)
    priors: dict[str, Prior] = {}
    if assume == "field":
        priors |= {
            "q": LogNormal(rate, RATE_SIGMA),
            "tau": LogNormal(lifetime, LIFETIME_SIGMA),
            "wind-direction": Normal(0.0, WIND_DIRECTION_STD_DEG),
            "wind-speed": LogNormal(1.0, WIND_SPEED_SIGMA),
        }
        if not isinstance(sensor, Hits):
            priors["noise"] = LogNormal(1.0, NOISE_SIGMA)
        if fluctuates(sensor):
            priors["cv"] = Normal(0.0, CV_STD)
            priors["puff-rate"] = LogNormal(PUFF_RATE, PUFF_RATE_SIGMA)
            priors["puff-share"] = Uniform(*PUFF_SHARES)
    for absolute, relative in REPLACED.items():
        if absolute in given:
            priors.pop(relative, None)
    return priors | dict(given)


def margin(assume: str, area: Area, given_m: float | None) -> float:
    """Return how far beyond the edges of an area the source may be, m, unless it is given."""
    return MARGIN[assume] * area.side_m if given_m is None else given_m


def _check(given: Mapping[str, Prior], sensor: Sensor) -> None:
    for name in given:
        if name not in PARAMETERS:
            raise ValueError(f"a prior of {name!r} is not allowed; wanted {', '.join(PARAMETERS)}")
    for absolute, relative in REPLACED.items():
        if absolute in given and relative in given:
            raise ValueError(
                f"a prior of {relative} is not allowed with one of {absolute}, which ignores the measured "
                "value; wanted one of them"
            )
    if "noise" in given and isinstance(sensor, Hits):
        raise ValueError(
            "a prior of noise is not allowed with the hits sensor, whose noise is Poisson's; wanted gaussian "
            "or threshold"
        )
    for name in ("cv", "puff-rate", "puff-share"):
        if name in given and not fluctuates(sensor):
            raise ValueError(
                f"a prior of {name} is not allowed with this sensor, for which intermittency is not "
                "modelled; wanted gaussian, pid or tdlas"
            )


def unknowns(priors: Mapping[str, Prior]) -> tuple[str, ...]:
    """Return the unknowns under these priors: x, y and all with a prior that is not fixed.

    They are in the order of `PARAMETERS`.
    """
    return tuple(
        name
        for name in PARAMETERS
        if not isinstance(priors.get(name), Fixed) and (name in ("x", "y") or name in priors)
    )
