"""A tap on the bus: takes all messages, many at once, for the recorder."""

import time
from typing import Any

import zenoh

from link.bus.keys import KEYS, Key
from link.bus.opening import DEFAULT_ROUTER
from link.bus.session import Bus, Stamped, most_waiting


class Tap(Bus):
    """A bus connection for recorders: messages wait in Zenoh, not in Python, and are taken in batches, as `Stamped`.

    A Python callback for each message would cost more than recording it.
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
        """Join a router as a client; takes and raises what `Bus` does."""
        # Each message keeps its receive buffer. With the default of 64 kB, clearing the buffers is half the cost of receiving.
        small = {"transport__link__tx__batch_size": 16_384}
        super().__init__(service, connect, namespace, log_level=log_level, announced=announced, **small | settings)
        self._taken_ns = 0

    def subscribe(self, *keys: Key, newest: bool = False) -> None:
        """Queue the messages of these keys for `take`, kept messages first."""
        for key in keys:
            self._put_in_order(key)
            self._declare(key, zenoh.handlers.RingChannel(most_waiting(key)))

    def take(self) -> list[Stamped]:
        """Return the messages that arrived since the last call, in order of publishing."""
        now_ns = time.time_ns()
        for key in KEYS:
            if key.name in self._subscribers:
                self._take_from(key, now_ns)
        self._taken_ns = now_ns
        self._look_after_sequences()
        self.keep_health()
        taken = sorted(self._ready, key=lambda message: message.published_ns)
        self._ready.clear()
        return taken

    def _take_from(self, key: Key, now_ns: int) -> None:
        handler, sequence = self._subscribers[key.name].handler, self._sequences.get(key.name)
        for _ in range(most_waiting(key)):  # at most one full channel: new messages keep coming
            if (sample := handler.try_recv()) is None:
                return
            published_ns = sample.timestamp.get_time_as_ntp64().as_nanos() if sample.timestamp else now_ns
            received_ns = min(max(published_ns, self._taken_ns), now_ns)
            attachment = sample.attachment.to_bytes() if sample.attachment else b""
            message = Stamped(key, sample.payload.to_bytes(), attachment, str(sample.key_expr), published_ns, received_ns)
            if sequence and (info := sample.source_info) is not None:
                self._ready += sequence.arrived(str(info.source_id), info.source_sn, message, time.monotonic())
            else:
                self._ready.append(message)
