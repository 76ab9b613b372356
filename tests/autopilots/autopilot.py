"""What both autopilot doubles share: the clock, the streams, commands and parameters, landing, returning
and the failsafes' triggers.
"""

import math
import random
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.autopilots.body import DT_S, FREE, NAN, STILL, Body, Vector
from tests.autopilots.faults import Fault, Faults
from tests.autopilots.gps import Gps
from tests.autopilots.settings import Settings

Message = Any
Result = int
ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = range(6)
NOTICE, WARNING, CRITICAL, INFO = 5, 4, 2, 6
GROUND, FLYING, TAKING_OFF, LANDING = 1, 2, 3, 4
FORCE = 21196.0


@dataclass
class Return:
    """How far a return home has come."""

    stage: str = "climb"
    place: Vector = FREE
    since_s: float = 0.0


class Autopilot:
    """A state machine: `hear` messages, `step` the clock, take what it says from `out`. It knows no wall
    clock.
    """

    autopilot: int
    is_ardupilot: bool
    ready_after_s: float
    """When the EKF of this autopilot usually has a position, s after boot."""
    says: dict[int, Callable[..., Message | None]]
    unasked_us: dict[int, int]
    disarm_delay: str
    """The parameter that says how long it stands armed, s."""
    """Messages that stream unasked, with their intervals."""
    defaults: dict[str, float]

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        self.ready_s = self.ready_after_s if self.settings.ready_s is None else self.settings.ready_s
        self.faults = Faults(self.settings.faults)
        self.parameters = {**self.defaults, **dict(self.settings.parameters)}
        self.body = Body(list(self.settings.home))
        self.boot()
        self._strike()

    def boot(self) -> None:
        """Start again: the clock at 0, on the ground or falling, nothing asked for."""
        self.steps = 0
        self.random = random.Random(self.settings.seed)
        self.home: Vector = self.settings.home
        self.out: list[Message] = []
        self.due_us: dict[int, int] = {}
        self.interval_us = {0: 1_000_000, **self.unasked_us}
        self.later: list[tuple[float, Message]] = []
        self.armed, self.armed_s, self.landed_s = False, 0.0, 0.0
        self.airborne_since_s: float | None = None
        self.targets = self.texts = 0
        self.failsafe = False
        self.battery_v, self.battery_percent = 12.6, 100
        self.noise = [0.0, 0.0, 0.0]
        self.drift, self.gps = [0.0, 0.0], Gps()
        self.gps_lost_s: float | None = None
        self.station_seen_s: float | None = None
        self.trip = Return()
        self.yaw_rad = 0.4
        self.radio = self.settings.radio

    @property
    def system(self) -> int:
        """Its system id."""
        return self.settings.instance + 1

    # ---- the clock

    @property
    def now_s(self) -> float:
        """Simulation time since boot."""
        return self.steps * DT_S

    @property
    def now_ms(self) -> int:
        """Simulation time since boot."""
        return round(self.now_s * 1000.0)

    def step(self) -> None:
        """One time step: faults, failsafes, control, motion, streams."""
        self.steps += 1
        if self.steps % 5 == 0:
            self.noise = [0.95 * n + self.random.gauss(0.0, 0.003) for n in self.noise]
            if self.origin_set and not self.position_good:
                self.drift = [d + 0.02 for d in self.drift]
        self._strike()
        self.gps_lost_s = (self.gps_lost_s or self.now_s) if self.faults.on("gps") else None
        if self.armed and self.steps % 50 == 0 and self.battery_percent > 1:
            self.battery_v -= 0.0002
        self.gps.step(self, DT_S)
        self.watch()
        self._land_detector()
        if self.armed:
            self.control()
        else:
            self.body.fall()
        self._stream()

    def _strike(self) -> None:
        airborne = None if self.airborne_since_s is None else self.now_s - self.airborne_since_s
        for one in self.faults.strike(self.now_s, airborne, self.targets):
            self.struck(one)

    def _land_detector(self) -> None:
        if not self.body.landed:
            self.landed_s = self.now_s
            if self.airborne_since_s is None:
                self.airborne_since_s = self.now_s
        elif self.now_s - self.landed_s > 1.0:
            self.airborne_since_s = None

    def _stream(self) -> None:
        now_us = round(self.now_s * 1e6)
        for number, interval in self.interval_us.items():
            if interval > 0 and now_us >= self.due_us.get(number, 0):
                self.due_us[number] = now_us + interval
                if (message := self.says[number](self)) is not None:
                    self.out.append(message)
        for when, message in [one for one in self.later if one[0] <= self.now_s]:
            self.out.append(message)
            self.later.remove((when, message))

    # ---- what it knows

    @property
    def landed(self) -> bool:
        """Whether the land detector says so: a second on the ground."""
        return self.airborne_since_s is None

    @property
    def origin_set(self) -> bool:
        """Whether the EKF has an origin: from then on there is a local position, good or bad."""
        return self.now_s >= self.ready_s

    @property
    def gps_good(self) -> bool:
        """Whether the receiver has a fix."""
        return self.now_s >= 0.1 * self.ready_s and not self.faults.on("gps")

    @property
    def position_good(self) -> bool:
        """Whether the EKF trusts its position: GPS may be gone for 5 s."""
        gps = self.gps_lost_s is None or self.now_s - self.gps_lost_s < 5.0
        return self.origin_set and gps and not self.faults.on("ekf")

    def reported(self) -> Vector:
        """The position that the EKF reports."""
        north, east, down = (p + n for p, n in zip(self.body.position, self.noise, strict=True))
        return north + self.drift[0] + self.gps.shift[0], east + self.drift[1] + self.gps.shift[1], down

    def text(self, severity: int, words: str) -> None:
        """STATUSTEXT; more than 50 characters go out in chunks that share an id."""
        chunks = [words[at : at + 50].encode() for at in range(0, len(words), 50)]
        self.texts = self.texts + 1 if len(chunks) > 1 else self.texts
        number = self.texts if len(chunks) > 1 else 0
        self.out += [
            mavlink.MAVLink_statustext_message(severity, chunk, number, n) for n, chunk in enumerate(chunks)
        ]

    # ---- what it hears

    def hear(self, message: Message) -> None:
        """One message; its sender is in its header."""
        if getattr(message, "target_system", 0) not in (0, self.system):
            return
        if getattr(message, "target_component", 0) not in (0, 1):
            return
        handler = getattr(self, f"hear_{message.get_type().lower()}", None)
        if handler is not None:
            handler(message)

    def hear_command_int(self, message: Message) -> None:
        """COMMAND_INT: param5 and param6 are integers."""
        values = [
            message.param1,
            message.param2,
            message.param3,
            message.param4,
            message.x,
            message.y,
            message.z,
        ]
        self._answer(message, values)

    def hear_command_long(self, message: Message) -> None:
        """COMMAND_LONG."""
        self._answer(message, [getattr(message, f"param{n}") for n in range(1, 8)])

    def _answer(self, message: Message, values: list[float]) -> None:
        def ack(result: Result) -> Message:
            return mavlink.MAVLink_command_ack_message(
                message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
            )

        if self.faults.on("busy"):
            self.out.append(ack(REJECTED))
            return
        result = self.command(int(message.command), values)
        if result == IN_PROGRESS:  # a calibration
            self.later.append((self.now_s + 2.0, ack(ACCEPTED)))
        elif self.faults.on("progress"):
            self.later.append((self.now_s + 1.0, ack(result)))
            result = IN_PROGRESS
        self.out.append(ack(result))

    def command(self, number: int, values: list[float]) -> Result:
        """Do a command that both autopilots know."""
        match number:
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                wanted, interval = int(values[0]), int(values[1])
                if wanted not in self.says:
                    return DENIED if self.is_ardupilot else FAILED
                self.interval_us[wanted] = (
                    interval if interval > 0 else self.unasked_us.get(wanted, -1) if interval == 0 else -1
                )
                return ACCEPTED
            case mavlink.MAV_CMD_REQUEST_MESSAGE:
                if (say := self.says.get(int(values[0]))) is None:
                    return FAILED if self.is_ardupilot else DENIED
                if (message := say(self)) is not None:
                    self.out.append(message)
                return ACCEPTED
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                return self._arm(values[1] == FORCE) if values[0] == 1.0 else self._disarm(values[1] == FORCE)
            case mavlink.MAV_CMD_PREFLIGHT_CALIBRATION:
                return REJECTED if self.armed else IN_PROGRESS
        return UNSUPPORTED

    def _arm(self, forced: bool) -> Result:
        if self.armed:
            return ACCEPTED
        why = "Compass not healthy" if self.faults.on("arm") else self.why_not_arm()
        if why is not None and not forced:
            return self.refuse_arming(why)
        self.armed, self.armed_s = True, self.now_s
        if self.origin_set:
            self.home = tuple(self.body.position)  # type: ignore[assignment]
        self.text(INFO, "Arming motors" if self.is_ardupilot else "Armed by external command")
        self.on_arm()
        return ACCEPTED

    def _disarm(self, forced: bool) -> Result:
        if self.armed and not self.landed and not forced:
            if not self.is_ardupilot:
                self.text(CRITICAL, "Disarming denied: not landed")
            return FAILED if self.is_ardupilot else REJECTED
        self.disarm()
        return ACCEPTED

    def disarm(self) -> None:
        """Motors off."""
        if self.armed:
            self.armed, self.failsafe = False, False
            self.text(INFO, "Disarming motors" if self.is_ardupilot else "Disarmed")
            self.on_disarm()

    # ---- parameters

    def hear_param_request_read(self, message: Message) -> None:
        """PARAM_REQUEST_READ, by name or index."""
        names = list(self.parameters)
        name = (
            names[message.param_index]
            if 0 <= message.param_index < len(names)
            else message.param_id.rstrip("\0")
        )
        if name in self.parameters:
            self._say_parameter(name)

    def hear_param_request_list(self, _message: Message) -> None:
        """PARAM_REQUEST_LIST."""
        for name in self.parameters:
            self._say_parameter(name)

    def hear_param_set(self, message: Message) -> None:
        """PARAM_SET; PX4 puts the bytes of an integer into the float."""
        name = message.param_id.rstrip("\0")
        if name in self.parameters:
            whole = self._is_integer(name)
            raw = (
                struct.unpack("<i", struct.pack("<f", message.param_value))[0]
                if whole
                else message.param_value
            )
            self.parameters[name] = float(raw)
            self._say_parameter(name)

    def _is_integer(self, name: str) -> bool:
        return not self.is_ardupilot and isinstance(self.defaults[name], int)

    def _say_parameter(self, name: str) -> None:
        value = self.parameters[name]
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        if self._is_integer(name):
            value, kind = struct.unpack("<f", struct.pack("<i", int(value)))[0], mavlink.MAV_PARAM_TYPE_INT32
        place = list(self.parameters).index(name)
        self.out.append(
            mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(self.parameters), place)
        )

    # ---- flight that both know

    def fly(self, place: Vector, velocity: Vector = STILL, descent: float = 1.5) -> None:
        """One time step towards a place."""
        self.body.fly(place, velocity, speed=4.0, climb=2.5, descent=descent)

    def hold(self) -> None:
        """Stay where the vehicle was when its mode began."""
        self.fly(self.trip.place)

    def begin(self) -> None:
        """A mode begins: remember where."""
        self.trip = Return(place=self.stopping_place(), since_s=self.now_s)

    def stopping_place(self) -> Vector:
        """Where it comes to rest if it brakes now."""
        north, east, down = (p + 0.6 * v for p, v in zip(self.body.position, self.body.velocity, strict=True))
        return north, east, min(down, self.body.ground)

    def sink(self, rate_mps: float | None = None) -> None:
        """Descend where it is; fast far from the ground, 0.5 m/s below 10 m."""
        rate = rate_mps or (1.5 if self.body.height_m > 10.0 else 0.5)
        north, east, _ = self.trip.place
        place = (north, east, NAN) if self.position_good else FREE
        self.fly(place, (0.0, 0.0, rate))
        if self.landed and rate_mps is None:
            self.disarm()

    def go_home(self, height_m: float, linger_s: float) -> None:
        """Climb to a height above home, fly home, wait, land."""
        north, east, down = self.trip.place
        match self.trip.stage:
            case "climb":
                up = min(down, self.home[2] - height_m)
                self._leg("cross", (north, east, up))
            case "cross":
                self._leg("linger", (self.home[0], self.home[1], down))
            case "linger":
                self.hold()
                if self.now_s - self.trip.since_s >= linger_s:
                    self.trip.stage = "land"
            case _:
                self.sink()

    def _leg(self, after: str, place: Vector) -> None:
        self.fly(place)
        if math.dist(place, self.body.position) < 0.5 and math.hypot(*self.body.velocity) < 0.5:
            self.trip = Return(after, place, self.now_s)

    def landed_state(self) -> int:
        """MAV_LANDED_STATE."""
        if self.landed:
            return GROUND
        return LANDING if self.landing() else TAKING_OFF if self.taking_off() else FLYING

    def disarm_on_ground(self) -> None:
        """Disarm a vehicle that stands armed for its delay without taking off, or has come down."""
        since = max(self.armed_s, self.landed_s)
        if self.landed and self.now_s - since >= self.parameters[self.disarm_delay]:
            self.disarm()

    # ---- what each autopilot says of itself

    base_mode = 0
    custom_mode = 0
    system_status = 0

    def why_not_arm(self) -> str | None:
        """Why it cannot arm, or None."""
        raise NotImplementedError

    def refuse_arming(self, why: str) -> Result:
        """Say why; return the result."""
        raise NotImplementedError

    def on_arm(self) -> None:
        """After arming."""

    def on_disarm(self) -> None:
        """After disarming."""

    def struck(self, one: Fault) -> None:
        """A fault strikes."""
        raise NotImplementedError

    def watch(self) -> None:
        """The failsafes."""
        raise NotImplementedError

    def control(self) -> None:
        """One time step of flight."""
        raise NotImplementedError

    def target_said(self) -> tuple[int, Vector, Vector, float] | None:
        """(type_mask, place, velocity, the rest) of POSITION_TARGET_LOCAL_NED."""
        raise NotImplementedError

    def ekf_flags(self) -> int:
        """The flags of EKF_STATUS_REPORT or ESTIMATOR_STATUS."""
        raise NotImplementedError

    def landing(self) -> bool:
        """Whether it is coming down to land."""
        raise NotImplementedError

    def taking_off(self) -> bool:
        """Whether it is taking off."""
        raise NotImplementedError
