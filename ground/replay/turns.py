"""Which reading closes each round of a search that vehicles leave or join, and when a replay calls it.

Each vehicle has a clock of its own, and the services answer a round at the time of its last reading. While
the last vehicle is the same, its clock tells the rounds apart. When it has left, or joins late, it is
another's, which may be behind.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec

from ground.replay.verify import Answer
from link.bus.keys import BELIEF, DEPARTURE, LATECOMER, READING, row_name
from link.bus.mavlink import BadFrame, nearest, split, unpack_reading
from link.bus.messages import Belief, Departure, Latecomer
from link.record.record import Entry

Said = tuple[int, int]  # the system of a reading, and its time_boot_ms


class Closing(NamedTuple):
    """A round, by the reading that closes it."""

    vehicle: int  # whose reading it is
    time_ms: int  # by which a replay calls it: later than those of the rounds before


@dataclass(frozen=True)
class Turns:
    """The rounds of a record; none where nobody has left or come late."""

    by_reading: dict[bytes, Closing] = field(default_factory=dict)  # by the frames of the closing reading
    # Of each vehicle what says most of how late it came, and then the first that says that it has left.
    roll: tuple[Entry, ...] = ()
    _by_said: dict[Said, Closing] = field(default_factory=dict)
    _by_step: dict[int, Closing] = field(default_factory=dict)
    _others: dict[bytes, frozenset[Said]] = field(default_factory=dict)  # the other readings of its round

    @classmethod
    def of(cls, entries: Iterable[Entry]) -> "Turns":
        """Return those of a record."""
        entries = list(entries)
        late: dict[int, tuple[int, Entry]] = {}
        departures: dict[int, Entry] = {}
        beliefs: dict[int, Belief] = {}
        for entry in entries:
            with suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
                if entry.key == DEPARTURE.name:
                    left = msgspec.json.decode(entry.payload, type=Departure)
                    departures.setdefault(left.vehicle, entry)
                elif entry.key == LATECOMER.name:
                    said = msgspec.json.decode(entry.payload, type=Latecomer)
                    if said.says > late.get(said.vehicle, (-1, entry))[0]:
                        late[said.vehicle] = said.says, entry
                elif entry.key == BELIEF.name:
                    belief = msgspec.json.decode(entry.payload, type=Belief)
                    beliefs.setdefault(belief.step, belief)
        roll = *(entry for _, entry in late.values()), *departures.values()
        if not roll:
            return cls()
        turns = cls(roll=roll)
        readings = {by: entry for entry in entries if (by := said_by(entry))}
        latest = -1
        for step, belief in sorted(beliefs.items()):
            each = [(one.system, one.time_boot_ms) for one in belief.readings or ()]
            if not (belief.readings and (last := readings.get(each[-1]))):
                continue
            latest = max(nearest(round(1000 * last.simulation_s), each[-1][1]), latest + 1)
            closing = Closing(belief.readings[-1].vehicle, latest)
            turns.by_reading[last.payload] = turns._by_said[each[-1]] = turns._by_step[step] = closing
            turns._others[last.payload] = frozenset(each[:-1])
        return turns

    def placed(self, answer: Answer, near_ms: float) -> Answer:
        """Return an answer with the time of its round; if that is not known, its own near to another, ms."""
        closing = self._by_said.get((answer.system, answer.time_ms))
        if closing is None and answer.kind == "stop" and isinstance(step := answer.fields.get("step"), int):
            closing = self._by_step.get(step)
        return answer.near(near_ms) if closing is None else answer._replace(time_ms=closing.time_ms)

    def named(self, entries: list[Entry]) -> list[Entry]:
        """Return messages with the plain name for the key of the readings that close a round."""
        return [
            entry._replace(key=row_name(entry.key)) if entry.payload in self.by_reading else entry
            for entry in entries
        ]

    def in_order(self, entries: list[Entry]) -> list[Entry]:
        """Return named messages so that the reading that closes a round comes after the others of it."""
        ordered: list[Entry] = []
        held: list[Entry] = []
        come: set[Said] = set()
        for entry in entries:
            if entry.key == READING.name:
                held.append(entry)
            else:
                ordered.append(entry)
                if said := said_by(entry):
                    come.add(said)
            ready = [each for each in held if self._others.get(each.payload, frozenset()) <= come]
            held = [each for each in held if each not in ready]
            ordered += ready
            come |= {said for each in ready if (said := said_by(each))}
        return ordered + held


def said_by(entry: Entry) -> Said | None:
    """Return the system and the time_boot_ms of a reading; None of all else."""
    if row_name(entry.key) != READING.name:
        return None
    with suppress(BadFrame):
        return split(entry.payload)[0].system, unpack_reading(entry.payload).time_boot_ms
    return None
