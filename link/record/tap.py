"""A tap on the bus: takes all messages, many at once, for the recorder."""

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh

from link.bus.inbox import Drops
from link.bus.keys import HEALTH, Key
from link.bus.opening import DEFAULT_ROUTER
from link.bus.session import Arrival, Bus, most_waiting

# How often Zenoh's rings are emptied: they are bounded by messages alone, of any size, and drop without a
# word.
DRAIN_EVERY_S = 0.05


class Tap(Bus):
    """A bus connection for recorders: messages are taken in batches, with the times that a record stores.

    A Python callback for each message would cost too much. Therefore messages come into rings of Zenoh's,
    and a thread moves them from there to the inbox, which is bounded by bytes, too, and counts what it
    drops.
    """

    def __init__(
        self,
        service: str,
        connect: str = DEFAULT_ROUTER,
        namespace: str = "uav/1",
        log_level: str = "info",
        announced: bool = True,
        **settings: Any,
    ) -> None:
        self._taken_ns = 0
        # The keys whose messages come into rings, and what puts them into the inbox.
        self._rings: dict[str, tuple[Key, Callable[[Any, int], None]]] = {}
        self._draining = threading.Lock()
        self._full = 0
        self._fullness = Drops("messages")
        self._ended = threading.Event()
        self._drainer = threading.Thread(target=self._keep_draining, name="tap", daemon=True)
        # Each message keeps its receive buffer. With the default of 64 kB, clearing the buffers is half the
        # cost of receiving.
        settings = {"transport__link__tx__batch_size": 16_384} | settings
        super().__init__(service, connect, namespace, log_level=log_level, announced=announced, **settings)
        self._drainer.start()

    def subscribe(self, *keys: Key, newest: bool = False) -> None:
        """Queue the messages of these keys for `take`, kept messages first."""
        for key in keys:
            self._put_in_order(key)
            put = self._inbox.lane(key.name, most_waiting(key))
            for name in self._names_heard(key):
                self._declare(key, name, zenoh.handlers.RingChannel(most_waiting(key)))
                self._rings[name] = key, put
            if key is HEALTH:
                self._ask_for_kept_health(partial(self._move, key, put))

    def take(self) -> list[Arrival]:
        """Return the messages that arrived since the last call, in order of publishing."""
        now_ns = time.time_ns()
        self._drain()
        with contextlib.suppress(queue.Empty):  # some may be dropped meanwhile
            for _ in range(self._inbox.waiting()):  # new messages keep coming
                self._accept(self._inbox.get(timeout=0))
        self._fullness.tell(self._full, self.log)
        self._look_after()
        taken = [
            message._replace(received_ns=min(max(message.published_ns, self._taken_ns), now_ns))
            for message in sorted(self._ready, key=lambda message: message.published_ns)
        ]
        self._ready.clear()
        self._taken_ns = now_ns
        return taken

    def close(self) -> None:
        """Leave the bus."""
        self._ended.set()
        if self._drainer.is_alive():  # else an older service is here, and we never were
            self._drainer.join()
        super().close()

    def _keep_draining(self) -> None:
        while not self._ended.wait(DRAIN_EVERY_S):
            self._drain()

    def _drain(self) -> None:
        """Move what is in the rings to the inbox.

        Of each key at most one full ring, as new messages keep coming.
        """
        with self._draining:
            for name, ring in tuple(self._rings.items()):
                self._full += self._drain_one(name, *ring)

    def _drain_one(self, name: str, key: Key, put: Callable[[Any, int], None]) -> bool:
        """Empty a ring.

        Returns whether it was full, and so may have dropped messages: nobody knows how many.
        """
        handler = self._held[name][1].handler
        for _ in range(most_waiting(key)):
            try:
                sample = handler.try_recv()
            except zenoh.ZError:  # another ring takes its place
                return False
            if sample is None:
                return False
            self._move(key, put, sample)
        return True

    def _move(self, key: Key, put: Callable[[Any, int], None], sample: zenoh.Sample) -> None:
        if message := self._arrival(key, sample):
            put(message, message.size)
