"""Protects the parameters: what stations read and set, how values lie in their bytes, and that what is set
acts.
"""

import binascii
import math
import struct
from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import common as mavlink

from link.modes import Mode
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.protocol import MavlinkProtocol
from sitl.autopilot.vehicle import Vehicle
from tests.ground.tlog.flights import hovering, offboard, on_the_ground

STATION = (255, 190)
REAL32, INT32, UINT32 = 9, 6, 5  # MAV_PARAM_TYPE


class Station:
    """A ground station that speaks to one vehicle; every message goes through its bytes."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.protocol = MavlinkProtocol(vehicle)
        self.vehicle = vehicle

    def ask(self, message):
        packed = message.pack(mavlink.MAVLink(None, *STATION))
        answers = self.protocol.receive(mavlink.MAVLink(None).decode(bytearray(packed)), self.vehicle.now_s)
        return [mavlink.MAVLink(None).decode(bytearray(m.pack(mavlink.MAVLink(None, 1, 1)))) for m in answers]

    def list(self):
        return self.ask(mavlink.MAVLink_param_request_list_message(1, 1))

    def read(self, name=b"", index=-1):
        return self.ask(mavlink.MAVLink_param_request_read_message(1, 1, name, index))

    def set(self, name, value, kind=REAL32):
        return self.ask(mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, kind))

    def value(self, name):
        (told,) = self.read(name.encode())
        return told.param_value


def int_in_float(number):
    return struct.unpack("<f", struct.pack("<i", number))[0]


def float_in_int(value):
    return struct.unpack("<i", struct.pack("<f", value))[0]


def text(answers):
    return "".join(m.text for m in answers if m.get_type() == "STATUSTEXT")


@pytest.fixture
def station():
    return Station(on_the_ground())


def test_a_station_that_asks_for_all_gets_each_once_with_its_index_and_the_count(station):
    first, *values = station.list()
    assert (first.param_id, first.param_type, first.param_index) == ("_HASH_CHECK", UINT32, 0xFFFF)
    assert [told.param_index for told in values] == list(range(len(values)))
    assert {told.param_count for told in (first, *values)} == {len(values)}
    names = [told.param_id for told in values]
    assert names == sorted(set(names))
    assert {
        "MIS_TAKEOFF_ALT",
        "RTL_RETURN_ALT",
        "MPC_XY_CRUISE",
        "COM_OF_LOSS_T",
        "MAV_SYS_ID",
        "SYS_AUTOSTART",
        "COM_RC_IN_MODE",
    } <= {*names}


def test_one_is_read_by_its_name_and_by_its_index(station):
    (by_name,) = station.read(b"MPC_Z_VEL_MAX_DN")
    (by_index,) = station.read(index=by_name.param_index)
    assert (by_name.param_value, by_name.param_type) == (1.5, REAL32)  # PX4's default
    assert by_index.to_dict() == by_name.to_dict()


def test_an_integer_lies_bytewise_in_the_float():
    (told,) = Station(Vehicle(VehicleConfig(sysid=1, home_alt_m=0.0))).read(b"SYS_AUTOSTART")
    assert (told.param_type, float_in_int(told.param_value)) == (INT32, 4001)


def test_the_hash_is_px4s_checksum_of_what_was_listed(station):
    """The vehicle's CRC begins with 0 and has no inversion: that of `binascii` with both undone, over
    names and bytes of values.
    """
    first, *values = station.list()
    crc = 0
    for told in values:
        for part in (told.param_id.encode(), struct.pack("<f", told.param_value)):
            crc = binascii.crc32(part, crc ^ 0xFFFFFFFF) ^ 0xFFFFFFFF
    assert struct.pack("<f", first.param_value) == struct.pack("<I", crc)
    (again,) = station.read(b"_HASH_CHECK")
    assert again.param_value == first.param_value
    station.set("MPC_XY_CRUISE", 4.0)
    assert station.read(b"_HASH_CHECK")[0].param_value != first.param_value
    assert (
        station.set("_HASH_CHECK", first.param_value, UINT32) == []
    )  # "I have them all": PX4 does not answer this either


@pytest.mark.parametrize(("stream_s", "told_s"), [(math.inf, 30.0), (1.0, 1.0)], ids=["kind", "strict"])
def test_a_companion_that_falls_silent_gets_what_the_failsafe_says(stream_s, told_s):
    """3 is PX4's number for a return."""
    vehicle = offboard()
    vehicle.setpoint(vehicle.now_s, (3.0, 4.0, -5.0))
    heard_s = vehicle.now_s + 10.0
    vehicle.setpoint(heard_s, (3.0, 4.0, -5.0))
    vehicle.configure(heard_s, replace(vehicle.config, stream_s=stream_s))
    station = Station(vehicle)
    assert float_in_int(station.value("COM_OBL_RC_ACT")) == 3
    assert station.value("COM_OF_LOSS_T") == told_s
    lost_s = heard_s + station.value("COM_OF_LOSS_T")
    vehicle.advance(lost_s - 0.01)
    assert vehicle.mode is Mode.OFFBOARD
    vehicle.advance(lost_s)
    assert vehicle.mode is Mode.RETURN


