"""Routing: on which links a frame goes on. Pure: no sockets, no clock.

The rules are those of https://mavlink.io/en/guide/routing.html, read strictly as mavlink-router does: a
message without a target goes to all other links, one with a target to the links on which that system and
component have been heard, and none back to its link.
"""

from collections.abc import Hashable
from typing import NamedTuple

from link.bus.frames import Frame

Link = Hashable  # what a caller has for a link to an endpoint
BUS = 0  # the link to the bus
ANOTHER_BRIDGE = -1  # where frames come from that another bridge has put on the bus
DUPLICATE_S = 0.5  # a frame that came on another link less than this ago came around a loop
# Most frames that are remembered to find duplicates: those of 0.5 s at 16,000 a second.
MOST_REMEMBERED = 8192
# A vehicle that is silent for this long on its link may turn up on another: three heartbeats.
MOVES_AFTER_S = 3.0
# Most senders remembered for each link, the latest heard. It is bounded because ids are easily forged.
MOST_HEARD = 1024
SETUP_SIGNING, RADIO_STATUS = 256, 109
AUTOPILOT = 1  # the component id of autopilots

DUPLICATE, ELSEWHERE, UNHEARD = (
    "duplicate",
    "of a vehicle of another link",
    "for a target that nobody has heard",
)
WITH_KEY = "with a key (SETUP_SIGNING)"  # why a frame is dropped

Sender = tuple[int, int]  # system and component id


class Route(NamedTuple):
    """Where a frame goes."""

    links: tuple[Link, ...] = ()
    # Whether a vehicle has sent it, or the radio on its link: on the bus it belongs on mavlink/out, else on
    # mavlink/in.
    vehicle: bool = False
    dropped: str = ""  # why it goes nowhere, if it should have gone somewhere


class Routes:
    """What has been heard on each link.

    A system is a vehicle on the link on which its autopilot's HEARTBEAT has come, or if the bus has
    frames of an autopilot on mavlink/out. Each sender of a vehicle has one link, on which it was heard
    first. Frames with its ids from other links are dropped: they came around a loop that is slower than
    DUPLICATE_S, or two vehicles have the same id. Once it is silent for MOVES_AFTER_S, it may move. A
    vehicle that is itself on the bus is at home there, wherever it was heard first: two bridges would
    otherwise hand its frames around for ever, each taking the other's side for its home. Ground stations
    may share an id.
    """

    def __init__(self) -> None:
        self.heard: dict[Link, dict[Sender, None]] = {BUS: {}}  # senders heard on each link, the latest last
        self._systems: dict[Link, set[int]] = {BUS: set()}  # systems heard on each link
        # Links and systems: whose autopilot has been heard there.
        self._vehicles: set[tuple[Link, int]] = set()
        # The link of each sender of a vehicle, and when it was last heard there.
        self._homes: dict[Sender, tuple[Link, float]] = {}
        # When each frame came first, and on which links it has come since; the oldest first.
        self.remembered: dict[bytes, tuple[float, frozenset[Link]]] = {}

    def join(self, link: Link) -> None:
        """Add a link."""
        self.heard[link] = {}
        self._systems[link] = set()

    def leave(self, link: Link) -> None:
        """Remove a link, and all that was heard on it."""
        del self.heard[link], self._systems[link]
        self._vehicles = {(at, system) for at, system in self._vehicles if at != link}
        self._homes = {sender: home for sender, home in self._homes.items() if home[0] != link}

    def route(
        self, frame: Frame, link: Link, now_s: float, *, out: bool = False, brought: bool = False
    ) -> Route:
        """Return where a frame goes that came on `link`; `out`: the bus had it on mavlink/out; `brought`:
        by another bridge.
        """
        if frame.message_id == SETUP_SIGNING:  # a key from a safe link must not leave by another one
            return Route(dropped=WITH_KEY)
        sender = (frame.system, frame.component)
        came_from = ANOTHER_BRIDGE if brought else link
        if out and came_from == BUS:
            self._homes[sender] = (BUS, now_s)
        home, heard_s = self._homes.get(sender, (came_from, now_s))
        away = home != came_from and now_s - heard_s < MOVES_AFTER_S
        if self._came_elsewhere(frame.data, came_from, now_s, remember=not away):
            return Route(dropped=DUPLICATE)
        if away:
            return Route(dropped=ELSEWHERE)
        vehicle = self._is_vehicle(frame, link, out=out)
        if vehicle:
            self._homes[sender] = (came_from, now_s)
        self._hear(sender, link)
        target = frame.target
        if not target[0]:
            of_radio = frame.message_id == RADIO_STATUS and link in {at for at, _ in self._vehicles} - {BUS}
            told = out or vehicle or of_radio
            return Route(tuple(other for other in self.heard if other != link), told)
        there = {other for other in self.heard if self._has(other, *target)}
        if vehicle and link != BUS:
            there.add(BUS)  # mavlink/out holds all that a vehicle says, for records and viewers
        onwards = (other for other in self.heard if other in there and other != link)
        return Route(tuple(onwards), out or vehicle, "" if there else UNHEARD)

    def _came_elsewhere(self, data: bytes, link: Link, now_s: float, *, remember: bool) -> bool:
        """Return whether a frame came on another link lately. A sender may repeat itself on its own link.

        A vehicle's frame that comes from afar is not remembered: it may have overtaken the one from the
        vehicle's own link.
        """
        remembered = self.remembered
        while remembered:
            oldest = next(iter(remembered))
            if now_s - remembered[oldest][0] < DUPLICATE_S and len(remembered) < MOST_REMEMBERED:
                break
            del remembered[oldest]
        came_s, links = remembered.get(data, (now_s, frozenset[Link]()))
        if remember:
            remembered[data] = (came_s, links | {link})
        return bool(links - {link})

    def _is_vehicle(self, frame: Frame, link: Link, *, out: bool) -> bool:
        """Whether a frame's system is a vehicle on its link; a HEARTBEAT may tell just now."""
        if link == BUS and not out:
            return False
        if frame.is_autopilot or (out and frame.component == AUTOPILOT):
            self._vehicles.add((link, frame.system))
        return (link, frame.system) in self._vehicles

    def _hear(self, sender: Sender, link: Link) -> None:
        heard = self.heard[link]
        heard.pop(sender, None)
        heard[sender] = None
        self._systems[link].add(sender[0])
        if len(heard) > MOST_HEARD:
            del heard[next(iter(heard))]
            self._systems[link] = {system for system, _ in heard}

    def _has(self, link: Link, system: int, component: int) -> bool:
        return (system, component) in self.heard[link] if component else system in self._systems[link]
