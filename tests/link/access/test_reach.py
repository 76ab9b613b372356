"""Protects the one answer to whether other machines reach an address: routers, MAVLink endpoints and the
page all go by it.
"""

import pytest

from aircraft.bridge.address import parse_address
from ground.view.access import AccessRules
from link.access.reach import can_be_called, endpoint_is_open, is_open

OPEN = {
    "127.0.0.1": False,
    "127.0.0.2": False,
    "127.255.255.254": False,
    "localhost": False,
    "LocalHost": False,
    "::1": False,
    "0:0:0:0:0:0:0:1": False,
    "::ffff:127.0.0.1": False,
    "0.0.0.0": True,
    "::": True,
    "*": True,
    "192.168.1.2": True,
    "10.0.0.1": True,
    "169.254.1.1": True,
    "fe80::1": True,
    "::ffff:192.168.1.2": True,
    "drone.lan": True,
    "127.evil.org": True,  # a name may point anywhere
    "127.0.0.1.evil.org": True,
    "localhost.evil.org": True,
    "notlocalhost": True,
}


@pytest.mark.parametrize(("host", "others"), OPEN.items())
def test_all_that_listen_agree_on_who_reaches_a_host(host: str, others: bool) -> None:
    bracketed = f"[{host}]" if ":" in host else host
    said = {
        "host": is_open(host),
        "router": endpoint_is_open(f"tcp/{bracketed}:7447"),
        "page": AccessRules(host, 8447).why_no_commands("") != "",
    }
    if ":" not in host:  # MAVLink's URLs know no IPv6
        said |= {
            f"MAVLink, {kind}": parse_address(f"{kind}:{host}:14550").risk("command") != ""
            for kind in ("udpin", "tcpin")
        }
    assert said == dict.fromkeys(said, others)


def test_no_host_is_every_interface() -> None:
    assert is_open("")
    assert AccessRules("", 8447).why_no_commands("") != ""


def test_an_endpoint_of_a_router_is_open_by_its_host() -> None:
    assert not endpoint_is_open("tcp/127.0.0.2:0?prio=1#iface=lo")
    assert endpoint_is_open("tls/[::]:0#iface=lo")
    assert not endpoint_is_open("unixsock-stream/router.sock")  # a file


@pytest.mark.parametrize(
    "endpoint", ["tcp/10.0.0.7:65535", "tls/[::1]:1?prio=1#iface=lo", "unixsock-stream/a"]
)
def test_an_endpoint_with_host_and_port_can_be_called(endpoint: str) -> None:
    assert can_be_called(endpoint)


@pytest.mark.parametrize(
    "endpoint", ["tcp/a", "tcp/:1", "tcp/a:", "tcp/a:0", "tls/a:65536", "udp/a:²", "ws/[::1]"]
)
def test_an_endpoint_without_host_or_port_cannot_be_called(endpoint: str) -> None:
    assert not can_be_called(endpoint)
