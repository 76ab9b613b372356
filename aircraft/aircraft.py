"""What the search needs of a vehicle, of the vehicle's clients, and of its gas sensor."""

import math
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple, Protocol

from aircraft.operator import CommandName
from aircraft.state import AircraftConfig, Arrived, Ned, Result, VehicleEvent
from aircraft.together import Together
from link.bus.keys import Key
from link.bus.mavlink import Message
from link.bus.session import Arrival
from link.modes import Mode


class Aircraft(Protocol):
    """A vehicle as its search knows it: the simulated `Vehicle`, or a `RemoteVehicle`.

    Times in s, positions NED, in m from home.
    """

    @property
    def config(self) -> AircraftConfig:
        """Where it may fly."""

    is_searched: bool  # True while its search leads it

    @property
    def now_s(self) -> float:
        """The time of the last call."""

    @property
    def mode(self) -> Mode:
        """The flight mode."""

    @property
    def armed(self) -> bool:
        """True while its motors may turn."""

    @property
    def moving(self) -> bool:
        """True while it flies somewhere."""

    @property
    def busy(self) -> bool:
        """True while it waits for nobody."""

    @property
    def free(self) -> bool:
        """True while it stands on the ground and nobody flies it."""

    @property
    def failure(self) -> str:
        """Why it has given the search up; empty if it has not."""

    @property
    def caveat(self) -> str:
        """What its readings have to be read with; empty if nothing is wrong with them."""

    @property
    def waypoint(self) -> Ned | None:
        """The last accepted position."""

    def catch_up(self, t_s: float) -> None:
        """Advance to a time; the next `advance` returns the events."""

    def advance(self, t_s: float) -> list[VehicleEvent]:
        """Advance to a time; return the events."""

    def next_event_s(self) -> float | None:
        """Return when to call `advance` again if no message comes."""

    def still(self, arrived: Arrived) -> Arrived:
        """Return an arrival as it is now, for another measurement there."""

    def arm(self, t_s: float) -> Result:
        """Start the motors."""

    def take_off(self, t_s: float) -> Result:
        """Climb to the take-off altitude."""

    def set_mode(self, t_s: float, mode: Mode) -> Result:
        """Change the flight mode."""

    def setpoint(self, t_s: float, wanted: Ned, *, answers: bool = False) -> Result:
        """Take a waypoint; `answers`: it answers a reading."""


class Clients(Protocol):
    """The vehicle's clients on the bus and over --out.

    They get their telemetry here, and what they say is dealt with here.

    A simulated vehicle is its own autopilot. A real one has its own, beside which the search is another
    component.
    """

    component: int  # the component id of what the search says

    @property
    def system(self) -> int:
        """The vehicle's MAVLink system id; 0 until it is known."""

    def serve(self) -> None:
        """Tell them what is due."""

    def wait_s(self) -> float:
        """Return the real time until something is due."""

    def changed(self) -> None:
        """Tell at once what the search does now."""

    def tell(self, severity: int, text: str) -> None:
        """Tell a text of a MAV_SEVERITY."""

    def send(self, *messages: Message) -> None:
        """Send messages on all links."""

    def measured(self, time_boot_ms: int, gas: float) -> None:
        """Tell a reading."""

    def take(self, arrival: Arrival) -> None:
        """Take what came from them on the bus. Raises BadFrame."""

    def refuse(self, result: Result, t_s: float) -> None:
        """Tell on the bus why a waypoint is refused."""

    def operate(self, name: CommandName) -> None:
        """Do what the script's operator wants."""

    def end(self, say: Callable[[int, str], None]) -> None:
        """Leave the vehicle to someone, and close the links."""


class Measured(NamedTuple):
    """What a sensor says of the place where the vehicle has arrived."""

    arrived: Arrived
    gas: float  # in the sensor's unit; NaN: it has no value now
    # (u cos φ, u sin φ) m/s, points to where the wind comes from, as float32; None: nobody knows it now
    wind: tuple[float, float] | None


class GasSensor:
    """A gas sensor that answers at once. One that is asked over the bus says more."""

    keys: tuple[Key, ...] = ()  # on which it is answered
    dwell_s = 0.0  # that the vehicle hovers before it measures
    waits_for = ""  # what it waits for before its vehicle is there for a search of several

    def __init__(self, together: Together) -> None:
        """Take the vehicles of its search."""
        self.together = together

    @property
    def services(self) -> frozenset[str]:
        """The services without which the search does not begin."""
        return self.together.services

    def latecomer(self) -> str:
        """Return why its vehicle cannot join a search that has begun; empty if it can."""
        return ""

    def measure(self, arrived: Arrived, time_boot_ms: int, number: int) -> Measured | None:
        """Take reading `number`; None: the values come later, through `take`."""
        raise NotImplementedError

    def go(self, places: Sequence[tuple[float, float]], step: int) -> None:
        """Learn where all vehicles that took part in round `step` go next, (x, y) m, in their order."""

    def blow(self, u: float | None, phi: float | None) -> None:
        """Change speed or direction of the wind in a simulated world; None: as it was."""

    def take(self, payload: bytes, wanted: bool) -> Measured | None:
        """Return what a message on one of `keys` says; `wanted`: whether the vehicle is still measuring.

        Raises BadFrame.
        """

    def prepare(self, waits_for: str, absent: Collection[str]) -> None:
        """Get ready; called while the search has not begun. waits_for: why not; absent: missing services.

        Raises VehicleFailed if it never will.
        """

    def go_on(self) -> None:
        """Send what is due."""

    def next_s(self) -> float:
        """Return when something is due, by time.monotonic()."""
        return math.inf
