"""The way to a real vehicle's waypoint: it is sent until the autopilot takes it, and then flown or failed."""

import math

from pymavlink.dialects.v20 import all as mavlink

from aircraft.operator import AUTOPILOT
from aircraft.remote.procedures import Procedures
from aircraft.state import AircraftConfig, Arrived, Ned, Result, as_float32, denied
from link.bus.mavlink import POSITION_ONLY

# Setpoints a second of the vehicle's time to PX4, from before OFFBOARD on. It wants more than 2.
STREAM_HZ = 10.0
# Time after which ArduPilot is sent a setpoint again that it has not read back; its target stands until there
# is another.
SEND_AGAIN_S = 0.5
INSIDE_M = 0.05  # a reading is taken at least this far inside the area's edge
IGNORED_M = 0.5  # a target that the autopilot reads back this far from the setpoint is not the setpoint
IGNORED_S = 5.0  # a setpoint that is not read back for this long is ignored
# A setpoint is ignored only once it has been sent this many times: at a high speed-up a lost one is sent
# again late, by the clock of the vehicle, and whoever is held up sends none.
COPIES = 5
# It arrives once it has stayed this near to its target, no faster than this, for this long.
RADIUS_M, SPEED_MPS, SETTLE_S = 0.3, 0.25, 0.3
SLOWEST_MPS, GRACE_S = 1.0, 30.0  # a leg has failed that takes longer than at this speed, and this much more


def deadline_s(now_s: float, position: Ned, target: Ned) -> float:
    """Return when a leg that begins now has failed."""
    return now_s + math.dist(position, target) / SLOWEST_MPS + GRACE_S


class Approach:
    """The way to one target, judged by telemetry. Positions NED in m, times in s."""

    def __init__(self, target: Ned, deadline_s: float) -> None:
        self.target, self.deadline_s = target, deadline_s
        self._near_since_s = math.inf

    def arrived(self, at_s: float, position: Ned, velocity: Ned, known: bool) -> bool:
        """Take where the vehicle is, at a time of its own clock.

        Returns whether it has arrived; with a position not `known`, it has not.

        By the vehicle's clock, what a slow or halting link takes is no time at rest.
        """
        near = math.dist(position, self.target) <= RADIUS_M and math.hypot(*velocity) <= SPEED_MPS
        self._near_since_s = min(self._near_since_s, at_s) if near and known else math.inf
        return at_s - self._near_since_s >= SETTLE_S


