"""Load of one search by several: from the last reading of a round to its waypoints, in real time on the bus.

    python -m benchmarks.load --vehicles 8 --missions 20

Each vehicle sends its telemetry at the usual rates, its position 10 times a second. A client of the bus hears
all of it and takes the times.
"""

import argparse
import statistics
import sys
import time

from link.bus.inbox import Inbox
from link.bus.keys import BELIEF, HEALTH, MAVLINK_OUT, READING, STOP, WAYPOINT
from link.bus.messages import Belief, Health
from link.bus.session import Arrival, Bus
from sitl.launch.launcher import start_parts
from sitl.launch.mission import Launch
from sitl.launch.processes import Processes
from sitl.script.script import Script


def fly(seed: int, vehicles: int) -> tuple[list[float], dict[str, float], float]:
    """Fly one mission of several from different corners in real time.

    Returns the ms from the last reading of each round to its waypoints, the ms of a round that the services
    computed, and the telemetry messages a second.
    """
    script = Script().changed(
        {"seed": seed, "speedup": 1.0, "fleet.vehicles": vehicles, "fleet.formation": "corners"}
    )
    processes, launch = (
        Processes(Inbox()),
        Launch(script=script, uav_arguments=("--seed", str(seed), "--speedup", "1")),
    )
    answers: list[float] = []
    computed: dict[str, float] = {}
    read_at = began = time.monotonic()
    heard = steps = 0
    try:
        endpoint = start_parts(processes, launch, {})
        with Bus("bench", endpoint, launch.namespace, announced=False, vehicles=launch.numbers) as bus:
            bus.subscribe(READING, WAYPOINT, BELIEF, STOP, HEALTH, MAVLINK_OUT)
            while True:
                item = bus.receive()
                if not isinstance(item, Arrival):
                    continue
                if item.key is MAVLINK_OUT:
                    heard += 1
                elif item.key is READING:
                    began = began if answers else item.at
                    read_at = item.at
                elif item.key is WAYPOINT and read_at:  # not the same once more
                    answers.append(1000 * (item.at - read_at))
                    read_at = 0.0
                elif item.key is HEALTH and (health := bus.decode(item, Health)):
                    computed[health.service] = 1000 * health.compute_s
                elif item.key is BELIEF and (belief := bus.decode(item, Belief)):
                    steps = belief.step
                    if belief.ceased or steps == script.budget:
                        break
            lasted_s = time.monotonic() - began
    finally:
        processes.stop()
    each = {name: computed.get(name, 0.0) / max(steps, 1) for name in ("estimator", "agent")}
    return answers, each, heard / lasted_s


def main() -> None:
    """Fly the missions and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--vehicles", type=int, default=8)
    parser.add_argument("--missions", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1_000_000)
    args = parser.parse_args()
    answers: list[float] = []
    each: list[dict[str, float]] = []
    telemetry: list[float] = []
    for seed in range(args.first_seed, args.first_seed + args.missions):
        times, computed, rate = fly(seed, args.vehicles)
        answers += times
        each.append(computed)
        telemetry.append(rate)
        print(f"seed {seed} flown: {len(times)} rounds", file=sys.stderr)
    p99 = statistics.quantiles(answers, n=100, method="inclusive")[98]
    print(f"{args.vehicles} vehicles, {args.missions} missions, {len(answers)} rounds, homing, field\n")
    print("| from the last reading of a round to its waypoints, ms | |\n|---|---|")
    print(f"| p50 | {statistics.median(answers):.1f} |\n| p99 | {p99:.1f} |")
    for name in ("estimator", "agent"):
        print(f"| computed by the {name}, a round | {statistics.fmean(one[name] for one in each):.1f} |")
    print(f"| telemetry on the bus, messages a second | {statistics.fmean(telemetry):.0f} |")


if __name__ == "__main__":
    main()
