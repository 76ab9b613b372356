"""Protects the lookup of policies by name, file and package, the checks on their answers, and the examples
of docs/policies.md.
"""

import json
import math
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from agent import policies
from agent.__main__ import main, parse
from agent.planners.registry import PLANNERS
from agent.planning.moves import HeadingAndStep, Headings, Move, Reach
from agent.policies import SHIPPED, PolicyError, choose, named, policy, reach
from agent.trials.rollout import mission, rollout
from link.bus.messages import Belief, Particles
from plume.problem import Area, Problem
from plumeward.evaluation import evaluate
from tests.agent.test_bundle import a_bundle

ROOT = Path(__file__).parents[2]
Plug = Callable[..., str]


@pytest.fixture(autouse=True)
def _looked_up_anew() -> Iterator[None]:
    policies.loaded.clear()
    yield
    policies.loaded.clear()


@pytest.fixture(scope="module")
def seen() -> tuple[Belief, Particles]:
    """The belief after the first reading of a mission, and its particles."""
    first = next(mission(1, "random", 100, 0.5, 1).steps)
    return first.belief, first.particles


def install(folder: Path, package: str, source: str, **names: str) -> None:
    """Install a package with policy entry points (NAME=FUNCTION) into a folder, as pip would."""
    (folder / f"{package}.py").write_text(textwrap.dedent(source))
    said = folder / f"{package}-1.0.dist-info"
    said.mkdir()
    (said / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    lines = [f"{name} = {value if ':' in value else f'{package}:{value}'}" for name, value in names.items()]
    (said / "entry_points.txt").write_text("\n".join(["[plumeward.policies]", *lines]) + "\n")


@pytest.fixture
def plug(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Plug:
    """Plug in one policy, `theirs`, from its source; returns its module's name."""
    module = re.sub(r"\W", "_", f"stranger_{tmp_path.name}")  # unique per test, since Python caches modules

    def put(source: str, value: str = "theirs") -> str:
        install(tmp_path, module, source, theirs=value)
        monkeypatch.syspath_prepend(tmp_path)
        return module

    return put


def command(*arguments: str, cwd: Path, packages: Path | None = None) -> "subprocess.CompletedProcess[str]":
    """Run `python -m arguments`, with other packages installed."""
    path = {"PYTHONPATH": str(packages)} if packages else {}
    return subprocess.run(
        [sys.executable, "-m", *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=cwd,
        env=os.environ | path,
    )


def flown(*arguments: str, cwd: Path, packages: Path | None = None) -> dict:
    done = command(*arguments, "--json", "--trace", cwd=cwd, packages=packages)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_the_names_are_the_planners_the_policies_that_ship_and_what_is_plugged_in(plug: Plug) -> None:
    assert named() == (*PLANNERS, "ppo", "dqn", "ddpg")
    plug("def theirs(*_): return 1, 2")
    assert named() == (*PLANNERS, "ppo", "dqn", "ddpg", "theirs")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("clairvoyance", "; wanted infotaxis, "),
        ("", "; wanted infotaxis, "),
        ("theirs", "; wanted infotaxis, "),
        ("homming", "; did you mean 'homing'? Wanted infotaxis, "),
        ("Infotaxis", "; did you mean 'infotaxis'? Wanted infotaxis, "),
        ("ppo.onnx", "; did you mean 'ppo'? Wanted infotaxis, "),
    ],
)
def test_an_unknown_name_is_answered_with_the_nearest_and_all_that_is_allowed(name: str, told: str) -> None:
    with pytest.raises(ValueError, match="is not allowed") as refused:
        policy(name)
    assert str(refused.value).startswith(f"{name!r} is not allowed{told}")
    for allowed in (*PLANNERS, *SHIPPED, "FILE.zip"):
        assert allowed in str(refused.value)


def test_a_bundle_is_named_by_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seen: tuple[Belief, Particles]
) -> None:
    monkeypatch.chdir(tmp_path)
    a_bundle(tmp_path / "a.zip")
    waypoint = choose("a.zip", *seen, 0, Reach())
    assert waypoint == choose(
        str(tmp_path / "a.zip"), *seen, 5, Reach()
    )  # a learned policy draws no random numbers
    assert math.dist(waypoint, seen[0].position) <= 1 + 1e-5


def way(bundle: Path) -> list[tuple[float, float]]:
    """Where a mission with a bundle measures."""
    return [point.position for point in rollout(1, str(bundle), 100, budget=4)[1]]


