"""TCP endpoints: `tcp` connects to a server and comes back to it, `tcpin` is one."""

import os
import selectors
import socket
import time

from aircraft.bridge.address import Address
from aircraft.bridge.links import MOST_PEERS, Endpoint, Hub
from aircraft.bridge.pipe import Pipe, Reopened

MOST_BYTES = 256 * 1024  # that wait for a connection, seconds of full telemetry
CONNECT_S = 5.0  # longest time for a server to answer
LOST_AFTER_S = 10  # a connection is lost once the other side has acknowledged nothing for this long
# Linux's names; other systems lack some.
OPTIONS = {"TCP_KEEPIDLE": 5, "TCP_KEEPINTVL": 2, "TCP_KEEPCNT": 3, "TCP_USER_TIMEOUT": 1000 * LOST_AFTER_S}


def _prepare(connection: socket.socket) -> None:
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in OPTIONS.items():
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class TcpOut(Reopened):
    """One link while the server is there."""

    there = "connected"

    def __init__(self, address: Address, hub: Hub) -> None:
        super().__init__(address, hub)
        self._calling: socket.socket | None = None
        self._until_s = 0.0

    def open(self) -> None:
        """Find the server's address; it need not be there yet."""
        self._where = self.address.resolve()

    def tick(self, now_s: float) -> None:
        """Connect if it is time to."""
        if self._calling and now_s >= self._until_s:
            self._fail("no answer")
        elif not self._calling and not self._pipe and self._retry.due(now_s):
            self._calling = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            _prepare(self._calling)
            self._until_s = now_s + CONNECT_S
            self._hub.selector.register(self._calling, selectors.EVENT_WRITE, self._answered)
            self._calling.connect_ex(self._where)  # how it went is asked for once the socket is writable

    def _answered(self, _events: int) -> None:
        connection = self._calling
        assert connection is not None
        error = connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if error or connection.getsockname() == connection.getpeername():
            # TCP may connect to itself where nobody listens
            self._fail(os.strerror(error) if error else "Connection refused")
            return
        self._hub.unwatch(connection)
        self._calling = None
        self._begin(connection, MOST_BYTES, time.monotonic())

    def close(self) -> None:
        """Free the connection."""
        super().close()
        if self._calling:
            self._hub.unwatch(self._calling)
            self._calling.close()
            self._calling = None


class TcpIn(Endpoint):
    """A link for each client, at most MOST_PEERS."""

    def __init__(self, address: Address, hub: Hub) -> None:
        super().__init__(address, hub)
        self._server = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._clients: dict[str, Pipe] = {}

    def open(self) -> None:
        """Listen."""
        where = self.address.resolve()
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
        who = f"{host}:{port}"
        if len(self._clients) >= MOST_PEERS:
            connection.close()
            self._hub.log.warning(
                f"{self.address.text}: {who} is turned away: there are {MOST_PEERS} clients"
            )
            return
        _prepare(connection)

        def lost(reason: str) -> None:
            del self._clients[who]
            self._hub.log.info(f"{self.address.text}: {who} has gone: {reason}")

        self._hub.log.info(f"{self.address.text}: {who} has called")
        self._clients[who] = Pipe(connection, self._hub, self.traffic, who, MOST_BYTES, lost)

    def close(self) -> None:
        """Free the server and its connections."""
        for pipe in self._clients.values():
            pipe.close()
        self._clients.clear()
        self._hub.unwatch(self._server)
        self._server.close()
