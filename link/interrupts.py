"""Ctrl-C, SIGTERM, SIGHUP and the death of a thread: the first one ends a command, at any moment."""

import contextlib
import os
import queue
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NoReturn

from link.early import INTERRUPTED, ends, tell_stack

STREAMS = (1, 2)  # file descriptors of stdout and stderr
# The environment variable with the launcher's process id: its parts end with it, however it ends.
LAUNCHER = "PLUMEWARD_LAUNCHER"
# Poll interval for the launcher; then interval and number of SIGTERMs before the part exits by force.
LOOK_S, AGAIN_S, AGAIN_TIMES = 0.2, 1.0, 30
# When a signal that could not be answered is sent again, and how long loading and compiling may delay the
# answer.
SOON_S, LOADING_S = 0.05, 1.0
# In the path of each file of numba. An exception there comes out of its C code as a SystemError.
NUMBA = f"{os.sep}numba{os.sep}"
_lost: queue.SimpleQueue[int] = queue.SimpleQueue()
_unanswered_since: float | None = None
_lost_thread = _launched = False


def on_end(handler: Callable[[int], object]) -> dict[int, Any]:
    """Call handler(number) when a signal asks this process to end; returns the handlers before."""

    def came(number: int, _frame: object) -> None:
        let_go_of_the_terminal()
        handler(number)

    return {number: signal.signal(number, came) for number in ends()}


def let_go_of_the_terminal() -> None:
    """Point stdout and stderr at nothing if their terminal has been closed: a last line there would fail."""
    if closed := [stream for stream in STREAMS if polled(stream) & select.POLLHUP]:
        discard(closed)


def polled(stream: int) -> int:
    """Return what `poll` says of a file descriptor.

    POLLHUP means a closed terminal, POLLERR a pipe whose reader has gone.
    """
    poll = select.poll()
    poll.register(stream, 0)
    return sum(events for _, events in poll.poll(0))


def discard(streams: Iterable[int]) -> None:
    """Point file descriptors at nothing."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    for stream in streams:
        os.dup2(nothing, stream)


def interrupt() -> None:
    """Let a signal raise KeyboardInterrupt in the main thread, again if Python has lost it.

    Let this process also end with its launcher, and when one of its threads dies, and tell its stack if
    it hangs.

    An exception in a handler can be lost: where Python calls it within a destructor or another callback,
    it says so to `sys.unraisablehook`; while a module is loaded or compiled, C code may swallow it or make
    another of it. The signal is then sent again.
    """
    on_end(_interrupt)
    tell_stack()
    sys.unraisablehook, sys.excepthook, threading.excepthook = (
        _ignored_exception,
        _uncaught,
        _end_without_thread,
    )
    threading.Thread(target=_send_again, name="signals", daemon=True).start()
    global _launched
    launcher = os.environ.pop(LAUNCHER, None)  # the launcher is not the parent of what this process starts
    if launcher is not None:
        _launched = True
        threading.Thread(
            target=_end_with_the_launcher, args=(int(launcher),), name="launcher", daemon=True
        ).start()


def is_launched() -> bool:
    """Whether a launcher has started this process, which ends with it."""
    return _launched


@contextlib.contextmanager
def uninterrupted() -> Iterator[list[int]]:
    """Hold the signals back: the end of the block raises KeyboardInterrupt instead.

    Yields the signals that have come.
    """
    held: list[int] = []
    before = on_end(held.append)
    try:
        yield held
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if held:
        raise KeyboardInterrupt


def leave() -> NoReturn:
    """Exit at once.

    An interrupt may strike while a session opens or closes; its threads would then keep the process for
    ever.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):  # nobody reads it, or it is closed
            stream.flush()
    os._exit(1 if _lost_thread else INTERRUPTED)


def is_ending() -> bool:
    """Whether a signal has come that could not be answered yet, or a thread has died."""
    return _unanswered_since is not None or _lost_thread


def _interrupt(number: int) -> None:
    global _unanswered_since
    now_s = time.monotonic()
    if not _would_be_lost():
        _unanswered_since = None
        raise KeyboardInterrupt
    _unanswered_since = _unanswered_since or now_s
    if now_s - _unanswered_since >= LOADING_S:
        leave()  # only a command that has not begun loads for this long: it has nothing to lose
    _lost.put(number)


def _would_be_lost() -> bool:
    """Whether the main thread is loading a module or compiling one of its functions.

    The main thread calls this, in a handler.
    """
    frame = sys._getframe()
    while frame := frame.f_back:  # type: ignore[assignment]
        file = frame.f_code.co_filename
        if file == "<frozen importlib._bootstrap>" or NUMBA in file:
            return True
    return False


def _ignored_exception(ignored: Any) -> None:
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        _lost.put(signal.SIGTERM)
    else:
        sys.__unraisablehook__(ignored)


def _uncaught(kind: type[BaseException], error: BaseException, trace: Any) -> None:
    if issubclass(kind, KeyboardInterrupt):  # one more signal, while the command is already leaving
        os._exit(INTERRUPTED)
    sys.__excepthook__(kind, error, trace)


def _end_without_thread(died: threading.ExceptHookArgs) -> None:
    """Say in one line which thread has died and why, and end this process.

    Others would wait for that thread for ever.

    It ends as by SIGTERM, so that a real vehicle is sent home and a record gets its end.
    """
    global _lost_thread
    if _lost_thread or issubclass(died.exc_type, SystemExit):
        return
    _lost_thread = True
    try:
        import traceback

        from link.terminal import printable

        place = traceback.extract_tb(died.exc_traceback)[-1]
        why = printable(f"{died.exc_type.__name__}: {died.exc_value} ({place.filename}:{place.lineno})")
        print(
            f"error: thread {died.thread.name if died.thread else ''!r} has died: {why}",
            file=sys.stderr,
            flush=True,
        )
    finally:
        threading.Thread(target=_end, name="ending", daemon=True).start()  # others may join the dead one


def _send_again() -> None:
    while True:
        number = _lost.get()
        time.sleep(SOON_S)
        os.kill(os.getpid(), number)


def _end_with_the_launcher(launcher: int) -> None:
    """End this process when the launcher that started it has gone, in whatever way it went.

    Linux could send one signal by itself (PR_SET_PDEATHSIG), but sends several at once for a launcher with
    threads.
    """
    with contextlib.suppress(AttributeError, OSError):  # only Linux can wait for a process that is no child
        select.select([os.pidfd_open(launcher)], [], [])
    while os.getppid() == launcher:
        time.sleep(LOOK_S)
    _end()


def _end() -> None:
    """Signal the main thread until this process ends.

    One signal is not enough: where it comes just before a wait begins, the wait goes on.
    """
    for _ in range(AGAIN_TIMES):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
        time.sleep(AGAIN_S)
    os._exit(1 if _lost_thread else INTERRUPTED)  # it hangs
