"""Protects timestamps: they only go forward, whatever the clock does, across restarts and kills; nothing
old is taken twice.
"""

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from link.signing import timestamps
from link.signing.timestamps import LAST, MOST_STREAMS, Timestamps, clock

A_S = 100_000
NOON = 1_000_000 * A_S
STATION = (255, 190, 0)
ME = (1, 1, 7)


@pytest.fixture
def now() -> list[int]:
    return [NOON]


@pytest.fixture
def opened(tmp_path: Path, now: list[int]) -> Iterator[Callable[[], Timestamps]]:
    """Open the timestamps as a process that starts; the one before has ended."""
    before: list[Timestamps] = []

    def begin() -> Timestamps:
        for each in before:
            each.close()
        before.append(Timestamps(tmp_path / "key.uav-1", lambda: now[0]))
        return before[-1]

    yield begin
    for each in before:
        each.close()


def test_the_clock_counts_ten_microseconds_since_2015() -> None:
    since_s = (datetime.now(UTC) - datetime(2015, 1, 1, tzinfo=UTC)).total_seconds()
    assert abs(clock() / 100_000 - since_s) < 5


def test_each_frame_gets_a_later_timestamp_though_the_clock_stands_still_or_steps_back(
    opened: Callable, now: list[int]
) -> None:
    times = opened()
    assert [times.next(ME), times.next(ME)] == [NOON, NOON + 1]
    now[0] -= 3600 * A_S
    assert times.next(ME) == NOON + 2
    now[0] = NOON + A_S
    assert times.next(ME) == NOON + A_S


def test_a_process_that_starts_again_goes_on_later_than_it_ended_though_the_clock_has_stepped_back(
    opened: Callable, now: list[int]
) -> None:
    last = [opened().next(ME) for _ in range(3)][-1]
    now[0] -= 86400 * A_S
    assert opened().next(ME) == last + 1


def test_what_was_accepted_makes_own_timestamps_later_also_after_a_restart(opened: Callable) -> None:
    times = opened()
    assert times.accept(STATION, NOON + 7 * A_S)
    assert times.next(ME) == NOON + 7 * A_S + 1
    assert opened().next(ME) == NOON + 7 * A_S + 2


def test_a_frame_is_taken_once_and_an_older_one_of_its_stream_never(opened: Callable) -> None:
    times = opened()
    assert times.accept(STATION, NOON)
    assert not times.accept(STATION, NOON)
    assert not times.accept(STATION, NOON - 1)
    assert times.accept(STATION, NOON + 1)
    for other in ((254, 190, 0), (255, 191, 0), (255, 190, 1)):
        assert times.accept(other, NOON - 1)


def test_a_frame_of_the_former_run_is_not_taken_again_but_its_sender_is_heard_on(opened: Callable) -> None:
    opened().accept(STATION, NOON)
    times = opened()
    assert not times.accept(STATION, NOON)
    assert not times.accept(STATION, NOON - 1)
    assert times.accept(STATION, NOON + 1)


def test_a_new_stream_may_be_a_minute_behind_and_no_more(opened: Callable) -> None:
    times = opened()
    assert not times.accept(STATION, NOON - 60 * A_S - 1)
    assert times.accept(STATION, NOON - 60 * A_S)
    assert times.accept((1, 2, 3), NOON + 300 * A_S)
    assert not times.accept((4, 5, 6), NOON)  # a minute behind the latest that is known, too


def test_of_senders_minutes_ahead_the_first_is_told_and_each_is_heard(opened: Callable) -> None:
    times = opened()
    assert times.accept(STATION, NOON + 60 * A_S)
    assert times.notice == ""
    assert times.accept(STATION, NOON + 599 * A_S)
    assert times.notice.startswith("system 255, component 190 signs 599 s later than the clock")
    times.notice = ""
    assert times.accept(STATION, NOON + 600 * A_S)
    assert times.notice == ""
    assert times.next(ME) > NOON + 600 * A_S


