"""Protects secured missions: with certificates the same is flown, replayed and shown, and
compose.secure.yaml flies.
"""

import datetime
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from agent.trials.rollout import mission
from link.access.authority import make
from plume.problems.fleet import Fleet
from tests.system.conftest import Part
from tests.system.live import run_agent

ROOT = Path(__file__).parents[2]
EXPIRED = "the certificate router expired on "
PLAIN, SECURE = (
    YAML(typ="safe").load(ROOT / name)["services"] for name in ("compose.yaml", "compose.secure.yaml")
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("certificates")
    make(path, [1, 2])
    make(path, [1, 2], search=1)
    return path


def run(cwd: Path, *words: str, status: int = 0) -> subprocess.CompletedProcess[str]:
    ran = subprocess.run([sys.executable, "-m", *words], capture_output=True, text=True, cwd=cwd, timeout=110)
    assert ran.returncode == status, ran.stderr
    return ran


def test_a_secured_mission_is_the_same_also_when_the_router_restarts(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = str(ROOT / "missions" / "router-restart.yaml")
    flown = run(
        tmp_path,
        "sitl",
        "fly",
        script,
        "--speedup",
        "0",
        "--secure",
        str(folder),
        "--no-record",
        "--json",
        "--trace",
    )
    secured = json.loads(flown.stdout.splitlines()[-1])
    assert "router killed at step 7" in flown.stderr
    assert "no right to" not in flown.stderr
    status, out, err = run_agent(monkeypatch, capsys, "rollout", "--seed", "2", "--json", "--trace")
    assert status == 0, err
    assert secured["trace"] == json.loads(out[-1])["trace"]


LOSING = """
{seed: 4, speedup: 0, fleet: {vehicles: 2, formation: corners}, agent: {budget: 6},
events: [{step: 2, do: return, vehicle: 2}]}
"""


@pytest.mark.full
def test_a_secured_search_by_two_that_one_leaves_is_the_same_and_its_record_verifies(
    tmp_path: Path, folder: Path
) -> None:
    (tmp_path / "losing.yaml").write_text(LOSING)
    secure = ["--speedup", "0", "--secure", str(folder)]
    flown = run(tmp_path, "sitl", "fly", "losing.yaml", *secure, "--record", "two.mcap", "--json", "--trace")
    assert "no right to" not in flown.stderr
    outcome = json.loads(flown.stdout.splitlines()[-1])
    (left,) = outcome["left"]
    assert left["vehicle"] == 2
    steps = mission(
        4, "homing", 1000, 0.5, budget=6, fleet=Fleet(2, "corners"), leaving={2: left["step"]}, assume="field"
    ).steps  # fmt: skip
    assert [(point["reading"], point["mean"], point["spread"]) for point in outcome["trace"]] == [
        (taken.gas, [*step.belief.mean], step.belief.spread) for step in steps for taken in step.readings
    ]
    replayed = run(tmp_path, "sitl", "replay", "two.mcap", "--verify", *secure)
    assert "verified: 7 beliefs, 0 stops, 6 waypoints" in replayed.stdout


@pytest.mark.full
def test_a_secured_replay_gives_the_recorded_answers(tmp_path: Path, folder: Path) -> None:
    record = str(ROOT / "tests" / "golden" / "greedy-hits.mcap")
    verified = run(tmp_path, "sitl", "replay", record, "--speedup", "0", "--verify", "--secure", str(folder))
    assert "verified: " in verified.stdout


@pytest.mark.full
def test_another_vehicle_joins_with_its_own_certificates(tmp_path: Path, folder: Path) -> None:
    flown = run(
        tmp_path,
        "sitl",
        "fly",
        "--instance",
        "1",
        "--seed",
        "11",
        "--speedup",
        "0",
        "--secure",
        str(folder),
        "--no-record",
        "--json",
        "--budget",
        "8",
        "--policy",
        "homing",
    )
    assert json.loads(flown.stdout.splitlines()[-1])["steps"] == 8


@pytest.mark.one_in(3)
@pytest.mark.parametrize("command", ["fly", "uav", "status", "record", "bridge", "view", "router"])
def test_a_missing_certificate_is_one_line(tmp_path: Path, command: str) -> None:
    words = {"record": ["bus.mcap"], "bridge": ["udpin:127.0.0.1:1"], "view": ["--port", "0"]}.get(
        command, []
    )
    ran = run(tmp_path, "sitl", command, *words, "--secure", "none", status=2)
    (line,) = [line for line in ran.stderr.splitlines() if "error: " in line]
    assert re.search(
        r"--secure: cannot read none/\S+: No such file or directory \(make it with: plumeward certs none",
        line,
    )


def test_a_router_whose_certificate_expires_says_so(
    start: type[Part], tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    for lasts_s in (6, 60, 300):  # a busy machine may not have started it before: then it is refused
        until = datetime.datetime.now(datetime.UTC) + datetime.timedelta(seconds=lasts_s)
        folder = tmp_path / str(lasts_s)
        make(folder, [1], days=1, now=until - datetime.timedelta(days=1))
        router = start("sitl", "router", "--listen", "tls/127.0.0.1:0", "--secure", str(folder))
        wait_until(
            lambda router=router: router.says(EXPIRED) or router.process.poll() is not None, lasts_s + 400.0
        )
        if router.says(EXPIRED) and router.process.poll() is None:
            return
    pytest.fail("it did not start before its certificate had expired")


# ---- compose.secure.yaml ----


def test_the_compose_file_is_one() -> None:
    tool = Path(sys.executable).with_name("check-jsonschema")
    if not tool.exists():
        pytest.skip("check-jsonschema is not installed")
    subprocess.run(
        [tool, "--builtin-schema", "vendor.compose-spec", ROOT / "compose.secure.yaml"],
        check=True,
        capture_output=True,
    )


def test_every_part_of_the_mission_is_secured() -> None:
    assert set(SECURE) == {*PLAIN, "certs"}
    for name, service in SECURE.items():
        if name != "certs":
            assert service["command"][service["command"].index("--secure") + 1] == "/data/certs"
            assert service["volumes"] == ["certs:/data/certs:ro"]
            assert not any(
                word.startswith("tcp/") for word in (*service["command"], *service["healthcheck"]["test"])
            )
    for name in ("estimator", "agent", "uav"):
        plain = [word.replace("tcp/router", "tls/router") for word in PLAIN[name]["command"]]
        secured = SECURE[name]["command"]
        at = secured.index("--secure")
        assert [*secured[:at], *secured[at + 2 :]] == plain
    assert SECURE["router"]["depends_on"] == {"certs": {"condition": "service_completed_successfully"}}
    assert "ports" not in str(SECURE)


def test_nobody_who_makes_keys_is_root_or_gains_rights() -> None:
    certs = SECURE["certs"]
    assert (certs["read_only"], certs["cap_drop"], certs["security_opt"]) == (
        True,
        ["ALL"],
        ["no-new-privileges:true"],
    )
    assert not SECURE["router"]["user"].startswith("0")


def words_of(command: list[str], folder: Path, endpoint: str) -> list[str]:
    """A command of the compose file as it runs here: its folder and its router's address are ours."""
    words = [
        str(folder) if word == "/data/certs" else re.sub(r"^tls/router:7447$", endpoint, word)
        for word in command
    ]
    words = (
        words[2:] if words[:2] == ["python", "-m"] else [{"certs": "link"}.get(words[1], "sitl"), *words[1:]]
    )
    return [sys.executable, "-m", *words]


@pytest.mark.full
def test_the_commands_of_the_compose_file_fly_a_mission(
    tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    folder, running = tmp_path / "certs", []
    environment: dict[str, Any] = {**os.environ, "PYTHONPATH": str(ROOT)}

    def start(name: str, endpoint: str, *more: str) -> subprocess.Popen[str]:
        words = [*words_of(SECURE[name]["command"], folder, endpoint), *more]
        part = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment
        )
        running.append(part)
        return part

    try:
        assert start("certs", "").wait(400) == 0
        router = start("router", "", "--listen", "tls/127.0.0.1:0")
        assert router.stdout
        endpoint = router.stdout.readline().strip()
        said: list[str] = []
        assert router.stderr
        listening = threading.Thread(target=lambda: said.extend(router.stderr or ()), daemon=True)
        listening.start()
        for name in ("estimator", "agent"):
            start(name, endpoint)
            check = words_of(SECURE[name]["healthcheck"]["test"][1:], folder, endpoint)
            wait_until(
                lambda check=check: (
                    subprocess.run(check, capture_output=True, cwd=tmp_path, env=environment).returncode == 0
                )
            )
        command = words_of(SECURE["uav"]["command"], folder, endpoint)
        at = command.index("--out")
        flown = subprocess.run(
            [*command[:at], "--speedup", "0", "--json"],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=environment,
            timeout=400,
        )
        assert flown.returncode == 0, flown.stderr
        assert json.loads(flown.stdout.splitlines()[-1])["located"] is True
    finally:
        for part in running:
            part.terminate()
        for part in running:
            part.communicate(timeout=400)
    listening.join(10)
    joined = {match[1] for line in said if (match := re.search(r'event="(\S+) joins from', line))}
    assert joined >= {"uav/1/estimator", "uav/1/agent", "uav/1/vehicle", "operator", "observer"}
    assert not [line for line in said if "level=warning" in line]
