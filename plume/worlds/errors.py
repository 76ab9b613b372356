"""Wrong assumptions by name: how the truth of a mission differs from what the estimator assumes."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from plume.elementary import exp, log
from plume.problem import PAPER, Area, Problem
from plume.randomness import keyed, uniform
from plume.scenario import draw

MOST_DRAWS = 100_000  # of a place until one is as wanted
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
    errors: Callable[[int, Problem], Errors]  # the errors of a problem's mission of a seed


def side(seed: int) -> int:
    """Return 1 or −1, the side to which the measured wind is wrong, drawn by the seed."""
    return 1 if keyed(seed, "wind error").random() < 0.5 else -1


def outside(seed: int, problem: Problem = PAPER) -> tuple[float, float]:
    """Draw a source uniformly from the area outside where a problem's are, (x, y) m.

    Raises ValueError where there is hardly such a place.
    """
    rng, area, sources = keyed(seed, "source outside"), problem.area, problem.sources
    for _ in range(MOST_DRAWS):
        x, y = uniform(rng, np.array(area.low), np.array(area.high)).tolist()
        if not (isinstance(sources, Area) and sources.holds((x, y))) and problem.may_leak((x, y)):
            return x, y
    raise ValueError("source-outside is not for a problem whose sources are drawn from the whole area")


def beyond(seed: int, problem: Problem = PAPER) -> tuple[float, float]:
    """Draw a source beyond one of the area's edges, (x, y) m.

    It is a fifteenth to a fifth of the area's side away, in Table 1's area 2 to 6 m.
    """
    rng, area = keyed(seed, "source beyond"), problem.area
    side_m = area.side_m
    drawn = rng.random(3)
    edge = 4.0 * drawn[0]
    across, along = (0, 1) if edge % 2 < 1 else (1, 0)
    along_m = float(area.low[along] + area.size_m[along] * drawn[1])
    off_m = float(side_m / 15 + (side_m / 5 - side_m / 15) * drawn[2])
    across_m = area.low[across] - off_m if edge < 2 else area.high[across] + off_m
    return (across_m, along_m) if across == 0 else (along_m, across_m)


def second(
    seed: int, problem: Problem = PAPER, first: tuple[float, float] | None = None
) -> tuple[float, float]:
    """Draw a place in the area that is away from the first source, (x, y) m: from the seed's, if not given.

    It is a sixth to a half of the area's side away, in Table 1's area 5 to 15 m.
    """
    first, rng, area = first or draw(seed, problem).source, keyed(seed, "second source"), problem.area
    for _ in range(MOST_DRAWS):
        x, y = uniform(rng, np.array(area.low), np.array(area.high)).tolist()
        if area.side_m / 6 <= math.dist((x, y), first) <= area.side_m / 2 and problem.may_leak((x, y)):
            return x, y
    raise ValueError("two-sources is not for a problem whose source is drawn far from its area")


def all_at_once(seed: int, _: Problem = PAPER) -> Errors:
    """Draw an error of every kind: direction and cv uniform, factors log-uniform."""
    rng = keyed(seed, "all at once")
    direction_deg, cv = uniform(rng, np.array([-30.0, 0.0]), np.array([30.0, 1.0])).tolist()
    speed = float(exp(uniform(rng, log(0.7), log(1.4))))
    noise, gain, q, tau, d = exp(log(2.0) * uniform(rng, -np.ones(5), 1.0)).tolist()
    return Errors(direction_deg=direction_deg, speed=speed, q=q, d=d, tau=tau, gain=gain, noise=noise, cv=cv)


def stuck(seed: int, _: Problem = PAPER) -> Errors:
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
        lambda seed, _: Errors(direction_deg=10.0 * side(seed)),
    ),
    "wind-30": Wrong(
        "true wind direction 30° off the measured one, left or right",
        lambda seed, _: Errors(direction_deg=30.0 * side(seed)),
    ),
    "speed-low": Wrong("true wind speed 0.7 times the measured one", lambda *_: Errors(speed=0.7)),
    "speed-high": Wrong("true wind speed 1.4 times the measured one", lambda *_: Errors(speed=1.4)),
    "wind-noisy": Wrong(
        "an anemometer that errs by 10° and 10% of the speed in each reading",
        lambda *_: Errors(wind_std_deg=10.0, wind_std=0.1),
    ),
    "noise-doubled": Wrong(
        "twice the sensor noise, α and β; a count of hits has none", lambda *_: Errors(noise=2.0)
    ),
    "noise-halved": Wrong(
        "half the sensor noise, α and β; a count of hits has none", lambda *_: Errors(noise=0.5)
    ),
    "gain-halved": Wrong("the sensor meets half the gas", lambda *_: Errors(gain=0.5)),
    "gain-doubled": Wrong("the sensor meets twice the gas", lambda *_: Errors(gain=2.0)),
    "rate-halved": Wrong("half the release rate", lambda *_: Errors(q=0.5)),
    "rate-doubled": Wrong("twice the release rate", lambda *_: Errors(q=2.0)),
    "tau-halved": Wrong("half the lifetime of the gas", lambda *_: Errors(tau=0.5)),
    "tau-doubled": Wrong("twice the lifetime of the gas", lambda *_: Errors(tau=2.0)),
    "d-halved": Wrong("half the diffusivity", lambda *_: Errors(d=0.5)),
    "d-doubled": Wrong("twice the diffusivity", lambda *_: Errors(d=2.0)),
    "cv-0.6": Wrong(
        "intermittent gas: its standard deviation is 0.6 times its mean", lambda *_: Errors(cv=0.6)
    ),
    "cv-1": Wrong("intermittent gas: its standard deviation equals its mean", lambda *_: Errors(cv=1.0)),
    "cv-2": Wrong("intermittent gas: its standard deviation is twice its mean", lambda *_: Errors(cv=2.0)),
    "cv-1-correlated": Wrong(
        "as cv-1, with a correlation of 0.7 between one reading and the next",
        lambda *_: Errors(cv=1.0, correlation=0.7),
    ),
    "all-at-once": Wrong(
        "wind, noise, gain, rate, lifetime, diffusivity and intermittency all drawn at random", all_at_once
    ),
    "readings-lost": Wrong(
        "20% of the readings have no value until they are taken again", lambda *_: Errors(lost=0.2)
    ),
    "source-outside": Wrong(
        "the source is outside where it is drawn: of paper the square [10, 25]²",
        lambda seed, problem: Errors(source=outside(seed, problem)),
    ),
    "source-beyond": Wrong(
        "the source is beyond an edge of the area, by 2 to 6 m of 30",
        lambda seed, problem: Errors(source=beyond(seed, problem)),
    ),
    "two-sources": Wrong(
        "a second source like the first, 5 to 15 m from it in an area of 30 m",
        lambda seed, problem: Errors(second=second(seed, problem)),
    ),
    "spike": Wrong(
        "one false reading among the first 30, too high by 0.5 to 100 g/m³ or hits",
        lambda seed, _: spikes(seed, 1),
    ),
    "spikes-3": Wrong("as spike, with three false readings", lambda seed, _: spikes(seed, 3)),
    "stuck": Wrong("the sensor repeats one value, from 0 to 3 g/m³, from reading 10 on", stuck),
    "stuck-noisy": Wrong(
        "the sensor reads 1 ± 0.2 g/m³ everywhere",
        lambda *_: Errors(stuck_from=0, stuck_at=1.0, stuck_std=0.2),
    ),
}


def combined(names: Sequence[str], seed: int, problem: Problem = PAPER) -> Errors:
    """Return the errors of a mission under several wrong assumptions at once; none if there are no names.

    Directions add, factors multiply. Raises ValueError where two say something of the same other thing.
    """
    usual: dict[str, Any] = Errors()._asdict()
    total = dict(usual)
    for name in names:
        for field, more in WRONG[name].errors(seed, problem)._asdict().items():
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
