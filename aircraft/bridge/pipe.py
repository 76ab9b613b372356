"""Links over a stream of bytes, each with a bounded queue, and endpoints that open a lost link again."""

import contextlib
import math
import os
import selectors
from collections import deque
from collections.abc import Callable
from typing import Any

from aircraft.bridge.address import Address
from aircraft.bridge.links import AWAY, LARGEST_READ, OVERFLOW, Channel, Endpoint, Hub, Traffic
from link.bus.backoff import Backoff
from link.bus.log import Log

# First and longest time after which a lost endpoint is tried again; it doubles each time.
BACK_OFF_FIRST_S, BACK_OFF_LAST_S = 0.25, 4.0


class Pipe:
    """An open file or socket, with a bounded queue of frames.

    If too many bytes wait, the oldest frames are dropped.
    """

    def __init__(
        self, file: Any, hub: Hub, traffic: Traffic, who: str, most_bytes: int, lost: Callable[[str], None]
    ) -> None:
        """Take what does not block, and close it in the end.

        who: the other side, for people. lost: called with the reason when that has gone.
        """
        self.link = Channel(traffic, self.send, who)
        self._file, self._hub, self._most_bytes, self._lost = file, hub, most_bytes, lost
        self._waiting: deque[bytes] = deque()
        self._bytes = 0
        self._begun = b""  # what is left of a frame that is partly written
        self._closed = False
        hub.selector.register(file, selectors.EVENT_READ, self._ready)
        hub.join(self.link)

    def send(self, frame: bytes) -> None:
        """Write a frame, or queue it."""
        if self._closed:
            return
        self._waiting.append(frame)
        self._bytes += len(frame)
        while self._bytes > self._most_bytes and len(self._waiting) > 1:
            self._bytes -= len(self._waiting.popleft())
            self.link.traffic.drop(OVERFLOW)
        if len(self._waiting) == 1 and not self._begun:
            self._write()

    def _ready(self, events: int) -> None:
        if events & selectors.EVENT_WRITE and not self._closed:
            self._write()
        if events & selectors.EVENT_READ and not self._closed:
            self._read()

    def _write(self) -> None:
        events = selectors.EVENT_READ
        try:
            while self._begun or self._waiting:
                if not self._begun:
                    self._begun = self._waiting.popleft()
                    self._bytes -= len(self._begun)
                self._begun = self._begun[os.write(self._file.fileno(), self._begun) :]
                self.link.traffic.sent += not self._begun
        except BlockingIOError:
            events |= selectors.EVENT_WRITE
        except OSError as error:
            self._end(str(error.strerror))
            return
        if self._hub.selector.get_key(self._file).events != events:
            self._hub.selector.modify(self._file, events, self._ready)

    def _read(self) -> None:
        try:
            data = os.read(self._file.fileno(), LARGEST_READ)
        except BlockingIOError:
            return
        except OSError as error:
            self._end(str(error.strerror))
            return
        if data:
            self._hub.route(self.link, self.link.take(data))
        else:
            self._end("the other side has closed it")

    def _end(self, reason: str) -> None:
        self.close()
        self._lost(reason)

    def close(self) -> None:
        """Give the link up; a second call has no effect."""
        if not self._closed:
            self._closed = True
            self.link.traffic.drop(AWAY, len(self._waiting) + bool(self._begun))
            self._hub.unwatch(self._file)
            self._hub.leave(self.link)
            with contextlib.suppress(OSError):  # a device that was unplugged
                self._file.close()


class Retry(Backoff):
    """When a lost endpoint is tried again, and what its log says of that.

    After a connection that lasted, waits begin short again. A reason is told once in a row.
    """

    def __init__(self, what: str, there: str, log: Log) -> None:
        """what: a URL; there: one word for one that works."""
        super().__init__(BACK_OFF_FIRST_S, BACK_OFF_LAST_S)
        self._what, self._there, self._log = what, there, log
        self._since_s = math.inf
        self._told = ""

    def due(self, now_s: float) -> bool:
        """Whether a try is due. If so, it is taken to be made now."""
        if now_s - self._since_s > BACK_OFF_LAST_S:
            self.relax(now_s)
        self._since_s = math.inf
        return super().due(now_s)

    def succeeded(self, now_s: float) -> None:
        """Remember when it was reached."""
        self._since_s = now_s
        self._told = ""
        self._log.info(f"{self._what}: {self._there}")

    def failed(self, reason: str) -> str:
        """Return why it is not there, in words."""
        trouble = f"{reason}; it is tried again"
        if reason != self._told:
            self._told = reason
            self._log.warning(f"{self._what}: {trouble}")
        return trouble


class Reopened(Endpoint):
    """One link while the other side is there; when it is lost, it is tried again."""

    there = "open"  # one word for a link that works

    def __init__(self, address: Address, hub: Hub) -> None:
        super().__init__(address, hub)
        self.trouble = f"not yet {self.there}"
        self._retry = Retry(address.text, self.there, hub.log)
        self._pipe: Pipe | None = None

    def _begin(self, file: Any, most_bytes: int, now_s: float) -> None:
        """Begin the link over what is open, in which at most this many bytes wait."""
        self._pipe = Pipe(file, self._hub, self.traffic, self.address.host, most_bytes, self._fail)
        self._retry.succeeded(now_s)
        self.trouble = ""

    def _fail(self, reason: str) -> None:
        self.close()
        self.trouble = self._retry.failed(reason)

    @property
    def state(self) -> str:
        """Whether the link works."""
        return f"({self.there})" if self._pipe else f"(not {self.there})"

    def close(self) -> None:
        """End the link."""
        if self._pipe:
            self._pipe.close()
            self._pipe = None
