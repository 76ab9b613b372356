"""The UAV service: flies, measures, and speaks MAVLink on the bus and over UDP."""

import queue
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from link.bus import SIGNAL_POLL_S, Arrival, Bus, LivelinessChange
from link.keys import MAVLINK_IN, MAVLINK_OUT, READING, STOP
from link.log import Log
from link.mavlink import BadFrame, Codec, Message, Reading, pack_reading, unpack
from link.messages import Stop
from plume.world import World
from sitl.clock import Clock
from sitl.protocol import COMPONENT, MavlinkProtocol
from sitl.telemetry import Snapshot, Telemetry
from sitl.udp import UdpLink
from sitl.vehicle import Arrived, Mode, Result, Vehicle, VehicleConfig

SEARCHERS = {"estimator", "agent"}
"""The search begins when these services are there."""
RESEND_FIRST_S, RESEND_LAST_S = 0.25, 2.0
"""Real time after which an unanswered reading is sent again; doubled each time."""


class Link(Protocol):
    """Somewhere that MAVLink messages are sent to."""

    def send(self, *messages: Message) -> None:
        """Send messages in this link's own sequence."""


class BusLink:
    """MAVLink over the bus."""

    def __init__(self, bus: Bus, system: int) -> None:
        """Send on `mavlink/out`."""
        self._bus = bus
        self._codec = Codec(system, COMPONENT)

    def send(self, *messages: Message) -> None:
        """Send messages as one sample."""
        self._bus.publish(MAVLINK_OUT, self._codec.pack(*messages))


class Port(NamedTuple):
    """A link and the telemetry that goes out on it: each client sets its own rates."""

    link: Link
    telemetry: Telemetry


class FromUdp(NamedTuple):
    """A message that came over UDP, and on which port of ours."""

    port: int
    message: Message


