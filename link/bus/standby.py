"""Another session when the router keeps ours out, since a stranger took its id while it was away."""

import contextlib
import threading
import time
from collections.abc import Callable

import zenoh

# How long a session is away before another is tried in its place, and the time between two trials. Zenoh
# brings it back within 0.5 s of its router.
AWAY_S = 5.0
# How long the other one waits for the first to come back: the router itself may have been away.
LAST_CHANCE_S = 1.0
TRY_S = 1.0
LOOK_S = 0.2  # how often to look whether the first is admitted


class Standby:
    """Tries, in a thread of its own, whether a router that does not admit a session admits another one."""

    def __init__(self, admitted: Callable[[], bool], join: Callable[[float], zenoh.Session]) -> None:
        """Take whether the session is admitted, and what opens another in time, s, or raises zenoh.ZError."""
        self._admitted = admitted
        self._join = join
        self._look_at, self._try_at = 0.0, time.monotonic() + AWAY_S
        self._thread: threading.Thread | None = None
        self._found: zenoh.Session | None = None
        self._ended = threading.Event()

    def look(self) -> zenoh.Session | None:
        """Return the session to go on with if the first is kept out; None as a rule. Call it now and then."""
        if (now_s := time.monotonic()) < self._look_at:
            return None
        self._look_at = now_s + LOOK_S
        if self._thread is None:
            if self._admitted():
                self._try_at = now_s + AWAY_S
            elif now_s >= self._try_at:
                self._thread = threading.Thread(target=self._try, name="standby", daemon=True)
                self._thread.start()
        elif not self._thread.is_alive():
            self._thread = None
            self._try_at = now_s + AWAY_S
            found, self._found = self._found, None
            return found
        return None

    def _try(self) -> None:
        with contextlib.suppress(zenoh.ZError):
            other = self._join(TRY_S)
            until = time.monotonic() + LAST_CHANCE_S
            while (
                not (back := self._admitted()) and time.monotonic() < until and not self._ended.wait(LOOK_S)
            ):
                pass
            if back or self._ended.is_set():
                other.close()  # type: ignore[no-untyped-call]
            else:
                self._found = other

    def close(self) -> None:
        """End the trial."""
        self._ended.set()
        if self._thread:
            self._thread.join()
        if self._found:
            self._found.close()  # type: ignore[no-untyped-call]
