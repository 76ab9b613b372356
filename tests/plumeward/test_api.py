"""Protects the names that `import plumeward` gives: each does what its docstring says, against truths
derived here or elsewhere.
"""

import ast
import json
import math
import re
import subprocess
import sys
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from mcap.reader import make_reader

import plumeward
from plume.randomness import derived_seed

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden" / "homing-gaussian.mcap"


def run(code: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, timeout=300)


def mean_gas(
    position: tuple[float, float],
    source: tuple[float, float],
    wind: tuple[float, float],
    q: float,
    d: float,
    tau: float,
) -> float:
    """The paper's equation: m = q/(4π d r) · exp(−r/λ + ψ)."""
    dx, dy = position[0] - source[0], position[1] - source[1]
    r = max(math.hypot(dx, dy), 0.1)
    decay = math.sqrt(d * tau / (1 + (wind[0] ** 2 + wind[1] ** 2) * tau / (4 * d)))
    return q / (4 * math.pi * d * r) * math.exp(-r / decay - (dx * wind[0] + dy * wind[1]) / (2 * d))


def test_every_name_of_the_api_is_there_and_typed_and_listed() -> None:
    tree = ast.parse((ROOT / "plumeward" / "__init__.py").read_text())
    (typed,) = (
        node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    names = {
        alias.asname or alias.name
        for node in typed.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert names | {"__version__"} == set(plumeward.__all__) <= set(dir(plumeward))
    for name in names:
        assert getattr(plumeward, name).__doc__
        assert getattr(plumeward, name).__name__ == {"read_record": "read"}.get(name, name)
    with pytest.raises(AttributeError, match="module 'plumeward' has no attribute 'rollouts'"):
        _ = plumeward.rollouts


def test_importing_loads_nothing_that_takes_long(tmp_path: Path) -> None:
    heavy = {"numpy", "gymnasium", "numba", "torch", "zenoh", "onnxruntime", "matplotlib", "ray"}
    ran = run(f"import sys, plumeward; print(sorted({heavy} & set(sys.modules)))", tmp_path)
    assert (ran.stdout, ran.stderr) == ("[]\n", "")


@pytest.mark.slow
def test_the_environments_are_made_by_name_after_an_import(tmp_path: Path) -> None:
    code = """
import gymnasium, plumeward
one = gymnasium.make("plumeward/SourceSearch-v0", particles=100)
assert isinstance(one.unwrapped, plumeward.SourceSearch)
assert one.observation_space.contains(one.reset(seed=1)[0])
assert gymnasium.make("plumeward/SourceSearchContinuous-v0").action_space.shape == (2,)
many = gymnasium.make_vec("plumeward/SourceSearch-v0", num_envs=3, vectorization_mode="vector_entry_point", particles=100)
assert isinstance(many.unwrapped, plumeward.SourceSearchVector)
assert len(many.reset(seed=1)[0]) == 3
"""
    ran = run(code, tmp_path)
    assert ran.returncode == 0, ran.stderr


@pytest.mark.slow
def test_a_rollout_by_default_is_homings_and_its_outcome_is_that_of_its_trace() -> None:
    outcome, trace = plumeward.rollout(seed=3)
    assert (outcome.policy, outcome.steps) == ("homing", len(trace) - 1)
    assert outcome.source == plumeward.draw(3).source
    assert outcome.error_m == pytest.approx(math.dist(trace[-1].mean, outcome.source))
    assert outcome.distance_m == pytest.approx(
        sum(math.dist(a.position, b.position) for a, b in pairwise(trace))
    )
    assert outcome.ceased == (trace[-1].spread < 0.5)
    assert trace == plumeward.rollout(3, "homing")[1]


def test_scenarios_are_of_table_1() -> None:
    drawn = [plumeward.draw(seed) for seed in range(2000)]
    values = np.array([(*it.source, it.q, it.u, it.phi, it.d, *it.start) for it in drawn])
    low, high = np.array(
        [(10, 25), (10, 25), (100, 500), (1, 4), (0, 2 * math.pi), (1, 8), (0, 5), (0, 5)], float
    ).T
    assert ((values >= low) & (values <= high)).all()
    # The mean of 2,000 uniform draws scatters by a width of 1/√12/√2000, 0.0065.
    assert ((values.mean(axis=0) - low) / (high - low)) == pytest.approx(0.5, abs=5 * 0.0065)


def test_a_world_answers_with_the_papers_gas_and_noise() -> None:
    scenario = plumeward.Scenario(
        source=(12.0, 15.0), q=250.0, u=2.0, phi=0.7, d=3.0, tau=10.0, start=(1.0, 2.0)
    )
    world = plumeward.World(scenario, seed=4)
    assert world.start == (1.0, 2.0)
    assert world.wind == pytest.approx((2 * math.cos(0.7), 2 * math.sin(0.7)))
    place = (10.5, 13.5)
    mean = mean_gas(place, (12.0, 15.0), world.wind, 250.0, 3.0, 10.0)
    readings = np.array([world.gas(place, step) for step in range(4000)])
    sigma = math.hypot(0.3 * mean, 0.2)
    assert readings.mean() == pytest.approx(mean, abs=4 * sigma / math.sqrt(4000))
    assert readings.std() == pytest.approx(sigma, rel=0.05)
    assert plumeward.World(scenario, seed=4).gas(place, 17) == readings[17]


def test_a_prior_is_uniform_over_the_area() -> None:
    posterior = plumeward.prior(plumeward.Config(particles=20_000))
    assert isinstance(posterior, plumeward.Posterior)
    assert posterior.particles.shape == (2, 20_000)
    assert posterior.particles.mean(axis=1) == pytest.approx([15, 15], abs=0.3)
    assert posterior.particles.std(axis=1) == pytest.approx([30 / math.sqrt(12)] * 2, rel=0.02)
    with pytest.raises(ValueError, match="a stop cannot wait for q"):
        plumeward.Config(stop_limits={"q": 5.0})


def test_two_readings_give_the_posterior_that_a_grid_gives() -> None:
    wind, rate, diffusivity = (1.5, -0.5), 250.0, 3.0
    config = plumeward.Config(particles=20_000, rate=rate, diffusivity=diffusivity)
    taken = [((8.0, 9.0), 1.3), ((12.0, 10.0), 2.1)]
    posterior = plumeward.prior(config)
    for step, (position, gas) in enumerate(taken):
        reading = plumeward.Reading(1000 * step, position, 5.0, wind, gas)
        posterior = plumeward.assimilate(posterior, reading, config)
        said, particles = plumeward.belief(posterior, reading, config)

    places = (np.arange(300) + 0.5) / 10
    log_density = np.zeros((300, 300))
    for position, gas in taken:
        means = np.array(
            [[mean_gas(position, (x, y), wind, rate, diffusivity, 10.0) for y in places] for x in places]
        )
        variance = (0.3 * means) ** 2 + 0.2**2
        log_density += -0.5 * np.log(variance) - (gas - means) ** 2 / (2 * variance)
    density = np.exp(log_density - log_density.max())
    density /= density.sum()
    x, y = density.sum(axis=1) @ places, density.sum(axis=0) @ places
    spread = math.sqrt(density.sum(axis=1) @ (places - x) ** 2 + density.sum(axis=0) @ (places - y) ** 2)
    assert said.mean == pytest.approx((x, y), abs=0.05 * spread)
    assert said.spread == pytest.approx(spread, rel=0.05)
    assert isinstance(said, plumeward.Belief)
    assert (said.step, said.ceased) == (1, False)
    assert particles.shape == (20_000, 3)
    assert particles[:, 2].sum() == pytest.approx(1, rel=1e-4)
    assert particles[:, 2] @ particles[:, :2] == pytest.approx(said.mean, rel=1e-3)


def test_readings_of_ones_own_give_the_beliefs_of_a_mission() -> None:
    scenario = plumeward.draw(5)
    _, trace = plumeward.rollout(5, particles=300, budget=12, assume="paper")
    config = plumeward.Config(300, seed=derived_seed(5, "estimator"), rate=scenario.q, diffusivity=scenario.d)
    posterior = plumeward.prior(config)
    for step, point in enumerate(trace):
        reading = plumeward.Reading(
            step, point.position, 5.0, plumeward.World(scenario, 5).wind, point.reading
        )
        posterior = plumeward.assimilate(posterior, reading, config)
        said, _ = plumeward.belief(posterior, reading, config)
        assert (said.mean, said.spread) == (point.mean, point.spread)


@pytest.mark.full
@pytest.mark.slow
def test_figures_are_those_of_the_missions_one_by_one() -> None:
    seeds = range(1_000_000, 1_000_006)
    said = plumeward.evaluate(["homing", "random"], scenarios=6, particles=200, budget=60)
    assert list(said) == ["homing", "random"]
    for policy, figures in said.items():
        flown = [plumeward.rollout(seed, policy, 200, budget=60)[0] for seed in seeds]
        ceased = [outcome for outcome in flown if outcome.ceased]
        assert figures["missions"] == 6
        assert figures["ceased"] == pytest.approx(len(ceased) / 6)
        assert figures["located"] == pytest.approx(sum(outcome.located for outcome in flown) / 6)
        if ceased:
            assert figures["mtd_m"] == pytest.approx(np.mean([outcome.distance_m for outcome in ceased]))
    assert (
        plumeward.evaluate("homing", 6, particles=200, budget=60)["homing"]["mtd_m"]
        == said["homing"]["mtd_m"]
    )


@pytest.mark.full
@pytest.mark.slow
def test_policies_are_compared_in_several_worlds() -> None:
    both = plumeward.evaluate("homing", 4, particles=200, budget=60, world=["as-modelled", "gain-halved"])
    assert list(both) == ["homing world=as-modelled", "homing world=gain-halved"]
    for world in ("as-modelled", "gain-halved"):
        alone = plumeward.evaluate("homing", 4, particles=200, budget=60, world=world)
        assert list(alone) == ["homing"]
        assert alone["homing"]["error_mean_m"] == both[f"homing world={world}"]["error_mean_m"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"policies": []},
        {"policies": "homming"},
        {"scenarios": 0},
        {"workers": 0},
        {"world": []},
        {"world": "windy"},
    ],
)
def test_what_cannot_be_evaluated_is_a_value_error(wrong: dict) -> None:
    with pytest.raises(ValueError, match=r"wanted|Wanted"):
        plumeward.evaluate(**{"scenarios": 1, **wrong})


