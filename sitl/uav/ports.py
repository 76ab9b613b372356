"""Where a vehicle's MAVLink messages go: the bus and UDP links, each with telemetry of its own."""

from typing import NamedTuple, Protocol

from link.bus.keys import MAVLINK_OUT
from link.bus.mavlink import Codec, Message
from link.bus.session import Bus
from sitl.autopilot.telemetry import Telemetry
from sitl.protocol.protocol import COMPONENT


class Link(Protocol):
    """A destination for MAVLink messages."""

    def send(self, *messages: Message) -> None:
        """Send messages with this link's own sequence numbers."""


class BusLink:
    """MAVLink over the bus."""

    def __init__(self, bus: Bus, system: int) -> None:
        """Publish on `mavlink/out` as this system id."""
        self._bus = bus
        self._codec = Codec(system, COMPONENT)

    def send(self, *messages: Message) -> None:
        """Send messages as one sample."""
        self._bus.publish(MAVLINK_OUT, self._codec.pack(*messages))


class Port(NamedTuple):
    """A link and its telemetry: the client of each link sets its own rates."""

    link: Link
    telemetry: Telemetry


class FromUdp(NamedTuple):
    """A message received over UDP, with the index of its `Port` and its sender's HOST:PORT."""

    port: int
    message: Message
    peer: str
