"""Protects the drawing: what a scene says is where it should be, as artists' data and as pixels, and the
same scene is the same file.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scene.scene import Backdrop, Craft, Measurement, Release, Scatter, Scene

pytestmark = pytest.mark.slow

SOURCE = (20.0, 24.0)
RELEASE = Release(SOURCE, wind=(2.0, 0.0), q=300.0, d=2.0, tau=10.0)
"""Wind comes from the east: gas lies to the west."""
PLACES = [(3.0, 4.0), (4.0, 4.0), (4.0, 5.0), (5.0, 9.0)]
TAKEN = [
    Measurement(step, float(step), place, gas, spread_m, (11.0, 13.0), (4.0, 0.0, 1.0))
    for step, (place, gas, spread_m) in enumerate(
        zip(PLACES, (0.1, -0.2, 7.0, 31.0), (9.0, 4.0, 2.0, 0.4), strict=True)
    )
]


def scene(steps: int = 4, release: Release | None = RELEASE) -> Scene:
    taken = TAKEN[:steps]
    places = np.array([[8.0, 2.0], [26.0, 2.0]], np.float32)
    return Scene(
        Backdrop("uav/1", title="homing, seed 3", release=release),
        craft=Craft(0.0, taken[-1].position, heading=math.pi / 2),
        measurements=taken,
        scatter=Scatter(places, np.array([0.75, 0.25], np.float32)),
        wind=(2.0, 0.0),
        stop="spread:0.5",
    )


def blank(*of: Any, **settings: Any) -> Any:
    """A drawing that shows nothing yet."""
    from scene.drawing import Drawing  # which loads matplotlib

    return Drawing(*of, **settings)


@pytest.fixture(scope="module")
def drawing() -> Any:
    return blank(scene(), steps=4)


def colour_at(drawing: Any, place: tuple[float, float]) -> np.ndarray:
    """The colour that is seen at a place of the map: three numbers from 0 to 255."""
    image = drawing.pixels()
    x, y = drawing.map.transData.transform(place)
    return image[round(image.shape[0] - 1 - y), round(x)].astype(int)


def is_orange(colour: np.ndarray) -> bool:
    red, green, blue = colour
    return bool(red > green > blue and red - blue > 30)


def test_path_readings_and_curves_are_those_of_the_measurements(drawing: Any) -> None:
    drawing.show(scene())
    (vehicle,) = drawing.vehicles
    assert vehicle.path.get_xydata().tolist() == [list(place) for place in PLACES]
    assert drawing.readings.get_offsets().tolist() == [list(place) for place in PLACES]
    assert drawing.readings.get_array().tolist() == [0.1, -0.2, 7.0, 31.0]
    assert drawing.spreads.get_xydata().tolist() == [[0, 9.0], [1, 4.0], [2, 2.0], [3, 0.4]]
    assert vehicle.gases.get_xydata().tolist() == [[0, 0.1], [1, -0.2], [2, 7.0], [3, 31.0]]
    assert any(set(line.get_ydata()) == {0.5} for line in drawing.spread.lines)  # ζ
    for chart, curve in ((drawing.spread, drawing.spreads), (drawing.gas, vehicle.gases)):
        (left, right), (low, high) = chart.get_xlim(), chart.get_ylim()
        assert all(left < x < right and low < y < high for x, y in curve.get_xydata())


def test_each_vehicle_of_a_search_has_its_way_its_gas_and_its_name() -> None:
    places = [(20.0, 20.0), (21.0, 20.0)]
    taken = [replace(it, position=place, gas=5.0) for it, place in zip(TAKEN, places, strict=False)]
    other = replace(scene(2), backdrop=Backdrop("uav/2"), measurements=taken)
    both = blank(scene(2), steps=4, beside=[other]).show(scene(2), [other])
    first, second = both.vehicles
    assert second.path.get_xydata().tolist() == [list(place) for place in places]
    assert second.gases.get_xydata().tolist() == [[0, 5.0], [1, 5.0]]
    assert both.readings.get_array().tolist() == [0.1, -0.2, 5.0, 5.0]
    assert first.path.get_color() != second.path.get_color() == second.gases.get_color()
    (legend,) = both.figure.legends
    assert [text.get_text() for text in legend.get_texts()][:2] == ["uav/1", "uav/2"]


def test_names_and_the_legend_of_many_vehicles_lie_on_nothing_that_is_written() -> None:
    corners = [(1.0, 1.0), (29.0, 1.0), (29.0, 29.0), (1.0, 29.0)]
    scenes = [
        replace(
            scene(),
            backdrop=Backdrop(f"uav/{i + 1}", title="a"),
            craft=Craft(0.0, place),
            measurements=[replace(it, position=place) for it in TAKEN],
        )
        for i, place in enumerate([*corners, *PLACES])
    ]
    drawing = blank(scenes[0], beliefs=[scenes[0]] * 5, steps=4, beside=scenes[1:]).show(
        scenes[0], scenes[1:]
    )
    drawing.figure.canvas.draw()
    edges = drawing.map.get_window_extent()
    for vehicle in drawing.vehicles:
        name = vehicle.name.get_window_extent()
        assert edges.x0 < name.x0 < name.x1 < edges.x1
        assert edges.y0 < name.y0 < name.y1 < edges.y1
    (legend,) = drawing.figure.legends
    words, label = [it.get_window_extent() for it in legend.get_texts()], drawing.map.xaxis.label
    assert max(it.y1 for it in words) < label.get_window_extent().y0
    assert min(it.y0 for it in words) > 0
    assert max(it.x1 for it in words) < drawing.figure.bbox.x1


def test_gas_of_a_vehicle_that_has_left_ends_where_it_left() -> None:
    after = replace(scene(), measurements=[*TAKEN[:3], replace(TAKEN[2], step=3, gas=math.nan)])
    shown = blank(after, steps=4).show(after)
    assert shown.readings.get_array().tolist() == [0.1, -0.2, 7.0]
    (vehicle,) = shown.vehicles
    assert np.isnan(vehicle.gases.get_ydata()).tolist() == [False, False, False, True]


def test_buildings_are_filled_and_the_polygon_to_keep_in_is_a_line() -> None:
    wall, fence = ((4.0, 4.0), (8.0, 4.0), (8.0, 9.0)), ((1.0, 1.0), (28.0, 1.0), (28.0, 28.0))
    made = scene(release=None)
    made = replace(made, backdrop=replace(made.backdrop, walls=(wall,), fence=fence))
    (inside, line), ring = (drawn := blank(made).show(made)).map.patches[:2], drawn.map.patches[2:]
    assert (inside.get_fill(), line.get_fill(), len(ring)) == (True, False, 1)
    assert colour_at(drawn, (7.0, 5.0)).max() < 220
    assert [tuple(corner) for corner in line.get_xy()[:3]] == list(fence)


def test_the_belief_is_its_particles_with_area_by_weight_and_its_ellipse_of_two_deviations(
    drawing: Any,
) -> None:
    drawing.show(scene())
    (dots,) = (it for it in drawing.map.collections if len(it.get_offsets()) == 2)
    assert dots.get_offsets().tolist() == [[8.0, 2.0], [26.0, 2.0]]
    one, other = dots.get_sizes()
    assert one == pytest.approx(3 * other)
    (ring,) = drawing.map.patches
    assert (ring.get_center(), ring.get_width(), ring.get_height(), ring.get_angle()) == (
        (11.0, 13.0),
        8.0,
        4.0,
        0.0,
    )


def test_gas_is_seen_downwind_of_the_source_and_nowhere_without_the_truth(drawing: Any) -> None:
    drawing.show(scene())
    assert colour_at(drawing, SOURCE).max() < 60  # the black star
    assert is_orange(colour_at(drawing, (17.0, 24.0)))
    assert colour_at(drawing, (29.5, 24.0)).min() > 240
    plain = blank(scene(release=None)).show(scene(release=None))
    assert colour_at(plain, SOURCE).tolist() == colour_at(plain, (17.0, 24.0)).tolist() == [255, 255, 255]


def test_the_vehicle_moves_from_frame_to_frame(drawing: Any) -> None:
    drawing.show(scene(1))
    assert is_orange(colour_at(drawing, PLACES[0]))
    assert colour_at(drawing, PLACES[3]).min() > 240
    drawing.show(scene(4))
    assert is_orange(colour_at(drawing, PLACES[3]))
    assert not is_orange(colour_at(drawing, PLACES[0]))


def test_a_drawing_that_showed_another_scene_before_shows_the_same_as_a_new_one() -> None:
    used = blank(scene(), steps=4).show(scene(2))
    used.pixels()
    image = used.show(scene()).pixels()
    assert (image.shape, image.dtype) == ((540, 960, 3), np.uint8)
    np.testing.assert_array_equal(image, blank(scene(), steps=4).show(scene()).pixels())


def test_charts_get_wider_as_steps_and_gas_grow() -> None:
    small = blank(scene(), steps=2).show(scene(2))
    assert small.gas.get_xlim()[1] < 3
    small.pixels()
    grown = small.show(replace(scene(), measurements=[*TAKEN, replace(TAKEN[-1], step=9, gas=5000.0)]))
    assert grown.gas.get_xlim()[1] > 9
    assert grown.gas.get_ylim()[1] > 5000


def test_the_wind_arrow_points_to_where_the_air_flows(drawing: Any) -> None:
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.text import Text

    drawing.show(replace(scene(), wind=(0.0, 3.0)))  # from the north
    drawing.pixels()
    (arrow,) = drawing.figure.findobj(FancyArrowPatch)
    tail, head = arrow.get_path().vertices[:2]
    assert head[0] == pytest.approx(tail[0])
    assert head[1] < 0 < tail[1]
    assert any("3.0 m/s" in text.get_text() for text in drawing.figure.findobj(Text))


def test_a_picture_shows_beliefs_in_colours_of_their_own_and_says_of_which_step(tmp_path: Path) -> None:
    from scene.drawing import BELIEFS

    picture = blank(scene(), beliefs=[scene(1), scene(2), scene(4)]).show(scene())
    rings = [patch.get_edgecolor() for patch in picture.map.patches if patch.get_visible()]
    assert len(set(rings)) == 3
    said = [text.get_text() for text in picture.figure.legends[0].get_texts()]
    assert [words for words in said if "belief" in words] == [
        f"belief at step {step}: particles, 2 σ" for step in (0, 1, 3)
    ]
    assert "vehicle" not in said
    assert len(set(BELIEFS)) == len(BELIEFS) == 5
    for form in ("svg", "png"):
        files = [tmp_path / f"{name}.{form}" for name in ("one", "two")]
        for file in files:
            blank(scene(), beliefs=[scene(1), scene(2), scene(4)]).show(scene()).save(file, form)
        assert files[0].read_bytes() == files[1].read_bytes()
    assert b"<dc:date>" not in (tmp_path / "one.svg").read_bytes()


def test_more_particles_do_not_hide_more_of_the_map(drawing: Any) -> None:
    covered = []
    for count in (1000, 4000):
        scatter = Scatter(np.full((count, 2), 5, np.float32), np.full(count, 1 / count, np.float32))
        drawing.show(replace(scene(), scatter=scatter))
        (dots,) = (it for it in drawing.map.collections if len(it.get_offsets()) == count)
        covered.append(dots.get_sizes().sum())
    assert covered[0] == pytest.approx(covered[1], rel=1e-5)


def test_a_scene_without_a_reading_can_be_drawn() -> None:
    empty = Scene(Backdrop("uav/1"))
    assert blank(empty).show(empty).pixels().shape == (540, 960, 3)


def test_the_map_widens_for_an_estimate_outside_the_area_and_shows_where_that_ends() -> None:
    far = Measurement(4, 4.0, (1.0, 5.0), 0.1, 3.0, (-4.0, 13.0), (4.0, 0.0, 1.0))
    wide = blank(scene(), steps=4)
    assert wide.map.get_xlim() == (0, 30)
    wide.show(replace(scene(), measurements=[*TAKEN, far]))
    (low, high), (south, north) = wide.map.get_xlim(), wide.map.get_ylim()
    assert low <= -4 < 0 < 30 < high
    assert (south, north) == (low, high)
    edge, inside, outside = (colour_at(wide, (x, 15.0)) for x in (30.0, 29.0, 31.0))
    assert edge.sum() < min(inside.sum(), outside.sum()) - 100


def test_an_absurd_estimate_leaves_the_area_in_sight() -> None:
    absurd = Measurement(4, 4.0, (1.0, 5.0), 0.1, 3.0, (-1e100, 13.0), (4.0, 0.0, 1.0))
    wide = blank(scene(), steps=4).show(replace(scene(), measurements=[*TAKEN, absurd]))
    assert wide.map.get_xlim() == (-60, 90)
    assert wide.pixels().shape[2] == 3


def in_wind(*winds: tuple[float, float]) -> Scene:
    """A scene with a reading in each of these winds."""
    taken = [
        replace(TAKEN[0], step=step, position=(4.0 + step, 5.0), measured_wind=wind)
        for step, wind in enumerate(winds)
    ]
    return replace(scene(), measurements=taken)


def test_where_the_wind_turned_is_marked_once_it_has_and_nowhere_in_a_steady_wind(tmp_path: Path) -> None:
    from matplotlib.patches import FancyArrowPatch

    east, north = (2.0, 0.0), (0.0, 2.0)
    turned = in_wind(*[east] * 5, *[north] * 4)
    drawing = blank(turned, steps=9).show(turned)
    arrows = [arrow for arrow in drawing.map.findobj(FancyArrowPatch) if arrow.get_visible()]
    tails = [arrow.get_path().vertices[0].tolist() for arrow in arrows]
    heads = [arrow.get_path().vertices[2] - arrow.get_path().vertices[0] for arrow in arrows]
    assert tails == [pytest.approx([9.0, 5.0])] * 2
    west, south = heads  # air flows to the west, then to the south
    assert west == pytest.approx([-np.hypot(*west), 0.0], abs=0.01)
    assert south == pytest.approx([0.0, -np.hypot(*south)], abs=0.01)
    assert [line.get_xdata() for line in drawing.gas.lines if line.get_linestyle() == ":"] == [[5, 5]]
    assert any(text.get_text().startswith("wind turns") for text in drawing.figure.legends[0].get_texts())
    before = replace(turned, measurements=turned.measurements[:5])
    assert not [it for it in drawing.show(before).map.findobj(FancyArrowPatch) if it.get_visible()]

    steady = in_wind(*[east] * 9)
    marked, plain = tmp_path / "steady.svg", tmp_path / "unknown.svg"
    blank(steady, beliefs=[steady]).show(steady).save(marked, "svg")
    unknown = replace(steady, measurements=[replace(it, measured_wind=None) for it in steady.measurements])
    blank(unknown, beliefs=[unknown]).show(unknown).save(plain, "svg")
    assert marked.read_bytes() == plain.read_bytes()
