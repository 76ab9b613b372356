"""Protects the replay of records on the page: scrub, step, jump, play, and two side by side. What is
expected is read from the files.
"""

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from ground.view.records import RecordedFleet
from link.bus.keys import BELIEF
from link.bus.messages import Belief
from link.record.reader import read
from plume.geodesy import HOME
from tests.view.conftest import PHONE, Window
from tests.view.stage import Served

M_PER_DEGREE = 6_371_000 * math.pi / 180  # to the north
PATIENCE_MS = 120_000.0  # the machine may be busy
GOLDEN = Path(__file__).parents[1] / "golden"
HOMING, INFOTAXIS = "homing-gaussian", "infotaxis-gaussian"


def beliefs(name: str) -> list[tuple[float, Belief]]:
    """The beliefs of a record with their times."""
    entries = [entry for entry in read(GOLDEN / f"{name}.mcap").entries if entry.key == BELIEF.name]
    return [(entry.simulation_s, msgspec.json.decode(entry.payload, type=Belief)) for entry in entries]


def served(*names: str) -> Iterator[str]:
    page = Served(RecordedFleet([GOLDEN / f"{name}.mcap" for name in names]))
    page.open()
    yield page.address
    page.close()


@pytest.fixture(scope="module")
def one() -> Iterator[str]:
    yield from served(HOMING)


@pytest.fixture(scope="module")
def two() -> Iterator[str]:
    yield from served(HOMING, INFOTAXIS)


@pytest.fixture
def replay(one: str, look: Callable[..., Window]) -> Window:
    return at_the_end(look(one))


def at_the_end(window: Window, *names: str) -> Window:
    for name in names or (HOMING,):
        window.until(f"plumeward.state.models['{name}']?.scene && plumeward.panes.get('{name}').map.view")
    return window


def now(window: Window, name: str = HOMING) -> float:
    """Wait until what is shown is what is asked for; returns its time, s."""
    time = f"plumeward.state.models['{name}'].scene.time_s"
    end = f"plumeward.state.vehicles.find((vehicle) => vehicle.name === '{name}').end_s"
    window.until(f"Math.abs({time} - Math.min({end}, plumeward.state.at_s)) < 1e-9")
    window.drawn()
    return window.of(time)


def shows(window: Window, belief: Belief, name: str = HOMING) -> None:
    """The page shows this belief and no later one."""
    rows = window.model("measurements", name)
    assert len(rows) == belief.step + 1
    assert rows[-1][0] == belief.step == int(window.page.locator("[data-fact=step]").first.text_content())
    assert rows[-1][5] == pytest.approx(belief.spread)
    assert window.model("scene.estimate.x", name) == pytest.approx(belief.mean[0])
    assert len(window.of(f"[...plumeward.panes.get('{name}').charts.spread.data[0]]")) == belief.step + 1
    x, y = belief.mean
    assert (
        window.count("estimate", (x - 0.5, y - 0.5, x + 0.5, y + 0.5), name) > 15
    )  # the cross, though others lie on it


def test_a_record_opens_at_its_outcome(replay: Window) -> None:
    time_s, last = beliefs(HOMING)[-1]
    assert last.ceased
    assert now(replay) >= time_s
    shows(replay, last)
    assert ". Found: " in replay.text(".sentence")
    assert replay.text(".sentence").startswith("Replay, ")
    assert replay.text(".notes").startswith("Located: ")
    assert replay.text("#link") == "record"
    assert not replay.page.locator("#notice").is_visible()
    assert not replay.page.locator(".operator").is_visible()  # a record takes no commands
    assert replay.violations() == []
    replay.keep("replay")


