"""A record of a mission as a history."""

import math
from contextlib import suppress
from typing import Any

import msgspec

from link.record.reader import Recording
from plume.scenario import Scenario
from scene.follow.history import History, WindTurn
from scene.scene import Backdrop, Release


def backdrop_of(about: dict[str, Any], vehicle: str = "") -> tuple[Backdrop, int | None]:
    """Return the backdrop and the budget, from a run's own description; what it does not tell, or not in
    this version, is left out.
    """
    try:
        release = Release.of(msgspec.convert(about["scenario"], Scenario))
    except (KeyError, msgspec.ValidationError):
        release = None
    policy, seed, budget = about.get("policy"), about.get("seed"), about.get("budget")
    title = f"{policy}, seed {seed}" if policy is not None else ""
    name = vehicle or str(about.get("namespace", "vehicle"))
    return Backdrop(name, title=title, release=release), budget if isinstance(budget, int) else None


def turns_of(about: dict[str, Any]) -> list[WindTurn] | None:
    """Return the changes of the wind that a run's mission script has; one that is not as scripts have it
    is left out.

    None if the plume blew with the wind that a real vehicle reported.
    """
    if "vehicle" in about:
        return None
    mission = about.get("mission")
    events = mission.get("events") if isinstance(mission, dict) else None
    winds = [event for event in events or () if isinstance(event, dict) and event.get("do") == "wind"]
    turns = []
    for event in winds:
        with suppress(msgspec.ValidationError):
            turn = msgspec.convert(
                (event.get("step"), event.get("time_s") or 0.0, event.get("u"), event.get("phi")), WindTurn
            )
            if all(math.isfinite(value) for value in turn if value is not None):
                turns.append(turn)
    return turns


def history_of(recording: Recording, vehicle: str = "") -> History:
    """Return all that a record tells."""
    backdrop, budget = backdrop_of(recording.about, vehicle)
    history = History(backdrop, budget, turns=turns_of(recording.about))
    for entry in sorted(recording.entries, key=lambda entry: entry.published_ns):
        history.take(entry.key, entry.payload, entry.attachment, entry.simulation_s, entry.published_ns / 1e9)
    return history


def remark_on(recording: Recording, history: History) -> str:
    """Return what people should know who see the record, after its name: `is cut off ...`; empty if there
    is nothing.
    """
    remarks = [recording.shortcoming]
    if history.missions > 1:
        remarks.append(f"holds {history.missions} missions, of which the last one is shown")
    if not recording.entries:
        remarks.append("holds no message")
    return ", and ".join(filter(None, remarks))
