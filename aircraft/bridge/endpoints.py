"""What opens each kind of URL."""

from aircraft.bridge.address import Address
from aircraft.bridge.links import Endpoint, Hub
from aircraft.bridge.serial_line import SerialLine
from aircraft.bridge.tcp import TcpIn, TcpOut
from aircraft.bridge.udp import Udp

ENDPOINTS: dict[str, type[Endpoint]] = {
    "udpin": Udp,
    "udpout": Udp,
    "tcp": TcpOut,
    "tcpin": TcpIn,
    "serial": SerialLine,
}


def endpoint_of(address: Address, hub: Hub) -> Endpoint:
    """Return the endpoint of an address, not open yet."""
    return ENDPOINTS[address.kind](address, hub)
