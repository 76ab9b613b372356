"""The bridge: one loop that waits for bytes on all links and sends each frame where routing says."""

import contextlib
import selectors
import socket
import time
from collections.abc import Sequence

from aircraft.bridge.address import Address
from aircraft.bridge.bus_link import BRIDGED, BusChannel
from aircraft.bridge.endpoints import ENDPOINTS, TICK_S
from aircraft.bridge.links import Channel
from aircraft.bridge.routing import BUS, ELSEWHERE, Routes
from link.bus.frames import Frame
from link.bus.keys import MAVLINK_OUT
from link.bus.session import Bus
from link.signing.signer import Signing


class Bridge:
    """Joins a bus with endpoints. Use it in one thread."""

    def __init__(
        self, addresses: Sequence[Address], bus: Bus, name: str, signing: Signing | None = None
    ) -> None:
        """Open the endpoints; raises ValueError if one cannot be used on this machine.

        name: the bus's in counts and logs; signing: what signs the links of the network. A serial line is
        taken for a safe cable.
        """
        self.log = bus.log
        self.selector: selectors.BaseSelector = selectors.DefaultSelector()
        self._bus = bus
        self._routes = Routes()
        self._links: dict[int, Channel] = {}
        self._numbers: dict[Channel, int] = {}
        self._next = BUS + 1
        self._told: set[tuple[str, int, int]] = set()
        """URLs and senders of which it was told that they are a vehicle's of another link."""
        self._tick_at_s = 0.0
        self._ended = False
        self._wake, self._woken = socket.socketpair()
        for end in (self._wake, self._woken):
            end.setblocking(False)
        self.selector.register(self._woken, selectors.EVENT_READ, self._empty)
        self._endpoints = [ENDPOINTS[address.kind](address, self) for address in addresses]
        for endpoint in self._endpoints:
            if signing and endpoint.address.kind != "serial":
                endpoint.traffic.signer = signing.link(endpoint.address.text)
            endpoint.open()
        self._bus_link = BusChannel(bus, name, self.wake)
        bus.tally.state = "bridging"

    # ---- what endpoints call ----

    def join(self, link: Channel) -> None:
        """Route frames to this link from now on."""
        self._links[self._next], self._numbers[link] = link, self._next
        self._routes.join(self._next)
        self._next += 1

    def leave(self, link: Channel) -> None:
        """Route no more frames to this link."""
        number = self._numbers.pop(link)
        del self._links[number]
        self._routes.leave(number)

    def route(self, link: Channel, frames: list[Frame]) -> None:
        """Send frames of this link on."""
        now_s = time.monotonic()
        for frame in frames:
            if (number := self._numbers.get(link)) is None:  # it was lost by sending on the frame before
                return
            self._send(frame, number, now_s)

    # ---- the loop ----

    def wake(self) -> None:
        """Wake the loop, from any thread."""
        with contextlib.suppress(OSError):  # it is being woken already, or closed
            self._wake.send(b"\0")

    @property
    def wake_descriptor(self) -> int:
        """A descriptor that wakes the loop if anything is written to it: for signals."""
        return self._wake.fileno()

    def end(self) -> None:
        """Let `run` return."""
        self._ended = True
        self.wake()

    def run(self) -> None:
        """Route until `end` is called."""
        while not self._ended:
            for key, events in self.selector.select(max(self._tick_at_s - time.monotonic(), 0.0)):
                key.data(events)
            self._route_from_bus()
            if (now_s := time.monotonic()) >= self._tick_at_s:
                self._tick(now_s)

    def _empty(self, _events: int) -> None:
        self._woken.recv(4096)

    def _route_from_bus(self) -> None:
        for arrival, frames in self._bus_link.take():
            now_s = time.monotonic()
            for frame in frames:
                self._send(
                    frame, BUS, now_s, out=arrival.key is MAVLINK_OUT, brought=arrival.attachment == BRIDGED
                )
            self._bus.tally.latency_s = time.monotonic() - arrival.at

    def _send(
        self, frame: Frame, came_on: int, now_s: float, *, out: bool = False, brought: bool = False
    ) -> None:
        route = self._routes.route(frame, came_on, now_s, out=out, brought=brought)
        if route.dropped:
            traffic = self._bus_link.traffic if came_on == BUS else self._links[came_on].traffic
            traffic.drop(route.dropped)
            if (
                route.dropped == ELSEWHERE
                and (who := (traffic.url, frame.system, frame.component)) not in self._told
            ):
                self._told.add(who)
                self.log.warning(
                    f"{traffic.url}: frames of {frame.system}/{frame.component} are dropped; it is a "
                    "vehicle of another link"
                )
            return
        self._bus.tally.did(-1)
        for number in route.links:
            if number == BUS:
                self._bus_link.send(frame.data, route.vehicle)
            elif (link := self._links.get(number)) is not None:
                link.send(frame.data)

    def _tick(self, now_s: float) -> None:
        self._tick_at_s = now_s + TICK_S
        for endpoint in self._endpoints:
            endpoint.tick(now_s)
            endpoint.traffic.tell_refused()
        self._bus_link.tick()
        tally = self._bus.tally
        tally.about = ", ".join(
            f"{endpoint.address.text} {endpoint.state()}".rstrip() for endpoint in self._endpoints
        )
        troubles = [(endpoint.address.text, endpoint.trouble()) for endpoint in self._endpoints]
        troubles.append((self._bus_link.traffic.url, self._bus_link.trouble()))
        tally.warnings = tuple(f"{url}: {trouble}" for url, trouble in troubles if trouble)
        self._bus.keep_health()

    # ---- the end ----

    def counts(self) -> list[str]:
        """A line of counts for each URL and the bus."""
        return [
            traffic.text()
            for traffic in (self._bus_link.traffic, *(endpoint.traffic for endpoint in self._endpoints))
        ]

    def close(self) -> None:
        """Free all that it has opened, but not the bus."""
        for endpoint in self._endpoints:
            endpoint.close()
        self._bus_link.close()
        self.selector.close()
        self._wake.close()
        self._woken.close()
