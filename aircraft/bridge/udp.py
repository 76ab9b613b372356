"""UDP endpoints: `udpout` calls one address, `udpin` answers all who call."""

import selectors
import socket
import time
from collections.abc import Callable

from aircraft.bridge.address import Address
from aircraft.bridge.links import (
    AWAY,
    LARGEST_READ,
    MOST_PEERS,
    MOST_READS,
    OVERFLOW,
    Channel,
    Endpoint,
    Hub,
)
from link.signing.signer import FREE

# A caller is forgotten after this silence: every MAVLink program sends a heartbeat every second.
FORGET_AFTER_S = 60.0
Peer = tuple[str, int]


class Udp(Endpoint):
    """A socket. `udpout` has one link, whether or not anyone answers there.

    `udpin` has a link for each caller that has sent a frame in the last minute, other than a radio's
    RADIO_STATUS, which needs no signature; at most MOST_PEERS, the latest.
    """

    def __init__(self, address: Address, hub: Hub) -> None:
        super().__init__(address, hub)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._called: Channel | None = None
        self._callers: dict[Peer, Channel] = {}  # also those without a link yet; the latest heard is the last

    def open(self) -> None:
        """Bind or connect."""
        where = self.address.resolve()
        try:
            if self.address.kind == "udpin":
                self._socket.bind(where)
            else:
                self._socket.connect(where)  # from now on the kernel delivers only this peer's datagrams
                self._called = self._link(self._socket.send, f"{self.address.host}:{self.address.port}")
                self._hub.join(self._called)
        except OSError as error:
            raise ValueError(f"{self.address.text}: {error.strerror}") from None
        self._hub.selector.register(self._socket, selectors.EVENT_READ, self._ready)

    def _ready(self, _events: int) -> None:
        for _ in range(MOST_READS):
            try:
                datagram, peer = self._socket.recvfrom(LARGEST_READ)
            except BlockingIOError:
                return
            except OSError:  # a peer refused an earlier datagram: no listener there (yet)
                continue
            if self._called:
                self._hub.route(self._called, self._called.take(datagram, datagram=True))
            else:
                self._hear(datagram, peer)

    def _link(self, put: Callable[[bytes], int], who: str) -> Channel:
        def send(frame: bytes) -> None:
            try:
                put(frame)
            except BlockingIOError:
                self.traffic.drop(OVERFLOW)
            except OSError:  # nobody listens there (yet)
                self.traffic.drop(AWAY)
            else:
                self.traffic.sent += 1

        return Channel(self.traffic, send, who)

    # ---- those who call ----

    def _hear(self, datagram: bytes, peer: Peer) -> None:
        caller = self._callers.get(peer) or self._link(
            lambda frame: self._socket.sendto(frame, peer), f"{peer[0]}:{peer[1]}"
        )
        frames = caller.take(datagram, datagram=True)
        if frames or caller not in self._hub.links:
            caller.heard_s = time.monotonic()
            self._callers.pop(peer, None)
            self._callers[peer] = caller
        if caller not in self._hub.links and any(frame.message_id not in FREE for frame in frames):
            self._hub.join(caller)
            self._hub.log.info(f"{self.address.text}: {caller.who} has called")
        if len(self._callers) > MOST_PEERS:
            strangers = (other for other, link in self._callers.items() if link not in self._hub.links)
            self._forget(next(strangers, next(iter(self._callers))))
        if caller in self._hub.links:
            self._hub.route(caller, frames)

    def _forget(self, peer: Peer) -> None:
        caller = self._callers.pop(peer)
        if caller in self._hub.links:
            self._hub.leave(caller)
            self._hub.log.info(f"{self.address.text}: {caller.who} is forgotten")

    def tick(self, now_s: float) -> None:
        """Forget who is silent."""
        for peer, caller in [*self._callers.items()]:
            if now_s - caller.heard_s >= FORGET_AFTER_S:
                self._forget(peer)

    def close(self) -> None:
        """Free the socket."""
        self._hub.unwatch(self._socket)
        self._socket.close()
