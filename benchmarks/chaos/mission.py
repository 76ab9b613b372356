"""Flies one mission with its faults, in processes, and gathers what they leave: `python -m
benchmarks.chaos.mission SEED [KIND]`.
"""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec

from aircraft.search.events import Delay, Duplicate, Lose
from benchmarks.chaos.arena import (
    NEAR,
    FarMachine,
    SteppedClock,
    enter,
    open_files,
    processes,
    send,
    shared_memory,
    sockets,
)
from benchmarks.chaos.faults import RESTARTED, Fault, far, is_split, plan, text
from benchmarks.chaos.hands import Hands
from benchmarks.chaos.judge import Evidence, Verdict, judge
from link.bus.inbox import Inbox
from link.bus.keys import BELIEF, HEALTH
from link.bus.messages import Belief
from link.bus.session import Arrival, Bus
from sitl.launch.mission import Launch, agent_arguments, estimator_arguments
from sitl.launch.processes import environment
from sitl.script.script import Cut, Kill, Script

SPEEDUP, SLOW_SPEEDUP = 20.0, 4.0
"""The second where packets are dropped: TCP's waits do not shrink with the time of the mission."""
MISSION_LIMIT_S = 240.0
"""Far beyond any mission with its faults: one that takes longer hangs."""
LOOK_S = 0.05
END_S = 20.0
"""How long processes may take to end once the mission is over."""
STATION_PORT = 14551


class Part:
    """A process of the mission, and the lines that it writes."""

    def __init__(self, command: list[str], env: dict[str, str], cwd: Path) -> None:
        """Start it."""
        self.began = time.monotonic()
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            env=env,
            cwd=cwd,
        )
        self.out: list[str] = []
        self.err: list[str] = []
        streams = ((self.process.stdout, self.out), (self.process.stderr, self.err))
        self._threads = [threading.Thread(target=self._collect, args=of, daemon=True) for of in streams]
        for thread in self._threads:
            thread.start()

    @staticmethod
    def _collect(stream: Any, lines: list[str]) -> None:
        with stream:
            lines.extend(iter(stream.readline, ""))

    def first_line(self) -> str:
        """Wait for its first line on stdout."""
        while not self.out:
            if self.process.poll() is not None:
                raise RuntimeError(f"{self.process.args!r} ended: {''.join(self.err[-5:])}")
            time.sleep(LOOK_S)
        return self.out[0].strip()

    def ended(self, timeout_s: float) -> bool:
        """Whether it ends in time; then all its lines are there."""
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        for thread in self._threads:
            thread.join(END_S)
        return True


class Mission:
    """One mission: what runs, and where."""

    def __init__(self, seed: int, faults: list[Fault], folder: Path) -> None:
        """Take its faults and a folder of its own."""
        self.seed, self.faults, self.folder = seed, faults, folder
        self.marker = f"{seed}-{os.getpid()}"
        self.script = _script(seed, faults)
        self.parts: dict[str, Part] = {}
        self.far = FarMachine() if is_split(faults) else None
        wanted = {fault.kind for fault in faults}
        self.clock = SteppedClock(folder) if "clock" in wanted else None
        self.env = {**environment(), "CHAOS_MISSION": self.marker, "PYTHONDONTWRITEBYTECODE": "1"}
        self.env.pop("PLUMEWARD_LAUNCHER", None)
        self.record = folder / "record" / "mission.mcap"
        self.record.parent.mkdir()
        self.disk = next((fault for fault in faults if fault.kind == "disk"), None)
        if self.disk:
            size = f"size={round(self.disk.amount)}"
            subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(self.record.parent)], check=True)
        host = NEAR if self.far else "127.0.0.1"
        self.port = _free_port()
        self.endpoint = f"tcp/{host}:{self.port}"

    def start(self, name: str, *words: str, far: bool = False, plain: bool = False) -> Part:
        """Start `python -m words`; `far`: on the other machine, `plain`: with the system's clock."""
        prefix = self.far.prefix if far and self.far else []
        env = self.env | (self.clock.environment if self.clock and not plain else {})
        part = Part([*prefix, sys.executable, "-m", *words], env, self.folder)
        self.parts[name] = part
        return part

    def service(self, name: str) -> tuple[str, ...]:
        """Return the words that start estimator or agent as the launcher would."""
        words = {"estimator": estimator_arguments, "agent": agent_arguments}[name](Launch(script=self.script))
        return (name, "--connect", self.endpoint, *words)

    def launch(self) -> Part:
        """Start all that flies."""
        file = self.folder / "mission.yaml"
        file.write_bytes(msgspec.json.encode(_written(self.script)))  # JSON is YAML
        hit = {fault.part for fault in self.faults}
        flags = ["--json", "--trace", "--log-level", "info", "--record", str(self.record)]
        if "station" in hit:
            flags += ["--out", f"udpout:127.0.0.1:{STATION_PORT}"]
        if self.far:
            self.start("router", "sitl", "router", "--listen", self.endpoint).first_line()
            for name in ("estimator", "agent"):
                self.start(name, *self.service(name), far=far(self.faults) == name)
            flags += ["--connect", self.endpoint]
        else:
            flags += ["--listen", self.endpoint]
        launcher = self.start(
            "launcher", "sitl", "fly", str(file), *flags, far=bool(self.far) and far(self.faults) == "uav"
        )
        if "station" in hit:
            there = bool(self.far) and far(self.faults) == "uav"
            url = f"udpin:127.0.0.1:{STATION_PORT}"
            self.start("station", "benchmarks.chaos.strangers", "station", url, str(self.seed), far=there)
        return launcher

    def pids(self) -> dict[str, int]:
        """Return the processes by part."""
        found = {name: part.process.pid for name, part in self.parts.items() if part.process.poll() is None}
        with contextlib.suppress(OSError, KeyError):
            launcher = found["launcher"]
            for child in Path(f"/proc/{launcher}/task/{launcher}/children").read_text().split():
                words = Path(f"/proc/{child}/cmdline").read_text().split("\0")
                if len(words) > 3:
                    name = words[3] if words[2] == "sitl" else words[2]
                    found[{"record": "recorder"}.get(name, name)] = int(child)
        return found

    def end(self) -> list[str]:
        """End what this program started; returns what is left of the launcher's processes, and then of
        all.
        """
        own = {part.process.pid for part in self.parts.values()}
        left = self._left(own)
        held: set[str] = set()
        if deaf := self.parts.get("deaf"):  # its session, which takes nothing more, would wait for ever
            held = open_files(deaf.process.pid)
            deaf.process.kill()
        for part in reversed(self.parts.values()):
            send(part.process.pid, signal.SIGCONT)
            part.process.terminate()
        for name, part in self.parts.items():
            if not part.ended(END_S):
                left.append(f"the {name} did not end")
                part.process.kill()
                part.ended(END_S)
        left += self._left(set()) + sockets(self.port)
        if self.far:
            self.far.close()
        return left + [path for path in shared_memory() if path not in held]

    def _left(self, but: set[int]) -> list[str]:
        """Wait for the processes of this mission to end, but for some; returns those that do not."""
        deadline = time.monotonic() + END_S
        while True:
            left = {
                pid: words
                for pid, words in processes(f"CHAOS_MISSION={self.marker}").items()
                if pid not in but
            }
            if not left or time.monotonic() >= deadline:
                return [f"process {words}" for words in left.values()]
            time.sleep(LOOK_S)


