"""Protects what people are shown: each message of the bus changes the scene as it says, and a scene of the
past knows nothing newer.
"""

import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.words import Words
from link.bus.mavlink import Codec, Reading, pack_reading, waypoint_message
from link.bus.messages import Belief, Departure, Health, RoundReading, Stop, pack_particles
from link.record.reader import Recording, read
from link.record.record import Entry
from scene.follow.history import History, history_of, remark_on
from scene.scene import Backdrop, Release

RELEASE = Release((12.0, 20.0), (2.0, 0.0), 300.0, 4.0, 10.0)
UAV = Codec(1, 1)
GOLDEN = Path(__file__).parents[2] / "golden" / "greedy-gaussian.mcap"
PARTICLES = np.array([[1.0, 2.0, 0.25], [3.0, 4.0, 0.75]], np.float32)


def belief(step: int, **changed: object) -> bytes:
    said = Belief(
        time_boot_ms=1000 * step,
        step=step,
        position=(float(step), 1.0),
        altitude_m=5.0,
        gas=0.5,
        wind=(2.0, 0.0),
        sensor="gaussian",
        rate=300.0,
        diffusivity=4.0,
        lifetime=10.0,
        z=5.0,
        unknowns=("x", "y"),
        means=(11.5, 20.0),
        stds=(0.2, 0.3),
        mean=(11.5, 20.0),
        covariance=(0.04, 0.0, 0.09),
        spread=0.36,
        effective_sample_size=2.0,
        p_value=1.0,
        ceased=False,
        assume="field",
        stop="spread:0.5",
    )
    return msgspec.json.encode(msgspec.structs.replace(said, **changed))


def stop(step: int, estimate: tuple[float, float]) -> bytes:
    return msgspec.json.encode(Stop(1000 * step, step, estimate, (0.04, 0.0, 0.09), 0.36, 0.5, "spread:0.5"))


def health(service: str, uptime_s: float, **changed: object) -> bytes:
    said = Health(service, "ready", step=3, compute_s=0.1, uptime_s=uptime_s, refused={})
    return msgspec.json.encode(msgspec.structs.replace(said, **changed))


def said(history: History) -> list[tuple[str, str, str]]:
    return [(it.level, it.who, it.text) for it in history.at().happenings]


@pytest.fixture
def history() -> History:
    return History(Backdrop("uav/1", release=RELEASE), budget=300)


def test_before_anything_is_said_there_is_nothing_to_see(history: History) -> None:
    scene = history.at()
    assert (scene.craft, scene.scatter, scene.waypoint, scene.wind, scene.ending) == (None,) * 5
    assert len(scene.track) == len(scene.measurements) == len(scene.services) == len(scene.happenings) == 0


def test_the_vehicle_is_where_its_telemetry_says_with_x_east_and_y_north(history: History) -> None:
    local = mavlink.MAVLink_local_position_ned_message(
        1000, 7.0, 3.0, -5.0, 0.0, 0.0, 0.0
    )  # 7 m north, 3 m east, 5 m up
    attitude = mavlink.MAVLink_attitude_message(
        1000, 0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0
    )  # its nose to the east
    fix = mavlink.MAVLink_global_position_int_message(1000, 473977500, 85456000, 493_000, 5000, 0, 0, 0, 9000)
    assert history.take("mavlink/out", UAV.pack(local, attitude, fix), b"", 1.0, 100.0)
    craft = history.at().craft
    assert craft is not None
    assert (craft.position, craft.altitude_m) == ((3.0, 7.0), 5.0)
    assert craft.heading == pytest.approx(0.0, abs=1e-7)  # east is 0, counter-clockwise
    assert craft.fix == pytest.approx((47.39775, 8.5456, 493.0))
    assert history.at().track.tolist() == [[3.0, 7.0]]


def test_the_track_has_a_point_every_tenth_of_a_metre(history: History) -> None:
    for n in range(101):  # 1 m in steps of 1 cm
        frame = mavlink.MAVLink_local_position_ned_message(n, 0.0, n / 100, -5.0, 0.0, 0.0, 0.0)
        history.take("mavlink/out", UAV.pack(frame), b"", n / 10, 100.0)
    track = history.at().track
    assert 10 <= len(track) <= 11  # float32 may put a point one centimetre later
    assert np.all(np.diff(track[:, 0]) >= 0.0999)


