"""One whole mission: router, uav, estimator and agent as processes, watched until the search ends."""

import contextlib
import math
import re
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import msgspec

from aircraft.operator import AUTOPILOT, LAUNCHER_IDS, SEARCH, order
from aircraft.search.events import OnBoard, ScriptEvent, words
from aircraft.search.search import STANDBY
from link.bus.inbox import Inbox
from link.bus.keys import (
    BELIEF,
    DEPARTURE,
    HEALTH,
    LATECOMER,
    LEAVE_OUT,
    MAVLINK_IN,
    MAVLINK_OUT,
    READING,
    SEARCHERS,
    STOP,
)
from link.bus.log import LEVELS
from link.bus.mavlink import Codec
from link.bus.messages import (
    Belief,
    Departure,
    Health,
    Latecomer,
    LeaveOut,
    departure_text,
    latecomer_text,
)
from link.bus.session import Arrival, Bus, LivelinessChange, part_of
from link.cli import BAD_INPUT
from link.early import INTERRUPTED
from link.terminal import printable
from plume import COMPILING
from plume.outcome import Outcome, TracePoint, outcome, outcome_json
from plume.problem import PAPER
from plume.scenario import AS_MODELLED
from scene.follow.described import outlines
from sitl.launch.disturbances import Disturbances
from sitl.launch.heard import MissionHeard, await_services
from sitl.launch.mission import Launch, agent_arguments, estimator_arguments, uav_arguments
from sitl.launch.processes import (
    FLYING,
    KINDS,
    RECORDER,
    ROUTER,
    Ended,
    LogLine,
    MissionFailed,
    Processes,
    how_ended,
    raise_for,
    secure_words,
    why_ended,
)
from sitl.launch.progress import Progress, pace
from sitl.launch.recording import RecordFiles
from sitl.launch.relay import Relay
from sitl.launch.viewing import NO_PAGE, MissionPage
from sitl.launch.watchdog import LOOK_S, Watchdog
from sitl.script.script import Cut, Expectation, Script

CALL_EVERY_S = 1.0  # real time between two commands to return home
LATE_STOP_S = 2.0  # a stop may reach us this much later than the vehicle, which lands because of it
SHOWN = re.compile("Script: |Check: ")  # lines that are shown whatever their level
EXPIRED = re.compile("the certificate .* expired on .*")  # what a part says of its own, see `Identity.expiry`
EVENT = re.compile("Script: .*")  # what a vehicle says of an event of the script
# Real time that record and trace may lag behind the mission's end: a part that was cut off receives first
# what it missed.
LAG_S = 5.0
LINES_S = 0.5  # real time that a vehicle's lines may lag behind what it says on the bus
MOST_REASON = 200  # characters of why a vehicle is left out


class Flown(NamedTuple):
    """The result of a mission."""

    script: Script  # names the agent's own policy where the agent runs elsewhere
    outcome: Outcome
    trace: list[TracePoint]
    expectations: dict[Expectation, bool]  # what the script expects, and whether it came true

    def json(self, *, with_trace: bool) -> str:
        """One line of JSON, with the expectations if there are any."""
        return outcome_json(
            self.outcome,
            self.trace if with_trace else None,
            {"expectations": self.expectations} if self.expectations else {},
        )


