"""Vehicles on a router, followed as they appear and go.

One thread talks to the bus; scenes may be asked for from any other.

The bus's thread only takes messages. Whoever asks first for a new version of a scene builds it, and all
others get the same one.
"""

import math
import re
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from aircraft.operator import AUTOPILOT, SEARCH
from link.access.identity import AccessError, secured
from link.access.roles import MOST_VEHICLES
from link.bus.keys import HEALTH, KEYS, MAVLINK_IN, MAVLINK_OUT, row_name, vehicle_of
from link.bus.opening import NoRouter
from link.bus.session import Arrival, Bus
from link.record.record import SimulationClock
from link.record.tap import Tap
from scene.follow.history import FIRST, begun
from scene.scene import Scene

# Commands go out now or never: what waited here would go out late, when nobody wants it any more. They are
# sent again anyway.
COMMAND_KEY = replace(MAVLINK_IN, delivery=replace(MAVLINK_IN.delivery, blocking=False))
# A namespace and its slash. A token may also be for a pattern of keys, such as uav/*: that is no vehicle.
NAMESPACE = re.compile(r"[^*$\x00-\x1f\x7f]{1,200}/")
# A vehicle of a search by several: the namespace of the search, and the vehicle's number there.
TOGETHER = re.compile(r"(search/.+)/uav/([1-9]\d?)")
CROWDED = f"warning: more than {MOST_VEHICLES} vehicles on the router; only the first ones are shown"
MOST_CHANGES = 10_000  # changes that wait; beyond that the oldest are dropped
EVERY_S = 0.01  # how often messages are taken
LOOK_S = 0.2  # how often it looks for the router, and tries again to join it
CONNECT_TIMEOUT_MS = 1000
# A part that is back within this time was not gone; a router that is back gets as long to name the parts
# that it knows.
GONE_AFTER_S = 0.5
JUDGE_S = 1.0  # longest time between two versions of what there is to see: silent parts are judged anew


class Presence(NamedTuple):
    """A service of a vehicle joined the router or left it."""

    namespace: str
    service: str
    alive: bool


class Roster(Bus):
    """An observer of a whole router, without a namespace of its own.

    It sees the services of every namespace by their liveliness tokens.
    """

    def __init__(self, connect: str, secure: Path | None = None) -> None:
        """Join a router as a client; raises what `Bus` raises."""
        super().__init__(
            "view",
            connect,
            None,
            announced=False,
            secure=secure,
            connect__timeout_ms=CONNECT_TIMEOUT_MS,
        )
        self._changes: deque[Presence] = deque(maxlen=MOST_CHANGES)
        tokens = f"**/{HEALTH.named()}"
        self._hold(
            "liveliness",
            lambda session: session.liveliness().declare_subscriber(tokens, self._changed, history=True),
        )

    def _changed(self, sample: zenoh.Sample) -> None:
        namespace, _, service = str(sample.key_expr).rpartition(HEALTH.name.partition("<")[0])
        if NAMESPACE.fullmatch(namespace) and self._names.admits(service):
            self._changes.append(Presence(namespace[:-1], service, sample.kind == zenoh.SampleKind.PUT))

    def changes(self) -> list[Presence]:
        """Return what has changed since the last call; at first, all that are there.

        A lost router takes all of them with it.
        """
        self._names.tell(self.log)
        self.keep_link()
        return [self._changes.popleft() for _ in range(len(self._changes))]


# A scene, which mission it is of, and when the newest message in it was published, ms since 1970.
Built = tuple[Scene, object, float | None]


