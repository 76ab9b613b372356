"""Protects what people see of a real autopilot: its own frames, from the place of the search area to what
it does not know.
"""

import math

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link.bus.mavlink import Codec
from link.bus.messages import Health
from scene.follow.history import History
from scene.scene import Backdrop, Condition, Craft
from tests.autopilots.settings import Settings
from tests.autopilots.telemetry import degrees_e7
from tests.autopilots.wire import Wire

COPTER, PX4 = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mavlink.MAV_AUTOPILOT_PX4
STANDBY, ACTIVE = mavlink.MAV_STATE_STANDBY, mavlink.MAV_STATE_ACTIVE
ON_GROUND, IN_AIR = mavlink.MAV_LANDED_STATE_ON_GROUND, mavlink.MAV_LANDED_STATE_IN_AIR
SYSTEM = 32
ALL_WELL = mavlink.MAV_SYS_STATUS_SENSOR_GPS | mavlink.MAV_SYS_STATUS_AHRS


def beat(custom_mode: int, autopilot: int = COPTER, status: int = ACTIVE, armed: bool = True) -> object:
    return mavlink.MAVLink_heartbeat_message(2, autopilot, 128 * armed + 1, custom_mode, status, 3)


def origin() -> object:
    return mavlink.MAVLink_gps_global_origin_message(*degrees_e7(0.0, 0.0), 488_000, 0)


def home(north: float, east: float, above_m: float = 0.0) -> object:
    """HOME_POSITION so far from the origin; like older ArduPilots it says nothing of the local frame."""
    return mavlink.MAVLink_home_position_message(
        *degrees_e7(north, east), round(488_000 + 1000 * above_m), *[0.0] * 3, [1, 0, 0, 0], *[0.0] * 3
    )


def local(north: float, east: float, down: float, at_ms: int = 1000) -> object:
    return mavlink.MAVLink_local_position_ned_message(at_ms, north, east, down, 0.0, 0.0, 0.0)


def landed(state: int) -> object:
    return mavlink.MAVLink_extended_sys_state_message(0, state)


def status(percent: int, millivolts: int, healthy: int = ALL_WELL, lost: int = 0) -> object:
    return mavlink.MAVLink_sys_status_message(
        ALL_WELL, ALL_WELL, healthy, 0, millivolts, -1, percent, lost, 0, 0, 0, 0, 0
    )


def gps(fix: int, satellites: int) -> object:
    return mavlink.MAVLink_gps_raw_int_message(0, fix, 0, 0, 0, 0, 0, 0, 0, satellites)


def ekf(flags: int) -> object:
    return mavlink.MAVLink_ekf_status_report_message(flags, 0.0, 0.0, 0.0, 0.0, 0.0)


class Heard:
    """What is seen of system 32, whose frames come one after the other."""

    def __init__(self) -> None:
        self.history = History(Backdrop("uav/1"))
        self.codec, self.search = Codec(SYSTEM, 1), Codec(SYSTEM, 191)
        self.now_s = 0.0

    def __call__(self, *messages: object, codec: Codec | None = None) -> "Heard":
        self.now_s += 1.0
        self.history.take("mavlink/out", (codec or self.codec).pack(*messages), b"", self.now_s, self.now_s)
        return self

    @property
    def craft(self) -> Craft:
        craft = self.history.craft
        assert craft is not None
        return craft

    @property
    def happened(self) -> list[tuple[str, str]]:
        return [(it.who, it.text) for it in self.history.at().happenings]


@pytest.fixture
def heard() -> Heard:
    return Heard()


# ---- where it is ----


@pytest.mark.parametrize("autopilot", [COPTER, PX4])
def test_a_place_is_told_from_home_where_the_autopilot_tells_it_from_its_own_origin(
    heard: Heard, autopilot: int
) -> None:
    heard(beat(4, autopilot), origin(), home(12.0, -5.0, above_m=2.0), local(20.0, 3.0, -9.0))
    assert heard.craft.position == pytest.approx(
        (8.0, 8.0), abs=0.03
    )  # the double's degrees are those of a sphere a little larger
    assert heard.craft.altitude_m == pytest.approx(7.0)
    assert heard.history.at().track.tolist() == [pytest.approx((8.0, 8.0), abs=0.03)]