def test_a_bundle_that_is_written_anew_is_flown_anew(tmp_path: Path) -> None:
    bundle, other = tmp_path / "a.zip", tmp_path / "b.zip"
    for path, seed in ((bundle, 0), (other, 1)):
        a_bundle(path, "polar", Headings(16), seed)
    first = way(bundle)
    a_bundle(bundle, "polar", Headings(16), 1)
    assert way(bundle) == way(other) != first
    bundle.unlink()
    with pytest.raises(ValueError, match=r"a\.zip: there is no such file$"):
        way(bundle)


def test_an_evaluation_flies_a_bundle_that_is_written_anew(
    tmp_path: Path, seen: tuple[Belief, Particles]
) -> None:
    bundle, waypoints = tmp_path / "a.zip", []
    for seed in (0, 1, 0):
        a_bundle(bundle, "polar", Headings(16), seed)
        evaluate(str(bundle), 1, particles=50, budget=1)
        waypoints.append(choose(str(bundle), *seen, 0, Reach()))
    assert waypoints[0] == waypoints[2] != waypoints[1]


def test_a_bundle_that_is_written_anew_in_flight_changes_no_mission(tmp_path: Path) -> None:
    bundle = tmp_path / "a.zip"
    a_bundle(bundle, "polar", Headings(16), 0)
    whole = way(bundle)
    flying = []
    for step in mission(1, str(bundle), 100, 0.5, 4, assume="field").steps:
        flying += [reading.position for reading in step.readings]
        a_bundle(bundle, "polar", Headings(16), 1)
    assert flying == whole


def test_what_ships_is_a_bundle_under_a_short_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seen: tuple[Belief, Particles]
) -> None:
    a_bundle(tmp_path / "a.zip")
    monkeypatch.setitem(SHIPPED, "dqn", tmp_path / "a.zip")
    assert choose("dqn", *seen, 0, Reach()) == choose(str(tmp_path / "a.zip"), *seen, 0, Reach())
    (tmp_path / "b.zip").write_bytes(b"")
    monkeypatch.setitem(SHIPPED, "ppo", tmp_path / "b.zip")
    with pytest.raises(ValueError, match=r"b.zip: not a bundle: File is not a zip file"):
        policy("ppo")


def test_only_planners_take_flags_that_say_how_to_move(tmp_path: Path, plug: Plug) -> None:
    a_bundle(tmp_path / "a.zip")
    plug("def theirs(*_): return 1, 2")
    bundle = str(tmp_path / "a.zip")
    assert reach(bundle) == Reach()
    with pytest.raises(
        ValueError, match=r"^--headings, --step is for planners; .*a.zip moves as it was trained to$"
    ):
        reach(bundle, {"headings": 8, "step": 0.5})
    assert reach("theirs", {"headings": 8, "step": 0.5}) == Reach(
        headings=8, step=0.5
    )  # the policy may use them or not


FIELD = Problem(area=Area((-100.0, 0.0), (200.0, 100.0)), step_m=5.0, prior=Area((0.0, 0.0), (50.0, 50.0)))


def test_a_learned_policy_that_knows_no_problem_flies_in_any_with_any_step(tmp_path: Path) -> None:
    a_bundle(tmp_path / "a.zip", "polar-2", Headings(16))
    bundle = str(tmp_path / "a.zip")
    assert reach(bundle, problem=FIELD) == Reach(step=5.0, area=FIELD.area)
    assert reach(bundle, {"step": 2.0}, FIELD) == Reach(step=2.0, area=FIELD.area)
    with pytest.raises(ValueError, match=r"^--headings is for planners; .*a.zip moves as it was trained to$"):
        reach(bundle, {"headings": 8, "step": 0.5})
    outcome, trace = rollout(1, bundle, particles=100, budget=5, problem=FIELD)
    assert all(FIELD.area.holds(point.position) for point in trace)
    assert outcome.distance_m > 0


