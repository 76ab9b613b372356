"""`python -m sitl`: fly or replay a mission, look into its log, or run one part alone."""

if __name__ == "__main__":  # here, because the modules below take long to load
    from link.early import end_at_once

    end_at_once()

import argparse
import importlib
import math
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, TextIO

from aircraft.payload.options import SIMULATED, add_payload_argument
from aircraft.remote.real import add_vehicle_url
from link import cli
from link.bus.opening import DEFAULT_ROUTER
from plume.scenario import BUDGET_STEPS
from sitl.launch import viewing
from sitl.launch.watchdog import PATIENCE_S, WARN_S
from sitl.script.options import add_mission_argument, add_seed_argument, add_world_arguments
from sitl.script.script import AgentPart, Script, find, load, shipped
from sitl.script.typed_yaml import Document, FileError
from sitl.uav.options import add_vehicle_arguments

if TYPE_CHECKING:
    from sitl.launch.recording import RecordFiles


def _record(text: str) -> Path:
    path = Path(text)
    if path.suffix != ".mcap":
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted a file that ends in .mcap")
    return path


def _policy_or_none(check: "CheckPolicy | None") -> "CheckPolicy":
    return lambda text: text == "none" or check is None or check(text)


SCRIPTS = (".yaml", ".yml")
OTHERS = {
    "replay": ("ground.replay.command", "feed a log to the estimator and agent again"),
    "log": ("ground.desk.summary", "summarise a log, or print one of its keys as CSV"),
    "draw": ("ground.desk.draw", "draw a log as a picture or an animation"),
    "status": (
        "ground.desk.status",
        "show how the parts of a running mission are doing; exit status 1 if something is wrong",
    ),
    "view": ("ground.view.command", "show missions on a page, live or recorded, and command the vehicle"),
    "bridge": (
        "aircraft.bridge.command",
        "join the bus with ground stations and autopilots over UDP, TCP and serial lines",
    ),
    "payload": (
        "aircraft.payload.command",
        "the gas sensor of a real autopilot: simulated, on a serial line, or a plug-in",
    ),
    "record": ("ground.desk.recorder", "record everything on a bus until interrupted"),
}
"""Commands with a module of their own. It is imported only for its command: a part starts fast."""
FIELDS = {
    "seed": "seed",
    "speedup": "speedup",
    "sensor": "sensor",
    "world": "world",
    "silence": "vehicle.silence_s",
    "policy": "agent.policy",
    "budget": "agent.budget",
    "headings": "agent.headings",
    "step": "agent.step_m",
    "measurements": "agent.measurements",
    "particles": "estimator.particles",
    "threshold": "estimator.threshold_m",
    "prior": "estimator.prior",
    "stop_on": "estimator.stop_on",
    "assume": "estimator.assume",
    "stop": "estimator.stop",
    "after_stop": "vehicle.after_stop",
    "strict": "vehicle.strict",
}
"""The field of a mission script that each flag sets."""
RECORD_FILE = "FILE.mcap"
"""What the recorder calls the file that --record names."""
CheckPolicy = Callable[[str], object]
"""Raises ValueError, with what is allowed, on a policy that cannot be flown."""
HOME = ("home_lat_deg", "home_lon_deg", "home_alt_m", "home_heading_deg")


def _script(args: argparse.Namespace, given: argparse.Namespace) -> Script:
    """Return the named mission script, or the default one, with the given flags put in. Raises FileError."""
    flags = {**vars(given)}
    if "prior" in flags:
        flags["prior"] = dict(item.partition("=")[::2] for item in given.prior)
    if args.mission:
        script = _load(args)
    else:
        script, flags = Script(), {**flags, **({"speedup": args.speedup} if "speedup" in args else {})}
    changes = {field: flags[name] for name, field in FIELDS.items() if name in flags}
    if {"threshold", "stop"} & set(flags):  # either replaces both
        changes = {"estimator.threshold_m": None, "estimator.stop": None, **changes}
    if "home" in flags:
        changes |= {f"vehicle.{field}": value for field, value in zip(HOME, given.home, strict=True)}
    if "sign" in given and not args.out:
        raise FileError("--sign: there is nothing to sign; wanted it with --out")
    script = script.changed(changes)
    if script.agent.policy == "none" and not script.scripted():
        raise FileError(
            "--policy: 'none' is not allowed; wanted a policy, or a mission that scripts all its waypoints"
        )
    return script


def _load(args: argparse.Namespace) -> Script:
    """Read the mission script. Raises FileError, with the nearest name where there is no such mission."""
    missions, name = shipped(), args.mission.removesuffix(".yaml")
    if (
        not os.path.lexists(args.mission)
        and name not in missions
        and (near := cli.did_you_mean(name, missions))
    ):
        raise FileError(
            f"{args.mission}: no such file and no shipped mission{near} Wanted a mission script, or one of "
            f"{', '.join(missions)}"
        )
    return load(args.mission)


