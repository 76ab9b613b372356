"""The conversation with one autopilot: it is found, asked for telemetry, and commanded."""

import itertools
import math
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar

from pymavlink.dialects.v20 import all as mavlink

from aircraft.firmware import FIRMWARES, unfit
from aircraft.keeper.connection import Connection
from aircraft.operator import AUTOPILOT, DONE_S, REASON_S, TRIES, CommandRun, command, companion_heartbeat
from aircraft.remote.known import Known
from aircraft.state import ACCEPTED, Result, VehicleFailed
from link.bus.mavlink import ONBOARD_COMPUTER, Message

AGAIN_S = 1.0  # time after which what is unanswered is sent again
SHORTEST_S = 0.5  # shortest real time for any answer, however fast the vehicle's simulator runs
# Shortest real time after which a vehicle that says nothing counts as lost, however fast its simulator runs.
SLOWEST_S = 2.0
BEAT_S = 1.0  # longest time between two HEARTBEATs, of the vehicle's and of real time
STREAMS_S = 2.0  # time between two looks at which streams are missing
MOST_UNFIT = 8  # kinds of HEARTBEATs that are not the vehicle's and are told

Returned = TypeVar("Returned")
Steps = Generator[None, None, Returned]  # something that takes a while: it is resumed at each poll


