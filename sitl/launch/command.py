"""`plumeward fly`: one mission from its command line to its outcome."""

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from aircraft.payload.options import SIMULATED, add_payload_argument
from aircraft.search.options import add_vehicle_url
from link import cli
from plume.outcome import outcome_text
from plume.problem import Problem
from plume.problems.options import add_fleet_arguments
from sitl.launch.launcher import Flown, fly
from sitl.launch.mission import Launch, RealVehicle, check_connect, check_fleet, check_payload
from sitl.launch.processes import MissionFailed
from sitl.launch.recording import (
    RecordFiles,
    check_findings,
    give_up,
    run_name,
    write_findings,
    write_summary,
)
from sitl.launch.viewing import MissionPage
from sitl.launch.watchdog import PATIENCE_S, WARN_S
from sitl.script.options import FIELDS, blamed, fleet_of, origin_of, script_for_vehicle, script_of
from sitl.script.script import AgentPart, Script
from sitl.uav.options import add_vehicle_arguments, check_ids, check_outs

RECORD_FILE = "FILE.mcap"  # what the recorder calls the file that --record names
# The flags that the uav has to know, too.
OF_THE_UAV = (
    "problem",
    "seed",
    "sensor",
    "dwell",
    "world",
    "silence",
    "after_stop",
    "sysid",
    "sign",
    "wind",
    "wait",
    "strict",
    "home",
    "speedup",
    "out",
)


