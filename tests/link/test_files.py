"""Protects what is on disk: a file is written whole or stays what it was."""

import os
from pathlib import Path

import pytest

from link.files import claim, is_claimed, obstacle, whole


def test_a_file_changes_when_all_is_written(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text("old")
    with whole(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_what_fails_half_way_leaves_what_was_there_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), whole(path) as partial:  # noqa: PT012
        partial.write_text("ne")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_a_link_and_a_pipe_a_pipe(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there" / "rows.csv")
    with whole(tmp_path / "link") as partial:
        partial.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "there" / "rows.csv").read_text() == "new"
    os.mkfifo(tmp_path / "pipe")
    with whole(tmp_path / "pipe") as pipe:
        assert pipe == tmp_path / "pipe"
    assert pipe.is_fifo()


def test_what_keeps_a_file_from_being_written_is_found_without_a_trace(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text("old")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "nowhere" / "rows.csv")
    os.mkfifo(tmp_path / "pipe")
    before = sorted(tmp_path.iterdir())
    for name in ("rows.csv", "new.csv", "pipe"):
        assert obstacle(tmp_path / name) is None
    for path, reason in (
        (tmp_path / "folder", "is a folder; wanted a file"),
        (tmp_path / "nowhere" / "rows.csv", "cannot be written: No such file or directory"),
        (tmp_path / "link", "cannot be written: No such file or directory"),
        (tmp_path / "rows.csv" / "rows.csv", "cannot be written: Not a directory"),
        (Path("/proc/rows.csv"), "cannot be written: No such file or directory"),
    ):
        assert obstacle(path) == reason
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "rows.csv").read_text() == "old"


def test_a_file_is_claimed_by_one_until_it_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    assert not is_claimed(path)
    with path.open("wb") as first, path.open("ab") as second:
        claim(first)
        assert is_claimed(path)
        with pytest.raises(OSError, match="another process is writing it"):
            claim(second)
    assert not is_claimed(path)
