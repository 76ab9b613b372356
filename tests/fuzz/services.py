"""What services read from the bus and from UDP: hostile bytes go through the services' own loops, which
must go on as before.
"""

import contextlib
import math
import queue
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
from pymavlink.dialects.v20 import common as mavlink

from agent import service as agent
from agent.policies import OURS, reach
from aircraft.bridge.routing import Routes
from aircraft.operator import MODES_WANTED, OPERATOR_IDS, SEARCH, change_mode, command, order
from aircraft.search.clock import Clock
from aircraft.search.command import Orders
from aircraft.search.search import RETURNING, SEARCHING
from aircraft.search.uav import Equipment, Speaker
from estimator import service as estimator
from estimator.filter import Config
from link.bus.frames import FrameStream
from link.bus.inbox import Inbox
from link.bus.keys import (
    BELIEF,
    DEPARTURE,
    JOIN,
    LATECOMER,
    LEAVE_OUT,
    MAVLINK_IN,
    MAVLINK_OUT,
    READING,
    STOP,
    WAYPOINT,
    Key,
)
from link.bus.log import LOGGER, Log
from link.bus.mavlink import Codec, Reading, pack_reading, split, unpack_reading, waypoint_message
from link.bus.messages import Belief, Departure, Health, Join, Latecomer, LeaveOut, Stop, unpack_particles
from link.bus.session import Arrival, Bus, LivelinessChange
from link.bus.tally import FAULT, REPEATED, Tally
from link.cli import numbers
from link.modes import Mode
from link.record.reader import read
from plume.problem import AREA
from plume.problems.fleet import ALONE, Fleet
from plume.scenario import draw
from plume.sensors.names import GAUSSIAN
from plume.worlds.world import World
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.vehicle import Vehicle
from sitl.uav.simulated import simulated_uav
from tests.fuzz.mutants import as_sent

QUIET = (LOGGER,)
"""What would write a line for most inputs."""
GOLDEN = Path(__file__).parents[1] / "golden"
BETWEEN = b"\xff\xff\xff"
"""Parts the payload of a message from its attachment: no JSON holds it."""
PARTICLES = 20


class _End(Exception):
    """All messages have been taken."""


class QuietBus(Bus):
    """A bus without a router: it delivers what it is given and keeps what is published."""

    def __init__(self, *arrivals: Arrival) -> None:
        self.service, self.tally = "fuzzed", Tally()
        self.log = Log(self.service, "-", self.tally)
        self._arrivals, self._given_at, self._vehicles = list(arrivals), 0.0, (1,)
        self.published: list[tuple[Key, bytes, bytes]] = []

    @property
    def connected(self) -> bool:
        return True

    def subscribe(self, *keys: Key, newest: bool = False) -> None: ...
    def watch_services(self) -> None: ...
    def announce(self) -> None: ...
    def kept(self, key: Key, service: str = "*") -> list[Arrival]:
        return []

    def publish_health(self) -> None: ...
    def keep_health(self) -> None: ...

    def receive(self, timeout_s: float | None = None) -> Any:
        if not self._arrivals:
            raise _End
        return self._arrivals.pop(0)

    def publish(
        self,
        key: Key,
        message: bytes | msgspec.Struct,
        attachment: bytes | None = None,
        vehicle: int | None = None,
    ) -> None:
        payload = message if isinstance(message, bytes) else msgspec.json.encode(message)
        self.published.append((key, payload, attachment or b""))


def until_all_are_taken(serve: Callable[[], object]) -> None:
    """Run a service until its bus has nothing more to give."""
    with contextlib.suppress(_End):
        serve()


@cache
def recorded(name: str = "homing-gaussian-field") -> dict[str, list[bytes]]:
    """Return real messages by key, each with its attachment."""
    said: dict[str, list[bytes]] = {}
    for entry in read(GOLDEN / f"{name}.mcap").entries:
        said.setdefault(entry.key, []).append(
            entry.payload + (BETWEEN + entry.attachment if entry.attachment else b"")
        )
    return said


def health() -> bytes:
    """Return a health message as services publish it."""
    return msgspec.json.encode(
        Health("estimator", "ready", 3, 0.1, 9.0, {"malformed": 2}, ("w",), 1, "e", 1.0, 0.1, "20 particles")
    )


# ---- readings: the estimator ----