class LiveVehicle:
    """One vehicle on the bus and its history since it was first seen."""

    def __init__(self, name: str, router: str, about: dict[str, Any], secure: Path | None = None) -> None:
        """Join its bus; raises NoRouter. `about` describes its run, as far as that is known."""
        self.name = name
        self.here = True
        self.version = 0  # grows with each change of what there is to see
        self.listeners: set[Callable[[bytes], None]] = set()  # called in the bus's thread with telemetry
        search = TOGETHER.fullmatch(name)
        self._number = search[2] if search else ""  # in a search by several
        self.history = begun(about, name, number=int(self._number or FIRST))
        self._clock = SimulationClock()
        self._frozen_s: float | None = None
        self._lock = threading.Lock()
        self._built: tuple[int, Built] | None = None
        self._judge_at = 0.0
        self._alive: dict[str, bool] = {}
        self._bus = Tap(
            "view",
            router,
            search[1] if search else name,
            "error",
            announced=False,
            secure=secure,
            vehicles=(int(self._number),) if search else (),
            connect__timeout_ms=CONNECT_TIMEOUT_MS,
        )
        self._bus.subscribe(*KEYS)

    def entry(self) -> dict[str, Any]:
        """Return its row of the list of vehicles."""
        backdrop = self.history.backdrop
        return {
            "name": self.name,
            "search": _search_of(self.name),
            "title": backdrop.title,
            "here": self.here,
            "has_truth": backdrop.release is not None,
            **dict.fromkeys(("begin_s", "end_s", "readings_s", "moments")),
        }

    def scene(self, _at_s: float | None = None) -> Built:
        """Return the newest scene, its mission, and when the newest message in it was published."""
        with self._lock:
            if self._built is None or self._built[0] != self.version:
                scene = self.history.at(wall_s=self._frozen_s or time.time())
                published_ms = 1000 * self.history.wall_s or None
                self._built = self.version, (scene, self.history.missions, published_ms)
            return self._built[1]

    @property
    def system(self) -> int:
        """Its MAVLink system id; 0: not known yet."""
        return self.history.own.system

    @property
    def commanded(self) -> int:
        """The component that obeys an operator: the simulated autopilot, or the search of a real one."""
        return SEARCH if self.history.is_real else AUTOPILOT

    def send(self, payload: bytes) -> None:
        """Publish on `mavlink/in`. It does not wait."""
        if self._frozen_s is None:
            self._bus.publish(COMMAND_KEY, payload)

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
        if vehicle_of(message.name) not in ("", self._number):
            return False  # the health of another
        time_s = self._clock.time_s(message.name, message.payload, message.published_ns)
        if row_name(message.name) == MAVLINK_OUT.name:
            for listener in tuple(self.listeners):
                listener(message.payload)
        return self.history.take(
            message.name, message.payload, message.attachment, time_s, message.published_ns / 1e9
        )

    def lives(self, service: str, alive: bool) -> None:
        """Take that a part appeared or is gone. The vehicle is here as long as one of them is."""
        with self._lock:
            self._alive[service] = alive
            self.here = any(self._alive.values())
            self.history.lives(service, alive, time.time())
            self.version += 1

    def close(self) -> None:
        """Leave its bus and keep what there is to see as it is now."""
        with self._lock:
            self._frozen_s = time.time()
            self.version += 1
        self._bus.close()


