"""The connection to an autopilot, whose link its keeper has."""

import contextlib
from collections import deque

from pymavlink.dialects.v20 import all as mavlink

from aircraft.bridge.address import Address
from aircraft.bridge.links import Hub
from aircraft.keeper.keeper import OWN
from aircraft.keeper.kept import Kept
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
MOST_FRAMES = 4096  # that wait to be handed on


class Connection(Hub):
    """One link, to the keeper, which knows which of its own (`udpin`, `tcpin`) is the vehicle's."""

    def __init__(self, address: Address, log: Log) -> None:
        """Open the endpoint; raises ValueError if it cannot be used on this machine."""
        super().__init__(log)
        self.address = address
        self._system = 0
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
        if self._system != system:
            self._system, self._codec = system, Codec(system, ONBOARD_COMPUTER)

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
            if frame.system == OWN:
                self._kept.hear(self._parser.decode(bytearray(frame.data)))
                continue
            if frame.system == self._system and frame.component != ONBOARD_COMPUTER:
                self._frames.append(frame.data)
            if frame.message_id in HEARD:
                with contextlib.suppress(mavlink.MAVError):
                    heard.append(self._parser.decode(bytearray(frame.data)))
        return heard

    def frames(self) -> list[bytes]:
        """Return the vehicle's own frames as they came, since the last call."""
        frames = [*self._frames]
        self._frames.clear()
        return frames
