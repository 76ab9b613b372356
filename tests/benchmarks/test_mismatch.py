"""Protects the worlds that differ from the model: each differs only as it states, and the estimator never learns of the difference."""

import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from rich.progress import Progress

from agent.trials.figures import MissionRow
from agent.trials.rollout import Step, rollout
from benchmarks import mismatch
from benchmarks.mismatch import WORLDS, fly, fly_all, keep, page, read, steps
from estimator.filter import Posterior
from link.bus.mavlink import Reading
from plume import __version__
from plume.outcome import TracePoint
from plume.randomness import keyed
from plume.scenario import draw

ROOT = Path(__file__).parents[2]
SEEDS = range(1_000_000, 1_000_300)


def flown(world: str, name: str, seed: int, particles: int = 200, budget: int = 40) -> list[Step]:
    return list(steps(WORLDS[world], name, seed, particles, budget))


def formula(at: tuple[float, float], source: tuple[float, float], q: float, u: float, phi: float, d: float, tau: float) -> float:
    """The paper's concentration, written independently of the code."""
    r = max(math.dist(at, source), 0.1)
    psi = -((at[0] - source[0]) * u * math.cos(phi) + (at[1] - source[1]) * u * math.sin(phi)) / (2 * d)
    return q / (4 * math.pi * d * r) * math.exp(-r / math.sqrt(d * tau / (1 + u**2 * tau / (4 * d))) + psi)


@pytest.mark.parametrize("name", ["infotaxis", "homing", "thompson", "random"])
@pytest.mark.parametrize("seed", [1_000_000, 1_000_003])
def test_a_mission_as_modelled_is_that_of_a_rollout_to_the_last_bit(name: str, seed: int) -> None:
    result, trace = rollout(seed, name, particles=300, budget=80, assume="paper")
    beliefs = [step.belief for step in flown("as-modelled", name, seed, 300, 80)]
    assert [TracePoint(it.position, it.gas, it.mean, it.spread) for it in beliefs] == trace
    row = fly("as-modelled", name, seed, 300, 80)
    for key in ("seed", "policy", "ceased", "located", "error_m", "spread_m", "steps", "distance_m"):
        assert getattr(row, key) == getattr(result, key)
    assert ((row.estimate_x, row.estimate_y), (row.source_x, row.source_y)) == (result.estimate, result.source)


@pytest.mark.parametrize(
    ("world", "tau", "alpha", "beta"),
    [
        ("as-modelled", 10, 0.3, 0.2),
        ("tau-halved", 5, 0.3, 0.2),
        ("tau-doubled", 20, 0.3, 0.2),
        ("wind-10", 10, 0.3, 0.2),
        ("wind-30", 10, 0.3, 0.2),
        ("noise-doubled", 10, 0.6, 0.4),
        ("source-outside", 10, 0.3, 0.2),
    ],
)
def test_readings_come_from_the_world_and_beliefs_from_the_model(world: str, tau: float, alpha: float, beta: float) -> None:
    seed = 1_000_001
    true = draw(seed)
    row = fly(world, "greedy", seed, 200, 40)
    source = (row.source_x, row.source_y)
    assert (source == true.source) == (world != "source-outside")
    for step in flown(world, "greedy", seed):
        said = step.belief
        mean = formula(said.position, source, true.q, true.u, true.phi, true.d, tau)  # the true wind carries the gas
        noise = keyed(seed, "sensor", said.step).standard_normal()
        assert said.gas == pytest.approx(mean + noise * math.sqrt((alpha * mean) ** 2 + beta**2), rel=1e-5, abs=1e-6)
        assert (said.rate, said.diffusivity, said.lifetime, said.sensor) == (true.q, true.d, 10.0, "gaussian:0.3,0.2")
        assert said.wind == WORLDS[world].measured_wind(seed)


@pytest.mark.parametrize("world", WORLDS)
def test_a_world_changes_nothing_of_a_scenario_but_what_it_says(world: str) -> None:
    for seed in SEEDS[:20]:
        there, usual = WORLDS[world].scenario(seed), draw(seed)
        assert replace(there, tau=usual.tau, source=usual.source) == usual
        assert there.tau == {"tau-halved": 5.0, "tau-doubled": 20.0}.get(world, 10.0)
        assert world == "source-outside" or there.source == usual.source


