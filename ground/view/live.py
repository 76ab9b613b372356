"""Vehicles on a router, followed as they appear and go. One thread talks to the bus; scenes may be asked
for from any other.

The bus's thread only takes messages. Whoever asks first for a new version of a scene builds it, and all
others get the same one.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from aircraft.operator import AUTOPILOT, SEARCH
from ground.view.roster import Presence, Roster
from link.access.identity import AccessError, secured
from link.bus.keys import KEYS, MAVLINK_IN, MAVLINK_OUT
from link.bus.opening import NoRouter
from link.bus.session import Arrival
from link.record.record import SimulationClock
from link.record.tap import Tap
from scene.follow.history import History, WindTurn
from scene.scene import Backdrop, Scene

COMMANDS = replace(MAVLINK_IN, delivery=replace(MAVLINK_IN.delivery, blocking=False))
"""Commands go out now or never: what waited here would go out late, when nobody wants it any more. They
are sent again anyway.
"""
EVERY_S = 0.01
"""How often messages are taken."""
LOOK_S = 0.2
"""How often it looks for the router, and tries again to join it."""
CONNECT_TIMEOUT_S = 1.0
GONE_AFTER_S = 0.5
"""A part that is back within this time was not gone; a router that is back gets as long to name the parts
that it knows.
"""
JUDGE_S = 1.0
"""Longest time between two versions of what there is to see: silent parts are judged anew."""
MOST_VEHICLES = 32


class Described(NamedTuple):
    """What was told beforehand of one vehicle."""

    namespace: str | None
    """None: the first vehicle that appears."""
    backdrop: Backdrop
    budget: int | None
    turns: Sequence[WindTurn] | None = ()


Built = tuple[Scene, object, float | None]
"""A scene, which mission it is of, and when the newest message in it was published, ms since 1970."""


class LiveVehicle:
    """One vehicle on the bus and its history since it was first seen."""

    def __init__(
        self, name: str, router: str, described: Described | None, secure: Path | None = None
    ) -> None:
        """Join its bus; raises NoRouter."""
        self.name = name
        self.here = True
        self.version = 0
        """Grows with each change of what there is to see."""
        self.listeners: set[Callable[[bytes], None]] = set()
        """Called in the bus's thread with each payload of telemetry."""
        told = described or Described(name, Backdrop(name), None)
        self.history = History(told.backdrop, told.budget, turns=told.turns, whole=False)
        self._clock = SimulationClock()
        self._frozen_s: float | None = None
        self._lock = threading.Lock()
        self._building = threading.Lock()
        self._built: tuple[int, Built] | None = None
        self._judge_at = 0.0
        self._alive: dict[str, bool] = {}
        self._bus = Tap(
            "view",
            router,
            name,
            "error",
            announced=False,
            secure=secure,
            connect__timeout_ms=round(1000 * CONNECT_TIMEOUT_S),
        )
        self._bus.subscribe(*KEYS)

    def entry(self) -> dict[str, Any]:
        """Return its row of the list of vehicles."""
        backdrop = self.history.backdrop
        return {
            "name": self.name,
            "title": backdrop.title,
            "here": self.here,
            "has_truth": backdrop.release is not None,
            "begin_s": None,
            "end_s": None,
            "readings_s": None,
            "moments": None,
        }

    def scene(self, at_s: float | None = None) -> Built:
        """Return the newest scene, which of its missions it is of, and when the newest message in it was
        published, ms since 1970.
        """
        with self._building:
            if self._built is None or self._built[0] != self.version:
                with self._lock:
                    history, version = self.history, self.version
                    scene = history.at(wall_s=self._frozen_s or time.time())
                    self._built = version, (scene, history.missions, 1000 * history.wall_s or None)
            return self._built[1]

    # ---- in the bus's thread ----

    def follow(self) -> bool:
        """Take what has arrived; returns whether there is something new to see."""
        messages, now_s = self._bus.take(), time.monotonic()
        if not messages and now_s < self._judge_at:
            return False
        with self._lock:
            changed = any([self._take(message) for message in messages]) or now_s >= self._judge_at
            self.version += changed
        if changed:
            self._judge_at = now_s + JUDGE_S
        return changed

    def _take(self, message: Arrival) -> bool:
        time_s = self._clock.time_s(message.name, message.payload, message.published_ns)
        if message.name == MAVLINK_OUT.name:
            for listener in tuple(self.listeners):
                listener(message.payload)
        return self.history.take(
            message.name, message.payload, message.attachment, time_s, message.published_ns / 1e9
        )

    def lives(self, service: str, alive: bool) -> None:
        """Take that a part appeared or is gone."""
        with self._lock:
            self._alive[service] = alive
            self.history.lives(service, alive, time.time())
            self.version += 1

    @property
    def system(self) -> int:
        """Its MAVLink system id; 0: not known yet."""
        return self.history.own.system

    @property
    def commanded(self) -> int:
        """The component that obeys an operator's words: the simulated autopilot, or the search that flies
        a real one.
        """
        return SEARCH if self.history.is_real else AUTOPILOT

    @property
    def inhabited(self) -> bool:
        """Whether any of its parts is on the bus."""
        return any(self._alive.values())

    def send(self, payload: bytes) -> None:
        """Publish on `mavlink/in`. It does not wait."""
        if self._frozen_s is None:
            self._bus.publish(COMMANDS, payload)

    def close(self) -> None:
        """Leave its bus and keep what there is to see as it is now."""
        with self._lock:
            self._frozen_s = time.time()
            self.version += 1
        self._bus.close()


