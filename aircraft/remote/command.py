"""`plumeward uav --vehicle URL`: a search by a real vehicle. The command finds this file by its name."""

import argparse
import contextlib

from aircraft.bridge.address import parse_address
from aircraft.keeper.connection import Connection
from aircraft.remote.commander import Commander
from aircraft.remote.passing import RealClients
from aircraft.remote.sensing import AskedSensor
from aircraft.remote.vehicle import RemoteVehicle
from aircraft.remote.winds import Winds
from aircraft.search.command import Orders, fly, given_by
from aircraft.search.options import parse_wind
from aircraft.search.search import Search
from aircraft.search.uav import Equipment, Handling, Uav
from aircraft.state import AircraftConfig
from link.interrupts import is_launched


def run(args: argparse.Namespace, orders: Orders, config: AircraftConfig) -> int:
    """Fly until interrupted; returns the exit status. Raises BadInput."""

    def make(equipment: Equipment, stack: contextlib.ExitStack) -> Uav:
        log, address = equipment.say.log, parse_address(args.vehicle)
        with given_by("--vehicle"):
            connection = Connection(address, log)
        stack.callback(connection.close)
        log.info(f"vehicle at {address.text}; the other side: {address.other_side}")
        if risk := address.risk("speak as the vehicle"):
            log.warning(risk)
        commander = Commander(connection, orders.speedup, args.sysid, Handling(log).of)
        vehicle = RemoteVehicle(config, commander, args.wait, launched=is_launched(), berth=orders.berth)
        return real_uav(vehicle, orders, equipment, parse_wind(args.wind) if args.wind else None)

    return fly(args, orders, make)


def real_uav(
    vehicle: RemoteVehicle, orders: Orders, equipment: Equipment, wind: tuple[float, float] | None = None
) -> Uav:
    """Return the uav service of a real vehicle, which needs a bus. Raises ValueError for a URL of `outs`.

    wind: that of all readings, if it is given; else the payload or the autopilot tells it.
    """
    clock, _, bus, say, outs, signing = equipment
    assert bus is not None
    berth = orders.berth
    search = Search(vehicle, berth.start if berth else orders.world.start, orders.after_stop, say)
    clients = RealClients(vehicle, search, bus, outs, clock, Handling(say.log), signing)
    vehicles = 1 + len(berth.others) if berth else 1
    winds = Winds(wind, orders.world.wind, say)
    sensor = AskedSensor(vehicle, bus, winds, vehicles, orders.number or 1, berth)
    sensor.dwell_s = orders.world.sensor.dwell
    return Uav(search, clients, sensor, equipment, orders.events)
