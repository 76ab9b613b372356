"""Sweeps on a Ray cluster: the same flights, the same rows; each node has our code installed, and is asked whether it is the same."""

import logging
import os
import pickle
import signal
import socket
from collections.abc import Generator, Iterable, Sequence
from itertools import islice
from typing import Any

from agent.trials.figures import MissionRow
from agent.trials.sweep import Flight, Sweep, code
from agent.trials.workers import THREADS

AHEAD = 10_000
"""Tasks handed out at once: more than a cluster flies in the second between two looks, and never all of ten million."""


class ClusterError(Exception):
    """The cluster cannot fly a sweep; the message says why in one line."""


def join(address: str) -> None:
    """Join the Ray cluster there, of which this machine must be a node: HOST:PORT of its head, or auto."""
    os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "1")  # at 40 s each
    try:
        import ray
    except ImportError:
        raise ClusterError("Ray is not installed; pip install 'plumeward[ray]'") from None
    terminate = signal.getsignal(signal.SIGTERM)
    try:
        if address != "auto":
            host, _, port = address.rpartition(":")
            socket.create_connection((host.strip("[]"), int(port)), timeout=5).close()  # Ray itself is slow to see that nobody answers
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR, runtime_env={"env_vars": dict.fromkeys(THREADS, "1")})
    except (OSError, RuntimeError, ValueError) as error:
        why = str(error.__cause__ or error).strip().splitlines()[-1].partition(". ")[0].rstrip(".")
        allowed = "HOST:PORT of a Ray cluster that this machine is in, or auto"
        raise ClusterError(f"cannot join {address!r} ({why}); wanted {allowed}") from error
    signal.signal(signal.SIGTERM, terminate)  # Ray took it


def on_cluster(sweep: Sweep, tasks: Iterable[Sequence[Flight]]) -> Generator[list[MissionRow], None, None]:
    """Fly on the cluster joined, and leave it."""
    import ray

    here = code()

    def fly_there(packed: bytes) -> Any:  # nested, it travels by value: it can say that what it needs is not there
        try:
            from agent.trials.sweep import code, fly

            if code() == here:
                return fly(*pickle.loads(packed))
        except ImportError:
            pass
        return socket.gethostname()

    try:
        remote = ray.remote(num_cpus=1)(fly_there)
        left = iter(tasks)
        waiting: list[Any] = []
        while waiting := waiting + [remote.remote(pickle.dumps((sweep, flights))) for flights in islice(left, AHEAD - len(waiting))]:
            finished, waiting = ray.wait(waiting, num_returns=len(waiting), timeout=1)
            for flown in ray.get(finished):
                if isinstance(flown, str):
                    raise ClusterError(f"node {flown!r} lacks the plumeward, numpy and numba that are here; install the same there")
                yield from flown
    finally:
        ray.shutdown()
