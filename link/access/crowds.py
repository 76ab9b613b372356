"""How many sessions of a router one certificate holds at once: more are closed.

Zenoh itself knows only a limit for all.
"""

import contextlib
import os
import socket
import stat
import threading
from collections import Counter, defaultdict

import zenoh

from link.access.roles import FOR_ALL

# Sessions of a certificate of one vehicle, and of one of all vehicles: all recorders share one. A router
# holds 1,000 sessions.
MOST_OF_A_PART, MOST_FOR_ALL = 16, 250


def most_of(name: str) -> int:
    """Return how many sessions the certificate of this name may hold at once."""
    return MOST_FOR_ALL if name in FOR_ALL else MOST_OF_A_PART


class Crowds:
    """Counts the sessions of a router by the names of their certificates, and closes what is too many."""

    def __init__(self, router: zenoh.Session) -> None:
        self._held: dict[str, set[str]] = defaultdict(set)
        self._closed: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._listener = router.info.declare_link_events_listener(self._changed, history=True)

    def _changed(self, event: zenoh.LinkEvent) -> None:
        """Note a link that came or went, in a thread of Zenoh's."""
        name, address = event.link.auth_identifier, event.link.dst.partition("/")[2]
        if name is None:
            return
        with self._lock:
            held = self._held[name]
            if event.kind != zenoh.SampleKind.PUT:
                held.discard(address)
            elif len(held) < most_of(name):
                held.add(address)
            else:
                self._closed[name] += 1
                _shut(address)

    def closed(self) -> Counter[str]:
        """Return how many sessions of which certificates were closed since the last call."""
        with self._lock:
            closed, self._closed = self._closed, Counter()
        return closed


def _shut(address: str) -> None:
    """End the connection of this process with an address: Zenoh has no way to close a session of another.

    It notices, and cleans up.
    """
    host, _, port = address.rpartition(":")
    for number in map(int, os.listdir("/dev/fd")):
        with contextlib.suppress(OSError):  # closed meanwhile, or no connection
            if stat.S_ISSOCK(os.fstat(number).st_mode):
                with socket.socket(fileno=os.dup(number)) as one:
                    if one.getpeername()[:2] == (host.strip("[]"), int(port)):
                        one.shutdown(socket.SHUT_RDWR)
                        return