class LiveFleet:
    """All vehicles on a router."""

    damaged = False  # no record

    def __init__(
        self,
        router: str,
        about: dict[str, Any],
        changed: Callable[[], None],
        say: Callable[[str], None],
        secure: Path | None = None,
    ) -> None:
        """Begin to follow.

        about: describes the run of the vehicle with its `namespace`, or, without one, of the first that
        appears.
        changed: called in the bus's thread when there is something new to see; say: told, in a line, of
        what is wrong.
        secure: the folder of certificates. Raises BusError if `router` is not an endpoint, AccessError
        without a certificate that is fit.
        """
        self.vehicles: dict[str, LiveVehicle] = {}  # in the order of their names, uav/2 before uav/10
        self.list_version = 0  # grows with each change of the list or the notice
        self.notice = ""  # what people should know of the bus: no router, too many vehicles
        self._router, self._about, self._changed, self._say = router, about, changed, say
        self._secure = secure
        self._ended = threading.Event()
        self._missed_s: dict[tuple[str, str], float] = {}  # parts that may be gone, and since when
        self._shared: dict[
            str, dict[str, bool]
        ] = {}  # the services of each search by several, if they are there
        self._crowded = False
        self._trouble = ""
        self._thread = threading.Thread(
            target=self._run, args=(self._joined(NoRouter),), name="bus", daemon=True
        )
        self._thread.start()

    def end(self) -> None:
        """Leave the bus. What there is to see stays as it is."""
        self._ended.set()
        self._thread.join(CONNECT_TIMEOUT_MS / 1000 + 1.0)

    # ---- the router ----

    def _joined(self, *awaited: type[NoRouter | AccessError]) -> Roster | None:
        """Join the router; None if an error says that we have to wait for it."""
        try:
            return Roster(self._router, self._secure)
        except awaited as error:
            self._trouble = self._reason(error)
            return None

    def _reason(self, error: Exception) -> str:
        """Return what people are told when the router cannot be joined."""
        reason = str(error).removeprefix("--connect: ")
        known = isinstance(error, AccessError) or "cannot be joined" in reason
        return reason if known else f"no router at {self._router}: waiting for one"

    def _run(self, roster: Roster | None) -> None:
        while roster is None:
            if self._ended.wait(LOOK_S):
                return
            self._tell(self._trouble)
            roster = self._joined(NoRouter, AccessError)
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
        while not self._ended.wait(EVERY_S):
            now_s = time.monotonic()
            if now_s >= look_at:
                look_at = now_s + LOOK_S
                if not roster.connected:
                    connected_since = math.inf
                elif math.isinf(connected_since):
                    connected_since = now_s
                gone = "" if roster.connected else f"the router at {self._router} is gone: waiting for it"
                self._tell((self._lack() if gone or joining else "") or gone)
            joining.extend(roster.changes())
            while joining and now_s >= join_at:
                if self._note(joining[0], now_s):
                    joining.popleft()
                else:
                    join_at = now_s + LOOK_S
            if now_s - connected_since >= GONE_AFTER_S:
                self._bury(now_s)
            if any([vehicle.follow() for vehicle in self.vehicles.values()]):
                self._changed()

    def _lack(self) -> str:
        """Return what is wrong with our certificate now: it may have expired since we joined.

        Empty if nothing is.
        """
        try:
            secured("--connect", self._router, self._secure, "view", None)
        except AccessError as error:
            return self._reason(error)
        return ""

    def _tell(self, notice: str) -> None:
        if notice != self.notice:
            self._say(notice or f"the router at {self._router} is there")
            self.notice = notice
            self._list_changed()

    def _list_changed(self) -> None:
        self.list_version += 1
        self._changed()

    # ---- who is there ----

    def _note(self, presence: Presence, now_s: float) -> bool:
        """Take a change; returns False if it has to wait for the router."""
        name, service, alive = presence
        if not alive:
            if name in self.vehicles or name in self._shared:
                self._missed_s[name, service] = now_s
            return True
        self._missed_s.pop((name, service), None)
        if name.startswith("search/") and not TOGETHER.fullmatch(name):
            self._lives(name, service, True)
            return True
        if name not in self.vehicles and len(self.vehicles) >= MOST_VEHICLES:
            if not self._crowded:
                self._say(CROWDED)
            self._crowded = True
            return True
        if name not in self.vehicles:
            try:
                vehicle = LiveVehicle(name, self._router, self._about_of(name), self._secure)
            except (NoRouter, AccessError):
                return False
            self.vehicles = dict(sorted({**self.vehicles, name: vehicle}.items(), key=_by_number))
            for shared, there in self._shared.get(_search_of(name), {}).items():
                vehicle.lives(shared, there)
        self._lives(name, service, True)
        return True

    def _lives(self, name: str, service: str, alive: bool) -> None:
        """Tell a vehicle that a part of it is there or gone; of a search by several, all its vehicles."""
        if name in self.vehicles:
            self.vehicles[name].lives(service, alive)
        elif name in self._shared or len(self._shared) < MOST_VEHICLES:
            self._shared.setdefault(name, {})[service] = alive
            for vehicle in self.vehicles.values():
                if _search_of(vehicle.name) == name:
                    vehicle.lives(service, alive)
        self._list_changed()

    def _about_of(self, name: str) -> dict[str, Any]:
        namespace = self._about.get("namespace")
        known = namespace in (name, _search_of(name)) or (namespace is None and not self.vehicles)
        return self._about if known else {}

    def _bury(self, now_s: float) -> None:
        """Report the parts that have been gone for long enough."""
        for (name, service), since_s in tuple(self._missed_s.items()):
            if now_s - since_s >= GONE_AFTER_S:
                del self._missed_s[name, service]
                self._lives(name, service, False)


def _by_number(item: tuple[str, object]) -> list[tuple[str, int]]:
    """Return what orders vehicles by name, so that uav/2 comes before uav/10."""
    return [(text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d*)", item[0])]


def _search_of(name: str) -> str:
    """Return the search that a vehicle belongs to; its own name if it searches alone."""
    search = TOGETHER.fullmatch(name)
    return search[1] if search else name
