"""Protects the sentence of state: it is true, in plain words, and says how long still only where that is known."""

import math
from dataclasses import replace
from pathlib import Path
from statistics import median

import pytest

from link.record.reader import read
from plume.scenario import stretch
from scene.follow.history import history_of
from scene.scene import Backdrop, Condition, Craft, Ending, Happening, Measurement, Release, Scene, Service
from scene.state import moves_left, state_of, target_radius_m

GOLDEN = Path(__file__).parents[1] / "golden"
HOME = (51.4494, -2.6023, 80.0)


def measured(step: int, spread_m: float, p_value: float = 1.0) -> Measurement:
    return Measurement(
        step,
        2.0 * step,
        (float(step), 0.0),
        1.0,
        spread_m,
        (20.0, 10.0),
        (1.0, 0.0, 1.0),
        radius_95_m=1.6 * spread_m,
        rate=(0.05, 0.1, 0.2),
        p_value=p_value,
    )


SCENE = Scene(
    Backdrop("uav/1"),
    time_s=10.0,
    craft=Craft(10.0, (5.0, 0.0), 5.0, mode="OFFBOARD", armed=True),
    measurements=[measured(step, 8.0 / (step + 1)) for step in range(5)],
    stop="spread:0.5",
    services=(Service("uav", "ok", "searching"), Service("estimator", "ok"), Service("agent", "ok")),
    home=HOME,
    silent_s=0.1,
)


def said(**changes: object) -> tuple[str, str, str]:
    state = state_of(replace(SCENE, **changes))  # type: ignore[arg-type]
    return state.kind, state.level, state.text


def flown(state: str, mode: str = "OFFBOARD") -> dict[str, object]:
    services = (Service("uav", "ok", state), *SCENE.services[1:])
    return {"services": services, "craft": Craft(10.0, (5.0, 0.0), 5.0, mode=mode, armed=True)}


def test_a_search_says_how_sure_it_is_when_it_stops_and_about_how_long_still() -> None:
    # A round Gaussian of spread s has 95% within s √(−ln 0.05) = 1.73 s: 0.87 m at the stop.
    # From 1.6 m to 0.5 m: 7.7 ln 3.2 = 9.0 moves, of 2 s each.
    state = state_of(SCENE)
    assert state.text == (
        "Searching: the source is within 2.6 m of the cross (95%); stops at about 0.87 m; about 9 moves more"
    )
    assert (state.kind, state.level, state.moves_left, state.seconds_left) == ("searching", "good", 9, 18.0)


def test_in_gas_that_comes_and_goes_it_stops_at_less() -> None:
    # For a cv of 0.6 the errors may be √(1.3 / 0.7) = 1.363 times wider: 0.8654 m / 1.363 = 0.635 m.
    # From 1.6 m to 0.5 m / 1.363: 7.7 ln 4.361 = 11.3 moves.
    last = replace(SCENE.measurements[-1], stretch=stretch(0.6))
    state = state_of(replace(SCENE, measurements=(*SCENE.measurements[:-1], last)))
    assert state.text.endswith("; stops at about 0.64 m; about 10 moves more")
    assert state.moves_left == 11


def test_what_is_not_known_is_left_out() -> None:
    state = state_of(replace(SCENE, stop="something:else"))
    assert state.text == "Searching: the source is within 2.6 m of the cross (95%)"
    assert state.moves_left is state.seconds_left is None


@pytest.mark.parametrize(
    ("changes", "kind", "begins"),
    [
        (flown("paused", "HOLD"), "paused", "Paused: it stays here"),
        (flown("paused", "POSITION"), "pilot", "A pilot flies it (Position)"),
        (flown("returning", "RTL"), "returning", "Returning home"),
        (flown("searching", "LAND"), "landing", "Landing"),
        (flown("landed", "HOLD"), "landed", "Landed"),
        ({**flown("standby"), "measurements": []}, "waiting", "On the ground"),
        ({**flown("taking off"), "measurements": []}, "searching", "Taking off: no reading yet"),
        ({"measurements": [measured(9, 2.0, 1e-6)]}, "doubtful", "Doubtful: the readings do not fit a plume"),
        ({"silent_s": 12.4}, "lost", "Lost link: nothing heard from the vehicle for 12 s"),
        (
            {"services": (*SCENE.services[:2], Service("agent", "missing"))},
            "stuck",
            "Waiting: the agent is not there",
        ),
        (
            {"services": (Service("uav", "stale", "searching"), *SCENE.services[1:])},
            "lost",
            "Lost link: the part that flies",
        ),
    ],
)
def test_each_state_has_its_words(changes: dict[str, object], kind: str, begins: str) -> None:
    found, _, text = said(**changes)
    assert found == kind
    assert text.startswith(begins)


@pytest.mark.parametrize(
    ("state", "mode", "kind", "text"),
    [
        ("holding", "LOITER", "pilot", "A pilot flies it (Loiter): it has left the search"),
        ("holding", "BRAKE", "holding", "It stays here: it has left the search"),
        ("returning", "RTL", "returning", "Returning home: it has left the search"),
        ("returning", "LAND", "returning", "Returning home: it has left the search"),
        ("landed", "RTL", "returning", "Returning home: it has left the search"),
        ("landed", "HOLD", "landed", "Landed: it has left the search"),
    ],
)
def test_one_that_has_left_the_search_of_several_is_not_said_to_have_ended_it(
    state: str, mode: str, kind: str, text: str
) -> None:
    found, _, told = said(**flown(state, mode), left=True)
    assert (found, told) == (kind, text)