@pytest.mark.full
@pytest.mark.slow
def test_the_track_is_not_copied_for_each_scene_and_a_former_scene_stays_as_it_was() -> None:
    history = History(Backdrop("uav/1"), whole=False)
    former = history.at()
    for n in range(150_000):
        frame = mavlink.MAVLink_local_position_ned_message(n, 0.0, n / 5, -5.0, 0.0, 0.0, 0.0)
        history.take("mavlink/out", UAV.pack(frame), b"", n / 10, 100.0)
        if n == 60_000:
            former = history.at()
            assert np.shares_memory(former.track, history.at().track)
    assert len(former.track) == 60_001
    assert np.allclose(former.track[:, 0], np.arange(60_001) / 5)
    newest = history.at().track
    assert 50_000 <= len(newest) <= 100_000  # it is bounded
    assert np.allclose(newest[:, 0], np.arange(150_000 - len(newest), 150_000) / 5)


def test_changes_of_mode_arming_and_long_texts_are_told_once(history: History) -> None:
    armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    for mode, flags in (((4, 3), 0), ((4, 2), armed), ((4, 2), armed), ((6, 0), armed)):
        beat = mavlink.MAVLink_heartbeat_message(2, 12, flags, mode[0] << 16 | mode[1] << 24, 4, 3)
        history.take("mavlink/out", UAV.pack(beat), b"", 1.0, 100.0)
    chunks = [
        mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_WARNING, text.encode(), 1, n)
        for n, text in enumerate(("a" * 50, "b"))
    ]
    history.take("mavlink/out", UAV.pack(*chunks), b"", 1.0, 100.0)
    assert said(history) == [
        ("info", "uav", "mode HOLD"),
        ("info", "uav", "mode TAKEOFF"),
        ("info", "uav", "armed"),
        ("info", "uav", "mode OFFBOARD"),
        ("warning", "uav", "a" * 50 + "b"),
    ]


@pytest.mark.full
@pytest.mark.slow
def test_a_text_whose_end_never_comes_does_not_grow_without_end(
    history: History, kept_bytes: Callable[..., int]
) -> None:
    begun = UAV.pack(mavlink.MAVLink_statustext_message(4, b"a" * 50, 1, 1))

    def never_ends() -> None:
        for _ in range(40_000):
            history.take("mavlink/out", begun, b"", 1.0, 100.0)

    assert kept_bytes(never_ends) < 40_000 * 50


def test_parts_with_forged_names_are_not_followed_without_end(history: History) -> None:
    history.take("health/uav", health("uav", 1.0), b"", 1.0, 100.0)
    for number in range(1000):
        history.take(f"health/forged {number}", health(f"forged {number}", 1.0), b"", 1.0, 100.0)
        history.lives(f"other {number}", True, 100.0)
    history.take(f"health/{'x' * 100_000}", health("x" * 100_000, 1.0), b"", 1.0, 100.0)
    assert history.take("health/uav", health("uav", 2.0), b"", 1.0, 100.0)
    services = history.at().services
    assert len(services) == 64
    assert services[0].name == "uav"
    assert max(len(service.name) for service in services) < 300


def test_a_part_speaks_for_itself_alone(history: History) -> None:
    history.take("health/uav", health("uav", 1.0), b"", 1.0, 100.0)
    assert not history.take("health/agent", health("uav", 2.0), b"", 1.0, 100.0)
    assert [service.name for service in history.at().services] == ["uav"]


def test_readings_and_waypoints_are_shown(history: History) -> None:
    history.take(
        "reading", pack_reading(UAV, Reading(1000, (2.0, 3.0), 5.0, (1.5, -0.5), 0.25)), b"", 1.0, 100.0
    )
    history.take("waypoint", Codec(1, 191).pack(waypoint_message(1, 1000, (2.5, 4.0), 5.0)), b"", 1.1, 100.0)
    assert (history.at().wind, history.at().waypoint) == ((1.5, -0.5), (2.5, 4.0))


