"""Protects the command `report`: from the missions of `evaluate` to a page, and its errors."""

import os
from pathlib import Path

import pytest

from tests.system.live import run_agent


@pytest.mark.full
def test_it_makes_a_page_of_what_evaluate_wrote(start, tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    flags = (
        "--policy",
        "greedy",
        "--scenarios",
        "2",
        "--particles",
        "20",
        "--workers",
        "1",
        "--missions",
        "results/greedy.csv",
    )
    assert start("agent", "evaluate", *flags, cwd=tmp_path).ended() == 0
    report = start("agent", "report", cwd=tmp_path)
    assert report.ended() == 0, "".join(report.err)
    assert report.says("flying 100 missions of greedy")
    assert report.out[-1] == "report/index.html\n"
    assert "| 20 | 0.5 | greedy | 2 |" in (tmp_path / "report" / "results.md").read_text()
    assert (tmp_path / "report" / "hundred.png").read_bytes().startswith(b"\x89PNG")
    again = start("agent", "report", cwd=tmp_path)
    assert again.ended() == 2
    assert again.err == ["error: --out: 'report/particles.png' exists; wanted another name, or --force\n"]


@pytest.mark.timeout(400)
def test_bad_input_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "shopping.csv").write_text("what,many\neggs,6\n")
    (tmp_path / "file").touch()
    for name in ("pipe", "folder", "link"):
        (tmp_path / name).mkdir()
    os.mkfifo(tmp_path / "pipe" / "a.csv")  # nobody writes to it
    (tmp_path / "folder" / "a.csv").mkdir()
    (tmp_path / "link" / "a.csv").symlink_to("nowhere.csv")
    for flags, error in (
        (
            ("--results", "nowhere"),
            "error: --results: no such folder: 'nowhere'; `plumeward evaluate --missions FILE.csv` writes",
        ),
        (
            ("--results", "empty"),
            "error: --results: no missions in 'empty'; `plumeward evaluate --missions FILE.csv` writes",
        ),
        (("--results", "other"), "error: --results: other/shopping.csv: "),
        (("--results", "pipe"), "error: --results: pipe/a.csv: not a file; wanted one"),
        (("--results", "folder"), "error: --results: folder/a.csv: not a file; wanted one"),
        (("--results", "link"), "error: --results: link/a.csv: No such file or directory"),
        (("--report", "empty"), "error: no flag '--report'"),
    ):
        status, out, (line,) = run_agent(monkeypatch, capsys, "report", *flags)
        assert (status, out) == (2, [])
        assert error in line
