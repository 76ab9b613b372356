"""Loop speed: ms per step of whole missions at --speedup 0, split into sitl, link, estimator and agent.

The same run also measures the same missions in-process, and a bare Zenoh ring (three clients, one router,
messages of the same size, no computation). The ring is the lower limit of the link's time. With --secure
the ring and each mission are also measured over mutual TLS.
"""

import argparse
import queue
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

from agent.trials.rollout import rollout
from link.access.authority import make
from link.bus.inbox import Inbox
from link.bus.keys import BELIEF, HEALTH, READING, WAYPOINT
from link.bus.mavlink import unpack_reading
from link.bus.messages import Belief, Health
from link.bus.session import Arrival, Bus
from sitl.launch.launcher import start_parts
from sitl.launch.mission import Launch
from sitl.launch.processes import Processes
from sitl.script.script import Script

RING_ROUNDS = 2000


def fly(seed: int, policy: str, particles: int, secure: Path | None = None) -> list[dict[str, float]]:
    """Fly one mission; returns the milliseconds of each step, by part."""
    processes = Processes(Inbox())
    script = Script().changed(
        {"seed": seed, "agent.policy": policy, "estimator.particles": particles, "estimator.assume": "paper"}
    )
    read_at: list[tuple[int, float]] = []
    compute: dict[str, dict[int, float]] = defaultdict(dict)
    try:
        endpoint = start_parts(
            processes,
            Launch(
                script=script,
                uav_arguments=("--seed", str(seed), "--speedup", "0"),
                secure=secure,
            ),
            {},
        )
        with Bus("bench", endpoint, announced=False, secure=secure) as bus:
            bus.subscribe(READING, BELIEF, HEALTH)
            last: int | None = None
            while last is None or not (
                last < len(read_at)
                and last in compute["estimator"]
                and last - 1 in compute["agent"]
                and last in compute["uav"]
            ):  # readings may come late: a missing one is asked for again
                item = bus.receive()
                now = time.perf_counter()
                match item:
                    case Arrival(key, payload) if key is READING:
                        time_boot_ms = unpack_reading(payload).time_boot_ms
                        if not read_at or time_boot_ms > read_at[-1][0]:
                            read_at.append((time_boot_ms, now))
                    case Arrival(key) if key is BELIEF:
                        belief = bus.decode(item, Belief)
                        if belief and (belief.ceased or belief.step == script.budget):
                            last = belief.step
                    case Arrival(key) if key is HEALTH:
                        health = bus.decode(item, Health)
                        if health and health.step >= 0:
                            compute[health.service].setdefault(health.step, health.compute_s)
    finally:
        processes.stop()
    steps = []
    for step in range(
        1, last
    ):  # from one reading to the next: the estimator and the agent answer reading `step`
        known = step in compute["uav"] and step + 1 in compute["uav"]
        if not (
            known and all({step - 1, step} <= compute[service].keys() for service in ("estimator", "agent"))
        ):
            continue  # health messages may be dropped: such a step is not measured
        total = read_at[step + 1][1] - read_at[step][1]
        parts = {
            "sitl": compute["uav"][step + 1] - compute["uav"][step],
            "estimator": compute["estimator"][step] - compute["estimator"][step - 1],
            "agent": compute["agent"][step] - compute["agent"][step - 1],
        }
        parts |= {
            "total": total,
            "link": total - sum(parts.values()),
            "beyond the planner": total - parts["agent"],
        }
        steps.append({name: 1000 * seconds for name, seconds in parts.items()})
    return steps