FIRST = pack_reading(Codec(1, 1), Reading(1000, (2.0, 3.0), 5.0, (1.5, 0.5), 0.5))
LAST = pack_reading(Codec(1, 1), Reading(9000, (3.0, 3.0), 5.0, (1.5, 0.5), 0.25))


def reading_seeds() -> list[bytes]:
    return [
        pack_reading(Codec(1, 1), Reading(5000, (2.5, 3.5), 5.0, (1.0, 0.5), 0.75)),
        *recorded()["reading"][:3],
    ]


@cache
def _config(assume: str) -> Config:
    return Config(PARTICLES, assume=assume)


def _estimated(assume: str, *payloads: bytes) -> QuietBus:
    bus = QuietBus(*(Arrival(READING, payload, b"") for payload in payloads))
    with contextlib.suppress(_End):
        estimator.run(bus, _config(assume), [1])
    return bus


@cache
def _undisturbed(assume: str) -> list[tuple[Key, bytes, bytes]]:
    return _estimated(assume, FIRST, LAST).published


def reading(data: bytes) -> None:
    """A refused reading leaves the belief as it is, to the last bit; after any other, beliefs are valid,
    and the service goes on.
    """
    assume = "field" if len(data) % 8 == 0 else "paper"
    bus = _estimated(assume, FIRST, as_sent(data), LAST)
    refused = set(bus.tally.refused)
    if refused and not refused & {
        REPEATED,
        "late",
        "conflicting",
    }:  # else it was an honest reading, and the last one came late
        assert bus.published == _undisturbed(assume)
    answers = [(said, attachment) for key, said, attachment in bus.published if key is BELIEF]
    assert len(answers) + bus.tally.refused.total() - bus.tally.refused[REPEATED] == 3
    for said, attachment in answers:
        belief = msgspec.json.decode(said, type=Belief)
        agent.check(belief, AREA)
        unpack_particles(attachment, len(belief.unknowns))


# ---- beliefs: the agent ----


@cache
def belief_seeds() -> list[bytes]:
    seeds = []
    for name in ("homing-gaussian-field", "ppo-hits", "greedy-threshold"):
        for said in recorded(name)["belief"][3:8:4]:
            payload, _, particles = said.partition(BETWEEN)
            row = 4 * (len(msgspec.json.decode(payload, type=Belief).unknowns) + 1)
            seeds.append(payload + BETWEEN + particles[: 8 * row])
    return [bytes([number]) + seed for seed in seeds for number in range(len(OURS))]


def answered(policy: str, *messages: bytes) -> QuietBus:
    """Return the bus of an agent that has taken these beliefs, each with its particles."""
    parts = [message.partition(BETWEEN) for message in messages]
    bus = QuietBus(*(Arrival(BELIEF, payload, attachment) for payload, _, attachment in parts))
    with contextlib.suppress(_End):
        agent.run(bus, policy, 3, 300, None, reach(policy))
    return bus


QUARTERS = [quarter * 2**30 + 2**30 - 1 for quarter in range(4)]
"""Times all around the circle of time_boot_ms: whichever comes before, the last one is later than what is
then the newest.
"""


@cache
def _last_answer(policy: str) -> tuple[list[bytes], bytes]:
    """Return beliefs whose last one comes after all others, and its waypoint."""
    payload, _, particles = belief_seeds()[0][1:].partition(BETWEEN)
    said = msgspec.structs.replace(msgspec.json.decode(payload, type=Belief), ceased=False)
    messages = [
        msgspec.json.encode(msgspec.structs.replace(said, time_boot_ms=time)) + BETWEEN + particles
        for time in QUARTERS
    ]
    return messages, answered(policy, messages[-1]).published[-1][1]


def belief(data: bytes) -> None:
    """Whatever came before, the agent answers the next belief as always; a waypoint that it gives lies in
    the area.
    """
    policy = OURS[data[0] % len(OURS)] if data else OURS[0]
    messages, answer = _last_answer(policy)
    bus = answered(policy, data[1:], *messages)
    if b'"time_boot_ms":4294967295' not in data:
        place = slice(10, -2)  # the number of the frame and the checksum differ
        assert bus.published[-1][1][place] == answer[place]
    for key, frames, _ in bus.published:
        assert key is WAYPOINT
        (waypoint,) = (mavlink.MAVLink(None).decode(bytearray(frame.data)) for frame in split(frames))
        assert 0.0 <= waypoint.x <= 30.0
        assert 0.0 <= waypoint.y <= 30.0
        assert math.isfinite(waypoint.z)