@pytest.mark.parametrize(("world", "degrees"), [("wind-10", 10), ("wind-30", 30)])
def test_the_measured_wind_is_turned_to_either_side_and_as_fast(world: str, degrees: float) -> None:
    turns = []
    for seed in SEEDS:
        true, measured = draw(seed).wind, WORLDS[world].measured_wind(seed)
        assert math.hypot(*measured) == pytest.approx(math.hypot(*true), rel=1e-6)
        assert [float(np.float32(value)) for value in measured] == list(measured)
        cross, dot = true[0] * measured[1] - true[1] * measured[0], true[0] * measured[0] + true[1] * measured[1]
        turns.append(math.degrees(math.atan2(cross, dot)))
    assert np.abs(turns) == pytest.approx(degrees, abs=1e-4)
    # Of 300, 150 ± 8.7 (one standard deviation) turn left: four standard deviations are allowed.
    assert 115 <= np.sum(np.array(turns) > 0) <= 185


def test_no_other_world_turns_the_wind() -> None:
    for world in WORLDS.keys() - {"wind-10", "wind-30"}:
        assert WORLDS[world].measured_wind(7) == tuple(np.float32(draw(7).wind).tolist())


@pytest.mark.parametrize("mean", [0.0, 2.0, 30.0])
def test_doubled_noise_has_twice_the_standard_deviation(mean: float) -> None:
    rng = np.random.default_rng(5)
    drawn, usual = (WORLDS[world].sensor.measure(np.full(100_000, mean), rng) for world in ("noise-doubled", "as-modelled"))
    # At 2 g/m³: sqrt((0.6 · 2)² + 0.4²) = 1.265. The standard error of such a deviation is 0.22% of it, that of the mean 0.32%.
    expected = math.sqrt((0.6 * mean) ** 2 + 0.4**2)
    assert drawn.std() == pytest.approx(expected, rel=0.01)
    assert usual.std() == pytest.approx(expected / 2, rel=0.01)
    assert drawn.mean() == pytest.approx(mean, abs=0.013 * expected)


def test_a_fifth_of_readings_is_lost_and_never_the_first() -> None:
    world = WORLDS["readings-lost"]
    lost = np.array([[world.loses(seed, step) for step in range(101)] for seed in SEEDS[:100]])
    assert not lost[:, 0].any()
    # Of 10,000, with a standard deviation of sqrt(0.2 · 0.8 / 10,000) = 0.4%: four standard deviations are allowed.
    assert abs(lost[:, 1:].mean() - 0.2) < 0.016
    assert (lost[0] != lost[1]).any()
    assert not any(other.loses(seed, step) for other in WORLDS.values() if other is not world for seed in SEEDS[:5] for step in range(50))


def test_a_lost_reading_never_reaches_the_filter_and_the_vehicle_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Reading] = []
    assimilate = mismatch.assimilate

    def watched(posterior: Posterior, reading: Reading, *config: object) -> Posterior:
        seen.append(reading)
        return assimilate(posterior, reading, *config)  # type: ignore[arg-type]

    monkeypatch.setattr(mismatch, "assimilate", watched)
    seed = 1_000_002
    world = WORLDS["readings-lost"]
    flight = flown("readings-lost", "random", seed, budget=60)
    lost = [step for step in range(61) if world.loses(seed, step)]
    assert len(lost) > 5
    assert [reading.time_boot_ms for reading in seen] == [step for step in range(61) if step not in lost]
    for before, after in pairwise(flight):
        assert math.dist(before.belief.position, after.belief.position) == pytest.approx(1.0, abs=1e-5)
        if after.belief.step in lost:
            assert replace(after.belief, position=before.belief.position, step=before.belief.step) == before.belief
            assert (after.particles == before.particles).all()
    # A reading that arrives is taken at the vehicle's position, with the noise of its step.
    true = draw(seed)
    for reading in seen:
        mean = formula(reading.position, true.source, true.q, true.u, true.phi, true.d, 10)
        noise = keyed(seed, "sensor", reading.time_boot_ms).standard_normal()
        assert reading.gas == pytest.approx(mean + noise * math.hypot(0.3 * mean, 0.2), rel=1e-5, abs=1e-6)
        assert reading.position == flight[reading.time_boot_ms].belief.position


