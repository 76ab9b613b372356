"""The files of a mission: its record, which may replace an older one, and the summary of its outcome."""

import json
import os
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

from link import cli
from link.files import drop_if_empty, is_claimed, whole
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

    def made_if(self, made: bool) -> None:
        """Note whether the recorder has made the files."""
        self.made = made

    def tell(self, to: TextIO) -> None:
        """Say where the record is, if there is one."""
        if self.made and self.path.exists():
            print(f"record   {self.path}", file=to)

    def give_up(self, *, refused: bool) -> None:
        """Clean up after a failed mission, and say where its record is.

        It is deleted if it was refused, or if older files are still in place. Files beside older ones are
        ours in any case.
        """
        if self.path != self._wanted or (self.made and refused):
            for path in both(self.path):
                path.unlink(missing_ok=True)
        self.tell(sys.stderr)


def give_up(files: RecordFiles | None, findings: Path | None, *, refused: bool = False) -> None:
    """Say where the record is of a mission that did not come to its end; no findings are made of it."""
    if findings:
        drop_if_empty(findings)
    if files:
        files.give_up(refused=refused)


def both(path: Path) -> tuple[Path, Path]:
    """Return the two files of a record, given the .mcap."""
    return path, path.with_suffix(".tlog")


# Names of the files that `findings` writes: `ground/findings/documents.py`; a test holds them equal.
FINDINGS = (
    "findings.html",
    "findings.geojson",
    "findings.kml",
    "findings.json",
    "figures.csv",
    "readings.csv",
)


def check_findings(folder: Path, force: bool, *, has_record: bool) -> None:
    """Raise BadInput if findings cannot be written into a folder, before the flight."""
    if not has_record:
        raise cli.BadInput("--findings: not with --no-record: findings are made of the record")
    cli.make_folder("--findings", folder, FINDINGS, force)


def write_findings(record: Path, folder: Path, to: TextIO) -> bool:
    """Let the command `findings` write what a recorded mission has found; returns whether it has.

    What it says goes to `to`, its warnings and errors to stderr.
    """
    words = ["-m", "sitl", "findings", str(record), "--out", str(folder), "--force"]
    try:
        done = subprocess.run(
            [sys.executable, *words], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, check=False
        )
    finally:
        drop_if_empty(folder)
    for line in done.stdout.splitlines():
        print(line, file=to)
    return done.returncode == 0


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
    with whole(path) as partial:
        partial.write_text(json.dumps(summary, indent=1) + "\n")