def test_a_record_from_before_waypoints_had_a_key_shows_where_each_led() -> None:
    history = history_of(read(GOLDEN))
    later = history.measurements.values[1:]
    assert len(later) > 10
    assert [history.at(measured.time_s - 0.01).waypoint for measured in later] == [
        measured.position for measured in later
    ]


def test_a_belief_gives_a_measurement_and_its_particles(history: History) -> None:
    history.take("belief", belief(3), pack_particles(PARTICLES), 3.0, 100.0)
    scene = history.at()
    (measured,) = scene.measurements
    assert (measured.step, measured.position, measured.gas, measured.spread_m, measured.estimate) == (
        3,
        (3.0, 1.0),
        0.5,
        0.36,
        (11.5, 20.0),
    )
    assert scene.scatter is not None
    assert scene.scatter.places.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert scene.scatter.weights.tolist() == [0.25, 0.75]
    assert (scene.assume, scene.stop, scene.threshold_m) == ("field", "spread:0.5", 0.5)


def test_a_coordinate_that_is_known_is_the_estimates_own_for_all_particles(history: History) -> None:
    rows = np.array([[5.0, 7.0, 1.0]], np.float32)  # q and y are unknown, x is known
    history.take(
        "belief",
        belief(0, unknowns=("q", "y"), means=(5.0, 7.0), stds=(1.0, 1.0)),
        pack_particles(rows),
        1.0,
        100.0,
    )
    scatter = history.at().scatter
    assert scatter is not None
    assert scatter.places.tolist() == [[11.5, 7.0]]


def test_a_repeated_belief_changes_nothing(history: History) -> None:
    assert history.take("belief", belief(3), b"", 3.0, 100.0)
    assert not history.take("belief", belief(3), b"", 3.0, 101.0)
    assert not history.take("belief", belief(2), b"", 3.1, 102.0)
    assert len(history.at().measurements) == 1


@pytest.mark.parametrize(
    ("estimate", "verdict", "error"),
    [((12.0, 19.2), "located", "0.80"), ((13.0, 21.0), "FALSE STOP", "1.41")],
    ids=["right", "wrong"],
)
def test_a_simulation_tells_whether_the_stop_is_right(
    history: History, estimate: tuple[float, float], verdict: str, error: str
) -> None:
    for _ in range(2):  # the stop is kept for late joiners, and may come again
        history.take("agdc/stop", stop(9, estimate), b"", 9.0, 100.0)
    ending = history.at().ending
    assert ending is not None
    assert (ending.verdict, ending.text.endswith(f"error {error} m")) == (verdict, True)
    assert [level for level, _, _ in said(history)] == ["stop"]


def test_where_the_truth_is_unknown_a_stop_is_only_a_claim() -> None:
    history = History(Backdrop("uav/1"))
    history.take("agdc/stop", stop(9, (12.0, 19.2)), b"", 9.0, 100.0)
    ending = history.at().ending
    assert ending is not None
    assert ending.verdict == "ceased"
    assert "error" not in ending.text


def test_a_spent_budget_ends_the_search(history: History) -> None:
    history.take("belief", belief(299), b"", 299.0, 100.0)
    assert history.at().ending is None
    history.take("belief", belief(300), b"", 300.0, 100.0)
    ending = history.at().ending
    assert ending is not None
    assert ending.verdict == "not ceased"


@pytest.mark.parametrize(
    ("key", "payload"),
    [("agdc/stop", stop(300, (12.0, 19.2))), ("belief", belief(300))],
    ids=["stop", "spent budget"],
)
def test_after_the_search_there_is_no_next_waypoint_whatever_others_ask_for(
    history: History, key: str, payload: bytes
) -> None:
    agent, pilot = Codec(1, 191), Codec(255, 190)
    history.take("waypoint", agent.pack(waypoint_message(1, 299, (2.5, 4.0), 5.0)), b"", 299.0, 100.0)
    history.take(key, payload, b"", 300.0, 101.0)
    assert history.waypoints.at() is history.at().waypoint is None
    assert history.at(299.5).waypoint == (2.5, 4.0)  # it was there before
    assert not history.take(
        "mavlink/in", pilot.pack(waypoint_message(1, 301, (7.0, 8.0), 5.0)), b"", 301.0, 102.0
    )
    assert history.waypoints.at() is history.at().waypoint is None


