"""Protects what a shell sees: results on stdout, tables as wide as the terminal, and a quiet end where
nobody reads on.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from link.bus.session import Bus
from tests.system.live import run_agent, run_sitl
from tests.system.screen import on_terminal

LOG = str(Path(__file__).parents[1] / "golden" / "homing-gaussian.mcap")
EVALUATE = (
    "agent",
    "evaluate",
    "--policy",
    "greedy,space-aware-infotaxis",
    "--scenarios",
    "2",
    "--particles",
    "100",
    "--budget",
    "40",
    "--workers",
    "1",
)
NOWHERE = "tcp/127.0.0.1:1"
COMMANDS = {
    "log": ("sitl", "log", LOG),
    "log --csv": ("sitl", "log", LOG, "--csv", "belief"),
    "log --json": ("sitl", "log", LOG, "--json"),
    "rollout": ("agent", "rollout", "--budget", "3"),
    "rollout --json": ("agent", "rollout", "--budget", "3", "--json", "--trace"),
    "evaluate": EVALUATE,
    "status": ("sitl", "status", "--connect", NOWHERE),
}


def ended(*arguments: str, cwd: Path, **streams: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", *arguments],
        text=True,
        cwd=cwd,
        timeout=400,
        **{"stderr": subprocess.PIPE, **streams},
    )


@pytest.mark.parametrize(
    ("name", "unbuffered"),
    [
        pytest.param(
            name,
            unbuffered,
            marks=() if (name, unbuffered) in (("log", ""), ("log", "1")) else pytest.mark.full,
        )
        for name in COMMANDS
        for unbuffered in ("", "1")
    ],
)
def test_a_reader_who_leaves_ends_a_command_quietly(
    name: str, unbuffered: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    command = [sys.executable, "-m", *COMMANDS[name]]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path, text=True
    )
    assert process.stdout is not None
    process.stdout.close()
    _, err = process.communicate(timeout=400)
    assert process.returncode == 141, err  # 128 + SIGPIPE
    assert "Traceback" not in err
    assert "BrokenPipeError" not in err


@pytest.mark.full
def test_a_reader_who_leaves_stderr_and_stdout_ends_a_command_as_well(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", *EVALUATE], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=tmp_path
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait(400) == 141


@pytest.mark.parametrize(
    "name",
    [name if name == "log" else pytest.param(name, marks=pytest.mark.full) for name in COMMANDS],
)
def test_a_full_disk_is_one_line_and_status_1(name: str, tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        command = ended(*COMMANDS[name], cwd=tmp_path, stdout=full)
    assert command.returncode == 1
    assert command.stderr.splitlines()[-1] == "error: No space left on device"
    assert "Traceback" not in command.stderr


def test_a_failure_of_something_else_is_no_silent_end(tmp_path: Path) -> None:
    code = "from link import cli\ndef broken(): raise BrokenPipeError(32, 'Broken pipe')\ncli.run(broken)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=400)
    assert done.returncode == 1
    assert done.stderr.endswith("BrokenPipeError: [Errno 32] Broken pipe\n")


@pytest.mark.parametrize(
    ("name", "result"),
    [
        ("rollout", "not ceased"),
        pytest.param("evaluate", "space-aware-infotaxis  ", marks=pytest.mark.full),
        ("log", "longest pause, s"),
    ],
)
def test_results_go_to_stdout_and_with_json_only_the_json(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    name: str,
    result: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    package, *words = COMMANDS[name]
    run = {"agent": run_agent, "sitl": run_sitl}[package]
    status, out, err = run(monkeypatch, capsys, *words)
    assert status == 0
    assert result in "\n".join(out)
    assert result not in "\n".join(err)
    status, (line,), err = run(monkeypatch, capsys, *words, "--json")
    assert status == 0
    assert isinstance(json.loads(line), dict)
    assert result in "\n".join(err)


@pytest.mark.full
def test_a_file_holds_the_whole_table_and_the_progress_is_not_in_it(tmp_path: Path) -> None:
    done = ended(*EVALUATE, "--threshold", "0.5,2", cwd=tmp_path, stdout=subprocess.PIPE)
    caption, heads, *rows = done.stdout.splitlines()
    assert caption == "N = 100, assume field, 2 missions each, [95% interval]"
    for head in (
        "policy",
        "ζ, m",
        "ceased, %",
        "located, %",
        "false stop, %",
        "MTD, m",
        "MTD, floors",
        "ST, s",
        "decision, ms",
    ):
        assert head in heads
    assert [row.split()[:2] for row in rows] == [
        [name, each] for name in ("greedy", "space-aware-infotaxis") for each in ("0.5", "2")
    ]
    assert done.stderr.splitlines()[0] == "starting 1 worker for 4 missions"


@pytest.mark.full
@pytest.mark.parametrize(
    "columns", [60, *(pytest.param(columns, marks=pytest.mark.full) for columns in (40, 80, 100, 200))]
)
def test_a_table_of_figures_fits_the_terminal_and_names_what_it_leaves_out(
    columns: int, tmp_path: Path
) -> None:
    status, lines = on_terminal(columns, *EVALUATE, cwd=tmp_path)
    assert status == 0
    assert lines[0].startswith("starting 1 worker")
    assert max(map(len, lines)) <= columns
    text = " ".join(" ".join(lines).split())
    shown, _, left_out = text.partition("left out: ")
    for figure in ("ceased", "located", "false stop", "MTD", "MTD in floors", "ST", "decision"):
        head = {"MTD in floors": "floors"}.get(figure, figure)
        assert (f"{head}, " in shown or f" {head} " in shown) != (
            f"{figure}," in left_out or f"{figure} (" in left_out
        ), figure
    assert ("--json" in left_out) == bool(left_out) == (columns < 200)
    assert "located" in shown


@pytest.mark.parametrize("columns", [60, 80])
def test_the_summary_of_a_log_fits_the_terminal(columns: int, tmp_path: Path) -> None:
    status, lines = on_terminal(columns, "sitl", "log", LOG, cwd=tmp_path)
    assert status == 0
    assert max(map(len, lines)) <= columns
    rows = {line.split()[0]: line.split() for line in lines}
    assert int(rows["belief"][1]) == int(rows["reading"][1]) > 1


@pytest.mark.parametrize("columns", [60, pytest.param(80, marks=pytest.mark.full)])
def test_a_status_fits_the_terminal_and_says_below_the_table_what_is_wrong(
    router: str, columns: int, tmp_path: Path
) -> None:
    with Bus("estimator", router) as bus:
        bus.tally.state, bus.tally.about = "ready", "1000 particles over x y q u phi d tau, stop below 0.5 m"
        bus.tally.warnings = ("a warning of many words " * 5,)
        bus.publish_health()
        status, lines = on_terminal(
            columns, "sitl", "status", "--connect", router, "--parts", "estimator,agent", cwd=tmp_path
        )
    assert status == 1
    assert max(map(len, lines)) <= columns
    (estimator,) = (line for line in lines if line.startswith("estimator  "))
    assert "ready: 1000 particle" in estimator
    assert "…" in estimator
    assert " ".join(" ".join(lines).split()).count("a warning of many words") == 5