def test_a_learned_policy_of_one_problem_refuses_that_in_one_line(tmp_path: Path) -> None:
    a_bundle(tmp_path / "a.zip", "polar", Headings(16))
    with pytest.raises(
        ValueError, match="is not allowed with a learned policy; it was trained in"
    ) as refused:
        reach(str(tmp_path / "a.zip"), problem=FIELD)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ("rollout", "--policy", "clairvoyance"),
            "--policy: 'clairvoyance' is not allowed; wanted infotaxis, ",
        ),
        (("--policy", "nowhere.zip"), "--policy: nowhere.zip: there is no such file"),
        (
            ("evaluate", "--policy", "random,empty.zip"),
            "--policy: empty.zip: not a bundle: File is not a zip file; wanted a zip file of ",
        ),
        (
            ("rollout", "--policy", "a.zip", "--headings", "8"),
            "--headings is for planners; a.zip moves as it was trained to",
        ),
        (
            ("evaluate", "--policy", "random,a.zip", "--step", "2"),
            "--step is for planners; a.zip moves as it was trained to",
        ),
        (
            ("--policy", "a.zip", "--measurements", "9"),
            "--measurements is for planners; a.zip moves as it was trained to",
        ),
        (("--area", "0"), "--area: '0' is not allowed; wanted a number above 0 up to 100000"),
        (
            ("--area", "50", "--policy", "a.zip"),
            "--problem: the area [0, 50] x [0, 50] m is not allowed with a learned policy; it was trained in the",
        ),
        (
            ("--area", "10", "--policy", "ppo"),
            "--problem: the area [0, 10] x [0, 10] m is not allowed with a learned policy; it was trained in the "
            "area [0, 30] x [0, 30] m, in steps of 1 m, with the source expected in [0, 30] x [0, 30] m",
        ),
        (
            ("--problem", '{"step_m": 2}', "--policy", "ppo"),
            "--problem: a step of 2 m is not allowed with a learned policy",
        ),
        (
            ("--waypoints", "0:1,30.5"),
            "--waypoints: '0:1,30.5' is not allowed; wanted STEP:X,Y;X,Y;... with places in the area, [0, 30] x [0, 30] m",
        ),
        (
            ("--area", "50", "--waypoints", "0:1,50.5"),
            "'0:1,50.5' is not allowed; wanted STEP:X,Y;X,Y;... with places in the area, [0, 50] x [0, 50] m",
        ),
        (
            ("--area", "20", "--waypoints", "0:1,25"),
            "'0:1,25' is not allowed; wanted STEP:X,Y;X,Y;... with places in the area, [0, 20] x [0, 20] m",
        ),
        (
            ("evaluate", "--first-seed", "9223372036854775807", "--scenarios", "2"),
            "--first-seed: 9223372036854775807 is not allowed with --scenarios 2; wanted 9223372036854775806 at most",
        ),
        (("--waypoints", "0:nan,1"), "--waypoints: '0:nan,1' is not allowed"),
        (("--waypoints=-1:2,1",), "--waypoints: '-1:2,1' is not allowed"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_bad_input_is_one_clear_line_and_status_2(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    line: str,
) -> None:
    a_bundle(tmp_path / "a.zip")
    (tmp_path / "empty.zip").write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["agent", *arguments])
    try:
        status = main()
    except SystemExit as ended:
        status = ended.code
    out, err = capsys.readouterr()
    assert (status, out) == (2, "")
    (said,) = err.splitlines()
    assert line in said


@pytest.mark.parametrize("name", [name for name in PLANNERS if name != "random"])
def test_the_agent_searches_all_of_the_area_that_it_is_told_of(
    seen: tuple[Belief, Particles], name: str
) -> None:
    belief, particles = seen
    away = replace(
        belief, position=(45.0, 45.0), mean=(58.0, 45.0)
    )  # outside the default area, where no move exists
    there = np.array(particles)
    there[:, :2] = np.random.default_rng(1).normal((58.0, 45.0), 0.5, (len(there), 2))
    x, y = choose(name, away, there, 0, parse("agent", ["--policy", name, "--area", "60"]).reach)
    assert math.dist((x, y), (45.0, 45.0)) == pytest.approx(1.0, abs=1e-5)
    assert not Reach().moves(away.position).size


def test_scripted_waypoints_may_lie_in_all_of_the_area() -> None:
    assert parse("agent", ["--area", "60", "--waypoints", "3:59.5,0;60,1"]).scripted == {
        3: (59.5, 0.0),
        4: (60.0, 1.0),
    }
    assert parse("agent", ["--waypoints", "0:30,0.1", "--waypoints", "4:2,3"]).scripted == {
        0: (30.0, float(np.float32(0.1))),
        4: (2.0, 3.0),
    }


