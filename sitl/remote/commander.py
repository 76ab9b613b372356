"""The conversation with one autopilot: it is found, asked for telemetry, and commanded until it acknowledges."""

import itertools
import math
from collections.abc import Callable, Generator
from typing import Protocol, TypeVar

from pymavlink.dialects.v20 import all as mavlink

from link.bus.mavlink import Message
from sitl.autopilot.state import ACCEPTED, Result, VehicleFailed, not_now
from sitl.bridge.links import Channel
from sitl.remote.connection import Heard
from sitl.remote.firmware import unfit
from sitl.remote.known import Known

AGAIN_S = 1.0
"""Time after which an unacknowledged command is sent again."""
TRIES = 5
PATIENT_S = 10.0
"""Longest time for a command that the autopilot says is in progress."""
CONFIRMED_S = 3.0
"""Longest time until telemetry shows what an acknowledged command has changed: a HEARTBEAT comes once a second."""
REASONS_S = 0.3
"""Time in which the text with the reason follows a refusal."""
SHORTEST_S = 0.5
"""Shortest real time for any answer, however fast the vehicle's simulator runs."""
SLOWEST_S = 2.0
"""Shortest real time after which a vehicle that says nothing counts as lost, however fast its simulator runs."""
BEAT_S = 1.0
"""Longest time between two HEARTBEATs, of the vehicle's and of real time."""
STREAMS_S = 2.0
"""Time between two looks at which streams are missing."""
NO_ANSWER = "no answer"
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1

Returned = TypeVar("Returned")
Steps = Generator[None, None, Returned]
"""Something that takes a while: it is resumed at each poll."""


class Radio(Protocol):
    """What a `Commander` needs of a connection."""

    def send(self, message: Message) -> None:
        """Send a message as a companion computer."""

    def poll(self, wait_s: float = 0.0) -> list[Heard]:
        """Return what has come."""

    def use(self, link: Channel, system: int) -> None:
        """Speak on this link from now on, as a companion of a system."""

    @property
    def state(self) -> str:
        """How the connection is doing."""


class Commander:
    """Keeps up what is known of one vehicle, and commands it. Times are of the vehicle's own clock, s, except where said."""

    def __init__(self, radio: Radio, speedup: float = 1.0, system: int | None = None) -> None:
        """Take the connection. speedup: how fast the vehicle's simulator runs. system: the vehicle's id; None takes the first heard."""
        self.known = Known(slowest_s=SLOWEST_S * speedup)
        self.system = 0
        """The vehicle's system id; 0 until it is found."""
        self.now_s = 0.0
        self.radio = radio
        self._wanted = system
        self.speedup = speedup
        self._acknowledged: dict[int, Message] = {}
        self._beat_s = self._streams_s = -math.inf

    def patient(self, seconds: float) -> float:
        """Return a time for an answer: at least `SHORTEST_S` of real time."""
        return max(seconds, SHORTEST_S * self.speedup)

    # ---- what goes in and out all the time ----

    def poll(self, now_s: float) -> None:
        """Take what has come, and send what is due. Raises VehicleFailed if this is no vehicle for a search."""
        self.now_s = now_s
        if now_s - self._beat_s >= min(BEAT_S, self.speedup):  # the autopilot's failsafes count by its time, people by real time
            self._beat_s = now_s
            kind, none = mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID
            self.radio.send(mavlink.MAVLink_heartbeat_message(kind, none, 0, 0, mavlink.MAV_STATE_ACTIVE, 3))
        for message, link in self.radio.poll():
            self._take(message, link)
        if self.system and now_s - self._streams_s >= self.patient(STREAMS_S):
            self._streams_s = now_s
            self._ask_for_streams()

    def _take(self, message: Message, link: Channel) -> None:
        system = message.get_srcSystem()
        if message.get_srcComponent() != AUTOPILOT or system != (self.system or self._wanted or system):
            return
        if message.get_type() == "HEARTBEAT":
            if message.autopilot == mavlink.MAV_AUTOPILOT_INVALID:
                return
            if reason := unfit(message):
                raise VehicleFailed(f"system {system}: {reason}")
            self.system = system
            self.radio.use(link, system)  # a vehicle may come back on another link
        if not self.system:
            return
        if message.get_type() == "COMMAND_ACK":
            self._acknowledged[message.command] = message
        self.known.take(message, self.now_s)

    def _ask_for_streams(self) -> None:
        """Ask for the messages that do not come: ArduPilot streams none of them unasked, and forgets them when it starts again."""
        number = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        for wanted, rate_hz in self.known.firmware.streams.items():
            if self.now_s - self.known.came_s.get(wanted, -math.inf) > self.patient(max(STREAMS_S, 3.0 / rate_hz)):
                self.send(number, float(wanted), 1e6 / rate_hz)

    def send(self, number: int, *params: float, attempt: int = 0) -> None:
        """Send MAV_CMD `number`; parameters not given are 0."""
        filled = (*params, *[0.0] * (7 - len(params)))
        self.radio.send(mavlink.MAVLink_command_long_message(self.system, AUTOPILOT, number, attempt, *filled))

    # ---- what takes a while ----

    def command(self, number: int, *params: float, seen: Callable[[], bool], within_s: float = CONFIRMED_S) -> Steps[Result]:
        """Send MAV_CMD `number` until it is acknowledged and telemetry shows what it does; a refusal has the texts that came with it.

        Telemetry counts, not the acknowledgement: that of a command that was obeyed may be lost, and its repetition refused.
        """
        if seen():
            return ACCEPTED
        self._acknowledged.pop(number, None)
        began_s = self.now_s
        for attempt in range(TRIES):
            self.send(number, *params, attempt=attempt)
            if (yield from self.until(lambda: seen() or number in self._acknowledged, self.patient(AGAIN_S))):
                break
        else:
            return not_now(NO_ANSWER)
        yield from self.until(lambda: seen() or not self._in_progress(number), PATIENT_S)
        result = self._acknowledged[number].result if number in self._acknowledged else mavlink.MAV_RESULT_ACCEPTED
        if result == mavlink.MAV_RESULT_ACCEPTED:
            shown = yield from self.until(seen, self.patient(within_s))
            return ACCEPTED if shown else not_now("acknowledged, and not done")
        yield from self.until(lambda: seen() or bool(self.known.warned(began_s)), self.patient(REASONS_S))
        if seen():
            return ACCEPTED
        said = self.known.warned(began_s)
        return Result(result, said or mavlink.enums["MAV_RESULT"][result].name.removeprefix("MAV_RESULT_").lower().replace("_", " "))

    def _in_progress(self, number: int) -> bool:
        return number not in self._acknowledged or self._acknowledged[number].result == mavlink.MAV_RESULT_IN_PROGRESS

    def until(self, holds: Callable[[], bool], for_s: float) -> Steps[bool]:
        """Wait until something holds, for at most so long; returns whether it does."""
        until_s = self.now_s + for_s
        while not (so := holds()) and self.now_s < until_s:
            yield
        return so

    def read_parameters(self, names: tuple[str, ...]) -> Steps[None]:
        """Read parameters into `known`; those that are not answered stay unknown. `A|B`: one or the other, whichever there is."""

        def missing() -> list[list[str]]:
            return [either for name in names if not self.known.parameters.keys() & (either := name.split("|"))]

        for _ in range(TRIES):
            for name in itertools.chain(*missing()):
                self.radio.send(mavlink.MAVLink_param_request_read_message(self.system, AUTOPILOT, name.encode(), -1))
            if (yield from self.until(lambda: not missing(), self.patient(AGAIN_S))):
                return
