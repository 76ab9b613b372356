"""A double of ArduCopter 4.6.3, as its sources and its SITL behave towards a companion."""

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.autopilots.autopilot import (
    ACCEPTED,
    CRITICAL,
    DENIED,
    FAILED,
    INFO,
    NOTICE,
    WARNING,
    Autopilot,
    Result,
)
from tests.autopilots.body import FREE, STILL, Vector
from tests.autopilots.faults import Fault
from tests.autopilots.telemetry import ARDUPILOT

MODES = {
    "STABILIZE": 0,
    "ALT_HOLD": 2,
    "AUTO": 3,
    "GUIDED": 4,
    "LOITER": 5,
    "RTL": 6,
    "LAND": 9,
    "POSHOLD": 16,
    "BRAKE": 17,
}
NAMES = {number: name for name, number in MODES.items()}
NEED_POSITION = {"AUTO", "GUIDED", "LOITER", "RTL", "POSHOLD", "BRAKE"}
MANUAL = {"STABILIZE", "ALT_HOLD", "LOITER", "POSHOLD"}
POSITION_MASK, VELOCITY_MASK, ACCELERATION_MASK = 0x007, 0x038, 0x1C0
LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED = 1, 7, 8, 9
SPOOL_S = 1.5
GCS_ACTIONS = {1: "RTL", 5: "LAND", 7: "BRAKE"}
FENCE_ACTIONS = {1: "RTL", 2: "LAND", 4: "BRAKE"}
BATTERY_ACTIONS = {1: "LAND", 2: "RTL"}
DEFAULTS = {
    "SYSID_MYGCS": 255.0,
    "FS_GCS_ENABLE": 0.0,
    "FS_GCS_TIMEOUT": 5.0,
    "RTL_ALT": 1500.0,
    "GUID_TIMEOUT": 3.0,
    "BATT_FS_LOW_ACT": 2.0,
    "BATT_FS_CRT_ACT": 1.0,  # the real ones are 0 until someone sets them
    "EK3_DRAG_BCOEF_X": 0.0,
    "EK3_DRAG_BCOEF_Y": 0.0,
    "EK3_DRAG_MCOEF": 0.0,
    "DISARM_DELAY": 10.0,
    "FENCE_ENABLE": 0.0,
    "FENCE_TYPE": 7.0,
    "FENCE_ACTION": 1.0,
    "FENCE_RADIUS": 300.0,
    "FENCE_ALT_MAX": 100.0,
}


