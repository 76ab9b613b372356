"""A vehicle's log: its MAVLink records by sender and message, and the autopilot that flies the vehicle."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog import onboard
from ground.tlog.frames import Integers, log_clock, once, scan
from link.bus.frames import MAVLINK_1, MAVLINK_2
from link.bus.mavlink import Message
from link.cli import BadInput

AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
LOCAL = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
GLOBAL = mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
GPS = mavlink.MAVLINK_MSG_ID_GPS_RAW_INT
NAMES = {message_id: kind.msgname for message_id, kind in mavlink.mavlink_map.items()}
MAKERS = {
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot",
    mavlink.MAV_AUTOPILOT_PX4: "PX4",
    mavlink.MAV_AUTOPILOT_GENERIC: "generic autopilot",
}
VERSIONS = {MAVLINK_1: "1", MAVLINK_2: "2"}  # by the first byte of a frame
LISTED = 5  # notes list this many items of a kind and count the rest


def few(texts: Sequence[str], count: int = 0) -> str:
    """List the first few texts and count the rest; `count` is their total if not all are given."""
    more = max(len(texts), count) - LISTED
    return ", ".join(texts[:LISTED]) + (f" and {more:,} more" if more > 0 else "")


def counted(count: int, what: str) -> str:
    """Write a number and its noun, in the plural if needed."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


class FlightLog:
    """The records of a log, by sender and message."""

    def __init__(self, data: bytes, is_onboard: bool = False) -> None:
        """Find the records; there may be none. `is_onboard`: the data was a log that is written on board."""
        self.data = data
        self.is_onboard = is_onboard
        self.notes: list[str] = []  # what was read, what was left out and why, in lines for people
        self.records, again = (scan(data), 0) if is_onboard else once(data, scan(data))
        if again:
            self.notes.append(f"skipped: {counted(again, 'frame')} that the log holds again, to the last bit")
        self.clock = log_clock(self.records.logged_us)
        self.times_us = self.clock.times_us.copy()  # µs since 1970; `vehicle_clock` may correct them
        self.is_timed = bool(len(self) and np.ptp(self.records.logged_us) > 0)
        self._parser = mavlink.MAVLink(None)

    def __len__(self) -> int:
        return len(self.records.starts)

    def select(
        self, system: int | None, message_ids: Iterable[int], component: int | None = None
    ) -> Integers:
        """Return the indices of the records of these messages and this sender."""
        chosen = np.isin(self.records.message_ids, list(message_ids))
        if system is not None:
            chosen &= self.records.systems == system
        if component is not None:
            chosen &= self.records.components == component
        return np.flatnonzero(chosen)

    def frame(self, index: int) -> bytes:
        """Return a record's original frame."""
        return self.data[self.records.starts[index] : self.records.ends[index]]

    def message(self, index: int) -> Message:
        """Decode a record."""
        return self._parser.decode(bytearray(self.frame(index)))

    def messages(self, indices: Integers) -> Iterator[tuple[int, Message]]:
        """Decode these records; yields (index, message)."""
        return ((index, self.message(index)) for index in indices.tolist())

    def seconds(self, index: int) -> float:
        """Return the log's time of a record, s from the first one."""
        return float(self.times_us[index] - self.times_us[0]) / 1e6

    def senders(self, indices: Integers | slice = slice(None)) -> Counter[tuple[int, int]]:
        """Count these records by (system, component)."""
        systems, components = self.records.systems[indices], self.records.components[indices]
        return Counter(zip(systems.tolist(), components.tolist(), strict=True))


# ---- the file ----


