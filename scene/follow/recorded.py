"""A record of a mission as a history."""

from typing import Any

from link.record.reader import Recording
from scene.follow.described import backdrop_of, turns_of
from scene.follow.history import History


def begun(about: dict[str, Any], vehicle: str = "", *, whole: bool = False) -> History:
    """Return the history of a run of which only its own description is known; for `whole` see `History`."""
    return History(*backdrop_of(about, vehicle), turns=turns_of(about), whole=whole)


def history_of(recording: Recording, vehicle: str = "") -> History:
    """Return all that a record tells."""
    history = begun(recording.about, vehicle, whole=True)
    for entry in sorted(recording.entries, key=lambda entry: entry.published_ns):
        history.take(entry.key, entry.payload, entry.attachment, entry.simulation_s, entry.published_ns / 1e9)
    return history


def remark_on(recording: Recording, history: History) -> str:
    """Return what people should know who see the record, after its name: `is cut off ...`."""
    remarks = [recording.shortcoming]
    if history.missions > 1:
        remarks.append(f"holds {history.missions} missions, of which the last one is shown")
    if not recording.entries:
        remarks.append("holds no message")
    return ", and ".join(filter(None, remarks))
