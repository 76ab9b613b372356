"""The player of a replay: publishes the vehicle's recorded messages.

In between it waits for the services' answers.
"""

import contextlib
import math
import time
from collections import deque
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from aircraft.together import misfit
from ground.replay import verify
from ground.replay.source import SERVICES, VEHICLE_KEYS, Source
from ground.replay.verify import Answer, Difference, Rules
from link.bus.backoff import Backoff
from link.bus.inbox import Inbox
from link.bus.keys import (
    BELIEF,
    DEPARTURE,
    HEALTH,
    LATECOMER,
    READING,
    RESEND_FIRST_S,
    RESEND_LAST_S,
    STOP,
    WAYPOINT,
    row_name,
    vehicle_of,
)
from link.bus.messages import Belief, Health, by_number
from link.bus.session import Arrival, Bus, LivelinessChange
from link.cli import numbers
from link.record.record import Entry
from sitl.launch.heard import rate_interval_of
from sitl.launch.processes import (
    RECORDER,
    Ended,
    LogLine,
    MissionFailed,
    Processes,
    raise_for,
    secure_words,
)
from sitl.launch.progress import Progress, pace

ANSWER_TIMEOUT_S = 10.0  # longest wait for an answer, s of real time, or three times the longest recorded one
RETURN_TIMEOUT_S = 60.0  # longest wait for a service that is gone: somebody may be starting it again
NOBODY = 0  # no vehicle has this number
ROLL = {key.name: key for key in (DEPARTURE, LATECOMER)}  # who has left, and who comes late
SETTLE_S = 0.3  # wait for unexpected answers at the end, s of real time, or twice the longest answer time


def replay(
    source: Source,
    rules: Rules | None,
    speedup: float,
    connect: str | None,
    secure: Path | None = None,
    record: Path | None = None,
) -> "Player":
    """Replay once; returns the player, which has the result. Raises MissionFailed.

    record: the file to record to. Every process started for it has ended when this returns or raises.
    """
    inbox = Inbox()
    with contextlib.ExitStack() as stack:
        readings = {source.time_of(entry) for entry in source.entries if entry.key == READING.name}
        started = ", ".join(["router", *source.parts]) if connect is None else "replay"
        progress = stack.enter_context(Progress(max(len(readings) - 1, 0), started))
        endpoint = connect or _start(stack.enter_context(Processes(inbox)), source, secure, record)
        together = numbers(source.vehicles)
        joined = partial(Bus, connect=endpoint, namespace=source.namespace, secure=secure)
        bus = stack.enter_context(joined("uav", inbox=inbox, vehicles=together))
        # With certificates each vehicle speaks for itself alone, and none says who has left or comes late.
        others = {
            number: stack.enter_context(joined("uav", announced=False, vehicles=[number]))
            for number in (together[1:] if secure else ())
        }
        if secure and source.turns.roll:
            others[NOBODY] = stack.enter_context(joined("agent", announced=False, vehicles=together))
        bus.subscribe(BELIEF, STOP, WAYPOINT, HEALTH)
        bus.watch_services()
        progress.say(f"replay: {source.path} as {source.namespace}, {pace(speedup)}, router at {endpoint}")
        player = Player(bus, others, source, progress, rules, own=connect is None)
        player.wait_for_services()
        player.play(speedup)
        return player


def _start(processes: Processes, source: Source, secure: Path | None, record: Path | None) -> str:
    """Start a router, the services and the recorder; returns the router's endpoint."""
    endpoint = processes.start_router("tcp/127.0.0.1:0", secure)
    joining = "--connect", endpoint, "--namespace", source.namespace, *secure_words(secure)
    if record:
        about = msgspec.json.encode(source.about).decode()
        together = ("--vehicles", str(source.vehicles)) if source.vehicles > 1 else ()
        recording = "record", str(record), *joining, "--about", about, *together
        processes.answer(processes.start(RECORDER, "sitl", *recording))
    for part, words in source.parts.items():
        processes.start(part, part, *joining, *words)
    return endpoint


