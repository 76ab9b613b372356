"""Protects the start and end of a record: it overwrites nothing unasked, and holds every message sent
before its end.
"""

import signal
from pathlib import Path

import pytest

from ground.desk import recorder
from ground.desk.scenes import RecordedScene
from link import cli
from link.bus.keys import BELIEF
from link.bus.session import Bus
from link.record.reader import read
from link.record.tap import Tap
from link.record.writer import Writer


def test_a_recorder_that_is_told_to_end_before_it_begins_writes_what_was_said(
    router: str, tmp_path: Path
) -> None:
    with Tap("recorder", router) as tap, Bus("estimator", router) as estimator:
        tap.subscribe(BELIEF)
        tap.settle(30.0)
        estimator.publish(BELIEF, b"said")
        estimator.settle(30.0)
        recorder.record(
            tap, Writer(tmp_path / "run.mcap", {}), [signal.SIGTERM], RecordedScene({}, "uav/1"), set()
        )
    recording = read(tmp_path / "run.mcap")
    assert recording.complete
    assert [entry.payload for entry in recording.entries] == [b"said"]


def test_once_told_to_end_it_says_how_much_is_left_to_write(
    router: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(recorder, "LEFT_S", 0.0)
    with Tap("recorder", router) as tap, Bus("estimator", router) as estimator:
        tap.subscribe(BELIEF)
        tap.settle(30.0)
        for number in range(3):
            estimator.publish(BELIEF, b"%d" % number)
        estimator.settle(30.0)
        recorder.record(
            tap, Writer(tmp_path / "run.mcap", {}), [signal.SIGTERM], RecordedScene({}, "uav/1"), set()
        )
    told = [
        line.strip('"').rpartition(" ")[2]
        for line in capsys.readouterr().err.splitlines()
        if "left to write" in line
    ]
    assert told == ["3", "2", "1"]


def recorded(path: Path, router: str, *flags: str) -> int:
    return cli.start(
        "record", cli.Command("ground.desk.recorder", ""), [str(path), "--connect", router, *flags]
    )


@pytest.mark.parametrize("there", ["run.mcap", "run.tlog"])
def test_a_file_that_exists_is_refused_in_one_line_before_anything_is_joined(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], there: str
) -> None:
    (tmp_path / there).write_text("old")
    assert recorded(tmp_path / "run.mcap", "tcp/127.0.0.1:1") == 2  # no router listens there
    assert (
        capsys.readouterr().err
        == f"error: FILE.mcap: {str(tmp_path / there)!r} exists; wanted another name, or --force\n"
    )
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(there, "old")]


@pytest.mark.parametrize("there", ["run.mcap", "run.tlog"])
def test_of_two_recorders_that_begin_at_once_the_second_is_refused(tmp_path: Path, there: str) -> None:
    (tmp_path / there).write_text("the first one's")  # created after the second recorder's first check
    with pytest.raises(FileExistsError):
        recorder.begin(tmp_path / "run.mcap", False, {})
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(there, "the first one's")]


def test_a_record_that_is_being_written_is_refused_even_with_force_and_stays_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], router: str
) -> None:
    first = recorder.begin(tmp_path / "run.mcap", True, {"seed": 1})
    assert recorded(tmp_path / "run.mcap", router, "--force") == 2
    path = str(tmp_path / "run.mcap")
    assert (
        capsys.readouterr().err.splitlines()[-1]
        == f"error: FILE.mcap: cannot write {path!r}: another process is writing it"
    )
    first.close()
    recording = read(tmp_path / "run.mcap")
    assert (recording.complete, recording.about) == (True, {"seed": 1})
    recorder.begin(tmp_path / "run.mcap", True, {"seed": 2}).close()
    assert read(tmp_path / "run.mcap").about == {"seed": 2}


def test_where_only_one_file_can_be_made_neither_is_left(tmp_path: Path) -> None:
    (tmp_path / "run.tlog").symlink_to(tmp_path / "nowhere" / "run.tlog")
    with pytest.raises(OSError, match="exists"):
        recorder.begin(tmp_path / "run.mcap", False, {})
    assert not (tmp_path / "run.mcap").exists()


def test_with_force_it_begins_anew(tmp_path: Path) -> None:
    for name in ("run.mcap", "run.tlog"):
        (tmp_path / name).write_text("old")
    recorder.begin(tmp_path / "run.mcap", True, {"seed": 3}).close()
    assert read(tmp_path / "run.mcap").about == {"seed": 3}
    assert (tmp_path / "run.tlog").read_bytes() == b""
