"""Protects the reader of telemetry logs: which samples become readings, where and when, and the notes on
everything else.
"""

import itertools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from estimator.belief import belief
from estimator.filter import Config, assimilate, prior
from ground.tlog.flight import LoggedFlight, read
from ground.tlog.samples import parse_gas
from ground.tlog.track import Track
from link.bus.mavlink import Reading, unpack_reading
from link.cli import BadInput
from plume.dispersion import concentration
from plume.geodesy import to_global
from plume.problem import square
from plume.scenario import Scenario
from plume.sensors.names import GAUSSIAN
from plume.worlds.world import World
from tests.ground.tlog.logs import (
    BEGAN_US,
    DISARMED,
    HOME,
    Recorder,
    attitude,
    gas,
    globe,
    gps,
    ground_station,
    heartbeat,
    landed,
    local,
    wind,
    wind_cov,
)

LAT_E7, LON_E7 = (round(10**7 * degrees) for degrees in HOME)
METRES_AN_E7 = math.radians(1e-7) * 6_371_000.0
COS_LAT = math.cos(math.radians(HOME[0]))
WESTERLY = (3.0, 270.0)
PX4 = mavlink.MAV_AUTOPILOT_PX4


def readings(flight: LoggedFlight) -> list[Reading]:
    return [
        unpack_reading(entry.payload, flight.system) for entry in flight.entries if entry.key == "reading"
    ]


def noted(flight: LoggedFlight, *words: str) -> str:
    """The only note with these words."""
    (note,) = [note for note in flight.notes if all(word in note for word in words)]
    return note


def eastward(seconds: float) -> tuple[float, float]:
    """North and east at 2 m/s from (1, 0)."""
    return 1.0, 2.0 * seconds


def fly(
    log: Recorder,
    begin_s: float,
    end_s: float,
    boot_at_s: float = 0.0,
    place: Callable[[float], tuple[float, float]] = eastward,
    value: Callable[[float], float] | None = None,
    system: int = 1,
) -> None:
    """Log a flight: heartbeat and wind at 1 Hz, positions at 5 Hz, gas at 1 Hz between two positions
    (default value: 10 × time in s).
    """
    for n in range(round(5 * begin_s), round(5 * end_s) + 1):
        now = n / 5
        boot_ms = round(1000 * (now - boot_at_s))
        if n % 5 == 0:
            log.hear(now, heartbeat(), system)
            log.hear(now, wind(270.0, 3.0), system)
        log.hear(now, local(boot_ms, *place(now)), system)
        if n % 5 == 2:
            log.hear(now + 0.1, gas(boot_ms + 100, value(now + 0.1) if value else 10.0 * (now + 0.1)), system)


# ---- whole flights, by hand ----


def test_an_ardupilot_flight_gives_the_readings_that_one_works_out_by_hand(tmp_path: Path) -> None:
    log = Recorder()
    log.hear(0.0, heartbeat(), version=1)
    log.hear(0.0, wind(270.0, 3.0), version=1)
    log.hear(2.0, globe(2000, LAT_E7, LON_E7, up_mm=4000))
    log.hear(2.6, gas(2500, 0.7, b"CH4"), version=1)
    log.hear(3.0, globe(3000, LAT_E7 + 360, LON_E7 + 530, up_mm=6000), version=1)
    log.hear(3.5, wind(0.0, 2.0))
    log.hear(3.8, gas(3750, 1.25, b"CH4"))
    log.hear(4.0, globe(4000, LAT_E7 + 360, LON_E7 + 930, up_mm=6000))
    flight = read(log.write(tmp_path), gas="CH4", origin=(-1.0, -2.0))
    # The local origin is the first fix. At 2.5 s half of the way is flown, at 3.75 s three quarters of the
    # next.
    first, second = readings(flight)
    assert first.time_boot_ms == 2500
    assert first.position == pytest.approx(
        (2.0 + 265 * METRES_AN_E7 * COS_LAT, 1.0 + 180 * METRES_AN_E7), abs=1e-4
    )
    assert (first.altitude_m, first.gas) == (5.0, float(np.float32(0.7)))
    assert first.wind == pytest.approx((-3.0, 0.0), abs=1e-6)  # from the west: it points to −x
    assert second.time_boot_ms == 3750
    assert second.position == pytest.approx(
        (2.0 + 830 * METRES_AN_E7 * COS_LAT, 1.0 + 360 * METRES_AN_E7), abs=1e-4
    )
    assert (second.altitude_m, second.gas) == (6.0, 1.25)
    assert second.wind == pytest.approx((0.0, 2.0), abs=1e-6)  # from the north: it points to +y
    assert flight.system == 1
    assert flight.area_m == 30.0
    assert flight.origin[:2] == (-1.0, -2.0)
    assert flight.origin[2:] == pytest.approx(to_global(LAT_E7 / 1e7, LON_E7 / 1e7, -1.0, -2.0), abs=1e-9)
    assert "8 frames of MAVLink 1 and 2 in 4.0 s from 2023-11-14 22:13:20 UTC" in flight.notes[0]


