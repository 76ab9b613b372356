"""Gas sensors: each class defines both how readings are drawn and their likelihood."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plume.parameters import BLANK
from plume.randomness import Draws, inverse_gaussian

Array = NDArray[np.float64]
# A reading this many standard deviations beyond what the strongest plume could give is absurd.
SURPRISE = 10.0
MANY = 12  # above this many expected hits, their entropy is computed by its asymptotic series

_erf = np.vectorize(math.erf, otypes=[np.float64])
_log_gamma = np.vectorize(math.lgamma, otypes=[np.float64])


def normal_cdf(value: ArrayLike) -> Array:
    """P(Z ≤ value) of a standard normal variable."""
    return np.asarray(0.5 * (1.0 + _erf(np.asarray(value) / math.sqrt(2.0))))


class Fluctuating(NamedTuple):
    """What a reading in intermittent gas is made of, for gas of a mean and a coefficient of variation cv.

    It is blank with a probability. Else there is gas, distributed as the inverse Gaussian law, with normal
    noise.
    """

    blank: float  # the probability that it is: noise of the mean's strength, and no gas
    mean: Array  # of the gas where there is some
    square: float | Array  # of the coefficient of variation of that gas, with the noise that goes with it
    std: Array  # of the noise that does not


def fluctuating(mean: Array, cv: float, slope: float | Array, floor: float | Array) -> Fluctuating:
    """Return what a reading is made of where the gas has this mean. slope, floor: α and β of the noise."""
    blank = BLANK * cv * cv / (1 + cv * cv)
    square = (1 - blank) * (1 + cv * cv) - 1
    steady = slope * slope / (slope * slope + square)
    there = mean / (1 - blank)
    std = np.sqrt(slope * slope * steady * there * there + floor * floor)
    return Fluctuating(blank, there, square * (1 + slope * slope + steady), std)


def _log_density(reading: Array, gas: Fluctuating, std: Array) -> Array:
    """Log-density of each reading; std: of the noise of a blank.

    A numerical integral over the logarithm of the gas.
    """
    reading, mean, noise = np.broadcast_arrays(reading, gas.mean, gas.std)
    mean = np.maximum(mean, 1e-9 * noise)[..., None]
    low, high = (
        1 + 1500 * gas.square + 12 * math.sqrt(gas.square),
        1 + 80 * gas.square + 12 * math.sqrt(gas.square),
    )
    even = np.exp(np.linspace(-math.log(low), math.log(high), 4001)) * mean
    near = np.maximum(reading[..., None] + noise[..., None] * np.linspace(-12.0, 12.0, 4001), 1e-300)
    c = np.sort(np.concatenate([even, near], axis=-1), axis=-1)
    gap = (reading[..., None] - c) / noise[..., None]
    exponent = -0.5 * (np.square(c - mean) / (gas.square * mean * c) + np.square(gap))
    exponent -= 1.5 * np.log(c / mean)
    total = np.trapezoid(np.exp(exponent), c, axis=-1)
    there = total / (2 * np.pi * math.sqrt(gas.square) * mean[..., 0] * noise)
    nothing = np.exp(-0.5 * np.square(reading / std)) / (std * math.sqrt(2 * np.pi))
    return np.asarray(np.log(np.maximum(gas.blank * nothing + (1 - gas.blank) * there, 1e-300)))


@dataclass(frozen=True)
class Gaussian:
    """The paper's sensor: z = m + v, v ~ N(0, σ²), σ² = (α m)² + β².

    The two noises are independent and add in quadrature.
    """

    sensor_noise: float = 0.3  # α: standard deviation as a share of the concentration
    environment_noise: float = 0.2  # β: standard deviation in clean air, g/m³; above 0
    # Intermittency: coefficient of variation of the gas, up to GREATEST_CV; 0 is steady gas. A reading is
    # then as `fluctuating` says, independent from reading to reading.
    cv: float = 0.0
    dwell: float = field(
        default=0.0, kw_only=True
    )  # s that it hovers for a reading, which is of the mean gas

    def noise_std(self, mean: ArrayLike) -> Array:
        """σ(m), g/m³."""
        return np.sqrt(
            np.square(self.sensor_noise * np.asarray(mean, np.float64))
            + self.environment_noise * self.environment_noise
        )

    def measure(
        self, mean: ArrayLike, rng: Draws, concentration: ArrayLike | None = None, noise: ArrayLike = 1.0
    ) -> Array:
        """Draw a reading for each mean concentration, g/m³; same shape.

        concentration: the gas that is there, g/m³, if it was drawn elsewhere.  noise: factor on the
        sensor's noise.
        """
        mean = np.asarray(mean, np.float64)
        normal = rng.standard_normal(mean.shape)
        if concentration is not None or not self.cv:
            there = mean if concentration is None else np.asarray(concentration, np.float64)
            return np.asarray(there + np.asarray(noise) * self.noise_std(mean) * normal)
        factor = np.asarray(noise)
        gas = fluctuating(mean, self.cv, factor * self.sensor_noise, factor * self.environment_noise)
        return np.where(
            rng.random(mean.shape) < gas.blank,
            factor * self.noise_std(mean) * normal,
            gas.mean * inverse_gaussian(gas.square, rng, mean.shape) + gas.std * normal,
        )

    def log_likelihood(self, reading: ArrayLike, mean: ArrayLike) -> Array:
        """log N(z; m, σ(m)²) with its normaliser, which differs between hypotheses because σ depends on m.

        In intermittent gas that of what `fluctuating` says, by numerical integration over the gas.
        """
        std = self.noise_std(mean)
        if self.cv > 0:
            gas = fluctuating(
                np.asarray(mean, np.float64), self.cv, self.sensor_noise, self.environment_noise
            )
            return _log_density(np.asarray(reading, np.float64), gas, std)
        residual = np.asarray(reading, np.float64) - np.asarray(mean, np.float64)
        return np.asarray(-0.5 * np.square(residual / std) - np.log(std) - 0.5 * np.log(2 * np.pi))

    def entropy(self, mean: ArrayLike, noise: ArrayLike = 1.0, cv: ArrayLike = 0.0) -> Array:
        """Entropy of a reading at each mean concentration, nats. noise: factor on the sensor's noise.

        cv: intermittency; with it, the entropy of the normal distribution with the same variance, which is
        an upper bound.
        """
        from plume.numerics import HALF_LOG_2PI, log_each  # compiled: the vehicle starts without

        std = np.asarray(noise) * self.noise_std(mean)
        if np.any(cv):
            std = np.sqrt(np.square(std) + np.square(np.asarray(cv) * np.asarray(mean, np.float64)))
        return log_each(std) + (HALF_LOG_2PI + 0.5)

    def is_noisy(self, _reading: float) -> bool:
        """True if noise makes two bit-identical readings of this value in a row practically impossible."""
        return True

    def refusal(self, reading: float, greatest_mean: float) -> str | None:
        """Reason why this sensor cannot give this reading; None if it can.

        No concentration exceeds `greatest_mean`, g/m³.
        """
        surprise = SURPRISE * float(self.noise_std(greatest_mean))
        # m − SURPRISE σ(m) is concave, so its minimum is at one of the ends. Near a strong source, noise
        # reaches far below 0.
        low, high = (
            min(-SURPRISE * self.environment_noise, greatest_mean - surprise),
            greatest_mean + surprise,
        )
        return (
            None
            if low <= reading <= high
            else f"gas {reading:g} is absurd; allowed is {low:g} to {high:g} g/m³"
        )


@dataclass(frozen=True)
class Threshold:
    """A sensor that reads 0 below its threshold, and sometimes also in gas.

    As in AutoSTE, Stone Soup and Hutchinson et al. 2018. z = 0 with probability p_m (missed detection).
    Otherwise z = m + v as in `Gaussian`, or 0 if that is below the threshold.
    """

    threshold: float = 0.5  # g/m³; above 0
    missed: float = 0.3  # p_m: probability of a missed detection, in [0, 1)
    sensor_noise: float = 0.3  # α
    environment_noise: float = 0.2  # β, g/m³
    dwell: float = field(
        default=0.0, kw_only=True
    )  # s that it hovers for a reading, which is of the mean gas

    def _analog(self) -> Gaussian:
        return Gaussian(self.sensor_noise, self.environment_noise)

    def measure(
        self, mean: ArrayLike, rng: Draws, concentration: ArrayLike | None = None, noise: ArrayLike = 1.0
    ) -> Array:
        """Draw a reading for each mean concentration, g/m³; same shape.

        concentration: the gas that is there, g/m³, if it was drawn elsewhere.  noise: factor on the
        sensor's noise.
        """
        value = self._analog().measure(mean, rng, concentration, noise)
        seen = rng.random(value.shape) >= self.missed
        return np.where(seen & (value >= self.threshold), value, 0.0)

    def log_likelihood(self, reading: ArrayLike, mean: ArrayLike) -> Array:
        """Log-probability of a reading of 0; log-density of one above the threshold."""
        below = normal_cdf((self.threshold - np.asarray(mean)) / self._analog().noise_std(mean))
        silent = np.log(np.maximum(self.missed + (1 - self.missed) * below, 1e-300))
        heard = math.log1p(-self.missed) + self._analog().log_likelihood(reading, mean)
        return np.where(np.asarray(reading) == 0.0, silent, heard)

    def entropy(self, mean: ArrayLike, noise: ArrayLike = 1.0, _cv: ArrayLike = 0.0) -> Array:
        """Entropy of a reading at each mean concentration, nats.

        It is that of the probability of 0 together with the density above the threshold.
        noise: factor on the sensor's noise. Intermittency is not modelled.
        """
        from plume.numerics import (
            HALF_LOG_2PI,
            erfc_each,
            exp_each,
            log_each,
        )  # compiled: the vehicle starts without

        std = np.asarray(noise) * self._analog().noise_std(mean)
        standard = (self.threshold - np.asarray(mean)) / std
        above = 0.5 * erfc_each(standard * math.sqrt(0.5))
        silent = 1 - (1 - self.missed) * above
        density = exp_each(-0.5 * np.square(standard)) / math.sqrt(2 * np.pi)
        # Of x = v/σ beyond the threshold, E[x²; above] = standard · density + above.
        heard = above * (log_each(1 - self.missed) - log_each(std) - HALF_LOG_2PI) - 0.5 * (
            standard * density + above
        )
        return np.asarray(-silent * log_each(np.maximum(silent, 1e-300)) - (1 - self.missed) * heard)

    def is_noisy(self, reading: float) -> bool:
        """True if noise makes two bit-identical readings of this value in a row practically impossible."""
        return reading != 0.0

    def refusal(self, reading: float, greatest_mean: float) -> str | None:
        """Reason why this sensor cannot give this reading; None if it can.

        No concentration exceeds `greatest_mean`, g/m³.
        """
        high = greatest_mean + SURPRISE * float(self._analog().noise_std(greatest_mean))
        # Readings arrive rounded to float32, so the threshold is rounded too before they are compared.
        if reading == 0.0 or np.float32(self.threshold) <= np.float32(reading) <= high:
            return None
        return f"gas {reading:g} is absurd; allowed is 0 or {self.threshold:g} to {high:g} g/m³"


MOST_HITS = 1e15  # greatest mean count: of more, numpy draws none


@dataclass(frozen=True)
class Hits:
    """A hit counter: the reading is a count k ~ Poisson(e m + b).

    As in Vergassola et al. 2007 and OTTO (Loisy and Eloy 2022).
    """

    efficiency: float = 3.0  # e: expected hits per reading and g/m³; above 0
    background: float = 0.1  # b: expected hits per reading in clean air; above 0
    dwell: float = field(
        default=0.0, kw_only=True
    )  # s that it hovers for a reading, which is of the mean gas

    def measure(
        self, mean: ArrayLike, rng: Draws, concentration: ArrayLike | None = None, _noise: ArrayLike = 1.0
    ) -> Array:
        """Draw a reading for each mean concentration, g/m³; same shape.

        concentration: the gas that is there, g/m³, if it was drawn elsewhere.  A count has no noise of its
        own to scale.
        """
        there = np.asarray(mean if concentration is None else concentration, np.float64)
        return np.asarray(
            rng.poisson(np.minimum(self.efficiency * there + self.background, MOST_HITS)), np.float64
        )

    def log_likelihood(self, reading: ArrayLike, mean: ArrayLike) -> Array:
        """log P(k; e m + b)."""
        expected = self.efficiency * np.asarray(mean, np.float64) + self.background
        count = np.asarray(reading, np.float64)
        return np.asarray(count * np.log(expected) - expected - _log_gamma(count + 1.0))

    def entropy(self, mean: ArrayLike, _noise: ArrayLike = 1.0, _cv: ArrayLike = 0.0) -> Array:
        """Entropy of a count at each mean concentration, nats.

        A sum up to MANY expected hits, else the asymptotic series (to 1e-5).
        """
        from plume.numerics import HALF_LOG_2PI, exp_each, log_each  # compiled: the vehicle starts without

        expected = self.efficiency * np.asarray(mean, np.float64) + self.background
        many = np.maximum(expected, MANY)
        series = (
            0.5 * log_each(many)
            + (HALF_LOG_2PI + 0.5)
            - 1 / (12 * many)
            - 1 / (24 * many * many)
            - 19 / (360 * many * many * many)
        )
        few = np.minimum(expected, MANY)
        probability = exp_each(-few)
        log_factorial, summed = np.zeros(()), few - few * log_each(few)
        for count in range(1, 4 * MANY):
            probability = probability * few / count
            log_factorial = log_factorial + log_each(count)
            summed = summed + probability * log_factorial
        return np.where(expected > MANY, series, summed)

    def is_noisy(self, _reading: float) -> bool:
        """True if noise makes two bit-identical readings of this value in a row practically impossible."""
        return False

    def refusal(self, reading: float, greatest_mean: float) -> str | None:
        """Reason why this sensor cannot give this reading; None if it can.

        No concentration exceeds `greatest_mean`, g/m³.
        """
        expected = self.efficiency * greatest_mean + self.background
        high = math.ceil(expected + SURPRISE * math.sqrt(expected) + SURPRISE)
        whole = math.isfinite(reading) and reading == int(reading)
        return (
            None
            if whole and 0 <= reading <= high
            else f"gas {reading:g} is absurd; allowed is a count of hits from 0 to {high}"
        )
