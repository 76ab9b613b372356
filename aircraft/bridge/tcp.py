"""TCP endpoints: `tcp` connects to a server and comes back to it, `tcpin` is one."""

import contextlib
import os
import selectors
import socket
import time

from aircraft.bridge.address import Address
from aircraft.bridge.links import MOST_PEERS, Endpoint, Hub, Pipe, Reopened, peers
from aircraft.bridge.udp import resolve

MOST_BYTES = 256 * 1024
"""Most bytes that wait for a connection, seconds of full telemetry."""
CONNECT_S = 5.0
"""Longest time for a server to answer."""
GONE_AFTER_S = 10
"""A connection whose other side acknowledges nothing for so long is lost."""


def _prepare(connection: socket.socket) -> None:
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (
        ("TCP_KEEPIDLE", 5),
        ("TCP_KEEPINTVL", 2),
        ("TCP_KEEPCNT", 3),
        ("TCP_USER_TIMEOUT", 1000 * GONE_AFTER_S),
    ):
        if hasattr(socket, name):  # the names are Linux's
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class TcpOut(Reopened):
    """One link while the server is there."""

    def __init__(self, address: Address, hub: Hub) -> None:
        """Start unconnected."""
        super().__init__(address, hub, "connected")
        self._connection: socket.socket | None = None
        self._until_s = 0.0

    def open(self) -> None:
        """Find the server's address; it need not be there yet."""
        self._where = resolve(self.address)

    def tick(self, now_s: float) -> None:
        """Connect if it is time to."""
        if self._connection is None:
            if self._retry.due(now_s):
                self._connect(now_s)
        elif self._pipe is None and now_s >= self._until_s:
            self._fail("no answer")

    def _connect(self, now_s: float) -> None:
        self._connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        _prepare(self._connection)
        self._until_s = now_s + CONNECT_S
        self._hub.selector.register(self._connection, selectors.EVENT_WRITE, self._answered)
        self._connection.connect_ex(self._where)  # how it went is asked for once the socket is writable

    def _answered(self, _events: int) -> None:
        assert self._connection is not None
        error = self._connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if (
            error or self._connection.getsockname() == self._connection.getpeername()
        ):  # TCP may connect to itself where nobody listens
            self._fail(os.strerror(error) if error else "Connection refused")
            return
        self._hub.selector.unregister(self._connection)
        self._begin(self._connection.fileno(), MOST_BYTES, time.monotonic())

    def close(self) -> None:
        """Free the connection."""
        super().close()
        if self._connection:
            with contextlib.suppress(KeyError, ValueError):
                self._hub.selector.unregister(self._connection)
            self._connection.close()
            self._connection = None


class TcpIn(Endpoint):
    """A link for each client, at most MOST_PEERS."""

    def __init__(self, address: Address, hub: Hub) -> None:
        """Start without clients."""
        super().__init__(address, hub)
        self._server = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._clients: dict[socket.socket, Pipe] = {}

    def open(self) -> None:
        """Listen."""
        where = resolve(self.address)
        try:
            self._server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._server.setblocking(False)
            self._server.bind(where)
            self._server.listen(MOST_PEERS)
        except OSError as error:
            raise ValueError(f"{self.address.text}: {error.strerror}") from None
        self._hub.selector.register(self._server, selectors.EVENT_READ, self._called)

    def _called(self, _events: int) -> None:
        try:
            connection, (host, port) = self._server.accept()
        except OSError:  # the caller has gone again
            return
        who = f"{self.address.text}: {host}:{port}"
        if len(self._clients) >= MOST_PEERS:
            connection.close()
            self._hub.log.warning(f"{who} is turned away: there are {MOST_PEERS} clients")
            return
        _prepare(connection)

        def lost(reason: str) -> None:
            del self._clients[connection]
            connection.close()
            self._hub.log.info(f"{who} has gone: {reason}")

        self._hub.log.info(f"{who} has called")
        self._clients[connection] = Pipe(
            connection.fileno(), self._hub, self.traffic, f"{host}:{port}", MOST_BYTES, lost
        )

    def state(self) -> str:
        """How many clients it has."""
        return peers(len(self._clients))

    def close(self) -> None:
        """Free the server and its connections."""
        for connection, pipe in self._clients.items():
            pipe.close()
            connection.close()
        self._clients.clear()
        with contextlib.suppress(KeyError, ValueError):
            self._hub.selector.unregister(self._server)
        self._server.close()
