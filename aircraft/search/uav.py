"""The UAV service: the loop that flies a search, measures, tells people, and lets clients have their part."""

import math
import queue
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from aircraft.aircraft import Clients, GasSensor
from aircraft.search.clock import Clock
from aircraft.search.events import (
    Delay,
    Dropout,
    Duplicate,
    Hold,
    Land,
    Lose,
    OnBoard,
    Resume,
    Return,
    Spike,
    Stuck,
    Timeline,
    Wind,
    words,
)
from aircraft.search.sampling import Sampling
from aircraft.search.search import PAUSED, RETURNING, SEARCHING, STANDBY, TAKING_OFF, Search
from aircraft.state import Arrived, Reached, TakenOver, VehicleFailed
from aircraft.together import Joining, misfit
from link.bus.backoff import Backoff
from link.bus.inbox import Inbox
from link.bus.keys import BELIEF, DEPARTURE, HEALTH, JOIN, LATECOMER, MAVLINK_IN, STOP, WAYPOINT
from link.bus.log import Log
from link.bus.mavlink import BadFrame, Codec, Message, unpack_plan, unpack_waypoint
from link.bus.messages import Belief, Departure, Health, Latecomer
from link.bus.session import SIGNAL_POLL_S, Arrival, Bus, LivelinessChange
from link.bus.tally import FAULT
from link.interrupts import uninterrupted
from link.signing.signer import Signing

ASK_S = 0.25  # real time after which a latecomer asks again for its part


class Speaker:
    """Tells people a text of a MAV_SEVERITY: in the log and, once there are clients, as STATUSTEXT (253)."""

    def __init__(self, log: Log) -> None:
        self.log = log
        self.clients: Clients | None = None

    def __call__(self, severity: int, text: str) -> None:
        """Tell a text."""
        self.note(severity, text)
        if self.clients:
            self.clients.tell(severity, text)

    def note(self, severity: int, text: str) -> None:
        """Log a text that the clients have heard already."""
        (self.log.warning if severity <= mavlink.MAV_SEVERITY_WARNING else self.log.info)(text)


class Handling:
    """The handling of clients' messages: a message that cannot be handled is dropped and counted."""

    def __init__(self, log: Log) -> None:
        """Take the log that is told of the first such message of each type, with the traceback."""
        self.log = log
        self._told: set[str] = set()

    @contextmanager
    def of(self, message: Message) -> Iterator[None]:
        """Drop what is raised while a message is handled, but not that the vehicle has failed."""
        try:
            yield
        except VehicleFailed:
            raise
        except Exception as error:
            self.log.tally.refuse(FAULT)
            if (kind := message.get_type()) not in self._told:
                self._told.add(kind)
                self.log.exception(
                    f"{kind} of {message.get_srcSystem()}/{message.get_srcComponent()} dropped: "
                    f"{type(error).__name__}: {error}"
                )


class Equipment(NamedTuple):
    """What a uav is connected to."""

    clock: Clock
    inbox: Inbox
    bus: Bus | None  # None for a plain MAVLink vehicle
    say: Speaker
    outs: Sequence[str] = ()  # URLs of its clients beside the bus
    signing: Signing | None = None


