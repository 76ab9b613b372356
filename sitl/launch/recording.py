"""The files of a mission's record: what must not be lost by them, and when they take the place of older ones."""

import os
from pathlib import Path

from link import cli


class RecordFiles:
    """An .mcap and the .tlog beside it. Older files of these names stay until there is a search to record."""

    def __init__(self, path: Path) -> None:
        """Take where the .mcap is to be."""
        self._wanted = path
        self.path = path
        """Where the recorder writes it."""
        self.made = False
        """Whether the recorder has made them; others are not ours."""

    def refusal(self, force: bool) -> str | None:
        """Say why they cannot be there. With `force` older files are no reason: then they are made beside these at first."""
        wanted = both(self._wanted)
        if reason := cli.existing("--record", wanted, force):
            return reason
        for path in wanted:
            if os.path.isdir(path):
                return f"--record: {str(path)!r} is a folder; wanted a file"
        if any(map(os.path.lexists, wanted)):
            self.path = self._wanted.with_name(f".{self._wanted.stem}-{os.getpid()}.mcap")
        return None

    def take_place(self) -> str:
        """The search has begun: replace older files. Returns what has gone wrong, empty if nothing has."""
        if self.path != self._wanted:
            try:
                for path, wanted in reversed(list(zip(both(self.path), both(self._wanted), strict=True))):
                    path.replace(wanted)
            except OSError as error:
                return f"the record stays in {self.path}: {error.strerror}"
            self.path = self._wanted
        return ""

    def give_up(self, *, refused: bool) -> None:
        """The mission has failed: of one that was refused no record stays, nor one that has not replaced older files."""
        if self.made and (refused or self.path != self._wanted):
            for path in both(self.path):
                path.unlink(missing_ok=True)


def both(path: Path) -> tuple[Path, Path]:
    """Return the two files of a record, of which the .mcap is given."""
    return path, path.with_suffix(".tlog")
