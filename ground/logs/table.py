"""A table as text (CSV), read row by row however large it is: its encoding, its delimiter, its first row."""

import codecs
import csv
import io
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import BinaryIO, NamedTuple

from link.cli import BadInput

SUFFIXES = (".csv", ".tsv", ".txt")
DELIMITERS = ",;\t|"
QUOTED = re.compile(r'"[^"]*"?')  # names between quotes, which may hold any of them
THOUSANDS = re.compile(r"[+-]?\d{1,3},\d{3}")  # or a decimal comma before three digits
LONGEST = 65_536  # characters of a row
MOST_LINES = 20  # of a row, whose cells may have breaks between quotes; of more, a quote is not closed
LOOKED_AT = 65_536  # bytes by which the encoding is told
MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}


class TextTable(NamedTuple):
    """The first row of a table, and the rows after it."""

    header: list[str]
    rows: Iterator[tuple[int, list[str]]]  # each with its number in the file; the first row is 1
    told: str  # encoding and delimiter, where they are not the usual ones


def is_table(path: Path) -> bool:
    """Whether a file is a table by its name."""
    return path.suffix.lower() in SUFFIXES


def read(path: Path, file: BinaryIO) -> TextTable:
    """Begin to read a table; `rows` reads on. Raises BadInput, as `rows` does."""
    encoding = _encoding(file)
    text = io.TextIOWrapper(file, encoding, errors="replace", newline="")
    lines = _lines(path, text)
    blank, first = next(((number, line) for number, line in enumerate(lines) if line.strip()), (0, ""))
    if not first:
        raise BadInput(f"{path} is empty; wanted a first row with the names of columns, and rows of values")
    if "\0" in first:
        raise BadInput(f"{path}, row 1: it is not text; wanted a table of comma-separated values (CSV)")
    delimiter = max(DELIMITERS, key=QUOTED.sub("", first).count)
    rows = _rows(path, chain([first], lines), delimiter, blank)
    header = [" ".join(name.split()) for name in next(rows)[1]]
    told = [encoding] * (encoding not in ("utf-8", "utf-8-sig"))
    told += [f"columns between {delimiter!r}"] * (delimiter != ",")
    return TextTable(header, rows, ", ".join(told))


def number(text: str, beside: str = "") -> float:
    """Return the number in a cell, which may have a decimal comma. Raises ValueError.

    beside: another number of the row. Where that has a point, the comma of 1,900 is none that can be told.
    """
    try:
        return float(text)
    except ValueError:
        if "." in beside and THOUSANDS.fullmatch(text):
            raise
        if text.count(",") == 1 and "." not in text and "_" not in text:
            return float(text.replace(",", "."))
        raise


def _encoding(file: BinaryIO) -> str:
    """Return the encoding of a file by its first bytes: its mark, else UTF-8 where they are that."""
    head = file.read(LOOKED_AT)
    file.seek(0)
    for mark, encoding in MARKS.items():
        if head.startswith(mark):
            return encoding
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _lines(path: Path, text: io.TextIOWrapper) -> Iterator[str]:
    number = 0
    while line := text.readline(LONGEST):
        number += 1
        if len(line) == LONGEST and not line.endswith("\n"):
            raise BadInput(
                f"{path}, row {number}: it has more than {LONGEST:,} characters; wanted a table of "
                "comma-separated values (CSV)"
            )
        yield line


def _rows(path: Path, lines: Iterator[str], delimiter: str, before: int) -> Iterator[tuple[int, list[str]]]:
    """Yield rows, each with the number of its last line in the file, of which `before` lines came before."""
    reader = csv.reader(lines, delimiter=delimiter)
    while True:
        begun = reader.line_num
        try:
            row = next(reader, None)
        except csv.Error as error:
            raise BadInput(
                f"{path}, row {before + begun + 1}: it cannot be read ({error}); wanted a table of "
                "comma-separated values (CSV)"
            ) from None
        if row is None:
            return
        if reader.line_num - begun > MOST_LINES:
            raise BadInput(
                f'{path}, row {before + begun + 1}: its quote (") is not closed before row '
                f"{before + reader.line_num}; wanted quotes in pairs, within {MOST_LINES} rows"
            )
        if row:
            yield before + reader.line_num, row
