"""A double of PX4 1.15, as its sources behave towards a companion on the onboard link."""

import math
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.autopilots.autopilot import ACCEPTED, CRITICAL, DENIED, REJECTED, WARNING, Autopilot, Result
from tests.autopilots.body import FREE, NAN, STILL, Vector
from tests.autopilots.faults import Fault
from tests.autopilots.telemetry import PX4 as SAYS
from tests.autopilots.telemetry import amsl_m

MODES = {
    "MANUAL": (1, 0),
    "ALTCTL": (2, 0),
    "POSCTL": (3, 0),
    "TAKEOFF": (4, 2),
    "HOLD": (4, 3),
    "RTL": (4, 5),
    "LAND": (4, 6),
    "OFFBOARD": (6, 0),
    "STABILIZED": (7, 0),
    "DESCEND": (4, 6),
}
"""(main, sub) mode. DESCEND is what is left without a position; it shows as LAND."""
WORDS = {
    "OFFBOARD": "Offboard",
    "HOLD": "Hold",
    "RTL": "Return",
    "LAND": "Land",
    "TAKEOFF": "Takeoff",
    "POSCTL": "Position",
}
BY_NUMBERS = {numbers: name for name, numbers in MODES.items() if name != "DESCEND"}
BY_HAND = {"MANUAL", "ALTCTL", "POSCTL", "STABILIZED"}
NEED_POSITION = {"POSCTL", "TAKEOFF", "HOLD", "RTL", "LAND", "OFFBOARD"}
OFFBOARD_LOSS = {0: "POSCTL", 1: "ALTCTL", 2: "STABILIZED", 3: "RTL", 4: "LAND", 5: "HOLD"}
LINK_LOSS = {1: "HOLD", 2: "RTL", 3: "LAND"}
FENCE = {2: "HOLD", 3: "RTL", 5: "LAND"}
OFFBOARD_EXCEPTED = 4
SLOWEST_GAP_S, STREAM_FOR_S = 0.5, 1.0
"""Before OFFBOARD, targets must come at more than 2 Hz for a second."""
SPOOL_S = 1.0
DEFAULTS: dict[str, float] = {
    "COM_OF_LOSS_T": 1.0,
    "COM_OBL_RC_ACT": 0,
    "COM_RCL_EXCEPT": 0,
    "NAV_DLL_ACT": 0,
    "NAV_RCL_ACT": 2,
    "COM_DL_LOSS_T": 10,
    "COM_FAIL_ACT_T": 5.0,
    "COM_LOW_BAT_ACT": 3,
    "COM_DISARM_PRFLT": 10.0,
    "COM_DISARM_LAND": 2.0,
    "MIS_TAKEOFF_ALT": 2.5,
    "RTL_RETURN_ALT": 60.0,
    "GF_ACTION": 2,
    "GF_MAX_HOR_DIST": 0.0,
    "GF_MAX_VER_DIST": 0.0,
    "EKF2_DRAG_CTRL": 0,
}
"""An int is an INT32 on the wire."""


