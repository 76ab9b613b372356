"""The word that allows commands: kept in a file, given by clients in a header, and guessed slowly."""

import math
import os
import secrets
import stat
from base64 import urlsafe_b64decode
from collections.abc import Iterable
from pathlib import Path

from ground.view.guard import WANTED, WRONG, AccessRules
from link.access.secret import read_secret

IN_FILE = "a file with a word of at least 8 characters in one line"
SHORTEST = 8
PROTOCOL, WORD = "plumeward", "word."
"""WebSocket subprotocols of the page: its own, and one with the word, in base64. It is a header: no log or
history keeps it.
"""
LATER = "read-only: a wrong word came from your address a moment ago: wait a second"
ASKS = {WANTED: "wanted", WRONG: "wrong", LATER: "later"}
"""For the page: what became of the word."""
WRONG_S = 1.0
"""An address that gave a wrong word is heard again after this time."""
MOST_WRONG = 1000
"""Addresses that are known to have given a wrong word."""


def word_in(path: Path) -> tuple[str, str]:
    """Return the word in a file, and a line for people or "". Makes the file, with a new word, if there is
    none. Raises ValueError.
    """
    word = secrets.token_urlsafe(16)
    try:
        with open(path, "x", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
            file.write(f"{word}\n")
    except FileExistsError:
        word, mode = read_secret(path, IN_FILE)
        if len(word) < SHORTEST:
            raise ValueError(
                f"{str(path)!r} holds a word of {len(word)} characters; wanted {IN_FILE}"
            ) from None
        others = bool(mode & (stat.S_IRWXG | stat.S_IRWXO))
        return (
            word,
            f"warning: {str(path)!r} is open to other users of this machine: chmod 600 {path}"
            if others
            else "",
        )
    except OSError as error:
        raise ValueError(f"{str(path)!r}: {error.strerror}; wanted {IN_FILE}") from None
    return word, f"{path} is new: it holds the word that allows commands"


class Doorkeeper:
    """Hears the word of clients. Who gave a wrong one is heard again later: so guessing takes long, and
    locks nobody else out.
    """

    def __init__(self, rules: AccessRules) -> None:
        """Take the rules; nobody has said anything yet."""
        self._rules = rules
        self._wrong_s: dict[str, float] = {}

    def why_no_commands(self, word: str, address: str, now_s: float) -> str:
        """Return why a client at this address that gives this word may only look; empty if it may command."""
        if word and now_s - self._wrong_s.get(address, -math.inf) < WRONG_S:
            return LATER
        why_not = self._rules.why_no_commands(word)
        if why_not == WRONG:
            self._wrong_s.pop(address, None)
            self._wrong_s[address] = now_s
            if len(self._wrong_s) > MOST_WRONG:
                del self._wrong_s[next(iter(self._wrong_s))]
        return why_not


def word_of(offered: Iterable[str]) -> str:
    """Return the word among the subprotocols that a client offers; empty if there is none."""
    coded = next((each.removeprefix(WORD) for each in offered if each.startswith(WORD)), "")
    try:
        return urlsafe_b64decode(coded + "=" * (-len(coded) % 4)).decode()
    except ValueError:
        return ""
