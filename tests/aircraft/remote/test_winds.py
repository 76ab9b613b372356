"""Protects where the wind of a reading comes from: given, measured or estimated, never drawn; without any
there is no flight.
"""

import pytest

from aircraft.remote.safety import Verdict
from aircraft.remote.winds import Winds, WindSource
from aircraft.search.options import parse_wind

SCENARIO, EAST, NORTH = (0.7, -2.0), (2.0, 0.0), (0.0, 3.0)
NO_DRAG = {"EK3_DRAG_BCOEF_X": 0.0, "EK3_DRAG_BCOEF_Y": 0.0, "EK3_DRAG_MCOEF": 0.0}


def begun(
    measured: tuple[float, float] | None,
    estimated: tuple[float, float] | None,
    given: tuple[float, float] | None = None,
    line: str = "",
) -> tuple[Winds, list[str]]:
    """Return winds that allow the flight, and what they tell people; line: what the list says of them."""
    news: list[str] = []
    winds = Winds(given, SCENARIO, lambda _, text: news.append(text))
    check = winds.before(measured, estimated, {"EK3_DRAG_MCOEF": 0.1}, "ArduCopter")
    assert check.verdict is Verdict.OK
    assert line in check.text
    return winds, news


def test_a_given_wind_is_told_as_sailors_do() -> None:
    """From the west it blows towards the east: it points to −x."""
    assert parse_wind("2.5,270") == pytest.approx((-2.5, 0.0), abs=1e-6)
    assert parse_wind("2.5,-90") == pytest.approx((-2.5, 0.0), abs=1e-6)
    assert parse_wind("4,0") == pytest.approx((0.0, 4.0))
    assert parse_wind("0,10") == (0.0, 0.0)


@pytest.mark.parametrize(
    "text", ["", "3", "3,", "a,b", "nan,0", "3,nan", "-1,0", "101,0", "3,361", "inf,0", "1,2,3"]
)
def test_a_wind_that_is_none_is_refused_with_what_is_wanted(text: str) -> None:
    with pytest.raises(ValueError, match=r"is not allowed; wanted SPEED,FROM: m/s from 0 to 100"):
        parse_wind(text)


@pytest.mark.parametrize(
    ("measured", "estimated", "given", "source", "wind"),
    [
        (NORTH, EAST, None, WindSource.PAYLOAD, NORTH),
        (None, EAST, None, WindSource.AUTOPILOT, EAST),
        (EAST, EAST, None, WindSource.AUTOPILOT, EAST),  # a simulated payload blows its plume with it
        (SCENARIO, None, None, WindSource.SCENARIO, SCENARIO),
        (NORTH, EAST, (0.0, 0.0), WindSource.GIVEN, (0.0, 0.0)),
        (None, None, NORTH, WindSource.GIVEN, NORTH),
    ],
)
def test_the_source_of_the_wind(
    measured: tuple[float, float] | None,
    estimated: tuple[float, float] | None,
    given: tuple[float, float] | None,
    source: WindSource,
    wind: tuple[float, float],
) -> None:
    winds, news = begun(measured, estimated, given, source.value)
    assert winds.source is source
    assert winds.of(measured, estimated) == wind
    assert not news


@pytest.mark.parametrize(
    ("firmware", "named"),
    [("ArduCopter", "EK3_DRAG_BCOEF_X, EK3_DRAG_BCOEF_Y, EK3_DRAG_MCOEF"), ("PX4", "EKF2_DRAG_CTRL")],
)
def test_without_any_wind_there_is_no_flight_and_what_to_set_is_told(firmware: str, named: str) -> None:
    _, verdict, reason = Winds(None, SCENARIO, print).before(None, None, NO_DRAG, firmware)
    assert verdict is Verdict.FORBIDS
    for words in (named, "a payload that measures it", "--wind SPEED,FROM"):
        assert words in reason
    assert "\n" not in reason


def test_an_autopilot_that_will_estimate_it_in_flight_may_fly() -> None:
    """On the ground it estimates none."""
    for parameters, firmware, verdict in (
        (NO_DRAG, "ArduCopter", Verdict.FORBIDS),
        ({}, "PX4", Verdict.FORBIDS),
        ({**NO_DRAG, "EK3_DRAG_BCOEF_Y": 20.0}, "ArduCopter", Verdict.OK),
        ({"EKF2_DRAG_CTRL": 1.0}, "PX4", Verdict.OK),
    ):
        assert Winds(None, SCENARIO, print).before(None, None, parameters, firmware).verdict is verdict
    winds, news = begun(None, None, line="estimated by the autopilot, once it flies")
    assert winds.of(None, EAST) == EAST
    assert not news


def test_a_payload_that_stops_measuring_the_wind_is_replaced_by_the_autopilot_and_that_is_told() -> None:
    winds, news = begun(NORTH, EAST)
    assert winds.of(None, EAST) == EAST
    assert news[-1] == "Wind of the readings: now estimated by the autopilot, 2.0 m/s from 90°"


def test_when_all_sources_are_quiet_there_is_no_wind_and_it_is_told_once() -> None:
    winds, news = begun(NORTH, None)
    assert winds.of(None, None) is None
    assert winds.of(None, None) is None
    assert [text for text in news if "no readings until one does" in text] == [news[-1]]
    assert winds.of(NORTH, None) == NORTH
    assert "now measured by the payload" in news[-1]
