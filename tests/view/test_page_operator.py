"""Protects what an operator does with the page: looks closer, asks what is under the pointer, copies where the source
is, watches several vehicles, and presses buttons that never move.
"""

import io
from collections.abc import Callable
from dataclasses import replace

import pytest
from PIL import Image

from tests.view.conftest import PHONE, Window
from tests.view.stage import RELEASE, Stage, cloud, measured, scene, states

MAP = "plumeward.panes.get('uav/1').map"
FIRST_LOAD_BYTES = 150_000


@pytest.fixture
def window(stage: Stage, look: Callable[..., Window]) -> Window:
    """The page with one vehicle, drawn."""
    stage.enter(scene())
    return drawn(look(stage.address))


def drawn(window: Window) -> Window:
    window.until(f"plumeward.drawn > 0 && plumeward.panes.get('uav/1') && {MAP}.view")
    return window


def at(window: Window, x: float, y: float) -> tuple[float, float]:
    """Where a place in m is in the window, px."""
    box = window.page.locator(".map canvas").bounding_box()
    px, py = window.of(f"[{MAP}.view.x({x}), {MAP}.view.y({y})]")
    return box["x"] + px, box["y"] + py


# ---- the map ----


def test_the_wheel_zooms_to_where_the_pointer_is_and_all_brings_everything_back(window: Window) -> None:
    before, place = window.of(f"{MAP}.view.scale"), at(window, 6.0, 12.0)
    window.page.mouse.move(*place)
    window.page.mouse.wheel(0, -600)
    window.until(f"{MAP}.view.scale > 1.5 * {before}")
    assert at(window, 6.0, 12.0) == pytest.approx(place, abs=1.5)
    window.page.get_by_role("button", name="All", exact=True).click()
    window.drawn()
    assert window.of(f"{MAP}.view.scale") == pytest.approx(before)


def test_the_mouse_moves_the_map_and_keys_do_both(window: Window) -> None:
    x, y = at(window, 6.0, 12.0)
    window.page.mouse.move(x, y)
    window.page.mouse.down()
    window.page.mouse.move(x + 50, y - 30)
    window.page.mouse.up()
    window.drawn()
    assert at(window, 6.0, 12.0) == pytest.approx((x + 50, y - 30), abs=1.5)
    window.page.locator(".map canvas").focus()
    window.page.keyboard.press("ArrowLeft")
    window.drawn()
    assert at(window, 6.0, 12.0) == pytest.approx((x + 110, y - 30), abs=1.5)
    scale = window.of(f"{MAP}.view.scale")
    window.page.keyboard.press("+")
    window.drawn()
    assert window.of(f"{MAP}.view.scale") == pytest.approx(1.3 * scale)
    window.page.keyboard.press("a")
    window.drawn()
    assert at(window, 6.0, 12.0) == pytest.approx((x, y), abs=1.5)


def test_a_map_is_never_empty_while_its_window_changes(window: Window) -> None:
    opaque = window.of(f"""new Promise((done) => {{
        const {{ canvas }} = {MAP};
        canvas.style.width = '60%';
        new ResizeObserver(() => done(canvas.getContext('2d').getImageData(9, 9, 1, 1).data[3])).observe(canvas);
    }})""")
    assert opaque == 255


