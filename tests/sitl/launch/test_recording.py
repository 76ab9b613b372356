"""Protects the files of a record: an existing file is overwritten only with --force, and only by a mission
that begins.
"""

import re
import resource
from pathlib import Path

import pytest

from link.cli import BadInput
from link.record.reader import read
from link.record.writer import Writer
from sitl.launch.recording import RecordFiles, write_summary


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """An older record."""
    (tmp_path / "good.mcap").write_text("old")
    (tmp_path / "good.tlog").write_text("old frames")
    return tmp_path / "good.mcap"


def made(path: Path) -> RecordFiles:
    """Files written by a recorder with --force."""
    files = RecordFiles(path)
    files.prepare(force=True)
    for each in (files.path, files.path.with_suffix(".tlog")):
        assert not each.exists()
        each.write_text("new")
    files.made = True
    return files


def content(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


@pytest.mark.parametrize("there", ["good.mcap", "good.tlog"])
def test_either_file_that_exists_is_refused_by_its_name(tmp_path: Path, there: str) -> None:
    (tmp_path / there).write_text("old")
    refusal = f"^--record: {re.escape(repr(str(tmp_path / there)))} exists; wanted another name, or --force$"
    with pytest.raises(BadInput, match=refusal):
        RecordFiles(tmp_path / "good.mcap").prepare(force=False)


def test_a_folder_is_refused_whatever_is_forced(tmp_path: Path) -> None:
    (tmp_path / "good.tlog").mkdir()
    with pytest.raises(BadInput, match=r"^--record: '.*good.tlog' is a folder; wanted a file$"):
        RecordFiles(tmp_path / "good.mcap").prepare(force=True)


def test_a_record_that_is_being_written_is_refused_whatever_is_forced(tmp_path: Path) -> None:
    path = tmp_path / "good.mcap"
    writer = Writer(path, {})
    with pytest.raises(BadInput, match=r"^--record: another process is writing '.*'; wanted another name$"):
        RecordFiles(path).prepare(force=True)
    writer.close()
    RecordFiles(path).prepare(force=True)


def test_of_two_missions_that_are_forced_on_one_name_both_records_stay_whole(old: Path) -> None:
    files = made(old)
    first = Writer(old, {"seed": 1})  # it began meanwhile
    assert files.take_place() == f"the record stays in {files.path}: another process is writing {old}"
    assert (files.path.read_text(), files.path.with_suffix(".tlog").read_text()) == ("new", "new")
    first.close()
    assert read(old).about == {"seed": 1}


def test_older_files_are_replaced_when_the_search_begins(old: Path) -> None:
    files = made(old)
    assert content(old.parent)["good.mcap"] == "old"
    assert files.take_place() == ""
    assert content(old.parent) == {"good.mcap": "new", "good.tlog": "new"}
    assert files.path == old
    files.give_up(refused=False)
    assert content(old.parent) == {"good.mcap": "new", "good.tlog": "new"}


@pytest.mark.parametrize("refused", [False, True])
def test_of_a_mission_that_never_began_the_older_files_stay(old: Path, refused: bool) -> None:
    made(old).give_up(refused=refused)
    assert content(old.parent) == {"good.mcap": "old", "good.tlog": "old frames"}


def test_files_beside_older_ones_are_removed_even_if_the_recorder_never_said_that_it_began(old: Path) -> None:
    files = made(old)
    files.made_if(False)
    files.give_up(refused=False)
    assert content(old.parent) == {"good.mcap": "old", "good.tlog": "old frames"}


def test_files_that_no_recorder_of_ours_has_made_are_not_removed(tmp_path: Path) -> None:
    files = RecordFiles(tmp_path / "good.mcap")
    files.prepare(force=False)
    (tmp_path / "good.mcap").write_text("another launch's")
    files.give_up(refused=True)
    assert content(tmp_path) == {"good.mcap": "another launch's"}


def test_a_record_that_cannot_take_the_place_stays_where_it_is(old: Path) -> None:
    files = made(old)
    old.unlink()
    old.mkdir()
    beside = files.path
    assert files.take_place() == f"the record stays in {beside}: Is a directory"
    assert (files.path, beside.read_text()) == (beside, "new")


def test_a_summary_that_does_not_fit_on_the_disk_leaves_no_part_of_it(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            write_summary(tmp_path / "runs" / "one.json", {"about": "x" * 1000}, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [*(tmp_path / "runs").iterdir()] == []
