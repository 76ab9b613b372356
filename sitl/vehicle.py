"""The autopilot: a state machine in simulation time that flies, refuses and answers like a PX4 quadrotor.

It is a deterministic function of its configuration, the messages with their times, and the time: `advance` works through what
happens at its exact, closed-form time, so one jump and a thousand small steps give the same events and the same bits.
"""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, Protocol

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from link.mavlink import Message
from sitl.geodesy import to_local
from sitl.motion import Limits, Motion, Path, Turn, Vector, attitude, fall, halt, wrapped

COMPONENT = mavlink.MAV_COMP_ID_AUTOPILOT1
FORCE = 21196.0
"""param2 of an arm or disarm command that skips the checks (MAVLink's magic number)."""
LOW_BATTERY = 0.15
TEXT_LENGTH = 50
GLOBAL_STEP_M = 0.02
"""A little more than 1e-7 degrees, the resolution of latitude and longitude in MAVLink."""


class Mode(Enum):
    """The PX4 flight modes that are flown here, as PX4 numbers them: (main mode, sub mode)."""

    TAKEOFF = (4, 2)
    HOLD = (4, 3)
    RETURN = (4, 5)
    LAND = (4, 6)
    OFFBOARD = (6, 0)

    @property
    def custom_mode(self) -> int:
        """The two in one number, as HEARTBEAT carries them."""
        main, sub = self.value
        return int(main << 16 | sub << 24)


@dataclass(frozen=True)
class VehicleConfig:
    """What the vehicle is and where it may fly; speeds, battery warning and mode numbers are PX4's defaults where it has them."""

    sysid: int = 1
    home_lat_deg: float = 47.397742
    home_lon_deg: float = 8.545594
    home_alt_m: float = 488.0
    """Above mean sea level."""
    home_heading_deg: float = 0.0
    area_m: float = 30.0
    """Side of the search plane [0, area]²: x east, y north, home is its origin."""
    ceiling_m: float = 120.0
    speed_mps: float = 5.0
    climb_mps: float = 3.0
    descent_mps: float = 1.5
    accel_mps2: float = 3.0
    yaw_rate_dps: float = 45.0
    takeoff_altitude_m: float = 5.0
    return_altitude_m: float = 5.0
    """A return climbs to it first when lower, and keeps its altitude when higher."""
    silence_s: float = 30.0
    endurance_s: float = 1800.0
    """How long the battery lasts with the motors on; `math.inf` for one that never drains."""

    def __post_init__(self) -> None:
        """Refuse what cannot fly."""
        if not 1 <= self.sysid <= 255:
            raise ValueError(f"sysid is {self.sysid}: allowed is 1 to 255")
        for name, limit in (("home_lat_deg", 90.0), ("home_lon_deg", 180.0), ("home_heading_deg", 360.0), ("home_alt_m", 10_000.0)):
            if not abs(getattr(self, name)) <= limit:
                raise ValueError(f"{name} is {getattr(self, name)}: allowed is -{limit:g} to {limit:g}")
        for name in ("area_m", "ceiling_m", "speed_mps", "climb_mps", "descent_mps", "accel_mps2", "yaw_rate_dps"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}: allowed is a finite number above 0")
        for name in ("takeoff_altitude_m", "return_altitude_m"):
            if not 0.0 < getattr(self, name) <= self.ceiling_m:
                raise ValueError(f"{name} is {getattr(self, name)}: allowed is above 0 and up to the ceiling, {self.ceiling_m:g}")
        for name in ("silence_s", "endurance_s"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}: allowed is above 0, inf for never")

    @property
    def limits(self) -> Limits:
        """The limits of motion."""
        return Limits(self.speed_mps, self.climb_mps, self.descent_mps, self.accel_mps2)


class State(NamedTuple):
    """All that telemetry needs to know of the vehicle at one instant. Vectors are north, east, down from home."""

    time_s: float
    position: Vector
    velocity: Vector
    acceleration: Vector
    roll: float
    pitch: float
    yaw: float
    yaw_rate: float
    mode: Mode
    armed: bool
    landed: int
    """MAV_LANDED_STATE."""
    failsafe: bool
    battery: float
    """What is left of it, 0 to 1."""
    fit: bool
    """Nothing but being disarmed keeps it from flying."""


