"""Protects the page's server from a WebSocket client that makes it keep ever more: what it has not read, and
pieces of a message that never ends.
"""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest
from starlette.types import Receive, Scope, Send
from uvicorn.server import ServerState
from websockets.frames import Frame, Opcode

from ground.view.serving import PageSocket, server_of

HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: here\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)


def frame(opcode: Opcode, data: bytes, *, fin: bool = True) -> bytes:
    return Frame(opcode, data, fin).serialize(mask=True)


class Client(asyncio.Transport):
    """The other side of a connection, which reads nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.unread = b""

    def write(self, data: Any) -> None:
        self.unread += data

    def pause_reading(self) -> None: ...

    def resume_reading(self) -> None: ...

    def close(self) -> None: ...

    def abort(self) -> None: ...

    def is_closing(self) -> bool:
        return False


def page(said: Callable[[PageSocket, Client], None]) -> list[Any]:
    """Let a client that has joined say something; returns the messages that the application got."""
    heard: list[Any] = []

    async def app(_: Scope, receive: Receive, send: Send) -> None:
        await receive()
        await send({"type": "websocket.accept"})
        heard.append(await receive())

    async def run() -> None:
        config = server_of(app, 4096, proxied=False).config
        socket, client = PageSocket(config, ServerState(), {}), Client()
        socket.connection_made(client)
        socket.data_received(HANDSHAKE)
        (task,) = socket.tasks
        while b"101 Switching" not in client.unread:
            await asyncio.sleep(0)
        client.unread = b""
        said(socket, client)
        await asyncio.wait_for(task, 10.0)

    asyncio.run(run())
    return heard


def test_pings_of_a_client_that_reads_nothing_wait_for_no_answers() -> None:
    def said(socket: PageSocket, client: Client) -> None:
        socket.data_received(frame(Opcode.PING, b"first"))
        assert client.unread.endswith(b"first")
        socket.pause_writing()  # as the transport says where too much is unread
        before = client.unread
        for _ in range(1000):
            socket.data_received(frame(Opcode.PING, bytes(100)))
        assert client.unread == before
        socket.resume_writing()
        socket.data_received(frame(Opcode.PING, b"last"))
        assert client.unread == before + b"\x8a\x04last"
        socket.data_received(frame(Opcode.TEXT, b"end"))

    assert page(said)[0]["text"] == "end"


@pytest.mark.parametrize("end", [b"", b"!"])
def test_empty_pieces_of_a_message_are_not_kept_and_it_is_heard_whole(end: bytes) -> None:
    def said(socket: PageSocket, _: Client) -> None:
        socket.data_received(frame(Opcode.TEXT, b"who", fin=False))
        for _ in range(1000):
            socket.data_received(frame(Opcode.CONT, b"", fin=False))
        assert len(socket.frames) == 1
        socket.data_received(frame(Opcode.CONT, b" goes", fin=False) + frame(Opcode.CONT, end))

    assert page(said)[0]["text"] == f"who goes{end.decode()}"
