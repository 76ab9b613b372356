"""The path of a logged vehicle, and when it was in the air."""

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise, takewhile
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog.clock import Floats, VehicleClock
from ground.tlog.frames import Integers
from ground.tlog.sender import GLOBAL, GPS, HEARTBEAT, LISTED, LOCAL, Autopilot, FlightError, FlightLog
from link.bus.mavlink import Message
from plume.geodesy import to_local

Place = tuple[float, float, float]
"""(north, east, up) m."""
Home = tuple[float, float, float]
"""Latitude and longitude in degrees, altitude above the sea in m."""

EXTENDED_SYS_STATE = mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE
JOIN_MS, REACH_MS = 5000.0, 1000.0
"""Fixes at most JOIN_MS apart are joined by a line; a line is extrapolated by at most REACH_MS beyond its
ends.
"""
SAMPLED = 500
"""About this many fixes suffice to find the offset between two frames."""
SHIFTED_M = 0.1
"""Smallest offset between two frames that is noted."""


def _groups(labels: Integers) -> Iterator[Integers]:
    """Yield the indices of the elements of each label, in order."""
    order = np.argsort(labels, kind="stable")
    starts = [0, *(np.flatnonzero(np.diff(labels[order])) + 1).tolist(), len(order)]
    return (order[first:end] for first, end in pairwise(starts) if end > first)


class Track:
    """Fixes of one kind in order of time."""

    def __init__(self, times_ms: Sequence[float], places: Sequence[Place], boots: Sequence[int]) -> None:
        """Take each fix's time, place, and the number of the vehicle's restarts before it."""
        self.times_ms, chosen = np.unique(np.array(times_ms, np.float64), return_index=True)
        self.places = np.array(places, np.float64).reshape(-1, 3)[chosen]
        self.boots = np.array(boots, np.int64)[chosen]
        breaks = (np.diff(self.times_ms) > JOIN_MS) | (np.diff(self.boots) != 0)
        self._lines = np.concatenate([[0], np.cumsum(breaks)])[: len(chosen)]
        """The number of each fix's line."""

    def __len__(self) -> int:
        """Number of fixes."""
        return len(self.times_ms)

    def lines(self) -> Iterator[tuple[float, float]]:
        """Yield the first and last time of each line of joined fixes."""
        for line in _groups(self._lines):
            yield float(self.times_ms[line[0]]), float(self.times_ms[line[-1]])

    def of_boots(self) -> Iterator[tuple[int, Integers]]:
        """Yield each number of restarts and the indices of its fixes, in order."""
        for fixes in _groups(self.boots):
            yield int(self.boots[fixes[0]]), fixes

    def at(self, time_ms: float) -> Place | None:
        """Return the place, interpolated on a line or extrapolated from its first or last second by at
        most 1 s; None elsewhere.
        """
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
    """A point on the globe and its place in the local frame."""

    lat_deg: float
    lon_deg: float
    north_m: float
    east_m: float


class FlownPath:
    """The vehicle's path in one local frame, from the best fixes available."""

    def __init__(self, tracks: Sequence[Track], anchor: Anchor | None) -> None:
        """Take the tracks, the best first, and the anchor on the globe, if known."""
        self.tracks = [track for track in tracks if len(track)]
        self.anchor = anchor

    def at(self, time_ms: float) -> Place | None:
        """Return the place at a time; None if no fix is near enough."""
        return next((place for track in self.tracks if (place := track.at(time_ms)) is not None), None)