def test_a_copter_is_nowhere_before_it_has_said_where_its_origin_and_its_home_are(heard: Heard) -> None:
    heard(beat(4), local(20.0, 3.0, -9.0))
    heard(origin(), local(20.0, 3.0, -9.0, 1100))
    assert (math.isnan(heard.craft.position[0]), heard.craft.mode, len(heard.history.at().track)) == (
        True,
        "GUIDED",
        0,
    )
    heard(home(20.0, 3.0), local(20.0, 3.0, -5.0, 1200))
    assert heard.craft.position == pytest.approx((0.0, 0.0), abs=0.02)


def test_arming_may_set_home_anew_but_in_the_air_it_is_no_longer_the_areas_corner(heard: Heard) -> None:
    heard(
        beat(0, status=STANDBY, armed=False),
        landed(ON_GROUND),
        origin(),
        home(10.0, 10.0),
        local(10.0, 10.0, 0.0),
    )
    heard(beat(4), home(10.0, 12.0), local(10.0, 12.0, 0.0, 1100))  # armed, and still on the ground
    assert heard.craft.position == pytest.approx((0.0, 0.0), abs=0.02)
    assert len(heard.history.at().track) == 1  # what was told from another corner is gone
    heard(landed(IN_AIR), local(10.0, 20.0, -5.0, 1200))
    heard(home(100.0, 100.0), local(10.0, 20.0, -5.0, 1300))
    assert heard.craft.position == pytest.approx((8.0, 0.0), abs=0.03)
    heard(landed(ON_GROUND), home(100.0, 100.0), local(10.0, 12.0, 0.0, 1400))  # it goes on saying so
    assert heard.craft.position == pytest.approx((0.0, 0.0), abs=0.02)


def test_a_copter_that_does_not_tell_whether_it_has_landed_flies_by_its_heartbeat(heard: Heard) -> None:
    heard(beat(4, status=ACTIVE), origin(), home(0.0, 0.0), local(3.0, 4.0, -5.0))
    heard(home(20.0, 0.0), local(3.0, 4.0, -5.0, 1100))
    assert heard.craft.position == pytest.approx((4.0, 3.0), abs=0.02)
    heard(beat(4, status=STANDBY, armed=False), home(21.0, 0.0), local(21.0, 0.0, 0.0, 1200))
    assert heard.craft.position == pytest.approx((0.0, 0.0), abs=0.03)


def test_an_autopilot_that_starts_again_has_to_say_anew_where_it_is(heard: Heard) -> None:
    heard(beat(4), origin(), home(5.0, 5.0), local(5.0, 5.0, 0.0, 60_000))
    heard(local(5.0, 5.0, 0.0, 500))
    assert math.isnan(heard.craft.position[0])


def test_the_doubles_own_frames_are_read(heard: Heard) -> None:
    wire = Wire("ardupilot", Settings())
    companion = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    for number in (1, 24, 30, 32, 33, 49, 168, 193, 242, 245):
        ask = mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, number, 1e5, 0, 0, 0, 0, 0
        )
        wire.hear(bytes(ask.pack(companion)))
    for frame in wire.advance(60 * 60):
        heard.history.take("mavlink/out", frame, b"", 0.0, 0.0)
    assert heard.craft.position == pytest.approx((0.0, 0.0), abs=0.3)
    assert heard.craft.altitude_m == pytest.approx(0.0, abs=0.3)
    assert (heard.craft.mode, heard.craft.armed) == ("STABILIZE", False)
    condition = heard.craft.condition
    assert (condition.gps, condition.placed, condition.health) == ("RTK fixed, 10 satellites", True, "ok")


# ---- what it says of itself ----


@pytest.mark.parametrize(
    ("autopilot", "custom_mode", "name"),
    [
        (COPTER, 4, "GUIDED"),
        (COPTER, 17, "BRAKE"),
        (COPTER, 6, "RTL"),
        (COPTER, 9, "LAND"),
        (COPTER, 199, "mode 199"),
        (PX4, 6 << 16, "OFFBOARD"),
        (PX4, 4 << 16 | 3 << 24, "HOLD"),
        (PX4, 4 << 16 | 77 << 24, "mode 4.77"),
        (0, 5, "mode 5"),
    ],
)
def test_a_mode_has_its_firmwares_name_and_an_unknown_one_its_number(
    heard: Heard, autopilot: int, custom_mode: int, name: str
) -> None:
    assert heard(beat(custom_mode, autopilot)).craft.mode == name
    assert heard.happened == [("uav", f"mode {name}"), ("uav", "armed")]


