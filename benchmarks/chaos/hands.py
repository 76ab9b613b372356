"""What a campaign does to a running mission from outside, at the steps and for the times that are drawn."""

import heapq
import itertools
import signal
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from benchmarks.chaos.arena import send
from benchmarks.chaos.faults import RESTARTED, Fault, far

if TYPE_CHECKING:
    from benchmarks.chaos.mission import Mission

BRIDGE = "udpin:127.0.0.1:14552"


class Hands:
    """Does each fault once it is due, and undoes it."""

    def __init__(self, mission: "Mission") -> None:
        """Take the mission; faults from the start begin now."""
        self._mission = mission
        self._to_come = list(mission.faults)
        self._undo: list[tuple[float, int, Callable[[], object]]] = []
        self._order = itertools.count()
        self._done: list[Fault] = []
        self._wants_bridge = any(fault.part == "bridge" for fault in mission.faults)
        self.reached(-1)

    def reached(self, step: int) -> None:
        """Begin the faults that are due at a step."""
        if step >= 0 and self._wants_bridge:
            self._wants_bridge = False
            self._mission.start("bridge", "sitl", "bridge", BRIDGE, "--connect", self._mission.endpoint)
        for fault in [fault for fault in self._to_come if step >= fault.step]:
            self._to_come.remove(fault)
            if self._begin(fault):
                self._done.append(fault)

    def undo(self, *, at_once: bool = False) -> None:
        """Undo what has lasted long enough, or everything."""
        while self._undo and (at_once or self._undo[0][0] <= time.monotonic()):
            heapq.heappop(self._undo)[2]()

    def done(self, said: list[str]) -> list[Fault]:
        """Return the faults that happened, among them those that the launcher says a script did."""
        scripted = {"kill": "script: {} killed", "cut": "script: link of {} cut", "radio": "Script: delay"}
        late = [
            fault
            for fault in self._mission.faults
            if fault not in self._done
            and any(scripted.get(fault.kind, "\0").format(fault.part) in line for line in said)
        ]
        return [*self._done, *late]

    def _after(self, delay_s: float, undo: Callable[[], object]) -> None:
        heapq.heappush(self._undo, (time.monotonic() + delay_s, next(self._order), undo))

    def _begin(self, fault: Fault) -> bool:
        """Begin a fault; returns whether it was possible. What the script does is left to the launcher."""
        mission, part = self._mission, fault.part
        pid = mission.pids().get(part)
        match fault.kind:
            case "kill" if mission.far or part not in RESTARTED:
                if pid is None:
                    return False
                send(pid, signal.SIGKILL)
                if part in RESTARTED:
                    self._after(fault.for_s, lambda: self._restart(part))
            case "hang":
                if pid is None:
                    return False
                send(pid, signal.SIGSTOP)
                self._after(fault.for_s, lambda: send(pid, signal.SIGCONT))
            case "unplug":
                assert mission.far
                loss = next((other.amount for other in mission.faults if other.kind == "loss"), 0.0)
                link = mission.far
                link.drop(1.0)
                self._after(fault.for_s, lambda: link.drop(loss))
            case "loss":
                assert mission.far
                mission.far.drop(fault.amount)
            case "deaf" | "echo":
                mission.start(
                    fault.kind, "benchmarks.chaos.strangers", fault.kind, mission.endpoint, str(mission.seed)
                )
            case "second":
                words = {
                    "estimator": ["--particles", "500", "--seed", "7"],
                    "agent": ["--policy", "random", "--seed", "7"],
                }[part]
                mission.start(f"second {part}", part, "--connect", mission.endpoint, *words)
            case "clock":
                assert mission.clock
                mission.clock.step(fault.amount)
            case "disk":
                pass  # mounted before
            case _:
                return False
        return True

    def _restart(self, part: str) -> None:
        mission = self._mission
        old = mission.parts[part]
        old.ended(1.0)
        words = (
            ("sitl", "router", "--listen", mission.endpoint) if part == "router" else mission.service(part)
        )
        if mission.parts["launcher"].process.poll() is None:
            mission.start(part, *words, far=part == far(mission.faults))
