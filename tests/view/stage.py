"""A stage for the page: the real server with hand-made scenes, in a thread of the test's process."""

import asyncio
import math
import socket
import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np

from ground.view.access import AccessRules
from ground.view.server import LONGEST_MESSAGE, PageServer
from ground.view.serving import server_of
from scene.scene import (
    Backdrop,
    Condition,
    Craft,
    Ending,
    Floats,
    Gauge,
    Happening,
    Measurement,
    Release,
    Scatter,
    Scene,
    Service,
)

RELEASE = Release(source=(24.0, 6.0), wind=(-3.0, -4.0), q=10.0, d=1.0, tau=10.0)
"""Its wind of 5 m/s comes from the south-west: from 216.87°."""


def measured(
    step: int, spread_m: float, gas: float = 1.0, estimate: tuple[float, float] = (10.0, 20.0)
) -> Measurement:
    """A reading each second, each half a metre further to the east."""
    return Measurement(
        step,
        float(step),
        (2.0 + 0.5 * step, 4.0),
        gas,
        spread_m,
        estimate,
        (4.0, 0.0, 1.0),
        radius_95_m=1.5 * spread_m,
        rate=(50.0, 90.0, 160.0),
        wind=RELEASE.wind,
        evidence=float(step),
        effective_sample_size=200.0,
    )


def cloud(
    count: int, middle: tuple[float, float] = (20.0, 25.0), size_m: float = 4.0, step: int = 0
) -> Scatter:
    """Particles of even weight in a square."""
    places: Floats = (
        np.random.default_rng(step).uniform(-size_m / 2, size_m / 2, (count, 2)).astype(np.float32)
    )
    return Scatter(places + np.array(middle, np.float32), np.full(count, 1 / count, np.float32))


def scene(vehicle: str = "uav/1", steps: int = 6, particles: int = 400) -> Scene:
    """A search half done: nothing lies on anything else, so that each thing can be looked for."""
    return Scene(
        Backdrop(vehicle, title=f"by hand, {vehicle}", release=RELEASE),
        time_s=float(steps),
        craft=Craft(
            float(steps),
            (6.0, 12.0),
            altitude_m=5.0,
            heading=0.0,
            mode="OFFBOARD",
            armed=True,
            condition=Condition(
                battery=0.62, volts=15.43, gps="3-D fix, 10 satellites", ailing=(), placed=True
            ),
            speed_mps=2.0,
        ),
        track=np.array([[2.0, 4.0], [6.0, 4.0], [6.0, 12.0]], np.float32),
        measurements=tuple(measured(step, 8.0 * 0.8**step) for step in range(steps)),
        scatter=cloud(particles),
        waypoint=(14.0, 12.0),
        wind=RELEASE.wind,
        stop="spread:0.5",
        assume="field",
        services=(
            Service("uav", "ok", "searching", "", 5, 0.012),
            Service("estimator", "refusing", "ready", "", 5, 0.034, ("hot",)),
        ),
        happenings=(Happening(0.5, "info", "uav", "armed"), Happening(3.0, "warning", "estimator", "hot")),
        home=(51.4494, -2.6023, 80.0),
        silent_s=0.1,
        gauge=Gauge("g/m³", (0.4, 1.2, 4.0, 12.0, 40.0)),
    )


def states() -> dict[str, Scene]:
    """What an operator may find on the page."""
    healthy = (
        Service("uav", "ok", "searching", "", 5, 0.012),
        Service("estimator", "ok", "ready", "4000 particles", 5, 0.034),
        Service("agent", "ok", "ready", "homing", 5, 0.002),
    )
    live = replace(scene(), services=healthy)
    craft, last = live.craft, live.measurements[-1]
    assert craft
    ailing = replace(craft.condition, battery=0.11, gps="no fix, 3 satellites", ailing=("gps",), placed=False)
    last = replace(last, spread_m=0.45, radius_95_m=0.8, covariance=(0.1, 0.0, 0.1))
    return {
        "live": live,
        "paused": replace(
            live,
            craft=replace(craft, mode="HOLD", speed_mps=0.0),
            services=(replace(healthy[0], state="paused"), *healthy[1:]),
            happenings=(*live.happenings, Happening(5.0, "warning", "uav", GIVES_WAY)),
        ),
        "warned": replace(
            live,
            craft=replace(craft, condition=ailing),
            services=(*healthy[:2], replace(healthy[2], verdict="missing")),
            happenings=(*live.happenings, Happening(5.0, "error", "uav", "Battery is low: 11%")),
        ),
        "found": replace(
            live,
            measurements=(*live.measurements[:-1], last),
            scatter=cloud(400, (10.0, 20.0), 0.9),
            waypoint=None,
            ending=Ending("located", "source found at (10.00, 20.00) ± 0.45 m after 5 steps; error 0.21 m"),
        ),
        "doubtful": replace(
            live, measurements=(*live.measurements[:-1], replace(live.measurements[-1], p_value=1e-6))
        ),
    }


