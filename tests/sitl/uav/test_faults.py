"""Protects the faults: what a broken sensor says and what a bad radio brings, reading by reading."""

import numpy as np

from sitl.script.script import Delay, Dropout, Duplicate, Lose, Spike, Stuck
from sitl.uav.faults import FaultyRadio, FaultySensor


def test_a_stuck_sensor_repeats_its_last_value_and_then_comes_loose() -> None:
    sensor = FaultySensor()
    said = [sensor.read(1.5)]
    sensor.begin(Stuck(step=1, readings=2), now_s=0.0)
    said += [sensor.read(gas) for gas in (2.5, 3.5, 4.5)]
    assert said == [1.5, 1.5, 1.5, 4.5]


def test_a_sensor_that_is_stuck_from_the_start_repeats_its_first_value() -> None:
    sensor = FaultySensor()
    sensor.begin(Stuck(step=0, readings=3), now_s=0.0)
    assert [sensor.read(gas) for gas in (2.5, 3.5, 4.5, 5.5)] == [2.5, 2.5, 2.5, 5.5]


def test_spikes_add_up_as_float32_and_pass() -> None:
    sensor = FaultySensor()
    sensor.begin(Spike(step=0, gas=0.1, readings=2), now_s=0.0)
    sensor.begin(Spike(step=0, gas=10.0), now_s=0.0)
    assert [sensor.read(1.0) for _ in range(3)] == [float(np.float32(11.1)), float(np.float32(1.1)), 1.0]


def test_a_dropout_lasts_as_long_as_it_says() -> None:
    sensor = FaultySensor()
    sensor.begin(Dropout(step=0, for_s=8.0), now_s=10.0)
    sensor.begin(Dropout(step=0, for_s=1.0), now_s=11.0)  # a shorter one within does not end it
    assert [sensor.silent(now_s) for now_s in (10.0, 12.5, 17.9, 18.0)] == [True, True, True, False]


def flown(*faults: Delay | Duplicate | Lose, readings: int = 3) -> tuple[FaultyRadio, list[bytes]]:
    """Send each reading once, at time 0."""
    arrived: list[bytes] = []
    radio = FaultyRadio(arrived.append)
    for fault in faults:
        radio.begin(fault)
    for number in range(readings):
        radio.new_reading()
        radio.send(b"%d" % number, 0.0)
    return radio, arrived


def test_a_lost_reading_arrives_when_it_is_sent_often_enough() -> None:
    arrived: list[bytes] = []
    radio = FaultyRadio(arrived.append)
    radio.begin(Lose(step=0, readings=1, times=2))
    radio.new_reading()
    for attempt in range(3):
        radio.send(b"%d" % attempt, float(attempt))
    assert arrived == [b"2"]


def test_readings_are_doubled_only_as_long_as_it_says() -> None:
    _, arrived = flown(Duplicate(step=0, readings=2, copies=2))
    assert arrived == [b"0"] * 3 + [b"1"] * 3 + [b"2"]


def test_delayed_readings_arrive_in_their_time_behind_later_ones() -> None:
    radio, arrived = flown(Delay(step=0, readings=1, by_s=0.5))
    assert (arrived, radio.next_s()) == ([b"1", b"2"], 0.5)
    radio.deliver(0.4)
    assert arrived == [b"1", b"2"]
    radio.deliver(0.5)
    assert arrived == [b"1", b"2", b"0"]
    assert radio.next_s() == float("inf")
