"""Reads on-board logs as telemetry that the vehicle would have sent: ArduPilot's .bin and PX4's .ulg.

Both walks are ours, since logs come from strangers. pymavlink's `DFReader_binary` never returns from a format
of length 0, stops indexing at the first type it does not know, and prints a line for each damaged byte.
pyulog never returns from some damaged definitions, and builds all fields that nested types claim. The tests
compare both with us.
"""

import contextlib
import re
import struct
from collections import Counter, defaultdict
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from pymavlink.DFReader import FORMAT_TO_STRUCT
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog.frames import LATEST_US, SURE_US
from link.bus.mavlink import WRAP_MS, Codec, Message

DATAFLASH = b"\xa3\x95"  # begins each message of a dataflash log, and so the log
ULOG, ULOG_HEADER = b"ULog\x01\x12\x35", 16  # its first bytes, and the length of its header
ULOG_HEAD = struct.Struct("<Hc")  # size and kind of a message
ULOG_LONGEST = 65_535  # bytes of a message's body
ULOG_KINDS = {bytes([kind]) for kind in b"BFIMPQALCDROS"}
ULOG_SYNC = b"\x08\x00S\x2f\x73\x13\x20\x25\x0c\xbb\x12"
ULOG_TYPES = {
    **{"int8_t": "b", "uint8_t": "B", "int16_t": "h", "uint16_t": "H", "int32_t": "i", "uint32_t": "I"},
    **{"int64_t": "q", "uint64_t": "Q", "float": "f", "double": "d", "bool": "?", "char": "s"},
}
ULOG_FIELD = re.compile(r"(\w+)(?:\[([0-9]{1,3})\])? (\w+);?")
# What a message raises that is not as its autopilot writes it.
UNLIKE = struct.error, LookupError, ValueError, TypeError, OverflowError, AttributeError
DATAFLASH_HEAD = 3  # bytes before a message's body
FORMAT_TYPE = 0x80  # of the dataflash message that defines the others
NAME_LENGTH = 10  # of a NAMED_VALUE_FLOAT
CONTENT = slice(7, -2)  # of a frame: all but its sequence number and checksum
TURN = 5  # a vehicle has restarted where so many messages are earlier than so many before them
Fields = dict[str, Any]


# ---- what becomes of their messages ----


def _place(lat: float, lon: float, alt_m: float) -> tuple[int, int, int]:
    return round(lat * 1e7), round(lon * 1e7), round(1000 * alt_m)


def _globe(time_ms: int, lat: float, lon: float, alt_m: float, up_m: float = 0.0) -> Message:
    place = *_place(lat, lon, alt_m), round(1000 * up_m)
    return mavlink.MAVLink_global_position_int_message(time_ms, *place, 0, 0, 0, 0)


def _local(time_ms: int, north: float, east: float, down: float, valid: bool) -> Message | None:
    place = north, east, down
    return mavlink.MAVLink_local_position_ned_message(time_ms, *place, 0.0, 0.0, 0.0) if valid else None


def _wind(_: int, north: float, east: float) -> Message:
    return mavlink.MAVLink_wind_cov_message(0, north, east, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def _armed(autopilot: int, armed_state: int, _: int, state: int) -> Message:
    mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if state == armed_state else 0
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, autopilot, mode, 0, 0, 3)


def _landed(_: int, landed: bool) -> Message:
    state = mavlink.MAV_LANDED_STATE_ON_GROUND if landed else mavlink.MAV_LANDED_STATE_IN_AIR
    return mavlink.MAVLink_extended_sys_state_message(0, state)


def _home(_: int, *place: float) -> Message:
    attitude = [1.0, 0.0, 0.0, 0.0]
    return mavlink.MAVLink_home_position_message(*_place(*place), 0.0, 0.0, 0.0, attitude, 0.0, 0.0, 0.0)


def _origin(time_ms: int, kind: int, *place: float) -> Message:
    return _home(time_ms, *place) if kind else mavlink.MAVLink_gps_global_origin_message(*_place(*place), 0)


def _named(time_ms: int, name: str, value: float, senders_ms: int | None = None) -> Message:
    return mavlink.MAVLink_named_value_float_message(
        time_ms if senders_ms is None else senders_ms, name.encode()[:NAME_LENGTH], value
    )


