"""Logs on stderr, one logfmt line per event; stdout is for results. They use the `logging` logger `plumeward` and its children."""

import json
import logging
import re
import sys
from collections.abc import MutableMapping
from datetime import UTC, datetime
from typing import Any

from link.bus.tally import Tally

LEVELS = ("debug", "info", "warning", "error")
LINE = re.compile(rf'time=\S+ level=({"|".join(LEVELS)}) service=(\S+) mission=\S+ step=-?\d+ event=(".*")')


class Log(logging.LoggerAdapter[logging.Logger]):
    """A service's logger. A warning or worse also becomes `last_error` of its tally."""

    def __init__(self, service: str, mission: str, tally: Tally, least: str = "info") -> None:
        """Take the names of service and mission, the service's tally, and the lowest of LEVELS that is written."""
        super().__init__(LOGGER.getChild(service))
        self._service = service
        self._mission = mission
        self.tally = tally
        self._least = logging.getLevelNamesMapping()[least.upper()]

    def isEnabledFor(self, level: int) -> bool:
        """True if this level is written. Two loggers of one service in one process may have different levels."""
        return level >= self._least and super().isEnabledFor(level)

    def log(self, level: int, msg: object, *args: object, **kwargs: Any) -> None:
        """Log a message at a level of `logging`."""
        if level >= logging.WARNING:
            self.tally.last_error = str(msg) % args if args else str(msg)
        super().log(level, msg, *args, **kwargs)

    def process(self, msg: Any, kwargs: MutableMapping[str, Any]) -> tuple[Any, MutableMapping[str, Any]]:
        """Add service, mission and step."""
        kwargs["extra"] = {"service": self._service, "mission": self._mission, "step": self.tally.step}
        return msg, kwargs


class Logfmt(logging.Formatter):
    """`time=… level=info service=uav mission=uav/1 step=12 event="Landed"`."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line; a traceback is part of the event."""
        text = record.getMessage()
        if record.exc_info:
            text += "\n" + self.formatException(record.exc_info)
        at = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        level = LEVELS[min(max(record.levelno // 10 - 1, 0), len(LEVELS) - 1)]
        who = {"service": record.name, "mission": "-", "step": -1} | record.__dict__
        event = json.dumps(text, ensure_ascii=not text.isprintable())  # unprintable characters could break the line or the terminal
        return f"time={at} level={level} service={who['service']} mission={who['mission']} step={who['step']} event={event}"


class _Stderr(logging.Handler):
    """Writes to the current `sys.stderr`, looked up at each record."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            print(self.format(record), file=sys.stderr, flush=True)
        except Exception:
            self.handleError(record)


LOGGER = logging.getLogger("plumeward")
"""It does not propagate to the root logger, which belongs to the user."""
LOGGER.propagate = False
LOGGER.setLevel(logging.DEBUG)
if not LOGGER.handlers:
    LOGGER.addHandler(_Stderr())
    LOGGER.handlers[0].setFormatter(Logfmt())


def parse(line: str) -> tuple[str, str]:
    """Return level and readable text of a log line. A line that is not a log event is returned unchanged, as info."""
    if (match := LINE.fullmatch(line)) is None:
        return "info", line
    level, service, event = match.groups()
    try:
        text = json.loads(event)
    except ValueError:  # two processes wrote at once
        return "info", line
    lines = str(text).replace("\n", "\n  ")  # what a line quotes looks like no line of its own
    return level, f"{service}: {'' if level in ('debug', 'info') else f'{level}: '}{lines}"
