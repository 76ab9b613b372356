"""What is done before a real vehicle is armed: one list is told, once.

What is missing is waited for, but not for ever.
"""

import math
from collections.abc import Collection

from pymavlink.dialects.v20 import all as mavlink

from aircraft.remote.commander import Steps
from aircraft.remote.procedures import ENDED, Procedures
from aircraft.remote.safety import ASKED, Check, Verdict, checks
from aircraft.state import LOW_BATTERY, AircraftConfig, VehicleFailed
from aircraft.together import Place
from link.bus.keys import OF_VEHICLE
from plume.problem import Area

READY_S = 3.0  # the battery, and whether it would arm, are waited for this long once its place is known
REFUSED_S = 10.0  # a refusal to arm comes with warnings, which are told for this long
SYS_STATUS = mavlink.MAVLINK_MSG_ID_SYS_STATUS
STILL_READING = "its parameters are being read"
WAITING = "Waiting for the autopilot: "
# What is waited for of the payload: its first answer, and one with a value
UNANSWERED = Check("wind", Verdict.FORBIDS, "the payload has not answered yet whether it measures the wind")
NO_VALUE = Check("gas", Verdict.FORBIDS, "the payload's sensor has no value")


def farthest_m(area: Area, home: Place = (0.0, 0.0)) -> float:
    """Return how far from home, (x, y) m, a vehicle flies in an area."""
    corners = ((x, y) for x in (area.low[0], area.high[0]) for y in (area.low[1], area.high[1]))
    return max(math.dist(home, corner) for corner in corners)


def lies(area: Area) -> str:
    """Say where an area lies."""
    width_m, height_m = area.size_m
    if area.low == (0.0, 0.0):
        return f"of {width_m:g} m x {height_m:g} m lies north and east"
    return f"{area.text} lies so far east and north"


