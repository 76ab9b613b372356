"""The connections of the page's server. Those that are no page wait in a lobby that never fills: a new one
drives out the oldest.
"""

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

MOST_WAITING = 100
"""Most connections that are no page."""


class Lobby:
    """The connections that have asked for nothing yet, or that only get files or a refusal; the oldest
    first.
    """

    def __init__(self, unread_s: float) -> None:
        """Begin empty. unread_s: after this long a page that was closed is gone, whatever it has not read."""
        self._waiting: dict[asyncio.Transport, None] = {}
        self._unread_s = unread_s

    def enter(self, transport: asyncio.Transport) -> None:
        """Take a connection, and cut the oldest one if there are too many."""
        self._waiting[transport] = None
        if len(self._waiting) > MOST_WAITING:
            oldest = next(iter(self._waiting))
            self.leave(oldest)
            oldest.abort()

    def leave(self, transport: asyncio.Transport) -> None:
        """A connection has gone, or is a page now."""
        self._waiting.pop(transport, None)

    def protocols(self) -> tuple[type[H11Protocol], type[WebSocketsSansIOProtocol]]:
        """Return uvicorn's protocols for HTTP and WebSocket, with this lobby."""
        lobby = self

        class Guest(H11Protocol):
            def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
                super().connection_made(transport)
                lobby.enter(transport)

            def connection_lost(self, exc: Exception | None) -> None:
                lobby.leave(self.transport)
                super().connection_lost(exc)

        class PageSocket(WebSocketsSansIOProtocol):
            async def run_asgi(self) -> None:
                lobby.leave(self.transport)
                await super().run_asgi()
                if not self.disconnected:
                    lobby.enter(self.transport)
                    self.loop.call_later(lobby._unread_s, self.transport.abort)

            def connection_lost(self, exc: Exception | None) -> None:
                lobby.leave(self.transport)
                super().connection_lost(exc)

        return Guest, PageSocket
