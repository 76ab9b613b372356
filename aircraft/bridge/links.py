"""What all links of the bridge share: counts for each URL, and a bounded queue in front of what can be
written to.
"""

import contextlib
import math
import os
import selectors
from collections import Counter, deque
from collections.abc import Callable
from typing import Protocol

from aircraft.bridge.address import Address
from aircraft.bridge.routing import DUPLICATE, UNHEARD
from link.bus.frames import Frame, FrameStream
from link.bus.log import Log
from link.signing.signature import unsigned
from link.signing.signer import Signer

GARBAGE, OVERFLOW, AWAY = "bytes of garbage", "that came too fast", "while it was not connected"
UNSIGNABLE = "of MAVLink 1, which cannot be signed"
"""Why something is dropped, beside routing's reasons."""
USUAL = frozenset({DUPLICATE, UNHEARD, AWAY})
"""Reasons that do not make a bridge unwell."""
LARGEST_READ = 65536
MOST_READS = 64
"""Deliveries that are read from a link before the others have their turn."""
BACK_OFF_FIRST_S, BACK_OFF_LAST_S = 0.25, 4.0
"""First and longest time after which a lost endpoint is tried again; it doubles each time."""
SIGNS_OF_LIFE_S = 60.0
"""A UDP peer that is silent for this long is forgotten: every MAVLink program sends a heartbeat every
second.
"""
MOST_PEERS = 16
"""A `udpin` or `tcpin` has at most this many peers."""


def peers(count: int) -> str:
    """Return the state of an endpoint with so many peers, as words."""
    return f"({count} peer{'' if count == 1 else 's'})"


class Traffic:
    """The counts of one URL: frames received and sent, and what was dropped, by reason."""

    def __init__(self, url: str, log: Log) -> None:
        """Take the URL, and the log whose tally counts what is dropped, too."""
        self.url = url
        self.is_serial = url.startswith("serial:")
        self.log = log
        self.received = 0
        self.sent = 0
        self.dropped: Counter[str] = Counter()
        self.signer: Signer | None = None
        """Signs what is sent, and says what may be received; None if nothing is signed."""

    def drop(self, reason: str, count: int = 1) -> None:
        """Count what is dropped."""
        if not count:
            return
        if reason not in self.dropped and reason not in USUAL:
            hint = (
                "; no frame has come: is this its baud rate?"
                if self.is_serial and reason == GARBAGE and not self.received
                else ""
            )
            self.log.warning(f"{self.url}: drops {reason}{hint}")
        self.dropped[reason] += count
        kind = f"{reason} ({self.url})"
        if reason in USUAL:
            self.log.tally.refused[kind] += count
        else:
            self.log.tally.refuse(kind, count)

    def tell_refused(self) -> None:
        """Log and count the frames that had no valid signature since the last call."""
        if self.signer:
            self.dropped += self.signer.tell(self.log)

    def text(self) -> str:
        """The counts in one line."""
        self.tell_refused()
        dropped = ", ".join(f"{count} {reason}" for reason, count in self.dropped.items())
        return f"{self.url}: {self.received} frames in, {self.sent} out; dropped: {dropped or 'nothing'}"


class Channel:
    """One sender and receiver of frames: a UDP peer, a TCP connection, a serial line.

    With a signer, signatures are the link's own: frames come without them out of `take`, and get them in
    `send`.
    """

    def __init__(self, traffic: Traffic, send: Callable[[bytes], None], who: str) -> None:
        """Take the counts of its URL, the function that sends a frame, and who the other side is."""
        self.traffic = traffic
        self.stream = FrameStream()
        self._send = send
        self.who = who
        """Who the other side is, for people."""

    @property
    def _garbage(self) -> int:
        return self.stream.garbage - (self.stream.opening if self.traffic.is_serial else 0)

    def send(self, frame: bytes) -> None:
        """Send a frame, signed if the link signs."""
        if self.traffic.signer and not (frame := self.traffic.signer.sign(frame)):
            self.traffic.drop(UNSIGNABLE)
        else:
            self._send(frame)

    def take(self, data: bytes, *, datagram: bool = False) -> list[Frame]:
        """Return the frames that are now complete, but none without a valid signature where the link
        signs; count them, and garbage.

        A serial line may be a console before it carries frames: its opening is no garbage.
        """
        before = self._garbage
        frames = self.stream.take(data, datagram=datagram)
        if signer := self.traffic.signer:
            frames = [
                frame._replace(data=unsigned(frame.data))
                for frame in frames
                if signer.admits(frame.data, self.who)
            ]
        self.traffic.received += len(frames)
        self.traffic.drop(GARBAGE, self._garbage - before)
        return frames


class Hub(Protocol):
    """What an endpoint knows of the bridge that it belongs to."""

    selector: selectors.BaseSelector
    """Its keys' data are functions that take the events."""
    log: Log

    def join(self, link: Channel) -> None:
        """Route frames to this link from now on."""

    def leave(self, link: Channel) -> None:
        """Route no more frames to this link."""

    def route(self, link: Channel, frames: list[Frame]) -> None:
        """Send frames of this link on."""


