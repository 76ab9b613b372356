"""Rows of benchmarks in files: one for each search, added as it is flown, so that an interrupt loses none."""

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

import msgspec

Row = TypeVar("Row", bound=msgspec.Struct)


def read(path: Path, kind: type[Row]) -> list[Row]:
    """Read the rows that there are."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [msgspec.convert(row, kind, strict=False) for row in csv.DictReader(file)]


def append(rows: Iterable[msgspec.Struct], path: Path) -> None:
    """Add rows to a file, with the names of their fields if it is new."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = not path.exists()
    with path.open("a", newline="") as file:
        for row in rows:
            writer = csv.DictWriter(file, row.__struct_fields__, lineterminator="\n")
            if new:
                writer.writeheader()
                new = False
            writer.writerow(msgspec.structs.asdict(row))
