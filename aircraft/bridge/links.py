"""Endpoints and their links: the counts of each URL, who is there, and the hub that polls them all."""

import contextlib
import selectors
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from aircraft.bridge.address import LISTENING, Address
from aircraft.bridge.routing import DUPLICATE, UNHEARD
from link.bus.frames import Frame, FrameStream
from link.bus.log import Log
from link.signing.signature import unsigned
from link.signing.signer import Signer, Signing

GARBAGE, OVERFLOW, AWAY = "bytes of garbage", "that came too fast", "while it was not connected"
UNSIGNABLE = "of MAVLink 1, which cannot be signed"  # why something is dropped, beside routing's reasons
USUAL = frozenset({DUPLICATE, UNHEARD, AWAY})  # reasons that do not make a bridge unwell
LARGEST_READ = 65536
MOST_READS = 64  # deliveries that are read from a link before the others have their turn
MOST_PEERS = 16  # of a `udpin` or `tcpin`
TICK_S = 0.2  # how often an endpoint does what is due by its clock


class Traffic:
    """The counts of one URL: frames received and sent, and what was dropped, by reason."""

    def __init__(self, url: str, log: Log) -> None:
        """Take the URL, and the log whose tally counts what is dropped, too."""
        self.url = url
        self.is_serial = url.startswith("serial:")
        self.log = log
        self.received = self.sent = 0
        self.dropped: Counter[str] = Counter()
        # Signs what is sent, and says what may be received; None if nothing is signed.
        self.signer: Signer | None = None

    def drop(self, reason: str, count: int = 1) -> None:
        """Count what is dropped."""
        if not count:
            return
        if reason not in self.dropped and reason not in USUAL:
            hint = "; no frame has come: is this its baud rate?"
            is_wrong = self.is_serial and reason == GARBAGE and not self.received
            self.log.warning(f"{self.url}: drops {reason}{hint * is_wrong}")
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

    With a signer, signatures are the link's own: `send` adds them, `take` removes them.
    """

    def __init__(self, traffic: Traffic, send: Callable[[bytes], None], who: str) -> None:
        """Take its URL's counts, what sends a frame, and who the other side is, for people."""
        self.traffic = traffic
        self.who = who
        self.heard_s = 0.0  # when a frame last came, for an endpoint that forgets its peers
        self._send = send
        self._stream = FrameStream()

    @property
    def _garbage(self) -> int:
        return self._stream.garbage - (self._stream.opening if self.traffic.is_serial else 0)

    def send(self, frame: bytes) -> None:
        """Send a frame, signed if the link signs."""
        if self.traffic.signer and not (frame := self.traffic.signer.sign(frame)):
            self.traffic.drop(UNSIGNABLE)
        else:
            self._send(frame)

    def take(self, data: bytes, *, datagram: bool = False) -> list[Frame]:
        """Return the frames that are now complete; count them, and garbage.

        Where the link signs, frames without a valid signature are left out. A serial line may be a console
        before it carries frames: its opening is no garbage.
        """
        before = self._garbage
        frames = self._stream.take(data, datagram=datagram)
        if signer := self.traffic.signer:
            frames = [
                frame._replace(data=unsigned(frame.data))
                for frame in frames
                if signer.admits(frame.data, self.who)
            ]
        self.traffic.received += len(frames)
        self.traffic.drop(GARBAGE, self._garbage - before)
        return frames


class Endpoint:
    """What lies behind one URL: none, one or several links."""

    def __init__(self, address: Address, hub: "Hub") -> None:
        self.address = address
        self.traffic = Traffic(address.text, hub.log)
        self.trouble = ""  # why nothing can be sent; empty if all is well
        self._hub = hub

    def open(self) -> None:
        """Begin; raises ValueError if the URL cannot be used on this machine."""

    def tick(self, now_s: float) -> None:
        """Do what is due; called several times a second."""

    @property
    def links(self) -> list[Channel]:
        """Its links that are there now."""
        return [link for link in self._hub.links if link.traffic is self.traffic]

    @property
    def state(self) -> str:
        """How it is doing, in a few words."""
        if self.address.kind not in LISTENING:
            return ""
        count = len(self.links)
        return f"({count} peer{'' if count == 1 else 's'})"

    def close(self) -> None:
        """Free what it holds."""


