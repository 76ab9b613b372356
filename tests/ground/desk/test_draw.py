"""Protects the command `draw`: a record becomes a picture or an animation, whole or not at all, and bad
input is one line.
"""

import re
import shutil
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from PIL import Image

from ground.desk import draw
from ground.desk.draw import telling
from link import cli
from scene.scene import Measurement
from sitl.__main__ import main

RECORD = Path(__file__).parents[2] / "golden" / "homing-gaussian-field.mcap"
"""30 readings."""


def drawn(*words: str) -> int:
    return cli.start("draw", cli.Command("ground.desk.draw", ""), words)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    shutil.copy(RECORD, tmp_path / "log.mcap")
    return tmp_path / "log.mcap"


def measured(*spreads_m: float) -> list[Measurement]:
    return [
        Measurement(step, 0.0, (0.0, 0.0), 0.0, spread_m, (0.0, 0.0), (1.0, 0.0, 1.0))
        for step, spread_m in enumerate(spreads_m)
    ]


def test_beliefs_are_shown_when_the_spread_has_fallen_by_a_third_by_two_thirds_and_last() -> None:
    assert telling(measured(10.0, 9.0, 7.5, 6.9, 4.0, 3.5, 1.0)) == [3, 4, 6]  # from 10 to 1: below 7 and 4
    assert telling(measured(10.0, 10.0, 1.0, 0.9)) == [2, 3]
    assert telling(measured(10.0, 4.0, 11.0)) == [0, 2]  # it has grown: there is no third of the way down
    assert telling(measured(5.0)) == [0]


@pytest.mark.slow
def test_the_picture_lies_beside_the_log_and_is_not_written_over_unasked(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments=["draw", str(log)]) == 0
    picture = log.with_suffix(".png")
    assert capsys.readouterr().out == f"{picture}\n"
    with Image.open(picture) as image:
        assert image.size == (1440, 810)
    before = picture.read_bytes()
    assert drawn(str(log), "--at", "3,20") == 2
    assert capsys.readouterr().err == f"error: --out: '{picture}' exists; wanted another name, or --force\n"
    assert picture.read_bytes() == before
    assert drawn(str(log), "--at", "3,20", "--force") == 0
    assert picture.read_bytes() != before


@pytest.mark.slow
def test_an_animation_has_a_frame_for_each_reading_and_needs_no_picture(log: Path) -> None:
    assert drawn(str(log), "--gif", str(log.with_name("a.gif"))) == 0
    assert {path.name for path in log.parent.iterdir()} == {"log.mcap", "a.gif"}
    with Image.open(log.with_name("a.gif")) as gif:
        assert (gif.n_frames, gif.size) == (35, (960, 540))


def test_an_interrupt_leaves_what_was_there_and_nothing_half_written(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(frames: object, path: Path) -> None:
        path.write_bytes(b"GIF8")
        raise KeyboardInterrupt

    monkeypatch.setattr(draw, "write_gif", interrupted)
    log.with_name("a.gif").write_bytes(b"mine")
    with pytest.raises(KeyboardInterrupt):
        drawn(str(log), "--gif", str(log.with_name("a.gif")), "--force")
    assert {path.name for path in log.parent.iterdir()} == {"log.mcap", "a.gif"}
    assert log.with_name("a.gif").read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["--at", "40"], "error: --at: 40 is not allowed; wanted steps of the log, 0 to 34\n"),
        (["--at", "1,2,3,4,5,6"], "error: --at: 6 steps are not allowed; wanted at most 5\n"),
        (
            ["--gif", "/proc/a.gif"],
            "error: --gif: '/proc/a.gif' cannot be written: No such file or directory\n",
        ),
        (
            ["--out", "nowhere/a.png"],
            "error: --out: 'nowhere/a.png' cannot be written: No such file or directory\n",
        ),
    ],
)
def test_what_cannot_be_drawn_is_one_line(
    log: Path, capsys: pytest.CaptureFixture[str], words: list[str], error: str
) -> None:
    assert drawn(str(log), *words) == 2
    assert capsys.readouterr() == ("", error)


def test_a_folder_is_no_log(capsys: pytest.CaptureFixture[str]) -> None:
    assert drawn(".") == 2
    assert capsys.readouterr().err.startswith("error: . is a folder; wanted a file")


def test_a_file_without_a_belief_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.mcap").write_text("milk, bread")
    for name in ("nowhere.mcap", "notes.mcap"):
        assert drawn(str(tmp_path / name)) == 2
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        assert name in err
    assert [path.name for path in tmp_path.iterdir()] == ["notes.mcap"]


@pytest.mark.slow
def test_a_log_that_was_cut_off_is_drawn_with_a_warning(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert drawn(str(log)) == 0
    assert capsys.readouterr().err == ""
    log.write_bytes(log.read_bytes()[:-100])  # its beliefs are there, its end is not
    assert drawn(str(log), "--force") == 0
    out, err = capsys.readouterr()
    assert out == f"{log.with_suffix('.png')}\n"
    assert err == f"warning: {log} is cut off, damaged or still being written: what follows is missing\n"


def test_what_is_not_installed_is_named(
    log: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    assert drawn(str(log), "--mp4", "a.mp4") == 1
    assert (
        capsys.readouterr().err
        == "error: --mp4 needs the program ffmpeg, which is not installed; --gif needs nothing more\n"
    )
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert drawn(str(log)) == 1
    assert capsys.readouterr().err == "error: draw needs matplotlib: pip install 'plumeward[view]'\n"


def in_small_chunks(log: Path) -> bytearray:
    """The same messages, in chunks of a few: one that is damaged is then not all of them."""
    with log.open("rb") as file, log.with_name("small.mcap").open("wb") as small:
        reader, writer = make_reader(file), Writer(small, chunk_size=16384)
        writer.start(reader.get_header().profile)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        channels: dict[int, int] = {}
        for _, channel, message in reader.iter_messages(log_time_order=False):
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, 0, channel.metadata
                )
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()
    return bytearray(log.with_name("small.mcap").read_bytes())


@pytest.mark.slow
def test_a_damaged_log_is_drawn_without_what_is_missing_and_has_a_status_of_its_own(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = in_small_chunks(log)
    chunks = [match.start() for match in re.finditer(b"\x04\x00\x00\x00zstd", whole)]
    at = chunks[len(chunks) // 4] + 40  # the other half are of the index
    whole[at : at + 16] = bytes(16)
    log.write_bytes(whole)
    assert drawn(str(log)) == 1
    out, err = capsys.readouterr()
    assert out == f"{log.with_suffix('.png')}\n"
    assert f"warning: {log} is damaged, and lacks " in err
