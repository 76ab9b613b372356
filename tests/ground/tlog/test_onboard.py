"""Protects the reader of on-board logs: a dataflash .bin and a ULog .ulg give the readings that one works out
by hand, damage costs nothing but itself, and what is no such log is one line.
"""

import re
import tracemalloc
from pathlib import Path

import pytest

from ground.tlog.flight import LoggedFlight, read
from link.bus.mavlink import Reading, unpack_reading
from link.cli import BadInput
from tests.ground.tlog.onboard_logs import Dataflash, ULog, flown, flown_by_px4

WESTERLY = (3.0, 270.0)


def readings(flight: LoggedFlight) -> list[Reading]:
    return [unpack_reading(entry.payload) for entry in flight.entries if entry.key == "reading"]


# ---- ArduPilot ----


def test_a_dataflash_log_gives_the_readings_that_one_works_out_by_hand(tmp_path: Path) -> None:
    flight = read(flown().write(tmp_path))
    said = readings(flight)
    # One a second from 12.05 s on: 1 m/s east since 10 s, for 2.05 s. The air moves north and west.
    assert [reading.time_boot_ms for reading in said] == [12_050 + 1000 * n for n in range(19)]
    assert [reading.gas for reading in said] == [n + 2.25 for n in range(19)]
    for n, reading in enumerate(said):
        assert reading.position == pytest.approx((2.05 + n, 1.0), abs=0.012)  # from home, in 1e-7 degrees
        assert (reading.altitude_m, reading.wind) == (5.0, (2.0, -1.5))
    assert "an ArduPilot dataflash log of" in flight.notes[0]
    assert "from 2023-11-13 22:00:05 UTC" in flight.notes[1]
    assert "garbage" not in "".join(flight.notes)


def test_any_field_of_a_dataflash_log_may_be_the_gas(tmp_path: Path) -> None:
    flight = read(flown().write(tmp_path), gas="GASX.Conc*0.5", wind=WESTERLY, area_m=50.0)
    assert [reading.gas for reading in readings(flight)] == [50.0 * n for n in range(10, 101, 5)]
    with pytest.raises(BadInput, match=r"sent no RFND\.Dist; its named values: gas;"):
        read(flown().write(tmp_path), gas="RFND.Dist")


@pytest.mark.parametrize("own", [1, 2, None])
def test_values_of_another_vehicle_with_the_same_name_do_not_count(tmp_path: Path, own: int | None) -> None:
    """A vehicle logs what it receives, also from others in its network. Its own id is a parameter; where that
    is not logged, the system that sends more counts.
    """
    every = 1 if own else 10  # messages
    log = flown(system=own or 1, other_every=every)
    log.define("PARM", "QNf", "TimeUS,Name,Value")
    if own:
        log.say("PARM", 30_000_000, "SYSID_THISMAV", float(own))
    said = readings(read(log.write(tmp_path), origin=(0.0, 0.0)))
    assert [reading.gas for reading in said] == [n + 2.25 for n in range(19)]
    assert any(
        f"messages, {1 + 100 // every} values of other systems with the same name left out" in note
        for note in read(log.write(tmp_path)).notes
    )


def test_damage_of_a_dataflash_log_costs_nothing_but_itself(tmp_path: Path) -> None:
    log = flown()
    clean = readings(read(log.write(tmp_path)))
    begin = log.data.index(b"\xa3\x95", 9 * 89)  # the first message behind the formats
    log.data = log.data[:begin] + b"\x00\xa3\x95\x07?" + log.data[begin:] + b"\xff" * 300
    flight = read(log.write(tmp_path))
    assert readings(flight) == clean
    assert ", 305 bytes skipped as garbage; " in flight.notes[0]
    log.data = log.data[:-400]
    part = readings(read(log.write(tmp_path)))
    assert 10 < len(part) < len(clean)
    assert part == clean[: len(part)]


