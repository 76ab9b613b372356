"""Protects a signed UDP link: strangers are neither heard nor answered, and do not push anyone out."""

import hashlib
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.bridge.links import MOST_PEERS
from aircraft.search.udp import UdpPorts
from link.bus.log import Log
from link.bus.tally import Tally
from link.signing.signature import signed
from link.signing.signer import Signing
from link.signing.timestamps import clock

KEY = hashlib.sha256(b"abc").digest()
WAIT_S = 60.0  # far longer than it takes; only a failure waits for it
RADIO = mavlink.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7)


def frame(number: int, message=None) -> bytes:
    return bytes(
        (message or mavlink.MAVLink_ping_message(0, number, 0, 0)).pack(
            mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        )
    )


@pytest.fixture
def log() -> Log:
    return Log("uav", "uav/1", Tally())


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def link(tmp_path: Path, log: Log, port: int) -> Iterator[UdpPorts]:
    (tmp_path / "key").write_text("abc")
    url = f"udpin:127.0.0.1:{port}"
    signing = Signing(str(tmp_path / "key"), "uav-7", log)
    link = UdpPorts([url], log, system=7, component=1, signing=signing)
    yield link
    link.close()
    signing.close()


@pytest.fixture
def caller(link: UdpPorts, port: int) -> Iterator[Callable[[], socket.socket]]:
    """Makes sockets that send to the link."""
    opened: list[socket.socket] = []

    def make() -> socket.socket:
        opened.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        opened[-1].connect(("127.0.0.1", port))
        opened[-1].settimeout(WAIT_S)
        return opened[-1]

    yield make
    for each in opened:
        each.close()


def received(link: UdpPorts) -> Any:
    """The next message that comes."""
    while True:
        assert link.selector.select(WAIT_S)
        if messages := [message for _, message, _ in link.receive()]:
            return messages[-1]


def heard(sender: socket.socket) -> list[bytes]:
    """The datagrams that wait at a socket; on one machine a sent datagram has already arrived."""
    sender.setblocking(False)
    datagrams = []
    try:
        while True:
            datagrams.append(sender.recv(1000))
    except BlockingIOError:
        return datagrams


def test_only_who_signs_is_heard_and_answered_and_the_answer_is_signed(
    link: UdpPorts, caller: Callable[[], socket.socket], log: Log
) -> None:
    stranger, guesser, station = caller(), caller(), caller()
    stranger.send(frame(1))
    guesser.send(signed(frame(2), b"?" * 32, 0, clock()))
    station.send(signed(frame(3), KEY, 0, clock()))
    assert received(link).seq == 3
    link.ports[0].send(mavlink.MAVLink_ping_message(0, 4, 0, 0))
    assert heard(stranger) == heard(guesser) == []
    (answer,) = heard(station)
    assert answer[2] == 1
    assert hashlib.sha256(KEY + answer[:-6]).digest()[:6] == answer[-6:]
    link.tick(time.monotonic())
    assert list(log.tally.refused.values()) == [1, 1]


def test_a_radio_is_not_refused_but_nobody_becomes_a_peer_by_it(
    link: UdpPorts, caller: Callable[[], socket.socket], log: Log
) -> None:
    stranger, station = caller(), caller()
    stranger.send(frame(0, RADIO))
    station.send(signed(frame(1), KEY, 0, clock()))
    assert received(link).seq == 1
    link.ports[0].send(mavlink.MAVLink_ping_message(0, 2, 0, 0))
    assert heard(stranger) == []
    assert len(heard(station)) == 1
    link.tick(time.monotonic())
    assert not log.tally.refused


def test_strangers_push_no_station_out(link: UdpPorts, caller: Callable[[], socket.socket]) -> None:
    station, last = caller(), caller()
    station.send(signed(frame(1), KEY, 0, clock()))
    for number in range(2 * MOST_PEERS):
        stranger = caller()
        stranger.send(frame(number))
        stranger.send(frame(number, RADIO))
    last.send(signed(frame(2), KEY, 1, clock()))
    while received(link).get_type() != "PING":
        pass
    link.ports[0].send(mavlink.MAVLink_ping_message(0, 3, 0, 0))
    assert len(heard(station)) == 1


def test_a_good_frame_behind_a_refused_one_in_a_datagram_is_read(
    link: UdpPorts, caller: Callable[[], socket.socket]
) -> None:
    caller().send(frame(1) + signed(frame(2), KEY, 0, clock()))
    assert received(link).seq == 2
    assert "bytes of garbage" not in link.endpoints[0].traffic.dropped
