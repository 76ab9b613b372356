"""A bundle's figures, measured on the test missions and written into it."""

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec

from agent.bundle import read, write
from agent.learn.env import Settings
from agent.trials.evaluate import FIRST_TEST_SEED, named, print_table
from agent.trials.sweep import Sweep, flown, journal_of, on_cores
from link.terminal import tell
from plume.problem import PAPER


def judge(bundle: Path, scenarios: int, particles: Sequence[int]) -> None:
    """Fly `scenarios` test missions with each number of particles and print the figures.

    A bundle that has figures keeps them.

    The estimator assumes what it assumed in training, and stops by the same `stop` if the recipe has one,
    else by the usual spread. What was trained on a set of problems flies `paper`.

    A journal beside the bundle keeps each flight until all have ended, so an interrupted call can resume.
    """
    page, graph = read(bundle)
    if page.evaluation:
        tell(f"{bundle} has its figures already")
        return
    settings = Settings(**page.training["env"])
    settings = replace(settings, threshold_m=None, budget=None)  # what it is flown with
    stop = settings.criterion
    sweep = Sweep(
        [str(bundle)],
        range(FIRST_TEST_SEED, FIRST_TEST_SEED + scenarios),
        particles,
        (stop,),
        knowledge={"assume": settings.assume},
        problem=PAPER if settings.draws else settings.searched,
    )
    journal = journal_of(sweep, bundle.parent)
    workers = os.cpu_count() or 1
    rows = flown(sweep, journal, on_cores(workers), "test missions", f"starting {workers} workers")
    evaluation = named(rows)
    figures = {str(said["particles"]): said for said in evaluation.values()}
    write(bundle, msgspec.structs.replace(page, evaluation=figures), graph)
    journal.unlink()
    print_table(evaluation, sys.stdout)
