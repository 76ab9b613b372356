"""Protects the sensor on a serial line: the first number after the question, whatever else comes, on a
device that may go and come.
"""

import math
import os
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aircraft.bridge.address import Address
from aircraft.payload.serial_sensor import LONGEST, NO_NUMBER, NumberLines, SerialSensor
from link.bus.log import Log
from link.bus.tally import Tally

EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "fake_sensor.py"


@pytest.fixture
def log() -> Log:
    return Log("payload", "uav/1", Tally(), "error")


def lines(log: Log) -> NumberLines:
    """Lines from the beginning of one on."""
    found = NumberLines(log)
    found.take(b"\n")
    return found


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.42", 0.42),
        ("-1", -1.0),
        ("+3.", 3.0),
        (".5", 0.5),
        ("1e-3", 0.001),
        ("2E2", 200.0),
        ("  7 ", 7.0),
        ("007", 7.0),
    ],
)
def test_a_number_is_a_line_of_its_own(text: str, value: float, log: Log) -> None:
    assert lines(log).take(text.encode() + b"\n") == [value]


@pytest.mark.parametrize(
    "text",
    ["gas 1.0", "1.0 ppm", "1,5", "1_000", "0x10", "inf", "1e39", "--1", "\x00\x01", "é1", "1 2", "e5", "."],
)
def test_any_other_line_is_left_out_and_counted(text: str, log: Log) -> None:
    assert lines(log).take(text.encode() + b"\n2\n") == [2.0]
    assert log.tally.refused == {NO_NUMBER: 1}


def test_a_sensor_may_say_that_it_has_no_value(log: Log) -> None:
    assert [math.isnan(value) for value in lines(log).take(b"nan\nNaN\n1\n")] == [True, True, False]
    assert not log.tally.refused


def test_lines_may_end_in_any_way_and_blank_ones_say_nothing(log: Log) -> None:
    assert lines(log).take(b"1\r\n2\r3\n\n   \n4\n") == [1.0, 2.0, 3.0, 4.0]
    assert not log.tally.refused


def test_the_rest_of_a_line_whose_beginning_is_not_known_is_no_number(log: Log) -> None:
    found = NumberLines(log)
    assert found.take(b"42") == []  # of 10.42
    assert found.take(b"\n5\n") == [5.0]
    found.begun = None
    assert found.take(b"7\n8\n") == [8.0]


@given(st.lists(st.binary(min_size=1, max_size=5), max_size=30))
def test_it_does_not_matter_in_which_pieces_the_bytes_come(pieces: list[bytes]) -> None:
    whole, split = (lines(Log("payload", "uav/1", Tally(), "error")) for _ in range(2))
    values = [value for piece in pieces for value in split.take(piece)]
    assert repr(values) == repr(whole.take(b"".join(pieces)))


def test_a_line_without_end_does_not_grow_memory_and_is_one_line_that_is_no_number(log: Log) -> None:
    found = lines(log)
    for _ in range(1000):
        assert found.take(b"1" * 4096) == []
        assert len(found.begun or b"") <= LONGEST + 1
    assert found.take(b"\n3\n") == [3.0]
    assert log.tally.refused == {NO_NUMBER: 1}


def test_lines_that_are_no_numbers_are_told_of_once(capsys: pytest.CaptureFixture[str]) -> None:
    log = Log("payload", "uav/1", Tally(), "info")
    lines(log).take(b"warming up\n" * 50)
    (line,) = capsys.readouterr().err.splitlines()
    assert "a line is not a number, 'warming up'" in line
    assert log.tally.refused == {NO_NUMBER: 50}


# ---- on a device ----


