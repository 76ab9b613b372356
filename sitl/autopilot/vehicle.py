"""The autopilot: a state machine in simulation time that flies, refuses commands and fails safe like a PX4
quadrotor.

It is a deterministic function of its configuration, the commands with their times, and the time. `advance`
handles each event at its exact, closed-form time: one jump and a thousand small steps give the same events
and the same positions, bit for bit.
"""

import math
from collections.abc import Callable

from pymavlink.dialects.v20 import common as mavlink

from aircraft.mode import Mode
from aircraft.state import (
    ACCEPTED,
    LOW_BATTERY,
    Arrived,
    Ned,
    Result,
    VehicleEvent,
    as_float32,
    denied,
    metres,
    not_now,
)
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.motion import Trajectory, tilt
from sitl.autopilot.navigator import Navigator
from sitl.autopilot.setpoint import Companion, Setpoint, facing
from sitl.autopilot.state import State


class Vehicle(Navigator):
    """One simulated multirotor with its autopilot.

    Every command (`arm`, `disarm`, `take_off`, `go_to`, `set_mode`, `setpoint`) takes the simulation time
    in s and first handles all events due by then. Time that runs backwards raises ValueError. Programs
    call the commands directly; MAVLink clients reach them through `sitl.protocol.protocol`. Positions are
    NED, in m from home.
    """

    failure = ""
    """It never gives a search up."""
    caveat = ""
    """Its position never jumps."""

    def __init__(self, config: VehicleConfig) -> None:
        """Start at home at time 0, disarmed, with a full battery."""
        super().__init__(config)
        self.companion = Companion()
        """Who flies it in OFFBOARD, and the newest setpoint."""
        self._alone_since_s = (
            0.0  # when OFFBOARD began to fly: a client's silence counts from here at the earliest
        )
        self._climb_m, self._waits_since_s = 0.0, 0.0  # a take-off that waits for the motors

    # ---- time ----

    def advance(self, t_s: float) -> list[VehicleEvent]:
        """Advance to a time; return the events since the last call, in order."""
        self.catch_up(t_s)
        events, self._events = self._events, []
        return events

    def catch_up(self, t_s: float) -> None:
        """Advance to a time; the next `advance` returns the events. Raises ValueError if the time runs
        backwards.
        """
        if not t_s >= self._now:
            raise ValueError(f"time runs backwards: {t_s} s after {self._now} s")
        while upcoming := [(at, happen) for at, happen in self._upcoming() if at <= t_s]:
            at, happen = min(upcoming, key=lambda event: event[0])
            self._now = max(at, self._now)
            happen()
        self._now = t_s

    def next_event_s(self) -> float | None:
        """Time of the next event if no message comes (leg end, touchdown, setpoint timeout, battery); None
        if there is none.
        """
        if self._events:
            return self._now
        return min((at for at, _ in self._upcoming() if at < math.inf), default=None)

    @property
    def now_s(self) -> float:
        """The current simulation time."""
        return self._now

    @property
    def mode(self) -> Mode:
        """The flight mode."""
        return self._mode

    @property
    def armed(self) -> bool:
        """True while its motors may turn."""
        return self._armed

    @property
    def moving(self) -> bool:
        """True while the current path has not ended; its end is then one of the coming events."""
        return not self._settled

    @property
    def landing(self) -> bool:
        """True from the beginning of a landing until the motors have stopped."""
        return self._armed and self._mode is Mode.LAND

    @property
    def busy(self) -> bool:
        """True while it waits for nobody: it flies, lands, or waits for a time of its mission."""
        return self.moving or self.landing or self.waiting

    @property
    def free(self) -> bool:
        """True while it stands on the ground and nobody flies it."""
        on_ground = self._landed_state() == mavlink.MAV_LANDED_STATE_ON_GROUND
        return on_ground and not self.moving and self._mode is Mode.HOLD

    @property
    def is_searched(self) -> bool:
        """True while its search leads it: that need not stream setpoints."""
        return self.companion.is_own_search

    @is_searched.setter
    def is_searched(self, leads: bool) -> None:
        self.companion.is_own_search = leads

    def still(self, arrived: Arrived) -> Arrived:
        """Return the arrival as it is now, for another measurement: a simulated vehicle does not drift."""
        return arrived

    def state(self, t_s: float) -> State:
        """The state at a time between the current one and the next event."""
        position, velocity, acceleration = self._path.at(t_s)
        yaw, yaw_rate = self._turn.at(t_s)
        roll, pitch = tilt(acceleration, yaw)
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
            landed_state=self._landed_state(),
            failsafe=self._failsafe,
            battery=self._battery.charge(t_s, self.config.endurance_s),
            fit=not (self._battery.empty or self._falling),
            target=self._path.target,
            cruise=self.companion.cruise(self.config)
            if self._armed and self._mode is Mode.OFFBOARD
            else None,
            mission=self.progress,
            breaches=self._breaches._replace(outside=bool(self.config.fence_refusal(position))),
        )

    def _upcoming(self) -> list[tuple[float, Callable[[], None]]]:
        """The coming events, each with its time and handler; of two at the same time, the first listed is
        handled first.
        """
        upcoming: list[tuple[float, Callable[[], None]]] = []
        if not self._settled:
            upcoming.append((self._path.end_s, self._settle))
        if self._armed:
            upcoming.append((self._left_s, self._breach))
        if self._armed and self._settled:
            upcoming.append((self._item_done_s(), self._pass_item))
        if self._armed and self._mode is Mode.OFFBOARD:
            upcoming.append(
                (self.companion.lost_s(self._alone_since_s, self._path.end_s, self.config), self._lose_client)
            )
        if not self._armed and self._mode is Mode.TAKEOFF:
            upcoming.append((self._waits_since_s + self.config.disarm_preflight_s, self._forget_take_off))
        if self._armed:
            upcoming.append((self._battery.next_alarm_s(self.config.endurance_s), self._alarm_battery))
        if self._armed and self._on_ground:
            waits_s = self.config.disarm_landed_s if self._has_flown else self.config.disarm_preflight_s
            upcoming.append((max(self._battery.on_s, self._path.end_s) + waits_s, self._disarm_itself))
        return upcoming

    def _settle(self) -> None:
        """Handle the end of the path."""
        self._settled = True
        if not self._armed:
            return  # the vehicle fell
        match self._mode:
            case Mode.TAKEOFF:
                self._mode = Mode.HOLD
            case Mode.OFFBOARD if self.waypoint is not None:
                self._events.append(Arrived(self._now, self._path.target))
            case Mode.OFFBOARD:
                self._steer_on()
            case Mode.RETURN:
                self._mode = Mode.LAND
                self._descend()

    def _disarm_itself(self) -> None:
        if not self._has_flown:
            self._say(
                mavlink.MAV_SEVERITY_INFO, f"Disarmed: no take-off for {self.config.disarm_preflight_s:g} s"
            )
        self._stop_motors()

    def _forget_take_off(self) -> None:
        self._say(
            mavlink.MAV_SEVERITY_INFO,
            f"Take-off given up: not armed for {self.config.disarm_preflight_s:g} s",
        )
        self._mode = Mode.HOLD

    def _lose_client(self) -> None:
        self._failsafe = True
        silence = f"No setpoint for {self.companion.borne_s(self.config):g} s"
        if self._on_ground:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, f"{silence}: disarmed")
            self._stop_motors()
        else:
            self._say(mavlink.MAV_SEVERITY_CRITICAL, f"{silence}: returning home")
            self._return()

    def _alarm_battery(self) -> None:
        """Warn when the battery is low, as PX4 does by default; land on the spot when it is empty."""
        self._battery.alarms += 1
        if not self._battery.empty:
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

    # ---- commands: a refused command gives a reason and changes nothing ----

    def configure(self, t_s: float, config: VehicleConfig) -> None:
        """Change the configuration. The leg under way goes on as it is; limits of motion act from the next
        leg on.
        """
        self.catch_up(t_s)
        self.config = config
        self._watch_fence()

    def arm(self, t_s: float) -> Result:
        """Arm: start the motors. A vehicle armed in OFFBOARD follows its setpoint, one armed in TAKEOFF
        takes off.
        """
        self.catch_up(t_s)
        if self._armed:
            return ACCEPTED
        if self._falling:
            return not_now("Arming refused: falling")
        if self._battery.empty:
            return not_now("Arming refused: battery empty")
        if self._mode is Mode.OFFBOARD and (missing := self.companion.missing(self._now, self.config)):
            return not_now(f"Arming refused: {missing}")
        if self._mode is Mode.MISSION and (missing := self._missing_mission()):
            return not_now(f"Arming refused: {missing}")
        self._armed, self._has_flown = True, False
        self._battery.switch_on(self._now)
        if self._mode is Mode.OFFBOARD:
            self._follow()
        elif self._mode is Mode.MISSION:
            self._fly_mission()
        elif self._mode is Mode.TAKEOFF:
            self._climb()
        return ACCEPTED

    def disarm(self, t_s: float, force: bool = False) -> Result:
        """Disarm: stop the motors. Refused in the air, unless forced: then the vehicle falls."""
        self.catch_up(t_s)
        if not self._armed:
            return ACCEPTED
        if self._on_ground:
            self._stop_motors()
            return ACCEPTED
        if not force:
            return not_now("Disarm refused: in the air")
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
                f"Take-off refused: altitude {metres(altitude)} m, allowed is above 0 and up to "
                f"{self.config.ceiling_m:g} m"
            )
        if self._mode is Mode.TAKEOFF and self._path.target[2] == -altitude:
            return ACCEPTED  # a client repeats the command if its acknowledgement was lost
        if self._falling or self._battery.empty:
            return not_now(f"Take-off refused: {'falling' if self._falling else 'battery empty'}")
        if not self._on_ground:
            return not_now("Take-off refused: already in the air")
        north, east, _ = self._motion.position
        if outside := self.config.fence_refusal((north, east, -altitude)):
            return denied(f"Take-off refused: {outside}")
        self._mode, self._failsafe = Mode.TAKEOFF, False
        self._climb_m, self._waits_since_s = altitude, self._now
        if self._armed:
            self._climb()
        return ACCEPTED

    def go_to(self, t_s: float, position: Ned, yaw_rad: float | None = None) -> Result:
        """Fly to a position and hold there, as MAV_CMD_DO_REPOSITION (192) asks; no reading is taken."""
        self.catch_up(t_s)
        if not self._armed or self._battery.empty:
            return not_now(f"Go-to refused: {'battery empty' if self._armed else 'disarmed'}")
        if self._on_ground:
            return not_now("Go-to refused: on the ground")
        if outside := self.config.outside(position):
            return denied(f"Go-to refused: {outside[1]}")
        self._mode, self._failsafe = Mode.HOLD, False
        self._go(position)
        self._face(yaw_rad)
        return ACCEPTED

    def set_mode(self, t_s: float, mode: Mode) -> Result:
        """Change the flight mode; OFFBOARD needs a setpoint that is at most `silence_s` old, or, if
        `stream_s` is finite, a stream.
        """
        self.catch_up(t_s)
        if mode is Mode.TAKEOFF:
            return self.take_off(t_s)
        if mode is self._mode:
            return ACCEPTED
        name = mode.name.capitalize()
        if self._falling:
            return not_now(f"{name} refused: falling")
        if self._battery.empty and mode is not Mode.LAND:
            return not_now(f"{name} refused: battery empty")
        match mode:
            case Mode.OFFBOARD:
                if missing := self.companion.missing(self._now, self.config):
                    return not_now(f"Offboard refused: {missing}")
                self._mode = mode
                if self._armed:
                    self._follow()
            case Mode.MISSION:
                if missing := self._missing_mission():
                    return not_now(f"Mission refused: {missing}")
                self._mode = mode
                if self._armed:
                    self._fly_mission()
            case Mode.RETURN | Mode.LAND:
                if self._on_ground:
                    return not_now(f"{name} refused: on the ground")
                if mode is Mode.RETURN:
                    self._return()
                else:
                    self._mode = mode
                    self._descend()
            case _:
                self._hold()
        self._failsafe = False
        return ACCEPTED

    def setpoint(
        self, t_s: float, wanted: Ned | Setpoint, yaw_rad: float | None = None, answers: bool = False
    ) -> Result:
        """Take a waypoint or another setpoint: follow it in OFFBOARD, else remember it.

        answers: it answers a reading, so the vehicle arrives there even if it is there already.
        """
        self.catch_up(t_s)
        setpoint = wanted if isinstance(wanted, Setpoint) else Setpoint(as_float32(wanted), yaw_rad=yaw_rad)
        if refusal := setpoint.refusal(self.config):
            return refusal

        new = answers or not setpoint.same_way(self.companion.setpoint)
        self.companion.hear(setpoint, self._now)
        if self._armed and self._mode is Mode.OFFBOARD:
            self._take(setpoint, new)
        return ACCEPTED

    @property
    def waypoint(self) -> Ned | None:
        """The last accepted setpoint if it is a position; None before the first."""
        return self.companion.setpoint.position if self.companion.setpoint else None

    # ---- flight ----

    def _climb(self) -> None:
        north, east, _ = self._motion.position
        self._go((north, east, -min(self._climb_m, self.config.ceiling_m)))

    def _follow(self) -> None:
        """Begin OFFBOARD flight: follow the remembered setpoint."""
        assert self.companion.setpoint is not None
        self._alone_since_s = self._now
        self._take(self.companion.setpoint, True)

    def _take(self, setpoint: Setpoint, new: bool) -> None:
        if new and setpoint.position is not None:
            self._go(setpoint.position)
        elif new:
            self._fly(setpoint.steered(self._now, self._motion, self.config))
        self._turn = facing(self._turn, self._now, setpoint, self.config)

    def _steer_on(self) -> None:
        """A velocity or an acceleration has come to rest: go on if it leads elsewhere, such as along the
        edge, else tell.
        """
        turn, on = self._turn, self.companion.goes_on(self._now, self._motion, self.config)
        if isinstance(on, Trajectory):
            self._fly(on)
            self._turn = turn
        elif on:
            self._say(mavlink.MAV_SEVERITY_WARNING, on)
