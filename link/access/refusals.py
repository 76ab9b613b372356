"""A router's own log as lines for people: joins and refusals. Zenoh reports them in no other way."""

import contextlib
import fcntl
import logging
import os
import re
import sys
from collections import Counter

import zenoh

# Lines only for connections and for refused messages. With `access_control=trace` a line would also say
# which message, but there would be lines for every message that is allowed, too: that stalls a busy router.
FILTER = (
    "off,zenoh_link_tls=debug,zenoh::net::routing::interceptor=trace,"
    "zenoh::net::routing::interceptor::access_control=off"
)
PIPE_BYTES = 1 << 20
EVERY_S = 10.0  # shortest time between two lines on the same refusal: a refused client tries again and again
MOST_KINDS = 100  # reasons that are logged one by one; all others are counted together
JOINS = re.compile(r"Accepted TLS connection on \S+: (\S+?)\. Common Name: (\S*?)\.?$")
REFUSES = re.compile(r"zenoh_link_tls\S*: (.+?)\.? Hint: ")
DROPS = "Msg intercepted!"
# What Zenoh's words mean.
MEANING = (
    ("InvalidContentType", "does not speak TLS"),
    ("UnknownIssuer", "has a certificate of another CA"),
    ("BadSignature", "has a certificate of another CA"),
    ("peer sent no certificates", "has no certificate"),
    ("for client authentication", "has a certificate that is not a client's"),
    ("certificate expired", "has an expired certificate"),
    ("fatal alert", "does not accept our certificate"),
)
COLOUR = re.compile(r"\x1b\[[0-9;]*m")


def _stdout_of_zenoh() -> int:
    """Let `sys.stdout` go where it went before, and return what reads from stdout, where Zenoh's log goes."""
    ours = os.dup(1)
    reader, writer = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)  # a full pipe loses lines, and holds up no router
    with contextlib.suppress(OSError):
        fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    sys.stdout.flush()
    os.dup2(writer, 1)
    os.close(writer)
    sys.stdout = os.fdopen(ours, "w")
    os.environ["RUST_LOG"] = FILTER
    zenoh.init_log_from_env_or("off")
    return reader


class Refusals:
    """Reads what Zenoh logs in this process.

    Make it before the router: Zenoh's log goes to stdout, which from then on is another one.
    """

    def __init__(self, reader: int | None = None) -> None:
        """Take over stdout for Zenoh; `sys.stdout` goes where it went before.

        Or read a log from a file descriptor that never blocks.
        """
        self._reader = _stdout_of_zenoh() if reader is None else reader
        self._begun = ""
        self._counts: Counter[tuple[str, str]] = Counter()
        self._told_at: dict[tuple[str, str], float] = {}

    def news(self, now_s: float) -> list[tuple[int, str]]:
        """Return what has happened since the last call, as levels of `logging` and lines.

        now_s: any monotonic clock.
        """
        lines: list[tuple[int, str]] = []
        for line in self._lines():
            if joins := JOINS.search(line):
                lines.append((logging.INFO, f"{joins[2] or 'a nameless client'} joins from {joins[1]}"))
            elif DROPS in line:
                self.count("messages", "the certificates of their senders give no right to them")
            elif refused := REFUSES.search(line):
                meant = next(
                    (meaning for words, meaning in MEANING if words in refused[1]),
                    f"is refused: {refused[1]}",
                )
                self.count("connections", f"the client {meant}")
        for (what, why), count in list(self._counts.items()):
            if now_s - self._told_at.get((what, why), -EVERY_S) >= EVERY_S:
                del self._counts[what, why]
                self._told_at[what, why] = now_s
                lines.append((logging.WARNING, f"refused {what} ({count}): {why}"))
        return lines

    def _lines(self) -> list[str]:
        try:
            text = self._begun + os.read(self._reader, PIPE_BYTES).decode(errors="replace")
        except BlockingIOError:
            return []
        *lines, self._begun = COLOUR.sub("", text).split("\n")
        return lines

    def count(self, what: str, why: str, more: int = 1) -> None:
        """Count what was refused and why: `news` tells of it."""
        known = self._told_at.keys() | self._counts.keys()
        if (what, why) not in known and len(known) >= MOST_KINDS:
            why = "for other reasons"
        self._counts[what, why] += more