def test_a_px4_flight_among_a_ground_station_and_an_onboard_computer_is_read(tmp_path: Path) -> None:
    log = Recorder()
    log.hear(0.0, ground_station(), system=255, component=190)
    log.hear(
        0.0, heartbeat(mavlink.MAV_AUTOPILOT_INVALID, 0, mavlink.MAV_TYPE_ONBOARD_CONTROLLER), component=191
    )
    log.hear(0.1, heartbeat(PX4))
    log.hear(0.1, landed(mavlink.MAV_LANDED_STATE_IN_AIR))
    log.hear(0.1, wind_cov(1.5, -2.0))
    log.hear(0.2, local(10_000, 1.0, 2.0, up=3.0))
    log.hear(0.3, gas(10_100, 0.5), component=191)
    log.hear(0.6, local(10_400, 3.0, 6.0, up=5.0))
    flight = read(log.write(tmp_path), origin=(0.0, 0.0))
    # A quarter of the way; the air moves north and west, so the wind comes from south and east.
    assert readings(flight) == [Reading(10_100, (3.0, 1.5), 3.5, (2.0, -1.5), 0.5)]
    assert "system 1 (PX4), component 1 (5 frames)" in noted(flight, "vehicle:")
    assert "component 191 (2 frames)" in noted(flight, "on board")
    assert "system 255 component 190 (ground station, 1 frame)" in noted(flight, "skipped:")
    assert flight.origin == (0.0, 0.0, None, None)  # no message ties the local frame to the globe


def test_all_that_the_vehicle_said_is_there_as_it_flew_and_in_order_of_time(tmp_path: Path) -> None:
    log = Recorder()
    log.hear(0.0, ground_station(), system=255, version=1)
    fly(log, 0.0, 4.0)
    log.hear(4.6, gas(4600, 7.0), component=191, version=1)
    flight = read(log.write(tmp_path))
    frames = [record[8:] for record in log.records[1:]]
    assert [entry.payload for entry in flight.entries if entry.key == "mavlink/out"] == frames
    assert {entry.key for entry in flight.entries} == {"mavlink/out", "reading"}
    for earlier, later in itertools.pairwise(flight.entries):
        assert earlier.published_ns <= later.published_ns
    # A reading is published at its gas value's time, 0.5, 1.5 … s, which is also its simulation time.
    said = [
        (entry.published_ns - 1000 * BEGAN_US, entry.simulation_s)
        for entry in flight.entries
        if entry.key == "reading"
    ]
    assert said == [(round(1e9 * s), s) for s in (0.5, 1.5, 2.5, 3.5, 4.6)]
    assert flight.entries[-1].key == "reading"


def test_floats_are_float32_and_times_grow(tmp_path: Path) -> None:
    log = Recorder()
    fly(log, 0.0, 20.0, place=lambda s: (s / 3, s / 7), value=lambda s: s / 9)
    flown = readings(read(log.write(tmp_path), every_s=0.3))
    for reading in flown:
        floats = (*reading.position, reading.altitude_m, *reading.wind, reading.gas)
        assert [float(np.float32(value)) for value in floats] == list(floats)
    assert all(earlier.time_boot_ms < later.time_boot_ms for earlier, later in itertools.pairwise(flown))
    assert len(flown) == 20


# ---- where ----


def test_local_positions_come_before_global_ones_which_fill_in_where_there_are_none(tmp_path: Path) -> None:
    log = Recorder()
    log.hear(0.0, heartbeat())
    for n in range(31):  # north at 1 m/s; the local origin is 3 m north and 4 m east of the first global fix
        now = n / 5
        log.hear(now, globe(200 * n, LAT_E7 + round(now / METRES_AN_E7), LON_E7, up_mm=5000))
        if n <= 15:
            log.hear(now, local(200 * n, now - 3.0 + 0.25, -4.0, up=5.0))
        log.hear(now, gas(200 * n, n))
    flight = read(log.write(tmp_path), wind=WESTERLY, origin=(-10.0, -10.0))
    assert noted(flight, "positions:") == "positions: 16 LOCAL_POSITION_NED, otherwise 31 GLOBAL_POSITION_INT"
    # The local frame is 0.25 m off the global one, and global fixes are moved onto it; their resolution is
    # 11.1 mm.
    expected = [(6.0, 7.25 + s) for s in range(7)]
    for reading, place in zip(readings(flight), expected, strict=True):
        assert reading.position == pytest.approx(place, abs=0.012)
    assert flight.origin[2:] == pytest.approx(
        to_global(LAT_E7 / 1e7, LON_E7 / 1e7, -10.0 + 2.75, -10.0 + 4.0), abs=2e-7
    )


