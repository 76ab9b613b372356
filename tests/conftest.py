"""Shared by many tests: compiled kernels, a router on a free port, and polling instead of sleeping."""

import gc
import signal
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from link.bus.opening import open_router
from tests.kernels import compile_kernels
from tests.workers import Units, mark_rows, rank

# The same examples on every run, and no time limit per example: the machine may be busy.
settings.register_profile("plumeward", derandomize=True, deadline=None)
settings.load_profile("plumeward")

# Under nohup, and on some CI, SIGHUP is ignored, and so it would be by every process that a test starts.
signal.signal(signal.SIGHUP, signal.SIG_DFL)

ROOT = Path(__file__).parents[1]


def pytest_sessionstart(session: pytest.Session) -> None:
    """Fill numba's cache before the first test: on a fresh checkout this takes a minute, longer than the
    time limits of the tests.

    The main process does it once, before the workers start.
    """
    if hasattr(session.config, "workerinput") or session.config.option.collectonly:
        return
    compile_kernels(ROOT)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Spare `make test-all` the files that it runs no test of: each process would import them."""
    if config.option.markexpr == "full" and collection_path.match("test_*.py"):
        text = collection_path.read_text()
        return not ("mark.full" in text or "mark.one_in" in text) or None
    return None


@pytest.hookimpl(tryfirst=True)  # before `-m` looks at the marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    mark_rows(items)
    items.sort(key=lambda item: rank(item.nodeid))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> Units:
    config.option.loadscopereorder = False  # by the number of tests, which says nothing of their length
    return Units(config, log)


@pytest.fixture
def router() -> Iterator[str]:
    """The endpoint of a router that runs during the test."""
    session, endpoint = open_router("tcp/127.0.0.1:0")
    with session:
        yield endpoint


def wait_until(holds: Callable[[], object], timeout_s: float = 400.0) -> None:
    """Poll until `holds()` is true. `timeout_s` is for what never comes true: a busy machine must not
    reach it.
    """
    deadline = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < deadline, f"not true within {timeout_s:g} s"
        time.sleep(0.01)


@pytest.fixture
def kept_bytes() -> Callable[[Callable[[], object]], int]:
    """Return a function that says how much more memory is held after a call than before it."""

    def held_after(call: Callable[[], object]) -> int:
        gc.collect()
        tracemalloc.start()
        try:
            call()
            gc.collect()
            return tracemalloc.get_traced_memory()[0]
        finally:
            tracemalloc.stop()

    return held_after


@pytest.fixture(name="wait_until")
def wait_until_fixture() -> Callable[..., None]:
    """Give tests the polling helper."""
    return wait_until
