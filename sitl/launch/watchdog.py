"""Notices which part of a mission has been silent for too long.

It has no clock: callers pass the time, s, and who was heard.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from sitl.launch.processes import KINDS, ROUTER, START_LIMIT_S, START_WARN_S

# Each part publishes its health every second: one that is silent for this long hangs, or its link is cut.
WARN_S = 5.0
PATIENCE_S = 30.0
# How often to call `look`. A later call means that the launcher itself was held up: that time does not
# count as silence.
LOOK_S = 1.0


@dataclass
class _Watched:
    """What is known of one part."""

    since_s: float  # when it last spoke, or was started
    spoken: bool = False
    told: bool = False  # whether its silence has been reported
    disturbed: int = 0  # how many script events silence it at the moment
    spared: bool = False  # whether the mission goes on without it


class Watchdog:
    """When each part was last heard, and what its silence means."""

    def __init__(
        self,
        parts: Iterable[str],
        patience_s: float,
        now_s: float,
        say: Callable[[str], None],
        hangs: Callable[[str], None] = lambda _: None,
    ) -> None:
        """Watch parts that have just been started; `hangs` is called with one that is silent for too long."""
        self._parts = {
            part: _Watched(now_s, spared=part in KINDS and bool(KINDS[part].spared)) for part in parts
        }
        self._patience_s = patience_s
        self._looked_s = now_s
        self._say, self._hangs = say, hangs

    def heard(self, part: str, now_s: float) -> None:
        """Note that a part was heard."""
        if (known := self._parts.get(part)) is None:
            return
        if known.told and known.spoken:
            self._say(f"the {part} is back")
        known.since_s, known.spoken, known.told = now_s, True, False

    def ended(self, part: str) -> None:
        """Stop watching a part that has ended."""
        self._parts.pop(part, None)

    def spare(self, parts: Iterable[str]) -> None:
        """Note that the mission goes on without these parts if they fall silent."""
        for part in parts:
            if known := self._parts.get(part):
                known.spared = True

    def is_lost(self, part: str, now_s: float) -> bool:
        """Whether a part without which the mission goes on has been silent for too long."""
        known = self._parts.get(part)
        return known is not None and known.spared and now_s - known.since_s >= self._patience_s

    def joins(self, part: str, now_s: float) -> None:
        """Watch a part that has been started now; the mission goes on without it."""
        self._parts[part] = _Watched(now_s, spared=True)

    def begins(self, part: str, now_s: float) -> None:
        """Note that a part was restarted: its first message may take a while."""
        if known := self._parts.get(part):
            known.since_s, known.spoken, known.told = now_s, False, False

    def disturb(self, part: str) -> None:
        """Note that a script silences a part: its silence means nothing until `mend`."""
        if known := self._parts.get(part):
            known.disturbed += 1

    def mend(self, part: str, now_s: float) -> None:
        """Note that a script has undone what silenced a part."""
        if known := self._parts.get(part):
            known.disturbed -= 1
            known.since_s, known.told = now_s, False

    def look(self, now_s: float, connected: bool) -> str:
        """Report silent parts; returns why the mission cannot go on, or an empty text.

        `connected`: the router is there.
        """
        held_up_s = max(now_s - self._looked_s - 2 * LOOK_S, 0.0)
        self._looked_s = now_s
        if connected:
            self.heard(ROUTER, now_s)
        for part, known in self._parts.items():
            known.since_s += held_up_s
            if known.disturbed or not (connected or part == ROUTER):
                known.since_s = now_s  # it cannot be heard
            silent_s = now_s - known.since_s
            warn_s, limit_s = (
                (WARN_S, self._patience_s)
                if known.spoken
                else (START_WARN_S, max(START_LIMIT_S, self._patience_s))
            )
            if silent_s >= limit_s and not known.spared:
                self._hangs(part)
                since = "" if known.spoken else " since it was started"
                return f"the {part} has said nothing for {limit_s:g} s{since} (--patience S waits longer)"
            if silent_s >= warn_s and not known.told:
                known.told = True
                self._say(
                    f"warning: the {part} has said nothing for {warn_s:g} s"
                    if known.spoken
                    else f"waiting for the {part} to start"
                )
        return ""