# ---- the vehicle: mavlink/in, UDP and the stop ----


@cache
def _world() -> World:
    return World(draw(1_000_000), 1, GAUSSIAN)


class _SetClock(Clock):
    """A clock that goes on only when it is told."""

    def __init__(self) -> None:
        super().__init__(1.0)
        self.s = 0.0

    def now_s(self) -> float:
        return self.s

    def stream_s(self) -> float:
        return self.s

    def wait_s(self, next_event_s: float | None, next_stream_s: float) -> float:
        return 0.0


class _Told(Inbox):
    """An inbox of what is put into it; a number among it is a time to pass, s. At its end the loop that
    takes from it ends.
    """

    def __init__(self, clock: _SetClock) -> None:
        super().__init__()
        self.items: list[Any] = []
        self._clock = clock

    def get(self, timeout: float | None = None) -> Any:
        if not self.items:
            raise _End
        item = self.items.pop(0)
        if not isinstance(item, float):
            return item
        self._clock.s += item
        raise queue.Empty


class _Flight:
    """A vehicle, its bus, and its loop."""

    def __init__(self, *, searching: bool, fleet: Fleet = ALONE) -> None:
        clock = _SetClock()
        self.bus, self.vehicle, self.inbox = QuietBus(), Vehicle(VehicleConfig()), _Told(clock)
        equipment = Equipment(clock, self.inbox, self.bus, Speaker(self.bus.log))
        self._uav = simulated_uav(self.vehicle, Orders(_world()), equipment, 1, fleet)
        if searching:
            others = [f"uav/{number}" for number in numbers(fleet.vehicles)]
            there = [LivelinessChange(name, True) for name in ("estimator", "agent", *others)]
            self.goes_on(*there, 20.0, 15.0, 0.0)

    def goes_on(self, *items: Any) -> None:
        """Let the loop take these."""
        self.inbox.items = [*items]
        with contextlib.suppress(_End):
            self._uav.run()


ASKED = command(1, mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)


def _lives_on(flight: _Flight) -> None:
    """The vehicle flies on for a while, and answers."""
    flight.goes_on(0.1, 1.0, 30.0, 0.0)
    state = flight.vehicle.state(flight.vehicle.now_s)
    assert all(map(math.isfinite, (*state.position, *state.velocity)))
    flight.bus.published.clear()
    flight.goes_on(Arrival(MAVLINK_IN, Codec(*OPERATOR_IDS).pack(ASKED), b""))
    ids = {
        frame.message_id
        for key, payload, _ in flight.bus.published
        if key is MAVLINK_OUT
        for frame in split(payload)
    }
    assert mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION in ids


@cache
def mavlink_in_seeds() -> list[bytes]:
    said = Codec(*OPERATOR_IDS).pack
    modes = [said(change_mode(1, mode)) for mode in (Mode.HOLD, Mode.OFFBOARD, Mode.MISSION, Mode.LAND)]
    numbers = (400, 22, 176, 178, 192, 300, 224, 193, 511, 510, 512, 520, 519, 410)
    orders = [said(command(1, number, 1.0)) for number in numbers]
    whole = [
        mavlink.MAVLink_command_int_message(
            1, 1, 3, 192, 0, 0, -1.0, 1.0, 0.0, math.nan, 473977420, 85455940, 10.0
        ),
        mavlink.MAVLink_mission_count_message(1, 1, 1, 0),
        mavlink.MAVLink_mission_item_int_message(
            1, 1, 0, 6, 16, 0, 1, 0.0, 0.0, 0.0, math.nan, 473977420, 85455940, 10.0, 0
        ),
        mavlink.MAVLink_mission_request_list_message(1, 1, 0),
        mavlink.MAVLink_param_set_message(1, 1, b"MPC_XY_CRUISE", 3.0, 9),
        mavlink.MAVLink_param_request_read_message(1, 1, b"MPC_XY_CRUISE", -1),
        mavlink.MAVLink_param_request_list_message(1, 1),
        mavlink.MAVLink_set_position_target_global_int_message(
            0, 1, 1, 6, 0x0DF8, 473977420, 85455940, 10.0, 0, 0, 0, 0, 0, 0, 0, 0
        ),
        mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [0] * 251),
        mavlink.MAVLink_timesync_message(0, 5),
        mavlink.MAVLink_manual_control_message(1, 100, 100, 500, 0, 1),
    ]
    waypoint = said(waypoint_message(1, 0, (5.0, 6.0), 5.0))
    upload = said(*whole[1:3]) + orders[5]
    return [
        *orders,
        *modes,
        waypoint,
        upload,
        *map(said, whole),
        orders[0] + orders[1] + modes[1],
        *recorded()["waypoint"][:2],
    ]