class LiveFleet:
    """All vehicles on a router."""

    def __init__(
        self,
        router: str,
        described: Described | None,
        changed: Callable[[], None],
        say: Callable[[str], None],
        secure: Path | None = None,
    ) -> None:
        """Begin to follow.

        changed: called in the bus's thread when there is something new to see; say: told, in a line, of
        what is wrong.
        secure: the folder of certificates. Raises BusError if `router` is not an endpoint, AccessError
        without a certificate that is fit.
        """
        self.vehicles: dict[str, LiveVehicle] = {}
        """In the order in which they appeared."""
        self.list_version = 0
        """Grows with each change of the list or the notice."""
        self.notice = ""
        """What people should know of the bus: no router, too many vehicles."""
        self._router, self._described, self._changed, self._say = router, described, changed, say
        self._secure = secure
        self._ended = threading.Event()
        self._pending: dict[tuple[str, str], float] = {}
        self._crowded = False
        roster, trouble = None, ""
        try:
            roster = Roster("view", router, CONNECT_TIMEOUT_S, secure)
        except NoRouter as error:
            trouble = self._trouble(error)
        self._thread = threading.Thread(target=self._run, args=(roster, trouble), name="bus", daemon=True)
        self._thread.start()

    def entries(self) -> list[dict[str, Any]]:
        """Return the list of vehicles."""
        return [vehicle.entry() for vehicle in tuple(self.vehicles.values())]

    def end(self) -> None:
        """Leave the bus. What there is to see stays as it is."""
        self._ended.set()
        self._thread.join(CONNECT_TIMEOUT_S + 1.0)

    def _run(self, roster: Roster | None, trouble: str) -> None:
        while roster is None and not self._ended.wait(LOOK_S):
            self._tell(trouble)
            try:
                roster = Roster("view", self._router, CONNECT_TIMEOUT_S, self._secure)
            except (NoRouter, AccessError) as error:
                trouble = self._trouble(error)
        if roster is None:
            return
        with roster:
            try:
                self._follow(roster)
                for vehicle in self.vehicles.values():
                    vehicle.follow()
            finally:
                for vehicle in self.vehicles.values():
                    vehicle.close()

    def _follow(self, roster: Roster) -> None:
        joining: deque[Presence] = deque()
        connected_since = look_at = join_at = time.monotonic()
        connected = True
        while not self._ended.wait(EVERY_S):
            now_s = time.monotonic()
            if now_s >= look_at:
                look_at = now_s + 0.2
                was, connected = connected, roster.connected
                connected_since = now_s if connected and not was else connected_since
                gone = "" if connected else f"the router at {self._router} is gone: waiting for it"
                self._tell((self._lack() if gone or joining else "") or gone)
            joining.extend(roster.changes())
            while joining and now_s >= join_at:
                if self._note(joining[0], now_s):
                    joining.popleft()
                else:
                    join_at = now_s + LOOK_S
            told = self._bury(now_s) if connected and now_s - connected_since >= GONE_AFTER_S else False
            seen = [vehicle.follow() for vehicle in self.vehicles.values()]
            if told or any(seen):
                self._changed()

    def _trouble(self, error: NoRouter | AccessError) -> str:
        """Return what people are told when the router cannot be joined."""
        reason = str(error).removeprefix("--connect: ")
        known = isinstance(error, AccessError) or "cannot be joined" in reason
        return reason if known else f"no router at {self._router}: waiting for one"

    def _lack(self) -> str:
        """Return what is wrong with our certificate now: it may have expired since we joined. Empty if
        nothing is.
        """
        try:
            secured("--connect", self._router, self._secure, "view", None)
        except AccessError as error:
            return self._trouble(error)
        return ""

    def _tell(self, notice: str) -> None:
        if notice != self.notice:
            self._say(notice or f"the router at {self._router} is there")
            self.notice = notice
            self._list_changed()

    def _list_changed(self) -> None:
        self.list_version += 1
        self._changed()

    def _note(self, presence: Presence, now_s: float) -> bool:
        """Take a change; returns False if it has to wait for the router."""
        name, service, alive = presence
        if not alive:
            if name in self.vehicles:
                self._pending[name, service] = now_s
            return True
        self._pending.pop((name, service), None)
        if name not in self.vehicles:
            if len(self.vehicles) >= MOST_VEHICLES:
                if not self._crowded:
                    self._say(
                        f"warning: more than {MOST_VEHICLES} vehicles on the router; only the first ones are "
                        "shown"
                    )
                self._crowded = True
                return True
            try:
                self.vehicles = {
                    **self.vehicles,
                    name: LiveVehicle(name, self._router, self._told_of(name), self._secure),
                }
            except (NoRouter, AccessError):
                return False
            self._list_changed()
        vehicle = self.vehicles[name]
        vehicle.lives(service, True)
        if not vehicle.here:
            vehicle.here = True
            self._list_changed()
        self._changed()
        return True

    def _told_of(self, name: str) -> Described | None:
        told = self._described
        if told is None or (told.namespace != name if told.namespace else self.vehicles):
            return None
        return told._replace(backdrop=replace(told.backdrop, vehicle=name))

    def _bury(self, now_s: float) -> bool:
        """Report the parts that have been gone for long enough; returns whether there are any."""
        gone = [part for part, since_s in self._pending.items() if now_s - since_s >= GONE_AFTER_S]
        for name, service in gone:
            del self._pending[name, service]
            vehicle = self.vehicles[name]
            vehicle.lives(service, False)
            if not vehicle.inhabited:
                vehicle.here = False
                self._list_changed()
        return bool(gone)
