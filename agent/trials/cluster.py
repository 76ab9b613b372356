"""Sweeps on a Ray cluster: the same flights and the same rows.

Each node must have the same code installed, which is checked.
"""

import logging
import os
import pickle
import signal
import socket
from collections.abc import Generator, Iterable, Sequence
from itertools import islice
from typing import Any

from agent.trials.figures import MissionRow
from agent.trials.sources import code
from agent.trials.sweep import Flight, Sweep
from agent.trials.workers import THREADS
from link.cli import BadInput

# Tasks handed out at once: more than a cluster flies in the second between two polls, without holding ten
# million in memory.
HANDED_OUT = 10_000


def join(address: str) -> None:
    """Join the Ray cluster at an address: HOST:PORT of its head, or auto.

    This machine must be one of its nodes. Raises BadInput.
    """
    os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "1")  # each retry takes 40 s
    try:
        import ray
    except ImportError:
        raise BadInput("--ray: Ray is not installed; pip install 'plumeward[ray]'") from None
    terminate = signal.getsignal(signal.SIGTERM)
    try:
        if address != "auto":
            host, _, port = address.rpartition(":")
            socket.create_connection(
                (host.strip("[]"), int(port)), timeout=5
            ).close()  # fails at once where nobody answers; Ray takes long
        ray.init(
            address,
            log_to_driver=False,
            logging_level=logging.ERROR,
            runtime_env={"env_vars": dict.fromkeys(THREADS, "1")},
        )
    except (OSError, RuntimeError, ValueError) as error:
        why = str(error.__cause__ or error).strip().splitlines()[-1].partition(". ")[0].rstrip(".")
        raise BadInput(
            f"--ray: cannot join {address!r} ({why}); wanted HOST:PORT of a Ray cluster that this machine is "
            "in, or auto"
        ) from error
    signal.signal(signal.SIGTERM, terminate)  # Ray replaces the handler


def on_cluster(sweep: Sweep, tasks: Iterable[Sequence[Flight]]) -> Generator[list[MissionRow], None, None]:
    """Fly on the cluster that `join` joined, then leave it.

    Raises BadInput where a node has other code.
    """
    import ray

    here = code()

    def fly_there(
        packed: bytes,
    ) -> Any:  # pickled by value because it is nested, so a node without our code can still run it
        try:
            from agent.trials.sources import code
            from agent.trials.sweep import fly

            if code() == here:
                return fly(*pickle.loads(packed))
        except ImportError:
            pass
        return socket.gethostname()

    try:
        remote = ray.remote(num_cpus=1)(fly_there)
        left = iter(tasks)
        waiting: list[Any] = []
        while waiting := waiting + [
            remote.remote(pickle.dumps((sweep, flights)))
            for flights in islice(left, HANDED_OUT - len(waiting))
        ]:
            finished, waiting = ray.wait(waiting, num_returns=len(waiting), timeout=1)
            for flown in ray.get(finished):
                if isinstance(flown, str):
                    raise BadInput(
                        f"--ray: node {flown!r} has other versions of plumeward, numpy or numba; "
                        "install those of this machine"
                    )
                yield from flown
    finally:
        ray.shutdown()
