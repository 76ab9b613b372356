"""Protects the replay of a search's own telemetry: its readings again, the same number, times, values and
places.
"""

from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog import flight
from link.bus.mavlink import Codec, Reading, pack_reading, split, unpack_reading
from plume.geodesy import to_global
from tests.ground.tlog.logs import ARMED, DISARMED, HOME, Recorder, gas, heartbeat, landed, local, wind_cov

WESTERLY = (2.0, 270.0)
IN_HOME = (-7.25, 12.5)
"""Home, m north and east of the EKF's origin."""


def readings(read: flight.LoggedFlight) -> list[Reading]:
    return [unpack_reading(entry.payload) for entry in read.entries if entry.key == "reading"]


def around(north: float, east: float) -> tuple[int, int]:
    """1e-7 degrees of a place in the EKF's frame, whose origin is HOME of the logs."""
    lat, lon = to_global(*HOME, north, east)
    return round(lat * 1e7), round(lon * 1e7)


def origin() -> mavlink.MAVLink_message:
    return mavlink.MAVLink_gps_global_origin_message(*around(0.0, 0.0), 488_000, 0)


def home(north: float, east: float) -> mavlink.MAVLink_message:
    return mavlink.MAVLink_home_position_message(
        *around(north, east), 488_000, 0, 0, 0, [1.0, 0.0, 0.0, 0.0], 0, 0, 0
    )


def measured() -> list[Reading]:
    """Four, 3 s apart."""
    places = np.array([(2.5, 3.0), (3.5, 3.25), (4.5, 3.5), (5.5, 3.75)], np.float32).tolist()
    return [Reading(10_000 + 3000 * n, (x, y), 5.0, (1.5, -0.5), 0.25 + n) for n, (x, y) in enumerate(places)]


def path_at(at_s: float) -> tuple[float, float]:
    """(north, east) from home: at rest for 1 s at each reading, between them it flies on."""
    times, x, y = [], [], []
    for reading in measured():
        times += [reading.time_boot_ms / 1000.0 - 0.5, reading.time_boot_ms / 1000.0 + 0.5]
        x += [reading.position[0]] * 2
        y += [reading.position[1]] * 2
    return float(np.interp(at_s, times, y)), float(np.interp(at_s, times, x))


def flown(in_home: tuple[float, float] = IN_HOME, every_s: float = 0.05) -> Recorder:
    """The autopilot's own telemetry: in the EKF's frame. It stands until 2 s, and home is set anew in
    flight.
    """
    log = Recorder()
    log.hear(0.0, heartbeat(mode=DISARMED))
    log.hear(0.0, landed(mavlink.MAV_LANDED_STATE_ON_GROUND))
    log.hear(0.1, origin())
    log.hear(0.1, home(3.0, 3.0))  # where it was switched on
    log.hear(1.9, home(*in_home))  # where it was armed
    for n in range(round(25.0 / every_s)):
        now = n * every_s
        north, east = path_at(now)
        log.hear(now, local(round(1000 * now), in_home[0] + north, in_home[1] + east))
        if n * every_s == 2.0:
            log.hear(now, heartbeat(mode=ARMED))
            log.hear(now, landed(mavlink.MAV_LANDED_STATE_IN_AIR))
    log.hear(20.0, home(50.0, 50.0))
    return log


def write(log: Recorder, folder: Path) -> Path:
    log.records.sort(key=lambda record: record[:8])
    return log.write(folder)


@pytest.mark.parametrize("component", [1, 191])
def test_a_value_that_is_said_again_counts_once_at_its_time_and_the_place_then(
    tmp_path: Path, component: int
) -> None:
    """As the simulated vehicle streams it: 10 times a second, until there is another."""
    log = flown((0.0, 0.0))
    for n in range(150):
        now = 10.02 + n / 10
        newest = [reading for reading in measured() if reading.time_boot_ms <= 1000 * now][-1]
        log.hear(now, gas(newest.time_boot_ms, newest.gas), component=component)
    read = flight.read(write(log, tmp_path), wind=WESTERLY, origin=(0.0, 0.0))
    assert [(each.time_boot_ms, each.gas) for each in readings(read)] == [
        (each.time_boot_ms, each.gas) for each in measured()
    ]
    for each, reading in zip(readings(read), measured(), strict=True):
        assert each.position == pytest.approx(reading.position, abs=1e-5)
    assert "146 repeated" in "".join(read.notes)


