"""Endurance: one long mission through the real processes, and what grows: memory, handles, threads,
latency.

    python -m benchmarks.soak                     # 100,000 steps
    python -m benchmarks.soak --steps 10000

Router, vehicle, estimator and agent live for all steps. The run after its first tenth is cut into 20
blocks. The slope of a quantity is the mean change from one block's mean to the next; its interval is
Student's t on these 19 changes. That holds for a random walk: a memory that the allocator once took stays
taken. It is cautious for noise around a line. All intervals hold together at 95% (Bonferroni). A quantity
has grown if its interval lies above zero.

A mission keeps its readings by design: the vehicle for who joins late, and their times to know late
answers by; the estimator in its posterior. Control processes keep the same and do nothing else: a bare
publisher, and the filter without a bus. Their slope is subtracted. The estimator's own compute time grows
with the readings, too, so latency is that of a step without it.
"""

import argparse
import itertools
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from aircraft.search.search import Answers
from estimator.filter import Config, assimilate, prior
from link import cli
from link.bus.inbox import Inbox
from link.bus.keys import HEALTH, READING
from link.bus.mavlink import Codec, Reading, pack_reading, unpack_reading
from link.bus.messages import Health
from link.bus.session import Arrival, Bus
from plume.randomness import keyed
from sitl.launch.launcher import start_parts
from sitl.launch.mission import Launch
from sitl.launch.processes import Processes
from sitl.script.script import Script

PARTS = ("router", "uav", "estimator", "agent")
QUANTITIES = ("memory, kB", "handles", "threads")
BLOCKS, WARM_UP, SAMPLES = 20, 0.1, 1000
CONFIDENCE = 0.95
WALK = math.sqrt(1.5)
"""Neighbouring changes between a random walk's block means correlate by 1/4: their mean varies so much
more than if they did not.
"""
PAGE_KB = os.sysconf("SC_PAGE_SIZE") / 1024
LATENCY = "latency, ms"
QUIET_S = 60.0


class Slope(NamedTuple):
    """Growth per 1,000 steps: the estimate, its standard error, and the degrees of freedom of Student's t."""

    value: float
    error: float
    freedom: float

    def interval(self, tests: int) -> tuple[float, float]:
        """Return the two-sided interval that holds at CONFIDENCE together with those of the other tests."""
        from scipy.stats import t as student  # type: ignore[import-untyped]

        half = float(student.ppf(1 - (1 - CONFIDENCE) / 2 / tests, self.freedom)) * self.error
        return self.value - half, self.value + half

    def minus(self, other: "Slope") -> "Slope":
        """Return the difference of two independent slopes (Welch)."""
        variances = self.error**2, other.error**2
        total = sum(variances)
        spent = sum(
            variance**2 / slope.freedom for variance, slope in zip(variances, (self, other), strict=True)
        )
        return Slope(self.value - other.value, math.sqrt(total), total**2 / spent if spent else self.freedom)


def slope(samples: Sequence[tuple[float, float]]) -> Slope:
    """Return the slope of (step, value) samples, by the changes between the means of BLOCKS blocks after
    the warm-up.
    """
    first, last = samples[0][0], samples[-1][0]
    begin = first + WARM_UP * (last - first)
    width = (last - begin) / BLOCKS
    blocks: list[list[float]] = [[] for _ in range(BLOCKS)]
    for step, value in samples:
        if step >= begin:
            blocks[min(int((step - begin) / width), BLOCKS - 1)].append(value)
    means = [statistics.fmean(block) for block in blocks]
    changes = [1000 * (after - before) / width for before, after in itertools.pairwise(means)]
    return Slope(
        statistics.fmean(changes),
        WALK * statistics.stdev(changes) / math.sqrt(len(changes)),
        len(changes) - 1,
    )


def look(pid: int) -> tuple[float, float, float]:
    """Return a process's resident memory in kB, and its numbers of handles and threads."""
    process = Path(f"/proc/{pid}")
    resident = int((process / "statm").read_text().split()[1]) * PAGE_KB
    return resident, len(list((process / "fd").iterdir())), len(list((process / "task").iterdir()))


def children() -> dict[str, int]:
    """Return the process ids of the parts that this process has started."""
    found = {}
    for task in Path("/proc/self/task").iterdir():
        for pid in (task / "children").read_text().split():
            words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
            found[words[3] if words[2] == "sitl" else words[2]] = int(pid)
    return {part: pid for part, pid in found.items() if part in PARTS}


