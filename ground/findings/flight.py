"""A flight as its record tells it: readings, the last belief, the track, and what was said meanwhile."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from link.bus.frames import frames_in, messages_in
from link.bus.keys import BELIEF, MAVLINK_OUT, READING, row_name, vehicle_of
from link.bus.mavlink import Reading, unpack_reading
from link.bus.messages import Belief, Particles, by_number, unpack_particles
from link.record.reader import RecordError, Recording, read
from link.record.record import Entry
from plume.geodesy import to_global
from scene.follow.described import Outlines
from scene.follow.history import (
    History,
    histories_of,
    history_of,
    on_one_clock,
    remark_on,
    vehicles_of,
)
from scene.scene import ERROR, WARNING, Point

Home = tuple[float, float]  # latitude and longitude, degrees, WGS84
NS = 1_000_000_000
OF_A_VEHICLE = ("uav", "search", "payload")  # who speaks for one vehicle, not for the search of several


class FlownReading(NamedTuple):
    """One reading that the estimator took, and the spread of its belief after it."""

    step: int
    utc_ns: int  # when it was published, ns since the Unix epoch
    time_s: float  # simulation time
    place: Point
    altitude_m: float  # above home
    gas: float  # in the sensor's unit
    wind: tuple[float, float]  # as measured: (east, north) m/s, points to where it comes from
    spread_m: float
    vehicle: int = 1  # whose it is


class Remark(NamedTuple):
    """Something that was said during the mission and that a reader of its findings should know."""

    utc_ns: int
    who: str
    text: str


class Flight(NamedTuple):
    """What a record tells of its last mission."""

    path: Path
    sha256: str
    about: dict[str, Any]  # the run's own description
    home: Home | None  # None: nobody said where it is
    home_by: str  # who said so, in words
    samples: list[FlownReading]
    last: Belief
    particles: Particles | None  # of the last belief; None if the record has none
    tracks: dict[int, NDArray[np.float32]]  # of each vehicle, by its number, of one alone 1: (K, 2) m
    walls: Outlines  # buildings and polygons to keep out of
    fence: tuple[Point, ...]  # the polygon that no way leaves; empty: the area's edge
    warnings: list[Remark]
    estimator_warned: list[Remark]  # those of the estimator: of stops that would not be honest
    remark: str  # what the record itself lacks, after its name; empty if it is whole
    is_damaged: bool  # pieces of the record are missing

    @property
    def read_text(self) -> str:
        """How often was read, in words."""
        taken = Counter(sample.vehicle for sample in self.samples)
        if len(taken) == 1:
            return f"{self.last.step + 1} reading{'s' * (self.last.step > 0)}"
        if len({*taken.values()}) == 1:
            count = taken[min(taken)]
            return f"{count} reading{'s' * (count > 1)} of each of {len(taken)} vehicles"
        return f"{taken.total()} readings of {len(taken)} vehicles"

    @property
    def is_flat(self) -> bool:
        """Whether one value was read at all places: that is no plume."""
        return len({sample.gas for sample in self.samples}) == 1

    @property
    def began_ns(self) -> int:
        """When the first reading was published, ns since the Unix epoch."""
        return self.samples[0].utc_ns

    @property
    def ended_ns(self) -> int:
        """When the last reading was published, ns since the Unix epoch."""
        return self.samples[-1].utc_ns


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def flight_of(path: Path) -> Flight:
    """Return what a record tells. Raises RecordError, also if it has no belief that can be read."""
    recording = read(path)
    flight = gathered(recording, path)
    if flight is None:
        why = f"it {recording.shortcoming}" if recording.shortcoming else "there was no search"
        raise RecordError(f"{path} has no belief that can be read: {why}")
    return flight


def home_of(recording: Recording) -> tuple[Home | None, str]:
    """Return where home is by a record, and who says so."""
    return _home(history_of(recording), recording.about)


def gathered(recording: Recording, path: Path, *, replayed_at: Home | None = None) -> Flight | None:
    """Return the last mission of what was recorded; None if there is no belief that can be read.

    replayed_at: home, where the record is of another vehicle's log, whose own frame is another.
    path: the file of the record, or of the log.
    """
    beliefs = _beliefs(recording.entries)
    if not beliefs:
        return None
    histories = histories_of(recording)
    history, numbers = histories[0], vehicles_of(recording)
    readings = _readings(recording.entries)
    # Of a log that was replayed, when its vehicle started; the record has the times of the replay.
    started_ns = _started_ns(recording.entries) if "log" in recording.about else None
    samples = [
        _sample(
            *(own, entry, vehicle, readings.get((vehicle if said.readings else 0, own.time_boot_ms))),
            started_ns,
        )
        for said, entry in beliefs
        for vehicle, own in by_number(said).items()
    ]
    last, entry = beliefs[-1]
    try:
        particles = unpack_particles(entry.attachment, len(last.unknowns)) if entry.attachment else None
    except ValueError:
        particles = None
    home, home_by = _home(history, recording.about)
    if replayed_at:
        home, home_by = replayed_at, "the log"
    clock, first = _Clock(on_one_clock(recording)), samples[0]

    def said_ns(time_s: float) -> int:
        return (
            clock.utc_ns(time_s) if started_ns is None else first.utc_ns + round(NS * (time_s - first.time_s))
        )

    said = (
        Remark(
            said_ns(it.time_s),
            f"{it.who}/{number}" if number and it.who in OF_A_VEHICLE else it.who,
            it.text,
        )
        for number, each in zip(numbers or [0], histories, strict=True)
        for it in each.at().happenings
        if it.level in (WARNING, ERROR)
    )
    one_a_second = {(it.utc_ns // NS, it.who, it.text): it for it in said}.values()
    warnings = sorted(one_a_second, key=lambda it: it.utc_ns)
    return Flight(
        path=path,
        sha256=sha256_of(path),
        about=recording.about,
        home=home,
        home_by=home_by,
        samples=samples,
        last=last,
        particles=particles,
        # The vehicle's own frame begins elsewhere than the area of a log.
        tracks={1: np.array([it.place for it in samples], np.float32)}
        if replayed_at
        else {number: each.at().track for number, each in zip(numbers or [1], histories, strict=True)},
        walls=history.backdrop.walls,
        fence=history.backdrop.fence,
        warnings=warnings,
        estimator_warned=[it for it in warnings if it.who == "estimator"],
        remark=remark_on(recording, history),
        is_damaged=bool(recording.damage),
    )


def _beliefs(entries: Iterable[Entry]) -> list[tuple[Belief, Entry]]:
    """Return the beliefs of the last mission in the order of their steps, each with its message.

    A first belief of another reading begins a mission; a restarted estimator says the same ones again.
    """
    found: dict[int, tuple[Belief, Entry]] = {}
    for entry in sorted(entries, key=lambda entry: entry.published_ns):
        if entry.key != BELIEF.name:
            continue
        with suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            said = msgspec.json.decode(entry.payload, type=Belief)
            if said.step == 0 and 0 in found and found[0][0].time_boot_ms != said.time_boot_ms:
                found = {}
            if said.step not in found or not found[said.step][1].attachment:
                found[said.step] = said, entry
    return [found[step] for step in sorted(found)]


def _readings(entries: Iterable[Entry]) -> dict[tuple[int, int], tuple[Reading, Entry]]:
    """Return the readings by the number of their vehicle, 0 of one alone, and their time_boot_ms.

    Of one that was sent again it is the first.
    """
    found: dict[tuple[int, int], tuple[Reading, Entry]] = {}
    for entry in entries:
        if row_name(entry.key) == READING.name:
            with suppress(ValueError):  # BadFrame among them
                said = unpack_reading(entry.payload)
                found.setdefault((int(vehicle_of(entry.key) or 0), said.time_boot_ms), (said, entry))
    return found


def _started_ns(entries: Iterable[Entry]) -> int | None:
    """Return when a vehicle started, ns since the Unix epoch, by its SYSTEM_TIME; None if it does not say."""
    for entry in entries:
        if row_name(entry.key) == MAVLINK_OUT.name:
            said = messages_in(frames_in(entry.payload)).get("SYSTEM_TIME", {})
            if unix_us := said.get("time_unix_usec"):
                return int(1000 * unix_us - 1_000_000 * said["time_boot_ms"])
    return None


def _sample(
    said: Belief,
    entry: Entry,
    vehicle: int,
    reading: tuple[Reading, Entry] | None,
    started_ns: int | None,
) -> FlownReading:
    """Return the reading that a belief answers; one that the record lacks is as the belief says."""
    wind = reading[0].wind if reading else said.wind
    at = reading[1] if reading else entry
    return FlownReading(
        said.step,
        at.published_ns if started_ns is None else started_ns + 1_000_000 * said.time_boot_ms,
        entry.simulation_s,
        said.position,
        said.altitude_m,
        said.gas,
        wind,
        said.spread,
        vehicle,
    )


def _home(history: History, about: dict[str, Any]) -> tuple[Home | None, str]:
    """Return where home is, and who says so."""
    if (fix := history.home) is not None and any(fix[:2]):
        return fix[:2], "the vehicle's HOME_POSITION"
    craft = history.craft
    if craft and craft.fix and craft.position[0] == craft.position[0]:
        (east, north), (lat, lon, _) = craft.position, craft.fix
        return to_global(lat, lon, -north, -east), "the vehicle's last position"
    mission = about.get("mission")
    vehicle = mission.get("vehicle") if isinstance(mission, dict) else None
    if isinstance(vehicle, dict) and "vehicle" not in about:
        match vehicle.get("home_lat_deg"), vehicle.get("home_lon_deg"):
            case (float(lat_deg), float(lon_deg)) if abs(lat_deg) <= 90 and abs(lon_deg) <= 180:
                return (lat_deg, lon_deg), "the mission's own description"
    return None, "nobody"


class _Clock:
    """From simulation time to the clock, by the messages of a record."""

    def __init__(self, entries: Sequence[Entry]) -> None:
        times_s = np.array([entry.simulation_s for entry in entries])
        order = np.argsort(times_s, kind="stable")
        self._times_s = times_s[order]
        self._walls_ns = np.array([entry.published_ns for entry in entries])[order]

    def utc_ns(self, time_s: float) -> int:
        """Return when something of a simulation time was said, ns since the Unix epoch."""
        at = min(int(np.searchsorted(self._times_s, time_s)), len(self._times_s) - 1)
        return int(self._walls_ns[at])
