"""The looks of the page that `test_looks` compares. `python -m tests.view.looks` makes them anew; look at them then."""

import contextlib
import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from PIL import Image

from ground.view.records import RecordedFleet
from tests.view.browser import launched
from tests.view.conftest import DESK, PHONE, Window
from tests.view.stage import Served, Stage, states

KEPT = Path(__file__).with_name("looks")
RECORD = Path(__file__).parents[1] / "golden" / "homing-gaussian-field.mcap"
SIZES = {"1280": (DESK, "light"), "1920": ((1920, 1080), "dark"), "360": (PHONE, "light")}
NAMES = ("live", "paused", "warned", "found", "doubtful", "four", "replay")
CELLS = (32, 20)
PATIENCE_MS = 120_000.0  # the machine may be busy
WIDEST = 480  # px of a kept picture
PARTS = {
    "sentence": ".sentence",
    "notes": ".notes",
    "map": ".map canvas",
    "buttons": ".buttons",
    "facts": ".facts",
    "charts": ".charts",
}
TEXTS = (".sentence", ".notes", ".facts dd", "[data-command]")


class Look(TypedDict):
    """How the page looks."""

    texts: list[str]  # of what is seen, in order
    boxes: dict[str, tuple[int, int, int, int]]  # x, y, width and height of each part, px


@contextlib.contextmanager
def shown(name: str) -> Iterator[str]:
    """Serve the page in a state; yields its address."""
    if name == "replay":
        served: Served = Served(RecordedFleet([RECORD]))
        served.open()
    else:
        served = Stage()
        served.open()
        made = states()["live" if name == "four" else name]
        for i in range(4 if name == "four" else 1):
            (x, y), craft = (6.0 + 5 * i, 12.0 - 2 * i), made.craft
            served.enter(
                made
                if name != "four" or craft is None
                else replace(
                    made,
                    backdrop=replace(made.backdrop, vehicle=f"uav/{i + 1}"),
                    craft=replace(craft, position=(x, y)),
                    track=made.track + np.array([5 * i, -2 * i], np.float32),
                    waypoint=(x + 6.0, y + 2.0),
                )
            )
    try:
        yield served.address
    finally:
        served.close()


def looked(window: Window, name: str) -> Look:
    """Wait until all is drawn, and return how it looks."""
    window.until(
        "plumeward.drawn > 0 && document.querySelector('.map canvas') && plumeward.state.show.length"
    )
    if name == "four":
        window.until("Object.values(plumeward.state.models).filter(({ scene }) => scene).length === 4")
    window.until("plumeward.panes.get(plumeward.state.show[0]).map.view")
    window.drawn()
    texts = window.of(
        f"[...document.querySelectorAll({json.dumps(', '.join(TEXTS))})].filter((one) => one.checkVisibility())"
        ".map((one) => one.innerText)"
    )
    boxes = window.of(
        f"Object.fromEntries(Object.entries({json.dumps(PARTS)}).map(([name, selector]) => "
        "[name, document.querySelector(selector)?.getBoundingClientRect()]).filter(([, box]) => box?.width)"
        ".map(([name, { x, y, width, height }]) => [name, [x, y, width, height].map(Math.round)]))"
    )
    return {"texts": texts, "boxes": boxes}


def cells_of(image: Any) -> Any:
    """Return the mean colours of coarse cells, (20, 32, 3)."""
    return np.asarray(image.convert("RGB").resize(CELLS, Image.Resampling.BOX), np.float64)


def main() -> None:
    """Make all looks anew."""
    KEPT.mkdir(exist_ok=True)
    table: dict[str, Look] = {}
    with launched() as chromium:
        for name in NAMES:
            with shown(name) as address:
                for size, ((width, height), scheme) in SIZES.items():
                    context = chromium.new_context(
                        viewport={"width": width, "height": height}, color_scheme=scheme
                    )
                    context.set_default_timeout(PATIENCE_MS)
                    window = Window(context.new_page(), address)
                    table[f"{name}-{size}"] = looked(window, name)
                    picture = Image.open(io.BytesIO(window.page.screenshot())).convert("RGB")
                    picture.thumbnail((WIDEST, 10 * WIDEST), Image.Resampling.LANCZOS)
                    picture.quantize(128).save(KEPT / f"{name}-{size}.png", optimize=True)
                    context.close()
    text = json.dumps(table, indent=1, ensure_ascii=False)
    (KEPT / "looks.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
