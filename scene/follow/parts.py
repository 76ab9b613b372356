"""How parts are doing, from their liveliness and their health messages.

`plumeward status` and the page judge alike.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

from link.bus.messages import Health, began_anew
from scene.follow.timed import Timed
from scene.scene import INFO, WARNING, Service

STALE_S = 5.0  # each part says every second how it is; after this long without, it hangs or its link is cut
OK, MISSING, STARTING, STALE, REFUSING = "ok", "missing", "starting", "stale", "refusing"
PARTS = ("uav", "estimator", "agent")  # of each search, in the order in which people see them
LONGEST = 300  # characters of a name or text that are kept: it may quote a stranger
MOST_PARTS = 64  # parts that are followed; health messages of more are left out: names are easily forged


def verdict(alive: bool, health: Health | None, silent_s: float) -> str:
    """Return the verdict on a part: ok, missing, starting, stale or refusing.

    `silent_s` is the time since it spoke or appeared.
    """
    if not alive:
        return MISSING
    if health is None:
        return STARTING
    if silent_s >= STALE_S:
        return STALE
    return REFUSING if health.refused_lately else OK


def in_order(name: str) -> tuple[int, str]:
    """Return the key by which parts are sorted."""
    service = name.partition("/")[0]  # `uav/2` in a search by several
    return PARTS.index(service) if service in PARTS else len(PARTS), name


class _Sign(NamedTuple):
    """A sign of life of a part, or of its end."""

    wall_s: float
    alive: bool
    health: Health | None


class Parts:
    """The parts on the bus of one vehicle."""

    def __init__(self, whole: bool, happened: Callable[[float, str, str, str], None]) -> None:
        """Know of none. `whole` keeps all that they say, not only the newest.

        happened: called with (time_s, level, who, text) when there is something that people want to know.
        """
        self._whole, self._happened = whole, happened
        self._signs: dict[str, Timed[_Sign]] = {}

    def restart(self, time_s: float) -> None:
        """Keep only how they are, as of another time."""
        for signs in self._signs.values():
            signs.restart(time_s)

    def lives(self, service: str, alive: bool, time_s: float, wall_s: float) -> None:
        """Take that a part appeared or is gone."""
        known, signs = self._known(service)
        if signs is not None and (known is None or known.alive != alive):
            signs.add(time_s, _Sign(wall_s, alive, None if alive or known is None else known.health))
            self._happened(time_s, *((INFO, service, "joined") if alive else (WARNING, service, "is gone")))

    def hears(self, said: Health, time_s: float, wall_s: float) -> bool:
        """Take a health message; returns whether it is new."""
        known, signs = self._known(said.service)
        before = known.health if known else None
        if signs is None or before == said:
            return False  # repeated to a late joiner
        since_s = wall_s - known.wall_s if known else 0.0
        for level, words in _news(before, said, since_s):
            self._happened(time_s, level, said.service, words)
        signs.add(time_s, _Sign(wall_s, True, said))
        return True

    def _known(self, service: str) -> tuple[_Sign | None, Timed[_Sign] | None]:
        """Return the newest sign of a part, and all of them; None if there is no room for its name."""
        signs = self._signs.get(service)
        if signs is None and len(service) <= LONGEST and len(self._signs) < MOST_PARTS:
            signs = self._signs[service] = Timed(self._whole)
        return (signs.at() if signs else None), signs

    def at(self, time_s: float, wall_s: float) -> Iterator[Service]:
        """Yield how each part was doing at a simulation time, when the clock said wall_s."""
        for name in sorted(self._signs, key=in_order):
            if sign := self._signs[name].at(time_s):
                judged, it = verdict(sign.alive, sign.health, wall_s - sign.wall_s), sign.health
                told = (it.state, it.about, it.step, it.latency_s, tuple(it.warnings)) if it else ()
                yield Service(name, judged, *told)


def _gist(warning: str) -> str:
    """Return a warning without its figures, which change while it lasts."""
    return warning.partition(" (")[0]


def _news(before: Health | None, said: Health, since_s: float) -> Iterator[tuple[str, str]]:
    """Yield (level, words) for what a health message says and the one before it, so long ago, did not."""
    if before and began_anew(said.uptime_s, before.uptime_s, since_s):
        yield WARNING, "was restarted"
    warned, error = ([*map(_gist, before.warnings)], before.last_error) if before else ([], "")
    every = [words for words in (*said.warnings, said.last_error) if words and words != error]
    new = [words for words in every if _gist(words) not in warned]
    # The log has a warning once, and with more words.
    for words in dict.fromkeys(
        said.last_error if said.last_error.startswith(_gist(it)) else it for it in new
    ):
        yield WARNING, words
    if before and said.service == "uav" and said.state != before.state:
        yield INFO, said.state