def test_sources_outside_are_uniform_over_the_area_without_the_square() -> None:
    x, y = np.array([WORLDS["source-outside"].scenario(seed).source for seed in range(2000)]).T
    assert ((x >= 0) & (x <= 30) & (y >= 0) & (y <= 30)).all()
    assert not ((x >= 10) & (x <= 25) & (y >= 10) & (y <= 25)).any()
    # Of 30² − 15² = 675 m², 300 are west of the square, 150 east of it, 150 south (10 · 15) and 75 north (5 · 15) of its middle.
    within = (x >= 10) & (x <= 25)
    shares = [(x < 10).mean(), (x > 25).mean(), (within & (y < 10)).mean(), (within & (y > 25)).mean()]
    # Standard deviations are below sqrt(0.25 / 2000) = 1.1%: four standard deviations are allowed.
    assert shares == pytest.approx([300 / 675, 150 / 675, 150 / 675, 75 / 675], abs=0.045)


def row(name: str, seed: int, ceased: bool = True, error_m: float = 0.5, distance_m: float = 40.0) -> MissionRow:
    return MissionRow(
        policy=name, particles=1000, threshold_m=0.5, seed=seed, budget=300, headings=4, step_m=1.0, measurements=25, ceased=ceased,
        located=ceased and error_m <= 1, estimate_x=error_m, estimate_y=0.0, source_x=0.0, source_y=0.0, error_m=error_m, spread_m=0.4,
        nees=2.0, steps=int(distance_m), distance_m=distance_m, floor_m=None, search_time_s=0.5, decision_ms=2.0, update_ms=1.0,
    )  # fmt: skip


FOUR = [row("greedy", 1, True, 0.5, 30.0), row("greedy", 2, True, 1.5, 50.0), row("greedy", 3, True, 0.2, 40.0), row("greedy", 4, False)]
"""Four missions: three ceased, two of them located."""


def test_what_is_flown_again_takes_its_old_place_and_leaves_the_rest(tmp_path: Path) -> None:
    keep(tmp_path, "wind-10", "greedy", FOUR)
    keep(tmp_path, "wind-10", "random", [row("random", 1)])
    keep(tmp_path, "wind-30", "greedy", [row("greedy", 9)])
    keep(tmp_path, "wind-10", "greedy", FOUR[:2])
    assert read(tmp_path) == {
        ("wind-10", "random"): [row("random", 1)],
        ("wind-10", "greedy"): FOUR[:2],
        ("wind-30", "greedy"): [row("greedy", 9)],
    }


def test_the_page_says_what_is_counted_by_hand_and_the_conclusions() -> None:
    text = page({("wind-10", "greedy"): FOUR, ("wind-30", "random"): [FOUR[3]], ("wind-30", "a.zip"): FOUR})
    # Wilson: (p + z²/2n ± z sqrt(p(1−p)/n + z²/4n²)) / (1 + z²/n) with z = 1.96, of 3 in 4, 2 in 4 and 1 in 3.
    line = "| wind direction 10° wrong | 4 | 75.0 [30.1, 95.4] | 50.0 [15.0, 85.0] | 33.3 [6.1, 79.2] | 40.0 [30.0, 50.0] |"
    assert line in text.splitlines()
    assert "| wind direction 30° wrong | 1 | 0.0 [0.0, 79.3] | 0.0 [0.0, 79.3] | – | – |" in text.splitlines()
    assert "| world | greedy | random | a.zip |" in text.splitlines()
    assert "| wind direction 10° wrong | 50.0 [15.0, 85.0] | – | – |" in text.splitlines()
    assert mismatch.CONCLUSIONS in text


