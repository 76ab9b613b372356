"""Worker processes: tasks go out, results come back as they end. A killed worker ends the work with an error; no worker outlives it."""

import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from itertools import islice
from multiprocessing import active_children, get_context
from multiprocessing.connection import Connection
from typing import TypeVar

from link.cli import uninterrupted

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
"""One thread a worker: thread pools beside each other slow all of them down."""
AHEAD = 4
"""Tasks handed out for each worker: none waits for its next one, and ten million tasks are never in memory."""

Task = TypeVar("Task")
Result = TypeVar("Result")


class WorkerLost(BrokenExecutor):
    """A worker process was killed."""


def as_flown(function: Callable[[Task], Result], tasks: Iterable[Task], workers: int) -> Generator[tuple[Task, Result], None, None]:
    """Yield (task, function(task)) as they end, from at most so many processes.

    Raises what a task raises, and WorkerLost where a worker was killed; what had ended by then has been yielded before.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")
    context, left = get_context("spawn"), iter(tasks)
    running: dict[Future[Result], Task] = {}
    alive, kept_open = context.Pipe(duplex=False)
    others = set(active_children())
    with alive, kept_open, ProcessPoolExecutor(workers, context, _end_with_parent, (alive,)) as pool:
        try:
            while True:
                for task in islice(left, AHEAD * workers - len(running)):
                    running[_submit(pool, function, task)] = task
                if not running:
                    return
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in sorted(done, key=lambda it: it.exception() is not None):  # what is flown is not lost to what failed
                    yield running.pop(future), future.result()
        except BaseException as error:
            for worker in set(active_children()) - others:  # now, not after their tasks, nor while they still start
                worker.kill()
            if isinstance(error, BrokenExecutor):
                raise WorkerLost("a worker process was killed; the memory may have run out") from error
            raise


def _submit(pool: ProcessPoolExecutor, function: Callable[[Task], Result], task: Task) -> Future[Result]:
    # It may start a worker. One that is begun is finished, so that it is known and can be ended; and it inherits the mask:
    # Ctrl-C, which a terminal sends to workers too, is this process's to answer.
    with uninterrupted():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return pool.submit(function, task)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent(alive: Connection) -> None:
    """End this worker when its parent closes the other end of a pipe, or is killed."""

    def watch() -> None:
        alive.poll(None)  # nothing is ever sent
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
