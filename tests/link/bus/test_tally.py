"""Protects the health of a service: recent rates, recent refusals, and publication without being asked."""

import json
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from link.bus.inbox import Inbox
from link.bus.keys import BELIEF, HEALTH, KEYS, READING
from link.bus.messages import Health
from link.bus.session import Arrival, Bus
from link.bus.tally import Tally
from link.record.tap import Tap

pytestmark = pytest.mark.slow


class Clock:
    """A clock that the test sets."""

    def __init__(self) -> None:
        self.s = 100.0

    def __call__(self) -> float:
        return self.s


def test_the_rate_is_of_the_last_ten_seconds() -> None:
    clock = Clock()
    tally = Tally(clock)
    for step in range(40):  # two a second for 20 s
        clock.s += 0.5
        tally.did(step)
    assert tally.rate_hz == 2.0
    clock.s += 5.0
    assert tally.rate_hz == 1.0
    clock.s += 5.0
    assert tally.rate_hz == 0.0
    assert tally.step == 39


def test_a_young_service_is_not_said_to_be_slow() -> None:
    clock = Clock()
    tally = Tally(clock)
    clock.s += 4.0
    for step in range(8):
        tally.did(step)
    assert tally.rate_hz == 2.0


def test_several_at_once_are_counted_as_many() -> None:
    clock = Clock()
    tally = Tally(clock)
    clock.s += 10.0
    tally.did(5, 300)
    assert tally.rate_hz == 30.0


def test_a_refusal_is_news_for_a_minute_and_counted_for_ever() -> None:
    clock = Clock()
    tally = Tally(clock)
    tally.refuse("late")
    clock.s += 30.0
    tally.refuse("malformed")
    assert tally.refused_lately == 2
    clock.s += 30.0
    assert tally.refused_lately == 1
    clock.s += 30.0
    assert tally.refused_lately == 0
    assert tally.refused == {"late": 1, "malformed": 1}


def test_a_flood_of_refusals_is_remembered_in_little(kept_bytes: Callable[..., int]) -> None:
    clock = Clock()
    tally = Tally(clock)

    def flood() -> None:
        for _ in range(100_000):  # within the last 50 s
            clock.s += 0.0005
            tally.refuse("malformed")

    assert kept_bytes(flood) < 1_000_000  # ten bytes each
    tally.refuse("overflow", 23)
    assert tally.refused_lately == 100_023
    clock.s += 61.0
    assert tally.refused_lately == 0
    assert tally.refused == {"malformed": 100_000, "overflow": 23}


def test_what_only_comes_again_is_counted_but_no_trouble() -> None:
    tally = Tally(Clock())
    tally.refuse("repeated")
    assert (tally.refused, tally.refused_lately) == ({"repeated": 1}, 0)


def heard(bus: Bus, wanted: Callable[[Health], bool]) -> Health:
    deadline = time.monotonic() + 120.0
    while time.monotonic() < deadline:
        item: Any = bus.receive(timeout_s=1.0)
        if (
            isinstance(item, Arrival)
            and item.key is HEALTH
            and wanted(health := Health(**json.loads(item.payload)))
        ):
            return health
    raise AssertionError("no such health came in time")


def test_an_idle_service_says_each_second_that_it_is_well_once_it_has_said_that_it_is_ready(
    router: str,
) -> None:
    with Bus("viewer", router, announced=False) as viewer, Bus("agent", router) as agent:
        viewer.subscribe(HEALTH)
        assert agent.receive(timeout_s=1.5) is None
        assert viewer.receive(timeout_s=0) is None
        agent.tally.about = "infotaxis"
        agent.publish_health()
        uptimes = [heard(viewer, lambda _: True).uptime_s]
        while len(uptimes) < 3:
            assert agent.receive(timeout_s=1.2) is None
            health = heard(viewer, lambda health: health.uptime_s > uptimes[-1])
            uptimes.append(health.uptime_s)
        assert (health.service, health.about) == ("agent", "infotaxis")
        assert uptimes[1] - uptimes[0] > 0.9


def test_so_does_one_that_takes_in_batches(router: str, wait_until: Callable[..., None]) -> None:
    with Tap("recorder", router) as tap:
        tap.subscribe(*KEYS)
        tap.publish_health()
        said: list[Any] = []
        wait_until(lambda: said.extend(tap.take()) or len(said) >= 3)
    uptimes = [json.loads(message.payload)["uptime_s"] for message in said]
    assert all(later - earlier > 0.9 for earlier, later in pairwise(uptimes))


def test_latency_is_from_the_arrival_of_what_was_answered_waiting_included(
    router: str, wait_until: Callable[..., None]
) -> None:
    inbox = Inbox()
    with (
        Bus("viewer", router, announced=False) as viewer,
        Bus("uav", router) as uav,
        Bus("estimator", router, inbox=inbox) as estimator,
    ):
        viewer.subscribe(HEALTH)
        estimator.subscribe(READING)
        published_at = time.monotonic()
        uav.publish(READING, b"frames")
        wait_until(inbox.waiting)
        arrived_by = time.monotonic()
        wait_until(lambda: time.monotonic() > arrived_by + 0.3)  # busy with something else
        estimator.receive()
        estimator.publish(BELIEF, b"{}")
        before = time.monotonic()
        estimator.answered()
        after = time.monotonic()
        health = heard(viewer, lambda health: health.latency_s > 0)
    assert before - arrived_by <= health.latency_s <= after - published_at


def test_who_looks_on_is_not_counted_among_the_services(router: str, wait_until: Callable[..., None]) -> None:
    with Bus("status", router, announced=False) as looker, Bus("agent", router):
        wait_until(looker.services)  # until the token has reached the router
        assert looker.services() == {"agent"}
