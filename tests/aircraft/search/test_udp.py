"""Protects the vehicle's UDP ports: what they refuse, what they survive, who is answered, and that closing them
frees thread and socket.
"""

import contextlib
import socket
import threading
import time

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

from aircraft.bridge.links import MOST_PEERS
from aircraft.search.udp import UdpPorts
from link.bus.frames import FrameStream
from link.bus.log import Log
from link.bus.tally import Tally
from link.cli import BAD_INPUT
from sitl.__main__ import main

WAIT_S = 60.0  # far longer than it takes; only a failure waits for it


def frame(force_mavlink1=False, gas=1.5):
    message = mavlink.MAVLink_named_value_float_message(7, b"gas", gas)
    return bytes(
        message.pack(mavlink.MAVLink(None, srcSystem=255, srcComponent=190), force_mavlink1=force_mavlink1)
    )


def opened(*urls):
    return UdpPorts(urls, Log("uav", "test", Tally(), "error"), system=7, component=1)


def values(link, count):
    """The next gas values that come, as many as that; and nothing else has come by then."""
    heard = []
    while len(heard) < count:
        assert link.selector.select(WAIT_S)
        heard += [message.value for _, message, _ in link.receive()]
    return heard


def numbers_in(*datagrams):
    """The numbers of the pings that a station was sent."""
    return [
        mavlink.MAVLink(None).decode(bytearray(one.data)).seq
        for datagram in datagrams
        for one in FrameStream().take(datagram, datagram=True)
    ]


def garbage(link):
    return link.endpoints[0].traffic.dropped["bytes of garbage"]


def ping(link, *numbers):
    link.ports[0].send(*[mavlink.MAVLink_ping_message(0, number, 0, 0) for number in numbers])


@pytest.fixture
def peer():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(WAIT_S)
        yield peer


@pytest.fixture
def link(peer):
    with contextlib.closing(opened(f"udpout:127.0.0.1:{peer.getsockname()[1]}")) as link:
        yield link


def test_an_unknown_host_is_refused():
    with pytest.raises(ValueError, match=r"udpout:no\.such\.host\.invalid:14540"):
        opened("udpout:no.such.host.invalid:14540")


def test_nobody_listening_is_survived():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        address = probe.getsockname()
    with contextlib.closing(opened(f"udpout:127.0.0.1:{address[1]}")) as link:
        ping(link, *range(20))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
            late.bind(address)
            late.settimeout(WAIT_S)
            ping(link, 1, 2)
            _, sender = late.recvfrom(1000)
            late.sendto(frame(), sender)
            assert values(link, 1) == [1.5]


def test_messages_go_out_as_mavlink_2_with_the_ports_own_numbers(link, peer):
    sent = []
    for n in range(258):
        ping(link, n)
        sent.append(peer.recv(1000))
    assert [data[4] for data in sent] == [n % 256 for n in range(258)]
    assert {(data[5], data[6], data[0]) for data in sent} == {(7, 1, 0xFD)}


def test_both_protocol_versions_are_received_and_garbage_between_them_is_counted(link, peer):
    ping(link, 0)
    _, sender = peer.recvfrom(1000)
    peer.sendto(b"\xfdgarbage", sender)
    peer.sendto(frame(force_mavlink1=True, gas=1.0) + b"??" + frame(gas=2.0), sender)
    assert values(link, 2) == [1.0, 2.0]
    assert garbage(link) == len(b"\xfdgarbage??")


def test_what_has_come_rings_once_until_it_is_taken(link, peer, wait_until):
    rung = []
    link.ring(lambda: rung.append(len(rung)))
    ping(link, 0)
    _, sender = peer.recvfrom(1000)
    for turn in (1, 2):
        peer.sendto(frame(), sender)
        peer.sendto(frame(), sender)
        wait_until(lambda turn=turn: len(rung) >= turn)
        assert values(link, 2) == [1.5, 1.5]


def test_close_ends_the_thread_and_frees_the_socket(peer):
    before = threading.active_count()
    link = opened(f"udpout:127.0.0.1:{peer.getsockname()[1]}")
    link.ring(lambda: None)
    ping(link, 0)
    _, own = peer.recvfrom(1000)
    link.close()
    assert threading.active_count() == before
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(own)