def ring(particles: int, secure: Path | None = None) -> list[float]:
    """Milliseconds of each round of the bare ring: messages of a reading's, belief's and waypoint's size
    through a router process.
    """
    processes = Processes(Inbox())
    try:
        endpoint = processes.start_router("tcp/127.0.0.1:0", secure)
        done: queue.SimpleQueue[None] = queue.SimpleQueue()
        with (
            Bus("uav", endpoint, secure=secure) as uav,
            Bus("estimator", endpoint, secure=secure) as estimator,
            Bus("agent", endpoint, secure=secure) as agent,
        ):
            answer, array, waypoint = b"x" * 500, b"x" * 12 * particles, b"x" * 65
            estimator.on(READING, lambda _: estimator.publish(BELIEF, answer, array))
            agent.on(BELIEF, lambda _: agent.publish(WAYPOINT, waypoint))
            uav.on(WAYPOINT, lambda _: done.put(None))
            times = []
            for round_number in range(RING_ROUNDS + 100):
                began = time.perf_counter()
                uav.publish(READING, b"x" * 100)
                done.get()
                if round_number >= 100:
                    times.append(1000 * (time.perf_counter() - began))
        return times
    finally:
        processes.stop()


def secured(args: argparse.Namespace, folder: Path) -> None:
    """Fly each mission and turn the ring plain and over TLS, in turns, and print both with their ratio."""
    ways: dict[str, Path | None] = {"plain": None, "--secure": folder}
    rings: dict[str, list[float]] = {way: [] for way in ways}
    totals: dict[str, list[float]] = {way: [] for way in ways}
    for seed in range(args.first_seed, args.first_seed + args.missions):
        for way, certificates in ways.items():
            totals[way] += [step["total"] for step in fly(seed, "homing", args.particles, certificates)]
            rings[way] += ring(args.particles, certificates)
        print(f"homing seed {seed} flown", file=sys.stderr)
    print("| ms | p50 | p99 |\n|---|---|---|")
    for name, times in (("a step", totals), ("bare Zenoh ring", rings)):
        for way in ways:
            print(row(f"{name}, {way}, n = {len(times[way])}", times[way]))
        ratio = statistics.median(times["--secure"]) / statistics.median(times["plain"])
        print(f"| {name}, --secure by plain | {ratio:.2f} | |")


def row(name: str, times: list[float]) -> str:
    """One line of the table."""
    return f"| {name} | {statistics.median(times):.3f} | {statistics.quantiles(times, n=100)[98]:.3f} |"


def main() -> None:
    """Fly the missions and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--missions", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=1_000_000)
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--secure", action="store_true", help="measure over mutual TLS, too, in turns")
    args = parser.parse_args()
    if args.secure:
        with tempfile.TemporaryDirectory() as folder:
            make(Path(folder), [1])
            secured(args, Path(folder))
        return
    for policy in ("infotaxis", "random"):
        seeds = range(args.first_seed, args.first_seed + args.missions)
        steps = []
        in_process = []
        rollout(
            args.first_seed, policy, args.particles, assume="paper"
        )  # the first mission of a process loads the kernels
        for seed in seeds:
            steps += fly(seed, policy, args.particles)
            began = time.perf_counter()
            result, _ = rollout(seed, policy, args.particles, assume="paper")
            in_process.append((result.steps, 1000 * (time.perf_counter() - began)))
            print(f"{policy} seed {seed} flown", file=sys.stderr)
        alone = sum(ms for _, ms in in_process) / sum(count for count, _ in in_process)
        print(f"\n{policy}, {args.missions} missions, {len(steps)} steps, {args.particles} particles\n")
        print("| ms a step | p50 | p99 |\n|---|---|---|")
        for name in ("total", "sitl", "link", "estimator", "agent", "beyond the planner"):
            print(row(name, [step[name] for step in steps]))
        bare = ring(args.particles)
        print(row("bare Zenoh ring, the link's floor", bare))
        mean = statistics.fmean(step["total"] for step in steps)
        floor = statistics.median(bare)
        print(f"\nmean total {mean:.3f} ms, in-process {alone:.3f} ms: {mean / alone:.1f} times;", end=" ")
        print(f"link p50 {statistics.median(step['link'] for step in steps) / floor:.1f} times the bare ring")


if __name__ == "__main__":
    main()
