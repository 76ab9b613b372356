"""Gas sensors: each class defines both how readings are drawn and their likelihood."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plume.randomness import Draws

Array = NDArray[np.float64]
# A reading this many standard deviations beyond what the strongest plume could give is absurd.
SURPRISE = 10.0
MANY = 12  # above this many expected hits, their entropy is computed by its asymptotic series

_erf = np.vectorize(math.erf, otypes=[np.float64])
_log_gamma = np.vectorize(math.lgamma, otypes=[np.float64])


def normal_cdf(value: ArrayLike) -> Array:
    """P(Z ≤ value) of a standard normal variable."""
    return np.asarray(0.5 * (1.0 + _erf(np.asarray(value) / math.sqrt(2.0))))


def fluctuating(mean: Array, cv: float, rng: Draws) -> Array:
    """Draw the concentration around each mean, g/m³.

    It is gamma-distributed with this coefficient of variation; the mean itself if that is 0.
    """
    return mean * rng.standard_gamma(1 / (cv * cv), mean.shape) * (cv * cv) if cv > 0 else mean


def _gamma_and_normal(reading: Array, mean: Array, std: Array, cv: float) -> Array:
    """Log-density of c + v at each reading: c is gamma with this mean and cv, v ~ N(0, std²).

    A numerical integral over c. It is taken by parts, since for a shape below 1 the gas piles up at 0.
    """
    reading, mean, std = np.broadcast_arrays(reading, mean, std)
    shape, scale = 1 / (cv * cv), np.maximum(mean, 1e-12 * std) * (cv * cv)
    peak = (shape + 1) * scale
    spread = 40 * np.sqrt(shape + 1) * scale
    far = np.linspace(-45 / (shape + 1) - 3, 0.0, 2001)  # of log c
    near = np.linspace(
        -12.0, 12.0, 2001
    )  # of standard deviations around the reading, and of shares of the gamma's spread
    ends = np.maximum(peak + spread, reading + 12 * std)
    nodes = [ends[..., None] * np.exp(far), np.maximum(reading[..., None] + std[..., None] * near, 0.0)]
    c = np.sort(
        np.concatenate([*nodes, np.maximum(peak[..., None] + spread[..., None] / 12 * near, 0.0)], axis=-1),
        axis=-1,
    )
    gap = (reading[..., None] - c) / std[..., None]
    exponent = shape * np.log(np.maximum(c, 1e-300)) - c / scale[..., None] - 0.5 * gap * gap
    top = exponent.max(axis=-1)
    # c^(k−1) = (c^k)'/k, so the integral is that of c^k / k times the negative derivative of the rest.
    slope = 1 / scale[..., None] - gap / std[..., None]
    total = np.trapezoid(slope * np.exp(exponent - top[..., None]), c, axis=-1)
    constant = (
        math.log(shape) + math.lgamma(shape) + shape * np.log(scale) + np.log(std) + 0.5 * np.log(2 * np.pi)
    )
    return np.asarray(np.log(np.maximum(total, 1e-300)) + top - constant)


@dataclass(frozen=True)
class Gaussian:
    """The paper's sensor: z = m + v, v ~ N(0, σ²), σ² = (α m)² + β².

    The two noises are independent and add in quadrature.
    """

    sensor_noise: float = 0.3  # α: standard deviation as a share of the concentration
    environment_noise: float = 0.2  # β: standard deviation in clean air, g/m³; above 0
    # Intermittency: coefficient of variation of the gas, up to GREATEST_CV; 0 is steady gas. The
    # concentration c is then gamma-distributed around the plume's mean with shape k = 1/cv² and scale m/k,
    # independent from reading to reading, and z = c + v.
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
        error = np.asarray(noise) * self.noise_std(mean) * rng.standard_normal(mean.shape)
        there = (
            fluctuating(mean, self.cv, rng)
            if concentration is None
            else np.asarray(concentration, np.float64)
        )
        return np.asarray(there + error)

    def log_likelihood(self, reading: ArrayLike, mean: ArrayLike) -> Array:
        """log N(z; m, σ(m)²) with its normaliser, which differs between hypotheses because σ depends on m.

        In intermittent gas that of the sum of a gamma-distributed concentration and the noise, by
        numerical integration over the gas.
        """
        std = self.noise_std(mean)
        if self.cv > 0:
            return _gamma_and_normal(
                np.asarray(reading, np.float64), np.asarray(mean, np.float64), std, self.cv
            )
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