class Device:
    """A serial device of the test's own, behind a link that can be taken away."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.ours = self._theirs = -1
        self.plug_in()

    def plug_in(self) -> None:
        self.ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        self.path.symlink_to(os.ttyname(self._theirs))

    def unplug(self) -> None:
        self.path.unlink(missing_ok=True)
        for descriptor in (self.ours, self._theirs):
            if descriptor >= 0:
                os.close(descriptor)
        self.ours = self._theirs = -1

    def say(self, data: bytes) -> None:
        os.write(self.ours, data)


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    device = Device(tmp_path / "sensor")
    yield device
    device.unplug()


@pytest.fixture
def sensor(device: Device, log: Log) -> Iterator[SerialSensor]:
    sensor = SerialSensor(Address("serial", str(device.path), 57600), log)
    sensor.open()
    yield sensor
    sensor.close()


class Asked(threading.Thread):
    """A value that is waited for, in a thread of its own."""

    def __init__(self, sensor: SerialSensor, timeout_s: float = 30.0) -> None:
        super().__init__()
        self._sensor, self._timeout_s = sensor, timeout_s
        self._value = math.nan
        self.start()

    def run(self) -> None:
        self._value = self._sensor.read(self._timeout_s)

    def value(self) -> float:
        self.join(30.0)
        return self._value

    def hears(self, device: Device, data: bytes) -> float:
        """The value, while the sensor says the same again and again, as sensors do."""
        while self.is_alive():
            device.say(data)
            self.join(0.02)
        return self._value


def then_says(monkeypatch: pytest.MonkeyPatch, sensor: SerialSensor, device: Device, data: bytes) -> None:
    """Have the device say something as soon as the question has come."""
    forget = sensor.forget

    def asked() -> None:
        forget()
        device.say(data)

    monkeypatch.setattr(sensor, "forget", asked)


def test_the_first_number_after_the_question_is_the_value(
    device: Device, sensor: SerialSensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    device.say(b"begun\n1.0\n2.0\n")  # before the question
    then_says(monkeypatch, sensor, device, b"warm\n3.5\n4.5\n")
    assert sensor.read(30.0) == 3.5


def test_a_number_whose_line_began_before_the_question_and_ended_after_it_counts_whole(
    device: Device, sensor: SerialSensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    device.say(b"begun\n10.")
    then_says(monkeypatch, sensor, device, b"25\n")
    assert sensor.read(30.0) == 10.25


def test_a_line_that_hangs_has_no_value_after_the_time_allowed(sensor: SerialSensor) -> None:
    began = time.monotonic()
    assert math.isnan(sensor.read(0.2))
    assert time.monotonic() - began >= 0.2  # it has waited


def test_after_much_that_was_not_read_no_number_is_made_of_pieces(
    device: Device, sensor: SerialSensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    device.say(b"1.0\n" * 500 + b"9")  # as much may have been lost: what follows need not belong to the 9
    then_says(monkeypatch, sensor, device, b".5\n2.5\n")
    assert sensor.read(30.0) == 2.5


def test_a_device_that_is_unplugged_is_opened_again_when_it_is_back(
    device: Device, sensor: SerialSensor
) -> None:
    assert Asked(sensor).hears(device, b"1.0\n") == 1.0
    device.unplug()
    assert math.isnan(sensor.read(0.3))
    device.plug_in()
    assert Asked(sensor).hears(device, b"2.0\n") == 2.0


def test_a_device_that_is_not_there_at_first_may_come_later(tmp_path: Path, log: Log) -> None:
    sensor = SerialSensor(Address("serial", str(tmp_path / "late"), 57600), log)
    sensor.open()
    assert math.isnan(sensor.read(0.0))
    device = Device(tmp_path / "late")
    try:
        assert Asked(sensor).hears(device, b"4.0\n") == 4.0
    finally:
        sensor.close()
        device.unplug()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_sensor_of_the_guide_takes_its_line_away_when_it_ends(number: int, tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, EXAMPLE], cwd=tmp_path, stdout=subprocess.PIPE) as sensor:
        assert sensor.stdout is not None
        sensor.stdout.readline()
        assert (tmp_path / "gas-sensor").is_symlink()
        sensor.send_signal(number)
        assert sensor.wait(400) == 0
    assert not list(tmp_path.iterdir())
