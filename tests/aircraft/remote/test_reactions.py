"""Protects the reactions to refusals and failsafes: each is told, none is waited out, and somebody is
always in charge of the vehicle.
"""

from typing import Any

import pytest

from aircraft.remote.commander import Commander
from aircraft.remote.vehicle import RemoteVehicle
from aircraft.search.search import LANDED, PAUSED, RETURNING, Search
from aircraft.state import VehicleFailed
from link.modes import Mode
from sitl.autopilot.config import VehicleConfig
from tests.aircraft.remote.cockpit import STEPS, Cockpit
from tests.autopilots.body import DT_S

KINDS = ("ardupilot", "px4")
both = pytest.mark.parametrize("kind", KINDS)
HOME_MODES = ("RTL", "LAND", "DESCEND")


def searching(kind: str, *faults: str, readings: int = 2, **settings: Any) -> Cockpit:
    """A search that has taken some readings."""
    cockpit = Cockpit(kind, *faults, **settings)
    cockpit.reads(readings)
    return cockpit


# ---- before it flies ----


@both
def test_a_refused_arming_is_told_with_its_reason_and_fails_the_mission_after_a_minute(kind: str) -> None:
    cockpit = Cockpit(kind, "arm")
    assert "Compass not healthy" in cockpit.fails()
    assert cockpit.vehicle.failure.startswith("Arming refused: ")
    assert 60.0 < cockpit.now_s < 90.0
    assert sum(said.endswith("; tried again") for said in cockpit.said) == 1, "told once"


@both
def test_arming_that_is_refused_for_a_while_is_tried_again(kind: str) -> None:
    cockpit = searching(kind, "arm:30")
    assert cockpit.heard("Compass not healthy")
    assert not cockpit.vehicle.failure


@pytest.mark.parametrize(
    ("kind", "reason"), [("ardupilot", "init failed"), ("px4", "Offboard is currently not available")]
)
def test_a_refused_mode_fails_the_mission_and_a_vehicle_in_the_air_comes_home(kind: str, reason: str) -> None:
    cockpit = Cockpit(kind, "mode")
    assert reason in cockpit.fails()
    assert cockpit.ap.landed
    assert not cockpit.readings


@both
def test_a_refused_take_off_fails_the_mission_and_the_motors_stop(kind: str) -> None:
    cockpit = Cockpit(kind, "takeoff")
    assert cockpit.fails(60.0).startswith("Take-off refused: ")
    assert not cockpit.ap.armed


@both
def test_a_vehicle_that_accepts_the_take_off_and_stays_fails_the_mission(kind: str) -> None:
    cockpit = Cockpit(kind, "stuck")
    assert "Take-off" in cockpit.fails(60.0)
    assert not cockpit.ap.armed


def test_px4_that_wants_a_ground_station_says_so() -> None:
    cockpit = Cockpit("px4", parameters={"NAV_DLL_ACT": 2})
    cockpit.run(20.0)
    assert cockpit.heard("NAV_DLL_ACT is above 0")
    assert not cockpit.ap.armed
    assert cockpit.heard("Waiting for the autopilot: a check before arming fails")


def test_a_vehicle_that_a_pilot_has_armed_is_left_to_him() -> None:
    cockpit = Cockpit("ardupilot", "pilot@1:STABILIZE", ready_s=10.0)
    cockpit.until(lambda: cockpit.ap.origin_set)
    cockpit.ap.armed = True
    cockpit.ap.armed_s = cockpit.ap.now_s
    cockpit.run(5.0)
    assert cockpit.heard("a pilot has armed it")
    assert cockpit.ap.mode == "STABILIZE"


# ---- in the air: the autopilot acts ----


@both
def test_a_failed_ekf_stops_the_readings_and_the_landing_is_told(kind: str) -> None:
    cockpit = searching(kind, "ekf@#3")
    count = len(cockpit.readings)
    cockpit.until(lambda: cockpit.search.state == RETURNING)
    assert cockpit.ap.mode in HOME_MODES
    cockpit.until(lambda: cockpit.search.state == LANDED)
    assert cockpit.heard("Position lost")
    assert "by its failsafe" in cockpit.vehicle.failure
    assert len(cockpit.readings) <= count + 1


@both
def test_a_position_without_gps_is_not_read_though_it_flows_on(kind: str) -> None:
    cockpit = searching(kind, "gps@#3")
    cockpit.until(lambda: cockpit.search.state == LANDED)
    lost_s = next(one.struck_s for one in cockpit.ap.faults.all) + 5.0
    assert all(at_s < lost_s + 0.5 for at_s, _ in cockpit.readings)


@both
def test_a_critical_battery_ends_the_mission_on_the_ground(kind: str) -> None:
    cockpit = searching(kind, "critical@#3")
    assert cockpit.fails()
    assert cockpit.ap.landed
    assert cockpit.search.state == LANDED


