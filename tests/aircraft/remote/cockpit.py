"""A search on an autopilot double, in step: no sockets, and time passes only when a test says so."""

import math
from collections import Counter
from collections.abc import Callable
from copy import copy
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from aircraft.remote.commander import Commander
from aircraft.remote.passing import RealClients
from aircraft.remote.safety import Check, Verdict
from aircraft.remote.vehicle import RemoteVehicle
from aircraft.search.clock import Clock
from aircraft.search.search import STANDBY, Search
from aircraft.search.uav import Handling
from aircraft.state import Arrived, Said, TakenOver, VehicleFailed
from aircraft.together import Berth
from link.bus.frames import frames_in
from link.bus.keys import MAVLINK_IN, MAVLINK_OUT, Key
from link.bus.log import Log
from link.bus.mavlink import Codec, Message, unpack, unpack_waypoint, waypoint_message
from link.bus.messages import Stop
from link.bus.session import Arrival, Bus
from link.bus.tally import Tally
from link.modes import Mode
from sitl.autopilot.config import VehicleConfig
from tests.autopilots.body import DT_S
from tests.autopilots.settings import Settings
from tests.autopilots.wire import Wire

STEPS = 4
"""Time steps of the double between two looks: 80 ms."""
START = (4.0, 2.0)


class Radio:
    """A connection without a socket: frames go straight to the double."""

    state = sent_home = ""

    def __init__(self, wire: Wire) -> None:
        self.wire = wire
        self.sent: list[Message] = []
        self._codec = Codec(0, 191)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._heard: list[Message] = []
        self._system = 0
        self._frames: list[bytes] = []
        self.said: list[bytes] = []
        """All frames that came from the double since it was found."""
        self.forwarded: list[bytes] = []
        """What was handed on to it."""
        self.late: dict[str, float] = {}
        """How long, in s, something is on its way: a message type, or `mode` and `status` of HEARTBEATs.
        """
        self.lost: Counter[str] = Counter()
        """How many of the next messages of a type do not arrive at the double."""
        self._now_s = 0.0
        self._way: list[tuple[float, Message]] = []
        self._beats: list[tuple[float, Message]] = []

    def send(self, message: Message) -> None:
        self.sent.append(message)
        if self.lost[message.get_type()]:
            self.lost[message.get_type()] -= 1
        else:
            self.wire.hear(self._codec.pack(message))

    def use(self, system: int) -> None:
        if system != self._system:
            self._system, self._codec = system, Codec(system, 191)

    def frames(self) -> list[bytes]:
        frames, self._frames = self._frames, []
        return frames

    def forward(self, frame: bytes) -> None:
        self.forwarded.append(frame)
        self.wire.hear(frame)

    def poll(self) -> list[Message]:
        heard, self._heard = self._heard, []
        return heard

    def advance(self) -> None:
        self._now_s += STEPS * DT_S
        for frame in self.wire.advance(STEPS):
            if self._system:
                self._frames.append(frame)
                self.said.append(frame)
            self._way += [(self._now_s, message) for message in self._parser.parse_buffer(frame) or ()]
        due = [one for one in self._way if one[0] + self.late.get(one[1].get_type(), 0.0) <= self._now_s]
        self._way = [one for one in self._way if one not in due]
        self._heard += [self._mixed(message) for _, message in due]

    def hear(self, message: Message, sender: tuple[int, int] = (1, 1)) -> None:
        """Something else comes over the link."""
        (heard,) = self._parser.parse_buffer(Codec(*sender).pack(message))
        self._heard.append(heard)

    def _mixed(self, message: Message) -> Message:
        """A HEARTBEAT as it is heard if its mode or its status came later than the rest."""
        if message.get_type() == "HEARTBEAT" and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID:
            self._beats.append((self._now_s, copy(message)))
            for name, field in (("mode", "custom_mode"), ("status", "system_status")):
                then = [
                    beat for at_s, beat in self._beats if at_s <= self._now_s - self.late.get(name, 0.0)
                ] or [message]
                setattr(message, field, getattr(then[-1], field))
        return message


class OneEnd(Bus):
    """A bus without a router, which keeps what the vehicle publishes."""

    def __init__(self, log: Log) -> None:
        self.log, self.tally = log, log.tally
        self.published: list[bytes] = []
        """Payloads of `mavlink/out`."""

    def publish(self, key: Key, message: bytes | Any, attachment: bytes | None = None) -> None:
        if key is MAVLINK_OUT:
            self.published.append(message)

    def frames(self, component: int) -> list[bytes]:
        """Return what a component has said on `mavlink/out`, frame by frame."""
        said = [frame for payload in self.published for frame in frames_in(payload)]
        return [frame.data for frame in said if frame.component == component]

    def heard(self, component: int = 191) -> list[Message]:
        """Return what a component has said on `mavlink/out`; first that of the search."""
        parser = mavlink.MAVLink(None)
        return [parser.decode(bytearray(frame)) for frame in self.frames(component)]


