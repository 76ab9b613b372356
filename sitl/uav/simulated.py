"""A simulated vehicle's clients: it is its own autopilot, tells them its state and does what they ask."""

import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from aircraft.aircraft import GasSensor, Measured
from aircraft.bridge.bus_link import BRIDGED
from aircraft.operator import OPERATOR_IDS, CommandName, named, order
from aircraft.payload.messages import Question
from aircraft.payload.simulated import Simulated, turned
from aircraft.search.command import Orders
from aircraft.search.search import Search
from aircraft.search.uav import Equipment, Handling, Uav
from aircraft.search.udp import UdpPorts
from aircraft.state import Arrived, Result, VehicleFailed, denied, not_now
from aircraft.together import Berth, Together
from link.bus.keys import MAVLINK_OUT
from link.bus.mavlink import Codec, Message, unpack
from link.bus.px4 import MissionCurrent
from link.bus.session import Arrival
from link.modes import Mode
from plume.flight import TRY_AGAIN_S, leg_s
from plume.problems.fleet import ALONE, Fleet, Place
from plume.scenario import WorldError
from plume.worlds.rounds import RoundTime
from plume.worlds.world import World
from sitl.autopilot.config import STREAM_S
from sitl.autopilot.protocol import COMPONENT, MavlinkProtocol
from sitl.autopilot.setpoint import GLOBAL, LOCAL
from sitl.autopilot.telemetry import Snapshot, Telemetry
from sitl.autopilot.vehicle import Vehicle
from sitl.uav.options import LATE_IN_A_MOVING_WORLD

MODE_MESSAGES = {"COMMAND_LONG", "COMMAND_INT", "SET_MODE"}
SETPOINT_MESSAGES = {LOCAL, GLOBAL}

Sender = tuple[int, int]  # system and component id


class Port(NamedTuple):
    """A link and its telemetry: the client of each link sets its own rates."""

    send: Callable[..., None]
    telemetry: Telemetry


class SimulatedClients:
    """The clients of a simulated vehicle, each link with telemetry of its own."""

    component = COMPONENT

    def __init__(
        self, vehicle: Vehicle, search: Search, sensor: "SimulatedSensor", equipment: Equipment
    ) -> None:
        """Open the links; raises ValueError for a UDP URL that cannot be used."""
        bus, outs = equipment.bus, equipment.outs
        self.system = vehicle.config.sysid
        self._vehicle, self._sensor, self._clock = vehicle, sensor, equipment.clock
        self._log = equipment.say.log
        self._handling = Handling(self._log)
        self._protocol = MavlinkProtocol(vehicle)
        self._asked = Asked(vehicle, self._protocol, search)
        self._gas: tuple[int, float] | None = None
        self._progress = vehicle.progress
        self._ports: list[Port] = []
        if bus is not None:
            publish, codec = bus.publish, Codec(self.system, COMPONENT)
            self._ports.append(Port(lambda *said: publish(MAVLINK_OUT, codec.pack(*said)), self._telemetry()))
        self._udp = UdpPorts(outs, self._log, self.system, COMPONENT, equipment.signing) if outs else None
        by_udp = self._udp.ports if self._udp else []
        self._by_udp = {port: Port(port.send, self._telemetry()) for port in by_udp}
        self._ports += self._by_udp.values()
        if self._udp:
            self._udp.ring(lambda: equipment.inbox.put(None))  # `serve` takes what has come

    def _telemetry(self) -> Telemetry:
        # The vehicle's time, not the streams' time: at speed-up 0 they differ.
        vehicle, sensor = self._vehicle, self._sensor
        return Telemetry(
            lambda _: Snapshot(vehicle.config, vehicle.state(vehicle.now_s), sensor.wind, self._gas)
        )

    # ---- what they are told ----

    def serve(self) -> None:
        """Take what has come over UDP, and tell what is due.

        That the mission goes on is told at once: stations take it for finished before they see the next mode.
        """
        if self._udp:
            for link, message, peer in self._udp.receive():
                self._take(message, self._by_udp[link], f"at {peer}")
        if (progress := self._vehicle.progress) != self._progress:
            self._progress = progress
            self._send_now(MissionCurrent.id)
        for port in self._ports:
            if due := [*port.telemetry.due(self._clock.stream_s()), *self._protocol.due(port.telemetry)]:
                port.send(*due)

    def _send_now(self, message_id: int) -> None:
        for port in self._ports:
            if message := port.telemetry.build(message_id, self._clock.stream_s()):
                port.send(message)

    def wait_s(self) -> float:
        """Return the real time until something is due."""
        telemetry_s = self._clock.wait_s(None, min(port.telemetry.next_due_s() for port in self._ports))
        return min(telemetry_s, max(self._protocol.plans.next_s() - time.monotonic(), 0.0))

    def changed(self) -> None:
        """Tell at once what the search does now: after the landing the process may end."""
        self._send_now(mavlink.MAVLINK_MSG_ID_HEARTBEAT)

    def tell(self, severity: int, text: str) -> None:
        """Tell a text."""
        self.send(*self._protocol.statustext(severity, text))

    def measured(self, time_boot_ms: int, gas: float) -> None:
        """Tell the newest reading from now on."""
        self._gas = time_boot_ms, gas

    def send(self, *messages: Message) -> None:
        """Send messages on all links."""
        for port in self._ports:
            port.send(*messages)

    # ---- what they ask ----

    def take(self, arrival: Arrival) -> None:
        """Take a payload of `mavlink/in`. Raises BadFrame."""
        whence = "through a bridge" if arrival.attachment == BRIDGED else "on the bus"
        for message in unpack(arrival.payload):
            self._take(message, self._ports[0], whence)

    def _take(self, message: Message, port: Port, whence: str) -> None:
        with self._handling.of(message):
            refused = self._protocol.refused.total()
            answers = self._asked.receive(message, self._clock.now_s(), whence, port.telemetry)
            if message.get_type() in SETPOINT_MESSAGES:
                self._clock.heard()
            if self._protocol.refused.total() > refused:
                self._log.tally.refuse("waypoint")
            self._answer(answers, port)

    def refuse(self, result: Result, t_s: float) -> None:
        """Tell on the bus why a waypoint is refused."""
        self._answer(self._protocol.refuse_setpoint(result, t_s), self._ports[0])

    def _answer(self, answers: Sequence[Message], *ports: Port) -> None:
        if texts := [answer.text for answer in answers if answer.get_type() == "STATUSTEXT"]:
            self._log.warning("".join(texts))
        for port in ports if answers else ():
            port.send(*answers)

    def operate(self, name: CommandName) -> None:
        """Handle a word of the script's operator as if it had come over a link."""
        message = order(name, self.system)
        message.pack(mavlink.MAVLink(None, *OPERATOR_IDS))
        self._answer(self._asked.receive(message, self._vehicle.now_s, "in the script"), *self._ports)

    def end(self, say: Callable[[int, str], None]) -> None:
        """Close the links."""
        if self._udp:
            self._udp.close()


