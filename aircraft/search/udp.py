"""MAVLink over UDP with a vehicle's ground stations and programs."""

import contextlib
from collections.abc import Sequence

from pymavlink.dialects.v20 import common as mavlink

from aircraft.bridge.address import parse_address
from aircraft.bridge.endpoints import endpoint_of
from aircraft.bridge.links import Endpoint, Hub
from link.bus.log import Log
from link.bus.mavlink import Codec, Message, message_of
from link.signing.signer import Signing


class UdpPort:
    """What lies behind one URL.

    A message goes to all who are there; one that cannot be sent is lost, as on a radio.
    """

    def __init__(self, endpoint: Endpoint, codec: Codec) -> None:
        """Take an open endpoint; a port has sequence numbers of its own."""
        self.endpoint = endpoint
        self._codec = codec

    def send(self, *messages: Message) -> None:
        """Send each message in a datagram of its own."""
        for frame in [self._codec.pack(message) for message in messages]:
            for link in self.endpoint.links:
                link.send(frame)


class UdpPorts(Hub):
    """All UDP ports of one vehicle."""

    def __init__(
        self, urls: Sequence[str], log: Log, system: int, component: int, signing: Signing | None = None
    ) -> None:
        """Open them; raises ValueError if one cannot be used on this machine.

        With `signing`, what is sent is signed, and frames without a valid signature are dropped.
        """
        super().__init__(log)
        self.ports: list[UdpPort] = []
        for url in urls:
            endpoint = endpoint_of(parse_address(url), self)
            self.open(endpoint, signing)
            self.ports.append(UdpPort(endpoint, Codec(system, component)))

    def receive(self) -> list[tuple[UdpPort, Message, str]]:
        """Return the messages that have come, each with its port and its sender's HOST:PORT."""
        heard = []
        for link, frame in self.take():
            port = next(port for port in self.ports if port.endpoint.traffic is link.traffic)
            with contextlib.suppress(mavlink.MAVError):  # a message type that the vehicle does not speak
                heard.append((port, message_of(frame), link.who))
        return heard
