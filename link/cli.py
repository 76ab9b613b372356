"""Command lines: bad input gets one clear line and exit status 2; Ctrl-C and SIGTERM end a command cleanly."""

import argparse
import contextlib
import ctypes
import errno
import gc
import math
import os
import select
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from link.bus.log import LEVELS
from link.bus.session import DEFAULT_ROUTER, BusError

INTERRUPTED = 130
UNREAD = 141
"""What a shell shows for a program that SIGPIPE has killed: of `plumeward evaluate | head -1`, as of `cat FILE | head -1`."""
STREAMS = (1, 2)
"""File descriptors of stdout and stderr."""
BAD_INPUT = 2
FAILED = 1
LAUNCHER = "PLUMEWARD_LAUNCHER"
"""The environment variable by which a launcher tells its parts its process id: they end with it, however it ends."""
PR_SET_PDEATHSIG = 1


class Parser(argparse.ArgumentParser):
    """An argparse parser that answers bad input with one line."""

    def error(self, message: str) -> NoReturn:
        """Name what was wrong; usage is what --help is for."""
        self.exit(BAD_INPUT, f"{self.prog}: error: {message.removeprefix('argument ')}\n")


def whole(low: int, high: int) -> Callable[[str], int]:
    """Argument type: a whole number from low to high."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted a whole number from {low} to {high}")
        return value

    return parse


def number(low: float, high: float, *, above: bool = False) -> Callable[[str], float]:
    """Argument type: a number from low (or above low) to high."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high or (above and value == low):
            raise argparse.ArgumentTypeError(
                f"{text!r} is not allowed; wanted a number {'above' if above else 'from'} {low:g} up to {high:g}"
            )
        return value

    return parse


def listed(parse: Callable[[str], Any]) -> Callable[[str], list[Any]]:
    """Argument type: several between commas, each once."""
    return lambda text: list(dict.fromkeys(parse(item) for item in text.split(",")))


def add_bus_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say which bus to join."""
    parser.add_argument("-e", "--connect", metavar="ENDPOINT", default=DEFAULT_ROUTER, help="Zenoh router to join (default: %(default)s)")
    parser.add_argument("--namespace", metavar="NAME", default="uav/1", help="the vehicle's key prefix (default: %(default)s)")
    add_log_argument(parser)


def add_log_argument(parser: argparse.ArgumentParser, default: str = "info") -> None:
    """Add the flag that says how much is logged."""
    parser.add_argument(
        "--log-level", choices=LEVELS, default=default, help="the least that is logged; debug is a line a step (default: %(default)s)"
    )


def add_filter_arguments(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Add the flags of the particle filter and its stop; with `several` the first two take lists."""
    count, threshold = whole(10, 1_000_000), number(0, 100, above=True)
    more = ", or several with commas between" if several else ""
    parser.add_argument(
        "--particles", type=listed(count) if several else count, default="1000", metavar="N", help=f"particles{more} (default: %(default)s)"
    )
    parser.add_argument(
        "--threshold", type=listed(threshold) if several else threshold, default="0.5", metavar="M",
        help=f"stop when the spread is below it{more} (default: %(default)s m)",
    )  # fmt: skip
    parser.add_argument(
        "--prior",
        action="append",
        default=[],
        metavar="NAME=KIND:NUMBERS",
        help="what else is unknown, or known better, of x y z q u phi d tau: q=gamma:2,150 u=normal:2.5,0.5 tau=uniform:5,15 z=fixed:1.5",
    )
    parser.add_argument(
        "--stop-on", default="location", metavar="WHAT",
        help="what a stop wants to know: location (the threshold), or standard deviations too: location,q=50 (default: %(default)s)",
    )  # fmt: skip


def add_reach_arguments(parser: argparse.ArgumentParser, budget: int) -> None:
    """Add the flags that say how often and how a planner may move, and how much it imagines."""
    parser.add_argument(
        "--budget", type=whole(1, 1_000_000), default=budget, metavar="STEPS", help="moves before giving up (default: %(default)s)"
    )
    parser.add_argument("--headings", type=int, choices=(4, 8), help="directions that a planner chooses from (default: the planner's own)")
    parser.add_argument("--step", type=number(0, 10, above=True), metavar="M", help="length of a move (default: 1 m)")
    parser.add_argument(
        "--measurements", type=whole(1, 10_000), metavar="K", help="hypothetical readings for each move (default: the planner's own)"
    )


