"""Protects the words of the tables: ceased, located, distance."""

import json

import pytest

from plume.outcome import TracePoint, outcome, outcome_json, outcome_text
from plume.scenario import Scenario

SCENARIO = Scenario(source=(3.0, 4.0), q=100.0, u=1.0, phi=0.0, d=1.0, tau=10.0, start=(0.0, 0.0))


def flown(estimate: tuple[float, float]) -> list[TracePoint]:
    positions = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)]
    return [TracePoint(position, 0.5, estimate, 0.4) for position in positions]


def test_a_stop_within_a_metre_is_located_and_one_farther_off_is_not() -> None:
    near = outcome(1, "random", SCENARIO, flown((3.0, 3.1)), True, 0.1, "field", "spread:0.5")
    far = outcome(1, "random", SCENARIO, flown((3.0, 2.9)), True, 0.1, "field", "spread:0.5")
    assert (near.ceased, near.located, far.ceased, far.located) == (True, True, True, False)


def test_a_mission_without_a_stop_is_not_located_however_good_its_estimate() -> None:
    assert not outcome(1, "random", SCENARIO, flown((3.0, 4.0)), False, 0.1, "field", "spread:0.5").located


def test_steps_and_distance_count_moves_not_readings() -> None:
    result = outcome(1, "random", SCENARIO, flown((3.0, 4.0)), True, 0.1, "field", "spread:0.5")
    assert (result.steps, result.distance_m) == (2, 2.0)


def test_the_json_has_the_fields_that_others_rely_on() -> None:
    trace = flown((3.0, 4.0))
    fields = json.loads(
        outcome_json(outcome(1, "random", SCENARIO, trace, True, 0.1, "field", "spread:0.5"), trace)
    )
    assert set(fields) == {
        "seed",
        "policy",
        "ceased",
        "located",
        "estimate",
        "source",
        "scenario",
        "error_m",
        "spread_m",
        "steps",
        "distance_m",
        "search_time_s",
        "assume",
        "stop",
        "world",
        "trace",
    }
    assert set(fields["scenario"]) == {"q", "u", "phi", "d", "tau", "start"}
    assert set(fields["trace"][0]) == {"position", "reading", "mean", "spread"}


@pytest.mark.parametrize(
    ("estimate", "ceased", "verdict"),
    [((3.0, 3.1), True, "located"), ((3.0, 2.0), True, "FALSE STOP"), ((3.0, 3.1), False, "not ceased")],
)
def test_the_text_names_verdict_estimate_and_source(
    estimate: tuple[float, float], ceased: bool, verdict: str
) -> None:
    told = outcome_text(
        outcome(1, "random", SCENARIO, flown(estimate), ceased, 0.1, "field", "spread:0.5")
    ).splitlines()
    assert told[0] == f"{verdict} after 2 steps, 2.0 m"
    assert told[1] == f"estimate (3.00, {estimate[1]:.2f}) ± 0.40 m"
    assert told[2] == f"source   (3.00, 4.00), error {4 - estimate[1]:.2f} m"
    assert told[3] == "assumed  field, stop spread:0.5"


def test_the_text_names_a_world_that_is_not_what_the_estimator_was_told() -> None:
    result = outcome(1, "random", SCENARIO, flown((3.0, 3.1)), True, 0.1, "paper", "within:1,0.99", "wind-30")
    assert outcome_text(result).splitlines()[3] == "assumed  paper, stop within:1,0.99, world wind-30"


@pytest.mark.parametrize(("ceased", "verdict"), [(True, "ceased"), (False, "not ceased")])
def test_of_a_source_that_nobody_knows_nothing_is_claimed(ceased: bool, verdict: str) -> None:
    result = outcome(1, "random", None, flown((3.0, 4.0)), ceased, 0.1, "field", "spread:0.5")
    fields = json.loads(outcome_json(result, None))
    assert [fields[name] for name in ("located", "error_m", "source", "scenario")] == [None] * 4
    assert fields["ceased"] is ceased
    lines = outcome_text(result).splitlines()
    assert lines == [
        f"{verdict} after 2 steps, 2.0 m",
        "estimate (3.00, 4.00) ± 0.40 m",
        "assumed  field, stop spread:0.5",
    ]