class Course:
    """The newest waypoint of a search and the way to it. Places are NED, m from the area's corner."""

    def __init__(self, flight: Procedures, config: AircraftConfig) -> None:
        self.waypoint: Ned | None = None  # the last accepted one
        self.heard_s = math.inf  # when it came, or was reached
        self._flight, self._known, self._commander = flight, flight.known, flight.commander
        self._config = config
        self.approach: Approach | None = None  # until the waypoint is reached
        self._sent_s = -math.inf
        # Since when the waypoint is not read back, and how often it has been sent since then.
        self._unread_since_s, self._copies = 0.0, 0

    def begin(self, wanted: Ned, *, answers: bool) -> Result | None:
        """Take a waypoint; returns why it is refused. `answers`: it answers a reading.

        The agent answers with the altitude that it has read, which is never exactly the one flown: the
        search's altitude is kept, or the vehicle would drift up or down from reading to reading. A
        waypoint on the area's edge is flown a little inside, so that the reading is taken inside, wherever
        around it the vehicle comes to rest.
        """
        wanted = as_float32(wanted)
        if outside := self._config.outside(wanted) or self._config.in_the_way(self._known.place, wanted):
            return denied(f"Waypoint refused: {outside[1]}", outside[0])
        inset_m = RADIUS_M + INSIDE_M
        area = self._config.area
        east, north = (
            min(max(along_m, low + inset_m), high - inset_m)
            for low, along_m, high in zip(area.low, (wanted[1], wanted[0]), area.high, strict=True)
        )
        down = -self._config.takeoff_altitude_m if answers else wanted[2]
        if answers or (north, east, down) != self.waypoint:
            self.waypoint = as_float32((north, east, down))
        now_s = self.heard_s = self._commander.now_s
        if self.approach is None or answers or self.approach.target != self.waypoint:
            self.approach = Approach(self.waypoint, math.inf)
            self._unread_since_s, self._copies = now_s, 0
        self.approach.deadline_s = max(
            deadline_s(now_s, self._known.place, self.waypoint),
            now_s + 2 * COPIES * self._commander.patient(SEND_AGAIN_S),
        )
        self._sent_s = -math.inf
        self.send()
        return None

    def again(self) -> None:
        """Let the next arrival be at the same waypoint: a reading was in vain."""
        assert self.waypoint
        until_s = deadline_s(self._commander.now_s, self._known.place, self.waypoint)
        self.approach = Approach(self.waypoint, until_s)

    def send(self) -> None:
        """Send the waypoint while it is flown: to PX4 all the time, to ArduPilot until it reads it back.

        A stream would hide the target of a ground station, which is the pilot's.
        """
        flight, now_s, is_ardupilot = self._flight, self._commander.now_s, self._known.firmware.is_ardupilot
        every_s = self._commander.patient(SEND_AGAIN_S) if is_ardupilot else 1.0 / STREAM_HZ
        if not flight.streams or self.waypoint is None or now_s - self._sent_s < every_s:
            return
        place = self._known.in_ekf_frame(self.waypoint)
        if is_ardupilot and (self._known.custom_mode != flight.guided or flight.targets.has(place)):
            return  # PX4 wants them before it takes OFFBOARD
        self._sent_s = now_s
        self._copies += 1
        flight.targets.send(place)
        self._commander.radio.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                round(now_s * 1000) & 0xFFFFFFFF,
                self._commander.system,
                AUTOPILOT,
                mavlink.MAV_FRAME_LOCAL_NED,
                POSITION_ONLY,
                *place,
                *[0.0] * 8,
            )
        )

    def look(self) -> Arrived | None:
        """Judge the way by what the vehicle says; returns its arrival. If it fails, so does the flight."""
        approach, known, now_s = self.approach, self._known, self._commander.now_s
        if approach is None:
            return None
        place = known.place
        if known.lost(now_s) or known.glitches.lasts(now_s):  # nothing can be said about it meanwhile
            approach.deadline_s = max(approach.deadline_s, deadline_s(now_s, place, approach.target))
        at_s, trusted = known.position_ms / 1000.0, known.trusts_place(now_s)
        if approach.arrived(at_s, place, known.velocity, trusted):
            self.approach, self.heard_s, known.glitches.read_s = None, now_s, now_s
            return Arrived(now_s, place, known.position_ms)
        waypoint = f"Waypoint ({approach.target[1]:.2f}, {approach.target[0]:.2f}) m"
        if self._is_ignored(approach.target):
            self._flight.fail(f"{waypoint} is ignored by the autopilot: is it outside its geofence?")
        elif now_s > approach.deadline_s:
            self._flight.fail(
                f"{waypoint} not reached in time: {math.dist(place, approach.target):.1f} m away"
            )
        return None

    def _is_ignored(self, target: Ned) -> bool:
        """Whether ArduPilot reads back another target: it ignores what it does not take without a word."""
        known, now_s = self._known, self._commander.now_s
        said_s = known.came_s.get(mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED, -math.inf)
        reads_back = known.firmware.is_ardupilot and now_s - said_s <= known.stale_s
        taken = known.target and math.dist(known.target, known.in_ekf_frame(target)) <= IGNORED_M
        if taken or not reads_back:
            self._unread_since_s, self._copies = now_s, 0
        return self._copies >= COPIES and now_s - self._unread_since_s > IGNORED_S
