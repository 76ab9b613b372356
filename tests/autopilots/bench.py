"""A companion in step with a double: it speaks pymavlink's frames, and time passes only when a test says
so.
"""

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.autopilots.body import DT_S
from tests.autopilots.settings import Settings
from tests.autopilots.wire import Wire

Message = Any
POSITION = 0x0DF8
VELOCITY = 0x0DC7
STATION = 255


class Bench:
    """A double and its companion. `heard` holds every (simulation time in s, message)."""

    def __init__(
        self, kind: str, *faults: str, parameters: dict[str, float] | None = None, **settings: Any
    ) -> None:
        self.wire = Wire(
            kind, Settings(faults=faults, parameters=tuple((parameters or {}).items()), **settings)
        )
        self.heard: list[tuple[float, Message]] = []
        self._newest: dict[str, Message] = {}
        self._mav = {
            system: mavlink.MAVLink(None, srcSystem=system, srcComponent=191) for system in (1, STATION)
        }
        self._parser = mavlink.MAVLink(None)
        self.stream: Message | None = None
        """A message that is sent at 20 Hz all the time."""

    def send(self, message: Message, system: int = 1) -> None:
        """Send one message."""
        self.wire.hear(bytes(message.pack(self._mav[system])))

    def run(self, seconds: float) -> None:
        """Let simulation time pass."""
        for _ in range(round(seconds / DT_S)):
            if self.stream is not None and self.wire.autopilot.steps % 3 == 0:
                self.send(self.stream)
            for frame in self.wire.advance():
                for one in self._parser.parse_buffer(frame) or ():
                    self.heard.append((self.wire.autopilot.now_s, one))
                    self._newest[one.get_type()] = one

    def run_until(self, holds: Any, most_s: float = 120.0) -> float:
        """Let time pass until something holds; return how long that took."""
        began = self.wire.autopilot.now_s
        while not holds():
            assert self.wire.autopilot.now_s - began < most_s, f"not true within {most_s:g} s"
            self.run(DT_S)
        return self.wire.autopilot.now_s - began

    def command(self, number: int, *values: float, target: int = 1) -> int | None:
        """Send COMMAND_LONG; return the result, or None without an answer."""
        before = len(self.heard)
        values = (*values, *[0.0] * (7 - len(values)))
        self.send(mavlink.MAVLink_command_long_message(target, 1, number, 0, *values))
        self.run(DT_S)
        acks = [
            one.result
            for _, one in self.heard[before:]
            if one.get_type() == "COMMAND_ACK" and one.command == number
        ]
        return acks[0] if acks else None

    def ask(self, *numbers: int, hz: float = 50.0) -> None:
        """SET_MESSAGE_INTERVAL."""
        for number in numbers:
            assert self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / hz) == 0

    def all(self, kind: str) -> list[Message]:
        """Every message of a type."""
        return [one for _, one in self.heard if one.get_type() == kind]

    def last(self, kind: str) -> Message:
        """The newest message of a type."""
        return self._newest[kind]

    @property
    def texts(self) -> list[str]:
        """Every STATUSTEXT, chunks joined."""
        whole: list[str] = []
        for one in self.all("STATUSTEXT"):
            whole[-1:] = [whole[-1] + one.text] if one.chunk_seq else [*whole[-1:], one.text]
        return whole

    @property
    def armed(self) -> bool:
        """As the newest heartbeat says."""
        return bool(self.last("HEARTBEAT").base_mode & 128)

    @property
    def mode(self) -> tuple[int, ...]:
        """(custom mode) of ArduPilot, (main, sub) of PX4, as the newest heartbeat says."""
        number = self.last("HEARTBEAT").custom_mode
        return (number >> 16 & 255, number >> 24) if self.last("HEARTBEAT").autopilot == 12 else (number,)

    @property
    def at(self) -> tuple[float, float, float]:
        """The newest LOCAL_POSITION_NED."""
        one = self.last("LOCAL_POSITION_NED")
        return one.x, one.y, one.z

    def home(self) -> tuple[float, float, float]:
        """HOME_POSITION, asked for."""
        self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 242)
        one = self.last("HOME_POSITION")
        return one.x, one.y, one.z


def target(
    place: tuple[float, float, float], mask: int = POSITION, frame: int = 1, system: int = 1
) -> Message:
    """SET_POSITION_TARGET_LOCAL_NED; with the VELOCITY mask `place` is a velocity."""
    values = (0.0, 0.0, 0.0, *place) if mask == VELOCITY else (*place, 0.0, 0.0, 0.0)
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, system, 1, frame, mask, *values, 0, 0, 0, 0, 0
    )


def heartbeat(kind: int = mavlink.MAV_TYPE_ONBOARD_CONTROLLER) -> Message:
    """A companion's, or a ground station's."""
    return mavlink.MAVLink_heartbeat_message(kind, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
