"""Who may look and who may command: other web pages may do neither, and people elsewhere only look."""

import hmac
import ipaddress
import re
import socket
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, NamedTuple

from link.access.reach import is_open

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Asgi = Callable[[Scope, Receive, Send], Awaitable[None]]

HEADERS = {
    "content-security-policy": "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors "
    "'none'; object-src 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-cache",
}


WANTED = "read-only: to command, enter the word of --token-file"
WRONG = "read-only: that is not the word of --token-file"
USUAL_PORTS = {"http": ":80", "https": ":443"}
FILE = "file://"
"""The Origin of programs that are made like web pages, such as the desktop app of Lichtblick, and of files
that a browser opens.
"""


class AccessRules(NamedTuple):
    """Where the page is served, from where others may use it, and the word that allows commands."""

    host: str
    """The address that it is bound to."""
    port: int
    token: str = ""
    """Empty: none is needed where only this machine reaches the page, and elsewhere nobody may command."""
    origins: tuple[str, ...] = ()
    """Other origins that may use it, as `origin` returns them: that of a proxy."""
    programs: bool = False
    """Whether programs may connect that are no web pages: they name no Origin, or FILE."""

    @property
    def address(self) -> str:
        """What to enter in a browser on this machine."""
        return f"http://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}/"

    def allows_host(self, host: str) -> bool:
        """Whether a Host header is this server's or a proxy's: a page whose name was pointed here (DNS
        rebinding) has another one.
        """
        return self._is_own(host) or any(host.lower() == known.partition("://")[2] for known in self.origins)

    def _is_own(self, host: str) -> bool:
        """Whether a Host header is this server's. Bound to all addresses, any address is: a name is what
        rebinding needs.
        """
        name, port = _split(host)
        if port != self.port:
            return False
        bound, asked = _address(self.host), _address(name)
        if name == "localhost":
            return not is_open(self.host) or (bound is not None and bound.is_unspecified)
        if bound is not None and bound.is_unspecified:
            return asked is not None or name == socket.gethostname().lower()
        return name == self.host.lower() or (asked is not None and asked == bound)

    def allows_origin(self, origin: str | None, host: str) -> bool:
        """Whether an Origin header, None if there is none, is of the page that this Host header asks for,
        or of the others allowed.
        """
        if origin is None or origin == FILE:
            return self.programs
        return origin.lower() in self.origins or (
            self._is_own(host) and origin.lower() == f"http://{host.lower()}"
        )

    def why_no_commands(self, token: str) -> str:
        """Return why a client with this token may only look; empty if it may command."""
        if self.token:
            if not token:
                return WANTED
            return "" if hmac.compare_digest(token.encode(), self.token.encode()) else WRONG
        if is_open(self.host):
            return f"read-only: the page is served on {self.host} without --token-file"
        return "read-only: the page is open to --origin without --token-file" if self.origins else ""


def origin(text: str) -> str:
    """Return an origin as browsers write it; raises ValueError if it is none."""
    match = re.fullmatch(
        r"([a-z][a-z0-9+.-]*)://([a-z0-9._-]+|\[[0-9a-f:.]+\])(:[0-9]{1,5})?/?", text.lower()
    )
    if not match:
        raise ValueError(
            f"{text!r} is not an origin; wanted the beginning of an address, without a path: "
            "https://drone.example:8443"
        )
    scheme, host, port = match[1], match[2], match[3] or ""
    return f"{scheme}://{host}{'' if port == USUAL_PORTS.get(scheme) else port}"


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _split(host: str) -> tuple[str, int]:
    """Return name and port of a Host header, in lower case and without brackets; port -1 if it is not a
    number.
    """
    name, colon, port = host.rpartition(":")
    if not colon or "]" in port:
        name, port = host, "80"
    return name.lower().removeprefix("[").removesuffix("]"), int(
        port
    ) if port.isascii() and port.isdigit() and len(port) <= 5 else -1


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
            headers = [
                (b"content-type", b"text/plain; charset=utf-8"),
                (b"content-length", str(len(body)).encode()),
            ]
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
    if scope["type"] == "websocket" and (
        len(origins) > 1 or not rules.allows_origin(next(iter(origins), None), hosts[0])
    ):
        return (
            f"Origin {', '.join(origins)!r} is not this page; wanted http://{hosts[0]}, or one that "
            "--origin names"
        )
    return ""


def _values(scope: Scope, name: bytes) -> list[str]:
    return [value.decode("latin-1") for header, value in scope["headers"] if header == name]
