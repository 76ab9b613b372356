"""The connection to an autopilot: one endpoint of the bridge's kinds, polled by whoever owns it. It comes back by itself."""

import contextlib
import selectors
import time
from typing import NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from link.bus.frames import MAVLINK_2
from link.bus.log import Log
from link.bus.mavlink import ONBOARD_COMPUTER, Codec, Message
from sitl.bridge.address import Address
from sitl.bridge.bridge import ENDPOINTS, TICK_S
from sitl.bridge.links import Channel
from sitl.bridge.stream import Letter

HEARD = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_SYS_STATUS, mavlink.MAVLINK_MSG_ID_PARAM_VALUE,
        mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
        mavlink.MAVLINK_MSG_ID_COMMAND_ACK, mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED, mavlink.MAVLINK_MSG_ID_FENCE_STATUS,
        mavlink.MAVLINK_MSG_ID_WIND, mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT, mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
        mavlink.MAVLINK_MSG_ID_WIND_COV, mavlink.MAVLINK_MSG_ID_HOME_POSITION, mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
        mavlink.MAVLINK_MSG_ID_STATUSTEXT,
    }
)  # fmt: skip
"""Messages that are decoded; the others are skipped."""


class Heard(NamedTuple):
    """A message and the link that it came on."""

    message: Message
    link: Channel


class Connection:
    """One endpoint. Behind it may be several links (`udpin`, `tcpin`); `use` says which one leads to the vehicle.

    What is sent while nothing is connected is lost, as on any radio.
    """

    def __init__(self, address: Address, log: Log) -> None:
        """Open the endpoint; raises ValueError if it cannot be used on this machine."""
        self.selector: selectors.BaseSelector = selectors.DefaultSelector()
        self.log = log
        self.address = address
        self._links: list[Channel] = []
        self._used: Channel | None = None
        self._system = 0
        self._codec = Codec(0, ONBOARD_COMPUTER)
        self._parser = mavlink.MAVLink(None)
        self._heard: list[Heard] = []
        self._tick_at_s = 0.0
        self._endpoint = ENDPOINTS[address.kind](address, self)
        self._endpoint.open()

    # ---- what the endpoint calls ----

    def join(self, link: Channel) -> None:
        """A link is there."""
        self._links.append(link)

    def leave(self, link: Channel) -> None:
        """A link has gone."""
        self._links.remove(link)
        if link is self._used:
            self._used = None

    def route(self, link: Channel, letters: list[Letter]) -> None:
        """Take frames of a link."""
        for letter in letters:
            frame = letter.data
            number = int.from_bytes(frame[7:10], "little") if frame[0] == MAVLINK_2 else frame[5]
            if number in HEARD:
                with contextlib.suppress(mavlink.MAVError):
                    self._heard.append(Heard(self._parser.decode(bytearray(frame)), link))

    # ---- what its owner calls ----

    @property
    def state(self) -> str:
        """Why nothing can be heard, or how the endpoint is doing."""
        return self._endpoint.trouble() or self._endpoint.state()

    def use(self, link: Channel, system: int) -> None:
        """Speak on this link from now on, as a companion computer of a system."""
        if self._system != system:
            self._system, self._codec = system, Codec(system, ONBOARD_COMPUTER)
        self._used = link

    def send(self, message: Message) -> None:
        """Send on the link in use; while there is none, on all of them."""
        frame = self._codec.pack(message)
        for link in [self._used] if self._used else [*self._links]:
            link.send(frame)

    def poll(self, wait_s: float = 0.0) -> list[Heard]:
        """Return what has come; waits for at most this real time until something does."""
        if (now_s := time.monotonic()) >= self._tick_at_s:
            self._tick_at_s = now_s + TICK_S
            self._endpoint.tick(now_s)
        for key, events in self.selector.select(wait_s):
            key.data(events)
        heard, self._heard = self._heard, []
        return heard

    def close(self) -> None:
        """Free all that it has opened."""
        self._endpoint.close()
        self.selector.close()