class ArduCopter(Autopilot):
    """ArduCopter. Only HEARTBEAT streams unasked; times are simulation times."""

    autopilot = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
    is_ardupilot = True

    ready_after_s = 41.0
    says = ARDUPILOT
    unasked_us: dict[int, int] = {}  # noqa: RUF012
    defaults = DEFAULTS
    disarm_delay = "DISARM_DELAY"

    def boot(self) -> None:
        """Start again in STABILIZE."""
        super().boot()
        self.mode = "STABILIZE"
        self.led_by_pilot = False
        self.bad_ekf_s = 0.0
        self.origin_told = self.breached = self.station_lost = False
        self.breaches = 0
        self.last_place: Vector = (0.0, 0.0, 0.0)
        self._stop()

    def _stop(self) -> None:
        """Guided flight begins, or got a target that it cannot take: velocity 0."""
        self.aim, self.place, self.velocity, self.aimed_s = "velocity", FREE, STILL, self.now_s

    # ---- what it says

    @property
    def base_mode(self) -> int:  # type: ignore[override]
        """MAV_MODE_FLAG."""
        return 81 | (128 if self.armed else 0) | (8 if self.mode in ("GUIDED", "RTL", "AUTO") else 0)

    @property
    def custom_mode(self) -> int:  # type: ignore[override]
        """The mode's number."""
        return MODES[self.mode]

    @property
    def system_status(self) -> int:  # type: ignore[override]
        """MAV_STATE: critical in a failsafe."""
        return 5 if self.failsafe else 3 if self.landed else 4

    def ekf_flags(self) -> int:
        """831 when all is well; flag 16 is the absolute position."""
        if self.now_s < 2.0:
            return 1024
        if self.position_good:
            return 831
        level = 1 + 4 + 32 + 128  # attitude, vertical speed and height, no horizontal position
        return level + (256 + 512 if self._predicts() else 0)

    def _predicts(self) -> bool:
        """Whether the EKF expects to have a position soon: that is enough to arm."""
        return not self.origin_set and self.gps_good and self.now_s >= 0.25 * self.ready_s

    def target_said(self) -> tuple[int, Vector, Vector, float] | None:
        """The target in GUIDED; None outside."""
        if self.mode != "GUIDED":
            return None
        if self.aim == "velocity":
            return 0x0C07, STILL, self.velocity, 0.0
        return (
            0x0DF8,
            self.last_place,
            STILL,
            0.0,
        )  # a take-off has no target of its own: what is read back is older

    def landing(self) -> bool:
        """In LAND, or at the end of RTL."""
        return self.mode == "LAND" or (self.mode == "RTL" and self.trip.stage == "land")

    def taking_off(self) -> bool:
        """Not yet near the height of the take-off."""
        return self.mode == "GUIDED" and self.aim == "takeoff" and self.body.position[2] - self.place[2] > 0.3

    # ---- arming and commands

    def why_not_arm(self) -> str | None:
        """A position that the EKF expects is enough."""
        if self.now_s < 2.0:
            return "AHRS: not healthy"
        if self.mode not in MANUAL | {"GUIDED"}:
            return f"{self.mode} mode not armable"
        if self.mode in NEED_POSITION and not (self.position_good or self._predicts()):
            return "Need Position Estimate"
        return "Battery failsafe" if self.battery_v < 10.5 else None

    def refuse_arming(self, why: str) -> Result:
        """FAILED, and the reason as text."""
        self.text(CRITICAL, f"Arm: {why}")
        return FAILED

    def on_disarm(self) -> None:
        """The next flight begins without a target."""
        self._stop()

    def command(self, number: int, values: list[float]) -> Result:
        """Modes, take-off; then what both know."""
        match number:
            case mavlink.MAV_CMD_DO_SET_MODE:
                if not int(values[0]) & 1:
                    return DENIED
                name = NAMES.get(int(values[1]))
                if name is None:
                    self.text(WARNING, f"No such mode {int(values[1])}")
                    return FAILED
                return self._by_command(name)
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                return self._take_off(values[6])
            case mavlink.MAV_CMD_NAV_LAND:
                return self._by_command("LAND")
            case mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                return self._by_command("RTL")
            case mavlink.MAV_CMD_NAV_LOITER_UNLIM:
                return self._by_command("LOITER")
        return super().command(number, values)

    def _by_command(self, name: str) -> Result:
        if name == "GUIDED" and self.faults.on("mode"):
            self.text(WARNING, "Mode change to GUIDED failed: init failed")
            return FAILED
        if not self.change(name):
            return FAILED
        self.led_by_pilot = False
        return ACCEPTED

    def change(self, name: str) -> bool:
        """Change the mode; armed, one that needs a position is refused without."""
        if name == self.mode:
            return True
        if self.armed and name in NEED_POSITION and not self.position_good:
            self.text(WARNING, f"Mode change to {name} failed: requires position")
            return False
        self.mode = name
        self.begin()
        if name == "GUIDED":
            self._stop()
        self.out.append(self.says[0](self))
        return True

    def _take_off(self, above_home_m: float) -> Result:
        """Refused unless armed, on the ground, in GUIDED, with a home to measure the height from."""
        ready = (
            self.armed
            and self.landed
            and self.mode == "GUIDED"
            and self.origin_set
            and not self.faults.on("takeoff")
        )
        if not ready or not above_home_m > self.home[2] - self.body.position[2]:
            return FAILED
        north, east, _ = self.body.position
        self.aim, self.place, self.aimed_s = "takeoff", (north, east, self.home[2] - above_home_m), self.now_s
        return ACCEPTED

    # ---- targets

    def hear_heartbeat(self, message: Any) -> None:
        """The station that FS_GCS watches."""
        station = self.parameters.get(
            "MAV_GCS_SYSID", self.parameters.get("SYSID_MYGCS")
        )  # as 4.7 and 4.6 call it
        if message.get_srcSystem() == station:
            self.station_seen_s = self.now_s

    def hear_set_position_target_local_ned(self, message: Any) -> None:
        """Ignored outside GUIDED; a mask that makes no target stops the vehicle. Nothing is ever answered."""
        if self.mode != "GUIDED" or self.faults.on("ignore"):
            return
        mask, frame = message.type_mask, message.coordinate_frame
        ignored = tuple(bool(mask & bits) for bits in (POSITION_MASK, VELOCITY_MASK, ACCELERATION_MASK))
        if frame not in (LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED) or ignored in (
            (False, True, False),
            (True, True, True),
        ):
            self._stop()
            return
        place, velocity = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
        if not all(map(math.isfinite, place if not ignored[0] else velocity)):
            return
        if ignored[0]:
            self.aim, self.place, self.aimed_s = "velocity", FREE, self.now_s
            self.velocity = self._turned(velocity) if frame in (BODY_NED, BODY_OFFSET_NED) else velocity
            return
        if frame in (BODY_NED, BODY_OFFSET_NED):
            place = self._turned(place)
        if frame != LOCAL_NED:
            north, east, down = (p + q for p, q in zip(place, self.body.position, strict=True))
            place = (north, east, down)
        if self._outside(place):
            return
        if self.aim != "position" or place != self.place:
            self.targets += 1
        self._aim_at(place)

    def _aim_at(self, place: Vector) -> None:
        self.aim, self.place, self.velocity, self.aimed_s, self.last_place = (
            "position",
            place,
            STILL,
            self.now_s,
            place,
        )

    def go_to(self, place: Vector) -> None:
        """MAV_CMD_DO_REPOSITION of a ground station, with the flag that changes the mode."""
        self._by_command("GUIDED")
        if not self._outside(place):
            self._aim_at(place)

    def _turned(self, vector: Vector) -> Vector:
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return vector[0] * cos - vector[1] * sin, vector[0] * sin + vector[1] * cos, vector[2]

    def _outside(self, place: Vector) -> bool:
        north, east, down = (p - h for p, h in zip(place, self.home, strict=True))
        far = (
            math.hypot(north, east) > self.parameters["FENCE_RADIUS"]
            or -down > self.parameters["FENCE_ALT_MAX"]
        )
        return bool(self.parameters["FENCE_ENABLE"]) and far

    # ---- flight

    def control(self) -> None:
        """One time step of the mode. LOITER without a radio reads throttle 0: it descends."""
        descend_blind = self.mode in MANUAL and not self.radio
        if self.landed and not (self.mode == "GUIDED" and self.aim == "takeoff"):
            self.body.rest()
            if self.landing():
                self.disarm()
            self.disarm_on_ground()
        elif descend_blind:
            self.sink(3.0 if self.mode == "STABILIZE" else 1.5)
        elif self.mode == "GUIDED":
            self._guided()
        elif self.mode == "RTL":
            self.go_home(self.parameters["RTL_ALT"] / 100.0, 5.0)
        elif self.mode == "LAND":
            self.sink()
        else:
            self.hold()

    def _guided(self) -> None:
        if (
            self.aim == "takeoff"
            and self.landed
            and (self.faults.on("stuck") or self.now_s - self.aimed_s < SPOOL_S)
        ):
            self.body.rest()
            self.disarm_on_ground()
            return
        if self.aim == "velocity" and self.now_s - self.aimed_s > self.parameters["GUID_TIMEOUT"]:
            self.velocity = STILL
        self.fly(self.gps.truly(self.place) if self.aim == "position" else self.place, self.velocity)

    # ---- failsafes

    def struck(self, one: Fault) -> None:
        """Faults that are events."""
        match one.name:
            case "pilot":
                self.radio, self.led_by_pilot = True, True
                self.change(one.argument)
            case "rc":
                self.radio = False
                if self.armed and not self.landed:
                    self._failsafe("Radio Failsafe", "RTL")
            case "low" | "critical":
                self.battery_v, self.battery_percent = (10.4, 18) if one.name == "low" else (9.9, 6)
                self.text(WARNING, f"Battery 1 is {one.name} {self.battery_v:.2f}V used 2640 mAh")
                action = self.parameters["BATT_FS_LOW_ACT" if one.name == "low" else "BATT_FS_CRT_ACT"]
                self._failsafe("Battery Failsafe", BATTERY_ACTIONS.get(int(action)))
            case "fence":
                self._breach("Circle")
            case "reboot":
                self.boot()

    def _failsafe(self, words: str, mode: str | None) -> None:
        """Announce it; in the air change the mode, to LAND if that one is refused."""
        self.text(WARNING, words)
        self.failsafe = self.armed
        if self.armed and mode and not self.landed and not self.change(mode):
            self.change("LAND")
        elif self.armed and mode and self.landed:
            self.disarm()

    def _breach(self, name: str) -> None:
        self.breached, self.breaches = True, self.breaches + 1
        self.text(NOTICE, f"{name} breached")
        mode = FENCE_ACTIONS.get(int(self.parameters["FENCE_ACTION"]))
        if self.armed and not self.landed and mode and not self.change(mode):
            self.change("LAND")

    def watch(self) -> None:
        """EKF, station, fence."""
        if self.origin_set and not self.origin_told:
            self.origin_told = True
            self.text(INFO, "EKF3 IMU0 origin set")
            self.text(INFO, "EKF3 IMU0 is using GPS")
            self.home = tuple(self.body.position)  # type: ignore[assignment]
        if not self.armed and self.steps % 1500 == 0 and (why := self.why_not_arm()):
            self.text(CRITICAL, f"PreArm: {why}")
        self._watch_ekf()
        self._watch_station()
        outside = self.armed and not self.landed and self._outside(tuple(self.body.position))  # type: ignore[arg-type]
        if outside and not self.breached:
            self._breach("Circle")
        elif not outside and not self.faults.on("fence"):
            self.breached = False

    def _watch_ekf(self) -> None:
        """A second without a position that it can trust, in a mode that needs one: LAND."""
        self.bad_ekf_s = 0.0 if self.position_good or not self.origin_set else self.bad_ekf_s + 0.02
        if not 1.0 <= self.bad_ekf_s < 1.02:
            return
        self.text(CRITICAL, "EKF variance")
        if self.armed and not self.landed and self.mode in NEED_POSITION:
            self.failsafe = True
            self.change("LAND")
            self.text(CRITICAL, "EKF Failsafe: changed to LAND Mode")

    def _watch_station(self) -> None:
        """FS_GCS: heard once, then silent for FS_GCS_TIMEOUT."""
        action = GCS_ACTIONS.get(int(self.parameters["FS_GCS_ENABLE"]))
        if self.station_seen_s is None or action is None:
            return
        lost = self.now_s - self.station_seen_s > self.parameters["FS_GCS_TIMEOUT"]
        if lost and not self.station_lost:
            self._failsafe("GCS Failsafe", action)
        elif self.station_lost and not lost:
            self.text(WARNING, "GCS Failsafe Cleared")
            self.failsafe = False
        self.station_lost = lost
