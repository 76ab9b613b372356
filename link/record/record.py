"""The record of a run: its messages, its topics, and the simulation time of messages.

A record is one MCAP file with every message as published, and a .tlog file beside it with the MAVLink
frames. `writer` writes both, `reader` reads the MCAP file.

A MAVLink payload is stored unchanged under its key. Decoded copies for viewers lie beside it: each message
under a topic such as `mavlink/out/ATTITUDE`, a reading under `reading/decoded`. JSON is stored under its
key with one more field, `simulation_s`; the particles of a belief under `belief/particles`. A message that
violates docs/bus.md is stored under `<key>/malformed`, with the reason. All parts of one message have the
same times and the same sequence number. Topics that begin with no key, such as `scene/particles`, are for
viewers only and are not read back.
"""

import contextlib
import json
import math
from collections.abc import Callable, Iterable
from typing import Annotated, Any, NamedTuple

import msgspec

from link.bus.frames import Frame, frame_at, frames_in
from link.bus.keys import (
    BELIEF,
    DEPARTURE,
    HEALTH,
    KEYS,
    LATECOMER,
    MAVLINK_IN,
    MAVLINK_OUT,
    READING,
    STOP,
    WAYPOINT,
    row_name,
    vehicle_of,
)
from link.bus.mavlink import ONBOARD_COMPUTER, continued
from link.bus.messages import Departure, Latecomer
from link.record.own import OwnSystem

# Name of the metadata record that describes the run. If recording stops early, a second such record gives
# the reason under STOPPED.
ABOUT, STOPPED = "plumeward", "stopped"
# Entry of ABOUT with the format of the record; the format that is written.
FORMAT_NAME, FORMAT = "format", 2
# Formats that are read. 0 stands for records without a format number; they are otherwise the same as 1.
# Until 1, waypoints were sent on `mavlink/in`: see `key_today`.
READABLE = (0, 1, FORMAT)
# Endings of topics, after their key.
MALFORMED, DECODED, PARTICLES, ATTACHMENT = "malformed", "decoded", "particles", "attachment"

STRUCTS: dict[str, type[msgspec.Struct]] = {
    key.name: key.payload for key in KEYS if isinstance(key.payload, type)
}
FRAME_KEYS = {key.name for key in KEYS if isinstance(key.payload, str)}
HEALTH_PREFIX = HEALTH.name.removesuffix("<service>")


class Entry(NamedTuple):
    """One message of a run.

    Attributes:
        key: Relative to the namespace: `reading`, `mavlink/out`, `health/uav`; of a search by several
            vehicles `uav/2/reading`.
        published_ns: When it was published, ns since the Unix epoch.
        simulation_s: Simulation time, s: the message's own if it has one, else the newest known.
        payload: The message, as it was published.
        attachment: What came with it: the particles of a belief.
    """

    key: str
    published_ns: int
    simulation_s: float
    payload: bytes
    attachment: bytes = b""


def row(key: str) -> str:
    """Return the name of a key's row in the table of keys; empty if it has none."""
    name = row_name(key)
    name = HEALTH.name if name.startswith(HEALTH_PREFIX) else name
    return name if name in STRUCTS or name in FRAME_KEYS else ""


def parted(topic: str) -> tuple[str, str]:
    """Split a topic into its key, empty if that is not in the table of keys, and its ending."""
    words = topic.split("/")
    for count in (1, 2, 3, 4):  # two more where it is a vehicle's of a search
        if row(key := "/".join(words[:count])):
            return key, "/".join(words[count:])
    return "", topic


def has_frames(key: str) -> bool:
    """Whether the messages of a key are MAVLink frames."""
    return row_name(key) in FRAME_KEYS


def key_today(key: str, payload: bytes, written: int) -> str:
    """Return the key that a message of a record in format `written` has today.

    The agent's setpoints on `mavlink/in` are waypoints.
    """
    frame = frame_at(payload) if written < FORMAT and key == MAVLINK_IN.name else None
    return (
        WAYPOINT.name
        if frame and frame.message_id in ANSWER_TIME and frame.component == ONBOARD_COMPUTER
        else key
    )