def test_no_waypoint_is_rounded_out_of_the_area(plug: Plug, seen: tuple[Belief, Particles]) -> None:
    plug("def theirs(belief, particles, reach, rng): return 1e9, reach.area.high[1]")
    reached = parse("agent", ["--policy", "theirs", "--area", "30.1", "--waypoints", "0:30.1,30.1"])
    assert np.float32(30.1).item() > 30.1
    below = np.nextafter(np.float32(30.1), np.float32(0)).item()
    assert choose("theirs", *seen, 0, reached.reach) == (below, below)
    assert reached.scripted == {0: (below, below)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flags", "line"),
    [
        (("--policy", "empty.zip"), "--policy: empty.zip: not a bundle: File is not a zip file; wanted "),
        pytest.param(
            *(("--policy", "a.zip", "--headings", "4"), "--headings is for planners; a.zip moves as it was"),
            marks=pytest.mark.full,
        ),
    ],
    ids=["empty", "headings"],
)
def test_a_mission_with_what_the_agent_refuses_ends_in_the_agents_line(
    tmp_path: Path, flags: tuple[str, ...], line: str
) -> None:
    a_bundle(tmp_path / "a.zip")
    (tmp_path / "empty.zip").write_bytes(b"")
    ended = command("sitl", "fly", *flags, "--speedup", "0", cwd=tmp_path)
    assert (ended.returncode, ended.stdout) == (2, "")
    *_, said = ended.stderr.splitlines()  # a slow machine's launcher says first what it waits for
    assert line in said


@pytest.mark.parametrize(
    ("said", "flown_to"),
    [
        ("(3, 4)", (3, 4)),
        ("[30.1, -1e300]", (30, 0)),
        ("np.array([0.1, 29.9])", (np.float32(0.1), np.float32(29.9))),
        ("(1e39, 2)", (30, 2)),
    ],
)
def test_a_waypoint_is_moved_into_the_area_and_made_float32(
    plug: Plug, seen: tuple[Belief, Particles], said: str, flown_to: tuple[float, float]
) -> None:
    plug(f"import numpy as np\ndef theirs(belief, particles, reach, rng): return {said}")
    waypoint = choose("theirs", *seen, 0, Reach())
    assert waypoint == flown_to
    assert [type(number) for number in waypoint] == [float, float]


@pytest.mark.parametrize(
    "said",
    [
        "'north'",
        "None",
        "(1, float('nan'))",
        "(float('inf'), 1)",
        "(1, 2, 3)",
        "5",
        "[[1, 2]]",
        "(1, 'b')",
        "{1: 2}",
        "(1j, 2)",
        "(1, (2, 3))",
    ],
)
def test_what_is_no_place_is_refused_in_one_line(
    plug: Plug, seen: tuple[Belief, Particles], said: str
) -> None:
    plug(f"def theirs(belief, particles, reach, rng): return {said}")
    with pytest.raises(
        PolicyError, match=r"^policy theirs said .*; wanted a waypoint \(x, y\) in metres$"
    ) as refused:
        choose("theirs", *seen, 0, Reach())
    assert repr(eval(said, {})) in str(refused.value)


@pytest.mark.parametrize("digits", [400, 5000])
def test_a_number_that_no_float_holds_is_refused_in_one_line(
    plug: Plug, seen: tuple[Belief, Particles], digits: int
) -> None:
    plug(f"def theirs(belief, particles, reach, rng): return 10**{digits}, 1")
    with pytest.raises(PolicyError, match=r"^policy theirs said .*too large.*; wanted a waypoint \(x, y\)"):
        choose("theirs", *seen, 0, Reach())


def test_even_a_long_answer_makes_a_short_line(plug: Plug, seen: tuple[Belief, Particles]) -> None:
    plug("import numpy as np\ndef theirs(belief, particles, reach, rng): return np.zeros((100, 3))")
    with pytest.raises(PolicyError) as refused:
        choose("theirs", *seen, 0, Reach())
    assert len(str(refused.value).splitlines()) == 1
    assert len(str(refused.value)) < 300


def test_a_decision_that_raises_is_told_with_its_place(plug: Plug, seen: tuple[Belief, Particles]) -> None:
    module = plug("def theirs(belief, particles, reach, rng):\n    far = 0\n    return 1 / far, 2")
    with pytest.raises(PolicyError) as refused:
        choose("theirs", *seen, 0, Reach())
    assert (
        str(refused.value)
        == f"policy theirs failed: ZeroDivisionError: division by zero ({module}.py, line 3)"
    )
    assert isinstance(refused.value.__cause__, ZeroDivisionError)  # a developer needs its traceback