def fly(steps: int, folder: Path) -> dict[tuple[str, str], list[tuple[float, float]]]:
    """Fly one mission of so many steps; returns (step, value) samples by part and quantity."""
    every = max(steps // SAMPLES, 1)
    changes = {
        "agent.policy": "random",
        "agent.budget": steps,
        "estimator.assume": "paper",
        "estimator.threshold_m": 1e-9,
    }
    processes = Processes(Inbox())
    samples: dict[tuple[str, str], list[tuple[float, float]]] = {
        (part, name): [] for part in PARTS for name in QUANTITIES
    }
    samples["loop", LATENCY] = []
    try:
        endless = folder / "soak.yaml"  # a battery lasts for half an hour
        endless.write_text("vehicle:\n  endurance_s: .inf\n")
        words = (str(endless), "--seed", "1", "--speedup", "0")
        endpoint = start_parts(processes, Launch(script=Script().changed(changes), uav_arguments=words), {})
        with Bus("soak", endpoint, announced=False) as bus:
            bus.subscribe(READING, HEALTH)
            pids: dict[str, int] = {}
            heard_s = time.monotonic()
            step, known, computed, before, seen = -1, -1, 0.0, 0.0, math.nan
            times: list[float] = []
            while step < steps:
                item = bus.receive(1.0)
                if time.monotonic() > heard_s + QUIET_S:
                    raise SystemExit(f"error: the mission has ended at step {step}")
                if not isinstance(item, Arrival):
                    continue
                if item.key is HEALTH:
                    health = bus.decode(item, Health)
                    if health and health.service == "estimator":
                        computed = health.compute_s
                    continue
                if (boot_ms := unpack_reading(item.payload).time_boot_ms) <= known:
                    continue  # repeated
                known, step, heard_s = boot_ms, step + 1, item.at
                if step:
                    times.append(1000 * (item.at - seen - (computed - before)))
                seen, before = item.at, computed
                if step % every == 0 and step:
                    pids = pids or children()
                    for part, pid in pids.items():
                        for name, value in zip(QUANTITIES, look(pid), strict=True):
                            samples[part, name].append((step, value))
                    samples["loop", LATENCY].append((step, statistics.median(times)))
                    times.clear()
                if step % max(steps // 20, 1) == 0:
                    print(f"step {step}", file=sys.stderr, flush=True)
    finally:
        processes.stop()
    return samples


def keep(part: str, steps: int, endpoint: str) -> Iterator[int]:
    """Keep readings as a part does, and nothing else; yields the step."""
    rng = keyed(0, "soak benchmark")
    places = rng.uniform(0.0, 30.0, (steps, 2)).tolist()
    readings = (Reading(1000 + number, (x, y), 5.0, (2.0, 1.0), 0.5) for number, (x, y) in enumerate(places))
    if part == "estimator":
        config = Config(assume="paper", threshold_m=1e-9)
        posterior = prior(config)
        for number, reading in enumerate(readings):
            posterior = assimilate(posterior, reading, config)
            yield number
        return
    codec, answers = Codec(1, 1), Answers()
    with Bus("uav", endpoint) as bus:
        for number, reading in enumerate(readings):
            bus.publish(READING, pack_reading(codec, reading))
            answers.sampled(reading.time_boot_ms)
            bus.publish_health()
            time.sleep(0.0005)  # a mission's step leaves the sender time to empty its queues
            yield number


def control(part: str, steps: int) -> Slope:
    """Return the slope of the memory of a process that only keeps readings."""
    processes = Processes(Inbox())
    try:
        endpoint = processes.start_router("tcp/127.0.0.1:0") if part == "uav" else "-"
        words = [sys.executable, "-m", "benchmarks.soak", "--keep", part, str(steps), endpoint]
        with subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout
            samples = [(float(line.split()[0]), float(line.split()[1])) for line in process.stdout]
    finally:
        processes.stop()
    return slope(samples)


def main() -> int:
    """Fly, compare, and print the table; returns 1 if something grows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--steps",
        type=cli.whole(1000, 1_000_000),
        default=100_000,
        metavar="N",
        help="(default: %(default)s)",
    )
    args = parser.parse_args()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        samples = fly(args.steps, Path(folder))
    print(f"{args.steps} steps in {time.monotonic() - began:.0f} s", file=sys.stderr)
    slopes = {(part, name): slope(values) for (part, name), values in samples.items()}
    controls = {part: control(part, args.steps) for part in ("uav", "estimator")}
    print(
        f"{args.steps} steps, changes per 1,000 steps\n\n| part | quantity | at the end | slope | kept by "
        "design | left, interval | |"
    )
    print("|---|---|---|---|---|---|---|")
    grown = 0
    for (part, name), found in slopes.items():
        kept = controls.get(part) if name == QUANTITIES[0] else None
        left = found.minus(kept) if kept else found
        low, high = left.interval(len(slopes))
        grown += low > 0
        design = f"{kept.value:.3f}" if kept else ""
        says = "grows" if low > 0 else ""
        print(
            f"| {part} | {name} | {samples[part, name][-1][1]:.2f} | {found.value:.3f} | {design} | "
            f"{low:.3f} to {high:.3f} | {says} |"
        )
    return cli.FAILED if grown else 0


def _keep(part: str, steps: int, endpoint: str) -> None:
    every = max(steps // SAMPLES, 1)
    for number in keep(part, steps, endpoint):
        if number % every == 0:
            print(number, look(os.getpid())[0], flush=True)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["--keep", part, steps, endpoint]:
            cli.run(lambda: _keep(part, int(steps), endpoint))
        case _:
            cli.run(main)
