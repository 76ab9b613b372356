"""Whose sensor lies: the readings of each vehicle of a search by several, held against those of the others.

For each vehicle two explanations of all readings are compared. One is the search's own: all sensors read the
same plume. In the other the vehicle's sensor reads it with a gain of its own, or hums at a value of its own,
and only the others' readings say where the source is. How many times more probable the readings are by the
second is known after each round. If the sensor is sound it exceeds R in one search of R at most, whenever
one looks (Ville 1939): with ODDS for each vehicle, one search of ODDS names a sound one. Densities of
readings are those before they are assimilated, estimated by particles: it holds but for the particles' error.

- Bennett 1976: Efficient estimation of free energy differences from Monte Carlo data, J. Comput. Phys. 22.
- Ville 1939: Étude critique de la notion de collectif.
"""

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from estimator.filter import Config, Posterior, prior, row_of, with_row
from estimator.kernels.densities import Model, log_likelihoods
from estimator.kernels.weights import weighted_mean
from link.bus.mavlink import Reading
from plume.elementary import Array, exp, log
from plume.parameters import GAIN, KNOWN
from plume.sensors.sensor import Gaussian

ODDS = 100.0
# Factors on the gas that a lying sensor reads; the least stands for none at all.
GAINS = (1e-6, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0)
FEW = 250  # particles of the beliefs without a vehicle: there are as many beliefs as vehicles
# Of a sensor that hums, before its first reading: the readings that its mean of 0 is worth, and the shape and
# scale of its variance, the latter in variances of the noise in clean air.
WORTH, SHAPE, SCALE = 0.1, 1.0, 1.25


@dataclass
class Hum:
    """A sensor that shows one value plus noise, both unknown: how probable its readings are, one by one.

    The predictive distribution is Student's t; its prior is normal-inverse-gamma.
    """

    scale: float
    log_density: float = 0.0  # of all readings so far
    _mean: float = 0.0
    _worth: float = WORTH
    _shape: float = SHAPE
    _ratio: float = field(default=math.sqrt(math.pi) / 2)  # Γ(shape + ½) / Γ(shape)

    def read(self, gas: float) -> None:
        """Take a reading."""
        degrees, away = 2 * self._shape, gas - self._mean
        square = self.scale * (self._worth + 1) / (self._shape * self._worth)
        self.log_density += float(
            log(self._ratio)
            - 0.5 * log(degrees * math.pi * square)
            - 0.5 * (degrees + 1) * log(1 + away * away / (degrees * square))
        )
        self.scale += 0.5 * self._worth * away * away / (self._worth + 1)
        self._mean += away / (self._worth + 1)
        self._worth += 1
        self._ratio, self._shape = self._shape / self._ratio, self._shape + 0.5


@dataclass
class _Suspect:
    """What is known of one vehicle."""

    without: Posterior  # of the others' readings
    gains: Array  # log densities of its readings by each of GAINS, given the others' readings
    hum: Hum | None
    others: float = 0.0  # log density of the others' readings
    sound: float = 0.0  # log density of its readings if its sensor is sound, given the others' readings

    def log_odds(self, together: float) -> float:
        """Return the log of how many times more probable all readings are if its sensor lies.

        The mean over the ways in which it may.  together: the log density of all readings if none lies. Where
        the search's own belief has too few particles to find what they have in common, `sound` says it.
        """
        ways = np.append(self.gains, self.hum.log_density) if self.hum else self.gains
        most = float(ways.max())
        lies = most + float(log(float(exp(ways - most).sum()) / len(ways)))
        return lies - max(together - self.others, self.sound)


