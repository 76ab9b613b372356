"""`plumeward uav`: one vehicle alone, simulated or real."""

import argparse
import contextlib
import sys
from typing import TYPE_CHECKING

from aircraft.bridge.address import parse_out
from aircraft.remote.real import add_vehicle_url, real_vehicle
from aircraft.remote.winds import parse_wind
from aircraft.search.clock import Clock
from aircraft.search.events import OnBoard
from aircraft.state import VehicleFailed
from link import cli
from link.bus.inbox import Inbox
from link.bus.log import Log
from link.bus.opening import DEFAULT_ROUTER
from link.bus.session import Bus
from link.bus.tally import Tally
from link.signing.signer import Signing
from sitl.autopilot.vehicle import Vehicle
from sitl.script.options import script_of
from sitl.script.vehicle import script_for_vehicle
from sitl.uav.options import add_vehicle_arguments, at_own_home
from sitl.uav.simulated import simulated_uav

if TYPE_CHECKING:
    from aircraft.remote.vehicle import RemoteVehicle


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add its flags."""
    cli.add_bus_arguments(parser)
    parser.set_defaults(connect=None, namespace=None)
    add_vehicle_arguments(parser, speedup=1.0)
    add_vehicle_url(parser)


def run(args: argparse.Namespace) -> int:
    """Fly until interrupted. Raises BadInput."""
    script = script_for_vehicle(script_of(args), args)
    config = at_own_home(script.vehicle_config(args.sysid or args.instance + 1), args.instance)
    outs = [parse_out(url, args.instance) for url in args.out]
    release = script.release()
    inbox = Inbox()
    namespace = args.namespace or f"uav/{args.instance + 1}"
    log = Log("uav", namespace, Tally(), args.log_level)
    if not args.out and not args.connect and not args.vehicle:
        usual = parse_out("udpout:127.0.0.1", args.instance)
        log.info(
            f"no client can connect by UDP without --out; --out {usual.text} is for {usual.other_side}; "
            "QGroundControl: port 14550"
        )
    with contextlib.ExitStack() as stack:
        bus = None
        if (
            args.connect or args.vehicle or not args.out
        ):  # with --out alone it is a plain MAVLink vehicle, without a bus
            endpoint = args.connect or DEFAULT_ROUTER
            bus = stack.enter_context(
                Bus("uav", endpoint, namespace, inbox, args.log_level, secure=args.secure, sole=True)
            )
            log = bus.log
            needed = "payload, estimator and agent" if args.vehicle else "estimator and agent"
            ends = f"; gives up after {args.wait:g} s (--wait)" if args.vehicle else ""
            log.info(f"on the bus at {endpoint} as {namespace}; takes off when {needed} are there{ends}")
            joining = f"--connect {endpoint} --namespace {namespace}" + (
                f" --secure {args.secure}" if args.secure else ""
            )
            chosen = "" if script.sensor == "gaussian" else f" --sensor {script.sensor}"
            chosen += "" if script.estimator.assume == "field" else f" --assume {script.estimator.assume}"
            who = "" if args.vehicle and not args.sysid else f" --sysid {config.sysid}"
            log.info(
                f"its estimator: plumeward estimator {joining} --rate {release.q!r} --diffusivity "
                f"{release.d!r}{chosen}{who}"
            )
            log.info(f"its agent: plumeward agent {joining}{who}")
            if args.vehicle:
                log.info(f"its payload: plumeward payload {joining}")
        events = [event for event in script.events if isinstance(event, OnBoard)]
        vehicle: Vehicle | RemoteVehicle = Vehicle(config)
        if args.vehicle:
            try:
                vehicle, connection = real_vehicle(
                    args.vehicle, config, script.speedup, args.sysid, args.wait, log
                )
            except ValueError as error:
                print(f"error: --vehicle: {error}", file=sys.stderr)
                return cli.BAD_INPUT
            stack.callback(connection.close)
        try:
            signing = (
                stack.enter_context(contextlib.closing(Signing(args.sign, f"uav-{config.sysid}", log)))
                if args.sign
                else None
            )
        except ValueError as error:
            print(f"error: --sign: {error}", file=sys.stderr)
            return cli.BAD_INPUT
        try:
            world, clock, urls = script.simulated(), Clock(script.speedup), [out.text for out in outs]
            after_stop = script.vehicle.after_stop
            if isinstance(vehicle, Vehicle):
                uav = simulated_uav(vehicle, world, clock, inbox, bus, log, urls, events, after_stop, signing)
            else:
                from aircraft.remote.command import real_uav  # loads all of MAVLink's dialects

                assert bus is not None
                wind = parse_wind(args.wind) if args.wind else None
                uav = real_uav(vehicle, world, clock, inbox, bus, urls, events, after_stop, signing, wind)
        except ValueError as error:
            print(f"error: --out: {error}", file=sys.stderr)
            return cli.BAD_INPUT
        for out in outs:
            log.info(f"MAVLink to {out.text}; {out.other_side}")
            if (risk := out.risk("command the vehicle")) and not args.sign:
                log.warning(risk)
        try:
            uav.run()
        except VehicleFailed as failure:
            print(f"error: {failure}", file=sys.stderr)
            return cli.FAILED
    return 0