class SimulatedSensor(GasSensor):
    """A gas sensor in a simulated world.

    The world's time is that of the path between readings, not of the vehicle's clock, which goes on while
    the vehicle waits for its agent: a mission then is the same on a slow machine.
    """

    def __init__(
        self, world: World, vehicle: Vehicle, start: Place, together: Together | None = None
    ) -> None:
        """Take where the search begins, (x, y) m, and the vehicles of one by several."""
        super().__init__(together or Together())
        self.simulated, self._vehicle = Simulated(world), vehicle
        self.dwell_s = world.sensor.dwell
        self.wind = world.wind  # as last measured
        self._number, self._place = -1, start
        self._time_s, self._since_s = 0.0, 0.0  # of the reading before, and since then

    def measure(self, arrived: Arrived, time_boot_ms: int, number: int) -> Measured:
        """Take reading `number`."""
        (north, east, _) = arrived.position
        now_s = self._now_s((east, north), number)
        self._place = east, north
        question = Question(0, time_boot_ms, number, self._place, None)
        try:
            sample = self.simulated(question, now_s)
        except WorldError as error:
            raise VehicleFailed(str(error)) from error
        self.wind = sample.wind or self.wind
        return Measured(arrived, sample.gas, sample.wind)

    def _now_s(self, place: Place, number: int) -> float:
        """Return the world's time of reading `number`, or of another attempt at it, s."""
        config = self._vehicle.config
        if number != self._number:
            self._time_s, self._number = self._time_s + self._since_s, number
            flown_s = float(leg_s(self._place, place, config.speed_mps, config.accel_mps2))
            self._since_s = flown_s + self.dwell_s
        else:
            self._since_s += TRY_AGAIN_S
        return self._time_s + self._since_s

    def blow(self, u: float | None, phi: float | None) -> None:
        """Turn the wind, and the plume with it."""
        self.simulated.world = world = turned(self.simulated.world, u, phi)
        self.wind = world.wind


