"""Protects which waypoint answers a reading: the first one with the newest reading's time."""

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.search.search import Answers

DENIED, REJECTED = mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_TEMPORARILY_REJECTED


def test_only_the_first_waypoint_with_the_time_of_the_newest_reading_answers_it():
    answers = Answers()
    assert answers.refusal(100) == (
        DENIED,
        "Waypoint refused: no reading was taken at 100 ms",
        "no reading",
    )
    answers.sampled(100)
    assert answers.refusal(100) is None
    answers.awaited = False
    assert answers.refusal(100) == (
        REJECTED,
        "Waypoint ignored: duplicate answer to the reading at 100 ms",
        "",
    )
    answers.sampled(200)
    assert answers.refusal(100) == (
        REJECTED,
        "Waypoint ignored: late answer to the reading at 100 ms",
        "",
    )
    assert answers.refusal(200) is None


def test_the_times_of_readings_must_grow():
    answers = Answers()
    answers.sampled(100)
    with pytest.raises(ValueError, match="100 ms"):
        answers.sampled(100)


def test_readings_and_their_answers_pass_the_wrap_of_time():
    answers = Answers()
    times = [
        answers.time_of(1000 * now_s) for now_s in (4_294_967.290, 4_294_967.290, 4_294_967.296, 4_294_967.5)
    ]
    assert times == [2**32 - 6, 2**32 - 5, 0, 204]
    for stamp in times:
        answers.sampled(stamp)
    late = "Waypoint ignored: late answer to the reading at 4294967290 ms"
    assert answers.refusal(times[0]) == (REJECTED, late, "")
    assert answers.refusal(204) is None
    with pytest.raises(ValueError, match="reading times must increase"):
        answers.sampled(2**32 - 4)