class Arrived(NamedTuple):
    """A setpoint was reached, to the last bit: take one reading here."""

    time_s: float
    position: Vector


class Said(NamedTuple):
    """The autopilot has something to say: one text, and the STATUSTEXT messages that carry it."""

    time_s: float
    text: str
    messages: list[Message]


Event = Arrived | Said


class Result(NamedTuple):
    """What became of a command: a MAV_RESULT, and the reason where it was refused."""

    code: int
    reason: str = ""
    kind: str = ""
    """Which of the reasons that a setpoint is refused for."""

    @property
    def accepted(self) -> bool:
        """Whether it is being done."""
        return self.code == ACCEPTED.code


ACCEPTED = Result(mavlink.MAV_RESULT_ACCEPTED)
UNSUPPORTED = Result(mavlink.MAV_RESULT_UNSUPPORTED)


class Streams(Protocol):
    """The telemetry of the link that a message came over: commands 410, 511, 512 and 520 are about it (`sitl.telemetry.Telemetry`)."""

    def set_interval(self, message_id: int, interval_us: float, now_s: float) -> bool:
        """Change a stream's rate; False where there is no such stream."""

    def build(self, message_id: int, now_s: float) -> Message | None:
        """The message as it is now; None where there is none."""


class Params(NamedTuple):
    """The parameters of COMMAND_LONG or COMMAND_INT alike; NaN means not given."""

    p1: float
    p2: float
    p3: float
    p4: float
    lat_deg: float
    lon_deg: float
    alt_m: float
    frame: int


