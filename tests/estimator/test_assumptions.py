"""Protects the named assumptions: which priors they give, how given priors replace them, and what is
refused.
"""

import math
from typing import get_args, get_type_hints

import pytest

from estimator.assumptions import ASSUMPTIONS, effective_priors
from estimator.filter import Config
from estimator.priors import Fixed, Gamma, LogNormal, Normal, Prior, Uniform
from link import cli
from plume.kernels import is_intermittent
from plume.parameters import (
    CV,
    NOISE,
    PARAMETERS,
    PHI,
    PUFF_RATE,
    PUFF_SHARE,
    TAU,
    WIND_DIRECTION,
    WIND_SPEED,
    D,
    Q,
    U,
)
from plume.sensors.names import GAUSSIAN, Sensor
from plume.sensors.sensor import Gaussian, Hits, Threshold
from sitl.script.script import EstimatorPart

FIELD = ("x", "y", "q", "tau", "wind-direction", "wind-speed", "noise", "cv", "puff-rate", "puff-share")
INTERMITTENCY = {"cv", "puff-rate", "puff-share"}


def test_flags_scripts_and_the_estimator_know_the_same_assumptions() -> None:
    assert set(cli.ASSUMPTIONS) == set(ASSUMPTIONS)
    assert set(get_args(get_type_hints(EstimatorPart)["assume"])) == set(ASSUMPTIONS)


def test_the_paper_takes_all_but_the_position_to_be_known() -> None:
    assert effective_priors("paper", {}, 300.0, 10.0, GAUSSIAN) == {}
    assert Config().unknowns == Config(assume="paper").unknowns == ("x", "y")


def test_in_the_field_what_is_told_is_the_middle_of_a_prior() -> None:
    config = Config(rate=250.0, lifetime=8.0, assume="field")
    assert config.unknowns == FIELD
    rows = config.prior_rows
    assert rows.shape == (15, 5)
    assert [math.exp(rows[index, 1]) for index in (Q, TAU, WIND_SPEED, NOISE, PUFF_RATE)] == pytest.approx(
        [250.0, 8.0, 1.0, 1.0, 100.0]
    )
    assert rows[WIND_DIRECTION, 1] == 0.0
    assert (rows[CV, 3], rows[CV, 4]) == (0.0, 3.0)  # a normal prior around 0 that cannot go below it
    assert rows[PUFF_SHARE, 1:].tolist() == [0.02, 1.0, 0.02, 1.0]
    assert rows[D, :2].tolist() == [0.0, 4.5]  # known: it is redundant to the others


@pytest.mark.parametrize(
    ("sensor", "lacks"),
    [(GAUSSIAN, set()), (Threshold(), INTERMITTENCY), (Hits(), {"noise"} | INTERMITTENCY)],
)
def test_noise_and_intermittency_are_unknown_for_the_sensors_that_have_them(
    sensor: Sensor, lacks: set[str]
) -> None:
    assert set(Config(assume="field", sensor=sensor).unknowns) == set(FIELD) - lacks


def test_gas_is_steady_only_if_it_has_no_cv_of_its_own_and_infinitely_many_puffs() -> None:
    assert not is_intermittent(Config().prior_rows)
    assert not is_intermittent(Config(assume="field", sensor=Hits()).prior_rows)
    for priors in ({"cv": Fixed(0.5)}, {"cv": Normal(0.0, 1.0)}, {"puff-rate": Fixed(1e6)}):
        assert is_intermittent(Config(priors=priors).prior_rows)
        assert is_intermittent(Config(priors={"puff-rate": Fixed(math.inf), **priors}).prior_rows)
    known = {"cv": Fixed(0.0), "puff-rate": Fixed(math.inf)}
    assert not is_intermittent(Config(assume="field", priors=known).prior_rows)


