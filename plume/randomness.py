"""Keyed randomness: every draw is a function of (seed, stream, step), never of clock, process, batch or thread."""

from collections.abc import Sequence
from functools import cache
from hashlib import blake2b
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

MAX_SEED = 2**63 - 1


@cache
def _word(text: str) -> int:
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little")


def keyed(seed: int, stream: str, step: int = 0) -> np.random.Generator:
    """Return the generator of one (seed, stream, step); the counter-based Philox makes them independent of each other."""
    return np.random.Generator(np.random.Philox(key=np.array([seed, _word(stream)], np.uint64), counter=[0, 0, step, 0]))


class Keyed:
    """One generator that is set to any (seed, stream, step): the draws of `keyed` in a fifth of the time, for those who need many."""

    def __init__(self) -> None:
        """Begin anywhere."""
        self._bits = np.random.Philox(0)
        self._generator = np.random.Generator(self._bits)
        self._state = self._bits.state

    def at(self, seed: int, stream: str, step: int = 0) -> np.random.Generator:
        """Return the generator, at the beginning of this (seed, stream, step): good until the next call."""
        self._state["state"]["key"][:] = seed, _word(stream)
        self._state["state"]["counter"][:] = 0, 0, step, 0
        self._bits.state = self._state
        return self._generator


class Draws(Protocol):
    """What noise is drawn from: numpy's generator, or many of them `Abreast`."""

    def standard_normal(self, size: tuple[int, ...], /) -> NDArray[np.float64]:
        """N(0, 1)."""

    def random(self, size: tuple[int, ...], /) -> NDArray[np.float64]:
        """U[0, 1)."""

    def poisson(self, lam: NDArray[np.float64], /) -> NDArray[np.int64]:
        """Counts of so many expected."""


class Abreast:
    """Generators side by side: each number of an array is drawn from its own, as if it were drawn alone."""

    def __init__(self, generators: Sequence[np.random.Generator]) -> None:
        """Take a generator for each number of the arrays, (M,), that are asked for."""
        self._generators = generators

    def standard_normal(self, _size: tuple[int, ...], /) -> NDArray[np.float64]:
        """(M,) of N(0, 1)."""
        return np.array([each.standard_normal() for each in self._generators])

    def random(self, _size: tuple[int, ...], /) -> NDArray[np.float64]:
        """(M,) of U[0, 1)."""
        return np.array([each.random() for each in self._generators])

    def poisson(self, lam: NDArray[np.float64], /) -> NDArray[np.int64]:
        """(M,) counts, of so many expected (M,)."""
        return np.array([each.poisson(expected) for each, expected in zip(self._generators, lam, strict=True)])


def derived_seed(seed: int, purpose: str) -> int:
    """One-way seed for a service: it makes its own draws repeatable and does not tell the mission's seed, hence not the source."""
    return _word(f"{seed}/{purpose}") & MAX_SEED
