"""The files of a mission: their name, and the summary of its outcome."""

import json
import os
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from plume import __version__
from sitl.launch.launcher import Flown


def run_name(policy: str, seed: int) -> str:
    """Return a unique name for a run's files."""
    return f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{Path(policy).stem}-seed{seed}-{os.getpid()}"


def write_summary(flown: Flown, path: Path) -> None:
    """Write a mission's outcome, trace and how it was flown to a file."""
    summary = {
        "flown_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "plumeward": __version__,
        "mission": msgspec.to_builtins(flown.script),
        "outcome": json.loads(flown.json(with_trace=True)),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(summary, indent=1) + "\n")
