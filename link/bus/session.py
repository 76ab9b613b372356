"""A session on the bus: publishers, subscribers, and one inbox for all messages that arrive."""

import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

import msgspec
import zenoh

from link.access.identity import secured
from link.access.roles import OF_ALL_VEHICLES, ON_BOARD, SERVICES
from link.bus.inbox import WAITING_BYTES, WAITING_MESSAGES, Drops, Inbox, ServiceNames
from link.bus.keys import HEALTH, KEYS, OF_A_VEHICLE, OF_VEHICLE, Key, vehicle_of
from link.bus.log import Log
from link.bus.messages import Health, Stop, stop_text
from link.bus.opening import (
    DEFAULT_ROUTER,
    BusError,
    ask_for_kept,
    declare_publisher,
    declare_subscriber,
    join,
    kept_of,
    open_client,
)
from link.bus.sequence import Sequence
from link.bus.sole import Sole
from link.bus.standby import Standby
from link.bus.tally import REPEATED, Tally

MOST_REASON = 300  # longest reason that is logged, characters: a reason may quote a stranger's message
LONGEST_NAMESPACE = 200  # characters of a vehicle's key prefix
HEALTH_EVERY_S = 1.0  # longest time between two health messages, also of an idle service
# Waits are cut into slices of this length: the system may deliver a signal to one of Zenoh's threads, which
# does not wake ours.
SIGNAL_POLL_S = 0.2

T = TypeVar("T", bound=msgspec.Struct)


class Arrival(NamedTuple):
    """One message from the bus."""

    key: Key
    payload: bytes
    attachment: bytes
    at: float = 0.0  # time of arrival, by time.monotonic()
    name: str = ""  # the key it was published on, within the namespace
    # Time of publishing, ns since the Unix epoch: by the publisher's clock, or by the router's if the message
    # has no timestamp.
    published_ns: int = 0
    # From a Tap: `published_ns`, clamped to the time between the previous `take` and now. They differ only if
    # clocks differ.
    received_ns: int = 0
    # The publisher's identity and sequence number, if the messages of this key are put in order.
    number: tuple[str, int] | None = None

    @property
    def size(self) -> int:
        """Bytes that it holds."""
        return len(self.payload) + len(self.attachment)

    @property
    def vehicle(self) -> int:
        """The number of the vehicle whose key it came on, in a search of several; else 1."""
        return int(vehicle_of(self.name) or 1)


def most_waiting(key: Key) -> int:
    """Return how many messages of a key may wait.

    Beyond that the oldest are dropped, so that the flight goes on.
    """
    return WAITING_MESSAGES + key.delivery.kept


def service_of(name: object) -> str:
    """Return the service that the name of a key of HEALTH ends with."""
    return str(name).rpartition("/")[2]


def part_of(name: object) -> str:
    """Return the part of a mission that a key of HEALTH belongs to: `agent`, or in a search `uav/2`."""
    service, number = service_of(name), vehicle_of(name)
    return f"{service}/{number}" if number else service


def _queue(put: Callable[[Any, int], None], arrival: Arrival) -> None:
    put(arrival, arrival.size)


def search_of(namespace: str, services: Collection[str]) -> str:
    """Return the namespace of the search of several whose vehicle has these services; else its own."""
    search, _, number = namespace.rpartition(f"/{OF_VEHICLE}")
    on_board = {service for role in ON_BOARD for service in SERVICES[role]}
    together = search and number.isdecimal() and on_board.issuperset(services)
    return search if together else namespace


class LivelinessChange(NamedTuple):
    """A service joined the bus or left it: `agent`, or in a search of several vehicles `uav/2`."""

    service: str
    alive: bool