def test_what_is_not_said_is_unknown(heard: Heard) -> None:
    assert heard(beat(4)).craft.condition == Condition()
    assert heard.craft.condition.health == ""
    heard(status(-1, 0xFFFF), gps(3, 255))
    assert (heard.craft.condition.battery, heard.craft.condition.volts, heard.craft.condition.gps) == (
        None,
        None,
        "3-D fix",
    )
    assert heard(status(-1, 0)).craft.condition.volts is None  # ArduPilot without a battery monitor
    assert heard.history.at().wind is None


def test_a_battery_and_a_gps_are_shown_as_they_are_and_what_is_lost_is_lost(heard: Heard) -> None:
    heard(beat(4), status(62, 15_400), gps(6, 10), ekf(831))
    condition = heard.craft.condition
    assert (condition.battery, condition.volts, condition.gps, condition.health) == (
        0.62,
        15.4,
        "RTK fixed, 10 satellites",
        "ok",
    )
    heard(status(-1, 15_300, healthy=mavlink.MAV_SYS_STATUS_AHRS), gps(1, 0), ekf(831 & ~16))
    condition = heard.craft.condition
    assert (condition.battery, condition.volts, condition.gps) == (None, 15.3, "no fix, 0 satellites")
    assert condition.health == "not healthy: gps, position"
    assert heard(gps(0, 255)).craft.condition.gps == "no GPS"
    assert heard(status(50, 15_000, lost=350)).craft.condition.lost == 0.035  # in hundredths of a percent


def test_the_radio_of_the_link_tells_its_strength_and_is_not_the_vehicle(heard: Heard) -> None:
    sik = Codec(51, 68)
    heard(beat(4), status(62, 15_400))
    heard(mavlink.MAVLink_radio_status_message(180, 170, 90, 40, 38, 0, 0), codec=sik)
    assert heard.craft.condition.radio == (180.0, 170.0)
    assert heard.craft.condition.battery == 0.62
    assert heard.history.at(wall_s=heard.now_s).silent_s == 1.0  # the vehicle has said nothing since
    heard(mavlink.MAVLink_radio_status_message(180, 255, 90, 40, 38, 0, 0), codec=sik)
    here, there = heard.craft.condition.radio
    assert here == 180.0
    assert math.isnan(there)
    heard(mavlink.MAVLink_radio_status_message(255, 255, 90, 40, 38, 0, 0), codec=sik)
    assert heard.craft.condition.radio is None


def test_a_position_lost_is_told_also_by_a_px4_which_sends_another_message(heard: Heard) -> None:
    estimates = mavlink.MAVLink_estimator_status_message(0, 1, *[0.0] * 8)
    assert heard(beat(6 << 16, PX4), estimates).craft.condition.health == "not healthy: position"


def test_the_wind_is_the_autopilots_own_and_one_of_zero_is_none(heard: Heard) -> None:
    heard(beat(4), mavlink.MAVLink_wind_message(270.0, 3.0, 0.0))  # from the west
    assert heard.history.at().wind == pytest.approx((-3.0, 0.0), abs=1e-6)
    assert heard(mavlink.MAVLink_wind_message(0.0, 0.0, 0.0)).history.at().wind is None
    px4 = Heard()(
        beat(6 << 16, PX4), mavlink.MAVLink_wind_cov_message(0, 2.0, 0.0, *[math.nan] * 6)
    )  # the air goes north
    assert px4.history.at().wind == pytest.approx((0.0, -2.0), abs=1e-6)
    assert px4(mavlink.MAVLink_wind_cov_message(0, *[math.nan] * 8)).history.at().wind is None


def test_without_a_position_there_is_no_fix(heard: Heard) -> None:
    assert heard(mavlink.MAVLink_global_position_int_message(0, 0, 0, 0, 0, 0, 0, 0, 65535)).craft.fix is None


# ---- the search that flies it ----