def fly(mission: Launch, files: RecordFiles | None, page: MissionPage) -> Flown:
    """Fly a mission, record it to files and show it on a page, which stays.

    Raises MissionFailed if a part dies or hangs, or if the vehicle gives up unexpectedly.
    """
    inbox = Inbox()
    with contextlib.ExitStack() as stack:
        payload = [*mission.payloads]
        uavs = ", ".join(mission.uavs)
        starting = [uavs if mission.connect else f"router, {uavs}, estimator, agent", *payload]
        progress = stack.enter_context(Progress(mission.script.budget, ", ".join(starting)))
        processes = Processes(inbox)
        if files:  # once all have ended: an interrupt may come between the recorder's answer and its reader
            stack.callback(lambda: files.made_if(processes.has_answered(RECORDER)))
        stack.enter_context(processes)
        stack.callback(page.over, processes)
        relays: dict[str, Relay] = {}

        def join(endpoint: str) -> Bus:
            bus = stack.enter_context(
                Bus(
                    "mission",
                    endpoint,
                    mission.namespace,
                    inbox,
                    announced=False,
                    secure=mission.secure,
                    vehicles=mission.numbers,
                )
            )
            together = [DEPARTURE, LATECOMER] if mission.numbers else []
            bus.subscribe(READING, BELIEF, STOP, HEALTH, *together, *[MAVLINK_OUT] * bool(mission.real))
            return bus

        if mission.connect:
            bus = join(mission.connect)
            wait_s = mission.real.wait_s if mission.real else math.inf
            policy = await_services(bus, mission.namespace, len(mission.uavs), progress.say, wait_s)
            mission = replace(mission, script=mission.script.changed({"agent.policy": policy}))
        endpoint = start_parts(processes, mission, relays, page, progress.say)
        if not mission.connect:
            bus = join(endpoint)
        for relay in relays.values():
            stack.callback(relay.close)
        for vehicle in mission.late:
            bus.publish(LEAVE_OUT, LeaveOut(vehicle, "joins later", late=True))
        uavs_at_first = [uav for number, uav in enumerate(mission.uavs, 1) if number not in mission.late]
        watchdog = Watchdog(
            [ROUTER, *uavs_at_first, *SEARCHERS, *payload, *[RECORDER] * bool(mission.record)],
            mission.patience_s,
            time.monotonic(),
            progress.say,
            processes.tell_stack,
        )
        disturbances = Disturbances(
            mission.script.events,
            processes,
            relays,
            watchdog,
            progress.say,
            lambda vehicle, why: bus.publish(LEAVE_OUT, LeaveOut(vehicle, why)),
            lambda vehicle: start_uav(processes, mission, endpoint, mission.uavs[vehicle - 1]),
        )
        return MissionWatch(mission, bus, progress, watchdog, disturbances, endpoint, files).until_the_end()


def start_parts(
    processes: Processes,
    mission: Launch,
    relays: dict[str, Relay],
    page: MissionPage = NO_PAGE,
    say: Callable[[str], None] = print,
) -> str:
    """Start all parts that do not run elsewhere; returns the router's endpoint.

    Links that the script cuts get a relay.

    Raises MissionFailed if the router or the recorder cannot start.
    """
    script, real = mission.script, mission.real
    connect, secured = mission.connect, secure_words(mission.secure)
    endpoint = connect or processes.start_router(mission.listen, mission.secure)
    for part in sorted({event.part for event in script.events if isinstance(event, Cut)}):
        relays[part] = Relay(endpoint)

    def joining(part: str) -> tuple[str, ...]:
        return joining_words(mission, relays[part].endpoint if part in relays else endpoint)

    services = (
        {} if connect else {"estimator": estimator_arguments(mission), "agent": agent_arguments(mission)}
    )
    about = {
        "namespace": mission.namespace,
        "mission": script,
        "problem": script.problem,
        "seed": script.seed,
        "policy": script.agent.policy,
        "budget": script.budget,
        "parts": services,
    }
    if walls := outlines(script.world):  # who reads the record need not have the world's file
        about["walls"] = walls
    if truth := mission.truth:
        about["scenario"] = truth
    if mission.numbers:
        about["fleet"] = mission.fleet
    if real:
        about |= {"vehicle": ", ".join(real.urls), "payload": real.payload}
    about_json = msgspec.json.encode(about).decode()
    recorder = None
    if mission.record:
        words = "record", str(mission.record), *joining(RECORDER), "--about", about_json
        together = ("--vehicles", str(len(mission.numbers))) if mission.numbers else ()
        recorder = processes.start(RECORDER, "sitl", *words, *together)
    page.start(processes, ("--connect", endpoint, *secured), about_json)
    for service, arguments in services.items():
        processes.start(service, service, *joining(service), *arguments)
    if recorder:
        processes.answer(recorder)  # it records everything from now on
    page.await_start(say)
    if real:
        measures = ("--payload", real.payload, *real.payload_arguments)
        for payload in mission.payloads:
            number = payload.partition("/")[2]
            own = ("--number", number) if number else ()
            processes.start(payload, "sitl", "payload", *measures, *joining(payload), *own)
    for vehicle, uav in enumerate(mission.uavs, 1):
        if vehicle not in mission.late:
            start_uav(processes, mission, relays[uav].endpoint if uav in relays else endpoint, uav)
    return endpoint


