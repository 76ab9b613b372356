"""The history of a mission: what was said so far, and the scene at any moment of it."""

import math
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import msgspec

from link.bus.frames import Frame
from link.bus.keys import (
    BELIEF,
    DEPARTURE,
    LATECOMER,
    MAVLINK_OUT,
    OF_VEHICLE,
    READING,
    STOP,
    WAYPOINT,
    row_name,
    vehicle_of,
)
from link.bus.mavlink import Texts, continued, unpack_reading
from link.bus.messages import (
    Belief,
    Departure,
    Health,
    Latecomer,
    Particles,
    Stop,
    by_number,
    departure_text,
    latecomer_text,
    unpack_particles,
)
from link.cli import MOST_VEHICLES
from link.modes import ARDUPILOT
from link.record.own import OwnSystem
from link.record.reader import Recording
from link.record.record import HEALTH_PREFIX, Entry, began_s
from scene.follow.area import HEARTBEAT, ORIGIN, PLACING, AreaFrame, Fix
from scene.follow.believed import gauge_of, measured, scatter
from scene.follow.described import WindTurn, backdrop_of, turns_of
from scene.follow.parts import LONGEST, Parts
from scene.follow.telemetry import LOCAL, RADIO, SETPOINT, SHOWN, TEXT, frames, level_of, seen, waypoint
from scene.follow.timed import MOST, Timed, Trail
from scene.scene import (
    INFO,
    STOPPED,
    WARNING,
    Backdrop,
    Craft,
    Ending,
    Gauge,
    Happening,
    Measurement,
    Point,
    Scatter,
    Scene,
    judged,
)

TRACK_STEP_M = 0.1  # the track gets a point when the vehicle has moved this far
FIRST = 1  # of several vehicles that search together, the one that is followed as a rule
SPOKEN = 20  # of a vehicle's texts, those that its health may say again
RESTART_MS = 1000  # a vehicle whose own time goes back by more was started again
# It writes on, and speaks, when all others have ended: that makes none of them silent.
RECORDER = f"{HEALTH_PREFIX}recorder"
TICK_S = 1e-6  # least time between two messages of a search by several
NOWHERE = math.nan, math.nan


