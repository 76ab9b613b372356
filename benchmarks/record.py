"""The cost of recording: how much slower the loop at --speedup 0 is with a recorder than without, on the
same missions.

A recorder repeatedly joins and leaves a running mission. The steps while it records are compared with
equally long stretches before it joins and after it leaves. All three lie within a second or two, so that
other load on the machine slows them alike.
"""

import argparse
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from link.bus.inbox import Inbox
from link.bus.keys import READING
from link.bus.mavlink import unpack_reading
from link.bus.session import Bus
from sitl.launch.launcher import start_parts
from sitl.launch.mission import Launch
from sitl.launch.processes import Processes
from sitl.script.script import load

SETTLE_STEPS = 40
"""Steps that are not counted after a recorder has joined or left."""
MISSION_STEPS = 700
"""After this many steps a new mission starts: a recorder that joins receives all readings so far, and
their number must stay small.
"""
MISSION = """\
seed: {seed}
speedup: 0
agent: {{policy: {policy}, budget: 100000}}
estimator: {{assume: paper, threshold_m: 1.0e-9}}
vehicle: {{endurance_s: 1.0e+6}}
"""
"""A mission that never ends by itself."""


def comparisons(seed: int, policy: str, stretch: int, log: Path) -> Iterator[tuple[float, float]]:
    """Fly a mission; yields pairs of milliseconds per step (without a recorder, with one)."""
    processes = Processes(Inbox())
    mission = log.with_name("mission.yaml")
    mission.write_text(MISSION.format(seed=seed, policy=policy))
    try:
        endpoint = start_parts(processes, Launch(script=load(mission), uav_arguments=(str(mission),)), {})
        with Bus("bench", endpoint) as bus:
            bus.subscribe(READING)
            newest = -1
            flown = 0

            def fly(steps: int) -> float:
                nonlocal newest, flown
                began, count = time.perf_counter(), 0
                while count < steps:
                    time_boot_ms = unpack_reading(bus.receive().payload).time_boot_ms
                    if time_boot_ms > newest:
                        newest, count = time_boot_ms, count + 1
                flown += count
                return 1000.0 * (time.perf_counter() - began) / steps

            def fly_until(done: Callable[[], bool]) -> None:
                while not done():
                    fly(1)
                fly(SETTLE_STEPS)

            fly(SETTLE_STEPS)
            while flown < MISSION_STEPS:
                before = fly(stretch)
                command = [sys.executable, "-m", "sitl", "record", str(log), "--force", "--connect", endpoint]
                with subprocess.Popen(command, stdout=subprocess.PIPE) as recorder:
                    fly_until(recording(recorder))
                    recorded = fly(2 * stretch)
                    recorder.send_signal(signal.SIGTERM)
                    fly_until(ended(recorder))
                yield (before + fly(stretch)) / 2, recorded
    finally:
        processes.stop()


def recording(recorder: "subprocess.Popen[bytes]") -> Callable[[], bool]:
    """Return a function that is true once the recorder has started."""
    assert recorder.stdout
    out = recorder.stdout.fileno()
    return lambda: bool(select.select([out], [], [], 0)[0])


def ended(recorder: "subprocess.Popen[bytes]") -> Callable[[], bool]:
    """Return a function that is true once the recorder has ended."""
    return lambda: recorder.poll() is not None


def interval(ratios: list[float]) -> tuple[float, float]:
    """95% bootstrap interval of the median."""
    draws = np.random.default_rng(1).choice(ratios, (10_000, len(ratios)))
    low, high = np.quantile(np.median(draws, axis=1), [0.025, 0.975])
    return float(low), float(high)


def main() -> None:
    """Fly and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--comparisons", type=int, default=40)
    parser.add_argument("--stretch", type=int, default=150, metavar="STEPS")
    parser.add_argument("--policy", default="random")
    parser.add_argument("--first-seed", type=int, default=1_000_000)
    args = parser.parse_args()
    print("| policy | comparisons | ms a step without | with | ratio | 95% interval |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for policy in args.policy.split(","):
            pairs: list[tuple[float, float]] = []
            seed = args.first_seed
            while len(pairs) < args.comparisons:
                pairs += comparisons(seed, policy, args.stretch, Path(folder) / "bench.mcap")
                seed += 1
            alone, recorded = np.median(pairs, axis=0)
            ratios = [with_it / without for without, with_it in pairs]
            low, high = interval(ratios)
            print(
                f"| {policy} | {len(pairs)} | {alone:.3f} | {recorded:.3f} | {np.median(ratios):.3f} | "
                f"{low:.3f} to {high:.3f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
