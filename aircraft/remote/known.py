"""What is known of a real vehicle: the newest of what it has said, and whether that is enough to fly."""

import math
import re
import struct
from collections import deque
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import all as mavlink

from aircraft.firmware import ARDUCOPTER, FIRMWARES, POSITION_GOOD, Firmware, stands
from aircraft.remote.glitches import Fix, Glitches
from aircraft.state import ZERO, Ned, as_float32
from aircraft.together import Berth
from link.bus.mavlink import Message, Texts, continued
from link.modes import Mode
from plume.geodesy import home_from, to_local
from plume.problem import AREA, Area

LOST_S = 3.0  # time without a HEARTBEAT after which the link counts as lost; it comes once a second
STALE_S = 1.0  # time after which a position is too old to act on
NEW_BOOT_MS = 2000  # a clock that goes back by more than this has begun anew
# What an autopilot's text on a geofence says.
BREACH = re.compile("breach|geofence|fence violation", re.IGNORECASE)
# What a text on a breach that is over says.
BREACH_OVER = re.compile("clear|recover|deactivated", re.IGNORECASE)
INTEGERS = {
    mavlink.MAV_PARAM_TYPE_UINT8,
    mavlink.MAV_PARAM_TYPE_INT8,
    mavlink.MAV_PARAM_TYPE_UINT16,
    mavlink.MAV_PARAM_TYPE_INT16,
    mavlink.MAV_PARAM_TYPE_UINT32,
    mavlink.MAV_PARAM_TYPE_INT32,
}
Global = tuple[float, float, float]  # latitude and longitude in degrees, altitude above sea in m


