"""Command lines: bad input gets one clear line and exit status 2; statuses say how a command has ended."""

import argparse
import contextlib
import errno
import gc
import io
import os
import re
import resource
import select
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeVar

from link.early import INTERRUPTED, end_at_once
from link.interrupts import STREAMS, discard, interrupt, is_ending, leave, polled

# Exit status if the reader of stdout has gone, as in `plumeward evaluate | head -1`: that of a program
# killed by SIGPIPE.
UNREAD = 141
BAD_INPUT = 2
FAILED = 1
# Names of what an estimator may take to be known; `estimator.assumptions` has what they mean.
LEAVE_OUT = "leave-out"  # with --doubted: a vehicle whose sensor seems to lie leaves the search
ASSUMPTIONS = ("field", "paper")
T = TypeVar("T")
MOST_VEHICLES = 8  # that search together; a test holds it equal to that of `plume.problems.fleet`
# What the flags of a filter and of planners may be, and the same arguments of functions.
PARTICLES = (10, 1_000_000)
FARTHEST_OUT_M = 100_000  # of --margin
HEADINGS = (4, 8)
MOST_MEASUREMENTS = 10_000
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # no space: of the disk, of the user, of a file
COMPLETING = "_ARGCOMPLETE"  # the environment variable by which a shell asks for completions


class BadInput(ValueError):
    """Input that a command refuses; the text is one line."""


class Command(NamedTuple):
    """A command, by the name of its module: a part starts fast, because only its own command is imported."""

    module: str  # has `add_arguments(parser)` and `run(args)`, which returns the exit status
    does: str


class Parser(argparse.ArgumentParser):
    """An argparse parser that answers bad input with one line, with the nearest name if one is near.

    A word such as -35.3,149.1 is a value, as -35.3 alone is.
    """

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self._negative_number_matcher = re.compile(r"-\.?[0-9]")

    def error(self, message: str) -> NoReturn:
        """Say what is wrong in one line and exit with status 2."""
        self.exit(BAD_INPUT, f"{self.prog}: error: {message.removeprefix('argument ')}\n")

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        """Parse a command line. If a shell asks for completions, print them and exit."""
        if COMPLETING in os.environ:
            import argcomplete

            argcomplete.autocomplete(self)
        return super().parse_args(args, namespace)

    def parse_given(self, words: Sequence[str]) -> argparse.Namespace:
        """Parse a command line without commands; `given` has the arguments that stand on it, by name.

        argparse leaves alone what a namespace has already: the defaults, which are values and no text that
        has yet to be parsed, are put in afterwards.
        """
        usual = {each.dest: each.default for each in self._actions if each.default != argparse.SUPPRESS}
        parsed = vars(self.parse_args(words, argparse.Namespace(**dict.fromkeys(usual))))
        given = {name: parsed[name] for name in usual if parsed[name] is not None}
        return argparse.Namespace(**{**parsed, **usual, **given, "given": given})

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse a command line, and refuse every word that no argument takes."""
        words = sys.argv[1:] if args is None else list(args)
        if COMPLETING not in os.environ:
            self._refuse_unknown_flags(words)
        parsed, unknown = super().parse_known_args(words, namespace)
        if unknown and COMPLETING not in os.environ:
            self.error(f"{unknown[0]!r} is not expected here")
        return parsed, unknown

    def _refuse_unknown_flags(self, words: Iterable[str]) -> None:
        """Refuse a wrong flag before its value is taken for something else.

        Words behind a command are the command's.
        """
        flags = self._option_string_actions
        subparsers = (each for each in self._actions if isinstance(each, argparse._SubParsersAction))
        commands = next((each.choices for each in subparsers), ())
        for word in words:
            if word == "--" or word in commands:
                return
            flag = word.partition("=")[0]
            if flag.startswith("--") and not any(known.startswith(flag) for known in flags):
                self.error(
                    f"no flag {flag!r}{did_you_mean(flag, flags) or f'; {self.prog} --help lists them'}"
                )

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        names = [str(choice) for choice in action.choices]
        if isinstance(action, argparse._SubParsersAction):
            raise argparse.ArgumentError(
                None, f"no command {value!r}{did_you_mean(value, names) or f'; wanted {listing(names)}'}"
            )
        raise argparse.ArgumentError(action, not_allowed(value, names, listing(names)))


def front(parser: argparse.ArgumentParser, commands: Mapping[str, str]) -> argparse.ArgumentParser:
    """Let a parser know commands by their names and what they do: it lists, completes and suggests them."""
    known = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)
    for name, does in commands.items():
        known.add_parser(name, help=does, add_help=False)
    return parser


def start(prog: str, command: Command, words: Sequence[str]) -> int:
    """Run a command with its words; bad input is one line."""
    module, parser = import_module(command.module), Parser(prog=prog)
    module.add_arguments(parser)
    try:
        return int(module.run(parser.parse_given(words)))
    except BadInput as error:
        return failed(error, BAD_INPUT)


def failed(why: object, status: int = FAILED) -> int:
    """Say in one line on stderr why a command has failed; return its exit status."""
    print(f"error: {why}", file=sys.stderr)
    return status


def listing(names: Sequence[str]) -> str:
    """Write a choice of names in words: fly, log or status."""
    return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'fly'?" with the known name nearest to a wrong one; empty if none is near."""
    import difflib

    near = difflib.get_close_matches(name, list(known), 1, cutoff=0.51)
    return f"; did you mean {near[0]!r}?" if near else ""


