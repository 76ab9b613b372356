"""A search on an autopilot double, in step: no sockets, and time passes only when a test says so."""

import math
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from link.bus.log import Log
from link.bus.mavlink import Codec, Message, unpack, unpack_waypoint, waypoint_message
from link.bus.messages import Stop
from link.bus.tally import Tally
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.state import Arrived, Led, Mode, Said, VehicleFailed
from sitl.bridge.links import Channel, Traffic
from sitl.protocol.protocol import MavlinkProtocol
from sitl.remote.commander import Commander
from sitl.remote.connection import Heard
from sitl.remote.refused import not_served
from sitl.remote.vehicle import RemoteVehicle
from sitl.uav.search import Search
from tests.autopilots.body import DT_S
from tests.autopilots.settings import Settings
from tests.autopilots.wire import Wire

STEPS = 4
"""Time steps of the double between two looks: 80 ms."""
START = (4.0, 2.0)


class Radio:
    """A connection without a socket: frames go straight to the double."""

    state = ""

    def __init__(self, wire: Wire) -> None:
        self.wire = wire
        self.sent: list[Message] = []
        self._codec = Codec(0, 191)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._link = Channel(Traffic("double", Log("uav", "test", Tally(), "error")), lambda _: None, "double")
        self._heard: list[Heard] = []

    def send(self, message: Message) -> None:
        self.sent.append(message)
        self.wire.hear(self._codec.pack(message))

    def use(self, link: Channel, system: int) -> None:
        assert link is self._link
        self._codec = Codec(system, 191)

    def poll(self, wait_s: float = 0.0) -> list[Heard]:
        heard, self._heard = self._heard, []
        return heard

    def advance(self) -> None:
        for frame in self.wire.advance(STEPS):
            self._heard += [Heard(message, self._link) for message in self._parser.parse_buffer(frame) or ()]


class Cockpit:
    """A double, the vehicle that flies it, its search, and an agent that goes 1 m further at each reading."""

    def __init__(
        self, kind: str, *faults: str, after_stop: Any = "return", parameters: dict[str, float] | None = None, **settings: Any
    ) -> None:
        settings = {"ready_s": 6.0, **settings}
        self.wire = Wire(kind, Settings(faults=faults, parameters=tuple((parameters or {}).items()), **settings))
        self.radio = Radio(self.wire)
        self.vehicle = RemoteVehicle(VehicleConfig(), Commander(self.radio))
        self.protocol = MavlinkProtocol(self.vehicle)
        self.protocol.services |= {service.request: service for service in not_served()}
        self.search = Search(self.vehicle, self.protocol, START, after_stop, lambda _, text: self.said.append(text), lambda: self.now_s)
        self.said: list[str] = []
        self.readings: list[tuple[float, tuple[float, float, float]]] = []
        """Time and reported place, north, east, down from the area's corner."""
        self.truths: list[tuple[float, float, float]] = []
        """Where the double truly was then, from home."""
        self.now_s = 0.0
        self.answers: Callable[[Cockpit], tuple[float, float] | None] = lambda cockpit: onwards(cockpit.readings[-1][1])
        """The next waypoint (x, y); None: no answer."""
        self.thinks_s = 0.3
        self.answer_at: float | None = None
        """When the agent's next waypoint is due."""

    def step(self) -> None:
        """One look."""
        self.radio.advance()
        self.now_s += STEPS * DT_S
        for event in self.vehicle.advance(self.now_s):
            if isinstance(event, Said):
                self.said.append(event.text)
            elif isinstance(event, Led):
                self.search.led(event.mode, event.given_back)
            elif isinstance(event, Arrived) and self.search.measures:
                self.readings.append((self.now_s, event.position))
                self.truths.append(tuple(at - home for at, home in zip(self.ap.body.position, self.ap.home, strict=True)))
                self.search.answers.sampled(round(self.now_s * 1000))
                self.answer_at = self.now_s + self.thinks_s
        self.search.go_on(searchers=True)
        if self.answer_at is not None and self.now_s >= self.answer_at:
            self.answer_at = None
            if (place := self.answers(self)) is not None:
                self.answer(place)

    def answer(self, place: tuple[float, float]) -> None:
        """Answer the newest reading as the agent does."""
        newest = self.search.answers.newest
        assert newest is not None
        self.search.answer(unpack_waypoint(Codec(1, 191).pack(waypoint_message(1, newest, place, 5.0)), 1), self.now_s)

    def tell(self, message: Message, sender: tuple[int, int] = (255, 190)) -> list[Message]:
        """Say something to the vehicle on the bus; returns the answers."""
        (heard,) = unpack(Codec(*sender).pack(message))
        return self.search.receive(heard, self.now_s, "on the bus")

    def run(self, seconds: float) -> None:
        """Let time pass."""
        until_s = self.now_s + seconds
        while self.now_s < until_s:
            self.step()

    def until(self, holds: Callable[[], object], most_s: float = 120.0) -> None:
        """Let time pass until something holds."""
        began_s = self.now_s
        while not holds():
            assert self.now_s - began_s < most_s, f"not true within {most_s:g} s; said: {self.said}"
            self.step()

    def fails(self, most_s: float = 200.0) -> str:
        """Let time pass until the mission has failed and the vehicle stands; returns the reason, as the uav service gives it."""
        began_s = self.now_s
        while not (self.vehicle.failure and not self.vehicle.state(self.now_s).armed):
            assert self.now_s - began_s < most_s, f"not failed within {most_s:g} s; said: {self.said}"
            try:
                self.step()
            except VehicleFailed as failure:
                return str(failure)
        return self.vehicle.failure

    def finds(self) -> None:
        """The estimator declares the stop."""
        self.search.declare(Stop(0, 0, (1.0, 2.0), ((0.1, 0.0), (0.0, 0.1)), 0.1, 0.5))

    def reads(self, number: int) -> None:
        """Let time pass until so many readings are taken."""
        self.until(lambda: len(self.readings) >= number)

    @property
    def ap(self) -> Any:
        """The double."""
        return self.wire.autopilot

    @property
    def mode(self) -> Mode:
        """As the vehicle reports it on the bus."""
        return self.vehicle.state(self.now_s).mode

    def heard(self, text: str) -> bool:
        """Whether people were told this."""
        return any(text in said for said in self.said)


def onwards(place: tuple[float, float, float]) -> tuple[float, float]:
    """1 m further east, within the area."""
    return min(place[1] + 1.0, 29.0), min(max(place[0], 0.0), 29.0)


def away_m(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    """Distance in m."""
    return math.dist(one, other)
