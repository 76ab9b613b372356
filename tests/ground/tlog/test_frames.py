"""Protects the scanner of telemetry logs: it finds every intact frame among damaged ones, and never fails
on bytes.
"""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog.frames import NO_STAMP, log_clock, scan
from tests.ground.tlog.logs import BEGAN_US, Recorder, attitude, gas, local

SECOND = 1_000_000


def found(data: bytes) -> list[bytes]:
    """The records found, each with its time if it has one."""
    r = scan(data)
    return [
        data[start - (8 if us != NO_STAMP else 0) : end]
        for us, start, end in zip(r.logged_us, r.starts, r.ends, strict=True)
    ]


def accounted(data: bytes) -> int:
    """Bytes of records, of garbage, and of a cut-off last record."""
    r = scan(data)
    return sum(map(len, found(data))) + sum(count for _, count in r.garbage) + r.cut_off


def mixed(count: int = 12) -> Recorder:
    log = Recorder()
    for n in range(count):
        log.hear(
            n / 10,
            (attitude(100 * n), local(100 * n, n, -n), gas(100 * n, n / 7))[n % 3],
            system=1 + n % 2,
            version=1 + n % 4 // 2,
        )
    return log


def unknown_frame(payload: bytes) -> bytes:
    """A MAVLink 2 frame of message 54321, which is in no dialect: its checksum cannot be verified."""
    return bytes([0xFD, len(payload), 0, 0, 7, 1, 1]) + (54_321).to_bytes(3, "little") + payload + b"\x12\x34"


def test_both_versions_and_signed_frames_are_found_with_their_senders_and_times() -> None:
    log = Recorder()
    log.hear(0.0, attitude(1), system=7, component=2, version=1)
    log.hear(0.25, attitude(2), system=8, component=3)
    signer = mavlink.MAVLink(None, srcSystem=9, srcComponent=4)
    signer.signing.secret_key, signer.signing.sign_outgoing = b"k" * 32, True
    log.put(0.5, bytes(attitude(3).pack(signer)))
    r = scan(log.data)
    assert found(log.data) == log.records
    assert r.systems.tolist() == [7, 8, 9]
    assert r.components.tolist() == [2, 3, 4]
    assert r.message_ids.tolist() == [30, 30, 30]
    assert r.logged_us.tolist() == [BEGAN_US, BEGAN_US + 250_000, BEGAN_US + 500_000]
    assert (r.garbage, r.cut_off) == ([], 0)


@given(st.binary(max_size=600))
def test_any_bytes_are_records_or_garbage_or_cut_off(data: bytes) -> None:
    assert accounted(data) == len(data)


@given(st.data())
def test_every_intact_frame_is_found_whatever_its_neighbours_are(data: st.DataObject) -> None:
    intact, parts = [], []
    for record in mixed().records:
        damage = data.draw(st.sampled_from(["none", "none", "insert", "flip", "delete"]))
        if damage == "insert":
            parts.append(data.draw(st.binary(min_size=1, max_size=40)))
        elif damage == "flip":
            bit = data.draw(st.integers(0, 8 * len(record) - 1))
            record = (int.from_bytes(record, "little") ^ 1 << bit).to_bytes(len(record), "little")
        elif damage == "delete":
            begin = data.draw(st.integers(0, len(record) - 1))
            record = record[:begin] + record[begin + data.draw(st.integers(1, 60)) :]
        if damage in ("none", "insert"):
            intact.append(record)
        parts.append(record)
    log = b"".join(parts)
    rest = iter(found(log))
    assert all(record in rest for record in intact)  # all of them, in their order
    assert accounted(log) == len(log)


def test_a_frame_whose_time_is_damaged_is_found_without_one() -> None:
    records = mixed(3).records
    data = (
        records[0] + b"\xff" + records[1][1:] + records[2][3:]
    )  # a time in the year 2,285,000 and one that lacks three bytes
    r = scan(data)
    assert r.logged_us.tolist() == [BEGAN_US, NO_STAMP, NO_STAMP]
    assert r.garbage == [(1, 8), (2, 5)]


def test_a_message_that_the_dialect_does_not_know_is_taken_where_a_record_follows() -> None:
    log = mixed(2)
    log.put(0.3, unknown_frame(b"payload"))
    log.hear(0.4, attitude(400))
    r = scan(log.data)
    assert found(log.data) == log.records
    assert r.unknown == {54_321: 1}
    assert scan(log.data[: -len(log.records[-1])]).unknown == {54_321: 1}  # or the end


