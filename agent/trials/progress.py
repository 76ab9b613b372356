"""The progress bar of missions or training, on stderr."""

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

BAR = 40  # columns of the bar of missions on a wide terminal
BESIDE = 52  # columns of the text beside it
NARROW = 80  # on a narrower terminal training shows its text without a bar


def progress_bar(*, stands: bool = False) -> Progress:
    """Return a bar that counts missions; with `stands`, one of training beside the task's `stands`."""
    console = Console(stderr=True)
    columns: tuple[ProgressColumn, ...]
    if stands:
        bar = () if console.width < NARROW else (BarColumn(bar_width=8),)
        columns = *bar, TaskProgressColumn(), TimeRemainingColumn(), TextColumn("{task.fields[stands]}")
    else:
        bar = (BarColumn(bar_width=min(max(console.width - BESIDE, 4), BAR)),)
        columns = *bar, MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()
    return Progress(TextColumn("{task.description}"), *columns, console=console)


def with_bar(
    flights: Generator[Flown, None, None], total: int, what: str, starting: str
) -> Generator[Flown, None, None]:
    """Yield what `flights` yields and show a bar of `total`.

    It is named `starting` until the first result, then `what`.
    """
    with progress_bar() as progress, closing(flights):
        task = progress.add_task(starting, total=total)
        if not progress.console.is_terminal:
            progress.console.print(f"{starting} for {total:,} {what}", highlight=False)
        for flown in flights:
            progress.update(task, description=what, advance=1)
            yield flown