SEEDS, COUNTS = f"a whole number from 0 to {2**63 - 1}", "a whole number from 10 to 1000000"
NUMBERS: list[tuple[str, Any, str]] = [
    *(
        ("particles", value, f"particles {value!r} is not allowed; wanted {COUNTS}")
        for value in (1, "9", True, 1e3)
    ),
    *(
        ("threshold_m", value, f"threshold_m {value!r} is not allowed; wanted a number above 0 up to 100")
        for value in (math.nan, -1, 0, 1000, math.inf, "1")
    ),
    *(
        ("margin_m", value, f"margin_m {value!r} is not allowed; wanted a number from 0 up to 100000")
        for value in (-1, math.nan, 1e9, "3")
    ),
    ("stop_limits", {"x": -1}, "stop_limits: x -1 is not allowed; wanted a number above 0"),
    ("stop_limits", {"x": math.inf}, "stop_limits: x inf is not allowed; wanted a number above 0"),
    ("stop_limits", 5, "stop_limits 5 is not allowed; wanted a dict"),
    ("priors", 5, "priors 5 is not allowed; wanted a dict"),
    ("stop", 5, "stop 5 is not allowed; wanted spread:Z, metres, or within:R,P"),
    ("budget", "3", "budget: '3' is not allowed; wanted "),
    ("budget", 0, "budget: 0 is not allowed; wanted "),
    ("world", 5, "world: 5 is not allowed; wanted "),
    ("vehicles", 2.5, "vehicles 2.5 is not allowed; wanted a whole number from 1 to 8"),
    ("assume", None, "assume None is not allowed; wanted paper or field"),
]