# ---- simulation time ----


class _Timed(msgspec.Struct):
    time_boot_ms: Annotated[int, msgspec.Meta(ge=0, lt=2**32)]


# ATTITUDE, LOCAL_POSITION_NED and GLOBAL_POSITION_INT begin with the vehicle's own time_boot_ms.
OWN_TIME = {30, 32, 33}
# SET_POSITION_TARGET_LOCAL_NED begins with the time_boot_ms of the reading it answers.
ANSWER_TIME = {84}


def _time_boot_ms(
    payload: bytes, message_ids: set[int], counts: Callable[[Frame], bool] = lambda _: True
) -> int | None:
    """Return the time_boot_ms of the first frame that counts with one of these ids; None without one.

    It reads headers only.
    """
    ours = (frame for frame in frames_in(payload) if frame.message_id in message_ids and counts(frame))
    return next((int.from_bytes(frame.payload[:4], "little") for frame in ours), None)


def _answered_ms(key: str, payload: bytes) -> int | None:
    """Return the time_boot_ms of the reading that a belief, stop or waypoint answers; None of all else."""
    if key == WAYPOINT.name:
        return _time_boot_ms(payload, ANSWER_TIME)
    if key in (BELIEF.name, STOP.name):
        with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return msgspec.json.decode(payload, type=_Timed).time_boot_ms
    return None


# Most readings remembered: repeated and answered ones are among the last few.
MOST_READINGS = 4096


class SimulationClock:
    """Assigns a simulation time to each message, from the vehicle's own time stamps.

    It goes on where those wrap. In a search by several vehicles each has a clock of its own; what is nobody's
    own goes by the last vehicle's.
    """

    def __init__(self) -> None:
        self._of: dict[str, SimulationClock] = {}  # of each vehicle, by its number
        self._own = OwnSystem()
        self._newest_ms = 0
        self._late_s = 0.0  # of a vehicle that comes late: the time of the others when it was first heard
        self._newest_published_ns = 0
        self._readings: dict[int, int] = {}  # the times of the last MOST_READINGS by their time_boot_ms
        self._count = 0
        self._left: set[str] = set()  # the numbers of those that have left a search of several
        self._late: dict[str, int | None] = {}  # the first round of those that come late; None: none yet

    def time_s(self, key: str, payload: bytes, published_ns: int) -> float:
        """Return the simulation time of a message, s.

        The newest known time is the vehicle's last published one. It may go back: that follows a restarted
        vehicle.
        """
        if number := vehicle_of(key):
            clock = self._of.get(number) or self._of.setdefault(number, self._begun(number))
            return clock.time_s(row_name(key), payload, published_ns) + clock._late_s
        if key in (DEPARTURE.name, LATECOMER.name):
            with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
                self._call_the_roll(key, payload)
        if self._of:
            clock = self._of[self._whose(key, payload)]
            return clock.time_s(key, payload, published_ns) + clock._late_s
        own: int | None = None
        self._own.learn(key, payload)
        if (answered := _answered_ms(key, payload)) is not None:
            # A waypoint may answer no reading.
            own = self._readings.get(answered, None if key == WAYPOINT.name else answered)
        elif (boot_ms := self._boot_ms(key, payload)) is not None:
            own = continued(self._newest_ms, boot_ms)
            if key == READING.name:
                own = self._noted(boot_ms, own)
            if published_ns >= self._newest_published_ns:
                self._newest_ms, self._newest_published_ns = own, published_ns
        return (self._newest_ms if own is None else own) / 1000.0

    def _begun(self, number: str) -> "SimulationClock":
        """Return the clock of a vehicle heard first. That of a latecomer begins at the others' time."""
        clock = SimulationClock()
        if number in self._late:
            clock._late_s = max(
                (each._newest_ms / 1000.0 + each._late_s for each in self._of.values()), default=0.0
            )
        return clock

    def _call_the_roll(self, key: str, payload: bytes) -> None:
        """Take who has left a search by several, and who comes late. Raises DecodeError."""
        if key == DEPARTURE.name:
            self._left.add(str(msgspec.json.decode(payload, type=Departure).vehicle))
            return
        late = msgspec.json.decode(payload, type=Latecomer)
        if late.step is not msgspec.UNSET:
            self._late[str(late.vehicle)] = late.step
        else:
            self._late.setdefault(str(late.vehicle), None)

    def _whose(self, key: str, payload: bytes) -> str:
        """Return whose clock a message of a search goes by that is nobody's own: the number of a vehicle.

        An answer goes by that of its round's first or last reading. The first or last vehicle may have
        left, or come late.
        """
        order = sorted(self._of, key=int, reverse=key != WAYPOINT.name)
        if not (self._left or self._late):
            return order[0]
        answered = _answered_ms(key, payload)
        return next((number for number in order if answered in self._of[number]._readings), order[0])

    def _boot_ms(self, key: str, payload: bytes) -> int | None:
        # A ground station has times of its own, a waypoint that of the reading it answers.
        if key not in FRAME_KEYS or key in (MAVLINK_IN.name, WAYPOINT.name):
            return None
        return _time_boot_ms(
            payload, OWN_TIME, lambda frame: key != MAVLINK_OUT.name or self._own.sent(frame)
        )

    def _noted(self, boot_ms: int, time_ms: int) -> int:
        """Return the time of a reading: that at which it first came."""
        if boot_ms not in self._readings:
            self._count += 1
            self._readings[boot_ms] = time_ms
            if len(self._readings) > MOST_READINGS:
                del self._readings[next(iter(self._readings))]
        return self._readings[boot_ms]

    @property
    def step(self) -> int:
        """Number of the newest reading, 0 at the start, -1 before it; of several that of the last to read."""
        searching = [
            clock.step + begin
            for number, clock in self._of.items()
            if number not in self._left and (begin := self._late.get(number, 0)) is not None
        ]
        return min(searching, default=self._count - 1)


