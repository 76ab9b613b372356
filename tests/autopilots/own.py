"""The project's own simulated vehicle in a double's place: a PX4 of its own kind, as `plumeward uav --out`
is without a bus.
"""

from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import Said
from link.modes import Mode
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.parameters import Parameters
from sitl.autopilot.protocol import MavlinkProtocol
from sitl.autopilot.telemetry import Snapshot, Telemetry
from sitl.autopilot.vehicle import State, Vehicle
from tests.autopilots.body import DT_S, Vector
from tests.autopilots.faults import Faults
from tests.autopilots.settings import Settings

WORDS = {Mode.RETURN: "RTL"}
"""Modes that the doubles call otherwise."""
WIND = (1.5, -2.0)
"""(u cos φ, u sin φ) m/s: where its wind comes from, x east, y north."""


class Own:
    """The vehicle and its protocol on the doubles' clock. Of the faults it knows those of the link,
    `ignore`, `pilot` and `reboot`.
    """

    home: Vector = (0.0, 0.0, 0.0)

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        self.faults = Faults(self.settings.faults)
        self.system = self.settings.instance + 1
        self.boot()

    def boot(self) -> None:
        """Start again at home."""
        self.steps = self.targets = 0
        self.vehicle = Vehicle(VehicleConfig(sysid=self.system))
        for name, value in self.settings.parameters:
            assert not (reason := Parameters(self.vehicle).change(name, value, 0.0)), reason
        self.protocol = MavlinkProtocol(self.vehicle, lambda: self.now_s)
        self.telemetry = Telemetry(lambda _: Snapshot(self.vehicle.config, self.body, WIND, None))
        self.out: list[Any] = []
        self._target: Vector | None = None
        self._airborne_since_s: float | None = None

    @property
    def now_s(self) -> float:
        """Simulation time since boot."""
        return self.steps * DT_S

    def hear(self, message: Any) -> None:
        """One message."""
        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
            if self.faults.on("ignore"):
                return
            self.targets += (place := (message.x, message.y, message.z)) != self._target
            self._target = place
        self.out += self.protocol.receive(message, self.now_s, self.telemetry)

    def step(self) -> None:
        """One time step."""
        self.steps += 1
        if self.landed:
            self._airborne_since_s = None
        elif self._airborne_since_s is None:
            self._airborne_since_s = self.now_s
        airborne_s = None if self._airborne_since_s is None else self.now_s - self._airborne_since_s
        for one in self.faults.strike(self.now_s, airborne_s, self.targets):
            if one.name == "pilot":
                self.change(one.argument)
            elif one.name == "reboot":
                self.boot()
        for event in self.vehicle.advance(self.now_s):
            if isinstance(event, Said):
                self.out += self.protocol.statustext(event.severity, event.text)
        self.out += self.telemetry.due(self.now_s)

    def change(self, mode: str) -> None:
        """A pilot changes the mode."""
        (wanted,) = [one for one in Mode if WORDS.get(one, one.name) == mode]
        assert self.vehicle.set_mode(self.now_s, wanted).accepted

    @property
    def body(self) -> State:
        """Where it is, and how it moves."""
        return self.vehicle.state(self.vehicle.now_s)

    @property
    def mode(self) -> str:
        """The mode, in the doubles' words."""
        return WORDS.get(self.vehicle.mode, self.vehicle.mode.name)

    @property
    def armed(self) -> bool:
        """Whether the motors may turn."""
        return self.vehicle.armed

    @property
    def landed(self) -> bool:
        """Whether it stands on the ground."""
        return self.body.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND
