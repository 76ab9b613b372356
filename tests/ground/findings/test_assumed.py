"""Protects what findings say of the estimator without importing it: priors and limits are the estimator's own."""

from pathlib import Path

import numpy as np
import pytest

from estimator import assumptions, belief
from estimator.__main__ import main
from estimator.assumptions import effective_priors
from estimator.priors import text
from ground.findings import assumed, verdict
from ground.findings.assumed import FIELD, WORDS, stop_text, told_of, unit_of
from ground.replay.source import table
from plume.parameters import PARAMETERS
from plume.sensors import names
from plume.sensors.names import KINDS
from tests.ground.findings.records import FOUND, GOLDEN, findings

LAWNMOWER = Path(__file__).parents[3] / "docs" / "examples" / "lawnmower.csv"


@pytest.mark.parametrize("sensor", KINDS.values(), ids=KINDS)
def test_the_priors_of_field_are_the_estimators(sensor: names.Sensor) -> None:
    priors = effective_priors("field", {}, 250.0, 12.0, sensor)
    wanted = {name: text(name, prior).partition("=")[2] for name, prior in priors.items()}
    assert {name: FIELD[name].format(rate=250.0, lifetime=12.0) for name in wanted} == wanted


def test_no_prior_of_field_is_of_no_sensor() -> None:
    of_some = [effective_priors("field", {}, 250.0, 12.0, sensor) for sensor in KINDS.values()]
    assert set().union(*of_some) == set(FIELD)


def test_limits_and_shares_are_the_estimators() -> None:
    assert (verdict.INCOMPATIBLE, verdict.CLEAR) == (belief.INCOMPATIBLE, belief.CLEAR)
    assert dict(assumed.SPIKES) == dict(assumptions.SPIKES)
    assert dict(assumed.MARGIN) == dict(assumptions.MARGIN)


def test_without_a_flag_rate_and_lifetime_are_the_estimators_own(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(arguments=["--help"])
    said = " ".join(capsys.readouterr().out.split())
    it = findings()
    rows = {
        row.name: row.words for row in told_of(it.last, {"parts": {"estimator": ["--sysid", "1"]}}).priors
    }
    for name, words in (("q", "release rate q, g/s"), ("tau", "lifetime τ of the gas, s")):
        told = said.partition(f"{words} (default: ")[2].partition(")")[0]
        assert f"median {told}," in rows[name]


def test_every_parameter_has_words_and_a_unit() -> None:
    assert set(WORDS) == set(PARAMETERS)
    assert set(FIELD) < set(WORDS)


def test_the_priors_of_a_record_are_those_of_its_unknowns() -> None:
    it = findings()
    told = told_of(it.last, it.flight.about)
    assert {row.name for row in told.priors} == set(it.last.unknowns)
    rate = it.flight.about["scenario"]["q"]
    [row] = [row for row in told.priors if row.name == "q"]
    assert row.words == f"log-normal, median {rate:.6g}, standard deviation of the logarithm 0.7"


def test_a_given_prior_stands_in_place_of_the_assumptions() -> None:
    it = findings()
    about = {"parts": {"estimator": ["--assume", "field", "--prior", "q=gamma:2,150", "--margin", "4"]}}
    told = told_of(it.last, about)
    [row] = [row for row in told.priors if row.name == "q"]
    assert (row.given, row.words) == (True, "gamma, shape 2, scale 150")
    assert told.margin_m == 4.0


def test_the_rate_of_a_log_that_tells_none_was_not_given() -> None:
    about = table(LAWNMOWER, {"columns": "gasflux"}, {}).about
    [row] = [row for row in told_of(findings().last, about).priors if row.name == "q"]
    assert (row.given, row.words) == (False, "log-normal, median 0.28, standard deviation of the logarithm 2")


def test_the_prior_of_a_problem_was_given() -> None:
    it = findings()
    about = {"problem": {"prior": {"low": [5, 5], "high": [20, 25]}}}
    rows = [row for row in told_of(it.last, about).priors if row.name in ("x", "y")]
    assert [(row.given, row.words) for row in rows] == [(True, "anywhere in [5, 20] x [5, 25] m")] * 2
    assert not any(row.given for row in it.told.priors if row.name in ("x", "y"))


def test_under_paper_only_the_place_has_a_prior() -> None:
    it = findings(GOLDEN / "homing-gaussian.mcap")
    assert [row.name for row in it.told.priors] == ["x", "y"]
    assert it.told.margin_m == 0.0


@pytest.mark.parametrize(
    ("sensor", "unit"),
    [("gaussian", "g/m³"), ("hits", "hits"), ("tgs2620", "RS/R0"), ("tdlas", "g/m²"), ("threshold", "g/m³")],
)
def test_readings_have_the_unit_of_their_sensor(sensor: str, unit: str) -> None:
    assert unit_of(names.parse(sensor)) == unit


def test_a_stop_is_told_in_words() -> None:
    assert stop_text("spread:0.5") == "the spread of the belief is below 0.5 m"
    assert stop_text("within:1,0.99") == "at least 99% of the belief lies within 1 m of the estimate"


def test_the_wind_is_told_as_whence_clockwise_from_north_and_what_was_believed_turns_with_it() -> None:
    it = findings(FOUND)
    east, north = it.flight.samples[0].wind
    assert it.wind.from_deg == pytest.approx(np.degrees(np.arctan2(east, north)) % 360)
    turned = it.last.means[it.last.unknowns.index("wind-direction")]  # counter-clockwise
    assert it.wind.believed_from
    assert it.wind.believed_from.value == pytest.approx(it.wind.from_deg - turned)
    low, high = it.wind.believed_from.low, it.wind.believed_from.high
    assert low is not None
    assert high is not None
    assert low < it.wind.believed_from.value < high