def test_a_small_belief_is_seen_large_in_a_corner_and_fills_the_map_when_asked_for(
    stage: Stage, window: Window
) -> None:
    assert window.of(f"{MAP}.inset") is None
    near = replace(measured(6, 0.2), covariance=(0.02, 0.0, 0.02))
    stage.vehicles["uav/1"].show(
        measurements=(*scene().measurements, near), scatter=cloud(400, (10.0, 20.0), 0.4)
    )
    window.until(f"{MAP}.inset")
    left, top, side = window.of(f"[{MAP}.inset.left, {MAP}.inset.top, {MAP}.inset.width]")
    inside = window.of(
        f"(() => {{ const {{ canvas, ratio }} = {MAP}; const {{ data }} = canvas.getContext('2d')"
        f".getImageData(...[{left}, {top}, {side}, {side}].map((px) => px * ratio)); let blue = 0;"
        "for (let i = 0; i < data.length; i += 4) blue += data[i + 2] > data[i] + 60; return blue; })()"
    )
    assert inside > 500  # the particles
    window.page.keyboard.press("b")
    window.until(f"!{MAP}.inset")
    assert window.of(f"{MAP}.view.scale") > 100
    assert window.page.get_by_role("button", name="To the belief").get_attribute("aria-pressed") == "true"


def test_the_inset_of_a_small_belief_hides_no_vehicle_on_a_phone(
    stage: Stage, look: Callable[..., Window]
) -> None:
    """The belief is in the north-west; first uav/1 is in the far corner, then uav/2 in the other, too."""
    near = replace(measured(6, 0.2, estimate=(10.0, 20.0)), covariance=(0.02, 0.0, 0.02))
    places = {"uav/1": (27.0, 3.0), "uav/2": (10.0, 27.0)}
    for name, place in places.items():
        craft = replace(scene().craft, position=place)
        stage.enter(replace(scene(name), craft=craft, waypoint=None), "search")
    stage.vehicles["uav/1"].show(measurements=(*scene().measurements, near))
    window = drawn(look(stage.address, PHONE, has_touch=True, is_mobile=True))
    for other in ((10.0, 27.0), (3.0, 3.0)):
        stage.vehicles["uav/2"].show(craft=replace(scene().craft, position=other))
        window.until(f"{MAP}.inset && {MAP}.others[0]?.scene?.craft.x === {other[0]}")
        window.drawn()
        left, top, side = window.of(f"[{MAP}.inset.left, {MAP}.inset.top, {MAP}.inset.width]")
        for x, y in (places["uav/1"], other, (10.0, 20.0)):
            px, py = window.of(f"[{MAP}.view.x({x}), {MAP}.view.y({y})]")
            assert not (left - 8 < px < left + side + 8 and top - 8 < py < top + side + 8)
        width, height = window.of(f"[{MAP}.width, {MAP}.height]")
        assert left > 0
        assert top > 0
        assert left + side < width
        assert top + side < height


def test_where_vehicles_are_in_every_corner_the_inset_hides_another_than_the_one_that_is_shown(
    stage: Stage, look: Callable[..., Window]
) -> None:
    near = replace(measured(6, 0.2, estimate=(10.0, 20.0)), covariance=(0.02, 0.0, 0.02))
    for name, place in {"uav/1": (27.0, 3.0), "uav/2": (3.0, 3.0), "uav/3": (10.0, 27.0)}.items():
        stage.enter(
            replace(scene(name), craft=replace(scene().craft, position=place), waypoint=None), "search"
        )
    stage.vehicles["uav/1"].show(measurements=(*scene().measurements, near))
    window = drawn(look(stage.address, PHONE, has_touch=True, is_mobile=True))
    window.until(f"{MAP}.inset && {MAP}.others.filter(({{ scene }}) => scene).length === 2")
    window.drawn()
    left, top, side = window.of(f"[{MAP}.inset.left, {MAP}.inset.top, {MAP}.inset.width]")
    for x, y in ((27.0, 3.0), (10.0, 20.0)):  # the vehicle that is shown, and the belief
        px, py = window.of(f"[{MAP}.view.x({x}), {MAP}.view.y({y})]")
        assert not (left - 8 < px < left + side + 8 and top - 8 < py < top + side + 8)


