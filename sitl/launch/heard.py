"""What a launcher hears of a mission: services elsewhere, its parts, its search, where the vehicle lands."""

import contextlib
import math
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType

import msgspec

from aircraft.operator import AUTOPILOT
from aircraft.together import misfit
from link.bus.keys import (
    BELIEF,
    DEPARTURE,
    HEALTH,
    LATECOMER,
    MAVLINK_OUT,
    OF_VEHICLE,
    READING,
    SEARCHERS,
    STOP,
)
from link.bus.mavlink import BadFrame, nearest, unpack_reading
from link.bus.messages import Belief, Departure, Health, Latecomer, Stop, by_number, unpack_particles
from link.bus.session import Arrival, Bus, LivelinessChange, part_of
from plume.outcome import LastWord, Left, TracePoint, rate_interval
from scene.follow.area import PLACING, AreaFrame
from scene.follow.telemetry import LOCAL, frames
from sitl.launch.processes import MissionFailed

AT_HOME_M, ON_GROUND_M = 0.5, 0.1
TOLD_AFTER_S = 1.0  # how long services elsewhere may be missing until people are told
MOST_READINGS = 100_000  # readings that wait for their beliefs; a stranger could publish without end


def await_services(bus: Bus, namespace: str, vehicles: int, say: Callable[[str], None], wait_s: float) -> str:
    """Wait until estimator and agent are there; returns the agent's policy.

    `bus` has subscribed to HEALTH. Raises MissionFailed if one of them has already flown a mission or is
    not there after wait_s, if another vehicle is there, or if the estimator says that it searches with
    another number of vehicles.
    """
    if others := sorted(part for part in bus.services() if part == "uav" or part.startswith(OF_VEHICLE)):
        raise MissionFailed(f"another {others[0]} is already on {namespace}")
    bus.watch_services()
    alive: set[str] = set()
    health: dict[str, Health] = {}
    told, until_s = False, time.monotonic() + wait_s
    while missing := SEARCHERS - (alive & set(health)):
        if time.monotonic() >= until_s:
            raise MissionFailed(f"no {' and '.join(sorted(missing))} on {namespace} in {wait_s:g} s (--wait)")
        item = bus.receive(TOLD_AFTER_S)
        match item:
            case None if not told:
                say(f"waiting for {' and '.join(sorted(missing))} on {namespace}")
                told = True
            case LivelinessChange(service, there):
                (alive.add if there else alive.discard)(service)
                if not there:
                    health.pop(service, None)  # a restarted one has to report first
            case Arrival(key) if key is HEALTH:
                if (said := bus.decode(item, Health)) is not None:
                    health[said.service] = said
    for service in sorted(SEARCHERS):
        if health[service].step >= 0:
            raise MissionFailed(
                f"the {service} has already flown a mission, to step {health[service].step}: restart it"
            )
    if wrong := misfit(health["estimator"].about, vehicles):
        raise MissionFailed(f"the estimator on {namespace} {wrong}")
    return health["agent"].about