@pytest.mark.parametrize("length", [0, 1, 3, 12])
def test_a_format_that_no_message_can_have_is_not_followed(tmp_path: Path, length: int) -> None:
    log = flown()
    clean = readings(read(log.write(tmp_path)))
    odd = Dataflash()
    odd.define("ODD", "?", "TimeUS", number=90, length=length)
    odd.data += bytes([0xA3, 0x95, 90]) + bytes(max(length - 3, 0))
    odd.data += log.data
    assert readings(read(odd.write(tmp_path))) == clean


def test_a_dataflash_log_of_nothing_to_read_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"is an ArduPilot dataflash log of 1 messages, but none that tells"):
        read(Dataflash().write(tmp_path))


def test_two_flights_in_one_log_are_read_one_after_the_other(tmp_path: Path) -> None:
    """A second flight in the same log starts its clock anew, as where files were joined."""
    first, second = flown(), flown(north=9.0, late_us=3_000)
    apart = [readings(read(log.write(tmp_path), area_m=30.0)) for log in (first, second)]
    first.data += second.data
    flight = read(first.write(tmp_path))
    assert [(each.position, each.gas) for each in readings(flight)] == [
        (each.position, each.gas) for each in apart[0] + apart[1]
    ]
    times_ms = [each.time_boot_ms for each in readings(flight)]
    assert times_ms == sorted(set(times_ms))
    assert any("the vehicle restarted: at " in note for note in flight.notes)


