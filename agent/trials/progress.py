"""The bar that shows how far missions or training are, on stderr."""

from collections.abc import Generator
from contextlib import closing
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

Flown = TypeVar("Flown")

BAR = 40
"""Columns of the bar of missions, where the terminal has room."""
BESIDE = 52
"""Columns of all that stands beside it."""
NARROW = 80
"""A narrower terminal gets no bar of training, but what is said beside it."""


def progress_bar(*, stands: bool = False) -> Progress:
    """Return a bar of missions flown; with `stands`, one of training: a task's field of this name stands beside it."""
    console = Console(stderr=True)
    columns: tuple[ProgressColumn, ...]
    if stands:
        bar = () if console.width < NARROW else (BarColumn(bar_width=8),)
        columns = *bar, TaskProgressColumn(), TimeRemainingColumn(), TextColumn("{task.fields[stands]}")
    else:
        bar = (BarColumn(bar_width=min(max(console.width - BESIDE, 4), BAR)),)
        columns = *bar, MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()
    return Progress(TextColumn("{task.description}"), *columns, console=console)


def with_bar(flights: Generator[Flown, None, None], total: int, what: str, starting: str) -> Generator[Flown, None, None]:
    """Yield what flights yield, beside a bar. It says `starting` until the first of them ends, then `what` is flown."""
    with progress_bar() as progress, closing(flights):
        task = progress.add_task(starting, total=total)
        if not progress.console.is_terminal:
            progress.console.print(f"{starting} for {total:,} {what}", highlight=False)
        for flown in flights:
            progress.update(task, description=what, advance=1)
            yield flown
