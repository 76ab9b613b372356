"""Where a logged vehicle was, and when it was in the air."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from link.bus.mavlink import Message
from sitl.autopilot.geodesy import to_local
from sitl.tlog.clock import Floats, VehicleClock
from sitl.tlog.sender import GLOBAL, GPS, HEARTBEAT, LOCAL, Autopilot, FlightError, FlightLog

Place = tuple[float, float, float]
"""(north, east, up) m."""
Home = tuple[float, float, float]
"""Latitude and longitude in degrees, altitude above the sea in m."""

EXTENDED_SYS_STATE = mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE
JOIN_MS, REACH_MS = 5000.0, 1000.0
"""Fixes that are so near in time are joined by a line, which is believed for so long beyond its ends."""
SAMPLED = 500
"""So many fixes say well enough how two frames lie to each other."""
SHIFTED_M = 0.1
"""A frame that lies so far off another is worth a note."""


class Track:
    """Fixes of one kind in order of time."""

    def __init__(self, times_ms: Sequence[float], places: Sequence[Place], boots: Sequence[int]) -> None:
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

    def at(self, time_ms: float) -> Place | None:
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

    def _between(self, a: int, b: int, time_ms: float) -> Place:
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

    def at(self, time_ms: float) -> Place | None:
        """The place at a time; None where no fix is near enough."""
        return next((place for track in self.tracks if (place := track.at(time_ms)) is not None), None)


def flown(log: FlightLog, autopilot: Autopilot, clock: VehicleClock) -> tuple[FlownPath, list[str]]:
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


def _track(log: FlightLog, autopilot: Autopilot, clock: VehicleClock, message_id: int, place: Callable[[Message], Place | None]) -> Track:
    """The fixes of one message. The time of a GPS_RAW_INT may be any clock's, so it counts from when it was logged."""
    records = log.select(autopilot.system, (message_id,), autopilot.component)
    fixes = [(index, spot, getattr(m, "time_boot_ms", 0)) for index, m in log.messages(records) if (spot := place(m)) is not None]
    kept = np.array([index for index, _, _ in fixes], np.int64)
    boot_ms = np.array([boot_ms for _, _, boot_ms in fixes], np.int64)
    times = clock.logged_ms(kept) if message_id == GPS else clock.own_ms(kept, boot_ms)
    return Track(times.tolist(), [spot for _, spot, _ in fixes], clock.boots(kept).tolist())


def _local_place(m: Message) -> Place | None:
    return (m.x, m.y, -m.z) if all(map(math.isfinite, (m.x, m.y, m.z))) else None


def _globe_track(
    log: FlightLog, autopilot: Autopilot, clock: VehicleClock, message_id: int, home: Home | None
) -> tuple[Track, Home | None]:
    """Fixes on the globe as metres from home, or from the first of them."""

    def place(m: Message) -> Place | None:
        nonlocal home
        fixed = _is_place(m.lat, m.lon) and not (message_id == GPS and m.fix_type < mavlink.GPS_FIX_TYPE_2D_FIX)
        if not fixed:
            return None
        home = home or (m.lat / 1e7, m.lon / 1e7, m.alt / 1e3)
        north, east = to_local(home[0], home[1], m.lat / 1e7, m.lon / 1e7)
        return north, east, m.relative_alt / 1e3 if message_id == GLOBAL else m.alt / 1e3 - home[2]

    return _track(log, autopilot, clock, message_id, place), home


def _home(log: FlightLog, autopilot: Autopilot) -> Home | None:
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


def flying(log: FlightLog, autopilot: Autopilot, clock: VehicleClock) -> tuple[Callable[[float], bool], list[str]]:
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
