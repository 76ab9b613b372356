"""Addresses of MAVLink endpoints: `udpin:`, `udpout:`, `tcp:`, `tcpin:` and `serial:` URLs."""

import re
import termios
from typing import NamedTuple

from link.access.reach import is_open

ALLOWED = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE[:BAUD]"
LISTENING = ("udpin", "tcpin")
"""Kinds that wait for others at HOST:PORT. The others call HOST:PORT."""
EVERYWHERE = "0.0.0.0"
DEFAULT_BAUD = 57600
"""The telemetry port of ArduPilot and PX4."""
BAUDS = {
    int(name[1:]): int(getattr(termios, name))
    for name in dir(termios)
    if re.fullmatch(r"B[0-9]+", name) and int(name[1:]) >= 1200
}
"""Baud rates that the system knows, with its own numbers for them."""
OTHER_SIDE = {
    "udpin": "MAVSDK: udpout://{host}:{port}, pymavlink and MAVProxy: udpout:{host}:{port}",
    "udpout": "MAVSDK: udpin://0.0.0.0:{port}, pymavlink and MAVProxy: udpin:0.0.0.0:{port}",
    "tcpin": "MAVSDK: tcpout://{host}:{port}, pymavlink and MAVProxy: tcp:{host}:{port}",
    "tcp": "it is a server: ArduPilot's SITL, or a program with tcpin:0.0.0.0:{port}",
    "serial": "8 data bits, no parity, no flow control",
}
"""What the other side of each kind of endpoint is, or how it connects."""


class Address(NamedTuple):
    """The parts of a URL."""

    kind: str
    """udpin, udpout, tcp, tcpin or serial."""
    host: str
    """Or the serial device."""
    port: int
    """Or the baud rate."""

    @property
    def text(self) -> str:
        """The URL itself, with its baud rate."""
        return f"{self.kind}:{self.host}:{self.port}"

    @property
    def other_side(self) -> str:
        """What the other side is, or how it connects."""
        return OTHER_SIDE[self.kind].format(
            host="HOST" if self.host == EVERYWHERE else self.host, port=self.port
        )

    @property
    def open(self) -> bool:
        """Whether it listens to other machines."""
        return self.kind in LISTENING and is_open(self.host)


def parse_address(url: str) -> Address:
    """Parse a URL; raises ValueError with what is allowed if it is not valid."""
    if match := re.fullmatch(r"serial:([^\s:][^\s]*?)(?::([0-9]+))?", url):
        baud = int(match[2] or DEFAULT_BAUD)
        if baud not in BAUDS:
            raise ValueError(
                f"{url!r}: {baud} baud is not allowed; wanted one of {', '.join(map(str, sorted(BAUDS)))}"
            )
        return Address("serial", match[1], baud)
    match = re.fullmatch(r"(udpin|udpout|tcp|tcpin):([^\s:/]+):([0-9]{1,5})", url)
    if not match or not 1 <= int(match[3]) <= 65535:
        raise ValueError(f"{url!r} is not a MAVLink endpoint; wanted {ALLOWED}, with a port from 1 to 65535")
    return Address(match[1], match[2], int(match[3]))
