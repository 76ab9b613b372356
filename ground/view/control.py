"""Commands of an operator to a vehicle on the bus, as any ground station sends them, and its answers."""

import asyncio
import time
from contextlib import suppress
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from aircraft.operator import (
    AUTOPILOT,
    MODES_WANTED,
    NO_ANSWER,
    OPERATOR_IDS,
    SEARCH,
    TRIES,
    CommandName,
    CommandRun,
    order,
)
from ground.view.live import LiveVehicle
from link.bus.frames import Frame
from link.bus.mavlink import BadFrame, Codec, Texts
from link.modes import Mode, meaning
from scene.follow.area import HEARTBEAT
from scene.follow.telemetry import TEXT, frames

# Commands that wait for nothing: they replace one that is not answered yet.
URGENT: tuple[CommandName, ...] = ("return", "land")
AGAIN_S = 0.4  # time after which a command that nobody has acknowledged is sent again
ANSWER_S = TRIES * AGAIN_S  # longest time without an acknowledgement
LOOK_S = 0.05  # longest time between two looks at a command that is not over
# Systems and components that an acknowledgement to us is for: 0 is everybody.
TO_US = {(system, component) for system in (0, OPERATOR_IDS[0]) for component in (0, OPERATOR_IDS[1])}
ACK = mavlink.MAVLINK_MSG_ID_COMMAND_ACK


class CommandAnswer(NamedTuple):
    """What became of a command."""

    accepted: bool
    reason: str = ""


class Awaited:
    """One command and what its vehicle says meanwhile. Its times are of one clock, s."""

    def __init__(self, name: CommandName, system: int, component: int = AUTOPILOT) -> None:
        """Begin with a command to a component: the simulated autopilot, or the search of a real one."""
        self._name, self._system, self._component = name, system, component
        self.run = CommandRun(order(name, system, component), self._seen, lambda: self._reason, AGAIN_S)
        self._texts = Texts()
        self._reason = self._mode = ""
        self._armed = True

    def hears(self, payload: bytes, now_s: float) -> None:
        """Take a payload of telemetry. The reason of a refusal is the text that follows it."""
        with suppress(BadFrame):
            for frame, fields in frames(payload, {ACK, HEARTBEAT, TEXT}, self._counts):
                if frame.message_id == HEARTBEAT:
                    self._mode = meaning(fields["autopilot"], fields["custom_mode"])
                    self._armed = bool(fields["base_mode"] & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
                elif frame.message_id == TEXT:
                    text = self._texts.joined(fields["text"], fields["id"], fields["chunk_seq"])
                    self._reason = text if text and self.run.refused else self._reason
                elif (fields["target_system"], fields["target_component"]) in TO_US:
                    self.run.acknowledged(fields["command"], fields["result"], now_s)

    def over(self, now_s: float) -> CommandAnswer | None:
        """Return the answer once it is known."""
        if (result := self.run.over(now_s)) is None:
            return None
        reason = f"{NO_ANSWER} within {ANSWER_S:g} s" if result.reason == NO_ANSWER else result.reason
        return CommandAnswer(result.accepted, reason)

    def _counts(self, frame: Frame) -> bool:
        """Whether a frame is the autopilot's HEARTBEAT, or what the commanded component says."""
        speaker = AUTOPILOT if frame.message_id == HEARTBEAT else self._component
        return (frame.system, frame.component) == (self._system, speaker)

    def _seen(self) -> bool:
        """Whether the vehicle does it, or once it has accepted, is through with it.

        A return ends as a landing, motors off. A real vehicle that is given back has to accept it: a pilot
        may fly it in the very mode in which the search does.
        """
        given_back = self._name == "resume" and self._component == SEARCH
        if self._mode == MODES_WANTED[self._name].name and (self.run.accepted or not given_back):
            return True
        landing = self._name == "return" and self._mode == Mode.LAND.name
        return self.run.accepted and (landing or not self._armed)


async def operate(vehicle: LiveVehicle, name: CommandName) -> CommandAnswer:
    """Send a command to a vehicle until it is done, and return its answer.

    Once this is cancelled, nothing more is sent.
    """
    if not vehicle.here:
        return CommandAnswer(False, f"{vehicle.name} is not there")
    until_s = time.monotonic() + ANSWER_S
    while not vehicle.system:  # it is told as soon as the bus is joined
        if time.monotonic() >= until_s:
            return CommandAnswer(False, f"{vehicle.name} has not said which system it is")
        await asyncio.sleep(LOOK_S)
    loop, heard = asyncio.get_running_loop(), asyncio.Queue[bytes]()

    def listener(payload: bytes) -> None:
        loop.call_soon_threadsafe(heard.put_nowait, payload)

    awaited, codec = Awaited(name, vehicle.system, vehicle.commanded), Codec(*OPERATOR_IDS)
    vehicle.listeners.add(listener)
    try:
        while (answer := awaited.over(time.monotonic())) is None:
            if copy := awaited.run.send(time.monotonic()):
                vehicle.send(codec.pack(copy))
            with suppress(TimeoutError):
                async with asyncio.timeout(LOOK_S):
                    awaited.hears(await heard.get(), time.monotonic())
        return answer
    finally:
        vehicle.listeners.discard(listener)