def _check_policy(args: argparse.Namespace, given: argparse.Namespace, check: CheckPolicy) -> None:
    """Refuse the policy of a mission script before anything starts; argparse has checked that of the flag.
    Raises FileError.
    """
    if not args.mission or args.connect or "policy" in given:
        return
    policy = _load(args).agent.policy
    try:
        if policy != "none":
            check(policy)
    except ValueError as error:
        raise Document(find(args.mission)).error(["agent", "policy"], str(error)) from None


def _module(command: str) -> ModuleType:
    return importlib.import_module(OTHERS[command][0])


def _parse(
    prog: str, arguments: list[str], check_policy: CheckPolicy | None, policies: Callable[[], Iterable[str]]
) -> tuple[argparse.Namespace, argparse.Namespace]:
    """Return all arguments, and those that were given on the command line."""
    parser = cli.Parser(
        prog=prog, description="Simulated flights to a gas leak. Without a command: fly, with its defaults."
    )
    commands = parser.add_subparsers(
        dest="command", parser_class=cli.Parser, required=True, metavar="COMMAND"
    )

    fly = commands.add_parser(
        "fly", help="fly one mission, with router, vehicle, estimator and agent as processes"
    )
    add_vehicle_arguments(fly, speedup=10.0)
    policy = fly.add_argument(
        "--policy",
        type=cli.checked(_policy_or_none(check_policy)),
        default=AgentPart().policy,
        metavar="NAME",
        help="how waypoints are chosen: a name that `plumeward list policies` shows, or a bundle, FILE.zip "
        "(default: %(default)s)",
    )
    cli.completed(policy, policies, "zip")
    cli.add_reach_arguments(fly, BUDGET_STEPS)
    cli.add_filter_arguments(fly)
    fly.add_argument(
        "-l",
        "--listen",
        metavar="ENDPOINT",
        default="tcp/127.0.0.1:0",
        help="where the router listens (default: a free local port)",
    )
    fly.add_argument(
        "-e",
        "--connect",
        metavar="ENDPOINT",
        help="join a router, estimator and agent that run elsewhere; start only the vehicle",
    )
    fly.add_argument(
        "--record",
        type=_record,
        metavar="FILE.mcap",
        help="the record's file; a .tlog is written beside it (default: in runs/)",
    )
    fly.add_argument("--no-record", action="store_true", help="record nothing")
    viewing.add_arguments(fly)
    add_vehicle_url(fly)
    add_payload_argument(fly, "with --vehicle, ")
    cli.add_output_guard(fly)
    fly.add_argument(
        "--patience",
        type=cli.number(WARN_S, math.inf),
        default=PATIENCE_S,
        metavar="S",
        help="fail the mission when a part is silent for S real seconds; inf waits for ever (default: "
        "%(default)g)",
    )
    cli.add_secure_argument(fly)
    cli.add_log_argument(fly, "warning")
    cli.add_output_arguments(fly)

    uav = commands.add_parser("uav", help="the simulated vehicle alone")
    cli.add_bus_arguments(uav)
    uav.set_defaults(connect=None, namespace=None)
    add_vehicle_arguments(uav, speedup=1.0)
    add_vehicle_url(uav)

    router = commands.add_parser("router", help="a Zenoh router alone")
    router.add_argument(
        "-l",
        "--listen",
        metavar="ENDPOINT",
        default=DEFAULT_ROUTER,
        help="where to listen (default: %(default)s)",
    )
    router.add_argument(
        "-e", "--connect", metavar="ENDPOINT", help="join the router of another site; not with --secure"
    )
    cli.add_secure_argument(router)

    for command, (_, help_text) in OTHERS.items():
        other = commands.add_parser(command, help=help_text)
        if command == "payload":
            add_mission_argument(other)
            add_seed_argument(other)
            add_world_arguments(other)
        if command in arguments[:1]:
            _module(command).add_arguments(other)

    if (
        not arguments
        or arguments[0].endswith(SCRIPTS)
        or (arguments[0].startswith("-") and arguments[0] not in ("-h", "--help"))
    ):
        arguments = ["fly", *arguments]
    args = parser.parse_args(arguments)
    for action in commands.choices[args.command]._actions:
        action.default = argparse.SUPPRESS
    return args, parser.parse_args(arguments)


def _words(given: argparse.Namespace, *names: str) -> list[str]:
    """Return the mission and the flags of these names as they were given."""
    words = [given.mission] if getattr(given, "mission", None) else []
    for name in names:
        if name in given:
            words += [f"--{name.replace('_', '-')}", str(getattr(given, name))]
    return words


def _handed_on(args: argparse.Namespace, given: argparse.Namespace) -> list[str]:
    """Return the words of the command line that the uav has to know, too."""
    words, changed = (
        _words(given, "seed", "sensor", "world", "silence", "after_stop", "sysid", "sign", "wind", "wait"),
        vars(given),
    )
    if "strict" in changed:
        words.append("--strict")
    if args.home:
        words.append("--home=" + ",".join(map(repr, args.home)))
    if "speedup" in changed or not (args.mission or args.vehicle):
        words += ["--speedup", repr(args.speedup)]
    return words + [word for url in args.out for word in ("--out", url)]


