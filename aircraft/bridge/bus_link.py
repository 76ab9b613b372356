"""The bridge's link to the bus: frames come in, and go out from a thread of their own."""

import queue
import threading
from collections.abc import Callable
from functools import partial

from aircraft.bridge.links import AWAY, GARBAGE, OVERFLOW, Traffic
from link.bus.frames import Frame, FrameStream
from link.bus.inbox import WAITING_MESSAGES, Inbox
from link.bus.keys import MAVLINK_IN, MAVLINK_OUT, STOP
from link.bus.session import Arrival, Bus

CLOSE_S = 1.0
# The attachment of what a bridge publishes: it tells other bridges that the sender itself is not on the bus.
BRIDGED = b"bridge"


class BusChannel:
    """Frames from and to the bus. A router that is slow or gone holds up no other link."""

    def __init__(self, bus: Bus, name: str, wake: Callable[[], None]) -> None:
        """Listen on the bus; `wake` is called, in another thread, when something has come."""
        self.traffic = Traffic(name, bus.log)
        self._bus, self._wake = bus, wake
        self._connected = True
        self._inbox = Inbox()
        self._leaving: queue.SimpleQueue[tuple[bytes, bool] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._publish, name="to the bus", daemon=True)
        self._thread.start()
        for key in (MAVLINK_OUT, MAVLINK_IN, STOP):
            bus.on(key, partial(self._arrived, self._inbox.lane(key.name)), own=key is STOP)

    def _arrived(self, put: Callable[[Arrival, int], None], arrival: Arrival) -> None:
        put(arrival, len(arrival.payload) + len(arrival.attachment))
        self._wake()

    def take(self) -> list[tuple[Arrival, list[Frame]]]:
        """Return what has come since the last call, with the frames in it; a message holds whole frames."""
        taken = []
        for _ in range(self._inbox.waiting()):
            arrival: Arrival = self._inbox.get(0.0)
            if arrival.key is STOP:
                self._bus.take_stop(arrival)
                continue
            frames = FrameStream().take(arrival.payload, datagram=True)
            taken.append((arrival, frames))
            self.traffic.received += len(frames)
            self.traffic.drop(GARBAGE, len(arrival.payload) - sum(len(frame.data) for frame in frames))
        return taken

    def send(self, frame: bytes, vehicle: bool) -> None:
        """Publish a frame: what a vehicle says on mavlink/out, all else on mavlink/in."""
        if not self._connected:
            self.traffic.drop(AWAY)
        elif self._leaving.qsize() >= WAITING_MESSAGES:
            self.traffic.drop(OVERFLOW)
        else:
            self._leaving.put((frame, vehicle))
            self.traffic.sent += 1

    def tick(self) -> None:
        """Look whether the router is there, to which Zenoh comes back by itself; tell what was lost."""
        self._inbox.tell_dropped(self._bus.log)
        connected = self._bus.connected
        if connected != self._connected:
            self._connected = connected
            if connected:
                self._bus.log.info(f"{self.traffic.url}: the router is back")
            else:
                self._bus.log.warning(f"{self.traffic.url}: {self.trouble()}")

    def trouble(self) -> str:
        """Why nothing can be sent."""
        return "" if self._connected else self._bus.expiry() or "the router is gone; it is tried again"

    def _publish(self) -> None:
        while (item := self._leaving.get()) is not None:
            frame, vehicle = item
            self._bus.publish(MAVLINK_OUT if vehicle else MAVLINK_IN, frame, BRIDGED)

    def close(self) -> None:
        """End the thread; frames that wait are sent if the router takes them."""
        self._leaving.put(None)
        self._thread.join(CLOSE_S)
