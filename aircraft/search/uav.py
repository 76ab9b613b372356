"""The UAV service: the loop that flies a search, measures, and lets the vehicle's clients have their part."""

import math
import queue
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, cast

import msgspec
from pymavlink.dialects.v20 import common as mavlink

from aircraft.aircraft import Aircraft, Clients
from aircraft.operator import CommandName
from aircraft.payload.asking import Asking, Sample
from aircraft.remote.winds import Winds
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
    Wind,
)
from aircraft.search.faults import FaultyRadio, FaultySensor
from aircraft.search.handling import Handling
from aircraft.search.search import PAUSED, SEARCHING, STANDBY, AfterStop, Search
from aircraft.search.timeline import Timeline
from aircraft.state import Arrived, Led, Reached, VehicleFailed
from link.bus.inbox import Inbox
from link.bus.keys import (
    MAVLINK_IN,
    PAYLOAD_IN,
    PAYLOAD_OUT,
    READING,
    RESEND_FIRST_S,
    RESEND_LAST_S,
    SEARCHERS,
    STOP,
    WAYPOINT,
)
from link.bus.log import Log
from link.bus.mavlink import BadFrame, Codec, Message, Reading, pack_reading, unpack_waypoint
from link.bus.session import SIGNAL_POLL_S, Arrival, Bus, LivelinessChange
from link.interrupts import uninterrupted
from plume.world import World

if TYPE_CHECKING:
    from aircraft.remote.vehicle import RemoteVehicle

TRY_AGAIN_S = 1.0
"""Simulation time after which a sensor without a value is read again."""
SENSING = SEARCHERS | {"payload"}
"""A real vehicle takes off when these services have joined the bus."""


