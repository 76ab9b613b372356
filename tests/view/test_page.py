"""Protects the page: what it draws of a scene, and its use on a phone, by keyboard, in the dark, and after
a lost connection.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link.bus.mavlink import Codec
from scene.follow.history import History
from scene.scene import Backdrop, Craft, Ending, Happening, Service
from tests.system.pages import Browser
from tests.view.conftest import PHONE, Window
from tests.view.stage import RELEASE, Stage, bearing_deg, cloud, measured, scene


@pytest.fixture
def window(stage: Stage, look: Callable[..., Window]) -> Window:
    """The page with one vehicle, drawn."""
    stage.enter(scene())
    return drawn(look(stage.address))


def more(window: Window) -> None:
    """Open what is one click away."""
    window.page.locator(".more summary").first.click()


def drawn(window: Window, vehicle: str = "uav/1") -> Window:
    window.until(f"plumeward.drawn > 0 && plumeward.panes.get('{vehicle}')?.map.view")
    return window


# ---- the map ----


def test_each_thing_is_drawn_at_its_place(window: Window) -> None:
    west, east, north, south = window.of(
        "(({ x, y }) => [x(0), x(30), y(30), y(0)])(plumeward.panes.get('uav/1').map.view)"
    )
    assert east - west == pytest.approx(south - north)
    assert east > west  # and south > north: the canvas has y down
    assert window.count("estimate", (9.5, 19.5, 10.5, 20.5)) > 40  # the cross
    # Its covariance is (4, 0, 1) m²: 2 standard deviations are 4 m to the east and 2 m to the north.
    for edge, (x, y) in {"east": (14, 20), "west": (6, 20), "north": (10, 22), "south": (10, 18)}.items():
        assert window.count("estimate", (x - 0.4, y - 0.4, x + 0.4, y + 0.4)) > 10, edge
    assert (
        window.count("estimate", (9.5, 22.5, 15, 29)) == window.count("estimate", (11, 19.5, 13, 20.5)) == 0
    )
    assert window.count("waypoint", (13.0, 11.0, 15.0, 13.0)) > 20
    assert window.count("gas-1", (1.5, 3.5, 5.0, 4.5)) > 60
    assert window.count("belief", (18, 23, 22, 27)) > 300
    assert window.count("belief", (16, 8, 30, 22)) == 0


def test_the_vehicle_points_to_where_it_heads(stage: Stage, window: Window) -> None:
    east, west = (window.pixel(6.0, 12.0, aside=(dx, 0)) for dx in (9, -9))
    assert sum(east) < 150 < sum(west)  # a dark nose, and light behind the notch
    stage.vehicles["uav/1"].show(craft=Craft(7.0, (6.0, 12.0), heading=math.pi / 2))
    window.until("plumeward.state.models['uav/1'].scene.craft.mode === ''")
    window.drawn()
    north, east = window.pixel(6.0, 12.0, aside=(0, 9)), window.pixel(6.0, 12.0, aside=(9, 0))
    assert sum(north) < 150 < sum(east)


def test_home_is_where_the_vehicle_returns_to(stage: Stage, window: Window) -> None:
    around = (2.7, 21.7, 3.3, 22.3)
    assert window.count("ink", around) == 0
    stage.vehicles["uav/1"].show(craft=Craft(7.0, (6.0, 12.0), home=(3.0, 22.0)))
    window.until("plumeward.state.models['uav/1'].scene.craft.mode === ''")
    window.drawn()
    assert window.count("ink", around) > 10


def test_the_arrow_shows_where_the_air_moves_to(window: Window) -> None:
    # The wind comes from the south-west: the arrow's head, which is wide, is up and to the right of its
    # middle.
    head, tail = window.of("""(() => {
        const { canvas, view, ratio } = plumeward.panes.get('uav/1').map, g = canvas.getContext('2d');
        const ink = (x, y) => {
            const { data } = g.getImageData(...[x, y, 14, 14].map((px) => Math.round(px * ratio)));
            return data.filter((value, i) => i % 4 === 0 && value < 128).length;
        };
        return [ink(24, 24 - 14), ink(24 - 14, 24)];
    })()""")
    assert head > 1.3 * tail > 0
    assert round(bearing_deg(RELEASE.wind)) == 217
    assert "wind 5.0 m/s from 217°" in window.page.locator("canvas").first.get_attribute("aria-label")


def test_the_truth_is_off_until_asked_for(window: Window) -> None:
    button = window.page.locator("#truth")
    assert "simulation only" in button.inner_text()
    assert window.model("scene.truth") is None
    assert window.count("truth", (23, 5, 25, 7)) == 0
    button.click()
    window.until("plumeward.state.models['uav/1'].scene.truth && plumeward.state.models['uav/1'].plume")
    window.drawn()
    assert window.count("truth", (23, 5, 25, 7)) > 100
    # The gas is where the air goes to.
    _, downwind, upwind = (
        255 - window.pixel(*place)[1] for place in (RELEASE.source, (26.4, 9.2), (21.6, 2.8))
    )
    assert downwind > 1.2 * upwind
    window.keep("truth")
    button.click()
    window.until("!plumeward.state.models['uav/1'].scene.truth")
    window.drawn()
    assert window.count("truth", (23, 5, 25, 7)) == 0


def test_a_real_flight_has_no_truth_to_show(stage: Stage, look: Callable[..., Window]) -> None:
    simulated = scene()
    stage.enter(replace(simulated, backdrop=replace(simulated.backdrop, release=None)))
    window = drawn(look(stage.address))
    assert not window.page.locator("#truth").is_visible()
    window.page.keyboard.press("t")
    window.drawn()
    assert window.of("plumeward.state.truth") is False


# ---- facts, charts, services, happenings ----


def test_facts_services_and_happenings_are_told(window: Window) -> None:
    more(window)
    facts = {
        name: window.text(f"[data-fact={name}]")
        for name in ("mode", "armed", "step", "spread", "time", "assume", "stop")
    }
    assert facts == {
        "mode": "OFFBOARD",
        "armed": "yes",
        "step": "5",
        "spread": f"{8 * 0.8**5:.2f} m",
        "time": "6.0 s",
        "assume": "field",
        "stop": "0.5 m spread",
    }
    assert window.text(".services li:nth-child(1)").split() == [
        "✓",
        "uav",
        "ok",
        "12",
        "ms",
        "searching",
        "·",
        "step",
        "5",
    ]
    assert "! hot" in window.text(".services li:nth-child(2)")
    assert [row.split("\n") for row in window.page.locator(".happenings li").all_inner_texts()] == [
        ["3.0 s", "!", "estimator", "hot"],
        ["0.5 s", "·", "uav", "armed"],
    ]


def test_how_the_gas_comes_and_goes_is_told_where_it_is_not_known(stage: Stage, window: Window) -> None:
    more(window)
    section = window.page.locator(".intermittency")
    assert not section.is_visible()
    said = {
        "downwind": (1.08, 1.849, 2.6),
        "cv": (0.1, 0.4, 0.9),
        "puff-rate": (2.2, 12.4, 63.0),
        "puff-share": (0.047, 0.2, 0.61),
    }
    last = replace(measured(6, 0.4), intermittency=said, advised_dwell_s=2.0)
    stage.vehicles["uav/1"].show(measurements=(*scene().measurements, last))
    window.until("document.querySelector('[data-fact=step]').textContent === '6'")
    assert section.is_visible()
    facts = {name: window.text(f"[data-fact={name}]") for name in ("downwind", "cv", "puffs", "advice")}
    assert facts == {
        "downwind": "cv 1.8 (1.1 to 2.6)",
        "cv": "cv 0.4 (0.1 to 0.9)",
        "puffs": "10/s (2 to 60), share 0.2 (0.05 to 0.6)",
        "advice": "hover 2 s for a reading",
    }
    window.keep("gas")


def test_a_copter_is_shown_as_it_says_it_is(stage: Stage, look: Callable[..., Window]) -> None:
    """ArduCopter, system 32, held by its pilot: without a battery monitor, and it has lost its GPS. Home
    is 8 m north of its origin.
    """
    history = History(Backdrop("uav/1", title="by hand"))
    messages = (
        mavlink.MAVLink_heartbeat_message(
            2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 128, 17, mavlink.MAV_STATE_CRITICAL, 3
        ),
        mavlink.MAVLink_gps_global_origin_message(600000000, 100000000, 100_000),
        mavlink.MAVLink_home_position_message(
            600000719, 100000000, 100_000, *[0.0] * 3, [1.0, 0.0, 0.0, 0.0], *[0.0] * 3
        ),
        mavlink.MAVLink_attitude_message(60_000, 0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0),
        mavlink.MAVLink_local_position_ned_message(60_000, 20.0, 6.0, -5.0, 0.0, 0.0, 0.0),
        mavlink.MAVLink_sys_status_message(32, 32, 0, 0, 0xFFFF, -1, -1, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_gps_raw_int_message(0, 1, 0, 0, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_ekf_status_report_message(167, 0.0, 0.0, 0.0, 0.0, 0.0),
    )
    history.take("mavlink/out", Codec(32, 1).pack(*messages), b"", 60.0, 0.0)
    history.take(
        "mavlink/out",
        Codec(32, 191).pack(mavlink.MAVLink_statustext_message(4, b"Search gives way: BRAKE")),
        b"",
        60.0,
        0.0,
    )
    made = scene()
    shown = history.at()
    paused = Service("uav", "ok", "paused", "", 5, 0.012)
    made = replace(
        made,
        craft=shown.craft,
        track=shown.track,
        wind=shown.wind,
        happenings=shown.happenings,
        waypoint=None,
        services=(paused, *made.services[1:]),
    )
    stage.enter(made)
    window = drawn(look(stage.address))
    more(window)
    facts = {
        name: window.text(f"[data-fact={name}]") for name in ("mode", "armed", "battery", "gps", "health")
    }
    assert facts == {
        "mode": "BRAKE",
        "armed": "yes",
        "battery": "–",
        "gps": "no fix, 0 satellites",
        "health": "not healthy: gps, position",
    }
    assert sum(window.pixel(6.0, 12.0)) < 150  # 20 m north of the origin, 12 m of home
    assert "vehicle at (6.0, 12.0)" in window.page.locator("canvas").first.get_attribute("aria-label")
    assert "wind" not in window.page.locator("canvas").first.get_attribute("aria-label")
    assert window.violations() == []
    window.keep("ardupilot")


def can(window: Window) -> dict[str, bool]:
    """Which buttons can be pressed, by name, of those that are seen."""
    return window.of(
        "Object.fromEntries([...document.querySelectorAll('[data-command]')].filter((button) => !button.hidden)"
        ".map((button) => [button.textContent, !button.disabled]))"
    )


def test_only_what_is_possible_can_be_pressed(stage: Stage, window: Window) -> None:
    searching = {"Pause": True, "Return": True, "Land here…": True, "Give back": False}
    paused = {"Resume": True, "Return": True, "Land here…": True, "Give back": False}
    flown = {"Pause": False, "Return": True, "Land here…": True, "Give back": True}
    returning = {"Pause": False, "Return": False, "Land here…": True, "Give back": True}
    grounded = dict.fromkeys(searching, False)
    assert can(window) == searching
    for state, mode, armed, possible in (
        ("paused", "HOLD", True, paused),
        ("searching", "OFFBOARD", True, searching),
        ("paused", "BRAKE", True, paused),
        ("paused", "POSITION", True, flown),
        ("returning", "RTL", True, returning),
        ("landed", "HOLD", False, grounded),
        ("taking off", "TAKEOFF", True, searching),
    ):
        craft = replace(scene().craft, mode=mode, armed=armed)
        stage.vehicles["uav/1"].show(services=(Service("uav", "ok", state),), craft=craft)
        window.until(f"plumeward.state.models['uav/1'].scene.craft.mode === '{mode}'")
        window.drawn()
        assert can(window) == possible, (state, mode)
    pilot = replace(scene().craft, mode="LOITER", armed=True)
    stage.vehicles["uav/1"].show(services=(Service("uav", "ok", "holding"),), craft=pilot, left=True)
    window.until("plumeward.state.models['uav/1'].scene.left")
    window.drawn()
    assert can(window) == flown | {"Give back": False}
    stage.vehicles["uav/1"].show(craft=replace(scene().craft, mode="HOLD", armed=False))
    window.until("document.querySelector('[data-command=return]').disabled")
    assert "on the ground" in window.page.get_by_role("button", name="Return").get_attribute("title")


def test_all_can_be_pressed_while_nobody_knows_what_the_vehicle_does(stage: Stage, window: Window) -> None:
    stage.vehicles["uav/1"].show(
        services=(Service("uav", "stale", "returning"),), craft=replace(scene().craft, mode="", armed=None)
    )
    window.until("plumeward.state.models['uav/1'].scene.craft.mode === ''")
    window.drawn()
    assert all(can(window).values())


def test_what_a_pilot_looks_for_has_units_and_a_colour_only_when_it_matters(
    stage: Stage, window: Window
) -> None:
    names = ("flies", "altitude", "speed", "battery", "home", "link", "moves", "left")

    def facts() -> dict[str, str]:
        return {name: window.text(f"[data-fact={name}]") for name in names}

    assert facts() == {
        "flies": "search",
        "altitude": "5.0 m",
        "speed": "2.0 m/s",
        "battery": "62%",
        "home": "13 m",
        "link": "good",
        "moves": "5 of ≈18",
        "left": "≈ 13 s",
    }
    assert window.page.locator(".facts [data-level]").count() == 0
    radio = replace(scene().craft.condition, radio=(180.0, math.nan))
    stage.vehicles["uav/1"].show(craft=replace(scene().craft, condition=radio))
    window.until("document.querySelector('[data-fact=link]').textContent === '180 / –'")
    lossy = replace(radio, lost=0.07)
    stage.vehicles["uav/1"].show(craft=replace(scene().craft, condition=lossy))
    window.until("document.querySelector('[data-fact=link]').textContent === '7% lost'")
    empty = replace(scene().craft.condition, battery=0.11)
    stage.vehicles["uav/1"].show(silent_s=2.4, craft=replace(scene().craft, mode="ALTITUDE", condition=empty))
    window.until("document.querySelector('[data-fact=battery]').textContent === '11%'")
    assert (facts()["link"], facts()["flies"]) == ("silent 2 s", "pilot: altitude")
    levels = window.of(
        "Object.fromEntries([...document.querySelectorAll('.facts [data-level]')].map((one) => "
        "[one.dataset.fact, one.dataset.level]))"
    )
    assert levels == {"flies": "warn", "battery": "bad", "link": "warn"}
    assert window.violations() == []


def test_the_charts_hold_every_reading_and_the_threshold(stage: Stage, window: Window) -> None:
    charts = "plumeward.panes.get('uav/1').charts"
    times, spread, threshold, _ = window.of(f"{charts}.spread.data.map((column) => [...column])")
    assert times == list(range(6))
    assert spread == pytest.approx([8, 6.4, 5.12, 4.096, 3.2768, 2.62144])
    assert threshold == [0.5] * 6
    grown = (*scene().measurements, *(measured(step, 4.0, gas=step / 2) for step in (6, 7)))
    stage.vehicles["uav/1"].show(measurements=grown)
    window.until(f"{charts}.gas.data[0].length === 8")
    assert window.of(f"[...{charts}.gas.data[1]]") == [1, 1, 1, 1, 1, 1, 3, 3.5]


def test_gas_of_a_vehicle_that_has_left_ends_where_it_left(stage: Stage, window: Window) -> None:
    more = (measured(6, 4.0, gas=50.0), replace(measured(7, 3.0, gas=math.nan), position=(5.0, 4.0)))
    stage.vehicles["uav/1"].show(measurements=(*scene().measurements, *more))
    window.until("plumeward.panes.get('uav/1').charts.gas.data[0].length === 8")
    window.drawn()
    assert window.of("[...plumeward.panes.get('uav/1').charts.gas.data[1]].slice(-2)") == [50, None]
    assert window.text(".gas-title") == "Gas: 50 g/m³"
    assert window.count("gas-5", (4.8, 3.8, 5.2, 4.2)) > 20  # nothing lies on its last reading
    at = window.of("(({ view }) => [view.x(5), view.y(4)])(plumeward.panes.get('uav/1').map)")
    window.page.locator(".map canvas").hover(position={"x": at[0], "y": at[1]})
    window.until("document.querySelector('.pointer').textContent.startsWith('reading 6: 50.0 g/m³')")


def test_only_warnings_and_the_stop_are_read_aloud(stage: Stage, window: Window) -> None:
    assert window.page.locator("#aloud").text_content() == ""  # what was there before is not news
    happenings = (
        *scene().happenings,
        Happening(5, "info", "uav", "mode HOLD"),
        Happening(6, "stop", "estimator", "source found"),
    )
    stage.vehicles["uav/1"].show(happenings=happenings)
    window.until("document.querySelector('#aloud').textContent")
    assert window.page.locator("#aloud").text_content() == "uav/1, estimator: source found"


def test_the_outcome_is_clear(stage: Stage, window: Window) -> None:
    looks = {window.text(".state .sign")}
    for verdict, begins in {
        "located": "Found: 51.4",
        "FALSE STOP": "False stop: the source is not at 51.4",
        "outside": "Outside: the source is not in the area",
        "not ceased": "Not found: the moves are spent",
    }.items():
        stage.vehicles["uav/1"].show(ending=Ending(verdict, "after 5 steps"))
        window.until(f"document.querySelector('.sentence').innerText.startsWith('{begins}')")
        assert window.text(".notes").endswith(f"{verdict}: after 5 steps")
        looks.add(window.text(".state .sign"))
        assert window.violations() == []
    assert len(looks) == 5


def covered(window: Window) -> bool:
    """Whether the legend lies on the map, or a button on the area in it."""
    return window.of("""[...document.querySelectorAll('.pane')].some((pane) => {
        const box = (selector) => pane.querySelector(selector).getBoundingClientRect(), map = box('canvas');
        const { view } = plumeward.panes.get(pane.getAttribute('aria-label').replace('Vehicle ', '')).map;
        return box('.legend-fold').top < map.bottom || box('.map-tools').bottom > map.top + view.y(30);
    })""")


# ---- vehicles that come and go ----


def test_without_a_vehicle_it_says_what_it_waits_for(stage: Stage, look: Callable[..., Window]) -> None:
    stage.notice = "no router at tcp/127.0.0.1:7447: waiting for one"
    stage.relist()
    window = look(stage.address)
    window.until("plumeward.state.notice")
    assert "No router at tcp/127.0.0.1:7447" in window.text("#notice")
    assert "Waiting for a vehicle" in window.text("#empty")
    assert "plumeward fly --view" in window.text("#empty")
    assert window.violations() == []
    window.keep("waiting")
    stage.notice = ""
    stage.enter(scene())
    drawn(window)
    assert not window.page.locator("#empty").is_visible()
    assert not window.page.locator("#notice").is_visible()


def test_two_vehicles_are_chosen_from_a_list_and_seen_side_by_side(stage: Stage, window: Window) -> None:
    other = stage.enter(scene("uav/2"))
    other.show(waypoint=(3.0, 27.0))
    window.until("plumeward.state.vehicles.length === 2")
    assert window.of("plumeward.state.show") == ["uav/1"]
    window.page.select_option("#first", "uav/2")
    drawn(window, "uav/2")
    assert window.count("waypoint", (2, 26, 4, 28), "uav/2") > 20
    assert window.page.locator(".pane").count() == 1
    window.page.select_option("#second", "uav/1")
    drawn(window)
    assert window.page.locator(".pane").count() == 2
    assert window.count("waypoint", (2, 26, 4, 28)) == 0
    left, right = (window.page.locator(".pane").nth(i).bounding_box() for i in (0, 1))
    assert left["x"] + left["width"] <= right["x"]
    assert not covered(window)
    assert window.page.locator(".facts dd").first.is_visible()
    window.keep("two-vehicles")
    assert window.violations() == []
    other.here = False
    stage.relist()
    window.until("plumeward.state.vehicles.some(({ here }) => !here)")
    assert "gone" in window.text(".pane .title")
    assert window.page.locator(".pane").nth(0).locator(".why").inner_text() == "The vehicle is gone."
    window.page.select_option("#second", "")
    assert window.page.locator(".pane").count() == 1


def test_on_a_phone_the_legend_lies_below_the_map_and_a_name_at_its_edge_is_whole(
    stage: Stage, look: Callable[..., Window]
) -> None:
    stage.enter(replace(scene(), craft=replace(scene().craft, position=(3.0, 27.0))), "search")
    at_the_edge = replace(scene("uav/2"), craft=replace(scene().craft, position=(29.9, 10.0)), waypoint=None)
    stage.enter(at_the_edge, "search")
    window = drawn(look(stage.address, PHONE, has_touch=True, is_mobile=True))
    window.until("plumeward.state.models['uav/2']?.scene")
    window.drawn()
    window.page.locator(".legend-fold summary").click()
    assert window.page.locator(".legend .gauge").is_visible()
    assert not covered(window)
    assert window.narrow_enough()
    assert window.count("ink", (24.5, 11.2, 28.8, 13.0)) > 20  # the name, to the left
    window.keep("phone-legend", whole=True)


def test_a_home_that_is_not_known_is_not_drawn_and_nothing_is_said_to_be_its_way(
    stage: Stage, look: Callable[..., Window]
) -> None:
    nowhere = (math.nan, math.nan)
    stage.enter(replace(scene(), craft=replace(scene().craft, home=nowhere)))
    window = drawn(look(stage.address))
    window.drawn()
    corner = (-0.4, -0.4, 0.4, 0.4)
    without = window.count("ink", corner)
    assert window.text("[data-fact=home]") == "–"
    stage.vehicles["uav/1"].show(craft=replace(scene().craft, home=(0.0, 0.0)))
    window.until("document.querySelector('[data-fact=home]').textContent === '13 m'")
    window.drawn()
    assert window.count("ink", corner) > without + 10


@pytest.mark.parametrize("size", [(1000, 700), (1200, 800), (1280, 800), (1280, 1024), (1920, 1080)])
def test_the_legend_is_open_at_first_only_where_it_does_not_lie_on_the_area(
    stage: Stage, look: Callable[..., Window], size: tuple[int, int]
) -> None:
    stage.enter(scene())
    window = drawn(look(stage.address, size))
    left, is_open = window.of(
        "(({ left }, { open }) => [left, open])(document.querySelector('.legend-fold').getBoundingClientRect(), "
        "document.querySelector('.legend-fold'))"
    )
    east = window.of(
        "document.querySelector('canvas').getBoundingClientRect().left + "
        "plumeward.panes.get('uav/1').map.view.x(30)"
    )
    assert left > east or not is_open
    assert is_open == (size in {(1280, 800), (1920, 1080)})


def test_the_list_of_vehicles_of_one_search_begins_with_what_tells_them_apart(
    stage: Stage, look: Callable[..., Window]
) -> None:
    """A phone shows only the first letters of a choice."""
    for name in ("search/1/uav/1", "search/1/uav/2"):
        stage.enter(scene(name), "search/1")
    window = drawn(look(stage.address, PHONE, has_touch=True, is_mobile=True), "search/1/uav/1")
    window.until("plumeward.state.vehicles.length === 2")
    choices = window.page.locator("#first option").all_inner_texts()
    assert [choice.split(" · ")[0] for choice in choices] == ["uav/1", "uav/2"]


def test_a_vehicle_that_is_chosen_again_shows_all_that_it_showed_before(stage: Stage, window: Window) -> None:
    stage.enter(scene("uav/2"))
    window.until("plumeward.state.vehicles.length === 2")
    happened = window.page.locator(".happenings li").all_inner_texts()
    assert len(happened) == 2
    for name in ("uav/2", "uav/1"):
        window.page.select_option("#first", name)
        drawn(window, name)
        window.drawn()
    assert window.page.locator(".happenings li").all_inner_texts() == happened
    assert window.page.locator(".services li").count() == 2
    assert window.of("plumeward.panes.get('uav/1').charts.spread.data[0].length") == 6
    assert window.count("estimate", (9.5, 19.5, 10.5, 20.5)) > 40
    assert window.page.locator("#aloud").text_content() == ""  # it is no news


# ---- the connection ----


def test_one_page_too_many_says_why_and_is_served_when_another_is_closed(
    stage: Stage, look: Callable[..., Window]
) -> None:
    stage.enter(scene())
    pages = [Browser(stage.port) for _ in range(20)]
    try:
        window = look(stage.address)
        window.until("plumeward.state.why")
        assert window.text("#notice") == "20 pages are open; close one of them. Trying again…"
        assert window.violations() == []
        window.keep("too-many-pages")
        pages.pop().close()
        drawn(window)
        assert not window.page.locator("#notice").is_visible()
    finally:
        for page in pages:
            page.close()


def test_a_lost_connection_is_told_and_comes_back_by_itself(stage: Stage, window: Window) -> None:
    stage.close()
    window.until("plumeward.state.link === 'lost'")
    assert "Connection lost" in window.text("#notice")
    assert window.page.locator("[data-command=hold]").is_disabled()
    assert window.count("estimate", (9.5, 19.5, 10.5, 20.5)) > 40  # the last picture is there
    assert window.text(".sentence").startswith("Lost link: this page has no connection")
    assert "grayscale" in window.of("getComputedStyle(document.querySelector('.map canvas')).filter")
    window.keep("connection-lost")
    assert window.violations() == []
    stage.vehicles["uav/1"].show(waypoint=(3.0, 27.0))
    stage.open()
    window.until(
        "plumeward.state.link === 'open' && plumeward.state.models['uav/1'].scene.waypoint[1] === 27"
    )
    window.drawn()
    assert not window.page.locator("#notice").is_visible()
    assert window.count("waypoint", (2, 26, 4, 28)) > 20
    assert window.model("measurements.length") == 6  # not twice
    assert window.of("getComputedStyle(document.querySelector('.map canvas')).filter") == "none"
    assert window.text(".sentence").startswith("Searching")


def test_a_mission_that_is_over_keeps_its_picture(stage: Stage, window: Window) -> None:
    stage.bye("the mission is over")
    window.until("plumeward.state.link === 'over'")
    assert window.text("#notice") == "The mission is over. The last picture stays."
    assert window.count("estimate", (9.5, 19.5, 10.5, 20.5)) > 40
    assert window.page.locator("[data-command=hold]").is_disabled()


# ---- who may command ----


def test_a_page_that_may_not_command_says_why(look: Callable[..., Window]) -> None:
    stage = Stage("0.0.0.0")
    stage.open()
    try:
        stage.enter(scene())
        window = drawn(look(stage.address))
        assert "Read-only" in window.text(".why")
        assert window.of(
            "[...document.querySelectorAll('[data-command]')].every((button) => button.disabled)"
        )
        window.keep("read-only")
        assert window.violations() == []
    finally:
        stage.close()


def enter(window: Window, word: str) -> None:
    """Give the page a word, as people do."""
    window.page.get_by_role("button", name="Enter the word…").click()
    window.page.get_by_label("It is in the file that --token-file names:").fill(word)
    window.page.keyboard.press("Enter")


def test_the_word_that_is_entered_allows_commands_until_the_window_closes_and_no_address_holds_it(
    look: Callable[..., Window],
) -> None:
    stage = Stage(token="two words, é+/")
    stage.open()
    try:
        stage.enter(scene())
        window = drawn(look(stage.address))
        commands = window.page.locator("[data-command]").first
        assert commands.is_disabled()
        assert "enter the word" in window.text(".why")
        window.page.get_by_role("button", name="Enter the word…").click()
        window.keep("word")
        assert window.violations() == []
        window.page.get_by_role("button", name="Only look").click()
        enter(window, "two words, é+/")
        window.until("plumeward.state.hello.may_command")
        window.until("!document.querySelector('[data-command]').disabled")
        assert window.page.locator("#word-open").is_hidden()
        window.page.reload()
        drawn(window)
        assert commands.is_enabled()
        assert window.page.url == stage.address
        assert {url.partition("?")[2] for url in window.asked} == {""}
        assert drawn(look(stage.address)).page.locator("[data-command]").first.is_disabled()  # another window
    finally:
        stage.close()


def test_a_wrong_word_is_told_and_forgotten_and_the_right_one_taken_though_it_comes_too_soon(
    look: Callable[..., Window],
) -> None:
    stage = Stage(token="the secret")
    stage.open()
    try:
        stage.enter(scene())
        window = drawn(look(stage.address))
        enter(window, "not the secret")
        window.until("document.querySelector('.why').innerText.includes('not the word')")
        assert window.of("sessionStorage.length") == 0
        enter(window, "the secret")
        window.until("plumeward.state.hello.may_command")
    finally:
        stage.close()


def test_an_answer_is_shown_with_its_reason_and_land_asks_first(window: Window) -> None:
    window.page.get_by_role("button", name="Land").click()
    dialog = window.page.get_by_role("dialog")
    assert "Land here?" in dialog.inner_text()
    window.keep("land")
    assert window.violations() == []
    dialog.get_by_role("button", name="Keep flying").click()
    assert window.of("plumeward.answers") == []
    window.page.get_by_role("button", name="Land").click()
    dialog.get_by_role("button", name="Land").click()
    window.until("plumeward.answers.length")
    assert "Land refused: there is no vehicle 'uav/1'" in window.text(
        ".answer"
    )  # the stage's vehicles are not on a bus
    assert window.of("plumeward.answers[0].command") == "land"


# ---- all windows, all people ----


def test_on_a_phone_nothing_reaches_beyond_the_sides(stage: Stage, look: Callable[..., Window]) -> None:
    stage.enter(scene())
    stage.vehicles["uav/1"].show(
        ending=Ending("FALSE STOP", "source found at (17.30, 21.94) ± 0.39 m after 33 steps; error 4.15 m")
    )
    stage.enter(scene("uav/a-vehicle-with-a-very-long-name-indeed"))
    window = drawn(look(stage.address, PHONE, has_touch=True, is_mobile=True))
    assert window.narrow_enough()
    box = window.page.locator(".map canvas").bounding_box()
    assert box["width"] == 360
    assert box["y"] < 640 / 3  # the map comes first, also below the longest sentence
    assert window.count("estimate", (9.5, 19.5, 10.5, 20.5)) > 20
    for button in ("Pause", "Return", "Land", "Give back"):
        box = window.page.get_by_role("button", name=button).bounding_box()
        assert box["height"] >= 44  # a thumb is wide
        assert box["x"] + box["width"] <= 360
        assert 540 < box["y"] < 640 - box["height"]  # in a bar at the lower edge, without scrolling
    window.keep("phone", whole=True)
    assert window.violations() == []
    window.page.select_option("#second", "uav/a-vehicle-with-a-very-long-name-indeed")
    drawn(window, "uav/a-vehicle-with-a-very-long-name-indeed")
    assert window.narrow_enough()


def test_it_is_dark_where_the_system_is_and_the_button_changes_that(
    stage: Stage, look: Callable[..., Window]
) -> None:
    stage.enter(scene())
    window = drawn(look(stage.address, scheme="dark"))
    empty = (27.0, 15.0)
    assert sum(window.pixel(*empty)) < 150
    assert window.count("belief", (18, 23, 22, 27)) > 300
    assert window.violations() == []
    window.keep("dark")
    window.page.locator("#theme").click()
    window.drawn()
    assert sum(window.pixel(*empty)) > 700
    assert window.violations() == []
    window.keep("light")


def test_all_is_reached_by_keyboard_and_the_focus_is_seen(window: Window) -> None:
    reached = []
    for _ in range(12):
        window.page.keyboard.press("Tab")
        reached.append(
            window.of(
                "document.activeElement.id || document.activeElement.dataset.command || "
                "document.activeElement.className"
            )
        )
        assert window.of("getComputedStyle(document.activeElement).outlineStyle") in ("solid", "auto")
        if reached[-1] == "land":
            break
    assert reached == [
        "first",
        "truth",
        "theme",
        "help-open",
        "hold",
        "return",
        "land",
    ]  # the search leads: nothing to resume or to give back
    window.page.keyboard.press("Enter")
    window.until("document.querySelector('#land').open")
    assert window.of("document.activeElement.textContent") == "Keep flying"  # the safe choice comes first
    window.page.keyboard.press("Escape")
    window.until("!document.querySelector('#land').open")
    window.page.keyboard.press("?")
    window.until("document.querySelector('#help').open")
    assert "pause: stay where it is" in window.text("#help")
    window.keep("help")
    assert window.violations() == []
    window.page.keyboard.press("Escape")
    window.page.keyboard.press("t")
    window.until("plumeward.state.models['uav/1'].plume")
    window.page.keyboard.press("h")
    window.until("plumeward.answers.length")
    assert window.of("plumeward.answers[0].command") == "hold"


def test_the_help_begins_at_its_top_where_the_window_is_lower_than_it(
    stage: Stage, look: Callable[..., Window]
) -> None:
    stage.enter(scene())
    window = drawn(look(stage.address, PHONE))
    window.page.keyboard.press("?")
    window.until("document.querySelector('#help').open")
    top, height = window.of(
        "[document.querySelector('#help-title').getBoundingClientRect().top, innerHeight]"
    )
    assert 0 <= top < height / 2
    window.page.keyboard.press("Tab")
    assert window.of("document.activeElement.textContent") == "Close"
    window.page.keyboard.press("Enter")
    window.until("!document.querySelector('#help').open")


@pytest.mark.full
def test_always_the_newest_and_never_a_backlog(stage: Stage, window: Window) -> None:
    actor = stage.vehicles["uav/1"]
    for step in range(6, 206):  # faster than anyone can draw
        actor.show(time_s=float(step), scatter=cloud(4000, step=step))
    window.until("plumeward.state.models['uav/1'].scene.time_s === 205")
    window.drawn()
    assert window.of("plumeward.drawn") < 100  # most were never sent


FRAMES = """window.frames_waited = new Promise((done) => {
    const before = plumeward.drawn;
    let frames = -1;
    const look = () => {
        if (frames >= 0 && plumeward.drawn > before) return done(frames);
        if (frames >= 0 || plumeward.state.models['uav/1'].scene.time_s === TIME_S) frames += 1;
        requestAnimationFrame(look);
    };
    requestAnimationFrame(look);
}), 0"""
"""Counts the frames from the one that finds a scene there to the one that finds it drawn, less one."""


def test_a_scene_is_drawn_a_few_frames_after_it_came(stage: Stage, window: Window) -> None:
    actor = stage.vehicles["uav/1"]
    before = window.of("plumeward.latencies_ms.length")
    for time_s in range(100, 120):
        window.of(FRAMES.replace("TIME_S", str(time_s)))
        actor.show(time_s=float(time_s), scatter=cloud(4000, step=time_s))
        assert window.of("window.frames_waited") <= 3
    assert window.of("plumeward.latencies_ms.length") == before + 20  # each was drawn, and its age noted