@pytest.mark.parametrize(("name", "value", "said"), NUMBERS)
def test_what_a_command_refuses_functions_refuse_in_a_line(name: str, value: Any, said: str) -> None:
    for flown in (partial(plumeward.rollout, 1), partial(plumeward.evaluate, "homing", 1)):
        with pytest.raises((ValueError, TypeError), match=f"^{re.escape(said)}") as refused:
            flown(**{name: value})
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize("seed", [-1, 1.5, "1", 2**63, True, None], ids=str)
def test_seeds_are_whole_numbers_that_a_key_can_hold(seed: Any) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(f'seed {seed!r} is not allowed; wanted {SEEDS}')}$"):
        plumeward.rollout(seed)
    with pytest.raises(ValueError, match=f"^{re.escape(f'seed {seed!r} is not allowed; wanted {SEEDS}')}$"):
        plumeward.draw(seed)
    line = f"first_seed {seed!r} is not allowed; wanted a whole number from 0 to {2**63 - 2}"
    with pytest.raises(ValueError, match=f"^{re.escape(line)}$"):
        plumeward.evaluate("homing", 2, first_seed=seed)


@pytest.mark.parametrize(
    ("moves", "said"),
    [
        *(
            ({"step": step}, f"moves: step {step!r} is not allowed; wanted a number above 0 up to 10")
            for step in (0, -1, 100, math.nan, "1")
        ),
        *(
            ({"headings": count}, f"moves: headings {count!r} is not allowed; wanted 4 or 8")
            for count in (5, 3.5, "4", None)
        ),
        *(
            (
                {"measurements": count},
                f"moves: measurements {count!r} is not allowed; wanted a whole number from 1",
            )
            for count in (0, 10_001, 2.5)
        ),
        ({"speed": 3}, "moves {'speed': 3} are not allowed; wanted a dict of headings, step, measurements"),
        (3, "moves 3 are not allowed; wanted a dict of headings, step, measurements"),
    ],
)
def test_moves_are_those_that_a_command_allows(moves: Any, said: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(said)}"):
        plumeward.rollout(1, moves=moves)


