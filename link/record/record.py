"""The record of a run: what one message of it is, what its topics are called, and the simulation time of messages.

A record is every message as it was published, in one MCAP file, and the MAVLink of it in a .tlog beside that. `writer` writes the two,
`reader` reads the first.

A payload of MAVLink lies as it flew under its key, and beside it what viewers can plot: each message under `mavlink/out/ATTITUDE` and
the like, a reading under `reading/decoded`. JSON lies under its key with one more field, `simulation_s`; the particles of a belief
under `belief/particles`. What is not what docs/bus.md says is kept under `<key>/malformed`, with the reason. All that comes from one
message has the same times and the same sequence number.
"""

import contextlib
import json
import math
from typing import Annotated, Any, NamedTuple

import msgspec

from link.bus.frames import frame_at
from link.bus.keys import BELIEF, HEALTH, KEYS, MAVLINK_IN, READING, STOP

ABOUT, STOPPED = "plumeward", "stopped"
"""Name of the metadata record that says what the run was, and the entry of a second one which says why the record broke off."""
FORMAT_NAME, FORMAT = "format", 1
"""The entry of ABOUT that says how a record is laid out, and the number of the layout that is written."""
READABLE = (0, FORMAT)
"""The layouts that are read: 0 is that of records without a number, which differ from 1 in nothing else."""
MALFORMED, DECODED, PARTICLES, ATTACHMENT = "malformed", "decoded", "particles", "attachment"
"""What topics add to their key."""

STRUCTS: dict[str, type[msgspec.Struct]] = {key.name: key.payload for key in KEYS if isinstance(key.payload, type)}
FRAME_KEYS = {key.name for key in KEYS if isinstance(key.payload, str)}
HEALTH_PREFIX = HEALTH.name.removesuffix("<service>")


class Entry(NamedTuple):
    """One message of a run."""

    key: str
    """Relative to the vehicle's namespace: `reading`, `mavlink/out`, `health/uav`."""
    published_ns: int
    """When it was published, ns since the Unix epoch."""
    simulation_s: float
    """Simulation time: the message's own where it has one, else the newest one known."""
    payload: bytes
    attachment: bytes = b""


def row(key: str) -> str:
    """The name of the row of the table of keys that a key is of; empty where it is of none."""
    name = HEALTH.name if key.startswith(HEALTH_PREFIX) else key
    return name if name in STRUCTS or name in FRAME_KEYS else ""


def parted(topic: str) -> tuple[str, str]:
    """Return the key that a topic belongs to, empty where it is none of ours, and what the topic adds to it."""
    words = topic.split("/")
    for count in (1, 2):
        if row(key := "/".join(words[:count])):
            return key, "/".join(words[count:])
    return "", topic


# ---- simulation time ----


class _Timed(msgspec.Struct):
    time_boot_ms: Annotated[int, msgspec.Meta(ge=0, lt=2**32)]


OWN_TIME = {30, 32, 33}
"""ATTITUDE, LOCAL_POSITION_NED and GLOBAL_POSITION_INT begin with the vehicle's own time_boot_ms."""
WAYPOINT = {84}
"""SET_POSITION_TARGET_LOCAL_NED begins with the time_boot_ms of the reading it answers."""


def _time_boot_ms(payload: bytes, message_ids: set[int]) -> int | None:
    """The time that the first such frame begins with, without decoding more than headers."""
    at = 0
    while (frame := frame_at(payload, at)) is not None:
        if frame.message_id in message_ids:
            return int.from_bytes(payload[frame.payload : min(frame.payload + 4, frame.checksum)], "little")
        at = frame.end
    return None


class SimulationClock:
    """Tells the simulation time of messages from what the vehicle says."""

    def __init__(self) -> None:
        """Begin at zero."""
        self._newest_ms = 0
        self._told_ns = 0
        self._readings: set[int] = set()

    def time_s(self, key: str, payload: bytes, published_ns: int) -> float:
        """Simulation time of a message; of the vehicle's, the last published one counts, so that one which begins anew is followed."""
        own: int | None = None
        if key in (BELIEF.name, STOP.name):
            with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
                own = msgspec.json.decode(payload, type=_Timed).time_boot_ms
        elif key == MAVLINK_IN.name:
            answered = _time_boot_ms(payload, WAYPOINT)
            own = answered if answered in self._readings else None  # a ground station may send times of its own
        elif key in FRAME_KEYS:
            own = _time_boot_ms(payload, OWN_TIME)
            if own is not None and key == READING.name:
                self._readings.add(own)
            if own is not None and published_ns >= self._told_ns:
                self._newest_ms, self._told_ns = own, published_ns
        return (self._newest_ms if own is None else own) / 1000.0

    @property
    def step(self) -> int:
        """Number of the newest reading, 0 at the start; -1 before the first."""
        return len(self._readings) - 1


# ---- what is written as text, and read back ----


def text_of(value: object) -> str:
    """A value of the metadata, which are strings: JSON, but for a string that cannot be mistaken for it."""
    if isinstance(value, str):
        try:
            json.loads(value)
        except ValueError:
            return value
    return json.dumps(value, ensure_ascii=False)


def value_of(text: str) -> Any:
    """Undo `text_of`."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def with_time(text: bytes, simulation_s: float) -> bytes:
    """Add the simulation time as the last field of a JSON object that has fields."""
    head, _, blank = text.rpartition(b"}")
    return head + time_field(simulation_s) + blank


def time_field(simulation_s: float) -> bytes:
    """The simulation time as the last field of a JSON object, with the end of that."""
    return f',"simulation_s":{simulation_s!r}}}'.encode()


def without_time(text: bytes) -> tuple[bytes, float]:
    """Undo `with_time`, to the last byte; raises ValueError where there is no such time."""
    head, _, tail = text.rpartition(b',"simulation_s":')
    number, _, blank = tail.partition(b"}")
    simulation_s = float(number)
    if not math.isfinite(simulation_s):
        raise ValueError(f"a simulation time of {simulation_s}")
    return head + b"}" + blank, simulation_s