class Preflight:
    """The list before arming, and the wait for its start. Times in s of the vehicle's clock."""

    def __init__(
        self,
        flight: Procedures,
        config: AircraftConfig,
        wait_s: float = math.inf,
        *,
        launched: bool = False,
    ) -> None:
        """Take the vehicle and what is flown.

        wait_s: real time in which the search has to begin; launched: whether a launcher starts the
        services, and waits for them itself.
        """
        self.has_read = False  # whether the vehicle has been found and its parameters have been read
        self._flight, self._known, self._config = flight, flight.known, config
        self._wait_s, self._launched = wait_s, launched
        self._since_s = 0.0
        self._steps = self._read()
        self._wind: Check | None = None
        self.payload_lacks = UNANSWERED  # while the wind is not known
        self._known_all = self._told = False

    @property
    def missing(self) -> str:
        """What the vehicle needs before it can be armed, and how to get it; empty if nothing."""
        flight, known = self._flight, self._known
        commander = flight.commander
        if not commander.system or known.lost(flight.now_s):
            wanted = f" of system {commander.wanted}" if commander.wanted else ""
            return f"no HEARTBEAT{wanted} {commander.radio.state}".rstrip()
        if missing := known.missing(flight.now_s):
            return missing
        if not self._known_all:
            return STILL_READING
        if (battery := self._battery).verdict is Verdict.FORBIDS:
            return f"battery: {battery.text}"
        return self._pilot

    @property
    def unready(self) -> str:
        """What is missing before it could be armed, the wind of its readings too; empty if nothing."""
        return self.missing or ("" if self._wind else self.payload_lacks.text)

    def look(self) -> None:
        """Go on reading what the list needs."""
        if self._flight.commander.system and not self._known_all:
            self._known_all = next(self._steps, ENDED) is ENDED

    def take_wind(self, check: Check) -> None:
        """Take where the wind of the readings comes from.

        Before that, and without any, there is no flight.
        """
        self._wind = check
        if check.verdict is Verdict.FORBIDS:
            self._tell()

    def ask(self) -> str:
        """Return what is missing before arming, `missing` or the wind.

        Once all of the list is known, it is told first.
        """
        if not self._known_all or self._told:
            return self.unready
        if self._wind:
            self._tell()
            return STILL_READING
        return self.payload_lacks.text

    def _read(self) -> Steps[None]:
        commander, known = self._flight.commander, self._known
        yield from commander.read_parameters(ASKED[known.firmware.name])
        self.has_read = True
        yield from commander.until(lambda: not known.unplaced(commander.now_s), math.inf)
        yield from commander.until(
            lambda: SYS_STATUS in known.came_s and not known.unready, commander.patient(READY_S)
        )

    def bound(self, waits_for: str, absent: Collection[str]) -> None:
        """Call it while the search has not begun. waits_for: why not, if all services are there; absent:
        the services that are not.

        Raises VehicleFailed once that has taken too long, and without any wind; the list comes before it.
        """
        if self._wind and self._wind.verdict is Verdict.FORBIDS:
            raise VehicleFailed(self._wind.text)
        why = [waits_for.removeprefix(WAITING)]
        if absent:
            others = sorted(each for each in absent if each.startswith(OF_VEHICLE))
            services = ", ".join(sorted({*absent} - {*others}))
            services = f"no {services}: the first lines of this log say how to start it" if services else ""
            others_wait = f"{', '.join(others)} not ready to take off" if others else ""
            why = [self.missing, "" if self._launched else services, others_wait]
        elif self._flight.arming:
            why.append(self._known.warned(self._flight.now_s - REFUSED_S))
        elif self._known.armed:
            why.append("the search begins when the vehicle stands disarmed")
        if not any(why):
            self._since_s = self._flight.now_s
        elif self._flight.now_s - self._since_s >= self._wait_s * self._flight.commander.speedup:
            if self._told:
                raise VehicleFailed(
                    f"the search has not begun in {self._wait_s:g} s (--wait): {'; '.join(filter(None, why))}"
                )
            self._tell()

    # ---- the list ----

    def _tell(self) -> None:
        lines, self._told = [] if self._told else self._checks(), True
        for line in lines:
            ok = line.verdict is Verdict.OK
            self._flight.say(mavlink.MAV_SEVERITY_INFO if ok else mavlink.MAV_SEVERITY_WARNING, str(line))

    def _checks(self) -> list[Check]:
        known, config, system = self._known, self._config, self._flight.commander.system
        if not system:
            return [Check("vehicle", Verdict.FORBIDS, self.missing)]
        found = f"{known.firmware.name}, system {system}, in {known.mode_name}"
        place = Check("position and home", Verdict.FORBIDS, known.unplaced(self._flight.now_s))
        if known.home and not place.text:
            (north, east, _), (lat, lon, _) = known.to_home(), known.home
            of_home, from_there = "home, ", ""
            if known.area_origin:
                lat, lon = known.area_origin
                of_home, (x, y) = "", known.home_place
                from_there = f" (--home); the vehicle's own home is ({x:.2f}, {y:.2f}) m east, north of there"
            where = (
                f"the area {lies(config.area)} of {of_home}{lat:.7f}, {lon:.7f}{from_there}; "
                f"home is ({north:.2f}, {east:.2f}) m north, east of the EKF's origin"
            )
            place = Check("position and home", Verdict.OK, where)
        lines = [Check("vehicle", Verdict.OK, found), place, self._battery]
        for about, why in (("arming", known.unready), ("pilot", self._pilot)):
            lines += [Check(about, Verdict.FORBIDS, why)] * bool(why)
        lines.append(self._wind or self.payload_lacks)
        return lines + checks(
            known.firmware,
            known.parameters,
            system,
            farthest_m(config.area, known.home_place if known.home and known.origin else (0.0, 0.0)),
            config.takeoff_altitude_m,
        )

    @property
    def _pilot(self) -> str:
        """Whose choice of mode on the ground is waited for; empty if nobody's."""
        known, start = self._known, self._known.firmware.modes[self._flight.start]
        if not self._flight.taken_over or known.custom_mode == start:
            return ""
        return (
            f"a pilot has chosen {known.mode_name}; {known.firmware.mode_name(start)} gives the vehicle to "
            "the search"
        )

    @property
    def _battery(self) -> Check:
        left, low = self._known.battery, f"is below {LOW_BATTERY:.0%}: charge or change it"
        if math.isnan(left):
            return Check("battery", Verdict.WARNS, "not known: the autopilot does not say how much is left")
        if left < LOW_BATTERY:
            return Check("battery", Verdict.FORBIDS, f"{left:.0%} {low}")
        return Check("battery", Verdict.OK, f"{left:.0%}")
