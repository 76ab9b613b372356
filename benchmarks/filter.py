"""The filter's speed, compared with three peers, and the lower limit: the likelihoods alone.

make bench-filter        # installs the peers into .venv first
"""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from benchmarks.filter_peers import Particles, Peer, PlainNumpy, StoneSoup
from estimator.batch import Batch
from estimator.filter import Config, prior
from estimator.kernels.densities import log_likelihoods
from estimator.kernels.update import RESAMPLE_BELOW, update
from plume.scenario import AREA_M, draw
from plume.worlds.world import World

Array = NDArray[np.float64]

SIZES = (1000, 4000, 20_000)
BATCHES = (1, 8, 64, 256, 1024)
MISSIONS = 8
STEPS = 30


def readings(seed: int, steps: int = STEPS) -> Array:
    """Readings (T, 7) on a straight path to the source, in the format of `Config.row`."""
    s = draw(seed)
    world = World(s, seed)
    ways = np.linspace(world.start, s.source, steps).astype(np.float32).tolist()
    return np.array([[x, y, 0.0, *world.wind, world.gas((x, y), k), 1.0] for k, (x, y) in enumerate(ways)])


def config_of(seed: int, count: int) -> Config:
    """The estimator's configuration in the mission of a seed."""
    s = draw(seed)
    return Config(particles=count, seed=seed, rate=s.q, diffusivity=s.d, lifetime=s.tau)


def ours(seed: int, count: int, rows: Array) -> tuple[list[float], list[bool]]:
    """(Seconds of each update of a mission, True for each update that resampled and moved)."""
    config = config_of(seed, count)
    p = prior(config)
    times, moved = [], []
    for t in range(1, len(rows) + 1):
        first = p.particles[0, 0], p.particles[0, -1]
        began = time.perf_counter()
        update(p.sample, rows[:t], config.model, seed, config.sweeps, RESAMPLE_BELOW)
        times.append(time.perf_counter() - began)
        moved.append(first != (p.particles[0, 0], p.particles[0, -1]))
    return times, moved


def peer_times(kind: Callable[..., Peer], seed: int, count: int, rows: Array, moves: bool) -> list[float]:
    """Seconds of each update of a mission by a peer."""
    s = draw(seed)
    peer = kind(count, seed, s.q, s.d, s.tau, AREA_M, moves=moves)
    times = []
    for row in rows[:, [0, 1, 3, 4, 5]]:
        began = time.perf_counter()
        peer.update(row)
        times.append(time.perf_counter() - began)
    return times


def limit(seed: int, count: int, rows: Array) -> float:
    """Median seconds to compute only the likelihoods of one reading, without a filter."""
    config = config_of(seed, count)
    particles = prior(config).particles
    times = []
    for row in np.repeat(rows, 20, axis=0):
        began = time.perf_counter()
        log_likelihoods(particles, config.model, row)
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def main() -> None:
    """Print the tables."""
    seeds = range(1_000_000, 1_000_000 + MISSIONS)
    flights = {seed: readings(seed) for seed in seeds}
    peers = {"Stone Soup": StoneSoup, "particles": Particles, "plain NumPy": PlainNumpy}
    for kind in peers.values():
        peer_times(kind, 1_000_000, 1000, flights[1_000_000], moves=True)  # compiles the kernels
    print("µs an update: median without resampling; mean over whole missions, resample-and-move included\n")
    print(
        "| N | filter | without resampling | ours is faster | whole mission, mean | ours is faster "
        "|\n|---|---|---|---|---|---|"
    )
    for count in SIZES:
        runs = [ours(seed, count, flights[seed]) for seed in seeds]
        plain = float(
            np.median([t for times, moved in runs for t, m in zip(times, moved, strict=True) if not m])
        )
        mean = float(np.mean([t for times, _ in runs for t in times]))
        alone = float(np.median([limit(seed, count, flights[seed]) for seed in seeds]))
        print(f"| {count} | likelihoods alone, the limit | {1e6 * alone:.1f} | {alone / plain:.2f}x | | |")
        print(f"| {count} | ours | {1e6 * plain:.1f} | | {1e6 * mean:.0f} | |")
        for name, kind in peers.items():
            reweighing = float(
                np.median(
                    [t for seed in seeds for t in peer_times(kind, seed, count, flights[seed], moves=False)]
                )
            )
            moving = float(
                np.mean(
                    [t for seed in seeds for t in peer_times(kind, seed, count, flights[seed], moves=True)]
                )
            )
            print(
                f"| {count} | {name} | {1e6 * reweighing:.0f} | {reweighing / plain:.1f}x | "
                f"{1e6 * moving:.0f} | {moving / mean:.1f}x |"
            )
    print(
        "\n| missions in a batch, N 1,000 | threads | µs a mission and update, whole missions "
        "|\n|---|---|---|"
    )
    for size in BATCHES:
        for threads in (1, 2):
            batch = Batch([config_of(1_000_000 + i, 1000) for i in range(size)], threads)
            rows = np.stack([readings(1_000_000 + i) for i in range(size)])
            began = time.perf_counter()
            for t in range(STEPS):
                batch.assimilate(rows[:, t])
            print(f"| {size} | {threads} | {1e6 * (time.perf_counter() - began) / (size * STEPS):.1f} |")


if __name__ == "__main__":
    main()