def test_a_decision_that_ends_the_program_has_failed(plug: Plug, seen: tuple[Belief, Particles]) -> None:
    module = plug("def theirs(belief, particles, reach, rng): raise SystemExit(0)")
    with pytest.raises(
        PolicyError, match=rf"(?m)^policy theirs failed: SystemExit: 0 \({module}\.py, line 1\)$"
    ):
        choose("theirs", *seen, 0, Reach())


@pytest.mark.parametrize(
    ("source", "value", "words"),
    [
        ("raise OSError('no\\nmap')", "theirs", "theirs of {module}:theirs does not load: OSError: no map"),
        ("raise SystemExit", "theirs", "theirs of {module}:theirs does not load: SystemExit: "),
        ("def theirs(:", "theirs", "does not load: SyntaxError: invalid syntax"),
        ("", "theirs", "does not load: AttributeError: module '{module}' has no attribute 'theirs'"),
        (
            "",
            "no.such.module:theirs",
            "theirs of no.such.module:theirs does not load: ModuleNotFoundError: No module named 'no'",
        ),
        (
            "theirs = 5",
            "theirs",
            "theirs is {module}:theirs, which cannot be called; wanted a function (belief, particles, reach, "
            "rng)",
        ),
    ],
)
def test_a_package_that_does_not_load_is_refused_in_one_line(
    plug: Plug, source: str, value: str, words: str
) -> None:
    module = plug(source, value)
    with pytest.raises(ValueError, match="theirs") as refused:
        policy("theirs")
    assert words.format(module=module) in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_a_name_that_two_packages_plug_in_is_refused(tmp_path: Path, plug: Plug) -> None:
    module = plug("def theirs(*_): return 1, 2")
    install(tmp_path, "another", "def b(*_): return 2, 1", theirs="b")
    with pytest.raises(ValueError, match=r"^theirs is plugged in more than once, by ") as refused:
        policy("theirs")
    assert f"{module}:theirs" in str(refused.value)
    assert "another:b" in str(refused.value)


def test_a_package_does_not_replace_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names, told = named(), policies.policies()
    install(tmp_path, "usurper", "def b(*_): return 2, 1", greedy="b", ppo="b")
    monkeypatch.syspath_prepend(tmp_path)
    assert rollout(1, "greedy", 100, budget=3)[1][-1].position != (2, 1)
    assert (named(), policies.policies()) == (names, told)


def test_a_policy_draws_by_seed_and_step_alone(plug: Plug) -> None:
    plug("def theirs(belief, particles, reach, rng): return rng.uniform(0, 30, 2)")
    _, trace = rollout(1, "theirs", 100, budget=4)
    places = [point.position for point in trace]
    assert len(set(places)) == 5
    assert places == [point.position for point in rollout(1, "theirs", 100, budget=4)[1]]
    assert places[1:] != [point.position for point in rollout(2, "theirs", 100, budget=4)[1]][1:]


def test_a_policy_cannot_change_what_the_estimator_believes(
    plug: Plug, seen: tuple[Belief, Particles]
) -> None:
    plug("def theirs(belief, particles, reach, rng):\n    particles[:, 2] = 1\n    return 1, 2")
    before = seen[1].copy()
    with pytest.raises(PolicyError, match="read-only"):
        choose("theirs", *seen, 0, Reach())
    assert (seen[1] == before).all()


def test_particles_lie_in_memory_alike_however_they_came(plug: Plug, seen: tuple[Belief, Particles]) -> None:
    """The memory layout sets the order of summation, which changes the last bits."""
    plug(
        "def theirs(belief, particles, reach, rng): return particles.flags.f_contiguous, "
        "particles.flags.writeable"
    )
    belief, particles = seen
    for order in "CF":
        assert choose("theirs", belief, np.array(particles, order=order), 0, Reach()) == (1, 0)


STRANGER = """
    import numpy as np

    def drawn(belief, particles, reach, rng):
        places, weights = particles[:, :2], particles[:, -1]
        mean = (weights[:, None] * places).sum(axis=0) + places.std(axis=0) / 50 + weights @ places / 100
        heading = np.arctan2(*(mean - belief.position)[::-1]) + rng.normal(0, 0.5)
        return belief.position + reach.step * np.array([np.cos(heading), np.sin(heading)])

    def word(belief, particles, reach, rng):
        return "north" if belief.step == 2 else belief.position

    def crash(belief, particles, reach, rng):
        raise LookupError("lost")

    number = 7
"""
STRANGERS = {"drawn": "drawn", "word": "word", "crash": "crash", "number": "number", "absent": "absent"}


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a stranger's package, for PYTHONPATH."""
    folder = tmp_path_factory.mktemp("packages")
    install(folder, "stranger", STRANGER, **STRANGERS)
    return folder


