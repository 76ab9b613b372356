"""The path of a logged vehicle, where its home was, and when it was in the air."""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from ground.tlog.clock import Floats, VehicleClock
from ground.tlog.frames import Integers
from ground.tlog.log import GLOBAL, GPS, HEARTBEAT, LISTED, LOCAL, Autopilot, FlightLog
from link.bus.mavlink import Message
from link.cli import BadInput
from plume.geodesy import to_global, to_local

NorthEastUp = tuple[float, float, float]  # m
Home = tuple[float, float, float]  # latitude and longitude in degrees, altitude above the sea in m

HOME, ORIGIN = mavlink.MAVLINK_MSG_ID_HOME_POSITION, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
JOIN_MS = 5000.0  # fixes at most this far apart are joined by a line
REACH_MS = 1000.0  # a line is extrapolated by at most this beyond its ends
SAMPLED = 500  # about this many fixes suffice to find the offset between two frames
SHIFTED_M = 0.1  # smallest offset between two frames that is noted


def _groups(labels: Integers) -> list[Integers]:
    """Return the indices of the elements of each label, in order."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(labels[order])) + 1) if len(labels) else []


class Track:
    """Fixes of one kind in order of time."""

    def __init__(
        self, times_ms: Sequence[float], places: Sequence[NorthEastUp], boots: Sequence[int]
    ) -> None:
        """Take each fix's time, place, and the number of the vehicle's restarts before it."""
        self.times_ms, chosen = np.unique(np.array(times_ms, np.float64), return_index=True)
        self.places = np.array(places, np.float64).reshape(-1, 3)[chosen]
        self.boots = np.array(boots, np.int64)[chosen]
        breaks = (np.diff(self.times_ms) > JOIN_MS) | (np.diff(self.boots) != 0)
        self._lines = np.concatenate([[0], np.cumsum(breaks)])[: len(chosen)]  # number of each fix's line

    def __len__(self) -> int:
        return len(self.times_ms)

    def lines(self) -> Iterator[tuple[float, float]]:
        """Yield the first and last time of each line of joined fixes."""
        for line in _groups(self._lines):
            yield float(self.times_ms[line[0]]), float(self.times_ms[line[-1]])

    def of_boots(self) -> Iterator[tuple[int, Integers]]:
        """Yield each number of restarts and the indices of its fixes, in order."""
        return ((int(self.boots[fixes[0]]), fixes) for fixes in _groups(self.boots))

    def at(self, time_ms: float) -> NorthEastUp | None:
        """Return the place at a time; None where no fix is near enough.

        It is interpolated on a line, or extrapolated from its first or last second by at most 1 s.
        """
        times_ms, lines = self.times_ms, self._lines
        b = int(np.searchsorted(times_ms, time_ms, side="right"))
        a = b - 1
        if a >= 0 and b < len(self) and lines[a] == lines[b]:
            pass
        elif a >= 0 and time_ms - times_ms[a] <= REACH_MS:
            second = int(np.searchsorted(times_ms, times_ms[a] - REACH_MS))
            a, b = max(min(second, a - 1), int(np.searchsorted(lines, lines[a]))), a
        elif b < len(self) and times_ms[b] - time_ms <= REACH_MS:
            second = int(np.searchsorted(times_ms, times_ms[b] + REACH_MS, side="right")) - 1
            a, b = b, min(max(second, b + 1), int(np.searchsorted(lines, lines[b], side="right")) - 1)
        else:
            return None
        share = (time_ms - times_ms[a]) / (times_ms[b] - times_ms[a]) if a != b else 0.0
        north, east, up = (self.places[a] + share * (self.places[b] - self.places[a])).tolist()
        return north, east, up


class Anchor(NamedTuple):
    """A point on the globe and its place in the local frame."""

    lat_deg: float
    lon_deg: float
    north_m: float
    east_m: float

    def globe(self, north_m: float, east_m: float) -> tuple[float, float]:
        """Return the latitude and longitude of a place in the local frame."""
        return to_global(self.lat_deg, self.lon_deg, north_m - self.north_m, east_m - self.east_m)


class FlownPath(NamedTuple):
    """The vehicle's path in one local frame, from the best fixes available."""

    tracks: Sequence[Track]  # the best first
    anchor: Anchor | None  # None if no message ties the frame to the globe
    is_local: bool  # whether the frame is the vehicle's own

    def at(self, time_ms: float) -> NorthEastUp | None:
        """Return the place at a time; None if no fix is near enough."""
        return next((place for track in self.tracks if (place := track.at(time_ms)) is not None), None)


