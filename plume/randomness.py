"""Keyed randomness: every draw is a function of (seed, stream, step) alone.

It depends on no clock, process, batch or thread.
"""

from collections.abc import Callable, Sequence
from functools import cache
from hashlib import blake2b

import numpy as np

from plume.elementary import Array, Indices

MAX_SEED = 2**63 - 1
EXACT_WITHIN = 3.65  # beyond it NumPy's normal draws are not a product of exact numbers


@cache
def _word(text: str) -> int:
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little")


def keyed(seed: int, stream: str, step: int = 0) -> np.random.Generator:
    """Return the generator of one (seed, stream, step): counter-based Philox, so all are independent."""
    return np.random.Generator(
        np.random.Philox(key=np.array([seed, _word(stream)], np.uint64), counter=[0, 0, step, 0])
    )


class Keyed:
    """One generator that can be set to any key: the draws of `keyed` in a fifth of the time."""

    def __init__(self) -> None:
        self._bits = np.random.Philox(0)
        self._generator = np.random.Generator(self._bits)
        self._state = self._bits.state

    def at(self, seed: int, stream: str, step: int = 0) -> np.random.Generator:
        """Return the generator, at the beginning of this (seed, stream, step).

        It is valid until the next call.
        """
        self._state["state"]["key"][:] = seed, _word(stream)
        self._state["state"]["counter"][:] = 0, 0, step, 0
        self._bits.state = self._state
        return self._generator


def uniform(rng: np.random.Generator, low: Array, high: Array | float) -> Array:
    """Draw uniformly between `low`, an array, and `high`.

    The rounding of the generator's own method depends on the processor.
    """
    return low + (high - low) * rng.random(low.shape)


def standard_normal(rng: np.random.Generator, size: int) -> Array:
    """Draw N(0, 1), the 0.03% beyond ±EXACT_WITHIN to 9 digits: NumPy takes them from the C library's log."""
    drawn = rng.standard_normal(size)
    return np.where(np.abs(drawn) > EXACT_WITHIN, np.rint(drawn * 2.0**30) / 2.0**30, drawn)


def standard_gamma(rng: "np.random.Generator | Alike", shape: Array | float, size: tuple[int, ...]) -> Array:
    """Draw gamma variables of scale 1, float32 values.

    How NumPy rounds them depends on the compiler that built it.
    """
    return rng.standard_gamma(shape, size).astype(np.float32).astype(np.float64)


def inverse_gaussian(square: float | Array, rng: "Draws", size: tuple[int, ...]) -> Array:
    """Draw inverse Gaussian variables of mean 1 and this squared coefficient of variation.

    As Michael, Schucany and Haas 1976: the smaller root of a quadratic, or the inverse of it.
    """
    half = 0.5 * square * np.square(rng.standard_normal(size))
    smaller = 1 / (1 + half + np.sqrt(half * (2 + half)))
    return np.where(rng.random(size) * (1 + smaller) < 1, smaller, 1 / smaller)


class Abreast:
    """Several keyed generators side by side, one for each element of an array.

    Each element is bit-identical to drawing it alone.
    """

    def __init__(self, keyed: Keyed, keys: Sequence[tuple[int, str, int]]) -> None:
        """Take a (seed, stream, step) for each element of the arrays (M,) to draw.

        `keyed` is set to one after the other.
        """
        self._keyed = keyed
        self._keys = keys
        self._draws: list[Callable[[np.random.Generator, int], float]] = []

    def _drawn(self, draw: Callable[[np.random.Generator, int], float]) -> list[float]:
        """Draw once more from each key.

        Its earlier draws are repeated first, to bring the shared generator to the right state.
        """
        *before, last = self._draws = [*self._draws, draw]
        numbers = []
        for number, key in enumerate(self._keys):
            generator = self._keyed.at(*key)
            for each in before:
                each(generator, number)
            numbers.append(last(generator, number))
        return numbers

    def standard_normal(self, _size: tuple[int, ...], /) -> Array:
        """(M,) of N(0, 1)."""
        return np.array(self._drawn(lambda generator, _: generator.standard_normal()))

    def random(self, _size: tuple[int, ...], /) -> Array:
        """(M,) of U[0, 1)."""
        return np.array(self._drawn(lambda generator, _: generator.random()))

    def standard_gamma(self, shape: float, _size: tuple[int, ...], /) -> Array:
        """(M,) gamma variables of this shape and scale 1."""
        return np.array(self._drawn(lambda generator, _: generator.standard_gamma(shape)))

    def poisson(self, lam: Array, /) -> Indices:
        """(M,) Poisson counts with means `lam` (M,)."""
        return np.array(self._drawn(lambda generator, number: generator.poisson(lam[number])), np.int64)


class Alike:
    """A generator for arrays (A, K) whose rows share their random numbers: each row is as if drawn alone.

    How many random numbers a count takes depends on its mean: after counts only counts may be drawn.
    """

    def __init__(self, bits: np.random.Philox, rows: int) -> None:
        """Take the generator's bits: the draws of each of the `rows` go on from there."""
        self._bits, self._generator = bits, np.random.Generator(bits)
        self._states = [bits.state] * rows

    def standard_normal(self, size: tuple[int, ...], /) -> Array:
        """(A, K) of N(0, 1)."""
        return np.broadcast_to(self._generator.standard_normal(size[1:]), size)

    def random(self, size: tuple[int, ...], /) -> Array:
        """(A, K) of U[0, 1)."""
        return np.broadcast_to(self._generator.random(size[1:]), size)

    def standard_gamma(self, shape: Array | float, size: tuple[int, ...], /) -> Array:
        """(K,) gamma variables of these shapes (K,) and scale 1, for all rows."""
        return self._generator.standard_gamma(shape, size[1:])

    def poisson(self, lam: Array, /) -> Indices:
        """(A, K) Poisson counts with means `lam` (A, K)."""
        counts = []
        for row, means in enumerate(lam):
            self._bits.state = self._states[row]
            counts.append(self._generator.poisson(means))
            self._states[row] = self._bits.state
        return np.array(counts, np.int64)


Draws = np.random.Generator | Abreast | Alike  # a source of noise


def derived_seed(seed: int, purpose: str) -> int:
    """Return a service's seed: a one-way hash, which does not reveal the mission's seed.

    The source could be drawn from that.
    """
    return _word(f"{seed}/{purpose}") & MAX_SEED


def seed_of(seed: int, vehicle: int) -> int:
    """Return the seed of a vehicle's own draws, of a fleet: the first one's is that of a vehicle alone."""
    return seed if vehicle == 1 else derived_seed(seed, f"vehicle {vehicle}")