class SensorWatch:
    """Watches the sensors of several vehicles that search together."""

    def __init__(self, config: Config, vehicles: int) -> None:
        """Take what the estimator assumes, and how many vehicles search."""
        self._config = config
        self._few = replace(config, particles=min(config.particles, FEW))
        known = config.prior_rows[GAIN, 0] == KNOWN
        self._models = [self._of_gain(gain) for gain in GAINS] if known else []
        self._hums = type(config.sensor) is Gaussian
        self._taken: list[tuple[int, Array]] = []  # (vehicle, reading as the kernels take it)
        self.waiting: list[tuple[Posterior, Posterior, Reading]] = []  # taken, but not looked at yet
        self._begin(range(1, vehicles + 1))

    def _of_gain(self, gain: float) -> Model:
        priors = self._config.model.priors.copy()
        priors[GAIN, 1] *= gain
        return self._config.model._replace(priors=priors)

    def _begin(self, vehicles: Iterable[int]) -> None:
        """Count from now on, with what has been read so far."""
        self._all = 0.0
        self.doubted: Sequence[int] = ()  # the vehicle whose sensor seemed to lie when it was looked last
        floor = self._config.sensor.environment_noise if isinstance(self._config.sensor, Gaussian) else 0.0
        self._suspects: dict[int, _Suspect] = {}
        for vehicle in vehicles if self._models or self._hums else ():
            without = prior(self._few)
            for other, row in self._taken:
                if other != vehicle:
                    without = with_row(without, row, self._few)
            hum = Hum(SCALE * floor * floor) if self._hums else None
            self._suspects[vehicle] = _Suspect(without, np.zeros(len(self._models)), hum)

    def take(self, before: Posterior, after: Posterior, reading: Reading) -> None:
        """Take a reading of a round, with the search's own posteriors before and after it."""
        self.waiting.append((before, after, reading))

    def look(self) -> None:
        """Say in `doubted` whose sensor seems to lie, after the readings that have been taken.

        This takes longer than to assimilate them: each vehicle has a belief without it.
        """
        if not self.waiting:
            return
        fresh = []
        for before, after, reading in self.waiting:
            row = row_of(before, reading, self._config)
            self._all += _log_evidence(before, after, row, self._config)
            fresh.append((reading.vehicle, row))
        self.waiting.clear()
        for vehicle, suspect in self._suspects.items():
            for other, row in fresh:
                if other != vehicle:
                    before, suspect.without = suspect.without, with_row(suspect.without, row, self._few)
                    suspect.others += _log_evidence(before, suspect.without, row, self._few)
            for own, row in fresh:
                if own == vehicle:
                    suspect.gains += [_log_density(suspect.without, row, model) for model in self._models]
                    suspect.sound += _log_density(suspect.without, row, self._few.model)
                    if suspect.hum:
                        suspect.hum.read(float(row[5]))
        self._taken += fresh
        self.doubted = self._worst()

    def _worst(self) -> Sequence[int]:
        if len(self._suspects) < 2:
            return ()
        odds = {vehicle: each.log_odds(self._all) for vehicle, each in self._suspects.items()}
        worst = max(odds, key=lambda vehicle: odds[vehicle])
        return (worst,) if odds[worst] > float(log(ODDS * len(odds))) else ()

    def forget(self, vehicles: Collection[int]) -> None:
        """Go on without vehicles whose readings are forgotten."""
        self._taken = [(vehicle, row) for vehicle, row in self._taken if vehicle not in vehicles]
        self._begin([vehicle for vehicle in self._suspects if vehicle not in vehicles])


def _log_density(posterior: Posterior, row: Array, model: Model, power: float = 1.0) -> float:
    """Return the log of a posterior's mean of the likelihood of a reading to a power."""
    densities = power * log_likelihoods(posterior.particles, model, row)
    most = float(densities.max())
    return most + float(log(weighted_mean(posterior.weights, exp(densities - most))))


def _log_evidence(before: Posterior, after: Posterior, row: Array, config: Config) -> float:
    """Return the log density of a reading, as the kernels take it, that a posterior has assimilated.

    E[√L] before, by E[1/√L] after: of a sharp likelihood L few particles before know (Bennett 1976).
    """
    return _log_density(before, row, config.model, 0.5) - _log_density(after, row, config.model, -0.5)
