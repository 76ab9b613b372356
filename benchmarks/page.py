"""How old a scene is when the page has drawn it, in headless Chromium: `python -m benchmarks.page`.

A mission's scenes change many times a second, each with new particles; the server sends them as it does live. The age is the time from
publication until the frame with the scene was drawn, by one clock.
"""

import argparse
import json
import time
from dataclasses import replace

import numpy as np

from tests.view.browser import launched
from tests.view.stage import Stage, cloud, measured, scene

READINGS_S = 1.0
"""Time between two readings: the charts are drawn anew."""
WARM_UP_S = 1.0


def measure(particles: int, rate_hz: float, duration_s: float, scheme: str, size: tuple[int, int]) -> dict[str, float]:
    """Return the figures of one window."""
    stage = Stage()
    stage.open()
    try:
        actor = stage.enter(scene(particles=particles))
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
                now = replace(actor.newest, time_s=passed_s, scatter=clouds[sent % len(clouds)])
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
        "median_ms": float(middle), "p95_ms": float(late), "most_ms": float(latest),
        "sent_per_s": sent / (WARM_UP_S + duration_s), "drawn_per_s": drawn / duration_s,
    }  # fmt: skip


def main() -> None:
    """Print a line for each window."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--particles", type=int, default=4000)
    parser.add_argument("--rate", type=float, default=20.0, help="updates a second")
    parser.add_argument("--duration", type=float, default=15.0, help="s")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    found = {}
    for name, scheme, size in (("desk", "light", (1280, 800)), ("large, dark", "dark", (1920, 1080)), ("phone", "light", (360, 640))):
        found[name] = figures = measure(args.particles, args.rate, args.duration, scheme, size)
        ages = f"median {figures['median_ms']:5.1f} ms, 95% {figures['p95_ms']:5.1f} ms, most {figures['most_ms']:6.1f} ms"
        print(
            f"{name:12} age when drawn: {ages}; {figures['sent_per_s']:.1f} updates a second, {figures['drawn_per_s']:.1f} drawn",
            flush=True,
        )
    if args.json:
        print(json.dumps({"particles": args.particles, "rate_hz": args.rate, "windows": found}))


if __name__ == "__main__":
    main()
