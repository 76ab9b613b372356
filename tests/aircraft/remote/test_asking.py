"""Protects the vehicle's question to its payload: asked again until it is answered, and only its own
answer counts.
"""

import math

import pytest

from aircraft.payload.messages import Sample, pack_answer, unpack_question
from aircraft.remote.sensing import Asking
from link.bus.mavlink import BadFrame, Codec

PLACE = (4.0, 3.0, -5.0)
WIND = (1.5, -0.5)


class Bench:
    """A question's way to the payload, under a clock that the test sets."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.sent: list[bytes] = []
        self.asking = Asking(self.sent.append, Codec(1, 1), lambda: self.now_s)

    def at(self, now_s: float) -> None:
        self.now_s = now_s
        self.asking.again()


def answer(time_boot_ms: int, gas: float = 0.5) -> bytes:
    return pack_answer(1, Sample(time_boot_ms, gas, WIND))


def test_a_question_goes_out_at_once() -> None:
    bench = Bench()
    bench.asking.ask(1000, 2, PLACE, WIND)
    assert [unpack_question(frames)[1:] for frames in bench.sent] == [(1000, 2, (3.0, 4.0), WIND)]
    assert bench.asking.waiting


def test_nothing_is_asked_while_no_question_is_open() -> None:
    bench = Bench()
    assert not bench.asking.waiting
    assert bench.asking.next_s() == math.inf
    bench.at(1e6)
    assert bench.sent == []


def test_an_unanswered_question_is_asked_again_at_doubled_intervals_up_to_two_seconds() -> None:
    bench = Bench()
    bench.asking.ask(1000, 0, PLACE, None)
    due = []
    for _ in range(6):
        due.append(bench.asking.next_s() - 100.0)
        bench.at(bench.asking.next_s())
    assert due == [0.25, 0.75, 1.75, 3.75, 5.75, 7.75]
    assert len(bench.sent) == 7
    assert set(bench.sent) == {bench.sent[0]}


def test_it_is_not_asked_again_before_it_is_due() -> None:
    bench = Bench()
    bench.asking.ask(1000, 0, PLACE, None)
    bench.at(100.249)
    assert len(bench.sent) == 1


def test_the_answer_closes_the_question() -> None:
    bench = Bench()
    bench.asking.ask(1000, 0, PLACE, None)
    assert bench.asking.receive(answer(1000)) == Sample(1000, 0.5, WIND)
    assert not bench.asking.waiting
    bench.at(200.0)
    assert len(bench.sent) == 1


def test_a_second_answer_says_nothing_new() -> None:
    bench = Bench()
    bench.asking.ask(1000, 0, PLACE, None)
    bench.asking.receive(answer(1000))
    assert bench.asking.receive(answer(1000, 0.75)) is None


def test_a_late_answer_to_a_replaced_question_does_not_count() -> None:
    bench = Bench()
    bench.asking.ask(1000, 0, PLACE, None)
    bench.asking.ask(2000, 1, PLACE, None)
    assert bench.asking.receive(answer(1000)) is None
    assert bench.asking.waiting
    assert bench.asking.receive(answer(2000)) == Sample(2000, 0.5, WIND)


def test_a_new_question_begins_with_short_intervals() -> None:
    bench = Bench()
    bench.asking.ask(1000, 0, PLACE, None)
    for now_s in (101.0, 103.0, 106.0):
        bench.at(now_s)
    bench.asking.ask(2000, 1, PLACE, None)
    assert bench.asking.next_s() == 106.25


def test_a_sensor_without_a_value_has_answered_too() -> None:
    bench = Bench()
    bench.asking.ask(1000, 0, PLACE, None)
    sample = bench.asking.receive(answer(1000, math.nan))
    assert sample
    assert math.isnan(sample.gas)
    assert not bench.asking.waiting


def test_a_malformed_answer_leaves_the_question_open() -> None:
    bench = Bench()
    bench.asking.ask(1000, 0, PLACE, None)
    with pytest.raises(BadFrame):
        bench.asking.receive(answer(1000)[:-1])
    assert bench.asking.waiting
