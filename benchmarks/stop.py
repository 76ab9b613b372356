"""How fast the stop arrives while all else is flooded: 50 kB beliefs at 200 Hz, and a subscriber that
never reads.

    python -m benchmarks.stop                    # 1,000 stops, in quiet and in the flood
    python -m benchmarks.stop --trials 100

The publisher of the beliefs also publishes the stops, as the estimator does. Other processes flood the
other keys. Vehicle and agent are the services themselves; they tell when they have taken each stop, by the
machine's monotonic clock.
"""

import argparse
import contextlib
import importlib
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import msgspec
import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from link import cli
from link.bus.keys import BELIEF, HEALTH, MAVLINK_IN, MAVLINK_OUT, READING, STOP, WAYPOINT
from link.bus.mavlink import Codec, Reading, pack_reading, waypoint_message
from link.bus.messages import Belief, Health, Stop, pack_particles
from link.bus.session import Arrival, Bus
from plume.randomness import keyed

PARTICLES = 4167
"""Their array has 50 kB."""
BELIEF_HZ, FLOOD_HZ = 200.0, 500.0
FLOODS = {key.name: key for key in (MAVLINK_IN, MAVLINK_OUT, WAYPOINT, READING, HEALTH)}
GIVE_UP_S, EVERY = 10.0, 50
"""Longest wait for a stop, and the number of stops after which another subscriber joins that never reads,
and one that does.
"""
WITNESSES = {"uav": ("sitl", "uav", "--seed", "1", "--speedup", "1"), "agent": ("agent",)}
CLAIM = Stop(0, 0, (23.5, 24.3), (0.1, 0.0, 0.1), 0.45, 0.5, "spread:0.5")
START_S = 60.0
"""Longest wait for vehicle and agent."""
SAID = Belief(
    time_boot_ms=0,
    step=0,
    position=(10.0, 12.0),
    altitude_m=5.0,
    gas=0.5,
    wind=(2.0, 1.0),
    sensor="gaussian",
    rate=300.0,
    diffusivity=4.5,
    lifetime=10.0,
    z=5.0,
    unknowns=("x", "y"),
    means=(15.0, 15.0),
    stds=(2.0, 2.0),
    mean=(15.0, 15.0),
    covariance=(4.0, 0.0, 4.0),
    spread=2.8,
    effective_sample_size=3.0,
    p_value=0.5,
    ceased=False,
)


class Trials(NamedTuple):
    """What was measured: ms from each stop's publishing to its taking, by part, and of those who joined
    later to their first.
    """

    taken: dict[str, list[float]]
    joined: list[float]
    lost: int


def witness(module: str, *arguments: str) -> None:
    """Run a service that says on stdout when it has taken each stop."""
    take = Bus.take_stop

    def timed(bus: Bus, arrival: Arrival) -> Stop | None:
        stop = take(bus, arrival)
        print(stop.step if stop else -1, time.monotonic_ns(), flush=True)
        return stop

    Bus.take_stop = timed  # type: ignore[method-assign, assignment]
    importlib.import_module(f"{module}.__main__").main(module, list(arguments))


def flood(name: str, endpoint: str) -> None:
    """Publish messages of a key at FLOOD_HZ: those of the vehicle's peers are valid, none answers a
    reading.
    """
    key, codec = FLOODS[name], Codec(1, 191)
    beat = codec.pack(
        mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)
    )
    said = {WAYPOINT: codec.pack(waypoint_message(1, 0, (10.0, 12.0), 5.0))}
    with Bus(f"flood-{name.partition('/')[2] or name}", endpoint, announced=False) as bus:
        said[HEALTH] = msgspec.json.encode(Health(bus.service, "flooding", 0, 0.0, 0.0, {}))
        for number in _paced(FLOOD_HZ):
            reading = (
                pack_reading(codec, Reading(number, (10.0, 12.0), 5.0, (2.0, 1.0), 0.5))
                if key is READING
                else b""
            )
            bus.publish(key, reading or said.get(key, beat))


def _paced(rate_hz: float, until: Callable[[], bool] = lambda: False) -> Iterator[int]:
    """Count from 0 at a rate; what cannot be kept up with is left out."""
    number, due = 0, time.monotonic()
    while not until():
        yield number
        number, due = number + 1, max(due + 1 / rate_hz, time.monotonic() - 1.0)
        time.sleep(max(due - time.monotonic(), 0.0))


