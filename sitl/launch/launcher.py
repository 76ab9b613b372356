"""One whole mission: router, uav, estimator and agent as processes, watched until the search ends."""

import contextlib
import math
import re
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec

from aircraft.operator import AUTOPILOT, LAUNCHER, SEARCH, CommandName, order
from link.bus.frames import Frame
from link.bus.inbox import Inbox
from link.bus.keys import BELIEF, HEALTH, MAVLINK_IN, MAVLINK_OUT, READING, SEARCHERS, STOP
from link.bus.log import LEVELS
from link.bus.mavlink import BadFrame, Codec
from link.bus.messages import Belief, Health, Stop
from link.bus.session import Arrival, Bus, LivelinessChange
from link.terminal import printable
from plume import COMPILING
from plume.outcome import Outcome, TracePoint, outcome, outcome_json
from plume.worlds import AS_MODELLED
from scene.follow.area import PLACING, AreaFrame
from scene.follow.telemetry import LOCAL, frames
from sitl.launch.disturbances import Disturbances
from sitl.launch.joining import await_services
from sitl.launch.mission import Launch, agent_arguments, estimator_arguments
from sitl.launch.processes import Ended, LogLine, MissionFailed, Processes, raise_for, secure_words
from sitl.launch.progress import Progress, pace
from sitl.launch.recording import RecordFiles
from sitl.launch.relay import Relay
from sitl.launch.trace import HeardTrace
from sitl.launch.viewing import MissionPage
from sitl.launch.watchdog import LOOK_S, RECORDER, ROUTER, Watchdog
from sitl.script.events import Cut, Kill
from sitl.script.script import Expectation, Script

PAYLOAD = "payload"
CALL_EVERY_S = 1.0
"""Real time between two commands to return home."""
AT_HOME_M, ON_GROUND_M = 0.5, 0.1
LATE_STOP_S = 2.0
"""A stop may reach us so much later than the vehicle, which lands because of it."""
SHOWN = re.compile("Script: |Check: ")
"""Lines that are shown whatever their level."""
LAG_S = 5.0
"""Real time that record and trace may lag behind the mission's end: who was cut off first receives what
was missed.
"""


class Flown(NamedTuple):
    """The result of a mission."""

    script: Script
    """Names the agent's own policy where the agent runs elsewhere."""
    outcome: Outcome
    trace: list[TracePoint]
    expectations: dict[Expectation, bool]
    """What the script expects, and whether it came true."""

    def json(self, *, with_trace: bool) -> str:
        """One line of JSON, with the expectations if there are any."""
        expectations = {"expectations": self.expectations} if self.expectations else {}
        return outcome_json(self.outcome, self.trace if with_trace else None, expectations)


def fly(mission: Launch, files: RecordFiles | None = None, page: MissionPage | None = None) -> Flown:
    """Fly a mission, record it to files and show it on a page, which stays.

    Raises MissionFailed if a part dies or hangs, or if the vehicle gives up unexpectedly.
    """
    if files:
        mission = mission._replace(record=files.path)
    inbox = Inbox()
    with contextlib.ExitStack() as stack:
        starting = ["uav"] if mission.connect else ["router", "uav", "estimator", "agent"]
        progress = stack.enter_context(
            Progress(mission.script.budget, ", ".join([*starting, *[PAYLOAD] * bool(mission.vehicle)]))
        )
        processes = stack.enter_context(Processes(inbox))
        if page:
            stack.callback(page.over, processes)
        relays: dict[str, Relay] = {}

        def join(endpoint: str) -> Bus:
            bus = stack.enter_context(
                Bus("mission", endpoint, mission.namespace, inbox, announced=False, secure=mission.secure)
            )
            bus.subscribe(READING, BELIEF, STOP, HEALTH)
            return bus

        def start() -> str:
            endpoint = start_parts(processes, mission, relays, page, progress.say)
            if files:
                files.made = True
            return endpoint

        if mission.connect:
            bus = join(mission.connect)
            policy = await_services(bus, mission.namespace, progress.say, mission.wait_s)
            mission = mission._replace(script=mission.script.changed({"agent.policy": policy}))
            endpoint = start()
        else:
            endpoint = start()
            bus = join(endpoint)
        for relay in relays.values():
            stack.callback(relay.close)
        parts = [
            ROUTER,
            "uav",
            *SEARCHERS,
            *[PAYLOAD] * bool(mission.vehicle),
            *[RECORDER] * bool(mission.record),
        ]
        watchdog = Watchdog(parts, mission.patience_s, time.monotonic(), progress.say, processes.tell_stacks)
        events = [event for event in mission.script.events if isinstance(event, Kill | Cut)]
        disturbances = Disturbances(events, processes, relays, watchdog, progress.say)
        return MissionWatch(mission, bus, progress, watchdog, disturbances, endpoint, files).until_the_end()


