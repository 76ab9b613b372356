"""The connection to an autopilot: the uav's side of the keeper, which has the link."""

import contextlib
import math
import os
import select
import socket
import subprocess
import sys
from collections import deque

from pymavlink.dialects.v20 import all as mavlink

from aircraft.bridge.address import Address
from aircraft.bridge.links import Hub
from aircraft.bridge.pipe import Reopened
from aircraft.keeper import keeper
from link.bus.log import Log
from link.bus.mavlink import ONBOARD_COMPUTER, Codec, Message

# Messages that are decoded; the others are only handed on.
HEARD = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_HEARTBEAT,
        mavlink.MAVLINK_MSG_ID_SYS_STATUS,
        mavlink.MAVLINK_MSG_ID_PARAM_VALUE,
        mavlink.MAVLINK_MSG_ID_ATTITUDE,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
        mavlink.MAVLINK_MSG_ID_COMMAND_ACK,
        mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED,
        mavlink.MAVLINK_MSG_ID_FENCE_STATUS,
        mavlink.MAVLINK_MSG_ID_WIND,
        mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
        mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
        mavlink.MAVLINK_MSG_ID_WIND_COV,
        mavlink.MAVLINK_MSG_ID_HOME_POSITION,
        mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
        mavlink.MAVLINK_MSG_ID_STATUSTEXT,
    }
)
RADIO_STATUS = int(mavlink.MAVLINK_MSG_ID_RADIO_STATUS)
MOST_FRAMES = 4096  # that wait to be handed on
MOST_BYTES = 65536  # that wait for a keeper that does not read
HANGS_S = 5.0  # a keeper says each second how it does; one that hands nothing on for this long is replaced
START_S = 60.0  # longest time in which a keeper starts, on a busy machine
# How long a keeper may take to end after the uav; one that sends the vehicle home takes longer, and is left.
END_S = 1.0


class Kept(Reopened):
    """One link, to the keeper, which is replaced if it dies.

    It is a process in a session of its own: no signal for the uav or its group reaches it.
    """

    there = "kept"

    def __init__(self, address: Address, hub: Hub) -> None:
        super().__init__(address, hub)
        # Why the keeper has sent the vehicle home, once it has: nothing of ours goes out any more.
        self.sent_home = ""
        self.system = 0  # of the vehicle, once it is known
        self._process: subprocess.Popen[bytes] | None = None
        self._said = ""
        self._said_s = self._looked_s = math.inf

    def hear(self, said: Message) -> None:
        """Take the keeper's own word, a STATUSTEXT."""
        if said.severity <= mavlink.MAV_SEVERITY_CRITICAL:
            self.sent_home = f"The keeper has taken the vehicle over: {said.text}"
        else:
            self._said = said.text

    def lives(self) -> None:
        """Something has come from the keeper. In a flood its own words may be dropped."""
        self._said_s = self._looked_s

    def open(self) -> None:
        """Start the keeper; raises ValueError if it cannot use the URL on this machine."""
        stdout = self._start(subprocess.PIPE, -math.inf).stdout
        assert stdout
        with stdout:
            line = stdout.readline() if select.select([stdout], [], [], START_S)[0] else b""
        if line != b"\n":
            raise ValueError(line.decode().strip() or f"{self.address.text}: its keeper does not start")

    def tick(self, now_s: float) -> None:
        """Start a new keeper if the last has died or hangs."""
        if now_s - self._looked_s > keeper.HELD_UP_S:
            # we ourselves were held up: what it has said meanwhile is not read yet
            self._said_s += now_s - self._looked_s
        self._looked_s = now_s
        if self._process and self._pipe and now_s - self._said_s > HANGS_S:
            self._hub.log.warning(f"{self.address.text}: its keeper hangs and is killed")
            self._said_s = math.inf
            self._process.kill()  # which closes the link
        if self._pipe is None and self._retry.due(now_s):
            self._start(subprocess.DEVNULL, now_s)

    def _start(self, stdout: int, now_s: float) -> "subprocess.Popen[bytes]":
        ours, its = socket.socketpair()
        with its:
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-m", keeper.__name__),
                    *(self.address.text, self._hub.log.least, str(self.system)),
                ],
                stdin=its.fileno(),
                stdout=stdout,
                start_new_session=True,
                env={
                    **os.environ,
                    "PYTHONSAFEPATH": "1",
                    "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
                },
            )
        ours.setblocking(False)
        self._said_s = math.inf
        self._begin(ours, MOST_BYTES, now_s)
        return self._process

    def _fail(self, reason: str) -> None:
        super()._fail("its keeper has ended")

    @property
    def state(self) -> str:
        """How the keeper's own endpoint does."""
        return self._said

    def close(self) -> None:
        """Let go of the keeper."""
        super().close()
        if self._process:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(END_S)


class Connection(Hub):
    """One link, to the keeper, which knows which of its own (`udpin`, `tcpin`) is the vehicle's."""

    def __init__(self, address: Address, log: Log) -> None:
        """Open the endpoint; raises ValueError if it cannot be used on this machine."""
        super().__init__(log)
        self.address = address
        self._codec = Codec(0, ONBOARD_COMPUTER)
        self._parser = mavlink.MAVLink(None)
        self._frames: deque[bytes] = deque(maxlen=MOST_FRAMES)
        self._kept = Kept(address, self)
        self.open(self._kept)

    @property
    def sent_home(self) -> str:
        """Why the keeper has sent the vehicle home, once it has: nothing of ours goes out any more."""
        return self._kept.sent_home

    @property
    def state(self) -> str:
        """Where it is expected, how that is doing, and what the other side needs."""
        doing = (self._kept.trouble or self._kept.state).strip("()")
        return (
            f"at {self.address.text}{f' ({doing})' if doing else ''}: is it running? "
            f"{self.address.other_side}"
        )

    def use(self, system: int) -> None:
        """Speak as a companion computer of a system from now on."""
        if self._kept.system != system:
            self._kept.system, self._codec = system, Codec(system, ONBOARD_COMPUTER)

    def send(self, message: Message) -> None:
        """Send a message."""
        self.forward(self._codec.pack(message))

    def forward(self, frame: bytes) -> None:
        """Send a frame of someone else as it is."""
        self.send_all([frame])

    def poll(self) -> list[Message]:
        """Return what has come."""
        heard = []
        for _, frame in self.take():
            self._kept.lives()
            if frame.system == keeper.OWN:
                self._kept.hear(self._parser.decode(bytearray(frame.data)))
                continue
            own = frame.system == self._kept.system and frame.component != ONBOARD_COMPUTER
            if own or frame.message_id == RADIO_STATUS:  # the radio on the link has a system id of its own
                self._frames.append(frame.data)
            if frame.message_id in HEARD:
                with contextlib.suppress(mavlink.MAVError):
                    heard.append(self._parser.decode(bytearray(frame.data)))
        return heard

    def frames(self) -> list[bytes]:
        """Return what the vehicle, and the radio on its link, have said since the last call, as it came."""
        frames = [*self._frames]
        self._frames.clear()
        return frames
