"""Protects the verdict: a find that deserves doubt is not told as one that does not."""

from pathlib import Path
from typing import Any

import msgspec
import pytest

from ground.findings.flight import Remark
from ground.findings.verdict import DOUBTFUL, FOUND, NOT_FOUND, OUTSIDE, Judgement, verdict
from link.bus.messages import Departure, departure_text
from plume.sensors.names import parse
from tests.ground.findings.records import FOUND as RECORD
from tests.ground.findings.records import findings


def judged(sensor: str = "", warned: str = "", remark: str = "", **changes: Any) -> Judgement:
    it = findings(RECORD)
    flight = it.flight._replace(last=msgspec.structs.replace(it.last, **changes), remark=remark)
    if warned:
        flight = flight._replace(estimator_warned=[Remark(0, "estimator", warned)])
    told = it.told._replace(sensor=parse(sensor)) if sensor else it.told
    return verdict(flight, told)


def test_a_stop_without_a_warning_is_a_find() -> None:
    assert judged(advised_dwell=0.0).kind == FOUND


def test_a_message_that_the_estimator_refused_is_no_doubt_of_the_find() -> None:
    assert judged(warned="refused reading: uav/3 has left the search", advised_dwell=0.0).kind == FOUND


def test_a_vehicle_that_left_the_search_is_no_doubt_of_the_find_of_the_others() -> None:
    left = departure_text(Departure(3, 7, "paused for 12.8 s: Search gives way: LOITER by 255/190"))
    assert judged(warned=left, advised_dwell=0.0).kind == FOUND


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"warned": "the readings do not fit the model (p = 1e-06 over the last 30)"}, "warned in flight"),
        ({"wind_p_value": 1e-6}, "the wind was not the same"),
        ({"sensor": "tgs2620"}, "metal oxide"),
        ({"advised_dwell": 2.0}, "came and went"),
        ({"remark": "is cut off"}, "cut off"),
    ],
)
def test_a_stop_is_doubtful_and_says_why(changes: dict[str, Any], why: str) -> None:
    said = judged(**changes)
    assert said.kind == DOUBTFUL
    assert why in said.sentence
    assert any(why in reason for reason in said.reasons)


def test_a_doubt_leaves_out_the_figures_of_a_warning_and_its_question() -> None:
    misfit = "the readings do not fit the model (p = 1e-06 over the last 30): is the sensor stuck?"
    assert judged(warned=misfit, advised_dwell=0.0).reasons == (
        "the estimator warned in flight: the readings do not fit the model",
    )
    doubted = "the readings of uav/3 do not fit those of the others: is the sensor stuck, dead or wrong?"
    assert judged(warned=doubted, advised_dwell=0.0).reasons == (
        "the estimator warned in flight: the readings of uav/3 do not fit those of the others",
    )


def test_a_belief_outside_the_area_is_outside_and_says_where_to() -> None:
    said = judged(outside=0.97, mean=(35.0, 12.0))
    assert said.kind == OUTSIDE
    assert "to the east (97% of the belief)" in said.sentence
    doubtful = judged(outside=0.97, mean=(35.0, 12.0), sensor="tgs2620")
    assert doubtful.kind == OUTSIDE
    assert "But the sensor is a metal oxide" in doubtful.sentence


def test_a_fleet_of_which_one_left_is_said_to_have_read_as_often_as_it_has() -> None:
    flight = findings().flight
    sample = flight.samples[0]
    both = [sample._replace(vehicle=number) for number in (1, 2) for _ in range(3)]
    assert flight._replace(samples=both).read_text == "3 readings of each of 2 vehicles"
    assert flight._replace(samples=both[:4]).read_text == "4 readings of 2 vehicles"
    assert flight._replace(samples=both[::3]).read_text == "1 reading of each of 2 vehicles"


def test_readings_that_are_all_the_same_are_not_said_to_hold_gas() -> None:
    it = findings(RECORD)
    same = [sample._replace(gas=0.0) for sample in it.flight.samples]
    last = msgspec.structs.replace(it.last, ceased=False, spread=9.0, evidence=20.0, p_value=0.0)
    said = verdict(it.flight._replace(samples=same, last=last), it.told)
    assert "need no source" in said.sentence
    assert "the sensor may be stuck" in said.sentence


def test_not_found_in_a_record_that_is_cut_off_says_what_that_means() -> None:
    said = judged(remark="is cut off", ceased=False, spread=4.0)
    assert said.kind == NOT_FOUND
    assert said.sentence.endswith("The record is cut off: what the search has found later is not in it.")
    assert "the record is cut off" in said.reasons


def test_a_narrow_belief_whose_stop_was_withheld_is_doubtful() -> None:
    said = judged(ceased=False, spread=0.3, evidence=1.0)
    assert said.kind == DOUBTFUL
    assert "the sensor may hum" in said.sentence
    assert judged(ceased=False, spread=0.3, p_value=1e-6).kind == DOUBTFUL


def test_a_search_without_a_stop_found_nothing_and_says_whether_there_was_gas() -> None:
    assert judged(ceased=False, spread=9.0, evidence=0.0).kind == NOT_FOUND
    assert "need no source" in judged(ceased=False, spread=9.0, evidence=0.0).sentence
    assert "hold gas of a source" in judged(ceased=False, spread=9.0, evidence=20.0).sentence
    stuck = judged(ceased=False, spread=9.0, evidence=0.0, p_value=1e-6)
    assert "But the last readings do not fit the model" in stuck.sentence
    cut_off = judged(ceased=False, spread=9.0, evidence=0.0, p_value=1e-6, remark="is cut off")
    assert cut_off.sentence.count("is cut off") == 1
    assert "But the last readings do not fit the model" in cut_off.sentence


def test_the_verdict_of_the_golden_record_is_told_in_a_sentence() -> None:
    assert findings(Path(RECORD)).verdict.sentence.endswith(".")
