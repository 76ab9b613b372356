"""The filter's speed, compared with its former moves, three peers, and the lower limit: the likelihoods alone.

make bench-filter        # installs the peers into .venv first
"""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from benchmarks.filter_former import former_resample_move
from benchmarks.filter_peers import Particles, Peer, PlainNumpy, StoneSoup
from estimator.batch import Batch
from estimator.filter import Config, prior
from estimator.kernels.densities import log_likelihoods
from estimator.kernels.moves import resample_move
from estimator.kernels.update import RESAMPLE_BELOW, update
from estimator.kernels.weights import moments, systematic, tempered_share
from plume.randomness import keyed
from plume.scenario import AREA_M, draw
from plume.world import World

Array = NDArray[np.float64]

SIZES = (1000, 4000, 20_000)
BATCHES = (1, 8, 64, 256, 1024)
MISSIONS = 8
STEPS = 30
MANY = 100_000
"""Particles of the reference that ours and the former moves are compared with."""
NARROW_M = 5.0
"""Beliefs of less spread than this are compared, m."""


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
    model = (config.unknown_indices, config.prior_rows, config.sensor_row, seed, config.sweeps)
    times, moved = [], []
    for t in range(1, len(rows) + 1):
        first = p.particles[0, 0], p.particles[0, -1]
        began = time.perf_counter()
        update(p.particles, p.log_weights, p.weights, p.log_targets, rows[:t], *model)
        times.append(time.perf_counter() - began)
        moved.append(first != (p.particles[0, 0], p.particles[0, -1]))
    return times, moved


def moved(seed: int, count: int, rows: Array, former: bool) -> tuple[float, Array]:
    """(Processor seconds of resample-and-move in a mission, its beliefs (T, 3): mean and spread), with ours or the former moves."""
    config = config_of(seed, count)
    model = (config.unknown_indices, config.prior_rows, config.sensor_row)
    p = prior(config)
    particles, log_weights, weights, log_targets, rows = p.particles, p.log_weights, p.weights, p.log_targets, rows.copy()
    seconds, beliefs = 0.0, []
    for t, row in enumerate(rows):
        done, stage = 0.0, 0
        while done < 1.0:
            densities = log_likelihoods(particles, *model, row)
            share, size = tempered_share(log_weights, densities, 1.0 - done, weights)
            done = 1.0 if share >= 1.0 - done else done + share
            row[6] = done
            log_weights += share * densities
            log_targets += share * densities
            if size < RESAMPLE_BELOW * count:
                ancestors = systematic(weights, float(keyed(seed, "offset", 100 * t + stage).random()))
                began = time.process_time()
                if former:
                    former_resample_move(
                        particles, log_targets, ancestors, rows[: t + 1], *model[1:], AREA_M, seed, t, stage
                    )  # fmt: skip
                else:
                    resample_move(particles, log_targets, ancestors, config.sweeps, rows[: t + 1], *model, seed, t, stage)
                seconds += time.process_time() - began
                log_weights[:], weights[:] = 0.0, 1.0
                stage += 1
        mean, covariance = moments(particles, weights)
        beliefs.append((*mean, np.sqrt(np.trace(covariance))))
    return seconds, np.array(beliefs)


def compare_moves(flights: dict[int, Array]) -> None:
    """Print what ours and the former moves cost, and how far their means are from those of many particles."""
    exact = {seed: moved(seed, MANY, rows, former=True)[1] for seed, rows in flights.items()}
    print(
        "\n| N | moves | processor µs a mission | ours to former | error of the mean, spreads·√N: median | rms |\n|---|---|---|---|---|---|"
    )
    for count in SIZES[:2]:
        best = {True: np.inf, False: np.inf}
        for _ in range(5):  # in turns: another program's load then falls on both
            for former in best:
                best[former] = min(best[former], sum(moved(seed, count, rows, former)[0] for seed, rows in flights.items()))
        for former, seconds in best.items():
            beliefs = {seed: moved(seed, count, rows, former)[1] for seed, rows in flights.items()}
            ours, many = np.concatenate(list(beliefs.values())), np.concatenate(list(exact.values()))
            errors = np.hypot(*(ours - many)[:, :2].T)[many[:, 2] < NARROW_M] / many[many[:, 2] < NARROW_M, 2] * np.sqrt(count)
            cost = f"{1e6 * seconds / len(flights):.0f} | {seconds / best[True]:.2f}"
            figures = f"{cost} | {np.median(errors):.2f} | {np.sqrt(np.mean(errors**2)):.2f}"
            print(f"| {count} | {'former' if former else 'ours'} | {figures} |")


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
        log_likelihoods(particles, config.unknown_indices, config.prior_rows, config.sensor_row, row)
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def main() -> None:
    """Print the tables."""
    seeds = range(1_000_000, 1_000_000 + MISSIONS)
    flights = {seed: readings(seed) for seed in seeds}
    compare_moves(flights)
    peers = {"Stone Soup": StoneSoup, "particles": Particles, "plain NumPy": PlainNumpy}
    for kind in peers.values():
        peer_times(kind, 1_000_000, 1000, flights[1_000_000], moves=True)  # compiles the kernels
    print("µs an update: median without resampling; mean over whole missions, resample-and-move included\n")
    print("| N | filter | without resampling | ours is faster | whole mission, mean | ours is faster |\n|---|---|---|---|---|---|")
    for count in SIZES:
        runs = [ours(seed, count, flights[seed]) for seed in seeds]
        plain = float(np.median([t for times, moved in runs for t, m in zip(times, moved, strict=True) if not m]))
        mean = float(np.mean([t for times, _ in runs for t in times]))
        alone = float(np.median([limit(seed, count, flights[seed]) for seed in seeds]))
        print(f"| {count} | likelihoods alone, the limit | {1e6 * alone:.1f} | {alone / plain:.2f}x | | |")
        print(f"| {count} | ours | {1e6 * plain:.1f} | | {1e6 * mean:.0f} | |")
        for name, kind in peers.items():
            reweighing = float(np.median([t for seed in seeds for t in peer_times(kind, seed, count, flights[seed], moves=False)]))
            moving = float(np.mean([t for seed in seeds for t in peer_times(kind, seed, count, flights[seed], moves=True)]))
            print(f"| {count} | {name} | {1e6 * reweighing:.0f} | {reweighing / plain:.1f}x | {1e6 * moving:.0f} | {moving / mean:.1f}x |")
    print("\n| missions in a batch, N 1,000 | threads | µs a mission and update, whole missions |\n|---|---|---|")
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