class Uav:
    """One vehicle on a search: the loop that connects its clock, its clients, its sensor and the bus."""

    def __init__(
        self,
        search: Search,
        clients: Clients,
        sensor: GasSensor,
        equipment: Equipment,
        events: Sequence[OnBoard] = (),
    ) -> None:
        """Take the search with its vehicle, and what is around it; it begins with `run`.

        events: those of a script that happen on board.
        """
        self._search, self._vehicle, self._clients, self._sensor = search, search.vehicle, clients, sensor
        self._clock, self._inbox, self._bus, self._say, *_ = equipment
        self._log, self._tally = equipment.say.log, equipment.say.log.tally
        self._handling = Handling(self._log)
        self._timeline = Timeline(events, self._perform)
        self._sampling = Sampling(search, clients, sensor, self._timeline, self._bus, self._log)
        self._services: set[str] = set()
        self._misfit = ""  # why it does not take off with the estimator that is there
        self._left: set[int] = set()  # the vehicles that have left a search of several
        self._early = b""  # waypoints that fit no round yet: who has left or come may not be known here
        self._joining: Joining | None = None  # while it comes late and has no part in the search yet
        self._asking = Backoff(ASK_S, ASK_S)
        self._astray = False  # whether it has been said that it cannot join from where it stands
        self._tally.state = search.state
        self._say.clients = clients
        self._meet()

    def _meet(self) -> None:
        """Speak with the vehicle's system id, once that is known."""
        if (system := self._clients.system) != self._tally.system:
            self._tally.system = system
            self._sampling.codec = Codec(system, self._clients.component)

    def run(self) -> None:
        """Run the service until it is interrupted."""
        if self._bus:
            together = [DEPARTURE, LATECOMER] if self._sensor.together.among > 1 else []
            for arrival in self._bus.kept(LATECOMER) if together else ():  # before it may take off
                self._handle(arrival)
            self._bus.subscribe(MAVLINK_IN, WAYPOINT, STOP, *together, *self._sensor.keys)
            self._bus.watch_services()
            self._bus.publish_health()
        # No KeyboardInterrupt: it could strike within a frame, be lost, or leave a real vehicle in the air.
        with uninterrupted() as ends:
            try:
                while not ends:
                    busy_since = time.perf_counter()
                    if not self._clock.speedup:
                        self._clock.jump(self._busy, self._next_event_s())
                    self._live_until(self._clock.now_s())
                    self._meet()
                    self._go_on_with_the_search()
                    failure = self._vehicle.failure or self._misfit
                    if failure and not self._vehicle.armed:  # it stands on the ground, or does so again
                        raise VehicleFailed("; ".join(filter(None, (failure, self._sampling.lack))))
                    self._sampling.go_on()
                    self._clients.serve()
                    self._tally.compute_s += time.perf_counter() - busy_since
                    if self._bus:
                        self._bus.keep_health()
                    self._inbox.tell_dropped(self._log)
                    self._handle(self._receive())
            finally:
                self._clients.end(self._say)

    # ---- time ----

    def _next_event_s(self) -> float | None:
        """Return the time of the next vehicle or script event if no message comes; None if there is none."""
        times = self._vehicle.next_event_s(), self._timeline.next_s()
        return min((at for at in times if at is not None), default=None)

    @property
    def _busy(self) -> bool:
        """True if the vehicle waits for nobody: at speed-up 0 time may then jump to the next event."""
        under_way = self._tally.state in (SEARCHING, PAUSED)
        scripted = under_way and self._timeline.next_s() is not None and not self._sampling.awaits_answer
        return self._vehicle.busy or scripted

    def _live_until(self, now_s: float) -> None:
        """Advance to a time; each script event happens at its exact time."""
        while (at := self._timeline.next_s()) is not None and at <= now_s:
            self._let_pass(max(at, self._vehicle.now_s))
            self._timeline.go_on(self._vehicle.now_s)
        self._let_pass(now_s)

    def _let_pass(self, now_s: float) -> None:
        for event in self._vehicle.advance(now_s):
            if isinstance(event, Arrived):
                self._sampling.arrived(event)
            elif isinstance(event, Reached):
                self._clients.send(mavlink.MAVLink_mission_item_reached_message(event.seq))
            elif isinstance(event, TakenOver):
                self._search.taken_over(event.mode, event.by)
            else:
                (self._say.note if event.heard else self._say)(event.severity, event.text)

    def _receive(self) -> Any:
        """Return what comes until something is due; None if nothing does."""
        wait_s = 0.0
        if self._clock.speedup or not self._busy:
            ask_s = self._asking.due_s - time.monotonic() if self._joining else math.inf
            wait_s = min(
                self._clock.wait_s(self._next_event_s(), math.inf),
                self._clients.wait_s(),
                max(self._sampling.next_s() - time.monotonic(), 0.0),
                ask_s if ask_s > 0.0 else math.inf,  # due, and not asked: it cannot yet
            )
        try:
            return self._inbox.get(timeout=min(wait_s, SIGNAL_POLL_S))
        except queue.Empty:
            return None

    # ---- what arrives ----

    def _handle(self, item: Any) -> None:
        match item:
            case LivelinessChange(service, alive):
                (self._services.add if alive else self._services.discard)(service)
                if self._bus and alive and service == "estimator" and self._search.state == STANDBY:
                    self._misfit = self._misfit_of(self._bus)
            case Arrival() if self._bus:
                try:
                    self._hear(self._bus, item)
                except BadFrame as error:
                    self._bus.refuse(item.key, str(error), error.kind)

    def _misfit_of(self, bus: Bus) -> str:
        """Return why it cannot search with the estimator that has come; empty if it can.

        Our estimator keeps its health before its token shows that it is there.
        """
        kept = [bus.decode(arrival, Health) for arrival in bus.kept(HEALTH, "estimator")]
        wrong = [misfit(said.about, self._sensor.together.among) for said in kept if said]
        return f"the estimator {wrong[-1]}" if any(wrong[-1:]) else ""

    def _hear(self, bus: Bus, arrival: Arrival) -> None:
        """Take a message from the bus. Raises BadFrame."""
        together = self._sensor.together
        if arrival.key is WAYPOINT and (self._search.left or self._sampling.newest < together.begin - 1):
            return  # it is for those that take part
        if arrival.key is WAYPOINT and together.among > 1:
            self._hear_plan(arrival.payload)
        elif arrival.key is WAYPOINT:
            self._answer(unpack_waypoint(arrival.payload, self._clients.system))
        elif arrival.key is DEPARTURE:
            if left := bus.decode(arrival, Departure):
                self._leaves(bus, left)
                self._hear_early()
        elif arrival.key is LATECOMER:
            if late := bus.decode(arrival, Latecomer):
                self._comes_late(bus, late)
                self._hear_early()
        elif arrival.key is BELIEF:
            if self._joining and (belief := bus.decode(arrival, Belief)):
                self._joining.hear(belief)
        elif arrival.key is STOP:
            if stop := bus.take_stop(arrival):
                self._search.declare(stop)
        elif arrival.key in self._sensor.keys:
            self._sampling.take(arrival.payload)
        else:
            self._clients.take(arrival)

    def _hear_plan(self, payload: bytes) -> None:
        """Take the waypoints of a round of several vehicles. Raises BadFrame.

        They may overtake the news that a vehicle has left or come: the first that do not fit wait for it.
        """
        try:
            self._take_plan(payload)
        except BadFrame as error:
            if error.kind != "other vehicle" or self._early:
                raise
            self._early = payload
        else:
            self._early = b""

    def _hear_early(self) -> None:
        """Take waypoints that waited for the news that has come. Raises BadFrame."""
        payload, self._early = self._early, b""
        if payload and not self._search.left:
            self._hear_plan(payload)

    def _take_plan(self, payload: bytes) -> None:
        waypoint, places = unpack_plan(payload, self._clients.system)
        step = self._sampling.newest
        wanted = len(self._sensor.together.here(step))
        if len(places) != wanted and waypoint.time_boot_ms == self._search.answers.newest:
            found = f"{len(places)} waypoints; wanted one for each of {wanted} vehicles"
            raise BadFrame(found, "other vehicle")
        own = waypoint.y, waypoint.x  # the vehicle judges it
        for x, y in (place for place in places if place != own):
            if wrong := self._vehicle.config.outside((y, x, 0.0)):
                raise BadFrame(f"the waypoint of another vehicle, {wrong[1]}", wrong[0])
        if self._answer(waypoint):
            self._sensor.go(places, step)

    def _leaves(self, bus: Bus, left: Departure) -> None:
        """Take that a vehicle has left the search. Raises BadFrame."""
        if left.vehicle in self._left:
            return
        if left.vehicle > self._sensor.together.among:
            raise BadFrame(
                f"vehicle {left.vehicle} of {self._sensor.together.among} has left", "other vehicle"
            )
        self._left.add(left.vehicle)
        self._sensor.together.leaves(left.vehicle, left.step)
        if left.vehicle == bus.vehicle:
            self._search.leave(left.reason)

    def _comes_late(self, bus: Bus, late: Latecomer) -> None:
        """Take how far a vehicle that comes late has come, this one perhaps. Raises BadFrame."""
        together = self._sensor.together
        if late.vehicle > together.among:
            raise BadFrame(f"vehicle {late.vehicle} of {together.among} comes late", "other vehicle")
        together.comes_late(late)
        if late.vehicle != bus.vehicle or self._search.state != STANDBY:
            return
        if together.begin < math.inf and self._joining:
            self._joining = None
            self._sampling.begin(int(together.begin))
        elif together.begin == math.inf and not self._joining and together.berth:
            self._joining = Joining(late.vehicle, together.berth)
            bus.subscribe(BELIEF, newest=True)

    def _answer(self, waypoint: Message) -> bool:
        """Take the answer to a reading; returns whether it is accepted."""
        with self._handling.of(waypoint):
            now_s = self._clock.now_s()
            result = self._search.answer(waypoint, now_s)
            self._clock.heard()
            if result.accepted:
                self._sampling.answered()
            elif result.code == mavlink.MAV_RESULT_DENIED:
                self._tally.refuse("waypoint")
                self._clients.refuse(result, now_s)
            return result.accepted
        return False

    # ---- the search ----

    def _go_on_with_the_search(self) -> None:
        absent = self._sensor.services - self._services
        ready = not (absent or self._misfit)
        self._search.go_on(ready and (not self._joining or self._search.found))
        if self._search.state == STANDBY:
            self._sensor.prepare(self._search.waits_for, absent)
        waits_for = self._search.waits_for or self._sensor.waits_for
        if self._joining and not (absent or waits_for or self._search.is_over):
            waits_for = self._ask_to_join(self._joining)
        self._tally.warnings = tuple(filter(None, (waits_for, self._vehicle.caveat)))
        if self._tally.state != self._search.state:
            self._tally.state = self._search.state
            if self._search.state == TAKING_OFF:
                self._tally.last_error = ""  # no warning from the ground is why it leaves a search later
            elif self._search.state == RETURNING and self._vehicle.failure:
                self._tally.last_error = self._vehicle.failure  # that is why, and not that it returns
            self._clients.changed()
            if self._bus:
                self._bus.publish_health()

    def _ask_to_join(self, joining: Joining) -> str:
        """Ask for its part in a search that others have begun; returns what it waits for."""
        if why := self._sensor.latecomer():
            if not self._astray:
                self._say(mavlink.MAV_SEVERITY_WARNING, why)
            self._astray = True
            return why
        self._astray = False
        if self._bus and self._vehicle.free and self._asking.due(time.monotonic()):
            self._bus.publish(JOIN, joining.asks)
        return f"joins late: waits for {'its round' if joining.asks.clear else 'a clear take-off'}"

    def _perform(self, event: OnBoard) -> None:
        self._say(mavlink.MAV_SEVERITY_INFO, words(event))
        match event:
            case Wind(u=u, phi=phi):
                self._sensor.blow(u, phi)
            case Dropout() | Stuck() | Spike():
                self._sampling.faults.begin(event, self._vehicle.now_s)
            case Delay() | Duplicate() | Lose():
                self._sampling.radio.begin(event)
            case Hold():
                self._clients.operate("hold")
                self._timeline.held(self._vehicle.now_s)
            case Resume():
                self._clients.operate("resume")
            case Return():
                self._clients.operate("return")
            case Land():
                self._clients.operate("land")
