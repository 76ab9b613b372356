"""Numbers that Python callers give: what is allowed is said as the commands say it."""

import math
import reprlib
from typing import Any

import numpy as np


def whole(name: str, value: Any, low: int, high: float = math.inf) -> int:
    """Return an argument that is a whole number within these limits. Raises ValueError."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not low <= value <= high:
        limit = "" if high == math.inf else f" to {high}"
        raise ValueError(f"{name} {short(value)} is not allowed; wanted a whole number from {low}{limit}")
    return int(value)


def number(name: str, value: Any, low: float, high: float, *, above: bool = False) -> float:
    """Return an argument that is a number from low, or above low, to high. Raises ValueError."""
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not is_number or not low <= value <= high or (above and value == low):
        limit = "above" if above else "from"
        raise ValueError(
            f"{name} {short(value)} is not allowed; wanted a number {limit} {low:g} up to {high:g}"
        )
    return float(value)


def short(value: Any) -> str:
    """Return a value as Python writes it, in one short line."""
    return " ".join(reprlib.repr(value).split())
