"""Protects readings from a position that jumps: none is taken while it is wrong, the vehicle stays, and
the stop is warned of.
"""

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from aircraft.remote.glitches import SHIFTED_S, SOUND_S, Fix, Glitches, innovation, margin_m
from aircraft.remote.known import Known
from aircraft.search.search import SEARCHING
from tests.aircraft.remote.cockpit import Cockpit, away_m
from tests.autopilots.gps import JUMP_M

KINDS = ("ardupilot", "px4")
both = pytest.mark.parametrize("kind", KINDS)
FAR_M = math.hypot(*JUMP_M)


def searching(kind: str, *faults: str, readings: int = 2, **settings: Any) -> Cockpit:
    cockpit = Cockpit(kind, *faults, **settings)
    cockpit.reads(readings)
    return cockpit


def at(boot_ms: int, north: float, north_mps: float = 0.0) -> Fix:
    return Fix(boot_ms, (north, 0.0, -5.0), (north_mps, 0.0, 0.0))


def flown(*fixes: Fix) -> Glitches:
    """A vehicle in the air that has said these, each at its own time."""
    glitches = Glitches()
    glitches.flies(True)
    for fix in fixes:
        glitches.moved(fix, fix.boot_ms / 1000.0)
    return glitches


# ---- the rule ----


def test_an_innovation_is_what_velocities_and_time_do_not_explain() -> None:
    """From 1 to 3 m/s in 0.5 s is 1 m."""
    assert innovation(at(1000, 10.0, 1.0), at(1500, 11.0, 3.0)) == pytest.approx((0.0, 0.0))
    assert innovation(at(1000, 10.0, 1.0), at(1500, 15.5, 3.0)) == pytest.approx((4.5, 0.0))


def test_the_margin_grows_with_the_time_between_two_reports_and_with_the_speed() -> None:
    """1 m; 5 m/s² for half a second and back in the other half are 1.25 m; a tenth of 4 m/s in 1 s is 0.4
    m.
    """
    assert margin_m(at(0, 0.0), at(50, 0.0)) == pytest.approx(1.0, abs=0.01)
    assert margin_m(at(0, 0.0), at(1000, 0.0)) == pytest.approx(2.25)
    assert margin_m(at(0, 0.0, 4.0), at(1000, 0.0, 0.0)) == pytest.approx(2.65)


def test_a_clock_that_wraps_counts_on() -> None:
    assert innovation(at(2**32 - 25, 0.0, 2.0), at(25, 0.1, 2.0)) == pytest.approx((0.0, 0.0))


@pytest.mark.parametrize(
    "fixes",
    [
        (at(0, 0.0), at(50, 0.9)),  # a small reset
        (
            at(0, 0.0),
            at(1050, 2.0),
        ),  # a second is lost in which it flew 2 m and stopped: 0.7 s at 5 m/s² speed up, and as long down
        (at(0, 0.0, 4.0), at(250, 1.0, 4.0), at(500, 2.0, 4.0)),
        (
            at(0, 0.0, 4.0),
            at(100, 0.4, 4.0),
            at(50, 0.2, 4.0),
            at(150, 0.6, 4.0),
        ),  # one has overtaken another
        (at(0, 0.0), at(50, 0.0), at(50, 30.0)),  # of one time only one counts
    ],
    ids=["reset", "gap", "lost", "overtaken", "twice"],
)
def test_what_is_no_jump_is_not_taken_for_one(fixes: tuple[Fix, ...]) -> None:
    glitches = flown(*fixes)
    assert not glitches.lasts(fixes[-1].boot_ms / 1000.0)
    assert glitches.shift == (0.0, 0.0)
    assert not glitches.caveat


@pytest.mark.parametrize("gap_ms", [33, 50, 1000])
def test_a_jump_of_33_m_is_seen_even_after_a_lost_second(gap_ms: int) -> None:
    glitches = flown(at(1000, 5.0, 1.0), at(1000 + gap_ms, 38.0, 1.0))
    assert glitches.lasts(1.0 + gap_ms / 1000.0)
    assert glitches.shift[0] == pytest.approx(33.0 - gap_ms / 1000.0)


def test_an_older_position_does_not_replace_a_newer_one() -> None:
    known = Known()
    for boot_ms, north in ((1000, 1.0), (1100, 1.4), (1050, 1.2)):
        known.take(
            mavlink.MAVLink_local_position_ned_message(boot_ms, north, 0.0, -5.0, 4.0, 0.0, 0.0),
            boot_ms / 1000.0,
        )
    assert known.position[0] == pytest.approx(1.4)
    assert known.boot_ms == 1100


