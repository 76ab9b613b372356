"""One service of a name on a vehicle's bus: a second one is refused before it says anything."""

import math
import time
from collections.abc import Callable
from contextlib import suppress

import msgspec
import zenoh

from link.bus.messages import Health

# How long a new service waits for another's token to go. The token of a service that was killed, hangs or is
# cut off goes within 2 s.
WAIT_S = 5.0
LOOK_S = 0.02
# An elder must be heard this long after its first message: that one may be a dead service's last.
APART_S = 0.5


class Sole:
    """Listens for a service of the same name that has been there for longer."""

    def __init__(self, key: str, uptime_s: Callable[[], float]) -> None:
        """Take the key of its own health within the namespace, and its own uptime, s."""
        self.has_elder = False  # true once another is known to be there. Of the two, the younger has to go
        self._key = key
        self._uptime_s = uptime_s
        self._first_s = math.inf  # the least uptime that an elder has told of

    def listen(self, session: zenoh.Session) -> zenoh.Subscriber[None]:
        """Listen on a session; returns the subscriber."""
        return session.declare_subscriber(self._key, self._heard, allowed_origin=zenoh.Locality.REMOTE)

    def await_elder(self, is_there: Callable[[], bool]) -> bool:
        """Return whether one is there and stays. `is_there`: whether its token is."""
        deadline = time.monotonic() + WAIT_S
        while is_there():
            if self._first_s < math.inf:
                deadline = min(deadline, time.monotonic() + APART_S)
            if time.monotonic() >= deadline:
                return True
            time.sleep(LOOK_S)
        return False

    def _heard(self, sample: zenoh.Sample) -> None:
        with suppress(msgspec.DecodeError, UnicodeDecodeError):
            uptime_s = msgspec.json.decode(sample.payload.to_bytes(), type=Health).uptime_s
            if uptime_s > self._uptime_s():
                self._first_s = min(self._first_s, uptime_s)
                self.has_elder = self.has_elder or uptime_s - self._first_s >= APART_S