class History:
    """What was said on the bus of one vehicle; of a search by several, it follows one of them.

    A message that breaks the contract is left out: the services count and refuse it.
    """

    def __init__(
        self,
        backdrop: Backdrop,
        budget: int | None = None,
        *,
        turns: Sequence[WindTurn] | None = (),
        whole: bool = True,
        number: int = FIRST,
    ) -> None:
        """Begin.

        whole: keep what scrubbing needs, each pose and each belief's particles; else only the newest ones.
        number: which of several vehicles that search together it follows.
        turns: the changes of the backdrop's wind, in order; None: it is the wind that the readings have.
        """
        self.backdrop = backdrop  # as it is at first
        self._number = number
        self._round: tuple[int, ...] = (number,)  # the numbers of those that took part in the newest round
        self.own = OwnSystem()  # which system the vehicle is
        self.is_real = False  # whether a search flies a real autopilot: it speaks beside it, under its id
        self.time_s = self.wall_s = 0.0  # of the newest message, by the simulation and by the clock
        self.missions = 0  # so far; with each one the measurements and the track begin anew
        self.craft: Craft | None = None  # the vehicle as it reported itself last
        self.happenings: Timed[Happening] = Timed(whole, MOST)
        self._budget, self._turns, self._whole = budget, turns, whole
        self._parts = Parts(whole, self._part_says)
        self._texts = {"uav": Texts(), "search": Texts()}
        self._spoken: deque[str] = deque(maxlen=SPOKEN)  # the vehicle's newest texts
        self._area = AreaFrame()
        self._begin()

    def _begin(self) -> None:
        self.missions += 1
        timed = partial(Timed[Any], self._whole)
        self.measurements: Timed[Measurement] = timed(MOST)
        self._scatters: Timed[Scatter | None] = timed()
        self._winds: Timed[tuple[float, float]] = timed()
        self.waypoints: Timed[Point | None] = timed()
        self._walls: Timed[float] = timed()
        self._endings: Timed[Ending] = timed()
        self._stop = self._assume = ""
        self._gauge: Gauge | None = None
        self._left: set[int] = set()  # vehicles that have left a search by several
        self._gone: Timed[bool] = timed()  # that the one it follows has
        self._late: dict[int, int] = {}  # of those that join it late, how much has been said of each
        self._forget_way()

    def _forget_way(self) -> None:
        """Forget where the vehicle is and was."""
        self._area.forget()
        self._boot_ms = 0
        self._heard_s = -math.inf  # when the vehicle was last heard, by the clock
        self._crafts: Timed[Craft] = Timed(self._whole)
        self._displace()

    def _displace(self) -> None:
        """Forget the places: they were told from another home."""
        self._track = Trail(self._whole)
        if self.craft:
            self.craft = replace(self.craft, position=NOWHERE)

    def _begin_again(self, time_s: float) -> None:
        """Follow the next mission of a vehicle that was started again.

        Services stay; happenings, too, where no one goes back in time.
        """
        self._begin()
        self.time_s = time_s
        if self._whole:  # what was said before has another mission's times
            self.happenings = Timed()
            self._parts.restart(time_s)
        self._happened(time_s, INFO, "uav", "a new mission begins")

    def _happened(self, time_s: float, level: str, who: str, text: str) -> None:
        self.happenings.add(time_s, Happening(time_s, level, who, text[:LONGEST]))

    def _part_says(self, time_s: float, level: str, who: str, text: str) -> None:
        """Take what a part says of itself, unless it has told it already: the uav logs its texts, too."""
        if text.encode("ascii", "replace").decode() not in self._spoken:
            self._happened(time_s, level, who, text)

    # ---- taking ----

    def take(self, key: str, payload: bytes, attachment: bytes, time_s: float, wall_s: float) -> bool:
        """Take a message, published at a simulation time and at a time by the clock, s.

        Returns whether it changes the scene.
        """
        if number := vehicle_of(key):
            if number != str(self._number):
                return False
            key, self._area.is_shared = row_name(key), True
        self.time_s = max(self.time_s, time_s)
        if key != RECORDER:
            self.wall_s = max(self.wall_s, wall_s)
            self._walls.add(time_s, wall_s)
        if self.own.learn(key, payload):
            self.is_real, self.craft = False, None
            self._forget_way()
        with suppress(ValueError, msgspec.DecodeError, RecursionError):  # BadFrame among them
            match key:
                case MAVLINK_OUT.name:
                    return self._take_telemetry(payload, time_s)
                case READING.name:
                    self._winds.add(time_s, unpack_reading(payload).wind)
                    return True
                case BELIEF.name:
                    seen = by_number(msgspec.json.decode(payload, type=Belief))
                    self._round = tuple(seen)
                    own = seen.get(self._number) or self._stayed(seen)
                    return own is not None and self._take_belief(own, attachment, time_s)
                case STOP.name:
                    return self._take_stop(msgspec.json.decode(payload, type=Stop), time_s)
                case DEPARTURE.name:
                    return self._take_departure(msgspec.json.decode(payload, type=Departure))
                case LATECOMER.name:
                    return self._take_latecomer(msgspec.json.decode(payload, type=Latecomer))
                case WAYPOINT.name:
                    places = [place for _, said in frames(payload, {SETPOINT}) if (place := waypoint(said))]
                    at = self._round.index(self._number) if self._number in self._round else len(places)
                    for place in places[at : at + 1]:  # those of several vehicles are in their order
                        self.waypoints.add(time_s, place)
                    return bool(places)
                case _ if key.startswith(HEALTH_PREFIX):
                    health = msgspec.json.decode(payload, type=Health)
                    return key == HEALTH_PREFIX + health.service and self._parts.hears(health, time_s, wall_s)
        return False

    def _take_departure(self, said: Departure) -> bool:
        """Take that a vehicle has left the search: it is said by the estimator, and again by the agent."""
        if said.vehicle in self._left:
            return False
        self._left.add(said.vehicle)
        if said.vehicle == self._number:
            self._gone.add(self.time_s, True)
        self._happened(self.time_s, WARNING, "estimator", departure_text(said))
        return True

    def _take_latecomer(self, said: Latecomer) -> bool:
        """Take how far a vehicle that comes late has come: the estimator says it, and the agent again."""
        if said.says <= self._late.get(said.vehicle, -1):
            return False
        self._late[said.vehicle] = said.says
        self._happened(self.time_s, INFO, "estimator", latecomer_text(said))
        return True

    def _stayed(self, seen: dict[int, Belief]) -> Belief | None:
        """Return a round's belief for a vehicle that has left: it stays where it has read last, without gas.

        None of one that has not read.
        """
        last = self.measurements.at()
        if last is None:
            return None
        return msgspec.structs.replace(next(iter(seen.values())), position=last.position, gas=math.nan)

    def lives(self, service: str, alive: bool, wall_s: float) -> None:
        """Take that a part appeared on the bus or is gone."""
        self.wall_s = max(self.wall_s, wall_s)
        self._parts.lives(service, alive, self.time_s, wall_s)

    def _counts(self, frame: Frame) -> bool:
        """Whether a frame is the vehicle's own, of its radio, or one of the search that flies it."""
        return (
            self.own.sent(frame)
            or frame.message_id == RADIO
            or (frame.message_id in (TEXT, HEARTBEAT, ORIGIN) and self.own.searched(frame))
        )

    def _take_telemetry(self, payload: bytes, time_s: float) -> bool:
        before, changed, heard = self.craft, False, False
        for frame, fields in frames(payload, SHOWN, self._counts):
            changed, is_own = True, self.own.sent(frame)
            heard |= frame.message_id != RADIO
            if frame.message_id == HEARTBEAT:
                self.is_real |= not is_own or fields["autopilot"] == ARDUPILOT
            if frame.message_id == TEXT:
                who = "uav" if is_own else "search"
                if text := self._texts[who].joined(fields["text"], fields["id"], fields["chunk_seq"]):
                    self._spoken.append(text)
                    self._happened(time_s, level_of(fields["severity"]), who, text)
            elif frame.message_id == ORIGIN and not is_own:
                if self._area.lies(fields):
                    self._displace()
            elif is_own or frame.message_id == RADIO:
                self._take_own(frame.message_id, fields, time_s)
        self._heard_s = self.wall_s if heard else self._heard_s
        if self.craft and self.craft is not before:
            self._crafts.add(time_s, self.craft)
        return changed

    def _take_own(self, message_id: int, fields: dict[str, Any], time_s: float) -> None:
        """Take what the vehicle's autopilot says of its place and state."""
        if message_id == LOCAL:
            boot_ms = continued(self._boot_ms, fields["time_boot_ms"])
            if boot_ms + RESTART_MS < self._boot_ms:
                self._begin_again(time_s)
            self._boot_ms = boot_ms
        if message_id in PLACING and self._area.take(message_id, fields):
            self._displace()
        before = self.craft or Craft(time_s, NOWHERE)
        craft = self.craft = seen(before, message_id, fields, time_s, self._area)
        if message_id == LOCAL and not math.isnan(craft.position[0]):
            last = self._track.last
            if last is None or math.dist(last, craft.position) >= TRACK_STEP_M:
                self._track.add(time_s, craft.position)
        if craft.mode != before.mode:
            self._happened(time_s, INFO, "uav", f"mode {craft.mode}")
        if craft.armed != before.armed and (craft.armed or before.armed):
            self._happened(time_s, INFO, "uav", "armed" if craft.armed else "disarmed")

    def _take_belief(self, said: Belief, attachment: bytes, time_s: float) -> bool:
        last = self.measurements.at()
        if last is not None and said.step <= last.step:
            return False  # repeated
        cloud = _cloud(said, attachment) if attachment else None
        self.measurements.add(time_s, measured(said, cloud, time_s, self._winds.at()))
        self._stop, self._assume, self._gauge = said.stop, said.assume, gauge_of(said.sensor)
        if attachment:
            self._scatters.add(time_s, None if cloud is None else scatter(said, cloud))
        if not said.ceased and self._budget is not None and said.step >= self._budget:
            self._ended(
                time_s,
                Ending(
                    "not ceased",
                    f"not ceased after {said.step} steps; estimate ({said.mean[0]:.2f}, {said.mean[1]:.2f}) "
                    f"± {said.spread:.2f} m",
                ),
            )
            self._happened(time_s, WARNING, "estimator", "the budget is spent and the source not found")
        return True

    def _take_stop(self, said: Stop, time_s: float) -> bool:
        if self._endings.values:
            return False  # repeated
        claim = said.step, said.estimate, said.spread, said.outside
        area = self.backdrop.area
        self._happened(time_s, STOPPED, "estimator", judged(*claim, None, area).text)
        self._ended(time_s, judged(*claim, self.backdrop.release, area))
        return True

    def _ended(self, time_s: float, ending: Ending) -> None:
        """Take the end of the search: no waypoint of it is flown to any more."""
        self._endings.add(time_s, ending)
        self.waypoints.add(time_s, None)

    # ---- looking ----

    @property
    def begin_s(self) -> float:
        """Simulation time at which the vehicle was first heard; 0 if it was started then."""
        return began_s(self._crafts.times_s)

    @property
    def home(self) -> Fix | None:
        """Home: latitude and longitude, degrees, and altitude above sea, m; None if unknown."""
        return self._area.home

    def at(self, time_s: float = math.inf, wall_s: float | None = None) -> Scene:
        """Return the scene at a simulation time, by default the newest.

        `wall_s` is now by the clock, for judging silent parts.
        """
        wall = (self._walls.at(time_s) or self.wall_s) if wall_s is None else wall_s
        now_s, measurements = min(time_s, self.time_s), self.measurements.until(time_s)
        craft = self._crafts.at(time_s)
        return Scene(
            backdrop=self._backdrop(now_s, measurements[-1].step if measurements else -1),
            time_s=now_s,
            craft=craft,
            track=self._track.until(time_s),
            measurements=measurements,
            scatter=self._scatters.at(time_s),
            waypoint=self.waypoints.at(time_s),
            wind=self._winds.at(time_s) or (craft.condition.wind if craft else None),
            stop=self._stop,
            assume=self._assume,
            services=tuple(self._parts.at(time_s, wall)),
            happenings=self.happenings.until(time_s),
            ending=self._endings.at(time_s),
            home=self._area.home,
            silent_s=None if wall_s is None or craft is None else max(0.0, wall_s - self._heard_s),
            gauge=self._gauge,
            left=bool(self._gone.at(time_s)),
        )

    def _backdrop(self, time_s: float, step: int) -> Backdrop:
        """Return the backdrop with the wind at a time, after the belief of a step."""
        if (release := self.backdrop.release) is None:
            return self.backdrop
        if self._turns is None:
            release = replace(release, wind=self._winds.at(time_s) or release.wind)
        for turn in self._turns or ():
            if turn.counts(step, time_s):
                release = turn.turned(release)
        return replace(self.backdrop, release=release)


