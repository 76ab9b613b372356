"""Protects worlds of other packages: all ways to fly take the one that docs/worlds.md shows."""

import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from agent.__main__ import main
from agent.learn.env import SourceSearchVector
from agent.trials.rollout import rollout
from plume.dispersion import concentration
from plume.randomness import keyed
from plume.scenario import WorldError, draw
from plume.worlds.names import named, worlds
from plume.worlds.world import World
from plumeward.evaluation import evaluate

ROOT = Path(__file__).parents[3]
PULSED = "pulsed:period_s=7,share=0.4"


@pytest.fixture(autouse=True)
def _looked_up_anew() -> Iterator[None]:
    named.cache_clear()
    yield
    named.cache_clear()


def install(folder: Path, module: str, source: str, **names: str) -> None:
    """Install a package with worlds (NAME=FUNCTION) into a folder, as pip would."""
    (folder / f"{module}.py").write_text(source)
    said = folder / f"{module}-1.0.dist-info"
    said.mkdir()
    (said / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    lines = [f"{name} = {module}:{function}" for name, function in names.items()]
    (said / "entry_points.txt").write_text("\n".join(["[plumeward.worlds]", *lines]) + "\n")


@pytest.fixture
def pulses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the package of docs/worlds.md."""
    page = (ROOT / "docs" / "worlds.md").read_text()
    (source,) = (code for code in re.findall(r"```python\n(.+?)```", page, re.DOTALL) if "def pulsed" in code)
    install(tmp_path, "pulses", source, pulsed="pulsed")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pulses", raising=False)
    return tmp_path


def expected(seed: int, path: list[tuple[float, float]]) -> list[float]:
    """The readings along a path: the paper's plume where the leak is open, and the noise of each step. Legs
    are shorter than 8 m: half of each is flown at 3 m/s², half at −3 m/s².
    """
    s, time_s, readings = draw(seed), 0.0, []
    for step, place in enumerate(path):
        time_s += 2 * math.sqrt(math.dist(path[max(step - 1, 0)], place) / 3)
        mean = float(concentration(place, s.source, s.wind, rate=s.q, diffusivity=s.d, lifetime=s.tau)) * (
            time_s % 7 < 2.8
        )
        noise = keyed(seed, "sensor", step).standard_normal()
        readings.append(mean + noise * math.sqrt((0.3 * mean) ** 2 + 0.2**2))
    return readings


def test_rollout_environment_and_evaluate_follow_a_plug_in(pulses: Path) -> None:
    flown, trace = rollout(3, "homing", 200, budget=25, world=PULSED)
    readings = [point.reading for point in trace]
    assert readings == pytest.approx(expected(3, [point.position for point in trace]), rel=1e-6, abs=1e-6)
    assert flown.world == PULSED

    env = SourceSearchVector(num_envs=2, world=PULSED, particles=100, budget=25)
    env.reset(seed=[3, 4])
    assert env.missions is not None
    path, gas = [env.missions.positions[0].tolist()], [env.missions.measurement(0).gas]
    for action in range(12):
        env.step(np.array([action, 0]))
        path.append(env.missions.positions[0].tolist())
        gas.append(env.missions.measurement(0).gas)
    assert gas == pytest.approx(expected(3, path), rel=1e-6, abs=1e-6)

    (row,) = evaluate("homing", 1, first_seed=3, particles=200, budget=25, world=[PULSED]).values()
    assert (row["world"], row["missions"]) == (PULSED, 1)
    assert "pulsed" in worlds()


@pytest.mark.full
def test_a_mission_over_the_bus_follows_a_plug_in_to_the_bit(pulses: Path) -> None:
    chosen = ["--seed", "3", "--particles", "200", "--budget", "12", "--world", f"{PULSED}+wind-10", "--json"]
    environment = {**os.environ, "PYTHONPATH": str(pulses)}
    outs = []
    for command in (["sitl", "fly", "--speedup", "0", "--no-record"], ["agent", "rollout"]):
        done = subprocess.run(
            [sys.executable, "-m", *command, *chosen, "--trace"],
            capture_output=True,
            text=True,
            cwd=pulses,
            env=environment,
            timeout=400,
        )
        assert done.returncode == 0, done.stderr
        outs.append(json.loads(done.stdout.splitlines()[-1]))
    for out in outs:
        del out["search_time_s"]
    assert outs[0] == outs[1]


def test_the_list_shows_a_plug_in(pulses: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert worlds()["pulsed"] == (
        "a leak that opens and closes: the steady plume, part of the time; period_s=20, share=0.5 [plug-in]"
    )


BAD = '''
def broken(scenario, seed):
    """A world that fails."""
    return lambda places, times_s: 1 / 0


def strange(scenario, seed, *, gas: float = -1.0):
    """A world of negative gas."""
    return lambda places, times_s: (gas, (0.0, 0.0))


def bare(scenario, seed, *, share):
    """A world whose parameter has no default."""


def raising(scenario, seed, *, share: float = 0.1):
    """A world that cannot be made."""
    raise KeyError("lost")


def leaving(scenario, seed):
    """A world that ends the program."""
    raise SystemExit(3)


def choosy(scenario, seed):
    """A world that cannot be made of each release."""
    if scenario.source != (3.0, 4.0):
        return lambda places, times_s: (0.0, (1.0, 0.0))
    raise SystemExit(3)
'''


def test_a_plug_in_that_fails_or_says_what_no_air_can_say_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(
        tmp_path,
        "badworlds",
        BAD,
        broken="broken",
        strange="strange",
        gone="gone",
        bare="bare",
        raising="raising",
        leaving="leaving",
        choosy="choosy",
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        WorldError,
        match=r"(?m)^world broken failed: ZeroDivisionError: division by zero "
        r"\(badworlds\.py, line 4\)$",
    ):
        World(draw(1), 1, name="broken").gas((1.0, 2.0), 0)
    for name, gas in (("strange", "-1"), ("strange:gas=1e300", r"1e\+300")):  # a reading of that is infinite
        with pytest.raises(
            WorldError, match=rf"^world {name} said gas {gas} and wind \[0\.0, 0\.0\]; wanted gas from 0 to"
        ):
            World(draw(1), 1, name=name).gas((1.0, 2.0), 0)
    with pytest.raises(ValueError, match=r"^world gone of badworlds:gone does not load: AttributeError: "):
        named("gone")
    with pytest.raises(
        ValueError, match=r"^world bare: its parameter share has no default that is a number or"
    ):
        named("bare")
    with pytest.raises(ValueError, match=r"^world 'raising' is not allowed: KeyError: 'lost'$"):
        named("raising")
    with pytest.raises(ValueError, match=r"^world 'leaving' is not allowed: SystemExit: 3$"):
        named("leaving")
    elsewhere = msgspec.structs.replace(draw(1), source=(3.0, 4.0))
    with pytest.raises(
        WorldError, match=r"(?m)^world choosy failed: SystemExit: 3 \(badworlds\.py, line \d+\)$"
    ):
        World(elsewhere, 1, name="choosy")
    assert worlds()["gone"].startswith("world gone of badworlds:gone does not load")


TALKS = '''
print("I load")


def talks(scenario, seed):
    """A world that prints."""
    print("I make the air")

    def air(places, times_s):
        print("I blow")
        return 0.5, (1.0, 0.0)

    return air
'''


@pytest.mark.parametrize(
    "words",
    [("rollout", "--seed", "1"), ("evaluate", "--scenarios", "1", "--workers", "1")],
    ids=["rollout", "evaluate"],
)
def test_what_a_world_prints_goes_to_stderr_and_leaves_the_json_alone(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    words: tuple[str, ...],
) -> None:
    module = f"talkers_{words[0]}"
    install(tmp_path, module, TALKS, talks="talks")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    flags = ("--world", "talks", "--particles", "50", "--budget", "2", "--json")
    assert not main(arguments=[*words, *flags])
    out, err = capfd.readouterr()
    assert isinstance(json.loads(out), dict)
    assert err.count("I blow\n") == 3
    assert {"I load", "I make the air"} <= {*err.splitlines()}


@pytest.mark.full
def test_a_plug_in_that_fails_ends_a_mission_with_a_line(tmp_path: Path) -> None:
    install(tmp_path, "badworlds", BAD, broken="broken", choosy="choosy")
    place = ["--problem", '{"source": [3, 4]}']
    rollout, fly = ["agent", "rollout"], ["sitl", "fly", "--speedup", "0", "--no-record"]
    for command, world, status, said in (
        (rollout, "broken", 1, "world broken failed: ZeroDivisionError: "),
        (fly, "broken", 2, "world broken failed: ZeroDivisionError: "),
        ([*rollout, *place], "choosy", 1, "world choosy failed: SystemExit: 3 (badworlds.py, line "),
        ([*fly, *place], "choosy", 2, "--world: world choosy failed: SystemExit: 3 (badworlds.py, line "),
    ):
        done = subprocess.run(
            [sys.executable, "-m", *command, "--world", world],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(tmp_path)},
            timeout=400,
        )
        last = done.stderr.splitlines()[-1]
        assert (done.returncode, said in last) == (status, True), done.stderr
