"""How old a scene is when the page has drawn it, and how long a record takes to open, in headless
Chromium: `python -m benchmarks.page`.

A mission's scenes change many times a second, each with new particles; the server sends them as it does
live. With several vehicles each has as many scenes a second, and the page shows them all. The age is the time
from publication until the frame with the scene was drawn, by one clock. A record
is opened as from a shell: from the start of `plumeward view LOG` until its last scene is drawn.
"""

import argparse
import json
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.view.browser import launched
from tests.view.stage import Stage, cloud, measured, scene

READINGS_S = 1.0
"""Time between two readings: the charts are drawn anew."""
WARM_UP_S = 1.0
RECORD_STEPS = 300
TIMES = 5
"""How often the record is opened."""


def measure(
    particles: int, rate_hz: float, duration_s: float, scheme: str, size: tuple[int, int], vehicles: int = 1
) -> dict[str, float]:
    """Return the figures of one window."""
    stage = Stage()
    stage.open()
    try:
        names = [f"search/1/uav/{number}" for number in range(1, vehicles + 1)]
        actors = [stage.enter(scene(name, particles=particles), "search/1") for name in names]
        with launched() as browser:
            page = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)
            page.goto(stage.address)
            clouds = [cloud(particles, (15.0, 15.0), 20.0, step) for step in range(20)]
            began, sent = time.perf_counter(), 0
            before = 0
            while (passed_s := time.perf_counter() - began) < WARM_UP_S + duration_s:
                if passed_s >= WARM_UP_S and not before:
                    page.evaluate("plumeward.latencies_ms.length = 0")
                    before = page.evaluate("plumeward.drawn")
                count = 6 + int(passed_s / READINGS_S)
                for number, actor in enumerate(actors):
                    assert actor.newest.craft
                    craft = replace(actor.newest.craft, position=(3.0 * number, 12.0 + passed_s % 10.0))
                    now = replace(
                        actor.newest, time_s=passed_s, craft=craft, scatter=clouds[sent % len(clouds)]
                    )
                    if count > len(now.measurements):
                        now = replace(now, measurements=(*now.measurements, measured(count - 1, 3.0)))
                    actor.show(now)
                sent += 1
                page.wait_for_timeout(max(1000 * (began + sent / rate_hz - time.perf_counter()), 0))
            page.wait_for_timeout(200)
            ages_ms = np.array(page.evaluate("plumeward.latencies_ms"))
            drawn = page.evaluate("plumeward.drawn") - before
    finally:
        stage.close()
    middle, late, latest = np.percentile(ages_ms, (50, 95, 100))
    return {
        "median_ms": float(middle),
        "p95_ms": float(late),
        "most_ms": float(latest),
        "sent_per_s": sent / (WARM_UP_S + duration_s),
        "drawn_per_s": drawn / duration_s,
    }


def opening() -> list[float]:
    """Fly a mission of RECORD_STEPS steps that does not cease, and return how long its record took to open
    each time, s.
    """
    plumeward = [sys.executable, "-m", "sitl"]
    with tempfile.TemporaryDirectory() as folder, launched() as browser:
        log = str(Path(folder) / "log.mcap")
        flown = [
            "--policy",
            "random",
            "--threshold",
            "0.0001",
            "--budget",
            str(RECORD_STEPS),
            "--speedup",
            "0",
            "--record",
            log,
        ]
        subprocess.run([*plumeward, "fly", *flown], check=True, capture_output=True, cwd=folder)
        found = []
        for _ in range(TIMES):
            began = time.perf_counter()
            server = subprocess.Popen(
                [*plumeward, "view", log, "--port", "0"], stdout=subprocess.PIPE, text=True
            )
            assert server.stdout
            with browser.new_context() as context:
                page = context.new_page()
                page.goto(server.stdout.readline().removeprefix("page at ").strip())
                while not page.evaluate("window.plumeward?.drawn"):
                    page.wait_for_timeout(5)
                found.append(time.perf_counter() - began)
                assert (
                    page.evaluate("Object.values(plumeward.state.models)[0].measurements.length")
                    == RECORD_STEPS + 1
                )
            server.send_signal(signal.SIGINT)
            server.wait()
    return found


def main() -> None:
    """Print a line for each window, and one for the record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--particles", type=int, default=4000)
    parser.add_argument("--rate", type=float, default=20.0, help="updates a second")
    parser.add_argument("--vehicles", type=int, default=1, help="of one search")
    parser.add_argument("--duration", type=float, default=15.0, help="s")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    found = {}
    for name, scheme, size in (
        ("desk", "light", (1280, 800)),
        ("large, dark", "dark", (1920, 1080)),
        ("phone", "light", (360, 640)),
    ):
        found[name] = figures = measure(args.particles, args.rate, args.duration, scheme, size, args.vehicles)
        ages = (
            f"median {figures['median_ms']:5.1f} ms, 95% {figures['p95_ms']:5.1f} ms, most "
            f"{figures['most_ms']:6.1f} ms"
        )
        print(
            f"{name:12} age when drawn: {ages}; {figures['sent_per_s']:.1f} updates a second, "
            f"{figures['drawn_per_s']:.1f} drawn",
            flush=True,
        )
    opened_s = opening()
    print(
        f"a record of {RECORD_STEPS} steps opens in {statistics.median(opened_s):.2f} s, at most "
        f"{max(opened_s):.2f} s, of {TIMES} times"
    )
    if args.json:
        print(
            json.dumps(
                {"particles": args.particles, "rate_hz": args.rate, "windows": found, "opened_s": opened_s}
            )
        )


if __name__ == "__main__":
    main()
