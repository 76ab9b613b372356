"""`python -m sitl`: fly one mission with all its parts, replay one, look into its log, or run one part alone."""

import argparse
import math
import sys
from pathlib import Path

from link import cli
from link.bus import DEFAULT_ROUTER
from plume import sensor
from plume.randomness import MAX_SEED
from plume.scenario import BUDGET_STEPS
from sitl import log, recorder, replay


def _udp_url(text: str) -> str:
    from sitl.udp import parse_url

    try:
        parse_url(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def _home(text: str) -> tuple[float, float, float, float]:
    try:
        lat, lon, alt, heading = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; wanted LAT,LON,ALT,HEADING") from None
    if not (abs(lat) <= 90 and abs(lon) <= 180 and abs(alt) <= 10_000 and abs(heading) <= 360):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not allowed; wanted LAT within ±90, LON within ±180, ALT within ±10000, HEADING within ±360"
        )
    return lat, lon, alt, heading


def _add_vehicle_arguments(parser: argparse.ArgumentParser, speedup: float) -> None:
    parser.add_argument("--seed", type=cli.whole(0, MAX_SEED), default=1, help="of the scenario and the sensor (default: %(default)s)")
    parser.add_argument(
        "--speedup",
        type=cli.number(0, 1000),
        default=speedup,
        metavar="X",
        help="1 real time, 0 as fast as possible (default: %(default)g)",
    )
    parser.add_argument(
        "-I", "--instance", type=cli.whole(0, 254), default=0, metavar="N", help="vehicle N: system id and namespace N+1 (default 0)"
    )
    parser.add_argument(
        "--sensor", type=cli.checked(sensor.parse), default="gaussian", metavar="KIND[:NUMBERS]",
        help="gaussian, threshold or hits, with their numbers where chosen, such as threshold:0.5,0.3 (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--home", type=_home, metavar="LAT,LON,ALT,HEADING", help="where home, the corner of the search area, is on the globe"
    )
    parser.add_argument(
        "--out", type=_udp_url, action="append", default=[], metavar="URL",
        help="also speak MAVLink there; by convention udpout:127.0.0.1:14540 (MAVSDK, MAVROS), udpout:127.0.0.1:14550 (ground stations)",
    )  # fmt: skip
    parser.add_argument(
        "--silence", type=cli.number(0, math.inf, above=True), default=30.0, metavar="S",
        help="real seconds without a waypoint after which the vehicle returns home and lands (default: %(default)g)",
    )  # fmt: skip


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = cli.Parser(prog="python -m sitl", description="Simulated flights to a gas leak. Without a command: fly, with its defaults.")
    commands = parser.add_subparsers(dest="command", parser_class=cli.Parser, required=True, metavar="fly | replay | log | uav | router | record")

    fly = commands.add_parser("fly", help="fly one mission: router, uav, estimator and agent as processes")
    _add_vehicle_arguments(fly, speedup=10.0)
    fly.add_argument(
        "--policy", default="infotaxis", help="how waypoints are chosen; `python -m agent -h` lists them (default: %(default)s)"
    )
    cli.add_reach_arguments(fly, BUDGET_STEPS)
    cli.add_filter_arguments(fly)
    fly.add_argument(
        "-l", "--listen", metavar="ENDPOINT", default="tcp/127.0.0.1:0", help="where the router listens (default: a free local port)"
    )
    cli.add_output_arguments(fly)

    uav = commands.add_parser("uav", help="the simulated vehicle alone")
    cli.add_bus_arguments(uav)
    uav.set_defaults(connect=None, namespace=None)
    _add_vehicle_arguments(uav, speedup=1.0)

    router = commands.add_parser("router", help="a Zenoh router alone")
    router.add_argument("-l", "--listen", metavar="ENDPOINT", default=DEFAULT_ROUTER, help="where to listen (default: %(default)s)")

    log.add_arguments(commands.add_parser("log", help="what a log holds: a summary, or one key as CSV"))
    replay.add_arguments(commands.add_parser("replay", help="fly a log again: what the vehicle said then, to services that run now"))
    recorder.add_arguments(commands.add_parser("record", help="record all that is said on a bus, until interrupted"))

    if not arguments or (arguments[0].startswith("-") and arguments[0] not in ("-h", "--help")):
        arguments = ["fly", *arguments]
    return parser.parse_args(arguments)