def test_a_piece_that_a_log_holds_twice_counts_once(tmp_path: Path) -> None:
    log = flown()
    clean = readings(read(log.write(tmp_path)))
    middle = log.data.index(b"\xa3\x95", len(log.data) // 2)
    log.data = log.data[:middle] + log.data[middle - 2000 :]
    assert readings(read(log.write(tmp_path))) == clean


def test_one_damaged_time_is_no_restart(tmp_path: Path) -> None:
    log = flown()
    log.say("ARM", 3_600_000_000, 1)
    late = log.data[-(3 + 9) :]
    log.data = log.data[:-12]
    clean = readings(read(log.write(tmp_path)))
    middle = log.data.index(b"\xa3\x95", len(log.data) // 2)
    log.data = log.data[:middle] + late + log.data[middle:]
    flight = read(log.write(tmp_path))
    assert readings(flight) == clean
    assert not any("restarted" in note for note in flight.notes)


# ---- PX4 ----


def test_a_ulog_gives_the_readings_that_one_works_out_by_hand(tmp_path: Path) -> None:
    flight = read(flown_by_px4().write(tmp_path), gas="CH4*2", origin=(0.0, 0.0))
    said = readings(flight)
    assert [reading.time_boot_ms for reading in said] == [11_100 + 1000 * n for n in range(10)]
    assert [reading.gas for reading in said] == [11.0 + 10.0 * n for n in range(10)]
    for n, reading in enumerate(said):
        assert reading.position == pytest.approx((2.2 + 2.0 * n, 1.0), abs=1e-5)
        assert (reading.altitude_m, reading.wind) == (3.0, (2.0, -1.5))
    assert "a PX4 ULog of" in flight.notes[0]
    assert "from 2023-11-14 22:13:21 UTC" in flight.notes[1]  # 1 s after the boot
    assert "system 1 (PX4)" in "".join(flight.notes)


def test_a_ulog_that_is_cut_off_is_read_up_to_there(tmp_path: Path) -> None:
    log = flown_by_px4()
    whole = readings(read(log.write(tmp_path), gas="CH4"))
    log.data = log.data[: len(log.data) * 3 // 4]
    part = readings(read(log.write(tmp_path), gas="CH4"))
    assert 3 < len(part) < len(whole)
    assert [reading.gas for reading in part] == [reading.gas for reading in whole[: len(part)]]


def test_damage_of_a_ulog_is_stepped_over_to_the_next_sync(tmp_path: Path) -> None:
    log = flown_by_px4()
    whole = readings(read(log.write(tmp_path), gas="CH4"))
    begin = log.data.index(b"\x08\x00S", len(log.data) // 2)
    log.data = log.data[: begin - 100] + b"\xff" * 60 + log.data[begin - 40 :]
    flight = read(log.write(tmp_path), gas="CH4")
    assert " bytes skipped as garbage; " in flight.notes[0]
    assert {reading.time_boot_ms for reading in readings(flight)} <= {each.time_boot_ms for each in whole}
    assert len(readings(flight)) >= len(whole) - 1


@pytest.mark.parametrize(
    "fields", ["b[9999] b", "uint8_t[99999999] x", "nowhere x", "float", "", "float[-3] x"]
)
def test_a_topic_that_no_message_can_have_is_not_followed(tmp_path: Path, fields: str) -> None:
    log = ULog()
    log.put("F", f"wind:{fields};".encode())
    log.put("F", f"b:{fields};".encode())
    log.data += flown_by_px4().data[len(ULog().data) :]
    assert len(readings(read(log.write(tmp_path), gas="CH4", wind=WESTERLY))) == 10


def test_a_topic_that_claims_more_than_a_message_can_hold_takes_no_memory(tmp_path: Path) -> None:
    log = ULog()
    log.put("F", b"wind:" + b"uint8_t[999] x;" * 1000)  # a million values in 15 kB
    log.data += flown_by_px4().data[len(ULog().data) :]
    path = log.write(tmp_path)
    tracemalloc.start()
    try:
        assert len(readings(read(path, gas="CH4"))) == 10
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()


# ---- as others read them ----


def test_pymavlink_and_pyulog_read_the_same_values_from_these_logs(tmp_path: Path) -> None:
    from pymavlink.DFReader import DFReader_binary
    from pyulog import ULog as Other

    theirs = DFReader_binary(str(flown().write(tmp_path)))
    said = [message for message in iter(lambda: theirs.recv_match(type=["NVAL"]), None)]
    ours = read(tmp_path / "00000001.BIN", every_s=0.001)
    by_time = {message.TimeBootMS: message.Value for message in said if message.get_type() == "NVAL"}
    assert {each.time_boot_ms: each.gas for each in readings(ours)}.items() <= by_time.items()
    topic = Other(str(flown_by_px4().write(tmp_path))).get_dataset("debug_key_value").data
    ours = read(tmp_path / "log.ulg", gas="CH4", every_s=0.001)
    times_ms, values = (topic["timestamp"] // 1000).tolist(), topic["value"].tolist()
    assert [(each.time_boot_ms, each.gas) for each in readings(ours)] == list(
        zip(times_ms[1:], values[1:], strict=True)
    )


# ---- units ----


def test_gas_of_a_named_unit_is_converted_and_its_background_subtracted(tmp_path: Path) -> None:
    for log, name in ((flown(), "gas"), (flown_by_px4(), "CH4")):
        said = [reading.gas for reading in readings(read(log.write(tmp_path), gas=name))]
        flight = read(log.write(tmp_path), gas=f"{name}@ppm", background=2.0)
        ppm = 101_325 * 16.043 / (8.314463 * 288.15) * 1e-6
        assert [reading.gas for reading in readings(flight)] == pytest.approx(
            [(gas - 2.0) * ppm for gas in said],
            rel=1e-6,  # readings are float32
        )
        assert flight.sensed is not None
        assert any("; 2 ppm is subtracted, as given" in note for note in flight.notes)
    for gas, words in (("gas@lel", "'lel' is not a unit"), ("gas@ppm*m", "is of a path; wanted a table")):
        with pytest.raises(BadInput, match=re.escape(words)):
            read(flown().write(tmp_path), gas=gas)
    with pytest.raises(BadInput, match="--background: only allowed where --gas names a unit"):
        read(flown().write(tmp_path), background=2.0)
