"""The keeper: a small process that owns the link to an autopilot.

It sends the vehicle home if the uav falls silent in flight.
It hands frames on, both ways, and knows from them whose flight it is. It goes on when the uav hangs, is
stopped or is killed, and ends when the uav has ended and nobody needs it: the vehicle stands, comes down,
or is a pilot's.
"""

import contextlib
import math
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from functools import partial

from pymavlink.dialects.v20 import common as mavlink

from aircraft.bridge.address import parse_address
from aircraft.bridge.endpoints import endpoint_of
from aircraft.bridge.links import TICK_S, Channel, Hub, Traffic
from aircraft.bridge.pipe import Pipe
from aircraft.firmware import ARDUCOPTER, COMING_DOWN, FIRMWARES, stands, unfit
from aircraft.operator import AUTOPILOT, command
from link.bus.frames import Frame
from link.bus.log import Log
from link.bus.mavlink import ONBOARD_COMPUTER, Message, message_of
from link.bus.tally import Tally
from link.early import ask_for_stack
from link.modes import Mode, px4_mode

# Real time without a HEARTBEAT of the uav after which it counts as silent, whatever the speed-up: its loop
# sends one each second.
SILENT_S = 3.0
# Two looks this far apart mean that the keeper itself was held up: that time does not count as silence.
HELD_UP_S = 1.0
# A vehicle that is armed later than this after the uav's last HEARTBEAT has been armed by someone else.
ARMED_S = 5.0
AGAIN_S = 1.0  # how often a vehicle that does not obey is told again, and the uav what has happened
GIVEN_UP_S = 60.0  # without the uav, an autopilot that is not heard for this long is given up
# Most bytes that wait for a uav that does not read, twice: a few seconds of telemetry, the newest.
WAITING_BYTES = 16384
# System id of the keeper's own words to the uav. No vehicle has it, and a frame with it from outside is not
# handed on.
OWN = 0
WARNING, CRITICAL, INFO = (
    mavlink.MAV_SEVERITY_WARNING,
    mavlink.MAV_SEVERITY_CRITICAL,
    mavlink.MAV_SEVERITY_INFO,
)