def flown(
    log: FlightLog, autopilot: Autopilot, clock: VehicleClock, foreign: Sequence[int] = ()
) -> FlownPath:
    """Return the path; raises BadInput if the vehicle sent no position.

    foreign: records of positions in another frame. Fixes come from LOCAL_POSITION_NED (32), else
    GLOBAL_POSITION_INT (33); from GPS_RAW_INT (24) only if neither was ever sent.
    """
    homes = [home for _, home in _told_places(log, autopilot, HOME)]
    local = _track(log, autopilot, clock, LOCAL, _local_place, foreign)
    around, home = _globe_track(log, autopilot, clock, GLOBAL, homes)
    name = "GLOBAL_POSITION_INT"
    if not len(local) and not len(around):
        around, home = _globe_track(log, autopilot, clock, GPS, homes)
        name = "GPS_RAW_INT"
    kinds = {"LOCAL_POSITION_NED": local, name: around}
    told = [f"{len(track):,} {kind}" for kind, track in kinds.items() if len(track)]
    if not told:
        raise BadInput(
            f"system {autopilot.system} sent no position; wanted LOCAL_POSITION_NED, or GLOBAL_POSITION_INT "
            "or GPS_RAW_INT with a fix"
        )
    log.notes.append(f"positions: {', otherwise '.join(told)}")
    if not len(local):
        return FlownPath([around], Anchor(home[0], home[1], 0.0, 0.0), False)
    offsets = _offsets(local, around)
    if len(np.unique(local.boots)) > max(1, len(offsets)):
        log.notes.append(
            "the local frame is assumed unchanged after each restart without GLOBAL_POSITION_INT"
        )
    if not offsets:
        return FlownPath([local], None, True)
    base = offsets[min(offsets)]
    around.places -= base
    moved = []
    for boot, fixes in local.of_boots():
        north, east, _ = shift = offsets.get(boot, base) - base
        local.places[fixes] += shift
        if math.hypot(north, east) >= SHIFTED_M:
            moved.append(
                f"after start {boot + 1} the origin of the local frame is {north:.1f} m north and {east:.1f} "
                "m east of the first one, by GLOBAL_POSITION_INT: positions are corrected"
            )
    log.notes += moved[:LISTED]
    if (more := len(moved) - LISTED) > 0:
        log.notes.append(f"so it is after {more:,} more starts")
    return FlownPath([local, around], Anchor(home[0], home[1], -float(base[0]), -float(base[1])), True)


