"""The roll of a search by several vehicles: who takes part, who has left it or joins, from which round on.

When a vehicle leaves or joins is all in a search that a clock decides. It is therefore a message of the bus,
a departure or a latecomer: what follows from readings and those is the same wherever and whenever it is
computed.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from time import monotonic as now_s

import msgspec
from msgspec import UNSET

from estimator.admission import refusal
from estimator.filter import Config
from estimator.gathering import Gathering
from link.bus.keys import DEPARTURE, HEALTH, JOIN, LATECOMER, LEAVE_OUT, OF_VEHICLE, READING, Key
from link.bus.mavlink import READING_KINDS, BadFrame, Reading, split, unpack_reading
from link.bus.messages import Departure, Health, Join, Latecomer, LeaveOut, departure_text, latecomer_text
from link.bus.session import Arrival, Bus, LivelinessChange, part_of
from plume.problems.fleet import Place

OVERDUE_S = 20.0  # real time for which a round waits for a vehicle: the others hover meanwhile
PAYLOAD = "payload/"  # and a vehicle's number: its gas sensor, if it is a real one
AWAY = ("returning", "landed")  # states of a vehicle that reads no more
# How often it is looked who is missing; and real time after the start in which nobody leaves: what a vehicle
# has read before an estimator began comes within it.
LOOK_S, LEARN_S = 0.5, 5.0
MOST_FRAMES = 1_000_000  # bytes of readings that travel with a departure


@dataclass
class Attendance:
    """Who holds up the rounds of a search, since when, and what is known of them.

    It has no clock: callers pass the time, s.
    """

    overdue_s: float  # 0: nobody ever leaves
    present: set[int] = field(default_factory=set)  # vehicles that have a liveliness token
    health: dict[int, Health] = field(default_factory=dict)  # the newest of each vehicle
    sensors: dict[int, Health] = field(default_factory=dict)  # and of its payload, if it has one
    known: set[int] = field(default_factory=set)  # vehicles that have ever had a token
    _since_s: Mapping[int, float] = field(default_factory=dict)  # when each of the missing was missed first

    def look(self, time_s: float, missing: Sequence[int]) -> list[tuple[int, str]]:
        """Return who of those that a round waits for leaves, and why."""
        self._since_s = {vehicle: self._since_s.get(vehicle, time_s) for vehicle in missing}
        return [
            (vehicle, why)
            for vehicle, since_s in self._since_s.items()
            if self.overdue_s and (why := self._why(vehicle, time_s - since_s))
        ]

    def lives(self, vehicle: int, alive: bool) -> None:
        """Take that a vehicle has joined the bus or is gone."""
        (self.present.add if alive else self.present.discard)(vehicle)
        self.known.add(vehicle)

    def gone(self) -> Sequence[int]:
        """Return the vehicles that were there and are gone, if others are there."""
        return sorted(self.known - self.present) if self.present else []

    def forgive(self) -> None:
        """Count no time up to now: nobody could be heard."""
        self._since_s = {}

    def _why(self, vehicle: int, waited_s: float) -> str:
        health = self.health.get(vehicle)
        state = health.state if health else ""
        last = health.last_error if health else ""
        words = f": {last}" if last else ""
        if vehicle in self.present and state in AWAY:
            return last or state
        if waited_s < self.overdue_s:
            return ""
        if vehicle not in self.present:
            return f"gone from the bus for {self.overdue_s:g} s"
        if state == "paused":
            return f"paused for {self.overdue_s:g} s{words}"
        sensor = self.sensors.get(vehicle)
        words = f": {sensor.warnings[0]}" if sensor and sensor.warnings else words
        return f"no reading for {self.overdue_s:g} s{words}"


class Roll:
    """Receives the readings of a search, and keeps the roll of who takes them; with one vehicle idle."""

    def __init__(
        self, bus: Bus, rounds: Gathering, systems: list[int | None], config: Config, overdue_s: float
    ) -> None:
        """Learn who has left, and who came late, before we joined.

        systems: the MAVLink system id of each vehicle, None where it is not known yet.
        """
        self.left: list[Departure] = []
        self.late: dict[int, Latecomer] = {}  # who comes late, by number: what says most
        self.vehicles = len(systems)  # that began
        self._bus, self._rounds, self._systems, self._config = bus, rounds, systems, config
        self._several = len(systems) > 1
        self._attendance = Attendance(overdue_s)
        self._frames: list[list[bytes]] = [[] for _ in systems]  # of each vehicle's readings that count
        self._look_at_s, self._begin_at_s = 0.0, now_s() + LEARN_S
        # Who says that somebody leaves or joins; each returns whether that changes who is waited for.
        self._called: dict[Key, Callable[[Arrival], bool]] = {
            DEPARTURE: self._hear,
            LEAVE_OUT: self._leave_out,
            LATECOMER: self._hear_late,
            JOIN: self._join,
        }
        self._told: set[int] = set()  # those whose readings after they left have been told of
        if self._several:
            bus.subscribe(DEPARTURE, LATECOMER, LEAVE_OUT, JOIN, HEALTH)
            bus.watch_services()
            for arrival in bus.kept(LATECOMER):  # first: of one that came late and has left, both are known
                self._hear_late(arrival)
            for arrival in bus.kept(DEPARTURE):
                self._hear(arrival)

    def receive(self, most_s: float = math.inf) -> Arrival | None:
        """Return the next reading that may count.

        None if somebody has left or joins, or if none has come for `most_s` of real time.
        """
        until_s = now_s() + most_s
        while True:
            if self._several and self._look():
                return None
            left_s = min(LOOK_S, until_s - now_s())
            if left_s <= 0:
                return None
            match self._bus.receive(left_s if self._several else None):
                case Arrival(key) as arrival if key is READING:
                    if self._rounds.is_late(arrival.vehicle):
                        self._bus.refuse(READING, f"uav/{arrival.vehicle} has no round yet", "late")
                    elif self._rounds.is_over(arrival.vehicle):
                        self._refuse(arrival.vehicle)
                    else:
                        return arrival
                case Arrival(key) as arrival if key in self._called:
                    if self._called[key](arrival):
                        return None
                case Arrival(key) as arrival if key is HEALTH:
                    name = part_of(arrival.name)
                    vehicle = self._number(name.replace(PAYLOAD, OF_VEHICLE))
                    if vehicle and (health := self._bus.decode(arrival, Health)):
                        attendance = self._attendance
                        (attendance.sensors if PAYLOAD in name else attendance.health)[vehicle] = health
                case LivelinessChange(service, alive):
                    if vehicle := self._number(service):
                        self._attendance.lives(vehicle, alive)

    def forgotten(self, step: int) -> frozenset[int]:
        """Return the vehicles whose readings do not count in a round, nor those that they took before."""
        return frozenset(each.vehicle for each in self.left if each.forgotten and each.step <= step)

    def joining(self, step: int) -> dict[int, Place]:
        """Return where each vehicle takes off, (x, y) m, of which the others keep clear after a round."""
        return {
            each.vehicle: each.place
            for each in self.late.values()
            if each.place is not UNSET and each.since <= step and (each.step is UNSET or step < each.step)
        }

    def took(self, vehicle: int, payload: bytes) -> None:
        """Note the frames of a reading that counts."""
        if self._several:
            self._frames[vehicle - 1].append(payload)

    def _number(self, part: str) -> int:
        """Return the number of the vehicle that a part is; 0 if it is none of ours."""
        number = part.removeprefix(OF_VEHICLE)
        ours = part.startswith(OF_VEHICLE) and number.isdecimal() and 0 < int(number) <= len(self._systems)
        return int(number) if ours else 0

    def _look(self) -> bool:
        """Let those leave for whom the others have waited long enough; returns whether there are any."""
        time_s = now_s()
        if time_s < self._look_at_s:
            return False
        self._look_at_s = time_s + LOOK_S
        # On the ground all wait for each other: for one that has not come yet without end.
        holding_up = self._rounds.missing() if self._rounds.has_begun else self._attendance.gone()
        # One that has left, but whose readings have not all come, cannot leave again: `--silence` ends that.
        missing = [
            each for each in holding_up if not (self._rounds.has_ended(each) or self._rounds.is_late(each))
        ]
        if not missing or self._bus.tally.ceased or not self._bus.connected:
            self._attendance.forgive()
            return False
        leaving = self._attendance.look(time_s, missing)
        if time_s < self._begin_at_s:
            return False
        for vehicle, why in leaving:
            self._part(Departure(vehicle, self._rounds.step_of(vehicle), why))
        return bool(leaving)

    def _leave_out(self, arrival: Arrival) -> bool:
        """Let a vehicle leave as an operator orders; returns whether it does."""
        order = self._bus.decode(arrival, LeaveOut)
        if order is not None and order.late:
            return self._begin_without(order.vehicle)
        return order is not None and self.leave_out(order.vehicle, order.reason)

    def _begin_without(self, number: int) -> bool:
        """Let the others begin without a vehicle that has not come; returns whether they do."""
        if number in self.late:
            return False  # an estimator that starts again hears the order again
        why = ""
        if number not in (left := self._rounds.left()):
            why = f"uav/{number} is none of the {len(self._systems)} vehicles"
        elif number in self._attendance.known:
            why = f"uav/{number} has come"
        elif self._rounds.number or self._rounds.counts[number - 1]:
            why = "the search has begun"
        elif left == [number]:
            why = f"uav/{number} is the only one left"
        if why:
            self._bus.refuse(LEAVE_OUT, why, "order")
            return False
        return self._come_late(Latecomer(number))

    def _join(self, arrival: Arrival) -> bool:
        """Answer one that comes late and asks for its part; returns whether it comes nearer to it."""
        wanted, late = self._bus.decode(arrival, Join), self.late.get(arrival.vehicle)
        if wanted is None:
            return False
        why = "" if late else f"uav/{arrival.vehicle} does not come late"
        why = "the search has ceased" if self._bus.tally.ceased else why
        why = why or self._outside(wanted.place)
        if why or late is None:
            self._bus.refuse(JOIN, why, "order")
            return False
        now = self._rounds.number
        if late.says == 0:
            return self._come_late(Latecomer(late.vehicle, wanted.place, now))
        # It has to have seen a belief after which its place was kept clear.
        if late.says == 1 and wanted.clear and late.since < now:
            return self._come_late(msgspec.structs.replace(late, step=now))
        self._bus.publish(LATECOMER, late)  # it has not heard our answer
        return False

    def _hear_late(self, arrival: Arrival) -> bool:
        """Take from the bus how far a latecomer has come; returns whether it is news."""
        said = self._bus.decode(arrival, Latecomer)
        if said is None or said.says <= (self.late[said.vehicle].says if said.vehicle in self.late else -1):
            return False
        if said.vehicle > len(self._systems):
            self._bus.refuse(LATECOMER, f"vehicle {said.vehicle} of {len(self._systems)}", "other vehicle")
            return False
        if said.place is not UNSET and (why := self._outside(said.place)):  # no agent could plan with it
            self._bus.refuse(LATECOMER, why, "malformed")
            return False
        return self._come_late(said)

    def _outside(self, place: Place) -> str:
        """Return that a place is outside the area, in words; empty if it is not."""
        inside = all(map(math.isfinite, place)) and self._config.area.holds(place)
        return "" if inside else f"{place} is outside the area {self._config.area.text}"

    def _come_late(self, said: Latecomer) -> bool:
        """Note how far a latecomer has come, and say so; returns whether that can be."""
        try:
            self._rounds.comes_late(said.vehicle, math.inf if said.step is UNSET else said.step)
        except ValueError as error:
            self._bus.refuse(LATECOMER, str(error), "conflicting")
            return False
        self.late[said.vehicle] = said
        self._bus.publish(LATECOMER, said)
        self._bus.log.info(latecomer_text(said))
        return True

    def leave_out(self, number: int, reason: str) -> bool:
        """Let a vehicle leave from the next round on, its readings forgotten; returns whether it does."""
        left = self._rounds.left()
        if any(number == each.vehicle for each in self.left):
            return False  # an estimator that starts again hears the order again
        why = f"uav/{number} is none of the {len(self._systems)} vehicles" if number not in left else ""
        why = f"uav/{number} takes no part yet" if number in self.late and number not in left else why
        why = "the search has ceased" if self._bus.tally.ceased else why
        if not why and left == [number]:
            why = f"uav/{number} is the only one left"
        if why:
            self._bus.refuse(LEAVE_OUT, why, "order")
            return False
        self._part(Departure(number, self._rounds.number, reason, forgotten=self._rounds.number > 0))
        return True

    def _part(self, said: Departure) -> None:
        """Let a vehicle leave, and say so, with the frames of its readings that count."""
        before = self._rounds.step_of(said.vehicle) - self._rounds.counts[said.vehicle - 1]
        frames = b"".join(self._frames[said.vehicle - 1][: max(said.step - before, 0)])
        self._leave(said)
        self._bus.publish(DEPARTURE, said, frames if len(frames) <= MOST_FRAMES else None)

    def _hear(self, arrival: Arrival) -> bool:
        """Take a departure from the bus; returns whether it is news. One that cannot be is refused.

        News is said again: whoever told it may be gone when the agent starts again.
        """
        said = self._bus.decode(arrival, Departure)
        if said is None or any(said.vehicle == known.vehicle for known in self.left):
            return False
        try:
            if said.vehicle > len(self._systems):
                raise BadFrame(f"vehicle {said.vehicle} of {len(self._systems)}", "other vehicle")
            readings = self._unpacked(said, arrival.attachment)
            self._leave(said)
        except ValueError as error:
            self._bus.refuse(DEPARTURE, str(error), getattr(error, "kind", "conflicting"))
            return False
        for reading, frames in readings:
            if not self._rounds.is_over(said.vehicle) and not refusal(
                reading, self._rounds.newest[said.vehicle - 1], self._config
            ):
                self._rounds.take(reading)
                self.took(said.vehicle, frames)
        self._bus.publish(DEPARTURE, arrival.payload, arrival.attachment or None)
        return True

    def _unpacked(self, said: Departure, frames: bytes) -> list[tuple[Reading, bytes]]:
        """Return the readings that came with a departure, each with its frames. Raises BadFrame."""
        own, readings = said.vehicle - 1, []
        whole = split(frames) if frames else []
        for at in range(0, len(whole), len(READING_KINDS)):
            group = whole[at : at + len(READING_KINDS)]
            payload = b"".join(frame.data for frame in group)
            reading = unpack_reading(payload, self._systems[own])._replace(vehicle=said.vehicle)
            self._systems[own] = self._systems[own] or group[0].system
            readings.append((reading, payload))
        return readings

    def _leave(self, said: Departure) -> None:
        """Take a vehicle from the roll. Raises ValueError."""
        self._rounds.leave(said.vehicle, said.step)
        self.left.append(said)
        self._bus.log.info(departure_text(said))

    def _refuse(self, vehicle: int) -> None:
        """Count a reading of a vehicle that has left; the first is told."""
        if vehicle in self._told:
            self._bus.tally.refuse("left")
            return
        self._told.add(vehicle)
        self._bus.refuse(READING, f"uav/{vehicle} has left the search", "left")
