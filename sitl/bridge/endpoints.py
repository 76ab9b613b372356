"""What opens each kind of URL."""

from sitl.bridge.links import Endpoint
from sitl.bridge.serial_line import SerialLine
from sitl.bridge.tcp import TcpIn, TcpOut
from sitl.bridge.udp import UdpIn, UdpOut

ENDPOINTS: dict[str, type[Endpoint]] = {"udpin": UdpIn, "udpout": UdpOut, "tcp": TcpOut, "tcpin": TcpIn, "serial": SerialLine}
"""By the kind of an address."""
TICK_S = 0.2
"""How often an endpoint is to be told the time."""
