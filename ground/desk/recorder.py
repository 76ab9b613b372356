"""`plumeward record`: records all messages on a bus."""

import argparse
import functools
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from ground.desk.scenes import RecordedScene
from link import cli
from link.bus.keys import KEYS, OF_VEHICLE, STOP
from link.bus.opening import CONNECT_TIMEOUT_S
from link.bus.session import Arrival
from link.interrupts import on_end
from link.record.record import Entry, SimulationClock
from link.record.tap import Tap
from link.record.writer import Writer
from plume import __version__
from scene.foxglove import schema_of

# Interval of batches of messages, s: waking up for each message would cost more than writing it.
BATCH_S = 0.2
FLUSH_S = 0.35  # interval of flushes, s, every second batch: a killed recorder loses 0.4 s
SIGNAL_POLL_S = 0.05
LOOK_S = 5.0  # how often it is looked for vehicles that are not recorded
LAST_WORDS_S = 0.5  # longest wait at the end for messages still in transit, s
LEFT_S = 2.0  # interval at which it says, once told to end, how much is left to write, s
# Zenoh's threads, read by the first session of a process: by default each message passes through four thread
# pools. Sending keeps its own thread: a receiver may wait for something to be sent first, which would block
# the router and with it the mission.
FEW_THREADS = (
    "(rx: (handover: net), acc: (handover: net), app: (handover: net), net: (worker_threads: 1), "
    "tx: (worker_threads: 1))"
)
# The flight has priority over its record. With 19 it would cost no less, and beside other work the record
# would lose its end.
NICENESS = 5
PACKAGES = ("eclipse-zenoh", "numpy", "pymavlink", "numba", "mcap")
ROOT = Path(__file__).parents[2]


def _file(text: str) -> Path:
    if not text.endswith(".mcap"):
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted a name that ends in .mcap")
    return Path(text)


def _about(text: str) -> dict[str, Any]:
    try:
        return msgspec.json.decode(text, type=dict[str, Any])
    except msgspec.DecodeError:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted a JSON object") from None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.add_argument(
        "file",
        type=_file,
        metavar="FILE.mcap",
        help="the record to write; a .tlog of all MAVLink is written beside it",
    )
    cli.add_output_guard(parser)
    cli.add_bus_arguments(parser)
    cli.add_vehicles_argument(parser)
    parser.add_argument(
        "--about",
        type=_about,
        default={},
        metavar="JSON",
        help="a description of the run, stored in the record",
    )


def run(args: argparse.Namespace) -> int:
    """Record until interrupted; a line on stdout says when it has begun. Raises BadInput."""
    os.environ.setdefault("ZENOH_RUNTIME", FEW_THREADS)
    if reason := cli.existing("FILE.mcap", _files(args.file), args.force):
        raise cli.BadInput(reason)
    fleet = {"fleet": {"vehicles": args.vehicles}} if args.vehicles > 1 else {}
    namespace = cli.namespace_of(args, args.vehicles > 1)
    with Tap(
        "recorder",
        args.connect,
        namespace,
        args.log_level,
        secure=args.secure,
        vehicles=cli.numbers(args.vehicles),
    ) as bus:
        ends: list[int] = []
        on_end(ends.append)  # no KeyboardInterrupt, which could strike within a message or leave half a file
        try:
            about = {**fleet, **args.about, **surroundings(namespace)}
            writer = begin(args.file, args.force, about)
        except OSError as error:
            culprit = "" if error.filename in (None, str(args.file)) else f": {error.filename}"
            cannot = f"FILE.mcap: cannot write {str(args.file)!r}: {error.strerror}{culprit}"
            reason = cli.existing("FILE.mcap", _files(args.file), args.force)
            raise cli.BadInput(reason or cannot) from None
        bus.subscribe(*KEYS)
        bus.settle(CONNECT_TIMEOUT_S)
        numbers = cli.numbers(args.vehicles)
        told = tell_missed(bus, {f"{OF_VEHICLE}{number}" for number in numbers})
        bus.tally.state = "recording"
        bus.publish_health()
        print(f"recording to {args.file}", flush=True)
        _give_way()
        try:
            record(bus, writer, ends, RecordedScene(args.about, namespace, numbers), told)
        except OSError as error:
            words = f"record stopped: {error.strerror} ({args.file})"
            bus.log.warning(words)
            bus.tally.state, bus.tally.warnings = "stopped", (words,)
            bus.publish_health()
            return cli.FAILED
    return 0


