"""The particle filter: the posterior over the unknowns of the source, one reading at a time.

Each reading is assimilated by reweighting, and where needed resampling and moving.
"""

import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from estimator.assumptions import SPIKES, effective_priors, margin
from estimator.criterion import WIDEST_M, Criterion
from estimator.kernels.densities import Model, log_priors
from estimator.kernels.update import RESAMPLE_BELOW, WITHIN_A_ROUND, WeightedSample, renew, update
from estimator.priors import Prior, draw, table
from link.bus.mavlink import Reading
from link.cli import FARTHEST_OUT_M, PARTICLES
from plume.elementary import Array, Indices
from plume.flight import leg_s
from plume.parameters import KNOWN, MEASURED, MOST, NEUTRAL, PARAMETERS
from plume.polygons.parts import numbered_sides
from plume.problem import AREA, Area, Fenced, PriorParts
from plume.problems.values import number, short, whole
from plume.randomness import MAX_SEED, keyed
from plume.scenario import LIFETIME_S
from plume.sensors.instruments import Instrument
from plume.sensors.names import GAUSSIAN, Sensor, lags, sensor_row, text
from plume.sensors.sensor import Gaussian

GREATEST = float(np.finfo(np.float32).max)  # number of a reading: a square of greater ones may be infinite


@dataclass(frozen=True)
class Config:
    """What the estimator knows beforehand, and its stop criterion.

    Raises ValueError if they are inconsistent, TypeError if the sensor or a prior is something else, such
    as its text.

    Examples:
        >>> config = plumeward.Config(rate=250.0, diffusivity=3.0)  # g/s and m²/s: knows both
        >>> config.particles, config.threshold_m
        (1000, 0.5)
    """

    particles: int = 1000
    threshold_m: float = 0.5  # ζ, m: the search stops when the spread is below it
    seed: int = 0
    # q, g/s, unless it has a prior. The defaults of rate and diffusivity are the middle of Table 1.
    rate: float = 300.0
    diffusivity: float = 4.5  # d, m²/s, unless it has a prior
    lifetime: float = LIFETIME_S  # τ, s, unless it has a prior
    area: Area = AREA  # where the search flies
    # How far beyond the area's edges the source may be, m; None is a third of its side under `field`, else 0.
    margin_m: float | None = None
    # Priors by name of `PARAMETERS`, which replace those of `assume` one by one. x and y are uniform over the
    # area by default, and less dense in the margin around it. Without a prior, the source's height z is the
    # flight height, and wind speed u and direction φ are those measured. With a prior, the measured value is
    # ignored.
    priors: Mapping[str, Prior] = field(default_factory=dict)
    sensor: Sensor = GAUSSIAN
    # True if a stop requires the location to be known: the spread below ζ, or `within`.
    stop_on_location: bool = True
    # Limits by name of unknown: a stop requires its standard deviation to be below.
    stop_limits: Mapping[str, float] = field(default_factory=dict)
    assume: str = "paper"  # what is taken to be known: a name of `estimator.assumptions.ASSUMPTIONS`
    # (R, P): the search stops when at least the share P of the belief lies within R m of the estimate.
    within: tuple[float, float] | None = None
    # The part of the area where the source is expected, uniformly; None: all of it, and the margin around it.
    expected: Area | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.sensor, Sensor):
            raise TypeError(
                f"sensor {self.sensor!r} is not allowed; wanted a sensor, such as "
                "plume.sensors.names.parse('hits:3,0.1')"
            )
        for name, place in (("area", self.area), ("expected", self.expected or self.area)):
            if not isinstance(place, Area):
                raise TypeError(f"{name} {short(place)} is not allowed; wanted a plumeward.Area")
        whole("particles", self.particles, 1, PARTICLES[1])
        whole("seed", self.seed, 0, MAX_SEED)
        for name in ("rate", "diffusivity", "lifetime"):
            number(name, getattr(self, name), 0, MOST, above=True)
        number("threshold_m", self.threshold_m, 0, WIDEST_M, above=True)
        if self.within is not None:
            if not isinstance(self.within, Sequence) or len(self.within) != 2:
                raise ValueError(
                    f"within {short(self.within)} is not allowed; wanted (R, P), metres and a share"
                )
            number("within: R", self.within[0], 0, WIDEST_M, above=True)
            number("within: P", self.within[1], 0, 1, above=True)
        if self.margin_m is not None:
            number("margin_m", self.margin_m, 0, FARTHEST_OUT_M)
        for argument, by_name in (("priors", self.priors), ("stop_limits", self.stop_limits)):
            if not isinstance(by_name, Mapping):
                raise TypeError(
                    f"{argument} {by_name!r:.60} is not allowed; wanted a dict by names of unknowns"
                )
        for name, given in self.priors.items():
            if not isinstance(given, Prior):
                raise TypeError(
                    f"the prior {given!r} of {name} is not allowed; wanted one such as "
                    "estimator.priors.Gamma(2, 150)"
                )
        if not len(self.unknown_indices):
            raise ValueError("nothing is unknown: at least one parameter needs a prior that is not fixed")
        for name, limit in self.stop_limits.items():
            if name not in self.unknowns:
                raise ValueError(
                    f"a stop cannot wait for {name}: it is not unknown; unknown are "
                    f"{', '.join(self.unknowns)}"
                )
            number(f"stop_limits: {name}", limit, 0, sys.float_info.max, above=True)
        if not (self.stop_on_location or self.stop_limits):
            raise ValueError("a stop needs a criterion: the location or a limit")

    @cached_property
    def effective_priors(self) -> Mapping[str, Prior]:
        """Priors by name: those of the assumption, each replaced by the one in `priors`.

        Uniform ones of x and y are not among them.
        """
        return effective_priors(self.assume, self.priors, self.rate, self.lifetime, self.sensor)

    @property
    def criterion(self) -> Criterion:
        """What a stop requires of the location."""
        return Criterion(self.threshold_m, self.within)

    @cached_property
    def prior_rows(self) -> Array:
        """(15, 5): the priors as the kernels take them."""
        cv = self.sensor.cv if isinstance(self.sensor, Gaussian) else 0.0
        known = {"q": self.rate, "d": self.diffusivity, "tau": self.lifetime, "z": 0.0, **NEUTRAL, "cv": cv}
        return table(self.effective_priors, known, self.area, self.margin, self.expected)

    @property
    def margin(self) -> float:
        """How far beyond the area's edges the source may be, m."""
        return margin(self.assume, self.area, self.margin_m)

    @cached_property
    def unknown_indices(self) -> Indices:
        """(D,): indices into `plume.parameters.PARAMETERS` of the unknowns."""
        return np.flatnonzero((self.prior_rows[:, 0] != KNOWN) & (self.prior_rows[:, 0] != MEASURED))

    @cached_property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the unknowns, in the order of the particles' rows."""
        return tuple(PARAMETERS[index] for index in self.unknown_indices)

    @cached_property
    def model(self) -> Model:
        """Unknowns, priors and sensor as the kernels take them."""
        spikes = np.array([self.spikes])
        sensor = sensor_row(self.sensor)
        return Model(self.unknown_indices, self.prior_rows, sensor, spikes, self.walls, self.densities)

    @cached_property
    def walls(self) -> Array:
        """The sides (W, 5) of polygons: x and y of both ends, and the polygon's number in `densities`.

        Number 0 are all those in which no source is. They run counter-clockwise.
        """
        ground, sides = self.area, [np.empty((0, 5))]
        if isinstance(ground, Fenced) and not ground.source_inside:
            sides.append(np.pad(ground.obstacles.walls.reshape(-1, 4), ((0, 0), (0, 1))))
        if self.parts:
            sides.append(numbered_sides(self.parts.polygons))
        return np.concatenate(sides)

    @cached_property
    def parts(self) -> PriorParts | None:
        """The polygons in which alone the source is expected; None: there are none."""
        parts = self.expected
        return parts if isinstance(parts, PriorParts) and not {"x", "y"} & set(self.priors) else None

    @property
    def densities(self) -> Array:
        """The prior's density outside of all its parts, then in each, up to a constant."""
        return np.concatenate([[0.0], self.parts.densities]) if self.parts else np.ones(1)

    @cached_property
    def sensor_text(self) -> str:
        """The sensor in the form of the flag --sensor."""
        return text(self.sensor)

    @property
    def spikes(self) -> float:
        """Share of the readings that say nothing of the source."""
        return SPIKES[self.assume]

    @property
    def sweeps(self) -> int:
        """Most Metropolis sweeps after each resampling.

        More unknowns need more, since fewer proposals are accepted.
        """
        return 3 * max(len(self.unknown_indices) - 1, 1)

    @property
    def columns(self) -> int:
        """Numbers of a reading as the kernels take it."""
        return 11 if lags(self.sensor) else 7

    def row(self, reading: Reading, before: Array | None = None) -> Array:
        """Return a reading as the kernels take it, (7,) or (11,).

        The seventh number, the exponent of its likelihood, is 1; `update` may lower it. Those of a
        sensor that lags say where the reading before was taken, x and y, what it was, and how long the leg
        from there takes by the usual speed: a clock would depend on the machine. Before the first it is in
        clean air.

        before: the row of the reading before, if there is one.
        """
        height = reading.altitude_m if "z" in self.priors else 0.0
        row = [*reading.position, height, *reading.wind, reading.gas, 1.0]
        if isinstance(self.sensor, Instrument) and lags(self.sensor):
            clean = float(self.sensor.settled(0.0))
            x, y, gas = (*reading.position, clean) if before is None else before[[0, 1, 5]].tolist()
            row += [x, y, gas, float(leg_s((x, y), reading.position))]
        return np.array(row)