def test_home_is_where_global_positions_count_from(tmp_path: Path) -> None:
    log = Recorder()
    log.hear(
        0.0, mavlink.MAVLink_home_position_message(LAT_E7, LON_E7, 488_000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
    )
    for n in range(3):
        log.hear(n, globe(1000 * n, LAT_E7 + 1000, LON_E7))
        log.hear(n, gas(1000 * n, n))
    flight = read(log.write(tmp_path), wind=WESTERLY, origin=(0.0, 0.0))
    assert readings(flight)[0].position == pytest.approx((0.0, 1000 * METRES_AN_E7), abs=1e-4)


def test_without_any_other_position_the_receivers_fixes_are_taken_and_no_fix_is_none(tmp_path: Path) -> None:
    log = Recorder()
    for n in range(8):
        log.hear(n, attitude(1000 * n))
        fix = mavlink.GPS_FIX_TYPE_NO_FIX if n < 2 else mavlink.GPS_FIX_TYPE_3D_FIX
        log.hear(n, globe(1000 * n, 0, 0))
        log.hear(n, gps(LAT_E7 + 100 * n, LON_E7, fix, alt_mm=490_000 + 1000 * n))
        log.hear(n, gas(1000 * n, n))
    flight = read(log.write(tmp_path), wind=WESTERLY, origin=(-5.0, 0.0))
    assert noted(flight, "positions:") == "positions: 6 GPS_RAW_INT"
    flown = readings(flight)
    assert [reading.gas for reading in flown] == [
        1,
        2,
        3,
        4,
        5,
        6,
        7,
    ]  # the first one 1 s before the first fix
    assert flown[-1].position == pytest.approx((0.0, 5.0 + 500 * METRES_AN_E7), abs=1e-3)
    assert flown[-1].altitude_m == 5.0


def test_no_position_at_all_is_an_error(tmp_path: Path) -> None:
    log = Recorder()
    for n in range(5):
        log.hear(n, globe(1000 * n, 0, 0))
        log.hear(n, local(1000 * n, math.nan, 0.0))
        log.hear(n, gas(1000 * n, n))
    with pytest.raises(BadInput, match="system 1 sent no position; wanted LOCAL_POSITION_NED"):
        read(log.write(tmp_path), wind=WESTERLY)


def test_gas_values_in_a_gap_are_left_out_and_up_to_a_second_beyond_its_ends_the_path_goes_on(
    tmp_path: Path,
) -> None:
    log = Recorder()
    fly(log, 0.0, 10.0)
    for late_s in (0.9, 1.6, 10.0, 18.9, 19.1):
        log.hear(10.0 + late_s, gas(round(1000 * (10.0 + late_s)), 500.0 + late_s))
    fly(log, 30.0, 33.0)
    flight = read(log.write(tmp_path), origin=(0.0, 0.0), area_m=100.0)
    assert (
        "gaps without a message from the vehicle: 8.4 s at 11.6 s, 8.9 s at 20.0 s; 17.3 s in total"
        in flight.notes
    )
    assert "3 without a position" in noted(flight, "left out")
    by_gas = {reading.gas: reading for reading in readings(flight)}
    assert by_gas[float(np.float32(500.9))].position == pytest.approx((21.8, 1.0), abs=1e-4)  # 2 m/s east
    assert by_gas[float(np.float32(519.1))].position == pytest.approx((58.2, 1.0), abs=1e-4)
    assert not {float(np.float32(value)) for value in (501.6, 510.0, 518.9)} & set(by_gas)


def test_an_area_of_30_m_is_laid_about_the_path_or_a_larger_one_that_holds_it(tmp_path: Path) -> None:
    log = Recorder()
    fly(log, 0.0, 12.0)  # readings from 1 m to 23 m east
    flight = read(log.write(tmp_path))
    assert (flight.area_m, *flight.origin[:2]) == (30.0, 1.0 - 15.0, 12.0 - 15.0)
    assert readings(flight)[0].position == (4.0, 15.0)
    assert (
        noted(flight, "area:")
        == "area: side 30 m, south-west corner -14 m north and -3 m east of the local origin"
    )
    fly(log, 12.2, 20.0)  # to 39 m: 38 m and 2 m at either end
    flight = read(log.write(tmp_path))
    assert (flight.area_m, *flight.origin[:2]) == (42.0, 1.0 - 21.0, 20.0 - 21.0)
    assert readings(flight)[0].position == (2.0, 21.0)


@pytest.mark.parametrize(
    ("far_m", "why"),
    [
        (150.0, "out of reach at 100 m/s"),
        (5_000.0, "out of reach at 100 m/s"),
        (400_000.0, "more than 20 km from the middle of the flight"),
    ],
)
def test_a_receiver_that_jumps_costs_no_more_than_its_values(tmp_path: Path, far_m: float, why: str) -> None:
    def place(seconds: float) -> tuple[float, float]:
        return (far_m, 0.0) if 6.0 < seconds < 7.0 else eastward(seconds)

    log, clean = Recorder(), Recorder()
    fly(log, 0.0, 12.0, place=place)
    fly(clean, 0.0, 12.0)
    flight, wanted = read(log.write(tmp_path)), read(clean.write(tmp_path, "clean.tlog"))
    assert flight.area_m == wanted.area_m == 30.0
    assert readings(flight) == [each for each in readings(wanted) if each.time_boot_ms != 6500]
    assert noted(flight, "left out") == f"left out: 1 {why}"


def test_a_chosen_area_leaves_out_what_is_not_in_it(tmp_path: Path) -> None:
    log = Recorder()
    fly(log, 0.0, 20.0)  # readings at 1, 3, 5 … 39 m
    path = log.write(tmp_path)
    flight = read(path, origin=(0.0, 4.0), area_m=10.0)
    assert [reading.position for reading in readings(flight)] == [(x, 1.0) for x in (1.0, 3.0, 5.0, 7.0, 9.0)]
    assert "15 outside the area" in noted(flight, "left out")
    assert read(path, area_m=10.0).origin[:2] == (-4.0, 15.0)
    assert read(path, origin=(0.0, 0.0)).area_m == 41.0  # 39 m and 2 m
    with pytest.raises(
        BadInput, match=r"none of the 20 samples can be a reading; left out: 20 outside the area"
    ):
        read(path, origin=(100.0, 100.0), area_m=5.0)


# ---- when ----


def test_after_a_restart_times_go_on_and_the_new_local_frame_is_laid_onto_the_first(tmp_path: Path) -> None:
    log = Recorder()

    def both(begin: int, end: int, boot_at_s: float, origin_east: float) -> None:
        for n in range(5 * begin, 5 * end + 1):
            now = n / 5
            boot_ms = round(1000 * (now - boot_at_s))
            log.hear(now, local(boot_ms, 0.0, now - origin_east))
            log.hear(now, globe(boot_ms, LAT_E7, LON_E7 + round(now / METRES_AN_E7 / COS_LAT)))
            if n % 5 == 0:
                log.hear(now, gas(boot_ms, now))

    both(0, 10, -100.0, 0.0)  # since 100 s on
    both(14, 20, 12.0, 8.0)  # started again at 12 s, with its origin 8 m further east
    flight = read(log.write(tmp_path), wind=WESTERLY, origin=(0.0, 0.0))
    note = noted(flight, "vehicle restarted")
    assert "at 14.0 s (time_boot_ms from 110,000 to 2,000)" in note
    assert "8.0 m east of the first one" in noted(flight, "after start 2")
    flown = readings(flight)
    # 10 s and 14 s are 4 s apart by the log's clock, and in the readings too.
    assert [reading.time_boot_ms for reading in flown] == [
        1000 * (100 + s) for s in (*range(11), *range(14, 21))
    ]
    for reading in flown:
        assert reading.position == pytest.approx((reading.gas, 0.0), abs=0.012)


def test_a_restart_without_global_positions_says_what_it_takes_for_granted(tmp_path: Path) -> None:
    log = Recorder()
    fly(log, 0.0, 5.0, boot_at_s=-60.0)
    fly(log, 6.0, 9.0, boot_at_s=5.5)
    assert "assumed unchanged after each restart" in noted(read(log.write(tmp_path)), "local frame")


def test_a_restart_without_a_clock_of_the_log_goes_on_by_a_millisecond(tmp_path: Path) -> None:
    log = Recorder(stamped=False)
    fly(log, 0.0, 5.0, boot_at_s=-60.0)
    fly(log, 6.0, 9.0, boot_at_s=5.5)
    flight = read(log.write(tmp_path, "flight.raw"))
    assert "no record times" in noted(flight, "the vehicle's own")
    # The last fix was at 65.0 s; the next fix carries 0.5 s, the gas value after it 1.0 s.
    times = [reading.time_boot_ms for reading in readings(flight)]
    assert times == [60_500, 61_500, 62_500, 63_500, 64_500, 65_001 + 500, 66_501, 67_501]


def test_messages_that_overtake_each_other_are_no_restart(tmp_path: Path) -> None:
    log = Recorder()
    fly(log, 0.0, 10.0, boot_at_s=-50.0)
    shuffled = sorted(
        range(len(log.records)), key=lambda n: n + (3 if n % 4 == 0 else 0)
    )  # some come 300 ms late
    log.records = [log.records[new][:8] + log.records[old][8:] for new, old in enumerate(shuffled)]
    log.hear(10.0, local(57_000, *eastward(7.0)))  # one even 3 s, and then the clock goes on
    for n in range(1, 6):
        log.hear(10.0 + n / 5, local(60_000 + 200 * n, *eastward(10.0 + n / 5)))
    flight = read(log.write(tmp_path), origin=(0.0, 0.0))
    assert not [note for note in flight.notes if "restarted" in note]
    flown = readings(flight)
    assert [reading.time_boot_ms for reading in flown] == [50_500 + 1000 * n for n in range(10)]
    for reading in flown:
        assert reading.position == pytest.approx(
            (2.0 * (reading.time_boot_ms - 50_000) / 1000, 1.0), abs=1e-4
        )
        assert reading.gas == pytest.approx((reading.time_boot_ms - 50_000) / 100, rel=1e-6)


def test_a_clock_that_wraps_after_49_days_is_no_restart(tmp_path: Path) -> None:
    log = Recorder()
    for n in range(11):
        boot_ms = (2**32 - 5000 + 1000 * n) % 2**32
        log.hear(n, local(boot_ms, 0.0, n))
        log.hear(n, gas(boot_ms, n))
    flight = read(log.write(tmp_path), wind=WESTERLY)
    assert not [note for note in flight.notes if "restarted" in note]
    # As they are, the times would not fit their field any more: they begin at 0.
    assert [reading.time_boot_ms for reading in readings(flight)] == [1000 * n for n in range(11)]


def test_a_log_that_is_joined_with_itself_is_one_flight(tmp_path: Path) -> None:
    log = Recorder()
    fly(log, 0.0, 12.0)
    path = log.write(tmp_path)
    wanted = read(path)
    path.write_bytes(log.data + b"".join(log.records[10:]))
    flight = read(path)
    assert flight.entries == wanted.entries
    again = len(log.records) - 10
    assert noted(flight, "skipped") == f"skipped: {again} frames that the log holds again, to the last bit"


def test_jumps_of_the_logs_clock_are_noted_and_change_no_reading(tmp_path: Path) -> None:
    plain, jumping = Recorder(), Recorder()
    for log, later_s, latest_s in ((plain, 0, 0), (jumping, 7200, -3600)):
        for begin, shift_s in ((0, 0), (10, later_s), (20, latest_s)):
            for n in range(begin, begin + 10):
                log.hear(n + shift_s, local(1000 * n, 0.0, n))
                log.hear(n + shift_s, gas(1000 * n, n))
    calm, shaken = (read(log.write(tmp_path), wind=WESTERLY) for log in (plain, jumping))
    assert readings(shaken) == readings(calm)
    assert "jumps back by 10,799.0 s at 7219.0 s" in noted(shaken, "log's clock jumps back")
    assert "7,200.0 s at 9.0 s" in noted(shaken, "log's clock jumps ahead")
    spans = [flight.entries[-1].published_ns - flight.entries[0].published_ns for flight in (calm, shaken)]
    assert spans == [
        29 * 10**9,
        28 * 10**9,
    ]  # the time between the two records around the set-back clock is unknown


@pytest.mark.parametrize("boot_ms", [lambda now: 0, lambda now: round(1000 * now) + 777_000])
def test_gas_from_a_computer_with_another_clock_or_none_is_placed_by_when_it_was_logged(
    tmp_path: Path, boot_ms: Callable
) -> None:
    log = Recorder()
    for n in range(51):
        now = n / 5
        log.hear(now, local(30_000 + 200 * n, *eastward(now)))
        if n % 5 == 3:
            log.hear(now + 0.1, gas(boot_ms(now), 5.0), component=191)
    flight = read(log.write(tmp_path), wind=WESTERLY, origin=(0.0, 0.0))
    assert "without the vehicle's clock: 10" in noted(flight, "log times are used")
    assert [reading.time_boot_ms for reading in readings(flight)] == [30_700 + 1000 * n for n in range(10)]
    assert readings(flight)[1].position == pytest.approx((3.4, 1.0), abs=1e-4)


# ---- what counts ----


def test_of_each_interval_the_first_value_counts(tmp_path: Path) -> None:
    log = Recorder()
    for n in range(31):
        log.hear(n / 10, local(100 * n, 0.0, n / 10))
        log.hear(n / 10, gas(100 * n, n))
    path = log.write(tmp_path)
    flight = read(path, wind=WESTERLY)
    assert [reading.gas for reading in readings(flight)] == [0.0, 10.0, 20.0, 30.0]
    assert "27 extra within 1 s" in noted(flight, "left out")
    assert [reading.gas for reading in readings(read(path, wind=WESTERLY, every_s=0.5))] == [
        5.0 * n for n in range(7)
    ]


def test_what_is_no_number_or_said_again_is_left_out_and_counted(tmp_path: Path) -> None:
    log = Recorder()
    said = [(0, 1.0), (0, 1.0), (1, math.nan), (2, math.inf), (3, 4.0), (3, 5.0), (4, 4.0)]
    for n in range(5):
        log.hear(n, local(1000 * n, 0.0, n))
        for at, value in said:
            if at == n:
                log.hear(n, gas(1000 * n, value))
    flight = read(log.write(tmp_path), wind=WESTERLY)
    assert [(reading.time_boot_ms, reading.gas) for reading in readings(flight)] == [
        (0, 1.0),
        (3000, 4.0),
        (4000, 4.0),
    ]
    assert noted(flight, "left out") == "left out: 1 repeated, 2 not finite, 1 with the time of another value"


@pytest.mark.parametrize("source", ["gas", "gas@ppm"])
def test_gas_that_is_never_a_number_is_refused_in_one_line(tmp_path: Path, source: str) -> None:
    log = Recorder()
    fly(log, 0.0, 3.0, value=lambda _: math.nan)
    with pytest.raises(BadInput, match=r"can be a reading; left out: 3 not finite$"):
        read(log.write(tmp_path), gas=source)


def test_a_value_that_is_none_of_its_unit_is_left_out(tmp_path: Path) -> None:
    log, clean = Recorder(), Recorder()
    fly(log, 0.0, 12.0, value=lambda seconds: 3e38 if 6.0 < seconds < 7.0 else seconds)
    fly(clean, 0.0, 12.0, value=lambda seconds: math.nan if 6.0 < seconds < 7.0 else seconds)
    flight, wanted = (
        read(each.write(tmp_path, f"{name}.tlog"), gas="gas@ppm")
        for name, each in (("log", log), ("clean", clean))
    )
    assert readings(flight) == readings(wanted)
    assert flight.sensed == wanted.sensed
    assert noted(flight, "left out") == "left out: 1 beyond ±1e+09 ppm"


def test_on_the_ground_nothing_is_measured(tmp_path: Path) -> None:
    log = Recorder()
    for n in range(10):  # armed from 2 s to 7 s, in the air from 3 s to 6 s
        log.hear(n, heartbeat(mode=heartbeat().base_mode if 2 <= n <= 7 else DISARMED))
        log.hear(
            n, landed(mavlink.MAV_LANDED_STATE_IN_AIR if 3 <= n <= 6 else mavlink.MAV_LANDED_STATE_ON_GROUND)
        )
        log.hear(n, local(1000 * n, 0.0, n))
        log.hear(n, gas(1000 * n, n))
    flight = read(log.write(tmp_path), wind=WESTERLY)
    assert [reading.gas for reading in readings(flight)] == [3.0, 4.0, 5.0, 6.0]
    assert "6 not in the air" in noted(flight, "left out")
    without_landed = [
        record for record in log.records if record[8 + 7 : 8 + 10] != (245).to_bytes(3, "little")
    ]
    log.records = without_landed
    assert [reading.gas for reading in readings(read(log.write(tmp_path), wind=WESTERLY))] == [
        2.0,
        3.0,
        4.0,
        5.0,
        6.0,
        7.0,
    ]


def test_a_vehicle_that_is_never_armed_is_carried(tmp_path: Path) -> None:
    log = Recorder()
    for n in range(4):
        log.hear(n, heartbeat(mode=DISARMED))
        log.hear(n, local(1000 * n, 0.0, n))
        log.hear(n, gas(1000 * n, n))
    flight = read(log.write(tmp_path), wind=WESTERLY)
    assert len(readings(flight)) == 4
    assert "all samples are used" in noted(flight, "in the air")


def test_gas_may_be_a_field_of_any_message_and_in_another_unit(tmp_path: Path) -> None:
    log = Recorder()
    for n in range(3):
        log.hear(n, local(1000 * n, 0.0, n))
        log.hear(n, mavlink.MAVLink_scaled_pressure3_message(1000 * n, 1000.0, 0.0, 250 + n, 0))
        log.hear(n, mavlink.MAVLink_named_value_int_message(1000 * n, b"ppm", 100 * n), version=1)
        log.hear(
            n, mavlink.MAVLink_battery_status_message(0, 0, 0, 0, [0] * 10, 10 * n, 0, 0, 0)
        )  # a message without a time
    path = log.write(tmp_path)
    assert [r.gas for r in readings(read(path, gas="SCALED_PRESSURE3.temperature", wind=WESTERLY))] == [
        250.0,
        251.0,
        252.0,
    ]
    assert [r.gas for r in readings(read(path, gas="ppm*0.25", wind=WESTERLY))] == [0.0, 25.0, 50.0]
    assert [r.gas for r in readings(read(path, gas="BATTERY_STATUS.current_battery", wind=WESTERLY))] == [
        0.0,
        10.0,
        20.0,
    ]


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", "wanted the NAME of a NAMED_VALUE_FLOAT, 1 to 10 characters, or MESSAGE.FIELD"),
        ("SCALED_PRESURE.temperature", "wanted the NAME"),
        (
            "SCALED_PRESSURE.temp",
            "a numeric field of SCALED_PRESSURE: time_boot_ms, press_abs, press_diff, temperature",
        ),
        ("DEBUG_FLOAT_ARRAY.data", "a numeric field of DEBUG_FLOAT_ARRAY: time_usec, array_id"),
        ("STATUSTEXT.text", "a numeric field of STATUSTEXT: severity"),
        ("CH4*ppm", "a number above 0 after the *"),
        ("CH4*-1", "a number above 0 after the *"),
        ("CH4*", "a number above 0 after the *"),
    ],
)
def test_a_bad_gas_mapping_is_refused_with_what_is_allowed(text: str, wanted: str) -> None:
    with pytest.raises(BadInput, match="is not allowed; wanted ") as refusal:
        parse_gas(text)
    assert wanted in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_readings_later_than_their_time_can_say_are_left_out(tmp_path: Path) -> None:
    log = Recorder()
    fly(log, 0.0, 4.0)
    for begin_s, boot_ms in (
        (5.0, 4_000_000_000),
        (15.0, 500_000_000),
        (25.0, 4_000_000_000),
    ):  # on the way, it adds up to 85 days
        for n in range(8):
            log.hear(begin_s + n, local(boot_ms + 1000 * n, 1.0, 1.0))
            log.hear(begin_s + n, gas(boot_ms + 1000 * n, 0.5))
    flight = read(log.write(tmp_path), wind=WESTERLY)
    assert readings(flight)
    assert "later than time_boot_ms can say" in noted(flight, "left out")


