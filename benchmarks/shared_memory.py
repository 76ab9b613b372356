"""Zenoh's shared memory on and off: how long a belief takes through the router, and what an idle process spends.

    python -m benchmarks.shared_memory
    python -m benchmarks.shared_memory --beliefs 1000

Publisher, router and receiver are processes, all with it or all without, in turns. The receiver answers each belief with one byte; the time
is that of both ways.
"""

import argparse
import contextlib
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zenoh

from benchmarks.stop import SAID
from link import cli
from link.bus.keys import BELIEF, MAVLINK_IN
from link.bus.messages import pack_particles
from link.bus.opening import zenoh_config
from link.bus.session import Bus
from plume.randomness import keyed

SIZES = (1000, 4000, 20_000, 100_000)
ROUNDS = 5
IDLE_S = 5.0
TICK_S = 1 / os.sysconf("SC_CLK_TCK")


def route(on: bool) -> None:
    """Be the router until stdin ends."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    with zenoh.open(zenoh_config("router", {"listen": [endpoint]}, transport__shared_memory__enabled=on)):
        print(endpoint, flush=True)
        sys.stdin.read()


def answer(endpoint: str, on: bool) -> None:
    """Answer each belief until stdin ends."""
    with Bus("agent", endpoint, announced=False, transport__shared_memory__enabled=on) as bus:
        bus.on(BELIEF, lambda _: bus.publish(MAVLINK_IN, b"\xfd"))
        print("ready", flush=True)
        sys.stdin.read()


@contextlib.contextmanager
def started(*words: str) -> Any:
    """Start a process of this file; yields its first line and its process id."""
    with subprocess.Popen(
        [sys.executable, "-m", "benchmarks.shared_memory", *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin
        assert process.stdout
        yield process.stdout.readline().strip(), process.pid
        process.stdin.close()


def spent_s(pid: int) -> float:
    """Return the processor time of a process and all its threads."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    return TICK_S * (int(fields[11]) + int(fields[12]))


def measure(on: bool, beliefs: int, sizes: tuple[int, ...]) -> tuple[dict[int, list[float]], float]:
    """Return the ms of each belief and its answer, by particles, and the ms a second that the idle receiver spends."""
    rng = keyed(0, "shared memory benchmark")
    times = {}
    with (
        started("--route", str(int(on))) as (endpoint, _),
        started("--answer", endpoint, str(int(on))) as (_, receiver),
        Bus("estimator", endpoint, announced=False, transport__shared_memory__enabled=on) as bus,
    ):
        bus.subscribe(MAVLINK_IN)
        for size in sizes:
            array = pack_particles(np.hstack([rng.uniform(0.0, 30.0, (size, 2)), np.full((size, 1), 1 / size)]).astype(np.float32))
            times[size] = [_once(bus, msgspec.structs.replace(SAID, time_boot_ms=number), array) for number in range(beliefs)]
            del times[size][: beliefs // 10]
        before = spent_s(receiver)
        time.sleep(IDLE_S)
        return times, 1000 * (spent_s(receiver) - before) / IDLE_S


def _once(bus: Bus, belief: msgspec.Struct, array: bytes) -> float:
    began = time.perf_counter()
    bus.publish(BELIEF, belief, array)
    if bus.receive(10.0) is None:
        raise SystemExit("error: a belief was lost")
    return 1000 * (time.perf_counter() - began)


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--beliefs", type=cli.whole(10, 1_000_000), default=300, metavar="N", help="of a size and round (default: %(default)s)"
    )
    args = parser.parse_args()
    times: dict[bool, dict[int, list[float]]] = {on: {size: [] for size in SIZES} for on in (True, False)}
    idle: dict[bool, list[float]] = {True: [], False: []}
    for turn in range(2 * ROUNDS):
        on = turn % 2 == 0
        found, spent = measure(on, args.beliefs, SIZES)
        idle[on].append(spent)
        for size, values in found.items():
            times[on][size] += values
    print("| particles | on: p50, ms | p99 | off: p50, ms | p99 | off to on, p50 |\n|---|---|---|---|---|---|")
    for size in SIZES:
        (on50, on99), (off50, off99) = (np.percentile(times[on][size], [50, 99]) for on in (True, False))
        print(f"| {size} | {on50:.3f} | {on99:.2f} | {off50:.3f} | {off99:.2f} | {off50 / on50:.2f} |")
    print(f"\nidle receiver, ms of processor time a second: on {np.median(idle[True]):.1f}, off {np.median(idle[False]):.1f}")


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["--route", on]:
            cli.run(lambda: route(on == "1"))
        case ["--answer", endpoint, on]:
            cli.run(lambda: answer(endpoint, on == "1"))
        case _:
            cli.run(main)
