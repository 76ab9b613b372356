"""The UAV service: flies, measures, and speaks MAVLink on the bus and over UDP."""

import math
import queue
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import msgspec
from pymavlink.dialects.v20 import common as mavlink

from link.bus.inbox import Inbox
from link.bus.keys import MAVLINK_IN, PAYLOAD_IN, PAYLOAD_OUT, READING, RESEND_FIRST_S, RESEND_LAST_S, SEARCHERS, STOP, WAYPOINT
from link.bus.log import Log
from link.bus.mavlink import BadFrame, Codec, Message, Reading, pack_reading, unpack, unpack_waypoint
from link.bus.px4 import MissionCurrent
from link.bus.session import SIGNAL_POLL_S, Arrival, Bus, LivelinessChange
from link.interrupts import uninterrupted
from link.signing.signer import Signing
from plume.world import World
from sitl.autopilot.operator import OPERATOR, CommandName, order
from sitl.autopilot.state import Arrived, Led, Reached, Snapshot, VehicleFailed
from sitl.autopilot.telemetry import Telemetry
from sitl.autopilot.vehicle import Vehicle
from sitl.bridge.bus_link import BRIDGED
from sitl.payload.asking import Asking, Sample
from sitl.protocol.protocol import COMPONENT, MavlinkProtocol
from sitl.script.events import Delay, Dropout, Duplicate, Hold, Land, Lose, OnBoard, Resume, Return, Spike, Stuck, Wind
from sitl.script.script import AfterStop
from sitl.uav.clock import Clock
from sitl.uav.faults import FaultyRadio, FaultySensor
from sitl.uav.handling import Handling
from sitl.uav.ports import BusLink, FromUdp, Port
from sitl.uav.real import leave
from sitl.uav.search import PAUSED, SEARCHING, SETPOINTS, Search
from sitl.uav.timeline import Timeline
from sitl.uav.udp import UdpLink

if TYPE_CHECKING:
    from sitl.remote.vehicle import RemoteVehicle

TRY_AGAIN_S = 1.0
"""Simulation time after which a sensor without a value is read again."""
SENSING = SEARCHERS | {"payload"}
"""A real vehicle takes off when these services have joined the bus."""