def test_a_name_that_would_break_the_line_or_the_terminal_is_quoted(tmp_path: Path) -> None:
    log = Recorder()
    log.hear(0.0, heartbeat())
    log.hear(0.0, local(0, 1.0, 1.0))
    log.hear(0.5, gas(500, 1.0, b"a\n\x1b[2J"))
    with pytest.raises(BadInput) as refused:
        read(log.write(tmp_path))
    assert r"its named values: 'a\n\x1b[2J'; " in str(refused.value)


def test_without_gas_the_names_that_are_there_are_told(tmp_path: Path) -> None:
    log = Recorder()
    for n in range(3):
        log.hear(n, local(1000 * n, 0.0, n))
        log.hear(n, gas(1000 * n, n, b"CH4"))
        log.hear(n, gas(1000 * n, n, b"Lights1"))
        log.hear(n, gas(1000 * n, n), system=7)
    with pytest.raises(BadInput) as refusal:
        read(log.write(tmp_path), wind=WESTERLY)
    assert str(refusal.value) == (
        "system 1 sent no gas; system 7 did; its named values: CH4, Lights1; "
        "choose one with --gas, or simulate a plume along its path with --plume MISSION.yaml"
    )


def test_the_wind_is_the_last_that_was_told_while_that_is_not_too_old(tmp_path: Path) -> None:
    log = Recorder()
    log.hear(0.0, wind(180.0, 1.0))
    for n in range(0, 60):
        log.hear(n, local(1000 * n, 0.0, n / 10))
        if n == 10:
            log.hear(n, wind(90.0, 2.0))
        if n % 10 == 5:
            log.hear(n, gas(1000 * n, n))
    flight = read(log.write(tmp_path))
    told = {reading.gas: reading.wind for reading in readings(flight)}
    assert told[5.0] == pytest.approx((0.0, -1.0), abs=1e-6)
    assert told[15.0] == pytest.approx((2.0, 0.0), abs=1e-6)
    assert sorted(told) == [5.0, 15.0, 25.0, 35.0]
    assert "2 without a wind" in noted(flight, "left out")
    # A given wind holds for the whole flight.
    for reading in readings(read(log.write(tmp_path), wind=(2.0, 30.0))):
        assert reading.wind == pytest.approx((1.0, math.sqrt(3.0)))


