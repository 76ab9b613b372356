"""The network of a learned policy, evaluated in a fixed order.

It is bit-identical on every machine, unlike an inference engine.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plume.compiled import kernel
from plume.numerics import exp

Row = NDArray[np.float32]
NO_WEIGHTS, NO_BIASES = np.empty((0, 0), np.float32), np.empty(0, np.float32)


class Layer(NamedTuple):
    """A layer: Gemm multiplies by weights and adds biases, Relu and Tanh change each number by itself."""

    operator: str
    weights: NDArray[np.float32] = NO_WEIGHTS  # (F, A), of a Gemm
    biases: Row = NO_BIASES  # (A,)
    scale: float = 1.0  # factor on the products


@kernel("float32[::1](float32[::1], float32[:, ::1], float32[::1], float32)")
def _product(row: Row, weights: NDArray[np.float32], biases: Row, scale: float) -> Row:
    """scale · row @ weights + biases, all in float32, added in the order of the row."""
    takes, gives = weights.shape
    result = np.zeros(gives, np.float32)
    whole = takes - takes % 4
    for i in range(0, whole, 4):  # four at a time: the sums are read and written less often
        a, b, c, d = row[i], row[i + 1], row[i + 2], row[i + 3]
        for j in range(gives):
            result[j] = (
                ((result[j] + a * weights[i, j]) + b * weights[i + 1, j]) + c * weights[i + 2, j]
            ) + d * weights[i + 3, j]
    for i in range(whole, takes):
        for j in range(gives):
            result[j] += row[i] * weights[i, j]
    for j in range(gives):
        result[j] = scale * result[j] + biases[j]
    return result


@kernel("float32[::1](float32[::1])")
def _tanh(row: Row) -> Row:
    result = np.empty_like(row)
    for i in range(len(row)):
        x = float(row[i])
        power = exp(-2.0 * abs(x))
        size = (1.0 - power) / (1.0 + power)
        result[i] = size if x >= 0 else -size if x < 0 else x  # NaN stays NaN
    return result


def said(layers: Sequence[Layer], row: Row) -> Row:
    """Return the network's output (A,) for a row of numbers (F,)."""
    for operator, weights, biases, scale in layers:
        if operator == "Gemm":
            row = _product(row, weights, biases, scale)
        else:
            row = _tanh(row) if operator == "Tanh" else np.maximum(row, np.float32(0))
    return row
