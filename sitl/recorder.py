"""`python -m sitl record`: writes down all that is said on a bus."""

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from link import cli
from link.bus import Stamped, Tap
from link.keys import KEYS
from link.record import Entry, SimulationClock, Writer
from plume import __version__

BATCH_S = 0.05
"""Messages are taken in batches: to wake for each of them would cost more than to write it."""
FLUSH_S = 0.4
"""The most that a killed recorder loses, but for a batch."""
LAST_BATCH_S = 0.4
"""Who ends a recorder gives it a second; the files want to be finished too."""
NICENESS = 5
"""The flight goes before its record."""
PACKAGES = ("eclipse-zenoh", "numpy", "pymavlink", "numba", "mcap")
ROOT = Path(__file__).parents[1]


def _file(text: str) -> Path:
    if not text.endswith(".mcap"):
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted a name that ends in .mcap")
    return Path(text)


def _about(text: str) -> dict[str, Any]:
    try:
        about = json.loads(text)
    except ValueError:
        about = None
    if not isinstance(about, dict):
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted a JSON object")
    return about


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    parser.add_argument("file", type=_file, metavar="FILE.mcap", help="where to record to; a .tlog of all MAVLink is written beside it")
    cli.add_bus_arguments(parser)
    parser.add_argument("--about", type=_about, default={}, metavar="JSON", help="what the run is; it is written into the file")


def run(args: argparse.Namespace) -> int:
    """Record until interrupted; stdout tells when that has begun."""
    _give_way()
    with Tap("recorder", args.connect, args.namespace) as bus:
        try:
            writer = Writer(args.file, {**args.about, **surroundings(args.namespace)})
        except OSError as error:
            print(f"error: cannot write {args.file}: {error.strerror}", file=sys.stderr)
            return cli.BAD_INPUT
        bus.subscribe(*KEYS)
        ends: list[int] = []
        for number in (signal.SIGINT, signal.SIGTERM):  # no exception: it could come in the middle of a message
            signal.signal(number, lambda number, _: ends.append(number))
        bus.tally.state = "recording"
        bus.publish_health()
        print(f"recording to {args.file}", flush=True)
        try:
            _record(bus, writer, ends)
        except OSError as error:
            words = f"record stopped: {error.strerror} ({args.file})"
            bus.log.warn(words)
            bus.tally.state, bus.tally.warnings = "stopped", (words,)
            bus.publish_health()
            return cli.FAILED
    return 0


def _record(bus: Tap, writer: Writer, ends: list[int]) -> None:
    clock = SimulationClock()
    flush_at = 0.0
    while not ends:
        time.sleep(BATCH_S)
        _take_batch(bus, writer, clock)
        if time.monotonic() >= flush_at:
            writer.flush()
            flush_at = time.monotonic() + FLUSH_S
    _take_batch(bus, writer, clock)
    writer.close()


def _take_batch(bus: Tap, writer: Writer, clock: SimulationClock) -> None:
    """Write what has arrived so far."""
    until = time.monotonic() + LAST_BATCH_S
    while time.monotonic() < until and (item := bus.receive(timeout_s=0.0)):
        assert isinstance(item, Stamped)
        simulation_s = clock.time_s(item.name, item.payload, item.published_ns)
        writer.write(Entry(item.name, item.published_ns, simulation_s, item.payload, item.attachment), item.received_ns)


def _give_way() -> None:
    """Have the scheduler prefer the flight; threads that are started from now on inherit it."""
    os.nice(NICENESS)
    if sys.platform == "linux":
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def surroundings(namespace: str) -> dict[str, Any]:
    """Return what a run depends on beside its own settings."""
    return {
        "namespace": namespace,
        "began": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "versions": {"plumeward": __version__, "python": platform.python_version(), **{name: version(name) for name in PACKAGES}},
        "git": git_revision(),
        "host": {"platform": platform.platform(), "machine": platform.machine(), "cpus": os.cpu_count()},
    }


def git_revision() -> str:
    """Return the commit that this code is of, with "-dirty" where it has been changed since; empty where it is not known."""
    if not (ROOT / ".git").exists():  # an installed package may lie within somebody else's repository
        return ""
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=2.0, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
