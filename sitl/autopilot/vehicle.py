"""The autopilot: a state machine in simulation time that flies, refuses and fails safe like a PX4 quadrotor.

It is a deterministic function of its configuration, the commands with their times, and the time. `advance`
handles each event at its exact, closed-form time: one jump and a thousand small steps give the same events
and the same positions, bit for bit.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import (
    ACCEPTED,
    LOW_BATTERY,
    Arrived,
    Ned,
    Reached,
    Result,
    Said,
    VehicleEvent,
    as_float32,
    denied,
    metres,
    not_now,
)
from link.modes import Mode
from sitl.autopilot import plan
from sitl.autopilot.config import FENCE_HOLD, FENCE_LAND, FENCE_RETURN, FENCE_TERMINATE, VehicleConfig
from sitl.autopilot.motion import Motion, Trajectory, fall, halt, tilt, turn, wrapped
from sitl.autopilot.offboard import SAME_PLACE_M, Companion, clamped, facing, steered, wants_to_move
from sitl.autopilot.plan import FlightPlan, Leg, MissionProgress, MissionStep
from sitl.autopilot.setpoint import Setpoint

INFO, WARNING = mavlink.MAV_SEVERITY_INFO, mavlink.MAV_SEVERITY_WARNING
CRITICAL, EMERGENCY = mavlink.MAV_SEVERITY_CRITICAL, mavlink.MAV_SEVERITY_EMERGENCY
EMPTY = "battery empty"
# What GF_ACTION does when the fence is left, and the mode that it changes to, if any.
FENCE_ACTIONS: dict[int, tuple[Mode | None, str]] = {
    FENCE_HOLD: (Mode.HOLD, "holding"),
    FENCE_RETURN: (Mode.RETURN, "returning"),
    FENCE_LAND: (Mode.LAND, "landing"),
    FENCE_TERMINATE: (None, "motors stopped"),
}


class Breaches(NamedTuple):
    """How often and when the fence was left."""

    outside: bool = False  # true while the vehicle is outside
    times: int = 0
    last_s: float = 0.0  # time of the last breach; 0 if there was none


class State(NamedTuple):
    """The vehicle at one instant.

    Vectors are NED from home, in m, m/s and m/s²; angles in rad, yaw clockwise from north.
    """

    time_s: float
    position: Ned
    velocity: Ned
    acceleration: Ned
    roll: float
    pitch: float
    yaw: float
    yaw_rate: float
    mode: Mode
    armed: bool
    landed_state: int  # MAV_LANDED_STATE
    failsafe: bool
    battery: float  # remaining charge, 0 to 1
    fit: bool  # false if the battery is empty or the vehicle is falling: it then cannot be armed
    target: Ned  # where the current path ends
    cruise: Ned | None = None  # the velocity that a companion asks for, within the limits, if it asks for one
    mission: MissionProgress = MissionProgress()
    breaches: Breaches = Breaches()


class Battery:
    """A battery that drains evenly with the motors on. Times in s of simulation time."""

    def __init__(self) -> None:
        self.alarms = 0  # how many it has given: 1 since it was low, 2 since it was empty
        self.on_s = math.inf  # when the motors were switched on; infinity while they are off
        self._spent_s = 0.0  # time used up before

    @property
    def empty(self) -> bool:
        """True once the last alarm was given."""
        return self.alarms == 2

    def switch_off(self, t_s: float) -> None:
        """Switch the motors off."""
        self._spent_s += t_s - self.on_s
        self.on_s = math.inf

    def next_alarm_s(self, endurance_s: float) -> float:
        """Return when the next alarm is due, low first, then empty; infinity if there is none."""
        if self.empty:
            return math.inf
        return self.on_s + endurance_s * (1.0 - LOW_BATTERY if self.alarms == 0 else 1.0) - self._spent_s

    def charge(self, t_s: float, endurance_s: float) -> float:
        """Return the remaining charge, 0 to 1."""
        return max(1.0 - (self._spent_s + max(t_s - self.on_s, 0.0)) / endurance_s, 0.0)


class Vehicle:
    """One simulated multirotor with its autopilot. It begins at its stand, at time 0, disarmed, battery full.

    Every command (`arm`, `disarm`, `take_off`, `go_to`, `set_mode`, `setpoint`, `load`, `set_current`) takes
    the simulation time in s and first handles all events due by then. Time that runs backwards raises
    ValueError. A refused command gives a reason and changes nothing. Programs call the commands directly;
    MAVLink clients reach them through `MavlinkProtocol`. Positions are NED, in m from home.
    """

    failure = ""  # it never gives a search up
    caveat = ""  # its position never jumps

    def __init__(self, config: VehicleConfig) -> None:
        self.config = config
        self.now_s = 0.0  # the current simulation time
        self.mode = Mode.HOLD
        self.armed = False  # whether its motors may turn
        self.moving = False  # True while the current path has not ended
        self.mission = FlightPlan()  # the mission on board; `load` changes it
        self.companion = Companion()  # the program that flies it in OFFBOARD
        self.is_searched = False  # whether its own search leads it: that need not stream setpoints

        self._events: list[VehicleEvent] = []
        self._battery = Battery()
        self._failsafe = False
        self._has_flown = False  # since it was armed
        self._path = Trajectory(0.0, (*config.stand, 0.0))
        heading = wrapped(math.radians(config.home_heading_deg))
        self._turn = turn(0.0, heading, heading, math.radians(config.yaw_rate_dps))
        self._leg: Leg | None = None  # of the mission, while one is flown
        self._left_s = math.inf  # when the path leaves the fence
        self._breaches = Breaches()
        self._climb_m, self._waits_since_s = 0.0, 0.0  # a take-off that waits for the motors
        self._alone_since_s = 0.0  # when OFFBOARD began to fly: silence counts from here at the earliest
        self._end_told: Ned | None = None  # where the end of a velocity was reported

    # ---- time ----

    def advance(self, t_s: float) -> list[VehicleEvent]:
        """Advance to a time; return the events since the last call, in order."""
        self.catch_up(t_s)
        events, self._events = self._events, []
        return events

    def catch_up(self, t_s: float) -> None:
        """Advance to a time; the next `advance` returns the events."""
        if not t_s >= self.now_s:
            raise ValueError(f"time runs backwards: {t_s} s after {self.now_s} s")
        while upcoming := [(at, happen) for at, happen in self._upcoming() if at <= t_s]:
            at, happen = min(upcoming, key=lambda event: event[0])
            self.now_s = max(at, self.now_s)
            happen()
        self.now_s = t_s

    def next_event_s(self) -> float | None:
        """Return the time of the next event if no message comes; None if there is none."""
        if self._events:
            return self.now_s
        return min((at for at, _ in self._upcoming() if at < math.inf), default=None)

    def _upcoming(self) -> list[tuple[float, Callable[[], None]]]:
        """The coming events with their handlers; of two at the same time the first listed comes first."""
        config, upcoming = self.config, [(self._path.end_s, self._settle)] if self.moving else []
        if not self.armed:
            if self.mode is Mode.TAKEOFF:
                upcoming.append((self._waits_since_s + config.disarm_preflight_s, self._forget_take_off))
            return upcoming
        upcoming.append((self._left_s, self._breach))
        if not self.moving:
            upcoming.append((self._item_done_s(), self._pass_item))
        if self.mode is Mode.OFFBOARD:
            upcoming.append((self._companion_lost_s(), self._lose_companion))
        upcoming.append((self._battery.next_alarm_s(config.endurance_s), self._alarm_battery))
        if self._on_ground:
            waits_s = config.disarm_landed_s if self._has_flown else config.disarm_preflight_s
            upcoming.append((max(self._battery.on_s, self._path.end_s) + waits_s, self._disarm_itself))
        return upcoming

    # ---- what it reports ----

    @property
    def busy(self) -> bool:
        """True while it waits for nobody: it flies, lands, or waits for a time of its mission."""
        waits = self.mode is Mode.LAND or self._item_done_s() < math.inf
        return self.moving or (self.armed and waits)

    @property
    def free(self) -> bool:
        """True while it stands on the ground and nobody flies it."""
        return self._on_ground and self.mode is Mode.HOLD

    @property
    def waypoint(self) -> Ned | None:
        """The last accepted setpoint if it is a position; None before the first."""
        return self.companion.setpoint.position if self.companion.setpoint else None

    @property
    def progress(self) -> MissionProgress:
        """How far the mission is."""
        return self.mission.progress(self.mode is Mode.MISSION, self.armed)

    def still(self, arrived: Arrived) -> Arrived:
        """Return the arrival as it is now, for another measurement: a simulated vehicle does not drift."""
        return arrived

    def state(self, t_s: float) -> State:
        """Return the state at a time between the current one and the next event."""
        position, velocity, acceleration = self._path.at(t_s)
        yaw, yaw_rate = self._turn.at(t_s)
        roll, pitch = tilt(acceleration, yaw)
        setpoint = self.companion.setpoint if self.armed and self.mode is Mode.OFFBOARD else None
        return State(
            time_s=t_s,
            position=position,
            velocity=velocity,
            acceleration=acceleration,
            roll=roll,
            pitch=pitch,
            yaw=yaw,
            yaw_rate=yaw_rate,
            mode=self.mode,
            armed=self.armed,
            landed_state=self._landed_state(),
            failsafe=self._failsafe,
            battery=self._battery.charge(t_s, self.config.endurance_s),
            fit=not self._unfit(),
            target=self._path.target,
            cruise=clamped(setpoint.velocity, self.config.limits) if setpoint and setpoint.velocity else None,
            mission=self.progress,
            breaches=self._breaches._replace(outside=bool(self.config.fence_refusal(position))),
        )

    def _landed_state(self) -> int:
        item = self._leg.step.command if self._leg and self.mode is Mode.MISSION else None
        if self._on_ground:
            return int(mavlink.MAV_LANDED_STATE_ON_GROUND)
        if self.mode is Mode.TAKEOFF or item == plan.TAKEOFF:
            return int(mavlink.MAV_LANDED_STATE_TAKEOFF)
        landing = self.mode is Mode.LAND or item == plan.LAND
        return int(mavlink.MAV_LANDED_STATE_LANDING if landing else mavlink.MAV_LANDED_STATE_IN_AIR)

    @property
    def _motion(self) -> Motion:
        return self._path.at(self.now_s)

    @property
    def _on_ground(self) -> bool:
        return not self.moving and self._path.target[2] >= 0.0

    def _unfit(self) -> str:
        """Why it cannot fly, or nothing."""
        if self.moving and not self.armed:
            return "falling"
        return EMPTY if self._battery.empty else ""

    def _say(self, severity: int, text: str) -> None:
        self._events.append(Said(self.now_s, severity, text))

    # ---- commands ----

    def configure(self, t_s: float, config: VehicleConfig) -> None:
        """Change the configuration. Limits of motion act from the next leg on."""
        self.catch_up(t_s)
        self.config = config
        self._watch_fence()

    def arm(self, t_s: float) -> Result:
        """Start the motors. A vehicle in OFFBOARD, MISSION or TAKEOFF begins to fly."""
        self.catch_up(t_s)
        if self.armed:
            return ACCEPTED
        if reason := self._unfit() or self._missing(self.mode):
            return not_now(f"Arming refused: {reason}")
        self.armed, self._has_flown = True, False
        self._battery.on_s = self.now_s
        self._fly_mode()
        return ACCEPTED

    def disarm(self, t_s: float, force: bool = False) -> Result:
        """Stop the motors. Refused in the air, unless forced: then the vehicle falls."""
        self.catch_up(t_s)
        if self.armed and self._on_ground:
            self._stop_motors()
        elif self.armed and not force:
            return not_now("Disarm refused: in the air")
        elif self.armed:
            self._drop()
        return ACCEPTED

    def take_off(self, t_s: float, altitude_m: float | None = None) -> Result:
        """Climb straight up to an altitude above home (default: `takeoff_altitude_m`), then hold.

        A disarmed vehicle waits `disarm_preflight_s` to be armed, in mode TAKEOFF; then it takes off, or
        goes back to HOLD.
        """
        self.catch_up(t_s)
        altitude = self.config.takeoff_altitude_m if altitude_m is None else altitude_m
        if not 0.0 < altitude <= self.config.ceiling_m:
            return denied(
                f"Take-off refused: altitude {metres(altitude)} m, "
                f"allowed is above 0 and up to {self.config.ceiling_m:g} m"
            )
        if self.mode is Mode.TAKEOFF and self._path.target[2] == -altitude:
            return ACCEPTED  # a client repeats the command if its acknowledgement was lost
        if reason := self._unfit() or ("" if self._on_ground else "already in the air"):
            return not_now(f"Take-off refused: {reason}")
        north, east, _ = self._motion.position
        if outside := self.config.fence_refusal((north, east, -altitude)):
            return denied(f"Take-off refused: {outside}")
        self._climb_m, self._waits_since_s, self._failsafe = altitude, self.now_s, False
        self._enter(Mode.TAKEOFF)
        return ACCEPTED

    def go_to(self, t_s: float, position: Ned, yaw_rad: float | None = None) -> Result:
        """Fly to a position and hold there, as MAV_CMD_DO_REPOSITION (192) asks; no reading is taken."""
        self.catch_up(t_s)
        if not self.armed or self._battery.empty:
            return not_now(f"Go-to refused: {EMPTY if self.armed else 'disarmed'}")
        if self._on_ground:
            return not_now("Go-to refused: on the ground")
        if outside := self.config.outside(position) or self.config.in_the_way(
            self._motion.position, position
        ):
            return denied(f"Go-to refused: {outside[1]}")
        self.mode, self._failsafe = Mode.HOLD, False
        self._go(position)
        self._face(yaw_rad)
        return ACCEPTED

    def set_mode(self, t_s: float, mode: Mode) -> Result:
        """Change the flight mode. OFFBOARD needs a recent setpoint, and if `stream_s` is finite a stream."""
        self.catch_up(t_s)
        if mode is Mode.TAKEOFF:
            return self.take_off(t_s)
        if mode is self.mode:
            return ACCEPTED
        reason = self._unfit()
        if mode is Mode.LAND and reason == EMPTY:
            reason = ""
        if not reason and mode in (Mode.RETURN, Mode.LAND) and self._on_ground:
            reason = "on the ground"
        if reason := reason or self._missing(mode):
            return not_now(f"{mode.name.capitalize()} refused: {reason}")
        self._failsafe = False
        self._enter(mode)
        return ACCEPTED

    def setpoint(self, t_s: float, wanted: Ned | Setpoint, answers: bool = False) -> Result:
        """Take a waypoint or another setpoint: follow it in OFFBOARD, else remember it.

        answers: it answers a reading, so the vehicle arrives there even if it is there already.
        """
        self.catch_up(t_s)
        setpoint = wanted if isinstance(wanted, Setpoint) else Setpoint(as_float32(wanted))
        if refusal := setpoint.refusal(self.config, self._motion.position):
            return refusal
        new = answers or not setpoint.same_way(self.companion.setpoint)
        self.companion.hear(setpoint, self.now_s)
        if self.armed and self.mode is Mode.OFFBOARD:
            self._take(setpoint, new)
        return ACCEPTED

    def load(self, t_s: float, steps: tuple[MissionStep, ...], number: int = 0, current: int = 0) -> None:
        """Replace the mission; a vehicle that flies one begins the new one, or holds if it is empty.

        number: the checksum of its items.
        """
        self.catch_up(t_s)
        self.mission = FlightPlan(steps, number, current)
        if self.mode is Mode.MISSION and not steps:
            self._say(WARNING, "Mission cleared: holding")
            self._enter(Mode.HOLD)
        elif self.mode is Mode.MISSION:
            self._fly_mode()

    def set_current(self, t_s: float, seq: int) -> Result:
        """Go on with another item of the mission, at once if it is being flown."""
        self.catch_up(t_s)
        count = len(self.mission.steps)
        if not 0 <= seq < count:
            allowed = f"allowed is 0 to {count - 1}" if count else "no mission on board"
            return denied(f"Mission item {seq} refused: {allowed}")
        self.mission.set_current(seq)
        if self.mode is Mode.MISSION:
            self._fly_mode()
        return ACCEPTED

    def _missing(self, mode: Mode) -> str:
        """What a mode still needs, or nothing."""
        if mode is Mode.OFFBOARD:
            return self.companion.missing(self.now_s, self._patience_s, self._wants_stream)
        if mode is not Mode.MISSION:
            return ""
        if not self.mission.steps:
            return "no mission on board"
        for seq, step in enumerate(self.mission.steps):  # area and fence may have changed since the upload
            if step.north_east and (outside := self.config.outside((*step.north_east, step.down_m))):
                return f"item {seq}: {outside[1]}"
        return ""

    # ---- modes ----

    def _enter(self, mode: Mode) -> None:
        self.mode = mode
        self._fly_mode()

    def _fly_mode(self) -> None:
        """Begin to fly as the mode says, if the motors are on."""
        if not self.armed:
            return
        match self.mode:
            case Mode.TAKEOFF:
                north, east, _ = self._motion.position
                self._go((north, east, -min(self._climb_m, self.config.ceiling_m)))
            case Mode.HOLD:
                if not self._on_ground:
                    self._fly(self._halted())
            case Mode.MISSION:
                self._fly_mission()
            case Mode.RETURN:
                self._return()
            case Mode.LAND:
                path = self._halted()
                self._fly(path.to((path.target[0], path.target[1], 0.0), self.config.limits))
            case Mode.OFFBOARD:
                assert self.companion.setpoint is not None
                self._alone_since_s = self.now_s
                self._take(self.companion.setpoint, True)

    def _settle(self) -> None:
        """Handle the end of the path."""
        self.moving = False
        if not self.armed:
            return  # the vehicle fell
        if self.mode is Mode.TAKEOFF:
            self.mode = Mode.HOLD
        elif self.mode is Mode.RETURN:
            self._enter(Mode.LAND)
        elif self.mode is Mode.OFFBOARD and self.waypoint is not None:
            self._events.append(Arrived(self.now_s, self._path.target))
        elif self.mode is Mode.OFFBOARD:
            self._steer_on()

    def _return(self) -> None:
        path, limits = self._halted(), self.config.limits
        north, east, down = path.target
        down = min(down, -self.config.return_altitude_m)
        end = self.config.rally.nearest(path.target, self.config.stand)
        self._fly(path.to((north, east, down), limits).to((*end, down), limits))

    # ---- the path ----

    def _fly(self, path: Trajectory) -> None:
        self._path, self.moving, self._turn = path, True, self._turn.stopped(self.now_s)
        self._has_flown |= path.target[2] < 0.0
        self._watch_fence()

    def _halted(self) -> Trajectory:
        return halt(self.now_s, self._motion, self.config.limits)

    def _go(self, target: Ned) -> None:
        self._fly(self._halted().to(target, self.config.limits))

    def _face(self, yaw_rad: float | None) -> None:
        if yaw_rad is not None:
            self._turn = facing(self._turn, self.now_s, Setpoint(yaw_rad=yaw_rad), self.config)

    def _take(self, setpoint: Setpoint, new: bool) -> None:
        """Follow a setpoint; one that is not new asks for the motion that is being flown."""
        if new and setpoint.position is not None:
            self._go(setpoint.position)
        elif new:
            self._fly(steered(setpoint, self.now_s, self._motion, self.config))
        self._turn = facing(self._turn, self.now_s, setpoint, self.config)

    def _steer_on(self) -> None:
        """A velocity has come to rest: go on if it leads elsewhere, such as along an edge; else say so."""
        setpoint, config, position = self.companion.setpoint, self.config, self._path.target
        assert setpoint is not None
        way = steered(setpoint, self.now_s, self._motion, config)
        if math.dist(way.target, position) > SAME_PLACE_M:
            turning, self._end_told = self._turn, None
            self._fly(way)
            self._turn = turning
        elif position != self._end_told and wants_to_move(setpoint, config.limits):
            self._end_told = position
            north, east, down = position
            self._say(
                WARNING,
                f"Setpoint ends at ({metres(east)}, {metres(north)}) m at {metres(-down)} m: "
                f"allowed is {config.flown.text} at [0, {config.ceiling_m:g}] m",
            )

    # ---- the mission ----

    def _fly_mission(self) -> None:
        """Fly the current item; hold at the end of the mission."""
        path = self._halted()
        self._leg = self.mission.leg(self.now_s, path.target, self._on_ground, self.config)
        if self._leg is None:
            self._say(INFO, "Mission finished")
            self._enter(Mode.HOLD)
        elif self._leg.step.command == plan.RETURN:
            self._pass_item()
        else:
            for stop in self._leg.stops:
                path = path.to(stop, self._leg.limits)
            self._fly(path)
            self._face(self._leg.step.yaw_rad)

    def _item_done_s(self) -> float:
        """When the item that is flown is done: after its flight, turn and wait; infinity if there is none."""
        if self.mode is not Mode.MISSION or self._leg is None:
            return math.inf
        return max(self._path.end_s, self._turn.end_s) + self._leg.step.wait_s

    def _pass_item(self) -> None:
        """Report that the current item is done, and go on with the next.

        A return home is another mode's: nothing is reached, as in PX4.
        """
        assert self._leg is not None
        step, self._leg = self._leg.step, None
        if step.command != plan.RETURN:
            self.mission.reached = self.mission.current, self.now_s
            self._events.append(Reached(self.now_s, self.mission.current))
        if not step.goes_on:
            return
        self.mission.current += 1
        if step.command == plan.RETURN and not self._on_ground:
            self.mission.end()
            self._enter(Mode.RETURN)
        else:
            self._fly_mission()

    # ---- the fence ----

    def _watch_fence(self, outside: bool = False) -> None:
        """Find out when the path leaves the fence next.

        outside: it leads away from the edge, so it has to come in first.
        """
        self._left_s = math.inf
        if self.armed and self.config.guards:
            outside = outside or not self.config.fence.allows(self._motion.position)
            self._left_s = self.config.fence.left_s(self._path, self.now_s, outside)

    def _breach(self) -> None:
        """The path leaves the fence: do what GF_ACTION says.

        A vehicle that already returns or lands goes on with it, as in PX4.
        """
        self._breaches = Breaches(True, self._breaches.times + 1, self.now_s)
        mode, does = FENCE_ACTIONS.get(self.config.fence_action, (None, ""))
        if mode and self.mode in (Mode.RETURN, Mode.LAND):
            mode, does = None, ""
        north, east, _ = self._motion.position
        self._say(CRITICAL, f"Fence breached at ({east:.2f}, {north:.2f}) m" + (does and f": {does}"))
        if self.config.fence_action == FENCE_TERMINATE:
            self._drop()
        elif mode:
            self._failsafe = True
            self._enter(mode)
        self._watch_fence(outside=True)

    # ---- motors, battery, silence ----

    def _drop(self) -> None:
        """Stop the motors in the air."""
        self._say(EMERGENCY, "Motors stopped in the air")
        self._stop_motors()
        self._fly(fall(self.now_s, self._motion))

    def _stop_motors(self) -> None:
        self._battery.switch_off(self.now_s)
        self._turn = self._turn.stopped(self.now_s)
        self.armed, self.mode, self._failsafe = False, Mode.HOLD, False

    def _disarm_itself(self) -> None:
        if not self._has_flown:
            self._say(INFO, f"Disarmed: no take-off for {self.config.disarm_preflight_s:g} s")
        self._stop_motors()

    def _forget_take_off(self) -> None:
        self._say(INFO, f"Take-off given up: not armed for {self.config.disarm_preflight_s:g} s")
        self.mode = Mode.HOLD

    @property
    def _wants_stream(self) -> bool:
        return math.isfinite(self.config.stream_s) and not self.is_searched

    @property
    def _patience_s(self) -> float:
        """How long the companion may be silent."""
        return self.config.stream_s if self._wants_stream else self.config.silence_s

    def _companion_lost_s(self) -> float:
        """When the companion that flies the vehicle counts as lost, if it says nothing more.

        A leg may take longer than it may be silent, so silence counts from the end of a leg to a position,
        unless it must stream.
        """
        since_s = max(self.companion.heard_s, self._alone_since_s)
        if self.waypoint is not None and not self._wants_stream:
            since_s = max(since_s, self._path.end_s)
        return since_s + self._patience_s

    def _lose_companion(self) -> None:
        self._fail_safe(f"No setpoint for {round(self._patience_s, 1):g} s", Mode.RETURN, "returning home")

    def _alarm_battery(self) -> None:
        """Warn when the battery is low, as PX4 does by default; land on the spot when it is empty."""
        self._battery.alarms += 1
        if self._battery.empty:
            self._fail_safe("Battery empty", Mode.LAND, "landing")
        else:
            self._say(WARNING, f"Battery low: {LOW_BATTERY:.0%} left")

    def _fail_safe(self, why: str, mode: Mode, does: str) -> None:
        """Change the mode in the air; on the ground, stop the motors."""
        self._say(CRITICAL, f"{why}: {'disarmed' if self._on_ground else does}")
        if self._on_ground:
            self._stop_motors()
            return
        self._failsafe = True
        if self.mode is not mode:
            self._enter(mode)
