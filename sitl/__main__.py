"""`python -m sitl`: fly or replay a mission, look into its log, or run one part alone."""

import argparse
import importlib
import math
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, TextIO

from link import cli
from link.bus.session import DEFAULT_ROUTER
from plume.scenario import BUDGET_STEPS
from sitl.launch import viewing
from sitl.launch.watchdog import PATIENCE_S, WARN_S
from sitl.script.script import AgentPart, OnBoard, Script, find, load, shipped
from sitl.script.typed_yaml import Document, FileError
from sitl.uav.options import add_vehicle_arguments, at_own_home

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
    "replay": ("sitl.replay.command", "feed a log to the estimator and agent again"),
    "log": ("sitl.desk.summary", "summarise a log, or print one of its keys as CSV"),
    "draw": ("sitl.desk.draw", "draw a log as a picture or an animation"),
    "status": ("sitl.desk.status", "show how the parts of a running mission are doing; exit status 1 if something is wrong"),
    "view": ("sitl.view.command", "show missions on a page, live or recorded, and command the vehicle"),
    "bridge": ("sitl.bridge.command", "join the bus with ground stations and autopilots over UDP, TCP and serial lines"),
    "record": ("sitl.desk.recorder", "record everything on a bus until interrupted"),
}
"""Commands with a module of their own. It is imported only for its command: a part starts fast."""
FIELDS = {
    "seed": "seed", "speedup": "speedup", "sensor": "sensor", "world": "world", "silence": "vehicle.silence_s", "policy": "agent.policy",
    "budget": "agent.budget", "headings": "agent.headings", "step": "agent.step_m", "measurements": "agent.measurements",
    "particles": "estimator.particles", "threshold": "estimator.threshold_m", "prior": "estimator.prior",
    "stop_on": "estimator.stop_on", "assume": "estimator.assume", "stop": "estimator.stop", "after_stop": "vehicle.after_stop",
    "strict": "vehicle.strict",
}  # fmt: skip
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
        script, flags = Script(), {**flags, "speedup": args.speedup}
    changes = {field: flags[name] for name, field in FIELDS.items() if name in flags}
    if {"threshold", "stop"} & set(flags):  # either replaces both
        changes = {"estimator.threshold_m": None, "estimator.stop": None, **changes}
    if "home" in flags:
        changes |= {f"vehicle.{field}": value for field, value in zip(HOME, given.home, strict=True)}
    script = script.changed(changes)
    if script.agent.policy == "none" and not script.scripted():
        raise FileError("--policy: 'none' is not allowed; wanted a policy, or a mission that scripts all its waypoints")
    return script


def _load(args: argparse.Namespace) -> Script:
    """Read the mission script. Raises FileError, with the nearest name where there is no such mission."""
    missions, name = shipped(), args.mission.removesuffix(".yaml")
    if not os.path.lexists(args.mission) and name not in missions and (near := cli.did_you_mean(name, missions)):
        raise FileError(
            f"{args.mission}: no such file and no shipped mission{near} Wanted a mission script, or one of {', '.join(missions)}"
        )
    return load(args.mission)


def _check_policy(args: argparse.Namespace, given: argparse.Namespace, check: CheckPolicy) -> None:
    """Refuse the policy of a mission script before anything starts; argparse has checked that of the flag. Raises FileError."""
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
    parser = cli.Parser(prog=prog, description="Simulated flights to a gas leak. Without a command: fly, with its defaults.")
    commands = parser.add_subparsers(dest="command", parser_class=cli.Parser, required=True, metavar="COMMAND")

    fly = commands.add_parser("fly", help="fly one mission, with router, vehicle, estimator and agent as processes")
    add_vehicle_arguments(fly, speedup=10.0)
    policy = fly.add_argument(
        "--policy", type=cli.checked(_policy_or_none(check_policy)), default=AgentPart().policy, metavar="NAME",
        help="how waypoints are chosen: a name that `plumeward list policies` shows, or a bundle, FILE.zip (default: %(default)s)",
    )  # fmt: skip
    cli.completed(policy, policies, "zip")
    cli.add_reach_arguments(fly, BUDGET_STEPS)
    cli.add_filter_arguments(fly)
    fly.add_argument(
        "-l", "--listen", metavar="ENDPOINT", default="tcp/127.0.0.1:0", help="where the router listens (default: a free local port)"
    )
    fly.add_argument(
        "-e", "--connect", metavar="ENDPOINT", help="join a router, estimator and agent that run elsewhere; start only the vehicle"
    )
    fly.add_argument(
        "--record", type=_record, metavar="FILE.mcap", help="the record's file; a .tlog is written beside it (default: in runs/)"
    )
    fly.add_argument("--no-record", action="store_true", help="record nothing")
    viewing.add_arguments(fly)
    cli.add_output_guard(fly)
    fly.add_argument(
        "--patience", type=cli.number(WARN_S, math.inf), default=PATIENCE_S, metavar="S",
        help="fail the mission when a part is silent for S real seconds; inf waits for ever (default: %(default)g)",
    )  # fmt: skip
    cli.add_log_argument(fly, "warning")
    cli.add_output_arguments(fly)

    uav = commands.add_parser("uav", help="the simulated vehicle alone")
    cli.add_bus_arguments(uav)
    uav.set_defaults(connect=None, namespace=None)
    add_vehicle_arguments(uav, speedup=1.0)

    router = commands.add_parser("router", help="a Zenoh router alone")
    router.add_argument("-l", "--listen", metavar="ENDPOINT", default=DEFAULT_ROUTER, help="where to listen (default: %(default)s)")

    for command, (_, help_text) in OTHERS.items():
        other = commands.add_parser(command, help=help_text)
        if command in arguments[:1]:
            _module(command).add_arguments(other)

    if not arguments or arguments[0].endswith(SCRIPTS) or (arguments[0].startswith("-") and arguments[0] not in ("-h", "--help")):
        arguments = ["fly", *arguments]
    args = parser.parse_args(arguments)
    for action in commands.choices[args.command]._actions:
        action.default = argparse.SUPPRESS
    return args, parser.parse_args(arguments)


