"""A real browser for the tests of the page: one for each file of them; what it shows is kept as
screenshots.
"""

import io
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.system.conftest import start as start
from tests.view.browser import MISSING, found, launched
from tests.view.stage import Stage

SCREENSHOTS = Path(__file__).parents[2] / "test-screenshots"
DESK, PHONE = (1280, 800), (360, 640)
CUT = "WebSocket connection to"
"""What the browser itself writes to its console where a connection fails."""


class Window:
    """A window of the browser with the page in it."""

    def __init__(self, page: Any, address: str) -> None:
        self.page = page
        self.errors: list[str] = []
        self.asked: list[str] = []
        page.on("console", lambda said: self.errors.append(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("request", lambda request: self.asked.append(request.url))
        page.on("websocket", lambda socket: self.asked.append(socket.url))
        self.address = address
        page.goto(address)

    def of(self, script: str) -> Any:
        """The value of an expression on the page."""
        return self.page.evaluate(script)

    def until(self, script: str, timeout_s: float = 120.0) -> Any:
        """Wait until an expression on the page is true; returns its value."""
        deadline = time.monotonic() + timeout_s
        while not (value := self.of(script)):
            if time.monotonic() > deadline:
                pytest.fail(
                    f"not true within {timeout_s:g} s on the page: {script}; errors: {self.errors}; state: "
                    f"{self.of(STATE)}"
                )
            self.page.wait_for_timeout(10)
        return value

    def model(self, part: str, vehicle: str = "uav/1") -> Any:
        """A part of what the page knows of a vehicle, such as `scene.time_s`."""
        return self.of(f"plumeward.state.models['{vehicle}']?.{part}")

    def text(self, selector: str) -> str:
        return self.page.locator(selector).first.inner_text()

    def drawn(self) -> int:
        """Wait for the next frame to be drawn; returns the number of the last scene."""
        return self.of(
            "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => "
            "done(plumeward.drawn))))"
        )

    def pixel(
        self, x: float, y: float, aside: tuple[int, int] = (0, 0), vehicle: str = "uav/1"
    ) -> tuple[int, int, int]:
        """The colour of the map at a place in m, so many px to the right and up."""
        return tuple(
            self.of(f"""(() => {{
                const {{ map }} = plumeward.panes.get('{vehicle}'), {{ view, ratio }} = map;
                const at = [view.x({x}) + {aside[0]}, view.y({y}) - {aside[1]}].map((px) => Math.round(px * ratio));
                return [...map.canvas.getContext('2d').getImageData(...at, 1, 1).data.slice(0, 3)];
            }})()""")
        )

    def count(self, colour: str, box: tuple[float, float, float, float], vehicle: str = "uav/1") -> int:
        """How many pixels of a box on the map, (west, south, east, north) in m, are nearer to a colour
        than to the card beneath.
        """
        west, south, east, north = box
        return self.of(f"""(() => {{
            const {{ map }} = plumeward.panes.get('{vehicle}'), {{ view, ratio }} = map;
            const [x, y, width, height] = [view.x({west}), view.y({north}), ({east - west}) * view.scale, ({north - south}) * view.scale];
            const {{ data }} = map.canvas.getContext('2d').getImageData(...[x, y, width, height].map((px) => Math.round(px * ratio)));
            const rgb = (name) => {{
                const probe = document.body.appendChild(document.createElement('i'));
                probe.style.color = `var(--${{name}})`;
                const found = getComputedStyle(probe).color.match(/\\d+/g).map(Number);
                probe.remove();
                return found;
            }};
            const wanted = rgb('{colour}'), card = rgb('card');
            const far = (one, i) => Math.hypot(...one.map((value, k) => value - data[i + k]));
            let found = 0;
            for (let i = 0; i < data.length; i += 4) found += far(wanted, i) < far(card, i) && far(wanted, i) < 90;
            return found;
        }})()""")

    def narrow_enough(self) -> bool:
        """Whether nothing reaches beyond the window's sides."""
        return self.of("document.documentElement.scrollWidth <= innerWidth")

    def keep(self, name: str, *, whole: bool = False) -> None:
        """Keep a screenshot for people to look at."""
        SCREENSHOTS.mkdir(exist_ok=True)
        self.page.screenshot(path=SCREENSHOTS / f"{name}.png", full_page=whole)

    def picture(self) -> Any:
        """A screenshot, as an image of Pillow."""
        return Image.open(io.BytesIO(self.page.screenshot()))

    def violations(self) -> list[str]:
        """What axe-core finds that hinders people."""
        from axe_playwright_python.sync_playwright import Axe

        self.until(
            "document.getAnimations().length === 0"
        )  # half-way from one colour to another, the contrast is nobody's
        found = Axe().run(self.page).response["violations"]
        return [
            f"{each['id']}: {node['html'][:150]} {node.get('failureSummary', '')}"
            for each in found
            for node in each["nodes"]
        ]


STATE = (
    "JSON.stringify({...plumeward.state, models: Object.keys(plumeward.state.models), vehicles: "
    "plumeward.state.vehicles.length})"
)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Headless Chromium, with a profile of its own. It goes with its module: as long as it lives, no other
    test can run an event loop.
    """
    if found() is None:
        if os.environ.get("CI"):
            pytest.fail(MISSING)
        pytest.skip(MISSING)
    with launched() as chromium:
        yield chromium


@pytest.fixture
def look(browser: Any) -> Iterator[Callable[..., Window]]:
    """Open the page in a window of its own. At the end no window may have had an error, nor asked any
    other server.
    """
    contexts, windows = [], []

    def opened(address: str, size: tuple[int, int] = DESK, scheme: str = "light", **more: Any) -> Window:
        context = browser.new_context(
            viewport={"width": size[0], "height": size[1]}, color_scheme=scheme, **more
        )
        contexts.append(context)
        windows.append(Window(context.new_page(), address))
        return windows[-1]

    yield opened
    for window in windows:
        host = window.address.split("/")[2]
        assert [error for error in window.errors if CUT not in error] == []
        assert {url.split("/")[2] for url in window.asked} == {host}
    for context in contexts:
        context.close()


@pytest.fixture
def stage() -> Iterator[Stage]:
    """The server of the page, with nobody on it."""
    opened = Stage()
    opened.open()
    yield opened
    opened.close()