def test_rows_are_the_same_from_any_process() -> None:
    seeds = range(1_000_000, 1_000_002)
    with Progress(disable=True) as progress:
        [(cell, rows)] = fly_all([("readings-lost", "greedy")], seeds, progress)
    assert cell == ("readings-lost", "greedy")
    timeless = {"search_time_s": 0.0, "decision_ms": 0.0, "update_ms": 0.0}
    assert [replace(it, **timeless) for it in rows] == [replace(fly("readings-lost", "greedy", seed), **timeless) for seed in seeds]


def test_rows_of_a_learned_policy_have_no_planners_numbers_and_all_say_who_flew_them() -> None:
    learned, planned = (fly("noise-doubled", name, 1_000_000, 100, 3) for name in ("ppo", "homing"))
    assert (learned.headings, learned.measurements, planned.headings, planned.measurements) == (None, None, 8, 100)
    assert (learned.version, planned.version) == (__version__, __version__)
    assert learned.sensor == "gaussian:0.3,0.2"  # the estimator's model, not the world's noise


def test_what_is_flown_again_joins_the_rows_that_an_older_version_kept(tmp_path: Path) -> None:
    committed = ROOT / "results" / "mismatch" / "wind-10.csv.gz"
    (tmp_path / committed.name).write_bytes(committed.read_bytes())
    before = read(tmp_path)
    keep(tmp_path, "wind-10", "ppo", [row("ppo", 1)])
    after = read(tmp_path)
    assert len(after.pop(("wind-10", "ppo"))) == 1
    assert len(before.pop(("wind-10", "ppo"))) > 1
    assert after == before


def test_a_killed_worker_ends_it_with_a_line(tmp_path: Path, wait_until: Callable) -> None:
    flags = ("--results", str(tmp_path / "rows"), "--page", str(tmp_path / "page.md"), "--only", "wind-10", "--policy", "greedy")
    python = (sys.executable, "-m", "benchmarks.mismatch", *flags, "--missions", "100000")
    with subprocess.Popen(python, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")

        def workers() -> list[int]:
            return [int(it) for it in children.read_text().split() if "spawn_main" in Path(f"/proc/{it}/cmdline").read_text()]

        try:
            wait_until(workers)
            os.kill(workers()[0], signal.SIGKILL)
            _, said = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 1
    lines = said.splitlines()
    assert "error: a worker process was killed; the memory may have run out" in lines
    assert lines[-1] == "0 of 1 cells were flown; run the command again with --resume to fly the others"


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    flags = ("--results", str(folder / "rows"), "--page", str(folder / "page.md"))
    python = (sys.executable, "-m", "benchmarks.mismatch")
    return subprocess.run([*python, *flags, *arguments], cwd=ROOT, env=dict(os.environ), capture_output=True, text=True)


def test_the_command_flies_what_is_asked_for_and_then_only_what_is_missing(tmp_path: Path) -> None:
    asked = ("--only", "wind-30,tau-halved", "--policy", "greedy", "--missions", "2")
    first = command(tmp_path, *asked)
    assert (first.returncode, first.stdout) == (0, f"{tmp_path / 'page.md'}\n")
    assert {cell: len(rows) for cell, rows in read(tmp_path / "rows").items()} == {("wind-30", "greedy"): 2, ("tau-halved", "greedy"): 2}
    (tmp_path / "rows" / "wind-30.csv.gz").unlink()
    before = (tmp_path / "rows" / "tau-halved.csv.gz").read_bytes()
    again = command(tmp_path, *asked, "--resume")
    assert again.returncode == 0
    assert "wind-30, greedy: ceased" in again.stderr
    assert "tau-halved, greedy: ceased" not in again.stderr
    assert (tmp_path / "rows" / "tau-halved.csv.gz").read_bytes() == before
    assert "| wind direction 30° wrong | 2 |" in (tmp_path / "page.md").read_text()


@pytest.mark.parametrize("flag", ["--only", "--policy"])
def test_what_it_does_not_know_it_says_in_one_line(flag: str, tmp_path: Path) -> None:
    refused = command(tmp_path, flag, "nonsense")
    assert refused.returncode == 2
    [line] = refused.stderr.splitlines()
    assert flag in line
    assert "'nonsense' is not allowed; wanted " in line
    assert not list(tmp_path.iterdir())
