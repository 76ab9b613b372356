"""Who reaches an address that a part listens on: this machine alone, or others too."""

import ipaddress
import re

INTERNET = ("tcp", "tls", "udp", "quic", "ws")  # protocols of Zenoh whose addresses are HOST:PORT


def is_open(host: str) -> bool:
    """Whether other machines reach what listens on a host.

    An empty one is all interfaces; of names only localhost is surely ours.
    """
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host.lower() != "localhost"
    return not (getattr(address, "ipv4_mapped", None) or address).is_loopback


def endpoint_is_open(endpoint: str) -> bool:
    """Whether other machines reach what listens on a Zenoh endpoint."""
    protocol, _, address = endpoint.partition("/")
    return not protocol.startswith("unixsock") and is_open(host_and_port(address)[0])


def host_and_port(address: str) -> tuple[str, str]:
    """Return host and port of a Zenoh address, without its metadata and configuration."""
    host, _, port = address.partition("#")[0].partition("?")[0].rpartition(":")
    return host.strip("[]"), port


def can_be_called(endpoint: str) -> bool:
    """Whether a Zenoh endpoint names a host and a port, where its protocol has them."""
    protocol, _, address = endpoint.partition("/")
    host, port = host_and_port(address)
    has_both = host and re.fullmatch("[0-9]{1,5}", port) and 0 < int(port) <= 65535
    return protocol not in INTERNET or bool(has_both)
