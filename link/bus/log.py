"""Logs on stderr, one logfmt line per event; stdout is for results.

They use the `logging` logger `plumeward` and its children.
"""

import json
import logging
import re
import select
import sys
from collections.abc import MutableMapping
from datetime import UTC, datetime
from typing import Any, TextIO

from link.bus.tally import Tally

LEVELS = ("debug", "info", "warning", "error")
PIECE = select.PIPE_BUF // 4  # characters that a pipe which takes more takes at once
LINE = re.compile(rf'time=\S+ level=({"|".join(LEVELS)}) service=(\S+) mission=\S+ step=-?\d+ event=(".*")')


class Log(logging.LoggerAdapter[logging.Logger]):
    """A service's logger. A warning or worse also becomes `last_error` of its tally."""

    def __init__(self, service: str, mission: str, tally: Tally, least: str = "info") -> None:
        """Take service, mission, the service's tally, and the lowest of LEVELS that is written."""
        super().__init__(LOGGER.getChild(service), {"service": service, "mission": mission})
        self.tally = tally
        self.least = least
        self._least = logging.getLevelNamesMapping()[least.upper()]

    def isEnabledFor(self, level: int) -> bool:
        """True if this level is written.

        Two loggers of one service in one process may have different levels.
        """
        return level >= self._least and super().isEnabledFor(level)

    def log(self, level: int, msg: object, *args: object, **kwargs: Any) -> None:
        """Log a message at a level of `logging`."""
        if level >= logging.WARNING:
            self.tally.last_error = str(msg) % args if args else str(msg)
        super().log(level, msg, *args, **kwargs)

    def process(self, msg: Any, kwargs: MutableMapping[str, Any]) -> tuple[Any, MutableMapping[str, Any]]:
        """Add service, mission and step."""
        return msg, {**kwargs, "extra": {**(self.extra or {}), "step": self.tally.step}}


class _Stderr(logging.Handler):
    """Writes to the current `sys.stderr`, looked up at each record.

    It never waits: what nobody reads is left out, and counted.
    """

    _missing = 0

    def format(self, record: logging.LogRecord) -> str:
        """Return `time=… level=info service=uav mission=uav/1 step=12 event="Landed"`.

        A traceback is part of the event.
        """
        text = record.getMessage()
        if record.exc_info:
            text += "\n" + logging.Formatter().formatException(record.exc_info)
        at = (
            datetime.fromtimestamp(record.created, UTC)
            .isoformat(timespec="milliseconds")
            .replace("+00:00", "Z")
        )
        level = LEVELS[min(max(record.levelno // 10 - 1, 0), len(LEVELS) - 1)]
        who = {"service": record.name, "mission": "-", "step": -1} | record.__dict__
        # Unprintable characters could break the line or the terminal.
        event = json.dumps(text, ensure_ascii=not text.isprintable())
        return (
            f"time={at} level={level} service={who['service']} mission={who['mission']} "
            f"step={who['step']} event={event}"
        )

    def emit(self, record: logging.LogRecord) -> None:
        try:
            if self._missing and _takes_more(sys.stderr):
                words, self._missing = f"{self._missing} lines are missing here: nobody has read them", 0
                gap = {"levelno": logging.WARNING, "msg": words, "args": (), "exc_info": None}
                self._write(logging.makeLogRecord({**record.__dict__, **gap}))
            self._write(record)
        except Exception:
            self.handleError(record)

    def _write(self, record: logging.LogRecord) -> None:
        line = self.format(record) + "\n"
        for at in range(0, len(line), PIECE):
            if not _takes_more(sys.stderr):
                self._missing += 1
                return
            print(line[at : at + PIECE], end="", file=sys.stderr, flush=True)


def _takes_more(stream: TextIO) -> bool:
    """Whether a stream takes a `PIECE` without a wait: a pipe may be full, and a terminal stand still."""
    try:
        descriptor = stream.fileno()
    except (AttributeError, OSError, ValueError):  # not a file of the system
        return True
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    return bool(poll.poll(0))


LOGGER = logging.getLogger("plumeward")  # it does not propagate to the root logger, which belongs to the user
LOGGER.propagate = False
LOGGER.setLevel(logging.DEBUG)
LOGGER.addHandler(_Stderr())


def parse(line: str) -> tuple[str, str]:
    """Return level and readable text of a log line.

    A line that is not a log event is returned unchanged, as info.
    """
    if (match := LINE.fullmatch(line)) is None:
        return "info", line
    level, service, event = match.groups()
    try:
        text = json.loads(event)
    except ValueError:  # two processes wrote at once
        return "info", line
    lines = str(text).replace("\n", "\n  ")  # what a line quotes looks like no line of its own
    return level, f"{service}: {'' if level in ('debug', 'info') else f'{level}: '}{lines}"