def _cloud(said: Belief, attachment: bytes) -> Particles | None:
    """Return a belief's particles; None if they are not valid."""
    try:
        return unpack_particles(attachment, len(said.unknowns))
    except ValueError:
        return None


# ---- of a run ----


def begun(about: dict[str, Any], vehicle: str = "", *, whole: bool = False, number: int = FIRST) -> History:
    """Return the history of a run of which only its own description is known; for the rest see `History`."""
    return History(*backdrop_of(about, vehicle), turns=turns_of(about), whole=whole, number=number)


def histories_of(recording: Recording, vehicle: str = "") -> list[History]:
    """Return all that a record tells of each vehicle: one, or those of a search by several, by number.

    vehicle: the name of one alone; in a search it comes before `uav/1`, `uav/2`, …
    """
    numbers, entries = vehicles_of(recording), on_one_clock(recording)
    histories: list[History] = []
    for number in numbers or [FIRST]:
        name = f"{vehicle} {OF_VEHICLE}{number}".strip() if numbers else vehicle
        histories.append(begun(recording.about, name, whole=True, number=number))
        for entry in entries:
            histories[-1].take(
                entry.key, entry.payload, entry.attachment, entry.simulation_s, entry.published_ns / 1e9
            )
    return histories


def vehicles_of(recording: Recording) -> list[int]:
    """Return the numbers of the vehicles of a search by several that a record has; none of one alone."""
    said = {int(number) for entry in recording.entries if (number := vehicle_of(entry.key))}
    return sorted(said & set(range(FIRST, FIRST + MOST_VEHICLES)))


def on_one_clock(recording: Recording) -> list[Entry]:
    """Return the messages in the order of publication; all vehicles have the clock of the last one.

    Each has a clock of its own, by which one that waits for the others in a fast simulation is earlier. While
    the last one's stands still, each message is a little later than the one before it.
    """
    entries = sorted(recording.entries, key=lambda entry: entry.published_ns)
    last, now_s = vehicles_of(recording)[-1:], 0.0
    for i, entry in enumerate(entries if last else ()):
        now_s += TICK_S
        if entry.key in (BELIEF.name, STOP.name) or vehicle_of(entry.key) == str(last[0]):
            now_s = max(now_s, entry.simulation_s)
        entries[i] = entry._replace(simulation_s=now_s)
    return entries


def history_of(recording: Recording) -> History:
    """Return all that a record tells of its first vehicle."""
    return histories_of(recording)[0]


def remark_on(recording: Recording, history: History) -> str:
    """Return what people should know who see the record, after its name: `is cut off ...`."""
    remarks = [recording.shortcoming]
    if history.missions > 1:
        remarks.append(f"holds {history.missions} missions, of which the last one is shown")
    if not recording.entries:
        remarks.append("holds no message")
    return ", and ".join(filter(None, remarks))