@dataclass
class Known:
    """The newest of what one vehicle has said.

    Times are the caller's, s; positions NED, m from the EKF's origin.

    `slowest_s`: shortest time after which anything may count as missing; a vehicle whose simulator runs
    fast needs it.
    """

    slowest_s: float = 0.0
    firmware: Firmware = ARDUCOPTER
    custom_mode: int = 0
    armed: bool = False
    status: int = mavlink.MAV_STATE_UNINIT
    heard_s: float = -math.inf  # when the last HEARTBEAT came
    critical_s: float = -math.inf  # when its status last rose to critical, or above
    position: Ned = ZERO
    velocity: Ned = ZERO
    position_s: float = -math.inf
    position_ms: int = 0  # the autopilot's clock at the position
    glitches: Glitches = field(default_factory=Glitches)  # whether that position can be trusted
    flags: int = 0  # ESTIMATOR_STATUS_FLAGS, or EKF_STATUS_FLAGS, whose first bits mean the same
    origin: Global | None = None
    home: Global | None = None
    target: Ned | None = None  # the position that it says it flies to
    landed: int = mavlink.MAV_LANDED_STATE_UNDEFINED
    healthy: bool = True  # False while SYS_STATUS says that a check before arming fails
    battery: float = math.nan  # 0 to 1; NaN where the autopilot does not know
    # (u cos φ, u sin φ) m/s, x east, y north, to where the wind comes from; None where the autopilot does not
    # tell.
    wind: tuple[float, float] | None = None
    wind_s: float = -math.inf  # when it last told of a wind, or that it does not know it
    breach_s: float = -math.inf  # when it last said that the geofence is breached
    breached_s: float = -math.inf  # when a breach last began, or a text last said so
    # STATUSTEXTs since they were last taken: severity and text.
    texts: list[tuple[int, str]] = field(default_factory=list)
    # The latest texts that warn, with their times.
    warnings: deque[tuple[float, str]] = field(default_factory=lambda: deque(maxlen=20))
    parameters: dict[str, float] = field(default_factory=dict)
    boot_ms: int = 0  # the autopilot's clock when it last told its position or attitude
    boots: int = 0  # how often that clock has begun anew
    came_s: dict[int, float] = field(default_factory=dict)  # when each message type last came, by number
    # Its place among several that search together, and their area; None: it searches alone.
    berth: Berth | None = None
    area: Area = AREA
    # Where home is meant to be, latitude and longitude in degrees, and how far from there it may be, m.
    home_meant: tuple[float, float] | None = None
    home_within_m: float = math.inf
    _texts: Texts = field(default_factory=Texts)
    _breach: tuple[int, int] = (0, 0)  # whether the fence is breached, and how often it was
    _corner: Ned = ZERO  # the search area's origin; known once home and the EKF's origin are

    def take(self, message: Message, now_s: float) -> None:
        """Take a message of this vehicle's autopilot."""
        self.came_s[message.get_msgId()] = now_s
        match message.get_type():
            case "HEARTBEAT":
                self.firmware = FIRMWARES[message.autopilot]
                if message.system_status >= max(self.status + 1, mavlink.MAV_STATE_CRITICAL):
                    self.critical_s = now_s
                self.custom_mode, self.status = message.custom_mode, message.system_status
                self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
                self.heard_s = now_s
            case "LOCAL_POSITION_NED":
                boot_ms = self._tick(message.time_boot_ms)
                position, velocity = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
                self.glitches.flies(self.flying)
                finite = all(map(math.isfinite, (*position, *velocity)))  # a lost EKF sends NaN
                if finite and self.glitches.moved(Fix(boot_ms, position, velocity), now_s):
                    self.position, self.velocity, self.position_s = position, velocity, now_s
                    self.position_ms = boot_ms
            case "ATTITUDE":
                self._tick(message.time_boot_ms)
            case "GPS_GLOBAL_ORIGIN":
                self.origin = message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1000.0
            case "HOME_POSITION":
                self.home = message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1000.0
            case "EKF_STATUS_REPORT" | "ESTIMATOR_STATUS":
                self.flags = message.flags
                self.glitches.judge(message, self.firmware.is_ardupilot, now_s)
            case "SYS_STATUS":
                left, check = message.battery_remaining, mavlink.MAV_SYS_STATUS_PREARM_CHECK
                self.battery = left / 100.0 if 0 <= left <= 100 else math.nan
                checked = message.onboard_control_sensors_present & check
                self.healthy = not checked & ~message.onboard_control_sensors_health
            case "EXTENDED_SYS_STATE":
                self.landed = message.landed_state
            case "WIND_COV":
                self._blows(message.wind_x, message.wind_y, now_s)
            case "WIND":  # ArduPilot's: from where it comes, degrees clockwise from north
                angle = math.radians(message.direction)
                self._blows(-message.speed * math.cos(angle), -message.speed * math.sin(angle), now_s)
            case "POSITION_TARGET_LOCAL_NED":
                place = message.x, message.y, message.z
                self.target = None if message.type_mask & 7 or not all(map(math.isfinite, place)) else place
            case "FENCE_STATUS":
                before, self._breach = self._breach, (message.breach_status, message.breach_count)
                if message.breach_status:
                    self.breach_s = now_s
                    self.breached_s = self.breached_s if self._breach == before else now_s
            case "PARAM_VALUE":
                self.parameters[message.param_id.rstrip("\0")] = self._value(message)
            case "STATUSTEXT":
                self._hear(message, now_s)

    def _tick(self, time_boot_ms: int) -> int:
        """Take the autopilot's clock; returns it as a time that goes on where time_boot_ms wraps, ms."""
        boot_ms = continued(self.boot_ms, time_boot_ms)
        if boot_ms < self.boot_ms - NEW_BOOT_MS:  # it has started again, and knows nothing of what it knew
            self.boot_ms = 0
            self.boots += 1
            self.origin = self.home = None
            self.flags = 0
            self.glitches.starts_again()
        self.boot_ms = max(self.boot_ms, boot_ms)
        return boot_ms

    def _value(self, message: Message) -> float:
        """The value of a PARAM_VALUE: PX4 sends the bytes of an integer where ArduPilot sends its value."""
        if self.firmware.is_ardupilot or message.param_type not in INTEGERS:
            if not math.isfinite(message.param_value):
                raise ValueError(f"{message.param_id} is {message.param_value}")
            return float(message.param_value)
        return float(struct.unpack("<i", struct.pack("<f", message.param_value))[0])

    def _blows(self, north: float, east: float, now_s: float) -> None:
        """Take the velocity of the air.

        A wind of exactly zero is one that the autopilot has not estimated.
        """
        known = math.isfinite(north) and math.isfinite(east) and (north or east)
        self.wind, self.wind_s = (-east, -north) if known else None, now_s

    def _hear(self, message: Message, now_s: float) -> None:
        text = self._texts.joined(message.text.rstrip("\0"), message.id, message.chunk_seq)
        if text is None:
            return
        self.glitches.hear(text, now_s)
        if BREACH.search(text) and not BREACH_OVER.search(text):
            self.breach_s = self.breached_s = now_s
        if message.severity <= mavlink.MAV_SEVERITY_NOTICE:
            self.warnings.append((now_s, text))
        self.texts.append((message.severity, text))

    def warned(self, since_s: float) -> str:
        """Return the warnings since a time, each once."""
        return "; ".join(dict.fromkeys(text for at_s, text in self.warnings if at_s >= since_s))

    def lost(self, now_s: float) -> bool:
        """True if the vehicle has not been heard for `LOST_S`."""
        return now_s - self.heard_s > max(LOST_S, self.slowest_s)

    @property
    def stale_s(self) -> float:
        """Time after which what comes several times a second is too old to act on."""
        return max(STALE_S, self.slowest_s)

    def knows_place(self, now_s: float) -> bool:
        """True if the position is fresh and the EKF stands by it.

        After a loss of GPS positions keep coming, but the flag goes.
        """
        return now_s - self.position_s <= self.stale_s and bool(self.flags & POSITION_GOOD)

    def trusts_place(self, now_s: float) -> bool:
        """True if the position is known and nothing speaks against it: a reading may be taken."""
        return self.knows_place(now_s) and not self.glitches.lasts(now_s)

    def missing(self, now_s: float) -> str:
        """Return what is still missing to fly by setpoints.

        Empty if nothing is. Arming may be accepted long before that.
        """
        return self.unplaced(now_s) or self.unready

    def unplaced(self, now_s: float) -> str:
        """Return what is missing to know where it and the area are, and how to get it.

        Empty if nothing is.
        """
        asked = "though it is asked for (MAV_CMD_REQUEST_MESSAGE):"
        if self.lost(now_s):
            return "no HEARTBEAT"
        if not self.trusts_place(now_s):
            return (
                "no position yet: its EKF has not settled, which takes ArduCopter 41 s; is GPS outside, "
                "with a fix?"
            )
        if self.origin is None:
            return f"no GPS_GLOBAL_ORIGIN, {asked} without it the area has no place"
        if self.home is None:
            return f"no HOME_POSITION, {asked} set home from a ground station"
        return self.misplaced

    @property
    def misplaced(self) -> str:
        """Why its home is not where the area was drawn for; empty if it is, or is not known."""
        if self.home is None or self.origin is None:
            return ""
        if self.berth:
            return self.berth.misplaced(self.home_place, self.area)
        if self.home_meant is None:
            return ""
        (lat, lon, _), (meant_lat, meant_lon) = self.home, self.home_meant
        north, east = to_local(meant_lat, meant_lon, lat, lon)
        away_m = math.sqrt(north * north + east * east)
        if away_m <= self.home_within_m:
            return ""
        return (
            f"home, {lat:.7f}, {lon:.7f}, is {away_m:.1f} m from the problem's, {meant_lat:.7f}, "
            f"{meant_lon:.7f}: its area would lie elsewhere by as much; wanted within "
            f"{self.home_within_m:g} m"
        )

    @property
    def unready(self) -> str:
        """Why it would not arm.

        Empty if it would. ArduPilot's check depends on the mode, and says why when it is armed.
        """
        if self.firmware.is_ardupilot or self.healthy:
            return ""
        return "a check before arming fails: the autopilot's texts, or a ground station, say which"

    # ---- where the search area is ----

    def place_area(self) -> None:
        """Place the area at home or at its own origin, at home's height, once home is known."""
        if self.origin is not None and self.home is not None:
            self._corner = self.to_area()

    @property
    def _area_at(self) -> Ned:
        """The area's corner.

        When the position jumps, it moves as well: the vehicle, and the area, have stayed.
        """
        north, east, down = self._corner
        return north + self.glitches.shift[0], east + self.glitches.shift[1], down

    @property
    def place(self) -> Ned:
        """Where it says it is, m from the area's corner, as float32."""
        north, east, down = (at - corner for at, corner in zip(self.position, self._area_at, strict=True))
        return as_float32((north, east, down))

    def in_ekf_frame(self, place: Ned) -> Ned:
        """Return where a place in the area is, m from the EKF's origin."""
        north, east, down = (at + corner for at, corner in zip(place, self._area_at, strict=True))
        return north, east, down

    def to_home(self) -> Ned:
        """Return where home is in the EKF's frame. Raises ValueError before both are known."""
        if self.origin is None or self.home is None:
            raise ValueError("origin and home are not known yet")
        return home_from(self.origin, self.home)

    @property
    def area_origin(self) -> tuple[float, float] | None:
        """The area's origin, latitude and longitude in degrees; None: it is home."""
        return self.berth.origin if self.berth else None

    def to_area(self) -> Ned:
        """Return where the area's origin is in the EKF's frame. Raises ValueError as `to_home` does."""
        home = self.to_home()
        if self.origin is None or self.area_origin is None:
            return home
        north, east, _ = home_from(self.origin, (*self.area_origin, self.origin[2]))
        return north, east, home[2]

    @property
    def home_place(self) -> tuple[float, float]:
        """Where home is in the area's frame, (x, y) m. Raises ValueError as `to_home` does."""
        (north, east, _), (area_north, area_east, _) = self.to_home(), self.to_area()
        return east - area_east, north - area_north

    @property
    def on_ground(self) -> bool:
        """Whether it stands on the ground, as far as it says."""
        return stands(self.landed, self.status)

    @property
    def flying(self) -> bool:
        """Whether it is armed and in the air."""
        return self.armed and not self.on_ground

    @property
    def reported(self) -> Mode | None:
        """The mode of the search that it is in; None for one that only pilots fly."""
        return self.firmware.reports.get(self.custom_mode)

    @property
    def mode_name(self) -> str:
        """The autopilot's name of the mode that it is in."""
        return self.firmware.mode_name(self.custom_mode)
