"""`plumeward train`: train a policy and export it as a bundle that the agent flies."""

import argparse
import os
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import msgspec

from agent.bundle import BundleError, CurvePoint, read
from agent.learn.train.folder import checkpoints, claim
from agent.learn.train.recipes import PRESETS, Recipe
from agent.trials.progress import NARROW, progress_bar
from link import cli
from link.terminal import tell
from plume.problem import Problem
from plume.problems.names import PROBLEMS
from plume.problems.options import add_problem_argument
from plume.randomness import MAX_SEED

KEPT_IN = Path("runs/train")
NEEDED = ("torch", "stable_baselines3", "gymnasium", "onnx", "tensorboard")
EVALUATED_AT = (100, 1000, 4000)  # numbers of particles with which a bundle's figures are measured


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `train`."""
    parser.add_argument("algorithm", choices=PRESETS["tuned"], help="learning algorithm: %(choices)s")
    parser.add_argument(
        "--preset",
        choices=PRESETS,
        default="tuned",
        help="recipe: our best one for a problem, the paper's, or one for any area, step and prior, which "
        "ppo learns in 14 minutes on a core (default: %(default)s)",
    )
    parser.add_argument(
        "--seed",
        type=cli.whole(0, MAX_SEED),
        default=0,
        help="the same seed gives the same policy (default: %(default)s)",
    )
    parser.add_argument(
        "--assume",
        choices=cli.ASSUMPTIONS,
        help="what the estimator takes to be known in training (default: as the recipe says, paper; with "
        "--preset anywhere paper at first, then field)",
    )
    cli.add_stop_argument(parser)
    cli.completed(add_problem_argument(parser), lambda: PROBLEMS, "yaml", "yml")
    parser.add_argument(
        "--steps", type=cli.whole(1, 10**12), metavar="N", help="moves to train on (default: the recipe's)"
    )
    parser.add_argument(
        "--out",
        type=cli.path,
        metavar="FOLDER",
        help=f"folder for checkpoints, curve and bundle (default: {KEPT_IN}/ALGORITHM-PRESET-SEED)",
    )
    parser.add_argument(
        "--threads",
        type=cli.whole(1, 4096),
        default=os.cpu_count() or 1,
        metavar="T",
        help="threads that share the missions, without effect on the result (default: all cores, "
        "%(default)s)",
    )
    parser.add_argument(
        "--scenarios",
        type=cli.whole(0, 10_000_000),
        default=1000,
        metavar="N",
        help="test missions to evaluate the bundle on (default: %(default)s)",
    )


def run(args: argparse.Namespace) -> int:
    """Train, export and evaluate; returns the exit status. Raises BadInput.

    If interrupted, the same command resumes.
    """
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise cli.BadInput(f"training needs {', '.join(missing)}: pip install 'plumeward[train]'")
    if args.algorithm not in PRESETS[args.preset]:
        raise cli.BadInput(
            f"--preset {args.preset}: there is no recipe of {args.algorithm}; wanted "
            f"{' or '.join(PRESETS[args.preset])}"
        )
    recipe = PRESETS[args.preset][args.algorithm]
    if args.steps is not None:
        at_a_time = recipe.moves_at_a_time
        recipe = msgspec.structs.replace(recipe, steps=-(-args.steps // at_a_time) * at_a_time)
    try:
        recipe = with_changes(recipe, args.assume, args.stop, args.problem)
    except ValueError as error:
        raise cli.BadInput(f"--{error}") from error
    folder: Path = args.out or KEPT_IN / f"{args.algorithm}-{args.preset}-{args.seed}"
    bundle = folder / f"{args.algorithm}.zip"
    try:
        claimed = claim(folder, recipe, args.seed)
    except OSError as error:
        raise cli.BadInput(
            f"--out: {str(folder)!r}: {error.strerror}; wanted a folder that can be written"
        ) from error
    except ValueError as error:
        raise cli.BadInput(f"--out: {error}") from error
    with claimed:
        _tell_of_steps(args.steps, recipe)
        try:
            _learn(recipe, args.seed, folder, args.threads, bundle)
            if args.scenarios:
                from agent.learn.train.judge import judge

                judge(bundle, args.scenarios, EVALUATED_AT)
        except BundleError as error:
            raise cli.BadInput(f"--out: {str(bundle)!r}: {error}; delete it to train again") from error
        except KeyboardInterrupt:
            tell(f"interrupted{_kept(recipe, folder, bundle)}")
            raise
    tell(f"fly it with\n  plumeward fly --policy {bundle}", sys.stdout)
    return 0


def with_changes(recipe: Recipe, assume: str | None, stop: str | None, problem: Problem | None) -> Recipe:
    """Return the recipe with another assumption, stop criterion or problem, or unchanged.

    Raises ValueError.
    """
    given = {"assume": assume, "stop": stop, "problem": problem.text if problem else None}
    usual = {"assume": "paper", "problem": "paper"}
    changes = {
        name: value
        for name, value in given.items()
        if value is not None and (name in recipe.first or value != (usual | recipe.env).get(name))
    }
    if not changes:
        return recipe
    from agent.learn.env import Settings  # here, because it loads the kernels

    env = {**recipe.env, **changes}
    Settings(**env)
    first = {name: value for name, value in recipe.first.items() if name not in changes}
    return msgspec.structs.replace(recipe, env=env, first=first)


def _tell_of_steps(asked: int | None, recipe: Recipe) -> None:
    """Say if a run is longer than asked for, or too short to learn anything."""
    if asked is None:
        return
    if recipe.steps != asked:
        at_a_time = f"{recipe.algorithm} learns from {recipe.moves_at_a_time:,} moves at a time"
        tell(f"--steps {asked}: rounded up to {recipe.steps:,}, since {at_a_time}")
    if recipe.steps <= (looks_on := recipe.settings.get("learning_starts", 0)):
        tell(
            f"warning: --steps {asked}: too few; {recipe.algorithm} begins to learn after {looks_on:,} moves"
        )


def _kept(recipe: Recipe, folder: Path, bundle: Path) -> str:
    """Return in words what an interrupted run has saved."""
    if bundle.exists():
        return f": {bundle} is trained. Run the command again: it resumes with the test missions"
    if checkpoints(folder):
        return f": {folder} holds the last checkpoint. Run the command again: it resumes there"
    return (
        f" before the first checkpoint at {recipe.checkpoint_steps:,} moves: nothing is saved, the "
        "command begins anew"
    )


def _learn(recipe: Recipe, seed: int, folder: Path, threads: int, bundle: Path) -> None:
    if bundle.exists():
        read(bundle)
        tell(f"{bundle} is already trained")
        return
    began = time.monotonic()
    with progress_bar(stands=True) as progress:
        wide = progress.console.width >= NARROW
        task = progress.add_task(recipe.algorithm, total=recipe.steps, stands="starting: loading torch")
        tell(f"training {recipe.algorithm} in {folder}: {recipe.steps:,} moves")
        from agent.learn.train.export import export
        from agent.learn.train.loop import train

        if kept := checkpoints(folder):
            tell(f"resuming from {kept[-1].name}")
        progress.update(task, stands="starting: first missions")

        def show(point: CurvePoint, speed: float) -> None:
            mtd = "–" if point.mtd_m is None else f"{point.mtd_m:.1f} m"
            ceased = f"ceased {100 * point.ceased:.1f}% " if wide else ""
            stands = f"{speed:,.0f} moves/s {ceased}located {100 * point.located:.1f}% MTD {mtd}"
            progress.update(task, completed=point.steps, stands=stands)
            if not progress.console.is_terminal:
                tell(f"{point.steps:,} moves: {stands}")

        model, curve = train(recipe, seed, folder, threads, show)
    export(model, recipe, seed, curve, bundle)
    tell(f"trained in {(time.monotonic() - began) / 60:.1f} minutes")
