"""A real vehicle as its search flies it: commands go out over MAVLink, arrival is derived from telemetry."""

import math

from pymavlink.dialects.v20 import all as mavlink

from aircraft.firmware import COMING_DOWN
from aircraft.remote.commander import Commander
from aircraft.remote.course import SPEED_MPS, Course
from aircraft.remote.known import Global
from aircraft.remote.preflight import WAITING, Preflight
from aircraft.remote.procedures import Procedures
from aircraft.remote.watch import Watch
from aircraft.state import (
    ACCEPTED,
    AircraftConfig,
    Arrived,
    Ned,
    Result,
    Said,
    VehicleEvent,
    as_float32,
    denied,
    going_on,
    metres,
    not_now,
)
from aircraft.together import Berth
from link.modes import Mode

POLL_S = 0.05
WIND_S = 5.0  # a wind that was told longer ago is not known


class RemoteVehicle:
    """One real multirotor, or its own simulator.

    Positions are NED, m from the origin of the search area, which is home unless a berth has another.

    No call waits: a command begins, `mode` shows what is being done, and `advance` tells what comes of it.
    Times are s of the caller's clock, which runs as fast as the vehicle's own simulator. Setpoints go out
    only while the caller goes on calling: if it hangs, the autopilot's failsafe sees that they have
    stopped.

    This is the search's interface. What is known of the vehicle is in `Known`, the conversation with it in
    `Commander`, what takes several seconds in `Procedures`, the way to a waypoint in `Course`.
    """

    def __init__(
        self,
        config: AircraftConfig,
        commander: Commander,
        wait_s: float = math.inf,
        *,
        launched: bool = False,
        berth: Berth | None = None,
    ) -> None:
        """Take the conversation with a vehicle, which need not be there yet.

        `config` says how high and how far it may fly.

        wait_s, launched: how long the search's begin is waited for, as `Preflight` says.
        berth: its place among several that search together.
        """
        self.config = config
        self.is_searched = False  # whether its search leads it
        self.now_s = 0.0  # the time of the last call
        self.flight = Procedures(commander)
        self.preflight = Preflight(self.flight, config, wait_s, launched=launched)
        self._commander, self._known = commander, commander.known
        self._known.berth, self._known.area = berth, config.area
        self._known.home_meant, self._known.home_within_m = config.home_meant, config.home_within_m
        self._watch = Watch(self.flight)
        self.course = Course(self.flight, config)
        self._follows = False  # whether the companion's mode means OFFBOARD, not HOLD

    # ---- time ----

    def catch_up(self, t_s: float) -> None:
        """Take what the vehicle has said, once for each time.

        Raises VehicleFailed if it cannot fly the search, or no longer.
        """
        if t_s <= self.now_s:
            return
        self.now_s = t_s
        self.flight.poll(t_s)
        if not self._known.flying:  # until the take-off home may still move
            self._known.place_area()
        self.preflight.look()
        self._watch.look(t_s)
        self.course.send()

    def advance(self, t_s: float) -> list[VehicleEvent]:
        """Take what the vehicle has said; returns its texts and ours, and its arrival if there is one."""
        self.catch_up(t_s)
        name, events = self._known.firmware.name, list[VehicleEvent](self.flight.events)
        events += [
            Said(self.now_s, severity, f"{name}: {text}", heard=True) for severity, text in self._known.texts
        ]
        self._known.texts.clear()
        self.flight.events.clear()
        if self._flies_course:
            if arrived := self.course.look():
                events.append(arrived)
        elif self.mode is Mode.OFFBOARD and self.now_s - self.course.heard_s > self.config.silence_s:
            silent_s = self.config.silence_s / self._commander.speedup
            self.flight.fail(f"No waypoint for {round(silent_s, 1):g} s")
        return events

    def next_event_s(self) -> float | None:
        """Return when to look again."""
        return self.now_s + POLL_S

    # ---- what it does, and how it is ----

    @property
    def mode(self) -> Mode:
        """The mode in the search's words: what is being done about it counts.

        One that only pilots fly is HOLD: the search has no part.
        """
        if self.flight.doing:
            return self.flight.doing
        mode = self._known.reported if self._known.armed else None
        follows = self._follows and not self.flight.taken_over
        return Mode.HOLD if mode is None or (mode is Mode.OFFBOARD and not follows) else mode

    @property
    def _flies_course(self) -> bool:
        follows = self.mode is Mode.OFFBOARD and self.flight.doing is None
        return follows and self._known.flying and self.course.approach is not None

    @property
    def moving(self) -> bool:
        """True while it flies to a setpoint, or is armed and not at rest."""
        return self.armed and (self._flies_course or math.hypot(*self._known.velocity) > SPEED_MPS)

    busy = moving  # there is nothing else that it would do by itself

    @property
    def free(self) -> bool:
        """True while it stands on the ground and no pilot has begun to fly it."""
        return not self._known.flying and not self.moving and self.mode is Mode.HOLD

    @property
    def armed(self) -> bool:
        """True while its motors may turn."""
        return self._known.armed

    @property
    def system(self) -> int:
        """The autopilot's system id; 0 until one is found."""
        return self._commander.system

    @property
    def waypoint(self) -> Ned | None:
        """The last accepted setpoint; None before the first."""
        return self.course.waypoint

    @property
    def area_origin(self) -> Global | None:
        """The area's origin, latitude and longitude in degrees, at home's altitude, m; None: it is home."""
        area, home = self._known.area_origin, self._known.home
        return (*area, home[2]) if area and home else None

    @property
    def wind(self) -> tuple[float, float] | None:
        """(u cos φ, u sin φ) m/s, to where the wind comes from, as float32.

        None where the autopilot does not tell, or no longer.
        """
        if self._known.wind is None or self.now_s - self._known.wind_s > self._commander.patient(WIND_S):
            return None
        x, y, _ = as_float32((*self._known.wind, 0.0))
        return x, y

    @property
    def failure(self) -> str:
        """Why the vehicle has given the search up; empty if it has not."""
        return self.flight.failure

    @property
    def caveat(self) -> str:
        """What its readings have to be read with, because of GPS glitches; empty if there was none."""
        return self._known.glitches.caveat

    def still(self, arrived: Arrived) -> Arrived:
        """Return the arrival as it is now: where it has drifted to since."""
        return Arrived(self.now_s, self._known.place, self._known.position_ms)

    # ---- commands: each is begun, not waited for ----

    def arm(self, t_s: float) -> Result:
        """Arm, once the vehicle can really fly; refused with what is being waited for until it is armed."""
        if self._known.armed:
            return ACCEPTED
        if missing := self.preflight.ask():
            return going_on(f"{WAITING}{missing}")
        if not self.flight.arming:
            self.flight.arm()
        return going_on("Arming")

    def take_off(self, t_s: float) -> Result:
        """Climb straight up to `takeoff_altitude_m` above home, then hold."""
        altitude = self.config.takeoff_altitude_m
        if not 0.0 < altitude <= self.config.ceiling_m:
            return denied(
                f"Take-off refused: altitude {metres(altitude)} m, allowed is above 0 and up to "
                f"{self.config.ceiling_m:g} m"
            )
        if not self._known.armed:
            return not_now("Take-off refused: disarmed")
        if self._known.flying:
            return not_now("Take-off refused: already in the air")
        if self.flight.taken_over or not self.flight.armed_by_us:
            return not_now("Take-off waits: a pilot has armed it")
        self._follows = False
        self.flight.take_off(altitude)
        return ACCEPTED

    def set_mode(self, t_s: float, mode: Mode) -> Result:
        """Begin to change the flight mode to OFFBOARD, HOLD, RETURN or LAND; OFFBOARD needs a setpoint."""
        name = mode.name.capitalize()
        if mode is self.mode and not self.flight.taken_over:
            return ACCEPTED
        if not self._known.flying:
            return not_now(f"{name} refused: on the ground")
        if mode is Mode.OFFBOARD and self.waypoint is None:
            return not_now("Offboard refused: no setpoint received yet")
        self._follows = mode is Mode.OFFBOARD
        self.flight.enter(mode)
        return ACCEPTED

    def setpoint(self, t_s: float, wanted: Ned, *, answers: bool = False) -> Result:
        """Take a waypoint as the simulated vehicle does: fly there in OFFBOARD, else remember it.

        The yaw is the autopilot's.
        """
        return self.course.begin(wanted, answers=answers) or ACCEPTED

    # ---- what its clients say and hear ----

    def frames(self) -> list[bytes]:
        """Return what the autopilot has said since the last call, frame by frame, unchanged."""
        return self._commander.radio.frames()

    def forward(self, frame: bytes, asks_for_mode: str = "") -> None:
        """Hand a client's frame on to the autopilot, unchanged.

        asks_for_mode: who sent it, if it may change the flight mode.
        """
        if asks_for_mode:
            self.flight.asked_by(asks_for_mode)
        self._commander.radio.forward(frame)

    # ---- the end ----

    def leave(self) -> str:
        """Send a vehicle home that nobody else is in charge of.

        Returns what becomes of it, nothing if it stands on the ground.

        Call it, and `catch_up`, again and again until `left`.
        """
        if not self._known.flying:
            if (self._known.armed or self.flight.arming) and self.flight.in_charge:
                self._commander.send(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0)
            return ""
        if self.left:
            return f"The vehicle is left in {self._known.mode_name}"
        if self.flight.doing not in COMING_DOWN:
            self.flight.enter(Mode.RETURN)
            self.flight.go_on()  # at once: `catch_up` may fail
        return "The vehicle is told to return home"

    @property
    def left(self) -> bool:
        """Whether someone else is in charge of it.

        This is a pilot, or the autopilot, which returns or lands by itself.
        """
        return not (self._known.flying and self.flight.in_charge) or self._known.reported in COMING_DOWN