def add_arguments(
    parser: argparse.ArgumentParser,
    check_policy: Callable[[str], object] | None = None,
    policies: Callable[[], Iterable[str]] = tuple,
) -> None:
    """Add its flags.

    `check_policy` refuses a policy before anything starts, by a ValueError that says what is allowed;
    without it the agent does when it has started.
    `policies` returns the names that a shell completes.
    """
    parser.set_defaults(check_policy=check_policy)
    add_vehicle_arguments(parser, speedup=10.0)
    policy = parser.add_argument(
        "--policy",
        type=cli.checked(lambda text: text == "none" or check_policy is None or check_policy(text)),
        default=AgentPart().policy,
        metavar="NAME",
        help="how waypoints are chosen: a name that `plumeward list policies` shows, or a bundle, FILE.zip "
        "(default: %(default)s)",
    )
    cli.completed(policy, policies, "zip")
    cli.add_reach_arguments(parser)
    cli.add_filter_arguments(parser)
    cli.add_doubted_argument(parser)
    parser.add_argument(
        "-l",
        "--listen",
        metavar="ENDPOINT",
        default="tcp/127.0.0.1:0",
        help="where the router listens (default: a free local port)",
    )
    parser.add_argument(
        "-e",
        "--connect",
        metavar="ENDPOINT",
        help="join a router, estimator and agent that run elsewhere; start only the vehicle, or vehicles",
    )
    parser.add_argument(
        "--record",
        type=cli.file_ending(".mcap"),
        metavar="FILE.mcap",
        help="the record's file; a .tlog is written beside it (default: in runs/)",
    )
    parser.add_argument("--no-record", action="store_true", help="record nothing")
    parser.add_argument(
        "--findings",
        type=cli.path,
        metavar="DIR",
        help="write what the mission has found into this folder: a page, GeoJSON, KML, CSV and JSON",
    )
    parser.add_argument(
        "--view", action="store_true", help="show the mission on a page, which stays open until it is closed"
    )
    parser.add_argument("--open", action="store_true", help="the same, and open it in a browser")
    add_fleet_arguments(parser)
    add_vehicle_url(parser, several=True)
    add_payload_argument(parser, "with --vehicle, ")
    cli.add_output_guard(parser)
    parser.add_argument(
        "--patience",
        type=cli.number(WARN_S, math.inf),
        default=PATIENCE_S,
        metavar="S",
        help="fail the mission when a part is silent for S real seconds; inf waits for ever (default: "
        "%(default)g)",
    )
    cli.add_secure_argument(parser)
    cli.add_log_argument(parser, "warning")
    cli.add_output_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Fly a mission, and say what has come of it. Raises BadInput."""
    script = _checked_script(args)
    policy = "connected" if args.connect else script.agent.policy
    summary = Path("runs") / f"{run_name(policy, script.seed)}.json"
    files = None if args.no_record else RecordFiles(args.record or summary.with_suffix(".mcap"))
    if files:
        files.prepare(args.force)
    if args.findings:
        check_findings(args.findings, args.force, has_record=files is not None)
    page = MissionPage(wanted=args.view, opened=args.open, attended=sys.stderr.isatty() and not args.json)
    try:
        flown = fly(_launch(args, script, files.path if files else None), files, page)
    except KeyboardInterrupt:
        page.end()
        give_up(files, args.findings)
        print("interrupted", file=sys.stderr)
        raise
    except MissionFailed as failure:
        refused = failure.status == cli.BAD_INPUT
        give_up(files, args.findings, refused=refused)
        print(f"error: {_refusal(args, str(failure)) if refused else failure}", file=sys.stderr)
        page.linger()
        return failure.status
    except Exception:  # it was refused, such as by a router
        give_up(files, args.findings)
        raise
    _tell_outcome(args, flown, summary, files)
    written = True
    if files and args.findings:
        written = write_findings(files.path, args.findings, sys.stderr if args.json else sys.stdout)
    if args.json:
        print(flown.json(with_trace=args.trace), flush=True)
    page.linger()
    return 0 if written and all(flown.expectations.values()) else cli.FAILED


def _checked_script(args: argparse.Namespace) -> Script:
    """Return what is flown. Raises BadInput if it cannot be: before anything starts."""
    script = script_of(args)
    if args.connect:
        if "listen" in args.given:
            raise cli.BadInput("--listen: not with --connect, whose router runs elsewhere")
        check_connect(script, [FIELDS[name] for name in args.given if name in FIELDS])
    elif args.check_policy and script.agent.policy != "none":
        try:
            args.check_policy(script.agent.policy)
        except ValueError as error:
            raise blamed(args, "--policy", str(error)) from None
    script = script_for_vehicle(script, args)
    if args.vehicle:
        check_payload(script, args.payload)
    fleet = fleet_of(args, script)
    check_ids(args, fleet.vehicles)
    check_outs(args.out, fleet.vehicles)
    check_fleet(script, fleet, args.given, origin_of(args, script))
    return script


def _launch(args: argparse.Namespace, script: Script, record: Path | None) -> Launch:
    given = args.given
    if not (args.mission or args.vehicle):  # then the uav would take its own default
        given = {**given, "speedup": args.speedup}
    real = None
    if args.vehicle:
        plume = (
            _words(given, "problem", "seed", "sensor", "dwell", "world") if args.payload == SIMULATED else []
        )
        real = RealVehicle(urls=args.vehicle, payload=args.payload, payload_arguments=plume, wait_s=args.wait)
    return Launch(
        script=script,
        instance=args.instance,
        sysid=args.sysid,
        uav_arguments=_words(given, *OF_THE_UAV),
        listen=args.listen,
        connect=args.connect,
        secure=args.secure,
        real=real,
        origin=origin_of(args, script) if script.fleet.vehicles > 1 else None,
        record=record,
        log_level=args.log_level,
        patience_s=args.patience,
    )


def _words(given: Mapping[str, Any], *names: str) -> list[str]:
    """Return the mission and the flags of these names as another command takes them."""
    words = [given["mission"]] if "mission" in given else []
    for name in names:
        flag, value = f"--{name.replace('_', '-')}", given.get(name)
        if value is True:
            words.append(flag)
        elif isinstance(value, Problem):
            words.append(f"{flag}={value.text}")
        elif isinstance(value, tuple):
            words.append(f"{flag}={','.join(map(repr, value))}")
        elif value is not None:
            words += [f"{flag}={each}" for each in (value if isinstance(value, list) else [value])]
    return words


def _refusal(args: argparse.Namespace, text: str) -> str:
    """Reword a part's refusal of a flag: name the line and field of the script that has set it."""
    flag, _, reason = text.partition(": ")
    if not flag.startswith("--") and flag != RECORD_FILE:
        return text
    return str(blamed(args, "--record" if flag == RECORD_FILE else flag, reason))


def _tell_outcome(args: argparse.Namespace, flown: Flown, summary: Path, files: RecordFiles | None) -> None:
    results = sys.stderr if args.json else sys.stdout
    print(outcome_text(flown.outcome), file=results)
    try:
        write_summary(summary, msgspec.to_builtins(flown.script), json.loads(flown.json(with_trace=True)))
        print(f"summary  {summary}", file=results)
    except OSError as error:
        print(f"warning: no summary written to runs/: {error.strerror}", file=sys.stderr)
    if files:
        files.tell(results)
    for expectation, came_true in flown.expectations.items():
        print(f"expected {expectation}: {'yes' if came_true else 'NO'}", file=results)