def start_parts(
    processes: Processes,
    mission: Launch,
    relays: dict[str, Relay],
    page: MissionPage | None = None,
    say: Callable[[str], None] = print,
) -> str:
    """Start all parts that do not run elsewhere; returns the router's endpoint. Links that the script cuts
    get a relay.

    Raises MissionFailed if the router or the recorder cannot start.
    """
    script = mission.script
    endpoint = mission.connect or processes.start_router(mission.listen, mission.secure)
    level = "debug" if mission.log_level == "debug" else "info"  # the launcher filters what it shows
    relays |= {
        part: Relay(endpoint)
        for part in sorted({event.part for event in script.events if isinstance(event, Cut)})
    }

    secured = secure_words(mission.secure)

    def joining(part: str) -> tuple[str, ...]:
        router = relays[part].endpoint if part in relays else endpoint
        return "--connect", router, "--namespace", mission.namespace, "--log-level", level, *secured

    services = (
        {}
        if mission.connect
        else {"estimator": estimator_arguments(mission), "agent": agent_arguments(mission)}
    )
    about = {
        "namespace": mission.namespace,
        "mission": script,
        "seed": script.seed,
        "policy": script.agent.policy,
        "budget": script.budget,
        "parts": services,
    }
    if truth := mission.truth:
        about["scenario"] = truth
    if mission.vehicle:
        about |= {"vehicle": mission.vehicle, "payload": mission.payload}
    about_json = msgspec.json.encode(about).decode()
    recording = None
    if mission.record:
        recording = processes.start(
            "recorder", "sitl", "record", str(mission.record), *joining("recorder"), "--about", about_json
        )
    if page:
        page.start(processes, ("--connect", endpoint, *secured), about_json)
    for service, words in services.items():
        processes.start(service, service, *joining(service), *words)
    if recording:
        processes.answer(recording)  # it records everything from now on
    if page:
        page.await_start(say)
    words = [*mission.uav_arguments, *joining("uav"), "-I", str(mission.instance)]
    if mission.vehicle:
        processes.start(
            PAYLOAD,
            "sitl",
            "payload",
            "--payload",
            mission.payload,
            *mission.payload_arguments,
            *joining(PAYLOAD),
        )
        processes.start("uav", "sitl", "uav", "--vehicle", mission.vehicle, *words).flies = True
    else:
        processes.start("uav", "sitl", "uav", *words)
    return endpoint