@dataclass(frozen=True)
class Posterior:
    """Weighted particles and the readings behind them; never changed, only replaced.

    Examples:
        >>> posterior = plumeward.prior(plumeward.Config(particles=500))
        >>> len(posterior.readings), posterior.log_weights.shape
        (0, (500,))
    """

    particles: Array  # (D, N), one row per unknown
    log_weights: Array  # (N,) up to a constant
    weights: Array  # (N,) exp(log_weights), scaled so that the greatest is 1
    # (N,) log posterior density given all readings so far, up to a constant, at each particle.
    log_targets: Array
    # (T, 7) or (T, 11): x, y, height, wind_x, wind_y, gas, share, and what `Config.row` says of a sensor that
    # lags. The share is the exponent of the reading's likelihood.
    # It is below 1 if the reading was too improbable to be assimilated in full.
    readings: Array
    # (T,) rank of each reading in its predictive distribution: uniform in (0, 1) if the model is right.
    ranks: Array
    # (T,) which vehicle of a fleet took each reading, from 1; None: one vehicle took all.
    vehicles: Indices | None = None

    @property
    def by_vehicle(self) -> "list[Indices | slice]":
        """The numbers of each vehicle's readings, in their order."""
        if self.vehicles is None:
            return [slice(None)]
        return [np.flatnonzero(self.vehicles == vehicle) for vehicle in np.unique(self.vehicles)]

    @property
    def whose(self) -> Indices:
        """Which vehicle took each reading, (T,)."""
        return np.ones(len(self.readings), np.int64) if self.vehicles is None else self.vehicles

    @property
    def sample(self) -> WeightedSample:
        """The arrays that `update` changes."""
        return WeightedSample(self.particles, self.log_weights, self.weights, self.log_targets)


