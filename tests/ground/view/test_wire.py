"""Protects the messages that the page reads: their bytes, and that nothing is sent twice or left out."""

import json
import math
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ground.view.wire import Sent, framed, packed
from plume.problem import AREA
from scene.scene import INFO, Backdrop, Condition, Craft, Happening, Measurement, Release, Scatter, Scene

RELEASE = Release((20.0, 12.0), (1.0, 0.0), q=300.0, d=4.0, tau=10.0)
SCATTER = Scatter(np.array([[1, 2], [3, 4]], np.float32), np.array([0.25, 0.75], np.float32))
HISTORY, ANOTHER = object(), object()


def measurement(step: int, gas: float = 0.5) -> Measurement:
    return Measurement(step, 10.0 + step, (1.0 + step, 2.0), gas, 3.0, (5.0, 6.0), (4.0, 0.0, 1.0))


UNSAID = {
    "battery": None,
    "volts": None,
    "gps": "",
    "health": "",
    "speed_mps": None,
    "lost": None,
    "radio": None,
}
SCENE = Scene(
    Backdrop("uav/1", AREA, "homing, seed 1", RELEASE),
    time_s=12.5,
    craft=Craft(12.5, (1.5, 2.5), 5.0, 0.5, "OFFBOARD", True),
    track=np.array([[0, 0], [1, 0], [2, 0]], np.float32),
    measurements=[measurement(0), measurement(1)],
    scatter=SCATTER,
    waypoint=(3.0, 2.0),
    wind=(1.0, -1.0),
    stop="spread:0.5",
    assume="field",
    happenings=[Happening(1.0, INFO, "uav", "armed")],
)


def unpacked(message: bytes) -> tuple[dict[str, Any], dict[str, list[float]]]:
    """Header and numbers of a message, taken apart by hand."""
    (length,) = struct.unpack_from("<I", message)
    assert (4 + length) % 4 == 0
    header, at, arrays = json.loads(message[4 : 4 + length]), 4 + length, {}
    for array in header["arrays"]:
        count = math.prod(array["shape"])
        arrays[array["name"]] = list(struct.unpack_from(f"<{count}f", message, at))
        at += 4 * count
    assert at == len(message)
    return header, arrays


def sent(
    scene: Scene, cursor: Sent, history: object = HISTORY, **how: Any
) -> tuple[dict[str, Any], dict[str, list[float]]]:
    return unpacked(packed(scene, cursor, history, 7, **how))


def test_a_message_is_a_length_a_padded_header_and_float32() -> None:
    message = framed({"a": 1}, [np.array([[1.0, -2.0]], np.float32)])
    assert message == b"\x08\0\0\0" + b'{"a":1} ' + b"\0\0\x80\x3f" + b"\0\0\0\xc0"


def test_a_scene_is_sent_in_full_at_first() -> None:
    header, arrays = sent(SCENE, Sent(), published_ms=1763800000000.5)
    assert header["number"] == 7
    assert header["vehicle"] == "uav/1"
    assert header["published_ms"] == 1763800000000.5
    assert header["threshold_m"] == 0.5
    assert (
        header["craft"]
        == {"x": 1.5, "y": 2.5, "altitude_m": 5.0, "heading": 0.5, "mode": "OFFBOARD", "armed": True}
        | {"means": "OFFBOARD", "home_m": math.hypot(1.5, 2.5), "home": [0.0, 0.0]}
        | UNSAID
    )
    assert header["estimate"] == {
        "x": 5.0,
        "y": 6.0,
        "spread_m": 3.0,
        "radius_95_m": None,
        "ellipse": [4.0, 2.0, 0.0],
    }  # 2 σ of variances 4 and 1 m²
    assert header["measurements"] == {
        "from": 0,
        "rows": [
            [0, 10.0, 1.0, 2.0, 0.5, 3.0, 5.0, 6.0, *[None] * 6, 1.0, 0.0, None],
            [1, 11.0, 2.0, 2.0, 0.5, 3.0, 5.0, 6.0, *[None] * 6, 1.0, 0.0, None],
        ],
    }
    assert header["happenings"] == {"from": 0, "rows": [[1.0, "info", "uav", "armed"]]}
    assert header["truth"] is None
    assert header["ending"] is None
    assert arrays == {"particles": [1, 2, 0.25, 3, 4, 0.75], "track": [0, 0, 1, 0, 2, 0]}


def test_how_the_gas_comes_and_goes_is_that_of_the_newest_belief() -> None:
    assert sent(SCENE, Sent())[0]["gas"] is None
    said = {"downwind": (0.5, 1.0, 2.0)}
    told = replace(measurement(2), intermittency=said, advised_dwell_s=2.0)
    header, _ = sent(replace(SCENE, measurements=[*SCENE.measurements, told]), Sent())
    assert header["gas"] == {"intermittency": {"downwind": [0.5, 1.0, 2.0]}, "advised_dwell_s": 2.0}
    assert sent(replace(SCENE, measurements=[told, measurement(3)]), Sent())[0]["gas"] is None
    assert sent(replace(SCENE, measurements=[]), Sent())[0]["gas"] is None


def test_only_what_is_new_follows() -> None:
    cursor = Sent()
    sent(SCENE, cursor)
    later = replace(
        SCENE,
        measurements=[*SCENE.measurements, measurement(2)],
        track=np.array([[0, 0], [1, 0], [2, 0], [2, 1]], np.float32),
    )
    header, arrays = sent(later, cursor)
    assert [row[0] for row in header["measurements"]["rows"]] == [2]
    assert header["measurements"]["from"] == 2
    assert header["happenings"] == {"from": 1, "rows": []}
    assert arrays == {"track": [2, 1]}
    assert header["arrays"][0]["from"] == 3


