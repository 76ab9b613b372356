"""Text for people: tables that fit the terminal and lines broken at its width.

A file or a pipe gets all of it.
"""

import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.console import Group

GAP = 2  # spaces between two columns
LONGEST_WORD = 11  # characters. A longer heading is broken if its cells are narrower
UNLIMITED = 100_000  # columns of a line that nothing limits


@dataclass(frozen=True)
class Column:
    """One column of a table."""

    heading: str
    cells: Sequence[str]
    rank: int = 0  # columns of the highest rank are left out first; those of rank 0 never
    name: str = ""  # its name in the note about left-out columns; empty: its heading
    left: bool = False  # aligned to the left; numbers are aligned to the right
    stacks: bool = False  # on a narrow terminal its heading breaks at its comma, its cells at the first space
    least: int | None = None  # a longer cell may be cut to this many characters; None: never cut
    keeps_end: bool = False  # true: a cut cell keeps its end, as a path should; False: its beginning
    styles: Sequence[str] = ()  # a style of rich for each cell

    @property
    def width(self) -> int:
        """Characters of the longest line in it."""
        return max(
            (len(line) for text in (self.heading, *self.cells) for line in text.split("\n")), default=0
        )


def width_of(stream: TextIO) -> int | None:
    """Columns of the terminal that a stream goes to; None for a file or a pipe."""
    from rich.console import Console

    return Console(file=stream).width if stream.isatty() else None


def fitted(columns: Sequence[Column], width: int | None) -> tuple[list[Column], list[str]]:
    """Return the columns that fit a width, and the names of those left out.

    Cells are stacked, then cut, before a column goes.
    """
    if width is None or _total(columns) <= width:
        return list(columns), []
    kept = [_stacked(column) for column in columns]
    left_out: list[str] = []
    while _total(shown := _squeezed(kept, width)) > width and (last := max(column.rank for column in kept)):
        kept = [column for column in kept if column.rank < last]
        left_out = [column.name or column.heading for column in columns if column.rank >= last]
    return shown, left_out


def _total(columns: Sequence[Column]) -> int:
    return sum(column.width for column in columns) + GAP * (len(columns) - 1)


def _stacked(column: Column) -> Column:
    if column.stacks:
        return replace(
            column,
            heading=column.heading.replace(", ", "\n"),
            cells=[cell.replace(" ", "\n", 1) for cell in column.cells],
        )
    room = max(replace(column, heading="").width, LONGEST_WORD)
    return replace(column, heading="\n".join(textwrap.wrap(column.heading, room, break_long_words=False)))


def _squeezed(columns: Sequence[Column], width: int) -> list[Column]:
    """Cut cells, as far as that is allowed, until all columns fit."""
    result = list(columns)
    for i, column in enumerate(columns):
        excess = _total(result) - width
        if column.least is not None and excess > 0:
            result[i] = _cut(column, max(column.width - excess, column.least))
    return result


def _cut(column: Column, width: int) -> Column:
    def cut(text: str) -> str:
        if len(text) <= width:
            return text
        return f"…{text[1 - width :]}" if column.keeps_end else f"{text[: width - 1]}…"

    return replace(column, cells=[cut(cell) for cell in column.cells])


def table(
    columns: Sequence[Column],
    width: int | None,
    elsewhere: str = "",
    above: Sequence[str] = (),
    below: Sequence[str] = (),
) -> "Group":
    """Return a table for rich, with lines above and below it.

    The last line names what is left out and says how to see it.
    """
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    shown, left_out = fitted(
        [replace(column, cells=[printable(cell) for cell in column.cells]) for column in columns], width
    )
    grid = Table(box=None, header_style="bold", pad_edge=False, padding=(0, GAP, 0, 0), collapse_padding=True)
    for column in shown:
        grid.add_column(Text(column.heading), justify="left" if column.left else "right", no_wrap=True)
    for row in range(max((len(column.cells) for column in shown), default=0)):
        grid.add_row(
            *(Text(column.cells[row], column.styles[row] if column.styles else "") for column in shown)
        )
    note = (
        [f"left out: {', '.join(left_out)} (a wider terminal{f', or {elsewhere}' * bool(elsewhere)})"]
        if left_out
        else []
    )
    return Group(
        *(Text(broken(printable(line), width), "bold") for line in above),
        grid,
        *(Text(broken(printable(line), width)) for line in (*below, *note)),
    )


def printable(text: str) -> str:
    """Return a stranger's text as one line: unprintable characters are escaped as in Python."""
    return "".join(it if it.isprintable() else it.encode("unicode_escape").decode() for it in text)


def broken(text: str, width: int | None) -> str:
    """Break each line of a text at spaces to fit a width; continuation lines are indented.

    All of it is made printable.
    """
    lines = [printable(line) for line in text.split("\n")]
    if width is None:
        return "\n".join(lines)
    return "\n".join(
        part
        for line in lines
        for part in textwrap.wrap(line, width, subsequent_indent="  ", break_on_hyphens=False) or [""]
    )


def tell(said: "str | Group", stream: TextIO | None = None) -> None:
    """Print a text or a `table`, by default on stderr."""
    from rich.console import Console

    stream = stream or sys.stderr
    width = width_of(stream)
    if isinstance(said, str):
        print(broken(said, width), file=stream, flush=True)
        return
    console = Console(file=stream, width=width or UNLIMITED, highlight=False)
    with console.capture() as captured:  # rich would end the program on a closed pipe
        console.print(said)
    print("\n".join(line.rstrip(" ") for line in captured.get().split("\n")), end="", file=stream, flush=True)