def test_no_wind_is_an_error_that_names_the_flag(tmp_path: Path) -> None:
    log = Recorder()
    for n in range(3):
        log.hear(n, local(1000 * n, 0.0, n))
        log.hear(n, gas(1000 * n, n))
        log.hear(n, wind_cov(math.nan, math.nan))
    with pytest.raises(BadInput, match="give it with --wind SPEED,FROM"):
        read(log.write(tmp_path))


# ---- whom ----


def test_of_several_vehicles_the_one_with_most_positions_is_read_or_the_one_that_is_asked_for(
    tmp_path: Path,
) -> None:
    log = Recorder()
    fly(log, 0.0, 10.0, system=3)
    fly(log, 10.2, 15.0, system=5, boot_at_s=10.0)
    log.hear(15.0, ground_station(), system=255)
    path = log.write(tmp_path)
    assert read(path).system == 3
    assert "system 5 component 1" in noted(read(path), "skipped")
    other = read(path, system=5)
    assert other.system == 5
    assert [reading.time_boot_ms for reading in readings(other)] == [500, 1500, 2500, 3500, 4500]
    with pytest.raises(BadInput, match=r"system 4 is not in the log; its systems: 3, 5, 255"):
        read(path, system=4)


def test_an_autopilot_is_known_by_its_heartbeat_whatever_its_component(tmp_path: Path) -> None:
    log = Recorder()
    log.hear(0.0, heartbeat(mavlink.MAV_AUTOPILOT_GENERIC), system=9, component=1)
    for n in range(3):
        log.hear(n, heartbeat(), system=2, component=0)
        log.hear(n, local(1000 * n, 0.0, n), system=2, component=0)
        log.hear(n, gas(1000 * n, n), system=2, component=0)
        log.hear(n, local(1000 * n, 50.0, n), system=2, component=154)  # a gimbal that sends its position
    flight = read(log.write(tmp_path), wind=WESTERLY, origin=(0.0, 0.0))
    assert [reading.position for reading in readings(flight)] == [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]
    assert "vehicle: system 2 (ArduPilot), component 0 (9 frames)" in flight.notes


