"""What a telemetry log tells about its vehicle: which one it is, its own time over restarts and gaps, where it was, and when it flew."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

from link.mavlink import Message
from sitl import tlog
from sitl.geodesy import to_local
from sitl.tlog import Integers

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]
"""(north, east, up) m."""
Home = tuple[float, float, float]
"""Latitude and longitude in degrees, altitude above the sea in m."""

AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
EXTENDED_SYS_STATE = mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE
LOCAL, GLOBAL, GPS = (
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
)
CLOCKS = {  # what any autopilot sends, and where in its payload time_boot_ms is
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 8,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 0,
    LOCAL: 0,
    GLOBAL: 0,
}
MAKERS = {
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot",
    mavlink.MAV_AUTOPILOT_PX4: "PX4",
    mavlink.MAV_AUTOPILOT_GENERIC: "generic autopilot",
}

REORDER_MS = 1000
"""Messages overtake each other by so much, on a radio or over UDP; a clock that goes back further was started again."""
LOOKAHEAD = 5
"""Of so many messages behind one that came later still, one shows that the clock went on; otherwise it was started again."""
WRAP = 2**32
"""time_boot_ms begins at zero again after 49.7 days."""
WRAPPED_MS = 3_600_000
"""So soon after that; a clock that shows more was started again."""
GAP_US = 5_000_000
"""A silence that is worth a note."""
JOIN_MS, REACH_MS = 5000.0, 1000.0
"""Fixes that are so near in time are joined by a line, which is believed for so long beyond its ends."""
LISTED = 5
"""So many of a kind are told one by one, the rest by their number."""
SAMPLED = 500
"""So many fixes say well enough how two frames lie to each other."""
SHIFTED_M = 0.1
"""A frame that lies so far off another is worth a note."""


def few(texts: Sequence[str]) -> str:
    """List the first few of many."""
    more = f" and {len(texts) - LISTED:,} more" if len(texts) > LISTED else ""
    return ", ".join(texts[:LISTED]) + more


def counted(count: int, what: str) -> str:
    """Write a number with its noun."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


class FlightError(ValueError):
    """What is asked of a log is not in it; the text is one clear line."""


class Log:
    """The records of a log, by who sent what."""

    def __init__(self, data: bytes) -> None:
        """Find them; there may be none."""
        self.data = data
        self.records = tlog.scan(data)
        self.clock = tlog.log_clock(self.records.logged_us)
        self.times_us = self.clock.times_us.copy()
        """When each was logged, µs since 1970; `vehicle_clock` may still mend it."""
        self._parser = mavlink.MAVLink(None)

    def __len__(self) -> int:
        """How many records there are."""
        return len(self.records.starts)

    @property
    def is_timed(self) -> bool:
        """Whether it says when its frames were logged."""
        return bool(len(self) and np.ptp(self.records.logged_us) > 0)

    def select(self, system: int | None, message_ids: Iterable[int], component: int | None = None) -> Integers:
        """Which records are of these messages and of this sender."""
        chosen = np.isin(self.records.message_ids, list(message_ids))
        if system is not None:
            chosen &= self.records.systems == system
        if component is not None:
            chosen &= self.records.components == component
        return np.flatnonzero(chosen)

    def frame(self, index: int) -> bytes:
        """A frame as it flew."""
        return self.data[self.records.starts[index] : self.records.ends[index]]

    def messages(self, indices: Integers) -> Iterator[tuple[int, Message]]:
        """Decode these records."""
        for index in indices.tolist():
            yield index, self._parser.decode(bytearray(self.frame(index)))

    def seconds(self, index: int) -> float:
        """When a record was logged, from the first one."""
        return float(self.times_us[index] - self.times_us[0]) / 1e6

    def senders(self, indices: Integers | slice = slice(None)) -> Counter[tuple[int, int]]:
        """How many of these records are of each (system, component)."""
        return Counter(zip(self.records.systems[indices].tolist(), self.records.components[indices].tolist(), strict=True))


