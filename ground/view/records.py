"""Recorded missions as the page shows them: their time line, and the scene at any time."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from link.record.reader import read
from scene.follow.history import History, history_of, remark_on
from scene.scene import Scene


class RecordedVehicle:
    """One record."""

    version = 0

    def __init__(self, name: str, history: History, path: Path) -> None:
        self.name, self.path = name, path
        self._history = history

    def entry(self) -> dict[str, Any]:
        """Return its row of the list of vehicles."""
        return {
            "name": self.name,
            "title": self._history.backdrop.title,
            "here": True,
            "has_truth": self._history.backdrop.release is not None,
            "begin_s": self._history.begin_s,
            "end_s": self._history.time_s,
            "findings": f"/findings/{quote(self.name, safe='')}",
            "readings_s": self._history.measurements.times_s,
            "moments": [
                (max(each.time_s, self._history.begin_s), each.level, each.who, each.text)
                for each in self._history.happenings.values
            ],
        }

    def scene(self, at_s: float | None = None) -> tuple[Scene, object, float | None]:
        """Return the scene at a simulation time, by default the last one, and which mission it is of.

        A record is not published.
        """
        return self._history.at(math.inf if at_s is None else at_s), self._history.missions, None


class RecordedFleet:
    """One record, or two to compare."""

    list_version = 0

    def __init__(self, paths: Sequence[Path]) -> None:
        """Read them; raises RecordError."""
        self.vehicles: dict[str, RecordedVehicle] = {}
        self.damaged = False  # whether pieces of them are missing
        remarks: list[str] = []
        for number, path in enumerate(paths, start=1):
            name = path.stem if path.stem not in self.vehicles else f"{path.stem} ({number})"
            recording = read(path)
            history = history_of(recording, name)
            self.damaged |= bool(recording.damage)
            self.vehicles[name] = RecordedVehicle(name, history, path)
            if remark := remark_on(recording, history):
                remarks.append(f"the record {name} {remark}")
        self.notice = "; ".join(remarks)  # what people should know of the files

    def end(self) -> None:
        """Nothing is open."""
