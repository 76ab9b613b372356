"""A link that can be cut: forwards TCP, and TLS within it, between a part and the router."""

import contextlib
import selectors
import socket
import threading

CHUNK = 1 << 16


class Relay:
    """One part's link to the router, in its own thread.

    While it is cut it forwards nothing and closes nothing, like a radio out of range: each side must
    notice by itself.
    """

    def __init__(self, router: str) -> None:
        """Listen on a free local port; raises ValueError if the router's endpoint is neither TCP nor TLS."""
        protocol, _, address = router.partition("/")
        host, _, port = address.rpartition(":")
        if protocol not in ("tcp", "tls"):
            raise ValueError(f"--listen: {router!r} is not allowed where links are cut; wanted tcp/HOST:PORT")
        self._router = (host.strip("[]"), int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setblocking(False)
        self.endpoint = f"{protocol}/127.0.0.1:{self._listener.getsockname()[1]}"
        """Where the part connects to."""
        self._peers: dict[socket.socket, socket.socket] = {}
        self._selector = selectors.DefaultSelector()
        self._wake, self._woken = socket.socketpair()
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._cut = self._closed = False
        self._thread = threading.Thread(target=self._carry, name="relay", daemon=True)
        self._thread.start()

    def cut(self) -> None:
        """Stop forwarding."""
        self._cut = True
        self._wake.send(b".")

    def restore(self) -> None:
        """Forward again. What was sent meanwhile arrives late, if its sender still waits."""
        self._cut = False
        self._wake.send(b".")

    def close(self) -> None:
        """End the thread and close all connections."""
        self._closed = True
        self._wake.send(b".")
        for each in tuple(self._peers):
            with contextlib.suppress(OSError):  # it has gone
                each.shutdown(socket.SHUT_RDWR)  # the thread may be waiting for one that takes nothing
        self._thread.join()
        for each in (*self._peers, self._listener, self._wake, self._woken):
            each.close()
        self._selector.close()

    def _carry(self) -> None:
        while not self._closed:
            if self._cut:
                self._woken.recv(CHUNK)  # sleeps
                continue
            for key, _ in self._selector.select():
                if key.fileobj is self._woken:
                    self._woken.recv(CHUNK)
                elif key.fileobj is self._listener:
                    self._connect()
                elif isinstance(key.fileobj, socket.socket) and key.fileobj in self._peers:
                    self._pass_on(key.fileobj)

    def _connect(self) -> None:
        part, _ = self._listener.accept()
        try:
            router = socket.create_connection(self._router, timeout=1.0)
        except OSError:  # the router is not there (yet): close, as it would refuse
            part.close()
            return
        for one, other in ((part, router), (router, part)):
            one.setblocking(True)
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._peers[one] = other
            self._selector.register(one, selectors.EVENT_READ)

    def _pass_on(self, source: socket.socket) -> None:
        target = self._peers[source]
        try:
            if data := source.recv(CHUNK):
                target.sendall(data)
                return
        except OSError:
            pass
        for each in (source, target):
            self._selector.unregister(each)
            del self._peers[each]
            with contextlib.suppress(OSError):
                each.close()