def test_it_is_over_once_it_has_jumped_back_and_been_sound_for_some_seconds() -> None:
    glitches = flown(at(0, 0.0), at(50, 33.0), at(2000, 33.0), at(2050, 0.5))
    assert not glitches.is_shifted
    assert glitches.lasts(2.05 + SOUND_S - 0.1)
    glitches.look(2.05 + SOUND_S + 0.1)
    assert not glitches.lasts(2.05 + SOUND_S + 0.1)
    assert [text.split(":")[0].split(" after")[0] for text in glitches.news] == [
        "GPS glitch",
        "GPS glitch",
        "GPS glitch is over",
    ]
    assert glitches.caveat == "GPS glitches in this flight: 1"


def test_a_place_that_has_stayed_shifted_is_awaited_for_longer_and_told() -> None:
    glitches = flown(at(0, 0.0), at(50, 33.0))
    assert glitches.lasts(SHIFTED_S - 0.1)
    glitches.look(SHIFTED_S + 0.1)
    assert "33.0 m off from now on" in glitches.news[-1]
    assert "33.0 m off from now on" in glitches.caveat


def test_a_jump_back_after_a_long_time_is_the_same_glitch() -> None:
    glitches = flown(at(0, 0.0), at(50, 33.0))
    glitches.look(SHIFTED_S + 1.0)
    for boot_ms, north in ((90_000, 33.0), (90_050, 0.0)):
        glitches.moved(at(boot_ms, north), boot_ms / 1000.0)
    assert glitches.news[-1].startswith("GPS glitch: the position has jumped back by 33.0 m; no readings")
    glitches.look(90.05 + SOUND_S)
    assert glitches.caveat == "GPS glitches in this flight: 1"


def test_what_jumps_on_the_ground_is_no_glitch_but_delays_the_arming() -> None:
    glitches = flown(at(0, 0.0))
    glitches.flies(False)
    glitches.moved(at(50, 33.0), 0.05)
    assert glitches.lasts(1.0)
    assert glitches.shift == (0.0, 0.0)
    assert not glitches.caveat


@pytest.mark.parametrize(
    "text",
    [
        "GPS Glitch or Compass error",
        "GPS Glitch",
        "EKF variance",
        "EKF primary changed:1",
        "EKF3 lane switch 1",
        "GNSS data fusion stopped",
    ],
)
def test_the_autopilots_own_words_begin_a_glitch(text: str) -> None:
    glitches = flown()
    glitches.hear(text, 10.0)
    assert glitches.lasts(10.0 + SOUND_S - 0.1)
    assert glitches.caveat


def test_its_own_word_ends_a_glitch() -> None:
    glitches = flown()
    glitches.hear("GPS Glitch or Compass error", 10.0)
    glitches.hear("Glitch cleared", 11.0)
    assert not glitches.lasts(11.0)


def ekf(variance: float, flags: int = 831) -> Any:
    return mavlink.MAVLink_ekf_status_report_message(flags, 0.1, variance, 0.1, 0.1, 0.0)


def estimator(ratio: float, flags: int = 831) -> Any:
    return mavlink.MAVLink_estimator_status_message(
        0, flags, 0.1, ratio, 0.1, 0.1, math.nan, math.nan, 0.3, 0.4
    )


def test_a_variance_that_stays_too_large_is_a_glitch_and_a_short_one_only_delays_a_reading() -> None:
    for is_ardupilot, report, bad, good in ((True, ekf, 0.8, 0.79), (False, estimator, 1.0, 0.99)):
        glitches = flown()
        glitches.judge(report(good), is_ardupilot, 0.0)
        assert not glitches.lasts(0.0)
        glitches.judge(report(bad), is_ardupilot, 1.0)
        assert glitches.lasts(1.0)
        assert not glitches.caveat
        glitches.judge(report(good), is_ardupilot, 1.2)
        glitches.judge(report(bad), is_ardupilot, 5.0)
        glitches.judge(report(bad), is_ardupilot, 6.0)
        assert glitches.caveat


def test_the_flag_of_each_autopilot_is_its_own_one() -> None:
    """1024 is PX4's glitch, and ArduPilot's filter that is not initialised; 32768 is ArduPilot's glitch."""
    for is_ardupilot, report, flag, other in ((True, ekf, 32768, 1024), (False, estimator, 1024, 32768)):
        glitches = flown()
        glitches.judge(report(0.1, 831 | other), is_ardupilot, 0.0)
        assert not glitches.lasts(0.0)
        glitches.judge(report(0.1, 831 | flag), is_ardupilot, 1.0)
        assert glitches.lasts(1.0)


# ---- a search ----