class TestUdpIn:
    """`udpin:HOST:PORT`: bound to its port, it answers every sender."""

    @pytest.fixture
    def port(self):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            return probe.getsockname()[1]

    @pytest.fixture
    def link(self, port):
        with contextlib.closing(opened(f"udpin:127.0.0.1:{port}")) as link:
            yield link

    @pytest.fixture
    def station(self, port):
        """Makes ground stations: sockets that send to the link."""
        stations = []

        def make():
            station = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            station.connect(("127.0.0.1", port))
            station.settimeout(WAIT_S)
            stations.append(station)
            return station

        yield make
        for station in stations:
            station.close()

    def greet(self, station, link):
        station.send(frame())
        assert values(link, 1) == [1.5]

    def numbers(self, station):
        """The pings that wait at a station; on one machine a sent datagram has already arrived."""
        station.setblocking(False)
        datagrams = []
        with contextlib.suppress(BlockingIOError):
            while True:
                datagrams.append(station.recv(1000))
        return numbers_in(*datagrams)

    def test_each_message_comes_with_its_port_and_the_address_of_its_sender(self, link, port, peer):
        peer.sendto(frame(gas=1.0), ("127.0.0.1", port))
        link.selector.select(WAIT_S)
        ((own, message, sender),) = link.receive()
        assert (own, message.value) == (link.ports[0], 1.0)
        assert sender == f"127.0.0.1:{peer.getsockname()[1]}"

    def test_a_pymavlink_client_that_calls_is_heard_and_answered(self, link, port):
        client = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=255)
        try:
            client.mav.heartbeat_send(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE
            )
            link.selector.select(WAIT_S)
            ((_, heartbeat, _),) = link.receive()
            assert (heartbeat.get_type(), heartbeat.get_srcSystem()) == ("HEARTBEAT", 255)
            ping(link, 42)
            answer = client.recv_match(type="PING", blocking=True, timeout=WAIT_S)
            assert (answer.seq, answer.get_srcSystem()) == (42, 7)
        finally:
            client.close()

    def test_frames_split_over_datagrams_are_joined_for_each_peer(self, link, station):
        one, two = station(), station()
        one.send(frame(gas=1.0)[:9])
        two.send(b"\xfe\xff" + bytes(20))  # the beginning of a frame that never ends
        two.send(frame(gas=2.0)[:15])
        one.send(frame(gas=1.0)[9:] + frame(gas=3.0))
        two.send(frame(gas=2.0)[15:])
        assert values(link, 3) == [1.0, 3.0, 2.0]

    def test_strangers_who_only_begin_frames_push_no_peer_out(self, link, station):
        known = station()
        self.greet(known, link)
        known.send(frame(gas=4.0)[:9])
        for _ in range(3 * MOST_PEERS):
            station().send(b"\xfe\xff")
        known.send(frame(gas=4.0)[9:])
        assert values(link, 1) == [4.0]
        ping(link, 1)
        assert self.numbers(known) == [1]

    def test_nothing_is_sent_before_somebody_has_spoken_and_garbage_is_not_speaking(self, link, station):
        caller = station()
        caller.send(b"not a frame")
        caller.send(b"\xfd" + bytes(40))
        ping(link, 1)
        self.greet(caller, link)  # the garbage was read before this greeting
        assert garbage(link) == len(b"not a frame") + 41
        ping(link, 2)
        assert self.numbers(caller) == [2]

    def test_several_stations_get_all_messages_and_all_are_heard(self, link, station):
        first, second = station(), station()
        self.greet(first, link)
        ping(link, 1)
        self.greet(second, link)
        ping(link, 2)
        assert self.numbers(first) == [1, 2]
        assert self.numbers(second) == [2]

    def test_a_station_that_has_gone_is_survived_and_one_that_comes_after_it_is_served(self, link, station):
        gone, late = station(), station()
        self.greet(gone, link)
        gone.close()
        ping(link, 0, 1, 2)
        self.greet(late, link)
        ping(link, 3)
        assert self.numbers(late) == [3]

    def test_who_is_silent_for_too_long_is_sent_no_more_until_it_speaks_again(
        self, link, station, monkeypatch
    ):
        caller = station()
        self.greet(caller, link)
        monkeypatch.setattr("aircraft.bridge.udp.FORGET_AFTER_S", 0.0)
        link.endpoints[0].tick(time.monotonic())
        ping(link, 1)
        monkeypatch.undo()
        self.greet(caller, link)
        ping(link, 2)
        assert self.numbers(caller) == [2]

    def test_of_many_callers_the_last_are_served(self, link, station):
        callers = [station() for _ in range(MOST_PEERS + 2)]
        for caller in callers:
            self.greet(caller, link)
        self.greet(callers[0], link)  # a peer that keeps sending stays served
        ping(link, 1)
        served = [self.numbers(caller) == [1] for caller in callers]
        assert served == [True, False, False] + [True] * (MOST_PEERS - 1)

    def test_a_port_that_is_taken_is_refused(self, link, port):
        with pytest.raises(ValueError, match=f"udpin:127.0.0.1:{port}.*Address already in use"):
            opened(f"udpin:127.0.0.1:{port}")

    def test_a_port_that_is_taken_is_bad_input_to_the_command(self, link, port, monkeypatch, capsys):
        monkeypatch.setattr("sys.argv", ["sitl", "uav", "--out", f"udpin:127.0.0.1:{port}"])
        assert main() == BAD_INPUT
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"error: --out: udpin:127.0.0.1:{port}: Address already in use")

    def test_a_url_that_is_given_twice_is_refused_as_such(self, port, monkeypatch, capsys):
        url = f"udpin:127.0.0.1:{port}"
        monkeypatch.setattr("sys.argv", ["sitl", "uav", "--out", url, "--out", url])
        assert main() == BAD_INPUT
        told = f"error: --out: {url} is given twice; wanted different endpoints\n"
        assert capsys.readouterr().err == told

    def test_close_frees_the_port(self, port, station):
        link = opened(f"udpin:127.0.0.1:{port}")
        self.greet(station(), link)
        link.close()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
            again.bind(("127.0.0.1", port))
