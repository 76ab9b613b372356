"""Notices which part of a mission has said nothing for too long. It has no clock: it is told the time, s, and who was heard."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from sitl.launch.processes import START_LIMIT_S, START_WARN_S

WARN_S = 5.0
"""A part says each second how it is doing: one that has not for so long hangs, or its link is cut."""
PATIENCE_S = 30.0
LOOK_S = 1.0
"""So often at least it is to look. Where it does later, it was held up itself, and that time says nothing about the parts."""
ROUTER, RECORDER = "router", "recorder"


@dataclass
class _Watched:
    """What is known of one part."""

    since_s: float
    """When it last spoke, or was started."""
    spoken: bool = False
    told: bool = False
    """Whether people know of its silence."""
    disturbed: int = 0
    """How many things that silence it a script has done and not mended yet."""


class Watchdog:
    """Who has spoken when, and what their silence means."""

    def __init__(self, parts: Iterable[str], patience_s: float, now_s: float, say: Callable[[str], None]) -> None:
        """Take parts that have just been started, how long one of them may be silent, and who tells people."""
        self._parts = {part: _Watched(now_s) for part in parts}
        self._patience_s = patience_s
        self._looked_s = now_s
        self._say = say

    def heard(self, part: str, now_s: float) -> None:
        """A part has spoken."""
        if (known := self._parts.get(part)) is None:
            return
        if known.told and known.spoken:
            self._say(f"the {part} is back")
        known.since_s, known.spoken, known.told = now_s, True, False

    def ended(self, part: str) -> None:
        """A part is gone for good."""
        self._parts.pop(part, None)

    def begins(self, part: str, now_s: float) -> None:
        """A part was started anew: it may take a while before it speaks."""
        if known := self._parts.get(part):
            known.since_s, known.spoken, known.told = now_s, False, False

    def disturb(self, part: str) -> None:
        """A script silences a part: from now on its silence means nothing."""
        if known := self._parts.get(part):
            known.disturbed += 1

    def mend(self, part: str, now_s: float) -> None:
        """What a script did to a part is mended."""
        if known := self._parts.get(part):
            known.disturbed -= 1
            known.since_s, known.told = now_s, False

    def look(self, now_s: float, connected: bool) -> str:
        """Tell of who has fallen silent; returns why the mission cannot go on, empty where it can. `connected`: the router is there."""
        held_up_s = max(now_s - self._looked_s - 2 * LOOK_S, 0.0)
        self._looked_s = now_s
        if connected:
            self.heard(ROUTER, now_s)
        for part, known in self._parts.items():
            known.since_s += held_up_s
            if known.disturbed or not (connected or part == ROUTER):
                known.since_s = now_s  # could not be heard
            silent_s = now_s - known.since_s
            warn_s, limit_s = (WARN_S, self._patience_s) if known.spoken else (START_WARN_S, max(START_LIMIT_S, self._patience_s))
            if silent_s >= limit_s and part != RECORDER:
                since = "" if known.spoken else " since it was started"
                return f"the {part} has said nothing for {limit_s:g} s{since} (--patience S waits longer)"
            if silent_s >= warn_s and not known.told:
                known.told = True
                self._say(f"warning: the {part} has said nothing for {warn_s:g} s" if known.spoken else f"waits for the {part} to start")
        return ""
