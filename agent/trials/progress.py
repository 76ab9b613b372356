"""The bar that shows how far missions or training are, on stderr."""

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


def progress_bar(*, stands: bool = False) -> Progress:
    """Return a bar of missions flown; with `stands`, one so narrow that a task's field of this name stands beside it in a line of 80."""
    columns: tuple[ProgressColumn, ...]
    if stands:
        columns = BarColumn(bar_width=8), TaskProgressColumn(), TimeRemainingColumn(), TextColumn("{task.fields[stands]}")
    else:
        columns = BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()
    return Progress(TextColumn("{task.description}"), *columns, console=Console(stderr=True))