def _handed_on(args: argparse.Namespace, given: argparse.Namespace) -> list[str]:
    """Return the words of the command line that the uav has to know, too."""
    words = [args.mission] if args.mission else []
    changed = vars(given)
    for name in ("seed", "sensor", "world", "silence", "after_stop", "sysid"):
        if name in changed:
            words += [f"--{name.replace('_', '-')}", str(changed[name])]
    if "strict" in changed:
        words.append("--strict")
    if args.home:
        words.append("--home=" + ",".join(map(repr, args.home)))
    if "speedup" in changed or not args.mission:
        words += ["--speedup", repr(args.speedup)]
    return words + [word for url in args.out for word in ("--out", url)]


def _fly(args: argparse.Namespace, given: argparse.Namespace) -> int:
    from plume.outcome import outcome_text
    from sitl.launch.launcher import Launch, fly
    from sitl.launch.processes import MissionFailed
    from sitl.launch.recording import RecordFiles
    from sitl.launch.summary import run_name, write_summary

    script = _script(args, given)
    if args.connect and (reason := _unfit_for_connect(script, given)):
        print(f"error: {reason}", file=sys.stderr)
        return cli.BAD_INPUT
    summary = Path("runs") / f"{run_name('connected' if args.connect else script.agent.policy, script.seed)}.json"
    record = None if args.no_record else RecordFiles(args.record or summary.with_suffix(".mcap"))
    if record and (reason := record.refusal(args.force)):
        print(f"error: {reason}", file=sys.stderr)
        return cli.BAD_INPUT
    launch = Launch(
        script, args.instance, args.listen, _handed_on(args, given), None, args.connect, args.log_level, args.patience, args.sysid
    )  # fmt: skip
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


def _uav(args: argparse.Namespace, given: argparse.Namespace) -> int:
    import contextlib

    from link.bus.inbox import Inbox
    from link.bus.log import Log
    from link.bus.session import Bus
    from link.bus.tally import Tally
    from sitl.uav.clock import Clock
    from sitl.uav.uav import Uav
    from sitl.uav.udp import parse_url

    script = _script(args, given)
    config = at_own_home(script.vehicle_config(args.sysid or args.instance + 1), args.instance)
    outs = [parse_url(url, args.instance) for url in args.out]
    release = script.release()
    inbox = Inbox()
    namespace = args.namespace or f"uav/{args.instance + 1}"
    log = Log("uav", namespace, Tally(), args.log_level)
    if not args.out and not args.connect:
        usual = parse_url("udpout:127.0.0.1", args.instance)
        log.info(f"no client can connect by UDP without --out; --out {usual.text} is for {usual.counterpart}; QGroundControl: port 14550")
    with contextlib.ExitStack() as stack:
        bus = None
        if args.connect or not args.out:  # with --out alone it is a plain MAVLink vehicle, without a bus
            endpoint = args.connect or DEFAULT_ROUTER
            bus = stack.enter_context(Bus("uav", endpoint, namespace, inbox, args.log_level, sole=True))
            log = bus.log
            log.info(f"on the bus at {endpoint} as {namespace}; takes off when estimator and agent are there")
            joining = f"--connect {endpoint} --namespace {namespace}"
            chosen = "" if script.sensor == "gaussian" else f" --sensor {script.sensor}"
            chosen += "" if script.estimator.assume == "field" else f" --assume {script.estimator.assume}"
            who = "" if config.sysid == 1 else f" --sysid {config.sysid}"
            log.info(f"its estimator: plumeward estimator {joining} --rate {release.q!r} --diffusivity {release.d!r}{chosen}{who}")
            log.info(f"its agent: plumeward agent {joining} --sysid {config.sysid}")
        events = [event for event in script.events if isinstance(event, OnBoard)]
        try:
            uav = Uav(
                config,
                script.simulated(),
                Clock(script.speedup),
                inbox,
                bus,
                [out.text for out in outs],
                log,
                events,
                script.vehicle.after_stop,
            )
        except ValueError as error:
            print(f"error: --out: {error}", file=sys.stderr)
            return cli.BAD_INPUT
        for out in outs:
            log.info(f"MAVLink to {out.text}; {out.counterpart}")
        uav.run()
    return 0


def main(
    prog: str = "python -m sitl",
    arguments: list[str] | None = None,
    check_policy: CheckPolicy | None = None,
    policies: Callable[[], Iterable[str]] = tuple,
) -> int:
    """Parse the command line and run the command.

    `check_policy` refuses a policy before anything starts; without it the agent does when it has started. `policies` returns the names
    that a shell completes.
    """
    args, given = _parse(prog, sys.argv[1:] if arguments is None else arguments, check_policy, policies)
    if args.command in ("fly", "uav"):
        try:
            if args.command == "fly" and check_policy:
                _check_policy(args, given, check_policy)
            return {"fly": _fly, "uav": _uav}[args.command](args, given)
        except FileError as error:
            print(f"error: {error}", file=sys.stderr)
            return cli.BAD_INPUT
    if args.command in OTHERS:
        return int(_module(args.command).run(args))
    from sitl.launch.router import run

    run(args.listen)
    return 0


if __name__ == "__main__":
    cli.run(main)