def test_no_part_of_a_record_is_stale_because_its_recorder_wrote_on_when_the_others_had_ended(
    history: History,
) -> None:
    for service in ("uav", "estimator", "recorder"):
        history.take(f"health/{service}", health(service, 1.0), b"", 1.0, 100.0)
    history.take("health/recorder", health("recorder", 10.0), b"", 2.0, 109.0)
    assert {it.name: it.verdict for it in history.at().services}["uav"] == "ok"
    assert {it.name: it.verdict for it in history.at(2.0).services}["estimator"] == "ok"
    history.take(
        "health/estimator", health("estimator", 10.0), b"", 2.0, 109.0
    )  # then it was there all the time
    assert {it.name: it.verdict for it in history.at().services} == {
        "uav": "stale",
        "estimator": "ok",
        "recorder": "ok",
    }


def test_services_are_judged_as_status_does(history: History) -> None:
    history.lives("agent", True, 100.0)
    history.take("health/uav", health("uav", 1.0), b"", 1.0, 100.0)
    history.take("health/estimator", health("estimator", 1.0, refused_lately=2), b"", 1.0, 104.0)
    told = {service.name: service.verdict for service in history.at(wall_s=104.9).services}
    assert told == {"uav": "ok", "estimator": "refusing", "agent": "starting"}
    assert {service.name: service.verdict for service in history.at(wall_s=105.0).services}["uav"] == "stale"
    history.lives("agent", False, 106.0)
    assert [service.name for service in history.at().services] == ["uav", "estimator", "agent"]
    assert history.at().services[2].verdict == "missing"


def test_warnings_restarts_and_departures_are_told_once(history: History) -> None:
    history.lives("estimator", True, 99.0)
    for wall_s, uptime_s in ((100.0, 1.0), (101.0, 2.0), (103.0, 0.5)):
        history.take(
            "health/estimator",
            health("estimator", uptime_s, warnings=("the readings do not fit",)),
            b"",
            1.0,
            wall_s,
        )
    history.lives("estimator", False, 104.0)
    assert said(history) == [
        ("info", "estimator", "joined"),
        ("warning", "estimator", "the readings do not fit"),
        ("warning", "estimator", "was restarted"),
        ("warning", "estimator", "is gone"),
    ]


def test_two_parts_of_one_name_are_no_restart(history: History) -> None:
    for second in range(3):
        for at_s, since_s in ((second, 40.0), (second + 0.5, 10.0)):
            history.take("health/recorder", health("recorder", at_s + since_s), b"", 1.0, 100.0 + at_s)
    assert said(history) == []


def test_a_warning_is_told_once_in_its_longer_form_and_again_only_when_it_comes_back(
    history: History,
) -> None:
    fit = "the readings do not fit the model (p = {} over the last 30)"
    logged = fit.format("1e-05") + ": is the sensor stuck, is the model right?"
    hums = "one value plus noise explains the readings as well as a plume does"
    for uptime_s, (warnings, error) in enumerate(
        [
            ((fit.format("1e-05"),), logged),
            ((fit.format("2e-07"),), logged),  # another figure is no other warning
            ((hums,), f"{hums}: does the sensor hum?"),
            ((), f"{hums}: does the sensor hum?"),
            ((hums,), f"{hums}: does the sensor hum?"),
        ]
    ):
        message = health("estimator", float(uptime_s), warnings=warnings, last_error=error)
        history.take("health/estimator", message, b"", float(uptime_s), 100.0 + uptime_s)
    assert [text for _, _, text in said(history)] == [logged, *[f"{hums}: does the sensor hum?"] * 2]