def test_an_unknown_message_followed_by_garbage_is_garbage() -> None:
    log = mixed(1)
    log.put(0.3, unknown_frame(b"payload"))
    log.records.append(b"?" * 40)
    r = scan(log.data)
    assert len(r.starts) == 1
    assert r.garbage == [(1, len(log.data) - len(log.records[0]))]


def test_what_may_be_an_unknown_message_never_swallows_a_frame_that_is_one() -> None:
    # A damaged header that spans the two whole records after it and ends exactly where a third begins.
    one, two, three = mixed(3).records
    head = struct.pack(">Q", BEGAN_US) + bytes([0xFD, len(one + two) - 2, 0, 0, 7, 1, 1, 0x31, 0xD4, 0x00])
    assert found(head + one + two + three) == [one, two, three]


def test_frames_with_a_wrong_checksum_are_counted_by_message() -> None:
    log = mixed(3)
    broken = log.records[0][:-1] + bytes([log.records[0][-1] ^ 1])
    r = scan(log.records[1] + broken + broken + log.records[2])
    assert r.refused == {30: 2}
    assert r.garbage == [(1, 2 * len(broken))]


@pytest.mark.parametrize("kept", [1, 7, 8, 9, 12, 20, 30])
def test_a_last_record_without_its_end_is_cut_off_not_garbage(kept: int) -> None:
    log = mixed(2)
    r = scan(log.records[0] + log.records[1][:kept])
    assert (len(r.starts), r.garbage, r.cut_off) == (1, [], kept)


def test_a_stream_without_times_is_found_too() -> None:
    log = Recorder(stamped=False)
    for n in range(5):
        log.hear(n, attitude(n), version=1 + n % 2)
    assert found(log.data) == log.records
    assert set(scan(log.data).logged_us.tolist()) == {NO_STAMP}


class TestTheLogsClock:
    """The log's times never decrease, however the clock was set."""

    @staticmethod
    def clock(*seconds: float | None):
        return log_clock(np.array([NO_STAMP if s is None else round(s * SECOND) for s in seconds], np.int64))

    def test_what_goes_on_is_left_as_it_is(self) -> None:
        clock = self.clock(10, 10, 10.5, 30, 8000, 8001)  # with gaps of 19.5 s and more than two hours
        assert clock.times_us.tolist() == [
            10 * SECOND,
            10 * SECOND,
            10_500_000,
            30 * SECOND,
            8000 * SECOND,
            8001 * SECOND,
        ]
        assert (clock.damaged, clock.jumps) == (0, [])

    def test_jumps_that_add_up_to_more_than_a_clock_can_say_are_damage(self) -> None:
        late = 130 * 365 * 24 * 3600.0  # in the year 2099
        clock = self.clock(*[late, late, late, 0, 0, 0] * 3000)
        assert clock.times_us[-1] < 2**63
        assert clock.times_us.tolist() == sorted(clock.times_us.tolist())
        assert clock.damaged == 3 * 2999  # 2099 added to itself is in no calendar; the first three are right

    def test_a_little_back_is_two_links_at_once(self) -> None:
        clock = self.clock(10, 10.5, 10.2, 10.6)
        assert clock.times_us.tolist() == [10 * SECOND, 10_500_000, 10_500_000, 10_600_000]
        assert (clock.damaged, clock.jumps) == (0, [])

    def test_after_it_is_set_back_it_goes_on_from_before(self) -> None:
        clock = self.clock(100, 101, 40, 41)
        assert clock.times_us.tolist() == [100 * SECOND, 101 * SECOND, 101 * SECOND, 102 * SECOND]
        assert clock.jumps == [(2, 61 * SECOND)]

    @pytest.mark.parametrize("odd", [None, 0.0, 55.0, 103.7, 4e9])
    def test_a_single_time_that_fits_no_neighbours_is_that_of_the_one_before(self, odd: float | None) -> None:
        clock = self.clock(100, 101, odd, 102, 103)
        assert clock.times_us.tolist() == [s * SECOND for s in (100, 101, 101, 102, 103)]
        assert (clock.damaged, clock.jumps) == (1, [])