@pytest.mark.parametrize(
    "changes", [flown("landed", "HOLD"), {**flown("returning", "RTL"), "left": True}], ids=["landed", "left"]
)
def test_of_one_that_searches_no_more_nothing_is_said_of_moves_that_are_left(
    changes: dict[str, object],
) -> None:
    state = state_of(replace(SCENE, **changes))  # type: ignore[arg-type]
    assert state.moves_left is state.seconds_left is None
    assert state_of(replace(SCENE, **flown("paused", "HOLD"))).moves_left == 9  # type: ignore[arg-type]


def test_it_is_told_who_paused() -> None:
    page = Happening(9.0, "warning", "uav", "Search gives way: HOLD by 255/190 on the bus")
    assert said(**flown("paused", "HOLD"), happenings=[page])[2].startswith("Paused by the operator: ")
    pilot = replace(page, text="Search gives way: BRAKE by the autopilot or its pilot")
    assert said(**flown("paused", "BRAKE"), happenings=[pilot])[2].startswith(
        "Paused by the autopilot or its pilot: "
    )


@pytest.mark.parametrize(
    ("verdict", "kind", "level", "begins"),
    [
        ("located", "found", "good", "Found: 51.4494"),
        ("ceased", "found", "calm", "Found: 51.4494"),
        ("FALSE STOP", "false", "bad", "False stop: the source is not at 51.4494"),
        ("outside", "outside", "warn", "Outside: the source is not in the area; most likely at 51.4494"),
        ("not ceased", "spent", "warn", "Not found: the moves are spent; the source is within 2.6 m"),
    ],
)
def test_each_end_has_its_words(verdict: str, kind: str, level: str, begins: str) -> None:
    found, how, text = said(ending=Ending(verdict, "after 4 steps"))
    assert (found, how) == (kind, level)
    assert text.startswith(begins)


def test_a_find_says_where_how_sure_and_how_much_and_can_be_copied() -> None:
    state = state_of(replace(SCENE, ending=Ending("located", "after 4 steps")))
    # 10 m north is 10 / 111,194.9 degrees; 20 m east is 20 / (111,194.9 cos 51.4494°). 0.1 g/s is 0.36 kg/h.
    assert state.text == "Found: 51.449490 N, 2.602011 W, ± 2.6 m (95%); 0.36 kg/h (90%: 0.18 to 0.72)"
    latitude, longitude = map(float, state.copy.split(", "))
    assert (latitude, longitude) == pytest.approx((51.4494899, -2.6020114), abs=2e-7)
    assert state.moves_left is None
    homeless = state_of(replace(SCENE, home=None, ending=Ending("located", "after 4 steps")))
    assert homeless.text.startswith("Found: 20.0 m east, 10.0 m north of home, ")
    assert homeless.copy == ""


def test_what_to_watch_is_told_the_worst_first_and_nothing_twice() -> None:
    ailing = Condition(battery=0.11, gps="no fix, 3 satellites", ailing=("gps",))
    services = (*SCENE.services[:2], Service("agent", "refusing", warnings=("hot",)))
    notes = state_of(
        replace(SCENE, craft=replace(SCENE.craft, condition=ailing), services=services)  # type: ignore[type-var]
    ).notes
    assert notes == (
        "battery 11%",
        "GPS: no fix, 3 satellites",
        "not healthy: gps",
        "agent is refusing",
        "hot",
    )
    assert state_of(SCENE).notes == ()


def test_only_a_simulation_tells_whether_the_find_is_right() -> None:
    ended = replace(SCENE, ending=Ending("ceased", "after 4 steps"))
    assert state_of(ended).notes == ()
    told = replace(ended, backdrop=Backdrop("uav/1", release=Release((1.0, 1.0), (1.0, 0.0), 1.0, 1.0, 1.0)))
    assert state_of(told).notes == ("ceased: after 4 steps",)


def test_a_stop_by_share_is_compared_with_the_same_radius() -> None:
    # 99% of a round Gaussian within 1 m: 95% within √(ln 0.05 / ln 0.01).
    assert target_radius_m("within:1,0.99") == pytest.approx(math.sqrt(math.log(0.05) / math.log(0.01)))
    assert target_radius_m("spread:0.5") == pytest.approx(0.8654, abs=1e-4)
    assert target_radius_m("spread:0.5", 2.0) == pytest.approx(0.4327, abs=1e-4)
    for unknown in ("", "spread", "spread:x", "within:1", "within:1,1", "spread:-1"):
        assert target_radius_m(unknown) is None


def test_nothing_is_promised_while_the_readings_do_not_fit() -> None:
    assert moves_left([measured(3, 2.0, p_value=1e-6)], "spread:0.5") is None
    assert moves_left([measured(3, math.nan)], "spread:0.5") is None
    assert moves_left([], "spread:0.5") is None
    assert moves_left([measured(3, 0.1)], "spread:0.5") == 1


def test_the_moves_left_are_right_within_a_factor_of_two_more_often_than_not() -> None:
    """Of the recorded searches by homing and infotaxis that ceased, from the fifth reading on."""
    ratios, errors = [], []
    for name in (
        "homing-gaussian-field",
        "homing-gaussian",
        "infotaxis-gaussian-field",
        "infotaxis-gaussian",
    ):
        scene = history_of(read(GOLDEN / f"{name}.mcap")).at()
        last = scene.measurements[-1]
        if not last.ceased:
            continue
        for count in range(5, len(scene.measurements)):
            told = moves_left(scene.measurements[:count], scene.stop)
            if told is not None:
                left = last.step - scene.measurements[count - 1].step
                ratios.append(max(told / left, left / told))
                errors.append(abs(told - left))
    assert len(ratios) > 40
    assert median(ratios) < 2.0
    assert median(errors) < 12.0
