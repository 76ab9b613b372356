"""MAVLink commands of an operator or a companion computer, and how one is sent until it is done.

A mission script's operator events, the page and the companion of a real autopilot send them.
"""

from collections.abc import Callable
from copy import copy
from typing import Literal

from pymavlink.dialects.v20 import common as mavlink

from aircraft.state import ACCEPTED, Result, not_now
from link.bus.mavlink import ONBOARD_COMPUTER, Message
from link.modes import Mode

# What an operator wants: the words of the page and of mission scripts
CommandName = Literal["hold", "resume", "return", "land"]
# The flight mode that each leads to
MODES_WANTED: dict[CommandName, Mode] = {
    "hold": Mode.HOLD,
    "resume": Mode.OFFBOARD,
    "return": Mode.RETURN,
    "land": Mode.LAND,
}
# The command of each word to the search of a real vehicle: its number, and its param 1 if that counts
TO_SEARCH: dict[CommandName, tuple[int, ...]] = {
    "hold": (mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 0),
    "resume": (mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 1),
    "return": (mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH,),
    "land": (mavlink.MAV_CMD_NAV_LAND,),
}
OPERATOR_IDS = (255, mavlink.MAV_COMP_ID_MISSIONPLANNER)  # system id and component id of a ground station
# Component ids of a vehicle's autopilot, and of the search that flies a real one
AUTOPILOT, SEARCH = int(mavlink.MAV_COMP_ID_AUTOPILOT1), ONBOARD_COMPUTER
# System id and component id of the launcher, which ends a search whose budget is spent, and what people are
# told of it
LAUNCHER_IDS, BY_LAUNCHER = (OPERATOR_IDS[0], mavlink.MAV_COMP_ID_PATHPLANNER), "the launcher"
TRIES = 5  # times that a command is sent that nobody acknowledges
IN_PROGRESS_S = 10.0  # longest time for a command that the autopilot says is in progress
# Longest time until telemetry shows what an acknowledged command has changed: a HEARTBEAT comes once a second
DONE_S = 3.0
REASON_S = 0.3  # time in which the text with the reason follows a refusal
NO_ANSWER = "no answer"
# What people are told of an answer that comes without a reason
DEFAULT_REASONS = {
    mavlink.MAV_RESULT_TEMPORARILY_REJECTED: "the vehicle refuses it for now",
    mavlink.MAV_RESULT_DENIED: "the vehicle refuses it",
    mavlink.MAV_RESULT_UNSUPPORTED: "the vehicle does not know this command",
    mavlink.MAV_RESULT_FAILED: "the vehicle could not do it",
    mavlink.MAV_RESULT_IN_PROGRESS: "the vehicle is still at it",
}


def command(system: int, number: int, *params: float, component: int = AUTOPILOT) -> Message:
    """COMMAND_LONG (76) to a component of a system; parameters not given are 0."""
    return mavlink.MAVLink_command_long_message(
        system, component, number, 0, *params, *[0.0] * (7 - len(params))
    )


def companion_heartbeat(state: int) -> Message:
    """HEARTBEAT (0) of a companion computer in a MAV_STATE."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, state, 3
    )


def change_mode(system: int, mode: Mode) -> Message:
    """COMMAND_LONG (76) with MAV_CMD_DO_SET_MODE (176) and PX4's mode numbers."""
    return command(
        system, mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, *mode.value
    )


def order(name: CommandName, system: int, component: int = AUTOPILOT) -> Message:
    """Return the command of a word to a simulated autopilot, or to the `SEARCH` that flies a real one.

    hold: stay where it is. resume: give the vehicle back to its search. return: fly home and land. land:
    land here.
    """
    if component != SEARCH and name in ("hold", "resume"):
        return change_mode(system, MODES_WANTED[name])
    return command(system, *TO_SEARCH[name], component=component)


def word_of(number: int, param1: float) -> CommandName | None:
    """Return the word that a MAV_CMD and its param 1 are to the `SEARCH`; None if they are none."""
    said = (number,), (number, param1)
    return next((word for word, asked in TO_SEARCH.items() if asked in said), None)


def named(sender: tuple[int, int], whence: str) -> str:
    """Return in words who a sender is, by system and component id, and how its message came.

    Anybody can write any ids.
    """
    return BY_LAUNCHER if sender == LAUNCHER_IDS else f"{sender[0]}/{sender[1]} {whence}"


class CommandRun:
    """One command by MAVLink's protocol: sent until it is acknowledged, and done when telemetry shows it.

    It holds no link and no clock: its owner sends what is due, and tells what comes. An acknowledgement
    may be lost: each copy gets one.
    Telemetry counts more than they do: the acknowledgement of a command that was obeyed may be lost, and
    that of its copy be a refusal.

    Example:
        while (result := run.over(now_s)) is None:
            if copy := run.send(now_s): link.send(copy)
            for answer in link.receive(): run.acknowledged(answer.command, answer.result, now_s)
    """

    def __init__(
        self,
        message: Message,
        seen: Callable[[], bool],
        reason: Callable[[], str],
        every_s: float,
        done_s: float = DONE_S,
        reason_s: float = REASON_S,
    ) -> None:
        """Begin with a COMMAND_LONG. Times are of the caller's clock, s.

        seen: whether telemetry shows that it is done; reason: the text, if any, that came with a refusal;
        every_s: time between copies;
        done_s, reason_s: longest time until telemetry shows it, and until the reason of a refusal comes.
        """
        self._message, self._seen, self._reason = message, seen, reason
        self._every_s, self._done_s, self._reason_s = every_s, done_s, reason_s
        self._copies, self._due_s = 0, -1e9
        self._result: int | None = None
        self._answered_s = 0.0

    @property
    def accepted(self) -> bool:
        """Whether it was acknowledged as accepted."""
        return self._result == int(mavlink.MAV_RESULT_ACCEPTED)

    @property
    def refused(self) -> bool:
        """Whether it was acknowledged as refused."""
        return self._result not in (None, mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS)

    def send(self, now_s: float) -> Message | None:
        """Return the next copy of the command if it is due, numbered by its `confirmation`."""
        if self._result is not None or self._copies == TRIES or now_s < self._due_s:
            return None
        again = copy(self._message)
        again.confirmation = self._copies
        self._copies += 1
        self._due_s = now_s + self._every_s
        return again

    def acknowledged(self, number: int, result: int, now_s: float) -> None:
        """Take a COMMAND_ACK: the MAV_CMD and its MAV_RESULT.

        The first result counts, unless it says that more will follow.
        """
        if number == self._message.command and self._result in (None, mavlink.MAV_RESULT_IN_PROGRESS):
            self._result, self._answered_s = result, now_s

    def over(self, now_s: float) -> Result | None:
        """Return what became of it, once that is known."""
        if self._seen():
            return ACCEPTED
        if self._result is None:
            return not_now(NO_ANSWER) if self._copies == TRIES and now_s >= self._due_s else None
        reason, waited_s = "", now_s - self._answered_s
        if self.accepted:
            return not_now("acknowledged, and not done") if waited_s >= self._done_s else None
        longest_s = IN_PROGRESS_S
        if self.refused:
            reason, longest_s = self._reason(), self._reason_s
        if not reason and waited_s < longest_s:
            return None
        return Result(
            self._result,
            reason or DEFAULT_REASONS.get(self._result, f"the vehicle answered with result {self._result}"),
        )