@pytest.mark.full
@pytest.mark.slow
def test_a_policy_of_another_package_flies_the_same_over_the_bus(tmp_path: Path, packages: Path) -> None:
    chosen = ("--policy", "drawn", "--seed", "5", "--budget", "10", "--particles", "100")
    over_the_bus = flown("sitl", "fly", *chosen, "--speedup", "0", cwd=tmp_path, packages=packages)
    in_process = flown("agent", "rollout", *chosen, cwd=tmp_path, packages=packages)
    assert over_the_bus["trace"] == in_process["trace"]
    for before, after in pairwise(in_process["trace"]):
        assert 0 < math.dist(before["position"], after["position"]) < 1 + 1e-5


@pytest.mark.full
@pytest.mark.slow
@pytest.mark.parametrize(
    ("schema", "move"),
    [("paper", HeadingAndStep()), pytest.param("polar", Headings(16), marks=pytest.mark.full)],
)
def test_a_bundle_flies_the_same_over_the_bus(tmp_path: Path, schema: str, move: Move) -> None:
    a_bundle(tmp_path / "a.zip", schema, move, seed=1)
    chosen = ("--policy", "a.zip", "--seed", "5", "--budget", "10", "--particles", "100")
    over_the_bus = flown("sitl", "fly", *chosen, "--speedup", "0", cwd=tmp_path)
    assert over_the_bus["trace"] == flown("agent", "rollout", *chosen, cwd=tmp_path)["trace"]
    assert len(over_the_bus["trace"]) == 11


@pytest.mark.full
@pytest.mark.slow
def test_a_policy_of_another_package_is_evaluated_by_all_workers(tmp_path: Path, packages: Path) -> None:
    chosen = (
        "--policy",
        "drawn,random",
        "--scenarios",
        "3",
        "--particles",
        "100",
        "--budget",
        "10",
        "--workers",
        "2",
    )
    done = command("agent", "evaluate", *chosen, "--json", cwd=tmp_path, packages=packages)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["drawn"]["missions"] == 3


@pytest.mark.full
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("number", "--policy: number is stranger:number, which cannot be called; wanted "),
        ("absent", "--policy: absent of stranger:absent does not load: "),
    ],
)
def test_a_package_that_does_not_fit_is_refused_before_anything_flies(
    tmp_path: Path, packages: Path, name: str, words: str
) -> None:
    for program in (("agent", "rollout"), ("sitl", "fly", "--speedup", "0")):
        ended = command(*program, "--policy", name, cwd=tmp_path, packages=packages)
        assert (ended.returncode, ended.stdout) == (2, "")
        (said,) = ended.stderr.splitlines()
        assert words in said


@pytest.mark.parametrize(
    "words",
    [("rollout", "--seed", "1"), ("evaluate", "--scenarios", "1", "--workers", "1")],
    ids=lambda it: it[0],
)
def test_what_a_policy_prints_goes_to_stderr_and_leaves_the_json_alone(
    plug: Plug,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    words: tuple[str, ...],
) -> None:
    plug("print('I load')\ndef theirs(*_):\n    print('I decide')\n    return 3.0, 4.0\n")
    monkeypatch.chdir(tmp_path)
    flags = ("--policy", "theirs", "--particles", "50", "--budget", "2", "--json")
    assert not main(arguments=[*words, *flags])
    out, err = capfd.readouterr()
    assert isinstance(json.loads(out), dict)
    assert "I load\n" in err
    assert err.count("I decide\n") == 2