class Keeper:
    """Judges by the frames of both sides, and acts.

    It has no clock and no link: times are the caller's, s of real time.
    """

    def __init__(
        self,
        send: Callable[[Message], None],
        say: Callable[[int, str], None],
        hangs: Callable[[], None] = lambda: None,
        system: int = 0,
    ) -> None:
        """Take how a message goes to the autopilot, and how people are told.

        hangs: what is done about a uav that is silent.
        """
        # The vehicle's system id: that of its companion, the uav, whose first HEARTBEAT with one tells it.
        # 0 until the uav has found it. Companions of other systems are strangers.
        self.system = system
        self.acted = ""  # why it has acted, once it has: from then on nothing of the uav's own is handed on
        self.over = False  # whether there is nothing left to do
        self._send, self._say, self._hangs = send, say, hangs
        self._firmware = ARDUCOPTER
        self._mode: int | None = None
        self._status = mavlink.MAV_STATE_UNINIT
        self._landed = mavlink.MAV_LANDED_STATE_UNDEFINED
        self._armed = False
        self._ours = False  # whether the uav says that it is in charge
        self._taken_over = False  # whether someone else has changed the mode since
        self._asked: frozenset[int] = frozenset()
        self._gone = self._told = False
        self._sent_s = -math.inf
        self._beat_s = self._looked_s = self._heard_s = math.inf

    # ---- the uav's side ----

    def passes(self, frame: Frame, now_s: float) -> bool:
        """Take a frame of the uav.

        Returns whether it is to be handed on: what it hands on of others, which has other ids, always.
        """
        if frame.component != ONBOARD_COMPUTER or frame.system != (self.system or frame.system):
            return True
        if self.acted:
            return False
        if frame.message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            self._beat_s, self.system = now_s, frame.system
            ours = message_of(frame).system_status == mavlink.MAV_STATE_ACTIVE
            self._taken_over = self._taken_over and ours == self._ours  # it knows best, once it knows
            self._ours = ours
        elif frame.message_id == mavlink.MAVLINK_MSG_ID_COMMAND_LONG:
            self._commanded(message_of(frame))
        return True

    def gone(self) -> None:
        """Note that the uav has ended, or has let go of us."""
        self._gone = True

    def _commanded(self, message: mavlink.MAVLink_command_long_message) -> None:
        """Remember which modes come of what the uav commands."""
        if message.command == mavlink.MAV_CMD_NAV_TAKEOFF:
            self._asked, self._taken_over = self._firmware.climbs, False
        elif message.command == mavlink.MAV_CMD_DO_SET_MODE:
            main, sub = int(message.param2), int(message.param3)
            mode = main if self._firmware.is_ardupilot else px4_mode(main, sub)
            self._asked, self._taken_over = frozenset({mode}), False

    # ---- the autopilot's side ----

    def hear(self, frame: Frame, now_s: float) -> bool:
        """Take a frame of the autopilot's link.

        Returns whether it is the vehicle's HEARTBEAT. Raises MAVError if it is malformed.
        """
        if (frame.system, frame.component) != (self.system, AUTOPILOT):
            return False
        number = frame.message_id
        if number == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            message = message_of(frame)
            if unfit(message):
                return False
            self._heard_s = now_s
            self._beats(message, now_s)
            return True
        if number == mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE:
            self._landed = message_of(frame).landed_state
        elif number == mavlink.MAVLINK_MSG_ID_COMMAND_ACK and self._is_in_charge and self.acted:
            message, land = message_of(frame), self._firmware.modes[Mode.LAND]
            refused = message.result not in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS)
            if refused and message.command == mavlink.MAV_CMD_DO_SET_MODE and self._asked != {land}:
                self._ask_for(Mode.LAND)
        return False

    def _beats(self, message: mavlink.MAVLink_heartbeat_message, now_s: float) -> None:
        self._firmware = FIRMWARES[message.autopilot]
        armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        if armed != self._armed:
            self._armed, self._taken_over = armed, False
            self._ours = self._ours and now_s - self._beat_s <= ARMED_S
        mode, before = message.custom_mode, self._mode
        failed = message.system_status >= mavlink.MAV_STATE_CRITICAL > self._status
        if before is not None and mode != before and mode not in self._asked:
            # a failsafe that only hovers has taken nothing over
            self._taken_over = not (failed and mode in self._firmware.hovers)
        self._mode, self._status = mode, message.system_status

    # ---- what is to be done ----

    def look(self, now_s: float) -> None:
        """Look, and act; call it several times a second."""
        if now_s - self._looked_s > HELD_UP_S:
            self._beat_s += now_s - self._looked_s
        self._looked_s = now_s
        if not (self.acted or self._gone or now_s - self._beat_s > SILENT_S):
            self._told = False
            return
        if self._gone and self._heard_s < now_s - GIVEN_UP_S:
            if self._is_in_charge:
                self._say(
                    CRITICAL,
                    f"The autopilot is not heard for {GIVEN_UP_S:g} s: its own failsafe is in charge",
                )
            self.over = True
        elif self._is_in_charge and self._firmware.reports.get(self._mode or 0) not in COMING_DOWN:
            self._act(now_s)
        else:
            if self.acted and not self._told:
                self._told = True
                left = f"The vehicle is left in {self._firmware.mode_name(self._mode or 0)}"
                self._say(WARNING, left if self._armed else "The motors have stopped")
            self.over = self._gone and (self._armed or not self._ours or now_s - self._beat_s > ARMED_S)

    def _act(self, now_s: float) -> None:
        if now_s - self._sent_s < AGAIN_S:
            return
        self._sent_s, self._told = now_s, False
        on_ground = stands(self._landed, self._status)
        if not self.acted:
            self.acted = "the uav has ended" if self._gone else f"the uav was silent for {SILENT_S:g} s"
            what = "stops the motors" if on_ground else "sends the vehicle home"
            self._say(CRITICAL, f"The keeper {what}: {self.acted}")
            if not self._gone:
                self._hangs()  # after our own line: its stack is written piece by piece, on the same stderr
        if on_ground:  # which is refused in flight
            self._send(command(self.system, mavlink.MAV_CMD_COMPONENT_ARM_DISARM))
        else:
            self._ask_for(Mode.RETURN)

    def _ask_for(self, mode: Mode) -> None:
        number = self._firmware.modes[mode]
        self._asked = frozenset({number})
        self._send(command(self.system, mavlink.MAV_CMD_DO_SET_MODE, *self._firmware.params(number)))

    @property
    def _is_in_charge(self) -> bool:
        """Whether nobody else is in charge of a vehicle whose motors turn."""
        return self._armed and self._ours and not self._taken_over