def mavlink_in(data: bytes) -> None:
    """The vehicle takes any payload, from the bus, or frame by frame as over UDP, flies on and answers."""
    payload = as_sent(data)
    flight = _Flight(searching=len(data) % 2 == 0)
    flight.goes_on(
        Arrival(MAVLINK_IN, payload, b""),
        *(Arrival(MAVLINK_IN, frame.data, b"") for frame in FrameStream().take(payload, datagram=True)),
    )
    assert FAULT not in flight.bus.tally.refused
    _lives_on(flight)


def clients_seeds() -> list[bytes]:
    said = Codec(*OPERATOR_IDS).pack
    to_search = [said(order(name, 1, SEARCH)) for name in MODES_WANTED]
    return [
        *to_search,
        said(mavlink.MAVLink_command_int_message(1, SEARCH, 0, 21, 0, 0, 0, 0, 0, 0, 0, 0, 0)),
        *mavlink_in_seeds(),
    ]


@cache
def _beside_an_autopilot() -> Any:
    from tests.aircraft.remote.cockpit import Cockpit

    cockpit = Cockpit("ardupilot")
    cockpit.until(lambda: cockpit.clients.system)
    cockpit.radio.wire = SimpleNamespace(hear=lambda _: None)  # the double need not bear anything
    return cockpit


def clients(data: bytes) -> None:
    """Clients of a real vehicle may say anything: nothing is handed on in the vehicle's own name, and the
    search goes on answering.
    """
    cockpit = _beside_an_autopilot()
    cockpit.hear(as_sent(data))
    assert FAULT not in cockpit.bus.tally.refused
    senders = {(frame.system, frame.component) for one in cockpit.radio.forwarded for frame in split(one)}
    assert not senders & {(1, 1), (1, SEARCH)}
    assert [
        said.result for said in cockpit.tell(order("hold", 1, SEARCH)) if said.get_type() == "COMMAND_ACK"
    ] == [1]
    cockpit.radio.forwarded.clear()
    cockpit.bus.published.clear()


def waypoint(data: bytes) -> None:
    """Whatever comes on the key of waypoints, nobody takes the vehicle from the search by it."""
    flight = _Flight(searching=True)
    flight.goes_on(Arrival(WAYPOINT, as_sent(data), b""), 0.0)
    assert (flight.vehicle.mode, flight.vehicle.armed, flight.bus.tally.state) == (
        Mode.OFFBOARD,
        True,
        SEARCHING,
    )
    assert FAULT not in flight.bus.tally.refused
    _lives_on(flight)


THREE = Fleet(3, "edge")


@cache
def _first_reading() -> int:
    """Return the time_boot_ms of the first reading of one of three."""
    flight = _Flight(searching=True, fleet=THREE)
    return next(unpack_reading(data).time_boot_ms for key, data, _ in flight.bus.published if key is READING)


def plan_seeds() -> list[bytes]:
    """A round's waypoints, one that is not the newest, and one too few."""
    now = _first_reading()
    whole = [[waypoint_message(n, time, (4.0 * n, 6.0), 5.0) for n in (1, 2, 3)] for time in (now, now + 1)]
    return [Codec(1, 191).pack(*plan) for plan in (*whole, whole[0][:2])]


def plan(data: bytes) -> None:
    """Whatever comes on the key of waypoints, one of three flies on, and what it reads next is a number."""
    flight = _Flight(searching=True, fleet=THREE)
    flight.goes_on(Arrival(WAYPOINT, as_sent(data), b""))
    flight.goes_on(1.0, 30.0, 0.0)
    for key, said, _ in flight.bus.published:
        if key is READING:
            unpack_reading(said)
    assert FAULT not in flight.bus.tally.refused
    _lives_on(flight)


def departure_seeds() -> list[bytes]:
    return [
        msgspec.json.encode(Departure(2, 1, "lost")) + BETWEEN + FIRST,
        msgspec.json.encode(Departure(1, 0, "its battery", forgotten=True)),
    ]


