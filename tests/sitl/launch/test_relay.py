"""Protects the relay that can be cut: it carries data both ways, nothing while cut, and resumes."""

import socket
import threading
from collections.abc import Iterator

import pytest

from sitl.launch.relay import Relay


@pytest.fixture
def echo() -> Iterator[str]:
    """The endpoint of an echo server."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve(peer: socket.socket) -> None:
        with peer:
            while data := peer.recv(65536):
                peer.sendall(data)

    def accept() -> None:
        while True:
            try:
                peer, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=serve, args=(peer,), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    yield f"tcp/127.0.0.1:{listener.getsockname()[1]}"
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()


@pytest.fixture
def relay(echo: str) -> Iterator[Relay]:
    relay = Relay(echo)
    yield relay
    relay.close()


def connected(relay: Relay) -> socket.socket:
    host, _, port = relay.endpoint.removeprefix("tcp/").partition(":")
    return socket.create_connection((host, int(port)), timeout=10.0)


def exactly(peer: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        data += peer.recv(65536)
    return data


def test_it_carries_both_ways_whole(relay: Relay) -> None:
    with connected(relay) as peer:
        data = bytes(range(256)) * 4096
        threading.Thread(target=peer.sendall, args=(data,), daemon=True).start()
        assert exactly(peer, len(data)) == data


def test_a_cut_link_is_silent_and_comes_back(relay: Relay) -> None:
    with connected(relay) as peer:
        peer.sendall(b"before")
        assert exactly(peer, 6) == b"before"
        relay.cut()
        peer.sendall(b"meanwhile")
        peer.settimeout(0.3)
        with pytest.raises(TimeoutError):  # only waiting can show that nothing arrives
            peer.recv(1)
        peer.settimeout(10.0)
        relay.restore()
        assert exactly(peer, 9) == b"meanwhile"


def test_who_connects_while_it_is_cut_is_served_afterwards(relay: Relay) -> None:
    relay.cut()
    with connected(relay) as peer:
        peer.sendall(b"hello")
        relay.restore()
        assert exactly(peer, 5) == b"hello"


def test_without_a_router_behind_it_a_connection_is_closed(echo: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        endpoint = f"tcp/127.0.0.1:{closed.getsockname()[1]}"
    relay = Relay(endpoint)
    with connected(relay) as peer:
        assert peer.recv(1) == b""
    relay.close()


def test_it_closes_though_a_router_takes_nothing() -> None:
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        relay = Relay(f"tcp/127.0.0.1:{deaf.getsockname()[1]}")
        with connected(relay) as peer:
            peer.settimeout(0.5)
            with pytest.raises(TimeoutError):  # all is full: the relay waits for the router
                peer.sendall(bytes(1 << 26))
            closing = threading.Thread(target=relay.close, daemon=True)
            closing.start()
            closing.join(20.0)
            assert not closing.is_alive()


def test_it_closes_without_a_word_while_a_connection_lasts(
    echo: str, caplog: pytest.LogCaptureFixture
) -> None:
    relay = Relay(echo)
    with connected(relay) as peer:
        peer.sendall(b"hello")
        assert exactly(peer, 5) == b"hello"
        relay.close()
    assert caplog.records == []  # asyncio logs what a task ends with


def test_other_protocols_than_tcp_are_refused() -> None:
    with pytest.raises(ValueError, match="wanted tcp/HOST:PORT"):
        Relay("udp/127.0.0.1:7447")
