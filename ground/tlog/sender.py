"""The senders of a telemetry log: its records by sender, and the autopilot that flies the vehicle."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog import frames
from ground.tlog.frames import Integers
from link.bus.mavlink import Message

AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
LOCAL, GLOBAL, GPS = (
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
)
MAKERS = {
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot",
    mavlink.MAV_AUTOPILOT_PX4: "PX4",
    mavlink.MAV_AUTOPILOT_GENERIC: "generic autopilot",
}

LISTED = 5
"""Notes list this many items of a kind and count the rest."""


def few(texts: Sequence[str]) -> str:
    """List the first few texts and count the rest."""
    more = f" and {len(texts) - LISTED:,} more" if len(texts) > LISTED else ""
    return ", ".join(texts[:LISTED]) + more


def counted(count: int, what: str) -> str:
    """Write a number and its noun, in the plural if needed."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


class FlightError(ValueError):
    """A log does not contain what was requested, or the request is not allowed; the message is one line."""


class FlightLog:
    """The records of a log, by sender and message."""

    def __init__(self, data: bytes) -> None:
        """Find the records; there may be none."""
        self.data = data
        self.records = frames.scan(data)
        self.clock = frames.log_clock(self.records.logged_us)
        self.times_us = self.clock.times_us.copy()
        """When each record was logged, µs since 1970; `vehicle_clock` may correct it."""
        self._parser = mavlink.MAVLink(None)

    def __len__(self) -> int:
        """Number of records."""
        return len(self.records.starts)

    @property
    def is_timed(self) -> bool:
        """True if the log has record times."""
        return bool(len(self) and np.ptp(self.records.logged_us) > 0)

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

    def messages(self, indices: Integers) -> Iterator[tuple[int, Message]]:
        """Decode these records; yields (index, message)."""
        for index in indices.tolist():
            yield index, self._parser.decode(bytearray(self.frame(index)))

    def seconds(self, index: int) -> float:
        """Return the log's time of a record, s from the first one."""
        return float(self.times_us[index] - self.times_us[0]) / 1e6

    def senders(self, indices: Integers | slice = slice(None)) -> Counter[tuple[int, int]]:
        """Count these records by (system, component)."""
        return Counter(
            zip(
                self.records.systems[indices].tolist(), self.records.components[indices].tolist(), strict=True
            )
        )


class Autopilot(NamedTuple):
    """The sender that flies the vehicle."""

    system: int
    component: int
    maker: str


def choose(log: FlightLog, system: int | None) -> Autopilot:
    """Return the autopilot that sent the most positions, of one system or of any; raises FlightError if
    there is none.
    """
    senders = log.senders()
    systems = sorted({of for of, _ in senders})
    present = ", ".join(map(str, systems))
    if system is not None and system not in systems:
        raise FlightError(f"system {system} is not in the log; its systems: {present}")
    makers = _makers(log)
    positions = log.senders(log.select(system, (LOCAL, GLOBAL, GPS)))
    candidates = [sender for sender in senders if system in (None, sender[0])]
    autopilots = [sender for sender in candidates if sender in makers or sender[1] == AUTOPILOT]
    if system is None and not autopilots:
        raise FlightError(
            f"no vehicle is in the log: none of its systems ({present}) is an autopilot; choose one with "
            "--sysid"
        )
    best = max(
        autopilots or candidates, key=lambda sender: (positions[sender], sender in makers, senders[sender])
    )
    return Autopilot(*best, makers.get(best, "no heartbeat of an autopilot"))


def _makers(log: FlightLog) -> dict[tuple[int, int], str]:
    """Return the senders whose HEARTBEAT (0) names an autopilot, with its maker."""
    return {
        (m.get_srcSystem(), m.get_srcComponent()): MAKERS.get(m.autopilot, f"autopilot {m.autopilot}")
        for _, m in log.messages(log.select(None, (HEARTBEAT,)))
        if m.autopilot != mavlink.MAV_AUTOPILOT_INVALID and m.type != mavlink.MAV_TYPE_GCS
    }


def notes_on_senders(log: FlightLog, autopilot: Autopilot) -> list[str]:
    """Return notes on the senders of a log, and on those whose frames are skipped."""
    ground = {
        (m.get_srcSystem(), m.get_srcComponent())
        for _, m in log.messages(log.select(None, (HEARTBEAT,)))
        if m.type == mavlink.MAV_TYPE_GCS
    }
    senders = log.senders().most_common()
    own = {
        component: counted(count, "frame")
        for (system, component), count in senders
        if system == autopilot.system
    }
    notes = [
        f"vehicle: system {autopilot.system} ({autopilot.maker}), component {autopilot.component} "
        f"({own.pop(autopilot.component)})"
    ]
    if own:
        notes.append(
            f"also on board: {few([f'component {component} ({count})' for component, count in own.items()])}"
        )
    strangers = [
        f"system {system} component {component} "
        f"({'ground station, ' if (system, component) in ground else ''}{counted(count, 'frame')})"
        for (system, component), count in senders
        if system != autopilot.system
    ]
    return [*notes, f"skipped: {few(strangers)}"] if strangers else notes