class MissionWatch:
    """Watches one mission until its end."""

    def __init__(
        self,
        mission: Launch,
        bus: Bus,
        progress: Progress,
        watchdog: Watchdog,
        disturbances: Disturbances,
        endpoint: str,
        files: RecordFiles | None,
    ) -> None:
        """Take the mission, where it is heard and shown, what goes wrong on purpose, and the files of its
        record.
        """
        self._mission = mission
        self._script = mission.script
        self._bus = bus
        self._progress = progress
        self._watchdog = watchdog
        self._look_at, self._began_at = 0.0, time.monotonic()
        self._disturbances = disturbances
        self._endpoint = endpoint
        self._files = files
        self._trace = HeardTrace()
        self._compute: dict[str, Health] = {}
        self._compiling = False
        self._last: Belief | None = None
        self._distance_m = 0.0
        self._last_words: dict[str, str] = {}
        self._warned = False
        self._gone: set[str] = set()
        self._record_ended = False
        self._stopped = self._landed = False
        self._landed_since = 0.0
        self._area, self._landed_at = AreaFrame(), (math.nan, math.nan)

    def until_the_end(self) -> Flown:
        """Watch; returns the result."""
        script = self._script
        lost_at = math.inf  # from then on what has not come counts as lost
        while not self._over and time.monotonic() < lost_at:
            self._listen(self._disturbances.wait_s())
            if self._last:
                self._disturbances.reached(self._last.step, self._time_s(self._last.step))
            if self._landed and not self._stopped and time.monotonic() >= self._landed_since + LATE_STOP_S:
                break
            if not (self._stopped or self._ceased) or self._disturbances.wait_s() is not None:
                lost_at = time.monotonic() + self._mission.patience_s
        if self._stopped and not self._ceased:
            raise MissionFailed("the estimator has declared the stop, but its last belief was not received")
        if self._last is None or (self._landed and not self._ceased and not script.expectations):
            if self._landed and (how := "; ".join(self._compute["uav"].warnings)):
                raise MissionFailed(how)
            words = self._last_words.get("uav", "none")
            raise MissionFailed(f"the uav landed before the search was over; its last words: {words}")
        self._await_landing(self._last)
        self._await_record(self._last.step)
        self._await_trace()
        return self._flown(self._last)

    def _time_s(self, step: int) -> float:
        """Return the time that a script's events count by, s: a reading's own, but a real vehicle's clock
        began before the mission.
        """
        since_s = (time.monotonic() - self._began_at) * self._script.speedup
        return since_s if self._mission.vehicle else self._trace.time_s(step)

    @property
    def _over(self) -> bool:
        """Whether the search is over and the last compute times, which follow the last belief, have
        arrived.
        """
        last, compute = self._last, self._compute
        if last is None or not self._ceased:
            return False
        wanted = {"estimator": last.step, "agent": last.step - 1}
        return all(service in compute and compute[service].step >= step for service, step in wanted.items())

    @property
    def _ceased(self) -> bool:
        """Whether the last belief has come."""
        return self._last is not None and (self._last.ceased or self._last.step >= self._script.budget)

    def _listen(self, timeout_s: float | None) -> None:
        """Handle what arrives within a time, and check now and then for silent parts."""
        if self._last is None:
            self._progress.wait(self._reason())
        self._take(self._bus.receive(LOOK_S if timeout_s is None else min(timeout_s, LOOK_S)))
        now_s = time.monotonic()
        if now_s >= self._look_at:
            self._look_at = now_s + LOOK_S
            if reason := self._watchdog.look(now_s, self._bus.connected):
                raise MissionFailed(reason)

    def _reason(self) -> str:
        """Return what the first belief waits for."""
        uav = self._compute.get("uav")
        if uav and uav.state != "standby":
            return "flying to the start" if uav.state == "searching" else uav.state
        missing = sorted({*SEARCHERS, "uav", *[PAYLOAD] * bool(self._mission.vehicle)} - set(self._compute))
        if self._compiling and SEARCHERS & set(missing):
            return COMPILING
        return (
            f"waiting for {', '.join(missing)}"
            if missing or uav is None
            else "; ".join(uav.warnings) or "waiting for takeoff"
        )

    def _take(self, item: Any) -> None:
        match item:
            case Ended(part="recorder"):
                self._record_ended = True
                self._watchdog.ended(RECORDER)
                self._progress.say(f"warning: the recording stopped: {item.last_words}")
            case Ended(part="view"):
                self._progress.say(f"warning: the page ended: {item.last_words}")
            case Ended():
                raise_for(item)
            case LogLine(part, line, level):
                self._last_words[part] = line
                self._compiling = self._compiling or line == COMPILING
                if LEVELS.index(level) >= LEVELS.index(self._mission.log_level) or SHOWN.search(line):
                    self._progress.say(line)
            case LivelinessChange(service, alive) if self._mission.connect and service in SEARCHERS:
                if not alive:
                    self._progress.say(f"warning: the {service} is gone")
                elif service in self._gone:
                    self._progress.say(f"the {service} is back")
                    self._watchdog.begins(service, time.monotonic())
                (self._gone.discard if alive else self._gone.add)(service)
            case Arrival(key) if key is STOP:
                self._stopped = self._stopped or self._bus.decode(item, Stop) is not None
            case Arrival(key) if key is BELIEF:
                if (belief := self._bus.decode(item, Belief)) and self._trace.belief(belief):
                    self._follow(belief)
            case Arrival(key, payload) if key is READING:
                self._trace.reading(payload, self._system or None)
            case Arrival(key) if key is HEALTH:
                if health := self._bus.decode(item, Health):
                    self._watchdog.heard(health.service, time.monotonic())
                    self._compute[health.service] = health
                    self._warned = self._warned or bool(health.service == "estimator" and health.warnings)
                    if (health.service, health.state) == ("uav", "landed") and not self._landed:
                        self._landed, self._landed_since = True, time.monotonic()
            case Arrival(key, payload) if key is MAVLINK_OUT:
                self._follow_down(payload)

    def _follow_down(self, payload: bytes) -> None:
        """Note where the vehicle stands, m from home."""
        with contextlib.suppress(BadFrame):
            for frame, fields in frames(payload, {*PLACING, LOCAL}, self._is_vehicle):
                if frame.message_id in PLACING:
                    self._area.take(frame.message_id, fields)
                elif (place := self._area.place(fields)) and (self._area.on_ground or place[2] < ON_GROUND_M):
                    self._landed_at = place[:2]

    def _is_vehicle(self, frame: Frame) -> bool:
        return frame.system == self._system and frame.component == AUTOPILOT

    @property
    def _system(self) -> int:
        """The vehicle's MAVLink system id, as its health tells it: a real autopilot has its own. 0: not
        known yet.
        """
        uav = self._compute.get("uav")
        return (uav.system if uav else 0) or self._mission.system or 0

    def _follow(self, belief: Belief) -> None:
        script = self._script
        if self._last and belief.step < self._last.step:
            return  # it was missed, and comes late
        if self._last is None:
            if script.about:
                self._progress.say(printable(script.about))
            where = "" if script.world == AS_MODELLED else f"world {script.world}, "
            self._progress.say(
                f"mission: seed {script.seed}, {script.agent.policy}, {where}{pace(script.speedup)}"
            )
            self._progress.say(f"router at {self._endpoint}")
            if self._files and (trouble := self._files.take_place()):
                self._progress.say(f"warning: {trouble}")
        else:
            self._distance_m += math.dist(self._last.position, belief.position)
        self._last = belief
        self._progress.show(belief, self._distance_m)

    def _await_landing(self, last: Belief) -> None:
        """Wait until the vehicle has done what comes after the search. A stop sends it on its way; else it
        is told to, each second.
        """
        home, after = "returned home" in self._script.expectations, self._script.vehicle.after_stop
        if after == "hold":
            if not home and "landed" not in self._script.expectations:
                return
            after = "return" if home else "land"
        if home:
            self._bus.subscribe(MAVLINK_OUT)  # where it has landed
        if not self._landed:
            self._progress.say("returning home" if after == "return" else "landing")
        word: CommandName = "return" if after == "return" else "land"
        codec, call_at = Codec(*LAUNCHER), 0.0
        lost_at = math.inf  # from then on the place that was not told is not waited for
        while not self._landed or (home and math.isnan(self._landed_at[0]) and time.monotonic() < lost_at):
            lost_at = min(lost_at, time.monotonic() + LAG_S) if self._landed else math.inf
            state = self._compute["uav"].state if "uav" in self._compute else ""
            if state in ("paused", "holding"):
                self._progress.say("a pilot leads the vehicle: it is left to them")
                return
            if state == "searching" and not last.ceased and time.monotonic() >= call_at:
                component = SEARCH if self._mission.vehicle else AUTOPILOT
                self._bus.publish(MAVLINK_IN, codec.pack(order(word, self._system, component)))
                call_at = time.monotonic() + CALL_EVERY_S
            self._listen(CALL_EVERY_S)

    def _await_record(self, step: int) -> None:
        """Wait until the record has all readings: only a running vehicle can send missing ones again."""
        if not self._mission.record:
            return
        deadline = time.monotonic() + LAG_S
        while not self._record_ended and not (
            "recorder" in self._compute and self._compute["recorder"].step >= step
        ):
            if time.monotonic() >= deadline:
                self._progress.say("warning: the record lacks the last readings: they came too late")
                return
            self._listen(deadline - time.monotonic())

    def _await_trace(self) -> None:
        """Wait for beliefs that were missed."""
        deadline = time.monotonic() + LAG_S
        while self._trace.missing and (left_s := deadline - time.monotonic()) > 0:
            self._listen(left_s)

    def _flown(self, last: Belief) -> Flown:
        script = self._script
        points, lost = (
            self._trace.points(),
            f"{self._trace.missing} of {last.step + 1} beliefs were not received",
        )
        if points is None:
            raise MissionFailed(f"{lost}: the trace has gaps")
        if self._trace.missing:
            self._progress.say(f"warning: {lost}: of these the trace has the readings")
        for number, event in enumerate(script.events):
            if event.step is not None and event.step > last.step:
                self._progress.say(
                    f"warning: events[{number}] of step {event.step} did not happen: the search ended at "
                    f"step {last.step}"
                )
        search_time_s = sum(
            self._compute[service].compute_s for service in ("estimator", "agent") if service in self._compute
        )
        said = last.ceased, search_time_s, last.assume, last.stop, script.world
        result = outcome(script.seed, script.agent.policy, self._mission.truth, points, *said)
        located = bool(result.located)
        so = {
            "ceased": result.ceased,
            "not ceased": not result.ceased,
            "located": located,
            "not located": not located,
            "false stop": result.ceased and not located,
            "warned": self._warned,
            "landed": self._landed,
            "returned home": self._landed and math.hypot(*self._landed_at) < AT_HOME_M,
        }
        return Flown(script, result, points, {expected: so[expected] for expected in script.expectations})
