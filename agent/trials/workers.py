"""Worker processes: results come back as tasks end.

A killed worker raises an error, and no worker outlives its parent.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from itertools import islice
from multiprocessing import active_children, get_context, resource_tracker
from multiprocessing.connection import Connection
from typing import TypeVar

from link.interrupts import uninterrupted

# Set to one thread per worker: competing thread pools slow each other down.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
HANDED_OUT = 4  # tasks handed out per worker: enough to keep it busy, without holding ten million in memory

Task = TypeVar("Task")
Result = TypeVar("Result")


class WorkerLost(BrokenExecutor):
    """A worker process was killed."""


def as_flown(
    function: Callable[[Task], Result], tasks: Iterable[Task], workers: int
) -> Generator[tuple[Task, Result], None, None]:
    """Yield (task, function(task)) as tasks end, computed by at most `workers` processes.

    Raises what a task raises, and WorkerLost if a worker was killed, after yielding all results that were
    there by then.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")
    _start_tracker()
    context, left = get_context("spawn"), iter(tasks)
    running: dict[Future[Result], Task] = {}
    alive, kept_open = context.Pipe(duplex=False)
    others = set(active_children())
    with alive, kept_open, ProcessPoolExecutor(workers, context, _begin, (alive,)) as pool:
        try:
            while True:
                for task in islice(left, HANDED_OUT * workers - len(running)):
                    running[_submit(pool, function, task)] = task
                if not running:
                    return
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in sorted(
                    done, key=lambda it: it.exception() is not None
                ):  # results first, then the error
                    yield running.pop(future), future.result()
        except BaseException as error:
            for worker in (
                set(active_children()) - others
            ):  # at once: closing the pool would wait for their tasks
                worker.kill()
            if isinstance(error, BrokenExecutor):
                raise WorkerLost("a worker process was killed; the memory may have run out") from error
            raise


def _start_tracker() -> None:
    """Start the process that looks after what workers share.

    One that a closed terminal ends before this process leaves its successor to tell tracebacks.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
    try:
        resource_tracker.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _submit(pool: ProcessPoolExecutor, function: Callable[[Task], Result], task: Task) -> Future[Result]:
    # This may start a worker. An interrupt waits until the start is complete, so that the worker is known and
    # can be ended.
    # The worker inherits the signal mask: a terminal sends its signals to workers too, but only this process
    # answers it.
    with uninterrupted():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
        try:
            return pool.submit(function, task)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(alive: Connection) -> None:
    """Begin this worker: it ends when its parent closes the other end of the pipe or dies.

    What a plug-in prints in it goes to stderr, as stdout is for the figures.
    """
    sys.stdout = sys.stderr

    def watch() -> None:
        try:
            alive.poll(None)  # nothing is ever sent
        finally:
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