def joining_words(mission: Launch, router: str) -> tuple[str, ...]:
    """Return the flags with which a part joins the bus at a router's endpoint."""
    level = "debug" if mission.log_level == "debug" else "info"  # the launcher filters what it shows
    secured = secure_words(mission.secure)
    return "--connect", router, "--namespace", mission.namespace, "--log-level", level, *secured


def start_uav(processes: Processes, mission: Launch, router: str, uav: str) -> None:
    """Start a part that flies, which joins the bus at a router's endpoint."""
    kind = FLYING if uav in mission.real_uavs else None
    words = "sitl", "uav", *uav_arguments(mission)[uav], *joining_words(mission, router)
    processes.start(uav, *words, kind=kind)


class MissionWatch:
    """Watches one mission until its end: the search, the landing, and what lags behind them."""

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
        self._mission, self._bus, self._progress = mission, bus, progress
        self._watchdog, self._disturbances = watchdog, disturbances
        self._endpoint, self._files = endpoint, files
        self._heard = MissionHeard(bus, mission.system, mission.stands, mission.late)
        self._began_at, self._look_at = time.monotonic(), 0.0
        self._last_words: dict[str, str] = {}
        self._expired: dict[str, str] = {}  # the parts whose certificate has expired, in their words
        self._happened: set[str] = set()  # events of the script on board, in words
        # Services elsewhere that have left the bus, and parts without which the mission goes on.
        self._gone: set[str] = set()

    def until_the_end(self) -> Flown:
        """Watch; returns the result."""
        self._await_search()
        last = self._searched()
        self._await_landing(last)
        self._await_record(last.step)
        deadline = time.monotonic() + LAG_S
        while self._heard.trace.missing and (left_s := deadline - time.monotonic()) > 0:
            self._listen(left_s)
        deadline = time.monotonic() + LINES_S
        while self._missed() and (left_s := deadline - time.monotonic()) > 0:
            self._listen(left_s)
        return self._flown(last)

    # ---- the search ----

    def _await_search(self) -> None:
        """Wait until the search is over: its last belief has come, with the compute times that follow it.

        What does not come within the patience counts as lost.
        """
        heard, lost_at = self._heard, math.inf
        while not self._is_complete() and time.monotonic() < lost_at:
            self._listen(self._disturbances.wait_s())
            if heard.last:
                self._disturbances.reached(heard.last.step, self._time_s(heard.last.step))
            flying = [vehicle for vehicle in heard.searching if vehicle.flies]
            last_landed_s = max(
                (vehicle.landed_since_s for vehicle in heard.flown if vehicle.landed), default=-math.inf
            )
            if not (heard.stopped or flying) and time.monotonic() >= last_landed_s + LATE_STOP_S:
                break
            if not (heard.stopped or self._has_ended()) or self._disturbances.wait_s() is not None:
                lost_at = time.monotonic() + self._mission.patience_s

    def _has_ended(self) -> bool:
        """Whether the last belief has come."""
        last = self._heard.last
        return last is not None and (last.ceased or last.step >= self._mission.script.budget)

    def _is_complete(self) -> bool:
        """Whether the last belief has come, and then the health of those who made it and answered it."""
        last, health = self._heard.last, self._heard.health
        if last is None or not self._has_ended():
            return False
        wanted = {"estimator": last.step, "agent": last.step - 1}
        return all(service in health and health[service].step >= step for service, step in wanted.items())

    def _searched(self) -> Belief:
        """Return the last belief. Raises MissionFailed if the search has not come to its end."""
        heard = self._heard
        if heard.stopped and not self._has_ended():
            raise MissionFailed("the estimator has declared the stop, but its last belief was not received")
        landed = next((vehicle for vehicle in heard.vehicles if vehicle.landed), None)
        broken_off = landed and not self._has_ended() and not self._mission.script.expectations
        if heard.last is None or broken_off:
            if landed and (how := "; ".join(landed.health.warnings if landed.health else ())):
                raise MissionFailed(how)
            part = landed.part if landed else self._mission.uavs[0]
            raise MissionFailed(
                f"the {part} landed before the search was over; its last words: "
                + self._last_words.get(part, "none")
            )
        return heard.last

    def _time_s(self, step: int) -> float:
        """Return the time that a script's events count by, s.

        It is a reading's own, but a real vehicle's clock began before the mission.
        """
        if self._mission.real:
            return (time.monotonic() - self._began_at) * self._mission.script.speedup
        return self._heard.trace.time_s(step)

    def _listen(self, timeout_s: float | None) -> None:
        """Handle what arrives within a time, and check now and then for silent parts."""
        if self._heard.last is None:
            self._progress.wait(self._awaited())
        self._take(self._bus.receive(LOOK_S if timeout_s is None else min(timeout_s, LOOK_S)))
        now_s = time.monotonic()
        if now_s >= self._look_at:
            self._look_at = now_s + LOOK_S
            if silent := self._watchdog.look(now_s, self._bus.connected):
                those = [why for part, why in self._expired.items() if silent.startswith(f"the {part} has ")]
                raise MissionFailed(self._bus.expiry() or ": ".join([silent, *those]))

    def _awaited(self) -> str:
        """Return what the first belief waits for."""
        heard = self._heard
        searching = [vehicle for vehicle in heard.searching if not vehicle.ended]
        uavs, states = [each.part for each in searching], [each.state for each in searching]
        if states.count("searching") == len(states):
            return "flying to the start" + "s" * (len(states) > 1)
        if busy := [state for state in states if state not in ("", "standby", "searching")]:
            return busy[0]
        missing = sorted({*SEARCHERS, *uavs, *self._mission.payloads} - set(heard.health))
        if any(self._last_words.get(part) == COMPILING for part in missing):
            return COMPILING
        if missing:
            return f"waiting for {', '.join(missing)}"
        warnings = [text for part in uavs for text in heard.health[part].warnings]
        return "; ".join(dict.fromkeys(warnings)) or "waiting for takeoff"

    def _take(self, item: Any) -> None:
        now_s = time.monotonic()
        match item:
            case Ended(part=part) if part in KINDS and (spared := KINDS[part].spared):
                self._gone.add(part)
                self._watchdog.ended(part)
                why = item.last_words if item.status > 0 else f"the {part} {how_ended(item)}"
                self._progress.say(f"warning: {spared}: {why}")
            case Ended(part=part) if self._goes_on_without(item):
                ended = next(each for each in self._heard.vehicles if each.part == part)
                ended.ended = why_ended(item)
                self._watchdog.ended(part)
                if ended.number and self._wait_on_the_ground():
                    self._bus.publish(LEAVE_OUT, LeaveOut(ended.number, ended.ended[:MOST_REASON]))
                self._progress.say(f"warning: {part} {how_ended(item)}; its last words: {item.last_words}")
            case Ended(part=part) if self._spares_payload(item):  # its vehicle gives up by itself
                self._watchdog.ended(part)
                self._progress.say(f"warning: {part} {how_ended(item)}; its last words: {item.last_words}")
            case Ended():
                raise_for(item)
            case LogLine(part, line, level):
                self._last_words[part] = line
                if expired := EXPIRED.search(line):
                    self._expired[part] = expired[0]
                if happened := EVENT.search(line):
                    self._happened.add(happened[0])
                if LEVELS.index(level) >= LEVELS.index(self._mission.log_level) or SHOWN.search(line):
                    self._progress.say(line)
            case LivelinessChange(service, alive) if self._mission.connect and service in SEARCHERS:
                if not alive:
                    self._gone.add(service)
                    self._progress.say(f"warning: the {service} is gone")
                elif service in self._gone:
                    self._gone.remove(service)
                    self._progress.say(f"the {service} is back")
                    self._watchdog.begins(service, now_s)
            case Arrival():
                is_first = self._heard.last is None
                match self._heard.take(item, now_s):
                    case Health():
                        self._watchdog.heard(part_of(item.name), now_s)
                    case Departure() as left:
                        self._progress.say(f"warning: {departure_text(left)}")
                    case Latecomer() as late if late.step is not msgspec.UNSET:
                        self._progress.say(latecomer_text(late))
                    case Belief() as belief:
                        if is_first:
                            self._introduce()
                        self._progress.show(belief, self._heard.distance_m)

    def _goes_on_without(self, ended: Ended) -> bool:
        """Whether the mission goes on without a part that has ended: one of several.

        The others search on, or the search is over.
        """
        others = [each for each in self._heard.searching if each.flies and each.part != ended.part]
        one_of_several = bool(self._mission.numbers) and ended.part in self._mission.uavs
        over = one_of_several and self._has_ended()
        return one_of_several and ended.status not in (INTERRUPTED, BAD_INPUT) and (bool(others) or over)

    def _spares_payload(self, ended: Ended) -> bool:
        """Whether a part that has ended is the payload of one of several vehicles."""
        is_one = bool(self._mission.numbers) and ended.part in self._mission.payloads
        return is_one and ended.status not in (INTERRUPTED, BAD_INPUT)

    def _wait_on_the_ground(self) -> bool:
        """Whether some of several vehicles may still wait for the others to be there."""
        begun = self._heard.last is not None
        return not begun and any(each.state in ("", STANDBY) for each in self._heard.vehicles)

    def _introduce(self) -> None:
        """Say what is flown, once the search has begun; from then on its record counts."""
        script = self._mission.script
        if self._mission.numbers:
            self._watchdog.spare([*self._mission.uavs, *self._mission.payloads])  # the others go on without
        if script.about:
            self._progress.say(printable(script.about))
        where = "" if script.problem.area == PAPER.area else f"area {script.problem.area.text}, "
        where += "" if script.world == AS_MODELLED else f"world {script.world}, "
        fleet = self._mission.fleet
        who = f"{fleet.vehicles} vehicles from {fleet.formation}, " if fleet.vehicles > 1 else ""
        self._progress.say(
            f"mission: seed {script.seed}, {script.agent.policy}, {who}{where}{pace(script.speedup)}"
        )
        self._progress.say(f"router at {self._endpoint}")
        if self._files and (trouble := self._files.take_place()):
            self._progress.say(f"warning: {trouble}")

    # ---- what follows it ----

    def _await_landing(self, last: Belief) -> None:
        """Wait until each vehicle has done what comes after the search.

        A stop sends them on their way; else they are commanded each second.
        """
        heard, expected = self._heard, self._mission.script.expectations
        home, after = "returned home" in expected, self._mission.script.vehicle.after_stop
        if after == "hold":
            if not home and "landed" not in expected:
                return
            after = "return" if home else "land"
        if (
            home and not self._mission.real
        ):  # a real vehicle's is heard from the beginning: it says where home is
            self._bus.subscribe(MAVLINK_OUT)  # where it has landed
        flying = [vehicle for vehicle in heard.flown if not vehicle.ended]
        if flying:  # as fast as possible they may have landed meanwhile: it is said all the same
            self._progress.say("returning home" if after == "return" else "landing")
        codec, call_at, lost_at = Codec(*LAUNCHER_IDS), 0.0, math.inf
        while flying := [
            vehicle
            for vehicle in flying
            if not vehicle.ended
            and (not vehicle.landed or (home and vehicle.landed_at is None and time.monotonic() < lost_at))
        ]:
            if all(vehicle.landed for vehicle in flying):  # where they stand is not waited for without end
                lost_at = min(lost_at, time.monotonic() + LAG_S)
            for vehicle in [vehicle for vehicle in flying if vehicle.state in ("paused", "holding")]:
                self._progress.say(f"a pilot leads the {vehicle.called}: it is left to them")
                flying.remove(vehicle)
            for vehicle in [
                vehicle for vehicle in flying if self._watchdog.is_lost(vehicle.part, time.monotonic())
            ]:
                self._progress.say(f"warning: the {vehicle.called} is silent: it is not waited for")
                flying.remove(vehicle)
            if not flying:
                return
            if not last.ceased and time.monotonic() >= call_at:
                for vehicle in flying:
                    if vehicle.state == "searching":
                        is_real = vehicle.part in self._mission.real_uavs
                        call = order(after, vehicle.system, SEARCH if is_real else AUTOPILOT)
                        self._bus.publish(MAVLINK_IN, codec.pack(call), vehicle=vehicle.number)
                call_at = time.monotonic() + CALL_EVERY_S
            self._listen(CALL_EVERY_S)

    def _await_record(self, step: int) -> None:
        """Wait until the record has all readings: only a running vehicle can send missing ones again."""
        health, deadline = self._heard.health, time.monotonic() + LAG_S
        while self._mission.record and RECORDER not in self._gone:
            if RECORDER in health and health[RECORDER].step >= step:
                return
            if time.monotonic() >= deadline:
                self._progress.say("warning: the record lacks the last readings: they came too late")
                return
            self._listen(deadline - time.monotonic())

    def _missed(self) -> list[ScriptEvent]:
        """Return the events that have a time and have not happened."""
        to_come = self._disturbances.to_come
        return [
            event
            for event in self._mission.script.events
            if event.time_s is not None
            and (
                words(event) not in self._happened
                if isinstance(event, OnBoard)
                else any(event is each for each in to_come)
            )
        ]

    def _flown(self, last: Belief) -> Flown:
        script, heard = self._mission.script, self._heard
        points, missing = heard.points(), heard.trace.missing
        lost = f"{missing} of {last.step + 1} beliefs were not received"
        if points is None:
            raise MissionFailed(f"{lost}: the trace has gaps")
        if missing:
            self._progress.say(f"warning: {lost}: of these the trace has the readings")
        missed = self._missed()
        for number, event in enumerate(script.events):
            if event.step is not None and event.step > last.step:
                when = f"step {event.step}"
            elif any(event is each for each in missed):
                when = f"time {event.time_s:g} s"
            else:
                continue
            self._progress.say(
                f"warning: events[{number}] of {when} did not happen: the search ended at step {last.step}"
            )
        result = outcome(
            script.seed,
            script.agent.policy,
            self._mission.truth,
            points,
            last.ceased,
            sum(heard.health[each].compute_s for each in ("estimator", "agent") if each in heard.health),
            last.assume,
            last.stop,
            script.world,
            last.outside,
            script.problem.area,
            intermittency=last.intermittency,
            advised_dwell_s=last.advised_dwell,
            last_word=heard.last_word(last),
            home=self._mission.origin
            or (heard.vehicles[0].home if self._mission.real else self._mission.home),
            left=heard.departures,
            doubted=heard.doubted,
            joined=heard.joined,
        )
        located = bool(result.located)
        came_true = {
            "ceased": result.ceased,
            "not ceased": not result.ceased,
            "located": located,
            "not located": not located,
            "outside": result.outside,
            "false stop": result.ceased and not located and not result.outside,
            "warned": heard.warned,
            "landed": all(vehicle.landed for vehicle in heard.flown),
            "returned home": all(vehicle.at_home for vehicle in heard.flown),
        }
        return Flown(script, result, points, {each: came_true[each] for each in script.expectations})
