"""Protects the command `plumeward`: help that is quick, near misses, and refusals before anything starts."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from link.bus.mavlink import Codec, gas_message
from plume import __version__
from plume.sensors.names import KINDS, Sensor, parse
from plume.worlds import errors
from plumeward.commands import COMMANDS, GROUPS, KNOWN, main

ROOT = Path(__file__).parents[2]
MISSIONS = {path.stem: path.read_text() for path in (ROOT / "missions").glob("*.yaml")}
HEAVY = ("gymnasium", "numba", "torch", "onnxruntime", "matplotlib", "ray", "onnx", "stable_baselines3")


def said(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str
) -> tuple[int, str, str]:
    """Run the command in this process; returns its status, stdout and stderr."""
    monkeypatch.setattr(sys, "argv", ["plumeward", *words])
    try:
        status = main() or 0
    except SystemExit as end:
        status = int(str(end.code or 0))
    return status, *capsys.readouterr()


def test_the_help_lists_every_command_in_a_group_within_80_columns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    status, out, err = said(capsys, monkeypatch, "--help")
    assert (status, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    assert re.findall(r"^  (\w[\w-]*) +", out, re.MULTILINE) == list(COMMANDS)
    assert [line for line in out.splitlines() if line.removesuffix(":") in GROUPS] == [
        f"{group}:" for group in GROUPS
    ]
    assert 'eval "$(register-python-argcomplete plumeward)"' in out
    assert said(capsys, monkeypatch)[1] == out
    assert said(capsys, monkeypatch, "--version") == (0, f"plumeward {__version__}\n", "")


@pytest.mark.one_in(4)
@pytest.mark.slow
@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_loads_nothing_that_takes_long(tmp_path: Path, command: str) -> None:
    words = ["plumeward", *([command] if command else []), "--help"]
    code = (
        f"import atexit, sys; sys.argv = {words}; loaded = lambda: sorted(set({HEAVY}) & set(sys.modules))\n"
        "atexit.register(lambda: print('loaded', loaded())); from plumeward.__main__ import command; "
        "command()"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=400
    )
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout.startswith(f"usage: {' '.join(words[:-1])} ")
    assert ran.stdout.endswith("loaded []\n")


def test_the_help_groups_the_commands_by_what_people_want() -> None:
    assert list(GROUPS) == [
        "Fly a mission",
        "Look while it flies",
        "Analyse a flight",
        "Do research",
        "Operate parts by themselves",
    ]
    assert sorted(name for names in GROUPS.values() for name in names) == sorted(KNOWN)
    assert GROUPS["Fly a mission"][0] == "fly"


def test_the_commands_own_help_loads_not_even_the_bus(tmp_path: Path) -> None:
    code = (
        "import atexit, sys; sys.argv = ['plumeward', '--help']\n"
        "atexit.register(lambda: print(sorted({'numpy', 'gymnasium', 'zenoh', 'msgspec', 'logging', "
        "'asyncio'} & set(sys.modules))))\n"
        "from plumeward.__main__ import command; command()"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=400, check=True
    )
    assert ran.stdout.endswith("\n[]\n")


def test_what_there_is_to_choose_from_is_listed_by_name(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    status, everything, _ = said(capsys, monkeypatch, "list")
    assert status == 0
    assert max(map(len, everything.splitlines())) <= 80
    kinds = ("missions", "policies", "sensors", "assumptions", "worlds")
    lists = [said(capsys, monkeypatch, "list", what)[1] for what in kinds]
    assert "\n".join(lists) == everything
    missions, policies, sensors, assumptions, worlds = (
        dict(re.findall(r"^  (\S+) +(.+)$", text, re.MULTILINE)) for text in lists
    )
    assert set(missions) == set(MISSIONS)
    for name, about in missions.items():
        assert f"about: {about}" in MISSIONS[name]
    assert {"homing", "infotaxis", "space-aware-infotaxis", "ppo", "dqn", "ddpg"} <= set(policies)
    kinds: list[Sensor] = [parse(text) for text in sensors]  # as --sensor takes them
    assert kinds == [*KINDS.values()]
    assert list(worlds) == ["as-modelled", "puffs", "walls", "recorded", *errors.WRONG]
    assert set(assumptions) == {"paper", "field"}


def test_what_a_terminal_cannot_show_is_printed_in_ascii() -> None:
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, "-m", "plumeward", "list", "sensors"]
    ran = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=400, encoding="ascii"
    )
    assert (ran.returncode, ran.stderr) == (0, "")
    assert "Gaussian noise, g/m\\xb3" in ran.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("most", "words", "status", "said"),
    [
        (
            30,
            "fly",
            2,
            "error: only 30 files may be open at a time; wanted 64 at least (set it with: ulimit -n 1024)",
        ),
        (
            8,
            "fly",
            1,
            "error: Too many open files: wanted more than the 8 that may be open at a time (set it with: "
            "ulimit",
        ),
        (
            20,
            "evaluate --scenarios 8 --policy random --budget 1 --workers 8",
            1,
            "error: Too many open files: wanted more than the 20 ",
        ),
    ],
)
def test_too_few_open_files_are_told_in_one_line_with_what_to_set(
    tmp_path: Path, most: int, words: str, status: int, said: str
) -> None:
    command = f"ulimit -n {most}; exec {sys.executable} -m plumeward {words}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run(
        ["bash", "-c", command], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    assert (ran.returncode, ran.stdout) == (status, "")
    assert ran.stderr.splitlines()[-1].startswith(said)
    assert "Traceback" not in ran.stderr


WRONG = [
    (["flyy"], "plumeward: error: no command 'flyy'; did you mean 'fly'?"),
    (["juggle"], "plumeward: error: no command 'juggle'; wanted fly, list, view, status, "),
    (
        ["list", "mission"],
        "plumeward list: error: what: 'mission' is not allowed; did you mean 'missions'? Wanted missions, "
        "policies, ",
    ),
    (["fly", "--polcy", "homing"], "plumeward fly: error: no flag '--polcy'; did you mean '--policy'?"),
    (
        ["fly", "--world", "wind-3"],
        "plumeward fly: error: --world: no world 'wind-3'; did you mean 'wind-30'? Wanted as-modelled, "
        "puffs, walls, recorded, wind-10, ",
    ),
    (
        ["rollout", "--world", "wind"],
        "plumeward rollout: error: --world: no world 'wind'; did you mean 'wind-",
    ),
    (
        ["evaluate", "--world", "cv-1,x"],
        "plumeward evaluate: error: --world: no world 'x'; wanted as-modelled, puffs, walls, recorded, wind-10, wind-30, ",
    ),
    (
        ["rollout", "--world", "wind-30+puffs:share=2"],
        "plumeward rollout: error: --world: world 'wind-30+puffs:share=2' is not allowed: share is 2; wanted ",
    ),
    (["fly", "--qqq=3"], "plumeward fly: error: no flag '--qqq'; plumeward fly --help lists them"),
    (["agent", "--polcy", "homing"], "plumeward agent: error: no flag '--polcy'; did you mean '--policy'?"),
    (
        ["estimator", "--particels", "5"],
        "plumeward estimator: error: no flag '--particels'; did you mean '--particles'?",
    ),
    (
        ["replay", "--speed-up", "3"],
        "plumeward replay: error: no flag '--speed-up'; did you mean '--speedup'?",
    ),
    (["fly", "wind-shift", "now"], "plumeward fly: error: 'now' is not expected here"),
    (
        ["fly", "--policy", "homming"],
        "plumeward fly: error: --policy: 'homming' is not allowed; did you mean 'homing'? Wanted infotaxis, ",
    ),
    (
        ["fly", "--policy", "missing.zip"],
        "plumeward fly: error: --policy: missing.zip: there is no such file",
    ),
    (["fly", "--policy", "empty.zip"], "plumeward fly: error: --policy: empty.zip: no"),
    (
        ["fly", "--policy", "none"],
        "error: --policy: 'none' is not allowed; wanted a policy, or a mission that scripts all its "
        "waypoints",
    ),
    (
        ["fly", "homming.yaml"],
        "error: homming.yaml:2: agent.policy: 'homming' is not allowed; did you mean 'homing'? Wanted "
        "infotaxis, ",
    ),
    (
        ["fly", "wnd-shift"],
        "error: wnd-shift: no such file and no shipped mission; did you mean 'wind-shift'? Wanted a mission ",
    ),
    (["fly", "list.yaml"], "error: list.yaml:1: "),
    (
        ["fly", "--sensor", "gausian"],
        "plumeward fly: error: --sensor: 'gausian' is not allowed; did you mean 'gaussian'? Wanted ",
    ),
    (["fly", "--sensor", "hits:0"], "plumeward fly: error: --sensor: 'hits:0' is not allowed; "),
    (
        ["fly", "--assume", "feild"],
        "plumeward fly: error: --assume: 'feild' is not allowed; did you mean 'field'? Wanted field or paper",
    ),
    (
        ["evaluate", "--assume", "all"],
        "plumeward evaluate: error: --assume: 'all' is not allowed; wanted field or paper",
    ),
    (
        ["fly", "--stop", "spread:1", "--threshold", "0.5"],
        "plumeward fly: error: --threshold: not allowed with argument --stop",
    ),
    (
        ["rollout", "--stop", "within:1"],
        "plumeward rollout: error: --stop: 'within:1' is not allowed; wanted spread:Z, metres, or "
        "within:R,P, metres and a share",
    ),
    (
        ["estimator", "--stop", "within:1,1.5"],
        "plumeward estimator: error: --stop: 'within:1,1.5' is not allowed; wanted R above 0 up to ",
    ),
    (
        ["estimator", "--prior", "u=fixed:2", "--prior", "wind-speed=fixed:1"],
        "plumeward estimator: error: --prior: a prior of wind-speed is ",
    ),
    (
        ["rollout", "--sensor", "hits", "--prior", "noise=fixed:2"],
        "plumeward rollout: error: --prior: a prior of noise is not allowed with ",
    ),
    (
        ["estimator", "--rate", "1e308"],
        "plumeward estimator: error: --rate: '1e308' is not allowed; wanted a number from 0.001 up to 1e+06",
    ),
    (
        ["rollout", "--sensor", "hits:1e308"],
        "plumeward rollout: error: --sensor: 'hits:1e308' is not allowed; efficiency is 1e+308, wanted ",
    ),
    (
        ["rollout", "--prior", "q=uniform:0,1e308"],
        "plumeward rollout: error: --prior: 'q=uniform:0,1e308' is not allowed; wanted LOW below HIGH, and "
        "numbers up to 1e+12",
    ),
    (
        ["evaluate", "--prior", "q=normal:-7.9,1"],
        "plumeward evaluate: error: --prior: the prior of q excludes nearly every possible value",
    ),
    (
        ["rollout", "--vehicles", "4", "--from", "edge", "--separation", "9"],
        "plumeward rollout: error: --separation: 9 is not allowed; 4 vehicles from edge have room for 0 to 7.5 m",
    ),
    (
        ["rollout", "--vehicles", "2", "--from", "edge", "--problem", '{"start": [1, 2]}'],
        "plumeward rollout: error: --from: 'edge' is not allowed; the problem has a start: wanted point",
    ),
    (["fly", "--headings", "5"], "plumeward fly: error: --headings: 5 is not allowed; wanted 4 or 8"),
    (
        ["rollout", "--policy", "homming"],
        "plumeward rollout: error: --policy: 'homming' is not allowed; did you mean 'homing'? Wanted ",
    ),
    (
        ["evaluate", "--policy", "homing,gredy"],
        "plumeward evaluate: error: --policy: 'gredy' is not allowed; did you mean 'greedy'? ",
    ),
    (
        ["train", "pp"],
        "plumeward train: error: algorithm: 'pp' is not allowed; did you mean 'ppo'? Wanted ppo, dqn or ddpg",
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize(("words", "line"), WRONG, ids=[" ".join(words) for words, _ in WRONG])
def test_what_is_wrong_is_one_line_before_anything_starts(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    line: str,
) -> None:
    (tmp_path / "empty.zip").write_bytes(b"")
    (tmp_path / "homming.yaml").write_text("seed: 3\nagent: {policy: homming}\n")
    (tmp_path / "list.yaml").write_text("- 1\n")
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(subprocess, "Popen", None)  # nothing can be started
    status, out, err = said(capsys, monkeypatch, *words)
    assert (status, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert err.startswith(line)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_a_flag_wins_over_the_policy_of_a_script_that_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "homming.yaml").write_text("seed: 3\nagent: {policy: homming, budget: 2}\n")
    monkeypatch.chdir(tmp_path)
    status, _, err = said(
        capsys, monkeypatch, "fly", "homming.yaml", "--policy", "random", "--speedup", "0", "--no-record"
    )
    assert status == 0, err


@pytest.mark.slow
@pytest.mark.parametrize(
    "mission", ["default-release", pytest.param("default-release.yaml", marks=pytest.mark.full)]
)
def test_a_shipped_mission_is_flown_by_its_name_from_anywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], mission: str
) -> None:
    monkeypatch.chdir(tmp_path)
    status, out, err = said(capsys, monkeypatch, "fly", mission, "--speedup", "0", "--no-record", "--json")
    assert status == 0, err
    flown = json.loads(out.splitlines()[-1])
    assert (flown["policy"], flown["expectations"]) == ("homing", {"located": True})


@pytest.mark.full
def test_a_plug_in_may_make_our_environments_also_in_the_workers_of_a_sweep(tmp_path: Path) -> None:
    (tmp_path / "theirs.py").write_text(
        "import gymnasium\n\n\ndef fly(belief, particles, reach, rng):\n"
        "    gymnasium.make('plumeward/SourceSearch-v0', particles=20)\n    return 3.0, 4.0\n"
    )
    about = tmp_path / "theirs-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[plumeward.policies]\ntheirs = theirs:fly\n")
    words = [
        "evaluate",
        "--policy",
        "theirs",
        "--scenarios",
        "2",
        "--workers",
        "2",
        "--budget",
        "1",
        "--json",
    ]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    command = [str(Path(sys.executable).parent / "plumeward"), *words]
    ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=110)
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout)["theirs"]["missions"] == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "what"),
    [
        ("log", "is an ArduPilot dataflash log of 0 messages, 27 bytes skipped as garbage, but none"),
        ("replay", "is an ArduPilot dataflash log of 0 messages, 27 bytes skipped as garbage, but none"),
        ("draw", "is not an MCAP file"),
        ("view", "is not an MCAP file"),
    ],
)
def test_each_command_that_takes_a_log_calls_an_autopilots_own_what_it_is(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    what: str,
) -> None:
    """Also one that holds whole MAVLink frames by chance, as a long one does."""
    log = tmp_path / "00000042.BIN"
    log.write_bytes(b"\xa3\x95\x80\x80" + Codec(1, 1).pack(gas_message(2000, 0.5)))
    status, out, err = said(capsys, monkeypatch, command, str(log))
    assert (status, out) == (2, "")
    assert err.startswith(f"error: {log} {what}")
    assert err.count("\n") == 1
