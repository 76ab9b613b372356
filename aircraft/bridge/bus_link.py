"""The bridge's link to the bus: frames of `mavlink/out` and `mavlink/in` come in, and go out from a thread
of their own.
"""

import queue
import threading
from collections import deque
from collections.abc import Callable

from aircraft.bridge.links import AWAY, GARBAGE, OVERFLOW, Traffic
from link.bus.frames import Frame, FrameStream
from link.bus.inbox import WAITING_BYTES
from link.bus.keys import MAVLINK_IN, MAVLINK_OUT, STOP
from link.bus.session import Arrival, Bus

MOST_WAITING = 4096
"""Most messages that wait in either direction; of those from the bus, WAITING_BYTES at most, too."""
CLOSE_S = 1.0
BRIDGED = b"bridge"
"""The attachment of what a bridge publishes: it tells other bridges that the sender itself is not on the
bus.
"""


class BusChannel:
    """Frames from and to the bus. A router that is slow or gone holds up no other link."""

    def __init__(self, bus: Bus, name: str, wake: Callable[[], None]) -> None:
        """Listen on the bus; `wake` is called, in another thread, when something has come."""
        self.traffic = Traffic(name, bus.log)
        self._bus = bus
        self._wake = wake
        self._connected = True
        self._lock = threading.Lock()
        self._arrived: deque[Arrival] = deque()
        self._bytes = 0
        self._overflowed = 0
        self._leaving: queue.SimpleQueue[tuple[bytes, bool] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._publish, name="to the bus", daemon=True)
        self._thread.start()
        for key in (MAVLINK_OUT, MAVLINK_IN):
            bus.on(key, self._queue, own=False)
        self._stops: deque[Arrival] = deque(maxlen=1)
        bus.on(STOP, self._stops.append)

    def _queue(self, arrival: Arrival) -> None:
        size = len(arrival.payload) + len(arrival.attachment)
        with self._lock:
            if len(self._arrived) >= MOST_WAITING or self._bytes + size > WAITING_BYTES:
                self._overflowed += 1
                return
            self._arrived.append(arrival)
            self._bytes += size
            first = len(self._arrived) == 1
        if first:
            self._wake()

    def take(self) -> list[tuple[Arrival, list[Frame]]]:
        """Return what has come since the last call, with the frames in it; a message holds whole frames."""
        with self._lock:
            arrived, self._arrived, self._bytes = self._arrived, deque(), 0
            overflowed, self._overflowed = self._overflowed, 0
        taken = []
        for arrival in arrived:
            stream = FrameStream()
            frames = stream.take(arrival.payload, datagram=True)
            taken.append((arrival, frames))
            self.traffic.received += len(frames)
            self.traffic.drop(GARBAGE, len(arrival.payload) - sum(len(frame.data) for frame in frames))
        self.traffic.drop(OVERFLOW, overflowed)
        return taken

    def send(self, frame: bytes, vehicle: bool) -> None:
        """Publish a frame: what a vehicle says on mavlink/out, all else on mavlink/in."""
        if not self._connected:
            self.traffic.drop(AWAY)
        elif self._leaving.qsize() >= MOST_WAITING:
            self.traffic.drop(OVERFLOW)
        else:
            self._leaving.put((frame, vehicle))
            self.traffic.sent += 1

    def tick(self) -> None:
        """Look whether the router is there, to which Zenoh comes back by itself, and whether the search
        has ceased.
        """
        while self._stops:
            self._bus.take_stop(self._stops.popleft())
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
