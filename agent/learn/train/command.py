"""`python -m agent train`: learn a policy, and write it down as a bundle that the agent flies."""

import argparse
import os
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import msgspec

from agent.bundle import BundleError, Point, read
from agent.learn.train.folder import CheckpointError, checkpoints, claim
from agent.learn.train.recipes import PRESETS, Recipe
from agent.trials.progress import NARROW, progress_bar
from link import cli
from link.terminal import tell
from plume.randomness import MAX_SEED

KEPT_IN = Path("runs/train")
NEEDED = ("torch", "stable_baselines3", "gymnasium", "onnx", "tensorboard")
EVALUATED_AT = (100, 1000, 4000)
"""Numbers of particles that a bundle's figures are measured with."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `train`."""
    parser.add_argument("algorithm", choices=PRESETS["tuned"], help="what learns: %(choices)s")
    parser.add_argument(
        "--preset", choices=PRESETS, default="tuned", help="the recipe: what did best, or the paper's (default: %(default)s)"
    )
    parser.add_argument("--seed", type=cli.whole(0, MAX_SEED), default=0, help="the same seed gives the same policy (default: %(default)s)")
    parser.add_argument("--steps", type=cli.whole(1, 10**12), metavar="N", help="moves to learn from (default: the recipe's)")
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help=f"checkpoints, curve and bundle (default: {KEPT_IN}/ALGORITHM-PRESET-SEED)"
    )
    parser.add_argument(
        "--threads", type=cli.whole(1, 4096), default=os.cpu_count() or 1, metavar="T",
        help="that share the missions; they change no result (default: all cores, %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--scenarios",
        type=cli.whole(0, 10_000_000),
        default=1000,
        metavar="N",
        help="test missions to judge the bundle by (default: %(default)s)",
    )


def run(args: argparse.Namespace) -> int:
    """Train, export and judge; the same command goes on where it was cut off."""
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        print(f"error: training needs {', '.join(missing)}: pip install 'plumeward[train]'", file=sys.stderr)
        return cli.BAD_INPUT
    recipe = PRESETS[args.preset][args.algorithm]
    if args.steps is not None:
        at_a_time = recipe.moves_at_a_time
        recipe = msgspec.structs.replace(recipe, steps=-(-args.steps // at_a_time) * at_a_time)
    folder: Path = args.out or KEPT_IN / f"{args.algorithm}-{args.preset}-{args.seed}"
    bundle = folder / f"{args.algorithm}.zip"
    try:
        claimed = claim(folder, recipe, args.seed, bundle)
    except (OSError, ValueError) as error:
        print(f"error: --out: {error}", file=sys.stderr)
        return cli.BAD_INPUT
    with claimed:
        _tell_of_steps(args.steps, recipe)
        try:
            _learn(recipe, args.seed, folder, args.threads, bundle)
            if args.scenarios:
                from agent.learn.train.judge import judge

                judge(bundle, args.scenarios, EVALUATED_AT)
        except BundleError as error:
            print(f"error: --out: {str(bundle)!r}: {error}; delete it to train anew", file=sys.stderr)
            return cli.BAD_INPUT
        except CheckpointError as error:
            print(f"error: --out: {error}", file=sys.stderr)
            return cli.BAD_INPUT
        except KeyboardInterrupt:
            print(f"interrupted{_kept(recipe, folder, bundle)}", file=sys.stderr)
            raise
    tell(f"fly it with\n  plumeward fly --policy {bundle}", sys.stdout)
    return 0


def _tell_of_steps(asked: int | None, recipe: Recipe) -> None:
    """Say where a run is longer than it was asked to be, or too short to learn anything."""
    if asked is None:
        return
    if recipe.steps != asked:
        at_a_time = f"{recipe.algorithm} learns from {recipe.moves_at_a_time:,} moves at a time"
        print(f"--steps {asked}: {at_a_time}: trains {recipe.steps:,}", file=sys.stderr)
    if recipe.steps <= (looks_on := recipe.settings.get("learning_starts", 0)):
        print(
            f"--steps {asked}: {recipe.algorithm} begins to learn after {looks_on:,} moves: from so few it learns nothing", file=sys.stderr
        )


def _kept(recipe: Recipe, folder: Path, bundle: Path) -> str:
    """What an interrupted run leaves behind."""
    if bundle.exists():
        return f": {bundle} is trained; the same command goes on with its test missions"
    if checkpoints(folder):
        return f": {folder} keeps the last checkpoint; the same command goes on from there"
    return f" before the first checkpoint, after {recipe.checkpoint_steps:,} moves: nothing is kept; the same command begins anew"


def _learn(recipe: Recipe, seed: int, folder: Path, threads: int, bundle: Path) -> None:
    if bundle.exists():
        read(bundle)
        print(f"{bundle} is there already: trained to its end", file=sys.stderr)
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

        def show(point: Point, speed: float) -> None:
            mtd = "–" if point.mtd_m is None else f"{point.mtd_m:.1f} m"
            ceased = f"ceased {100 * point.ceased:.1f}% " if wide else ""
            stands = f"{speed:,.0f} moves/s {ceased}located {100 * point.located:.1f}% MTD {mtd}"
            progress.update(task, completed=point.steps, stands=stands)
            if not progress.console.is_terminal:
                tell(f"{point.steps:,} moves: {stands}")

        model, curve = train(recipe, seed, folder, threads, show)
    export(model, recipe, seed, curve, bundle)
    tell(f"trained in {(time.monotonic() - began) / 60:.1f} minutes")
