"""One line an event, as logfmt, on stderr: stdout is for results. They go through `logging`, by the logger `plumeward` and its children."""

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
    """What happens to a service, for `logging`; a warning or worse is also the last error that its tally tells."""

    def __init__(self, service: str, mission: str, tally: Tally, least: str = "info") -> None:
        """Take who speaks, of which mission, what it counts, and the least of LEVELS that is written."""
        super().__init__(LOGGER.getChild(service))
        self._service = service
        self._mission = mission
        self.tally = tally
        self._least = logging.getLevelNamesMapping()[least.upper()]

    def isEnabledFor(self, level: int) -> bool:
        """Whether it is written: two of one name in one process may differ in that."""
        return level >= self._least and super().isEnabledFor(level)

    def log(self, level: int, msg: object, *args: object, **kwargs: Any) -> None:
        """Say it at a level of `logging`."""
        if level >= logging.WARNING:
            self.tally.last_error = str(msg) % args if args else str(msg)
        super().log(level, msg, *args, **kwargs)

    def process(self, msg: Any, kwargs: MutableMapping[str, Any]) -> tuple[Any, MutableMapping[str, Any]]:
        """Add who speaks, and at which step."""
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
        event = json.dumps(text, ensure_ascii=not text.isprintable())  # others would break the line, or the terminal
        return f"time={at} level={level} service={who['service']} mission={who['mission']} step={who['step']} event={event}"


class _Stderr(logging.Handler):
    """Writes to what is the process's stderr at that time."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            print(self.format(record), file=sys.stderr, flush=True)
        except Exception:
            self.handleError(record)


LOGGER = logging.getLogger("plumeward")
"""Apart from the root, which is the user's."""
LOGGER.propagate = False
LOGGER.setLevel(logging.DEBUG)
if not LOGGER.handlers:
    LOGGER.addHandler(_Stderr())
    LOGGER.handlers[0].setFormatter(Logfmt())


def parse(line: str) -> tuple[str, str]:
    """Return the level and the text of a log's line, as people are told it; one that is no event is told as it is, as info."""
    if (match := LINE.fullmatch(line)) is None:
        return "info", line
    level, service, event = match.groups()
    try:
        said = json.loads(event)
    except ValueError:  # two wrote at once
        return "info", line
    return level, f"{service}: {'' if level in ('debug', 'info') else f'{level}: '}{said}"
