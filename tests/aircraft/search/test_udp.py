"""Protects the UDP link: what it refuses, what it survives, and that closing it frees its thread and
socket.
"""

import contextlib
import queue
import socket
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

import aircraft.search.udp
from aircraft.search.udp import MOST_PEERS, UdpLink, decode, parse_url
from link.cli import BAD_INPUT
from sitl.__main__ import main

WAIT_S = 60.0  # far longer than it takes; only a failure waits for it


def frame(force_mavlink1=False, gas=1.5):
    message = mavlink.MAVLink_named_value_float_message(7, b"gas", gas)
    return bytes(
        message.pack(mavlink.MAVLink(None, srcSystem=255, srcComponent=190), force_mavlink1=force_mavlink1)
    )


@pytest.fixture
def peer():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(WAIT_S)
        yield peer


@pytest.fixture
def received():
    return queue.Queue()


def into(received):
    """What puts received messages, without their senders, into a queue."""
    return lambda message, sender: received.put(message)


@pytest.fixture
def link(peer, received):
    link = UdpLink(f"udpout:127.0.0.1:{peer.getsockname()[1]}", into(received), system=7)
    yield link
    link.close()


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
def test_a_bad_url_is_refused_in_one_line_that_names_it_and_what_is_allowed(url):
    with pytest.raises(ValueError, match="allowed is udpout:HOST:PORT or udpin:HOST:PORT") as refusal:
        parse_url(url)
    assert repr(url) in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("url", "instance", "port"),
    [("udpout:h", 0, 14540), ("udpout:h", 3, 14543), ("udpin:h", 3, 14583), ("udpin:h:9", 3, 9)],
)
def test_a_missing_port_is_that_of_px4s_vehicle_of_the_same_number(url, instance, port):
    assert parse_url(url, instance).port == port
    assert parse_url(url, instance).text == f"{url.removesuffix(':9')}:{port}"


def test_an_unknown_host_is_refused():
    with pytest.raises(ValueError, match=r"udpout:no\.such\.host\.invalid:14540"):
        UdpLink("udpout:no.such.host.invalid:14540", print)


def test_a_good_url_is_who_calls_and_a_host_and_a_port():
    assert parse_url("udpout:127.0.0.1:14540") == (False, "127.0.0.1", 14540)
    assert parse_url("udpin:0.0.0.0:14550") == (True, "0.0.0.0", 14550)


def test_each_form_says_what_its_clients_are_given():
    assert "pymavlink and MAVProxy: udpin:0.0.0.0:14540" in parse_url("udpout:127.0.0.1:14540").counterpart
    assert "pymavlink and MAVProxy: udpout:HOST:14550" in parse_url("udpin:0.0.0.0:14550").counterpart


@given(st.binary(max_size=400))
def test_garbage_is_counted_and_never_an_error(garbage):
    messages, skipped, rest = decode(garbage)
    assert skipped + len(rest) == len(garbage) - sum(len(m.get_msgbuf()) for m in messages)


@given(st.binary(max_size=40).filter(lambda garbage: garbage[-20:] not in frame()), st.booleans())
def test_garbage_never_swallows_the_frame_behind_it(garbage, mavlink1):
    messages, skipped, _ = decode(garbage + frame(mavlink1))
    assert [(m.get_type(), m.value) for m in messages][-1] == ("NAMED_VALUE_FLOAT", 1.5)
    assert skipped <= len(garbage)


def test_a_broken_checksum_and_an_unknown_message_are_garbage():
    broken = frame()[:-1] + bytes([frame()[-1] ^ 1])
    assert decode(broken) == ([], len(broken), b"")
    unknown = bytearray(frame())
    unknown[7:10] = (0xAB, 0xCD, 0xEF)
    assert decode(bytes(unknown))[0] == []


def test_a_signed_frame_is_read():
    signer = mavlink.MAVLink(None, srcSystem=255)
    signer.signing.secret_key, signer.signing.sign_outgoing = b"k" * 32, True
    messages, skipped, _ = decode(
        bytes(mavlink.MAVLink_named_value_float_message(7, b"gas", 2.5).pack(signer))
    )
    assert [m.value for m in messages] == [2.5]
    assert skipped == 0


@pytest.mark.parametrize("mavlink1", [False, True])
def test_a_frame_that_is_cut_anywhere_is_whole_again_with_its_other_half(mavlink1):
    whole = frame(mavlink1)
    for cut in range(1, len(whole)):
        messages, skipped, rest = decode(b"??" + whole[:cut])
        assert (messages, skipped, rest) == ([], 2, whole[:cut])
        messages, skipped, rest = decode(rest + whole[cut:] + b"??")
        assert ([m.value for m in messages], skipped, rest) == ([1.5], 2, b"")


@given(st.binary(max_size=60).filter(lambda beginning: beginning[-20:] not in frame()))
def test_the_beginning_of_a_frame_that_never_comes_does_not_delay_the_next(beginning):
    _, _, rest = decode(beginning)
    messages, _, rest = decode(rest + frame())
    assert [m.value for m in messages][-1] == 1.5
    assert rest == b""


