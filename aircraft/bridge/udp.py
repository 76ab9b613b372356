"""UDP endpoints: `udpout` calls one address, `udpin` answers all who call."""

import contextlib
import selectors
import socket
import time

from aircraft.bridge.address import Address
from aircraft.bridge.links import (
    AWAY,
    LARGEST_READ,
    MOST_PEERS,
    MOST_READS,
    OVERFLOW,
    SIGNS_OF_LIFE_S,
    Channel,
    Endpoint,
    Hub,
    peers,
)
from link.signing.signer import FREE


def resolve(address: Address) -> tuple[str, int]:
    """Return the IPv4 address and port; raises ValueError if the host is unknown."""
    try:
        found = socket.getaddrinfo(address.host, address.port, socket.AF_INET, socket.SOCK_STREAM)
    except OSError as error:
        raise ValueError(
            f"{address.text}: {error.strerror}; wanted an IPv4 address or the name of a host"
        ) from None
    host, port = found[0][4][:2]
    return str(host), int(port)


class _Udp(Endpoint):
    """A socket, with what both kinds share."""

    def __init__(self, address: Address, hub: Hub) -> None:
        super().__init__(address, hub)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def open(self) -> None:
        """Bind or connect."""
        where = resolve(self.address)
        try:
            if self.address.kind == "udpin":
                self._socket.bind(where)
            else:
                self._socket.connect(where)  # from now on the kernel delivers only this peer's datagrams
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
            self._arrived(datagram, peer)

    def _arrived(self, datagram: bytes, peer: tuple[str, int]) -> None:
        raise NotImplementedError

    def _send(self, frame: bytes, peer: tuple[str, int] | None) -> None:
        try:
            if peer is None:
                self._socket.send(frame)
            else:
                self._socket.sendto(frame, peer)
        except BlockingIOError:
            self.traffic.drop(OVERFLOW)
        except OSError:  # nobody listens there (yet)
            self.traffic.drop(AWAY)
        else:
            self.traffic.sent += 1

    def close(self) -> None:
        """Free the socket."""
        with contextlib.suppress(KeyError, ValueError):
            self._hub.selector.unregister(self._socket)
        self._socket.close()


class UdpOut(_Udp):
    """One link, whether or not anyone answers there."""

    def open(self) -> None:
        """Connect; the link is there from now on."""
        super().open()
        self._link = Channel(
            self.traffic, lambda frame: self._send(frame, None), f"{self.address.host}:{self.address.port}"
        )
        self._hub.join(self._link)

    def _arrived(self, datagram: bytes, peer: tuple[str, int]) -> None:
        if frames := self._link.take(datagram, datagram=True):
            self._hub.route(self._link, frames)


class _Caller:
    """A sender of datagrams; it has a link once it has sent a frame, other than a radio's RADIO_STATUS,
    which needs no signature.
    """

    def __init__(self, link: Channel) -> None:
        self.link = link
        self.joined = False
        self.heard_s = 0.0


class UdpIn(_Udp):
    """A link for each peer that has sent a frame in the last minute, at most MOST_PEERS, the latest."""

    def __init__(self, address: Address, hub: Hub) -> None:
        """Open a socket; nobody has called yet."""
        super().__init__(address, hub)
        self._callers: dict[tuple[str, int], _Caller] = {}
        """The latest heard is the last."""

    def _arrived(self, datagram: bytes, peer: tuple[str, int]) -> None:
        caller = self._callers.get(peer)
        if caller is None:
            caller = _Caller(
                Channel(self.traffic, lambda frame: self._send(frame, peer), f"{peer[0]}:{peer[1]}")
            )
        frames = caller.link.take(datagram, datagram=True)
        if frames or not caller.joined:
            caller.heard_s = time.monotonic()
            self._callers.pop(peer, None)
            self._callers[peer] = caller
        if not caller.joined and any(frame.message_id not in FREE for frame in frames):
            caller.joined = True
            self._hub.join(caller.link)
            self._hub.log.info(f"{self.address.text}: {peer[0]}:{peer[1]} has called")
        if len(self._callers) > MOST_PEERS:
            strangers = (other for other, known in self._callers.items() if not known.joined)
            self._forget(next(strangers, next(iter(self._callers))))
        if frames and caller.joined:
            self._hub.route(caller.link, frames)

    def _forget(self, peer: tuple[str, int]) -> None:
        caller = self._callers.pop(peer)
        if caller.joined:
            caller.joined = False
            self._hub.leave(caller.link)
            self._hub.log.info(f"{self.address.text}: {peer[0]}:{peer[1]} is forgotten")

    def tick(self, now_s: float) -> None:
        """Forget who is silent."""
        for peer in [
            peer for peer, caller in self._callers.items() if now_s - caller.heard_s >= SIGNS_OF_LIFE_S
        ]:
            self._forget(peer)

    def state(self) -> str:
        """How many peers it has."""
        return peers(sum(caller.joined for caller in self._callers.values()))