def test_what_is_known_has_the_value_of_a_faultless_measurement() -> None:
    for sensor, cv in ((GAUSSIAN, 0.0), (Gaussian(cv=0.5), 0.5), (Threshold(), 0.0), (Hits(), 0.0)):
        rows = Config(sensor=sensor).prior_rows
        assert dict(zip(PARAMETERS[8:], rows[8:, :2].tolist(), strict=True)) == {
            "wind-direction": [0.0, 0.0],
            "wind-speed": [0.0, 1.0],
            "gain": [0.0, 1.0],
            "noise": [0.0, 1.0],
            "cv": [0.0, cv],
            "puff-rate": [0.0, math.inf],
            "puff-share": [0.0, 0.2],
        }


@pytest.mark.parametrize(
    ("given", "name", "prior"),
    [
        ({"q": Fixed(300.0)}, "q", Fixed(300.0)),
        ({"tau": Uniform(5.0, 15.0)}, "tau", Uniform(5.0, 15.0)),
        ({"cv": Fixed(0.4)}, "cv", Fixed(0.4)),
        ({"puff-rate": Fixed(40.0)}, "puff-rate", Fixed(40.0)),
        ({"gain": LogNormal(1.0, 0.2)}, "gain", LogNormal(1.0, 0.2)),
        ({"d": Gamma(4.0, 1.0)}, "d", Gamma(4.0, 1.0)),
    ],
    ids=str,
)
def test_a_given_prior_replaces_the_assumptions_and_leaves_the_others(
    given: dict[str, Prior], name: str, prior: Prior
) -> None:
    usual = effective_priors("field", {}, 300.0, 10.0, GAUSSIAN)
    assert effective_priors("field", given, 300.0, 10.0, GAUSSIAN) == {**usual, name: prior}
    unknown = set(Config(assume="field", priors=given).unknowns)
    assert unknown ^ set(FIELD) == ({name} & set(FIELD) if isinstance(prior, Fixed) else {name} - set(FIELD))


@pytest.mark.parametrize(
    ("absolute", "index", "relative"), [("u", U, "wind-speed"), ("phi", PHI, "wind-direction")]
)
def test_an_absolute_prior_of_the_wind_stands_for_that_of_its_measurement(
    absolute: str, index: int, relative: str
) -> None:
    config = Config(assume="field", priors={absolute: Normal(2.0, 0.5)})
    assert set(config.unknowns) == set(FIELD) - {relative} | {absolute}
    assert config.prior_rows[index, 1:3].tolist() == [2.0, 0.5]


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"assume": "feild"}, "assume 'feild' is not allowed; wanted paper or field"),
        ({"priors": {"wind": Fixed(1.0)}}, "a prior of 'wind' is not allowed; wanted x, y, z, q, "),
        (
            {"priors": {"u": Fixed(2.0), "wind-speed": Fixed(1.1)}},
            "a prior of wind-speed is not allowed with one of u, which ignores",
        ),
        (
            {"priors": {"phi": Normal(0, 1), "wind-direction": Normal(0, 9)}},
            "a prior of wind-direction is not allowed with one of phi",
        ),
        (
            {"priors": {"noise": Fixed(2.0)}, "sensor": Hits()},
            "a prior of noise is not allowed with the hits sensor",
        ),
        ({"priors": {"cv": Fixed(0.5)}, "sensor": Hits()}, "a prior of cv is not allowed with this sensor"),
        (
            {"priors": {"cv": Normal(0, 1)}, "sensor": Threshold()},
            "a prior of cv is not allowed with this sensor",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
@pytest.mark.parametrize("assume", ["paper", "field"])
def test_what_means_nothing_is_refused_in_one_line(assume: str, settings: dict, line: str) -> None:
    with pytest.raises(ValueError, match="is not allowed") as refused:
        Config(**{"assume": assume, **settings})
    assert str(refused.value).startswith(line)
    assert "wanted" in str(refused.value)
    assert "\n" not in str(refused.value)
