"""A real vehicle as its search flies it: commands go out over MAVLink, arrival is derived from telemetry."""

import math

from pymavlink.dialects.v20 import all as mavlink

from aircraft.config import AircraftConfig
from aircraft.mode import Mode
from aircraft.remote.arrival import Approach, ArrivalRule
from aircraft.remote.commander import AUTOPILOT, Commander
from aircraft.remote.known import Known
from aircraft.remote.preflight import WAITING, Preflight
from aircraft.remote.procedures import Procedures
from aircraft.remote.watch import COMING_DOWN, Watch
from aircraft.state import (
    ACCEPTED,
    ZERO,
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
from link.bus.mavlink import POSITION_ONLY

STREAM_HZ = 10.0
"""Setpoints a second of the vehicle's time to PX4, from before OFFBOARD on. It wants more than 2."""
SEND_AGAIN_S = 0.5
"""Time after which ArduPilot is sent a setpoint again that it has not read back; its target stands until
there is another.
"""
POLL_S = 0.05
INSIDE_M = 0.05
"""A reading is taken at least this far inside the area's edge."""
IGNORED_M = 0.5
"""A target that the autopilot reads back so far from the setpoint is not the setpoint."""
IGNORED_S = 5.0
"""A setpoint that is not read back for this long is ignored."""
COPIES = 5
"""A setpoint is ignored only once it has been sent this many times: at a high speed-up a lost one is sent
again late, by the clock of the vehicle.
"""


WIND_S = 5.0
"""A wind that was told so long ago is not known."""
ARRIVAL = ArrivalRule()


class RemoteVehicle:
    """One real multirotor, or its own simulator. Positions are NED, m from the search area's south-west
    corner, which is home.

    No call waits: a command begins, `mode` shows what is being done, and `advance` tells what comes of it.
    Times are s of the caller's clock, which runs as fast as the vehicle's own simulator. Setpoints go out
    only while the caller goes on calling: if it hangs, the autopilot's failsafe sees that they have
    stopped.
    """

    def __init__(
        self,
        config: AircraftConfig,
        commander: Commander,
        arrival: ArrivalRule = ARRIVAL,
        wait_s: float = math.inf,
        *,
        launched: bool = False,
    ) -> None:
        """Take the conversation with a vehicle, which need not be there yet; `config` says how high and
        how far it may fly.

        wait_s, launched: how long the search's begin is waited for, as `Preflight` says.
        """
        self.config = config
        self.is_searched = False
        """True while its search leads it."""
        self.flight = Procedures(commander)
        self.preflight = Preflight(self.flight, config, wait_s, launched=launched)
        self._guard = Watch(self.flight)
        self._commander, self._arrival = commander, arrival
        self._inset_m = arrival.radius_m + INSIDE_M
        self._now = 0.0
        self._corner: Ned | None = None  # of the area in the EKF's frame; known once home and origin are
        self._follows = False  # whether the companion's mode means OFFBOARD, not HOLD
        self._setpoint: Ned | None = None
        self._leg: Approach | None = None  # to the setpoint, until it is reached
        self._streamed_s = -math.inf
        self._ignored_since_s = math.inf
        self._heard_s = math.inf  # when the last waypoint came, or was reached

    # ---- time ----

    @property
    def now_s(self) -> float:
        """The time of the last call."""
        return self._now

    def catch_up(self, t_s: float) -> None:
        """Take what the vehicle has said; once for each time. Raises VehicleFailed if it cannot fly the
        search, or no longer.
        """
        if t_s <= self._now:
            return
        self._now = t_s
        self.flight.poll(self._now)
        self._place_area()
        self.preflight.look()
        self._guard.look(self._now)
        self._stream()

    def advance(self, t_s: float) -> list[VehicleEvent]:
        """Take what the vehicle has said; returns its texts and ours, and its arrival if there is one."""
        self.catch_up(t_s)
        heard = [
            Said(self._now, severity, f"{self.flight.firmware.name}: {text}", heard=True)
            for severity, text in self._known.texts
        ]
        events: list[VehicleEvent] = [*self.flight.events, *heard]
        self._known.texts.clear()
        self.flight.events.clear()
        if self._leg and self._flies_leg:
            self._go_on_with(self._leg, events)
        elif self.mode is Mode.OFFBOARD and self._now - self._heard_s > self.config.silence_s:
            self.flight.fail(f"No waypoint for {self.config.silence_s / self._commander.speedup:g} s")
        return events

    def next_event_s(self) -> float | None:
        """Return when to look again."""
        return self._now + POLL_S

    @property
    def moving(self) -> bool:
        """True while it flies to a setpoint, or is armed and not at rest."""
        return self._known.armed and (
            self._flies_leg or math.hypot(*self._known.velocity) > self._arrival.speed_mps
        )

    @property
    def busy(self) -> bool:
        """True while it moves: there is nothing else that it would do by itself."""
        return self.moving

    @property
    def free(self) -> bool:
        """True while it stands on the ground and no pilot has begun to fly it."""
        return not self.flight.flying and not self.moving and self.mode is Mode.HOLD

    @property
    def armed(self) -> bool:
        """True while its motors may turn."""
        return self._known.armed

    @property
    def wind(self) -> tuple[float, float] | None:
        """(u cos φ, u sin φ) m/s, to where the wind comes from, as float32; None where the autopilot does
        not tell, or no longer.
        """
        if self._known.wind is None or self._now - self._known.wind_s > self._commander.patient(WIND_S):
            return None
        x, y, _ = as_float32((*self._known.wind, 0.0))
        return x, y

    @property
    def system(self) -> int:
        """The autopilot's system id; 0 until one is found."""
        return self._commander.system

    @property
    def doubtful(self) -> bool:
        """Whether its position cannot be trusted now, because of a GPS glitch."""
        return self._known.glitches.lasts(self._now)

    def arrive_again(self) -> None:
        """Let the next arrival be at the same waypoint, once the position can be trusted: a reading was in
        vain.
        """
        assert self._setpoint
        self._leg = Approach(
            self._arrival, self._setpoint, self._arrival.deadline_s(self._now, self.position, self._setpoint)
        )

    def still(self, arrived: Arrived) -> Arrived:
        """Return the arrival as it is now: where it has drifted to since."""
        return Arrived(self._now, self.position, self._known.position_ms)

    # ---- what its clients say and hear ----

    def frames(self) -> list[bytes]:
        """Return what the autopilot has said since the last call, frame by frame, unchanged."""
        return self._commander.radio.frames()

    def forward(self, frame: bytes, asks_for_mode: str = "") -> None:
        """Hand a client's frame on to the autopilot, unchanged. asks_for_mode: who sent it, if it may
        change the flight mode.
        """
        if asks_for_mode:
            self.flight.asked_by(asks_for_mode)
        self._commander.radio.forward(frame)

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
        if self.flight.flying:
            return not_now("Take-off refused: already in the air")
        if self.flight.theirs or not self.flight.armed_by_us:
            return not_now("Take-off waits: a pilot has armed it")
        self._follows = False
        self.flight.take_off(altitude)
        return ACCEPTED

    def set_mode(self, t_s: float, mode: Mode) -> Result:
        """Begin to change the flight mode to OFFBOARD, HOLD, RETURN or LAND; OFFBOARD needs a setpoint."""
        name = mode.name.capitalize()
        if mode is self.mode and not self.flight.theirs:
            return ACCEPTED
        if not self.flight.flying:
            return not_now(f"{name} refused: on the ground")
        if mode is Mode.OFFBOARD and self._setpoint is None:
            return not_now("Offboard refused: no setpoint received yet")
        self._follows = mode is Mode.OFFBOARD
        {
            Mode.OFFBOARD: self.flight.fly,
            Mode.HOLD: self.flight.hold,
            Mode.RETURN: self.flight.go_home,
            Mode.LAND: self.flight.land,
        }[mode]()
        return ACCEPTED

    def setpoint(self, t_s: float, wanted: Ned, *, answers: bool = False) -> Result:
        """Take a waypoint as the simulated vehicle does: fly there in OFFBOARD, else remember it. The yaw
        is the autopilot's.

        The agent answers with the altitude that it has read, which is never exactly the one flown: the
        search's altitude is kept, or the vehicle would drift up or down from reading to reading. A
        waypoint on the area's edge is flown a little inside, so that the reading is taken inside, wherever
        around it the vehicle comes to rest.
        """
        wanted = as_float32(wanted)
        if outside := self.config.outside(wanted):
            return denied(f"Waypoint refused: {outside[1]}", outside[0])
        north, east = (
            min(max(along_m, self._inset_m), self.config.area_m - self._inset_m) for along_m in wanted[:2]
        )
        down = -self.config.takeoff_altitude_m if answers else wanted[2]
        if answers or (north, east, down) != self._setpoint:
            self._setpoint = as_float32((north, east, down))
        deadline_s = self._arrival.deadline_s(self._now, self.position, self._setpoint)
        deadline_s = max(deadline_s, self._now + 2 * COPIES * self._commander.patient(SEND_AGAIN_S))
        if self._leg is None or answers or self._leg.target != self._setpoint:
            self._leg, self._ignored_since_s = Approach(self._arrival, self._setpoint, deadline_s), math.inf
        self._leg.deadline_s = deadline_s
        self._heard_s, self._streamed_s = self._now, -math.inf
        self._stream()
        return ACCEPTED

    @property
    def waypoint(self) -> Ned | None:
        """The last accepted setpoint; None before the first."""
        return self._setpoint

    def leave(self) -> str:
        """Send a vehicle home that nobody else is in charge of; returns what becomes of it, nothing if it
        stands on the ground.

        Call it, and `catch_up`, again and again until `left`.
        """
        if not self.flight.flying:
            if (self._known.armed or self.flight.arming) and self.flight.in_charge:
                self._commander.send(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0)
            return ""
        if self.left:
            return f"The vehicle is left in {self._mode_name}"
        if self.flight.doing not in COMING_DOWN:
            self.flight.go_home()
            self.flight.go_on()  # at once: `catch_up` may fail
        return "The vehicle is told to return home"

    @property
    def failure(self) -> str:
        """Why the vehicle has given the search up; empty if it has not."""
        return self.flight.failure

    @property
    def caveat(self) -> str:
        """What its readings have to be read with, because of GPS glitches; empty if there was none."""
        return self._known.glitches.caveat

    @property
    def left(self) -> bool:
        """Whether someone else is in charge of it: a pilot, or the autopilot, which returns or lands by
        itself.
        """
        return (
            not (self.flight.flying and self.flight.in_charge)
            or self.flight.firmware.reports.get(self._known.custom_mode) in COMING_DOWN
        )

    # ---- flight ----

    @property
    def _known(self) -> Known:
        return self._commander.known

    @property
    def _mode_name(self) -> str:
        return self.flight.firmware.mode_name(self._known.custom_mode)

    @property
    def mode(self) -> Mode:
        """The mode in the search's words: what is being done about it counts. One that only pilots fly is
        HOLD: the search has no part.
        """
        if self.flight.doing:
            return self.flight.doing
        mode = (
            self.flight.firmware.reports.get(self._known.custom_mode, Mode.HOLD)
            if self._known.armed
            else Mode.HOLD
        )
        return Mode.HOLD if mode is Mode.OFFBOARD and (self.flight.theirs or not self._follows) else mode

    @property
    def _flies_leg(self) -> bool:
        return (
            self._leg is not None
            and self.mode is Mode.OFFBOARD
            and self.flight.doing is None
            and self.flight.flying
        )

    @property
    def position(self) -> Ned:
        """Where it says it is, in the area's frame, as float32."""
        north, east, down = (
            there - at for there, at in zip(self._known.position, self._area_at, strict=True)
        )
        return as_float32((north, east, down))

    @property
    def _area_at(self) -> Ned:
        """The area's corner in the EKF's frame. When the position jumps, it moves as well: the vehicle,
        and the area, have stayed.
        """
        north, east, down = self._corner or ZERO
        shift = self._known.glitches.shift
        return north + shift[0], east + shift[1], down

    def _place_area(self) -> None:
        """Place the area at home; until the take-off home may still move."""
        known = self._known
        if known.origin is None or known.home is None or self.flight.flying:
            return
        self._corner = known.to_home()

    def _go_on_with(self, leg: Approach, events: list[VehicleEvent]) -> None:
        """Judge the way to the setpoint by what the vehicle says."""
        (north, east, _), away_m = leg.target, math.dist(self.position, leg.target)
        if self._known.lost(self._now) or self._known.glitches.lasts(
            self._now
        ):  # nothing can be said about it meanwhile
            leg.deadline_s = max(
                leg.deadline_s, self._arrival.deadline_s(self._now, self.position, leg.target)
            )
        if leg.arrived(
            self._known.position_ms / 1000.0,
            self.position,
            self._known.velocity,
            self._known.trusts_place(self._now),
        ):
            self._leg, self._heard_s = None, self._now
            self._known.glitches.read_s = self._now
            events.append(Arrived(self._now, self.position, self._known.position_ms))
        elif self._is_ignored(leg.target):
            self.flight.fail(
                f"Waypoint ({east:.2f}, {north:.2f}) m is ignored by the autopilot: is it outside its "
                "geofence?"
            )
        elif self._now > leg.deadline_s:
            self.flight.fail(f"Waypoint ({east:.2f}, {north:.2f}) m not reached in time: {away_m:.1f} m away")

    def _is_ignored(self, target: Ned) -> bool:
        """Whether ArduPilot reads back another target: it ignores what it does not take without a word."""
        said_s = self._known.came_s.get(mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED, -math.inf)
        reads_back = self.flight.firmware.is_ardupilot and self._now - said_s <= self._known.stale_s
        taken = (
            self._known.target is not None
            and math.dist(self._known.target, self._in_ekf_frame(target)) <= IGNORED_M
        )
        self._ignored_since_s = (
            min(self._ignored_since_s, self._now) if reads_back and not taken else math.inf
        )
        return self._now - self._ignored_since_s > max(
            IGNORED_S, COPIES * self._commander.patient(SEND_AGAIN_S)
        )

    def _in_ekf_frame(self, position: Ned) -> Ned:
        north, east, down = (there + at for there, at in zip(position, self._area_at, strict=True))
        return north, east, down

    def _stream(self) -> None:
        """Send the setpoint while it is flown: to PX4 all the time, to ArduPilot until it reads it back.

        A stream would hide the target of a ground station, which is the pilot's.
        """
        ardupilot = self.flight.firmware.is_ardupilot
        every_s = self._commander.patient(SEND_AGAIN_S) if ardupilot else 1.0 / STREAM_HZ
        if not self.flight.streams or self._setpoint is None or self._now - self._streamed_s < every_s:
            return
        place = self._in_ekf_frame(self._setpoint)
        if ardupilot and (self._known.custom_mode != self.flight.guided or self.flight.targets.has(place)):
            return  # PX4 wants them before it takes OFFBOARD
        self._streamed_s = self._now
        self.flight.targets.send(place)
        milliseconds = round(self._now * 1000) & 0xFFFFFFFF
        self._commander.radio.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                milliseconds,
                self._commander.system,
                AUTOPILOT,
                mavlink.MAV_FRAME_LOCAL_NED,
                POSITION_ONLY,
                *place,
                *[0.0] * 8,
            )
        )