class Stage:
    """Router, vehicle and agent as processes; with `flooded` also those that flood, and one that never
    reads.
    """

    def __init__(self, flooded: bool, stack: contextlib.ExitStack) -> None:
        """Start them, and wait until they are there. They end with `stack`."""
        self.taken: dict[str, dict[int, int]] = {part: {} for part in WITNESSES}
        self.arrived: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._stack = stack
        self.endpoint = (
            self._start("-m", "sitl", "router", "--listen", "tcp/127.0.0.1:0").stdout.readline().strip()
        )
        self.bus = stack.enter_context(Bus("estimator", self.endpoint, announced=False))
        for part, words in WITNESSES.items():
            process = self._start("-m", "benchmarks.stop", "--witness", *words, "--connect", self.endpoint)
            threading.Thread(target=self._listen, args=(part, process.stdout), daemon=True).start()
        patient = time.monotonic() + START_S
        while missing := WITNESSES.keys() - self.bus.services():
            if time.monotonic() > patient:
                raise SystemExit(f"error: not on the bus within {START_S:g} s: {', '.join(sorted(missing))}")
            time.sleep(0.05)
        self._over = threading.Event()
        self._deaf: list[Any] = []
        if flooded:
            self.another_deaf()
            for name in FLOODS:
                self._start("-m", "benchmarks.stop", "--flood", name, self.endpoint)
            beliefs = threading.Thread(target=self._believe)
            stack.callback(beliefs.join)
            stack.callback(self._over.set)
            beliefs.start()

    def another_deaf(self) -> None:
        """Let another subscriber that never reads take the place of the one before: the router cuts it off
        once it is full.
        """
        for process in self._deaf:
            process.kill()
        self._deaf = [self._start("-m", "benchmarks.chaos.strangers", "deaf", self.endpoint, "0")]
        self._deaf[0].stdout.readline()

    def _start(self, *words: str) -> Any:
        process = subprocess.Popen(
            [sys.executable, *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process

    def _listen(self, part: str, lines: Any) -> None:
        for line in lines:
            if (words := line.split())[0].isdigit():
                self.taken[part].setdefault(int(words[0]), int(words[1]))
                self.arrived.put(part)

    def _believe(self) -> None:
        rng = keyed(0, "stop benchmark")
        weights = np.full((PARTICLES, 1), 1 / PARTICLES)
        array = pack_particles(
            np.hstack([rng.uniform(0.0, 30.0, (PARTICLES, 2)), weights]).astype(np.float32)
        )
        for number in _paced(BELIEF_HZ, self._over.is_set):
            self.bus.publish(
                BELIEF, msgspec.structs.replace(SAID, time_boot_ms=number, step=min(number, 250)), array
            )


def measure(trials: int, *, flooded: bool, every: int = EVERY, settle_s: float = 3.0) -> Trials:
    """Publish stops, one after the other, and take the times at which vehicle and agent have taken them."""
    rng = keyed(1, "stop benchmark")
    taken: dict[str, list[float]] = {part: [] for part in WITNESSES}
    joined: list[float] = []
    lost = 0
    with contextlib.ExitStack() as stack:
        stage = Stage(flooded, stack)
        time.sleep(settle_s)
        for number in range(trials):
            began = time.monotonic_ns()
            stage.bus.publish(STOP, msgspec.structs.replace(CLAIM, step=number))
            deadline = time.monotonic() + GIVE_UP_S
            while not all(number in times for times in stage.taken.values()) and time.monotonic() < deadline:
                with contextlib.suppress(queue.Empty):
                    stage.arrived.get(timeout=0.1)
            for part, times in stage.taken.items():
                if number in times:
                    taken[part].append((times[number] - began) / 1e6)
                else:
                    lost += 1
            if number % every == every - 1:
                joined.append(join(stage.endpoint, number))
                if flooded:
                    stage.another_deaf()
            time.sleep(float(rng.uniform(0.0, 0.03)))
    return Trials(taken, joined, lost)


def join(endpoint: str, number: int) -> float:
    """Join the bus; returns the ms until the stop has come, infinite if it has not come in time."""
    with Bus("late", endpoint, announced=False) as bus:
        began = time.monotonic()
        bus.subscribe(STOP)
        arrival = bus.receive(GIVE_UP_S)
        came = arrival is not None and (stop := bus.decode(arrival, Stop)) is not None and stop.step == number
        return 1000 * (time.monotonic() - began) if came else float("inf")


def row(name: str, times: list[float]) -> str:
    """One line of the table."""
    p50, p99 = np.percentile(times, [50, 99])
    return f"| {name} | {len(times)} | {p50:.2f} | {p99:.2f} | {max(times):.2f} |"


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--trials",
        type=cli.whole(1, 1_000_000),
        default=1000,
        metavar="N",
        help="stops (default: %(default)s)",
    )
    args = parser.parse_args()
    print("| ms | stops | p50 | p99 | max |\n|---|---|---|---|---|")
    for name, flooded in (("quiet", False), ("flooded", True)):
        trials = measure(args.trials, flooded=flooded)
        for part, times in trials.taken.items():
            print(row(f"{name}: stop to {part}", times))
        if trials.joined:
            print(row(f"{name}: to who joins after it", trials.joined))
        print(f"{name}: {trials.lost} stops lost", file=sys.stderr)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["--witness", *words]:
            cli.run(lambda: witness(*words))
        case ["--flood", name, endpoint]:
            cli.run(lambda: flood(name, endpoint))
        case _:
            cli.run(main)
