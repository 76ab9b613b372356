"""One whole mission: router, uav, estimator and agent as processes, watched until the search ends."""

import contextlib
import json
import math
import os
import queue
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from link.bus import Arrival, Bus
from link.cli import BAD_INPUT, FAILED, INTERRUPTED
from link.keys import BELIEF, HEALTH, STOP
from link.messages import Belief, Health
from plume import __version__
from plume.outcome import Outcome, TracePoint, outcome, outcome_json
from plume.randomness import derived_seed
from plume.scenario import Scenario, draw
from sitl.processes import Ended, Processes, Said
from sitl.progress import Progress


class Mission(NamedTuple):
    """What to fly, and with what."""

    seed: int
    policy: str
    particles: int
    threshold_m: float
    budget: int
    speedup: float
    instance: int
    listen: str
    sensor: str = "gaussian"
    filter_arguments: Sequence[str] = ()
    """Flags that are handed on to the estimator."""
    agent_arguments: Sequence[str] = ()
    """Flags that are handed on to the agent."""
    uav_arguments: Sequence[str] = ()
    """Flags that are handed on to the uav."""


class MissionFailed(Exception):
    """The mission cannot go on; the text says why, the status is the launcher's."""

    def __init__(self, text: str, status: int = FAILED) -> None:
        """Take the reason and the exit status."""
        super().__init__(text)
        self.status = status


def fly(mission: Mission) -> tuple[Outcome, list[TracePoint]]:
    """Fly a mission; returns its outcome and trace. Raises MissionFailed where a part dies or the vehicle gives up."""
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
    scenario = draw(mission.seed)
    with contextlib.ExitStack() as stack:
        progress = stack.enter_context(Progress(mission.budget))
        processes = Processes(inbox)
        stack.callback(processes.stop)
        endpoint = start_parts(processes, mission, scenario)
        if not endpoint:
            _raise_for(_first_end(inbox))
        bus = stack.enter_context(Bus("mission", endpoint, f"uav/{mission.instance + 1}", inbox))
        bus.subscribe(BELIEF, STOP, HEALTH)
        return _watch(mission, scenario, bus, endpoint, progress)


def start_parts(processes: Processes, mission: Mission, scenario: Scenario) -> str:
    """Start all parts; returns the router's endpoint, empty where it could not listen."""
    endpoint = processes.start("router", "sitl", "router", "--listen", mission.listen).readline().strip()
    if not endpoint:
        return ""
    joining = ("--connect", endpoint, "--namespace", f"uav/{mission.instance + 1}")
    instance = str(mission.instance)
    seed, speedup = str(mission.seed), repr(mission.speedup)
    flight = ("-I", instance, "--seed", seed, "--speedup", speedup, "--sensor", mission.sensor)
    processes.start("uav", "sitl", "uav", *joining, *flight, *mission.uav_arguments)
    # Only what the paper's estimator knows, and seeds of their own: from the mission's seed the source could be drawn.
    knowledge = ("--rate", repr(scenario.q), "--diffusivity", repr(scenario.d), "--lifetime", repr(scenario.tau))
    system = str(mission.instance + 1)
    filter_flags = ("--particles", str(mission.particles), "--threshold", repr(mission.threshold_m), "--sensor", mission.sensor)
    estimator_seed, agent_seed = (str(derived_seed(mission.seed, service)) for service in ("estimator", "agent"))
    own = ("--seed", estimator_seed, "--sysid", system)
    processes.start("estimator", "estimator", *joining, *filter_flags, *knowledge, *mission.filter_arguments, *own)
    policy_flags = ("--policy", mission.policy, "--budget", str(mission.budget), "--sysid", system)
    processes.start("agent", "agent", *joining, *policy_flags, "--seed", agent_seed, *mission.agent_arguments)
    return endpoint


def _watch(mission: Mission, scenario: Scenario, bus: Bus, endpoint: str, progress: Progress) -> tuple[Outcome, list[TracePoint]]:
    trace: dict[int, TracePoint] = {}
    compute: dict[str, Health] = {}
    last: Belief | None = None
    distance_m = 0.0
    last_words: dict[str, str] = {}
    for message in _messages(bus):
        if isinstance(message, Said):
            last_words[message.part] = message.line
            if "warning:" in message.line:
                progress.say(message.line)
        elif isinstance(message, Health):
            compute[message.service] = message
            if message.state == "landed":
                raise MissionFailed(f"the uav has landed before the search was over; its last words: {last_words.get('uav', 'none')}")
        elif message.step not in trace:
            if last is None:
                progress.say(f"mission: seed {mission.seed}, {mission.policy}, speed-up {mission.speedup:g}, router at {endpoint}")
            else:
                distance_m += math.dist(last.position, message.position)
            last = message
            trace[message.step] = TracePoint(message.position, message.gas, message.mean, message.spread)
            progress.show(message, distance_m)
        if last is None or not (last.ceased or last.step >= mission.budget):
            continue
        # The last compute times come just behind the last belief.
        wanted = {"estimator": last.step, "agent": last.step - 1}
        if all(service in compute and compute[service].step >= step for service, step in wanted.items()):
            break
    assert last is not None
    points = [trace[step] for step in sorted(trace)]
    if len(points) != last.step + 1:
        raise MissionFailed(f"{last.step + 1 - len(points)} of {last.step + 1} beliefs were not received: the trace has gaps")
    search_time_s = compute["estimator"].compute_s + compute["agent"].compute_s
    return outcome(mission.seed, mission.policy, scenario, points, last.ceased, search_time_s), points


def _messages(bus: Bus) -> Iterator[Belief | Health | Said]:
    """What comes from the bus and from the parts; the end of a part ends the mission."""
    while True:
        item = bus.receive()
        match item:
            case Ended():
                _raise_for(item)
            case Said():
                yield item
            case Arrival(key) if key is BELIEF:
                if belief := bus.decode(item, Belief):
                    yield belief
            case Arrival(key) if key is HEALTH:
                if health := bus.decode(item, Health):
                    yield health


def _first_end(inbox: "queue.SimpleQueue[Any]") -> Ended:
    while not isinstance(item := inbox.get(), Ended):
        pass
    return item


def _raise_for(ended: Ended) -> None:
    if ended.status == INTERRUPTED:
        raise KeyboardInterrupt  # somebody interrupted a part: that ends the mission as Ctrl-C does
    if ended.status == BAD_INPUT:
        raise MissionFailed(ended.last_words.rpartition("error: ")[2], BAD_INPUT)
    how = f"was killed by signal {-ended.status}" if ended.status < 0 else f"exited with status {ended.status}"
    raise MissionFailed(f"{ended.part} {how}; its last words: {ended.last_words}")


def write_summary(mission: Mission, result: Outcome, trace: Sequence[TracePoint], folder: Path) -> Path:
    """Write a mission's outcome, trace and how it was flown to a new file in a folder."""
    now = datetime.now(UTC)
    summary = {
        "flown_at": now.isoformat(timespec="seconds"),
        "plumeward": __version__,
        "mission": mission._asdict(),
        "outcome": json.loads(outcome_json(result, trace)),
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{now:%Y%m%d-%H%M%S}-{Path(mission.policy).stem}-seed{mission.seed}-{os.getpid()}.json"
    path.write_text(json.dumps(summary, indent=1) + "\n")
    return path
