"""Who may look and who may command: other web pages may do neither, and people elsewhere only look."""

import hmac
import ipaddress
import socket
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, NamedTuple
from urllib.parse import quote

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Asgi = Callable[[Scope, Receive, Send], Awaitable[None]]

HEADERS = {
    "content-security-policy": "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; object-src 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-cache",
}


class AccessRules(NamedTuple):
    """Where the page is served, and the word that allows commands."""

    host: str
    """The address that it is bound to."""
    port: int
    token: str = ""
    """Empty: none is needed on a loopback address, and elsewhere nobody may command."""

    @property
    def address(self) -> str:
        """What to enter in a browser on this machine."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/" + (f"?token={quote(self.token, safe='')}" if self.token else "")

    def allows_host(self, host: str) -> bool:
        """Whether a Host header is this server's: a page whose name was pointed here (DNS rebinding) has another one.

        Bound to all addresses, any address is: a name is what rebinding needs.
        """
        name, port = _split(host)
        if port != self.port:
            return False
        bound, asked = _address(self.host), _address(name)
        if name == "localhost":
            return bound is None or bound.is_loopback or bound.is_unspecified
        if bound is not None and bound.is_unspecified:
            return asked is not None or name == socket.gethostname().lower()
        return name == self.host.lower() or (asked is not None and asked == bound)

    def allows_origin(self, origin: str, host: str) -> bool:
        """Whether an Origin header is that of the page served under this Host header."""
        return origin.lower() == f"http://{host.lower()}"

    def why_no_commands(self, token: str) -> str:
        """Return why a client with this token may only look; empty if it may command."""
        if self.token:
            right = hmac.compare_digest(token.encode(), self.token.encode())
            return "" if right else "read-only: the page's address lacks the right token (?token=...)"
        bound = _address(self.host)
        loopback = self.host == "localhost" if bound is None else bound.is_loopback
        return "" if loopback else f"read-only: the page is served on {self.host} without --token"


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _split(host: str) -> tuple[str, int]:
    """Return name and port of a Host header, in lower case and without brackets; port -1 if it is not a number."""
    name, colon, port = host.rpartition(":")
    if not colon or "]" in port:
        name, port = host, "80"
    return name.lower().removeprefix("[").removesuffix("]"), int(port) if port.isascii() and port.isdigit() and len(port) <= 5 else -1


def guarded(app: Asgi, rules: AccessRules) -> Asgi:
    """Return the app behind its checks: others get 403 and a line that says why; every answer has HEADERS."""

    async def checked(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await app(scope, receive, send)
            return

        async def answer(message: MutableMapping[str, Any]) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                own = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
                message = {**message, "headers": [*message.get("headers", []), *own]}
            await send(message)

        if reason := _refusal(scope, rules):
            kind = "http" if scope["type"] == "http" else "websocket.http"
            body = f"refused: {reason}\n".encode()
            headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode())]
            await answer({"type": f"{kind}.response.start", "status": 403, "headers": headers})
            await send({"type": f"{kind}.response.body", "body": body})
            return
        await app(scope, receive, answer)

    return checked


def _refusal(scope: Scope, rules: AccessRules) -> str:
    """Return why a request is refused; empty if it is not."""
    hosts, origins = _values(scope, b"host"), _values(scope, b"origin")
    if len(hosts) != 1 or not rules.allows_host(hosts[0]):
        return f"Host {', '.join(hosts)!r} is not this server; wanted its address and port {rules.port}"
    if scope["type"] == "websocket" and (len(origins) != 1 or not rules.allows_origin(origins[0], hosts[0])):
        return f"Origin {', '.join(origins)!r} is not this page; wanted http://{hosts[0]}"
    return ""


def _values(scope: Scope, name: bytes) -> list[str]:
    return [value.decode("latin-1") for header, value in scope["headers"] if header == name]
