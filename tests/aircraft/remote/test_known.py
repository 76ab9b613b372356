"""Protects what is taken from a real vehicle's words: frames, winds, parameters, texts, and what it still
lacks to fly.
"""

import struct
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from aircraft.firmware import ARDUCOPTER, PX4, unfit
from aircraft.remote.known import Known

ORIGIN = mavlink.MAVLink_gps_global_origin_message(473977419, 85455938, 488_000, 0)


def home(lat_e7: int, lon_e7: int, alt_mm: int) -> Any:
    return mavlink.MAVLink_home_position_message(
        lat_e7, lon_e7, alt_mm, 0, 0, 0, [1.0, 0.0, 0.0, 0.0], 0, 0, 0
    )


def beat(autopilot: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, kind: int = mavlink.MAV_TYPE_QUADROTOR) -> Any:
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 81, 0, 3, 3)


def position(boot_ms: int = 1000, north: float = 1.0) -> Any:
    return mavlink.MAVLink_local_position_ned_message(boot_ms, north, 2.0, -3.0, 0.0, 0.0, 0.0)


def known(*messages: Any, at_s: float = 10.0) -> Known:
    all_of_it = Known()
    for message in messages:
        all_of_it.take(message, at_s)
    return all_of_it


def test_home_lies_where_its_latitude_and_longitude_are_from_the_origin() -> None:
    """1e-5 degrees of latitude are 6371 km * pi / 180 * 1e-5 = 1.1119 m; of longitude at 47.4 degrees,
    that times its cosine 0.67690.
    """
    north, east, down = known(ORIGIN, home(473977519, 85455838, 488_400)).to_home()
    assert north == pytest.approx(1.1119, abs=2e-4)
    assert east == pytest.approx(-0.7527, abs=2e-4)
    assert down == pytest.approx(-0.4)


def test_a_vehicle_can_fly_only_when_all_of_it_is_known() -> None:
    good = mavlink.MAVLink_ekf_status_report_message(831, 0, 0, 0, 0, 0)
    blind = mavlink.MAVLink_ekf_status_report_message(831 & ~16, 0, 0, 0, 0, 0)
    assert "HEARTBEAT" in known(position(), good, ORIGIN, home(0, 0, 0)).missing(10.0)
    assert "EKF" in known(beat(), position(), blind, ORIGIN, home(0, 0, 0)).missing(10.0)
    assert "EKF" in known(beat(), good, ORIGIN, home(0, 0, 0)).missing(10.0)
    assert "HOME_POSITION" in known(beat(), position(), good, ORIGIN).missing(10.0)
    whole = known(beat(), position(), good, ORIGIN, home(0, 0, 0))
    assert whole.missing(10.9) == ""
    assert "EKF" in whole.missing(11.5), "a position that is 1.5 s old"
    assert "HEARTBEAT" in whole.missing(14.0)


def test_a_position_that_is_not_a_number_is_no_position() -> None:
    heard = known(beat(), position(), position(north=float("nan")))
    assert heard.position == (1.0, 2.0, -3.0)


def test_wind_points_to_where_it_comes_from() -> None:
    """ArduPilot says where it comes from, in degrees from north; WIND_COV says where the air goes."""
    assert known(mavlink.MAVLink_wind_message(90.0, 2.0, 0.0)).wind == pytest.approx((2.0, 0.0))
    air_to_the_south = mavlink.MAVLink_wind_cov_message(0, -3.0, 0.0, 0, 0, 0, 0, 0, 0)
    assert known(air_to_the_south).wind == pytest.approx((0.0, 3.0))


def test_a_wind_of_zero_is_not_known() -> None:
    assert known(mavlink.MAVLink_wind_message(0.0, 0.0, 0.0)).wind is None


def test_an_integer_parameter_of_px4_comes_as_its_bytes() -> None:
    (as_float,) = struct.unpack("<f", struct.pack("<i", 3))
    said = mavlink.MAVLink_param_value_message(
        b"COM_OBL_RC_ACT", as_float, mavlink.MAV_PARAM_TYPE_INT32, 1, 0
    )
    assert known(beat(mavlink.MAV_AUTOPILOT_PX4), said).parameters == {"COM_OBL_RC_ACT": 3.0}
    plain = mavlink.MAVLink_param_value_message(b"FS_GCS_ENABLE", 1.0, mavlink.MAV_PARAM_TYPE_INT8, 1, 0)
    assert known(beat(), plain).parameters == {"FS_GCS_ENABLE": 1.0}


def test_a_long_text_comes_whole() -> None:
    first = b"Mode change to AUTO RTL failed: No return path or "
    assert len(first) == 50
    chunks = (
        mavlink.MAVLink_statustext_message(4, text, 7, at)
        for at, text in enumerate((first, b"landing sequence found"))
    )
    assert known(*chunks).texts == [
        (4, "Mode change to AUTO RTL failed: No return path or landing sequence found")
    ]


def test_an_autopilot_that_starts_again_has_forgotten_its_origin() -> None:
    again = known(beat(), position(60_000), ORIGIN, home(0, 0, 0), position(500))
    assert again.boots == 1
    assert again.origin is None


def test_an_autopilot_whose_clock_wraps_has_not_started_again() -> None:
    wrapped = known(beat(), position(2**32 - 40), ORIGIN, position(60, north=2.0))
    assert (wrapped.boots, wrapped.origin is None) == (0, False)
    assert wrapped.position == (2.0, 2.0, -3.0)
    assert wrapped.position_ms == 2**32 + 60


@pytest.mark.parametrize("text", ["Circle fence breached", "Geofence violation"])
def test_a_breach_of_the_fence_is_heard(text: str) -> None:
    assert known(mavlink.MAVLink_statustext_message(4, text.encode())).breach_s == 10.0


def test_other_autopilots_and_planes_are_named_in_one_line() -> None:
    assert unfit(beat()) == unfit(beat(mavlink.MAV_AUTOPILOT_PX4)) == ""
    assert unfit(beat(mavlink.MAV_AUTOPILOT_GENERIC)).startswith(
        "autopilot GENERIC (0) is not supported; wanted"
    )
    assert unfit(beat(kind=mavlink.MAV_TYPE_FIXED_WING)).startswith(
        "vehicle type FIXED_WING (1) cannot hover; wanted"
    )


def test_modes_are_asked_for_by_each_autopilots_own_numbers() -> None:
    assert ARDUCOPTER.params(4) == (1.0, 4.0, 0.0)
    assert PX4.params(6 << 16) == (1.0, 6.0, 0.0)
    assert PX4.params(4 << 16 | 5 << 24) == (1.0, 4.0, 5.0)
