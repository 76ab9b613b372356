"""What a record holds, taken message by message: times, counts and the search, however large it is."""

from array import array
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from hashlib import blake2b
from itertools import islice, pairwise
from typing import NamedTuple

import msgspec

from ground.tlog.log import LISTED, few
from link.bus.keys import BELIEF, OF_VEHICLE, READING, STOP, row_name, vehicle_of
from link.bus.mavlink import WRAP_MS
from link.bus.messages import Belief, Departure, Latecomer, Stop, began_anew, by_number
from link.bus.session import part_of
from link.record.record import Entry, began_s
from link.terminal import printable
from plume.outcome import TracePoint

REPEATED = {READING.name, BELIEF.name, STOP.name}  # keys whose repeats mean something
PAUSE_S = 2.0  # A longer silence of the whole bus is reported, s: telemetry comes every second
LONGEST = 120  # longest description of an unreadable message, characters
MOST_REASONS = 1000  # different descriptions of unreadable messages that are kept


class KeyTable(NamedTuple):
    """The messages of one key, or of one type of MAVLink message."""

    name: str
    published_s: Sequence[float]
    simulation_s: Sequence[float]
    repeats: int | None  # number of repeated messages; None where repeats mean nothing


class Alive(msgspec.Struct):
    """The fields used of a health message."""

    uptime_s: float


class Survey:
    """What a record holds. No payload stays in memory."""

    def __init__(self, entries: Iterable[Entry]) -> None:
        self.published_s: dict[str, array[float]] = defaultdict(lambda: array("d"))
        self.simulation_s: dict[str, array[float]] = defaultdict(lambda: array("d"))
        # The times of all readings, ms, by their keys; `answered` has those of beliefs, as time_boot_ms,
        # which wraps.
        self.asked: dict[str, set[int]] = defaultdict(set)
        self.answered: dict[str, set[int]] = defaultdict(set)
        # By step, what the first belief of the step says: a point of each vehicle.
        self.trace: dict[int, list[TracePoint]] = {}
        self.last: Belief | None = None  # the first belief of the last step
        self.left: dict[int, Departure] = {}  # who has left a search of several, by number
        self.joined: dict[int, int] = {}  # who has joined it late, by number: the first round
        self.doubted: dict[int, int] = {}  # when a vehicle was named whose sensor seemed to lie: its step
        self.restarts: Counter[str] = Counter()
        # Digests of the messages of the keys whose repeats mean something.
        self._told: dict[str, set[bytes]] = defaultdict(set)
        self._alive: dict[str, tuple[float, float]] = {}  # each part's last message: when, and its uptime, s
        self._unreadable: Counter[str] = Counter()
        self._reasons: dict[str, dict[str, None]] = defaultdict(dict)
        for entry in entries:
            self._take(entry)

    @property
    def tables(self) -> list[KeyTable]:
        """Return a table for each key.

        Simulation times from before the vehicle told its clock are left out.
        """
        began = began_s(time_s for times in self.simulation_s.values() for time_s in times)
        told = {
            key: [time_s for time_s in times if time_s >= began] if began else times
            for key, times in self.simulation_s.items()
        }
        return [
            KeyTable(key, times, told[key], len(times) - len(self._told[key]) if key in self._told else None)
            for key, times in sorted(self.published_s.items())
        ]

    @property
    def unreadable(self) -> list[str]:
        """Return one line for each kind of messages that are no JSON, or of another version."""
        return [
            f"{count} {name}{'s' * (count > 1)} could not be read: {few(list(self._reasons[name]))}"
            for name, count in self._unreadable.items()
        ]

    def gaps(self) -> list[str]:
        """Return a line for each kind of gap: readings, steps, pauses, and restarts of services."""
        lines = []
        for key, times_ms in sorted(self.asked.items()):
            answered = self.answered[key]
            if unanswered := sorted(time_ms for time_ms in times_ms if time_ms % WRAP_MS not in answered):
                whose = f" of {OF_VEHICLE}{number}" if (number := vehicle_of(key)) else ""
                times = [f"{time_ms / 1000:.2f} s" for time_ms in unanswered[:LISTED]]
                lines.append(
                    f"{len(unanswered)} reading{'s' * (len(unanswered) > 1)}{whose} without a belief, at "
                    f"{few(times, len(unanswered))} of simulation"
                )
        steps = sorted(self.trace)
        # Missing ones are counted, not listed: a foreign message may have any step.
        if missing := max(steps, default=-1) + 1 - len(steps):
            absent = (
                str(step) for before, after in pairwise([-1, *steps]) for step in range(before + 1, after)
            )
            lines.append(f"{missing} beliefs missing, of step {few(list(islice(absent, LISTED)), missing)}")
        published_s = sorted(time for times in self.published_s.values() for time in times)
        pauses = [
            f"{after - before:.1f} s at {before - published_s[0]:.1f} s"
            for before, after in pairwise(published_s)
            if after - before > PAUSE_S
        ]
        if pauses:
            lines.append(f"{len(pauses)} pauses of the whole bus: {few(pauses)}")
        return lines + [
            f"{service} was restarted {count} time{'s' * (count > 1)}"
            for service, count in sorted(self.restarts.items())
            if count
        ]

    def _take(self, entry: Entry) -> None:
        self.published_s[entry.key].append(entry.published_ns / 1e9)
        self.simulation_s[entry.key].append(entry.simulation_s)
        kind_of = row_name(entry.key)
        if kind_of in REPEATED:
            self._told[entry.key].add(
                blake2b(f"{entry.simulation_s!r}".encode() + entry.payload, digest_size=16).digest()
            )
        if kind_of == READING.name:
            self.asked[entry.key].add(round(entry.simulation_s * 1000))
        for prefix, name, kind in (
            ("belief", "belief", Belief),
            ("agdc/stop", "stop", Stop),
            ("departure", "departure", Departure),
            ("latecomer", "latecomer", Latecomer),
            ("health/", "health message", Alive),
        ):
            if kind_of.startswith(prefix):
                try:
                    self._hear(entry, msgspec.json.decode(entry.payload, type=kind))
                except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                    self._unreadable[name] += 1
                    if len(self._reasons[name]) < MOST_REASONS:
                        self._reasons[name][_line(str(error))] = None

    def _hear(self, entry: Entry, message: msgspec.Struct) -> None:
        if isinstance(message, Belief) and message.step not in self.trace:
            each = by_number(message)
            self.trace[message.step] = [
                TracePoint(own.position, own.gas, own.mean, own.spread, number)
                for number, own in each.items()
            ]
            for number, own in each.items():
                self.answered[READING.named(vehicle=number if message.readings else None)].add(
                    own.time_boot_ms
                )
            for number in message.doubted or ():
                self.doubted.setdefault(number, message.step)
            if self.last is None or message.step > self.last.step:
                self.last = message
        elif isinstance(message, Departure):
            self.left.setdefault(message.vehicle, message)
        elif isinstance(message, Latecomer):
            if message.step is not msgspec.UNSET:
                self.joined.setdefault(message.vehicle, message.step)
        elif isinstance(message, Alive):
            part, now_s = part_of(entry.key), entry.published_ns / 1e9
            said_s, uptime_s = self._alive.get(part, (now_s, 0.0))
            self.restarts[part] += began_anew(message.uptime_s, uptime_s, now_s - said_s)
            self._alive[part] = now_s, message.uptime_s


def _line(text: str) -> str:
    """Return an error text that may quote a message, made safe for a terminal."""
    plain = printable(text)
    return plain if len(plain) <= LONGEST else f"{plain[:LONGEST]} ..."