class Player:
    """Publishes the vehicle's recorded messages, and waits for the services' answers in between."""

    def __init__(
        self,
        bus: Bus,
        others: Mapping[int, Bus],
        source: Source,
        progress: Progress,
        rules: Rules | None,
        own: bool,
    ) -> None:
        """Take the bus, joined as the uav.

        others: that on which a vehicle of a search speaks, by its number, if not on the first; that of
        NOBODY says who has left or comes late.
        own: the services were started for this replay.
        """
        self._bus, self._others = bus, others
        self._source, self._progress, self._rules, self._own = source, progress, rules, own
        # The number of the vehicle whose reading the services answer, of several.
        self._last = source.vehicles if source.vehicles > 1 else None
        available = {kind for kind, service in SERVICES.items() if not own or service in source.parts}
        available -= rules.ignored if rules else frozenset()
        self._awaited = deque(key for key in source.then if key[1] in available)
        self._services = {SERVICES[kind] for _, kind in self._awaited} if source.recorded else {"estimator"}
        self._present: set[str] = set()
        self._due: set[tuple[int, str]] = set()  # answers still missing for what has been published
        self._given_up: set[str] = set()
        self._patience_s = max(ANSWER_TIMEOUT_S, 3 * source.slowest_s)
        self._slowest_s = 0.0
        self._heard: set[tuple[int, str]] = set()
        self._reading = b""  # the newest one's payload
        self._first_ms, self._latest_ms, self._shown_ms = -1, -1, -1
        self._published_at = 0.0
        self._resending = Backoff(RESEND_FIRST_S, RESEND_LAST_S)
        self._flown_m = 0.0
        self.last: Belief | None = None
        self.said: list[Entry] = []  # what the services said, at the times of the log
        self._newest: int | None = None  # where the last belief is in it
        self._when = 0, 0.0  # of the newest reading: published, ns, and simulation time, s
        self.ceased_at: int | None = None  # the step at which the search ceased
        self.difference: Difference | None = None  # the first from the recording

    @property
    def counts(self) -> dict[str, int]:
        """Number of different messages received, by kind."""
        return {kind: sum(heard == kind for _, heard in self._heard) for kind in SERVICES}

    def wait_for_services(self) -> None:
        """Wait, like the vehicle, until the services that answered in the recording are present."""
        while missing := sorted(self._services - self._present):
            if not self._own:
                self._progress.wait(f"waiting for {' and '.join(missing)} on {self._source.namespace}")
            self._take(self._bus.receive(timeout_s=1.0))

    def play(self, speedup: float) -> None:
        """Publish all messages at their pace, up to the first difference."""
        for said in self._source.turns.roll:  # first: no reading may come before it that is too late
            self._speaker(NOBODY).publish(ROLL[said.key], said.payload)
        began, first_ns = time.monotonic(), self._source.entries[0].published_ns
        for entry in self._source.entries:
            if speedup:
                self._listen(began + (entry.published_ns - first_ns) / 1e9 / speedup)
            if (
                entry.key == READING.name
                and (time_ms := self._source.time_of(entry)) is not None
                and time_ms > self._latest_ms
            ):
                began += self._wait_for_answers()
                if not self.difference:
                    self._begin(entry, time_ms)
            if self.difference:
                return
            self._publish(entry)
        self._wait_for_answers()
        if self._rules and any(self._must_be_silent((self._latest_ms, kind)) for kind in SERVICES):
            self._listen(time.monotonic() + max(SETTLE_S, 2 * self._slowest_s))

    def _publish(self, entry: Entry) -> None:
        closing = self._source.turns.by_reading.get(entry.payload)
        number = int(vehicle_of(entry.key) or 0) or (closing.vehicle if closing else self._last)
        key = VEHICLE_KEYS[row_name(entry.key)]
        self._speaker(number).publish(key, entry.payload, entry.attachment or None, vehicle=number)

    def _speaker(self, number: int | None) -> Bus:
        """Return the bus on which a vehicle speaks."""
        return self._others.get(number or 0, self._bus)

    # ---- waiting ----

    def _begin(self, reading: Entry, time_ms: int) -> None:
        """Expect the answers to a new reading."""
        self._reading, self._latest_ms = reading.payload, time_ms
        if closing := self._source.turns.by_reading.get(reading.payload):
            self._last = closing.vehicle
        self._when = reading.published_ns, reading.simulation_s
        if self._first_ms < 0:
            self._first_ms = time_ms
        if self._source.recorded:
            while self._awaited and self._awaited[0][0] <= time_ms:
                self._due.add(self._awaited.popleft())  # also answers whose reading the log lacks
        else:
            self._due.add((time_ms, "belief"))
        self._due = {
            (time, kind) for time, kind in self._due if time >= self._first_ms and kind not in self._given_up
        }
        self._published_at = time.monotonic()
        self._resending.tried(self._published_at)

    def _wait_for_answers(self) -> float:
        """Wait for all answers due; returns the time it took, s.

        A missing answer is a difference or a warning.
        """
        began = time.monotonic()
        self._listen(began + self._patience_s, for_answers=True)
        if gone := sorted({SERVICES[kind] for _, kind in self._due} - self._present):
            self._progress.say(f"waiting for {' and '.join(gone)} on {self._source.namespace}")
            self._listen(time.monotonic() + RETURN_TIMEOUT_S, for_answers=True)
        if self._due and not self.difference:
            self._miss(min(self._due, key=verify.place))
        return time.monotonic() - began

    def _miss(self, key: tuple[int, str]) -> None:
        time_ms, kind = key
        service = SERVICES[kind]
        why = ""
        if service not in self._present:
            why = f": the {service} is gone"
        elif not (self._own or self._heard):
            why = " (it refuses readings that it has seen before: restart it)"
        self._progress.say(
            f"warning: no {kind} received for the reading at {time_ms / 1000:.2f} s within "
            f"{time.monotonic() - self._published_at:.0f} s{why}"
        )
        self._compare(key, None)
        self._given_up |= {kind for _, kind in self._due}  # not waited for again until one arrives
        self._due.clear()

    def _listen(self, until: float, for_answers: bool = False) -> None:
        """Receive until a time, or until nothing is due.

        Meanwhile repeat an unanswered reading, as the vehicle does.
        """
        while not self.difference and (self._due or not for_answers) and (now := time.monotonic()) < until:
            if self._due and self._resending.due(now):
                self._speaker(self._last).publish(READING, self._reading, vehicle=self._last)
            self._take(self._bus.receive(min(until, self._resending.due_s if self._due else math.inf) - now))

    # ---- what arrives ----

    def _take(self, item: Any) -> None:
        match item:
            case Ended():
                raise_for(item)
            case LogLine(part, line, level):
                if level == "warning":
                    self._progress.say(line)
                if part == "estimator" and "warning: refused reading" in line and not self._source.recorded:
                    self._due.clear()
            case LivelinessChange(service, alive):
                if not alive:
                    self._present.discard(service)
                elif not self._own:
                    self._present.add(service)
            case Arrival(key) if key is HEALTH:
                # A service started just now is present once it reports its health: it may compile kernels
                # first.
                if (health := self._bus.decode(item, Health)) is not None:
                    self._check(health)
                    self._present.add(health.service)
                    self._keep(HEALTH.named(health.service), item)
            case Arrival(key, payload, attachment):
                for said in verify.answers(key.name, payload, attachment):
                    self._answered(answer := self._source.turns.placed(said, self._latest_ms))
                    if key is not WAYPOINT and answer.time_ms <= self._latest_ms:
                        self._keep(key.name, item)
                    if answer.kind == "belief" and self._shown_ms < answer.time_ms <= self._latest_ms:
                        self._shown_ms = answer.time_ms
                        self._show(self._bus.decode(item, Belief))

    def _check(self, health: Health) -> None:
        """Raise MissionFailed if an estimator searches with another number of vehicles."""
        if health.service == "estimator" and (wrong := misfit(health.about, self._source.vehicles)):
            raise MissionFailed(f"the estimator on {self._source.namespace} {wrong}")

    def _keep(self, key: str, item: Arrival) -> None:
        if key == BELIEF.name:  # only the last one's particles are needed
            if self._newest is not None:
                self.said[self._newest] = self.said[self._newest]._replace(attachment=b"")
            self._newest = len(self.said)
        self.said.append(Entry(key, *self._when, item.payload, item.attachment))

    @property
    def rate_interval(self) -> tuple[float, float] | None:
        """The 95% interval of the last belief's release rate, g/s; None if it is known, or not told."""
        if self.last is None or self._newest is None:
            return None
        return rate_interval_of(self.last, self.said[self._newest].attachment)

    def _answered(self, answer: Answer) -> None:
        if answer.time_ms > self._latest_ms:
            return  # from an earlier flight, kept for late joiners
        key = answer.time_ms, answer.kind
        self._due.discard(key)
        self._given_up.discard(answer.kind)
        if key not in self._heard and answer.time_ms == self._latest_ms:
            self._slowest_s = max(self._slowest_s, time.monotonic() - self._published_at)
        self._heard.add(key)
        self._compare(key, answer)

    def _compare(self, key: tuple[int, str], now: Answer | None) -> None:
        """Compare an answer with the recorded one; `now` is None if none came in time."""
        then = self._source.then
        if self._rules and not self.difference and (key in then or self._must_be_silent(key)):
            step = verify.step_of(then.get((key[0], "belief")))
            self.difference = verify.difference(then.get(key), now, self._rules, step)

    def _must_be_silent(self, key: tuple[int, str]) -> bool:
        """Whether the log proves that there was no such answer."""
        return (
            key not in self._source.then
            and key[0] <= self._source.sure_ms
            and verify.must_be_silent(self._source.then, *key, self._source.budget)
        )

    def _show(self, belief: Belief | None) -> None:
        if belief is not None:
            if self.last:
                before, now = by_number(self.last), by_number(belief)
                self._flown_m += sum(
                    math.dist(before[each].position, now[each].position)
                    for each in before.keys() & now.keys()
                )
            if belief.ceased and self.ceased_at is None:
                self.ceased_at = belief.step
            self.last = belief
            self._progress.show(belief, self._flown_m)