class Uav:
    """One vehicle in one world: the loop that ties its clock, its links and its sensor together."""

    def __init__(
        self,
        config: VehicleConfig,
        world: World,
        clock: Clock,
        inbox: "queue.SimpleQueue[Any]",
        bus: Bus | None,
        outs: Sequence[str],
    ) -> None:
        """Join the links; raises ValueError for a UDP URL that cannot be used."""
        self._vehicle = Vehicle(config)
        self._protocol = MavlinkProtocol(self._vehicle)
        self._world = world
        self._clock = clock
        self._inbox = inbox
        self._bus = bus
        self._log = bus.log if bus else Log("uav")
        self._gas: float | None = None
        self._last_reading = b""
        self._last_time_boot_ms = -1
        self._readings = 0
        self._codec = Codec(config.sysid, COMPONENT)
        self._resend_s = RESEND_FIRST_S
        self._resend_at = time.monotonic()
        self._searchers: set[str] = set()
        self._stopped = False
        self._state = "standby"
        self._ports: list[Port] = []
        self._udp: list[UdpLink] = []
        if bus is not None:
            self._ports.append(Port(BusLink(bus, config.sysid), self._telemetry()))
        for url in outs:
            index = len(self._ports)
            link = UdpLink(url, lambda message, index=index: inbox.put(FromUdp(index, message)), config.sysid, COMPONENT)  # type: ignore[misc]
            self._udp.append(link)
            self._ports.append(Port(link, self._telemetry()))

    def _telemetry(self) -> Telemetry:
        # The vehicle's own time, not that of the streams: at speed-up 0 the two differ.
        return Telemetry(lambda _: Snapshot(self._vehicle.config, self._vehicle.state(self._vehicle.now_s), self._world.wind, self._gas))

    def run(self) -> None:
        """Fly until interrupted."""
        if self._bus:
            self._bus.subscribe(MAVLINK_IN, STOP)
            self._bus.watch_services()
        self._set_state("standby")
        try:
            while True:
                busy_since = time.perf_counter()
                self._clock.jump(self._vehicle.moving, self._vehicle.next_event_s())
                for event in self._vehicle.advance(self._clock.now_s()):
                    if isinstance(event, Arrived):
                        self._sample(event)
                    else:
                        self._log.info(event.text)
                        self._broadcast(self._protocol.statustext(event.severity, event.text))
                self._go_on_with_the_search()
                self._resend()
                for port in self._ports:
                    if due := port.telemetry.due(self._clock.stream_s()):
                        port.link.send(*due)
                if self._bus:
                    self._bus.tally.compute_s += time.perf_counter() - busy_since
                self._handle(self._receive())
        finally:
            for link in self._udp:
                link.close()

    def _receive(self) -> Any:
        next_event_s = self._vehicle.next_event_s()
        if self._vehicle.moving and not self._clock.speedup:
            timeout_s = 0.0
        else:
            next_stream_s = min(port.telemetry.next_due_s() for port in self._ports)
            timeout_s = self._clock.wait_s(next_event_s, next_stream_s)
            if self._must_resend:
                timeout_s = min(timeout_s, max(self._resend_at - time.monotonic(), 0.0))
        try:
            return self._inbox.get(timeout=min(timeout_s, SIGNAL_POLL_S))  # a client may have turned all streams off
        except queue.Empty:
            return None

    # ---- what arrives ----

    def _handle(self, item: Any) -> None:
        match item:
            case FromUdp(index, message):
                self._message(message, self._ports[index])
            case Arrival(key, payload) if key is MAVLINK_IN:
                try:
                    messages = unpack(payload)
                except BadFrame as error:
                    if self._bus:
                        self._bus.refuse(MAVLINK_IN, str(error), "malformed")
                    return
                for message in messages:
                    self._message(message, self._ports[0])
            case Arrival(key) if key is STOP and self._bus:
                stop = self._bus.decode(item, Stop)
                self._stopped = self._stopped or stop is not None
            case LivelinessChange(service, alive):
                (self._searchers.add if alive else self._searchers.discard)(service)

    def _message(self, message: Message, port: Port) -> None:
        refused = self._protocol.refused.total()
        answers = self._protocol.receive(message, self._clock.now_s(), port.telemetry)
        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
            self._clock.heard()
        if self._bus and self._protocol.refused.total() > refused:
            self._bus.refused["waypoint"] += 1
        if texts := [answer.text for answer in answers if answer.get_type() == "STATUSTEXT"]:
            self._log.warn("".join(texts))
        if answers:
            port.link.send(*answers)

    # ---- the search ----

    def _go_on_with_the_search(self) -> None:
        """Arm, take off and go to the start when estimator and agent are there; then their waypoints lead."""
        now_s = self._vehicle.now_s
        mode = self._vehicle.state(now_s).mode
        if self._state == "standby" and self._searchers >= SEARCHERS:
            if not self._vehicle.state(now_s).armed:
                self._warn_where_refused(self._vehicle.arm(now_s))
            self._warn_where_refused(self._vehicle.take_off(now_s))
            self._set_state("taking off")
        elif self._state == "taking off" and mode is Mode.HOLD:
            start_x, start_y = self._world.start
            self._warn_where_refused(self._vehicle.setpoint(now_s, (start_y, start_x, -self._vehicle.config.takeoff_altitude_m)))
            self._warn_where_refused(self._vehicle.set_mode(now_s, Mode.OFFBOARD))
            self._set_state("searching")
        elif self._state == "searching" and mode in (Mode.RETURN, Mode.LAND):
            self._set_state("returning")
        elif self._state == "returning" and not self._vehicle.state(now_s).armed:
            self._set_state("landed")

    def _warn_where_refused(self, result: Result) -> None:
        if not result.accepted:
            self._log.warn(result.reason)

    def _set_state(self, state: str) -> None:
        self._state = state
        if self._bus:
            self._bus.tally.state = state
            self._bus.publish_health()

    def _sample(self, arrived: Arrived) -> None:
        """Take one reading where the vehicle came to rest, and publish it."""
        north, east, down = arrived.position
        self._last_time_boot_ms = max(round(arrived.time_s * 1000), self._last_time_boot_ms + 1)
        self._gas = self._world.gas((east, north), self._readings)
        reading = Reading(self._last_time_boot_ms, (east, north), -down, self._world.wind, self._gas)
        self._vehicle.sampled(reading.time_boot_ms)
        self._last_reading = pack_reading(self._codec, reading)
        if self._bus:
            self._bus.publish(READING, self._last_reading)
            self._bus.tally.step = self._readings
            self._bus.publish_health()
        self._readings += 1
        self._resend_s = RESEND_FIRST_S
        self._resend_at = time.monotonic() + self._resend_s

    @property
    def _must_resend(self) -> bool:
        return self._bus is not None and self._state == "searching" and self._vehicle.awaiting_answer and not self._stopped

    def _resend(self) -> None:
        """Send an unanswered reading again: whichever message of the round trip was lost, this one has it said once more."""
        if self._bus and self._must_resend and time.monotonic() >= self._resend_at:
            self._bus.publish(READING, self._last_reading)
            self._resend_s = min(2 * self._resend_s, RESEND_LAST_S)
            self._resend_at = time.monotonic() + self._resend_s

    def _broadcast(self, messages: Sequence[Message]) -> None:
        for port in self._ports:
            port.link.send(*messages)