def test_what_is_under_the_pointer_is_told(window: Window) -> None:
    window.page.mouse.move(*at(window, 15.0, 15.0))
    window.until("document.querySelector('.pointer').textContent")
    # 15 m are 15 / 111,194.9 degrees of latitude, and of longitude that over cos 51.4494°.
    assert window.text(".pointer") == "15.0 m east, 15.0 m north · 51.449535 N, 2.602084 W"
    window.page.mouse.move(*at(window, 4.0, 4.0))
    window.until("document.querySelector('.pointer').textContent.includes('reading')")
    assert window.text(".pointer").startswith("reading 4: 1.00 g/m³, at 4.0 s · ")


def test_noise_is_grey_whatever_else_was_read(stage: Stage, look: Callable[..., Window]) -> None:
    made = scene()
    faint = tuple(replace(each, gas=0.1) for each in made.measurements)
    stage.enter(replace(made, measurements=faint))
    window = drawn(look(stage.address))
    assert window.count("noise", (1.8, 3.7, 2.2, 4.3)) > 8
    assert "< 0.4: noise" in window.text(".gauge")


def test_all_vehicles_are_on_the_map_with_their_names(stage: Stage, window: Window) -> None:
    other = replace(scene("uav/2"), craft=replace(scene().craft, position=(26.0, 20.0)), waypoint=None)
    stage.enter(other)
    window.until("plumeward.state.models['uav/2']?.scene")
    window.drawn()
    label = window.page.locator(".map canvas").get_attribute("aria-label")
    assert "uav/2 at (26.0, 20.0)" in label
    assert window.count("muted", (25.4, 19.4, 26.6, 20.6)) > 20
    assert window.text(".sentence").startswith("uav/1: Searching")
    assert window.of("plumeward.state.models['uav/2'].particles.length") == 0  # they are not sent for it
    assert not window.page.locator(".of-others").is_hidden()


def test_a_vehicle_of_another_mission_lies_at_its_own_home(stage: Stage, look: Callable[..., Window]) -> None:
    made = scene()
    assert made.home is not None
    latitude, longitude, height = made.home
    stage.enter(made)
    stage.enter(
        replace(
            scene("uav/2"),
            home=(latitude + 40 / 111_194.9, longitude, height),  # 40 m further north
            craft=replace(made.craft, position=(5.0, 6.0)),
            waypoint=None,
        )
    )
    window = drawn(look(stage.address))
    window.until("plumeward.state.models['uav/2']?.scene")
    window.drawn()
    assert "uav/2 at (5.0, 46.0)" in window.page.locator(".map canvas").get_attribute("aria-label")
    assert window.count("muted", (4.4, 45.4, 5.6, 46.6)) > 5
    assert window.count("muted", (29.0, 50.0, 31.0, 60.0)) > 10  # the edge of its area
    window.keep("two-missions")
    window.page.mouse.move(*at(window, 4.0, 44.0))  # its fifth reading
    window.until("document.querySelector('.pointer').textContent.includes('reading')")
    assert window.text(".pointer").startswith("uav/2, reading 4: ")


def test_walls_and_home_are_drawn(stage: Stage, look: Callable[..., Window]) -> None:
    made = scene()
    walls = (((24.0, 2.0), (28.0, 2.0), (28.0, 6.0), (24.0, 6.0)),)
    fence = ((1.0, 1.0), (29.0, 1.0), (29.0, 29.0), (1.0, 29.0))
    stage.enter(replace(made, backdrop=replace(made.backdrop, walls=walls, fence=fence)))
    window = drawn(look(stage.address))
    assert window.count("ink", (28.7, 10.0, 29.3, 16.0)) > 30
    assert not window.page.locator(".of-fence").is_hidden()
    inside, outside = (sum(window.pixel(*place)) for place in ((25.7, 4.3), (21.7, 4.3)))
    assert inside < outside - 100
    assert window.count("ink", (-0.4, -0.4, 0.4, 0.4)) > 15