def test_a_log_of_nothing_but_a_ground_station_has_no_vehicle(tmp_path: Path) -> None:
    log = Recorder()
    for n in range(3):
        log.hear(n, ground_station(), system=255, component=190)
    with pytest.raises(
        BadInput, match=r"no vehicle is in the log: none of its systems \(255\) is an autopilot"
    ):
        read(log.write(tmp_path))


# ---- a simulated plume ----


def test_a_plume_laid_over_the_path_is_read_as_its_world_tells_it(tmp_path: Path) -> None:
    log = Recorder()
    for n in range(51):
        now = n / 5
        log.hear(now, heartbeat(mode=heartbeat().base_mode if n > 5 else DISARMED))
        log.hear(now, local(20_000 + 200 * n, *eastward(now), up=4.0))
    s = Scenario(source=(15.0, 16.0), q=300.0, u=2.0, phi=0.5, d=4.0, tau=10.0, start=(0.0, 0.0))
    flight = read(log.write(tmp_path), plume=World(s, 9), every_s=2.0, origin=(-15.0, -5.0))
    world = World(s, 9)
    expected = [
        Reading(
            20_000 + 1000 * second,
            (place := (5.0 + 2.0 * second, 16.0)),
            4.0,
            world.wind,
            world.gas(place, step),
        )
        for step, second in enumerate((2, 4, 6, 8, 10))
    ]
    assert readings(flight) == expected
    assert flight.area_m == 30.0
    with pytest.raises(BadInput, match="a wind is not allowed with a plume"):
        read(log.write(tmp_path), plume=world, wind=WESTERLY)


