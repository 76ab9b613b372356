"""How the page and the stream for Foxglove are served.

Who is refused, how many may wait, and when a slow client is gone.
"""

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from typing import Any

import msgspec
import uvicorn
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame

from ground.view.access import AccessRules

HEADERS = {
    b"content-security-policy": b"default-src 'self'; base-uri 'none'; form-action 'none'; "
    b"frame-ancestors 'none'; object-src 'none'",
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"same-origin",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"cache-control": b"no-cache",
}
MOST_WAITING = 100  # connections that are no page
SEND_S = 5.0  # a WebSocket client that takes longer to read what was sent is gone
GONE = (WebSocketDisconnect, RuntimeError)  # what a send to a client that has gone raises
UNREADABLE = (ValueError, msgspec.DecodeError, RecursionError)  # what reading a client's message raises
TRY_AGAIN_LATER, POLICY = 1013, 1008  # reasons for closing a WebSocket, by its standard's numbers


def guarded(app: ASGIApp, rules: AccessRules) -> ASGIApp:
    """Return the app behind its checks.

    Strangers get 403 and a line that says why. Every answer has HEADERS, where it has none of its own.
    A client that is too slow to read what a WebSocket sends is cut off.
    """

    async def checked(scope: Scope, receive: Receive, send: Send) -> None:
        async def answer(message: Message) -> None:
            if message["type"].endswith("http.response.start"):
                message = {**message, "headers": [*(HEADERS | dict(message["headers"])).items()]}
            async with asyncio.timeout(SEND_S if scope["type"] == "websocket" else None):
                await send(message)

        reason = _refusal(scope, rules)
        await (PlainTextResponse(f"refused: {reason}\n", 403) if reason else app)(scope, receive, answer)

    return checked


def _refusal(scope: Scope, rules: AccessRules) -> str:
    """Return why a request is refused; empty if it is not."""
    headers = Headers(scope=scope)
    hosts, origins = headers.getlist("host"), headers.getlist("origin")
    if len(hosts) != 1 or not rules.allows_host(hosts[0]):
        return f"Host {', '.join(hosts)!r} is not this server; wanted its address and port {rules.port}"
    if scope["type"] == "websocket" and (
        len(origins) > 1 or not rules.allows_origin(next(iter(origins), None), hosts[0])
    ):
        return (
            f"Origin {', '.join(origins)!r} is not this page; wanted http://{hosts[0]}, or one that "
            "--origin names"
        )
    return ""


async def converse(
    socket: WebSocket, hear: Callable[[str | bytes], None], speak: Callable[[], Coroutine[Any, Any, None]]
) -> None:
    """Run `speak` and hand what the client says to `hear`, until it goes, or `hear` raises one of UNREADABLE:
    then the connection is closed with its text.
    """
    reason = ""

    async def listen() -> None:
        nonlocal reason
        while (received := await socket.receive())["type"] != "websocket.disconnect":
            try:
                hear(received.get("text") or received.get("bytes") or b"")
            except UNREADABLE as error:
                # A WebSocket has room for 123 bytes.
                reason = str(error).encode()[:120].decode(errors="ignore")
                break
            await asyncio.sleep(0)  # a flood from one client leaves the others their turn
        raise WebSocketDisconnect

    try:
        async with asyncio.TaskGroup() as both:
            both.create_task(listen())
            both.create_task(speak())
    except* GONE:
        pass
    with contextlib.suppress(*GONE):
        await socket.close(POLICY, reason)


# ---- connections ----


def _make_room(connections: set[Any]) -> None:
    """Cut the oldest connection that is no page, if there are too many.

    They have asked for nothing yet, or only get files or a refusal.
    """
    waiting = [each for each in connections if each.waiting_since]
    if len(waiting) > MOST_WAITING:
        oldest = min(waiting, key=lambda each: each.waiting_since)
        oldest.waiting_since = 0.0
        oldest.transport.abort()


class Guest(H11Protocol):
    """A connection that is no page yet."""

    waiting_since = 0.0  # by the loop's clock; 0: it does not wait

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait."""
        super().connection_made(transport)
        self.waiting_since = self.loop.time()
        _make_room(self.connections)


class PageSocket(WebSocketsSansIOProtocol):
    """A connection that has become a page, and waits again once that is closed.

    What a client can make it keep is bounded: answers that are not read, and pieces of a message.
    """

    waiting_since = 0.0

    def handle_ping(self) -> None:
        """Answer, but not a client that has left so much unread: one answer to several pings is enough."""
        if self.writable.is_set():
            super().handle_ping()
        else:
            self.conn.data_to_send()

    def handle_cont(self, event: Frame) -> None:
        """Take a piece of a message; ws_max_size bounds its bytes, and so the pieces that are not empty."""
        if event.data or event.fin:
            super().handle_cont(event)

    async def run_asgi(self) -> None:
        """Serve it. What it has not read soon after it was closed, it will not read."""
        await super().run_asgi()
        self.waiting_since = self.loop.time()
        _make_room(self.connections)
        self.loop.call_later(SEND_S, self.transport.abort)


def server_of(app: ASGIApp, longest_message: int, *, proxied: bool) -> uvicorn.Server:
    """Return a server of an app that leaves signals and logs to its caller.

    Messages of clients are limited in bytes.

    proxied: whether a proxy of this machine may say, by X-Forwarded-For, from where a client comes.
    """
    config = uvicorn.Config(
        app,
        http=Guest,
        ws=PageSocket,
        lifespan="off",
        log_config=None,
        log_level="critical",
        access_log=False,
        server_header=False,
        date_header=False,
        ws_max_size=longest_message,
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=1,
        proxy_headers=proxied,
    )
    server = uvicorn.Server(config)
    server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign, assignment]
    return server