TELEMETRY: dict[str, tuple[Callable[..., Message | None], tuple[str, ...]]] = {
    # message or topic: (what it becomes, its fields)
    "POS": (_globe, ("Lat", "Lng", "Alt", "RelHomeAlt")),
    "ORGN": (_origin, ("Type", "Lat", "Lng", "Alt")),
    "XKF2": (_wind, ("VWN", "VWE")),
    "NKF2": (_wind, ("VWN", "VWE")),
    "ARM": (partial(_armed, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1), ("ArmState",)),
    "NVF": (_named, ("Name", "Value")),  # a value that the autopilot sent
    "NVAL": (_named, ("Name", "Value", "TimeBootMS")),  # one that it received
    "vehicle_local_position": (_local, ("x", "y", "z", "xy_valid")),
    "vehicle_global_position": (_globe, ("lat", "lon", "alt")),
    "home_position": (_home, ("lat", "lon", "alt")),
    "wind": (_wind, ("windspeed_north", "windspeed_east")),
    "wind_estimate": (_wind, ("windspeed_north", "windspeed_east")),
    "vehicle_status": (partial(_armed, mavlink.MAV_AUTOPILOT_PX4, 2), ("arming_state",)),
    "vehicle_land_detected": (_landed, ("landed",)),
    "debug_key_value": (_named, ("key", "value")),
}
PARAMETER, OWN_IDS = "PARM", ("SYSID_THISMAV", "MAV_SYSID")  # ArduPilot's, of its own system id
TIME_OF_DAY = ("GPS", "vehicle_gps_position", "sensor_gps")  # messages that tell the time of day
GPS_EPOCH_US = 315_964_800_000_000  # 6 January 1980
LEAP_US = 18_000_000  # GPS time is ahead of UTC by this, since 2017
WEEK_US = 7 * 86_400 * 1_000_000


def telemetry(data: bytes, gas: str = "") -> tuple[bytes, str]:
    """Return an on-board log as the bytes of a .tlog, and what it is in words.

    gas: MESSAGE.FIELD of gas values that are no named values; they become some, by the first letters of this
    name.
    """
    said = _Said(re.split(r"[*@]", gas)[0])
    told = _read_dataflash(data, said) if data.startswith(DATAFLASH) else _read_ulog(data, said)
    own = said.own_frames()
    if others := len(said.frames) - len(own):
        told += f", {others:,} values of other systems with the same name left out"
    return b"".join((said.utc_us + us).to_bytes(8) + frame for us, frame in _in_order(own)), told


