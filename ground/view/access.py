"""Who may look and who may command: other web pages may do neither, and people elsewhere only look.

Commands may need a word. It is kept in a file, given by clients in a header, and guessed slowly.
"""

import hmac
import ipaddress
import math
import os
import re
import secrets
import socket
import stat
from base64 import urlsafe_b64decode
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from link.access.reach import is_open
from link.access.secret import read_secret

USUAL_PORTS = {"http": ":80", "https": ":443"}
FILE = "file://"  # the Origin of files, and of programs made like web pages, such as Lichtblick's desktop app
# WebSocket subprotocols of the page: its own, and one with the word, in base64. It is a header: no log or
# history keeps it.
PROTOCOL, WORD = "plumeward", "word."
WORD_WANTED = "read-only: to command, enter the word of --token-file"
WORD_WRONG = "read-only: that is not the word of --token-file"
WORD_LATER = "read-only: a wrong word came from your address a moment ago: wait a second"
WORD_STATES = {WORD_WANTED: "wanted", WORD_WRONG: "wrong", WORD_LATER: "later"}  # as the page knows them
IN_FILE = "a file with a word of at least 8 characters in one line"
SHORTEST = 8
WRONG_S = 1.0  # an address that gave a wrong word is ignored for this time
MOST_WRONG = 1000  # addresses that are remembered for a wrong word


class AccessRules(NamedTuple):
    """Where the page is served, from where others may use it, and the word that allows commands."""

    host: str  # the address that it is bound to
    port: int
    token: str = ""  # empty: none is needed on this machine, and elsewhere nobody may command
    origins: tuple[str, ...] = ()  # others that may use it, as `origin` returns them: that of a proxy
    programs: bool = False  # whether programs that are no web pages may connect: no Origin, or FILE

    @property
    def address(self) -> str:
        """What to enter in a browser on this machine."""
        return f"http://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}/"

    def allows_host(self, host: str) -> bool:
        """Whether a Host header is this server's or a proxy's.

        A page whose name was pointed here (DNS rebinding) has another one.
        """
        return self._is_own(host) or any(host.lower() == known.partition("://")[2] for known in self.origins)

    def _is_own(self, host: str) -> bool:
        """Whether a Host header is this server's.

        Bound to all addresses, any address is: rebinding needs a name.
        """
        match = re.fullmatch(r"(?:\[(.*)\]|(.*?))(?::([0-9]{1,5}))?", host.lower())
        if match is None or int(match[3] or 80) != self.port:
            return False
        name = match[1] or match[2] or ""
        bound, asked = _address(self.host), _address(name)
        everywhere = bound is not None and bound.is_unspecified
        if name == "localhost":
            return everywhere or not is_open(self.host)
        if everywhere:
            return asked is not None or name == socket.gethostname().lower()
        return name == self.host.lower() or (asked is not None and asked == bound)

    def allows_origin(self, origin: str | None, host: str) -> bool:
        """Whether an Origin header, None if there is none, is allowed.

        It has to be of the page that this Host header asks for, or one of the others.
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
                return WORD_WANTED
            return "" if hmac.compare_digest(token.encode(), self.token.encode()) else WORD_WRONG
        if is_open(self.host):
            return f"read-only: the page is served on {self.host} without --token-file"
        return "read-only: the page is open to --origin without --token-file" if self.origins else ""


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


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
    scheme, host, port = match.groups(default="")
    return f"{scheme}://{host}{'' if port == USUAL_PORTS.get(scheme) else port}"


# ---- the word ----


def word_in(path: Path) -> tuple[str, str]:
    """Return the word in a file, and a line for people or "".

    If there is no file, makes it, with a new word. Raises ValueError.
    """
    word = secrets.token_urlsafe(16)
    try:
        with open(path, "x", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
            file.write(f"{word}\n")
        return word, f"{path} is new: it holds the word that allows commands"
    except FileExistsError:
        word, mode = read_secret(path, IN_FILE)
    except OSError as error:
        raise ValueError(f"{str(path)!r}: {error.strerror}; wanted {IN_FILE}") from None
    if len(word) < SHORTEST:
        raise ValueError(f"{str(path)!r} holds a word of {len(word)} characters; wanted {IN_FILE}")
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        return word, f"warning: {str(path)!r} is open to other users of this machine: chmod 600 {path}"
    return word, ""


def word_of(offered: Iterable[str]) -> str:
    """Return the word among the subprotocols that a client offers; empty if there is none."""
    coded = next((each.removeprefix(WORD) for each in offered if each.startswith(WORD)), "")
    try:
        return urlsafe_b64decode(coded + "=" * (-len(coded) % 4)).decode()
    except ValueError:
        return ""


class Doorkeeper:
    """Checks the words of clients.

    After a wrong word an address is ignored for a while: guessing takes long, and locks nobody else out.
    """

    def __init__(self, rules: AccessRules) -> None:
        self._rules = rules
        self._wrong_s: dict[str, float] = {}

    def why_no_commands(self, word: str, address: str, now_s: float) -> str:
        """Return why a client at this address that gives this word may only look; empty if it may command."""
        if word and now_s - self._wrong_s.get(address, -math.inf) < WRONG_S:
            return WORD_LATER
        why_not = self._rules.why_no_commands(word)
        if why_not == WORD_WRONG:
            self._wrong_s.pop(address, None)
            self._wrong_s[address] = now_s
            if len(self._wrong_s) > MOST_WRONG:
                del self._wrong_s[next(iter(self._wrong_s))]
        return why_not
