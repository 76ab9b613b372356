"""The bridge: one loop that waits for bytes on all links and sends each frame where routing says."""

import time
from collections.abc import Sequence

from aircraft.bridge.address import Address
from aircraft.bridge.bus_link import BRIDGED, BusChannel
from aircraft.bridge.endpoints import endpoint_of
from aircraft.bridge.links import TICK_S, Channel, Hub
from aircraft.bridge.routing import BUS, ELSEWHERE, Routes
from link.bus.frames import Frame
from link.bus.keys import MAVLINK_OUT
from link.bus.session import Bus
from link.signing.signer import Signing


class Bridge(Hub):
    """Joins a bus with endpoints. Use it in one thread."""

    def __init__(
        self, addresses: Sequence[Address], bus: Bus, name: str, signing: Signing | None = None
    ) -> None:
        """Open the endpoints; raises ValueError if one cannot be used on this machine.

        name: the bus's in counts and logs; signing: what signs the links of the network.
        """
        super().__init__(bus.log)
        self._bus = bus
        self._routes = Routes()
        self._told: set[tuple[str, int, int]] = set()  # URLs and senders that were told as ELSEWHERE
        self._ended = False
        self._bus_link = BusChannel(bus, name, self.wake)
        for address in addresses:
            self.open(endpoint_of(address, self), signing)
        bus.tally.state = "bridging"

    def join(self, link: Channel) -> None:
        """Route frames to this link from now on."""
        super().join(link)
        self._routes.join(link)

    def leave(self, link: Channel) -> None:
        """Route no more frames to this link."""
        super().leave(link)
        self._routes.leave(link)

    def end(self) -> None:
        """Let `run` return."""
        self._ended = True
        self.wake()

    def run(self) -> None:
        """Route until `end` is called."""
        while not self._ended:
            for link, frame in self.take(TICK_S):
                if link in self._routes.heard:  # else it was lost by sending on a frame before
                    self._send(frame, link, time.monotonic())
            for arrival, frames in self._bus_link.take():
                now_s, out = time.monotonic(), arrival.key is MAVLINK_OUT
                for frame in frames:
                    self._send(frame, BUS, now_s, out=out, brought=arrival.attachment == BRIDGED)
                self._bus.tally.latency_s = time.monotonic() - arrival.at

    def _send(
        self, frame: Frame, came_on: Channel | int, now_s: float, *, out: bool = False, brought: bool = False
    ) -> None:
        route = self._routes.route(frame, came_on, now_s, out=out, brought=brought)
        if route.dropped:
            traffic = came_on.traffic if isinstance(came_on, Channel) else self._bus_link.traffic
            traffic.drop(route.dropped)
            who = traffic.url, frame.system, frame.component
            if route.dropped == ELSEWHERE and who not in self._told:
                self._told.add(who)
                self.log.warning(
                    f"{traffic.url}: frames of {frame.system}/{frame.component} are dropped; it is a "
                    "vehicle of another link"
                )
            return
        self._bus.tally.did(-1)
        for link in route.links:
            if isinstance(link, Channel):
                link.send(frame.data)
            else:
                self._bus_link.send(frame.data, route.vehicle)

    def tick(self, now_s: float) -> None:
        """Do what is due, and tell how all are doing."""
        super().tick(now_s)
        self._bus_link.tick()
        tally = self._bus.tally
        tally.about = ", ".join(f"{end.address.text} {end.state}".rstrip() for end in self.endpoints)
        troubles = {end.address.text: end.trouble for end in self.endpoints}
        troubles[self._bus_link.traffic.url] = self._bus_link.trouble()
        tally.warnings = tuple(f"{url}: {trouble}" for url, trouble in troubles.items() if trouble)
        self._bus.keep_health()

    def counts(self) -> list[str]:
        """A line of counts for each URL and the bus."""
        return [
            traffic.text() for traffic in (self._bus_link.traffic, *(end.traffic for end in self.endpoints))
        ]

    def close(self) -> None:
        """Free all that it has opened, but not the bus."""
        super().close()
        self._bus_link.close()
