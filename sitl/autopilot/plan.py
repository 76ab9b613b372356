"""Missions: their items as MAVLink carries them, the steps that they mean, and which one is flown next."""

import math
import struct
from collections import Counter
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import Ned, metres
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.fence import Circle, Fence, NorthEast, Polygon
from sitl.autopilot.motion import Limits

NOT_GIVEN = 0x7FFFFFFF  # latitude or longitude of an item that has none
MOST_AT_ONCE = 2000  # items without duration that may follow each other: a mission that only jumps ends
MOST_JUMPS = 1000
FASTEST_MPS = 20.0  # highest speed that DO_CHANGE_SPEED may set, that of MPC_XY_CRUISE

ABOVE_SEA = {mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT}
ABOVE_HOME = {mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT}
MISSION_FRAMES = ABOVE_SEA | ABOVE_HOME | {mavlink.MAV_FRAME_MISSION}

TAKEOFF, LAND = mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_CMD_NAV_LAND
WAYPOINT, RETURN = mavlink.MAV_CMD_NAV_WAYPOINT, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH
LOITER, LOITER_TIME = mavlink.MAV_CMD_NAV_LOITER_UNLIM, mavlink.MAV_CMD_NAV_LOITER_TIME
DELAY, SPEED, JUMP = mavlink.MAV_CMD_NAV_DELAY, mavlink.MAV_CMD_DO_CHANGE_SPEED, mavlink.MAV_CMD_DO_JUMP
# The items of a mission that are carried out, and how.
FLOWN = {
    TAKEOFF: "climbs straight up, then flies to its position if it has one",
    WAYPOINT: "flies there, turns to its yaw, waits the hold time; acceptance and pass radius are ignored: "
    "it comes to rest",
    LOITER: "flies there and stays",
    LOITER_TIME: "flies there and stays the time of param 1",
    DELAY: "stays for the seconds of param 1",
    LAND: "flies above the place, then lands; without a position on the spot",
    RETURN: "RETURN, which ends the mission",
    SPEED: f"sets the horizontal speed of the items that follow, up to {FASTEST_MPS:g} m/s; -1 keeps it, -2 "
    "restores it",
    JUMP: f"goes on with item param 1, param 2 times, at most {MOST_JUMPS}",
}
# Items for a camera or a gimbal, which stations put into plans: taken and passed over, as by a PX4 that has
# neither.
IGNORED = (
    mavlink.MAV_CMD_DO_LAND_START,
    mavlink.MAV_CMD_DO_SET_ROI_LOCATION,
    mavlink.MAV_CMD_DO_SET_ROI_WPNEXT_OFFSET,
    mavlink.MAV_CMD_DO_SET_ROI_NONE,
    mavlink.MAV_CMD_DO_CONTROL_VIDEO,
    mavlink.MAV_CMD_DO_SET_ROI,
    mavlink.MAV_CMD_DO_DIGICAM_CONTROL,
    mavlink.MAV_CMD_DO_MOUNT_CONFIGURE,
    mavlink.MAV_CMD_DO_MOUNT_CONTROL,
    mavlink.MAV_CMD_DO_SET_CAM_TRIGG_DIST,
    mavlink.MAV_CMD_DO_SET_CAM_TRIGG_INTERVAL,
    mavlink.MAV_CMD_SET_CAMERA_MODE,
    mavlink.MAV_CMD_SET_CAMERA_ZOOM,
    mavlink.MAV_CMD_SET_CAMERA_FOCUS,
    mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW,
    mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE,
    mavlink.MAV_CMD_IMAGE_START_CAPTURE,
    mavlink.MAV_CMD_IMAGE_STOP_CAPTURE,
    mavlink.MAV_CMD_DO_TRIGGER_CONTROL,
    mavlink.MAV_CMD_VIDEO_START_CAPTURE,
    mavlink.MAV_CMD_VIDEO_STOP_CAPTURE,
)
PLACED = {TAKEOFF, WAYPOINT, LOITER, LOITER_TIME, LAND}
ANYWHERE = {TAKEOFF, LAND}  # items that may leave out their latitude and longitude
CORNER = {
    mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION: True,
    mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION: False,
}
CIRCLE = {mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION: True, mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION: False}


