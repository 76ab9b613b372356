"""A small movie, and what is seen of one through our readers."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plume.recorded.opening import opened

FRAMES = np.arange(5 * 4 * 3, dtype=np.float32).reshape(5, 4, 3)
"""5 frames of 4 rows and 3 columns: pixel (t, j, i) is 12 t + 3 j + i, linear in each."""
BLOSC = {"id": "blosc", "cname": "zstd", "clevel": 3, "shuffle": 1, "blocksize": 0}


def every_pixel(footage: Any) -> np.ndarray:
    """The gas at the centre of each pixel in each frame (t, y, x)."""
    facts = footage.facts
    x, y = (
        low + step * (np.arange(count) + 0.5)
        for low, step, count in zip(facts.low, facts.cell, facts.cells, strict=True)
    )
    t, y, x = (each.ravel() for each in np.meshgrid(np.arange(facts.frames), y, x, indexing="ij"))
    gas = footage.gas(np.column_stack([x, y, 0 * x]), t)
    return gas.reshape(facts.frames, *facts.cells[::-1])


def refused(path: Path) -> str:
    """The line with which a file is refused, without its name."""
    with pytest.raises(ValueError, match=re.escape(f"{path}")) as raised:
        every_pixel(opened(path))
    line = str(raised.value)
    assert len(line.splitlines()) == 1
    return line.removeprefix(f"{path}")