def test_the_source_of_a_lawnmower_flight_is_found(tmp_path: Path) -> None:
    """An ArduPilot log with GLOBAL_POSITION_INT at 5 Hz, WIND, and gas of a known source: the filter must
    find it.

    With an honest Gaussian posterior of spread σ√2 the error exceeds twice the spread in exp(−4) = 1.8% of
    flights; this flight is always the same. The spread must be below the stop threshold ζ = 0.5 m of a
    mission: the error is then below 1 m.
    """
    s = Scenario(source=(18.3, 12.9), q=250.0, u=2.0, phi=2.2, d=3.0, tau=10.0, start=(0.0, 0.0))
    compass = math.degrees(math.atan2(*s.wind)) % 360.0
    lanes = [(2.0, 2.0)]
    for lane, y in enumerate(np.arange(2.0, 29.0, 3.25).tolist()):
        lanes += [((28.0, y) if lane % 2 else (2.0, y)), ((2.0, y) if lane % 2 else (28.0, y))]
    lengths = np.cumsum([0.0, *(math.dist(a, b) for a, b in itertools.pairwise(lanes))])
    rng = np.random.default_rng(5)
    log = Recorder()
    log.hear(
        0.0, mavlink.MAVLink_home_position_message(LAT_E7, LON_E7, 488_000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
    )
    for n in range(round(5 * lengths[-1] / 2.0)):  # at 2 m/s
        now, boot_ms = n / 5, 60_000 + 200 * n
        x, y = (float(np.interp(2.0 * now, lengths, [place[axis] for place in lanes])) for axis in (0, 1))
        lat, lon = to_global(LAT_E7 / 1e7, LON_E7 / 1e7, y, x)
        log.hear(now, globe(boot_ms, round(lat * 1e7), round(lon * 1e7)), version=1 + n % 2)
        if n % 5 == 0:
            log.hear(now, heartbeat(), version=1)
            log.hear(now, wind(compass, s.u), version=1)
            mean = concentration(
                (x, y, 0.0), (*s.source, 0.0), s.wind, rate=s.q, diffusivity=s.d, lifetime=s.tau
            )
            log.hear(now, gas(boot_ms, float(GAUSSIAN.measure(mean, rng)), b"CH4"))
    flight = read(log.write(tmp_path), gas="CH4")
    assert flight.area_m == 30.0
    assert flight.origin[:2] == pytest.approx((0.0, 0.0), abs=0.02)  # the lanes lie in the middle of the area
    config = Config(rate=s.q, diffusivity=s.d, lifetime=s.tau, area=square(flight.area_m))
    posterior = prior(config)
    for reading in readings(flight):
        posterior = assimilate(posterior, reading, config)
    summary, _ = belief(posterior, reading, config)
    assert summary.spread < 0.5
    assert math.dist(summary.mean, s.source) < 2.0 * summary.spread


# ---- damaged logs, and files that are not logs ----


def test_garbage_between_frames_costs_nothing_but_itself(tmp_path: Path) -> None:
    log = Recorder()
    fly(log, 0.0, 10.0)
    clean = read(log.write(tmp_path))
    rng = np.random.default_rng(3)
    log.records = [part for record in log.records for part in (rng.bytes(int(rng.integers(1, 50))), record)]
    dirty = read(log.write(tmp_path))
    assert readings(dirty) == readings(clean)
    assert f"bytes of garbage in {len(log.records) // 2} runs, the first at 0.0 s" in noted(dirty, "skipped:")


def test_what_is_damaged_is_told(tmp_path: Path) -> None:
    log = Recorder()
    fly(log, 0.0, 4.0)
    log.records[10] = log.records[10][:-1] + bytes([log.records[10][-1] ^ 1])
    log.put(4.0, bytes([0xFD, 1, 0, 0, 7, 1, 1]) + (54_321).to_bytes(3, "little") + b"?\x12\x34")
    log.hear(4.0, attitude(4000))
    log.hear(4.1, attitude(4100))
    log.records[-1] = b"\xff" + log.records[-1][1:]
    log.hear(4.2, attitude(4200))
    log.records[-1] = log.records[-1][:20]
    notes = read(log.write(tmp_path)).notes
    assert f"skipped: {len(log.records[10]) + 8} bytes of garbage in 2 runs, the first at 1.2 s" in notes
    assert (
        "among them, frames with a wrong checksum (damaged or from another dialect): 1 LOCAL_POSITION_NED"
        in notes
    )
    assert "frames of unknown messages, whose checksums cannot be verified: 1 of id 54321" in notes
    assert "the last record is cut off after 20 bytes" in notes
    assert "frames with a missing or impossible time: 1; each takes the time of the frame before it" in notes


@pytest.mark.parametrize("data", [b"", b"plain text\n" * 50])
def test_another_kind_of_file_is_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "some.log"
    path.write_bytes(data)
    with pytest.raises(
        BadInput, match=r"contains no MAVLink 1 or 2 frame; wanted a telemetry log \(\.tlog\)"
    ):
        read(path)


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    for path, why in ((tmp_path / "none.tlog", "No such file"), (tmp_path, "Is a directory")):
        with pytest.raises(BadInput, match=f"cannot be read: {why}"):
            read(path)


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        (
            {"wind": (-1.0, 0.0)},
            "wind -1,0 is not allowed; wanted a speed from 0 to 100 m/s and a direction within ±360°",
        ),
        ({"wind": (2.0, 400.0)}, "within ±360°"),
        ({"every_s": 0.0}, "a reading every 0 s is not allowed; wanted a number from 0.001"),
        ({"area_m": 0.0}, "an area of 0 m is not allowed; wanted a number above 0"),
        ({"origin": (math.nan, 0.0)}, "origin nan,0 is not allowed; wanted m north and m east"),
    ],
)
def test_what_is_asked_is_checked(tmp_path: Path, asked: dict, reason: str) -> None:
    log = Recorder()
    fly(log, 0.0, 2.0)
    with pytest.raises(BadInput) as refusal:
        read(log.write(tmp_path), **asked)
    assert reason in str(refusal.value)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_whatever_is_in_the_file_it_is_read_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    log = Recorder()
    fly(log, 0.0, 3.0)
    shuffled = data.draw(st.permutations(log.records)) if data.draw(st.booleans()) else log.records
    raw = bytearray(b"".join(shuffled))
    for _ in range(data.draw(st.integers(0, 12))):
        at = data.draw(st.integers(0, len(raw) - 1))
        match data.draw(st.sampled_from(["flip", "delete", "insert"])):
            case "flip":
                raw[at] ^= 1 << data.draw(st.integers(0, 7))
            case "delete":
                del raw[at : at + data.draw(st.integers(1, 30))]
            case _:
                raw[at:at] = data.draw(st.binary(min_size=1, max_size=30))
    path = tmp_path / "flight.tlog"
    path.write_bytes(raw)
    try:
        flight = read(path)
    except BadInput:
        return
    times = [reading.time_boot_ms for reading in readings(flight)]
    assert times == sorted(set(times))
    assert all(0.0 <= value <= flight.area_m for reading in readings(flight) for value in reading.position)