class SharedSensor(SimulatedSensor):
    """The gas sensor of one of several vehicles that search together in a simulated world.

    The world's time is that of their rounds.
    """

    def __init__(
        self,
        world: World,
        vehicle: Vehicle,
        number: int,
        starts: Sequence[Place],
        berth: Berth | None = None,
    ) -> None:
        """Take the world as vehicle 1 measures it, this vehicle's number and place, and where all start."""
        together = Together(len(starts), number, berth)
        super().__init__(world.of_vehicle(number), vehicle, starts[number - 1], together)
        self._vehicle_number = number
        self._world = world
        self._rounds = RoundTime(world, starts, vehicle.config.speed_mps, vehicle.config.accel_mps2)
        self._rounds.go(starts)

    def go(self, places: Sequence[Place], step: int) -> None:
        """Learn where those of a round go next, by which the time goes on."""
        self._rounds.go(places, self.together.here(step))

    def latecomer(self) -> str:
        """Return why its vehicle cannot join a search that has begun: it does not know the world's time."""
        return "" if self._world.is_steady else LATE_IN_A_MOVING_WORLD

    def _now_s(self, place: Place, number: int) -> float:
        return self._rounds.time_s

    def blow(self, u: float | None, phi: float | None) -> None:
        """Turn the wind, and the plume with it."""
        self._world = turned(self._world, u, phi)
        self.simulated.world = self._world.of_vehicle(self._vehicle_number)
        self.wind = self._world.wind


def simulated_uav(
    vehicle: Vehicle, orders: Orders, equipment: Equipment, number: int = 1, fleet: Fleet = ALONE
) -> Uav:
    """Return the uav service of a simulated vehicle. Raises ValueError for a URL of `outs`.

    number: which vehicle of the fleet it is.
    """
    world = orders.world
    starts = fleet.starts(world.start, world.seed, world.problem.ground)
    search = Search(vehicle, starts[number - 1], orders.after_stop, equipment.say)
    sensor = (
        SharedSensor(world, vehicle, number, starts, orders.berth)
        if len(starts) > 1
        else SimulatedSensor(world, vehicle, starts[0])
    )
    clients = SimulatedClients(vehicle, search, sensor, equipment)
    return Uav(search, clients, sensor, equipment, orders.events)


class Asked:
    """Handles what clients ask.

    Anyone's change of mode takes the vehicle from the search; OFFBOARD gives it back.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        protocol: MavlinkProtocol,
        search: Search,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._vehicle, self._protocol, self._search, self._clock = vehicle, protocol, search, clock
        self._streams: dict[Sender, float] = {}  # when each client last sent a setpoint

    def receive(
        self, message: Message, t_s: float, whence: str, streams: Telemetry | None = None
    ) -> list[Message]:
        """Handle a message from any link as `MavlinkProtocol.receive` does; only the leader leads.

        whence: how it came, in words; anybody can write any ids into a frame.
        """
        self._vehicle.catch_up(t_s)
        if not self._protocol.is_addressed(message):
            return []
        kind, sender = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        who = named(sender, whence)
        if kind in SETPOINT_MESSAGES:
            self._streams[sender] = self._clock()
            if self._search.leads:
                return self._protocol.refuse_setpoint(
                    denied("Waypoint refused: the search leads, HOLD stops it", "not leading"), t_s
                )
        if kind not in MODE_MESSAGES:
            return self._protocol.receive(message, t_s, streams)
        before = self._vehicle.mode, self._vehicle.armed
        if _asks_offboard(message) and self._search.under_way and not self._search.is_over:
            if self._search.leads and self._is_streaming(sender):
                return self._protocol.refuse(
                    message, not_now("Offboard refused: the search leads, HOLD stops it")
                )
            if not self._search.leads and not self._is_streaming(None):
                return self._give_back(message, who, t_s, streams)
        answers = self._protocol.receive(message, t_s, streams)
        if self._search.under_way and (self._vehicle.mode, self._vehicle.armed) != before:
            how = self._vehicle.mode.name if self._vehicle.armed else "disarmed"
            self._search.give_way(how, who)
        return answers

    def _give_back(self, message: Message, who: str, t_s: float, streams: Telemetry | None) -> list[Message]:
        """Lead again where the search left off. Nobody else sends its waypoint again, so it is set here."""
        self._search.leads = True
        self._vehicle.setpoint(t_s, self._search.waypoint)
        answers = self._protocol.receive(message, t_s, streams)
        self._search.leads = self._vehicle.mode is Mode.OFFBOARD
        if self._search.leads:
            self._search.resumed(who)
        return answers

    def _is_streaming(self, sender: Sender | None) -> bool:
        """Whether a client, or with None any client, streams setpoints: it then leads in OFFBOARD."""
        heard_s = [at_s for client, at_s in self._streams.items() if sender in (None, client)]
        return self._clock() - max(heard_s, default=-math.inf) <= STREAM_S


def _asks_offboard(message: Message) -> bool:
    main = Mode.OFFBOARD.value[0]
    if message.get_type() == "SET_MODE":
        return bool(message.custom_mode >> 16 & 0xFF == main)
    return bool(message.command == mavlink.MAV_CMD_DO_SET_MODE and message.param2 == main)