def flown(
    log: FlightLog, autopilot: Autopilot, clock: VehicleClock, foreign: Sequence[int] = ()
) -> tuple[FlownPath, list[str]]:
    """Return the path and notes; raises FlightError if the vehicle sent no position. foreign: records of
    positions in another frame.

    Fixes come from LOCAL_POSITION_NED (32), else GLOBAL_POSITION_INT (33); from GPS_RAW_INT (24) only if
    neither was ever sent.
    """
    home = next((home for _, home in _homes(log, autopilot)), None)
    local = _track(log, autopilot, clock, LOCAL, _local_place, foreign)
    around, home = _globe_track(log, autopilot, clock, GLOBAL, home)
    name = "GLOBAL_POSITION_INT"
    if not len(local) and not len(around):
        around, home = _globe_track(log, autopilot, clock, GPS, home)
        name = "GPS_RAW_INT"
    told = [
        f"{len(track):,} {kind}"
        for track, kind in ((local, "LOCAL_POSITION_NED"), (around, name))
        if len(track)
    ]
    if not told:
        raise FlightError(
            f"system {autopilot.system} sent no position; wanted LOCAL_POSITION_NED, or GLOBAL_POSITION_INT "
            "or GPS_RAW_INT with a fix"
        )
    notes = [f"positions: {', otherwise '.join(told)}"]
    if not len(local):
        assert home is not None
        return FlownPath([around], Anchor(home[0], home[1], 0.0, 0.0)), notes
    offsets = _offsets(local, around)
    if len(np.unique(local.boots)) > max(1, len(offsets)):
        notes.append("the local frame is assumed unchanged after each restart without GLOBAL_POSITION_INT")
    if not offsets:
        return FlownPath([local], None), notes
    assert home is not None
    base = offsets[min(offsets)]
    moved = []
    for boot, fixes in local.of_boots():
        if boot not in offsets:
            continue
        north, east, _ = (offsets[boot] - base).tolist()
        local.places[fixes] += offsets[boot] - base
        if math.hypot(north, east) >= SHIFTED_M:
            moved.append(
                f"after start {boot + 1} the origin of the local frame is {north:.1f} m north and {east:.1f} "
                "m east of the first one, "
                "by GLOBAL_POSITION_INT: positions are corrected"
            )
    around.places -= base
    notes += moved[:LISTED]
    if (more := len(moved) - LISTED) > 0:
        notes.append(f"so it is after {more:,} more starts")
    return FlownPath([local, around], Anchor(home[0], home[1], -float(base[0]), -float(base[1]))), notes


def _track(
    log: FlightLog,
    autopilot: Autopilot,
    clock: VehicleClock,
    message_id: int,
    place: Callable[[Message], Place | None],
    foreign: Sequence[int] = (),
) -> Track:
    """Return the fixes of one message. A GPS_RAW_INT (24) may carry any clock's time, so its log time is
    used.
    """
    records = np.setdiff1d(log.select(autopilot.system, (message_id,), autopilot.component), foreign)
    fixes = [
        (index, spot, getattr(m, "time_boot_ms", 0))
        for index, m in log.messages(records)
        if (spot := place(m)) is not None
    ]
    kept = np.array([index for index, _, _ in fixes], np.int64)
    boot_ms = np.array([boot_ms for _, _, boot_ms in fixes], np.int64)
    times = clock.logged_ms(kept) if message_id == GPS else clock.own_ms(kept, boot_ms)
    return Track(times.tolist(), [spot for _, spot, _ in fixes], clock.boots(kept).tolist())


def _local_place(m: Message) -> Place | None:
    return (m.x, m.y, -m.z) if all(map(math.isfinite, (m.x, m.y, m.z))) else None


def _globe_track(
    log: FlightLog, autopilot: Autopilot, clock: VehicleClock, message_id: int, home: Home | None
) -> tuple[Track, Home | None]:
    """Return global fixes as metres from home (or from the first fix without a home), and that origin."""

    def place(m: Message) -> Place | None:
        nonlocal home
        fixed = _is_place(m.lat, m.lon) and not (
            message_id == GPS and m.fix_type < mavlink.GPS_FIX_TYPE_2D_FIX
        )
        if not fixed:
            return None
        home = home or (m.lat / 1e7, m.lon / 1e7, m.alt / 1e3)
        north, east = to_local(home[0], home[1], m.lat / 1e7, m.lon / 1e7)
        return north, east, m.relative_alt / 1e3 if message_id == GLOBAL else m.alt / 1e3 - home[2]

    return _track(log, autopilot, clock, message_id, place), home


def _homes(log: FlightLog, autopilot: Autopilot) -> list[tuple[int, Home]]:
    """Return each valid HOME_POSITION (242), with its record."""
    told = log.messages(
        log.select(autopilot.system, (mavlink.MAVLINK_MSG_ID_HOME_POSITION,), autopilot.component)
    )
    return [
        (index, (m.latitude / 1e7, m.longitude / 1e7, m.altitude / 1e3))
        for index, m in told
        if _is_place(m.latitude, m.longitude)
    ]