def test_the_search_speaks_beside_the_autopilot_and_is_told_apart(heard: Heard) -> None:
    heard(beat(4), mavlink.MAVLink_statustext_message(4, b"EKF variance"))
    heard(
        mavlink.MAVLink_heartbeat_message(18, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3),
        mavlink.MAVLink_statustext_message(4, b"Search gives way: BRAKE"),
        codec=heard.search,
    )
    assert heard.craft.mode == "GUIDED"  # the search has none
    assert heard.happened[-2:] == [("uav", "EKF variance"), ("search", "Search gives way: BRAKE")]


def test_in_a_search_of_several_it_is_as_far_from_home_as_from_where_it_returns_to(heard: Heard) -> None:
    heard(beat(4), origin(), home(31.0, 30.0), local(28.0, 26.0, -5.0))
    heard(origin(), codec=heard.search)  # the area's, of component 191
    heard(local(28.0, 26.0, -5.0, 1100))
    assert heard.craft.position == pytest.approx((26.0, 28.0), abs=0.1)
    assert heard.craft.home_m == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize(
    ("key", "away_m"), [("uav/2/mavlink/out", 5.0), ("mavlink/out", math.hypot(30.0, 24.0))]
)
def test_a_simulated_one_of_several_is_as_far_from_home_as_from_where_it_took_off(
    key: str, away_m: float
) -> None:
    """Its HOME_POSITION is the area's origin, as for all; alone it takes off there."""
    history = History(Backdrop("uav/2"), number=2)
    took_off = beat(6 << 16, PX4), home(0.0, 0.0), landed(1), local(26.0, 27.0, 0.0)
    history.take(key, Codec(2, 1).pack(*took_off, landed(2), local(30.0, 24.0, -5.0, 1100)), b"", 1.0, 1.0)
    assert history.craft
    assert history.craft.home_m == pytest.approx(away_m)
    history.take(key, Codec(2, 1).pack(local(26.0, 27.0, 0.0, 1200), landed(1)), b"", 2.0, 2.0)
    assert history.craft.home_m == pytest.approx(0.0 if away_m == 5.0 else math.hypot(26.0, 27.0))


def test_where_a_simulated_one_of_several_took_off_is_not_known_if_it_was_first_heard_in_flight() -> None:
    history = History(Backdrop("uav/2"), number=2)

    def heard_at(*said: object) -> float:
        history.take("uav/2/mavlink/out", Codec(2, 1).pack(*said), b"", 1.0, 1.0)
        assert history.craft
        return history.craft.home_m

    in_air, up, down = landed(2), landed(3), landed(1)  # IN_AIR, TAKEOFF, ON_GROUND
    assert math.isnan(heard_at(beat(6 << 16, PX4), home(0.0, 0.0), in_air, local(30.0, 24.0, -5.0)))
    assert heard_at(down, local(26.0, 27.0, 0.0, 1100), in_air, local(30.0, 24.0, -5.0, 1200)) == 5.0
    history = History(Backdrop("uav/2"), number=2)
    climbs = beat(6 << 16, PX4), home(0.0, 0.0), up, local(26.0, 27.0, -3.0)
    assert heard_at(*climbs, in_air, local(30.0, 24.0, -5.0, 1100)) == 5.0


def test_a_vehicle_that_a_search_flies_is_a_real_one(heard: Heard) -> None:
    assert not heard(beat(6 << 16, PX4)).history.is_real
    assert heard(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), codec=heard.search).history.is_real
    assert Heard()(beat(4)).history.is_real  # the simulated vehicle is like a PX4


def test_its_system_is_told_by_the_uavs_health_and_none_before_it_is_known(heard: Heard) -> None:
    health = Health("uav", "standby", step=-1, compute_s=0.0, uptime_s=1.0, refused={}, system=0)
    heard.history.take("health/uav", msgspec.json.encode(health), b"", 0.0, 0.0)
    heard(beat(4))
    assert heard.history.own.system == SYSTEM


def test_a_time_line_begins_where_the_autopilots_clock_was(heard: Heard) -> None:
    heard.history.lives("agent", True, 0.0)
    heard.now_s = 3600.0
    assert heard(beat(4), origin(), home(0, 0), local(1.0, 1.0, 0.0, 3_601_000)).history.begin_s == 3601.0
    simulated = Heard()
    simulated.now_s = -0.9  # a tenth of a second after its start
    assert simulated(beat(6 << 16, PX4), local(1.0, 1.0, 0.0, 100)).history.begin_s == 0.0
