"""Addresses of MAVLink endpoints: `udpin:`, `udpout:`, `tcp:`, `tcpin:` and `serial:` URLs."""

import contextlib
import re
import socket
import termios
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from link.access.reach import is_open

ALLOWED = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE[:BAUD]"
LISTENING = ("udpin", "tcpin")  # kinds that wait for others at HOST:PORT. The others call HOST:PORT.
EVERYWHERE = "0.0.0.0"
DEFAULT_BAUD = 57600  # of the telemetry port of ArduPilot and PX4
# Baud rates that the system knows, with its own numbers for them.
BAUDS = {
    int(name[1:]): int(getattr(termios, name))
    for name in dir(termios)
    if re.fullmatch(r"B[0-9]+", name) and int(name[1:]) >= 1200
}
# What the other side of each kind of endpoint is, or how it connects.
OTHER_SIDE = {
    "udpin": "MAVSDK: udpout://{host}:{port}, pymavlink and MAVProxy: udpout:{host}:{port}",
    "udpout": "MAVSDK: udpin://0.0.0.0:{port}, pymavlink and MAVProxy: udpin:0.0.0.0:{port}",
    "tcpin": "MAVSDK: tcpout://{host}:{port}, pymavlink and MAVProxy: tcp:{host}:{port}",
    "tcp": "it is a server: ArduPilot's SITL, or a program with tcpin:0.0.0.0:{port}",
    "serial": "8 data bits, no parity, no flow control",
}
# Ports of PX4's first simulated vehicle for programs: where it sends to, and where it listens.
PX4_PORTS = {"udpout": 14540, "udpin": 14580}


class Address(NamedTuple):
    """The parts of a URL."""

    kind: str  # udpin, udpout, tcp, tcpin or serial
    host: str  # or the serial device
    port: int  # or the baud rate

    @property
    def text(self) -> str:
        """The URL itself, with its port or baud rate."""
        return f"{self.kind}:{self.host}:{self.port}"

    @property
    def other_side(self) -> str:
        """What the other side is, or how it connects."""
        host = "HOST" if self.host == EVERYWHERE else self.host
        return OTHER_SIDE[self.kind].format(host=host, port=self.port)

    def risk(self, may: str) -> str:
        """Return a warning that other machines reach it, and what they may then do; empty if they do not."""
        if self.kind not in LISTENING or not is_open(self.host):
            return ""
        return f"{self.text} is open to other machines: whoever reaches port {self.port} can {may}"

    def resolve(self) -> tuple[str, int]:
        """Return the IPv4 address and port; raises ValueError if the host is unknown."""
        try:
            found = socket.getaddrinfo(self.host, self.port, socket.AF_INET, socket.SOCK_STREAM)
        except OSError as error:
            raise ValueError(
                f"{self.text}: {error.strerror}; wanted an IPv4 address or the name of a host"
            ) from None
        return str(found[0][4][0]), int(found[0][4][1])


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


def parse_out(url: str, instance: int = 0) -> Address:
    """Parse the URL of an `--out`, which is UDP; raises ValueError if it is not valid.

    A missing port is that of PX4's simulated vehicle of this number.
    """
    kind, _, host = url.partition(":")
    usual = f":{PX4_PORTS[kind] + instance}" if kind in PX4_PORTS and host and ":" not in host else ""
    with contextlib.suppress(ValueError):
        if (address := parse_address(url + usual)).kind in PX4_PORTS:
            return address
    raise ValueError(
        f"{url!r} is not a MAVLink UDP URL; wanted udpout:HOST:PORT or udpin:HOST:PORT, with a port from "
        "1 to 65535"
    )


def repeated(addresses: Iterable[Address]) -> str:
    """Return the URL that is given twice; empty if none is."""
    return next((address.text for address, times in Counter(addresses).items() if times > 1), "")