class Hub:
    """Endpoints and their links, polled by their owner in one thread.

    They come back by themselves; what is sent while nothing is connected is lost.
    """

    def __init__(self, log: Log) -> None:
        self.log = log
        # Its keys' data are functions that take the events.
        self.selector: selectors.BaseSelector = selectors.DefaultSelector()
        self.endpoints: list[Endpoint] = []
        self.links: list[Channel] = []
        self._came: list[tuple[Channel, Frame]] = []
        self._tick_at_s = 0.0
        self._bell: threading.Thread | None = None
        self._rung, self._closed = threading.Event(), False
        self._wake, self._woken = socket.socketpair()
        for end in (self._wake, self._woken):
            end.setblocking(False)
        self.selector.register(self._woken, selectors.EVENT_READ, lambda _: self._woken.recv(4096))

    # ---- what its owner calls ----

    def open(self, endpoint: Endpoint, signing: Signing | None = None) -> None:
        """Open an endpoint; raises ValueError if it cannot be used on this machine.

        signing: what signs links of the network. A serial line is taken for a safe cable.
        """
        self.endpoints.append(endpoint)
        if signing and endpoint.address.kind != "serial":
            endpoint.traffic.signer = signing.link(endpoint.address.text)
        try:
            endpoint.open()
        except ValueError:
            self.close()
            raise

    def send_all(self, frames: Sequence[bytes]) -> None:
        """Send frames on all links."""
        for link in [*self.links]:
            for frame in frames:
                link.send(frame)

    def take(self, wait_s: float = 0.0) -> list[tuple[Channel, Frame]]:
        """Return the frames that have come, each with its link.

        Waits until something does, at most this real time, and at most TICK_S.
        """
        if (now_s := time.monotonic()) >= self._tick_at_s:
            self._tick_at_s = now_s + TICK_S
            self.tick(now_s)
        for key, events in self.selector.select(min(wait_s, self._tick_at_s - now_s)):
            key.data(events)
        came, self._came = self._came, []
        self._rung.set()
        return came

    def tick(self, now_s: float) -> None:
        """Do what is due."""
        for endpoint in self.endpoints:
            endpoint.tick(now_s)
            endpoint.traffic.tell_refused()

    def ring(self, bell: Callable[[], None]) -> None:
        """Call `bell`, in a thread of its own, when something has come: once before each `take`."""

        def wait() -> None:
            while not self._closed:
                self._rung.clear()
                if self.selector.select() and not self._closed:
                    bell()
                    self._rung.wait()

        self._bell = threading.Thread(target=wait, name="bell", daemon=True)
        self._bell.start()

    def wake(self) -> None:
        """Let `take` return, from any thread."""
        with contextlib.suppress(OSError):  # it is being woken already, or closed
            self._wake.send(b"\0")

    def close(self) -> None:
        """Free all that was opened; a second call has no effect."""
        self._closed = True
        self._rung.set()
        self.wake()
        if self._bell:
            self._bell.join()
        for endpoint in self.endpoints:
            endpoint.close()
        self.selector.close()
        self._wake.close()
        self._woken.close()

    # ---- what endpoints call ----

    def join(self, link: Channel) -> None:
        """A link is there."""
        self.links.append(link)

    def leave(self, link: Channel) -> None:
        """A link has gone."""
        self.links.remove(link)

    def route(self, link: Channel, frames: list[Frame]) -> None:
        """Take frames of a link."""
        self._came += [(link, frame) for frame in frames]

    def unwatch(self, file: Any) -> None:
        """Poll a file or socket no more; it may be closed already."""
        with contextlib.suppress(KeyError, ValueError):
            self.selector.unregister(file)
