"""Protects the URLs of the bridge: what they mean, and that a wrong one gets one line that says what is
allowed.
"""

import pytest

from aircraft.bridge.address import Address, parse_address, parse_out


@pytest.mark.parametrize(
    ("url", "parts"),
    [
        ("udpin:127.0.0.1:14550", ("udpin", "127.0.0.1", 14550)),
        ("udpout:gcs.local:1", ("udpout", "gcs.local", 1)),
        ("tcp:127.0.0.1:5760", ("tcp", "127.0.0.1", 5760)),
        ("tcpin:0.0.0.0:65535", ("tcpin", "0.0.0.0", 65535)),
        ("serial:/dev/ttyACM0", ("serial", "/dev/ttyACM0", 57600)),
        ("serial:/dev/ttyUSB0:921600", ("serial", "/dev/ttyUSB0", 921600)),
        (
            "serial:/dev/serial/by-path/pci-0:00-usb-0:1:1.0-port0",
            ("serial", "/dev/serial/by-path/pci-0:00-usb-0:1:1.0-port0", 57600),
        ),
    ],
)
def test_a_url_names_its_kind_place_and_port_or_baud_rate(url: str, parts: tuple[str, str, int]) -> None:
    assert parse_address(url) == Address(*parts)


@pytest.mark.parametrize(
    "url",
    [
        *(
            "",
            "udp:h:1",
            "udpin:",
            "udpin:14550",
            "udpin::14550",
            "udpin:h",
            "udpin:h:1:2",
            "UDPIN:h:1",
            "udpout:h:0",
        ),
        *("tcp:h:65536", "tcp:h:-1", "tcp:h:1\n", "tcpin://h:1", "serial:", "serial:/dev/tty A"),
    ],
)
def test_a_wrong_url_is_refused_in_one_line_that_names_it_and_what_is_allowed(url: str) -> None:
    with pytest.raises(
        ValueError,
        match="wanted udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEV",
    ) as refusal:
        parse_address(url)
    assert repr(url) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_wrong_baud_rate_is_refused_with_those_that_are_allowed() -> None:
    with pytest.raises(
        ValueError, match=r"57601 baud is not allowed; wanted one of .*9600.* 57600, 115200"
    ) as refusal:
        parse_address("serial:/dev/ttyS0:57601")
    assert "\n" not in str(refusal.value)


def test_only_what_listens_is_open_to_other_machines() -> None:
    listening = {
        url
        for kind in ("udpin", "udpout", "tcp", "tcpin")
        for url in [f"{kind}:0.0.0.0:9"]
        if parse_address(url).risk("command the vehicle")
    }
    assert listening == {"udpin:0.0.0.0:9", "tcpin:0.0.0.0:9"}


def test_what_others_may_do_is_said_with_the_port() -> None:
    assert parse_address("udpin:0.0.0.0:9").risk("command the vehicle") == (
        "udpin:0.0.0.0:9 is open to other machines: whoever reaches port 9 can command the vehicle"
    )
    assert parse_address("udpin:127.0.0.1:9").risk("command the vehicle") == ""


@pytest.mark.parametrize(
    "url",
    [
        "",
        "udp:127.0.0.1:14540",
        "udpin:",
        "udpout:127.0.0.1:",
        "udpout::1",
        "udpout:h:0",
        "udpout:h:65536",
        "udpout:h:-1",
        "tcp:h:1",
    ],
)
def test_a_wrong_url_of_an_out_is_refused_in_one_line_that_names_it_and_what_is_allowed(url: str) -> None:
    with pytest.raises(ValueError, match="wanted udpout:HOST:PORT or udpin:HOST:PORT") as refusal:
        parse_out(url)
    assert repr(url) in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("url", "instance", "port"),
    [("udpout:h", 0, 14540), ("udpout:h", 3, 14543), ("udpin:h", 3, 14583), ("udpin:h:9", 3, 9)],
)
def test_a_missing_port_of_an_out_is_that_of_px4s_vehicle_of_the_same_number(
    url: str, instance: int, port: int
) -> None:
    assert parse_out(url, instance).text == f"{url.removesuffix(':9')}:{port}"


def test_the_other_side_is_told_the_url_it_needs() -> None:
    assert "udpout:127.0.0.1:9" in parse_address("udpin:127.0.0.1:9").other_side
    assert "udpin:0.0.0.0:9" in parse_address("udpout:127.0.0.1:9").other_side
    assert "tcp:HOST:9" in parse_address("tcpin:0.0.0.0:9").other_side
