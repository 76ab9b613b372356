"""Which vehicles are on a router: the services of every namespace, by their liveliness tokens."""

import re
from collections import deque
from pathlib import Path
from typing import NamedTuple

import zenoh

from link.bus.keys import HEALTH
from link.bus.session import Bus

WORDS = re.compile(r"[^*$\x00-\x1f\x7f]{1,200}/")
"""A namespace and its slash. A token may also be for a pattern of keys, such as uav/*: that is no vehicle.
"""
MOST_CHANGES = 10_000
"""Changes that wait; beyond that the oldest are dropped."""


class Presence(NamedTuple):
    """A service of a vehicle joined the router or left it."""

    namespace: str
    service: str
    alive: bool


class Roster(Bus):
    """An observer of a whole router, without a namespace of its own."""

    def __init__(
        self, service: str, connect: str, connect_timeout_s: float, secure: Path | None = None
    ) -> None:
        """Join a router as a client; raises what `Bus` raises."""
        super().__init__(
            service,
            connect,
            None,
            announced=False,
            secure=secure,
            connect__timeout_ms=round(1000 * connect_timeout_s),
        )
        self._changes: deque[Presence] = deque(maxlen=MOST_CHANGES)
        name = HEALTH.name.replace("<service>", "*")
        self._hold(
            "liveliness",
            lambda session: session.liveliness().declare_subscriber(
                f"**/{name}", self._changed, history=True
            ),
        )

    def _changed(self, sample: zenoh.Sample) -> None:
        middle = HEALTH.name.partition("<")[0]
        namespace, _, service = str(sample.key_expr).rpartition(middle)
        if WORDS.fullmatch(namespace) and self._names.admits(service):
            self._changes.append(Presence(namespace[:-1], service, sample.kind == zenoh.SampleKind.PUT))

    def changes(self) -> list[Presence]:
        """Return what has changed since the last call; at first, all that are there. A lost router takes
        all of them with it.
        """
        self._names.tell(self.log)
        self.keep_link()
        return [self._changes.popleft() for _ in range(len(self._changes))]
