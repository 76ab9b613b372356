"""Protects the words of the tables: ceased, located, distance."""

import json

import msgspec
import numpy as np
import pytest

from plume.outcome import (
    Left,
    TracePoint,
    gas_lines,
    outcome,
    outcome_json,
    outcome_text,
    rate_interval,
    verdict,
)
from plume.problem import AREA
from plume.scenario import Scenario

SCENARIO = Scenario(source=(3.0, 4.0), q=100.0, u=1.0, phi=0.0, d=1.0, tau=10.0, start=(0.0, 0.0))


def flown(estimate: tuple[float, float]) -> list[TracePoint]:
    positions = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)]
    return [TracePoint(position, 0.5, estimate, 0.4) for position in positions]


def test_a_stop_within_a_metre_is_located_and_one_farther_off_is_not() -> None:
    near = outcome(1, "random", SCENARIO, flown((3.0, 3.1)), True, 0.1, "field", "spread:0.5")
    far = outcome(1, "random", SCENARIO, flown((3.0, 2.9)), True, 0.1, "field", "spread:0.5")
    assert (near.ceased, near.located, far.ceased, far.located) == (True, True, True, False)


@pytest.mark.parametrize(
    ("estimate", "source", "share", "said"),
    [
        ((3.0, 4.0), (3.0, 4.5), 0.0, "located"),
        ((3.0, 4.0), (3.0, 5.5), 0.0, "FALSE STOP"),
        ((29.5, 4.0), (32.0, 4.0), 0.94, "FALSE STOP"),  # it does not say that the source is outside
        ((34.0, 4.0), (32.0, 4.0), 0.95, "outside"),
        ((31.0, 4.0), (29.8, 4.0), 0.95, "FALSE STOP"),
        ((30.5, 4.0), (29.8, 4.0), 0.95, "outside"),  # as near as any find has to be
        ((34.0, 4.0), None, 0.95, "outside"),
        ((34.0, 4.0), None, 0.94, "ceased"),
    ],
)
def test_a_stop_with_the_belief_outside_claims_only_that(
    estimate: tuple[float, float], source: tuple[float, float] | None, share: float, said: str
) -> None:
    assert verdict(True, estimate, source, share) == said
    assert verdict(False, estimate, source, share) == "not ceased"


def test_it_says_beyond_which_edges_the_estimate_is() -> None:
    told = {AREA.beyond((x, y)): (x, y) for x in (-1.0, 15.0, 31.0) for y in (-1.0, 15.0, 31.0)}
    assert told == {
        "south-west": (-1, -1),
        "west": (-1, 15),
        "north-west": (-1, 31),
        "south": (15, -1),
        "": (15, 15),
        "north": (15, 31),
        "south-east": (31, -1),
        "east": (31, 15),
        "north-east": (31, 31),
    }
    result = outcome(
        1, "random", None, flown((33.0, 34.0)), True, 0.1, "field", "spread:0.5", outside_share=0.962
    )
    assert outcome_text(result).startswith("outside, to the north-east (96%), after 2 steps, 2.0 m\n")


# Of 1,000 equal particles from 1 to 1,000 g/s, evenly in the logarithm, 95% lie between 10^0.075 and 10^2.925.
EVENLY = np.stack([np.logspace(0, 3, 1000), np.ones(1000)], axis=1)


@pytest.mark.parametrize(
    ("puffs_per_s", "low", "high"),
    [
        (900.0, 0.075, 2.925),
        (200.0, 0.075, 2.925),
        (200 / 1.2**4, -0.21, 3.21),  # 1.2 times as far from the middle, 10^1.5
        (1.0, -1.35, 4.35),  # never more than twice
        (0.0, -1.35, 4.35),
    ],
)
def test_the_interval_of_the_rate_is_wider_where_puffs_are_few(
    puffs_per_s: float, low: float, high: float
) -> None:
    ends = rate_interval(["q"], EVENLY, {"puff-rate": (0.0, puffs_per_s, 1e3)})
    assert np.log10(ends) == pytest.approx((low, high), abs=0.01)


def test_a_rate_that_was_told_has_no_interval() -> None:
    assert rate_interval(["x"], EVENLY, {}) is None
    assert np.log10(rate_interval(["q"], EVENLY, {})) == pytest.approx((0.075, 2.925), abs=0.01)


def test_a_find_near_either_of_two_sources_is_located() -> None:
    two = msgspec.structs.replace(SCENARIO, second=(20.0, 20.0))
    result = outcome(1, "random", two, flown((20.0, 20.5)), True, 0.1, "field", "spread:0.5")
    assert (result.located, result.source, result.error_m) == (True, (20.0, 20.0), 0.5)


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
        "outside",
        "outside_share",
        "outside_to",
        "intermittency",
        "advised_dwell_s",
        "latitude_deg",
        "longitude_deg",
        "covariance_m2",
        "rate_gs",
        "rate_interval_gs",
        "units",
        "distances_m",
        "measured",
        "left",
        "doubted",
        "joined",
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


