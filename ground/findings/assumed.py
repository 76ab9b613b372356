"""What a search took to be known, in words: its sensor, its assumption with all priors, and its stop."""

import shlex
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from link.bus.messages import Belief
from plume.problem import Problem
from plume.sensors import names
from plume.sensors.instruments import Instrument
from plume.sensors.names import Sensor
from plume.sensors.sensor import Gaussian, Hits, Threshold
from scene.follow.described import problem_of

# The priors of `field`, as `estimator/assumptions.py` has them; a test holds them equal. The medians of q and
# tau are what is told.
RATE_SIGMA = LIFETIME_SIGMA = 0.7
FIELD: Mapping[str, str] = {
    "q": f"lognormal:{{rate}},{RATE_SIGMA}",
    "tau": f"lognormal:{{lifetime}},{LIFETIME_SIGMA}",
    "wind-direction": "normal:0.0,20.0",
    "wind-speed": "lognormal:1.0,0.5",
    "noise": "lognormal:1.0,0.5",
    "cv": "normal:0.0,1.2",
    "puff-rate": "lognormal:100.0,2.0",
    "puff-share": "uniform:0.02,1.0",
}
SPIKES: Mapping[str, float] = {"paper": 0.0, "field": 0.05}
MARGIN: Mapping[str, float] = {"paper": 0.0, "field": 1 / 3}
# What the estimator takes to be told where no flag tells it.
USUAL: Mapping[str, str] = {"rate": "300", "lifetime": "10"}
# Of a log of a leak of which nothing is told: 1 kg/h, two thirds within a factor of 7.4.
UNTOLD_RATE = "q=lognormal:0.28,2"
# What each parameter is, in words, and its unit.
WORDS: Mapping[str, tuple[str, str]] = {
    "x": ("distance of the source east of home", "m"),
    "y": ("distance of the source north of home", "m"),
    "z": ("height of the source above home", "m"),
    "q": ("release rate", "g/s"),
    "u": ("wind speed", "m/s"),
    "phi": ("direction the wind comes from, counter-clockwise from east", "rad"),
    "d": ("effective diffusivity", "m²/s"),
    "tau": ("lifetime of the gas", "s"),
    "wind-direction": ("added to the measured wind direction, counter-clockwise", "°"),
    "wind-speed": ("factor on the measured wind speed", "1"),
    "gain": ("factor of the sensor: reading by gas", "1"),
    "noise": ("factor on the sensor's noise", "1"),
    "cv": ("coefficient of variation of the gas everywhere", "1"),
    "puff-rate": ("puffs that leave the source", "1/s"),
    "puff-share": ("share of the diffusivity that widens a puff", "1"),
}
KINDS: Mapping[str, str] = {
    "uniform": "uniform from {} to {}",
    "normal": "normal, mean {}, standard deviation {}",
    "gamma": "gamma, shape {}, scale {}",
    "lognormal": "log-normal, median {}, standard deviation of the logarithm {}",
    "fixed": "known: {}",
}
NUMBERS: Mapping[str, str] = {
    "sensor_noise": "noise as a share of the reading",
    "environment_noise": "noise in clean air",
    "cv": "coefficient of variation of the gas",
    "dwell": "hover for a reading, s",
    "threshold": "least reading, g/m³",
    "missed": "probability of a missed detection",
    "efficiency": "expected hits a g/m³",
    "background": "expected hits in clean air",
    "rise": "time constant of rise, s",
    "decay": "time constant of decay, s",
    "saturation": "greatest reading",
    "warmup": "warm-up, s",
    "drift": "drift, share in an hour",
    "rate": "samples of the gas, 1/s",
    "air": "RS/R0 in clean air",
    "factor": "A of RS/R0 = A c^B, c in ppm of methane",
    "power": "B of RS/R0 = A c^B",
    "ray": "length of the ray, m",
    "pitch": "pitch of the ray, °",
    "azimuth": "azimuth of the ray, °",
}


class PriorRow(NamedTuple):
    """One prior, in words."""

    name: str
    meaning: str
    unit: str
    prior: str  # in the form of --prior
    words: str
    given: bool  # by the user, instead of what is taken where nothing is told


class Told(NamedTuple):
    """What the estimator was told, as far as the record says it."""

    sensor: Sensor | None  # None if this version does not know it
    priors: list[PriorRow]
    margin_m: float
    spikes: float  # share of the readings that say nothing of the source