@pytest.mark.parametrize(
    ("said", "tracebacks", "words"),
    [
        ('float("nan"), 4.0', 0, "said (nan, 4.0); wanted a waypoint (x, y) in metres"),
        ("1 / 0, 4.0", 1, "failed: ZeroDivisionError: division by zero"),
    ],
)
def test_a_policy_that_fails_in_a_worker_is_one_line_and_shows_its_own_code_if_that_raised(
    plug: Plug,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    said: str,
    tracebacks: int,
    words: str,
) -> None:
    plug(f"def theirs(*_):\n    return {said}\n")
    monkeypatch.chdir(tmp_path)
    flags = ("--policy", "theirs", "--particles", "50", "--budget", "2", "--workers", "1")
    assert main(arguments=["evaluate", "--scenarios", "1", *flags]) == 1
    err = capfd.readouterr().err
    assert f"error: policy theirs {words}" in err.splitlines()[-1]
    assert err.count("Traceback") == tracebacks
    assert "_process_worker" not in err  # where the worker called it


@pytest.mark.full
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "words"),
    [
        pytest.param(
            "word", "policy word said 'north'; wanted a waypoint (x, y) in metres", marks=pytest.mark.full
        ),
        ("crash", "policy crash failed: LookupError: lost (stranger.py, line 14)"),
    ],
)
def test_a_policy_that_fails_in_flight_ends_the_mission_with_a_line_that_names_it(
    tmp_path: Path, packages: Path, name: str, words: str
) -> None:
    chosen = ("--policy", name, "--budget", "5", "--particles", "100")
    for program in (
        ("agent", "rollout"),
        ("sitl", "fly", "--speedup", "0"),
        ("agent", "evaluate", "--scenarios", "1"),
    ):
        ended = command(*program, *chosen, cwd=tmp_path, packages=packages)
        assert (ended.returncode, ended.stdout) == (1, "")
        assert words in ended.stderr.splitlines()[-1]


def examples(page: str = "policies.md") -> dict[str, str]:
    """The files in a page of docs/: code blocks whose first line is the file's name."""
    blocks = re.findall(
        r"^```\w+\n(# (\S+)\n.*?)^```$", (ROOT / "docs" / page).read_text(), re.DOTALL | re.MULTILINE
    )
    return {name: text for text, name in blocks}


@pytest.mark.slow
def test_the_documented_bundle_is_made_without_our_code_and_flies_where_it_says(tmp_path: Path) -> None:
    source = examples()["beeline.py"]
    assert not re.search(r"^(from|import) (agent|link|plume|estimator)\b", source, re.MULTILINE)
    (tmp_path / "beeline.py").write_text(source)
    subprocess.run([sys.executable, "beeline.py"], check=True, cwd=tmp_path, timeout=300)
    trace = flown(
        "agent", "rollout", "--policy", "beeline.zip", "--seed", "3", "--particles", "200", cwd=tmp_path
    )["trace"]
    assert len(trace) > 10
    angles = 2 * math.pi * np.arange(8) / 8
    steps = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for before, after in pairwise(trace):
        towards = steps @ np.subtract(before["mean"], before["position"])
        wanted = np.clip(before["position"] + steps[towards.argmax()], 0, 30)
        assert after["position"] == pytest.approx(wanted, abs=1e-5)


@pytest.mark.full
def test_the_documented_package_installs_and_flies(tmp_path: Path) -> None:
    source, packages = tmp_path / "source", tmp_path / "packages"
    source.mkdir()
    for name, text in examples("tutorials/research.md").items():
        (source / name).write_text(text)
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "--no-index",
        "--no-build-isolation",
        "--no-deps",
        "--target",
        str(packages),
    ]
    subprocess.run([*pip, str(source)], check=True, timeout=300)
    done = command(
        "agent",
        "evaluate",
        "--policy",
        "heaviest",
        "--scenarios",
        "8",
        "--particles",
        "300",
        "--workers",
        "1",
        "--json",
        cwd=tmp_path,
        packages=packages,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["heaviest"]["ceased"] >= 0.5
    over_the_bus, in_process = (
        flown(
            *program,
            "--policy",
            "heaviest",
            "--budget",
            "10",
            "--particles",
            "100",
            "--seed",
            "2",
            cwd=tmp_path,
            packages=packages,
        )
        for program in (("sitl", "fly", "--speedup", "0"), ("agent", "rollout"))
    )
    assert over_the_bus["trace"] == in_process["trace"]


def test_the_documented_page_has_every_field_of_a_bundle_and_every_observation() -> None:
    from agent.bundle import Page
    from agent.observation import SCHEMAS

    page = (ROOT / "docs" / "policies.md").read_text()
    for name in Page.__struct_fields__:
        assert f"| `{name}` |" in page
    for name, schema in SCHEMAS.items():
        assert f"| `{name}`, {schema.version} | {schema.size} |" in page
    assert policies.PLUGINS in page
