"""Protects the command `findings`: a record becomes a folder of documents, and bad input is one line."""

import json
import shutil
from pathlib import Path

import msgspec
import pytest

from ground.findings import command
from ground.findings.documents import DOCUMENTS
from link import cli
from sitl.launch.recording import FINDINGS
from tests.ground.findings.records import FOUND, believing, rewritten


def written(*words: str) -> int:
    return cli.start("findings", cli.Command("ground.findings.command", ""), words)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    shutil.copy(FOUND, tmp_path / "log.mcap")
    return tmp_path / "log.mcap"


def test_the_documents_lie_beside_the_record_and_are_not_written_over_unasked(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert written(str(log)) == 0
    folder = log.with_name("log-findings")
    assert sorted(path.name for path in folder.iterdir()) == sorted(DOCUMENTS)
    before = (folder / "findings.html").read_bytes()
    capsys.readouterr()
    assert written(str(log)) == 2
    assert capsys.readouterr().err == (
        f"error: --out: {str(folder / 'findings.html')!r} exists; wanted another name, or --force\n"
    )
    assert (folder / "findings.html").read_bytes() == before
    assert written(str(log), "--force") == 0


def test_the_json_is_one_line_on_stdout(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert written(str(log), "--json") == 0
    [line] = capsys.readouterr().out.splitlines()
    said = json.loads(line)
    assert said["verdict"] in ("found", "doubtful")
    assert said == json.loads((log.with_name("log-findings") / "findings.json").read_text())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["none.mcap"], "none.mcap: No such file or directory"),
        (["empty.mcap"], "empty.mcap is empty"),
        (["."], ". is a folder; wanted a file"),
        (
            ["cut.mcap"],
            "cut.mcap has no belief that can be read: it is cut off, damaged or still being written",
        ),
        (["text.tlog"], "plumeward replay text.tlog --findings DIR"),
        (["log.mcap", "--bounds", "1,2,3,4"], "--bounds: only with --background"),
        (["log.mcap", "--background", "none.png"], "--background: none.png: No such file"),
        (["log.mcap", "--out", "text.tlog"], "--out: 'text.tlog' is not a folder"),
    ],
    ids=lambda it: it[-1] if isinstance(it, list) else "",
)
def test_bad_input_is_one_line(
    log: Path,
    words: list[str],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(log.parent)
    Path("empty.mcap").touch()
    Path("cut.mcap").write_bytes(log.read_bytes()[:3000])
    Path("text.tlog").write_text("no record")
    assert written(*words) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    "bounds", ["1,2,3", "9,47,8,48", "179,1,-179,2", "9,47,370,48", "8,48,9,47", "a,b,c,d", "8,47,nan,48"]
)
def test_bounds_are_west_south_east_north(log: Path, bounds: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        written(str(log), "--background", "x.png", "--bounds", bounds)
    assert "wanted WEST,SOUTH,EAST,NORTH" in capsys.readouterr().err


def test_a_record_that_is_cut_off_gives_what_it_has_and_says_so(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = log.read_bytes()
    log.write_bytes(data[: len(data) // 2])
    status = written(str(log), "--force")
    told = capsys.readouterr().err
    if status != 2:  # some of its beliefs could be read
        assert "warning: " in told
        assert "the record" in (log.with_name("log-findings") / "findings.html").read_text()
    assert [line.partition(": ")[0] for line in told.splitlines() if ": " in line] == [
        "error" if status == 2 else "warning"
    ]


def test_a_file_that_is_no_record_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("noise.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(500))
    assert written("noise.mcap") == written("none.mcap") == 2
    capsys.readouterr()
    assert [path.name for path in tmp_path.iterdir()] == ["noise.mcap"]


def not_ceased(log: Path) -> str:
    """The record of a flight that found nothing."""
    path = log.with_name("nothing.mcap")
    return str(rewritten(path, believing(lambda belief: msgspec.structs.replace(belief, ceased=False))))


def test_of_a_flight_that_found_nothing_it_says_that_it_looks_for_the_smallest_rates(
    log: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of thousands of readings that takes minutes."""
    assert written(not_ceased(log), "--json") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["smallest_rate"]["cells"]
    assert err.startswith("looking for the smallest rate that would have been seen, at 225 places\n")
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes it for a terminal
    assert written(not_ceased(log), "--json", "--force") == 0
    again, err = capsys.readouterr()
    assert json.loads(again)["smallest_rate"] == json.loads(out)["smallest_rate"]
    assert "100%" in err


def test_an_interrupt_leaves_no_folder(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        assert log.with_name("log-findings").is_dir()
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "findings_of", interrupted)
    with pytest.raises(KeyboardInterrupt):
        written(str(log))
    assert [path.name for path in log.parent.iterdir()] == ["log.mcap"]


def test_fly_looks_for_the_files_that_findings_writes() -> None:
    assert tuple(DOCUMENTS) == FINDINGS
