"""`python -m agent train`: learn a policy, and write it down as a bundle that the agent flies."""

import argparse
import os
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import msgspec
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from agent.learn.train.recipes import PRESETS, Recipe
from link import cli
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
    recipe = recipe if args.steps is None else msgspec.structs.replace(recipe, steps=args.steps)
    folder: Path = args.out or KEPT_IN / f"{args.algorithm}-{args.preset}-{args.seed}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _claim(folder, recipe, args.seed)
    except (OSError, ValueError) as error:
        print(f"error: --out: {error}", file=sys.stderr)
        return cli.BAD_INPUT
    bundle = folder / f"{args.algorithm}.zip"
    try:
        _learn(recipe, args.seed, folder, args.threads, bundle)
        if args.scenarios:
            from agent.learn.train.judge import judge

            judge(bundle, args.scenarios, EVALUATED_AT)
    except KeyboardInterrupt:
        print(f"interrupted: {folder} keeps the last checkpoint; the same command goes on from there", file=sys.stderr)
        raise
    print(f"{bundle}: fly it with `python -m sitl --policy {bundle}`", file=sys.stderr)
    return 0


def _claim(folder: Path, recipe: Recipe, seed: int) -> None:
    """Raise ValueError where a folder holds another run than this one."""
    said = msgspec.json.format(msgspec.json.encode({"seed": seed, "recipe": recipe}))
    path = folder / "recipe.json"
    if path.exists() and path.read_bytes() != said:
        raise ValueError(f"{str(folder)!r} holds a run of another recipe or seed; wanted an empty folder, or the same command as then")
    partial = folder / "recipe.partial"
    partial.write_bytes(said)
    partial.replace(path)


def _learn(recipe: Recipe, seed: int, folder: Path, threads: int, bundle: Path) -> None:
    if bundle.exists():
        print(f"{bundle} is there already: trained to its end", file=sys.stderr)
        return
    from agent.bundle import Point
    from agent.learn.train.export import export
    from agent.learn.train.loop import checkpoints, train

    began = time.monotonic()
    # So narrow that all of it stands in a line of 80.
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=8),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[stands]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(recipe.algorithm, total=recipe.steps, stands="")
        if kept := checkpoints(folder):
            progress.console.print(f"goes on from {kept[-1].name}")

        def tell(point: Point, speed: float) -> None:
            mtd = "–" if point.mtd_m is None else f"{point.mtd_m:.1f} m"
            stands = f"{speed:,.0f} moves/s ceased {100 * point.ceased:.1f}% located {100 * point.located:.1f}% MTD {mtd}"
            progress.update(task, completed=point.steps, stands=stands)
            if not progress.console.is_terminal:
                progress.console.print(f"{point.steps:,} moves: {stands}")

        model, curve = train(recipe, seed, folder, threads, tell)
    export(model, recipe, seed, curve, bundle)
    print(f"trained in {(time.monotonic() - began) / 60:.1f} minutes", file=sys.stderr)
