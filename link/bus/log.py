"""One line an event, as logfmt, on stderr: stdout is for results."""

import json
import re
import sys
from datetime import UTC, datetime
from typing import NamedTuple

from link.bus.tally import Tally

LEVELS = ("debug", "info", "warning", "error")
LINE = re.compile(r'time=\S+ level=(\w+) service=(\S+) mission=\S+ step=-?\d+ event=(".*")')


class Event(NamedTuple):
    """What a service wrote, as people are told."""

    level: str
    text: str


class Log:
    """Writes what happens to a service: `time=… level=info service=uav mission=uav/1 step=12 event="Landed"`."""

    def __init__(self, service: str, mission: str, tally: Tally, least: str = "info") -> None:
        """Take who speaks, of which mission, what it counts, and the least of LEVELS that is written."""
        self._service = service
        self._mission = mission
        self.tally = tally
        self._least = LEVELS.index(least)

    def debug(self, text: str) -> None:
        """Say what only who looks for a fault wants to know."""
        self._write("debug", text)

    def info(self, text: str) -> None:
        """Say what happened."""
        self._write("info", text)

    def warn(self, text: str) -> None:
        """Say what went wrong and was survived."""
        self.tally.last_error = text
        self._write("warning", text)

    def _write(self, level: str, text: str) -> None:
        if LEVELS.index(level) < self._least:
            return
        now = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        event = json.dumps(text, ensure_ascii=not text.isprintable())  # others would break the line, or the terminal
        line = f"time={now} level={level} service={self._service} mission={self._mission} step={self.tally.step} event={event}"
        print(line, file=sys.stderr, flush=True)


def parse(line: str) -> Event:
    """Return what a line of a log says, for people; a line that is none counts as info."""
    if (match := LINE.fullmatch(line)) is None:
        return Event("info", line)
    level, service, event = match.groups()
    return Event(level, f"{service}: {'' if level in ('debug', 'info') else f'{level}: '}{json.loads(event)}")