def test_what_the_vehicle_has_told_its_health_does_not_say_again(history: History) -> None:
    told, wide = "Search gives way: HOLD by 255/190 on the bus", "Search gives way: 40 m – too far"
    for text in (told, wide):
        frames = Words().statustext(mavlink.MAV_SEVERITY_WARNING, text)
        history.take("mavlink/out", UAV.pack(*frames), b"", 1.0, 100.0)
    for uptime_s, error in enumerate((told, wide, "nobody answers")):
        message = health("uav", float(uptime_s), last_error=error)
        history.take("health/uav", message, b"", 2.0 + uptime_s, 101.0 + uptime_s)
    assert [text for _, _, text in said(history)] == [told, wide.replace("–", "?"), "nobody answers"]


def test_a_vehicle_that_leaves_a_search_is_told_once(history: History) -> None:
    left = msgspec.json.encode(Departure(3, 4, "gone from the bus for 20 s"))
    assert history.take("departure", left, b"", 9.0, 100.0)
    assert not history.take("departure", left, b"", 9.5, 100.5)  # said again by another vehicle
    assert said(history) == [
        ("warning", "estimator", "uav/3 has left the search at step 4: gone from the bus for 20 s")
    ]


def test_a_vehicle_has_left_from_its_departure_on_and_no_other_has() -> None:
    left = msgspec.json.encode(Departure(3, 4, "gone from the bus for 20 s"))
    for number, has_left in ((3, True), (2, False)):
        history = History(Backdrop(f"uav/{number}"), number=number)
        history.take("departure", left, b"", 9.0, 100.0)
        assert not history.at(8.9).left
        assert history.at().left == has_left


def test_a_vehicle_that_has_left_reads_no_more_and_still_shows_the_belief_of_the_others() -> None:
    history = History(Backdrop("search/1/uav/2"), number=2)
    own, other = RoundReading(2, 2, 0, (7.0, 8.0), 5.0, 0.5), RoundReading(1, 1, 0, (1.0, 2.0), 5.0, 3.0)
    history.take("belief", belief(0, readings=[other, own]), b"", 0.0, 100.0)
    history.take("belief", belief(1, readings=[other], spread=0.25), b"", 1.0, 101.0)
    first, second = history.at().measurements
    assert (first.gas, first.position, first.spread_m) == (0.5, (7.0, 8.0), 0.36)
    assert math.isnan(second.gas)
    assert (second.position, second.spread_m) == ((7.0, 8.0), 0.25)


def test_a_scene_of_the_past_knows_nothing_newer(history: History) -> None:
    for step in range(5):
        history.take(
            "belief", belief(step), pack_particles(PARTICLES + np.float32(step)), float(step), 100.0 + step
        )
        frame = mavlink.MAVLink_local_position_ned_message(1000 * step, 0.0, float(step), -5.0, 0.0, 0.0, 0.0)
        history.take("mavlink/out", UAV.pack(frame), b"", float(step), 100.0 + step)
    history.take("agdc/stop", stop(4, (12.0, 20.0)), b"", 4.0, 105.0)
    then = history.at(2.5)
    assert (then.time_s, len(then.measurements), then.ending, len(then.happenings)) == (2.5, 3, None, 0)
    assert then.craft is not None
    assert then.craft.position == (2.0, 0.0)
    assert then.track.tolist() == [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]
    assert then.scatter is not None
    assert then.scatter.places[0].tolist() == [3.0, 4.0]
    assert history.at().ending is not None


def test_a_vehicle_that_is_started_again_begins_a_new_mission(history: History) -> None:
    def local(time_boot_ms: int) -> bytes:
        return UAV.pack(
            mavlink.MAVLink_local_position_ned_message(
                time_boot_ms, 0.0, time_boot_ms / 1000, -5.0, 0.0, 0.0, 0.0
            )
        )

    for step in (4, 5):
        history.take("mavlink/out", local(1000 * step), b"", float(step), 100.0 + step)
        history.take("belief", belief(step), pack_particles(PARTICLES), float(step), 100.0 + step)
    history.take("agdc/stop", stop(5, (12.0, 20.0)), b"", 5.0, 105.5)
    history.take("mavlink/out", local(500), b"", 0.5, 200.0)
    history.take("belief", belief(0), pack_particles(PARTICLES), 0.6, 201.0)
    scene = history.at()
    assert (scene.time_s, [it.step for it in scene.measurements], scene.ending) == (0.6, [0], None)
    assert scene.track.tolist() == [[0.5, 0.0]]
    assert said(history)[-1] == ("info", "uav", "a new mission begins")