def told_of(last: Belief, about: dict[str, Any]) -> Told:
    """Return what the last belief and the run's own description say of it."""
    try:
        sensor = names.parse(last.sensor)
    except ValueError:
        sensor = None
    flags = _flags(_words(about))
    usual = USUAL if flags else {}
    single = {**usual, **{name: values[-1] for name, values in flags.items()}}
    problem = problem_of(about)
    margin = 0.0 if problem.prior else _number(single.get("margin"))
    if margin is None:
        margin = MARGIN.get(last.assume, 0.0) * problem.area.side_m
    given = dict(text.partition("=")[::2] for text in flags.get("prior", ()))
    rate = single.get("rate", "what is told") if "q" in last.unknowns else repr(last.rate)
    lifetime = single.get("lifetime", "what is told") if "tau" in last.unknowns else repr(last.lifetime)
    rows = [
        _row(name, *given_or_usual, last, problem)
        for name in WORDS
        if (given_or_usual := _prior(name, given, last, rate, lifetime))
    ]
    return Told(sensor, rows, margin, SPIKES.get(last.assume, 0.0))


def _prior(
    name: str, given: Mapping[str, str], last: Belief, rate: str, lifetime: str
) -> tuple[str, bool] | None:
    """Return the text of a parameter's prior and whether it was given; None if it has none."""
    if name in given:
        return given[name], f"{name}={given[name]}" != UNTOLD_RATE
    if name in ("x", "y"):
        return "area", False
    if last.assume == "field" and name in FIELD and name in last.unknowns:
        return FIELD[name].format(rate=rate, lifetime=lifetime), False
    return None


def _row(name: str, text: str, given: bool, last: Belief, problem: Problem) -> PriorRow:
    meaning, unit = WORDS[name]
    if text == "area" and problem.support:
        return PriorRow(name, meaning, unit, "", f"anywhere in {problem.support.text}", True)
    if text == "area":
        beyond = "" if last.assume == "paper" else ", and a fifth as likely beyond its edges"
        return PriorRow(name, meaning, unit, "", f"anywhere in the area{beyond}", given)
    kind, _, numbers = text.partition(":")
    values = [_short(number) for number in numbers.split(",")]
    form = KINDS.get(kind, text)
    words = form.format(*values) if form.count("{}") == len(values) else text
    return PriorRow(name, meaning, unit, text, words, given)


def _short(text: str) -> str:
    value = _number(text)
    return text if value is None else f"{value:.6g}"


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None


def _flags(words: Sequence[str]) -> dict[str, list[str]]:
    """Return the values of the flags of a command line, by name."""
    found: dict[str, list[str]] = {}
    name = ""
    for word in words:
        if word.startswith("--"):
            name, equals, value = word[2:].partition("=")
            found.setdefault(name, [])
            if equals:
                found[name].append(value)
        elif name:
            found[name].append(word)
    return {name: values for name, values in found.items() if values}


def command_line(about: Mapping[str, Any]) -> str:
    """Return the estimator's flags as a record has them; empty if it has none."""
    return shlex.join(_words(about))


def _words(about: Mapping[str, Any]) -> list[str]:
    parts = about.get("parts")
    words = parts.get("estimator") if isinstance(parts, dict) else None
    return [*map(str, words)] if isinstance(words, list) else []


def calibration(sensor: Sensor) -> dict[str, float]:
    """Return the numbers that turn gas into a reading of this sensor, by their meaning."""
    return {NUMBERS.get(name, name): value for name, value in names.numbers(sensor).items()}


def unit_of(sensor: Sensor | None) -> str:
    """Return the unit of a sensor's readings."""
    if isinstance(sensor, Hits):
        return "hits"
    if isinstance(sensor, Instrument):
        return "RS/R0" if sensor.air else "g/m²" if sensor.ray else "g/m³"
    return "g/m³" if isinstance(sensor, Gaussian | Threshold) else "the sensor's unit"


def stop_text(stop: str) -> str:
    """Return a stop criterion in words."""
    kind, _, numbers = stop.partition(":")
    values = numbers.split(",")
    if kind == "spread" and numbers:
        return f"the spread of the belief is below {_short(values[0])} m"
    if kind == "within" and len(values) == 2 and (share := _number(values[1])) is not None:
        return f"at least {100 * share:.6g}% of the belief lies within {_short(values[0])} m of the estimate"
    return "the spread of the belief is below a threshold" if kind == "spread" else stop
