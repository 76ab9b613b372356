"""Wrong assumptions by name: how the truth of a mission differs from what the estimator assumes."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from plume.elementary import exp, log
from plume.randomness import keyed, uniform
from plume.scenario import AREA_M, SOURCE_HIGH_M, SOURCE_LOW_M, draw

SPIKED_READINGS = 30  # spikes are among so many first readings: most searches take as many
SPIKES = 0.5, 100.0  # their least and greatest size, g/m³ or hits


class Errors(NamedTuple):
    """The truth of one mission against what its estimator assumes. A factor is true value / assumed value."""

    # What has to be added to the measured wind direction, degrees counter-clockwise.
    direction_deg: float = 0.0
    speed: float = 1.0  # factor on the measured wind speed
    q: float = 1.0  # factor on the release rate
    d: float = 1.0  # factor on the diffusivity
    tau: float = 1.0  # factor on the lifetime of the gas
    source: tuple[float, float] | None = None  # the source, (x, y) m; None is where the scenario has it
    second: tuple[float, float] | None = None  # another source like it, (x, y) m
    gain: float = 1.0  # factor on the gas that the sensor meets
    noise: float = 1.0  # factor on α and β of the sensor. A count of hits has neither, so it stays as it is.
    # Coefficient of variation of the gas, which is gamma-distributed around the plume's mean; None is that of
    # the sensor as told.
    cv: float | None = None
    correlation: float = 0.0  # correlation of the gas between one reading and the next
    # Probability of a reading, never the first, to have no value at first; the sensor is then read again.
    lost: float = 0.0
    # Number of the first reading that has nothing to do with the gas: it is `stuck_at` + N(0, `stuck_std`²)
    # instead.
    stuck_from: float = math.inf
    stuck_at: float = 0.0  # g/m³
    stuck_std: float = 0.0  # g/m³
    # False readings, which last one reading each: the number of the reading, and the amount that it is too
    # high by, g/m³ or hits. Nothing shows of them in a stuck sensor.
    spikes: tuple[tuple[int, float], ...] = ()
    # Standard deviations of an anemometer's errors in each reading: of the direction, and of the speed as a
    # share of it.
    wind_std_deg: float = 0.0
    wind_std: float = 0.0


FACTORS = frozenset({"speed", "q", "d", "tau", "gain", "noise"})  # errors that multiply
# What other errors say, in words.
SAID = {
    "cv": "intermittency",
    "correlation": "intermittency",
    "stuck_from": "stuck sensor",
    "spikes": "false readings",
}


class Wrong(NamedTuple):
    """A wrong assumption to choose."""

    about: str  # one line about it
    errors: Callable[[int], Errors]  # the errors of the mission of a seed


def side(seed: int) -> int:
    """Return 1 or −1, the side to which the measured wind is wrong, drawn by the seed."""
    return 1 if keyed(seed, "wind error").random() < 0.5 else -1


def outside(seed: int) -> tuple[float, float]:
    """Draw a source uniformly from the area outside Table 1's square, (x, y) m."""
    rng = keyed(seed, "source outside")
    while True:
        x, y = uniform(rng, np.zeros(2), AREA_M).tolist()
        if not (SOURCE_LOW_M <= x <= SOURCE_HIGH_M and SOURCE_LOW_M <= y <= SOURCE_HIGH_M):
            return x, y


def beyond(seed: int) -> tuple[float, float]:
    """Draw a source 2 to 6 m beyond one of the area's edges, (x, y) m."""
    rng = keyed(seed, "source beyond")
    edge, along_m, off_m = uniform(rng, np.array([0, 0, 2.0]), np.array([4, AREA_M, 6.0])).tolist()
    across_m = -off_m if edge < 2 else AREA_M + off_m
    return (across_m, along_m) if edge % 2 < 1 else (along_m, across_m)


def second(seed: int) -> tuple[float, float]:
    """Draw a place in the area that is 5 to 15 m from the source of the seed's scenario, (x, y) m."""
    first, rng = draw(seed).source, keyed(seed, "second source")
    while True:
        x, y = uniform(rng, np.zeros(2), AREA_M).tolist()
        if 5.0 <= math.dist((x, y), first) <= 15.0:
            return x, y


def all_at_once(seed: int) -> Errors:
    """Draw an error of every kind: direction and cv uniform, factors log-uniform."""
    rng = keyed(seed, "all at once")
    direction_deg, cv = uniform(rng, np.array([-30.0, 0.0]), np.array([30.0, 1.0])).tolist()
    speed = float(exp(uniform(rng, log(0.7), log(1.4))))
    noise, gain, q, tau, d = exp(log(2.0) * uniform(rng, -np.ones(5), 1.0)).tolist()
    return Errors(direction_deg=direction_deg, speed=speed, q=q, d=d, tau=tau, gain=gain, noise=noise, cv=cv)


def stuck(seed: int) -> Errors:
    """Draw the value that the sensor repeats from reading 10 on: uniform from 0 to 3 g/m³."""
    return Errors(stuck_from=10, stuck_at=3.0 * keyed(seed, "stuck").random())