# ---- in the air: the search acts ----


@both
def test_a_low_battery_brings_it_home_even_if_the_autopilot_only_warns(kind: str) -> None:
    """10% with a failsafe that does nothing: PX4's default, and ArduCopter's with BATT_FS_LOW_ACT 0."""
    cockpit = searching(kind, parameters={"BATT_FS_LOW_ACT": 0, "COM_LOW_BAT_ACT": 0})
    cockpit.ap.battery_percent = 10
    assert cockpit.fails() == "Battery low: 10%"
    assert cockpit.heard("Returning home")
    assert cockpit.ap.landed


@pytest.mark.parametrize(("kind", "holds"), [("ardupilot", {"FENCE_ACTION": 4}), ("px4", {"GF_ACTION": 2})])
def test_a_breached_fence_that_only_stops_the_vehicle_brings_it_home(
    kind: str, holds: dict[str, float]
) -> None:
    """BRAKE or HOLD by a failsafe would hover for ever: no pilot has chosen it."""
    cockpit = searching(kind, "fence@#3", parameters=holds)
    reason = cockpit.fails()
    assert "by its failsafe" in reason
    assert cockpit.heard("Returning home")
    assert cockpit.ap.landed


def test_a_breached_fence_that_is_only_reported_brings_it_home() -> None:
    cockpit = searching("ardupilot", "fence@#3", parameters={"FENCE_ACTION": 0})
    assert cockpit.fails().startswith("Geofence breached: ")


def test_a_breached_fence_that_returns_ends_the_mission() -> None:
    cockpit = searching("ardupilot", "fence@#3", parameters={"FENCE_ACTION": 1})
    assert "changed to RTL by its failsafe: Circle breached" in cockpit.fails()


def test_setpoints_that_are_lost_at_a_high_speed_up_are_sent_again_and_do_not_end_the_search() -> None:
    cockpit = Cockpit("ardupilot", speedup=20.0)
    cockpit.reads(2)
    cockpit.radio.lost["SET_POSITION_TARGET_LOCAL_NED"] = 3
    cockpit.reads(4)
    assert not cockpit.vehicle.failure


def test_a_setpoint_that_is_lost_while_the_program_is_held_up_is_sent_again_and_not_taken_for_ignored() -> (
    None
):
    cockpit = searching("ardupilot")
    before = len(cockpit.readings)
    cockpit.radio.lost["SET_POSITION_TARGET_LOCAL_NED"] = 1
    cockpit.until(lambda: not cockpit.radio.lost["SET_POSITION_TARGET_LOCAL_NED"])
    cockpit.run(0.3)
    for _ in range(100):  # 8 s in which the program does nothing
        cockpit.radio.advance()
        cockpit.now_s += STEPS * DT_S
    cockpit.reads(before + 2)
    assert not cockpit.vehicle.failure


@pytest.mark.parametrize(("speedup", "gives_up_s"), [(1.0, 60.0), (10.0, 200.0)])
def test_a_simulator_that_runs_fast_has_real_time_to_come_back(speedup: float, gives_up_s: float) -> None:
    cockpit = Cockpit("ardupilot", "silence@#3", speedup=speedup)
    with pytest.raises(VehicleFailed, match="link lost for") as failure:
        cockpit.run(500.0)
    assert abs(float(str(failure.value).split()[3]) - gives_up_s) < 3.0


def test_targets_that_arducopter_ignores_silently_are_seen_in_what_it_reads_back() -> None:
    cockpit = searching("ardupilot", "ignore@#3")
    ignored_s = cockpit.now_s
    assert "is ignored by the autopilot" in cockpit.fails()
    assert cockpit.heard("Returning home")
    assert cockpit.now_s - ignored_s < 60.0, "6 s, and the way home"


def test_a_waypoint_outside_the_autopilots_own_fence_ends_the_mission() -> None:
    cockpit = searching("ardupilot", parameters={"FENCE_ENABLE": 1, "FENCE_RADIUS": 8.0}, readings=4)
    assert "outside its geofence?" in cockpit.fails()
    assert max(place[1] for _, place in cockpit.readings) < 8.0


def test_targets_that_px4_ignores_are_none_so_that_its_failsafe_acts() -> None:
    cockpit = searching("px4", "ignore@#3")
    assert "by its failsafe" in cockpit.fails()
    assert cockpit.ap.landed


