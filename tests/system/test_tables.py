"""Protects `plumeward replay FLIGHT.csv` from end to end: a table ends in a record from which the same beliefs
follow again, and what cannot be done with it is one line, before anything starts.
"""

import json
from pathlib import Path

import pytest

from link.record.reader import read
from tests.ground.logs.flights import Plume, gasflux
from tests.system.live import run_sitl

FEW = ("--speedup", "0", "--every", "10", "--particles", "100")


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    return gasflux(tmp_path / "flight.csv", Plume())


@pytest.mark.full
def test_a_table_ends_in_a_record_that_is_enough(start, flight: Path) -> None:
    record = flight.with_suffix(".mcap")
    replay = start("sitl", "replay", str(flight), *FEW, "--record", str(record), "--json")
    assert replay.ended() == 0, "".join(replay.err)
    result = json.loads(replay.out[-1])
    assert replay.says("replay: background: ")
    assert replay.says(f"record   {record}")
    recording = read(record)
    assert recording.complete
    assert recording.about["log"]["file"] == "flight.csv"
    beliefs = {json.loads(entry.payload)["step"] for entry in recording.entries if entry.key == "belief"}
    assert beliefs == set(range(result["beliefs"]))
    again = start("sitl", "replay", str(record), "--verify", "--speedup", "0", "--json")
    assert again.ended() == 0, "".join(again.err)
    assert json.loads(again.out[-1])["estimate"] == result["estimate"]


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--sysid", "1"], "error: --sysid: not allowed with {0}: it is a table"),
        (["--gas", "CH4"], "error: --gas: not allowed with {0}: it is a table"),
        (["--plume", "lawnmower"], "error: --plume: not allowed with {0}: it is a table"),
        (["--columns", "skyhub"], "error: {0}, row 1: no column 'Date' for date; wanted one of timestamp, "),
        (["--ray", "5"], "error: --ray: not allowed with gas in ppm; "),
        (["--every", "0.01"], "error: --every: 0.01 s is not allowed with {0}; wanted 0.05 s or more"),
        (["--area", "3"], "error: {0}: none of its "),
        (
            ["--loop", "--record", "x.mcap"],
            "error: --record: only allowed with one replay of a log of others",
        ),
        (["--loop", "--findings", "x"], "error: --findings: not with --loop, which never comes to an end"),
        (["--wind", "2,inf"], "error: wind 2,inf is not allowed; wanted a speed from 0 to "),
        (
            ["--background", "inf"],
            "python -m sitl replay: error: --background: 'inf' is not allowed; wanted a ",
        ),
        (
            ["--record", "x.bag"],
            "python -m sitl replay: error: --record: 'x.bag' is not allowed; wanted a file",
        ),
        (["--verify"], "error: --verify: not allowed with {0}: "),
    ],
)
def test_what_cannot_be_done_with_it_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    flight: Path,
    flags: list[str],
    words: str,
) -> None:
    status, out, err = run_sitl(monkeypatch, capsys, "replay", str(flight), *flags)
    assert (status, out, len(err)) == (2, [], 1), err
    assert err[0].startswith(words.format(flight))


def test_a_record_that_exists_is_not_overwritten(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], flight: Path
) -> None:
    record = flight.with_suffix(".mcap")
    record.write_bytes(b"mine")
    status, _, err = run_sitl(monkeypatch, capsys, "replay", str(flight), *FEW, "--record", str(record))
    assert (status, err) == (2, [f"error: --record: '{record}' exists; wanted another name, or --force"])
    assert record.read_bytes() == b"mine"