def _files(path: Path) -> tuple[Path, Path]:
    return path, path.with_suffix(".tlog")


def begin(path: Path, force: bool, about: dict[str, Any]) -> Writer:
    """Create the files. Raises OSError, and leaves none, if that fails or if one exists without `force`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    made: list[Path] = []
    try:
        for file in _files(path) if not force else ():
            file.open("xb").close()  # exclusive: of two recorders that start at once, one is refused
            made.append(file)
        return Writer(path, about)
    except OSError:
        for file in made:
            file.unlink(missing_ok=True)
        raise


def tell_missed(bus: Tap, known: set[str]) -> set[str]:
    """Tell which vehicles are there and neither recorded nor told of; returns all that now are."""
    missed = [part for part in bus.fleet() if part not in known]
    if missed:
        bus.log.warning(f"not recorded: {', '.join(missed)}; --vehicles says how many there are")
    return known | {*missed}


def record(bus: Tap, writer: Writer, ends: list[int], scene: RecordedScene, vehicles: set[str]) -> None:
    """Write what comes, in batches, until there is an end. Raises OSError if it cannot be written.

    vehicles: of a search of several, those that are recorded or told of.
    """
    clock = SimulationClock()
    flush_at, look_at = 0.0, time.monotonic() + LOOK_S
    ended = False
    while not ended:
        until = time.monotonic() + BATCH_S
        while not ends and (left_s := until - time.monotonic()) > 0.0:
            time.sleep(min(left_s, SIGNAL_POLL_S))
        ended = bool(ends)  # read first, so that the messages from before the end are still written
        if ended:
            bus.settle(LAST_WORDS_S)
        messages = bus.take()
        for message in _one_by_one(messages, ends, bus.log.info):
            if message.key is STOP:
                bus.take_stop(message)
            simulation_s = clock.time_s(message.name, message.payload, message.published_ns)
            entry = Entry(
                message.name, message.published_ns, simulation_s, message.payload, message.attachment
            )
            writer.write(entry, message.received_ns)
            for topic, kind, data in scene.take(entry, message.received_ns):
                writer.write_for_viewers(topic, functools.partial(schema_of, kind), data, message.received_ns)
        if scene.failure and not bus.tally.warnings:
            bus.log.warning(scene.failure)
            bus.tally.warnings = (scene.failure,)
        stepped = clock.step != bus.tally.step
        if messages:
            bus.tally.did(clock.step, len(messages))
            bus.tally.latency_s = max(time.time_ns() - messages[0].received_ns, 0) / 1e9
        if stepped:
            bus.publish_health()
        if time.monotonic() >= flush_at:
            writer.flush()
            flush_at = time.monotonic() + FLUSH_S
        if time.monotonic() >= look_at and bus.connected:
            vehicles = tell_missed(bus, vehicles)
            look_at = time.monotonic() + LOOK_S
    writer.close()


def _one_by_one(
    messages: Sequence[Arrival], ends: list[int], say: Callable[[str], None]
) -> Iterator[Arrival]:
    """Yield messages. Once told to end, say now and then how many are left: the launcher waits as long."""
    said_s = time.monotonic()
    for done, message in enumerate(messages):
        if ends and time.monotonic() - said_s >= LEFT_S:
            said_s = time.monotonic()
            say(f"messages left to write: {len(messages) - done:,}")
        yield message


def _give_way() -> None:
    """Lower the priority of this thread.

    Zenoh's threads, already running, keep theirs: the router waits for them.
    """
    if sys.platform == "linux":  # elsewhere it would affect the whole process
        os.nice(NICENESS)
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def surroundings(namespace: str) -> dict[str, Any]:
    """Return the versions, git revision and host of a run."""
    return {
        "namespace": namespace,
        "began": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "versions": {
            "plumeward": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in PACKAGES},
        },
        "git": git_revision(),
        "host": {"platform": platform.platform(), "machine": platform.machine(), "cpus": os.cpu_count()},
    }


def git_revision() -> str:
    """Return the commit of this code, with "-dirty" if it has been changed since; empty if unknown."""
    if not (ROOT / ".git").exists():  # an installed package may lie within another repository
        return ""
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=2.0, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
