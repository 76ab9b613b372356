"""What a microservice of MAVLink is here: which message it takes, what it answers, and how; and what all of them need of a vehicle."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from link.bus.mavlink import Message
from sitl.autopilot.config import VehicleConfig
from sitl.autopilot.motion import Ned
from sitl.autopilot.plan import FlightPlan, MissionProgress, MissionStep
from sitl.autopilot.setpoint import Companion, Setpoint
from sitl.autopilot.state import Mode, Result, State, VehicleEvent


class AnyVehicle(Protocol):
    """A vehicle as its protocol and its search know it: the simulated `Vehicle`, which says what all this is, or a real one."""

    config: VehicleConfig
    mission: FlightPlan
    companion: Companion

    @property
    def now_s(self) -> float:
        """The current time of the vehicle."""

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
    def landing(self) -> bool:
        """True from the beginning of a landing until the motors have stopped."""

    @property
    def waiting(self) -> bool:
        """True while its mission waits for a time."""

    @property
    def waypoint(self) -> Ned | None:
        """The last accepted position."""

    @property
    def progress(self) -> MissionProgress:
        """How far its mission is."""

    def catch_up(self, t_s: float) -> None:
        """Advance to a time; the next `advance` returns the events."""

    def advance(self, t_s: float) -> list[VehicleEvent]:
        """Advance to a time; return the events."""

    def next_event_s(self) -> float | None:
        """Return when to call `advance` again if no message comes."""

    def state(self, t_s: float) -> State:
        """Return the state at a time."""

    def configure(self, t_s: float, config: VehicleConfig) -> None:
        """Change the configuration."""

    def load(self, t_s: float, steps: tuple[MissionStep, ...], number: int = 0, current: int = 0) -> None:
        """Replace the mission."""

    def set_current(self, t_s: float, seq: int) -> Result:
        """Go on with another item of the mission."""

    def arm(self, t_s: float) -> Result:
        """Start the motors."""

    def disarm(self, t_s: float, force: bool = False) -> Result:
        """Stop the motors."""

    def take_off(self, t_s: float, altitude_m: float | None = None) -> Result:
        """Climb to an altitude above home."""

    def go_to(self, t_s: float, position: Ned, yaw_rad: float | None = None) -> Result:
        """Fly to a position and hold there."""

    def set_mode(self, t_s: float, mode: Mode) -> Result:
        """Change the flight mode."""

    def setpoint(self, t_s: float, wanted: Ned | Setpoint, yaw_rad: float | None = None, answers: bool = False) -> Result:
        """Take a waypoint or another setpoint."""


class Reply(NamedTuple):
    """The answer to a message: messages for its sender, and the reason if it was refused, for a STATUSTEXT (253)."""

    messages: list[Message]
    reason: str = ""
    kind: str = ""
    """Kind of reason that is told at most once a second, since clients repeat such messages many times a second; empty: tell always."""


class Microservice(NamedTuple):
    """One type of message and what becomes of it."""

    request: str
    """Message type."""
    answer: Callable[[Message, float], Reply]
    """Takes the message and the simulation time, s."""
    says: str
    """What the answer is, for the documentation."""
    supported: bool = True
    """False if the answer is a refusal, or tells that there is nothing."""


def asker(message: Message) -> tuple[int, int]:
    """System and component id of a message's sender: the target of its answer."""
    return message.get_srcSystem(), message.get_srcComponent()