def spikes(seed: int, count: int) -> Errors:
    """Draw so many spikes: of the readings 0 to 29, no one twice, and sizes from 0.5 to 100, log-uniform."""
    rng = keyed(seed, "spikes")
    numbers = np.argsort(rng.random(SPIKED_READINGS), kind="stable")[:count].tolist()
    sizes = exp(uniform(rng, np.full(count, log(SPIKES[0])), log(SPIKES[1]))).tolist()
    return Errors(spikes=tuple(zip(numbers, sizes, strict=True)))


# The wrong assumptions, by name.
WRONG: dict[str, Wrong] = {
    "wind-10": Wrong(
        "true wind direction 10° off the measured one, left or right",
        lambda seed: Errors(direction_deg=10.0 * side(seed)),
    ),
    "wind-30": Wrong(
        "true wind direction 30° off the measured one, left or right",
        lambda seed: Errors(direction_deg=30.0 * side(seed)),
    ),
    "speed-low": Wrong("true wind speed 0.7 times the measured one", lambda _: Errors(speed=0.7)),
    "speed-high": Wrong("true wind speed 1.4 times the measured one", lambda _: Errors(speed=1.4)),
    "wind-noisy": Wrong(
        "an anemometer that errs by 10° and 10% of the speed in each reading",
        lambda _: Errors(wind_std_deg=10.0, wind_std=0.1),
    ),
    "noise-doubled": Wrong(
        "twice the sensor noise, α and β; a count of hits has none", lambda _: Errors(noise=2.0)
    ),
    "noise-halved": Wrong(
        "half the sensor noise, α and β; a count of hits has none", lambda _: Errors(noise=0.5)
    ),
    "gain-halved": Wrong("the sensor meets half the gas", lambda _: Errors(gain=0.5)),
    "gain-doubled": Wrong("the sensor meets twice the gas", lambda _: Errors(gain=2.0)),
    "rate-halved": Wrong("half the release rate", lambda _: Errors(q=0.5)),
    "rate-doubled": Wrong("twice the release rate", lambda _: Errors(q=2.0)),
    "tau-halved": Wrong("half the lifetime of the gas", lambda _: Errors(tau=0.5)),
    "tau-doubled": Wrong("twice the lifetime of the gas", lambda _: Errors(tau=2.0)),
    "d-halved": Wrong("half the diffusivity", lambda _: Errors(d=0.5)),
    "d-doubled": Wrong("twice the diffusivity", lambda _: Errors(d=2.0)),
    "cv-0.6": Wrong(
        "intermittent gas: its standard deviation is 0.6 times its mean", lambda _: Errors(cv=0.6)
    ),
    "cv-1": Wrong("intermittent gas: its standard deviation equals its mean", lambda _: Errors(cv=1.0)),
    "cv-2": Wrong("intermittent gas: its standard deviation is twice its mean", lambda _: Errors(cv=2.0)),
    "cv-1-correlated": Wrong(
        "as cv-1, with a correlation of 0.7 between one reading and the next",
        lambda _: Errors(cv=1.0, correlation=0.7),
    ),
    "all-at-once": Wrong(
        "wind, noise, gain, rate, lifetime, diffusivity and intermittency all drawn at random", all_at_once
    ),
    "readings-lost": Wrong(
        "20% of the readings have no value until they are taken again", lambda _: Errors(lost=0.2)
    ),
    "source-outside": Wrong(
        "the source is outside the square [10, 25]²", lambda seed: Errors(source=outside(seed))
    ),
    "source-beyond": Wrong(
        "the source is 2 to 6 m beyond an edge of the area", lambda seed: Errors(source=beyond(seed))
    ),
    "two-sources": Wrong(
        "a second source like the first, 5 to 15 m from it", lambda seed: Errors(second=second(seed))
    ),
    "spike": Wrong(
        "one false reading among the first 30, too high by 0.5 to 100 g/m³ or hits",
        lambda seed: spikes(seed, 1),
    ),
    "spikes-3": Wrong("as spike, with three false readings", lambda seed: spikes(seed, 3)),
    "stuck": Wrong("the sensor repeats one value, from 0 to 3 g/m³, from reading 10 on", stuck),
    "stuck-noisy": Wrong(
        "the sensor reads 1 ± 0.2 g/m³ everywhere",
        lambda _: Errors(stuck_from=0, stuck_at=1.0, stuck_std=0.2),
    ),
}


def combined(names: Sequence[str], seed: int) -> Errors:
    """Return the errors of a mission under several wrong assumptions at once; none if there are no names.

    Directions add, factors multiply. Raises ValueError where two say something of the same other thing.
    """
    usual: dict[str, Any] = Errors()._asdict()
    total = dict(usual)
    for name in names:
        for field, more in WRONG[name].errors(seed)._asdict().items():
            if more == usual[field]:
                continue
            if field == "direction_deg":
                total[field] += more
            elif field in FACTORS:
                total[field] *= more
            elif total[field] == usual[field]:
                total[field] = more
            else:
                what = SAID.get(field, field)
                raise ValueError(f"{' and '.join(names)} say more than once what the {what} is; wanted one")
    return Errors(**total)