def test_a_vehicle_whose_time_wraps_is_in_the_same_mission_and_one_that_is_started_again_then_is_not(
    history: History,
) -> None:
    for number, time_boot_ms in enumerate((2**32 - 500, 2**32 - 1, 20, 5000)):
        local = mavlink.MAVLink_local_position_ned_message(
            time_boot_ms, 0.0, float(number), -5.0, 0.0, 0.0, 0.0
        )
        history.take("mavlink/out", UAV.pack(local), b"", 4_294_967.0 + number, 100.0 + number)
    assert (history.missions, len(history.at().track)) == (1, 4)
    history.take(
        "mavlink/out", UAV.pack(mavlink.MAVLink_local_position_ned_message(0, *[0.0] * 6)), b"", 0.0, 200.0
    )
    assert history.missions == 2


def test_of_a_record_of_two_missions_the_last_one_is_shown_on_its_own_times(history: History) -> None:
    def local(time_s: float) -> bytes:
        return UAV.pack(
            mavlink.MAVLink_local_position_ned_message(round(1000 * time_s), 0.0, 0.0, -5.0, 0.0, 0.0, 0.0)
        )

    history.take("health/agent", health("agent", 1.0), b"", 1.0, 101.0)
    history.take("mavlink/out", local(50.0), b"", 50.0, 150.0)
    history.take("agdc/stop", stop(50, (12.0, 20.0)), b"", 50.0, 150.0)
    history.take("mavlink/out", local(0.5), b"", 0.5, 200.0)
    history.take("agdc/stop", stop(9, (12.0, 20.0)), b"", 9.0, 209.0)
    assert history.missions == 2
    assert history.time_s == 9.0
    assert [(it.time_s, it.level) for it in history.at().happenings] == [(0.5, "info"), (9.0, "stop")]
    early = history.at(4.0)
    assert [it.text for it in early.happenings] == ["a new mission begins"]
    assert [service.name for service in early.services] == ["agent"]  # it was there all the time
    assert (early.ending, history.at(9.0).ending is None) == (None, False)
    entry = Entry("reading", 0, 0.0, b"")
    assert (
        remark_on(Recording({}, [entry], True), history) == "holds 2 missions, of which the last one is shown"
    )
    assert remark_on(Recording({}, [entry], True), History(Backdrop("uav/1"))) == ""
    assert remark_on(
        Recording({"stopped": "No space left on device"}, [], False), History(Backdrop("uav/1"))
    ) == ("ends early: No space left on device, and holds no message")


def test_a_live_history_keeps_only_the_newest_particles_and_pose() -> None:
    history = History(Backdrop("uav/1"), whole=False)
    for step in range(100):
        history.take("belief", belief(step), pack_particles(PARTICLES), float(step), 100.0)
    assert history.at(50.0).scatter is None
    assert len(history.at().measurements) == 100


@pytest.mark.parametrize(
    "key", ["belief", "agdc/stop", "health/uav", "reading", "mavlink/out", "waypoint", "nothing/known"]
)
@pytest.mark.parametrize(
    "payload",
    [b"", b"{}", b"\xff" * 100, b"[" * 10_000, b'{"step": 1e999}'],
    ids=["empty", "object", "bytes", "deep", "huge"],
)
def test_what_strangers_send_changes_nothing(history: History, key: str, payload: bytes) -> None:
    assert not history.take(key, payload, b"", 1.0, 100.0)
    assert len(history.at().happenings) == 0


def test_bad_particles_are_not_shown(history: History) -> None:
    history.take("belief", belief(1), b"123", 1.0, 100.0)
    assert history.at().scatter is None
    assert len(history.at().measurements) == 1
