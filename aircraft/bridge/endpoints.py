"""What opens each kind of URL."""

from aircraft.bridge.links import Endpoint
from aircraft.bridge.serial_line import SerialLine
from aircraft.bridge.tcp import TcpIn, TcpOut
from aircraft.bridge.udp import UdpIn, UdpOut

ENDPOINTS: dict[str, type[Endpoint]] = {
    "udpin": UdpIn,
    "udpout": UdpOut,
    "tcp": TcpOut,
    "tcpin": TcpIn,
    "serial": SerialLine,
}
"""By the kind of an address."""
TICK_S = 0.2
"""How often an endpoint is to be told the time."""