@pytest.mark.parametrize("ahead", [600 * A_S + 1, LAST - NOON])
def test_a_frame_far_ahead_of_the_clock_takes_nobody_along(opened: Callable, ahead: int) -> None:
    times = opened()
    assert times.accept(STATION, NOON)
    for stream in (STATION, (254, 190, 0)):
        assert not times.accept(stream, NOON + ahead)
    for begun in (times, opened()):
        assert begun.next(ME) < NOON + A_S
        assert begun.accept(STATION, begun.next(ME))
        assert begun.accept((254, 190, 0), begun.next(ME))


def test_a_machine_without_a_clock_takes_the_time_of_whoever_signs(opened: Callable, now: list[int]) -> None:
    now[0] = 0
    times = opened()
    assert times.accept(STATION, NOON)
    assert times.next(ME) == NOON + 1
    now[0] = NOON  # GPS has set it
    assert not times.accept(STATION, LAST)


def test_a_sender_without_a_clock_is_heard_after_a_long_silence(opened: Callable, now: list[int]) -> None:
    opened().accept(STATION, NOON)
    now[0] += 600 * A_S
    assert opened().accept(STATION, NOON + 1)


def test_streams_without_end_neither_fill_memory_nor_let_an_old_frame_in(
    opened: Callable, now: list[int], tmp_path: Path
) -> None:
    times = opened()
    streams = [(1 + number // 256, 1, number % 256) for number in range(2 * MOST_STREAMS)]
    assert all(times.accept(stream, NOON + number) for number, stream in enumerate(streams))
    for reopened in (times, opened()):
        assert not any(reopened.accept(stream, NOON + number) for number, stream in enumerate(streams))
    assert not times.accept(STATION, NOON)  # of an unknown stream: it may be one that was forgotten
    assert opened().accept(STATION, NOON + A_S)
    assert (tmp_path / "key.uav-1").stat().st_size == 28 * MOST_STREAMS


def test_what_is_sent_for_ever_new_senders_does_not_let_a_stations_last_frame_in_again(
    opened: Callable,
) -> None:
    times = opened()
    assert times.accept(STATION, NOON)
    for number in range(MOST_STREAMS + 10):  # as a bridge signs what others send
        times.next((1 + number // 256, 1, number % 256))
    assert not times.accept(STATION, NOON)
    times = opened()
    assert not times.accept(STATION, NOON)
    assert times.accept(STATION, NOON + A_S)


def test_what_was_written_is_brought_to_the_disk_without_end_of_the_process(
    opened: Callable, monkeypatch: pytest.MonkeyPatch, wait_until: Callable[..., None]
) -> None:
    kept: list[bytes] = []
    monkeypatch.setattr(timestamps, "KEPT_EVERY_S", 0.01)
    monkeypatch.setattr(os, "fdatasync", lambda file: kept.append(os.pread(file, 28, 0)))
    times = opened()
    wait_until(lambda: kept)
    assert times.accept(STATION, NOON)
    wait_until(lambda: kept[-1].split() == [b"255", b"190", b"0", b"%d" % NOON])


def test_the_last_timestamp_of_all_is_no_error(opened: Callable, now: list[int]) -> None:
    now[0] = LAST
    times = opened()
    assert times.accept(STATION, LAST)
    assert times.next(ME) == LAST
    assert opened().next(ME) == LAST


def test_the_file_belongs_to_one_process_and_to_its_user(tmp_path: Path) -> None:
    path = tmp_path / "key.uav-1"
    first = Timestamps(path)
    with pytest.raises(ValueError, match=r"key\.uav-1' is in use by another process"):
        Timestamps(path)
    first.close()
    Timestamps(path).close()
    assert path.stat().st_mode & 0o777 == 0o600


def test_what_is_sent_always_has_room(opened: Callable) -> None:
    times = opened()
    said = [times.next((1 + number // 256, 1, number % 256)) for number in range(MOST_STREAMS + 10)]
    assert said == list(range(NOON, NOON + MOST_STREAMS + 10))
    assert not times.accept((1 + MOST_STREAMS // 256, 1, 9), said[-1])


@pytest.mark.parametrize("line", [0, 1, 5])
def test_a_damaged_file_gets_one_line_and_is_left_as_it_is(
    line: int, opened: Callable, tmp_path: Path
) -> None:
    opened().accept(STATION, NOON)
    opened().close()
    path = tmp_path / "key.uav-1"
    content = bytearray(path.read_bytes())
    content[28 * line + 3] = ord("x")
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"line {line + 1} is damaged") as refusal:
        opened()
    assert "\n" not in str(refusal.value)
    assert path.read_bytes() == content


def test_a_file_that_was_begun_and_not_finished_is_used(opened: Callable, tmp_path: Path) -> None:
    (tmp_path / "key.uav-1").write_bytes(b" " * 40)
    with pytest.raises(ValueError, match="line 1 is damaged"):
        opened()
    (tmp_path / "key.uav-1").write_bytes((b" " * 27 + b"\n") * 2 + b" " * 9)
    assert opened().accept(STATION, NOON)
    assert not opened().accept(STATION, NOON)


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match="keeps the last timestamps, but cannot be written: No such file or directory"
    ):
        Timestamps(tmp_path / "none" / "key.uav-1")


def test_a_full_disk_is_told_once_and_frames_are_still_taken_once(
    opened: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = opened()

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", full)
    assert times.accept(STATION, NOON)
    assert "No space left on device" in times.notice
    times.notice = ""
    assert not times.accept(STATION, NOON)
    assert times.next(ME) > NOON
    assert times.notice == ""


KILLED = """
import os, sys
from pathlib import Path
from link.signing.timestamps import Timestamps
times = Timestamps(Path(sys.argv[1]))
for number in range(10_000_000):
    accepted = times.next(ME)
    times.accept((255, 190, number % 3), accepted)
    os.write(1, b"%d %d\\n" % (number % 3, accepted))
"""


def test_a_process_that_is_killed_at_any_time_leaves_nothing_that_can_be_repeated(tmp_path: Path) -> None:
    path = tmp_path / "key.uav-1"
    for lines in (1, 20, 300):
        with subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE) as process:
            assert process.stdout
            for _ in range(lines):
                process.stdout.readline()
            process.send_signal(signal.SIGKILL)
            rest = process.stdout.read().rpartition(b"\n")[0].splitlines()
        said = [tuple(map(int, line.split())) for line in rest]
        times = Timestamps(path)
        assert all(not times.accept((255, 190, link), timestamp) for link, timestamp in said)
        assert times.next(ME) > max((timestamp for _, timestamp in said), default=0)
        times.close()


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("send"), st.integers(0, 2)),
            st.tuples(st.just("hear"), st.integers(0, 2), st.integers(-8_000_000, 8_000_000)),
            st.tuples(st.just("clock"), st.integers(-20_000_000, 20_000_000)),
            st.tuples(st.just("restart")),
        ),
        max_size=40,
    )
)
def test_whatever_happens_what_is_sent_grows_and_what_is_taken_grows_for_each_stream(
    steps: list[tuple],
) -> None:
    now, sent, taken = [NOON], 0, dict[int, int]()
    with TemporaryDirectory() as folder:
        times = Timestamps(Path(folder) / "key", lambda: now[0])
        for what, *numbers in steps:
            if what == "clock":
                now[0] += numbers[0]
            elif what == "restart":
                times.close()
                times = Timestamps(Path(folder) / "key", lambda: now[0])
            elif what == "send":
                before, sent = sent, times.next((1, 1, numbers[0]))
                assert sent > max(before, *taken.values(), 0)
            else:
                link, at = numbers[0], now[0] + numbers[1]
                if times.accept((255, 190, link), at):
                    assert at > taken.get(link, 0)
                    taken[link] = at
                elif link in taken:
                    assert at <= taken[link]
        times.close()