class Told(Clock):
    """A clock that stands where its cockpit is."""

    def __init__(self, cockpit: "Cockpit") -> None:
        super().__init__(1.0)
        self._cockpit = cockpit

    def now_s(self) -> float:
        return self._cockpit.now_s


class Cockpit:
    """A double, the vehicle that flies it, its search, and an agent that goes 1 m further at each reading."""

    def __init__(
        self,
        kind: str,
        *faults: str,
        after_stop: Any = "return",
        parameters: dict[str, float] | None = None,
        outs: tuple[str, ...] = (),
        wait_s: float = math.inf,
        launched: bool = False,
        speedup: float = 1.0,
        berth: Berth | None = None,
        config: VehicleConfig | None = None,
        **settings: Any,
    ) -> None:
        settings = {"ready_s": 6.0, **settings}
        self.wire = Wire(
            kind, Settings(faults=faults, parameters=tuple((parameters or {}).items()), **settings)
        )
        self.radio = Radio(self.wire)
        self.log = Log("uav", "test", Tally(), "warning")
        commander = Commander(self.radio, speedup, handling=Handling(self.log).of)
        self.vehicle = RemoteVehicle(
            config or VehicleConfig(), commander, wait_s=wait_s, launched=launched, berth=berth
        )
        self.search = Search(self.vehicle, START, after_stop, lambda _, text: self.said.append(text))
        self.bus = OneEnd(Log("uav", "test", Tally(), "error"))
        self.clients = RealClients(
            self.vehicle, self.search, self.bus, outs, Told(self), Handling(self.bus.log), None
        )
        self.said: list[str] = []
        self.wind = Check("wind", Verdict.OK, "given by --wind")
        """What the payload's first answer leads to."""
        self.absent: set[str] = set()
        """Services that are not there."""
        self.readings: list[tuple[float, tuple[float, float, float]]] = []
        """Time and reported place, north, east, down from the area's corner."""
        self.truths: list[tuple[float, float, float]] = []
        """Where the double truly was then, from home."""
        self.now_s = 0.0
        self.answers: Callable[[Cockpit], tuple[float, float] | None] = lambda cockpit: onwards(
            cockpit.readings[-1][1]
        )
        """The next waypoint (x, y); None: no answer."""
        self.thinks_s = 0.3
        self.answer_at: float | None = None
        """When the agent's next waypoint is due."""

    def step(self) -> None:
        """One look."""
        self.vehicle.preflight.take_wind(self.wind)
        self.radio.advance()
        self.now_s += STEPS * DT_S
        for event in self.vehicle.advance(self.now_s):
            if isinstance(event, Said):
                self.said.append(event.text)
            elif isinstance(event, TakenOver):
                self.search.taken_over(event.mode, event.by)
            elif isinstance(event, Arrived) and self.search.measures:
                self.readings.append((self.now_s, event.position))
                self.truths.append(
                    tuple(at - home for at, home in zip(self.ap.body.position, self.ap.home, strict=True))
                )
                self.search.answers.sampled(round(self.now_s * 1000))
                self.answer_at = self.now_s + self.thinks_s
        self.search.go_on(searchers=not self.absent)
        if self.search.state == STANDBY:
            self.vehicle.preflight.bound(self.search.waits_for, self.absent)
        self.clients.serve()
        if self.answer_at is not None and self.now_s >= self.answer_at:
            self.answer_at = None
            if (place := self.answers(self)) is not None:
                self.answer(place)

    def answer(self, place: tuple[float, float]) -> None:
        """Answer the newest reading as the agent does."""
        newest = self.search.answers.newest
        assert newest is not None
        system = self.ap.system
        frame = Codec(system, 191).pack(waypoint_message(system, newest, place, 5.0))
        self.search.answer(unpack_waypoint(frame, system), self.now_s)

    def tell(self, message: Message, sender: tuple[int, int] = (255, 190)) -> list[Message]:
        """Say something on the bus; returns what the search answers at once."""
        before = len(self.bus.published)
        self.hear(Codec(*sender).pack(message))
        return [answer for payload in self.bus.published[before:] for answer in unpack(payload)]

    def hear(self, payload: bytes) -> None:
        """Hear a payload on `mavlink/in`."""
        self.clients.take(Arrival(MAVLINK_IN, payload, b""))

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
        """Let time pass until the mission has failed and the vehicle stands; returns the reason, as the
        uav service gives it.
        """
        began_s = self.now_s
        while not (self.vehicle.failure and not self.vehicle.armed):
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
        return self.vehicle.mode

    @property
    def checks(self) -> list[str]:
        """The lines of the list before arming."""
        return [said.removeprefix("Check: ") for said in self.said if said.startswith("Check: ")]

    def heard(self, text: str) -> bool:
        """Whether people were told this."""
        return any(text in said for said in self.said)


def onwards(place: tuple[float, float, float]) -> tuple[float, float]:
    """1 m further east, within the area."""
    return min(place[1] + 1.0, 29.0), min(max(place[0], 0.0), 29.0)


def away_m(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    """Distance in m."""
    return math.dist(one, other)