class Uav:
    """One vehicle in one world: the loop that connects its clock, its links and its sensor."""

    def __init__(
        self,
        vehicle: Aircraft,
        make_clients: "Callable[[Uav], Clients]",
        world: World,
        clock: Clock,
        inbox: Inbox,
        bus: Bus | None,
        log: Log,
        events: Sequence[OnBoard] = (),
        after_stop: AfterStop = "return",
        remote: "RemoteVehicle | None" = None,
        wind: tuple[float, float] | None = None,
    ) -> None:
        """Open the links of the clients; raises ValueError for a URL that cannot be used.

        log: the bus's own log if there is a bus; events: the script events that happen on board;
        after_stop: what the vehicle does once the source is found; remote: the vehicle, if it is a real
        one, which needs a bus, where its gas sensor answers; wind: of its readings, if it is given.
        """
        self._vehicle: Aircraft = vehicle
        self.search = self._search = Search(vehicle, world.start, after_stop, self._tell)
        self._world = world
        self._clock = clock
        self._inbox = inbox
        self._bus = bus
        self._log = log
        self._tally = log.tally
        self.handling = self._handling = Handling(log)
        self._timeline = Timeline(events)
        self._after_hold_s = [
            event.after_s for event in events if isinstance(event, Resume) and event.after_s is not None
        ]
        self._sensor = FaultySensor()
        self._radio = FaultyRadio(self._publish_reading)
        self._last_reading = b""
        self._last_time_boot_ms = -1
        self._readings = 0
        self._tried = -1  # number of the newest reading that was tried
        self._codec = Codec(0, 0)
        self._resend_s, self._resend_at = RESEND_FIRST_S, time.monotonic()
        self._asking: Asking | None = None
        self._asked: Arrived | None = None
        self._remote = remote
        self._winds = Winds(wind, world.wind)  # of a real vehicle
        self._searchers: set[str] = set()
        self._tally.state = self._search.state
        self._sampled_at = time.monotonic()
        self._clients = make_clients(self)
        if remote:
            assert bus is not None
            self._asking = Asking(lambda question: bus.publish(PAYLOAD_IN, question), self._codec)
        self._meet()

    @property
    def wind(self) -> tuple[float, float]:
        """The simulated wind, (u cos φ, u sin φ) m/s: points to where it comes from."""
        return self._world.wind

    def _meet(self) -> None:
        """Speak with the vehicle's system id, once that is known."""
        system = self._clients.system
        if system != self._tally.system:
            self._tally.system, self._codec = system, Codec(system, self._clients.component)
            if self._asking:
                self._asking.codec = self._codec

    def run(self) -> None:
        """Run the service until it is interrupted."""
        if self._bus:
            self._bus.subscribe(MAVLINK_IN, WAYPOINT, STOP, *[PAYLOAD_OUT] * bool(self._asking))
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
                    if (
                        self._vehicle.failure and not self._vehicle.armed
                    ):  # it has given the search up, and stands on the ground again
                        raise VehicleFailed(self._vehicle.failure)
                    self._resend()
                    self._clients.serve()
                    self._tally.compute_s += time.perf_counter() - busy_since
                    if self._bus:
                        self._bus.keep_health()
                    self._inbox.tell_dropped(self._log)
                    self._handle(self._receive())
            finally:
                self._clients.end(self._tell)

    # ---- time ----

    def _next_event_s(self) -> float | None:
        """Return the time of the next vehicle or script event if no message comes; None if there is none."""
        return min(
            (at for at in (self._vehicle.next_event_s(), self._timeline.next_s()) if at is not None),
            default=None,
        )

    @property
    def _busy(self) -> bool:
        """True if the vehicle waits for nobody: at speed-up 0 time may then jump to the next event."""
        under_way = self._tally.state in (SEARCHING, PAUSED)
        scripted = under_way and self._timeline.next_s() is not None and not self._must_resend
        return self._vehicle.busy or scripted

    def _live_until(self, now_s: float) -> None:
        """Advance to a time; each script event happens at its exact time."""
        while (at := self._timeline.next_s()) is not None and at <= now_s:
            self._let_pass(max(at, self._vehicle.now_s))
            if (at := self._timeline.next_s()) is not None and at <= self._vehicle.now_s:
                self._perform(self._timeline.pop())
        self._let_pass(now_s)

    def _let_pass(self, now_s: float) -> None:
        for event in self._vehicle.advance(now_s):
            if isinstance(event, Arrived):
                if self._measures:
                    self._sample(event)
            elif isinstance(event, Reached):
                self._clients.send(mavlink.MAVLink_mission_item_reached_message(event.seq))
            elif isinstance(event, Led):
                self._search.led(event.mode, event.by)
            elif event.heard:
                self._log_text(event.severity, event.text)
            else:
                self._tell(event.severity, event.text)

    def _receive(self) -> Any:
        next_event_s = self._next_event_s()
        if self._busy and not self._clock.speedup:
            timeout_s = 0.0
        else:
            timeout_s = min(self._clock.wait_s(next_event_s, math.inf), self._clients.wait_s())
            real_s = min(self._radio.next_s(), self._resend_at if self._must_resend else math.inf)
            real_s = min(real_s, self._asking.next_s() if self._asking else math.inf)
            timeout_s = min(timeout_s, max(real_s - time.monotonic(), 0.0))
        try:
            return self._inbox.get(
                timeout=min(timeout_s, SIGNAL_POLL_S)
            )  # the timeout may be infinite: a client can turn all streams off
        except queue.Empty:
            return None

    # ---- what arrives ----

    def _handle(self, item: Any) -> None:
        match item:
            case Arrival(key, payload) if key is WAYPOINT and self._bus:
                try:
                    self._answer(unpack_waypoint(payload, self._clients.system))
                except BadFrame as error:
                    self._bus.refuse(WAYPOINT, str(error), error.kind)
            case Arrival(key, payload) if key is PAYLOAD_OUT and self._asking and self._bus:
                try:
                    if (sample := self._asking.receive(payload)) and self._remote:
                        self._measured(self._remote, sample)
                except BadFrame as error:
                    self._bus.refuse(PAYLOAD_OUT, str(error), error.kind)
            case Arrival(key) if key is STOP and self._bus:
                if stop := self._bus.take_stop(item):
                    self._search.declare(stop)
            case LivelinessChange(service, alive):
                (self._searchers.add if alive else self._searchers.discard)(service)
            case None:
                pass
            case _:
                self._clients.take(item)

    def _answer(self, waypoint: Message) -> None:
        """Fly where the agent wants."""
        with self._handling.of(waypoint):
            awaited, now_s = self._search.answers.awaited, self._clock.now_s()
            result = self._search.answer(waypoint, now_s)
            self._clock.heard()
            if awaited and not self._search.answers.awaited:
                self._tally.latency_s = time.monotonic() - self._sampled_at
            if result.code == mavlink.MAV_RESULT_DENIED:
                self._tally.refuse("waypoint")
                self._clients.refuse(result, now_s)

    # ---- the search ----

    def _go_on_with_the_search(self) -> None:
        self._search.go_on(self._searchers >= (SENSING if self._asking else SEARCHERS))
        self._ask_for_the_wind()
        if self._remote and self._search.state == STANDBY:
            self._remote.preflight.bound(self._search.waits_for, SENSING - self._searchers)
        self._tally.warnings = tuple(filter(None, (self._search.waits_for, self._vehicle.caveat)))
        if self._tally.state != self._search.state:
            self._tally.state = self._search.state
            self._clients.changed()
            if self._bus:
                self._bus.publish_health()

    def _ask_for_the_wind(self) -> None:
        """Ask a real vehicle's payload on the ground whether it measures the wind: before that is known
        there is no flight.
        """
        remote, asking = self._remote, self._asking
        if not (remote and asking) or self._winds.source is not None:
            return
        if self._searchers >= SENSING and remote.preflight.has_read and not asking.waiting:
            asking.ask(round(remote.now_s * 1000), 0, remote.position, self._winds.asked(remote.wind))

    def _tell(self, severity: int, text: str) -> None:
        """Tell people: in the log and as STATUSTEXT (253)."""
        self._log_text(severity, text)
        self._clients.tell(severity, text)

    def _log_text(self, severity: int, text: str) -> None:
        (self._log.warning if severity <= mavlink.MAV_SEVERITY_WARNING else self._log.info)(text)

    @property
    def _measures(self) -> bool:
        """Whether an arrival is measured: at the search's waypoints, and everywhere by a plain vehicle,
        which has no bus.
        """
        return self._search.measures or self._bus is None

    def _sample(self, arrived: Arrived) -> None:
        """Take one reading where the vehicle came to rest, and publish it. A sensor without a value
        publishes NaN and is read again.
        """
        for event in self._timeline.before(self._readings):
            self._perform(event)
        north, east, _ = arrived.position
        boot_ms = self._vehicle.now_s * 1000 if arrived.boot_ms is None else arrived.boot_ms
        self._last_time_boot_ms = self._search.answers.time_of(boot_ms)
        if self._asking and self._remote:
            self._asked = arrived
            self._asking.ask(
                self._last_time_boot_ms,
                self._readings,
                arrived.position,
                self._winds.asked(self._remote.wind),
            )
            return
        lost = self._world.loses(self._readings) and self._tried < self._readings
        self._tried = self._readings
        silent = lost or self._sensor.silent(self._vehicle.now_s)
        self._read(
            arrived, math.nan if silent else self._world.gas((east, north), self._readings), self._world.wind
        )

    def _measured(self, remote: "RemoteVehicle", sample: Sample) -> None:
        """Take the payload's answer, unless the vehicle has been led away; the first, on the ground, says
        where the wind comes from.
        """
        arrived, self._asked = self._asked, None
        if self._winds.source is None:
            known = remote.flight.known
            remote.preflight.take_wind(
                self._winds.before(sample.wind, remote.wind, known.parameters, known.firmware.name)
            )
        elif arrived and self._measures and remote.doubtful:
            remote.arrive_again()
        elif arrived and self._measures:
            if wind := self._winds.of(sample.wind, remote.wind):
                self._read(arrived, math.nan if self._sensor.silent(remote.now_s) else sample.gas, wind)
            else:
                self._timeline.schedule(remote.now_s + TRY_AGAIN_S, arrived)
        for text in self._winds.news:
            self._tell(mavlink.MAV_SEVERITY_WARNING, text)
        self._winds.news.clear()

    def _read(self, arrived: Arrived, measured: float, wind: tuple[float, float]) -> None:
        """Make a reading of what was measured where the vehicle has arrived; NaN: the sensor has no value."""
        north, east, down = arrived.position
        gas = measured if math.isnan(measured) else self._sensor.read(measured)
        reading = pack_reading(self._codec, Reading(self._last_time_boot_ms, (east, north), -down, wind, gas))
        if math.isnan(gas):
            self._publish_reading(reading)
            self._timeline.schedule(self._vehicle.now_s + TRY_AGAIN_S, arrived)
            return
        self._clients.measured(self._last_time_boot_ms, gas)
        self._search.answers.sampled(self._last_time_boot_ms)
        self._last_reading = reading
        self._radio.new_reading()
        self._radio.send(reading, time.monotonic())
        self._sampled_at = time.monotonic()
        self._tally.did(self._readings)
        self._log.debug(f"reading {gas:.4g} at ({east:.2f}, {north:.2f}) m, {self._vehicle.now_s:.2f} s")
        if self._bus:
            self._bus.publish_health()
        self._readings += 1
        self._resend_s = RESEND_FIRST_S
        self._resend_at = time.monotonic() + self._resend_s
        for event in self._timeline.after(self._readings - 1):
            self._perform(event)

    def _publish_reading(self, reading: bytes) -> None:
        if self._bus:
            self._bus.publish(READING, reading)

    @property
    def _must_resend(self) -> bool:
        return self._bus is not None and self._search.wants_answers

    def _resend(self) -> None:
        """Publish an unanswered reading again: the reading, the belief or the waypoint may have been lost."""
        now_s = time.monotonic()
        self._radio.deliver(now_s)
        if self._asking:
            self._asking.again()
        if self._must_resend and now_s >= self._resend_at:
            self._radio.send(self._last_reading, now_s)
            self._resend_s = min(2 * self._resend_s, RESEND_LAST_S)
            self._resend_at = now_s + self._resend_s

    # ---- the script ----

    def _perform(self, event: OnBoard | Arrived) -> None:
        """Carry out a script event, or measure again after a dropout."""
        if isinstance(event, Arrived):
            if self._measures and not self._vehicle.moving:
                self._sample(self._vehicle.still(event))
            return
        words = " ".join(
            f"{name} {value}" for name, value in msgspec.structs.asdict(event).items() if value is not None
        )
        self._tell(mavlink.MAV_SEVERITY_INFO, f"Script: {event.__struct_config__.tag} {words}")
        match event:
            case Wind(u=u, phi=phi):
                world = self._world
                turned = {
                    "u": world.scenario.u if u is None else u,
                    "phi": world.scenario.phi if phi is None else phi,
                }
                self._world = World(
                    msgspec.structs.replace(world.scenario, **turned), world.seed, world.sensor, world.name
                )
            case Dropout() | Stuck() | Spike():
                self._sensor.begin(event, self._vehicle.now_s)
            case Delay() | Duplicate() | Lose():
                self._radio.begin(event)
            case Hold() | Resume() | Return() | Land():
                self._clients.operate(cast(CommandName, event.__struct_config__.tag))
                if isinstance(event, Hold) and self._after_hold_s:
                    due_s = self._vehicle.now_s + self._after_hold_s.pop(0)
                    self._timeline.schedule(due_s, Resume(time_s=due_s))