def test_a_scenario_is_drawn_of_a_problem_however_it_is_said(tmp_path: Path) -> None:
    field, fields = tmp_path / "field.yaml", {"q": [20, 30], "u": 2}
    field.write_text("q: [20, 30]\nu: 2")
    drawn = plumeward.draw(5, plumeward.Problem(q=(20, 30), u=2))
    assert 20 <= drawn.q <= 30
    assert drawn.u == 2
    for said in (fields, json.dumps(fields), field, str(field)):
        assert plumeward.draw(5, said) == drawn
    assert plumeward.draw(5, "paper") == plumeward.draw(5)
    with pytest.raises(ValueError, match=r"^problem 5 is not allowed; wanted paper, a YAML file"):
        plumeward.draw(5, 5)  # type: ignore[arg-type]


def test_problems_and_bundles_are_taken_by_their_paths(tmp_path: Path) -> None:
    field, bundle = tmp_path / "field.yaml", ROOT / "agent" / "bundles" / "ppo.zip"
    field.write_text("budget: 3")
    few: dict[str, Any] = {"particles": 50, "assume": "paper"}
    by_path, _ = plumeward.rollout(1, bundle, problem=field, **few)
    assert (by_path.policy, by_path.steps) == (str(bundle), 3)
    assert plumeward.evaluate([bundle, "homing"], 1, problem=field, **few).keys() == {str(bundle), "homing"}
    assert plumeward.evaluate(bundle, 1, problem=field, **few).keys() == {str(bundle)}
    env = gymnasium.make("plumeward/SourceSearch-v0", problem=field, particles=50)
    env.reset(seed=1, options={"problem": field})
    assert [env.step(0)[3] for _ in range(3)] == [False, False, True]


@pytest.mark.parametrize("policy", [None, 5, "homming"], ids=str)
def test_a_policy_that_is_none_is_named(policy: Any) -> None:
    line = f"^{re.escape(f'policy: {policy!r} is not allowed')}"
    with pytest.raises(ValueError, match=line):
        plumeward.rollout(1, policy)
    for policies in (policy, [policy], ["homing", policy]):
        with pytest.raises(ValueError, match=line):
            plumeward.evaluate(policies, 1)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (
            {"rate": 250.0},
            "argument rate=250.0 is not allowed; wanted further knowledge of margin_m, priors, ",
        ),
        ({"ends": False}, "argument ends=False is not allowed; wanted further knowledge of "),
        (
            {"sensor": "hits:3,0.1"},
            "sensor 'hits:3,0.1' is not allowed; wanted a sensor, such as plume.sensors.names.parse",
        ),
        (
            {"priors": {"q": "gamma:2,150"}},
            "the prior 'gamma:2,150' of q is not allowed; wanted one such as estimator.priors.Gamma",
        ),
    ],
)
def test_an_argument_that_a_mission_cannot_take_is_named_with_those_that_it_can(
    wrong: dict, said: str
) -> None:
    for flown in (partial(plumeward.rollout, 1), partial(plumeward.evaluate, "homing", 1)):
        with pytest.raises(TypeError, match=f"^{re.escape(said)}"):
            flown(**wrong)


def test_the_policies_are_the_planners_the_learned_ones_and_plug_ins(tmp_path: Path) -> None:
    files = {path.stem.replace("_", "-") for path in (ROOT / "agent" / "planners").glob("*.py")} - {
        "--init--",
        "registry",
    }
    assert set(plumeward.policies()) == files | {"ppo", "dqn", "ddpg"}
    assert all(plumeward.policies().values())
    (tmp_path / "theirs.py").write_text('def fly(belief, particles, reach, rng):\n    """Fly north."""\n')
    about = tmp_path / "theirs-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1\n")
    (about / "entry_points.txt").write_text(
        "[plumeward.policies]\ntheirs = theirs:fly\nbroken = nowhere:fly\n"
    )
    code = (
        f"import sys; sys.path.append({str(tmp_path)!r}); import plumeward, json; "
        "print(json.dumps(plumeward.policies()))"
    )
    said = json.loads(run(code, tmp_path).stdout)
    assert said["theirs"] == "Fly north. [plug-in theirs:fly]"
    assert said["broken"].startswith("does not load: ModuleNotFoundError: ")


def test_a_record_is_read_back_as_it_was_written() -> None:
    recording = plumeward.read_record(str(GOLDEN))
    assert isinstance(recording, plumeward.Recording)
    with GOLDEN.open("rb") as file:
        written = [
            json.loads(message.data)["spread"]
            for _, channel, message in make_reader(file).iter_messages(topics=["belief"])
        ]
    assert [
        json.loads(entry.payload)["spread"] for entry in recording.entries if entry.key == "belief"
    ] == written
    assert len(written) > 5
    assert (recording.complete, recording.about["policy"]) == (True, "homing")
