"""What many tests need: a router on a free port of this machine, and polling instead of sleeping."""

import time
from collections.abc import Callable, Iterator

import pytest
from hypothesis import settings

from link.bus.session import open_router

# The same examples on every run, and no judgement of how long one takes: the machine may be busy.
settings.register_profile("plumeward", derandomize=True, deadline=None)
settings.load_profile("plumeward")


@pytest.fixture
def router() -> Iterator[str]:
    """The endpoint of a router that lives as long as the test."""
    session, endpoint = open_router("tcp/127.0.0.1:0")
    with session:
        yield endpoint


def wait_until(holds: Callable[[], object], timeout_s: float = 30.0) -> None:
    """Poll until something holds; fails where it does not within the time."""
    deadline = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < deadline, "it did not come to hold in time"
        time.sleep(0.01)


@pytest.fixture(name="wait_until")
def wait_until_fixture() -> Callable[..., None]:
    """Give tests the polling helper."""
    return wait_until
