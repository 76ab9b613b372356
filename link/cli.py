"""Command lines: bad input gets one clear line and exit status 2; Ctrl-C and SIGTERM end a command cleanly."""

import argparse
import math
import signal
import sys
from collections.abc import Callable
from types import FrameType
from typing import NoReturn

from link.bus import DEFAULT_ROUTER, BusError

INTERRUPTED = 130
BAD_INPUT = 2
FAILED = 1


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


def add_bus_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say which bus to join."""
    parser.add_argument("-e", "--connect", metavar="ENDPOINT", default=DEFAULT_ROUTER, help="Zenoh router to join (default: %(default)s)")
    parser.add_argument("--namespace", metavar="NAME", default="uav/1", help="the vehicle's key prefix (default: %(default)s)")


def add_filter_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the particle filter and its stop."""
    parser.add_argument("--particles", type=whole(10, 1_000_000), default=1000, metavar="N", help="particles (default: %(default)s)")
    parser.add_argument(
        "--threshold",
        type=number(0, 100, above=True),
        default=0.5,
        metavar="M",
        help="stop when the spread is below it (default: %(default)s m)",
    )
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


def _terminate(_signal: int, _frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def run(command: Callable[[], int | None]) -> NoReturn:
    """Run a command and exit with its status: 0 done, 1 failed, 2 bad input, 130 interrupted."""
    # A shell starts background jobs with SIGINT ignored; a service must end on it all the same.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, _terminate)
    try:
        status = command() or 0
    except KeyboardInterrupt:
        status = INTERRUPTED
    except BusError as error:
        print(f"error: {error}", file=sys.stderr)
        status = BAD_INPUT
    sys.exit(status)