class Uav:
    """One vehicle in one world: the loop that connects its clock, its links and its sensor."""

    def __init__(
        self,
        vehicle: "Vehicle | RemoteVehicle",
        world: World,
        clock: Clock,
        inbox: Inbox,
        bus: Bus | None,
        outs: Sequence[str],
        log: Log,
        events: Sequence[OnBoard] = (),
        after_stop: AfterStop = "return",
        signing: Signing | None = None,
    ) -> None:
        """Open the links; raises ValueError for a UDP URL that cannot be used.

        vehicle: a real one needs a bus, where its gas sensor answers; outs: UDP URLs; log: the bus's own log if there is a bus;
        events: the script events that happen on board; after_stop: what the vehicle does once the source is found;
        signing: what signs its UDP links.
        """
        config = vehicle.config
        self._vehicle = vehicle
        self._remote = None if isinstance(vehicle, Vehicle) else vehicle
        self._protocol = MavlinkProtocol(vehicle)
        if self._remote:
            from sitl.remote.refused import not_served  # a simulated vehicle starts without all of MAVLink's dialects

            self._protocol.services |= {service.request: service for service in not_served()}
        self._search = Search(self._vehicle, self._protocol, world.start, after_stop, self._tell)
        self._world = world
        self._clock = clock
        self._inbox = inbox
        self._bus = bus
        self._log = log
        self._tally = log.tally
        self._handling = Handling(log)
        self._timeline = Timeline(events)
        self._after_hold_s = [event.after_s for event in events if isinstance(event, Resume) and event.after_s is not None]
        self._sensor = FaultySensor()
        self._radio = FaultyRadio(self._publish_reading)
        self._gas: tuple[int, float] | None = None
        self._last_reading = b""
        self._last_time_boot_ms = -1
        self._readings = 0
        self._tried = -1  # number of the newest reading that was tried
        self._codec = Codec(config.sysid, COMPONENT)
        self._resend_s, self._resend_at = RESEND_FIRST_S, time.monotonic()
        self._asking: Asking | None = None
        if self._remote and bus is not None:
            self._asking = Asking(lambda question: bus.publish(PAYLOAD_IN, question), self._codec)
        self._asked: Arrived | None = None
        self._felt: tuple[float, float] | None = None  # the wind of the last sample
        self._searchers: set[str] = set()
        self._progress = self._vehicle.progress
        self._tally.system, self._tally.state = config.sysid, self._search.state
        self._sampled_at = time.monotonic()
        self._ports: list[Port] = []
        self._udp: list[UdpLink] = []
        if bus is not None:
            self._ports.append(Port(BusLink(bus, config.sysid), self._telemetry()))
        for url in outs:
            index = len(self._ports)
            put = inbox.lane(url)
            signer = signing.link(url) if signing else None
            link = UdpLink(url, lambda *said, index=index, put=put: put(FromUdp(index, *said), 0), config.sysid, COMPONENT, signer)
            self._udp.append(link)
            self._ports.append(Port(link, self._telemetry()))

    def _telemetry(self) -> Telemetry:
        # The vehicle's time, not the streams' time: at speed-up 0 they differ.
        return Telemetry(lambda _: Snapshot(self._vehicle.config, self._vehicle.state(self._vehicle.now_s), self._wind, self._gas))

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
                    self._tell_progress()
                    self._go_on_with_the_search()
                    self._judge()
                    self._resend()
                    for port in self._ports:
                        if due := [*port.telemetry.due(self._clock.stream_s()), *self._protocol.due(port.telemetry)]:
                            port.link.send(*due)
                    self._tally.compute_s += time.perf_counter() - busy_since
                    if self._bus:
                        self._bus.keep_health()
                    self._inbox.tell_dropped(self._log)
                    for link in self._udp:
                        link.tell_refused(self._log)
                    self._handle(self._receive())
            finally:
                if self._remote:
                    leave(self._remote, self._clock, self._tell)
                for link in self._udp:
                    link.close()

    def _judge(self) -> None:
        """Raise VehicleFailed once a real vehicle has given the search up and stands on the ground again."""
        if self._remote and self._remote.failure and not self._remote.armed:
            raise VehicleFailed(self._remote.failure)

    # ---- time ----

    def _next_event_s(self) -> float | None:
        """Return the time of the next vehicle or script event if no message comes; None if there is none."""
        return min((at for at in (self._vehicle.next_event_s(), self._timeline.next_s()) if at is not None), default=None)

    @property
    def _busy(self) -> bool:
        """True if the vehicle waits for nobody: at speed-up 0 time may then jump to the next event."""
        vehicle, under_way = self._vehicle, self._tally.state in (SEARCHING, PAUSED)
        scripted = under_way and self._timeline.next_s() is not None and not self._must_resend
        return vehicle.moving or vehicle.landing or vehicle.waiting or scripted

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
                self._broadcast([mavlink.MAVLink_mission_item_reached_message(event.seq)])
            elif isinstance(event, Led):
                self._search.led(event.mode, event.given_back)
            else:
                self._tell(event.severity, event.text)

    def _receive(self) -> Any:
        next_event_s = self._next_event_s()
        if self._busy and not self._clock.speedup:
            timeout_s = 0.0
        else:
            next_stream_s = min(port.telemetry.next_due_s() for port in self._ports)
            timeout_s = self._clock.wait_s(next_event_s, next_stream_s)
            real_s = min(self._radio.next_s(), self._protocol.next_due_s(), self._resend_at if self._must_resend else math.inf)
            real_s = min(real_s, self._asking.next_s() if self._asking else math.inf)
            timeout_s = min(timeout_s, max(real_s - time.monotonic(), 0.0))
        try:
            return self._inbox.get(timeout=min(timeout_s, SIGNAL_POLL_S))  # the timeout may be infinite: a client can turn all streams off
        except queue.Empty:
            return None

    # ---- what arrives ----

    def _handle(self, item: Any) -> None:
        match item:
            case FromUdp(index, message, peer):
                port = self._ports[index]
                self._message(message, port, partial(self._search.receive, whence=f"at {peer}", streams=port.telemetry))
            case Arrival(key, payload, attachment) if key in (MAVLINK_IN, WAYPOINT) and self._bus:
                port, whence = self._ports[0], "through a bridge" if attachment == BRIDGED else "on the bus"
                take = self._search.answer if key is WAYPOINT else partial(self._search.receive, whence=whence, streams=port.telemetry)
                try:
                    messages = [unpack_waypoint(payload, self._vehicle.config.sysid)] if key is WAYPOINT else unpack(payload)
                except BadFrame as error:
                    self._bus.refuse(key, str(error), error.kind)
                    return
                for message in messages:
                    self._message(message, port, take)
            case Arrival(key, payload) if key is PAYLOAD_OUT and self._asking and self._bus:
                try:
                    if sample := self._asking.receive(payload):
                        self._measured(sample)
                except BadFrame as error:
                    self._bus.refuse(PAYLOAD_OUT, str(error), error.kind)
            case Arrival(key) if key is STOP and self._bus:
                if stop := self._bus.take_stop(item):
                    self._search.declare(stop)
            case LivelinessChange(service, alive):
                (self._searchers.add if alive else self._searchers.discard)(service)

    def _message(self, message: Message, port: Port, take: Callable[[Message, float], list[Message]]) -> None:
        with self._handling.of(message):
            refused, awaited = self._protocol.refused.total(), self._search.answers.awaited
            answers = take(message, self._clock.now_s())
            if message.get_type() in SETPOINTS:
                self._clock.heard()
            if awaited and not self._search.answers.awaited:
                self._tally.latency_s = time.monotonic() - self._sampled_at
            if self._protocol.refused.total() > refused:
                self._tally.refuse("waypoint")
            if texts := [answer.text for answer in answers if answer.get_type() == "STATUSTEXT"]:
                self._log.warning("".join(texts))
            if answers:
                port.link.send(*answers)

    # ---- the search ----

    def _go_on_with_the_search(self) -> None:
        self._search.go_on(self._searchers >= (SENSING if self._remote else SEARCHERS))
        self._tally.warnings = (self._search.waits_for,) if self._search.waits_for else ()
        if self._tally.state != self._search.state:
            self._tally.state = self._search.state
            for port in self._ports:  # stations see at once what has changed: after the landing the process may end
                if heartbeat := port.telemetry.build(mavlink.MAVLINK_MSG_ID_HEARTBEAT, self._clock.stream_s()):
                    port.link.send(heartbeat)
            if self._bus:
                self._bus.publish_health()

    def _tell(self, severity: int, text: str) -> None:
        """Tell people: in the log and as STATUSTEXT (253)."""
        (self._log.warning if severity <= mavlink.MAV_SEVERITY_WARNING else self._log.info)(text)
        self._broadcast(self._protocol.statustext(severity, text))

    def _tell_progress(self) -> None:
        """Tell at once when the mission goes on, as PX4 does: stations take it for finished before they see the next mode."""
        if (progress := self._vehicle.progress) != self._progress:
            self._progress = progress
            for port in self._ports:
                if current := port.telemetry.build(MissionCurrent.id, self._clock.stream_s()):
                    port.link.send(current)

    @property
    def _measures(self) -> bool:
        """Whether an arrival is measured: at the search's waypoints, and everywhere by a plain vehicle, which has no bus."""
        return self._search.measures or self._bus is None

    def _sample(self, arrived: Arrived) -> None:
        """Take one reading where the vehicle came to rest, and publish it. A sensor without a value publishes NaN and is read again."""
        for event in self._timeline.before(self._readings):
            self._perform(event)
        north, east, _ = arrived.position
        self._last_time_boot_ms = self._search.answers.time_of(self._vehicle.now_s)
        if self._asking and self._remote:
            self._asked = arrived
            self._asking.ask(self._last_time_boot_ms, self._readings, arrived.position, self._remote.wind)
            return
        lost = self._world.loses(self._readings) and self._tried < self._readings
        self._tried = self._readings
        silent = lost or self._sensor.silent(self._vehicle.now_s)
        self._read(arrived, math.nan if silent else self._world.gas((east, north), self._readings))

    def _measured(self, sample: Sample) -> None:
        """Take the payload's answer, unless the vehicle has been led away meanwhile."""
        arrived, self._asked = self._asked, None
        if arrived and self._measures:
            if sample.wind:
                self._felt = sample.wind
            silent = self._sensor.silent(self._vehicle.now_s)
            self._read(arrived, math.nan if silent else sample.gas)

    @property
    def _wind(self) -> tuple[float, float]:
        """The wind of a reading: the payload knows it best, then the autopilot, else it is the scenario's."""
        return self._felt or (self._remote and self._remote.wind) or self._world.wind

    def _read(self, arrived: Arrived, measured: float) -> None:
        """Make a reading of what was measured where the vehicle has arrived; NaN: the sensor has no value."""
        north, east, down = arrived.position
        gas = measured if math.isnan(measured) else self._sensor.read(measured)
        reading = pack_reading(self._codec, Reading(self._last_time_boot_ms, (east, north), -down, self._wind, gas))
        if math.isnan(gas):
            self._publish_reading(reading)
            self._timeline.schedule(self._vehicle.now_s + TRY_AGAIN_S, arrived)
            return
        self._gas = self._last_time_boot_ms, gas
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
                self._sample(event)
            return
        words = " ".join(f"{name} {value}" for name, value in msgspec.structs.asdict(event).items() if value is not None)
        self._tell(mavlink.MAV_SEVERITY_INFO, f"Script: {event.__struct_config__.tag} {words}")
        match event:
            case Wind(u=u, phi=phi):
                world = self._world
                turned = {"u": world.scenario.u if u is None else u, "phi": world.scenario.phi if phi is None else phi}
                self._world = World(msgspec.structs.replace(world.scenario, **turned), world.seed, world.sensor, world.name)
            case Dropout() | Stuck() | Spike():
                self._sensor.begin(event, self._vehicle.now_s)
            case Delay() | Duplicate() | Lose():
                self._radio.begin(event)
            case Hold() | Resume() | Return() | Land():
                self._operate(order(cast(CommandName, event.__struct_config__.tag), self._vehicle.config.sysid))
                if isinstance(event, Hold) and self._after_hold_s:
                    due_s = self._vehicle.now_s + self._after_hold_s.pop(0)
                    self._timeline.schedule(due_s, Resume(time_s=due_s))

    def _operate(self, message: Message) -> None:
        """Handle a message of the script's operator as if it had come over a link."""
        message.pack(mavlink.MAVLink(None, *OPERATOR))
        answers = self._search.receive(message, self._vehicle.now_s, whence="in the script")
        for text in (answer.text for answer in answers if answer.get_type() == "STATUSTEXT"):
            self._log.warning(text)
        self._broadcast(answers)

    def _broadcast(self, messages: Sequence[Message]) -> None:
        for port in self._ports:
            port.link.send(*messages)
