"""Protects how the page looks: at three sizes, in each state that an operator may find it in.

`looks/` keeps what is compared, and can be looked at: a small screenshot of each, and a table of the texts and boxes
of its parts. Fonts and browsers differ, so boxes may be a little off, and pictures are compared by the mean colours
of coarse cells. `python -m tests.view.looks` makes them anew.
"""

import json
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from PIL import Image

from tests.view.conftest import Window
from tests.view.looks import CELLS, KEPT, NAMES, SIZES, Look, cells_of, looked, shown

NEAR_PX = 14  # a box may be off by so many, or by so much of the window
NEAR_SHARE = 0.03
NEAR_COLOUR = 28.0  # mean difference of a cell's colour, of 255
MOST_CELLS = 0.06  # of cells that may differ more: words are elsewhere where a line breaks elsewhere


@pytest.fixture(scope="module")
def table() -> dict[str, Look]:
    return json.loads((KEPT / "looks.json").read_text())


@pytest.fixture
def address(request: pytest.FixtureRequest) -> Iterator[str]:
    with shown(request.param) as served:
        yield served


@pytest.mark.one_in(4)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("name", "address"), [(name, name) for name in NAMES], indirect=["address"], ids=NAMES
)
def test_the_page_looks_as_it_was_last_looked_at(
    name: str, address: str, size: str, look: Callable[..., Window], table: dict[str, Look]
) -> None:
    ((width, height), scheme), key = SIZES[size], f"{name}-{size}"
    window = look(address, (width, height), scheme)
    seen = looked(window, name)
    window.keep(f"look-{key}")
    wanted = table[key]
    assert seen["texts"] == wanted["texts"]
    assert seen["boxes"].keys() == wanted["boxes"].keys()
    for part, box in wanted["boxes"].items():
        for is_, was, whole in zip(seen["boxes"][part], box, (width, height) * 2, strict=True):
            assert abs(is_ - was) <= max(NEAR_PX, NEAR_SHARE * whole), (part, seen["boxes"][part], box)
    kept = cells_of(Image.open(KEPT / f"{key}.png"))
    now = cells_of(window.picture())
    differs = np.abs(kept - now).mean(axis=-1) > NEAR_COLOUR
    assert differs.mean() <= MOST_CELLS, f"{differs.sum()} of {CELLS[0] * CELLS[1]} cells differ"


@pytest.mark.parametrize("name", NAMES)
def test_what_an_operator_needs_is_seen_without_scrolling(name: str, table: dict[str, Look]) -> None:
    for size, ((width, height), _) in SIZES.items():
        boxes = table[f"{name}-{size}"]["boxes"]
        parts = ["sentence", "map", *([] if name == "replay" else ["buttons"])]
        for part in parts:
            x, y, wide, high = boxes[part]
            assert 0 <= x <= width - wide, (part, size)
            assert 0 <= y <= height - high, (part, size)
        *_, wide, high = boxes["map"]
        assert wide * high > 0.4 * width * height, size  # the map is the page
