"""The conversation with one autopilot: it is found, asked for telemetry, and commanded until it
acknowledges.
"""

import itertools
import math
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol, TypeVar

from pymavlink.dialects.v20 import all as mavlink

from aircraft.operator import DONE_S, REASON_S, TRIES, CommandRun, command
from aircraft.remote.firmware import FIRMWARES, unfit
from aircraft.remote.known import Known
from aircraft.state import ACCEPTED, Result, VehicleFailed
from link.bus.mavlink import ONBOARD_COMPUTER, Message

AGAIN_S = 1.0
"""Time after which what is unanswered is sent again."""
SHORTEST_S = 0.5
"""Shortest real time for any answer, however fast the vehicle's simulator runs."""
SLOWEST_S = 2.0
"""Shortest real time after which a vehicle that says nothing counts as lost, however fast its simulator
runs.
"""
BEAT_S = 1.0
"""Longest time between two HEARTBEATs, of the vehicle's and of real time."""
STREAMS_S = 2.0
"""Time between two looks at which streams are missing."""
MOST_UNFIT = 8
"""So many kinds of HEARTBEATs that are not the vehicle's are told."""
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1

Returned = TypeVar("Returned")
Steps = Generator[None, None, Returned]
"""Something that takes a while: it is resumed at each poll."""


class Radio(Protocol):
    """What a `Commander` needs of a connection."""

    def send(self, message: Message) -> None:
        """Send a message as a companion computer."""

    def poll(self) -> list[Message]:
        """Return what has come."""

    def use(self, system: int) -> None:
        """Speak as a companion of a system from now on."""

    def frames(self) -> list[bytes]:
        """Return the vehicle's own frames as they came, since the last call."""

    def forward(self, frame: bytes) -> None:
        """Send a frame of someone else as it is."""

    @property
    def state(self) -> str:
        """How the connection is doing."""

    @property
    def sent_home(self) -> str:
        """Why the vehicle was sent home by another process in our place; empty if it was not."""


def _is_ours(ack: Message, system: int) -> bool:
    """Whether an acknowledgement is for us: clients' commands are handed on to the same autopilot."""
    return ack.target_system in (0, system) and ack.target_component in (0, ONBOARD_COMPUTER)


