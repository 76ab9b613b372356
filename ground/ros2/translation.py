"""What is said on a vehicle's bus, translated into messages of topics, with their stamps."""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress

import msgspec

from ground.ros2 import topics
from ground.ros2.messages import Messages, Place, SourceClaim, believed, claimed
from ground.ros2.topics import POSES_PER_S, Topic
from link.bus.keys import BELIEF, MAVLINK_OUT, READING, STOP
from link.bus.mavlink import Reading, unpack_reading
from link.bus.messages import Belief, Health, Stop, unpack_particles
from link.bus.session import Arrival
from link.record.own import OWN_HEALTH
from link.record.record import SimulationClock
from scene.follow.area import Fix
from scene.follow.history import begun

LONGEST_TRACK = 1000  # poses of the track: the newest ones
# How long the vehicle is listened to before it is taken for a simulated one: the search of a real one says
# once a second that it is there.
LISTEN_S = 2.5
MOST_WAITING = 10_000  # messages that wait meanwhile: the newest
SLOT_NS = 10**9 // POSES_PER_S
Said = tuple[Topic, bytes]


class Translation:
    """Translates the messages of one vehicle's bus, in the order of their publishing.

    Stamps of a simulated vehicle are the time of its mission, which `/clock` tells; those of a real one are
    UTC, by the clock of the computer that published. What answers a reading has the reading's stamp. Until
    it is known which of the two the vehicle is, messages wait.
    """

    def __init__(self, vehicle: str, messages: Messages) -> None:
        """Begin. vehicle: its namespace, `uav/1`."""
        self.is_real: bool | None = None  # None as long as that is not known
        self._vehicle, self._messages = vehicle, messages
        self._probe = begun({}, vehicle)
        self._heard_at_s: float | None = None  # when an autopilot was first heard
        self._waiting: deque[Arrival] = deque(maxlen=MOST_WAITING)
        self._restart()

    def _restart(self) -> None:
        """Know nothing yet."""
        self.history = begun({}, self._vehicle)  # what there is to see of the vehicle
        self._clock = SimulationClock()
        self._home: Fix | None = None
        self._state = ""
        self._begin()

    def _begin(self) -> None:
        """Follow a mission from its begin."""
        self.missions = self.history.missions  # so far
        self._stamps: dict[int, int] = {}  # of readings, by time_boot_ms
        self._track: deque[tuple[Place, int]] = deque(maxlen=LONGEST_TRACK)
        self._source: SourceClaim | None = None
        self._step = self._slot = self._clock_slot = self._track_ns = -1
        self._has_stopped = False

    def take(self, arrivals: Sequence[Arrival], now_s: float) -> Iterator[Said]:
        """Take messages, and yield what is to be published. now_s: any monotonic clock."""
        if self.is_real is None:
            self._waiting.extend(arrivals)
            if self._learn(arrivals, now_s) is None:
                return
            arrivals, self._waiting = self._waiting, deque()
        for arrival in arrivals:
            yield from self._translated(arrival)
        if self._track and self._track[-1][1] != self._track_ns:  # once, however many readings have come
            self._track_ns = self._track[-1][1]
            yield topics.TRACK, self._messages.track(self._track, self._track_ns)

    def _learn(self, arrivals: Sequence[Arrival], now_s: float) -> bool | None:
        """Return whether the vehicle is a real one, once that is known."""
        for it in arrivals:
            self._probe.take(it.name, it.payload, b"", 0.0, 0.0)
        if self._heard_at_s is None and self._probe.craft and self._probe.craft.mode:
            self._heard_at_s = now_s
        if self._probe.is_real:
            self.is_real = True
        elif self._heard_at_s is not None and now_s - self._heard_at_s >= LISTEN_S:
            self.is_real = False
        return self.is_real

    def _translated(self, it: Arrival) -> Iterator[Said]:
        time_s = self._clock.time_s(it.name, it.payload, it.published_ns)
        self.history.take(it.name, it.payload, b"", time_s, it.published_ns / 1e9)
        if self.history.is_real:
            self.is_real = True  # its search has been silent until now
        if self.history.missions != self.missions:
            self._begin()
        stamp_ns = it.published_ns if self.is_real else round(1e9 * time_s)
        if not self.is_real and stamp_ns // SLOT_NS > self._clock_slot:
            self._clock_slot = stamp_ns // SLOT_NS
            yield topics.CLOCK, self._messages.clock(stamp_ns)
        with suppress(ValueError, msgspec.DecodeError, RecursionError):  # BadFrame among them
            match it.key.name:
                case MAVLINK_OUT.name:
                    yield from self._telemetry(stamp_ns)
                case READING.name:
                    yield from self._reading(unpack_reading(it.payload), stamp_ns)
                case BELIEF.name:
                    said = msgspec.json.decode(it.payload, type=Belief)
                    yield from self._belief(
                        said, it.attachment, self._stamps.get(said.time_boot_ms, stamp_ns)
                    )
                case STOP.name:
                    stop = msgspec.json.decode(it.payload, type=Stop)
                    yield from self._stop(stop, self._stamps.get(stop.time_boot_ms, stamp_ns))
                case _ if it.name == OWN_HEALTH:
                    yield from self._health(msgspec.json.decode(it.payload, type=Health))

    def _telemetry(self, stamp_ns: int) -> Iterator[Said]:
        """Yield where the vehicle is, unless that was said of this slot of time."""
        craft, home, slot = self.history.craft, self.history.home, stamp_ns // SLOT_NS
        if home and home != self._home:
            self._home = home
            yield topics.TF_STATIC, self._messages.earth(home, stamp_ns)
            if self._source:
                yield topics.ESTIMATE_FIX, self._messages.source_fix(self._source, home, stamp_ns)
        if craft is None or slot == self._slot or not all(map(math.isfinite, craft.position)):
            return
        self._slot = slot
        yield topics.TF, self._messages.transform(craft, stamp_ns)
        yield topics.POSE, self._messages.pose(craft, stamp_ns)
        if craft.fix:
            yield topics.FIX, self._messages.fix(craft, craft.fix, stamp_ns)

    def _reading(self, said: Reading, stamp_ns: int) -> Iterator[Said]:
        if said.time_boot_ms in self._stamps:
            return  # repeated, as it is until it is answered
        self._stamps[said.time_boot_ms] = stamp_ns
        self._track.append(((*said.position, said.altitude_m), stamp_ns))
        yield topics.GAS, self._messages.gas(said.gas, stamp_ns)
        yield topics.WIND, self._messages.wind(said.wind, stamp_ns)

    def _belief(self, said: Belief, attachment: bytes, stamp_ns: int) -> Iterator[Said]:
        if said.step <= self._step:
            return  # repeated
        self._step = said.step
        rows = unpack_particles(attachment, len(said.unknowns))
        source = self._source = believed(said)
        yield topics.ESTIMATE, self._messages.source(source, stamp_ns)
        if self._home:
            yield topics.ESTIMATE_FIX, self._messages.source_fix(source, self._home, stamp_ns)
        yield topics.BELIEF, self._messages.cloud(said, rows, stamp_ns)

    def _stop(self, said: Stop, stamp_ns: int) -> Iterator[Said]:
        if not self._has_stopped:
            self._has_stopped = True
            yield topics.STOP, self._messages.source(claimed(said, self._source), stamp_ns)

    def _health(self, said: Health) -> Iterator[Said]:
        if said.service == "uav" and said.state != self._state:
            self._state = said.state
            yield topics.STATE, self._messages.state(said.state)
