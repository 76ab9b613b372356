"""Headless Chromium of this machine, with a profile of its own."""

import contextlib
import shutil
from collections.abc import Callable, Iterator
from typing import Any

UNWANTED = (
    "WebUIOmniboxPopup",
    "WebUIOmniboxAimPopup",
    "AvoidCorsURLLoaderRestartOnRedirect",
    "AvoidUnnecessaryBeforeUnloadCheckSync",
    "DestroyProfileOnBrowserClose",
    "HttpsUpgrades",
    "HttpsFirstBalancedModeAutoEnable",
    "LensOverlay",
    "MediaRouter",
    "NetworkTimeServiceQuerying",
    "OptimizationHints",
    "PaintHolding",
    "PreconnectToSearch",
    "ThirdPartyStoragePartitioning",
)
"""Features that are switched off. The first two load two pages of the browser's own beside each window, at
twice the cost of ours. The others Playwright switches off, too, but the last such flag replaces its own.
"""
FLAGS = (
    f"--disable-features={','.join(UNWANTED)}",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
MISSING = "no Chromium for the tests of the page; install it: apt-get install chromium"


def found() -> str | None:
    """Its path; None if there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


@contextlib.contextmanager
def launched() -> Iterator[Any]:
    """Start it, and end it with the `with` block."""
    from playwright.sync_api import sync_playwright

    path = found()
    assert path, MISSING
    with sync_playwright() as driver:
        chromium = standing(lambda: driver.chromium.launch(executable_path=path, args=list(FLAGS)))
        yield chromium
        chromium.close()


def standing(launch: Callable[[], Any], attempts: int = 3) -> Any:
    """A browser that has shown an empty page. On a busy machine Chromium may die at its start."""
    from playwright.sync_api import Error

    chromium = launch()
    try:
        chromium.new_page().close()
    except Error:
        if attempts == 1:
            raise
        return standing(launch, attempts - 1)
    return chromium
