"""Protects that the page goes on following its router: without a certificate that is fit, and past
strangers.
"""

import datetime
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ground.view.live import LiveFleet
from link.access.authority import make
from link.bus.opening import open_router
from link.bus.session import Bus
from tests.system.stranger import Stranger

LONG_AGO = datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=800)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Certificates whose CA is old enough to have issued some that have expired."""
    make(tmp_path / "certs", [1], now=LONG_AGO)
    make(tmp_path / "certs", [1], force=True)
    return tmp_path / "certs"


@contextmanager
def following(router: str, folder: Path | None = None) -> Iterator[tuple[LiveFleet, list[str]]]:
    """A fleet that is followed, and the lines that it has said."""
    lines: list[str] = []
    fleet = LiveFleet(router, {}, lambda: None, lines.append, folder)
    try:
        yield fleet, lines
    finally:
        fleet.end()


def test_who_waits_for_a_router_says_once_that_the_certificate_has_expired_and_takes_a_new_one(
    folder: Path, wait_until: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ground.view.live.CONNECT_TIMEOUT_MS", 100)
    nobody = "tls/127.0.0.1:1"
    with following(nobody, folder) as (fleet, lines):
        wait_until(lambda: fleet.notice == f"no router at {nobody}: waiting for one")
        make(folder, [1], now=LONG_AGO, force=True)
        wait_until(lambda: f"{folder}/operator.pem expired on " in fleet.notice)
        make(folder, [1], force=True)
        wait_until(lambda: len(lines) == 3)
        assert fleet.notice == f"no router at {nobody}: waiting for one"
        assert ["expired" in line for line in lines] == [False, True, False]


def test_a_certificate_that_has_expired_does_not_end_the_page_and_a_new_one_shows_the_vehicles(
    folder: Path, wait_until: Callable[..., None]
) -> None:
    session, endpoint = open_router("tls/127.0.0.1:0", folder)
    with session, Bus("uav", endpoint, "uav/1", secure=folder), following(endpoint, folder) as (fleet, lines):
        wait_until(lambda: list(fleet.vehicles) == ["uav/1"])
        make(folder, [2])
        kept = {file: file.read_bytes() for file in folder.glob("operator.*")}
        make(folder, [1, 2], now=LONG_AGO, force=True)
        operator = {file: file.read_bytes() for file in kept}
        make(folder, [1, 2], force=True)
        for file, data in operator.items():
            file.write_bytes(data)
        with Bus("uav", endpoint, "uav/2", secure=folder):
            wait_until(lambda: "operator.pem expired on " in fleet.notice)
            for file, data in kept.items():
                file.write_bytes(data)
            wait_until(lambda: list(fleet.vehicles) == ["uav/1", "uav/2"] and not fleet.notice)
        assert sum("expired" in line for line in lines) == 1


def test_a_token_for_a_pattern_of_keys_is_no_vehicle_and_does_not_end_the_page(
    router: str, wait_until: Callable[..., None]
) -> None:
    patterns = ("uav/*", "**", "uav/$*1")
    with Stranger(router) as stranger, Stranger(router) as witness, following(router) as (fleet, _):
        for pattern in patterns:
            stranger.announce("health/uav", namespace=pattern)
        wait_until(lambda: {f"{pattern}/health/uav" for pattern in patterns} <= set(witness.announced()))
        with Bus("uav", router, "uav/7"):
            wait_until(lambda: list(fleet.vehicles) == ["uav/7"])
