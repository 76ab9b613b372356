"""How many vehicles one machine carries: full stacks in real time, 10 Hz telemetry and about one reading a
second each.

    python -m benchmarks.fleet                          # 1, 2, 4, 8, ... vehicles, until the p99 latency
    of a step has doubled python -m benchmarks.fleet --vehicles 6 --seconds 60

One router; a vehicle, an estimator and an agent for each instance. The latency of a step is from the
reading to its waypoint, as an observer on the bus sees them.
"""

import argparse
import functools
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from aircraft.operator import OPERATOR_IDS, command
from link import cli
from link.bus.inbox import Inbox
from link.bus.keys import MAVLINK_IN, READING, WAYPOINT
from link.bus.mavlink import BadFrame, Codec, unpack, unpack_reading
from link.bus.session import Arrival, Bus
from sitl.autopilot.telemetry import STREAMS
from sitl.launch.mission import Launch, agent_arguments, estimator_arguments
from sitl.launch.processes import Processes
from sitl.script.script import Script

PARTS = ("uav", "estimator", "agent", "router")
SPEEDUP = 1.25
"""A vehicle in real time takes a reading every 1.25 s."""
TELEMETRY_HZ = 10.0 / SPEEDUP
"""In the vehicle's time: 10 Hz in real time."""
TICK_S = 1 / os.sysconf("SC_CLK_TCK")
START_S = 120.0
"""Longest wait for a vehicle's parts, and for its first reading."""
MB = 1e6


class Load(NamedTuple):
    """What a fleet did: latencies in ms, readings a second and vehicle, and by part CPU seconds a second
    and memory in MB.

    Memory is the proportional set size: what processes share is divided among them.
    """

    latencies: list[float]
    readings_hz: float
    cpu: dict[str, float]
    memory: dict[str, float]


def measure(vehicles: int, seconds: float) -> Load:
    """Fly a fleet."""
    script = Script().changed(
        {"agent.policy": "random", "agent.budget": 100_000, "estimator.threshold_m": 1e-9}
    )
    fleets: list[Processes] = []
    buses: list[Bus] = []
    latencies: list[float] = []
    asked: dict[tuple[int, int], float] = {}
    inboxes = [Inbox() for _ in range(vehicles)]
    first = Processes(Inbox())
    fleets.append(first)
    try:
        endpoint = first.start_router("tcp/127.0.0.1:0")
        for instance in range(vehicles):
            processes = Processes(Inbox())
            fleets.append(processes)
            words = ("--seed", str(instance + 1), "--speedup", str(SPEEDUP))
            mission = Launch(script=script, instance=instance, uav_arguments=words)
            start_beside(processes, mission, endpoint)
            bus = Bus("fleet", endpoint, mission.namespace, inboxes[instance], announced=False)
            buses.append(bus)
            bus.on(READING, functools.partial(asked_at, instance, asked))
            bus.on(WAYPOINT, functools.partial(answered_at, instance, asked, latencies))
            wait_until(functools.partial(there, bus), f"the parts of vehicle {instance + 1} are there")
            for stream in STREAMS:
                if stream.rate_hz > TELEMETRY_HZ:
                    order = command(
                        instance + 1,
                        mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
                        stream.message_id,
                        1e6 / TELEMETRY_HZ,
                    )
                    bus.publish(MAVLINK_IN, Codec(*OPERATOR_IDS).pack(order))
        wait_until(
            lambda: len({instance for instance, _ in list(asked)}) == vehicles,
            "each vehicle has taken a reading",
        )
        time.sleep(2.0)
        latencies.clear()
        before, began = spent(), time.monotonic()
        time.sleep(seconds)
        after, took = spent(), time.monotonic() - began
        cpu = {part: (after[part] - before[part]) / took for part in after}
        return Load(list(latencies), len(latencies) / took / vehicles, cpu, held())
    finally:
        for bus in buses:
            bus.close()
        for processes in reversed(fleets):
            processes.stop()


def there(bus: Bus) -> bool:
    """Whether all parts of a bus's vehicle have joined."""
    return bus.services() >= {"uav", "estimator", "agent"}


