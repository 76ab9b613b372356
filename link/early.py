"""The first thing that a command loads: until it is under way, a signal ends it at once and without a word."""

import _signal as signal  # type: ignore[import-not-found]  # `signal` loads more: until it has, a signal would print a traceback
import os

INTERRUPTED = 130
"""Exit status of a command that was interrupted."""


def end_at_once() -> None:
    """Let a signal end this process: while it only loads modules, and when it has nothing left to do."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_: os._exit(INTERRUPTED))
