"""The first thing that a command loads: until it is under way, a signal ends it at once, silently."""

import _signal as signal  # type: ignore[import-not-found]  # `signal` loads more: until it has, a signal would print a traceback
import contextlib
import faulthandler
import os

INTERRUPTED = 130  # exit status of a command that was interrupted
# On this signal a process writes the stack of its main thread to stderr, even if it hangs. To walk those of
# other threads while they run can end it (SIGSEGV). A stopped process does so when it continues.
STACK = signal.SIGUSR1


def ends() -> list[int]:
    """Return the signals that end this process.

    SIGHUP, which says that its terminal is closed, is not one if `nohup` has it ignored.
    """
    # A shell starts background jobs with SIGINT ignored; a service must end on it all the same.
    hangup = [] if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else [signal.SIGHUP]
    return [signal.SIGINT, signal.SIGTERM, *hangup]


def end_at_once() -> None:
    """Let a signal end this process: while it only loads modules, and when it has nothing left to do."""
    for number in ends():
        signal.signal(number, lambda *_: os._exit(INTERRUPTED))


def begin() -> None:
    """Begin a command of ours, before it loads anything."""
    end_at_once()
    # Else NumPy's BLAS starts a thread for each core, in every part of a mission, and none has work for it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def tell_stack() -> None:
    """Let this process write its stack on `STACK`, whatever it does then."""
    faulthandler.register(STACK, file=2, all_threads=False, chain=False)


def ask_for_stack(pid: int) -> None:
    """Ask a process for its stack, if it is one that tells it: the signal would end any other."""
    import ctypes  # Python itself can only signal a process: any thread may take it

    lacking = OSError, StopIteration, AttributeError  # not Linux, or not its usual C library
    with contextlib.suppress(*lacking), open(f"/proc/{pid}/status") as status:
        caught = int(next(line for line in status if line.startswith("SigCgt:")).split()[1], 16)
        if caught >> STACK - 1 & 1:
            ctypes.CDLL(None).tgkill(pid, pid, STACK)