def reach_given(args: argparse.Namespace) -> dict[str, float]:
    """Of the flags of `add_reach_arguments`, those that were given: by the flag's name."""
    given = {"headings": args.headings, "step": args.step, "measurements": args.measurements}
    return {name: value for name, value in given.items() if value is not None}


def checked(parse: Callable[[str], object]) -> Callable[[str], str]:
    """Argument type: text that `parse` accepts; its ValueError says what is allowed."""

    def check(text: str) -> str:
        try:
            parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
        return text

    return check


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say what a mission prints."""
    parser.add_argument("--json", action="store_true", help="print the outcome as one JSON object on the last line of stdout")
    parser.add_argument("--trace", action="store_true", help="with --json: add every step's position, reading, mean and spread")


def add_output_guard(parser: argparse.ArgumentParser) -> None:
    """Add the flag without which no file that exists is written over."""
    parser.add_argument("--force", action="store_true", help="overwrite files that exist")


def existing(flag: str, paths: Iterable[Path], force: bool) -> str | None:
    """Return the refusal, in one line, to overwrite the first of these that exists; None where there is none, or with `force`."""
    there = next((path for path in paths if not force and os.path.lexists(path)), None)
    return None if there is None else f"{flag}: {str(there)!r} exists; wanted another name, or --force"


def _terminate(_signal: int, _frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C and SIGTERM back, so that a child that has been started is also known to have been."""
    held: list[int] = []
    before = {number: signal.signal(number, lambda number, _: held.append(number)) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if held:
        raise KeyboardInterrupt


def _end_with_the_launcher() -> None:
    """Have Linux end a process that a launcher has started when that dies, however it dies."""
    launcher = os.environ.pop(LAUNCHER, None)  # what this process starts is not the launcher's child
    if launcher is None or sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if str(os.getppid()) != launcher:  # it died before it could be said
        sys.exit(INTERRUPTED)


def run(command: Callable[[], int | None]) -> NoReturn:
    """Run a command and exit with its status: 0 done, 1 failed, 2 bad input, 130 interrupted, 141 where nobody reads its output."""
    # A shell starts background jobs with SIGINT ignored; a service must end on it all the same.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, _terminate)
    _end_with_the_launcher()
    gc.set_threshold(100_000)  # Python's own 700 costs a tenth of the start-up time
    try:
        try:
            status = command() or 0
        except SystemExit as end:  # of --help, whose output has to be flushed too; of bad input; of rich on a closed pipe
            status = end.code if isinstance(end.code, int) else FAILED if end.code else 0
            if status == FAILED and any(map(_unread, STREAMS)):
                raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE)) from None
        if sys.stdout:  # None where the caller closed it
            sys.stdout.flush()
    except KeyboardInterrupt:
        status = INTERRUPTED
    except BusError as error:
        print(f"error: {error}", file=sys.stderr)
        status = BAD_INPUT
    except OSError as error:
        status = _lost_output(error)
    gc.freeze()  # skips a last look through all objects
    sys.exit(status)


def _lost_output(error: OSError) -> int:
    """Return the status of a command whose output cannot be written. Raises any other error again."""
    unread = error.errno == errno.EPIPE and any(map(_unread, STREAMS))
    if not unread and error.errno != errno.ENOSPC:
        raise error
    if not unread:
        print(f"error: {error.strerror}", file=sys.stderr)
    _discard_output()
    return UNREAD if unread else FAILED


def _unread(stream: int) -> bool:
    """Whether a file descriptor is a pipe whose reader has gone."""
    poll = select.poll()
    poll.register(stream, 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))


def _discard_output() -> None:
    """Point stdout and stderr at nothing, or Python would complain that it cannot flush them at exit."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    for stream in STREAMS:
        os.dup2(nothing, stream)
