"""Recorded missions as the page shows them: their time line, and the scene at any time."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from link.record.reader import read
from scene.follow.history import History, histories_of, remark_on
from scene.scene import Scene


class RecordedVehicle:
    """One vehicle of a record."""

    version = 0

    def __init__(self, name: str, history: History, path: Path, search: str = "") -> None:
        """Take its name on the page; `search`: the name of the record, if several vehicles search in it."""
        self.name, self.path, self.search = name, path, search or name
        self._history = history

    def entry(self) -> dict[str, Any]:
        """Return its row of the list of vehicles."""
        return {
            "name": self.name,
            "search": self.search,
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
    """The vehicles of one record, or of two to compare."""

    list_version = 0

    def __init__(self, paths: Sequence[Path]) -> None:
        """Read them; raises RecordError."""
        self.vehicles: dict[str, RecordedVehicle] = {}
        self.damaged = False  # whether pieces of them are missing
        remarks: list[str] = []
        for number, path in enumerate(paths, start=1):
            taken = {vehicle.search for vehicle in self.vehicles.values()}
            name = path.stem if path.stem not in taken else f"{path.stem} ({number})"
            recording = read(path)
            histories = histories_of(recording, name)
            self.damaged |= bool(recording.damage)
            for history in histories:
                called = history.backdrop.vehicle
                self.vehicles[called] = RecordedVehicle(called, history, path, name)
            if remark := remark_on(recording, histories[0]):
                remarks.append(f"the record {name} {remark}")
        self.notice = "; ".join(remarks)  # what people should know of the files

    def end(self) -> None:
        """Nothing is open."""
