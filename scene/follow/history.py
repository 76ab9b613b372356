"""The history of a mission: what was said so far, and the scene at any moment of it."""

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from link.bus.frames import Frame
from link.bus.keys import BELIEF, MAVLINK_OUT, READING, STOP, WAYPOINT
from link.bus.mavlink import BadFrame, Texts, continued, unpack_reading
from link.bus.messages import Belief, Health, Stop, unpack_particles
from link.modes import ARDUPILOT
from link.record.own import OwnSystem
from link.record.record import HEALTH_PREFIX, began_s
from scene.follow.area import HEARTBEAT, PLACING, AreaFrame
from scene.follow.parts import restarted, verdict
from scene.follow.telemetry import LOCAL, SETPOINT, SHOWN, TEXT, frames, said, seen, waypoint
from scene.follow.timed import MOST, Timed, Trail
from scene.scene import (
    INFO,
    WARNING,
    Backdrop,
    Craft,
    Ending,
    Floats,
    Happening,
    Measurement,
    Place,
    Scatter,
    Scene,
    Service,
    judged,
)
from scene.scene import STOP as STOPPED

TRACK_STEP_M = 0.1
"""The track gets a point when the vehicle has moved so far."""
RESTART_MS = 1000
"""A vehicle whose own time goes back by more was started again."""
LONGEST = 300
"""Characters of a text that are kept: it may quote a stranger."""
MOST_PARTS = 64
"""Most parts that are followed; health messages of more are left out. Names are easily forged."""


class WindTurn(NamedTuple):
    """A change of the true wind, and of the whole plume with it, by a mission script."""

    step: int | None
    """The reading from which on it counts; None if it is the time that counts."""
    time_s: float
    u: float | None
    """Its new speed, m/s; None: as before."""
    phi: float | None
    """The direction it comes from now, rad; None: as before."""


class _Sign(NamedTuple):
    """A sign of life of a part, or of its end."""

    wall_s: float
    alive: bool
    health: Health | None


class _Packed(NamedTuple):
    """Particles as they came."""

    payload: bytes
    unknowns: tuple[str, ...]
    estimate: Place