def test_a_value_that_is_first_heard_long_after_it_was_taken_has_its_own_time(tmp_path: Path) -> None:
    log = flown((0.0, 0.0))
    first, *others = measured()
    log.hear(17.5, gas(first.time_boot_ms, first.gas))
    for reading in others:
        log.hear(reading.time_boot_ms / 1000.0 + 0.02, gas(reading.time_boot_ms, reading.gas))
    read = flight.read(write(log, tmp_path), wind=WESTERLY, origin=(0.0, 0.0))
    assert [each.gas for each in readings(read)] == [each.gas for each in measured()]
    assert readings(read)[0].position == pytest.approx(first.position, abs=1e-5)


def test_a_value_that_was_taken_before_the_log_began_is_at_no_place(tmp_path: Path) -> None:
    log = Recorder()
    for n in range(100):
        log.hear(n / 10, local(60_000 + 100 * n, 0.0, n / 10))
        log.hear(n / 10, gas(50_000 if n < 50 else 65_000, 1.0 if n < 50 else 2.0))
    log.hear(9.9, gas(69_900, 3.0))
    read = flight.read(log.write(tmp_path), wind=WESTERLY)
    assert [each.gas for each in readings(read)] == [2.0, 3.0]


def test_the_same_value_with_a_new_time_is_a_new_reading(tmp_path: Path) -> None:
    log = flown((0.0, 0.0))
    for reading in measured():
        log.hear(reading.time_boot_ms / 1000.0 + 0.02, gas(reading.time_boot_ms, 0.5))
    assert [each.gas for each in readings(flight.read(write(log, tmp_path), wind=WESTERLY))] == [0.5] * 4


def test_what_a_ground_station_hears_of_a_real_vehicle_is_put_into_the_area_by_home_and_origin(
    tmp_path: Path,
) -> None:
    """1e-7 degrees are 1.1 cm."""
    log = flown()
    for reading in measured():
        log.hear(reading.time_boot_ms / 1000.0 + 0.02, gas(reading.time_boot_ms, reading.gas), component=191)
    read = flight.read(write(log, tmp_path), wind=WESTERLY)
    assert [(each.time_boot_ms, each.gas) for each in readings(read)] == [
        (each.time_boot_ms, each.gas) for each in measured()
    ]
    for each, reading in zip(readings(read), measured(), strict=True):
        assert each.position == pytest.approx(reading.position, abs=0.011)
    assert read.area_m == 30.0


@pytest.mark.parametrize("component", [1, 191])
@pytest.mark.parametrize("in_home", [(0.0, 0.0), IN_HOME])
def test_the_record_of_a_search_gives_its_readings_to_the_last_bit(
    tmp_path: Path, component: int, in_home: tuple[float, float]
) -> None:
    """Each is said on the bus, again while it is unanswered, and its value on `mavlink/out`; one had no
    value at first.
    """
    log = flown(in_home)
    codec = Codec(1, component)
    none = pack_reading(codec, measured()[1]._replace(time_boot_ms=12_900, gas=float("nan")))
    log.put(12.9, none)
    for reading in measured():
        payload = pack_reading(codec, reading)
        for after_s in (0.01, 0.5, 1.5):
            for frame in split(payload):
                log.put(reading.time_boot_ms / 1000.0 + after_s, frame.data)
        log.hear(reading.time_boot_ms / 1000.0 + 0.02, gas(reading.time_boot_ms, reading.gas), component=191)
    log.hear(11.0, wind_cov(9.0, 9.0))
    path = write(log, tmp_path)
    assert readings(flight.read(path)) == measured()
    along = flight.read(path, wind=WESTERLY)
    assert [each.time_boot_ms for each in readings(along)] == [each.time_boot_ms for each in measured()]
    for each, reading in zip(readings(along), measured(), strict=True):
        assert each.position == pytest.approx(reading.position, abs=0.011), (
            "the readings' own positions are no fixes of the path"
        )


def test_readings_of_a_record_that_are_close_in_time_all_count(tmp_path: Path) -> None:
    log = flown()
    close = [reading._replace(time_boot_ms=10_000 + 300 * n) for n, reading in enumerate(measured())]
    for reading in close:
        payload = pack_reading(Codec(1, 191), reading)
        for frame in split(payload):
            log.put(reading.time_boot_ms / 1000.0, frame.data)
    path = write(log, tmp_path)
    assert readings(flight.read(path)) == close
    assert len(readings(flight.read(path, every_s=1.0))) == 1


def test_a_flight_that_is_not_north_and_east_of_home_has_its_area_around_it(tmp_path: Path) -> None:
    log = Recorder()
    log.hear(0.0, origin())
    log.hear(0.0, home(5.0, 0.0))
    for n in range(11):
        log.hear(n, local(1000 * n, 0.0, n))
        log.hear(n, gas(1000 * n, n))
    read = flight.read(log.write(tmp_path), wind=WESTERLY)
    assert readings(read)[0].position == pytest.approx((10.0, 15.0), abs=0.01)