def wait_until(true: Callable[[], bool], words: str) -> None:
    """Wait until something is true; ends the program if it takes too long."""
    patient = time.monotonic() + START_S
    while not true():
        if time.monotonic() > patient:
            raise SystemExit(f"error: not within {START_S:.0f} s: {words}")
        time.sleep(0.1)


def start_beside(processes: Processes, mission: Launch, endpoint: str) -> None:
    """Start the three parts of one vehicle on a router that is there already."""
    joining = ("--connect", endpoint, "--namespace", mission.namespace)
    processes.start("estimator", "estimator", *joining, *estimator_arguments(mission))
    processes.start("agent", "agent", *joining, *agent_arguments(mission))
    processes.start("uav", "sitl", "uav", *mission.uav_arguments, *joining, "-I", str(mission.instance))


def asked_at(instance: int, asked: dict[tuple[int, int], float], item: Any) -> None:
    """Take the time of a reading, at its first copy."""
    arrival = item if isinstance(item, Arrival) else item.arrival
    asked.setdefault((instance, unpack_reading(arrival.payload).time_boot_ms), arrival.at)


def answered_at(
    instance: int, asked: dict[tuple[int, int], float], latencies: list[float], item: Arrival
) -> None:
    """Take the time of a reading's first waypoint."""
    try:
        messages = unpack(item.payload)
    except BadFrame:
        return
    for message in messages:
        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED" and (
            at := asked.get((instance, message.time_boot_ms))
        ):
            asked[instance, message.time_boot_ms] = 0.0
            latencies.append(1000 * (item.at - at))


def parts() -> Iterator[tuple[str, Path]]:
    """Yield the part and the /proc folder of each process that this one has started."""
    for task in Path("/proc/self/task").iterdir():
        for pid in (task / "children").read_text().split():
            process = Path("/proc", pid)
            words = (process / "cmdline").read_text().split("\0")
            yield (words[3] if words[2] == "sitl" else words[2]), process


def spent() -> dict[str, float]:
    """Return the CPU seconds that the parts have used, by part."""
    found: dict[str, float] = defaultdict(float)
    for part, process in parts():
        fields = (process / "stat").read_text().rpartition(") ")[2].split()
        found[part] += TICK_S * (int(fields[11]) + int(fields[12]))
    return found


def held() -> dict[str, float]:
    """Return the MB of memory that the parts hold, by part."""
    found: dict[str, float] = defaultdict(float)
    for part, process in parts():
        found[part] += 1024 / MB * int((process / "smaps_rollup").read_text().partition("Pss:")[2].split()[0])
    return found


def row(vehicles: int, load: Load) -> str:
    """One line of the table."""
    p50, p99 = np.percentile(load.latencies, [50, 99])
    shares = " | ".join(
        f"{1000 * load.cpu[part] / vehicles:.1f}, {load.memory[part] / vehicles:.0f}" for part in PARTS
    )
    return (
        f"| {vehicles} | {len(load.latencies)} | {load.readings_hz:.2f} | {p50:.2f} | {p99:.2f} | {shares} |"
    )


def main() -> None:
    """Fly fleets of growing size, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--vehicles",
        type=cli.listed(cli.whole(1, 100)),
        metavar="N,N",
        help="sizes of the fleet (default: until p99 doubles)",
    )
    parser.add_argument(
        "--seconds",
        type=cli.number(0.0, 3600.0, above=True),
        default=60.0,
        metavar="S",
        help="time measured, s (default: %(default)s)",
    )
    args = parser.parse_args()
    print("By part: ms of processor time a second and MB of memory, for each vehicle.\n")
    print(
        "| vehicles | steps | readings, Hz | p50, ms | p99, ms | "
        + " | ".join(PARTS)
        + " |\n"
        + "|---" * (5 + len(PARTS))
        + "|"
    )
    sizes = list(args.vehicles or [1])
    base = None
    while sizes:
        vehicles = sizes.pop(0)
        load = measure(vehicles, args.seconds)
        print(row(vehicles, load), flush=True)
        p99 = float(np.percentile(load.latencies, 99))
        base = base or p99
        if not args.vehicles and p99 < 2 * base:
            sizes.append(2 * vehicles)


if __name__ == "__main__":
    cli.run(main)