def _fly(args: argparse.Namespace) -> int:
    from plume.outcome import outcome_json, outcome_text
    from sitl.launcher import Mission, MissionFailed, fly, write_summary

    handed_on = [flag for url in args.out for flag in ("--out", url)] + ["--silence", repr(args.silence)]
    if args.home:
        handed_on.append("--home=" + ",".join(map(repr, args.home)))
    filter_arguments = [flag for prior in args.prior for flag in ("--prior", prior)] + ["--stop-on", args.stop_on]
    agent_arguments = [word for name, value in cli.reach_given(args).items() for word in (f"--{name}", repr(value))]
    mission = Mission(
        args.seed, args.policy, args.particles, args.threshold, args.budget, args.speedup, args.instance, args.listen, args.sensor,
        filter_arguments, agent_arguments, handed_on,
    )  # fmt: skip
    try:
        result, trace = fly(mission)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise
    except MissionFailed as failure:
        print(f"error: {failure}", file=sys.stderr)
        return failure.status
    print(outcome_text(result), file=sys.stderr)
    try:
        print(f"summary in {write_summary(mission, result, trace, Path('runs'))}", file=sys.stderr)
    except OSError as error:
        print(f"warning: no summary written to runs/: {error.strerror}", file=sys.stderr)
    if args.json:
        print(outcome_json(result, trace if args.trace else None))
    return 0


def _uav(args: argparse.Namespace) -> int:
    import contextlib
    import queue

    from link.bus import Bus
    from link.log import Log
    from plume.scenario import draw
    from plume.world import World
    from sitl.clock import Clock
    from sitl.uav import Uav
    from sitl.vehicle import VehicleConfig

    silence_s = args.silence * (args.speedup or 1.0)  # who is silent lives in real time; at speed-up 0 so does a waiting vehicle
    config = VehicleConfig(args.instance + 1, silence_s=silence_s)
    if args.home:
        lat, lon, alt, heading = args.home
        config = VehicleConfig(args.instance + 1, lat, lon, alt, heading, silence_s=silence_s)
    scenario = draw(args.seed)
    inbox: queue.SimpleQueue[object] = queue.SimpleQueue()
    log = Log("uav")
    with contextlib.ExitStack() as stack:
        bus = None
        if args.connect or not args.out:  # with --out alone it is a plain MAVLink vehicle, without a bus
            endpoint = args.connect or DEFAULT_ROUTER
            namespace = args.namespace or f"uav/{args.instance + 1}"
            bus = stack.enter_context(Bus("uav", endpoint, namespace, inbox))
            log.info(f"on the bus at {endpoint} as {namespace}; takes off when estimator and agent are there")
            joining = f"--connect {endpoint} --namespace {namespace}"
            chosen = "" if args.sensor == "gaussian" else f" --sensor {args.sensor}"
            who = "" if config.sysid == 1 else f" --sysid {config.sysid}"
            log.info(f"its estimator: python -m estimator {joining} --rate {scenario.q!r} --diffusivity {scenario.d!r}{chosen}{who}")
            log.info(f"its agent: python -m agent {joining} --sysid {config.sysid}")
        uav = Uav(config, World(scenario, args.seed, sensor.parse(args.sensor)), Clock(args.speedup), inbox, bus, args.out)
        for url in args.out:
            port = url.rpartition(":")[2]
            log.info(f"MAVLink to {url}; MAVSDK: udpin://0.0.0.0:{port}, pymavlink and MAVProxy: udpin:0.0.0.0:{port}")
        uav.run()
    return 0


def main() -> int:
    """Parse the command line and run what it names."""
    args = _parse(sys.argv[1:])
    if args.command == "fly":
        return _fly(args)
    if args.command == "uav":
        return _uav(args)
    if args.command in ("log", "replay", "record"):
        return {"log": log, "replay": replay, "record": recorder}[args.command].run(args)
    from sitl.router import run

    run(args.listen)
    return 0


if __name__ == "__main__":
    cli.run(main)