def prior(config: Config) -> Posterior:
    """Return the belief before any reading: N particles of equal weight, drawn from the priors.

    Examples:
        >>> plumeward.prior(plumeward.Config(particles=500)).particles.shape  # a row for x and one for y, m
        (2, 500)
    """
    count = config.particles
    rows, unknowns, rng = config.prior_rows, config.unknown_indices, keyed(config.seed, "prior")
    forbidden = config.walls[config.walls[:, 4] == 0, :4]
    particles = draw(rows, unknowns, count, rng, forbidden, config.parts)
    log_targets = log_priors(particles, config.model)
    return Posterior(
        particles, np.zeros(count), np.ones(count), log_targets, np.empty((0, config.columns)), np.empty(0)
    )


def forget(posterior: Posterior, vehicles: Collection[int], config: Config) -> Posterior:
    """Return the posterior of the readings that these vehicles of a fleet have not taken.

    It is computed anew from the prior, with the readings that are left in their order, and renewed between
    their rounds.
    """
    took = posterior.whose
    kept = np.flatnonzero(~np.isin(took, list(vehicles)))
    again = prior(config)
    for count, own in enumerate(kept.tolist(), 1):
        row = posterior.readings[own].copy()
        row[6] = 1.0  # its share
        if count > 1 and took[own] <= again.whose[-1]:
            again = renewed(again, config)  # a round was over
        again = with_row(again, row, config, took[kept[:count]])
    return again