class VehicleHeard:
    """What has been heard of one vehicle."""

    def __init__(
        self, system: int | None, number: int | None, stand: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Take its MAVLink system id, if that is known, and its number in a search of several.

        stand: where it takes off, (x, y) m from home.
        """
        self.number, self._stand = number, stand
        self.part = "uav" if number is None else f"uav/{number}"
        self.called = "vehicle" if number is None else self.part
        self.health: Health | None = None  # the newest
        self.trace = HeardTrace()
        self.landed_since_s = math.inf  # when it was first heard to have landed
        self.ended = ""  # how its process has ended, if it has
        # (x, y) m from home, where it stands; followed once MAVLINK_OUT is subscribed.
        self.landed_at: tuple[float, float] | None = None
        self._system = system or 0
        self._area = AreaFrame()

    @property
    def system(self) -> int:
        """Its MAVLink system id by its health: a real autopilot has its own. 0: not known."""
        return (self.health.system if self.health else 0) or self._system

    @property
    def state(self) -> str:
        """What it is doing; empty before its first health."""
        return self.health.state if self.health else ""

    @property
    def landed(self) -> bool:
        """Whether it has landed since it began."""
        return self.landed_since_s < math.inf

    @property
    def flies(self) -> bool:
        """Whether it may still land."""
        return not self.landed and not self.ended

    @property
    def at_home(self) -> bool:
        """Whether it has landed where it took off."""
        there = self.landed_at if self.landed else None
        return there is not None and math.dist(there, self._stand) < AT_HOME_M

    @property
    def home(self) -> tuple[float, float] | None:
        """Latitude and longitude of home, degrees; followed once MAVLINK_OUT is subscribed."""
        return self._area.home[:2] if self._area.home else None

    def take_health(self, health: Health, now_s: float) -> None:
        """Take its health."""
        self.health = health
        if self.state == "landed":
            self.landed_since_s = min(self.landed_since_s, now_s)

    def follow_down(self, payload: bytes) -> None:
        """Note where it stands, m from home."""
        with contextlib.suppress(BadFrame):
            vehicle = self.system, AUTOPILOT
            for frame, fields in frames(
                payload, {*PLACING, LOCAL}, lambda frame: (frame.system, frame.component) == vehicle
            ):
                if frame.message_id in PLACING:
                    self._area.take(frame.message_id, fields)
                elif place := self._area.place(fields):
                    stands = self._area.on_ground or place[2] < ON_GROUND_M
                    self.landed_at = place[:2] if stands else None


class MissionHeard:
    """What has been heard of a mission so far."""

    def __init__(
        self,
        bus: Bus,
        system: int | None,
        stands: Mapping[int, tuple[float, float]] = MappingProxyType({}),
        late: Collection[int] = (),
    ) -> None:
        """Take the first vehicle's MAVLink system id.

        stands: of several that search together, by number, where they take off, (x, y) m from home.  late:
        those of them that join when the others have begun.
        """
        self._bus = bus
        self.vehicles = [VehicleHeard(system, None)]
        if stands:
            self.vehicles = [
                VehicleHeard(system and system + k, *each) for k, each in enumerate(stands.items())
            ]
        self.health: dict[str, Health] = {}  # the newest health of each part
        self.last: Belief | None = None  # the belief of the greatest step
        self._particles = b""  # of that belief
        self.distance_m = 0.0  # how far the vehicles have flown from the first belief to the last
        self.stopped = False  # whether the estimator has declared a stop
        self.warned = False  # whether the estimator has ever warned
        self.left: dict[
            int, Departure
        ] = {}  # who has left the search, by number, in the order in which they did
        self.joined: dict[int, int] = {}  # the first round of each that has joined late, in their order
        self._awaited = {*late}  # those that come late and have no round yet
        self.doubted: dict[int, int] = {}  # the step at which a vehicle was named whose sensor seemed to lie

    def take(self, arrival: Arrival, now_s: float) -> Belief | Health | Departure | Latecomer | None:
        """Take a message.

        Returns the health that it is, the belief that goes beyond the last one, the first departure of a
        vehicle, or its first round if it comes late.
        """
        if arrival.key is LATECOMER:
            return self._latecomer(self._bus.decode(arrival, Latecomer))
        if arrival.key is DEPARTURE:
            return self._departure(self._bus.decode(arrival, Departure))
        if arrival.key is STOP:
            self.stopped = self.stopped or self._bus.decode(arrival, Stop) is not None
        elif arrival.key is READING:
            vehicle = self._vehicle(arrival)
            vehicle.trace.reading(arrival.payload, vehicle.system or None)
        elif arrival.key is MAVLINK_OUT:
            self._vehicle(arrival).follow_down(arrival.payload)
        elif arrival.key is HEALTH:
            return self._health(arrival, now_s)
        elif arrival.key is BELIEF:
            return self._belief(self._bus.decode(arrival, Belief), arrival.attachment)
        return None

    def _vehicle(self, arrival: Arrival) -> VehicleHeard:
        return self.vehicles[arrival.vehicle - 1]

    def _departure(self, left: Departure | None) -> Departure | None:
        if left is None or left.vehicle in self.left or left.vehicle > len(self.vehicles):
            return None
        ended = self.vehicles[left.vehicle - 1].ended  # of a process that has ended this says why it left
        self.left[left.vehicle] = msgspec.structs.replace(left, reason=ended or left.reason)
        return left

    def _latecomer(self, late: Latecomer | None) -> Latecomer | None:
        if late is None or late.vehicle > len(self.vehicles) or late.vehicle in self.joined:
            return None
        if late.step is msgspec.UNSET:
            self._awaited.add(late.vehicle)
            return None
        self._awaited.discard(late.vehicle)
        self.joined[late.vehicle] = late.step
        self.vehicles[late.vehicle - 1].trace.begins(late.step)
        return late

    @property
    def flown(self) -> "list[VehicleHeard]":
        """The vehicles that take part in the search, or have."""
        return [vehicle for number, vehicle in enumerate(self.vehicles, 1) if number not in self._awaited]

    @property
    def searching(self) -> "list[VehicleHeard]":
        """The vehicles that take part in the search."""
        away = self.left.keys() | self._awaited
        return [vehicle for number, vehicle in enumerate(self.vehicles, 1) if number not in away]

    @property
    def departures(self) -> list[Left]:
        """Who has left the search, and whose process has ended in it."""
        said = {
            number: Left(number, each.step, each.reason, each.forgotten) for number, each in self.left.items()
        }
        ended = {
            number: Left(number, vehicle.trace.newest + 1, vehicle.ended)
            for number, vehicle in enumerate(self.vehicles, 1)
            if vehicle.ended
        }
        return [*(said | ended | said).values()]

    @property
    def trace(self) -> "HeardTrace":
        """The beliefs and readings of the vehicle that has searched longest.

        Those of the others have no other steps.
        """
        return max((vehicle.trace for vehicle in self.vehicles), key=lambda trace: trace.newest)

    def points(self) -> list[TracePoint] | None:
        """Return the trace, the vehicles' points one after the other in each step; None if it has gaps."""
        traces = [vehicle.trace.points() for vehicle in self.vehicles]
        if None in traces:
            return None
        whole = [trace for trace in traces if trace is not None]
        begins = [self.joined.get(number, 0) for number in range(1, len(whole) + 1)]
        return [
            msgspec.structs.replace(trace[step - begin], vehicle=number)
            for step in range(max(begin + len(trace) for begin, trace in zip(begins, whole, strict=True)))
            for number, (begin, trace) in enumerate(zip(begins, whole, strict=True), 1)
            if begin <= step < begin + len(trace)
        ]

    def _health(self, arrival: Arrival, now_s: float) -> Health | None:
        if health := self._bus.decode(arrival, Health):
            part = part_of(arrival.name)
            self.health[part] = health
            self.warned = self.warned or (part == "estimator" and bool(health.warnings))
            for vehicle in self.vehicles:
                if vehicle.part == part:
                    vehicle.take_health(health, now_s)
        return health

    def last_word(self, last: Belief) -> LastWord:
        """Return what else the last belief says; without its particles the rate has no interval."""
        return LastWord(last.covariance, last.rate, rate_interval_of(last, self._particles))

    def _belief(self, belief: Belief | None, particles: bytes) -> Belief | None:
        if not belief or max(seen := by_number(belief)) > len(self.vehicles):
            return None
        if not all([self.vehicles[number - 1].trace.belief(said) for number, said in seen.items()]):
            return None
        for number in belief.doubted or ():
            self.doubted[number] = min(belief.step, self.doubted.get(number, belief.step))
        if self.last:
            if belief.step < self.last.step:
                return None  # it was missed, and comes late
            before = by_number(self.last)
            self.distance_m += sum(
                math.dist(before[number].position, now.position)
                for number, now in seen.items()
                if number in before
            )
        self.last, self._particles = belief, particles
        return belief


def rate_interval_of(said: Belief, particles: bytes) -> tuple[float, float] | None:
    """Return the 95% interval of a belief's release rate, g/s; None if it is known, or not told."""
    with contextlib.suppress(ValueError):
        rows = unpack_particles(particles, len(said.unknowns))
        return rate_interval(said.unknowns, rows, said.intermittency)
    return None


class HeardTrace:
    """Beliefs by step, and the readings since the last of them before which none is missing.

    Beliefs are dropped where a link cannot carry them; readings never are.
    """

    def __init__(self) -> None:
        self._points: dict[int, TracePoint] = {}
        self._times: dict[int, float] = {-1: -math.inf}
        # The time of the newest belief, ms, which goes on where time_boot_ms wraps; before any,
        # that of the first reading.
        self._near_ms: int | None = None
        # The readings whose beliefs are not all known, by time.
        self.kept: dict[int, tuple[tuple[float, float], float]] = {}
        self._begin, self._whole_to = 0, -1

    def begins(self, step: int) -> None:
        """Take that the first step is another than 0."""
        self._begin, self._whole_to = step, step - 1
        self._times = {step - 1: -math.inf}

    def reading(self, payload: bytes, system: int | None) -> None:
        """Take a reading of a system, or with None of any.

        One that cannot be read is left to the estimator, which refuses it.
        """
        try:
            said = unpack_reading(payload, system)
        except BadFrame:
            return
        time_ms = self._time_ms(said.time_boot_ms)
        if time_ms > self._times[self._whole_to] and len(self.kept) < MOST_READINGS:
            self.kept.setdefault(time_ms, (said.position, said.gas))

    def _time_ms(self, time_boot_ms: int) -> int:
        if self._near_ms is None:
            self._near_ms = time_boot_ms
        return nearest(self._near_ms, time_boot_ms)

    def belief(self, belief: Belief) -> bool:
        """Take a belief; returns whether it is a new one."""
        if belief.step in self._points:
            return False
        self._points[belief.step] = TracePoint(belief.position, belief.gas, belief.mean, belief.spread)
        self._times[belief.step] = self._near_ms = self._time_ms(belief.time_boot_ms)
        if belief.step == self._whole_to + 1:
            while self._whole_to + 1 in self._points:
                self._whole_to += 1
            now = self._times[self._whole_to]
            self.kept = {time: said for time, said in self.kept.items() if time > now}
        return True

    def time_s(self, step: int) -> float:
        """Return the simulation time of a belief that has come, s."""
        return self._times[step] / 1000

    @property
    def newest(self) -> int:
        """The greatest step; -1 before any."""
        return max(self._points, default=-1)

    @property
    def missing(self) -> int:
        """How many beliefs before the last one have not come."""
        return max(self._points, default=self._begin - 1) + 1 - self._begin - len(self._points)

    def points(self) -> list[TracePoint] | None:
        """Return the trace; None if it has gaps.

        A belief that was not received has the position and gas of its reading, and NaN as mean and spread.
        This needs as many readings between two beliefs as beliefs are missing: the estimator may have
        refused some.
        """
        trace: list[TracePoint] = []
        times = sorted(self.kept)
        for step in sorted(self._points):
            if lost := step - (next_step := self._begin + len(trace)):
                between = times[
                    bisect_right(times, self._times[next_step - 1]) : bisect_left(times, self._times[step])
                ]
                if len(between) != lost:
                    return None
                trace += [
                    TracePoint(*self.kept[time], mean=(math.nan, math.nan), spread=math.nan)
                    for time in between
                ]
            trace.append(self._points[step])
        return trace