def test_the_battery_warns_and_lands_at_the_charges_that_are_told():
    """2 is PX4's number for a landing at the critical charge."""
    vehicle = hovering(VehicleConfig(endurance_s=100.0))
    station = Station(vehicle)
    assert float_in_int(station.value("COM_LOW_BAT_ACT")) == 2
    low_s, critical_s = (100.0 * (1.0 - station.value(name)) for name in ("BAT_LOW_THR", "BAT_CRIT_THR"))
    assert vehicle.advance(low_s - 0.1) == []
    assert [event.text for event in vehicle.advance(low_s + 0.1)] == ["Battery low: 15% left"]
    vehicle.advance(critical_s - 0.1)
    assert vehicle.mode is Mode.HOLD
    vehicle.advance(critical_s + 0.1)
    assert vehicle.mode is Mode.LAND


@pytest.mark.parametrize(
    ("name", "value", "field"),
    [
        ("MIS_TAKEOFF_ALT", 12.0, "takeoff_altitude_m"),
        ("RTL_RETURN_ALT", 15.0, "return_altitude_m"),
        ("GF_MAX_VER_DIST", 50.0, "ceiling_m"),
        ("MPC_XY_CRUISE", 2.5, "speed_mps"),
        ("MPC_Z_VEL_MAX_UP", 2.0, "climb_mps"),
        ("MPC_Z_VEL_MAX_DN", 0.75, "descent_mps"),
        ("MPC_ACC_HOR", 5.0, "accel_mps2"),
        ("MPC_YAWRAUTO_MAX", 90.0, "yaw_rate_dps"),
        ("COM_OF_LOSS_T", 5.0, "silence_s"),
        ("COM_DISARM_LAND", 0.5, "disarm_landed_s"),
        ("COM_DISARM_PRFLT", 30.0, "disarm_preflight_s"),
    ],
)
def test_what_is_set_is_told_and_configures_the_vehicle(station, name, value, field):
    (told,) = station.set(name, value)
    assert (told.param_id, told.param_value) == (name, value)
    assert station.value(name) == value
    assert getattr(station.vehicle.config, field) == value


def test_minus_one_turns_automatic_disarming_off(station):
    (told,) = station.set("COM_DISARM_PRFLT", -1.0)
    assert (told.param_value, station.vehicle.config.disarm_preflight_s) == (-1.0, math.inf)