class Commander:
    """Keeps up what is known of one vehicle, and commands it. Times are of the vehicle's own clock, s,
    except where said.
    """

    def __init__(
        self,
        radio: Radio,
        speedup: float = 1.0,
        system: int | None = None,
        handling: Callable[[Message], AbstractContextManager[None]] = lambda _: nullcontext(),
    ) -> None:
        """Take the connection.

        speedup: how fast the vehicle's simulator runs; system: the vehicle's id, None takes the first
        heard;
        handling: what a message is read in, so that a fault of ours ends nothing.
        """
        self.known = Known(slowest_s=SLOWEST_S * speedup)
        self.system = 0
        """The vehicle's system id; 0 until it is found."""
        self.now_s = 0.0
        self.quiet = False
        """Whether only HEARTBEATs go out unasked: a pilot leads."""
        self.ignored: list[str] = []
        """What is not listened to, and why, in words; each once."""
        self.radio = radio
        self._handling = handling
        self._unfit: set[str] = set()
        self.wanted = system
        """The only system id that is taken; None: the first heard."""
        self.speedup = speedup
        self._running: CommandRun | None = None
        self.in_charge = False
        """Whether the vehicle is in our charge, which our HEARTBEAT says: ACTIVE, else STANDBY. The keeper
        goes by it.
        """
        self._beat_s = self._streams_s = -math.inf
        self._state = mavlink.MAV_STATE_UNINIT

    def patient(self, seconds: float) -> float:
        """Return a time for an answer: at least `SHORTEST_S` of real time."""
        return max(seconds, SHORTEST_S * self.speedup)

    # ---- what goes in and out all the time ----

    def poll(self, now_s: float) -> None:
        """Take what has come, and send what is due. Raises VehicleFailed if this is no vehicle for a
        search.
        """
        if (
            now_s - self.now_s > SLOWEST_S * self.speedup
        ):  # we were held up: what has come meanwhile is not read yet
            self.known.heard_s += now_s - self.now_s
        self.now_s = now_s
        state = mavlink.MAV_STATE_ACTIVE if self.in_charge else mavlink.MAV_STATE_STANDBY
        due = now_s - self._beat_s >= min(
            BEAT_S, self.speedup
        )  # the autopilot's failsafes count by its time, people by real time
        if due or state != self._state:
            self._beat_s, self._state = now_s, state
            kind, none = mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID
            self.radio.send(mavlink.MAVLink_heartbeat_message(kind, none, 0, 0, state, 3))
        for message in self.radio.poll():
            with self._handling(message):
                self._take(message)
        if self.system and not self.quiet and now_s - self._streams_s >= self.patient(STREAMS_S):
            self._streams_s = now_s
            self._ask_for_streams()

    def _take(self, message: Message) -> None:
        system = message.get_srcSystem()
        if message.get_srcComponent() != AUTOPILOT or system != (self.system or self.wanted or system):
            return
        if message.get_type() == "HEARTBEAT":
            if message.autopilot == mavlink.MAV_AUTOPILOT_INVALID:
                return
            reason = unfit(message)
            if reason and not self.system:
                raise VehicleFailed(f"system {system}: {reason}")
            if not reason and self.system and FIRMWARES[message.autopilot] is not self.known.firmware:
                reason = f"this is not {self.known.firmware.name}"
            if reason:  # a gimbal or a companion that has taken the vehicle's ids
                if reason not in self._unfit and len(self._unfit) < MOST_UNFIT:
                    self._unfit.add(reason)
                    self.ignored.append(
                        f"Another HEARTBEAT with the vehicle's ids, {system}/{AUTOPILOT}, is ignored: "
                        f"{reason}"
                    )
                return
            self.system = system
            self.radio.use(system)
        if not self.system:
            return
        if message.get_type() == "COMMAND_ACK" and self._running and _is_ours(message, system):
            self._running.acknowledged(message.command, message.result, self.now_s)
        self.known.take(message, self.now_s)

    def _ask_for_streams(self) -> None:
        """Ask for the messages that do not come: ArduPilot streams none of them unasked, and forgets them
        when it starts again.
        """
        number = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        for wanted, rate_hz in self.known.firmware.streams.items():
            if self.now_s - self.known.came_s.get(wanted, -math.inf) > self.patient(
                max(STREAMS_S, 3.0 / rate_hz)
            ):
                self.send(number, float(wanted), 1e6 / rate_hz)
                if (
                    wanted not in self.known.came_s
                ):  # some autopilots stream no GPS_GLOBAL_ORIGIN, but say it when asked
                    self.send(mavlink.MAV_CMD_REQUEST_MESSAGE, float(wanted))

    def send(self, number: int, *params: float) -> None:
        """Send MAV_CMD `number` once; parameters not given are 0."""
        self.radio.send(command(self.system, number, *params))

    # ---- what takes a while ----

    def command(
        self, number: int, *params: float, seen: Callable[[], bool], within_s: float = DONE_S
    ) -> Steps[Result]:
        """Send MAV_CMD `number` until it is done (`CommandRun`); a refusal has the texts that came with
        it.
        """
        if seen():
            return ACCEPTED
        began_s = self.now_s
        run = self._running = CommandRun(
            command(self.system, number, *params),
            seen,
            lambda: self.known.warned(began_s),
            self.patient(AGAIN_S),
            self.patient(within_s),
            self.patient(REASON_S),
        )
        while (result := run.over(self.now_s)) is None:
            if copy := run.send(self.now_s):
                self.radio.send(copy)
            yield
        return result

    def until(self, holds: Callable[[], bool], for_s: float) -> Steps[bool]:
        """Wait until something holds, for at most so long; returns whether it does."""
        until_s = self.now_s + for_s
        while not (so := holds()) and self.now_s < until_s:
            yield
        return so

    def read_parameters(self, names: tuple[str, ...]) -> Steps[None]:
        """Read parameters into `known`; those that are not answered stay unknown. `A|B`: one or the other,
        whichever there is.
        """

        def missing() -> list[list[str]]:
            return [
                either for name in names if not self.known.parameters.keys() & (either := name.split("|"))
            ]

        for _ in range(TRIES):
            for name in itertools.chain(*missing()):
                self.radio.send(
                    mavlink.MAVLink_param_request_read_message(self.system, AUTOPILOT, name.encode(), -1)
                )
            if (yield from self.until(lambda: not missing(), self.patient(AGAIN_S))):
                return