def open_log(path: Path, gas: str = "") -> FlightLog:
    """Return a log's records, with notes about the file. Raises BadInput if it cannot be read or is none.

    gas: the message and field that an on-board log's gas values are read from, if it is not a named value.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadInput(f"{path} cannot be read: {error.strerror}") from None
    told = ""
    if data.startswith((onboard.DATAFLASH, onboard.ULOG)):
        data, told = onboard.telemetry(data, gas)
    log = FlightLog(data, bool(told))
    if not len(log):
        raise BadInput(
            f"{path} is {told}, but none that tells of a position, the wind or gas"
            if told
            else f"{path} contains no MAVLink 1 or 2 frame; wanted a telemetry log (.tlog), as ground "
            "stations write it, or a log that an autopilot writes on board (.bin, .ulg)"
        )
    if told:
        log.notes.append(f"{path.name}: {told}; read as the telemetry that follows")
    _note_file(path.name, log)
    return log


def _note_file(name: str, log: FlightLog) -> None:
    records, clock, notes = log.records, log.clock, log.notes
    markers = {log.data[start] for start in records.starts.tolist()}
    versions = " and ".join(VERSIONS[marker] for marker in sorted(markers, reverse=True))
    began = datetime.fromtimestamp(int(log.times_us[0]) / 1e6, UTC)
    span = f" in {log.seconds(-1):,.1f} s from {began:%Y-%m-%d %H:%M:%S} UTC" if log.is_timed else ""
    notes.append(f"{name}: {counted(len(log), 'frame')} of MAVLink {versions}{span}")
    if records.garbage:
        first_s = log.seconds(min(records.garbage[0][0], len(log) - 1))
        notes.append(
            f"skipped: {counted(sum(count for _, count in records.garbage), 'byte')} of garbage in "
            f"{counted(len(records.garbage), 'run')}, the first at {first_s:.1f} s"
        )
    for counts_by_id, told in (
        (records.refused, "among them, frames with a wrong checksum (damaged or from another dialect)"),
        (records.unknown, "frames of unknown messages, whose checksums cannot be verified"),
    ):
        if counts_by_id:
            by_message = [
                f"{count:,} {NAMES.get(number, f'of id {number}')}"
                for number, count in counts_by_id.most_common()
            ]
            notes.append(f"{told}: {few(by_message)}")
    if records.cut_off:
        notes.append(f"the last record is cut off after {counted(records.cut_off, 'byte')}")
    if log.is_timed and clock.damaged:
        notes.append(
            f"frames with a missing or impossible time: {clock.damaged:,}; each takes the time of the frame "
            "before it"
        )
    if clock.jumps:
        jumps = [f"{back_us / 1e6:,.1f} s at {log.seconds(index):.1f} s" for index, back_us in clock.jumps]
        notes.append(f"the log's clock jumps back by {few(jumps)}: later times are corrected")


# ---- its senders ----


class Autopilot(NamedTuple):
    """The sender that flies the vehicle."""

    system: int
    component: int
    maker: str


def choose(log: FlightLog, system: int | None) -> Autopilot:
    """Return the autopilot that sent the most positions, of one system or of any, and note all senders.

    Raises BadInput if there is none.
    """
    makers, stations = {}, set()
    for _, m in log.messages(log.select(None, (HEARTBEAT,))):
        sender = m.get_srcSystem(), m.get_srcComponent()
        if m.type == mavlink.MAV_TYPE_GCS:
            stations.add(sender)
        elif m.autopilot != mavlink.MAV_AUTOPILOT_INVALID:
            makers[sender] = MAKERS.get(m.autopilot, f"autopilot {m.autopilot}")
    senders = log.senders()
    systems = sorted({of for of, _ in senders})
    present = ", ".join(map(str, systems))
    if system is not None and system not in systems:
        raise BadInput(f"system {system} is not in the log; its systems: {present}")
    positions = log.senders(log.select(system, (LOCAL, GLOBAL, GPS)))
    candidates = [sender for sender in senders if system in (None, sender[0])]
    autopilots = [sender for sender in candidates if sender in makers or sender[1] == AUTOPILOT]
    if system is None and not autopilots:
        raise BadInput(
            f"no vehicle is in the log: none of its systems ({present}) is an autopilot; choose one with "
            "--sysid"
        )
    best = max(
        autopilots or candidates, key=lambda sender: (positions[sender], sender in makers, senders[sender])
    )
    chosen = Autopilot(*best, makers.get(best, "no heartbeat of an autopilot"))
    log.notes.append(
        f"vehicle: system {chosen.system} ({chosen.maker}), component {chosen.component} "
        f"({counted(senders.pop(best), 'frame')})"
    )
    ranked = senders.most_common()
    own = [f"component {part} ({counted(n, 'frame')})" for (of, part), n in ranked if of == chosen.system]
    strangers = [
        f"system {of} component {part} ({'ground station, ' * ((of, part) in stations)}{counted(n, 'frame')})"
        for (of, part), n in ranked
        if of != chosen.system
    ]
    told = {"also on board": own, "skipped": strangers}
    log.notes += [f"{what}: {few(listed)}" for what, listed in told.items() if listed]
    return chosen