@both
def test_a_waypoint_that_is_not_reached_in_time_ends_the_mission(kind: str) -> None:
    """A storm that it cannot fly against: it hovers 2 m away. 1 m at 1 m/s, and 30 s."""
    cockpit = searching(kind)
    fly = cockpit.ap.fly
    cockpit.ap.fly = lambda place, *rest, **more: fly((place[0] - 2.0, *place[1:]), *rest, **more)
    began_s = cockpit.now_s
    cockpit.until(lambda: cockpit.heard("not reached in time: 2."))
    assert 30.0 < cockpit.now_s - began_s < 40.0
    cockpit.ap.fly = fly
    assert cockpit.fails()


@both
def test_a_link_that_is_lost_on_the_way_takes_no_time_from_it(kind: str) -> None:
    cockpit = searching(kind, "mute@#3:40")
    cockpit.reads(4)
    assert not cockpit.vehicle.failure


@both
def test_an_agent_that_does_not_answer_for_30_s_brings_it_home(kind: str) -> None:
    cockpit = Cockpit(kind, config=VehicleConfig(silence_s=30.04))
    cockpit.answers = lambda _: None
    assert cockpit.fails() == "No waypoint for 30 s"
    assert cockpit.ap.landed


@both
def test_a_position_that_stays_lost_is_landed_if_the_autopilot_only_hovers(kind: str) -> None:
    cockpit = searching(kind)
    cockpit.vehicle.flight.known.take = forgetful(cockpit.vehicle.flight.known.take)
    assert cockpit.fails().startswith("Position lost for 1")
    assert cockpit.ap.landed


def forgetful(take: Any) -> Any:
    """Telemetry whose flags say that the position is bad, of a vehicle that does nothing about it."""

    def taken(message: Any, now_s: float) -> None:
        if message.get_type() in ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS"):
            message.flags &= ~16
        take(message, now_s)

    return taken


# ---- the link ----


@both
def test_a_short_silence_is_told_and_the_search_goes_on(kind: str) -> None:
    """10 s: PX4 returns meanwhile, and takes OFFBOARD again when the setpoints are back, as its failsafe
    says.
    """
    cockpit = searching(kind, "silence@#3:6")
    cockpit.until(lambda: cockpit.heard("Link lost"))
    cockpit.until(lambda: cockpit.heard("Link is back"))
    cockpit.reads(4)
    assert not cockpit.vehicle.failure


@both
def test_a_link_that_stays_lost_ends_the_mission_after_a_minute(kind: str) -> None:
    cockpit = searching(kind, "silence@#3")
    with pytest.raises(
        VehicleFailed, match=r"link lost for 6[0-9] s: the autopilot's own failsafe is in charge"
    ):
        cockpit.run(100.0)


def test_px4_that_no_longer_hears_us_returns_by_itself() -> None:
    cockpit = searching("px4", "deaf@#3")
    cockpit.until(lambda: cockpit.search.state == LANDED)
    assert "by its failsafe" in cockpit.vehicle.failure


def test_arducopter_whose_failsafe_watches_the_companion_returns_when_it_is_killed_and_not_before() -> None:
    """FS_GCS_TIMEOUT is 5 s."""
    cockpit = searching("ardupilot", readings=4, parameters={"FS_GCS_ENABLE": 1, "SYSID_MYGCS": 1})
    assert not cockpit.heard("GCS Failsafe")
    assert cockpit.heard("if this computer fails: ok, FS_GCS acts after 5 s")
    for _ in range(100):  # 8 s in which the program does nothing
        cockpit.radio.advance()
    assert cockpit.ap.mode == "RTL"


@both
def test_an_autopilot_that_starts_again_before_the_flight_is_asked_for_telemetry_again(kind: str) -> None:
    cockpit = searching(kind, "reboot@5")
    assert not cockpit.vehicle.failure


@both
def test_an_autopilot_that_starts_again_in_flight_ends_the_mission(kind: str) -> None:
    cockpit = searching(kind, "reboot@#3")
    assert cockpit.fails().endswith("has started again in flight")


# ---- the end ----


@both
def test_a_program_that_ends_sends_the_vehicle_home(kind: str) -> None:
    cockpit = searching(kind)
    assert cockpit.vehicle.leave() == "The vehicle is told to return home"
    for _ in range(10):  # 0.8 s
        cockpit.radio.advance()
        cockpit.now_s += 0.08
        cockpit.vehicle.leave()
        cockpit.vehicle.catch_up(cockpit.now_s)
    assert cockpit.vehicle.left
    assert cockpit.ap.mode == "RTL"


@both
def test_a_program_that_ends_while_it_holds_sends_it_home_too(kind: str) -> None:
    cockpit = searching(kind, after_stop="hold")
    cockpit.finds()
    cockpit.run(5.0)
    assert cockpit.vehicle.leave() == "The vehicle is told to return home"