# ---- who it is ----


class Autopilot(NamedTuple):
    """The sender that flies the vehicle."""

    system: int
    component: int
    maker: str


def choose(log: Log, system: int | None) -> Autopilot:
    """Return the autopilot, of a system or of any, that sent the most positions; raises FlightError where there is none."""
    senders = log.senders()
    systems = sorted({of for of, _ in senders})
    present = ", ".join(map(str, systems))
    if system is not None and system not in systems:
        raise FlightError(f"system {system} is not in the log; those that are: {present}")
    makers = _makers(log)
    positions = log.senders(log.select(system, (LOCAL, GLOBAL, GPS)))
    candidates = [sender for sender in senders if system in (None, sender[0])]
    autopilots = [sender for sender in candidates if sender in makers or sender[1] == AUTOPILOT]
    if system is None and not autopilots:
        raise FlightError(f"no vehicle is in the log: no autopilot is among the systems {present}; choose one of them with --sysid")
    best = max(autopilots or candidates, key=lambda sender: (positions[sender], sender in makers, senders[sender]))
    return Autopilot(*best, makers.get(best, "no heartbeat of an autopilot"))


def _makers(log: Log) -> dict[tuple[int, int], str]:
    """Who says in a HEARTBEAT to be an autopilot, and whose."""
    return {
        (m.get_srcSystem(), m.get_srcComponent()): MAKERS.get(m.autopilot, f"autopilot {m.autopilot}")
        for _, m in log.messages(log.select(None, (HEARTBEAT,)))
        if m.autopilot != mavlink.MAV_AUTOPILOT_INVALID and m.type != mavlink.MAV_TYPE_GCS
    }


def notes_on_senders(log: Log, autopilot: Autopilot) -> list[str]:
    """Say who is heard in a log, and whose words are left out."""
    ground = {
        (m.get_srcSystem(), m.get_srcComponent()) for _, m in log.messages(log.select(None, (HEARTBEAT,))) if m.type == mavlink.MAV_TYPE_GCS
    }
    senders = log.senders().most_common()
    own = {component: counted(count, "frame") for (system, component), count in senders if system == autopilot.system}
    notes = [f"vehicle: system {autopilot.system} ({autopilot.maker}), component {autopilot.component} ({own.pop(autopilot.component)})"]
    if own:
        notes.append(f"on board of it too: {few([f'component {component} ({count})' for component, count in own.items()])}")
    strangers = [
        f"system {system} component {component} ({'ground station, ' if (system, component) in ground else ''}{counted(count, 'frame')})"
        for (system, component), count in senders
        if system != autopilot.system
    ]
    return [*notes, f"skipped: {few(strangers)}"] if strangers else notes


# ---- its time ----