class Endpoint:
    """What lies behind one URL: none, one or several links. All methods are called in the bridge's thread."""

    def __init__(self, address: Address, hub: Hub) -> None:
        """Take the parts of the URL."""
        self.address = address
        self.traffic = Traffic(address.text, hub.log)
        self._hub = hub

    def open(self) -> None:
        """Begin; raises ValueError if the URL cannot be used on this machine."""

    def tick(self, now_s: float) -> None:
        """Do what is due; called several times a second."""

    def trouble(self) -> str:
        """Why nothing can be sent; empty if all is well."""
        return ""

    def state(self) -> str:
        """How it is doing, in a few words."""
        return ""

    def close(self) -> None:
        """Free what it holds."""


class Pipe:
    """A file descriptor of a stream, with a bounded queue of frames: if too many bytes wait, the oldest
    frames are dropped.
    """

    def __init__(
        self,
        descriptor: int,
        hub: Hub,
        traffic: Traffic,
        who: str,
        most_bytes: int,
        lost: Callable[[str], None],
    ) -> None:
        """Take a descriptor that does not block, and who is on the other side; `lost` is called with the
        reason when that has gone.
        """
        self.link = Channel(traffic, self.send, who)
        self._descriptor = descriptor
        self._hub = hub
        self._most_bytes = most_bytes
        self._lost = lost
        self._waiting: deque[bytes] = deque()
        self._bytes = 0
        self._begun = b""
        """What is left of a frame that is partly written."""
        self._closed = False
        hub.selector.register(descriptor, selectors.EVENT_READ, self._ready)
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
        try:
            while self._begun or self._waiting:
                if not self._begun:
                    self._begun = self._waiting.popleft()
                    self._bytes -= len(self._begun)
                self._begun = self._begun[os.write(self._descriptor, self._begun) :]
                self.link.traffic.sent += not self._begun
        except BlockingIOError:
            self._watch(selectors.EVENT_READ | selectors.EVENT_WRITE)
        except OSError as error:
            self._end(str(error.strerror))
        else:
            self._watch(selectors.EVENT_READ)

    def _watch(self, events: int) -> None:
        if self._hub.selector.get_key(self._descriptor).events != events:
            self._hub.selector.modify(self._descriptor, events, self._ready)

    def _read(self) -> None:
        try:
            data = os.read(self._descriptor, LARGEST_READ)
        except BlockingIOError:
            return
        except OSError as error:
            self._end(str(error.strerror))
            return
        if not data:
            self._end("the other side has closed it")
        elif frames := self.link.take(data):
            self._hub.route(self.link, frames)

    def _end(self, reason: str) -> None:
        if not self._closed:
            self.close()
            self._lost(reason)

    def close(self) -> None:
        """Give the link up. The descriptor stays its owner's; unregister comes before it is closed."""
        if not self._closed:
            self._closed = True
            self.link.traffic.drop(AWAY, len(self._waiting) + bool(self._begun))
            with contextlib.suppress(KeyError):
                self._hub.selector.unregister(self._descriptor)
            self._hub.leave(self.link)


class Retry:
    """When a lost endpoint is tried again."""

    def __init__(self) -> None:
        """Try at once."""
        self._wait_s = BACK_OFF_FIRST_S
        self._at_s = -math.inf
        self._since_s = math.inf

    def due(self, now_s: float) -> bool:
        """Whether it is time; if so, the next time is later. After a connection that lasted, waits begin
        short again.
        """
        if now_s < self._at_s:
            return False
        if now_s - self._since_s > BACK_OFF_LAST_S:
            self._wait_s = BACK_OFF_FIRST_S
        self._since_s = math.inf
        self._at_s = now_s + self._wait_s
        self._wait_s = min(2 * self._wait_s, BACK_OFF_LAST_S)
        return True

    def succeeded(self, now_s: float) -> None:
        """Remember when it was reached."""
        self._since_s = now_s


class Reopened(Endpoint):
    """One link while the other side is there; when it is lost, it is tried again."""

    def __init__(self, address: Address, hub: Hub, there: str) -> None:
        """Start without the link. there: one word for a link that works, such as "open"."""
        super().__init__(address, hub)
        self._there = there
        self._retry = Retry()
        self._pipe: Pipe | None = None
        self._trouble, self._told = f"not yet {there}", ""

    def _begin(self, descriptor: int, most_bytes: int, now_s: float) -> None:
        """Begin the link over an open descriptor, in which at most so many bytes wait."""
        self._pipe = Pipe(descriptor, self._hub, self.traffic, self.address.host, most_bytes, self._fail)
        self._retry.succeeded(now_s)
        self._trouble = self._told = ""
        self._hub.log.info(f"{self.address.text}: {self._there}")

    def _fail(self, reason: str) -> None:
        self.close()
        self._trouble = f"{reason}; it is tried again"
        if reason != self._told:
            self._told = reason
            self._hub.log.warning(f"{self.address.text}: {self._trouble}")

    def trouble(self) -> str:
        """Why the link does not work."""
        return self._trouble

    def state(self) -> str:
        """Whether the link works."""
        return f"({self._there})" if self._pipe else f"(not {self._there})"

    def close(self) -> None:
        """End the link."""
        if self._pipe:
            self._pipe.close()
            self._pipe = None