def not_allowed(value: object, known: Iterable[str], wanted: str) -> str:
    """Say that a value is not allowed, which name is nearest to it, and what is wanted."""
    near = did_you_mean(str(value), known)
    return f"{value!r} is not allowed{f'{near} Wanted' if near else '; wanted'} {wanted}"


def completed(action: argparse.Action, names: Callable[[], Iterable[str]], *endings: str) -> None:
    """Let a shell complete an argument by names and by files with these endings.

    In a list with commas it completes the last item.
    """

    def complete(prefix: str, **_: Any) -> list[str]:
        from argcomplete.completers import FilesCompleter

        before, comma, last = prefix.rpartition(",")
        files = FilesCompleter(endings)(last) if endings else []
        return [f"{before}{comma}{name}" for name in (*names(), *files) if name.startswith(last)]

    action.completer = complete  # type: ignore[attr-defined]


def whole(low: int, high: int) -> Callable[[str], int]:
    """Argument type: a whole number from low to high."""
    return _accepted(int, lambda value: low <= value <= high, f"a whole number from {low} to {high}")


def number(low: float, high: float, *, above: bool = False) -> Callable[[str], float]:
    """Argument type: a number from low (or above low) to high."""
    return _accepted(
        float,
        lambda value: low <= value <= high and not (above and value == low),
        f"a number {'above' if above else 'from'} {low:g} up to {high:g}",
    )


def _accepted(kind: Callable[[str], T], accepts: Callable[[T], bool], wanted: str) -> Callable[[str], T]:
    def parse(text: str) -> T:
        with contextlib.suppress(ValueError):
            if accepts(value := kind(text)):
                return value
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted {wanted}")

    return parse


def path(text: str) -> Path:
    """Argument type: a file or a folder. An empty text, as of a variable that is not set, is not one."""
    if not text:
        raise argparse.ArgumentTypeError("'' is not allowed; wanted a path")
    return Path(text)


def file_ending(*endings: str) -> Callable[[str], Path]:
    """Argument type: a file with one of these endings."""
    return _accepted(Path, lambda path: path.suffix in endings, f"a file that ends in {listing(endings)}")


def listed(
    parse: Callable[[str], Any], separate: Callable[[str], Sequence[str]] = lambda text: text.split(",")
) -> Callable[[str], list[Any]]:
    """Argument type: several between commas, each once. separate: what splits the list."""
    return lambda text: list(dict.fromkeys(parse(item) for item in separate(text)))


def add_bus_arguments(parser: argparse.ArgumentParser, namespace: str | None = "uav/1") -> None:
    """Add the flags that choose the bus to join; namespace: the default, None: every vehicle's."""
    from link.bus.opening import DEFAULT_ROUTER  # loads Zenoh

    parser.add_argument(
        "-e",
        "--connect",
        metavar="ENDPOINT",
        default=DEFAULT_ROUTER,
        help="the Zenoh router to join (default: %(default)s)",
    )
    parser.add_argument(
        "--namespace",
        metavar="NAME",
        default=namespace,
        help=f"the vehicle's key prefix (default: {namespace or 'every vehicle on the router'})",
    )
    add_secure_argument(parser)
    add_log_argument(parser)


def add_vehicles_argument(parser: argparse.ArgumentParser) -> None:
    """Add the flag that says how many vehicles search together.

    The usual namespace follows from it, see `namespace_of`.
    """
    parser.set_defaults(namespace=None)
    parser.add_argument(
        "--vehicles",
        type=whole(1, MOST_VEHICLES),
        default=1,
        metavar="N",
        help="how many vehicles search together; the namespace is then their search's, search/1 (default: "
        "%(default)s)",
    )


def namespace_of(args: argparse.Namespace, together: bool) -> str:
    """Return the namespace that was given, else the first of searches by several, or of single vehicles."""
    return args.namespace or ("search/1" if together else "uav/1")


def numbers(vehicles: int) -> range:
    """Return the numbers by which each vehicle of a search has keys of its own; none of one that is alone."""
    return range(1, vehicles + 1) if vehicles > 1 else range(0)