class Commander:
    """Keeps up what is known of one vehicle, and commands it.

    Times are of the vehicle's own clock, s, except where said.
    """

    def __init__(
        self,
        radio: Connection,
        speedup: float = 1.0,
        system: int | None = None,
        handling: Callable[[Message], AbstractContextManager[None]] = lambda _: nullcontext(),
    ) -> None:
        """Take the connection.

        speedup: how fast the vehicle's simulator runs; system: the vehicle's id, None takes the first
        heard; handling: what a message is read in, so that a fault of ours ends nothing.
        """
        self.radio, self.speedup, self.wanted = radio, speedup, system
        self.known = Known(slowest_s=SLOWEST_S * speedup)
        self.system = 0  # the vehicle's system id; 0 until it is found
        self.now_s = 0.0
        self.quiet = False  # whether only HEARTBEATs go out unasked: a pilot leads
        # Whether the vehicle is in our charge, which our HEARTBEAT says: ACTIVE, else STANDBY. The keeper
        # goes by it.
        self.in_charge = False
        self.ignored: list[str] = []  # what is not listened to, and why, in words; each once
        self._handling = handling
        self._unfit: set[str] = set()
        self._running: CommandRun | None = None
        self._beat_s = self._streams_s = -math.inf
        self.refused_s = -math.inf  # when the autopilot has last refused a client's command
        self._state = mavlink.MAV_STATE_UNINIT

    def patient(self, seconds: float) -> float:
        """Return a time for an answer: at least `SHORTEST_S` of real time."""
        return max(seconds, SHORTEST_S * self.speedup)

    # ---- what goes in and out all the time ----

    def poll(self, now_s: float) -> None:
        """Take what has come, and send what is due.

        Raises VehicleFailed if this is no vehicle for a search.
        """
        if now_s - self.now_s > SLOWEST_S * self.speedup:
            # we were held up: what has come meanwhile is not read yet
            self.known.heard_s += now_s - self.now_s
        self.now_s = now_s
        self._beat()
        for message in self.radio.poll():
            with self._handling(message):
                self._take(message)
        if self.system and not self.quiet and now_s - self._streams_s >= self.patient(STREAMS_S):
            self._streams_s = now_s
            self._ask_for_streams()

    def _beat(self) -> None:
        """Send a HEARTBEAT if it is due: the autopilot's failsafes count by its time, people by real time."""
        state = mavlink.MAV_STATE_ACTIVE if self.in_charge else mavlink.MAV_STATE_STANDBY
        if state == self._state and self.now_s - self._beat_s < min(BEAT_S, self.speedup):
            return
        self._beat_s, self._state = self.now_s, state
        self.radio.send(companion_heartbeat(state))

    def _take(self, message: Message) -> None:
        system, kind = message.get_srcSystem(), message.get_type()
        if message.get_srcComponent() != AUTOPILOT or system != (self.system or self.wanted or system):
            return
        if (kind == "HEARTBEAT" and not self._is_the_vehicles(message, system)) or not self.system:
            return
        if kind == "COMMAND_ACK" and not _is_ours(message, system):
            if message.result not in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS):
                self.refused_s = self.now_s
        elif kind == "COMMAND_ACK" and self._running:
            self._running.acknowledged(message.command, message.result, self.now_s)
        self.known.take(message, self.now_s)

    def _is_the_vehicles(self, message: Message, system: int) -> bool:
        """Whether a HEARTBEAT is the vehicle's, which the first one that is fit finds."""
        if message.autopilot == mavlink.MAV_AUTOPILOT_INVALID:
            return False
        reason = unfit(message)
        if reason and not self.system:
            raise VehicleFailed(f"system {system}: {reason}")
        if not reason and self.system and FIRMWARES[message.autopilot] is not self.known.firmware:
            reason = f"this is not {self.known.firmware.name}"
        if not (reason or self.system):
            self.system, self._beat_s = system, -math.inf
            self.radio.use(system)
            self._beat()  # before anything of a stranger: it tells the keeper whose companion we are
        elif reason and reason not in self._unfit and len(self._unfit) < MOST_UNFIT:
            # a gimbal or a companion that has taken the vehicle's ids
            self._unfit.add(reason)
            self.ignored.append(
                f"Another HEARTBEAT with the vehicle's ids, {system}/{AUTOPILOT}, is ignored: {reason}"
            )
        return not reason

    def _ask_for_streams(self) -> None:
        """Ask for the messages that do not come.

        ArduPilot streams none of them unasked, and forgets them when it starts again.
        """
        came_s = self.known.came_s
        for wanted, rate_hz in self.known.firmware.streams.items():
            late_s = self.patient(max(STREAMS_S, 3.0 / rate_hz))
            if self.now_s - came_s.get(wanted, -math.inf) > late_s:
                self.send(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(wanted), 1e6 / rate_hz)
                if wanted not in came_s:  # some autopilots stream no GPS_GLOBAL_ORIGIN, but say it when asked
                    self.send(mavlink.MAV_CMD_REQUEST_MESSAGE, float(wanted))

    def send(self, number: int, *params: float) -> None:
        """Send MAV_CMD `number` once; parameters not given are 0."""
        self.radio.send(command(self.system, number, *params))

    # ---- what takes a while ----

    def command(
        self, number: int, *params: float, seen: Callable[[], bool], within_s: float = DONE_S
    ) -> Steps[Result]:
        """Send MAV_CMD `number` until it is done (`CommandRun`).

        A refusal has the texts that came with it.
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
        """Wait until something holds, for at most this long; returns whether it does."""
        until_s = self.now_s + for_s
        while not (so := holds()) and self.now_s < until_s:
            yield
        return so

    def wait(self, for_s: float) -> Steps[bool]:
        """Wait this long."""
        return self.until(lambda: False, for_s)

    def read_parameters(self, names: tuple[str, ...]) -> Steps[None]:
        """Read parameters into `known`.

        Those that are not answered stay unknown. `A|B`: one or the other, whichever there is.
        """
        wanted = [name.split("|") for name in names]

        def missing() -> list[str]:
            known = self.known.parameters.keys()
            return [*itertools.chain(*(either for either in wanted if known.isdisjoint(either)))]

        for _ in range(TRIES):
            for name in missing():
                self.radio.send(
                    mavlink.MAVLink_param_request_read_message(self.system, AUTOPILOT, name.encode(), -1)
                )
            if (yield from self.until(lambda: not missing(), self.patient(AGAIN_S))):
                return


def _is_ours(ack: Message, system: int) -> bool:
    """Whether an acknowledgement is for us: clients' commands are handed on to the same autopilot."""
    return ack.target_system in (0, system) and ack.target_component in (0, ONBOARD_COMPUTER)