def test_what_is_kept_for_the_next_datagram_is_shorter_than_the_longest_frame():
    longest = 10 + 255 + 2 + 13  # header, payload, checksum, signature
    for noise in (b"\xfd\xff\x01" * 400, b"\xfe\xff\x00" * 400):
        assert 0 < len(decode(noise).rest) < longest


@pytest.mark.parametrize(
    "start", [b"\xfe", b"\xfd", b"\xfe\x00\x00\x01\x01\x00", b"\xfd\x00\x00\x00\x00\x01"]
)
def test_a_flood_of_false_starts_costs_little(start):
    parsed, decode_once = [], aircraft.search.udp.frame_at
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "aircraft.search.udp.frame_at",
            lambda data, start: parsed.append(start) or decode_once(data, start),
        )
        messages, garbage, rest = decode(start * (60_000 // len(start)))
    assert (messages, garbage, rest) == ([], 60_000, b"")
    assert len(parsed) <= 500


def test_nobody_listening_is_survived(received):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        address = probe.getsockname()
    link = UdpLink(f"udpout:127.0.0.1:{address[1]}", into(received))
    try:
        for _ in range(20):
            link.send(mavlink.MAVLink_ping_message(0, 0, 0, 0))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
            late.bind(address)
            late.settimeout(WAIT_S)
            link.send(mavlink.MAVLink_ping_message(0, 1, 0, 0), mavlink.MAVLink_ping_message(0, 2, 0, 0))
            _, sender = late.recvfrom(1000)
            late.sendto(frame(), sender)
            assert received.get(timeout=WAIT_S).value == 1.5
    finally:
        link.close()


def test_messages_go_out_as_mavlink_2_with_the_links_own_numbers(link, peer):
    sent = []
    for n in range(258):
        link.send(mavlink.MAVLink_ping_message(0, n, 0, 0))
        sent += decode(peer.recv(1000))[0]
    assert [m.get_seq() for m in sent] == [n % 256 for n in range(258)]
    assert {(m.get_srcSystem(), m.get_srcComponent(), m.get_msgbuf()[0]) for m in sent} == {(7, 1, 0xFD)}


def test_both_protocol_versions_are_received_and_garbage_between_them_is_counted(link, peer, received):
    link.send(mavlink.MAVLink_ping_message(0, 0, 0, 0))
    _, sender = peer.recvfrom(1000)
    peer.sendto(b"\xfdgarbage", sender)
    peer.sendto(frame(force_mavlink1=True, gas=1.0) + b"??" + frame(gas=2.0), sender)
    assert [received.get(timeout=WAIT_S).value for _ in range(2)] == [1.0, 2.0]
    assert link.garbage == len(b"\xfdgarbage??")


def test_a_handler_that_fails_does_not_end_the_link(peer, received, caplog):
    def handle(message, sender):
        received.put(message)
        raise RuntimeError("no")

    link = UdpLink(f"udpout:127.0.0.1:{peer.getsockname()[1]}", handle)
    try:
        link.send(mavlink.MAVLink_ping_message(0, 0, 0, 0))
        _, sender = peer.recvfrom(1000)
        for gas in (1.0, 2.0):
            peer.sendto(frame(gas=gas), sender)
        assert [received.get(timeout=WAIT_S).value for _ in range(2)] == [1.0, 2.0]
    finally:
        link.close()
    assert "NAMED_VALUE_FLOAT was not handled" in caplog.text


def test_close_ends_the_thread_and_frees_the_socket_and_may_be_repeated(peer, received):
    before = threading.active_count()
    link = UdpLink(f"udpout:127.0.0.1:{peer.getsockname()[1]}", into(received))
    link.send(mavlink.MAVLink_ping_message(0, 0, 0, 0))
    _, own = peer.recvfrom(1000)
    link.close()
    link.close()
    assert threading.active_count() == before
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(own)
    link.send(mavlink.MAVLink_ping_message(0, 1, 0, 0))
    peer.setblocking(False)
    with pytest.raises(BlockingIOError):  # sending on a closed link has no effect and raises nothing
        peer.recv(1000)


class TestUdpIn:
    """`udpin:HOST:PORT`: bound to its port, it answers every sender."""

    @pytest.fixture
    def port(self):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            return probe.getsockname()[1]

    def test_each_message_comes_with_the_address_of_its_sender(self, port, peer):
        heard = queue.Queue()
        with contextlib.closing(
            UdpLink(f"udpin:127.0.0.1:{port}", lambda message, sender: heard.put((message.value, sender)))
        ):
            peer.sendto(frame(gas=1.0), ("127.0.0.1", port))
            assert heard.get(timeout=WAIT_S) == (1.0, f"127.0.0.1:{peer.getsockname()[1]}")

    @pytest.fixture
    def link(self, port, received):
        link = UdpLink(f"udpin:127.0.0.1:{port}", into(received), system=7)
        yield link
        link.close()

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

    def greet(self, station, received):
        station.send(frame())
        assert received.get(timeout=WAIT_S).value == 1.5

    def numbers(self, station):
        """The pings that wait at a station; on one machine a sent datagram has already arrived."""
        station.setblocking(False)
        pings = []
        try:
            while True:
                pings += [message.seq for message in decode(station.recv(1000))[0]]
        except BlockingIOError:
            return pings

    def ping(self, link, number):
        link.send(mavlink.MAVLink_ping_message(0, number, 0, 0))

    def test_a_pymavlink_client_that_calls_is_heard_and_answered(self, link, port, received):
        client = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=255)
        try:
            client.mav.heartbeat_send(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE
            )
            heartbeat = received.get(timeout=WAIT_S)
            assert (heartbeat.get_type(), heartbeat.get_srcSystem()) == ("HEARTBEAT", 255)
            self.ping(link, 42)
            answer = client.recv_match(type="PING", blocking=True, timeout=WAIT_S)
            assert (answer.seq, answer.get_srcSystem()) == (42, 7)
        finally:
            client.close()

    def test_frames_split_over_datagrams_are_joined_for_each_peer(self, link, station, received):
        one, two = station(), station()
        one.send(frame(gas=1.0)[:9])
        two.send(b"\xfe\xff" + bytes(20))  # the beginning of a frame that never ends
        two.send(frame(gas=2.0)[:15])
        one.send(frame(gas=1.0)[9:] + frame(gas=3.0))
        two.send(frame(gas=2.0)[15:])
        assert [received.get(timeout=WAIT_S).value for _ in range(3)] == [1.0, 3.0, 2.0]

    def test_beginnings_of_frames_from_many_strangers_are_not_kept_for_ever(self, link, station, received):
        known = station()
        self.greet(known, received)
        known.send(frame(gas=4.0)[:9])
        for _ in range(3 * MOST_PEERS):
            station().send(b"\xfe\xff")
        known.send(frame(gas=4.0)[9:])
        assert received.get(timeout=WAIT_S).value == 4.0
        assert len(link.rests) <= MOST_PEERS

    def test_nothing_is_sent_before_somebody_has_spoken_and_garbage_is_not_speaking(
        self, link, station, received
    ):
        caller = station()
        caller.send(b"not a frame")
        caller.send(b"\xfd" + bytes(40))
        self.ping(link, 1)
        self.greet(caller, received)  # the garbage was read before this greeting
        assert link.garbage == len(b"not a frame") + 41
        self.ping(link, 2)
        assert self.numbers(caller) == [2]

    def test_several_stations_get_all_messages_and_all_are_heard(self, link, station, received):
        first, second = station(), station()
        self.greet(first, received)
        self.ping(link, 1)
        self.greet(second, received)
        self.ping(link, 2)
        assert self.numbers(first) == [1, 2]
        assert self.numbers(second) == [2]

    def test_a_station_that_has_gone_is_survived_and_one_that_comes_after_it_is_served(
        self, link, station, received
    ):
        gone, late = station(), station()
        self.greet(gone, received)
        gone.close()
        for number in range(3):
            self.ping(link, number)
        self.greet(late, received)
        self.ping(link, 3)
        assert self.numbers(late) == [3]

    def test_who_is_silent_for_too_long_is_sent_no_more_until_it_speaks_again(
        self, link, station, received, monkeypatch
    ):
        caller = station()
        self.greet(caller, received)
        monkeypatch.setattr("aircraft.search.udp.FORGET_AFTER_S", 0.0)
        self.ping(link, 1)
        monkeypatch.undo()
        self.ping(link, 2)
        assert self.numbers(caller) == [2]

    def test_of_many_callers_the_last_are_served(self, link, station, received):
        callers = [station() for _ in range(MOST_PEERS + 2)]
        for caller in callers:
            self.greet(caller, received)
        self.greet(callers[0], received)  # a peer that keeps sending stays served
        self.ping(link, 1)
        served = [self.numbers(caller) == [1] for caller in callers]
        assert served == [True, False, False] + [True] * (MOST_PEERS - 1)

    def test_a_port_that_is_taken_is_refused(self, link, port):
        with pytest.raises(ValueError, match=f"udpin:127.0.0.1:{port}.*Address already in use"):
            UdpLink(f"udpin:127.0.0.1:{port}", print)

    def test_a_port_that_is_taken_is_bad_input_to_the_command(self, link, port, monkeypatch, capsys):
        monkeypatch.setattr("sys.argv", ["sitl", "uav", "--out", f"udpin:127.0.0.1:{port}"])
        assert main() == BAD_INPUT
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(
            f"error: --out: 'udpin:127.0.0.1:{port}' cannot be used: Address already in use"
        )

    def test_close_ends_the_thread_and_frees_the_port(self, port, received, station):
        before = threading.active_count()
        link = UdpLink(f"udpin:127.0.0.1:{port}", into(received))
        caller = station()
        self.greet(caller, received)
        link.close()
        link.close()
        assert threading.active_count() == before
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
            again.bind(("127.0.0.1", port))
        self.ping(link, 1)
        assert self.numbers(caller) == []
