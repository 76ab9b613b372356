"""What a recorder adds for viewers: the scene, followed while it is recorded."""

import math
from collections.abc import Sequence
from typing import Any

from link.bus.frames import frames_in
from link.bus.keys import BELIEF, MAVLINK_OUT, OF_VEHICLE, READING, WAYPOINT, row_name, vehicle_of
from link.record.record import Entry
from scene.follow.area import PLACING
from scene.follow.history import FIRST, begun
from scene.follow.telemetry import ATTITUDE, CONDITION, GLOBAL, LOCAL, TEXT
from scene.foxglove import Encoded, SceneEncoder, pose_slot

SLOTTED = CONDITION | {ATTITUDE, LOCAL, GLOBAL}  # kinds of telemetry of which few are enough


class RecordedScene:
    """The scene of a mission that is being recorded, of one vehicle or of several that search together.

    Its memory is bounded, and it follows no more telemetry than it shows.
    """

    def __init__(self, about: dict[str, Any], namespace: str, numbers: Sequence[int] = ()) -> None:
        """Begin.

        about: the run's own description, which for a simulation has the truth.
        numbers: of the vehicles of a search by several; none: of one alone.
        """
        self._vehicles = [
            _Followed(about, f"{OF_VEHICLE}{number}" if numbers else namespace, number)
            for number in numbers or (FIRST,)
        ]
        self.failure = ""  # why there are no more scenes: messages are recorded in any case

    def take(self, entry: Entry, stamp_ns: int) -> list[Encoded]:
        """Take a message; returns what changed for viewers.

        `stamp_ns` is the time at which it is recorded. Raises nothing.
        """
        if self.failure:
            return []
        try:
            return [said for vehicle in self._vehicles for said in vehicle.take(entry, stamp_ns)]
        except Exception as error:  # whatever a message did: the record goes on
            self.failure = f"no more scenes are recorded for viewers: {type(error).__name__}: {error}"
            return []


class _Followed:
    """One vehicle, as viewers see it. The first one has what all share."""

    def __init__(self, about: dict[str, Any], name: str, number: int) -> None:
        self._history = begun(about, name, number=number)
        self._number, aside = str(number), number != FIRST
        self._encoder = SceneEncoder(f"{name}/" if aside else "", aside=aside)
        self._slots: dict[int, int] = {}
        self._happening: object = self  # none is this one: the first message gives a scene

    def take(self, entry: Entry, stamp_ns: int) -> list[Encoded]:
        """Take a message; returns what changed."""
        if number := vehicle_of(entry.key):
            if number != self._number:
                return []
            entry = entry._replace(key=row_name(entry.key))
        news = self._news(entry) if entry.key == MAVLINK_OUT.name else ()
        if entry.key == MAVLINK_OUT.name and not news:
            return []
        self._history.take(
            entry.key, entry.payload, entry.attachment, entry.simulation_s, entry.published_ns / 1e9
        )
        if entry.key == READING.name:
            return []  # its belief shows it
        happening = self._history.happenings.at(math.inf)
        if entry.key == BELIEF.name or happening is not self._happening:
            self._happening = happening
            return self._encoder.encode(self._history.at(), stamp_ns)
        if entry.key == WAYPOINT.name:
            return list(self._encoder.encode_waypoint(self._history.waypoints.at(), stamp_ns))
        return list(self._encoder.encode_pose(self._history.craft, stamp_ns)) if LOCAL in news else []

    def _news(self, entry: Entry) -> set[int]:
        """Return the kinds of telemetry in a payload that are to be followed.

        Of each kind of motion and condition these are the first messages of each slot of time.
        """
        news, slot, own = set(), pose_slot(entry.simulation_s), self._history.own
        own.learn(entry.key, entry.payload)
        for frame in frames_in(entry.payload):
            kind = frame.message_id
            is_own = own.sent(frame)
            if is_own and kind in SLOTTED and self._slots.get(kind) != slot:
                self._slots[kind] = slot
                news.add(kind)
            elif (is_own and kind in PLACING) or (kind == TEXT and (is_own or own.searched(frame))):
                news.add(kind)
        return news