def _in_order(said: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """Return frames, each once, in order of time.

    Where the vehicle's clock goes back it has restarted: then times go on.
    """
    frames = list({(us, frame[CONTENT]): (us, frame) for us, frame in said}.values())
    times_us = np.array([us for us, _ in frames], np.int64)
    starts = [0]
    if len(frames) > TURN:
        runs = sliding_window_view(times_us, TURN)  # one damaged time is no restart
        back = runs[TURN:].max(axis=1) < runs[:-TURN].min(axis=1) - SURE_US
        starts += (np.flatnonzero(back) + TURN).tolist()
    ordered: list[tuple[int, bytes]] = []
    for start, end in pairwise([*starts, len(frames)]):
        boot = sorted(frames[start:end], key=lambda each: each[0])
        on_us = ordered[-1][0] - boot[0][0] if ordered else 0
        ordered += [(us + on_us, frame) for us, frame in boot]
    return ordered


class _Said:
    """What a log says that telemetry has a message for."""

    def __init__(self, gas: str) -> None:
        # With their times, µs since the boot, and of a value that was received its name and sender's system.
        self.frames: list[tuple[int, bytes, tuple[str, int] | None]] = []
        self._system = 0  # the vehicle's own id; 0 until it says so
        self.utc_us = 0  # time of the boot, µs since 1970; 0 until a receiver tells it
        self._gas = gas
        self._topic, _, self._field = gas.partition(".")
        self.topics = {*TELEMETRY, *TIME_OF_DAY, PARAMETER, self._topic}
        self._codec = Codec(1, mavlink.MAV_COMP_ID_AUTOPILOT1)

    def take(self, topic: str, fields: Fields) -> None:
        """Take a message. What is not as its autopilot writes it is left out."""
        with contextlib.suppress(*UNLIKE):
            time_us = int(fields["TimeUS"] if "TimeUS" in fields else fields["timestamp"])
            if not 0 <= time_us < LATEST_US:
                return
            if topic == PARAMETER and fields["Name"] in OWN_IDS:
                self._system = int(fields["Value"])
            if topic in TIME_OF_DAY and not self.utc_us:
                self._set_clock(time_us, fields)
            time_ms = time_us // 1000 % WRAP_MS
            if topic == self._topic and self._field in fields:
                self._add(time_us, _named(time_ms, self._gas, float(fields[self._field])))
            become, names = TELEMETRY.get(topic, (None, ()))
            if become and not fields.get("C"):  # ArduPilot runs several estimators: the first one
                message = become(time_ms, *(fields[name] for name in names))
                self._add(time_us, message, (fields["Name"], fields["SSys"]) if topic == "NVAL" else None)

    def own_frames(self) -> list[tuple[int, bytes]]:
        """Return the frames without values that another vehicle sent, where several say the same name."""
        senders: dict[str, Counter[int]] = defaultdict(Counter)
        for _, _, heard in self.frames:
            if heard:
                senders[heard[0]][heard[1]] += 1
        own = {
            (name, self._system if self._system in counts else counts.most_common(1)[0][0])
            for name, counts in senders.items()
        }
        return [(us, frame) for us, frame, heard in self.frames if heard is None or heard in own]

    def _add(self, time_us: int, message: Message | None, heard: tuple[str, int] | None = None) -> None:
        if message is not None:
            self.frames.append((time_us, self._codec.pack(message), heard))

    def _set_clock(self, time_us: int, fields: Fields) -> None:
        utc_us = int(fields.get("time_utc_usec", 0))
        if fields.get("GWk"):
            utc_us = GPS_EPOCH_US + fields["GWk"] * WEEK_US + fields["GMS"] * 1000 - LEAP_US
        if time_us < utc_us < LATEST_US:
            self.utc_us = utc_us - time_us


class _Layout(NamedTuple):
    """How a message is laid out: its values, and their names and factors."""

    body: struct.Struct
    columns: list[tuple[str, float | None]]

    def fields(self, data: bytes, at: int) -> Fields:
        """Return the fields of the message at an offset."""
        values = zip(self.columns, self.body.unpack_from(data, at), strict=True)
        return {name: _value(value, factor) for (name, factor), value in values}


def _value(value: Any, factor: float | None) -> Any:
    if isinstance(value, bytes):
        return value.partition(b"\0")[0].decode("latin-1")
    return value if factor is None else value * factor


# ---- ArduPilot's dataflash ----


def _dataflash_layout(letters: str, names: str, length: int) -> _Layout | None:
    """Return how a type of message is laid out; None if that is not so long."""
    rows = [FORMAT_TO_STRUCT.get(letter, ("", None, None)) for letter in letters]
    body, columns = struct.Struct("<" + "".join(code for code, _, _ in rows)), names.split(",")
    if len(rows) != len(columns) or DATAFLASH_HEAD + body.size != length:
        return None
    return _Layout(body, [(name, row[1]) for name, row in zip(columns, rows, strict=True)])


def _read_dataflash(data: bytes, said: _Said) -> str:
    """Read all messages; returns what the log is. A damaged message is stepped over to the next head."""
    formats = {FORMAT_TYPE: ("FMT", 89, _dataflash_layout("BBnNZ", "Type,Length,Name,Format,Columns", 89))}
    at = count = read = 0
    while 0 <= (at := data.find(DATAFLASH, at)) < len(data) - 2:
        name, length, layout = formats.get(data[at + 2], ("", 0, None))
        if not length or at + length > len(data):
            at += 1
            continue
        if layout and data[at + 2] == FORMAT_TYPE:
            number, size, defined, letters, names = layout.fields(data, at + DATAFLASH_HEAD).values()
            if number != FORMAT_TYPE and size > DATAFLASH_HEAD:
                formats[number] = defined, size, _dataflash_layout(letters, names, size)
        elif layout and name in said.topics:
            said.take(name, layout.fields(data, at + DATAFLASH_HEAD))
        at += length
        read += length
        count += 1
    lost = f", {len(data) - read:,} bytes skipped as garbage" if read < len(data) else ""
    return f"an ArduPilot dataflash log of {count:,} messages{lost}"


# ---- PX4's ULog ----


def _read_ulog(data: bytes, said: _Said) -> str:
    """Read all topics; returns what the log is. What is damaged is stepped over to the next sync message."""
    layouts: dict[str, _Layout | None] = {}
    topics: dict[int, str] = {}
    at, lost = ULOG_HEADER, 0
    while at + ULOG_HEAD.size <= len(data):
        size, kind = ULOG_HEAD.unpack_from(data, at)
        body = data[at + ULOG_HEAD.size : at + ULOG_HEAD.size + size]
        if kind not in ULOG_KINDS or len(body) < size:
            found = data.find(ULOG_SYNC, at)
            after = found if found > 0 else len(data)
            lost, at = lost + after - at, after
            continue
        at += ULOG_HEAD.size + size
        topic = topics.get(int.from_bytes(body[:2], "little"), "")
        layout = layouts.get(topic)
        if kind == b"F":
            topic, _, fields = body.decode("latin-1").partition(":")
            layouts[topic] = _ulog_layout(fields) if topic in said.topics else None
        elif kind == b"A" and size > 3 and not body[0]:  # the first of several sensors
            topics[int.from_bytes(body[1:3], "little")] = body[3:].decode("latin-1")
        elif kind == b"D" and layout and size >= 2 + layout.body.size:
            said.take(topic, layout.fields(body, 2))
    damage = f", {lost:,} bytes skipped as garbage" if lost else ""
    return f"a PX4 ULog of {len(data):,} bytes{damage}"


def _ulog_layout(fields: str) -> _Layout | None:
    """Return how a topic is laid out; None if it cannot be read. Arrays are values with a number: `q[0]`."""
    codes = "<"
    names: list[str] = []
    for kind, many, name in ULOG_FIELD.findall(fields):
        if name.startswith("_padding"):  # only at the end, where it is not logged
            break
        if kind not in ULOG_TYPES or len(names) + int(many or 1) > ULOG_LONGEST:
            return None
        if kind == "char":
            codes += f"{many or 1}s"
            names.append(name)
        else:
            codes += ULOG_TYPES[kind] * int(many or 1)
            names += [f"{name}[{number}]" for number in range(int(many))] if many else [name]
    return _Layout(struct.Struct(codes), [(name, None) for name in names])