class BadItem(ValueError):
    """An item or a list that is refused; `code` is its MAV_MISSION_RESULT."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


def bad_param(number: int, text: str) -> BadItem:
    """Return the refusal of an item because of one of its params, 1 to 7."""
    return BadItem(mavlink.MAV_MISSION_INVALID_PARAM1 + number - 1, text)


class Item(NamedTuple):
    """An item of a mission, a fence or rally points, as it was uploaded."""

    command: int
    frame: int
    autocontinue: int
    params: tuple[float, float, float, float]
    x: int  # latitude in 1e-7 degrees, or param 5
    y: int  # longitude in 1e-7 degrees, or param 6
    z: float  # altitude in m, or param 7

    @property
    def packed(self) -> bytes:
        """The bytes that PX4 makes its checksum of."""
        return struct.pack(
            "<BHB4fiif", self.frame, self.command, self.autocontinue, *self.params, self.x, self.y, self.z
        )


class MissionStep(NamedTuple):
    """What an item of a mission means."""

    command: int
    north_east: NorthEast | None = None  # m from home; None: where the vehicle is
    down_m: float = 0.0
    yaw_rad: float | None = None
    wait_s: float = 0.0
    goes_on: bool = True  # false if the vehicle stays once the item is done (autocontinue 0)
    value: float = 0.0  # speed in m/s; or how often to jump
    jumps_to: int = 0


class Leg(NamedTuple):
    """The flight of one step: straight from stop to stop, a turn, a wait."""

    step: MissionStep
    stops: tuple[Ned, ...]
    limits: Limits


class MissionProgress(NamedTuple):
    """How far a mission is: the content of MISSION_CURRENT (42)."""

    seq: int = 0
    total: int = 0
    state: int = mavlink.MISSION_STATE_NO_MISSION
    active: bool = False  # true in mission mode
    number: int = 0  # the checksum of the mission's items; 0 without a mission
    reached: tuple[int, float] | None = None  # the item that was done last, and when, s


# ---- what items mean ----


def step(item: Item, count: int, config: VehicleConfig) -> MissionStep:
    """Return what an item of a mission of `count` items means; raises BadItem."""
    command, (p1, p2, _, p4) = item.command, item.params
    if command not in FLOWN and command not in IGNORED:
        raise BadItem(mavlink.MAV_MISSION_UNSUPPORTED, f"command {command} is not supported")
    if item.frame not in MISSION_FRAMES or (command in PLACED and item.frame == mavlink.MAV_FRAME_MISSION):
        raise BadItem(mavlink.MAV_MISSION_UNSUPPORTED_FRAME, f"frame {item.frame} is not supported")
    goes_on = bool(item.autocontinue)
    match command:
        case mavlink.MAV_CMD_DO_CHANGE_SPEED:
            _check(1, p1, p1 in (0.0, 1.0), "0 or 1, a horizontal speed")
            holds = 0.0 < p2 <= FASTEST_MPS or p2 in (-1.0, -2.0)
            _check(2, p2, holds, f"above 0 to {FASTEST_MPS:g} m/s, -1 or -2")
            return MissionStep(command, value=p2)
        case mavlink.MAV_CMD_DO_JUMP:
            _check(1, p1, p1 in range(count), f"0 to {count - 1}, an item")
            _check(2, p2, p2 in range(MOST_JUMPS + 1), f"0 to {MOST_JUMPS}")
            return MissionStep(command, value=p2, jumps_to=int(p1))
        case mavlink.MAV_CMD_NAV_DELAY:
            _check(1, p1, 0.0 <= p1 < math.inf, "0 s and more; a time of day is not supported")
            return MissionStep(command, wait_s=p1, goes_on=goes_on)
    if command not in PLACED:
        return MissionStep(command, goes_on=goes_on)
    wait_s = math.inf if command == LOITER else 0.0
    if command in (WAYPOINT, LOITER_TIME) and not math.isnan(p1):
        _check(1, p1, 0.0 <= p1 < math.inf, "0 s and more")
        wait_s = p1
    _check(4, p4, not math.isinf(p4), "a yaw in degrees, or NaN")
    down_m = 0.0  # the ground is flat, whatever altitude an item to land gives
    if command != LAND:
        _check(7, item.z, math.isfinite(item.z), "an altitude in m")
        down_m = -(item.z - (config.home_alt_m if item.frame in ABOVE_SEA else 0.0))
    anywhere = command in ANYWHERE and (NOT_GIVEN in (item.x, item.y) or (item.x, item.y) == (0, 0))
    north_east = None if anywhere else place(item, config)
    if outside := config.outside((*(north_east or (0.0, 0.0)), down_m), fence=north_east is not None):
        raise bad_param(7 if outside[0] == "outside the altitudes" else 5, outside[1])
    if command == TAKEOFF and down_m >= 0.0:
        raise bad_param(7, f"take-off to {metres(-down_m)} m, allowed is above 0")
    yaw_rad = None if math.isnan(p4) else math.radians(p4)
    return MissionStep(command, north_east, down_m, yaw_rad, wait_s, goes_on)


def _check(number: int, value: float, holds: bool, allowed: str) -> None:
    if not holds:
        raise bad_param(number, f"param {number} is {value:g}, allowed is {allowed}")


def place(item: Item, config: VehicleConfig) -> NorthEast:
    """Return (north, east) of an item; raises BadItem unless it has a latitude and a longitude."""
    for number, value, limit, name in ((5, item.x, 90, "latitude"), (6, item.y, 180, "longitude")):
        if abs(value) > limit * 10_000_000:
            raise bad_param(number, f"param {number} is no {name}")
    return config.local(item.x / 1e7, item.y / 1e7)


def fence(items: tuple[Item, ...], number: int, config: VehicleConfig) -> Fence:
    """Return the fence that items make; raises BadItem.

    The vertices of a polygon follow each other, each with their count.
    """
    shapes: list[Circle | Polygon] = []
    at = 0
    while at < len(items):
        item = items[at]
        size = int(item.params[0]) if item.command in CORNER else 1
        group = items[at : at + size]
        if len(group) < size or any(
            (other.command, other.params[0]) != (item.command, item.params[0]) for other in group
        ):
            raise BadItem(
                mavlink.MAV_MISSION_INVALID_PARAM1,
                f"Fence refused: item {at}: a polygon of {size} vertices is incomplete",
            )
        places = tuple(place(other, config) for other in group)
        shapes.append(
            Polygon(CORNER[item.command], places)
            if item.command in CORNER
            else Circle(CIRCLE[item.command], places[0], item.params[0])
        )
        at += size
    return Fence(tuple(shapes), number)


def check(item: Item, mission_type: int, count: int, config: VehicleConfig) -> None:
    """Check an item of a list of `count` items by itself; raises BadItem."""
    if mission_type == mavlink.MAV_MISSION_TYPE_MISSION:
        step(item, count, config)
        return
    is_fence = mission_type == mavlink.MAV_MISSION_TYPE_FENCE
    if item.command not in ({**CORNER, **CIRCLE} if is_fence else {mavlink.MAV_CMD_NAV_RALLY_POINT}):
        raise BadItem(mavlink.MAV_MISSION_UNSUPPORTED, f"command {item.command} is not supported")
    if item.frame not in ABOVE_SEA | ABOVE_HOME:
        raise BadItem(mavlink.MAV_MISSION_UNSUPPORTED_FRAME, f"frame {item.frame} is not supported")
    north_east, p1 = place(item, config), item.params[0]
    if item.command in CORNER:
        _check(1, p1, 3.0 <= p1 < math.inf and p1 == int(p1), "a count of 3 vertices and more")
    elif item.command in CIRCLE:
        _check(1, p1, 0.0 < p1 < math.inf, "a radius above 0 m")
    elif outside := config.outside((*north_east, 0.0)):
        raise bad_param(5, outside[1])


# ---- which step is flown ----


class FlightPlan:
    """A mission on board: its steps, the checksum of its items, the current step, and what has been done."""

    def __init__(self, steps: tuple[MissionStep, ...] = (), number: int = 0, current: int = 0) -> None:
        self.steps, self.number, self.current = steps, number, current
        self.begun = self.finished = False
        self.reached: tuple[int, float] | None = None  # the step that was done last, and when, s
        self._jumps: Counter[int] = Counter()  # how often each jump was taken
        self._speed_mps = 0.0  # 0: that of the configuration
        self._now_s, self._at_once = 0.0, 0

    def set_current(self, seq: int) -> None:
        """Go on with a step; all jumps count anew."""
        self.current, self.finished = seq, False
        self._jumps.clear()
        self._speed_mps = self._speed_mps if seq else 0.0

    def leg(self, t_s: float, at: Ned, grounded: bool, config: VehicleConfig) -> Leg | None:
        """Carry out what needs no flight; return the leg of the first step that does, None at the end.

        at: where the vehicle is, or comes to rest; grounded: whether it stands on the ground.
        """
        if self.finished:
            self.set_current(0)
        self.begun = True
        if t_s > self._now_s:
            self._now_s, self._at_once = t_s, 0
        while self.current < len(self.steps) and self._at_once < MOST_AT_ONCE:
            self._at_once += 1
            now = self.steps[self.current]
            if now.command not in (JUMP, SPEED, *IGNORED):
                limits = config.limits._replace(speed_mps=self._speed_mps or config.speed_mps)
                return Leg(now, _stops(now, at, grounded, config), limits)
            self.current = self._after(now)
        self.end()
        return None

    def _after(self, now: MissionStep) -> int:
        """Carry out a step that needs no flight; return the number of the next one."""
        if now.command == SPEED and now.value != -1.0:
            self._speed_mps = max(now.value, 0.0)
        if now.command != JUMP or self._jumps[self.current] >= now.value:
            return self.current + 1
        self._jumps[self.current] += 1
        return now.jumps_to

    def end(self) -> None:
        """End the mission; the next start begins with the first step."""
        self.current, self.finished = len(self.steps) - 1, True

    def progress(self, active: bool, flying: bool) -> MissionProgress:
        """Return how far it is. active: the vehicle is in mission mode; flying: it is also armed."""
        if not self.steps:
            return MissionProgress(active=active)
        state = mavlink.MISSION_STATE_PAUSED if self.begun else mavlink.MISSION_STATE_NOT_STARTED
        if self.finished:
            state = mavlink.MISSION_STATE_COMPLETE
        elif active and flying:
            state = mavlink.MISSION_STATE_ACTIVE
        return MissionProgress(self.current, len(self.steps), state, active, self.number, self.reached)


def _stops(now: MissionStep, at: Ned, grounded: bool, config: VehicleConfig) -> tuple[Ned, ...]:
    """Where a step leads, by straight lines. From the ground it climbs straight up first, as PX4 does."""
    if now.command in (DELAY, RETURN):
        return (at,)
    north, east = now.north_east or at[:2]
    there: Ned = (north, east, now.down_m)
    if now.command == TAKEOFF:
        return ((at[0], at[1], now.down_m), there) if grounded else (there,)
    if now.command == LAND and (north, east) == at[:2]:
        return (there,)
    high = min(now.down_m, -config.takeoff_altitude_m) if grounded else at[2]
    above: Ned = (north, east, high)
    climb: tuple[Ned, ...] = ((at[0], at[1], high),) if grounded else ()
    return (*climb, above, there) if now.command == LAND else (*climb, there)
