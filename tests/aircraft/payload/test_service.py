"""Protects the payload's loop: one answer to a question, repeated when it was lost, and no sensor that
hangs holds it up.
"""

import contextlib
import math
import queue
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.payload import service
from aircraft.payload.messages import Question, Sample, pack_question, unpack_answer
from aircraft.payload.service import Measuring
from link.bus.inbox import Inbox
from link.bus.keys import PAYLOAD_IN, PAYLOAD_OUT, STOP, Key
from link.bus.log import Log
from link.bus.mavlink import Codec
from link.bus.session import Arrival
from link.bus.tally import Tally

PLACE = (4.0, 3.0, -5.0)


def asked(time_boot_ms: int, number: int = 0) -> bytes:
    return pack_question(Codec(1, 1), time_boot_ms, number, PLACE, None)


class Ended(Exception):
    """The test is over."""


class FakeBus:
    """A bus without a network: what the test puts into the inbox arrives, what the service publishes is
    kept.
    """

    def __init__(self, inbox: Inbox) -> None:
        self.tally = Tally()
        self.log = Log("payload", "uav/1", self.tally, "error")
        self.said: queue.SimpleQueue[Sample] = queue.SimpleQueue()
        self.refused: list[tuple[str, str]] = []
        self.reports = 0
        self.inbox = inbox
        self.now_s: Callable[[], float] = lambda: 0.0

    def subscribe(self, *keys: Key) -> None:
        assert keys == (PAYLOAD_IN, STOP)

    def publish_health(self) -> None:
        self.reports += 1

    answered = publish_health

    def refuse(self, key: Key, reason: str, kind: str) -> None:
        self.refused.append((reason, kind))

    def publish(self, key: Key, message: bytes) -> None:
        assert key is PAYLOAD_OUT
        self.said.put(unpack_answer(message))

    def receive(self, timeout_s: float | None = None) -> Any:
        try:
            item = self.inbox.get(timeout_s)
        except queue.Empty:
            return None
        if item is Ended:
            raise Ended
        return item

    # the test's side

    def ask(self, payload: bytes) -> None:
        self.inbox.put(Arrival(PAYLOAD_IN, payload, b""))

    def hear(self) -> Sample:
        return self.said.get(timeout=30)


class Bench:
    """A running service whose sensor the test is."""

    def __init__(self) -> None:
        inbox = Inbox()
        self.bus = FakeBus(inbox)
        self.wanted: queue.SimpleQueue[Question] = queue.SimpleQueue()
        self.values: queue.SimpleQueue[float] = queue.SimpleQueue()
        self._measuring = Measuring(self._measure, inbox)
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _measure(self, question: Question) -> Sample:
        self.wanted.put(question)
        return Sample(question.time_boot_ms, self.values.get(timeout=30), None)

    def _run(self) -> None:
        with contextlib.suppress(Ended):
            service.run(self.bus, self._measuring)  # type: ignore[arg-type]

    def end(self) -> None:
        self.bus.inbox.put(Ended)
        self.thread.join(30)
        self.values.put(0.0)  # frees a sensor that hangs


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.end()


def test_a_question_is_answered_with_the_value_and_its_own_time(bench: Bench) -> None:
    bench.bus.ask(asked(1000, 3))
    assert bench.wanted.get(timeout=30) == Question(1, 1000, 3, (3.0, 4.0), None)
    bench.values.put(0.5)
    assert bench.bus.hear() == Sample(1000, 0.5, None)


def test_a_question_that_was_answered_gets_the_same_answer_without_another_measurement(bench: Bench) -> None:
    bench.bus.ask(asked(1000))
    bench.values.put(0.5)
    first = bench.bus.hear()
    bench.bus.ask(asked(1000))
    bench.bus.ask(asked(1000))
    assert [bench.bus.hear(), bench.bus.hear()] == [first, first]
    assert bench.wanted.qsize() == 1


def test_a_question_that_is_repeated_while_it_is_measured_is_measured_once(bench: Bench) -> None:
    for _ in range(3):
        bench.bus.ask(asked(1000))
    bench.wanted.get(timeout=30)
    bench.values.put(0.5)
    assert bench.bus.hear().gas == 0.5
    bench.bus.ask(asked(2000))
    assert bench.wanted.get(timeout=30).time_boot_ms == 2000


def test_a_vehicle_that_starts_again_is_not_given_the_answer_of_its_former_life(bench: Bench) -> None:
    for number, value in ((5, 0.5), (0, 0.75)):  # the same time, but another reading
        bench.bus.ask(asked(1000, number))
        bench.values.put(value)
        assert bench.bus.hear().gas == value


def test_a_value_for_a_question_that_was_replaced_is_not_passed_on(bench: Bench) -> None:
    bench.bus.ask(asked(1000))
    bench.wanted.get(timeout=30)
    bench.bus.ask(asked(2000, 1))
    while bench.bus.inbox.waiting():
        threading.Event().wait(0.001)
    bench.values.put(0.5)  # for the first
    assert bench.wanted.get(timeout=30).time_boot_ms == 2000
    bench.values.put(0.75)
    assert bench.bus.hear() == Sample(2000, 0.75, None)


def test_a_sensor_that_hangs_has_no_value_and_what_it_says_later_is_dropped(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service, "HUNG_S", 0.05)
    bench.bus.ask(asked(1000))
    sample = bench.bus.hear()
    assert (sample.time_boot_ms, math.isnan(sample.gas)) == (1000, True)
    assert bench.bus.tally.warnings == (service.NO_VALUE,)
    monkeypatch.setattr(service, "HUNG_S", 30.0)
    bench.bus.ask(asked(2000))
    bench.values.put(0.5)  # for the first
    bench.values.put(0.75)
    assert bench.bus.hear() == Sample(2000, 0.75, None)
    bench.end()
    assert bench.bus.tally.warnings == ()


def test_a_malformed_question_is_refused_with_the_reason_and_the_next_one_answered(bench: Bench) -> None:
    bench.bus.ask(b"noise")
    bench.bus.ask(Codec(1, 1).pack(mavlink.MAVLink_named_value_int_message(1000, b"sample", 0)))
    bench.bus.ask(pack_question(Codec(1, 1), 1000, 0, (math.nan, 0.0, 0.0), None))
    bench.bus.ask(asked(2000))
    bench.values.put(0.5)
    assert bench.bus.hear().time_boot_ms == 2000
    assert [kind for _, kind in bench.bus.refused] == ["malformed", "malformed", "not finite"]


def test_it_reports_each_reading_that_it_has_measured(bench: Bench) -> None:
    assert bench.bus.tally.step == -1
    bench.bus.ask(asked(1000, 4))
    bench.values.put(0.5)
    bench.bus.hear()
    bench.end()
    assert bench.bus.tally.step == 4
    assert bench.bus.reports == 2  # ready, and the answer
