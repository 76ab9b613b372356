"""The files of a mission: its record, which may replace an older one, and the summary of its outcome."""

import argparse
import json
import os
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

from link import cli
from link.files import is_claimed
from plume import __version__


class RecordFiles:
    """An .mcap and the .tlog beside it. Older files of these names stay until a search has begun."""

    def __init__(self, path: Path) -> None:
        self._wanted = path
        self.path = path  # where the recorder writes
        self.made = False  # whether the recorder has made the files

    def prepare(self, force: bool) -> None:
        """Raise BadInput if the files cannot be written.

        With `force`, new files are first written beside older ones.
        """
        wanted = both(self._wanted)
        if reason := cli.existing("--record", wanted, force):
            raise cli.BadInput(reason)
        for path in wanted:
            if os.path.isdir(path):
                raise cli.BadInput(f"--record: {str(path)!r} is a folder; wanted a file")
            if is_claimed(path):
                raise cli.BadInput(f"--record: another process is writing {str(path)!r}; wanted another name")
        if any(map(os.path.lexists, wanted)):
            self.path = self._wanted.with_name(f".{self._wanted.stem}-{os.getpid()}.mcap")

    def take_place(self) -> str:
        """Replace older files, once the search has begun. Returns what went wrong, or an empty text."""
        if self.path != self._wanted:
            if is_claimed(self._wanted):
                return f"the record stays in {self.path}: another process is writing {self._wanted}"
            try:
                for path, wanted in reversed(list(zip(both(self.path), both(self._wanted), strict=True))):
                    path.replace(wanted)
            except OSError as error:
                return f"the record stays in {self.path}: {error.strerror}"
            self.path = self._wanted
        return ""

    def tell(self, to: TextIO) -> None:
        """Say where the record is, if there is one."""
        if self.made and self.path.exists():
            print(f"record   {self.path}", file=to)

    def give_up(self, *, refused: bool) -> None:
        """Clean up after a failed mission, and say where its record is.

        It is deleted if it was refused, or if older files are still in place.
        """
        if self.made and (refused or self.path != self._wanted):
            for path in both(self.path):
                path.unlink(missing_ok=True)
        self.tell(sys.stderr)


def record_file(text: str) -> Path:
    """Argument type: the file of a record."""
    path = Path(text)
    if path.suffix != ".mcap":
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted a file that ends in .mcap")
    return path


def both(path: Path) -> tuple[Path, Path]:
    """Return the two files of a record, given the .mcap."""
    return path, path.with_suffix(".tlog")


def run_name(policy: str, seed: int) -> str:
    """Return a unique name for a run's files."""
    return f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{Path(policy).stem}-seed{seed}-{os.getpid()}"


def write_summary(path: Path, mission: Any, outcome: Any) -> None:
    """Write how a mission was flown, its outcome and its trace to a file."""
    summary = {
        "flown_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "plumeward": __version__,
        "mission": mission,
        "outcome": outcome,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(summary, indent=1) + "\n")
