"""Protects the vehicle's question to its payload: asked again until it is answered, and only its own
answer counts.
"""

import math
from types import SimpleNamespace
from typing import Any

import pytest

from aircraft.aircraft import Measured
from aircraft.payload.messages import Sample, pack_answer, unpack_question
from aircraft.remote import sensing
from aircraft.remote.sensing import AskedSensor
from aircraft.remote.winds import Winds, WindSource
from aircraft.state import Arrived
from aircraft.together import Berth
from link.bus.mavlink import BadFrame

THERE = Arrived(1.0, (4.0, 3.0, -5.0), 1000)
WIND = (1.5, -0.5)


class Bench:
    """A question's way to the payload, under a clock that the test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 100.0
        self.sent: list[bytes] = []
        monkeypatch.setattr(sensing, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        known = SimpleNamespace(glitches=SimpleNamespace(lasts=lambda _: False), place=(10.0, 20.0, 0.0))
        self.vehicle: Any = SimpleNamespace(wind=None, now_s=0.0, flight=SimpleNamespace(known=known))
        bus: Any = SimpleNamespace(publish=lambda _, question: self.sent.append(question))
        winds = Winds(None, (0.7, -2.0), print)
        winds.source = WindSource.PAYLOAD
        berth = Berth((20.5, 10.0), [(2.0, 2.0)], 3.0)
        self.sensor = AskedSensor(self.vehicle, bus, winds, 2, 1, berth)

    def at(self, now_s: float) -> None:
        self.now_s = now_s
        self.sensor.go_on()

    def ask(self, time_boot_ms: int, number: int) -> None:
        self.sensor.measure(THERE, time_boot_ms, number)

    def answered(self, payload: bytes) -> Measured | None:
        return self.sensor.take(payload, wanted=True)

    @property
    def waiting(self) -> bool:
        return self.sensor.next_s() < math.inf


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def answer(time_boot_ms: int, gas: float = 0.5) -> bytes:
    return pack_answer(1, Sample(time_boot_ms, gas, WIND))


def test_a_question_goes_out_at_once(bench: Bench) -> None:
    bench.vehicle.wind = WIND
    bench.ask(1000, 2)
    assert [unpack_question(frames)[1:] for frames in bench.sent] == [(1000, 2, (3.0, 4.0), WIND)]
    assert bench.waiting


def test_nothing_is_asked_while_no_question_is_open(bench: Bench) -> None:
    assert bench.sensor.next_s() == math.inf
    bench.at(1e6)
    assert bench.sent == []


def test_an_unanswered_question_is_asked_again_at_doubled_intervals_up_to_two_seconds(bench: Bench) -> None:
    bench.ask(1000, 0)
    due = []
    for _ in range(6):
        due.append(bench.sensor.next_s() - 100.0)
        bench.at(bench.sensor.next_s())
    assert due == [0.25, 0.75, 1.75, 3.75, 5.75, 7.75]
    assert len(bench.sent) == 7
    assert set(bench.sent) == {bench.sent[0]}


def test_it_is_not_asked_again_before_it_is_due(bench: Bench) -> None:
    bench.ask(1000, 0)
    bench.at(100.249)
    assert len(bench.sent) == 1


def test_the_answer_closes_the_question(bench: Bench) -> None:
    bench.ask(1000, 0)
    assert bench.answered(answer(1000)) == Measured(THERE, 0.5, WIND)
    assert not bench.waiting
    bench.at(200.0)
    assert len(bench.sent) == 1


def test_a_second_answer_says_nothing_new(bench: Bench) -> None:
    bench.ask(1000, 0)
    bench.answered(answer(1000))
    assert bench.answered(answer(1000, 0.75)) is None


def test_a_late_answer_to_a_replaced_question_does_not_count(bench: Bench) -> None:
    bench.ask(1000, 0)
    bench.ask(2000, 1)
    assert bench.answered(answer(1000)) is None
    assert bench.waiting
    assert bench.answered(answer(2000)) == Measured(THERE, 0.5, WIND)


def test_a_new_question_begins_with_short_intervals(bench: Bench) -> None:
    bench.ask(1000, 0)
    for now_s in (101.0, 103.0, 106.0):
        bench.at(now_s)
    bench.ask(2000, 1)
    assert bench.sensor.next_s() == 106.25


def test_a_sensor_without_a_value_has_answered_too(bench: Bench) -> None:
    bench.ask(1000, 0)
    measured = bench.answered(answer(1000, math.nan))
    assert measured
    assert math.isnan(measured.gas)
    assert not bench.waiting


def test_a_malformed_answer_leaves_the_question_open(bench: Bench) -> None:
    bench.ask(1000, 0)
    with pytest.raises(BadFrame):
        bench.answered(answer(1000)[:-1])
    assert bench.waiting


def test_a_real_vehicle_that_joins_late_has_to_stand_at_its_start(bench: Bench) -> None:
    """Where it takes off the others keep clear, not on a way from elsewhere."""
    assert bench.sensor.latecomer() == ""  # half a metre east of it
    bench.vehicle.flight.known.place = (10.0, 19.0, 0.0)
    assert bench.sensor.latecomer() == (
        "to join late it has to stand within 1 m of its start (20.5, 10.0); it is 1.5 m away"
    )