def test_going_back_in_time_cuts_off_what_comes_later() -> None:
    cursor = Sent()
    sent(SCENE, cursor)
    header, arrays = sent(
        replace(SCENE, measurements=[measurement(0)], track=SCENE.track[:1], scatter=None, happenings=[]),
        cursor,
    )
    assert header["measurements"] == {"from": 1, "rows": []}
    assert header["happenings"] == {"from": 0, "rows": []}
    assert header["arrays"] == [
        {"name": "particles", "shape": [0, 3]},
        {"name": "track", "from": 1, "shape": [0, 2]},
    ]
    assert arrays == {"particles": [], "track": []}


def test_another_mission_is_sent_from_its_beginning() -> None:
    cursor = Sent()
    sent(SCENE, cursor)
    header, arrays = sent(SCENE, cursor, ANOTHER)
    assert header["measurements"]["from"] == header["happenings"]["from"] == 0
    assert len(arrays["track"]) == 6
    assert len(arrays["particles"]) == 6


def test_what_the_newest_columns_of_a_reading_say() -> None:
    told = replace(
        measurement(2),
        radius_95_m=2.5,
        wind=(1.0, -1.0),
        rate=(1.0, 2.0, 4.0),
        p_value=0.3,
        evidence=7.0,
        effective_sample_size=90.0,
    )
    header, _ = sent(replace(SCENE, measurements=[told]), Sent())
    assert header["measurements"]["rows"][0][8:] == [2.5, 1.0, -1.0, 1.0, 2.0, 4.0, 0.3, 7.0, 90.0]
    assert header["estimate"]["radius_95_m"] == 2.5
    assert header["state"]["text"].startswith("Searching: the source is within 2.5 m of the cross (95%)")


def test_a_vehicle_aside_is_sent_without_particles_and_with_them_once_it_is_in_the_middle() -> None:
    cursor = Sent()
    _, arrays = sent(SCENE, cursor, aside=True)
    assert set(arrays) == {"track"}
    _, arrays = sent(SCENE, cursor)
    assert arrays["particles"] == [1, 2, 0.25, 3, 4, 0.75]


def test_walls_are_sent_once() -> None:
    wall = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))
    walled = replace(SCENE, backdrop=replace(SCENE.backdrop, walls=(wall,), fence=wall))
    cursor = Sent()
    header, _ = sent(walled, cursor)
    assert (header["walls"], header["fence"]) == ([[[0, 0], [1, 0], [1, 1]]], [[0, 0], [1, 0], [1, 1]])
    header, _ = sent(walled, cursor)
    assert (header["walls"], header["fence"]) == (None, None)


def test_the_truth_is_sent_once_and_only_when_asked_for() -> None:
    cursor = Sent()
    assert "plume" not in sent(SCENE, cursor)[1]
    header, arrays = sent(SCENE, cursor, truth=True)
    assert header["truth"] == {"sources": [[20.0, 12.0]]}
    gas = np.array(arrays["plume"]).reshape(96, 96)
    row, column = np.unravel_index(gas.argmax(), gas.shape)
    assert math.dist(((column + 0.5) * 30 / 96, (row + 0.5) * 30 / 96), (20.0, 12.0)) < 0.5
    assert "plume" not in sent(SCENE, cursor, truth=True)[1]
    moved = replace(SCENE, backdrop=replace(SCENE.backdrop, release=replace(RELEASE, wind=(0.0, 1.0))))
    assert "plume" in sent(moved, cursor, truth=True)[1]
    assert sent(moved, cursor)[0]["truth"] is None
    assert "plume" in sent(moved, cursor, truth=True)[1]


def test_a_real_flight_has_no_truth_to_send() -> None:
    real = replace(SCENE, backdrop=replace(SCENE.backdrop, release=None))
    header, arrays = sent(real, Sent(), truth=True)
    assert header["truth"] is None
    assert "plume" not in arrays


@pytest.mark.parametrize("heading", [math.nan, math.inf])
def test_numbers_that_are_not_finite_are_null(heading: float) -> None:
    scene = replace(
        SCENE, craft=Craft(1.0, (1.0, 2.0), heading=heading), measurements=[measurement(0, math.nan)]
    )
    header, _ = sent(scene, Sent())
    assert header["craft"]["heading"] is None
    assert header["measurements"]["rows"][0][4] is None


def test_a_vehicle_that_has_not_said_where_it_is_has_no_place_yet_but_a_mode() -> None:
    craft = sent(replace(SCENE, craft=Craft(0.0, (math.nan, math.nan), mode="HOLD")), Sent())[0]["craft"]
    assert (craft["x"], craft["y"], craft["mode"]) == (None, None, "HOLD")


def test_what_the_vehicle_says_of_itself_is_sent() -> None:
    condition = Condition(0.5, 15.1, "no fix", ("gps",), placed=False, radio=(180.0, math.nan))
    craft = sent(replace(SCENE, craft=Craft(0.0, (1.0, 2.0), condition=condition)), Sent())[0]["craft"]
    assert {name: craft[name] for name in UNSAID} == {
        "speed_mps": None,
        "battery": 0.5,
        "volts": 15.1,
        "gps": "no fix",
        "health": "not healthy: gps, position",
        "lost": None,
        "radio": [180.0, None],
    }
