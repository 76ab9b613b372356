"""A tap on the bus: everything that is said, taken many messages at once, for those who write it down."""

import time

import zenoh

from link.bus.keys import KEYS, Key
from link.bus.session import DEFAULT_ROUTER, Bus, Stamped, most_waiting


class Tap(Bus):
    """A place on the bus for who writes everything down: messages wait in Zenoh, not in Python, and are taken many at once, Stamped.

    A Python callback for each message would cost more than all that is done with it afterwards.
    """

    def __init__(self, service: str, connect: str = DEFAULT_ROUTER, namespace: str = "uav/1", log_level: str = "info") -> None:
        """Join as any other."""
        # A message keeps the buffer that it came in: at the usual 64 kB each, clearing these is half the cost of receiving.
        super().__init__(service, connect, namespace, log_level=log_level, transport__link__tx__batch_size=16_384)
        self._taken_ns = 0

    def subscribe(self, *keys: Key, newest: bool = False) -> None:
        """Have what is published under these keys, kept messages first, wait to be taken."""
        for key in keys:
            self._put_in_order(key)
            self._declare(key, zenoh.handlers.RingChannel(most_waiting(key)))

    def take(self) -> list[Stamped]:
        """Return what has arrived since the last time, in the order in which it was published."""
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
        for _ in range(most_waiting(key)):  # not more than waited at first, however many are coming
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
