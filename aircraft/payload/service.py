"""The payload service: answers each question of the vehicle with one value."""

import math
import threading
import time
from typing import NamedTuple

from aircraft.payload.drivers import TIMEOUT_S, Measure
from aircraft.payload.messages import Question, Sample, pack_answer, unpack_question
from link.bus.inbox import Inbox
from link.bus.keys import PAYLOAD_IN, PAYLOAD_OUT, STOP
from link.bus.mavlink import BadFrame
from link.bus.session import Arrival, Bus

HUNG_S = TIMEOUT_S + 1.0  # real time after which the service answers in place of a sensor that hangs
NO_VALUE = "the sensor has no value"


class Answered(NamedTuple):
    """The answer to a question."""

    question: Question
    sample: Sample


class Measuring:
    """Measures in a thread of its own: a sensor that hangs costs its values, not the service."""

    def __init__(self, measure: Measure, inbox: Inbox) -> None:
        self._measure = measure
        self._inbox = inbox
        self._questions = Inbox()
        self._put = self._questions.lane("question", newest=True)
        threading.Thread(target=self._run, name="sensor", daemon=True).start()

    def begin(self, question: Question) -> None:
        """Answer a question in place of any other that waits."""
        self._put(question, 0)

    def _run(self) -> None:
        while True:
            question: Question = self._questions.get()
            self._inbox.put(Answered(question, self._measure(question)))


def run(bus: Bus, measuring: Measuring) -> None:
    """Serve until interrupted."""
    bus.subscribe(PAYLOAD_IN, STOP)
    bus.publish_health()
    bus.log.info(f"ready: {bus.tally.about}")
    question, deadline_s = None, math.inf  # what is being measured
    answered, answer = None, b""
    while True:
        item = bus.receive(None if question is None else max(deadline_s - time.monotonic(), 0.0))
        sample = None
        match item:
            case Arrival(key) if key is STOP:
                bus.take_stop(item)
            case Arrival() if (asked := _question(bus, item)) is not None:
                if asked == answered:
                    bus.publish(PAYLOAD_OUT, answer)  # it was lost
                elif asked != question:
                    question, deadline_s = asked, time.monotonic() + HUNG_S
                    measuring.begin(asked)
            case Answered() if item.question == question:  # else the vehicle asks something else by now
                sample = item.sample
        if question is None:
            continue
        if sample is None and time.monotonic() >= deadline_s:
            sample = Sample(question.time_boot_ms, math.nan, None)
        if sample is not None:
            answered, answer, question = question, pack_answer(question.system, sample), None
            bus.publish(PAYLOAD_OUT, answer)
            _note(bus, answered, sample)


def _question(bus: Bus, arrival: Arrival) -> Question | None:
    try:
        return unpack_question(arrival.payload)
    except BadFrame as error:
        bus.refuse(PAYLOAD_IN, str(error), error.kind)
        return None


def _note(bus: Bus, question: Question, sample: Sample) -> None:
    if math.isnan(sample.gas):
        if not bus.tally.warnings:
            bus.log.warning(f"{NO_VALUE} for reading {question.number}")
        bus.tally.warnings = (NO_VALUE,)
    else:
        bus.tally.warnings = ()
    x, y = question.position
    bus.log.debug(f"{sample.gas:.4g} at ({x:.2f}, {y:.2f}) m")
    bus.tally.did(question.number)
    bus.answered()
