"""Protects a signed UDP link: strangers are neither heard nor answered, and do not push anyone out."""

import hashlib
import queue
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from aircraft.search.udp import MOST_PEERS, UdpLink
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
def received() -> queue.Queue:
    return queue.Queue()


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def link(tmp_path: Path, log: Log, received: queue.Queue, port: int) -> Iterator[UdpLink]:
    (tmp_path / "key").write_text("abc")
    url = f"udpin:127.0.0.1:{port}"
    signing = Signing(str(tmp_path / "key"), "uav-7", log)
    link = UdpLink(url, lambda message, sender: received.put(message), system=7, signer=signing.link(url))
    yield link
    link.close()
    signing.close()


@pytest.fixture
def caller(link: UdpLink, port: int) -> Iterator[Callable[[], socket.socket]]:
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
    link: UdpLink, caller: Callable[[], socket.socket], received: queue.Queue, log: Log
) -> None:
    stranger, guesser, station = caller(), caller(), caller()
    stranger.send(frame(1))
    guesser.send(signed(frame(2), b"?" * 32, 0, clock()))
    station.send(signed(frame(3), KEY, 0, clock()))
    assert received.get(timeout=WAIT_S).seq == 3
    link.send(mavlink.MAVLink_ping_message(0, 4, 0, 0))
    assert heard(stranger) == heard(guesser) == []
    (answer,) = heard(station)
    assert answer[2] == 1
    assert hashlib.sha256(KEY + answer[:-6]).digest()[:6] == answer[-6:]
    link.tell_refused(log)
    assert list(log.tally.refused.values()) == [1, 1]


def test_a_radio_is_let_through_but_nobody_becomes_a_peer_by_it(
    link: UdpLink, caller: Callable[[], socket.socket], received: queue.Queue, log: Log
) -> None:
    stranger = caller()
    stranger.send(frame(0, RADIO))
    assert received.get(timeout=WAIT_S).get_type() == "RADIO_STATUS"
    link.send(mavlink.MAVLink_ping_message(0, 1, 0, 0))
    assert heard(stranger) == []
    link.tell_refused(log)
    assert not log.tally.refused


def test_strangers_push_no_station_out(
    link: UdpLink, caller: Callable[[], socket.socket], received: queue.Queue
) -> None:
    station, last = caller(), caller()
    station.send(signed(frame(1), KEY, 0, clock()))
    for number in range(2 * MOST_PEERS):
        stranger = caller()
        stranger.send(frame(number))
        stranger.send(frame(number, RADIO))
    last.send(signed(frame(2), KEY, 1, clock()))
    while received.get(timeout=WAIT_S).get_type() != "PING" or received.qsize():
        pass
    link.send(mavlink.MAVLink_ping_message(0, 3, 0, 0))
    assert len(heard(station)) == 1


def test_a_good_frame_behind_a_refused_one_in_a_datagram_is_read(
    link: UdpLink, caller: Callable[[], socket.socket], received: queue.Queue
) -> None:
    caller().send(frame(1) + signed(frame(2), KEY, 0, clock()))
    assert received.get(timeout=WAIT_S).seq == 2
    assert link.garbage == 0