# A run whose first time is at most this begins at 0.
EARLY_S = 60.0


def began_s(times_s: Iterable[float]) -> float:
    """Return when a run begins by the vehicle's clock, from the simulation times of its messages.

    Those before its first word are at 0, and an autopilot may have been on for hours before that.
    """
    first_s = min((time_s for time_s in times_s if time_s > 0.0), default=0.0)
    return first_s if first_s > EARLY_S else 0.0


# ---- conversion to text and back ----


def text_of(value: object) -> str:
    """Return a metadata value as text: JSON, except that a string which is not valid JSON stays as it is."""
    if isinstance(value, str) and value_of(value) is value:
        return value
    return json.dumps(value, ensure_ascii=False)


def value_of(text: str) -> Any:
    """Undo `text_of`: what is not valid JSON is returned as it is."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def with_time(text: bytes, simulation_s: float) -> bytes:
    """Add the simulation time as the last field of a JSON object that has fields."""
    head, _, blank = text.rpartition(b"}")
    return head + time_field(simulation_s) + blank


def time_field(simulation_s: float) -> bytes:
    """Return the simulation time as the last field of a JSON object, with the closing brace."""
    return f',"simulation_s":{simulation_s!r}}}'.encode()


def without_time(text: bytes) -> tuple[bytes, float]:
    """Undo `with_time` to the last byte; raises ValueError if there is no finite time."""
    head, _, tail = text.rpartition(b',"simulation_s":')
    number, _, blank = tail.partition(b"}")
    simulation_s = float(number)
    if not math.isfinite(simulation_s):
        raise ValueError(f"the simulation time is {simulation_s}; wanted a finite number")
    return head + b"}" + blank, simulation_s