def add_secure_argument(parser: argparse.ArgumentParser) -> None:
    """Add the flag that secures the bus."""
    parser.add_argument(
        "--secure",
        type=path,
        metavar="DIR",
        help="mutual TLS, with the certificates that `plumeward certs DIR` made; tcp/ then means tls/",
    )


def add_log_argument(parser: argparse.ArgumentParser, default: str = "info") -> None:
    """Add the flag that chooses how much is logged."""
    from link.bus.log import LEVELS

    parser.add_argument(
        "--log-level",
        choices=LEVELS,
        default=default,
        help="the lowest level that is logged; debug logs every step (default: %(default)s)",
    )


def add_filter_arguments(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Add the flags of the particle filter and its stop; with `several` the first two take lists."""
    count, threshold = whole(*PARTICLES), number(0, 100, above=True)
    more = "; several between commas" if several else ""
    parser.add_argument(
        "--particles",
        type=listed(count) if several else count,
        default=[1000] if several else 1000,
        metavar="N",
        help=f"particles of the filter{more} (default: 1000)",
    )
    parser.add_argument(
        "--assume",
        choices=ASSUMPTIONS,
        default="field",
        help="what the estimator takes to be known. paper: all but the position x, y; field: wind, release "
        "rate, lifetime, noise and "
        "intermittency only roughly (default: %(default)s)",
    )
    stop = parser.add_mutually_exclusive_group()
    stop.add_argument(
        "--threshold",
        type=listed(threshold) if several else threshold,
        metavar="M",
        help=f"stop when the spread of the belief is below M metres, the short form of --stop spread:M{more} "
        "(default: the problem's, 0.5)",
    )
    add_stop_argument(stop, several=several)
    parser.add_argument(
        "--prior",
        action="append",
        default=[],
        metavar="NAME=KIND:NUMBERS",
        help="prior of one of x y z q u phi d tau wind-direction wind-speed gain noise cv puff-rate "
        "puff-share, instead of the assumption's, such as "
        "q=gamma:2,150 u=normal:2.5,0.5 tau=uniform:5,15 z=fixed:1.5; may be repeated",
    )
    parser.add_argument(
        "--margin",
        type=number(0, FARTHEST_OUT_M),
        metavar="M",
        help="how far beyond the edges of the area the source may be, m; there it is less likely (default: a "
        "third of the area's side under field, else 0)",
    )
    parser.add_argument(
        "--stop-on",
        default="location",
        metavar="WHAT",
        help="what must be known to stop: location (--stop), or also standard deviations, as in "
        "location,q=50 (default: %(default)s)",
    )


def add_doubted_argument(parser: argparse.ArgumentParser) -> None:
    """Add the flag that chooses what happens to a vehicle whose sensor seems to lie."""
    parser.add_argument(
        "--doubted",
        choices=("name", LEAVE_OUT),
        default="name",
        help="of several vehicles, name one whose sensor seems to lie, or also leave it out of the search "
        "(default: %(default)s)",
    )


def add_stop_argument(parser: argparse._ActionsContainer, *, several: bool = False) -> None:
    """Add the flag that chooses the stop criterion, or with `several` a list of them; None without it."""
    parser.add_argument(
        "--stop",
        metavar="CRITERION",
        action="append" if several else "store",
        help="spread:Z stops when the spread of the belief is below Z metres, within:R,P when at least the "
        "share P of the belief is within "
        f"R metres of the estimate, as in within:1,0.99{'; may be repeated' if several else ''} (default: "
        "the problem's, spread:0.5)",
    )


def add_reach_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags that set how often and how a planner may move, and how many readings it samples."""
    parser.add_argument(
        "--budget",
        type=whole(1, 1_000_000),
        metavar="STEPS",
        help="give up after this many moves (default: the problem's, 300)",
    )
    parser.add_argument(
        "--headings",
        type=int,
        choices=HEADINGS,
        help="directions that the planner chooses from (default: the planner's own)",
    )
    parser.add_argument(
        "--step",
        type=number(0, 10_000, above=True),
        metavar="M",
        help="length of a move, at most a third of the area's shorter side, m (default: the problem's, 1)",
    )
    parser.add_argument(
        "--measurements",
        type=whole(1, MOST_MEASUREMENTS),
        metavar="K",
        help="hypothetical readings for each move (default: the planner's own)",
    )


def reach_given(args: argparse.Namespace) -> dict[str, float]:
    """Return the flags of `add_reach_arguments` that were given, by their names."""
    names = ("headings", "step", "measurements")
    return {name: value for name in names if (value := getattr(args, name)) is not None}


def checked(parse: Callable[[str], object], known: Collection[str] = ()) -> Callable[[str], str]:
    """Argument type: text that `parse` accepts; its ValueError says what is allowed.

    A name before a colon may be near a known one.
    """

    def check(text: str) -> str:
        try:
            parse(text)
        except ValueError as error:
            name, said = text.partition(":")[0], str(error)
            near = "" if name in known else did_you_mean(name, known)
            raise argparse.ArgumentTypeError(
                said.replace("; wanted", f"{near} Wanted", 1) if near else said
            ) from None
        return text

    return check


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags that choose what a mission prints."""
    parser.add_argument("--json", action="store_true", help="print the outcome as one JSON object on stdout")
    parser.add_argument(
        "--trace",
        action="store_true",
        help="with --json: add the position, reading, mean and spread of every step",
    )


def add_output_guard(parser: argparse.ArgumentParser) -> None:
    """Add the flag that allows overwriting files."""
    parser.add_argument("--force", action="store_true", help="overwrite files that exist")


def existing(flag: str, paths: Iterable[Path], force: bool) -> str | None:
    """Return one line that refuses to overwrite the first of these files that exists.

    None if none exists, or with `force`.
    """
    there = next((path for path in paths if not force and os.path.lexists(path)), None)
    return None if there is None else f"{flag}: {str(there)!r} exists; wanted another name, or --force"


def unwritable(flag: str, paths: Iterable[Path], force: bool) -> str | None:
    """Return one line that refuses to write the first of these files that exists or cannot be written.

    None if all can be. A pipe or a device has no content to protect.
    """
    from link.files import obstacle

    for path in paths:
        if reason := existing(flag, filter(os.path.isfile, [path]), force):
            return reason
        if reason := obstacle(path):
            return f"{flag}: {str(path)!r} {reason}"
    return None


def make_folder(flag: str, folder: Path, names: Iterable[str], force: bool) -> None:
    """Make a folder for files of these names; BadInput if they cannot be written, or would replace others."""
    if folder.exists() and not folder.is_dir():
        raise BadInput(f"{flag}: {str(folder)!r} is not a folder")
    paths = [folder / name for name in names]
    if reason := existing(flag, paths, force):
        raise BadInput(reason)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"{flag}: {str(folder)!r} cannot be made: {error.strerror}") from None
    if reason := unwritable(flag, paths, force=True):
        raise BadInput(reason)


def run(command: Callable[[], int | None]) -> NoReturn:
    """Run a command and exit with its status.

    0 done, 1 failed, 2 bad input, 130 interrupted, 141 if the reader of its output has gone.
    """
    gc.set_threshold(100_000)  # Python's own 700 costs a tenth of the start-up time
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # None where the caller closed it
            # Where ASCII alone is printed, and for names of files that are not text.
            stream.reconfigure(errors="backslashreplace")
    try:
        interrupt()
        status = _status(command)
        if status == INTERRUPTED or is_ending():
            leave()
        end_at_once()
    except KeyboardInterrupt:  # a second signal: `timeout` sends two
        leave()
    gc.freeze()  # skips a last look through all objects
    sys.exit(status)


def _status(command: Callable[[], int | None]) -> int:
    try:
        try:
            status = command() or 0
        except SystemExit as end:  # of --help, whose output must be flushed; bad input; rich on a closed pipe
            status = end.code if isinstance(end.code, int) else FAILED if end.code else 0
            if status == FAILED and any(map(_unread, STREAMS)):
                raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE)) from None
        if sys.stdout:  # None where the caller closed it
            sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        return INTERRUPTED
    except _refusals() as error:
        return failed(error, BAD_INPUT)
    except OSError as error:
        if error.errno == errno.EMFILE:
            most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
            return failed(
                f"{error.strerror}: wanted more than the {most} that may be open at a time (set it "
                "with: ulimit -n 1024)"
            )
        return _lost_output(error)


def _refusals() -> tuple[type[Exception], ...]:
    """Return the errors that are told in one line.

    Their modules take long to load: one that has not been loaded has raised none.
    """
    names = {"link.access.identity": "AccessError", "link.bus.opening": "BusError"}
    return tuple(
        getattr(sys.modules[module], name)
        for module, name in names.items()
        if hasattr(sys.modules.get(module), name)
    )


def _lost_output(error: OSError) -> int:
    """Return the status of a command whose output cannot be written. Raises any other error again."""
    unread = error.errno in (errno.EPIPE, errno.EIO) and any(map(_unread, STREAMS))
    if not unread and error.errno not in FULL:
        raise error
    if not unread:
        print(f"error: {error.strerror}", file=sys.stderr)
    discard(STREAMS)  # or Python would complain that it cannot flush them at exit
    return UNREAD if unread else FAILED


def _unread(stream: int) -> bool:
    """Whether a file descriptor is a pipe whose reader has gone, or a terminal that has been closed."""
    return bool(polled(stream) & select.POLLERR)
