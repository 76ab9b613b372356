"""What the vehicle flies by itself: legs, the return, missions; and the watch over the fence."""

import math

from pymavlink.dialects.v20 import common as mavlink

from aircraft.mode import Mode
from aircraft.state import ACCEPTED, ZERO, Ned, Reached, Result, Said, VehicleEvent, denied
from sitl.autopilot.battery import Battery
from sitl.autopilot.config import HOLD, LAND, RETURN, TERMINATE, VehicleConfig
from sitl.autopilot.motion import Motion, Spin, Trajectory, Turn, fall, halt, wrapped
from sitl.autopilot.plan import LAND as LAND_ITEM
from sitl.autopilot.plan import RETURN as RETURN_ITEM
from sitl.autopilot.plan import TAKEOFF as TAKEOFF_ITEM
from sitl.autopilot.plan import FlightPlan, Leg, MissionProgress, MissionStep
from sitl.autopilot.setpoint import Setpoint, facing
from sitl.autopilot.state import Breaches

ACTIONS = {HOLD: (Mode.HOLD, "holding"), RETURN: (Mode.RETURN, "returning"), LAND: (Mode.LAND, "landing")}
"""What GF_ACTION does when the fence is left."""


class Navigator:
    """The flight of a `Vehicle`: its path and what determines it. Times in s of simulation time, positions
    NED in m from home.
    """

    def __init__(self, config: VehicleConfig) -> None:
        """Start at home at time 0, disarmed."""
        self.config = config
        self.mission = FlightPlan()
        """The mission on board; `load` changes it."""

        self._now = 0.0
        self._mode = Mode.HOLD
        self._armed = False
        self._failsafe = False
        self._events: list[VehicleEvent] = []
        self._battery = Battery()
        self._has_flown = False  # since it was armed

        heading = wrapped(math.radians(config.home_heading_deg))
        self._turn: Turn | Spin = Turn(0.0, heading, heading, math.radians(config.yaw_rate_dps))
        self._path = Trajectory(0.0, ZERO)
        self._settled = True  # the end of the path has been handled

        self._leg: Leg | None = None  # of the mission, while one is flown
        self._left_s = math.inf  # when the path leaves the fence
        self._breaches = Breaches()

    def catch_up(self, t_s: float) -> None:
        """Advance to a time."""
        raise NotImplementedError

    # ---- the mission ----

    def load(self, t_s: float, steps: tuple[MissionStep, ...], number: int = 0, current: int = 0) -> None:
        """Replace the mission; a vehicle that flies one begins the new one, or holds if it is empty.
        `number` is its checksum.
        """
        self.catch_up(t_s)
        self.mission = FlightPlan(steps, number)
        self.mission.current = current
        if self._mode is Mode.MISSION and not steps:
            self._say(mavlink.MAV_SEVERITY_WARNING, "Mission cleared: holding")
            self._hold()
        elif self._mode is Mode.MISSION and self._armed:
            self._fly_mission()

    def set_current(self, t_s: float, seq: int) -> Result:
        """Go on with another item of the mission, at once if it is being flown."""
        self.catch_up(t_s)
        if not 0 <= seq < len(self.mission.steps):
            what = (
                f"allowed is 0 to {len(self.mission.steps) - 1}"
                if self.mission.steps
                else "no mission on board"
            )
            return denied(f"Mission item {seq} refused: {what}")
        self.mission.set_current(seq)
        if self._mode is Mode.MISSION and self._armed:
            self._fly_mission()
        return ACCEPTED

    @property
    def waiting(self) -> bool:
        """True while the mission's current item waits for a time: the end of the wait is then one of the
        coming events.
        """
        return self._armed and self._settled and self._item_done_s() < math.inf

    @property
    def progress(self) -> MissionProgress:
        """How far the mission is."""
        return self.mission.progress(self._mode is Mode.MISSION, self._armed)

    def _missing_mission(self) -> str:
        """Why the mission cannot be flown, or nothing: the area or the fence may have changed since it was
        uploaded.
        """
        if not self.mission.steps:
            return "no mission on board"
        for seq, step in enumerate(self.mission.steps):
            if step.north_east and (outside := self.config.outside((*step.north_east, step.down_m))):
                return f"item {seq}: {outside[1]}"
        return ""

    def _fly_mission(self) -> None:
        """Fly the current item; hold at the end of the mission."""
        path = self._halted()
        self._leg = self.mission.leg(self._now, path.target, self._on_ground, self.config)
        if self._leg is None:
            self._say(mavlink.MAV_SEVERITY_INFO, "Mission finished")
            self._hold()
        elif self._leg.step.command == RETURN_ITEM:
            self._pass_item()
        else:
            for stop in self._leg.stops:
                path = path.to(stop, self._leg.limits)
            self._fly(path)
            self._face(self._leg.step.yaw_rad)

    def _item_done_s(self) -> float:
        """When the current item of the mission is done: after its flight, its turn and its wait; infinity
        if none is flown.
        """
        if self._mode is not Mode.MISSION or self._leg is None:
            return math.inf
        return max(self._path.end_s, self._turn.end_s) + self._leg.step.wait_s

    def _pass_item(self) -> None:
        """Tell that the current item is done, and go on with the next. A return home is another mode's:
        nothing is reached, as in PX4.
        """
        assert self._leg is not None
        step, self._leg = self._leg.step, None
        if step.command != RETURN_ITEM:
            self.mission.reached = self.mission.current, self._now
            self._events.append(Reached(self._now, self.mission.current))
        if not step.goes_on:
            return
        self.mission.current += 1
        if step.command == RETURN_ITEM and not self._on_ground:
            self.mission.end()
            self._return()
        else:
            self._fly_mission()

    # ---- the fence ----

    def _watch_fence(self, outside: bool = False) -> None:
        """Find out when the path leaves the fence next. One that leads away from its edge, `outside`, has
        to come in first.
        """
        self._left_s = math.inf
        if self._armed and self.config.guards:
            outside = outside or not self.config.fence.allows(self._motion.position)
            self._left_s = self.config.fence.left_s(self._path, self._now, outside)

    def _breach(self) -> None:
        """The path leaves the fence: do what GF_ACTION says. A vehicle that already returns or lands goes
        on with it, as in PX4.
        """
        self._breaches = Breaches(True, self._breaches.times + 1, self._now)
        action = self.config.fence_action
        mode, doing = ACTIONS.get(action, (self._mode, ""))
        if self._mode in (Mode.RETURN, Mode.LAND) and action != TERMINATE:
            doing = ""
        north, east, _ = self._motion.position
        does = "motors stopped" if action == TERMINATE else doing
        self._say(
            mavlink.MAV_SEVERITY_CRITICAL,
            f"Fence breached at ({east:.2f}, {north:.2f}) m" + (does and f": {does}"),
        )
        if action == TERMINATE:
            self._drop()
        elif doing:
            self._failsafe = True
            self._mode = mode
            if mode is Mode.RETURN:
                self._return()
            elif mode is Mode.LAND:
                self._descend()
            else:
                self._fly(self._halted())
        self._watch_fence(outside=True)

    # ---- flight ----

    def _say(self, severity: int, text: str) -> None:
        self._events.append(Said(self._now, severity, text))

    @property
    def _motion(self) -> Motion:
        return self._path.at(self._now)

    @property
    def _on_ground(self) -> bool:
        return self._settled and self._path.target[2] >= 0.0

    @property
    def _falling(self) -> bool:
        return not self._armed and not self._settled

    def _landed_state(self) -> int:
        item = self._leg.step.command if self._leg and self._mode is Mode.MISSION else None
        if self._on_ground:
            return int(mavlink.MAV_LANDED_STATE_ON_GROUND)
        if self._mode is Mode.TAKEOFF or item == TAKEOFF_ITEM:
            return int(mavlink.MAV_LANDED_STATE_TAKEOFF)
        landing = self._mode is Mode.LAND or item == LAND_ITEM
        return int(mavlink.MAV_LANDED_STATE_LANDING if landing else mavlink.MAV_LANDED_STATE_IN_AIR)

    def _fly(self, path: Trajectory) -> None:
        self._path, self._settled, self._turn = path, False, self._turn.stopped(self._now)
        self._has_flown |= path.target[2] < 0.0
        self._watch_fence()

    def _halted(self) -> Trajectory:
        return halt(self._now, self._motion, self.config.limits)

    def _go(self, target: Ned) -> None:
        self._fly(self._halted().to(target, self.config.limits))

    def _face(self, yaw_rad: float | None) -> None:
        if yaw_rad is not None:
            self._turn = facing(self._turn, self._now, Setpoint(yaw_rad=yaw_rad), self.config)

    def _hold(self) -> None:
        self._mode = Mode.HOLD
        if not self._on_ground:
            self._fly(self._halted())

    def _return(self) -> None:
        self._mode = Mode.RETURN
        path, limits = self._halted(), self.config.limits
        north, east, down = path.target
        down = min(down, -self.config.return_altitude_m)
        self._fly(
            path.to((north, east, down), limits).to((*self.config.rally.nearest(path.target), down), limits)
        )

    def _descend(self) -> None:
        path = self._halted()
        self._fly(path.to((path.target[0], path.target[1], 0.0), self.config.limits))

    def _drop(self) -> None:
        """Stop the motors in the air."""
        self._say(mavlink.MAV_SEVERITY_EMERGENCY, "Motors stopped in the air")
        falling = fall(self._now, self._motion)
        self._stop_motors()
        self._fly(falling)

    def _stop_motors(self) -> None:
        self._battery.switch_off(self._now)
        self._turn = self._turn.stopped(self._now)
        self._armed, self._mode, self._failsafe = False, Mode.HOLD, False