def home(
    log: FlightLog,
    autopilot: Autopilot,
    clock: VehicleClock,
    flying: Callable[[float], bool],
    anchor: Anchor | None,
) -> tuple[float, float] | None:
    """Return where home was before the flight, (north, east) in m of the local frame; None if the log does
    not say.

    It is where GPS_GLOBAL_ORIGIN (49) puts it, as for the search; else where the vehicle's global
    positions do, to 1 cm.
    """
    homes = _homes(log, autopilot)
    times_ms = clock.logged_ms(np.array([index for index, _ in homes], np.int64)).tolist()
    before = list(takewhile(lambda told: not flying(told[0]), zip(times_ms, homes, strict=True)))
    if not homes:
        return None
    lat, lon, _ = (before[-1][1] if before else homes[0])[1]
    for _, m in log.messages(
        log.select(autopilot.system, (mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,), autopilot.component)
    ):
        if _is_place(m.latitude, m.longitude):
            return to_local(m.latitude / 1e7, m.longitude / 1e7, lat, lon)
    if anchor is None:
        return None
    north, east = to_local(anchor.lat_deg, anchor.lon_deg, lat, lon)
    return round(anchor.north_m + north, 2) + 0.0, round(anchor.east_m + east, 2) + 0.0


def _is_place(lat_e7: int, lon_e7: int) -> bool:
    """True for a valid latitude and longitude; (0, 0) is sent without a fix."""
    return abs(lat_e7) <= 900_000_000 and abs(lon_e7) <= 1_800_000_000 and (lat_e7, lon_e7) != (0, 0)


def _offsets(local: Track, around: Track) -> dict[int, Floats]:
    """Return, by number of restarts, the local frame's origin in the other track's frame, from fixes at
    equal times.
    """
    offsets = {}
    for boot, fixes in local.of_boots():
        chosen = fixes[:: max(1, len(fixes) // SAMPLED)].tolist()
        pairs = [(around.at(float(local.times_ms[fix])), local.places[fix]) for fix in chosen]
        differences = [np.array(place) - own for place, own in pairs if place is not None]
        if differences:
            offsets[boot] = np.asarray(np.median(differences, axis=0))
    return offsets


# ---- reported states ----


class Told:
    """A reported state over time: values and the times of their messages."""

    def __init__(self, times_ms: Floats, values: Sequence[float | tuple[float, ...]]) -> None:
        """Take the times in order."""
        self.times_ms = times_ms
        self.values = np.array(values, np.float64)

    def last(self, time_ms: float) -> int:
        """Return the index of the latest value at a time; before the first value, that of the first."""
        return max(int(np.searchsorted(self.times_ms, time_ms, side="right")) - 1, 0)


def flying(
    log: FlightLog, autopilot: Autopilot, clock: VehicleClock
) -> tuple[Callable[[float], bool], list[str]]:
    """Return a function that tells if the vehicle was in the air at a time (ms), and notes.

    In the air means armed (HEARTBEAT, 0) and not on the ground (EXTENDED_SYS_STATE, 245). A state that was
    never reported is ignored.
    """

    def told(message_id: int, state: Callable[[Message], bool | None]) -> Told:
        records = log.select(autopilot.system, (message_id,), autopilot.component)
        said = [(index, value) for index, m in log.messages(records) if (value := state(m)) is not None]
        return Told(
            clock.logged_ms(np.array([index for index, _ in said], np.int64)), [value for _, value in said]
        )

    def is_aloft(m: Message) -> bool | None:
        return (
            None
            if m.landed_state == mavlink.MAV_LANDED_STATE_UNDEFINED
            else bool(m.landed_state != mavlink.MAV_LANDED_STATE_ON_GROUND)
        )

    armed = told(HEARTBEAT, lambda m: bool(m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED))
    aloft = told(EXTENDED_SYS_STATE, is_aloft)
    words = [word for word, state in (("disarmed", armed), ("on the ground", aloft)) if state.values.any()]
    states = [state for state in (armed, aloft) if state.values.any()]
    notes = [f"in the air: samples taken while {' or '.join(words)} are not used"]
    if not words:
        notes = ["in the air: the log never reports armed or airborne, so all samples are used"]
    return lambda time_ms: all(bool(state.values[state.last(time_ms)]) for state in states), notes