def _track(
    log: FlightLog,
    autopilot: Autopilot,
    clock: VehicleClock,
    message_id: int,
    place: Callable[[Message], NorthEastUp | None],
    foreign: Sequence[int] = (),
) -> Track:
    """Return the fixes of one message.

    A GPS_RAW_INT (24) may carry any clock's time, so its log time is used.
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


def _local_place(m: Message) -> NorthEastUp | None:
    return (m.x, m.y, -m.z) if all(map(math.isfinite, (m.x, m.y, m.z))) else None


def _globe_track(
    log: FlightLog, autopilot: Autopilot, clock: VehicleClock, message_id: int, homes: Sequence[Home]
) -> tuple[Track, Home]:
    """Return global fixes as metres from the first home, else from the first fix, and that origin."""
    origin = list(homes[:1])

    def place(m: Message) -> NorthEastUp | None:
        if not _is_place(m.lat, m.lon) or (message_id == GPS and m.fix_type < mavlink.GPS_FIX_TYPE_2D_FIX):
            return None
        if not origin:
            origin.append((m.lat / 1e7, m.lon / 1e7, m.alt / 1e3))
        lat, lon, alt_m = origin[0]
        north, east = to_local(lat, lon, m.lat / 1e7, m.lon / 1e7)
        return north, east, m.relative_alt / 1e3 if message_id == GLOBAL else m.alt / 1e3 - alt_m

    track = _track(log, autopilot, clock, message_id, place)
    return track, origin[0] if origin else (0.0, 0.0, 0.0)


def _told_places(log: FlightLog, autopilot: Autopilot, message_id: int) -> list[tuple[int, Home]]:
    """Return each valid HOME_POSITION (242) or GPS_GLOBAL_ORIGIN (49), with its record."""
    return [
        (index, (m.latitude / 1e7, m.longitude / 1e7, m.altitude / 1e3))
        for index, m in log.messages(log.select(autopilot.system, (message_id,), autopilot.component))
        if _is_place(m.latitude, m.longitude)
    ]


def home(
    log: FlightLog,
    autopilot: Autopilot,
    clock: VehicleClock,
    flying: Callable[[float], bool],
    path: FlownPath,
) -> tuple[float, float] | None:
    """Return where home was before the flight, (north, east) in m of the path's frame; None if unknown.

    It is where GPS_GLOBAL_ORIGIN (49), the origin of the vehicle's own frame, puts it, as for the search;
    else where the vehicle's global positions do, to 1 cm.
    """
    homes = _told_places(log, autopilot, HOME)
    if not homes:
        return None
    times_ms = clock.logged_ms(np.array([index for index, _ in homes], np.int64)).tolist()
    before = sum(1 for _ in itertools.takewhile(lambda time_ms: not flying(time_ms), times_ms))
    lat, lon, _ = homes[max(before - 1, 0)][1]
    origins = _told_places(log, autopilot, ORIGIN) if path.is_local else []
    if origins:
        _, (origin_lat, origin_lon, _) = origins[0]
        return to_local(origin_lat, origin_lon, lat, lon)
    if path.anchor is None:
        return None
    north, east = to_local(path.anchor.lat_deg, path.anchor.lon_deg, lat, lon)
    return round(path.anchor.north_m + north, 2) + 0.0, round(path.anchor.east_m + east, 2) + 0.0


def _is_place(lat_e7: int, lon_e7: int) -> bool:
    """True for a valid latitude and longitude; (0, 0) is sent without a fix."""
    return abs(lat_e7) <= 900_000_000 and abs(lon_e7) <= 1_800_000_000 and (lat_e7, lon_e7) != (0, 0)


def _offsets(local: Track, around: Track) -> dict[int, Floats]:
    """Return the local frame's origin in the other track's frame, by number of restarts.

    It is taken from fixes at equal times.
    """
    offsets = {}
    for boot, fixes in local.of_boots():
        chosen = fixes[:: max(1, len(fixes) // SAMPLED)].tolist()
        pairs = [(around.at(float(local.times_ms[fix])), local.places[fix]) for fix in chosen]
        if differences := [np.array(place) - own for place, own in pairs if place is not None]:
            offsets[boot] = np.asarray(np.median(differences, axis=0))
    return offsets


# ---- reported states ----


class Reported:
    """A reported state over time: values and the times of their messages, in order."""

    def __init__(self, clock: VehicleClock, said: Sequence[tuple[int, float | tuple[float, ...]]]) -> None:
        """Take each value with its record."""
        self.times_ms = clock.logged_ms(np.array([index for index, _ in said], np.int64))
        self.values = np.array([value for _, value in said], np.float64)

    def last(self, time_ms: float) -> int:
        """Return the index of the latest value at a time; before the first value, that of the first."""
        return max(int(np.searchsorted(self.times_ms, time_ms, side="right")) - 1, 0)


def flying(log: FlightLog, autopilot: Autopilot, clock: VehicleClock) -> Callable[[float], bool]:
    """Return a function that tells if the vehicle was in the air at a time (ms).

    In the air means armed (HEARTBEAT, 0) and not on the ground (EXTENDED_SYS_STATE, 245). A state that was
    never reported is ignored.
    """
    landed = mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE
    said: dict[str, list[tuple[int, float]]] = {"disarmed": [], "on the ground": []}
    for index, m in log.messages(log.select(autopilot.system, (HEARTBEAT, landed), autopilot.component)):
        if m.get_msgId() == HEARTBEAT:
            said["disarmed"].append((index, bool(m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)))
        elif m.landed_state != mavlink.MAV_LANDED_STATE_UNDEFINED:
            said["on the ground"].append((index, m.landed_state != mavlink.MAV_LANDED_STATE_ON_GROUND))
    states = {word: Reported(clock, each) for word, each in said.items() if any(aloft for _, aloft in each)}
    note = "the log never reports armed or airborne, so all samples are used"
    if states:
        note = f"samples taken while {' or '.join(states)} are not used"
    log.notes.append(f"in the air: {note}")
    return lambda time_ms: all(bool(state.values[state.last(time_ms)]) for state in states.values())