def test_the_findings_of_a_record_are_one_click_away(replay: Window) -> None:
    _, last = beliefs(HOMING)[-1]
    errors: list[str] = []
    asked: list[str] = []
    replay.page.context.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    replay.page.context.on("request", lambda request: asked.append(request.url))
    with replay.page.expect_popup() as opened:
        replay.page.get_by_role("link", name="Findings").click()
    findings = opened.value
    findings.wait_for_load_state(timeout=PATIENCE_MS)
    said = findings.inner_text("body")
    assert f"{HOMING}.mcap" in said
    latitude = re.search(r"latitude ([\d.]+)°", findings.inner_text(".verdict"))
    assert latitude
    assert float(latitude[1]) == pytest.approx(HOME[0] + last.mean[1] / M_PER_DEGREE, abs=2e-7)
    assert errors == []
    assert asked == [f"{replay.address}findings/{HOMING}"]
    findings.close()


def test_findings_of_what_is_no_record_are_a_line(replay: Window) -> None:
    answer = replay.page.context.request.get(f"{replay.address}findings/none")
    assert (answer.status, answer.text()) == (404, "no findings: there is no such record\n")


@pytest.mark.full
def test_a_record_that_was_cut_off_is_shown_and_says_so(look: Callable[..., Window], tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(
        (GOLDEN / f"{HOMING}.mcap").read_bytes()[:-100]
    )  # its beliefs are there, its end is not
    page = Served(RecordedFleet([tmp_path / "cut.mcap"]))
    page.open()
    try:
        window = at_the_end(look(page.address), "cut")
        now(window, "cut")
        shows(window, beliefs(HOMING)[-1][1], "cut")
        assert (
            window.text("#notice")
            == "The record cut is cut off, damaged or still being written: what follows is missing"
        )
        assert window.violations() == []
        window.keep("replay-cut-off")
    finally:
        page.close()


@pytest.mark.full
def test_stepping_goes_from_reading_to_reading(replay: Window) -> None:
    said = beliefs(HOMING)
    replay.page.keyboard.press("Home")
    now(replay)
    assert replay.model("measurements.length", HOMING) == 0
    assert "Found" not in replay.text(".sentence")
    for time_s, belief in said[:3]:
        replay.page.keyboard.press("ArrowRight")
        assert now(replay) == pytest.approx(time_s)
        shows(replay, belief)
    replay.page.get_by_role("button", name="Previous reading").click()
    assert now(replay) == pytest.approx(said[1][0])
    shows(replay, said[1][1])


def test_scrubbing_goes_to_any_time_and_back(replay: Window) -> None:
    said = beliefs(HOMING)
    line = replay.page.locator("#at")
    for step in (20, 5):
        wanted_s = (said[step][0] + said[step + 1][0]) / 2
        line.fill(str(wanted_s))
        assert now(replay) == pytest.approx(wanted_s)
        shows(replay, said[step][1])
    box = line.bounding_box()
    replay.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert now(replay) == pytest.approx(replay.of("plumeward.line.span[1] / 2"), rel=0.02)
    replay.keep("replay-half-way")


@pytest.mark.full
def test_jumping_goes_to_what_happened(replay: Window) -> None:
    stopped_s = next(time_s for time_s, belief in beliefs(HOMING) if belief.ceased)
    to_come = replay.page.locator(".happenings li.future")
    the_stop = replay.page.locator(".happenings li.future [data-level=stop]")
    replay.page.keyboard.press("Home")
    times_s = [now(replay)]
    assert times_s == [0.0]
    assert the_stop.count() == 1
    while (
        to_come.count()
    ):  # a record goes on for as long as its recorder was there, past the stop and sometimes to the landing
        replay.page.get_by_role("button", name="Next event").click()
        times_s.append(now(replay))
        assert times_s[-1] > times_s[-2]
        assert the_stop.count() == (times_s[-1] < stopped_s)
    assert stopped_s in times_s
    replay.page.keyboard.press("Shift+ArrowLeft")
    assert now(replay) == times_s[-2]
    replay.page.keyboard.press("Shift+ArrowRight")
    assert now(replay) == times_s[-1]
    replay.page.locator(".happenings [data-level=stop]").click()
    assert now(replay) == stopped_s
    assert the_stop.count() == 0
    assert replay.page.locator("[data-fact=armed]").text_content() == "yes"
    assert replay.page.locator("#marks .mark").count() == replay.page.locator(".happenings li").count()


def test_playing_runs_to_the_end_at_the_chosen_speed(replay: Window) -> None:
    end_s = replay.of("plumeward.line.span[1]")
    replay.page.select_option("#speed", "50")
    # In one go: on a busy machine it may have ended before the next question.
    playing, took_s, frames, times = replay.of("""new Promise((done) => {
        const seen = new Set(), began_ms = performance.now();
        let frames = 0;
        plumeward.line.toggle();  // at the end: it begins anew
        const playing = plumeward.line.playing;
        const look = () => {
            seen.add(plumeward.state.models['homing-gaussian'].scene.time_s);
            frames += 1;
            if (plumeward.line.playing) requestAnimationFrame(look);
            else done([playing, (performance.now() - began_ms) / 1000, frames, [...seen]]);
        };
        look();
    })""")
    assert playing
    assert took_s >= end_s / 50
    assert now(replay) == pytest.approx(end_s)
    assert times[1:] == sorted(times[1:])
    assert len(times) > 2 or frames < 5  # it is seen on the way, unless there were hardly any frames
    shows(replay, beliefs(HOMING)[-1][1])


@pytest.mark.full
def test_space_plays_and_pauses_and_the_speed_has_keys(replay: Window) -> None:
    replay.page.keyboard.press("Home")
    replay.page.keyboard.press("-")
    assert replay.of("plumeward.line.speed") == 5
    replay.page.keyboard.press("Space")
    replay.until("plumeward.line.at_s > 0.2")
    assert replay.page.get_by_role("button", name="Pause").first.is_visible()
    replay.page.keyboard.press("Space")
    paused_s = replay.of("plumeward.line.at_s")
    assert now(replay) == paused_s < replay.of("plumeward.line.span[1]")


@pytest.mark.full
def test_two_records_are_compared_on_one_time_line(two: str, look: Callable[..., Window]) -> None:
    window = at_the_end(look(two, scheme="dark"), HOMING, INFOTAXIS)
    homing, infotaxis = beliefs(HOMING), beliefs(INFOTAXIS)
    assert window.page.locator(".pane").count() == 2
    assert window.of("plumeward.line.span[1]") >= infotaxis[-1][0] > homing[-1][0]
    now(window)
    now(window, INFOTAXIS)
    charts = [f"[...plumeward.panes.get('{name}').charts.spread.data" for name in (HOMING, INFOTAXIS)]
    for column, said in ((1, homing), (3, infotaxis)):  # the other's beside ours, null at the other's times
        spreads = [spread for spread in window.of(f"{charts[0]}[{column}]]") if spread is not None]
        assert spreads == pytest.approx([belief.spread for _, belief in said])
    wanted_s = (homing[12][0] + homing[13][0]) / 2
    window.page.locator("#at").fill(str(wanted_s))
    for name, said in ((HOMING, homing), (INFOTAXIS, infotaxis)):
        assert now(window, name) == pytest.approx(wanted_s)
        newest = [belief for time_s, belief in said if time_s <= wanted_s][-1]
        assert window.model("measurements.length", name) == newest.step + 1
        assert window.model("scene.estimate.y", name) == pytest.approx(newest.mean[1])
    assert window.violations() == []
    window.page.locator("#truth").click()
    window.until(f"plumeward.state.models['{INFOTAXIS}'].plume && plumeward.state.models['{HOMING}'].plume")
    window.drawn()
    window.keep("two-records")


@pytest.mark.full
def test_a_replay_fits_a_phone(two: str, look: Callable[..., Window]) -> None:
    window = at_the_end(look(two, PHONE, has_touch=True, is_mobile=True), HOMING, INFOTAXIS)
    assert window.narrow_enough()
    for button in ("Previous event", "Previous reading", "Play", "Next reading", "Next event"):
        box = window.page.get_by_role("button", name=button).bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= PHONE[0]
        assert box["y"] + box["height"] <= PHONE[1]  # in reach without scrolling
    assert window.violations() == []
    window.keep("phone-replay")
