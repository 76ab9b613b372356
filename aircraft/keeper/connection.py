"""Endpoints of the bridge's kinds, polled by whoever owns them: the connection to an autopilot, and the
links of its clients.
"""

import contextlib
import selectors
import time
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from aircraft.bridge.address import Address
from aircraft.bridge.endpoints import ENDPOINTS, TICK_S
from aircraft.bridge.links import Channel, Endpoint
from aircraft.keeper.kept import Kept
from link.bus.frames import Frame
from link.bus.log import Log
from link.bus.mavlink import ONBOARD_COMPUTER, Codec, Message
from link.signing.signer import Signing

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
"""Messages that are decoded; the others are only handed on."""
MOST_FRAMES = 4096
"""Most frames that wait to be handed on."""


class Heard(NamedTuple):
    """A message and the link that it came on."""

    message: Message
    link: Channel


class Came(NamedTuple):
    """A frame and the link that it came on."""

    link: Channel
    frame: Frame


class Endpoints:
    """Endpoints, each with any number of links. They come back by themselves; what is sent while nothing
    is connected is lost.
    """

    def __init__(self, addresses: Sequence[Address], log: Log, signing: Signing | None = None) -> None:
        """Open them; raises ValueError if one cannot be used on this machine. signing: what signs all
        links.
        """
        self.selector: selectors.BaseSelector = selectors.DefaultSelector()
        self.log = log
        self.links: list[Channel] = []
        self._came: list[Came] = []
        self._tick_at_s = 0.0
        self._endpoints = [self._endpoint(address) for address in addresses]
        for endpoint in self._endpoints:
            endpoint.traffic.signer = signing.link(endpoint.address.text) if signing else None
            try:
                endpoint.open()
            except ValueError:
                self.close()
                raise

    def _endpoint(self, address: Address) -> Endpoint:
        return ENDPOINTS[address.kind](address, self)

    # ---- what an endpoint calls ----

    def join(self, link: Channel) -> None:
        """A link is there."""
        self.links.append(link)

    def leave(self, link: Channel) -> None:
        """A link has gone."""
        self.links.remove(link)

    def route(self, link: Channel, frames: list[Frame]) -> None:
        """Take frames of a link."""
        self._came += [Came(link, frame) for frame in frames]

    # ---- what their owner calls ----

    @property
    def state(self) -> str:
        """Why nothing can be heard, or how the endpoints are doing."""
        return ", ".join(endpoint.trouble() or endpoint.state() for endpoint in self._endpoints)

    def send_all(self, frames: Sequence[bytes]) -> None:
        """Send frames on all links."""
        for link in [*self.links]:
            for frame in frames:
                link.send(frame)

    def take(self, wait_s: float = 0.0) -> list[Came]:
        """Return what has come; waits for at most this real time until something does."""
        if (now_s := time.monotonic()) >= self._tick_at_s:
            self._tick_at_s = now_s + TICK_S
            for endpoint in self._endpoints:
                endpoint.tick(now_s)
                endpoint.traffic.tell_refused()
        for key, events in self.selector.select(wait_s):
            key.data(events)
        came, self._came = self._came, []
        return came

    def close(self) -> None:
        """Free all that they have opened."""
        for endpoint in self._endpoints:
            endpoint.close()
        self.selector.close()


class Connection(Endpoints):
    """The endpoint of an autopilot, which its keeper has. The keeper knows which of several links
    (`udpin`, `tcpin`) is the vehicle's.
    """

    def __init__(self, address: Address, log: Log) -> None:
        """Open the endpoint; raises ValueError if it cannot be used on this machine."""
        self.address = address
        self._used: Channel | None = None
        self._system = 0
        self._codec = Codec(0, ONBOARD_COMPUTER)
        self._parser = mavlink.MAVLink(None)
        self._frames: deque[bytes] = deque(maxlen=MOST_FRAMES)
        super().__init__([address], log)

    def _endpoint(self, address: Address) -> Endpoint:
        self._kept = Kept(address, self)
        return self._kept

    @property
    def sent_home(self) -> str:
        """Why the keeper has sent the vehicle home, once it has: nothing of ours goes out any more."""
        return self._kept.sent_home

    @property
    def state(self) -> str:
        """Where it is expected, how that is doing, and what the other side needs."""
        doing = super().state.strip("()")
        return (
            f"at {self.address.text}{f' ({doing})' if doing else ''}: is it running? "
            f"{self.address.other_side}"
        )

    def leave(self, link: Channel) -> None:
        """A link has gone."""
        super().leave(link)
        if link is self._used:
            self._used = None

    def use(self, link: Channel, system: int) -> None:
        """Speak on this link from now on, as a companion computer of a system."""
        if self._system != system:
            self._system, self._codec = system, Codec(system, ONBOARD_COMPUTER)
        self._used = link

    def send(self, message: Message) -> None:
        """Send on the link in use; while there is none, on all of them."""
        self.forward(self._codec.pack(message))

    def forward(self, frame: bytes) -> None:
        """Send a frame of someone else as it is."""
        for link in [self._used] if self._used else [*self.links]:
            link.send(frame)

    def poll(self, wait_s: float = 0.0) -> list[Heard]:
        """Return what has come; waits for at most this real time until something does."""
        heard = []
        for link, frame in self.take(wait_s):
            if link is self._used and frame.system == self._system and frame.component != ONBOARD_COMPUTER:
                self._frames.append(frame.data)
            if frame.message_id in HEARD:
                with contextlib.suppress(mavlink.MAVError):
                    heard.append(Heard(self._parser.decode(bytearray(frame.data)), link))
        return heard

    def frames(self) -> list[bytes]:
        """Return the vehicle's own frames as they came, since the last call."""
        frames = [*self._frames]
        self._frames.clear()
        return frames