def departure(data: bytes) -> None:
    """Whatever is said of who leaves, one of three lives on, the agent says it again once at most, and the
    estimator of three serves on.
    """
    payload, _, frames = as_sent(data).partition(BETWEEN)
    said = Arrival(DEPARTURE, payload, frames)
    flight = _Flight(searching=True, fleet=THREE)
    flight.goes_on(said, said)
    _lives_on(flight)
    agent_bus = QuietBus(said, said)
    until_all_are_taken(lambda: agent.run(agent_bus, "random", 3, 300, None, reach("random")))
    assert len(agent_bus.published) <= 1
    bus = QuietBus(
        said,
        *(Arrival(READING, pack, b"", name=READING.named(vehicle=n)) for n, pack in enumerate(_round(), 1)),
    )
    until_all_are_taken(lambda: estimator.run(bus, _config("paper"), [1, 2, 3]))
    assert FAULT not in bus.tally.refused


def latecomer_seeds() -> list[bytes]:
    late, where = Latecomer(3), Latecomer(3, (6.0, 3.0), 1)
    order, asks = LeaveOut(3, "later", late=True), Join((6.0, 3.0), clear=True)
    said = [late, where, msgspec.structs.replace(where, step=2), order, asks]
    return [msgspec.json.encode(each) for each in said]


def latecomer(data: bytes) -> None:
    """Whatever is said of who comes late, one of three lives on, the agent says it again once at most, and
    the estimator of three serves on, whoever is let in.
    """
    said = Arrival(LATECOMER, as_sent(data), b"", name=LATECOMER.name)
    for searching in (False, True):  # on the ground it may be about the vehicle itself
        flight = _Flight(searching=searching, fleet=THREE)
        flight.goes_on(said, said)
        _lives_on(flight)
    agent_bus = QuietBus(said, said)
    until_all_are_taken(lambda: agent.run(agent_bus, "random", 3, 300, None, reach("random")))
    assert len(agent_bus.published) <= 1
    for key in (LATECOMER, LEAVE_OUT, JOIN):
        whose = key.named(vehicle=3) if key.own else key.name
        bus = QuietBus(
            Arrival(LEAVE_OUT, latecomer_seeds()[3], b""),
            Arrival(key, as_sent(data), b"", name=whose),
            *(
                Arrival(READING, pack, b"", name=READING.named(vehicle=n))
                for n, pack in enumerate(_round(), 1)
            ),
        )
        until_all_are_taken(lambda bus=bus: estimator.run(bus, _config("paper"), [1, 2, 3]))
        assert FAULT not in bus.tally.refused


def _round() -> list[bytes]:
    """Return a reading of each of three."""
    return [pack_reading(Codec(n, 1), Reading(1000, (2.0 * n, 3.0), 5.0, (1.5, 0.5), 0.5)) for n in (1, 2, 3)]


def stop_seeds() -> list[bytes]:
    return [
        recorded("greedy-gaussian")["agdc/stop"][0],
        msgspec.json.encode(Stop(5, 1, (1.0, 2.0), (0.1, 0.0, 0.1), 0.4, 0.5, "spread")),
    ]


def stop(data: bytes) -> None:
    """The vehicle takes any payload as a stop; one that is refused does not end the search."""
    flight = _Flight(searching=True)
    assert flight.bus.tally.state == SEARCHING
    flight.goes_on(Arrival(STOP, data, b""), 0.0)
    assert (flight.bus.tally.state == RETURNING) != bool(flight.bus.tally.refused)
    _lives_on(flight)


# ---- frames in a stream: UDP and the bridge ----


def frames_seeds() -> list[bytes]:
    unknown = bytes([0xFD, 1, 0, 0, 0, 1, 1, 0xFF, 0xFF, 0x7F, 5, 0, 0])
    one = mavlink_in_seeds()
    return [
        *recorded()["mavlink/out"][:4],
        one[0] + one[3] + unknown + one[14],
        b"\xfd" * 40 + one[2],
        one[1][:-3] + one[2],
    ]


def frames(data: bytes) -> None:
    """Every byte is in a frame, garbage or kept for later."""
    payload = as_sent(data)
    for datagram in (False, True):
        stream, routes = FrameStream(), Routes()
        routes.join(1)
        half = len(payload) // 2
        frames = [
            frame
            for part in (payload[:half], payload[half:])
            for frame in stream.take(part, datagram=datagram)
        ]
        assert sum(len(frame.data) for frame in frames) + stream.garbage + len(stream.rest) == len(payload)
        assert len(stream.rest) <= 280
        for frame in frames:
            routes.route(frame, 1, 0.0)