class History:
    """What was said on the bus of one vehicle. A message that breaks the contract is left out: the
    services count and refuse it.
    """

    def __init__(
        self,
        backdrop: Backdrop,
        budget: int | None = None,
        *,
        turns: Sequence[WindTurn] | None = (),
        whole: bool = True,
    ) -> None:
        """Begin. `whole` keeps what scrubbing needs: each pose and each belief's particles; else only the
        newest ones.

        turns: the changes of the backdrop's wind, in order; None: it is the wind that the readings have.
        """
        self.backdrop = backdrop
        """As it is at first."""
        self.own = OwnSystem()
        """Which system the vehicle is."""
        self._turns = turns
        self.time_s = 0.0
        """Simulation time of the newest message."""
        self.wall_s = 0.0
        self._budget = budget
        self._whole = whole
        self.happenings: Timed[Happening] = Timed(whole, MOST)
        self._signs: dict[str, Timed[_Sign]] = {}
        self._texts = {"uav": Texts(), "search": Texts()}
        self._area = AreaFrame()
        self.is_real = False
        """Whether a search flies a real autopilot: it speaks beside it, under the same system id."""
        self.missions = 0
        """Missions so far; with each one the measurements and the track begin anew."""
        self._begin()

    def _begin(self) -> None:
        """Begin a mission."""
        whole = self._whole
        self.missions += 1
        self._forget_way()
        self._scatters: Timed[_Packed] = Timed(whole)
        self._winds: Timed[tuple[float, float]] = Timed(whole)
        self._waypoints: Timed[Place | None] = Timed(whole)
        self._walls: Timed[float] = Timed(whole)
        self.measurements: Timed[Measurement] = Timed(whole, MOST)
        self._endings: Timed[Ending] = Timed()
        self._stop = self._assume = ""
        self._unpacked: tuple[_Packed, Scatter | None] | None = None

    def _forget_way(self) -> None:
        """Forget where the vehicle is and was."""
        self._area.forget()
        self._boot_ms = 0
        self._crafts: Timed[Craft] = Timed(self._whole)
        self._track = Trail(self._whole)

    def _begin_again(self, time_s: float) -> None:
        """Follow the next mission of a vehicle that was started again. Services stay; happenings, too,
        where no one goes back in time.
        """
        self._begin()
        self.time_s = time_s
        if self._whole:  # what was said before has another mission's times
            self.happenings = Timed()
            for signs in self._signs.values():
                signs.restart(time_s)
        self._happened(time_s, INFO, "uav", "a new mission begins")

    # ---- taking ----

    def take(self, key: str, payload: bytes, attachment: bytes, time_s: float, wall_s: float) -> bool:
        """Take a message, published at a simulation time and at a time by the clock, s. Returns whether it
        changes the scene.
        """
        self.time_s, self.wall_s = max(self.time_s, time_s), max(self.wall_s, wall_s)
        self._walls.add(time_s, wall_s)
        if self.own.learn(key, payload):
            self.is_real = False
            self._forget_way()
        with suppress(BadFrame, msgspec.DecodeError, UnicodeDecodeError, RecursionError, ValueError):
            if key == MAVLINK_OUT.name:
                return self._take_telemetry(payload, time_s)
            if key == BELIEF.name:
                return self._take_belief(msgspec.json.decode(payload, type=Belief), attachment, time_s)
            if key == STOP.name:
                return self._take_stop(msgspec.json.decode(payload, type=Stop), time_s)
            if key.startswith(HEALTH_PREFIX):
                said = msgspec.json.decode(payload, type=Health)
                return key == HEALTH_PREFIX + said.service and self._take_health(said, time_s, wall_s)
            if key == READING.name:
                self._winds.add(time_s, unpack_reading(payload).wind)
                return True
            if key == WAYPOINT.name:
                places = [place for _, fields in frames(payload, {SETPOINT}) if (place := waypoint(fields))]
                for place in places:
                    self._waypoints.add(time_s, place)
                return bool(places)
        return False

    def lives(self, service: str, alive: bool, wall_s: float) -> None:
        """Take that a part appeared on the bus or is gone."""
        self.wall_s = max(self.wall_s, wall_s)
        known = self._sign(service)
        if self._is_crowded(service):
            return
        if known is None or known.alive != alive:
            self._signed(
                service, _Sign(wall_s, alive, None if alive or known is None else known.health), self.time_s
            )
            self._happened(self.time_s, INFO if alive else WARNING, service, "joined" if alive else "is gone")

    def _counts(self, frame: Frame) -> bool:
        """Whether a frame is the vehicle's own, or one of the search that flies it."""
        return self.own.sent(frame) or (frame.message_id in (TEXT, HEARTBEAT) and self.own.searched(frame))

    def _take_telemetry(self, payload: bytes, time_s: float) -> bool:
        changed = False
        before = self._crafts.at(math.inf) or Craft(time_s, (math.nan, math.nan))
        craft = before
        for frame, fields in frames(payload, SHOWN, self._counts):
            changed, message_id = True, frame.message_id
            is_own = self.own.sent(frame)
            if message_id == HEARTBEAT:
                self.is_real |= not is_own or fields["autopilot"] == ARDUPILOT
            if message_id == TEXT:
                who = "uav" if is_own else "search"
                if heard := said(self._texts[who], fields):
                    self._happened(time_s, heard[0], who, heard[1])
            if message_id == TEXT or not is_own:
                continue
            if message_id == LOCAL:
                boot_ms = continued(self._boot_ms, fields["time_boot_ms"])
                if boot_ms + RESTART_MS < self._boot_ms:
                    self._begin_again(time_s)
                    craft = replace(craft, position=(math.nan, math.nan))
                self._boot_ms = boot_ms
            if message_id in PLACING and self._area.take(
                message_id, fields
            ):  # where it was is told from another corner
                craft, self._track = replace(craft, position=(math.nan, math.nan)), Trail(self._whole)
            craft = seen(craft, message_id, fields, time_s, self._area)
            last = self._track.last
            known = message_id == LOCAL and not math.isnan(craft.position[0])
            if known and (last is None or math.dist(last, craft.position) >= TRACK_STEP_M):
                self._track.add(time_s, craft.position)
            if message_id == HEARTBEAT:
                if craft.mode != before.mode:
                    self._happened(time_s, INFO, "uav", f"mode {craft.mode}")
                if craft.armed != before.armed and (craft.armed or before.armed):
                    self._happened(time_s, INFO, "uav", "armed" if craft.armed else "disarmed")
        if craft is not before:
            self._crafts.add(time_s, craft)
        return changed

    def _take_belief(self, said: Belief, attachment: bytes, time_s: float) -> bool:
        last = self.measurements.at(math.inf)
        if last is not None and said.step <= last.step:
            return False  # repeated
        measurement = Measurement(
            said.step, time_s, said.position, said.gas, said.spread, said.mean, said.covariance, said.ceased
        )
        self.measurements.add(time_s, measurement)
        self._stop, self._assume = said.stop, said.assume
        if attachment:
            self._scatters.add(time_s, _Packed(attachment, said.unknowns, said.mean))
        if not said.ceased and self._budget is not None and said.step >= self._budget:
            words = (
                f"not ceased after {said.step} steps; estimate ({said.mean[0]:.2f}, {said.mean[1]:.2f}) "
                f"± {said.spread:.2f} m"
            )
            self._ended(time_s, Ending("not ceased", words))
            self._happened(time_s, WARNING, "estimator", "the budget is spent and the source not found")
        return True

    def _take_stop(self, said: Stop, time_s: float) -> bool:
        if self._endings.values:
            return False  # repeated
        words = (
            f"source found at ({said.estimate[0]:.2f}, {said.estimate[1]:.2f}) ± {said.spread:.2f} m "
            f"after {said.step} steps"
        )
        self._happened(time_s, STOPPED, "estimator", words)
        self._ended(time_s, judged(said.step, said.estimate, said.spread, self.backdrop.release))
        return True

    def _ended(self, time_s: float, ending: Ending) -> None:
        """Take the end of the search: no waypoint of it is flown to any more."""
        self._endings.add(time_s, ending)
        self._waypoints.add(time_s, None)

    def _take_health(self, said: Health, time_s: float, wall_s: float) -> bool:
        known = self._sign(said.service)
        before = known.health if known else None
        if before == said or self._is_crowded(said.service):
            return False  # repeated to a late joiner
        if restarted(before, said):
            self._happened(time_s, WARNING, said.service, "was restarted")
        for words in said.warnings:
            if before is None or words not in before.warnings:
                self._happened(time_s, WARNING, said.service, words)
        if said.last_error and said.last_error not in (before.last_error if before else "", *said.warnings):
            self._happened(time_s, WARNING, said.service, said.last_error)
        if before and said.service == "uav" and said.state != before.state:
            self._happened(time_s, INFO, "uav", said.state)
        self._signed(said.service, _Sign(wall_s, True, said), time_s)
        return True

    def _sign(self, service: str) -> _Sign | None:
        return self._signs[service].at(math.inf) if service in self._signs else None

    def _is_crowded(self, service: str) -> bool:
        """Whether there is no room for a part of this name."""
        return len(service) > LONGEST or (service not in self._signs and len(self._signs) >= MOST_PARTS)

    def _signed(self, service: str, sign: _Sign, time_s: float) -> None:
        self._signs.setdefault(service, Timed(self._whole)).add(time_s, sign)

    def _happened(self, time_s: float, level: str, who: str, text: str) -> None:
        self.happenings.add(time_s, Happening(time_s, level, who, text[:LONGEST]))

    # ---- looking ----

    @property
    def craft(self) -> Craft | None:
        """The vehicle as it reported itself last."""
        return self._crafts.at(math.inf)

    @property
    def begin_s(self) -> float:
        """Simulation time at which the vehicle was first heard; 0 if it was started then."""
        return began_s(self._crafts.times_s)

    @property
    def waypoint(self) -> Place | None:
        """The next waypoint; None if there is none, or none any more."""
        return self._waypoints.at(math.inf)

    def at(self, time_s: float = math.inf, wall_s: float | None = None) -> Scene:
        """Return the scene at a simulation time, by default the newest. `wall_s` is now by the clock, for
        judging silent parts.
        """
        count = self.measurements.count(time_s)
        wall = (self._walls.at(time_s) or self.wall_s) if wall_s is None else wall_s
        packed, craft = self._scatters.at(time_s), self._crafts.at(time_s)
        return Scene(
            backdrop=self._backdrop(
                min(time_s, self.time_s), self.measurements.values[count - 1].step if count else -1
            ),
            time_s=min(time_s, self.time_s),
            craft=craft,
            track=self._track.until(time_s),
            measurements=self.measurements.values[:count],
            scatter=self._scatter(packed) if packed else None,
            waypoint=self._waypoints.at(time_s),
            wind=self._winds.at(time_s) or (craft.condition.wind if craft else None),
            stop=self._stop,
            assume=self._assume,
            services=tuple(self._services(time_s, wall)),
            happenings=self.happenings.until(time_s),
            ending=self._endings.at(time_s),
        )

    def _scatter(self, packed: _Packed) -> Scatter | None:
        """Return the particles; those of the same belief are the same object when asked for again."""
        unpacked = self._unpacked  # several threads may ask
        if unpacked is None or unpacked[0] is not packed:
            unpacked = self._unpacked = packed, _scatter(packed)
        return unpacked[1]

    def _backdrop(self, time_s: float, step: int) -> Backdrop:
        """Return the backdrop with the wind at a time, after the belief of a step."""
        if (release := self.backdrop.release) is None:
            return self.backdrop
        if self._turns is None:
            return replace(
                self.backdrop, release=replace(release, wind=self._winds.at(time_s) or release.wind)
            )
        for turn in self._turns:
            if step >= turn.step if turn.step is not None else time_s >= turn.time_s:
                u = math.hypot(*release.wind) if turn.u is None else turn.u
                phi = math.atan2(release.wind[1], release.wind[0]) if turn.phi is None else turn.phi
                release = replace(release, wind=(u * math.cos(phi), u * math.sin(phi)))
        return replace(self.backdrop, release=release)

    def _services(self, time_s: float, wall_s: float) -> Iterator[Service]:
        order = ("uav", "estimator", "agent")
        for name in sorted(
            self._signs, key=lambda name: (order.index(name) if name in order else len(order), name)
        ):
            if (sign := self._signs[name].at(time_s)) is None:
                continue
            plain = Service(name, verdict(sign.alive, sign.health, wall_s - sign.wall_s))
            said = sign.health
            yield (
                plain
                if said is None
                else replace(
                    plain,
                    state=said.state,
                    about=said.about,
                    step=said.step,
                    latency_s=said.latency_s,
                    warnings=said.warnings,
                )
            )


def _scatter(packed: _Packed) -> Scatter | None:
    """Return the particles in the plane; a known x or y is the estimate's own. None if they are not valid."""
    try:
        rows = unpack_particles(packed.payload, len(packed.unknowns))
    except ValueError:
        return None
    columns: list[NDArray[np.float32]] = []
    for name, known in zip("xy", packed.estimate, strict=True):
        columns.append(
            rows[:, packed.unknowns.index(name)]
            if name in packed.unknowns
            else np.full(len(rows), known, np.float32)
        )
    places: Floats = np.ascontiguousarray(np.stack(columns, axis=1))
    return Scatter(places, rows[:, -1])