class Px4(Autopilot):
    """PX4. The onboard link streams telemetry unasked."""

    autopilot = mavlink.MAV_AUTOPILOT_PX4
    is_ardupilot = False
    disarm_delay = "COM_DISARM_PRFLT"
    ready_after_s = 12.0
    says = SAYS
    unasked_us = {  # noqa: RUF012
        1: 1_000_000,
        24: 200_000,
        30: 50_000,
        32: 33_000,
        33: 50_000,
        49: 1_000_000,
        74: 200_000,
        85: 100_000,
        147: 1_000_000,
        230: 1_000_000,
        231: 500_000,
        242: 1_000_000,
        245: 200_000,
    }
    defaults = DEFAULTS

    def boot(self) -> None:
        """Start again in HOLD."""
        super().boot()
        self.mode = self.wished = "HOLD"
        self.place, self.velocity = FREE, STILL
        self.stream_since_s = self.target_s = -math.inf
        self.pending: tuple[float, str] | None = None
        self.fallen_back = self.breached = self.station_lost = False
        self.spooled_s = 0.0
        self.had_radio = self.radio

    # ---- what it says

    @property
    def base_mode(self) -> int:  # type: ignore[override]
        """MAV_MODE_FLAG."""
        return (81 if self.mode in BY_HAND else 29) | (128 if self.armed else 0)

    @property
    def custom_mode(self) -> int:  # type: ignore[override]
        """Main mode in the third byte, sub mode in the fourth."""
        main, sub = MODES[self.mode]
        return main << 16 | sub << 24

    @property
    def system_status(self) -> int:  # type: ignore[override]
        """MAV_STATE: critical in a failsafe."""
        return 5 if self.failsafe else 4 if self.armed else 3

    def ekf_flags(self) -> int:
        """831 when all is well; flag 16 is the absolute position."""
        if self.position_good:
            return 831
        return 1 + 4 + 32 + 128 if self.now_s > 2.0 else 0

    def target_said(self) -> tuple[int, Vector, Vector, float] | None:
        """What it flies to; what it has no value for is NaN."""
        if self.armed and self.mode == "OFFBOARD":
            return 0, self.place, self.velocity, NAN
        return (0, self.trip.place, (NAN, NAN, NAN), NAN) if self.armed else None

    def landing(self) -> bool:
        """In LAND or DESCEND, or at the end of RTL."""
        return self.mode in ("LAND", "DESCEND") or (self.mode == "RTL" and self.trip.stage == "land")

    def taking_off(self) -> bool:
        """In TAKEOFF."""
        return self.mode == "TAKEOFF"

    # ---- arming and commands

    @property
    def signal(self) -> bool:
        """Whether targets come: more than 2 Hz to begin with, and not older than COM_OF_LOSS_T later."""
        age = self.now_s - self.target_s
        if self.mode == "OFFBOARD" and self.armed:
            return age < self.parameters["COM_OF_LOSS_T"]
        return age < SLOWEST_GAP_S and self.now_s - self.stream_since_s >= STREAM_FOR_S

    @property
    def station(self) -> bool:
        """Whether a ground station is heard."""
        return (
            self.station_seen_s is not None
            and self.now_s - self.station_seen_s < self.parameters["COM_DL_LOSS_T"]
        )

    def can_run(self, mode: str) -> bool:
        """Whether the mode can fly now."""
        if mode == "OFFBOARD" and (self.faults.on("mode") or not self.signal):
            return False
        return (mode not in NEED_POSITION or self.position_good) and (mode not in BY_HAND or self.radio)

    def why_not_arm(self) -> str | None:
        """Position, station, and that the mode can run."""
        if not self.position_good:
            return "ekf2 missing data"
        if self.parameters["NAV_DLL_ACT"] > 0 and not self.station:
            return "No connection to the ground control station"
        if self.mode in ("RTL", "LAND"):
            return "Mode not suitable for takeoff"
        return None if self.can_run(self.mode) else ""

    def refuse_arming(self, why: str) -> Result:
        """TEMPORARILY_REJECTED; some reasons are said as text, a missing OFFBOARD signal is not."""
        if why:
            self.text(WARNING, f"Preflight Fail: {why}")
        self.text(CRITICAL, "Arming denied: Resolve system health failures first")
        return REJECTED

    def on_arm(self) -> None:
        """The way up begins."""
        self.spooled_s = self.now_s + SPOOL_S
        self.had_radio = self.radio
        if self.mode != "TAKEOFF":
            self.begin()

    def on_disarm(self) -> None:
        """Back to HOLD."""
        self.pending, self.fallen_back = None, False
        self.mode = self.wished = "HOLD"

    def command(self, number: int, values: list[float]) -> Result:
        """Modes, take-off; then what both know."""
        match number:
            case mavlink.MAV_CMD_DO_SET_MODE:
                if not int(values[0]) & 1:
                    return DENIED
                name = BY_NUMBERS.get((int(values[1]), int(values[2])))
                return self.change(name) if name else DENIED
            case mavlink.MAV_CMD_NAV_TAKEOFF:
                return self._take_off(values[6])
            case mavlink.MAV_CMD_NAV_LAND:
                return self.change("LAND")
            case mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
                return self.change("RTL")
            case mavlink.MAV_CMD_NAV_LOITER_UNLIM:
                return self.change("HOLD")
        return super().command(number, values)

    def change(self, mode: str) -> Result:
        """Disarmed, any mode is taken; armed, only one that can run."""
        if (self.armed and not self.can_run(mode)) or (mode == "OFFBOARD" and self.faults.on("mode")):
            self.text(CRITICAL, f"Switching to {WORDS.get(mode, mode)} is currently not available")
            return REJECTED
        self.wished, self.pending, self.failsafe, self.fallen_back = mode, None, False, False
        self._enter(mode)
        return ACCEPTED

    def _enter(self, mode: str) -> None:
        if mode != self.mode:
            self.mode = mode
            self.begin()
            self.out.append(self.says[0](self))

    def _take_off(self, altitude_amsl_m: float) -> Result:
        """The altitude is above mean sea level: one that is meant above home is below the ground, and the
        vehicle stays.
        """
        if self.faults.on("takeoff"):
            self.text(CRITICAL, "Switching to Takeoff is currently not available")
            return REJECTED
        if (result := self.change("TAKEOFF")) == ACCEPTED:
            now = amsl_m(self.body.position[2])
            if math.isnan(altitude_amsl_m):
                altitude_amsl_m = amsl_m(self.home[2]) + self.parameters["MIS_TAKEOFF_ALT"]
            if altitude_amsl_m < now:
                self.text(CRITICAL, "Already higher than takeoff altitude")
                altitude_amsl_m = now
            north, east, _ = self.body.position
            self.trip.place = (north, east, self.body.position[2] - (altitude_amsl_m - now))
            self.spooled_s = self.now_s + SPOOL_S
        return result

    # ---- targets

    def go_to(self, place: Vector) -> None:
        """MAV_CMD_DO_REPOSITION of a ground station: HOLD elsewhere."""
        self.change("HOLD")
        self.trip.place = place

    def hear_heartbeat(self, message: Any) -> None:
        """Ground stations count, companions do not."""
        if message.type == mavlink.MAV_TYPE_GCS:
            self.station_seen_s = self.now_s

    def hear_set_position_target_local_ned(self, message: Any) -> None:
        """Heard in every mode, flown in OFFBOARD; each axis may be ignored."""
        if self.faults.on("ignore"):
            return
        if message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
            self.text(CRITICAL, f"SET_POSITION_TARGET_LOCAL_NED frame {message.coordinate_frame} unsupported")
            return
        mask = message.type_mask
        place = tuple(
            NAN if mask & 1 << n else value for n, value in enumerate((message.x, message.y, message.z))
        )
        velocity = tuple(
            NAN if mask & 8 << n else value for n, value in enumerate((message.vx, message.vy, message.vz))
        )
        if all(map(math.isnan, place + velocity)):
            return
        if self.now_s - self.target_s > SLOWEST_GAP_S:
            self.stream_since_s = self.now_s
        self.target_s = self.now_s
        if place != self.place and not any(map(math.isnan, place)):
            self.targets += 1
        self.place, self.velocity = place, velocity  # type: ignore[assignment]

    # ---- flight

    def control(self) -> None:
        """One time step of the mode."""
        if self.landed and not self._lifts():
            self.body.rest()
            if self.landing():
                self.disarm()
            self.disarm_on_ground()
            return
        match self.mode:
            case "OFFBOARD":
                velocity = tuple(0.0 if math.isnan(v) else v for v in self.velocity)
                self.fly(self.gps.truly(self.place), velocity)  # type: ignore[arg-type]
            case "TAKEOFF":
                self.hold()
                if abs(self.body.position[2] - self.trip.place[2]) < 0.3:
                    self.mode = self.wished = "HOLD"  # at the place that it has climbed to
                    self.out.append(self.says[0](self))
            case "RTL":
                far = math.dist(self.home[:2], self.body.position[:2])
                self.go_home(min(self.parameters["RTL_RETURN_ALT"], max(far, 2.0)), 0.0)
            case "LAND" | "DESCEND":
                self.sink()
            case _:
                self.hold()

    def _lifts(self) -> bool:
        """Whether a vehicle on the ground may leave it: not while the motors start."""
        if self.faults.on("stuck") or self.now_s < self.spooled_s:
            return False
        down = {"OFFBOARD": self.place[2], "TAKEOFF": self.trip.place[2]}.get(self.mode, math.inf)
        climbs = self.mode == "OFFBOARD" and math.isnan(down) and self.velocity[2] < 0.0
        return climbs or down < self.body.ground - 0.2

    # ---- failsafes

    def struck(self, one: Fault) -> None:
        """Faults that are events."""
        match one.name:
            case "pilot":
                self.radio = self.had_radio = True
                self.change({"LOITER": "POSCTL"}.get(one.argument, one.argument))
            case "rc":
                self.radio = False
                excepted = (
                    self.mode == "OFFBOARD" and int(self.parameters["COM_RCL_EXCEPT"]) & OFFBOARD_EXCEPTED
                )
                if self.armed and self.had_radio and not excepted:
                    self._failsafe("Manual control lost", LINK_LOSS.get(int(self.parameters["NAV_RCL_ACT"])))
            case "low":
                self.battery_v, self.battery_percent = 10.8, 14
                self.text(WARNING, "Low battery level")
            case "critical":
                self.battery_v, self.battery_percent = 10.2, 6
                self.text(CRITICAL, "Critical battery level!")
                self._failsafe("", {2: "LAND", 3: "RTL"}.get(int(self.parameters["COM_LOW_BAT_ACT"])))
            case "fence":
                self._breach()
            case "reboot":
                self.boot()

    def _failsafe(self, words: str, action: str | None) -> None:
        """Announce it; hold for COM_FAIL_ACT_T, then act."""
        if words:
            self.text(CRITICAL, words)
        if not self.armed or action is None or self.landed:
            return
        self.text(CRITICAL, "Failsafe activated")
        self.failsafe, self.pending = True, (self.now_s + self.parameters["COM_FAIL_ACT_T"], action)
        self._enter("HOLD" if self.can_run("HOLD") else "DESCEND")

    def _breach(self) -> None:
        self.breached = True
        self._failsafe("Geofence violation", FENCE.get(int(self.parameters["GF_ACTION"])))

    def watch(self) -> None:
        """Pending actions, the mode that cannot run on, the station, the fence."""
        if self.pending and self.now_s >= self.pending[0]:
            action, self.pending = self.pending[1], None
            self._enter(action if self.can_run(action) else "DESCEND")
        if self.armed:
            self._fall_back()
        if self.parameters["NAV_DLL_ACT"] > 0 and self.station_seen_s is not None:
            if not self.station and not self.station_lost:
                self._failsafe(
                    "Connection to ground station lost", LINK_LOSS.get(int(self.parameters["NAV_DLL_ACT"]))
                )
            self.station_lost = not self.station
        self._watch_fence()

    def _fall_back(self) -> None:
        """A mode that cannot run gives way: OFFBOARD as COM_OBL_RC_ACT says, then RTL, at last DESCEND."""
        if self.mode == "DESCEND":
            return
        if (
            self.fallen_back
            and self.wished == "OFFBOARD"
            and not self.landed
            and self._fresh()
            and self.position_good
        ):
            self.fallen_back, self.failsafe = False, False
            self._enter("OFFBOARD")
            return
        if self.can_run(self.mode):
            return
        wish = (
            OFFBOARD_LOSS.get(int(self.parameters["COM_OBL_RC_ACT"]), "RTL")
            if self.mode == "OFFBOARD"
            else "RTL"
        )
        self.fallen_back, self.failsafe = True, True
        self.text(CRITICAL, "Failsafe activated")
        self._enter(next((mode for mode in (wish, "RTL", "LAND") if self.can_run(mode)), "DESCEND"))

    def _fresh(self) -> bool:
        return self.now_s - self.target_s < self.parameters["COM_OF_LOSS_T"]

    def _watch_fence(self) -> None:
        far, high = self.parameters["GF_MAX_HOR_DIST"], self.parameters["GF_MAX_VER_DIST"]
        away = math.dist(self.home[:2], self.body.position[:2])
        outside = (far > 0 and away > far) or (high > 0 and self.home[2] - self.body.position[2] > high)
        if outside and self.armed and not self.breached:
            self._breach()
        elif not outside and not self.faults.on("fence"):
            self.breached = False