BURSTS = {"downwind": (1.08, 1.849, 2.6), "cv": (0.1, 0.4, 0.9), "puff-rate": (2.2, 12.4, 63.0)}
BURSTS["puff-share"] = (0.047, 0.2, 0.61)


def test_the_text_tells_how_the_gas_came_and_went_and_how_long_to_hover() -> None:
    flight = (1, "random", SCENARIO, flown((3.0, 3.1)), True, 0.1, "field", "spread:0.5", "as-modelled")
    told = outcome_text(outcome(*flight, intermittency=BURSTS, advised_dwell_s=2.0)).splitlines()
    assert told[4:] == [
        "gas      comes in bursts: cv 1.8 (1.1 to 2.6) near source",
        "puffs    10/s (2 to 60), share 0.2 (0.05 to 0.6)",
        "advice   hover 2 s for a reading of such gas: --dwell 2",
    ]
    assert outcome_text(outcome(*flight, intermittency=BURSTS)).splitlines() == told[:6]  # as long as it did
    assert outcome_text(outcome(*flight)).splitlines() == told[:4]  # the gas is taken to be known
    fields = json.loads(outcome_json(outcome(*flight, intermittency=BURSTS, advised_dwell_s=2.0), None))
    assert fields["intermittency"] == {name: list(values) for name, values in BURSTS.items()}
    assert fields["advised_dwell_s"] == 2.0
    assert json.loads(outcome_json(outcome(*flight, intermittency=BURSTS), None))["advised_dwell_s"] is None


def test_gas_of_which_little_is_known_has_no_name_yet() -> None:
    assert gas_lines({"downwind": (0.24, 1.0, 1.9)}, None)[0].startswith(
        "gas      may come and go: cv 1 (0.24"
    )


@pytest.mark.parametrize(
    ("cv", "words"),
    [(0.2, "is steady"), (0.5, "comes and goes"), (0.999, "comes and goes"), (1, "comes in bursts")],
)
def test_gas_is_named_by_its_median_cv(cv: float, words: str) -> None:
    assert gas_lines({"downwind": (0.05, cv, 1.4)}, None)[0].startswith(
        f"gas      {words}: cv {cv:.2g} (0.05 to 1.4)"
    )


def test_lines_of_the_gas_are_at_most_60_characters() -> None:
    """With the longest numbers: of cv up to 30, of rates within the prior's 8 sigmas, of shares."""
    for cv in (0.012345, 0.54321, 12.345, 30.0):
        for rate in (1.125e-5, 0.012345, 123.45, 123456.0, 8.9e8):
            said = {"downwind": (cv,) * 3, "puff-rate": (rate,) * 3, "puff-share": (0.023456,) * 3}
            assert max(map(len, gas_lines(said, 600.0))) <= 60


def test_a_share_that_is_known_is_not_told() -> None:
    assert gas_lines({"downwind": (0.5, 0.7, 0.9), "puff-rate": (10.0, 20.0, 30.0)}, 0.0) == [
        "gas      comes and goes: cv 0.7 (0.5 to 0.9) near source",
        "puffs    20/s (10 to 30)",
    ]


def test_puffs_of_steady_gas_are_not_told() -> None:
    assert gas_lines({"downwind": (0.1, 0.2, 0.3), "puff-rate": (10.0, 20.0, 30.0)}, 0.0) == [
        "gas      is steady: cv 0.2 (0.1 to 0.3) near source"
    ]


def test_the_lines_of_several_vehicles_say_who_measured_what_and_who_left_when_and_why() -> None:
    trace = [
        TracePoint((3.0, 4.0), 0.25, (5.0, 5.0), 1.0),
        TracePoint((9.0, 4.0), 1.5, (5.0, 5.0), 1.0, vehicle=2),
        TracePoint((3.0, 5.0), 0.75, (5.0, 5.0), 0.4),
    ]
    why = "no reading for 20 s: Gas sensor silent since the last of its values came"
    left = [Left(3, 0, "was killed by signal 9"), Left(2, 1, why)]
    result = outcome(1, "random", SCENARIO, trace, True, 0.1, "field", "spread:0.5", left=left)
    assert outcome_text(result).splitlines()[-6:] == [
        "uav/1    2 readings, at most 0.75",
        "uav/2    1 reading, at most 1.5",
        "         left at step 1: no reading for 20 s: Gas sensor",
        "         silent since the last of its values came",
        "uav/3    0 readings",
        "         left at step 0: was killed by signal 9",
    ]
    assert result.distances_m == (1.0, 0.0, 0.0)