@pytest.mark.parametrize(
    ("name", "value", "kind", "reason"),
    [
        ("MPC_XY_CRUISE", 100.0, REAL32, "MPC_XY_CRUISE refused: 100, allowed is 0.5 to 20 m/s"),
        ("MPC_XY_CRUISE", -1.0, REAL32, "MPC_XY_CRUISE refused: -1, allowed is 0.5 to 20 m/s"),
        ("MPC_XY_CRUISE", math.nan, REAL32, "MPC_XY_CRUISE refused: nan, allowed is 0.5 to 20 m/s"),
        ("MPC_XY_CRUISE", int_in_float(5), INT32, "MPC_XY_CRUISE refused: type 6, wanted 9"),
        (
            "COM_DISARM_LAND",
            0.0,
            REAL32,
            "COM_DISARM_LAND refused: 0, allowed is above 0 to 20 s, or -1 for never",
        ),
        (
            "COM_DISARM_LAND",
            -0.5,
            REAL32,
            "COM_DISARM_LAND refused: -0.5, allowed is above 0 to 20 s, or -1 for never",
        ),
        (
            "GF_MAX_VER_DIST",
            4.0,
            REAL32,
            "GF_MAX_VER_DIST refused: takeoff_altitude_m is 5.0: allowed is above 0 and up to the ceiling, 4",
        ),
        ("MAV_SYS_ID", int_in_float(7), INT32, "MAV_SYS_ID refused: 7, it cannot be changed"),
    ],
)
def test_a_value_out_of_range_is_refused_with_the_old_value_and_what_is_allowed(
    station, name, value, kind, reason
):
    before, config = station.value(name), station.vehicle.config
    told, *rest = station.set(name, value, kind)
    assert (told.get_type(), told.param_id, told.param_value) == ("PARAM_VALUE", name, before)
    assert text(rest) == reason
    assert station.vehicle.config == config


def test_a_fixed_value_that_is_set_to_what_it_is_is_no_fault(station):
    answers = station.set("MAV_SYS_ID", int_in_float(1), INT32)
    assert [m.get_type() for m in answers] == ["PARAM_VALUE"]


@pytest.mark.parametrize(
    "ask",
    [
        lambda s: s.read(b"NO_SUCH"),
        lambda s: s.set("NO_SUCH", 1.0),
        lambda s: s.read(index=1000),
        lambda s: s.read(index=-7),
    ],
)
def test_what_is_not_there_is_refused_and_named(station, ask):
    error, *rest = ask(station)
    assert (error.get_type(), error.error, error.target_system, error.target_component) == (
        "PARAM_ERROR",
        1,
        *STATION,
    )
    assert text(rest).startswith("No parameter")


def test_a_speed_that_is_set_in_flight_acts_from_the_next_leg_on():
    station = Station(hovering())
    vehicle = station.vehicle
    t = vehicle.now_s
    vehicle.go_to(t, (0.0, 20.0, -5.0))
    ends = vehicle.next_event_s()
    station.set("MPC_XY_CRUISE", 1.0)
    assert vehicle.next_event_s() == ends
    vehicle.go_to(30.0, (0.0, 10.0, -5.0))
    assert vehicle.next_event_s() == pytest.approx(
        30.0 + 10.0 + 1.0 / 3.0
    )  # 10 m at 1 m/s, and one ramp at 3 m/s²


def test_the_silence_that_is_set_brings_the_vehicle_home():
    station = Station(offboard())
    station.set("COM_OF_LOSS_T", 2.0)
    vehicle = station.vehicle
    vehicle.advance(vehicle.now_s + 2.1)
    assert vehicle.state(vehicle.now_s).mode in (Mode.RETURN, Mode.LAND)


def test_the_loss_time_of_a_strict_vehicle_is_that_of_its_stream():
    station = Station(offboard(VehicleConfig(stream_s=3.0)))
    assert station.value("COM_OF_LOSS_T") == 3.0
    station.set("COM_OF_LOSS_T", 2.0)
    assert (station.vehicle.config.stream_s, station.vehicle.config.silence_s) == (2.0, 30.0)


def test_extended_parameters_are_refused(station):
    (none,) = station.ask(mavlink.MAVLink_param_ext_request_list_message(1, 1))
    assert (none.get_type(), none.param_count) == ("PARAM_EXT_VALUE", 0)
    (read,) = station.ask(mavlink.MAVLink_param_ext_request_read_message(1, 1, b"CAM_MODE", -1))
    (written,) = station.ask(mavlink.MAVLink_param_ext_set_message(1, 1, b"CAM_MODE", b"1", 1))
    for answer in (read, written):
        assert (answer.get_type(), answer.param_id, answer.param_result) == (
            "PARAM_EXT_ACK",
            "CAM_MODE",
            2,
        )  # PARAM_ACK_FAILED