class Bus:
    """One service's connection to the bus of one vehicle."""

    def __init__(
        self,
        service: str,
        connect: str = DEFAULT_ROUTER,
        namespace: str | None = "uav/1",
        inbox: Inbox | None = None,
        log_level: str = "info",
        announced: bool = True,
        secure: Path | None = None,
        sole: bool = False,
        certified: str | None = None,
        vehicles: Iterable[int] = (),
        **settings: Any,
    ) -> None:
        """Join a router as a client.

        namespace: the vehicle's key prefix; None: keys are those of the router, with every vehicle's
        prefix.
        inbox: receives all messages; pass your own if other sources fill it too. If too many messages
        wait, some are dropped and counted.
        announced: if False, the service has no liveliness token (observer).  settings: Zenoh's, beside
        these or instead of them.
        secure: the folder of certificates; the connection is then mutual TLS, with the certificate of the
        service's role.
        sole: refuse to be here beside an older service of the same name, now and later on.
        certified: the vehicle whose certificate is used, where that is not `namespace`.
        vehicles: the numbers of those that it deals with, in the namespace of a search of several; a
        vehicle's own service says its own. Empty: one vehicle, whose namespace it is.

        Raises NoRouter if no router admits us in time (open_client), BusError if `connect` is not an
        endpoint or an older one is here, AccessError if we have no certificate that is fit.
        """
        self.service = service
        self._namespace = namespace
        self._vehicles = tuple(vehicles)
        connect, self._identity = secured("--connect", connect, secure, service, certified or self._space())
        usual: dict[str, Any] = {
            **({"transport__link__tls": self._identity.tls} if self._identity else {}),
            **({} if namespace is None else {"namespace": namespace}),
            "timestamping__enabled": True,  # otherwise the router's clock stamps the messages
        }
        self.tally = Tally()
        self.log = Log(part_of(self._name(HEALTH)), namespace or "-", self.tally, log_level)
        self._session = open_client(connect, self._identity, self.log.warning, **usual | settings)
        self._standby = Standby(
            lambda: self.connected, lambda within_s: join(connect, within_s, **usual | settings)
        )
        self._inbox = Inbox() if inbox is None else inbox
        self._declaring = threading.Lock()
        self._publishers: dict[str, tuple[Key, Any]] = {}  # by the names of their keys
        # What we hold on the session, behind what makes it: once more, if another session takes its place.
        self._held: dict[str, tuple[Callable[[zenoh.Session], Any], Any]] = {}
        self._sequences: dict[str, Sequence[Arrival]] = {}
        self._drops: dict[str, Drops] = {}
        self._names = ServiceNames()
        self._ready: deque[Any] = deque()
        self._given_at = time.monotonic()
        self._health_at = math.inf
        self._expired = False
        own_health = self._name(HEALTH)
        self._sole = Sole(own_health, lambda: self.tally.uptime_s) if sole else None
        if self._sole:
            self._hold("own health", self._sole.listen)
            if self._sole.await_elder(lambda: part_of(own_health) in self.services()):
                self.close()
                raise self._superfluous()
        if announced:
            self.announce()

    def announce(self) -> None:
        """Show by a liveliness token that the service is there."""
        self._look_for_rights(HEALTH, HEALTH.writers, "publish", self.service)
        own_health = self._name(HEALTH)
        self._hold("token", lambda session: session.liveliness().declare_token(own_health))

    def _name(self, key: Key, vehicle: int | None = None) -> str:
        """Return the name on which it publishes: of its own vehicle, unless another is given."""
        if vehicle is None and self._vehicles and (key.own or self._is_on_board(key)):
            vehicle = self._vehicles[0]
        return key.named(self.service, vehicle)

    def _space(self) -> str | None:
        """Return the keys that it speaks for: its namespace, or in a search of several its own vehicle's."""
        if self._vehicles and self.service in OF_A_VEHICLE:
            return f"{self._namespace}/{OF_VEHICLE}{self._vehicles[0]}"
        return self._namespace

    def _is_on_board(self, key: Key) -> bool:
        return key is HEALTH and self.service in OF_A_VEHICLE

    def _names_heard(self, key: Key) -> list[str]:
        """Return the names on which it hears the messages of a key."""
        if key.own and self._vehicles:
            return [key.named(vehicle=vehicle) for vehicle in self._vehicles]
        return [f"**/{key.named()}" if key is HEALTH and self._vehicles else key.named()]

    def _hold(self, name: str, declare: Callable[[zenoh.Session], Any]) -> None:
        """Declare something on the session, and on each that takes its place.

        It replaces what had this name.
        """
        if before := self._held.get(name):
            before[1].undeclare()
        self._held[name] = declare, declare(self._session)

    def _superfluous(self) -> BusError:
        part = part_of(self._name(HEALTH))
        return BusError(f"another {part} is already on {self._namespace or 'the bus'}")

    def _look_for_rights(
        self, key: Key, roles: tuple[str, ...], verb: str, service: str | None = None
    ) -> None:
        """Say which right our certificate lacks: the router drops what it does not allow without a word."""
        if self._identity and (
            reason := self._identity.lack(roles, f"{verb} {key.named(service or '*')}", service)
        ):
            self.log.warning(reason)

    def _publisher(self, key: Key, vehicle: int | None) -> Any:
        if (name := self._name(key, vehicle)) not in self._publishers:
            with self._declaring:
                self._look_for_rights(key, key.writers, "publish", self.service if key is HEALTH else None)
                self._publishers[name] = key, declare_publisher(self._session, name, key.delivery)
        return self._publishers[name][1]

    def publish(
        self,
        key: Key,
        message: bytes | msgspec.Struct,
        attachment: bytes | None = None,
        vehicle: int | None = None,
    ) -> None:
        """Publish a message: bytes as they are, a struct as JSON.

        vehicle: the number of the one whose key it is, in a search; by default its own.
        """
        payload = message if isinstance(message, bytes) else msgspec.json.encode(message)
        try:
            self._publisher(key, vehicle).put(payload, attachment=attachment)
        except zenoh.ZError:  # in another thread a new session has taken the place of its session
            self._publisher(key, vehicle).put(payload, attachment=attachment)

    def subscribe(self, *keys: Key, newest: bool = False) -> None:
        """Put the messages of these keys into the inbox, kept ones first.

        With `newest` only the newest message of a key waits there.
        """
        for key in keys:
            self._put_in_order(key)
            put = self._inbox.lane(key.name, most_waiting(key), newest=newest, urgent=key.delivery.realtime)

            # Callbacks only queue: a callback that blocks or computes delays the whole session, stop messages
            # included.
            self.on(key, partial(_queue, put))

    def _put_in_order(self, key: Key) -> None:
        if key.delivery.kept > 1 and key.name not in self._sequences:
            self._sequences[key.name] = Sequence(
                most_waiting(key), WAITING_BYTES, lambda arrival: arrival.size
            )
            self._drops[key.name] = Drops(key.name)

    def on(self, key: Key, arrived: Callable[[Any], None], *, own: bool = True) -> None:
        """Call `arrived` with each message of a key, kept messages first, in a thread of Zenoh's.

        Without `own`, not with ours.
        """

        heard: set[str] = set()

        def received(sample: zenoh.Sample) -> None:
            if key is HEALTH:
                heard.add(part_of(sample.key_expr))
            if arrival := self._arrival(key, sample):
                arrived(arrival)

        for name in self._names_heard(key):
            self._declare(key, name, received, zenoh.Locality.ANY if own else zenoh.Locality.REMOTE)
        if key is HEALTH:  # what is new may come before what is kept
            self._ask_for_kept_health(
                lambda sample: received(sample) if part_of(sample.key_expr) not in heard else None
            )

    def _arrival(self, key: Key, sample: zenoh.Sample) -> Arrival | None:
        """Return what has come; None for the health of a service that is not admitted."""
        if key is HEALTH and not self._names.admits(service_of(sample.key_expr)):
            return None
        stamp, info = sample.timestamp, sample.source_info if key.name in self._sequences else None
        return Arrival(
            key,
            sample.payload.to_bytes(),
            sample.attachment.to_bytes() if sample.attachment else b"",
            time.monotonic(),
            str(sample.key_expr),
            stamp.get_time_as_ntp64().as_nanos() if stamp else time.time_ns(),
            number=(str(info.source_id), info.source_sn) if info else None,
        )

    def _accept(self, item: Any) -> None:
        """Make an item of the inbox ready, with those that waited for it."""
        if isinstance(item, Arrival) and item.number:
            self._ready += self._sequences[item.key.name].arrived(*item.number, item, time.monotonic())
        else:
            self._ready.append(item)

    def _declare(
        self, key: Key, name: str, handler: Any, origin: zenoh.Locality = zenoh.Locality.ANY
    ) -> None:
        self._look_for_rights(key, (*key.readers, *OF_ALL_VEHICLES), "receive")
        self._hold(name, lambda session: declare_subscriber(session, name, key.delivery, handler, origin))

    def _ask_for_kept_health(self, received: Callable[[zenoh.Sample], None]) -> None:
        ask_for_kept(
            self._session,
            self._names_heard(HEALTH)[0],
            HEALTH.delivery.kept,
            lambda reply: received(reply.ok) if reply.ok else None,
        )

    def kept(self, key: Key, service: str = "*") -> list[Arrival]:
        """Return what all publishers of a key keep now, each in its order.

        service: whose, of a key that each service has.
        """
        replies = ask_for_kept(
            self._session,
            key.named(service),
            key.delivery.kept,
            zenoh.handlers.FifoChannel(most_waiting(key)),
        )
        samples = (reply.ok for reply in replies if reply.ok is not None)
        return [arrival for sample in samples if (arrival := self._arrival(key, sample))]

    def settle(self, timeout_s: float) -> None:
        """Wait, at most timeout_s, until all that was sent before has arrived, in both directions.

        What is called with a message (`on`) runs in another thread, and may be called a little later.
        """
        # A query that nobody answers: the router's reply comes after everything exchanged before it.
        list(self._session.get("nobody", timeout=timeout_s))

    def watch_services(self) -> None:
        """Put a LivelinessChange into the inbox whenever a service joins or leaves.

        It begins with those present.
        """

        put = self._inbox.lane("liveliness")

        def changed(sample: zenoh.Sample) -> None:
            if self._names.admits(service_of(sample.key_expr)):
                put(LivelinessChange(part_of(sample.key_expr), sample.kind == zenoh.SampleKind.PUT), 0)

        tokens = self._names_heard(HEALTH)[0]
        self._hold(
            "liveliness",
            lambda session: session.liveliness().declare_subscriber(tokens, changed, history=True),
        )

    def services(self) -> set[str]:
        """Return the names of the services present, by their liveliness tokens."""
        return {
            part_of(reply.ok.key_expr)
            for reply in self._session.liveliness().get(self._names_heard(HEALTH)[0])
            if reply.ok is not None and self._names.admits(service_of(reply.ok.key_expr))
        }

    def fleet(self) -> list[str]:
        """Return the vehicles of a search by several that are in the namespace: `uav/1` and so on."""
        tokens = self._session.liveliness().get(f"{OF_VEHICLE}*/{HEALTH.named('uav')}")
        parts = {part_of(reply.ok.key_expr) for reply in tokens if reply.ok is not None}
        return sorted(part for part in parts if part.startswith(OF_VEHICLE))

    def tell_fleet(self) -> None:
        """Say once that vehicles search together in the namespace: who is for one vehicle hears none of them.

        It is said as soon as one is there, now or later.
        """
        told = threading.Event()

        def changed(sample: zenoh.Sample) -> None:
            if vehicle_of(sample.key_expr) and not told.is_set():
                told.set()
                space, part = self._namespace, part_of(sample.key_expr)
                self.log.warning(f"{space} is a search by several; --namespace {space}/{part} joins one")

        tokens = f"{OF_VEHICLE}*/{HEALTH.named('uav')}"
        self._hold(
            "fleet", lambda session: session.liveliness().declare_subscriber(tokens, changed, history=True)
        )

    def vehicles(self) -> set[str]:
        """Return the namespaces in which services are present; only without a namespace of our own.

        Several vehicles that search together have one, that of their search.
        """
        tokens = HEALTH.named()
        present: dict[str, set[str]] = {}
        for reply in self._session.liveliness().get(f"**/{tokens}"):
            if (
                reply.ok is not None
                and (namespace := str(reply.ok.key_expr).rpartition(f"/{tokens.partition('*')[0]}")[0])
                # A token of a pattern of keys is no vehicle, and strangers may choose any name.
                and not set(namespace) & set("*$")
                and namespace.isprintable()
                and len(namespace) <= LONGEST_NAMESPACE
            ):
                present.setdefault(namespace, set()).add(service_of(reply.ok.key_expr))
        return {search_of(namespace, services) for namespace, services in present.items()}

    @property
    def vehicle(self) -> int | None:
        """The number of the only vehicle of a search that it deals with; None: it deals with all."""
        return self._vehicles[0] if len(self._vehicles) == 1 else None

    @property
    def connected(self) -> bool:
        """True while a router is connected."""
        return bool(self._session.info.routers_zid())

    def expiry(self) -> str:
        """Return that our certificate has expired, and what to do; empty if there is no such trouble."""
        return self._identity.expiry() if self._identity else ""

    def receive(self, timeout_s: float | None = None) -> Any:
        """Return the next item of the inbox; None if none comes within timeout_s.

        Without a timeout it waits forever.
        """
        deadline = math.inf if timeout_s is None else time.monotonic() + timeout_s
        while not self._ready:
            self._look_after()
            left_s = deadline - time.monotonic()
            if left_s < -SIGNAL_POLL_S:
                return None  # a flood of duplicates must not extend the wait
            try:
                self._accept(self._inbox.get(timeout=min(SIGNAL_POLL_S, max(left_s, 0.0))))
            except queue.Empty:
                if left_s <= SIGNAL_POLL_S:
                    return None
        item = self._ready.popleft()
        if isinstance(item, Arrival):
            self._given_at = item.at
        return item

    def _look_after(self) -> None:
        """Ask again for missing messages, log what was lost or dropped, and publish health if it is time."""
        now_s = time.monotonic()
        for name, sequence in self._sequences.items():
            if sequence.should_ask_again(now_s):
                if self.connected:
                    # a new subscriber receives the history again
                    self.subscribe(next(key for key in KEYS if key.name == name))
                else:
                    sequence.wait_on(now_s)
            missing, ready = sequence.given_up(now_s)
            if missing:
                self.log.warning(f"{missing} messages of {name} are lost: no publisher has kept them")
            self._ready += ready
            self._drops[name].tell(sequence.dropped, self.log)
        self._inbox.tell_dropped(self.log)
        self._names.tell(self.log)
        self.keep_health()

    def refuse(self, key: Key, reason: str, kind: str) -> None:
        """Count a dropped message under `kind` and log the reason.

        It is logged as info if it is only repeated, or if the last one was refused for the same, else as a
        warning.
        """
        self.tally.refuse(kind)
        shown = reason if len(reason) <= MOST_REASON else f"{reason[:MOST_REASON]}…"
        said, before = f"refused {key.name}: {shown}", self.tally.last_refused
        self.tally.last_refused = said
        (self.log.info if kind == REPEATED or said == before else self.log.warning)(said)

    def decode(self, arrival: Arrival, kind: type[T]) -> T | None:
        """Decode JSON into a struct. A message that does not decode is refused, and None is returned."""
        try:
            said = msgspec.json.decode(arrival.payload, type=kind)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            self.refuse(arrival.key, str(error), "malformed")
            return None
        if isinstance(said, Health) and (named := service_of(arrival.name)) != said.service:
            self.refuse(arrival.key, f"{named!r} says that it is {said.service!r}", "malformed")
            return None
        return said

    def take_stop(self, arrival: Arrival) -> Stop | None:
        """Decode the stop, and say in log and health, at the first one, that the search has ceased."""
        stop = self.decode(arrival, Stop)
        if stop and not self.tally.ceased:
            self.tally.ceased = True
            self.log.info(stop_text(stop))
            self.publish_health()
        return stop

    def answered(self) -> None:
        """Report that the last received message has been answered: log its latency and publish health."""
        self.tally.latency_s = time.monotonic() - self._given_at
        self.log.debug(
            f"answered after {1000 * self.tally.latency_s:.2f} ms; {1000 * self.tally.compute_s:.2f} ms "
            "computed so far"
        )
        self.publish_health()

    def publish_health(self) -> None:
        """Publish the service's health now.

        After the first call, `receive` repeats it at least every HEALTH_EVERY_S.
        """
        tally = self.tally
        health = Health(
            service=self.service,
            state=tally.state,
            about=tally.about,
            step=tally.step,
            rate_hz=tally.rate_hz,
            latency_s=tally.latency_s,
            compute_s=tally.compute_s,
            uptime_s=tally.uptime_s,
            refused=dict(tally.refused),
            refused_lately=tally.refused_lately,
            last_error=tally.last_error,
            warnings=tally.warnings,
            ceased=tally.ceased,
            system=tally.system,
        )
        self.publish(HEALTH, health)
        self._health_at = time.monotonic() + HEALTH_EVERY_S

    def keep_link(self) -> None:
        """Go on with a new session if the router keeps ours out: its id was taken while it was away.

        `keep_health` does it, too.
        """
        if (session := self._standby.look()) is None:
            return
        self.log.warning(
            f"the router admits others but not us: our session id {self._session.zid()} is taken; going on "
            "with a new one"
        )
        before = self._session
        kept = [
            (key, *message, int(vehicle_of(name)) if vehicle_of(name) else None)
            for name, (key, _) in self._publishers.items()
            if key is not HEALTH
            for message in kept_of(before, name, key.delivery)
        ]
        with self._declaring:
            self._session, self._publishers = session, {}
        for name, (declare, _) in self._held.items():
            self._held[name] = declare, declare(session)
        for message in kept:
            self.publish(*message)
        before.close()  # type: ignore[no-untyped-call]

    def keep_health(self) -> None:
        """Publish the service's health if HEALTH_EVERY_S have passed since the last time.

        Raises BusError beside an older one, if sole.
        """
        if self._sole and self._sole.has_elder:
            raise self._superfluous()
        self.keep_link()
        if not self._expired and (expiry := self.expiry()):
            self._expired = True
            self.log.warning(expiry)
        if time.monotonic() >= self._health_at:
            self.publish_health()

    def close(self) -> None:
        """Leave the bus. An open session would hang the exit of the process."""
        self._standby.close()
        for _, held in self._held.values():
            held.undeclare()
        self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
