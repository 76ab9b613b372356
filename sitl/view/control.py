"""Commands of an operator to a vehicle on the bus, as any ground station sends them, and the vehicle's answers."""

import asyncio
import time
from typing import Literal, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from link.bus.mavlink import BadFrame, Codec, Message
from scene.follow.telemetry import TEXT, Texts, frames
from sitl.autopilot.operator import OPERATOR, change_mode, command
from sitl.autopilot.state import Mode
from sitl.view.live import LiveVehicle

CommandName = Literal["pause", "resume", "return", "abort"]
ANSWER_S = 2.0
"""How long a vehicle may take to answer."""
REASON_S = 0.3
"""How long after a refusal its reason may come."""
ACK = mavlink.MAVLINK_MSG_ID_COMMAND_ACK
UNSAID = {
    mavlink.MAV_RESULT_TEMPORARILY_REJECTED: "the vehicle refuses it for now",
    mavlink.MAV_RESULT_DENIED: "the vehicle refuses it",
    mavlink.MAV_RESULT_UNSUPPORTED: "the vehicle does not know this command",
    mavlink.MAV_RESULT_FAILED: "the vehicle could not do it",
}
"""What a refusal means that comes without a reason."""


class CommandAnswer(NamedTuple):
    """What became of a command."""

    accepted: bool
    reason: str = ""


def message(name: CommandName, system: int) -> Message:
    """Return the message of a command to a system.

    pause: hold the position. resume: OFFBOARD, which gives the vehicle back to its search. return: fly home and land. abort: land here.
    """
    match name:
        case "pause":
            return change_mode(system, Mode.HOLD)
        case "resume":
            return change_mode(system, Mode.OFFBOARD)
        case "return":
            return command(system, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH)
        case "abort":
            return command(system, mavlink.MAV_CMD_NAV_LAND)


class Awaited:
    """The answer to one command, found among a vehicle's telemetry. Its times are of one clock, s."""

    def __init__(self, number: int, now_s: float) -> None:
        """Wait for the acknowledgement of a MAV_CMD."""
        self._number = number
        self._until_s = now_s + ANSWER_S
        self._refused = ""
        self._texts = Texts()

    def hears(self, payload: bytes, now_s: float) -> CommandAnswer | None:
        """Take a payload of telemetry; returns the answer once it is known. A refusal's reason is the text that follows it."""
        try:
            for message_id, fields in frames(payload, {ACK, TEXT}):
                if message_id == ACK and fields["command"] == self._number and _to_us(fields["target_system"], fields["target_component"]):
                    if fields["result"] == mavlink.MAV_RESULT_ACCEPTED:
                        return CommandAnswer(True)
                    if fields["result"] != mavlink.MAV_RESULT_IN_PROGRESS:
                        self._refused = UNSAID.get(fields["result"], f"the vehicle answered with result {fields['result']}")
                        self._until_s = now_s + REASON_S
                elif message_id == TEXT and (said := self._texts.said(fields)) and self._refused:
                    return CommandAnswer(False, said[1])
        except BadFrame:
            pass
        return None

    def over(self, now_s: float) -> CommandAnswer | None:
        """Return the answer that no more waiting gives; None before the time is over."""
        if now_s < self._until_s:
            return None
        return CommandAnswer(False, self._refused or f"no answer within {ANSWER_S:g} s")

    def left_s(self, now_s: float) -> float:
        """Time left to wait."""
        return max(self._until_s - now_s, 0.0)


def _to_us(system: int, component: int) -> bool:
    return system in (0, OPERATOR[0]) and component in (0, OPERATOR[1])


async def operate(vehicle: LiveVehicle, name: CommandName) -> CommandAnswer:
    """Send a command to a vehicle and wait for its answer."""
    if not vehicle.here:
        return CommandAnswer(False, f"{vehicle.name} is not there")
    loop, heard = asyncio.get_running_loop(), asyncio.Queue[bytes]()

    def listener(payload: bytes) -> None:
        loop.call_soon_threadsafe(heard.put_nowait, payload)

    said = message(name, vehicle.system)
    awaited = Awaited(said.command, time.monotonic())
    vehicle.listeners.add(listener)
    try:
        # In another thread: publishing waits where the router does not keep up.
        sent = asyncio.create_task(asyncio.to_thread(vehicle.send, Codec(*OPERATOR).pack(said)))
        answer = None
        while answer is None and (answer := awaited.over(time.monotonic())) is None:
            try:
                async with asyncio.timeout(awaited.left_s(time.monotonic())):
                    payload = await heard.get()
            except TimeoutError:
                continue
            answer = awaited.hears(payload, time.monotonic())
        sent.cancel()
        return answer
    finally:
        vehicle.listeners.discard(listener)