def truly_where_told(cockpit: Cockpit) -> bool:
    """Noise of 0.03 m, and jumps that are known to some cm."""
    return all(
        away_m(told, true) < 0.3 for (_, told), true in zip(cockpit.readings, cockpit.truths, strict=True)
    )


@both
def test_a_gps_glitch_costs_time_and_no_reading_is_off(kind: str) -> None:
    """It lasts for 20 s: the EKF follows it after 10 s, or 7, and follows it back as much later."""
    cockpit = searching(kind, "glitch@#3:20")
    began_s = cockpit.now_s
    before = len(cockpit.readings)
    cockpit.until(lambda: cockpit.heard("GPS glitch is over"), 200.0)
    assert len(cockpit.readings) <= before + 1
    assert cockpit.now_s - began_s > 30.0
    cockpit.reads(before + 5)
    assert truly_where_told(cockpit)
    assert cockpit.search.state == SEARCHING
    assert not cockpit.vehicle.failure
    assert sum(said.startswith("GPS glitch is over") for said in cockpit.said) == 1, (
        "both jumps are one event"
    )
    assert "jumped back" in "".join(cockpit.said)


@both
@pytest.mark.parametrize("faults", [("jump@#3:8",), ("jump@#3:8", "drop:20")], ids=["heard", "a fifth lost"])
def test_a_jump_without_a_word_is_seen(kind: str, faults: tuple[str, ...]) -> None:
    cockpit = searching(kind, *faults)
    cockpit.until(lambda: cockpit.heard("the position has jumped by 3"))
    count = len(cockpit.readings)
    cockpit.until(lambda: cockpit.heard("GPS glitch is over"))
    assert len(cockpit.readings) == count
    cockpit.reads(count + 4)
    assert truly_where_told(cockpit)


@both
def test_the_vehicle_stays_where_it_is_when_its_position_jumps(kind: str) -> None:
    cockpit = searching(kind, "jump@#3")
    place = tuple(cockpit.ap.body.position)
    cockpit.until(lambda: cockpit.heard("GPS glitch is over"))
    assert away_m(place, cockpit.ap.body.position) < 2.0, (
        "the rest of its way of 1 m, and what it drifted at first"
    )


@both
def test_a_position_that_has_stayed_shifted_is_told_for_the_rest_and_the_places_stay_true(kind: str) -> None:
    cockpit = searching(kind, "jump@#3")
    cockpit.until(lambda: cockpit.heard("m off from now on"))
    cockpit.reads(len(cockpit.readings) + 4)
    assert truly_where_told(cockpit)
    assert "may be 3" in cockpit.vehicle.caveat


@pytest.mark.one_in(3)
@both
@pytest.mark.parametrize(
    "faults", [("drop:20",), ("mute@#3:1",), ("mute@#4:1", "drop:20"), ("silence@#3:1.5",)], ids=str
)
def test_lost_datagrams_are_no_glitch(kind: str, faults: tuple[str, ...]) -> None:
    cockpit = searching(kind, *faults, seed=5)
    cockpit.reads(10)
    assert not cockpit.heard("glitch")
    assert not cockpit.vehicle.caveat


@both
def test_a_reading_just_before_a_glitch_is_told_to_be_doubtful(kind: str) -> None:
    cockpit = searching(kind)
    cockpit.reads(3)
    strike(cockpit, "jump")
    cockpit.until(lambda: cockpit.heard("may be off"))
    assert "readings taken just before it was noticed, which may be off: 1" in cockpit.vehicle.caveat


def strike(cockpit: Cockpit, name: str) -> None:
    """Let a fault strike now, for ever."""
    from tests.autopilots.faults import Fault

    cockpit.ap.faults.all.append(Fault(name, argument="inf"))


@both
def test_a_stop_after_a_glitch_is_warned_of(kind: str) -> None:
    cockpit = searching(kind, "jump@#3:5")
    cockpit.until(lambda: cockpit.heard("GPS glitch is over"))
    cockpit.finds()
    found = next(n for n, said in enumerate(cockpit.said) if said.startswith("Source found at"))
    assert cockpit.said[found + 1].startswith("The source may be elsewhere: GPS glitches in this flight: 1")


@both
def test_a_stop_without_a_glitch_is_not(kind: str) -> None:
    cockpit = searching(kind)
    cockpit.finds()
    assert not cockpit.heard("elsewhere")


def test_a_glitch_that_never_ends_ends_the_search() -> None:
    cockpit = searching("ardupilot")
    cockpit.ap.gps.ratios = lambda: (0.1, 2.0, 0.1, 0.1)
    assert cockpit.fails(400.0).startswith("GPS glitch for 12")
    assert cockpit.ap.landed