@both
def test_a_program_that_is_interrupted_within_a_procedure_still_sends_it_home(kind: str) -> None:
    """Ctrl-C ends a procedure where it stands, as a KeyboardInterrupt in it does."""
    cockpit = searching(kind)
    cockpit.vehicle.set_mode(cockpit.now_s, Mode.RETURN)
    procedure = cockpit.vehicle.flight.procedure
    assert procedure is not None
    procedure.close()
    for _ in range(10):
        cockpit.vehicle.leave()
        cockpit.radio.advance()
        cockpit.now_s += 0.08
        cockpit.vehicle.catch_up(cockpit.now_s)
    assert cockpit.ap.mode == "RTL"


@both
def test_a_program_that_ends_leaves_the_vehicle_to_its_pilot(kind: str) -> None:
    cockpit = searching(kind, "pilot@#3", radio=True)
    cockpit.until(lambda: cockpit.search.state == PAUSED)
    assert cockpit.vehicle.leave().startswith("The vehicle is left in ")
    cockpit.run(3.0)
    assert cockpit.ap.mode in ("LOITER", "POSCTL")


@both
def test_a_flight_that_was_under_way_before_the_program_is_someone_elses(kind: str) -> None:
    cockpit = searching(kind)
    cockpit.answer_at = None
    cockpit.vehicle = RemoteVehicle(VehicleConfig(), Commander(cockpit.radio))
    cockpit.search = Search(cockpit.vehicle, (1.0, 1.0), "return", lambda _, text: cockpit.said.append(text))
    cockpit.ap.parameters["BATT_FS_LOW_ACT"] = cockpit.ap.parameters["COM_LOW_BAT_ACT"] = 0
    cockpit.ap.parameters["COM_OBL_RC_ACT"] = 5
    cockpit.ap.battery_percent = 10
    cockpit.run(10.0)
    assert cockpit.heard("Search waits: a pilot flies the vehicle")
    assert cockpit.ap.mode not in HOME_MODES
    assert cockpit.vehicle.leave().startswith("The vehicle is left in ")
    assert cockpit.vehicle.left


def another_program(cockpit: Cockpit) -> None:
    """A second search, on the link of the first."""
    cockpit.answer_at = None
    cockpit.readings.clear()
    cockpit.vehicle = RemoteVehicle(VehicleConfig(), Commander(cockpit.radio))
    cockpit.search = Search(cockpit.vehicle, (1.0, 1.0), "return", lambda _, text: cockpit.said.append(text))


@pytest.mark.parametrize("mode", ["RTL", "LAND"])
@both
def test_a_vehicle_that_stands_disarmed_in_what_a_flight_left_behind_is_free(kind: str, mode: str) -> None:
    """The next program is there before the vehicle has begun to come home, and sees its mode change."""
    cockpit = searching(kind)
    another_program(cockpit)
    cockpit.until(lambda: cockpit.heard("Search waits: a pilot flies the vehicle"))
    cockpit.ap.change(mode)
    cockpit.until(lambda: not cockpit.ap.armed)
    assert kind == "px4" or cockpit.ap.mode == mode
    cockpit.reads(1)


@pytest.mark.parametrize(("kind", "mode"), [("ardupilot", "RTL"), ("px4", "POSCTL")])
def test_a_pilot_who_has_just_chosen_a_mode_on_the_ground_is_waited_for(kind: str, mode: str) -> None:
    cockpit = Cockpit(kind, radio=True)
    cockpit.run(4.0)
    cockpit.ap.change(mode)
    cockpit.run(30.0)
    assert cockpit.heard("a pilot")
    assert not cockpit.ap.armed
    cockpit.ap.change("GUIDED" if kind == "ardupilot" else "HOLD")
    cockpit.reads(1)


def test_a_pilot_who_lands_by_hand_keeps_the_vehicle() -> None:
    cockpit = searching("ardupilot", radio=True)
    another_program(cockpit)
    cockpit.run(2.0)
    cockpit.ap.change("LAND")
    cockpit.run(2.0)
    cockpit.ap.change("LOITER")
    cockpit.until(lambda: cockpit.search.waits_for)
    cockpit.ap.disarm()
    cockpit.run(30.0)
    assert not cockpit.ap.armed
    assert "a pilot" in cockpit.search.waits_for


def test_a_program_that_ends_on_the_ground_stops_the_motors() -> None:
    cockpit = Cockpit("ardupilot", "stuck")
    cockpit.until(lambda: cockpit.ap.armed)
    cockpit.run(0.5)
    assert cockpit.vehicle.leave() == ""
    cockpit.radio.advance()
    assert not cockpit.ap.armed


def test_the_mode_that_is_asked_for_is_told_at_once() -> None:
    cockpit = searching("ardupilot")
    cockpit.vehicle.set_mode(cockpit.now_s, Mode.RETURN)
    assert cockpit.mode is Mode.RETURN
