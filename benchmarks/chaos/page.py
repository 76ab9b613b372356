"""The rows of a campaign, and the table that docs/faults.md shows of them."""

import csv
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import msgspec

from benchmarks.chaos.faults import KINDS
from benchmarks.chaos.judge import AS_UNDISTURBED, BROKEN, FAILSAFE, TOLD

BEGIN, END = "<!-- campaign -->\n", "<!-- end -->"


class Row(msgspec.Struct, frozen=True):
    """One mission."""

    seed: int
    only: str
    """The kind that was asked for; empty if all were drawn."""
    faults: str
    """Those that were drawn, in words."""
    happened: str
    """Their kinds, and whom they hit, of those that happened: `hang uav;deaf`."""
    outcome: str
    steps: int
    wall_s: float

    @classmethod
    def of(cls, said: Mapping[str, Any], only: str) -> "Row":
        """Return the row of a verdict."""
        happened = ";".join(f"{fault['kind']} {fault.get('part', '')}".strip() for fault in said["done"])
        return cls(
            said["seed"], only, said["words"], happened, said["outcome"], said["steps"], said["wall_s"]
        )

    def cells(self) -> tuple[Any, ...]:
        """Return its cells, in the order of COLUMNS."""
        return msgspec.structs.astuple(self)


COLUMNS = Row.__struct_fields__


def read(path: Path) -> dict[tuple[int, str], Row]:
    """Read the rows of earlier campaigns, by seed and the kind that was asked for."""
    if not path.exists():
        return {}
    with path.open(newline="") as file:
        rows = [msgspec.convert(cells, Row, strict=False) for cells in csv.DictReader(file)]
    return {(row.seed, row.only): row for row in rows}


def page(text: str, rows: Collection[Row]) -> str:
    """Return the page with its table made anew; its prose stays. Raises ValueError if it has no place for
    the table.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"the page has no lines {BEGIN.strip()} and {END} to put the table between")
    return f"{before}{begin}\n{table(rows)}\n{end}{after}"


def table(rows: Collection[Row]) -> str:
    """Return the table: a line for each kind of fault, with the parts that it hit, and one for all."""
    lines = []
    for kind, fault in KINDS.items():
        by_part = {
            part: sum(f"{kind} {part}" in row.happened.split(";") for row in rows) for part in fault.parts
        }
        hit = [row for row in rows if any(it.partition(" ")[0] == kind for it in row.happened.split(";"))]
        parts = ", ".join(f"{part} {count}" for part, count in by_part.items())
        lines.append([f"`{kind}`", fault.what, parts, fault.promise, *_counts(hit)])
    lines.append(["all", "", "", "", *_counts(rows)])
    heads = ["fault", "what happens", "to", "promise", "missions", AS_UNDISTURBED, FAILSAFE, TOLD, BROKEN]
    told = "".join(f"| {' | '.join(line)} |\n" for line in (heads, ["---"] * len(heads), *lines))
    return told + f"\n{len(rows)} missions. One with several faults counts in the row of each.\n"


def _counts(rows: Collection[Row]) -> list[str]:
    return [
        str(len(rows)),
        *(
            str(sum(row.outcome == outcome for row in rows))
            for outcome in (AS_UNDISTURBED, FAILSAFE, TOLD, BROKEN)
        ),
    ]