class Vehicle:
    """One simulated multirotor with its autopilot.

    Every method takes the simulation time, which never runs backwards, and first does what falls due until then. The commands of a
    program (`arm`, `take_off`, `go_to`, `set_mode`, `setpoint`) and those of a MAVLink client (`receive`) are the same code.
    """

    def __init__(self, config: VehicleConfig, start_s: float = 0.0) -> None:
        """Stand at home, disarmed, with a full battery."""
        self.config = config
        self.ignored: Counter[str] = Counter()
        """Setpoints that came too late or twice, by which of the two."""
        self.refused: Counter[str] = Counter()
        """Setpoints refused, by kind of reason."""

        self._now = start_s
        self._mode = Mode.HOLD
        self._armed = False
        self._failsafe = False
        self._events: list[Event] = []

        heading = wrapped(math.radians(config.home_heading_deg))
        self._turn = Turn(start_s, heading, heading, math.radians(config.yaw_rate_dps))
        self._path = Path(start_s, (0.0, 0.0, 0.0))
        self._settled = True  # the end of the path has been dealt with

        self._setpoint: Vector | None = None
        self._setpoint_yaw: float | None = None
        self._heard_s = -math.inf  # the last accepted setpoint
        self._alone_since_s = start_s  # the client has not had its say before: when OFFBOARD began to fly
        self._readings: set[int] = set()
        self._newest: int | None = None
        self._answered = True

        self._motors_on_s = start_s
        self._spent_s = 0.0  # battery time used up before the motors were last switched on
        self._battery_alarms = 0

        self._texts = 0
        self._refusals_said: dict[str, float] = {}

    # ---- time ----

    def advance(self, t_s: float) -> list[Event]:
        """Let time pass; return what happened since the last call, in order."""
        self._advance(t_s)
        events, self._events = self._events, []
        return events

    def next_event_s(self) -> float | None:
        """When the next thing happens if no message comes: a leg ends, it touches down, silence or the battery runs out."""
        if self._events:
            return self._now
        return min((at for at, _ in self._upcoming() if at < math.inf), default=None)

    @property
    def now_s(self) -> float:
        """The time it has been brought to."""
        return self._now

    @property
    def moving(self) -> bool:
        """Whether it is under way to somewhere (the end of that is then among the next events)."""
        return not self._settled

    def state(self, t_s: float) -> State:
        """Everything about it at a time between the last advance and the next event."""
        position, velocity, acceleration = self._path.at(t_s)
        yaw, yaw_rate = self._turn.at(t_s)
        roll, pitch = attitude(acceleration, yaw)
        return State(
            time_s=t_s,
            position=position,
            velocity=velocity,
            acceleration=acceleration,
            roll=roll,
            pitch=pitch,
            yaw=yaw,
            yaw_rate=yaw_rate,
            mode=self._mode,
            armed=self._armed,
            landed=self._landed_state(),
            failsafe=self._failsafe,
            battery=self._battery(t_s),
            fit=not (self._battery_empty or self._falling),
        )

    def _advance(self, t_s: float) -> None:
        if not t_s >= self._now:
            raise ValueError(f"time runs backwards: {t_s} s after {self._now} s")
        while upcoming := [(at, happen) for at, happen in self._upcoming() if at <= t_s]:
            at, happen = min(upcoming, key=lambda event: event[0])
            self._now = max(at, self._now)
            happen()
        self._now = t_s

    def _upcoming(self) -> list[tuple[float, Callable[[], None]]]:
        """What will happen by itself; of two things at the same time, the first one listed goes first."""
        upcoming: list[tuple[float, Callable[[], None]]] = []
        if not self._settled:
            upcoming.append((self._path.end_s, self._settle))
        if self._armed and self._mode is Mode.OFFBOARD:
            # A leg may take longer than the client is allowed to be silent, so that silence counts from its end.
            upcoming.append((max(self._heard_s, self._alone_since_s, self._path.end_s) + self.config.silence_s, self._lose_client))
        if self._armed and self._battery_alarms < 2:
            lasts_s = self.config.endurance_s * (1.0 - LOW_BATTERY if self._battery_alarms == 0 else 1.0)
            upcoming.append((self._motors_on_s + lasts_s - self._spent_s, self._alarm_battery))
        return upcoming

    def _settle(self) -> None:
        """The path has ended."""
        self._settled = True
        if not self._armed:
            return  # it fell
        match self._mode:
            case Mode.TAKEOFF:
                self._mode = Mode.HOLD
            case Mode.OFFBOARD:
                self._events.append(Arrived(self._now, self._path.target))
            case Mode.RETURN:
                self._mode = Mode.LAND
                self._descend()
            case Mode.LAND:
                self._stop_motors()

    def _lose_client(self) -> None:
        self._failsafe = True
        if self._on_ground:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, f"No setpoint for {self.config.silence_s:g} s: disarmed")
            self._stop_motors()
        else:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, f"No setpoint for {self.config.silence_s:g} s: returning home")
            self._return()

    def _alarm_battery(self) -> None:
        """Warn when low, as PX4 does by default; land where it is when empty, for nothing flies on an empty battery."""
        self._battery_alarms += 1
        if self._battery_alarms == 1:
            self._say(mavlink.MAV_SEVERITY_WARNING, f"Battery low: {LOW_BATTERY:.0%} left")
        elif self._on_ground:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "Battery empty: disarmed")
            self._stop_motors()
        else:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, "Battery empty: landing")
            self._failsafe = True
            if self._mode is not Mode.LAND:
                self._mode = Mode.LAND
                self._descend()

    # ---- commands: each is done, or refused with a reason and then changes nothing ----

    def arm(self, t_s: float) -> Result:
        """Start the motors."""
        self._advance(t_s)
        if self._armed:
            return ACCEPTED
        if self._falling:
            return _not_now("Arming refused: falling")
        if self._battery_empty:
            return _not_now("Arming refused: battery empty")
        if self._mode is Mode.OFFBOARD and (missing := self._missing_setpoint()):
            return _not_now(f"Arming refused: {missing}")
        self._armed, self._motors_on_s = True, self._now
        if self._mode is Mode.OFFBOARD:
            self._follow()
        return ACCEPTED

    def disarm(self, t_s: float, force: bool = False) -> Result:
        """Stop the motors; in the air only by force, and then it drops."""
        self._advance(t_s)
        if not self._armed:
            return ACCEPTED
        if self._on_ground:
            self._stop_motors()
            return ACCEPTED
        if not force:
            return _not_now("Disarm refused: in the air")
        self._say(mavlink.MAV_SEVERITY_EMERGENCY, "Motors stopped in the air")
        falling = fall(self._now, self._motion)
        self._stop_motors()
        self._fly(falling)
        return ACCEPTED

    def take_off(self, t_s: float, altitude_m: float | None = None) -> Result:
        """Climb straight up to an altitude above home, then hold."""
        self._advance(t_s)
        altitude = self.config.takeoff_altitude_m if altitude_m is None else altitude_m
        if not self._armed:
            return _not_now("Take-off refused: disarmed")
        if not 0.0 < altitude <= self.config.ceiling_m:
            return _denied(f"Take-off refused: {_metres(altitude)} m is not above 0 and up to {self.config.ceiling_m:g} m")
        north, east, _ = self._motion.position
        if self._mode is Mode.TAKEOFF and self._path.target[2] == -altitude:
            return ACCEPTED  # the command again, because its acknowledgement was lost
        if not self._on_ground:
            return _not_now("Take-off refused: already in the air")
        self._mode, self._failsafe = Mode.TAKEOFF, False
        self._go((north, east, -altitude))
        return ACCEPTED

    def go_to(self, t_s: float, position: Vector, yaw_rad: float | None = None) -> Result:
        """Fly somewhere and hold there (the guided flight of DO_REPOSITION); no reading is taken on it."""
        self._advance(t_s)
        if refusal := self._unfit():
            return _not_now(f"Go-to refused: {refusal}")
        if self._on_ground:
            return _not_now("Go-to refused: on the ground")
        if outside := self._outside(position):
            return _denied(f"Go-to refused: {outside[1]}")
        self._mode, self._failsafe = Mode.HOLD, False
        self._go(position)
        self._face(yaw_rad)
        return ACCEPTED

    def set_mode(self, t_s: float, mode: Mode) -> Result:
        """Change the flight mode."""
        self._advance(t_s)
        if mode is Mode.TAKEOFF:
            return self.take_off(t_s)
        if mode is self._mode:
            return ACCEPTED
        name = mode.name.capitalize()
        if self._falling:
            return _not_now(f"{name} refused: falling")
        if self._battery_empty and mode is not Mode.LAND:
            return _not_now(f"{name} refused: battery empty")
        match mode:
            case Mode.OFFBOARD:
                if missing := self._missing_setpoint():
                    return _not_now(f"Offboard refused: {missing}")
                self._mode = mode
                if self._armed:
                    self._follow()
            case Mode.RETURN | Mode.LAND:
                if self._on_ground:
                    return _not_now(f"{name} refused: on the ground")
                if mode is Mode.RETURN:
                    self._return()
                else:
                    self._mode = mode
                    self._descend()
            case _:
                self._mode = Mode.HOLD
                if not self._on_ground:
                    self._fly(self._halted())
        self._failsafe = False
        return ACCEPTED

    def setpoint(self, t_s: float, position: Vector, yaw_rad: float | None = None, time_boot_ms: int | None = None) -> Result:
        """Take a waypoint: fly there if in OFFBOARD, else remember it. It answers the reading of the same `time_boot_ms`, if any.

        What answers a reading again or answers an old one is ignored and counted, and gives TEMPORARILY_REJECTED.
        """
        self._advance(t_s)
        position, answers = _float32(position), self.awaiting_answer and time_boot_ms == self._newest
        if time_boot_ms in self._readings and not answers:
            kind = "duplicate" if time_boot_ms == self._newest else "late"
            self.ignored[kind] += 1
            return _not_now(f"Waypoint ignored: {kind} answer to the reading of {time_boot_ms} ms")
        if yaw_rad is not None and not math.isfinite(yaw_rad):
            return self._refuse("not finite", f"yaw {yaw_rad} is not finite")
        if outside := self._outside(position):
            return self._refuse(*outside)

        new = answers or position != self._setpoint
        self._setpoint, self._setpoint_yaw, self._heard_s = position, yaw_rad, self._now
        if answers:
            self._answered = True
        if self._armed and self._mode is Mode.OFFBOARD:
            if new:
                self._go(position)
            self._face(yaw_rad)
        return ACCEPTED

    # ---- readings ----

    def sampled(self, time_boot_ms: int) -> None:
        """A reading was taken: setpoints that carry its time answer it, once."""
        if self._newest is not None and time_boot_ms <= self._newest:
            raise ValueError(f"a reading of {time_boot_ms} ms after one of {self._newest} ms: their times must grow to tell them apart")
        self._readings.add(time_boot_ms)
        self._newest, self._answered = time_boot_ms, False

    @property
    def awaiting_answer(self) -> bool:
        """Whether the newest reading has not been answered."""
        return not self._answered

    # ---- MAVLink ----

    def receive(self, message: Message, t_s: float, streams: Streams | None = None) -> list[Message]:
        """Handle one decoded message; return the messages that answer it, unsent, for the link that it came over."""
        self._advance(t_s)
        if getattr(message, "target_system", 0) not in (0, self.config.sysid):
            return []
        if getattr(message, "target_component", 0) not in (0, COMPONENT):
            return []
        match message.get_type():
            case "COMMAND_LONG" | "COMMAND_INT":
                result, answers = self._command(message.command, _params(message), streams)
                return [_acknowledge(message, message.command, result), *answers, *self._reason(result)]
            case "SET_MODE":
                result = self._set_custom_mode(message.base_mode, message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24)
                return [_acknowledge(message, mavlink.MAVLINK_MSG_ID_SET_MODE, result), *self._reason(result)]
            case "SET_POSITION_TARGET_LOCAL_NED":
                return self._setpoint_message(message)
        return []

    def _command(self, command: int, p: Params, streams: Streams | None) -> tuple[Result, list[Message]]:
        for number, value in enumerate(p[: _NUMBERED.get(command, 0)], start=1):
            if not math.isfinite(value):
                return _denied(f"Command {command} refused: param {number} is {value}"), []
        match command:
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                if p.p1 not in (0.0, 1.0):
                    return _denied(f"Arming refused: param 1 is {p.p1:g}, allowed is 0 or 1"), []
                return self.arm(self._now) if p.p1 else self.disarm(self._now, force=p.p2 == FORCE), []
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                return self.take_off(self._now, self._above_home(p) if math.isfinite(p.alt_m) else None), []
            case mavlink.MAV_CMD_NAV_LAND:
                return self.set_mode(self._now, Mode.LAND), []
            case mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                return self.set_mode(self._now, Mode.RETURN), []
            case mavlink.MAV_CMD_DO_SET_MODE:
                return self._set_custom_mode(int(p.p1), int(p.p2), int(p.p3) if math.isfinite(p.p3) else 0), []
            case mavlink.MAV_CMD_DO_REPOSITION:
                return self._reposition(p), []
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                if streams is None or not streams.set_interval(int(p.p1), p.p2, self._now):
                    return UNSUPPORTED, []
                return ACCEPTED, []
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                return self._request(int(p.p1), streams)
            case mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
                return self._request(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, streams)
            case mavlink.MAV_CMD_GET_HOME_POSITION:
                return self._request(mavlink.MAVLINK_MSG_ID_HOME_POSITION, streams)
        return UNSUPPORTED, []

    def _request(self, message_id: int, streams: Streams | None) -> tuple[Result, list[Message]]:
        message = streams.build(message_id, self._now) if streams is not None else None
        return (UNSUPPORTED, []) if message is None else (ACCEPTED, [message])

    def _set_custom_mode(self, base_mode: int, main: int, sub: int) -> Result:
        if not base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            return _denied("Mode refused: only PX4's custom modes are known")
        if main == Mode.OFFBOARD.value[0]:
            sub = 0
        try:
            mode = Mode((main, sub))
        except ValueError:
            return _denied(f"Mode refused: PX4 mode {main}, {sub} is not flown here")
        return self.set_mode(self._now, mode)

    def _reposition(self, p: Params) -> Result:
        if p.frame not in _ABOVE_SEA | _ABOVE_HOME:
            return _denied(f"Go-to refused: frame {p.frame} is not global")
        north, east, down = self._motion.position
        if math.isfinite(p.lat_deg) and math.isfinite(p.lon_deg):
            local = to_local(self.config.home_lat_deg, self.config.home_lon_deg, p.lat_deg, p.lon_deg)
            # The edge of the area, home itself on it, is hard to hit in steps of 1e-7 degrees: what misses it by less is on it.
            north, east = (_snapped(metres, self.config.area_m) for metres in local)
        if math.isfinite(p.alt_m):
            down = -self._above_home(p)
        return self.go_to(self._now, (north, east, down), p.p4 if math.isfinite(p.p4) else None)

    def _above_home(self, p: Params) -> float:
        return p.alt_m if p.frame in _ABOVE_HOME else p.alt_m - self.config.home_alt_m

    def _setpoint_message(self, m: Message) -> list[Message]:
        if m.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
            result = self._refuse("frame", f"frame {m.coordinate_frame} is not LOCAL_NED ({mavlink.MAV_FRAME_LOCAL_NED})")
        elif m.type_mask & _NO_POSITION:
            result = self._refuse("no position", "it has no position x, y, z")
        else:
            yaw = None if m.type_mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE else m.yaw
            result = self.setpoint(self._now, (m.x, m.y, m.z), yaw, m.time_boot_ms)
        # Clients repeat setpoints at 20 Hz: each kind of refusal is told once a second at most, and an ignored setpoint not at all.
        if result.code != mavlink.MAV_RESULT_DENIED or self._now - self._refusals_said.get(result.kind, -math.inf) < 1.0:
            return []
        self._refusals_said[result.kind] = self._now
        return self._reason(result)

    def _refuse(self, kind: str, reason: str) -> Result:
        self.refused[kind] += 1
        return Result(mavlink.MAV_RESULT_DENIED, f"Waypoint refused: {reason}", kind)

    def _reason(self, result: Result) -> list[Message]:
        return self._text(mavlink.MAV_SEVERITY_WARNING, result.reason) if result.reason else []

    def _say(self, severity: int, text: str) -> None:
        self._events.append(Said(self._now, text, self._text(severity, text)))

    def _text(self, severity: int, text: str) -> list[Message]:
        """STATUSTEXT in chunks; the receiver joins those of one id until one is not full."""
        raw = text.encode("ascii", "replace")
        if len(raw) <= TEXT_LENGTH:
            return [mavlink.MAVLink_statustext_message(severity, raw)]
        self._texts = self._texts % 0xFFFF + 1
        chunks = [raw[at : at + TEXT_LENGTH] for at in range(0, len(raw) + 1, TEXT_LENGTH)]
        return [mavlink.MAVLink_statustext_message(severity, chunk, self._texts, n) for n, chunk in enumerate(chunks)]

    # ---- flight ----

    @property
    def _motion(self) -> Motion:
        return self._path.at(self._now)

    @property
    def _on_ground(self) -> bool:
        return self._settled and self._path.target[2] >= 0.0

    @property
    def _falling(self) -> bool:
        return not self._armed and not self._settled

    @property
    def _battery_empty(self) -> bool:
        return self._battery_alarms == 2

    def _battery(self, t_s: float) -> float:
        spent = self._spent_s + (t_s - self._motors_on_s if self._armed else 0.0)
        return max(1.0 - spent / self.config.endurance_s, 0.0)

    def _landed_state(self) -> int:
        if self._on_ground:
            return int(mavlink.MAV_LANDED_STATE_ON_GROUND)
        if self._mode is Mode.TAKEOFF:
            return int(mavlink.MAV_LANDED_STATE_TAKEOFF)
        return int(mavlink.MAV_LANDED_STATE_LANDING if self._mode is Mode.LAND else mavlink.MAV_LANDED_STATE_IN_AIR)

    def _missing_setpoint(self) -> str:
        if self._setpoint is None:
            return "no setpoint received yet"
        return "" if self._now - self._heard_s <= self.config.silence_s else f"no setpoint in the last {self.config.silence_s:g} s"

    def _unfit(self) -> str:
        if not self._armed:
            return "disarmed"
        return "battery empty" if self._battery_empty else ""

    def _outside(self, position: Vector) -> tuple[str, str] | None:
        """(kind, reason) where the position is not one inside the fence."""
        north, east, down = position
        area, ceiling = self.config.area_m, self.config.ceiling_m
        place = f"({_metres(east)}, {_metres(north)}) m"
        if not all(map(math.isfinite, position)):
            return "not finite", f"{place} at {_metres(-down)} m is not finite"
        if not (0.0 <= east <= area and 0.0 <= north <= area):
            return "outside the area", f"{place} is outside the area [0, {area:g}] x [0, {area:g}] m"
        if not 0.0 <= -down <= ceiling:
            return "outside the altitudes", f"altitude {_metres(-down)} m is outside [0, {ceiling:g}] m"
        return None

    def _fly(self, path: Path) -> None:
        self._path, self._settled = path, False

    def _halted(self) -> Path:
        return halt(self._now, self._motion, self.config.limits)

    def _go(self, target: Vector) -> None:
        self._fly(self._halted().to(target, self.config.limits))

    def _follow(self) -> None:
        """OFFBOARD begins to fly: to the setpoint remembered."""
        assert self._setpoint is not None
        self._alone_since_s = self._now
        self._go(self._setpoint)
        self._face(self._setpoint_yaw)

    def _face(self, yaw_rad: float | None) -> None:
        if yaw_rad is not None and wrapped(yaw_rad) != self._turn.target_rad:
            self._turn = Turn(self._now, self._turn.at(self._now)[0], wrapped(yaw_rad), self._turn.rate_radps)

    def _return(self) -> None:
        self._mode = Mode.RETURN
        path, limits = self._halted(), self.config.limits
        north, east, down = path.target
        down = min(down, -self.config.return_altitude_m)
        self._fly(path.to((north, east, down), limits).to((0.0, 0.0, down), limits))

    def _descend(self) -> None:
        path = self._halted()
        self._fly(path.to((path.target[0], path.target[1], 0.0), self.config.limits))

    def _stop_motors(self) -> None:
        self._spent_s += self._now - self._motors_on_s
        self._armed, self._mode, self._failsafe = False, Mode.HOLD, False


