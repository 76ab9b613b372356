"""The files of a mission's record: when they may replace older ones, and when they are deleted."""

import os
from pathlib import Path

from link import cli
from link.files import is_claimed


class RecordFiles:
    """An .mcap and the .tlog beside it. Older files of these names stay until a search has begun."""

    def __init__(self, path: Path) -> None:
        """Take the path of the .mcap."""
        self._wanted = path
        self.path = path
        """Where the recorder writes."""
        self.made = False
        """Whether the recorder has made the files."""

    def refusal(self, force: bool) -> str | None:
        """Return why the files cannot be written, or None. With `force`, new files are first written
        beside older ones.
        """
        wanted = both(self._wanted)
        if reason := cli.existing("--record", wanted, force):
            return reason
        for path in wanted:
            if os.path.isdir(path):
                return f"--record: {str(path)!r} is a folder; wanted a file"
            if is_claimed(path):
                return f"--record: another process is writing {str(path)!r}; wanted another name"
        if any(map(os.path.lexists, wanted)):
            self.path = self._wanted.with_name(f".{self._wanted.stem}-{os.getpid()}.mcap")
        return None

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

    def give_up(self, *, refused: bool) -> None:
        """Clean up after a failed mission: delete the record if it was refused, or if older files are
        still in place.
        """
        if self.made and (refused or self.path != self._wanted):
            for path in both(self.path):
                path.unlink(missing_ok=True)


def both(path: Path) -> tuple[Path, Path]:
    """Return the two files of a record, given the .mcap."""
    return path, path.with_suffix(".tlog")