class Switch(Hub):
    """Hands frames on between the uav and the autopilot's endpoint."""

    def __init__(self, url: str, uav: socket.socket, log: Log, system: int) -> None:
        """Open the endpoint; raises ValueError if it cannot be used on this machine."""
        super().__init__(log)
        self.keeper = Keeper(self._send, self._say, partial(ask_for_stack, os.getppid()), system)
        self._codec = mavlink.MAVLink(None)
        self._used: Channel | None = None  # the vehicle's link
        self._told, self._tell_s = "", -math.inf  # the last word to the uav, and when it was said
        self._endpoint = endpoint_of(parse_address(url), self)
        self.open(self._endpoint)
        uav.setblocking(False)
        uav.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, WAITING_BYTES)
        self._uav = Pipe(
            uav, self, Traffic("uav", log), "uav", WAITING_BYTES, lambda _: self.keeper.gone()
        ).link

    def leave(self, link: Channel) -> None:
        """A link has gone."""
        super().leave(link)
        if link is self._used:
            self._used = None

    def run(self) -> None:
        """Hand on until nobody needs it."""
        while not self.keeper.over:
            for link, frame in self.take(TICK_S):
                now_s = time.monotonic()
                if link is self._uav:
                    if self.keeper.passes(frame, now_s):
                        self._out(frame.data)
                elif frame.system != OWN:
                    with contextlib.suppress(mavlink.MAVError):
                        if self.keeper.hear(frame, now_s):
                            self._used = link  # a vehicle may come back on another link
                    self._uav.send(frame.data)
        self.close()

    def tick(self, now_s: float) -> None:
        """Look after the endpoint and the vehicle."""
        super().tick(now_s)
        self.keeper.look(now_s)
        self._tell_the_uav(now_s)

    def _out(self, data: bytes) -> None:
        for link in [self._used] if self._used else self._endpoint.links:
            link.send(data)

    def _send(self, message: Message) -> None:
        self._out(self._packed(message, self.keeper.system))

    def _say(self, severity: int, text: str) -> None:
        self.log.warning(text)
        self._send(mavlink.MAVLink_statustext_message(severity, text[:50].encode()))

    def _tell_the_uav(self, now_s: float) -> None:
        """Say why the keeper has acted, or else how the endpoint does: at once if new, and each second.

        A uav that does not read may miss a word.
        """
        text = self.keeper.acted or self._endpoint.trouble or self._endpoint.state
        if text == self._told and now_s - self._tell_s < AGAIN_S:
            return
        self._told, self._tell_s = text, now_s
        severity = CRITICAL if self.keeper.acted else INFO
        self._uav.send(self._packed(mavlink.MAVLink_statustext_message(severity, text[:50].encode()), OWN))

    def _packed(self, message: Message, system: int) -> bytes:
        self._codec.srcSystem, self._codec.srcComponent = system, ONBOARD_COMPUTER
        self._codec.seq = (self._codec.seq + 1) % 256
        return bytes(message.pack(self._codec))


def main() -> None:
    """Keep the vehicle at a URL, whose system id is 0 as long as it is not known, for the uav on stdin.

    The line on stdout is empty if the URL can be used, else it says why not.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends when the uav has ended and the vehicle is cared for
    url, level, system = sys.argv[1:]
    # A uav that was interrupted meanwhile reads no line; it has flown nothing.
    with socket.socket(fileno=0) as uav, contextlib.suppress(BrokenPipeError):
        try:
            switch = Switch(url, uav, Log("keeper", "-", Tally(), level), int(system))
        except ValueError as error:
            os.write(sys.stdout.fileno(), f"{error}\n".encode())
            return
        os.write(sys.stdout.fileno(), b"\n")
        switch.run()


if __name__ == "__main__":
    main()
