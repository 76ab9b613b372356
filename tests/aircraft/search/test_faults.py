"""Protects the simulated faults: the values of a broken sensor and the deliveries of a bad radio, reading
by reading.
"""

import numpy as np

from aircraft.search.events import Delay, Dropout, Duplicate, Lose, Spike, Stuck
from aircraft.search.faults import FaultyRadio, FaultySensor


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


# ---- several at once: each adds its own, and ends after its own readings ----


def test_overlapping_spikes_add_up_and_each_ends_after_its_own_readings() -> None:
    sensor = FaultySensor()
    sensor.begin(Spike(step=0, gas=1.0, readings=3), now_s=0.0)
    said = [sensor.read(0.5)]
    sensor.begin(Spike(step=1, gas=-8.0, readings=1), now_s=1.0)
    sensor.begin(Spike(step=1, gas=16.0, readings=3), now_s=1.0)
    said += [sensor.read(0.5) for _ in range(4)]
    assert said == [0.5 + 1, 0.5 + 1 - 8 + 16, 0.5 + 1 + 16, 0.5 + 16, 0.5]


def test_a_stuck_sensor_says_the_spike_that_it_got_stuck_on_and_no_other() -> None:
    sensor = FaultySensor()
    sensor.begin(Spike(step=0, gas=10.0, readings=4), now_s=0.0)
    said = [sensor.read(1.0)]
    sensor.begin(Stuck(step=1, readings=2), now_s=1.0)
    said += [sensor.read(gas) for gas in (2.0, 3.0, 4.0, 5.0)]
    assert said == [11.0, 11.0, 11.0, 14.0, 5.0]  # the spike's four readings pass meanwhile


def test_a_sensor_that_gets_stuck_twice_comes_loose_after_the_longer_time() -> None:
    sensor = FaultySensor()
    said = [sensor.read(1.0)]
    sensor.begin(Stuck(step=1, readings=3), now_s=0.0)
    said.append(sensor.read(2.0))
    sensor.begin(Stuck(step=2, readings=1), now_s=0.0)
    said += [sensor.read(gas) for gas in (3.0, 4.0, 5.0)]
    assert said == [1.0, 1.0, 1.0, 1.0, 5.0]


def test_of_overlapping_dropouts_the_last_end_counts() -> None:
    sensor = FaultySensor()
    sensor.begin(Dropout(step=0, for_s=8.0), now_s=10.0)  # to 18
    sensor.begin(Dropout(step=0, for_s=8.0), now_s=15.0)  # to 23
    sensor.begin(Dropout(step=0, for_s=1.0), now_s=16.0)  # to 17
    assert [sensor.silent(now_s) for now_s in (15.0, 17.5, 18.0, 22.9, 23.0)] == [
        True,
        True,
        True,
        True,
        False,
    ]
    sensor.begin(Dropout(step=0, for_s=2.0), now_s=30.0)
    assert [sensor.silent(now_s) for now_s in (31.9, 32.0)] == [True, False]


class Air:
    """A radio that notes each delivery with its time; it delivers what is due every 0.25 s."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.arrivals: list[tuple[float, bytes]] = []
        self.radio = FaultyRadio(lambda payload: self.arrivals.append((self.now_s, payload)))

    def send(self, *readings: bytes, at_s: float) -> None:
        """Take readings and send each once, all at one time."""
        self.wait(at_s)
        for reading in readings:
            self.radio.new_reading()
            self.radio.send(reading, at_s)

    def wait(self, until_s: float) -> None:
        while self.now_s < until_s:
            self.now_s += 0.25
            self.radio.deliver(self.now_s)


def test_overlapping_delays_add_up_and_each_ends_after_its_own_readings() -> None:
    air = Air()
    air.radio.begin(Delay(step=0, readings=2, by_s=0.5))
    air.send(b"0", at_s=0.0)
    air.radio.begin(Delay(step=1, readings=2, by_s=0.25))
    for second in (1, 2, 3):
        air.send(b"%d" % second, at_s=float(second))
    assert air.arrivals == [(0.5, b"0"), (1.0 + 0.5 + 0.25, b"1"), (2.0 + 0.25, b"2"), (3.0, b"3")]


def test_a_reading_that_is_sent_again_is_late_again_by_as_much() -> None:
    air = Air()
    air.radio.begin(Delay(step=0, readings=1, by_s=0.5))
    air.radio.begin(Delay(step=0, readings=1, by_s=0.25))
    air.send(b"0", at_s=0.0)
    air.wait(0.5)
    air.radio.send(b"again", 0.5)
    assert air.radio.next_s() == 0.75
    air.wait(2.0)
    assert air.arrivals == [(0.75, b"0"), (1.25, b"again")]


def test_a_reading_with_fewer_delays_overtakes_one_with_more() -> None:
    air = Air()
    air.radio.begin(Delay(step=0, readings=1, by_s=1.5))
    air.radio.begin(Delay(step=0, readings=2, by_s=0.5))
    air.send(b"0", b"1", b"2", at_s=0.0)
    air.wait(3.0)
    assert air.arrivals == [(0.0, b"2"), (0.5, b"1"), (2.0, b"0")]


def test_readings_that_are_equally_late_keep_their_order() -> None:
    air = Air()
    air.radio.begin(Delay(step=0, readings=3, by_s=0.5))
    air.send(b"b", b"c", b"a", at_s=0.0)
    air.wait(1.0)
    assert air.arrivals == [(0.5, b"b"), (0.5, b"c"), (0.5, b"a")]


def test_overlapping_losses_add_up_and_each_ends_after_its_own_readings() -> None:
    air = Air()
    air.radio.begin(Lose(step=0, readings=2, times=1))
    air.radio.begin(Lose(step=0, readings=1, times=2))
    for reading in (b"0", b"1", b"2"):
        air.radio.new_reading()
        for attempt in (b"a", b"b", b"c", b"d"):
            air.radio.send(reading + attempt, 0.0)
    assert [payload for _, payload in air.arrivals] == [
        b"0d",
        b"1b",
        b"1c",
        b"1d",
        b"2a",
        b"2b",
        b"2c",
        b"2d",
    ]


def test_overlapping_duplicates_add_up_and_each_ends_after_its_own_readings() -> None:
    air = Air()
    air.radio.begin(Duplicate(step=0, readings=2, copies=1))
    air.radio.begin(Duplicate(step=0, readings=1, copies=2))
    air.send(b"0", b"1", b"2", at_s=0.0)
    assert [payload for _, payload in air.arrivals] == [b"0"] * (1 + 1 + 2) + [b"1"] * (1 + 1) + [b"2"]


def test_what_is_lost_once_then_comes_late_and_twice() -> None:
    air = Air()
    for fault in (
        Lose(step=0, readings=1),
        Delay(step=0, readings=1, by_s=0.5),
        Duplicate(step=0, readings=1),
    ):
        air.radio.begin(fault)
    air.send(b"lost", at_s=0.0)
    air.wait(1.0)
    air.radio.send(b"0", 1.0)
    air.wait(2.0)
    assert air.arrivals == [(1.5, b"0"), (1.5, b"0")]


def test_a_fault_begins_with_the_next_reading_not_within_one() -> None:
    air = Air()
    air.send(b"0", at_s=0.0)
    for fault in (
        Lose(step=0, readings=1),
        Delay(step=0, readings=1, by_s=0.5),
        Duplicate(step=0, readings=1),
    ):
        air.radio.begin(fault)
    air.radio.send(b"0 again", 0.0)
    air.send(b"1", at_s=1.0)
    assert air.arrivals == [(0.0, b"0"), (0.0, b"0 again")]