GIVES_WAY = "Search gives way: HOLD by 255/190 on the bus"


class Actor:
    """A vehicle whose scene is what the test sets."""

    def __init__(self, stage: "Stage", shown: Scene, search: str) -> None:
        self.name = shown.backdrop.vehicle
        self.search = search or self.name
        self.version = 0
        self.here = True
        self.published_ms = 1000 * time.time()
        self._stage, self._scene, self._history = stage, shown, object()

    def entry(self) -> dict[str, Any]:
        backdrop = self._scene.backdrop
        return {
            "name": self.name,
            "search": self.search,
            "title": backdrop.title,
            "here": self.here,
            "has_truth": backdrop.release is not None,
            "begin_s": None,
            "end_s": None,
            "readings_s": None,
            "moments": None,
        }

    def scene(self, at_s: float | None = None) -> tuple[Scene, object, float | None]:
        return self._scene, self._history, self.published_ms

    def show(self, shown: Scene | None = None, **changes: Any) -> None:
        """Change what there is to see."""
        self._scene = replace(self._scene if shown is None else shown, **changes)
        self.published_ms = 1000 * time.time()
        self.version += 1
        self._stage.news()

    @property
    def newest(self) -> Scene:
        return self._scene


class Served:
    """The page of some vehicles, served by a thread."""

    def __init__(self, shown: Any, host: str = "127.0.0.1", token: str = "") -> None:
        self._shown, self._token = shown, token
        self._host, self.port = host, 0
        self._loop: asyncio.AbstractEventLoop | None = None

    def news(self) -> None:
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._server.news)

    def bye(self, words: str) -> None:
        self._server.bye = words
        self.news()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    def open(self) -> None:
        """Serve, on the same port as before."""
        self._listening = socket.create_server((self._host, self.port))
        self.port = self._listening.getsockname()[1]
        self._server = PageServer(self._shown, AccessRules(self._host, self.port, self._token))
        self._uvicorn = server_of(self._server.app(), LONGEST_MESSAGE, proxied=False)
        ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(ready)))
        self._thread.start()
        assert ready.wait(120)

    def close(self) -> None:
        """Stop serving: connections are cut."""
        self._uvicorn.should_exit = self._uvicorn.force_exit = True
        self._thread.join()
        self._listening.close()
        self._loop = None

    async def _serve(self, ready: threading.Event) -> None:
        self._loop = asyncio.get_running_loop()
        ready.set()
        await self._uvicorn.serve(sockets=[self._listening])


class Stage(Served):
    """The page of vehicles that come, change and go as the test says."""

    def __init__(self, host: str = "127.0.0.1", token: str = "") -> None:
        super().__init__(self, host, token)
        self.vehicles: dict[str, Any] = {}
        self.list_version = 0
        self.notice = ""

    def enter(self, shown: Scene, search: str = "") -> Actor:
        """Let a vehicle appear, in a search by several if it is named."""
        actor = Actor(self, shown, search)
        self.vehicles = {**self.vehicles, actor.name: actor}
        self.relist()
        return actor

    def relist(self) -> None:
        """Tell the page that the list of vehicles, or the notice, has changed."""
        self.list_version += 1
        self.news()


def bearing_deg(wind: tuple[float, float]) -> float:
    """Where a wind comes from, clockwise from north."""
    return math.degrees(math.atan2(wind[0], wind[1])) % 360