@pytest.mark.timeout(60)
def test_a_track_of_nothing_but_gaps_takes_no_longer_for_each_fix() -> None:
    """By n this takes half a second, by n² longer than it is given."""
    fixes = 100_000
    track = Track(
        [10_000.0 * number for number in range(fixes)], [(0.0, 0.0, 0.0)] * fixes, list(range(fixes))
    )
    assert list(track.lines()) == [(10_000.0 * number, 10_000.0 * number) for number in range(fixes)]
    assert [(boot, each.tolist()) for boot, each in track.of_boots()] == [
        (number, [number]) for number in range(fixes)
    ]


def test_the_lines_of_a_track_end_at_gaps_and_at_restarts() -> None:
    track = Track([0.0, 4000.0, 9001.0, 9002.0, 9003.0], [(0.0, 0.0, 0.0)] * 5, [0, 0, 0, 1, 0])
    assert list(track.lines()) == [(0.0, 4000.0), (9001.0, 9001.0), (9002.0, 9002.0), (9003.0, 9003.0)]
    assert [(boot, each.tolist()) for boot, each in track.of_boots()] == [(0, [0, 1, 2, 4]), (1, [3])]
    assert list(Track([], [], []).lines()) == []


def test_a_log_of_very_many_restarts_is_told_in_few_lines(tmp_path: Path) -> None:
    log = Recorder()
    log.hear(0.0, heartbeat())
    for start in range(20):
        boot_ms = (10_000_000, 40_000_000)[
            start % 2
        ]  # hours back each second time; home is a metre further north each time
        for tick in range(8):
            log.hear(100.0 * start + 0.1 * tick, local(boot_ms + 100 * tick, 0.0, 0.0))
        log.hear(100.0 * start + 0.8, globe(boot_ms + 700, LAT_E7 + round(start / 2 / METRES_AN_E7), LON_E7))
        log.hear(100.0 * start + 0.9, gas(boot_ms + 700, 1.0))
    flight = read(log.write(tmp_path), wind=WESTERLY)
    assert noted(flight, "so it is after 4 more starts")
    assert sum("the origin of the local frame is" in note for note in flight.notes) == 5