def test_a_picture_of_ones_own_lies_beneath_the_map_and_is_not_sent(window: Window) -> None:
    red = io.BytesIO()
    Image.new("RGB", (20, 20), (255, 0, 0)).save(red, "PNG")
    asked = len(window.asked)
    window.page.get_by_role("button", name="Picture…").click()
    window.page.get_by_label("Picture", exact=True).set_input_files(
        {"name": "plan.png", "mimeType": "image/png", "buffer": red.getvalue()}
    )
    window.page.get_by_role("button", name="Show it").click()
    window.until(f"{MAP}.picture")
    window.drawn()
    r, g, _ = window.pixel(27.3, 15.7)
    assert r > g + 100
    assert len(window.asked) == asked
    assert window.violations() == []


# ---- the sentence and the buttons ----


def test_where_the_source_is_can_be_copied(stage: Stage, look: Callable[..., Window]) -> None:
    stage.enter(states()["found"])
    window = drawn(look(stage.address, permissions=["clipboard-read", "clipboard-write"]))
    window.page.get_by_role("button", name="Copy coordinates").click()
    window.until("document.querySelector('.copy').textContent === 'Copied'")
    latitude, longitude = map(float, window.of("navigator.clipboard.readText()").split(", "))
    assert (latitude, longitude) == pytest.approx((51.44958, -2.602156), abs=1e-6)


def test_no_message_moves_a_button(stage: Stage, window: Window) -> None:
    def place() -> dict[str, float]:
        return window.page.get_by_role("button", name="Return").bounding_box()

    before = place()
    for shown in states().values():
        stage.vehicles["uav/1"].show(shown)
        window.until(f"plumeward.state.models['uav/1'].scene.state.kind !== '' && {MAP}.view")
        window.drawn()
        assert place() == before
    stage.notice = "the router is gone: waiting for it"
    stage.relist()
    window.until("!document.querySelector('#notice').hidden")
    assert place() == before


def test_an_answer_goes_when_it_is_stale(window: Window) -> None:
    window.page.clock.install()
    window.page.keyboard.press("h")
    window.until("plumeward.answers.length && document.querySelector('.answer').textContent")
    window.page.clock.fast_forward(8100)
    window.until("!document.querySelector('.answer').textContent")


# ---- charts ----


def test_events_are_marked_on_the_time_axis_and_say_what_they_are(window: Window) -> None:
    mark = window.page.locator(".chart-marks .mark[data-level=warning]")
    assert mark.get_attribute("aria-label") == "3.0 s · estimator: hot"
    mark.focus()
    window.until("document.querySelector('.charts-all .mark-words').textContent === '3.0 s · estimator: hot'")
    left = window.of("plumeward.panes.get('uav/1').charts.spread.valToPos(3, 'x')")
    plot = window.page.locator(".chart.spread .u-over").bounding_box()
    box = mark.bounding_box()
    assert box["x"] + box["width"] / 2 == pytest.approx(plot["x"] + left, abs=3)


@pytest.mark.full
def test_further_charts_are_one_click_away(window: Window) -> None:
    assert window.page.locator(".chart").count() == 2
    window.page.locator(".more summary").click()
    window.until("document.querySelectorAll('.chart').length === 7")
    titles = window.page.locator(".more-charts h3").all_inner_texts()
    assert titles[0] == "Release rate, with 90% of the belief: 324 kg/h"
    assert titles[1].startswith("Wind comes from: 217°")
    assert [title.split(":")[0] for title in titles[2:]] == [
        "Fit of the readings (p-value)",
        "Evidence for gas",
        "Effective sample size",
    ]
    assert RELEASE.wind == (-3.0, -4.0)
    assert window.violations() == []


# ---- weight ----


def test_the_first_load_is_light(stage: Stage, window: Window) -> None:
    entries = "performance.getEntriesByType('resource').map((entry) => entry.transferSize)"
    page = window.of("performance.getEntriesByType('navigation')[0].transferSize")
    assert page + sum(window.of(entries)) <= FIRST_LOAD_BYTES