def _fly(args: argparse.Namespace, given: argparse.Namespace) -> int:
    from plume.outcome import outcome_text
    from sitl.launch.launcher import fly
    from sitl.launch.mission import Launch, unfit_for_payload
    from sitl.launch.processes import MissionFailed
    from sitl.launch.recording import RecordFiles
    from sitl.launch.summary import run_name, write_summary
    from sitl.script.real import real_script

    script = _script(args, given)
    reason = _unfit_for_connect(script, given) if args.connect else None
    try:
        script = real_script(script, given)
    except ValueError as error:
        reason = str(error)
    if reason := reason or unfit_for_payload(script, args.vehicle, args.payload, vars(given)):
        print(f"error: {reason}", file=sys.stderr)
        return cli.BAD_INPUT
    summary = (
        Path("runs") / f"{run_name('connected' if args.connect else script.agent.policy, script.seed)}.json"
    )
    record = None if args.no_record else RecordFiles(args.record or summary.with_suffix(".mcap"))
    if record and (reason := record.refusal(args.force)):
        print(f"error: {reason}", file=sys.stderr)
        return cli.BAD_INPUT
    plume = _words(given, "seed", "sensor", "world") if args.payload == SIMULATED else []
    launch = Launch(
        script,
        args.instance,
        args.listen,
        _handed_on(args, given),
        None,
        args.connect,
        args.log_level,
        args.patience,
        args.sysid,
        args.vehicle,
        args.payload,
        plume,
        args.secure,
        args.wait if args.vehicle else math.inf,
    )
    page = viewing.page_of(args)
    try:
        flown = fly(launch, record, page)
    except KeyboardInterrupt:
        page.end()
        _give_up(record)
        print("interrupted", file=sys.stderr)
        raise
    except MissionFailed as failure:
        refused = failure.status == cli.BAD_INPUT
        _give_up(record, refused=refused)
        print(f"error: {_in_script(str(failure), args, given) if refused else failure}", file=sys.stderr)
        page.linger()
        return failure.status
    results = sys.stderr if args.json else sys.stdout
    print(outcome_text(flown.outcome), file=results)
    try:
        write_summary(flown, summary)
        print(f"summary  {summary}", file=results)
    except OSError as error:
        print(f"warning: no summary written to runs/: {error.strerror}", file=sys.stderr)
    _tell_record(record, results)
    for expectation, so in flown.expectations.items():
        print(f"expected {expectation}: {'yes' if so else 'NO'}", file=results)
    if args.json:
        print(flown.json(with_trace=args.trace), flush=True)
    page.linger()
    return 0 if all(flown.expectations.values()) else cli.FAILED


def _unfit_for_connect(script: Script, given: argparse.Namespace) -> str | None:
    from sitl.launch.joining import refusal

    if "listen" in given:
        return "--listen: not with --connect, whose router runs elsewhere"
    return refusal(script, [FIELDS[name] for name in vars(given) if name in FIELDS])


def _give_up(record: "RecordFiles | None", *, refused: bool = False) -> None:
    if record:
        record.give_up(refused=refused)
        _tell_record(record, sys.stderr)


def _tell_record(record: "RecordFiles | None", to: TextIO) -> None:
    if record and record.made and record.path.exists():
        print(f"record   {record.path}", file=to)


def _in_script(refusal: str, args: argparse.Namespace, given: argparse.Namespace) -> str:
    """Reword a part's refusal of a flag that the script set: name the script's line and field instead."""
    flag, _, reason = refusal.partition(": ")
    if flag == RECORD_FILE:
        return f"--record: {reason}"
    name = flag.removeprefix("--").replace("-", "_")
    if args.mission and name in FIELDS and name not in given:
        return str(Document(find(args.mission)).error([*FIELDS[name].split(".")], reason))
    return refusal


def main(
    prog: str = "python -m sitl",
    arguments: list[str] | None = None,
    check_policy: CheckPolicy | None = None,
    policies: Callable[[], Iterable[str]] = tuple,
) -> int:
    """Parse the command line and run the command.

    `check_policy` refuses a policy before anything starts; without it the agent does when it has started.
    `policies` returns the names that a shell completes.
    """
    args, given = _parse(prog, sys.argv[1:] if arguments is None else arguments, check_policy, policies)
    if args.command in ("fly", "uav", "payload"):
        try:
            if args.command == "fly" and check_policy:
                _check_policy(args, given, check_policy)
            if args.command == "fly":
                return _fly(args, given)
            script = _script(args, given)
            if args.command == "payload":
                return int(_module("payload").run(args, given, script.simulated()))
            return int(importlib.import_module("sitl.uav.command").run(args, given, script))
        except FileError as error:
            print(f"error: {error}", file=sys.stderr)
            return cli.BAD_INPUT
    if args.command in OTHERS:
        return int(_module(args.command).run(args))
    from sitl.launch.router import run

    if args.connect and args.secure:
        print("error: --connect: not with --secure, whose rules admit no other router", file=sys.stderr)
        return cli.BAD_INPUT
    run(args.listen, args.secure, args.connect)
    return 0


if __name__ == "__main__":
    cli.run(main)