class Clock:
    """The vehicle's time, ms since its start; it goes on growing when the vehicle is started again."""

    def __init__(self, log: Log, ticks: Integers, raw: Integers, times_ms: Integers, boots: Integers) -> None:
        """Take the records that tell it, what they say, what that is in a row, and how many starts were before."""
        self._log = log
        self._ticks = ticks
        self._raw = raw
        self._times_ms = times_ms
        self._boots = boots
        self._ticks_us = log.times_us[ticks]
        self._newest_ms = np.maximum.accumulate(times_ms) if len(ticks) else times_ms

    def boots(self, records: Integers) -> Integers:
        """How often the vehicle had been started again when these were logged."""
        return self._boots[self._tick(records)] if len(self._ticks) else np.zeros(len(records), np.int64)

    def own_ms(self, records: Integers, boot_ms: Integers) -> Floats:
        """The vehicle's time at records that say their time_boot_ms."""
        if not len(self._ticks):
            return self.logged_ms(records)
        tick = self._tick(records)
        since = (boot_ms - self._raw[tick] + WRAP // 2) % WRAP - WRAP // 2
        return (self._times_ms[tick] + since).astype(np.float64)

    def logged_ms(self, records: Integers) -> Floats:
        """The vehicle's time when records were logged: what to go by where a message does not say its own."""
        us = self._log.times_us[records]
        if not len(self._ticks):
            return np.asarray((us - self._log.times_us[0]) / 1000.0)
        first, last = self._ticks_us[0], self._ticks_us[-1]
        beyond = np.where(us < first, us - first, np.maximum(us - last, 0)) / 1000.0
        return np.asarray(np.interp(us - first, self._ticks_us - first, self._newest_ms) + beyond)

    def logged_us(self, times_ms: Floats) -> Integers:
        """When times of the vehicle were logged, or would have been."""
        first = self._log.times_us[self._ticks[0] if len(self._ticks) else 0]
        if not len(self._ticks):
            return np.asarray(first + np.rint(1000.0 * times_ms).astype(np.int64))
        return np.asarray(first + np.rint(np.interp(times_ms, self._newest_ms, self._ticks_us - first)).astype(np.int64))

    def _tick(self, records: Integers) -> Integers:
        return np.maximum(np.searchsorted(self._ticks, records, side="right") - 1, 0)


def vehicle_clock(log: Log, autopilot: Autopilot) -> tuple[Clock, list[str]]:
    """Put the vehicle's times in a row, and take leaps out of the log's clock. Raises FlightError where neither tells the time."""
    ticks = log.select(autopilot.system, CLOCKS, autopilot.component)
    raw = []
    for start, message_id in zip(log.records.starts[ticks].tolist(), log.records.message_ids[ticks].tolist(), strict=True):
        at = CLOCKS[message_id]
        raw.append(int.from_bytes(tlog.payload(log.data, start)[at : at + 4], "little"))
    times_ms, boots = _in_a_row(raw, log.times_us[ticks].tolist())
    own = np.flatnonzero(log.records.systems == autopilot.system)
    if log.is_timed:
        notes = _take_out_leaps(log, own, ticks, times_ms, boots)
    elif len(ticks):
        log.times_us = np.interp(np.arange(len(log)), ticks, np.maximum.accumulate(times_ms) * 1000).astype(np.int64)
        notes = ["its frames were logged without times: the vehicle's own are taken"]
    else:
        raise FlightError("neither the log nor the vehicle tells the time; wanted a telemetry log (.tlog) as ground stations write it")
    starts = (np.flatnonzero(np.diff(boots)) + 1).tolist()
    if starts:
        told = [f"at {log.seconds(ticks[tick]):.1f} s (time_boot_ms from {raw[tick - 1]:,} to {raw[tick]:,})" for tick in starts]
        notes.append(f"the vehicle was started again: {few(told)}; here its time goes on")
    return Clock(log, ticks, np.array(raw, np.int64), times_ms, boots), notes + _notes_on_gaps(log, own)


def _in_a_row(raw: list[int], logged_us: list[int]) -> tuple[Integers, Integers]:
    """Times that go on where the clock was started again, as far as the log's did and by 1 ms at least; and the starts before each."""
    times, boots = [], []
    boot, last = 0, raw[0] if raw else 0
    newest = last
    for index, now in enumerate(raw):
        if _goes_on(last, now):
            late = (last - now) % WRAP
            if late > REORDER_MS:
                newest, last, late = newest + (now - last) % WRAP, now, 0
        elif any(_goes_on(last, later) for later in raw[index + 1 : index + 1 + LOOKAHEAD]):
            late = last - now
        else:
            newest += max(1, (logged_us[index] - logged_us[index - 1]) // 1000)
            last, late, boot = now, 0, boot + 1
        times.append(newest - late)
        boots.append(boot)
    return np.array(times, np.int64), np.array(boots, np.int64)


def _goes_on(last: int, now: int) -> bool:
    """Whether a clock that showed `last` can show `now` without a new start: it is later, or a little late, or has wrapped."""
    return now > last or (last - now) % WRAP <= REORDER_MS or (now - last) % WRAP <= WRAPPED_MS


def _take_out_leaps(log: Log, own: Integers, ticks: Integers, times_ms: Integers, boots: Integers) -> list[str]:
    told = []
    steps_us = np.diff(log.times_us[own])
    for silence in np.flatnonzero(steps_us > GAP_US).tolist():
        before, after = np.searchsorted(ticks, own[silence], side="right") - 1, np.searchsorted(ticks, own[silence + 1])
        if before < 0 or after >= len(ticks) or boots[before] != boots[after]:
            continue
        leap_us = int(steps_us[silence]) - 1000 * max(0, int(times_ms[after] - times_ms[before]))
        if leap_us > GAP_US:
            log.times_us[own[silence + 1] :] -= leap_us
            told.append(f"{leap_us / 1e6:,.1f} s at {log.seconds(own[silence]):.1f} s")
    return [f"the log's clock leaps ahead of the vehicle's by {few(told)}: that is taken off"] if told else []


def _notes_on_gaps(log: Log, own: Integers) -> list[str]:
    silences_us = np.diff(log.times_us[own])
    gaps = np.flatnonzero(silences_us > GAP_US).tolist()
    told = [f"{silences_us[gap] / 1e6:.1f} s at {log.seconds(own[gap]):.1f} s" for gap in gaps]
    return [f"gaps without a word of the vehicle: {few(told)}; {silences_us[gaps].sum() / 1e6:.1f} s in all"] if gaps else []


# ---- where it was ----


class Track:
    """Fixes of one kind in order of time."""

    def __init__(self, times_ms: Sequence[float], places: Sequence[Vector], boots: Sequence[int]) -> None:
        """Take each fix's time, place, and the starts of the vehicle before it."""
        self.times_ms, chosen = np.unique(np.array(times_ms, np.float64), return_index=True)
        self.places = np.array(places, np.float64).reshape(-1, 3)[chosen]
        self.boots = np.array(boots, np.int64)[chosen]
        breaks = (np.diff(self.times_ms) > JOIN_MS) | (np.diff(self.boots) != 0)
        self._lines = np.concatenate([[0], np.cumsum(breaks)])[: len(chosen)]
        """The number of the line that each fix is on."""

    def __len__(self) -> int:
        """How many fixes there are."""
        return len(self.times_ms)

    def lines(self) -> Iterator[tuple[float, float]]:
        """From when to when fixes are joined."""
        for line in np.unique(self._lines):
            times = self.times_ms[self._lines == line]
            yield float(times[0]), float(times[-1])

    def at(self, time_ms: float) -> Vector | None:
        """The place between the fixes before and after; up to 1 s beyond the end of a line, where its last second leads. None elsewhere."""
        after = int(np.searchsorted(self.times_ms, time_ms, side="right"))
        before = after - 1
        if before >= 0 and after < len(self) and self._lines[before] == self._lines[after]:
            return self._between(before, after, time_ms)
        if before >= 0 and time_ms - self.times_ms[before] <= REACH_MS:
            second = int(np.searchsorted(self.times_ms, self.times_ms[before] - REACH_MS))
            begin = int(np.searchsorted(self._lines, self._lines[before]))
            return self._between(max(min(second, before - 1), begin), before, time_ms)
        if after < len(self) and self.times_ms[after] - time_ms <= REACH_MS:
            second = int(np.searchsorted(self.times_ms, self.times_ms[after] + REACH_MS, side="right")) - 1
            end = int(np.searchsorted(self._lines, self._lines[after], side="right")) - 1
            return self._between(after, min(max(second, after + 1), end), time_ms)
        return None

    def _between(self, a: int, b: int, time_ms: float) -> Vector:
        share = (time_ms - self.times_ms[a]) / (self.times_ms[b] - self.times_ms[a]) if a != b else 0.0
        north, east, up = (self.places[a] + share * (self.places[b] - self.places[a])).tolist()
        return north, east, up


class Anchor(NamedTuple):
    """A point of the globe, and where it is in the local frame."""

    lat_deg: float
    lon_deg: float
    north_m: float
    east_m: float


class FlownPath:
    """Where the vehicle was, in one local frame, by the best fixes there are."""

    def __init__(self, tracks: Sequence[Track], anchor: Anchor | None) -> None:
        """Take the tracks, the best first, and what ties them to the globe."""
        self.tracks = [track for track in tracks if len(track)]
        self.anchor = anchor

    def at(self, time_ms: float) -> Vector | None:
        """The place at a time; None where no fix is near enough."""
        return next((place for track in self.tracks if (place := track.at(time_ms)) is not None), None)


def flown(log: Log, autopilot: Autopilot, clock: Clock) -> tuple[FlownPath, list[str]]:
    """Return the path: LOCAL_POSITION_NED, else GLOBAL_POSITION_INT, and GPS_RAW_INT where neither was ever sent; raises FlightError."""
    home = _home(log, autopilot)
    local = _track(log, autopilot, clock, LOCAL, _local_place)
    around, home = _globe_track(log, autopilot, clock, GLOBAL, home)
    name = "GLOBAL_POSITION_INT"
    if not len(local) and not len(around):
        around, home = _globe_track(log, autopilot, clock, GPS, home)
        name = "GPS_RAW_INT"
    told = [f"{len(track):,} of {kind}" for track, kind in ((local, "LOCAL_POSITION_NED"), (around, name)) if len(track)]
    if not told:
        raise FlightError(
            f"system {autopilot.system} told no position; wanted LOCAL_POSITION_NED, or GLOBAL_POSITION_INT or GPS_RAW_INT with a fix"
        )
    notes = [f"positions: {', else '.join(told)}"]
    if not len(local):
        assert home is not None
        return FlownPath([around], Anchor(home[0], home[1], 0.0, 0.0)), notes
    offsets = _offsets(local, around)
    if len(np.unique(local.boots)) > max(1, len(offsets)):
        notes.append("its local frame is taken to be the same after each start where no GLOBAL_POSITION_INT tells otherwise")
    if not offsets:
        return FlownPath([local], None), notes
    assert home is not None
    base = offsets[min(offsets)]
    for boot, offset in offsets.items():
        north, east, _ = (offset - base).tolist()
        local.places[local.boots == boot] += offset - base
        if math.hypot(north, east) >= SHIFTED_M:
            notes.append(
                f"after start {boot + 1} the origin of its local frame lies {north:.1f} m north and {east:.1f} m east of where it was, "
                "by GLOBAL_POSITION_INT: what follows is moved by that"
            )
    around.places -= base
    return FlownPath([local, around], Anchor(home[0], home[1], -float(base[0]), -float(base[1]))), notes


def _track(log: Log, autopilot: Autopilot, clock: Clock, message_id: int, place: Callable[[Message], Vector | None]) -> Track:
    """The fixes of one message. The time of a GPS_RAW_INT may be any clock's, so it counts from when it was logged."""
    records = log.select(autopilot.system, (message_id,), autopilot.component)
    fixes = [(index, spot, getattr(m, "time_boot_ms", 0)) for index, m in log.messages(records) if (spot := place(m)) is not None]
    kept = np.array([index for index, _, _ in fixes], np.int64)
    boot_ms = np.array([boot_ms for _, _, boot_ms in fixes], np.int64)
    times = clock.logged_ms(kept) if message_id == GPS else clock.own_ms(kept, boot_ms)
    return Track(times.tolist(), [spot for _, spot, _ in fixes], clock.boots(kept).tolist())


def _local_place(m: Message) -> Vector | None:
    return (m.x, m.y, -m.z) if all(map(math.isfinite, (m.x, m.y, m.z))) else None


def _globe_track(log: Log, autopilot: Autopilot, clock: Clock, message_id: int, home: Home | None) -> tuple[Track, Home | None]:
    """Fixes on the globe as metres from home, or from the first of them."""

    def place(m: Message) -> Vector | None:
        nonlocal home
        fixed = _is_place(m.lat, m.lon) and not (message_id == GPS and m.fix_type < mavlink.GPS_FIX_TYPE_2D_FIX)
        if not fixed:
            return None
        home = home or (m.lat / 1e7, m.lon / 1e7, m.alt / 1e3)
        north, east = to_local(home[0], home[1], m.lat / 1e7, m.lon / 1e7)
        return north, east, m.relative_alt / 1e3 if message_id == GLOBAL else m.alt / 1e3 - home[2]

    return _track(log, autopilot, clock, message_id, place), home


def _home(log: Log, autopilot: Autopilot) -> Home | None:
    """The first home that is one."""
    for _, m in log.messages(log.select(autopilot.system, (mavlink.MAVLINK_MSG_ID_HOME_POSITION,), autopilot.component)):
        if _is_place(m.latitude, m.longitude):
            return m.latitude / 1e7, m.longitude / 1e7, m.altitude / 1e3
    return None


def _is_place(lat_e7: int, lon_e7: int) -> bool:
    """Zero and zero is what is told without a fix."""
    return abs(lat_e7) <= 900_000_000 and abs(lon_e7) <= 1_800_000_000 and (lat_e7, lon_e7) != (0, 0)


def _offsets(local: Track, around: Track) -> dict[int, Floats]:
    """By start: where the origin of the local frame is in the other track's frame, from fixes of one time."""
    offsets = {}
    for boot in np.unique(local.boots).tolist():
        fixes = np.flatnonzero(local.boots == boot)
        fixes = fixes[:: max(1, len(fixes) // SAMPLED)].tolist()
        pairs = [(around.at(float(local.times_ms[fix])), local.places[fix]) for fix in fixes]
        differences = [np.array(place) - own for place, own in pairs if place is not None]
        if differences:
            offsets[boot] = np.asarray(np.median(differences, axis=0))
    return offsets


# ---- what was said of a state ----


class Told:
    """What was said of something, by when it was said."""

    def __init__(self, times_ms: Floats, values: Sequence[float | tuple[float, ...]]) -> None:
        """Take the times in order."""
        self.times_ms = times_ms
        self.values = np.array(values, np.float64)

    def last(self, time_ms: float) -> int:
        """Number of what was said last at a time, or else first of all."""
        return max(int(np.searchsorted(self.times_ms, time_ms, side="right")) - 1, 0)


def flying(log: Log, autopilot: Autopilot, clock: Clock) -> tuple[Callable[[float], bool], list[str]]:
    """Return what says whether it was in the air at a time: armed, and not on the ground, as far as it ever said to be."""

    def told(message_id: int, state: Callable[[Message], bool | None]) -> Told:
        records = log.select(autopilot.system, (message_id,), autopilot.component)
        said = [(index, value) for index, m in log.messages(records) if (value := state(m)) is not None]
        return Told(clock.logged_ms(np.array([index for index, _ in said], np.int64)), [value for _, value in said])

    def is_aloft(m: Message) -> bool | None:
        return None if m.landed_state == mavlink.MAV_LANDED_STATE_UNDEFINED else bool(m.landed_state != mavlink.MAV_LANDED_STATE_ON_GROUND)

    armed = told(HEARTBEAT, lambda m: bool(m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED))
    aloft = told(EXTENDED_SYS_STATE, is_aloft)
    words = [word for word, state in (("disarmed", armed), ("on the ground", aloft)) if state.values.any()]
    states = [state for state in (armed, aloft) if state.values.any()]
    notes = [f"in the air: what was measured while it was {' or '.join(words)} is no reading"]
    if not words:
        notes = ["in the air: it never says to be armed or off the ground, so all that was measured counts"]
    return lambda time_ms: all(bool(state.values[state.last(time_ms)]) for state in states), notes