_ABOVE_SEA = {mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT}
_ABOVE_HOME = {mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT}
_NUMBERED = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: 1,
    mavlink.MAV_CMD_DO_SET_MODE: 2,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: 2,
    mavlink.MAV_CMD_REQUEST_MESSAGE: 1,
}
"""How many of a command's first parameters have to be numbers; NaN elsewhere is "not given"."""
_NO_POSITION = (
    mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE | mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE
)


def _not_now(reason: str) -> Result:
    """Refused because of the state that the vehicle is in."""
    return Result(mavlink.MAV_RESULT_TEMPORARILY_REJECTED, reason)


def _denied(reason: str) -> Result:
    """Refused because of what was asked."""
    return Result(mavlink.MAV_RESULT_DENIED, reason)


def _params(m: Message) -> Params:
    if m.get_type() == "COMMAND_LONG":
        return Params(m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7, mavlink.MAV_FRAME_GLOBAL)
    lat, lon = (math.nan if degrees == 0x7FFFFFFF else degrees / 1e7 for degrees in (m.x, m.y))  # INT32_MAX: not given
    return Params(m.param1, m.param2, m.param3, m.param4, lat, lon, m.z, m.frame)


def _acknowledge(message: Message, command: int, result: Result) -> Message:
    return mavlink.MAVLink_command_ack_message(
        command, result.code, target_system=message.get_srcSystem(), target_component=message.get_srcComponent()
    )


def _snapped(metres: float, edge_m: float) -> float:
    inside = min(max(metres, 0.0), edge_m)
    return inside if abs(metres - inside) < GLOBAL_STEP_M else metres


def _float32(position: Vector) -> Vector:
    """The same as the wire carries it."""
    with np.errstate(over="ignore"):  # what is too great becomes infinite, and is refused as that
        north, east, down = np.array(position, np.float32).tolist()
    return north, east, down


def _metres(value: float) -> str:
    """The shortest decimal that is this float32: 31.1, not 31.100000381."""
    return str(np.float32(value))