def _script(seed: int, faults: list[Fault]) -> Script:
    """Return the mission's script, with the faults that scripts have words for."""
    split = is_split(faults)
    events: list[Any] = []
    for fault in faults:
        at = {"step": fault.step}
        if fault.kind == "kill" and fault.part in RESTARTED and not split:
            events.append(Kill(part=fault.part, restart_after_s=fault.for_s, **at))  # type: ignore[arg-type]
        elif fault.kind == "cut":
            events.append(Cut(part=fault.part, for_s=fault.for_s, **at))  # type: ignore[arg-type]
        elif fault.kind == "radio":
            # The vehicle sends an unanswered reading again: late copies of it arrive after the next one.
            events.append(Delay(readings=2, by_s=fault.for_s, **at))
            events.append(Duplicate(readings=4, copies=2, **at))
            events.append(Lose(readings=3, times=2, step=fault.step + 2))
    return Script(seed=seed, speedup=SLOW_SPEEDUP if split else SPEEDUP, events=events)


def _written(script: Script) -> dict[str, Any]:
    return {
        "seed": script.seed,
        "speedup": script.speedup,
        "events": [msgspec.to_builtins(event) for event in script.events],
    }


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def fly(seed: int, only: str | None, folder: Path) -> Verdict:
    """Fly a mission and judge it."""
    faults = plan(seed, only)
    mission = Mission(seed, faults, folder)
    began = time.monotonic()
    launcher = mission.launch()
    hands = Hands(mission)
    try:
        with contextlib.ExitStack() as stack:
            bus = stack.enter_context(_observer(mission, launcher))
            while launcher.process.poll() is None and time.monotonic() - began < MISSION_LIMIT_S:
                item = bus.receive(LOOK_S)
                if isinstance(item, Arrival) and item.key is BELIEF and (belief := bus.decode(item, Belief)):
                    hands.reached(belief.step)
                hands.undo()
    finally:
        hands.undo(at_once=True)
        over, hung = time.monotonic(), not launcher.ended(0.1)
        left = mission.end()
    busy = max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))  # processes that share a core
    evidence = Evidence(
        seed=seed,
        faults=tuple(faults),
        done=tuple(hands.done(launcher.err)),
        status=None if hung else launcher.process.returncode,
        out=tuple(launcher.out),
        err=tuple(launcher.err),
        others={name: tuple(part.err) for name, part in mission.parts.items() if name != "launcher"},
        statuses={name: part.process.returncode for name, part in mission.parts.items()},
        beside_s={name: (over - part.began) / busy for name, part in mission.parts.items()},
        record=mission.record,
        left=tuple(left),
        wall_s=round(time.monotonic() - began, 1),
    )
    return judge(evidence)


def _observer(mission: Mission, launcher: Part) -> Bus:
    """Join the mission's router, once it is there."""
    while True:
        try:
            bus = Bus("chaos", mission.endpoint, inbox=Inbox(), announced=False)
        except Exception:
            if launcher.process.poll() is not None:
                raise RuntimeError(f"the launcher ended: {''.join(launcher.err[-5:])}") from None
            continue
        bus.subscribe(BELIEF, HEALTH)
        return bus


def main(seed: int, only: str | None = None) -> None:
    """Fly one mission in this process's namespaces, and print its verdict as JSON."""
    enter()
    with TemporaryDirectory(prefix="chaos-") as folder:
        try:
            verdict = fly(seed, only, Path(folder))
        finally:
            subprocess.run(["umount", "-q", str(Path(folder) / "record")], check=False, capture_output=True)
    words = " + ".join(text(fault) for fault in plan(seed, only))
    print(msgspec.json.encode({"words": words, **msgspec.to_builtins(verdict)}).decode(), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else None)