def assimilate(posterior: Posterior, reading: Reading, config: Config) -> Posterior:
    """Return the posterior after one more reading: reweight; if the weights degenerate, resample and move.

    `estimator.kernels.update` does it. In a round of several vehicles they may degenerate further: `renewed`
    follows the round. A function of its arguments alone: the same readings in the same order give the same
    particles. `posterior` is not changed. Raises ValueError if a number is not finite as a float32, as which
    readings are told.

    Examples:
        >>> samples, wind = [((8.0, 9.0), 1.3), ((12.0, 10.0), 2.1), ((12.0, 12.0), 0.4)], (1.5, -0.5)
        >>> config = plumeward.Config(rate=250.0, diffusivity=3.0)
        >>> posterior = plumeward.prior(config)
        >>> for step, (position, gas) in enumerate(samples):
        ...     reading = plumeward.Reading(1000 * step, position, 5.0, wind, gas)
        ...     posterior = plumeward.assimilate(posterior, reading, config)
        ...     said, particles = plumeward.belief(posterior, reading, config)
        ...     print(step, round(said.spread, 2), said.ceased)
        0 3.03 False
        1 1.69 False
        2 1.16 False
    """
    numbers = (*reading.position, reading.altitude_m, *reading.wind, reading.gas)
    if not all(abs(each) <= GREATEST for each in numbers):  # false of NaN, too
        raise ValueError(f"{reading} is not allowed; wanted finite numbers of float32")
    vehicles = posterior.vehicles
    if vehicles is not None or reading.vehicle != 1:
        vehicles = np.append(posterior.whose, reading.vehicle)
    return with_row(posterior, row_of(posterior, reading, config), config, vehicles)


def row_of(posterior: Posterior, reading: Reading, config: Config) -> Array:
    """Return the next reading as the kernels take it: an instrument follows those of its own vehicle."""
    own = posterior.readings[posterior.whose == reading.vehicle]
    return config.row(reading, own[-1] if len(own) else None)


def with_row(posterior: Posterior, row: Array, config: Config, vehicles: Indices | None = None) -> Posterior:
    """Return the posterior after one more reading, as the kernels take it, and who has taken them all."""
    sample = WeightedSample(*(array.copy() for array in posterior.sample))
    readings = np.vstack([posterior.readings, row])
    least = WITHIN_A_ROUND if _are_several(vehicles) else RESAMPLE_BELOW
    rank = update(sample, readings, config.model, config.seed, config.sweeps, least)
    return Posterior(*sample, readings, np.append(posterior.ranks, rank), vehicles)


def _are_several(vehicles: Indices | None) -> bool:
    return vehicles is not None and bool((vehicles != vehicles[0]).any())


def renewed(posterior: Posterior, config: Config) -> Posterior:
    """Return the posterior of several vehicles after a round's last reading, resampled and well moved.

    Within the round its weights may degenerate, so that waypoints do not wait for moves: there is time for
    these while the vehicles fly. If they have hardly changed, or of one vehicle, it is what it was.
    """
    if not _are_several(posterior.vehicles):
        return posterior
    sample = WeightedSample(*(array.copy() for array in posterior.sample))
    renew(sample, posterior.readings, config.model, config.seed, config.sweeps)
    return Posterior(*sample, posterior.readings, posterior.ranks, posterior.vehicles)
